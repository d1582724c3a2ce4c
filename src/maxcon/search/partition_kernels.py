"""Kernels of the partition search around one node: its linear programme, its packing bound, its witnesses.

A programme has a column for each kept point of the node and each point enforced elsewhere. It is solved by the dual
simplex from a basis that is always dual feasible: enforced rows, free variables pinned where they are, gamma >= 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import (
    BASIS_TOLERANCE,
    FAILED,
    INFEASIBLE,
    OK,
    compute_residuals,
    dual_simplex,
    refine_vertex,
)
from maxcon.minimax.simplex import coefficients, pivot, start

# What a programme comes to, beside INFEASIBLE (no model keeps the enforced points) and FAILED (rounding).
FEASIBLE = 10  # some model keeps all points within the limit
CONFLICT = 11  # no model does: the free points of the basis hold an outlier

#: A basis row with a smaller multiplier is no part of a conflict: the rounding of a zero is below it.
ZERO_MULTIPLIER = 1e-13

#: An enforced row joins the starting basis only over a pivot of this size, relative to the largest coefficient.
STEADY_PIVOT = 1e-3

#: Multipliers of a vertex that are off by more are computed again.
DRIFT = 1e-11


@kernel
def pack_programme(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    limit: float,
    kept: NDArray[np.uint8],
    held: NDArray[np.uint8],
    enforced: NDArray[np.int64],
    n_enforced: int,
    lo: int,
    hi: int,
    offset: int,
    lp_rows: NDArray[np.float64],
    lp: NDArray[np.float64],
    lp_place: NDArray[np.int64],
) -> int:
    """Write the rows of the kept points from lo to hi, then of the points enforced elsewhere; return how many."""
    m = 0
    for p in range(lo, hi):
        if kept[p]:
            lp_place[offset + m] = p
            m += 1
    for k in range(n_enforced):
        p = enforced[k]
        if p < lo or p >= hi:
            lp_place[offset + m] = p
            m += 1
    d = At.shape[0]
    for c in range(m):
        p = lp_place[offset + c]
        lp[0, offset + c] = b[p]
        lp[1, offset + c] = 0.0 if held[p] else 1.0
        lp[2, offset + c] = limit if held[p] else 0.0
    for j in range(d):
        row = d * offset + j * m
        for c in range(m):
            lp_rows[row + c] = At[j, lp_place[offset + c]]
    return m


@kernel
def copy_vertex(
    C: NDArray[np.float64],
    x: NDArray[np.float64],
    q: NDArray[np.int64],
    C_to: NDArray[np.float64],
    x_to: NDArray[np.float64],
    q_to: NDArray[np.int64],
) -> None:
    """Copy a vertex."""
    n = x.shape[0]
    for j in range(n):
        for k in range(n):
            C_to[j, k] = C[j, k]
        x_to[j] = x[j]
        q_to[j] = q[j]


@kernel
def hold_column(
    A: NDArray[np.float64],
    b: NDArray[np.float64],
    cap: NDArray[np.float64],
    C: NDArray[np.float64],
    x: NDArray[np.float64],
    q: NDArray[np.int64],
    table: NDArray[np.float64],
    column: int,
) -> None:
    """Bring an enforced row into a starting basis, in place of a free variable; not if it depends on those in it."""
    n = x.shape[0]
    g, w = table[n], table[n + 1]
    residual = b[column]
    for j in range(n - 1):
        residual -= A[j, column] * x[j]
    sign = 1.0 if residual >= 0.0 else -1.0
    for j in range(n - 1):
        g[j] = sign * A[j, column]
    g[n - 1] = 0.0
    coefficients(C, g, w)
    leave, size, largest = -1, 0.0, 0.0
    for k in range(n):
        largest = max(largest, abs(w[k]))
        if q[k] < 0 and q[k] > -n and abs(w[k]) > size:
            leave, size = k, abs(w[k])
    if leave < 0 or size <= STEADY_PIVOT * largest:
        return
    pivot(C, w, leave)
    q[leave] = 2 * column + (0 if sign > 0.0 else 1)
    step = abs(residual) - cap[column]
    for j in range(n):
        x[j] += step * C[j, leave]


@kernel
def start_programme(
    A: NDArray[np.float64],
    b: NDArray[np.float64],
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    C: NDArray[np.float64],
    x: NDArray[np.float64],
    q: NDArray[np.int64],
    table: NDArray[np.float64],
) -> None:
    """Put the starting basis of all enforced rows into C, x, q."""
    start(C, x, q)
    for c in range(b.shape[0]):
        if gain[c] == 0.0 and cap[c] < np.inf:
            hold_column(A, b, cap, C, x, q, table, c)


@kernel
def enforce_in_vertex(
    A: NDArray[np.float64],
    b: NDArray[np.float64],
    cap: NDArray[np.float64],
    C: NDArray[np.float64],
    x: NDArray[np.float64],
    q: NDArray[np.int64],
    table: NDArray[np.float64],
    column: int,
) -> bool:
    """Change the basis row of `column`, if there is one, from "at most gamma" to "at most cap".

    The row g becomes g - e_n, a change of rank one: C += C[:, k] C[n, :] / (1 - C[n, k]). False where that is
    ill-conditioned, or both sides of the point are in the basis.
    """
    n = x.shape[0]
    row, sides = -1, 0
    for k in range(n):
        if q[k] >= 0 and q[k] >> 1 == column:
            row = k
            sides += 1
    if sides == 0:
        return True
    rest = 1.0 - C[n - 1, row]
    if sides == 2 or rest < 1e-4:
        return False
    last = table[n]
    for k in range(n):
        last[k] = C[n - 1, k] / rest
    step = x[n - 1] - cap[column]
    for j in range(n):
        c = C[j, row]
        for k in range(n):
            C[j, k] += c * last[k]
        x[j] += step * C[j, row]
    return True


@kernel
def doubt(
    A: NDArray[np.float64],
    b: NDArray[np.float64],
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    C: NDArray[np.float64],
    x: NDArray[np.float64],
    q: NDArray[np.int64],
    table: NDArray[np.float64],
) -> float:
    """Return how much less than gamma the multipliers prove, for rounding.

    They should be >= 0, and combine the rows to gamma; x should lie on the rows.
    """
    n = x.shape[0]
    total = table[n]
    for j in range(n):
        total[j] = 0.0
    total[n - 1] = -1.0
    error = 0.0
    for k in range(n):
        multiplier = C[n - 1, k]
        if q[k] < 0:
            total[-1 - q[k]] += multiplier
            if q[k] == -n:
                error += abs(multiplier * x[n - 1]) + max(-multiplier, 0.0)
            else:
                error += abs(multiplier)
            continue
        i = q[k] >> 1
        sign = 1.0 - 2.0 * (q[k] & 1)
        gap = cap[i] + gain[i] * x[n - 1] - sign * b[i]
        for j in range(n - 1):
            a = sign * A[j, i]
            gap += a * x[j]
            total[j] += multiplier * a
        total[n - 1] += multiplier * gain[i]
        error += abs(multiplier * gap) + max(-multiplier, 0.0)
    for j in range(n):
        error += abs(total[j]) * (1.0 + abs(x[j]))
    return error


@kernel
def solve_from(
    A: NDArray[np.float64],
    b: NDArray[np.float64],
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    C: NDArray[np.float64],
    x: NDArray[np.float64],
    q: NDArray[np.int64],
    r: NDArray[np.float64],
    work: NDArray[np.float64],
    table: NDArray[np.float64],
    limit: float,
    to_optimum: bool,
) -> int:
    """Solve from a dual feasible vertex: FEASIBLE, CONFLICT, INFEASIBLE or FAILED.

    Stops at the first vertex that proves a conflict, unless `to_optimum`. Where rounding stands in the way it begins
    again from nothing, with care.
    """
    n = x.shape[0]
    for attempt in range(2):
        if attempt > 0:
            start(C, x, q)
        stop_above = np.inf if to_optimum else limit
        status = dual_simplex(A, b, gain, cap, C, x, q, r, work, table, stop_above, attempt > 0)
        if status == INFEASIBLE:
            return INFEASIBLE
        if status == FAILED:
            continue
        error = doubt(A, b, gain, cap, C, x, q, table)
        if error > DRIFT:
            if not refine_vertex(A, b, gain, cap, C, x, q, table, True):
                continue
            error = doubt(A, b, gain, cap, C, x, q, table)
        if x[n - 1] - error > limit:
            return CONFLICT
        if x[n - 1] <= limit and status == OK:
            return FEASIBLE
    return FAILED


@kernel
def inherit_bases(labels: NDArray[np.int32], f: int, m: int, bases: int, column: int, removed: bool) -> int:
    """Write to row f of `labels` the bases of row f - 1 that survive; return how many.

    They all do where `column` is enforced; where it is removed, its own does not.
    """
    lost = labels[f - 1, column] if removed else 0
    for c in range(m):
        label = labels[f - 1, c]
        if label == lost:
            label = 0
        elif label == bases and lost > 0:
            label = lost
        labels[f, c] = label
    labels[f, column] = 0
    return bases - 1 if lost > 0 else bases


@kernel
def label_basis(
    C: NDArray[np.float64],
    q: NDArray[np.int64],
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    labels: NDArray[np.int32],
    label: int,
) -> None:
    """Remove the free points of a basis from a programme, and label them."""
    n = q.shape[0]
    for k in range(n):
        if q[k] >= 0 and C[n - 1, k] > ZERO_MULTIPLIER and gain[q[k] >> 1] > 0.0:
            gain[q[k] >> 1] = 0.0
            cap[q[k] >> 1] = np.inf
            labels[q[k] >> 1] = label


@kernel
def branching_column(
    C: NDArray[np.float64],
    q: NDArray[np.int64],
    gain: NDArray[np.float64],
    place: NDArray[np.int64],
    rank: NDArray[np.float64],
) -> tuple[int, int]:
    """Return the column of the free basis point with the largest rank (-1: none), and how many there are."""
    n = q.shape[0]
    best, best_rank, count = -1, -1.0, 0
    for k in range(n):
        if q[k] >= 0 and C[n - 1, k] > ZERO_MULTIPLIER and gain[q[k] >> 1] > 0.0:
            count += 1
            if C[n - 1, k] > BASIS_TOLERANCE and rank[place[q[k] >> 1]] > best_rank:
                best = q[k] >> 1
                best_rank = rank[place[best]]
    return best, count


@kernel
def write_outliers(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    x: NDArray[np.float64],
    limit: float,
    far: NDArray[np.float64],
    out: NDArray[np.uint8],
) -> int:
    """Write the outliers of model x to `out` and return how many there are.

    A vertex puts enforced points on the limit: rounding must not make outliers of them.
    """
    compute_residuals(At, b, x, far)
    size = 1.0
    for j in range(x.shape[0]):
        size += abs(x[j])
    allowed = limit + 1e-13 * size
    outliers = 0
    for i in range(far.shape[0]):
        out[i] = abs(far[i]) > allowed
        outliers += out[i]
    return outliers


@kernel
def fewest_outliers(
    models: NDArray[np.uint8],
    node: int,
    n_models: int,
    kept: NDArray[np.uint8],
    enforced: NDArray[np.int64],
    n_enforced: int,
    lo: int,
    hi: int,
    fewest: int,
) -> int:
    """Return the fewest kept outliers, from place lo to hi, of the models of `node` that keep all enforced points."""
    for slot in range(n_models):
        valid = True
        for k in range(n_enforced):
            if models[node, slot, enforced[k]]:
                valid = False
                break
        if valid:
            total = 0
            for i in range(lo, hi):
                total += models[node, slot, i] & kept[i]
            fewest = min(fewest, total)
    return fewest
