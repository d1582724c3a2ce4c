"""The exact answer for two parameters: sweep the arrangement of the strips in the plane of all models."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import allocate
from maxcon.minimax.linear import FAILED, OK, cold_fit
from maxcon.problem import inlier_slack
from maxcon.search.anytime import Step, Task
from maxcon.search.removal_kernels import greedy_kernel
from maxcon.search.sweep_kernels import BUCKETS, Strips, members, sweep_lines
from maxcon.search.vertex_kernels import allocate_copies

#: Rounding of a whitened entry, in terms of the sum of sizes that it is the sum of: eight units in the last
#: place.
ROUNDING = 8 * float(np.finfo(np.float64).eps)

#: Strips crossed between two yields: some 10 ms.
WORK_PER_YIELD = 500_000


def exact_sweep(task: Task) -> Iterator[Step]:
    """Find the largest consensus of a problem with two parameters, and prove it, in O(N^2 log N).

    Point i is an inlier of exactly the models theta in the strip |a_i . theta - b_i| <= threshold of the
    plane. Where most strips overlap, their intersection is the whole plane or has a boundary, which lies on a
    boundary line of one of them. So walk along all 2 N boundary lines; on each the other strips are
    intervals, and sorting their ends tells the deepest position (the arrangement of lines in the dual plane;
    de Berg et al., "Computational Geometry", chapter 8). A line is not sorted where counting the ends in
    buckets shows that it cannot beat the best. Rows with a_i = 0, parallel and duplicate rows, and A of rank
    0 or 1 are no exception: their strips cover all or nothing of a line.

    Soundness against rounding: the sweep is done with strips that are wider, by half the slack that belongs
    to the definition of an inlier, and by a bound on the rounding of each interval. No set S with f(S) <=
    threshold + slack is missed by it, so its depth is an upper bound. (Strips that are parallel but for
    rounding are taken to be so: models at which they are told apart are beyond double precision.) The set
    found is an answer only if the minimax fit confirms it. If the fit does not (some f(S) lies within half a
    slack above the limit), points are removed greedily until it does, and the sweep is done again with strips
    narrower than the limit by half the slack, in which whatever is found is feasible by a margin. If that
    leaves the two apart, the gap is reported.

    Yields
    ------
    Feasible sets as they are found, empty steps in between, and at the end the upper bound.

    Raises
    ------
    ValueError
        If the problem does not have two parameters.
    ArithmeticError
        If a minimax fit does not converge.
    """
    if task.problem.n_params != 2:
        raise ValueError(f"the sweep needs a problem with 2 parameters, but this one has {task.problem.n_params}")
    return _steps(task)


def _steps(task: Task) -> Iterator[Step]:
    slack = inlier_slack(task.threshold, task.problem.scale) / task.rows.scale
    bound = found = 0
    for limit in (task.limit + 0.5 * slack, task.limit - 0.5 * slack):
        for depth, mask in _walk(task, limit, found):
            bound = max(bound, depth)
            subset = None if mask is None else _feasible_part(task, mask)
            size = 0 if subset is None else int(np.count_nonzero(subset))
            yield Step(subset=subset) if size > found else Step()
            found = max(found, size)
        if found == bound:
            break
    yield Step(upper_bound=bound)


def _walk(task: Task, limit: float, at_least: int) -> Iterator[tuple[int, NDArray[np.bool_] | None]]:
    """Walk along all boundary lines; yield the depth reached so far and, where it has grown, who is there.

    Only depths above `at_least` count.
    """
    N = task.problem.n_points
    strips = _strips(task)
    buckets = np.zeros((2, BUCKETS), dtype=np.int64)
    ends = np.empty((2, N))

    mask = np.empty(N, dtype=np.bool_)
    members(strips, limit, -1, 0.0, mask)  # without boundary lines any model is as good as theta = 0
    depth = max(at_least, int(np.count_nonzero(mask)))
    yield depth, (mask if depth > at_least else None)
    chunk = max(1, WORK_PER_YIELD // N)
    for begin in range(0, 2 * N, chunk):
        end = min(begin + chunk, 2 * N)
        depth, line, t = sweep_lines(strips, limit, begin, end, depth, ends[0], ends[1], buckets[0], buckets[1])
        if line < 0:
            yield depth, None
            continue
        mask = np.empty(N, dtype=np.bool_)
        members(strips, limit, line, t, mask)
        yield depth, mask


def _strips(task: Task) -> Strips:
    """Return the strips, with a bound on their rounding from how each whitened row comes from its original.

    At.T = A @ to_model / scale and b = (b - A @ origin) / scale, each sum good to a few units in the last
    place of the sum of the sizes of its terms. (The engine's At, the Q of a QR decomposition, is the same up
    to rounding, but that of the longest row: it makes a boundary line of a zero row.) Parallel rows of A are
    parallel up to the noise.
    """
    problem, rows = task.problem, task.rows
    At = np.zeros((2, problem.n_points))
    At[: len(rows.At)] = (problem.A @ (rows.to_model / rows.scale)).T
    sizes = np.abs(problem.A) @ (np.abs(rows.to_model).sum(axis=1) + np.abs(rows.origin)) + np.abs(problem.b)
    return Strips(At, rows.b, np.hypot(At[0], At[1]), ROUNDING * sizes / rows.scale)


def _feasible_part(task: Task, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return `mask` if its minimax fit is within the limit, else what greedy removal leaves of it."""
    workspace = allocate(task.rows, mask)
    status = cold_fit(*workspace)
    if status == OK and workspace.x[-1] > task.limit:
        path = np.empty(len(mask), dtype=np.int64)
        basis = np.empty(len(workspace.x), dtype=np.int64)
        copies = allocate_copies(task.rows, 2)
        status, _ = greedy_kernel(workspace, task.limit, copies, basis, path, 0, len(mask))
    if status == FAILED:
        raise ArithmeticError("a minimax fit of the sweep did not converge; please report the data")
    return np.equal(workspace.gain, 1.0)
