"""What "auto" does beyond three parameters: when it stops for a proof, and what it does where none is in reach."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from numba import config

from instances import synthetic
from maxcon.agent.search_networks import shipped_search_networks
from maxcon.problem import LinearProblem
from maxcon.search import portfolio
from maxcon.search.anytime import Step, make_task, run
from maxcon.search.learned import learned
from oracles import milp_consensus

compiled_only = pytest.mark.skipif(config.DISABLE_JIT, reason="takes minutes where kernels are interpreted")

#: Seconds that no test takes: one that does has missed the proof that should have ended it.
LONG = 60.0


briefly = partial(learned, rounds=8)


def task_for(rate, time_limit, n_points=30, d=5, seed=0):
    A, b = synthetic(np.random.default_rng(seed), n_points, d, rate)
    return make_task(LinearProblem(A, b), 0.1, np.random.default_rng(0), time_limit)


@compiled_only
@pytest.mark.parametrize("seed", range(4))
def test_easy_data_are_proven_in_between(seed):
    task = task_for(0.15, LONG, seed=seed)
    best = run(task, portfolio._learned_and_proof(task, learned))
    assert best.gap == 0
    assert best.size == milp_consensus(task.problem.A, task.problem.b, 0.1)
    assert task.seconds_left() > 0.5 * LONG


def test_what_cannot_be_proven_in_time_is_not_begun(monkeypatch):
    task = task_for(0.15, LONG)
    monkeypatch.setattr(portfolio, "PROOF_RATE", 1e9)
    monkeypatch.setattr(portfolio, "exact_partition", lambda *_, **__: pytest.fail("a proof was begun"))
    steps = list(portfolio._learned_and_proof(task, briefly))
    assert any(step.settled for step in steps)


@compiled_only
def test_a_proof_in_between_has_its_time_and_the_search_the_rest(monkeypatch):
    given = []

    def fruitless(task, **_):
        given.append(task.seconds_left())
        yield Step(upper_bound=29)

    monkeypatch.setattr(portfolio, "exact_partition", fruitless)
    steps = list(portfolio._learned_and_proof(task_for(0.15, LONG), briefly))
    place = next(k for k, step in enumerate(steps) if step.upper_bound == 29)
    assert steps[place - 1].settled
    assert place + 1 < len(steps)
    sets = [step.subset for step in steps[:place] if step.subset is not None]
    assert portfolio.PROOF_TIMES * portfolio.reckoned_proof(sets[-1]) < portfolio.LEAST_SHARE * LONG
    assert given[0] == pytest.approx(portfolio.LEAST_SHARE * LONG, rel=0.05)
    monkeypatch.setattr(portfolio, "PROOF_TIMES", 1e9)
    list(portfolio._learned_and_proof(task_for(0.15, LONG), briefly))
    assert given[1] == pytest.approx(portfolio.PROOF_SHARE * LONG, rel=0.05)


@compiled_only
def test_a_proof_that_does_not_end_gives_the_time_back(monkeypatch):
    """It is the caller who stops the exact search, which goes on in small steps when its time is over."""
    monkeypatch.setattr(portfolio, "PROOF_RATE", 1e-18)
    task = task_for(0.6, 1.0, n_points=300, d=8)
    proving = []
    for step in portfolio._learned_and_proof(task, learned):
        proving.append(step.upper_bound is not None)
        if task.over():
            break
    assert any(proving)
    assert not proving[-1]


def test_the_reckoned_time_grows_with_points_and_outliers():
    few, many, more = (np.arange(n) >= out for n, out in ((100, 20), (100, 40), (200, 40)))
    assert portfolio.reckoned_proof(many) == pytest.approx(100 * portfolio.reckoned_proof(few))
    assert portfolio.reckoned_proof(more) == pytest.approx(4 * portfolio.reckoned_proof(few))


@compiled_only
@pytest.mark.parametrize("out_of_reach", [True, False])
def test_where_a_proof_is_out_of_reach_the_search_goes_on(monkeypatch, out_of_reach):
    monkeypatch.setattr(portfolio, "PROOF_RATE", 1e9 if out_of_reach else 1e-18)
    limits, last = [], []

    def noted(task, **options):
        limits.append(task.seconds_left())
        return learned(task, rounds=4, **options)

    def bounded(task, *, start, **_):
        last.append((task.seconds_left(), np.count_nonzero(start)))
        yield Step()

    monkeypatch.setattr(portfolio, "learned", noted)
    monkeypatch.setattr(portfolio, "exact_partition", bounded)
    task = task_for(0.5, LONG)
    best = run(task, portfolio.auto(task))
    assert len(limits) == (2 if out_of_reach else 1)
    assert limits[0] == np.inf
    if out_of_reach:
        assert limits[1] == pytest.approx((1 - portfolio.BOUND_SHARE) * LONG, rel=0.05)
    assert last[-1][1] == best.size


@compiled_only
def test_ones_own_networks_are_searched_with(tmp_path, monkeypatch):
    nets, used = shipped_search_networks(), []

    def noted(task, *, network, **options):
        used.append(network)
        return learned(task, network=network, **options)

    monkeypatch.setattr(portfolio, "learned", noted)
    for time_limit in (1e-4, LONG):
        list(portfolio.auto(task_for(0.1, time_limit), network=nets))
    assert len(used) >= 2
    assert all(each is nets for each in used)
    with pytest.raises(ValueError, match="there is no file"):
        portfolio.auto(task_for(0.1, None), network=tmp_path / "none.safetensors")
