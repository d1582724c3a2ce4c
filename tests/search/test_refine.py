"""Local tree refinement and swaps, against fits by the exact oracle."""

import numpy as np
import pytest

from instances import BUILDERS, synthetic
from maxcon.minimax import allocate, minimax_fit
from maxcon.minimax.linear import OK, cold_fit
from maxcon.minimax.refits import refit_after_enforcement
from maxcon.problem import LinearProblem
from maxcon.search.anytime import Task, make_task
from maxcon.search.refine import swap_refinement, tree_refinement
from maxcon.search.refine_kernels import (
    addition_bounds,
    addition_bounds_of,
    allocate_refinement,
    refine_kernel,
    swap_kernel,
)
from oracles import brute_force_consensus, highs_minimax

REFINERS = (tree_refinement, swap_refinement)


def draw_task(name: str, seed: int, most: int = 14) -> tuple[Task, np.random.Generator]:
    """Draw an instance of a family, d in 1..4, and a threshold that many of its points cannot keep."""
    rng = np.random.default_rng([seed, len(name)])
    d = int(rng.integers(1, 5))
    A, b = BUILDERS[name](rng, int(rng.integers(d + 2, most + 1)), d)
    threshold = float(rng.choice([0.1, 0.5, 1.0, 0.1 * np.abs(b).max() + 1e-9]))
    return make_task(LinearProblem(A, b), threshold, rng), rng


def f(task: Task, subset: np.ndarray) -> float:
    """f(S), exactly; 0 for the empty set."""
    return highs_minimax(task.problem.A[subset], task.problem.b[subset])


def limit_of(task: Task) -> float:
    return task.limit * task.rows.scale


def feasible_start(task: Task, rng: np.random.Generator) -> np.ndarray:
    """Add points in random order until one does not fit."""
    subset = np.zeros(task.problem.n_points, dtype=bool)
    for i in rng.permutation(task.problem.n_points):
        subset[i] = True
        if f(task, subset) > limit_of(task):
            subset[i] = False
            break
    return subset


def with_point(subset: np.ndarray, *points: int) -> np.ndarray:
    larger = subset.copy()
    larger[list(points)] = True
    return larger


@pytest.mark.parametrize("name", BUILDERS)
def test_result_is_feasible_and_takes_no_further_point(name):
    for seed in range(3):
        task, rng = draw_task(name, seed)
        start = feasible_start(task, rng)
        if not start.any():
            continue
        before = start.copy()
        sets = [refine(task, start) for refine in REFINERS]
        np.testing.assert_array_equal(start, before)
        assert (sets[0] >= start).all()
        assert sets[1].sum() >= sets[0].sum()
        for subset in sets:
            assert subset.dtype == bool
            assert f(task, subset) <= limit_of(task) * (1 + 1e-12) + 1e-13 * task.problem.scale
            for i in np.flatnonzero(~subset):
                assert f(task, with_point(subset, i)) > limit_of(task) * (1 - 1e-12)


@pytest.mark.parametrize("name", ["random_instance", "uniform_noise", "quantised_halves", "quantised", "duplicate_a"])
def test_no_basis_point_is_worth_swapping(name):
    """Drop a basis point: of the points that could come in, there is one that excludes all others.

    Were there none, whichever came in first would have left room for another, and the swap had paid.
    """
    stuck = 0
    for seed in range(25):
        task, rng = draw_task(name, seed, most=40)

        def fits(subset: np.ndarray, task: Task = task) -> bool:
            return minimax_fit(task.problem, subset).value <= limit_of(task)

        start = feasible_start(task, rng)
        if not start.any():
            continue
        subset = swap_refinement(task, start)
        for p in minimax_fit(task.problem, subset).basis:
            rest = subset.copy()
            rest[p] = False
            if rest.any() and f(task, rest) >= f(task, subset) * (1 - 1e-9):
                continue  # a tie: another basis does without it
            others = [i for i in np.flatnonzero(~subset) if rest.any() and fits(with_point(rest, i))]
            if len(others) >= 2:
                stuck += 1
                assert any(not any(fits(with_point(rest, i, j)) for j in others if j != i) for i in others)
    assert stuck > 0 or name == "duplicate_a"  # there hardly a swap that could be made is not worth it


def test_swap_gets_out_of_a_set_that_takes_no_further_point():
    # Heights 0, 2 are within 1 of a constant; giving up 0 lets 2, 3, 3.5, 4 in.
    task = make_task(LinearProblem(np.ones((5, 1)), [0.0, 2.0, 3.0, 3.5, 4.0]), 1.0, np.random.default_rng(0))
    start = np.array([True, True, False, False, False])
    np.testing.assert_array_equal(tree_refinement(task, start), start)
    np.testing.assert_array_equal(swap_refinement(task, start), [False, True, True, True, True])


def test_swap_comes_close_to_the_optimum():
    gaps = dict.fromkeys(REFINERS, 0)
    for seed in range(30):
        rng = np.random.default_rng(seed)
        A, b = synthetic(rng, 14, 2, 0.5)
        task = make_task(LinearProblem(A, b), 0.1, rng)
        start = feasible_start(task, rng)
        best = brute_force_consensus(A, b, 0.1)
        for refine in REFINERS:
            gap = best - int(refine(task, start).sum())
            assert gap >= 0
            gaps[refine] += gap
    assert gaps[swap_refinement] < gaps[tree_refinement]


@pytest.mark.parametrize("refine", REFINERS)
def test_infeasible_set_is_refused(refine):
    # d + 2 points above the threshold: adding what keeps f low would grow a set that is no consensus.
    rng = np.random.default_rng(5)
    A, b = synthetic(rng, 30, 3, 0.8)
    task = make_task(LinearProblem(A, b), 0.1, rng)
    subset = np.zeros(30, dtype=bool)
    subset[np.argsort(np.abs(b))[-5:]] = True
    assert f(task, subset) > limit_of(task)
    with pytest.raises(ValueError, match="subset must be feasible"):
        refine(task, subset)


