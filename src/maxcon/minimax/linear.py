"""Kernels of the minimax fit for linear residuals: cold, and what the warm re-fits (`refits`) are made of.

Every point i has a mode, two numbers: its residual must be at most ``gain[i] * gamma + cap[i]``.
In the minimax fit: gain 1, cap 0. Removed: gain 0, cap infinite. Enforced within a threshold: gain 0, cap = threshold.
All kernels share one vertex (C, x, q; see `simplex`), the residuals r at it, and scratch space
`work`, shape (3, max(N, n)), and `table`, shape (n + 2, n). They return OK, INFEASIBLE or FAILED.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel
from maxcon.minimax.simplex import (
    coefficients,
    invert,
    leaving_row,
    pivot,
    release,
    row_to_relax,
    start,
)

OK = 0
INFEASIBLE = 1
FAILED = 2  # rounding defeated the pivots; callers start again cold
STOPPED = 3  # gamma has passed `stop_above`

#: A row is violated when it is by more than this, times the size of its residual (see `_tolerance`): some hundred
#: times what rounding does to it.
FEASIBILITY_TOLERANCE = 3e-14

#: What no row of whitened data can be said to be violated by: b is at most 1.
ROUNDING = 1e-15

#: Enforced points that meet at their thresholds, but for rounding, can be kept: a tenth of the slack of a threshold.
DOUBT_TOLERANCE = 1e-10


@kernel
def compute_residuals(
    At: NDArray[np.float64], b: NDArray[np.float64], x: NDArray[np.float64], r: NDArray[np.float64]
) -> None:
    """Write r = b - At.T @ x[:d]."""
    for i in range(r.shape[0]):
        r[i] = b[i]
    _subtract_product(At, x, r)


@kernel
def _subtract_product(At: NDArray[np.float64], x: NDArray[np.float64], r: NDArray[np.float64]) -> None:
    d, N = At.shape[0], r.shape[0]
    j = 0
    while j + 3 < d:  # four directions a pass: memory traffic, not arithmetic, is what costs
        x0, x1, x2, x3 = x[j], x[j + 1], x[j + 2], x[j + 3]
        a0, a1, a2, a3 = At[j], At[j + 1], At[j + 2], At[j + 3]
        for i in range(N):
            r[i] -= (a0[i] * x0 + a1[i] * x1) + (a2[i] * x2 + a3[i] * x3)
        j += 4
    while j < d:
        x0, a0 = x[j], At[j]
        for i in range(N):
            r[i] -= a0[i] * x0
        j += 1


@kernel
def _most_violated(
    r: NDArray[np.float64],
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    gamma: float,
    excess: NDArray[np.float64],
) -> int:
    """Return the point whose residual exceeds what its mode allows by the most; -1 if none does."""
    N = r.shape[0]
    for i in range(N):
        excess[i] = abs(r[i]) - (gain[i] * gamma + cap[i])
    # The order of positive floats is the order of their bits, and a maximum of integers vectorises.
    bits = excess.view(np.int64)
    most = np.int64(0)
    for i in range(N):
        most = max(most, bits[i])
    if most <= 0:
        return -1
    for i in range(N):
        if bits[i] == most:
            return i
    return -1


@kernel
def _first_violated(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    x: NDArray[np.float64],
    r: NDArray[np.float64],
) -> int:
    gamma = x[x.shape[0] - 1]
    for i in range(r.shape[0]):
        excess = abs(r[i]) - (gain[i] * gamma + cap[i])
        if excess > 0.0 and excess > _tolerance(At, b, gain, cap, x, i):
            return i
    return -1


@kernel
def _tolerance(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    x: NDArray[np.float64],
    i: int,
) -> float:
    """Return what point i may be violated by and still count as kept: the rounding of the sum that its residual is.

    A short row among long ones (that may all be removed) has a small sum of large x.
    """
    d = At.shape[0]
    own = abs(b[i]) + gain[i] * abs(x[d]) + cap[i]
    common = 1.0 + abs(x[d])
    for j in range(d):
        own += abs(At[j, i] * x[j])
        common += abs(x[j])
    return float(FEASIBILITY_TOLERANCE * min(own, common))


@kernel
def _fill_row(At: NDArray[np.float64], gain: NDArray[np.float64], name: int, n: int, g: NDArray[np.float64]) -> None:
    """Write the row called `name` into g."""
    if name < 0:
        for j in range(n):
            g[j] = 0.0
        g[-1 - name] = 1.0
        return
    i = name >> 1
    sign = 1.0 - 2.0 * (name & 1)
    for j in range(n - 1):
        g[j] = sign * At[j, i]
    g[n - 1] = gain[i]


@kernel
def refine_vertex(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    C: NDArray[np.float64],
    x: NDArray[np.float64],
    q: NDArray[np.int64],
    table: NDArray[np.float64],
    always: bool,
) -> bool:
    """Bring x onto its tight rows by one step of iterative refinement; re-invert where C has drifted.

    Returns False where the basis has become singular.
    """
    n = x.shape[0]
    gap = table[n]
    for attempt in range(3):
        worst = 0.0
        settled = True
        for k in range(n):
            name = q[k]
            allowed = FEASIBILITY_TOLERANCE
            if name < 0:
                gap[k] = -x[n - 1] if name == -n else 0.0
            else:
                i = name >> 1
                sign = 1.0 - 2.0 * (name & 1)
                value = sign * b[i] - cap[i] - gain[i] * x[n - 1]
                for j in range(n - 1):
                    value -= sign * At[j, i] * x[j]
                gap[k] = value
                allowed = _tolerance(At, b, gain, cap, x, i)
            worst = max(worst, abs(gap[k]))
            settled = settled and abs(gap[k]) <= 0.3 * allowed
        if not always or attempt > 0:
            if settled:
                return True
            if attempt == 0 and worst <= 1e-9:
                for j in range(n):
                    for k in range(n):
                        x[j] += C[j, k] * gap[k]
                continue
        if attempt == 2:
            return worst <= 1e-9
        for k in range(n):
            _fill_row(At, gain, q[k], n, table[k])
        if not invert(table[:n], C):
            return False
        for j in range(n):
            for k in range(n):
                x[j] += C[j, k] * gap[k]
    return True


@kernel
def _doubt(
    At: NDArray[np.float64],
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    x: NDArray[np.float64],
    q: NDArray[np.int64],
    g: NDArray[np.float64],
    w: NDArray[np.float64],
) -> float:
    """Return how far a row g with no row to leave for it must be violated before that proves infeasibility.

    With ``g = sum_k w[k] * row k`` and no w[k] > 0 (Farkas' certificate), g . x is largest at the vertex. This is what
    rounding may add: a w[k] a little above 0, and g not quite that sum.
    """
    n = x.shape[0]
    doubt = 0.0
    for k in range(n):
        if q[k] >= 0:
            i = q[k] >> 1
            doubt += max(w[k], 0.0) * 2.0 * (gain[i] * max(x[n - 1], 1.0) + cap[i])
        elif q[k] > -n:
            doubt += abs(w[k]) * (1.0 + abs(x[-1 - q[k]]))
        else:
            doubt += max(w[k], 0.0) * max(x[n - 1], 1.0)
    for j in range(n):
        error = g[j]
        for k in range(n):
            if q[k] < 0:
                error -= w[k] if -1 - q[k] == j else 0.0
            elif j == n - 1:
                error -= w[k] * gain[q[k] >> 1]
            else:
                error -= w[k] * (1.0 - 2.0 * (q[k] & 1)) * At[j, q[k] >> 1]
        doubt += abs(error) * (1.0 + abs(x[j]))
    return doubt


@kernel
def dual_simplex(
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
    stop_above: float,
    careful: bool,
) -> int:
    """Restore feasibility from a vertex whose multipliers have the right sign; gamma only grows.

    `careful` takes the first violated row (Bland's rule: no cycling) and re-inverts often.
    """
    n = x.shape[0]
    N = r.shape[0]
    g, w = table[n], table[n + 1]
    bland = careful
    stalled = 0
    fresh = False
    last_gamma = x[n - 1]
    for count in range(40 * n + 400):
        if count > 0 and (careful or count % 40 == 0) and not refine_vertex(At, b, gain, cap, C, x, q, table, True):
            return FAILED
        compute_residuals(At, b, x, r)
        gamma = x[n - 1]
        if bland:
            enter = _first_violated(At, b, gain, cap, x, r)
        else:
            enter = _most_violated(r, gain, cap, gamma, work[0, :N])
            if enter >= 0 and work[0, enter] <= _tolerance(At, b, gain, cap, x, enter):
                enter = _first_violated(At, b, gain, cap, x, r) if work[0, enter] > ROUNDING else -1
        if enter < 0:
            return OK
        if not (abs(r[enter]) < np.inf):
            return FAILED
        name = 2 * enter + (1 if r[enter] < 0.0 else 0)
        _fill_row(At, gain, name, n, g)
        coefficients(C, g, w)
        leave = leaving_row(C, q, w, bland)
        step = abs(r[enter]) - (gain[enter] * gamma + cap[enter])
        if leave < 0:
            doubt = _doubt(At, gain, cap, x, q, g, w)
            if step > doubt:
                return INFEASIBLE
            if not fresh:  # C may have drifted
                if not refine_vertex(At, b, gain, cap, C, x, q, table, True):
                    return FAILED
                fresh = True
                continue
            most = _most_violated(r, gain, cap, gamma, work[0, :N])
            return OK if max(doubt, work[0, most]) <= DOUBT_TOLERANCE else FAILED
        pivot(C, w, leave)
        for j in range(n):
            x[j] += step * C[j, leave]
        q[leave] = name
        if x[n - 1] > stop_above:
            return STOPPED
        if x[n - 1] > last_gamma + FEASIBILITY_TOLERANCE:
            last_gamma = x[n - 1]
            stalled = 0
        else:
            stalled += 1
            bland = careful or stalled > 4 * n + 8
    return FAILED


@kernel
def relax_row(
    At: NDArray[np.float64],
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    C: NDArray[np.float64],
    x: NDArray[np.float64],
    q: NDArray[np.int64],
    r: NDArray[np.float64],
    work: NDArray[np.float64],
    table: NDArray[np.float64],
    leave: int,
    removed: bool,
) -> int:
    """Let go of basis row `leave` and move, gamma falling, until another row is tight: one primal pivot."""
    n = x.shape[0]
    N = r.shape[0]
    direction, g, w = table[n - 1], table[n], table[n + 1]
    multiplier = C[n - 1, leave]
    free = removed or (q[leave] < 0 and q[leave] > -n)
    sigma = -1.0 if (free and multiplier >= 0.0) else 1.0
    size = 0.0
    for j in range(n):
        direction[j] = sigma * C[j, leave]
        size = max(size, abs(direction[j]))
    slope = direction[n - 1]
    gamma = x[n - 1]
    least = PIVOT_FLOOR * size

    rate = work[0, :N]
    for i in range(N):
        rate[i] = 0.0
    _subtract_product(At, direction, rate)
    steps = work[1, :N]
    for i in range(N):
        limit = gain[i] * gamma + cap[i]
        closing = gain[i] * slope
        upper = rate[i] - closing
        lower = -rate[i] - closing
        to_upper = max(limit - r[i], 0.0) / upper if upper > least else np.inf
        to_lower = max(limit + r[i], 0.0) / lower if lower > least else np.inf
        steps[i] = min(to_upper, to_lower)
    bits = steps.view(np.int64)
    shortest = np.int64(0x7FF0000000000000)  # the bits of infinity
    for i in range(N):
        shortest = min(shortest, bits[i])
    enter = -1
    step = np.inf
    if shortest < np.int64(0x7FF0000000000000):
        for i in range(N):
            if bits[i] == shortest:
                enter = i
                step = steps[i]
                break
    if slope < -least:  # gamma >= 0 may come first
        held = False
        for k in range(n):
            held = held or q[k] == -n
        if not held and gamma <= -slope * step:
            _fill_row(At, gain, -n, n, g)
            coefficients(C, g, w)
            step = max(gamma, 0.0) / -slope
            for i in range(N):
                r[i] += step * rate[i]
            for j in range(n):
                x[j] += step * direction[j]
            pivot(C, w, leave)
            q[leave] = -n
            return OK
    if enter < 0:
        if abs(multiplier) > 1e-9:
            return FAILED
        release(C, q, leave)
        return OK
    limit = gain[enter] * gamma + cap[enter]
    closing = gain[enter] * slope
    upper = rate[enter] - closing
    to_upper = max(limit - r[enter], 0.0) / upper if upper > least else np.inf
    name = 2 * enter + (0 if to_upper == step else 1)
    for i in range(N):
        r[i] += step * rate[i]
    for j in range(n):
        x[j] += step * direction[j]
    _fill_row(At, gain, name, n, g)
    coefficients(C, g, w)
    if abs(w[leave]) < least:
        return FAILED
    pivot(C, w, leave)
    q[leave] = name
    return OK


#: The smallest rate, relative to the direction, at which a row can stop a primal step.
PIVOT_FLOOR = 1e-10


@kernel
def cold_fit(
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
    """Solve from the all-artificial basis, that is from the least-squares fit of all points."""
    status = FAILED
    for attempt in range(2):
        start(C, x, q)
        if attempt == 0 and x.shape[0] > 5 and r.shape[0] >= 40 * x.shape[0]:
            # The fit of some points is a good start for the fit of all, and its pivots look at those points only;
            # with few parameters there are too few pivots to save.
            m = 8 * x.shape[0]
            early = dual_simplex(At, b[:m], gain[:m], cap[:m], C, x, q, r[:m], work, table, np.inf, False)
            if early != OK:
                start(C, x, q)
        status = dual_simplex(At, b, gain, cap, C, x, q, r, work, table, np.inf, attempt > 0)
        if status == OK:
            status = settle(At, b, gain, cap, C, x, q, r, work, table)
        if status != FAILED:
            return status
    return status


@kernel
def settle(
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
    """Refine the vertex and make sure that it is optimal: all rows kept, all multipliers of the right sign."""
    n = x.shape[0]
    for _ in range(4):
        if not refine_vertex(At, b, gain, cap, C, x, q, table, False):
            return FAILED
        status = dual_simplex(At, b, gain, cap, C, x, q, r, work, table, np.inf, False)
        if status != OK:
            return status
        relax = row_to_relax(C, q, False)
        if relax < 0:
            return OK
        for count in range(20 * n + 100):
            if relax_row(At, gain, cap, C, x, q, r, work, table, relax, False) != OK:
                return FAILED
            relax = row_to_relax(C, q, count > 4 * n + 8)
            if relax < 0:
                break
    return FAILED


#: Only a row whose multiplier is above this holds the fit in place: removing its point lowers f(S).
BASIS_TOLERANCE = 1e-10


@kernel
def basis_points(C: NDArray[np.float64], q: NDArray[np.int64], basis: NDArray[np.int64]) -> int:
    """Write the points that hold the fit into `basis`, ascending, the rest -1; return how many there are."""
    n = q.shape[0]
    size = 0
    for k in range(n):
        if q[k] < 0 or C[n - 1, k] <= BASIS_TOLERANCE:
            continue
        point = q[k] >> 1
        place = size
        while place > 0 and basis[place - 1] > point:
            place -= 1
        if place > 0 and basis[place - 1] == point:  # both sides of one point
            continue
        for m in range(size, place, -1):
            basis[m] = basis[m - 1]
        basis[place] = point
        size += 1
    for k in range(size, n):
        basis[k] = -1
    return size


@kernel
def basis_multipliers(
    C: NDArray[np.float64], q: NDArray[np.int64], basis: NDArray[np.int64], multipliers: NDArray[np.float64]
) -> None:
    """Write the dual multiplier of each point of `basis` (from `basis_points`), 0 where it is -1."""
    n = q.shape[0]
    for slot in range(basis.shape[0]):
        multipliers[slot] = 0.0
        for k in range(n):
            if q[k] >= 0 and q[k] >> 1 == basis[slot]:
                multipliers[slot] += max(C[n - 1, k], 0.0)
