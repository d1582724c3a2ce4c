"""Trials on a few points: what they forbid is infeasible, with proof; what is feasible they never forbid."""

import numpy as np
import pytest

from instances import BUILDERS, synthetic
from maxcon.minimax import allocate, minimax_fit
from maxcon.minimax.linear import OK, cold_fit
from maxcon.problem import LinearProblem
from maxcon.search.anytime import make_task
from maxcon.search.gnc import gnc
from maxcon.search.trial_kernels import allocate_near, gather_near, near_forbid


def placed(task):
    """Return a workspace at the vertex of a feasible set, and the set."""
    subset = next(step.subset for step in gnc(task) if step.subset is not None)
    workspace = allocate(task.rows, subset)
    assert cold_fit(*workspace) == OK
    return workspace, subset


def grown(subset, point):
    larger = subset.copy()
    larger[point] = True
    return larger


@pytest.mark.parametrize("name", BUILDERS)
def test_what_is_forbidden_is_infeasible_with_the_points_that_are_named(name):
    forbidden = 0
    for seed in range(6):
        rng = np.random.default_rng([seed, 71])
        d = int(rng.integers(1, 5))
        A, b = BUILDERS[name](rng, int(rng.integers(d + 4, 40)), d)
        task = make_task(LinearProblem(A, b), float(rng.choice([0.1, 0.5, 1.0])), rng)
        try:
            workspace, subset = placed(task)
        except StopIteration:
            continue
        near = allocate_near(task.rows)
        before = [np.copy(array) for array in workspace]
        m = gather_near(workspace, near)
        for point in np.flatnonzero(~subset) if m > 0 else ():
            no = near_forbid(workspace, task.limit, near, m, point)
            value = minimax_fit(task.problem, grown(subset, point)).value / task.rows.scale
            if not no:
                continue
            forbidden += 1
            assert value > task.limit * (1 - 1e-9)
            tight = near.q[(near.q >= 0) & (near.C[-1] > 1e-10)] >> 1
            named = np.zeros_like(subset)
            named[tight] = True
            assert (subset | ~named)[np.arange(len(subset)) != point].all()
            assert minimax_fit(task.problem, named).value / task.rows.scale > task.limit * (1 - 1e-9)
        for array, old in zip(workspace[:8], before[:8], strict=True):  # the rest is scratch space
            np.testing.assert_array_equal(array, old)
    if name in ("synthetic_some", "uniform_noise", "random_instance"):
        assert forbidden > 10


def test_few_points_decide_nearly_all_trials():
    """Of 600 points with 300 inliers, those near the edge forbid what all of them forbid."""
    rng = np.random.default_rng(3)
    A, b = synthetic(rng, 600, 5, 0.5)
    task = make_task(LinearProblem(A, b), 0.1, rng)
    workspace, subset = placed(task)
    near = allocate_near(task.rows)
    m = gather_near(workspace, near)
    assert 0 < m < subset.sum() // 1.5
    agreed = both = 0
    for point in np.flatnonzero(~subset)[:120]:
        no = near_forbid(workspace, task.limit, near, m, point)
        truth = minimax_fit(task.problem, grown(subset, point)).value / task.rows.scale > task.limit
        assert truth or not no
        both += truth
        agreed += no
    assert agreed >= 0.95 * both > 50
