"""Kernels that fit again, from the vertex at hand, after points were removed, added or enforced.

Arguments and answers are those of `maxcon.minimax.linear`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import FAILED, OK, cold_fit, dual_simplex, refine_vertex, relax_row, settle
from maxcon.minimax.simplex import row_to_relax


@kernel
def refit_after_removal(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    C: NDArray[np.float64],
    x: NDArray[np.float64],
    q: NDArray[np.int64],
    r: NDArray[np.float64],
    work: NDArray[np.float64],
    table: NDArray[np.float64],
    point: int,
) -> int:
    """Remove `point` (its mode is set here) and move from the vertex to the fit of the rest."""
    gain[point] = 0.0
    cap[point] = np.inf
    return _refit_without(At, b, gain, cap, C, x, q, r, work, table)


@kernel
def refit_after_removals(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    C: NDArray[np.float64],
    x: NDArray[np.float64],
    q: NDArray[np.int64],
    r: NDArray[np.float64],
    work: NDArray[np.float64],
    table: NDArray[np.float64],
    points: NDArray[np.int64],
    count: int,
) -> int:
    """Remove ``points[:count]`` together, for fewer pivots than one after the other."""
    for k in range(count):
        gain[points[k]] = 0.0
        cap[points[k]] = np.inf
    return _refit_without(At, b, gain, cap, C, x, q, r, work, table)


@kernel
def _refit_without(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    C: NDArray[np.float64],
    x: NDArray[np.float64],
    q: NDArray[np.int64],
    r: NDArray[np.float64],
    work: NDArray[np.float64],
    table: NDArray[np.float64],
) -> int:
    """Let go of the basis rows of points that are out, and move to the fit of the rest."""
    n = x.shape[0]
    status = OK
    for k in range(n):
        if status == OK and q[k] >= 0 and cap[q[k] >> 1] == np.inf:
            status = relax_row(At, gain, cap, C, x, q, r, work, table, k, True)
    if status == OK:
        for count in range(20 * n + 100):
            relax = row_to_relax(C, q, count > 4 * n + 8)
            if relax < 0:
                break
            status = relax_row(At, gain, cap, C, x, q, r, work, table, relax, False)
            if status != OK:
                break
    if status == OK:
        status = settle(At, b, gain, cap, C, x, q, r, work, table)
    if status != OK:
        status = cold_fit(At, b, gain, cap, C, x, q, r, work, table)
    return status


@kernel
def refit_after_addition(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    C: NDArray[np.float64],
    x: NDArray[np.float64],
    q: NDArray[np.int64],
    r: NDArray[np.float64],
    work: NDArray[np.float64],
    table: NDArray[np.float64],
    point: int,
    stop_above: float,
) -> int:
    """Add `point` to the fit (its mode is set here); STOPPED as soon as gamma is proven above `stop_above`.

    After STOPPED the vertex belongs to no state: the caller restores the one that it had.
    """
    if gain[point] == 0.0 and cap[point] < np.inf:  # enforced so far: its row, if tight, would change its meaning
        status = refit_after_removal(At, b, gain, cap, C, x, q, r, work, table, point)
        if status != OK:
            return status
    gain[point] = 1.0
    cap[point] = 0.0
    if abs(r[point]) <= x[x.shape[0] - 1]:
        return OK
    status = dual_simplex(At, b, gain, cap, C, x, q, r, work, table, stop_above, False)
    if status == OK:
        status = settle(At, b, gain, cap, C, x, q, r, work, table)
    if status == FAILED:
        status = cold_fit(At, b, gain, cap, C, x, q, r, work, table)
    return status


@kernel
def refit_after_enforcement(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    C: NDArray[np.float64],
    x: NDArray[np.float64],
    q: NDArray[np.int64],
    r: NDArray[np.float64],
    work: NDArray[np.float64],
    table: NDArray[np.float64],
    point: int,
    threshold: float,
) -> int:
    """Demand that the residual of `point` is at most `threshold` from now on (its mode is set here).

    INFEASIBLE where no model keeps all enforced points within their thresholds.
    """
    n = x.shape[0]
    was_free = gain[point] == 1.0
    gain[point] = 0.0
    cap[point] = threshold
    status = OK
    sides = 0
    drifted = False
    for k in range(n):
        if q[k] >= 0 and q[k] >> 1 == point and was_free:
            # The row loses its gamma: g' = g - e_n, a change of rank one in G and so in C. Not so where both sides
            # of the point are tight: without gamma they are one row.
            multiplier = C[n - 1, k]
            sides += 1
            if sides == 2 or 1.0 - multiplier < 1e-7:
                status = FAILED
                break
            for m in range(n):
                table[n, m] = C[n - 1, m] / (1.0 - multiplier)
            for j in range(n):
                c = C[j, k]
                for m in range(n):
                    C[j, m] += c * table[n, m]
            # x moves along that row's column of C, on which no other basis row changes, to the new residual.
            gap = (1.0 - 2.0 * (q[k] & 1)) * r[point] - threshold
            for j in range(n):
                x[j] += gap * C[j, k]
            drifted = multiplier > 0.9  # and so C grew tenfold, rounding with it
    if sides == 1 and status == OK and not refine_vertex(At, b, gain, cap, C, x, q, table, drifted):
        status = FAILED
    if status == OK:
        status = dual_simplex(At, b, gain, cap, C, x, q, r, work, table, np.inf, False)
    if status == OK:
        status = settle(At, b, gain, cap, C, x, q, r, work, table)
    if status == FAILED:
        status = cold_fit(At, b, gain, cap, C, x, q, r, work, table)
    return status
