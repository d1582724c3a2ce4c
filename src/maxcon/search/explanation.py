"""Why a point is out: which inliers speak against it, and what it would cost to force it in."""

from __future__ import annotations

import numpy as np

from maxcon.minimax import minimax_fit
from maxcon.problem import Consensus, Explanation, LinearProblem
from maxcon.problem.validate import check_time_limit
from maxcon.search.anytime import make_task, run
from maxcon.search.proof import prove
from maxcon.search.refine import swap_refinement


def explain(
    problem: LinearProblem, consensus: Consensus, point: int, *, time_limit: float | None = 10.0
) -> Explanation:
    """Explain why a point is no inlier of a result.

    Parameters
    ----------
    problem
        What was fitted.
    consensus
        The result.
    point
        The index of a point that is not among its inliers.
    time_limit
        Seconds after which the best so far is returned; None for no limit.

    Raises
    ------
    TypeError
        If `point` is not a whole number.
    ValueError
        If there is no such point, or it is an inlier.

    Notes
    -----
    The inliers have a model within the threshold, so if they have none together with the point, the basis of
    their minimax fit (at most d + 1 points) holds the point. What it costs to force it in is the consensus of a
    problem in which the point is repeated so often that no optimal model can do without it, found and proven by the
    exact search.
    """
    N = problem.n_points
    check_time_limit(time_limit)
    if isinstance(point, bool) or not isinstance(point, (int, np.integer)):
        raise TypeError(f"point must be a whole number, but it is {point!r}")
    if not 0 <= point < N:
        raise ValueError(f"point must be from 0 to {N - 1}, but it is {point}")
    if consensus.inlier_mask.shape != (N,):
        raise ValueError(f"consensus must be of this problem, with {N} points, but it has {len(consensus.inlier_mask)}")
    if not consensus.problem.same_data(problem):
        raise ValueError("consensus must be of this problem, but it is of other data")
    if consensus.inlier_mask[point]:
        raise ValueError(f"point must not be an inlier, but {point} is one")
    point = int(point)
    together = consensus.inlier_mask.copy()
    together[point] = True
    fit = minimax_fit(problem, together)
    limit = problem.inlier_limit(consensus.threshold)
    basis = fit.basis if fit.value > limit else np.empty(0, dtype=np.int64)
    if len(basis) == 1:  # no parameter moves its residual
        return Explanation(point, basis, 0, consensus.n_inliers, True)

    # To leave out the point and all its repetitions costs more than there is to gain: an optimal model explains it.
    extra = consensus.upper_bound + 1
    repeated = np.r_[np.arange(N), np.full(extra, point)]
    insisting = LinearProblem(problem.A[repeated], problem.b[repeated])
    task = make_task(insisting, consensus.threshold, np.random.default_rng(0), time_limit)
    best = run(task, prove(task), swap_refinement)
    found = max(best.size - extra, 1)
    return Explanation(point, basis, found, consensus.n_inliers - found, best.gap <= 0)
