"""The peel against a naive one, against exact optima, and what it promises: a feasible superset."""

from __future__ import annotations

import itertools
import math
import time

import numpy as np
import pytest
from numba import config

import oracles
from instances import BUILDERS, synthetic
from maxcon.minimax import allocate
from maxcon.minimax.linear import OK, cold_fit
from maxcon.problem import LinearProblem
from maxcon.search import peel as peel_module
from maxcon.search.anytime import make_task, run
from maxcon.search.peel import peel, peel_improve
from maxcon.search.peel_kernels import include_within, peel_down
from maxcon.search.sampling import lo_ransac, ransac

compiled_only = pytest.mark.skipif(config.DISABLE_JIT, reason="takes minutes where kernels are interpreted")


def task_for(A, b, threshold, seed=0, time_limit=None):
    return make_task(LinearProblem(A, b), threshold, np.random.default_rng(seed), time_limit)


def size_found(task, method=peel, **options):
    return run(task, method(task, **options)).size


def start_set(task, samples=20):
    """A mediocre feasible set."""
    return run(task, ransac(task, samples=samples)).subset


def naive_peel(A, b, limit, rho, reach):
    """Remove the basis point with the largest incumbent residual from exact fits, until feasible."""
    kept = np.flatnonzero(rho <= reach)
    while True:
        value, basis = oracles.minimax_fit(A[kept], b[kept])
        if value <= limit:
            return kept
        kept = np.delete(kept, max(basis, key=lambda k: rho[kept[k]]))


@pytest.mark.parametrize(("N", "d", "rate"), [(30, 1, 0.5), (30, 2, 0.5), (40, 3, 0.4), (40, 5, 0.3)])
def test_peeling_down_follows_the_definition(N, d, rate):
    for seed, reach in itertools.product(range(4), (math.inf, 4.0)):
        A, b = synthetic(np.random.default_rng(seed), N, d, rate)
        task = task_for(A, b, 0.1)
        rng = np.random.default_rng(seed)
        rho = np.abs(task.rows.b - task.rows.At.T @ (0.02 * rng.standard_normal(d)))
        workspace = allocate(task.rows)
        assert include_within(workspace, rho, reach * task.limit) == OK
        status, removed = peel_down(workspace, rho, task.limit, 1000)
        assert status == OK
        limit = 0.1 + oracles.default_slack(0.1, b)
        expected = naive_peel(A, b, limit, rho, reach * task.limit)
        assert np.array_equal(np.flatnonzero(workspace.gain == 1.0), expected)
        assert removed == np.count_nonzero(rho <= reach * task.limit) - len(expected)


@pytest.mark.parametrize("name", BUILDERS)
def test_improvement_is_a_feasible_superset_that_takes_no_more(name):
    rng = np.random.default_rng(13)
    for d, N in ((1, 8), (2, 10), (3, 11)):
        A, b = BUILDERS[name](rng, N, d)
        value = oracles.highs_linprog(A, b)[0]
        for threshold in (0.3 * value if value > 1e-9 else 0.1, 1.0):
            optimum = oracles.brute_force_consensus(A, b, threshold)
            limit = threshold + oracles.default_slack(threshold, b)
            task = task_for(A, b, threshold)
            subset = start_set(task, samples=1)
            if subset is None:
                assert optimum == 0 or not A.any()
                continue
            improved = peel_improve(task, subset)
            assert improved[subset].all()
            assert improved.sum() <= optimum
            assert oracles.highs_minimax(A[improved], b[improved]) <= limit * (1 + 1e-12)
            for point in np.flatnonzero(~improved):
                larger = improved.copy()
                larger[point] = True
                assert oracles.highs_minimax(A[larger], b[larger]) > limit * (1 - 1e-12)


@pytest.mark.parametrize("start", ["lo-ransac", "gnc"])
@pytest.mark.parametrize("name", BUILDERS)
def test_never_above_the_optimum_and_mostly_at_it(name, start):
    rng = np.random.default_rng(14)
    short = 0
    for d, N in ((1, 8), (2, 10), (3, 11)):
        A, b = BUILDERS[name](rng, N, d)
        value = oracles.highs_linprog(A, b)[0]
        for threshold in (0.3 * value if value > 1e-9 else 0.1, 1.0):
            optimum = oracles.brute_force_consensus(A, b, threshold)
            limit = threshold + oracles.default_slack(threshold, b)
            best = 0
            for step in peel(task_for(A, b, threshold), samples=300, start=start, restarts=5):
                if step.subset is not None:
                    best = max(best, int(step.subset.sum()))
                    assert oracles.highs_minimax(A[step.subset], b[step.subset]) <= limit * (1 + 1e-12)
            assert best <= optimum
            short += optimum - best
    assert short <= 2  # of six instances