@pytest.mark.parametrize("refine", REFINERS)
def test_bad_subset_is_refused(refine):
    task, _ = draw_task("random_instance", 0)
    with pytest.raises(ValueError, match="subset must hold at least one point"):
        refine(task, np.zeros(task.problem.n_points, dtype=bool))
    with pytest.raises(ValueError, match="subset must have shape"):
        refine(task, np.ones(task.problem.n_points + 1, dtype=bool))


@pytest.mark.parametrize("name", BUILDERS)
def test_bounds_are_below_f(name):
    sharp = 0
    for seed in range(3):
        task, rng = draw_task(name, seed)
        N = task.problem.n_points
        subset = np.zeros(N, dtype=bool)
        subset[rng.permutation(N)[: max(1, N // 2)]] = True
        workspace = allocate(task.rows, subset)
        assert cold_fit(*workspace) == OK
        gamma = workspace.x[-1] * task.rows.scale
        bound, leave = np.empty(N), np.empty(N, dtype=np.int64)
        addition_bounds(workspace, bound, leave)
        outside, single = np.flatnonzero(~subset), np.full(N, np.nan)
        addition_bounds_of(workspace, outside, len(outside), single, np.empty(N, dtype=np.int64))
        np.testing.assert_allclose(single[outside], bound[outside], rtol=1e-9, atol=1e-12)
        assert np.isnan(single[subset]).all()
        for i in np.flatnonzero(~subset):
            value = f(task, with_point(subset, i))
            found = bound[i] * task.rows.scale
            assert gamma * (1 - 1e-12) <= found <= value + 1e-9 * value + 1e-12 * task.problem.scale
            sharp += found > gamma * (1 + 1e-6) + 1e-9
    if name in ("random_instance", "synthetic_some", "uniform_noise", "two_structures"):
        assert sharp > 0


@pytest.mark.parametrize("name", ["random_instance", "uniform_noise", "quantised", "zero_rows"])
def test_certificates_are_infeasible(name):
    """Also those of points that were tried in swaps which came to nothing."""
    checked = 0
    for seed in range(25):
        task, rng = draw_task(name, seed, most=40)
        start = feasible_start(task, rng)
        if not start.any():
            continue
        workspace = allocate(task.rows, start)
        cold_fit(*workspace)
        scratch = allocate_refinement(task.rows)
        swap_kernel(workspace, task.limit, scratch)
        subset = workspace.gain == 1.0
        for i in np.flatnonzero(~subset):
            proof = scratch.certificate[i][scratch.certificate[i] >= 0]
            assert subset[proof].all()
            blamed = with_point(np.zeros_like(subset), i, *proof)
            assert minimax_fit(task.problem, blamed).value > limit_of(task) * (1 - 1e-9)
            checked += 1
    assert checked > 100


@pytest.mark.parametrize("kernel", [refine_kernel, swap_kernel])
def test_kernels_leave_other_modes_alone(kernel):
    """Enforced points stay enforced, and neither leave nor are they counted."""
    rng = np.random.default_rng(2)
    A, b = synthetic(rng, 40, 3, 0.2)
    task = make_task(LinearProblem(A, b), 0.1, rng)
    start = feasible_start(task, rng)
    held = int(np.flatnonzero(start)[0])
    workspace = allocate(task.rows, start)
    cold_fit(*workspace)
    assert refit_after_enforcement(*workspace, held, task.limit) == OK
    gained = kernel(workspace, task.limit, allocate_refinement(task.rows))
    assert workspace.gain[held] == 0.0
    assert workspace.cap[held] == task.limit
    subset = workspace.gain == 1.0
    assert subset.sum() == start.sum() - 1 + gained
    assert gained > 0
    assert workspace.x[-1] <= task.limit
    assert f(task, with_point(subset, held)) <= limit_of(task) * (1 + 1e-12)
    residuals = np.abs(task.rows.At.T @ workspace.x[:-1] - task.rows.b)
    assert residuals[with_point(subset, held)].max() <= task.limit * (1 + 1e-12) + 1e-12


def test_kernel_does_not_try_what_it_is_told_not_to():
    rng = np.random.default_rng(4)
    A, b = synthetic(rng, 40, 2, 0.2)
    task = make_task(LinearProblem(A, b), 0.1, rng)
    start = feasible_start(task, rng)
    added = np.flatnonzero(tree_refinement(task, start) & ~start)
    workspace = allocate(task.rows, start)
    cold_fit(*workspace)
    scratch = allocate_refinement(task.rows)
    scratch.tried[added[::2]] = True
    refine_kernel(workspace, task.limit, scratch)
    assert len(added) > 4
    assert (workspace.gain[added[::2]] == 0.0).all()
    assert scratch.tried[workspace.gain == 0.0].all()


@pytest.mark.slow
@pytest.mark.parametrize("N", [100, 300])
@pytest.mark.parametrize("d", [2, 5, 8])
def test_large_sets(N, d):
    for seed in range(5):
        rng = np.random.default_rng([seed, N, d])
        A, b = synthetic(rng, N, d, 0.5)
        task = make_task(LinearProblem(A, b), 0.1, rng)
        start = feasible_start(task, rng)
        subset = swap_refinement(task, start)
        assert subset.sum() >= tree_refinement(task, start).sum() >= start.sum()
        assert f(task, subset) <= limit_of(task) * (1 + 1e-12)
        for i in np.flatnonzero(~subset):
            assert f(task, with_point(subset, i)) > limit_of(task) * (1 - 1e-12)
