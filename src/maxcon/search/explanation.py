"""Why a point is out: which inliers speak against it, and what it would cost to force it in."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import allocate, linear_rows, minimax_fit
from maxcon.minimax.linear import BASIS_TOLERANCE, INFEASIBLE, OK, cold_fit
from maxcon.problem import Consensus, Explanation, LinearProblem, inlier_slack
from maxcon.search.anytime import Step, Task, make_task, run
from maxcon.search.exact import MOST_PARAMETERS
from maxcon.search.partition import exact_partition
from maxcon.search.peel import peel, peel_improve
from maxcon.search.proposal import propose
from maxcon.search.refine import swap_refinement
from maxcon.search.stabbing import exact_stabbing

#: Models that explain one given outlier leave out many points: that takes more starts than usual.
RESTARTS = 30


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
    if isinstance(point, bool) or not isinstance(point, (int, np.integer)):
        raise TypeError(f"point must be a whole number, but it is {point!r}")
    if not 0 <= point < N:
        raise ValueError(f"point must be from 0 to {N - 1}, but it is {point}")
    if consensus.inlier_mask.shape != (N,):
        raise ValueError(f"consensus must be of this problem, with {N} points, but it has {len(consensus.inlier_mask)}")
    if consensus.inlier_mask[point]:
        raise ValueError(f"point must not be an inlier, but {point} is one")
    point = int(point)
    together = consensus.inlier_mask.copy()
    together[point] = True
    fit = minimax_fit(problem, together)
    limit = consensus.threshold + inlier_slack(consensus.threshold, problem.scale)
    basis = fit.basis if fit.value > limit else np.empty(0, dtype=np.int64)
    if len(basis) == 1:  # no parameter moves its residual
        return Explanation(point, basis, 0, consensus.n_inliers, True)

    # To leave the point and all its repetitions out costs more than this set leaves out: an optimal model explains it.
    start = _with_point(problem, consensus, point, together)
    extra = N - int(np.count_nonzero(start)) + 1
    repeated = np.r_[np.arange(N), np.full(extra, point)]
    insisting = LinearProblem(problem.A[repeated], problem.b[repeated])
    task = make_task(insisting, consensus.threshold, np.random.default_rng(0), time_limit)
    start = np.r_[start, np.ones(extra, dtype=np.bool_)]
    best = run(task, _search(task, start), swap_refinement)
    found = max(best.size - extra, 1)
    return Explanation(point, basis, found, consensus.n_inliers - found, best.gap <= 0)


def _with_point(
    problem: LinearProblem, consensus: Consensus, point: int, together: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return a set with the point that one model explains: the inliers without some that speak against it."""
    rows = linear_rows(problem)
    limit = (consensus.threshold + inlier_slack(consensus.threshold, problem.scale)) / rows.scale
    subset = together.copy()
    workspace = allocate(rows, subset)
    while True:
        workspace.gain[:] = subset
        workspace.cap[:] = np.where(subset, 0.0, np.inf)
        status = cold_fit(*workspace)
        if status == OK and workspace.x[-1] <= limit:
            return subset
        held = (workspace.q >= 0) & (workspace.C[-1] > BASIS_TOLERANCE)
        against = [int(name) >> 1 for name in workspace.q[held] if int(name) >> 1 != point]
        if status == INFEASIBLE or not against:
            break
        # Each basis holds the point; the inlier that goes is the one that holds the fit most.
        multipliers = workspace.C[-1][held]
        names = workspace.q[held] >> 1
        multipliers[names == point] = -1.0
        subset[names[int(np.argmax(multipliers))]] = False
    alone = np.zeros_like(subset)
    alone[point] = True
    return alone


def _search(task: Task, start: NDArray[np.bool_]) -> Iterator[Step]:
    """Improve a set with the point, then prove that it is the largest, or find a larger one."""
    best = peel_improve(task, start)
    yield Step(subset=best)
    if task.problem.n_params <= MOST_PARAMETERS:
        yield from exact_stabbing(task)
        return
    for step in chain(peel(task, start="gnc", restarts=RESTARTS), propose(task)):
        if step.subset is not None and np.count_nonzero(step.subset) > np.count_nonzero(best):
            best = step.subset
        yield step
    yield from exact_partition(task, start=best)
