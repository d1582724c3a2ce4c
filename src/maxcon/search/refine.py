"""Local tree refinement (paper, section 3.6 and Algorithm 2) and its swap extension."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import Workspace, allocate
from maxcon.minimax.linear import OK, cold_fit
from maxcon.problem import check_indices
from maxcon.search.anytime import Task
from maxcon.search.refine_kernels import allocate_refinement, refine_kernel, swap_kernel


def tree_refinement(task: Task, subset: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Add points that the set takes without leaving the threshold, until it takes none (paper, Algorithm 2).

    Parameters
    ----------
    task
        The problem and the limit.
    subset
        Shape (N,), bool, or indices: a set S with f(S) <= threshold.

    Returns
    -------
    Shape (N,), bool: a feasible set that holds `subset` and to which no single point can be added.

    Raises
    ------
    ValueError
        If `subset` is empty or infeasible: no point can make an infeasible set feasible.
    ArithmeticError
        If its minimax fit does not converge.

    Notes
    -----
    The order in which points are tried is free in the paper. Here: at every fit first all points within the
    limit of it, together; then the one with the smallest lower bound on f(S + i), of equal ones the lowest
    index. One pass replaces the paper's outer loop, with the same end; why is proven in `refine_kernels`.
    """
    workspace = _fitted(task, subset)
    refine_kernel(workspace, task.limit, allocate_refinement(task.rows))
    return np.equal(workspace.gain, 1.0)


def swap_refinement(task: Task, subset: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Refine; then, while it pays, drop one basis point and add back everything else that fits.

    Parameters, return value and errors are those of `tree_refinement`, but the set need not hold `subset`: it
    is at least as large, no single point can be added to it, and no basis point can be traded for two others
    by adding greedily.
    """
    workspace = _fitted(task, subset)
    swap_kernel(workspace, task.limit, allocate_refinement(task.rows))
    return np.equal(workspace.gain, 1.0)


def _fitted(task: Task, subset: NDArray[np.bool_]) -> Workspace:
    """Return a workspace at the minimax fit of `subset`; ValueError if it is not within the limit."""
    mask = check_indices(subset, task.problem.n_points)
    workspace = allocate(task.rows, mask)
    if cold_fit(*workspace) != OK:
        raise ArithmeticError("the minimax fit of subset did not converge; please report the data")
    gamma = float(workspace.x[-1])
    if gamma > task.limit:
        raise ValueError(
            f"subset must be feasible, f(S) <= threshold = {task.threshold:g}, "
            f"but f(S) = {gamma * task.rows.scale:g} for its {int(mask.sum())} points"
        )
    return workspace