@compiled_only
@pytest.mark.parametrize("outliers", [10, 15, 20])
def test_finds_all_planted_inliers_in_eight_dimensions(outliers):
    """From LO-RANSAC, which alone is one to two points short."""
    lo, peeled = [], []
    for seed in range(20):
        A, b = synthetic(np.random.default_rng(seed), 100, 8, outliers / 100)
        lo.append(size_found(task_for(A, b, 0.1), lo_ransac, samples=2000))
        peeled.append(size_found(task_for(A, b, 0.1)))
    assert min(peeled) >= 100 - outliers
    assert np.mean(peeled) > np.mean(lo) + 0.5


def test_lines_reach_the_exact_optimum():
    for seed in range(10):
        A, b = synthetic(np.random.default_rng(seed), 40, 2, 0.4)
        task = task_for(A, b, 0.1)
        assert run(task, peel(task)).size == oracles.line_consensus_bruteforce(A[:, 0], b, 0.1)


@pytest.mark.parametrize(("d", "N", "rate"), [(3, 300, 0.5), (8, 100, 0.5)])
def test_small_pieces_change_nothing(monkeypatch, d, N, rate):
    for seed in range(5):
        task = task_for(*synthetic(np.random.default_rng(seed), N, d, rate), 0.1)
        subset = start_set(task, samples=100)
        whole = peel_improve(task, subset)
        monkeypatch.setattr(peel_module, "PIECE", 1)  # a step after each refit
        assert np.array_equal(peel_improve(task, subset), whole)
        monkeypatch.undo()
        assert whole[subset].all()


@compiled_only
def test_the_deadline_cuts_an_improvement_short():
    A, b = synthetic(np.random.default_rng(0), 20_000, 8, 0.5)
    task = task_for(A, b, 0.1, time_limit=60.0)
    subset = start_set(task, samples=300)
    began = time.perf_counter()
    late = task_for(A, b, 0.1, time_limit=0.0)
    improved = peel_improve(late, subset)
    assert time.perf_counter() - began < 1.5
    assert improved.sum() >= subset.sum()


def test_infeasible_and_complete_sets_come_back_as_they_are():
    A, b = synthetic(np.random.default_rng(0), 30, 3, 0.5)
    everything = np.ones(30, dtype=bool)
    assert np.array_equal(peel_improve(task_for(A, b, 0.1), everything), everything)  # infeasible: not its business
    assert np.array_equal(peel_improve(task_for(A, b, 100.0), everything), everything)


def test_a_single_point_grows():
    A, b = synthetic(np.random.default_rng(2), 50, 2, 0.2)
    task = task_for(A, b, 0.1)
    subset = np.zeros(50, dtype=bool)
    subset[7] = True
    improved = peel_improve(task, subset)
    assert improved[7]
    assert improved.sum() > 1
    workspace = allocate(task.rows, improved)
    assert cold_fit(*workspace) == OK
    assert workspace.x[-1] <= task.limit


@pytest.mark.parametrize("start", ["lo-ransac", "gnc"])
def test_seeds_decide(start):
    A, b = BUILDERS["uniform_noise"](np.random.default_rng(1), 60, 4)

    def masks(seed):
        steps = peel(task_for(A, b, 0.1, seed), samples=100, restarts=4, start=start)
        return [step.subset.tobytes() for step in steps if step.subset is not None]

    assert masks(1) == masks(1)
    assert masks(1) != masks(2)


def test_restarts_draw_anew():
    A, b = BUILDERS["uniform_noise"](np.random.default_rng(3), 100, 6)
    one = size_found(task_for(A, b, 0.1), samples=50)
    ten = size_found(task_for(A, b, 0.1), samples=50, restarts=10)
    assert ten > one


def test_restarts_go_on_until_the_time_is_over():
    A, b = synthetic(np.random.default_rng(3), 30, 2, 0.3)
    endless = peel(task_for(A, b, 0.1, time_limit=60.0), samples=5, restarts=None)
    assert sum(1 for _ in itertools.islice(endless, 100)) == 100
    assert size_found(task_for(A, b, 0.1, time_limit=0.2), samples=5, restarts=None) >= 20


def test_no_parameters_and_no_inliers():
    b = np.array([1.0, 2.0, 2.0, -3.0])
    assert size_found(task_for(np.zeros((4, 2)), b, 2.0)) == 3
    assert size_found(task_for(np.zeros((4, 2)), b, 0.5)) == 0


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"samples": 0}, ValueError, "samples must be at least 1"),
        ({"restarts": -1}, ValueError, "restarts must be at least 0"),
        ({"restarts": None}, ValueError, "restarts must be a number where there is no time limit"),
        ({"start": "magic"}, ValueError, "start must be 'lo-ransac' or 'gnc'"),
        ({"reach": 0.5}, ValueError, "reach must be at least 1"),
        ({"reach": math.nan}, ValueError, "reach must be at least 1"),
        ({"reach": "far"}, TypeError, "reach must be a number"),
    ],
)
def test_options_are_checked(options, error, match):
    A, b = synthetic(np.random.default_rng(0), 20, 2, 0.2)
    with pytest.raises(error, match=match):
        peel(task_for(A, b, 0.1), **options)
