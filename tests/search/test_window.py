"""Walks and swaps in a window of many points: what is found there is a set of all points that one model explains."""

import numpy as np
import pytest

from instances import synthetic
from maxcon.agent.search_networks import shipped_search_networks
from maxcon.minimax import allocate, minimax_fit
from maxcon.minimax.linear import OK, cold_fit
from maxcon.problem import LinearProblem
from maxcon.search.anytime import make_task
from maxcon.search.belief_proposals import MANY
from maxcon.search.learned_kernels import (
    WALK_INCUMBENT,
    begin_search,
    finish_search,
    play_parts,
    swap_search,
)
from maxcon.search.learned_memory import IN_WINDOW, SIZE, SWAPPED, WHOLLY, allocate_arena, carve
from maxcon.search.learned_settings import Settings
from maxcon.search.peel_walk import walk_workspace
from maxcon.search.random_kernels import seed_state
from maxcon.search.refine_kernels import allocate_refinement, refine_kernel, swap_by, swap_kernel
from maxcon.search.window import CORE, OUTER, choose_window, window_scratch


def search_on(A, b, threshold):
    task = make_task(LinearProblem(A, b), threshold, np.random.default_rng(0))
    nets = shipped_search_networks()
    arena = allocate_arena(task.rows, seed_state(task.rng), nets.points, nets.peel)
    begin_search(arena, task.limit)
    return task, arena


def test_a_window_holds_the_residuals_between_core_and_edge():
    r = np.array([0.0, -0.1, 0.15, -0.5, 2.0, -2.5, 2.6, 9.0])
    points = np.full(len(r), -1)
    m, below = choose_window(r, CORE, OUTER, points)
    np.testing.assert_array_equal(points[:m], [2, 3, 4, 5])
    assert below == 2
    assert choose_window(r, 0.0, np.inf, points) == (len(r), 0)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("quantised", [False, True])
def test_of_many_points_the_incumbent_stays_a_feasible_set_and_never_shrinks(seed, quantised):
    A, b = synthetic(np.random.default_rng(seed), MANY + 1 + 40 * seed, 4, 0.4)
    if quantised:
        A, b = np.round(4.0 * A) / 4.0, np.round(20.0 * b) / 20.0
    task, arena = search_on(A, b, 0.1)
    counts, member = arena.integers, arena.flags[: len(b)]
    sizes = [int(counts[SIZE])]

    def check():
        assert counts[SIZE] == member.sum() >= sizes[-1]
        assert minimax_fit(task.problem, member.copy()).value <= 0.1 * (1 + 1e-8)
        sizes.append(int(counts[SIZE]))

    play_parts(arena, task.limit, Settings(), WALK_INCUMBENT, WALK_INCUMBENT + 1)
    check()
    swap_search(arena, task.limit)
    assert counts[SWAPPED] in (0, IN_WINDOW)  # 0: a better set has not been swapped itself
    check()
    for _ in range(3):
        play_parts(arena, task.limit, Settings(), 0, 7)
        check()
    finish_search(arena, task.limit)
    check()
    if counts[SWAPPED] == WHOLLY:
        workspace = allocate(task.rows, member.copy())
        assert cold_fit(*workspace) == OK
        assert refine_kernel(workspace, task.limit, allocate_refinement(task.rows)) == 0
    assert sizes[-1] > sizes[0] or quantised


def test_scratch_space_of_a_window_serves_its_swap():
    A, b = synthetic(np.random.default_rng(7), 120, 3, 0.4)
    task, arena = search_on(A, b, 0.1)
    search = carve(arena)
    m = 90
    found = []
    for cut in (False, True):
        if cut:
            search.walk.points[:m] = np.arange(m)
            window = walk_workspace(3, m, search.walk)
            window.At[:], window.b[:] = task.rows.At[:, :m], task.rows.b[:m]
            scratch = window_scratch(m, search.refinement)
        else:
            part = type(task.rows)(**{**vars(task.rows), "At": task.rows.At[:, :m].copy(), "b": task.rows.b[:m].copy()})
            window, scratch = allocate(part), allocate_refinement(part)
        inside = search.member[:m]
        window.gain[:], window.cap[:] = np.where(inside, 1.0, 0.0), np.where(inside, 0.0, np.inf)
        assert cold_fit(*window) == OK
        found.append((swap_kernel(window, task.limit, scratch), window.gain.copy()))
    assert found[0][0] == found[1][0]
    np.testing.assert_array_equal(found[0][1], found[1][1])


@pytest.mark.parametrize("tries", [1, 3])
def test_a_swap_that_gives_up_early_ends_at_a_feasible_maximal_set(tries):
    for seed in range(3):
        A, b = synthetic(np.random.default_rng([seed, 9]), 80, 4, 0.5)
        task = make_task(LinearProblem(A, b), 0.1, np.random.default_rng(0))
        start = np.zeros(80, dtype=bool)
        start[np.argsort(np.abs(task.rows.b - task.rows.At.T @ np.zeros(4)))[:3]] = True
        sizes = []
        for few in (tries, 80):
            workspace, scratch = allocate(task.rows, start), allocate_refinement(task.rows)
            assert cold_fit(*workspace) == OK
            gained = swap_by(workspace, task.limit, scratch, few)
            kept = workspace.gain == 1.0
            assert kept.sum() == start.sum() + gained
            assert minimax_fit(task.problem, kept).value <= 0.1 * (1 + 1e-8)
            scratch.tried[:] = False
            assert refine_kernel(workspace, task.limit, scratch) == 0
            sizes.append(gained)
        assert sizes[0] > 0
