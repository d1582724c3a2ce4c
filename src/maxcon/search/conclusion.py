"""From the best set that a search found to the `Consensus` that a user gets."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import minimax_fit, rank_holds
from maxcon.problem import Consensus, LinearProblem, Status
from maxcon.search.anytime import Best, Task


def conclude(task: Task, best: Best, method: str, seed: int | None, seconds: float) -> Consensus:
    """Return the result: the minimax fit of the inliers, everything else recomputed from its model.

    The inliers of the fit of a set contain the set, and can be more; their own fit can have more again. The loop ends
    with a model that is the fit of its own inliers.
    """
    problem = task.problem
    limit = problem.inlier_limit(task.threshold)
    subset = best.subset if best.subset is not None and best.subset.any() else any_feasible_set(task)
    if subset is None:
        return _infeasible(problem, task.threshold, method, seed, seconds)
    size = 0
    while (n_inliers := int(np.count_nonzero(subset))) > size:
        size = n_inliers
        fit = minimax_fit(problem, subset)
        residuals = problem.residuals(fit.model)
        subset = residuals <= limit
    upper_bound, status = _standing(task, n_inliers, best.upper_bound)
    return Consensus(
        model=fit.model,
        inlier_mask=subset,
        n_inliers=n_inliers,
        upper_bound=upper_bound,
        gap=upper_bound - n_inliers,
        status=status,
        residuals=residuals,
        basis=fit.basis,
        path=best.path,
        threshold=task.threshold,
        method=method,
        seed=seed,
        seconds=seconds,
        problem=problem,
    )


def judge(
    task: Task, model: NDArray[np.float64], mask: NDArray[np.bool_], upper_bound: int, seconds: float
) -> Consensus:
    """Return the result that a given model and set of its inliers are, whoever found them, under a proven bound."""
    problem = task.problem
    residuals = problem.residuals(model)
    n_inliers = int(mask.sum())
    upper_bound, status = _standing(task, n_inliers, upper_bound)
    return Consensus(
        model=model,
        inlier_mask=mask,
        n_inliers=n_inliers,
        upper_bound=upper_bound,
        gap=upper_bound - n_inliers,
        status=status,
        residuals=residuals,
        basis=minimax_fit(problem, mask).basis if mask.any() else np.empty(0, dtype=np.int64),
        path=np.empty(0, dtype=np.int64),
        threshold=task.threshold,
        method="given",
        seed=None,
        seconds=seconds,
        problem=problem,
    )


def _standing(task: Task, n_inliers: int, upper_bound: int) -> tuple[int, Status]:
    """Return the bound that stands, and what it makes of so many inliers.

    A recount above the bound refutes it. And a bound on the whitened rows is none on the data where whitening took
    columns for dependent that are not, to the letter: then nothing is proven.
    """
    N = task.problem.n_points
    if n_inliers > upper_bound or (upper_bound < N and not rank_holds(task.problem)):
        upper_bound = N
    if upper_bound == n_inliers:  # also where all points are inliers, which needs no proof
        return upper_bound, "optimal" if n_inliers > 0 else "infeasible"
    return upper_bound, "bounded" if upper_bound < N else "heuristic"


def any_feasible_set(task: Task) -> NDArray[np.bool_] | None:
    """Return some set of points that one model explains, however poor, or None if no model explains even one point.

    This is what a search stopped before its first step has to show.
    """
    rows, limit = task.rows, task.limit
    if np.abs(rows.b).min() <= limit:  # the least-squares fit of all points explains some
        subset: NDArray[np.bool_] = np.abs(rows.b) <= limit
        return subset
    sizes = np.abs(task.problem.A).max(axis=1)
    if sizes.max() == 0:  # no parameter moves any residual, and none is within the threshold
        return None
    subset = np.zeros(task.problem.n_points, dtype=np.bool_)
    subset[sizes.argmax()] = True
    return subset


def _infeasible(problem: LinearProblem, threshold: float, method: str, seed: int | None, seconds: float) -> Consensus:
    N = problem.n_points
    return Consensus(
        model=np.full(problem.n_params, np.nan),
        inlier_mask=np.zeros(N, dtype=np.bool_),
        n_inliers=0,
        upper_bound=0,
        gap=0,
        status="infeasible",
        residuals=np.full(N, np.nan),
        basis=np.empty(0, dtype=np.int64),
        path=np.empty(0, dtype=np.int64),
        threshold=threshold,
        method=method,
        seed=seed,
        seconds=seconds,
        problem=problem,
    )
