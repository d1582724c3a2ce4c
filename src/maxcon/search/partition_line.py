"""A bound from d - 1 enforced points: they leave the models one degree of freedom, and intervals on a line are easy.

With d - 1 independent enforced rows e_k and a unit vector u orthogonal to all of them, every row is a = sum_k w_k e_k +
c u, so that a point's residual is b - sum_k w_k b_k - c t + sum_k w_k r_k with t = u . model and |r_k| <= limit.
The point can then be an inlier only for t in an interval, and no model has more inliers than intervals share a point.

The array `line`, shape (2 d + 3, d), holds a scratch matrix (rows 0 to d - 1), the dual vectors D_k with w_k = D_k . a
(rows d to 2 d - 2), u (row 2 d), v = sum_k b_k D_k (row 2 d + 1) and the sum of all |D_k| (entry [2 d + 2, 0]).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel

#: A row counts as independent of others if this part of its length is; the weights w are then of moderate size.
INDEPENDENT = 1e-3

#: A coefficient c below this says nothing that rounding could not.
STEEP = 1e-4

#: What rounding may add to a residual, in the unit of the weights.
ROUNDING = 1e-11


@kernel
def find_line(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    enforced: NDArray[np.int64],
    n_enforced: int,
    line: NDArray[np.float64],
    line_place: NDArray[np.int64],
) -> int:
    """Find the line that d - 1 independent enforced rows leave; return how many rows it took, -1 if there is none."""
    d = At.shape[0]
    for i in range(d):
        for j in range(d):
            line[i, j] = 0.0  # the projection on what is orthogonal to the rows so far
        line[i, i] = 1.0
    found = used = 0
    g, u, v = 2 * d - 1, 2 * d, 2 * d + 1
    for k in range(n_enforced):
        if found == d - 1:
            break
        p = enforced[k]
        length = 0.0
        for j in range(d):
            line[u, j] = At[j, p]
            length += At[j, p] ** 2
        for _ in range(2):  # projected twice: orthogonal to rounding
            for j in range(d):
                line[g, j] = 0.0
            for i in range(d):
                a = line[u, i]
                for j in range(d):
                    line[g, j] += a * line[i, j]
            for j in range(d):
                line[u, j] = line[g, j]
        rest = 0.0
        for j in range(d):
            rest += line[u, j] ** 2
        if rest <= INDEPENDENT**2 * length or rest == 0.0:
            continue
        for i in range(d):
            a = line[u, i] / rest
            for j in range(d):
                line[i, j] -= a * line[u, j]
        for m in range(found):
            dot = 0.0
            for j in range(d):
                dot += line[d + m, j] * At[j, p]
            dot /= rest
            for j in range(d):
                line[d + m, j] -= dot * line[u, j]
        for j in range(d):
            line[d + found, j] = line[u, j] / rest
        line_place[found] = p
        found += 1
        used = k + 1
    if found < d - 1:
        return -1
    best = 0
    for i in range(d):
        if line[i, i] > line[best, best]:
            best = i
    length = 0.0
    for j in range(d):
        length += line[best, j] ** 2
    length = np.sqrt(length)
    if length == 0.0:
        return -1
    for j in range(d):
        line[u, j] = line[best, j] / length
        line[v, j] = 0.0
    size = 1.0
    for k in range(d - 1):
        for j in range(d):
            line[v, j] += b[line_place[k]] * line[d + k, j]
            size += abs(line[d + k, j])
    line[v + 1, 0] = size
    return used if _accurate(At, line, line_place) else -1


@kernel
def _accurate(At: NDArray[np.float64], line: NDArray[np.float64], line_place: NDArray[np.int64]) -> bool:
    """Whether sum_k e_k D_k + u u is the unit matrix to rounding; it is not where rows are nearly dependent."""
    d = At.shape[0]
    for i in range(d):
        for j in range(d):
            line[0, j] = line[2 * d, i] * line[2 * d, j]
        line[0, i] -= 1.0
        for k in range(d - 1):
            a = At[i, line_place[k]]
            for j in range(d):
                line[0, j] += a * line[d + k, j]
        for j in range(d):
            if abs(line[0, j]) > 1e-12:
                return False
    return True


@kernel
def line_intervals(
    A: NDArray[np.float64],
    b: NDArray[np.float64],
    limit: float,
    line: NDArray[np.float64],
    left: NDArray[np.float64],
    right: NDArray[np.float64],
    work: NDArray[np.float64],
) -> None:
    """Write the interval of every column, a little wide; a column nearly orthogonal to the line gets all of it."""
    d, m = A.shape
    u, v, size = 2 * d, 2 * d + 1, line[2 * d + 2, 0]
    for c in range(m):
        left[c] = b[c]  # the centre, in the unit of a residual
        right[c] = 1.0  # the half width
        work[0, c] = 0.0  # the slope
    for j in range(d):
        along, across = line[u, j], line[v, j]
        for c in range(m):
            work[0, c] += along * A[j, c]
            left[c] -= across * A[j, c]
    for k in range(d - 1):
        for c in range(m):
            work[1, c] = 0.0
        for j in range(d):
            weight = line[d + k, j]
            for c in range(m):
                work[1, c] += weight * A[j, c]
        for c in range(m):
            right[c] += abs(work[1, c])
    for c in range(m):
        slope = work[0, c]
        if abs(slope) <= STEEP:
            left[c], right[c] = -np.inf, np.inf
            continue
        half = (right[c] * limit + ROUNDING * (right[c] + size)) / abs(slope)
        centre = left[c] / slope
        half += 1e-8 * (1.0 + abs(centre) + half)
        left[c] = centre - half
        right[c] = centre + half


@kernel
def line_bound(
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    left: NDArray[np.float64],
    right: NDArray[np.float64],
    work: NDArray[np.float64],
    target: int,
    never: int,
) -> int:
    """Return a lower bound on the outliers among the free columns, 0 if it is below `target`.

    `never` where the enforced columns already have no point in common.
    """
    m = gain.shape[0]
    first, last = -np.inf, np.inf
    for c in range(m):
        if gain[c] == 0.0 and cap[c] < np.inf:
            first = max(first, left[c])
            last = min(last, right[c])
    if first > last:
        return never
    free = shared = 0
    for c in range(m):
        if gain[c] > 0.0:
            free += 1
            if left[c] <= last and right[c] >= first:
                work[0, shared] = max(left[c], first)
                work[1, shared] = right[c]
                shared += 1
    deepest = 0
    if free - shared < target:
        for i in range(shared):
            at = work[0, i]
            depth = 0
            for k in range(shared):
                depth += (work[0, k] <= at) & (at <= work[1, k])
            deepest = max(deepest, depth)
            if free - deepest < target:
                return 0
    else:
        deepest = shared
    return free - deepest
