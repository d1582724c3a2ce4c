"""The dual simplex on (d+1) x (d+1) bases, apart from where its rows come from.

The linear programme is: minimise gamma = x[d] subject to rows ``g . x >= h``. A vertex is held by n = d + 1
tight rows G x = h with the explicit inverse C = G^-1; the multipliers of the rows are the last row of C.
Rows are named by integers (`q`): ``2 i`` and ``2 i + 1`` are the upper and the lower side of point i; negative
names are artificial rows: ``-1 - j`` pins x[j] where it is (j < d; a free variable that nothing holds yet, its
multiplier must be 0) and ``-1 - d`` is ``gamma >= 0``.

Starting from C = I, all rows artificial, every problem has a dual feasible basis, whatever its rank.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel

#: A free variable counts as held by a row only if its coefficient, relative to the largest, is above this;
#: the rows are whitened, so that what lies below is rounding of a dependent row.
FREE_TOLERANCE = 1e-11

#: A multiplier (they sum to 1) may be this far below 0: Harris' ratio test trades it for a larger pivot.
DUAL_TOLERANCE = 1e-12

#: The smallest pivot, relative to the largest coefficient of the row (its rounding grows with that); a row that would
#: need a smaller one is treated as parallel to the basis.
PIVOT_TOLERANCE = 1e-10


@kernel
def start(C: NDArray[np.float64], x: NDArray[np.float64], q: NDArray[np.int64]) -> None:
    """Put the all-artificial basis at x = 0 into C, x, q."""
    n = x.shape[0]
    for j in range(n):
        for k in range(n):
            C[j, k] = 0.0
        C[j, j] = 1.0
        x[j] = 0.0
        q[j] = -1 - j


@kernel
def coefficients(C: NDArray[np.float64], g: NDArray[np.float64], w: NDArray[np.float64]) -> None:
    """Write the row g in terms of the basis rows: g = sum_k w[k] * row k."""
    n = w.shape[0]
    for k in range(n):
        w[k] = 0.0
    for j in range(n):
        gj = g[j]
        if gj != 0.0:
            for k in range(n):
                w[k] += gj * C[j, k]


@kernel
def leaving_row(C: NDArray[np.float64], q: NDArray[np.int64], w: NDArray[np.float64], bland: bool) -> int:
    """Return which basis row makes room for a violated row with coefficients w, or -1: infeasible."""
    n = w.shape[0]
    largest = 0.0
    for k in range(n):
        largest = max(largest, abs(w[k]))
    leave = -1
    best = FREE_TOLERANCE * (1.0 + largest)
    for k in range(n):  # a variable that was free is held from now on
        if q[k] < 0 and q[k] > -n and abs(w[k]) > best:
            best = abs(w[k])
            leave = k
    if leave >= 0:
        return leave

    slack = 0.0 if bland else DUAL_TOLERANCE
    least = PIVOT_TOLERANCE * (1.0 + largest)
    bound = np.inf
    for k in range(n):
        if w[k] > least and (q[k] >= 0 or q[k] == -n):
            bound = min(bound, (max(C[n - 1, k], 0.0) + slack) / w[k])
    if bound == np.inf:
        return -1
    best = 0.0
    name = np.int64(0)
    for k in range(n):
        if w[k] > least and (q[k] >= 0 or q[k] == -n) and max(C[n - 1, k], 0.0) <= bound * w[k]:
            if bland:
                if leave < 0 or q[k] < name:
                    leave = k
                    name = q[k]
            elif w[k] > best:
                leave = k
                best = w[k]
    return leave


@kernel
def pivot(C: NDArray[np.float64], w: NDArray[np.float64], leave: int) -> None:
    """Update the inverse: the row with coefficients w takes the place of basis row `leave`."""
    n = w.shape[0]
    inverse = 1.0 / w[leave]
    for j in range(n):
        c = C[j, leave] * inverse
        if c != 0.0:
            for k in range(n):
                C[j, k] -= c * w[k]
        C[j, leave] = c


@kernel
def release(C: NDArray[np.float64], q: NDArray[np.int64], k: int) -> None:
    """Replace basis row k, which nothing holds any more, by the artificial row that fits best."""
    n = q.shape[0]
    free = 0
    best = -1.0
    for j in range(n - 1):
        if abs(C[j, k]) > best:
            best = abs(C[j, k])
            free = j
    row = C[free].copy()
    pivot(C, row, k)
    q[k] = -1 - free


@kernel
def row_to_relax(C: NDArray[np.float64], q: NDArray[np.int64], bland: bool) -> int:
    """Return a basis row whose multiplier has the wrong sign, the worst or (bland) the first; -1 if none."""
    n = q.shape[0]
    worst = 1e-11
    relax = -1
    for k in range(n):
        multiplier = C[n - 1, k]
        wrong = abs(multiplier) if (q[k] < 0 and q[k] > -n) else -multiplier
        if wrong > worst:
            if bland:
                if relax < 0 or q[k] < q[relax]:
                    relax = k
            else:
                worst = wrong
                relax = k
    return relax


@kernel
def invert(G: NDArray[np.float64], C: NDArray[np.float64]) -> bool:
    """Write the inverse of G into C by Gauss-Jordan with partial pivoting (G is spent); False if singular."""
    n = G.shape[0]
    for j in range(n):
        for k in range(n):
            C[j, k] = 0.0
        C[j, j] = 1.0
    for k in range(n):
        p = k
        for j in range(k + 1, n):
            if abs(G[j, k]) > abs(G[p, k]):
                p = j
        if abs(G[p, k]) < 1e-14:
            return False
        if p != k:
            for m in range(n):
                G[k, m], G[p, m] = G[p, m], G[k, m]
                C[k, m], C[p, m] = C[p, m], C[k, m]
        inverse = 1.0 / G[k, k]
        for m in range(n):
            G[k, m] *= inverse
            C[k, m] *= inverse
        for j in range(n):
            if j != k and G[j, k] != 0.0:
                c = G[j, k]
                for m in range(n):
                    G[j, m] -= c * G[k, m]
                    C[j, m] -= c * C[k, m]
    return True
