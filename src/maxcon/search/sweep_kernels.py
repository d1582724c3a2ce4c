"""Kernels of the exact sweep in the plane: walk along the boundary lines of strips, count how many overlap.

Point j is within the limit where theta lies in the strip |a_j . theta - b_j| <= limit. Along the line
theta(t) = foot + t u, u of length 1, its residual is c + e t with c = a_j . foot - b_j and e = a_j . u, so
the strip is an interval of t.

Rounding is given away in favour of the strips. `noise[j]` says by how much a_j, in each direction, and b_j
may be wrong. Then the residual at a model theta is wrong by noise[j] (1 + |theta|), and by as much again,
|a_j| noise[i] / |a_i| for each unit of 1 + |theta|, because the line, that of point i, is not quite where it
should be. An interval here is the set of all t with |c + e t| <= limit + (1 + |foot| + |t|) times the sum of
the two.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel

#: A row, or its direction along a line, of less than so many times its noise is taken for zero: a point
#: without a strip, or a strip parallel to the line.
ZERO = 4.0

#: Into how many buckets the positions along a line are sorted before it is decided whether to sort them in
#: earnest.
BUCKETS = 64


class Strips(NamedTuple):
    """The strips of a problem with two parameters.

    Attributes
    ----------
    At, b
        Whitened rows, shapes (2, N) and (N,); At[1] is zero where the rank is 1, At[0] as well where it is 0.
    lengths
        Shape (N,): the lengths of the columns of At.
    noise
        Shape (N,): bounds on the rounding errors of At and b.
    """

    At: NDArray[np.float64]
    b: NDArray[np.float64]
    lengths: NDArray[np.float64]
    noise: NDArray[np.float64]


@kernel
def boundary_line(strips: Strips, limit: float, line: int) -> tuple[float, float, float, float, float]:
    """Return foot, direction and tilt (its noise) of boundary line 2 i (upper) or 2 i + 1 (lower) of point i.

    Line -1 stands for the single model theta = 0.
    """
    if line < 0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    i = line >> 1
    length = strips.lengths[i]
    v0, v1 = strips.At[0, i] / length, strips.At[1, i] / length
    distance = (strips.b[i] + (limit if line & 1 == 0 else -limit)) / length
    return v0 * distance, v1 * distance, -v1, v0, strips.noise[i] / length


@kernel
def interval(
    a0: float,
    a1: float,
    b: float,
    limit: float,
    foot0: float,
    foot1: float,
    u0: float,
    u1: float,
    noise: float,
) -> tuple[float, float]:
    """Return from where to where the strip of a point covers the line; (inf, -inf) if nowhere."""
    c = a0 * foot0 + a1 * foot1 - b
    e = a0 * u0 + a1 * u1
    reach = limit + noise * (1.0 + abs(foot0) + abs(foot1))
    if abs(e) <= ZERO * noise:
        return (-np.inf, np.inf) if abs(c) <= reach else (np.inf, -np.inf)
    if e < 0.0:
        c, e = -c, -e
    # c + e t <= reach + noise |t| and >= -(reach + noise |t|): where |t| helps depends on the side of t = 0.
    upper = reach - c
    lower = -reach - c
    last = upper / (e - noise if upper > 0.0 else e + noise)
    first = lower / (e - noise if lower < 0.0 else e + noise)
    return first, last


@kernel
def members(strips: Strips, limit: float, line: int, t: float, mask: NDArray[np.bool_]) -> None:
    """Write which strips cover the position t of a boundary line."""
    At, b = strips.At, strips.b
    foot0, foot1, u0, u1, tilt = boundary_line(strips, limit, line)
    for j in range(b.shape[0]):
        noise = strips.noise[j] + strips.lengths[j] * tilt
        first, last = interval(At[0, j], At[1, j], b[j], limit, foot0, foot1, u0, u1, noise)
        mask[j] = first <= t <= last
    if line >= 0:
        mask[line >> 1] = True


@kernel
def _bucket(t: float) -> int:
    """Return in which of the buckets t lies; t / (1 + |t|) squeezes the line into (-1, 1)."""
    return min(int((t / (1.0 + abs(t)) + 1.0) * (0.5 * BUCKETS)), BUCKETS - 1)


@kernel
def _peak(entering: NDArray[np.int64], leaving: NDArray[np.int64], depth: int) -> int:
    """Return a bound on the depth anywhere: whatever leaves a bucket is taken to leave it last."""
    most = depth
    for k in range(BUCKETS):
        depth += entering[k]
        most = max(most, depth)
        depth -= leaving[k]
        entering[k] = 0
        leaving[k] = 0
    return most


@kernel
def sweep_lines(
    strips: Strips,
    limit: float,
    begin: int,
    end: int,
    best: int,
    firsts: NDArray[np.float64],
    lasts: NDArray[np.float64],
    entering: NDArray[np.int64],
    leaving: NDArray[np.int64],
) -> tuple[int, int, float]:
    """Walk along boundary lines `begin` to `end` (not included).

    Parameters
    ----------
    strips
        The points.
    limit
        Half the width of the strips, in the unit of b.
    begin, end
        Of the 2 N lines; see `boundary_line`.
    best
        Only depths above this count.
    firsts, lasts, entering, leaving
        Scratch space, shapes (N,) and (BUCKETS,); the last two all zero.

    Returns
    -------
    depth, line, t
        The deepest position, and how many strips cover it; (`best`, -1, 0) if none is deeper than `best`.
    """
    At, b, lengths = strips.At, strips.b, strips.lengths
    N = b.shape[0]
    best_line = -1
    best_t = 0.0
    for line in range(begin, end):
        i = line >> 1
        if lengths[i] <= ZERO * strips.noise[i]:
            continue
        foot0, foot1, u0, u1, tilt = boundary_line(strips, limit, line)
        everywhere = 1  # strip i
        crossing = 0
        for j in range(N):
            noise = strips.noise[j] + lengths[j] * tilt
            first, last = interval(At[0, j], At[1, j], b[j], limit, foot0, foot1, u0, u1, noise)
            if j == i or first == np.inf:
                continue
            if first == -np.inf:
                everywhere += 1
                continue
            firsts[crossing] = first
            lasts[crossing] = last
            entering[_bucket(first)] += 1
            leaving[_bucket(last)] += 1
            crossing += 1
        if _peak(entering, leaving, everywhere) <= best:
            continue
        if everywhere > best:
            best, best_line, best_t = everywhere, line, 0.0
        enter = firsts[:crossing]
        leave = lasts[:crossing]
        enter.sort()
        leave.sort()
        gone = 0
        for k in range(crossing):
            while leave[gone] < enter[k]:  # strictly: strips are closed, an entry counts before an exit
                gone += 1
            depth = everywhere + k + 1 - gone
            if depth > best:
                best, best_line, best_t = depth, line, enter[k]
    return best, best_line, best_t
