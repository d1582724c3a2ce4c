"""Walks by the peel network: where they end, what they remove, and what they tell of it."""

import numpy as np
import pytest

from instances import BUILDERS, synthetic
from maxcon.agent.search_networks import shipped_search_networks
from maxcon.minimax import allocate, minimax_fit
from maxcon.minimax.linear import OK, cold_fit
from maxcon.problem import LinearProblem
from maxcon.search.anytime import make_task
from maxcon.search.learned_kernels import begin_search
from maxcon.search.learned_memory import allocate_arena, carve
from maxcon.search.peel_walk import ONE_OF, choose_start, install_walk, walk_down
from maxcon.search.random_kernels import seed_state


def walked(A, b, threshold, reach=np.inf, explore=0.0, log_steps=40, seed=0, loyal=False):
    task = make_task(LinearProblem(A, b), threshold, np.random.default_rng(seed))
    nets = shipped_search_networks()
    arena = allocate_arena(task.rows, seed_state(task.rng), nets.points, nets.peel, log_steps)
    begin_search(arena, task.limit)
    search = carve(arena)
    r = task.rows.b - task.rows.At.T @ search.x
    m = choose_start(r, reach * task.limit, search.walk.points)
    start = search.walk.points[:m].copy()
    kept = np.zeros(0, dtype=bool) if not loyal else search.member
    args = (task.rows.At, task.rows.b, task.limit, nets.peel, m, 0, np.inf, r, 0.5, explore, kept, search.belief)
    status, removed, steps = walk_down(*args, search.scratch.state, search.walk)
    assert steps <= removed <= (1 + m // ONE_OF) * steps
    return task, search, start, status, removed


@pytest.mark.parametrize("name", BUILDERS)
def test_a_walk_ends_at_the_fit_of_a_feasible_set(name):
    for seed in range(2):
        rng = np.random.default_rng([seed, 5])
        A, b = BUILDERS[name](rng, 25, int(rng.integers(1, 5)))
        threshold = float(0.2 * np.abs(b).max() + 1e-6)
        task, search, start, status, removed = walked(A, b, threshold, explore=0.5 * seed)
        if status != OK:
            assert name in {"bad_column", "graded_columns", "vandermonde"}  # rounding, and nothing is claimed
            continue
        install_walk(search.ws, len(start), search.walk)
        kept = search.ws.gain == 1.0
        assert kept.sum() == len(start) - removed
        assert set(np.flatnonzero(kept)) <= set(start.tolist())
        if kept.any():
            value = minimax_fit(task.problem, kept).value
            assert value <= threshold * (1 + 1e-8) + 1e-11 * task.problem.scale
            assert search.ws.x[-1] * task.rows.scale == pytest.approx(value, rel=1e-7, abs=1e-11 * task.problem.scale)


def test_each_step_removes_a_point_of_the_basis_that_it_logs():
    rng = np.random.default_rng(8)
    A, b = BUILDERS["synthetic_some"](rng, 60, 3)
    task, search, start, status, removed = walked(A, b, 0.1, reach=30.0)
    assert status == OK
    assert 3 < removed <= 40
    assert np.isfinite(search.walk.log[:removed, 0]).all()
    workspace = allocate(task.rows)
    inside = np.zeros(60, dtype=bool)
    inside[start] = True
    final = np.zeros(60, dtype=bool)
    final[start[search.walk.gain[: len(start)] == 1.0]] = True
    for step in range(removed):
        basis = search.walk.log_basis[step]
        basis = set(basis[basis >= 0].tolist())
        workspace.gain[:], workspace.cap[:] = np.where(inside, 1.0, 0.0), np.where(inside, 0.0, np.inf)
        assert cold_fit(*workspace) == OK
        assert workspace.x[-1] > task.limit
        assert search.walk.log[step, 0, 0] == pytest.approx(np.log(workspace.x[-1] / task.limit))
        assert basis <= set(np.flatnonzero(inside).tolist())
        later = search.walk.log_basis[step + 1] if step + 1 < removed else np.array([-1])
        gone = [p for p in basis if not final[p] and p not in later[later >= 0]]
        assert gone
        # One of them left here: the one without which the next basis is the basis.
        for p in gone:
            rest = inside.copy()
            rest[p] = False
            if step + 1 == removed or set(minimax_fit(task.problem, rest).basis.tolist()) == set(later[later >= 0]):
                inside = rest
                break
        else:
            pytest.fail("no point of the logged basis leads to the next")


@pytest.mark.parametrize("name", ["synthetic_some", "quantised", "duplicate_a", "uniform_noise", "leverage_outliers"])
def test_a_loyal_walk_keeps_the_incumbent(name):
    for seed in range(4):
        A, b = BUILDERS[name](np.random.default_rng([seed, 6]), 40, 3)
        _, search, start, status, removed = walked(A, b, 0.3, reach=20.0, loyal=True)
        assert status == OK
        install_walk(search.ws, len(start), search.walk)
        assert (search.ws.gain == 1.0)[search.member].all()
        assert removed + search.member.sum() <= len(start)


@pytest.mark.parametrize("loyal", [False, True])
def test_of_many_points_several_are_removed_in_a_step(loyal):
    A, b = synthetic(np.random.default_rng(3), 3 * ONE_OF, 3, 0.2)
    task, search, start, status, removed = walked(A, b, 0.1, reach=1.5, loyal=loyal)
    assert status == OK
    assert len(start) > 2 * ONE_OF
    install_walk(search.ws, len(start), search.walk)
    kept = search.ws.gain == 1.0
    assert kept.sum() == len(start) - removed
    assert minimax_fit(task.problem, kept).value <= 0.1 * (1 + 1e-8)
    if loyal:
        assert kept[search.member].all()
    steps = np.count_nonzero(search.walk.log[:, 0, 0])
    assert 1.5 * steps < removed


def test_exploring_walks_are_seeded():
    A, b = BUILDERS["synthetic_some"](np.random.default_rng(2), 50, 3)
    ends = [walked(A, b, 0.1, explore=0.9, seed=seed)[1].walk.gain.copy() for seed in (0, 0, 1)]
    np.testing.assert_array_equal(ends[0], ends[1])
    assert (ends[0] != ends[2]).any()


def test_a_walk_from_nothing_fails():
    A, b = BUILDERS["uniform_noise"](np.random.default_rng(2), 20, 2)
    _, _, start, status, _ = walked(A, b, 0.1, reach=-1.0)
    assert len(start) == 0
    assert status != OK
