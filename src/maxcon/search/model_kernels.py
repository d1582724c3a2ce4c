"""Kernels that make models, from a minimal sample or by weighted least squares, and that count their inliers.

All work on whitened rows (see `maxcon.minimax.rows`): `At` of shape (r, N), `b` of shape (N,). A model is a
vector x of r numbers with residuals ``b - At.T @ x``. Where the points that define it leave some direction
open, as duplicate, collinear or quantised points do, the model is 0 in that direction (where the
least-squares fit of all points is): every call makes a model.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import compute_residuals
from maxcon.minimax.sums import dot
from maxcon.search.random_kernels import draw_next

#: A row counts as dependent on those before it where elimination leaves less than this of its largest
#: entry, or no more than the rounding of whitened rows (whose entries are of order 1).
DEPENDENT = 1e-9
ROUNDING = 1e-12

#: The same for a pivot of the normal equations, whose entries are squares.
DEPENDENT_SQUARED = 1e-12

#: Points scored before asking whether a model can still win; smaller blocks cost more than they save.
BLOCK = 256


@kernel
def count_within(r: NDArray[np.float64], limit: float) -> int:
    """Return how many residuals are at most `limit` in size."""
    count = 0
    for i in range(r.shape[0]):
        count += abs(r[i]) <= limit
    return count


@kernel
def score(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    x: NDArray[np.float64],
    limit: float,
    to_beat: int,
    r: NDArray[np.float64],
) -> int:
    """Return the consensus of model x, or some number <= `to_beat` once it cannot be more; r is spoilt."""
    d, N = At.shape
    if N < 2 * BLOCK:
        compute_residuals(At, b, x, r)
        return count_within(r, limit)
    count = 0
    for first in range(0, N, BLOCK):
        last = min(first + BLOCK, N)
        part = r[first:last]
        part[:] = b[first:last]
        for j in range(d):
            a, xj = At[j, first:last], x[j]
            for i in range(last - first):
                part[i] -= a[i] * xj
        count += count_within(part, limit)
        if count + N - last <= to_beat:
            return count
    return count


@kernel
def minimal_model(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    pool: NDArray[np.int64],
    size: int,
    state: NDArray[np.int64],
    table: NDArray[np.float64],
    places: NDArray[np.int64],
    x: NDArray[np.float64],
) -> None:
    """Write into x the model through r independent points drawn from ``pool[:size]``.

    Points are drawn one by one and eliminated as they come (pivoting by columns); one that depends on those
    before it is passed over, up to 2 r + 8 draws in all. `table` has shape (r, r + 1), `places` shape (r,).
    """
    d = At.shape[0]
    for j in range(d):
        places[j] = j
    rank = 0
    for draw in range(min(size, 2 * d + 8)):
        if rank == d:
            break
        if eliminate_point(At, b, draw_next(state, pool, draw, size), rank, table, places):
            rank += 1
    substitute_back(rank, table, places, x)


@kernel
def eliminate_point(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    point: int,
    rank: int,
    table: NDArray[np.float64],
    places: NDArray[np.int64],
) -> bool:
    """Write the row of `point`, freed of the `rank` rows before it, into ``table[rank]``; False if it depends on them.

    `places` tells which column has gone where; it starts as 0, 1, 2, ...
    """
    d = At.shape[0]
    length = 0.0
    for j in range(d):
        table[rank, j] = At[places[j], point]
        length = max(length, abs(table[rank, j]))
    table[rank, d] = b[point]
    for k in range(rank):
        c = table[rank, k]
        for j in range(k + 1, d + 1):
            table[rank, j] -= c * table[k, j]
    place = rank
    largest = 0.0
    for j in range(rank, d):
        if abs(table[rank, j]) > largest:
            largest = abs(table[rank, j])
            place = j
    if largest <= max(DEPENDENT * length, ROUNDING):
        return False
    if place != rank:
        places[rank], places[place] = places[place], places[rank]
        for k in range(rank + 1):
            table[k, rank], table[k, place] = table[k, place], table[k, rank]
    inverse = 1.0 / table[rank, rank]
    for j in range(rank + 1, d + 1):
        table[rank, j] *= inverse
    return True


@kernel
def substitute_back(rank: int, table: NDArray[np.float64], places: NDArray[np.int64], x: NDArray[np.float64]) -> None:
    """Write the model of the `rank` rows of `table`, made by `eliminate_point`, into x."""
    d = x.shape[0]
    for j in range(d):
        x[j] = 0.0
    for k in range(rank - 1, -1, -1):
        value = table[k, d]
        for m in range(k + 1, rank):
            value -= table[k, m] * x[places[m]]
        x[places[k]] = value


@kernel
def weighted_model(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    w: NDArray[np.float64],
    weighted: NDArray[np.float64],
    table: NDArray[np.float64],
    x: NDArray[np.float64],
) -> None:
    """Write into x the model that minimises sum w[i] r[i]^2: normal equations, Cholesky (L D L^T).

    `weighted` is scratch of shape (N,), `table` of shape (r, r + 1).
    """
    d, N = At.shape
    for j in range(d):
        a = At[j]
        for i in range(N):
            weighted[i] = w[i] * a[i]
        for k in range(j + 1):
            table[j, k] = dot(weighted, At[k])
        table[j, d] = dot(weighted, b)
    solve_normal_equations(table, x)


@kernel
def least_squares_model(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    points: NDArray[np.int64],
    count: int,
    table: NDArray[np.float64],
    x: NDArray[np.float64],
) -> None:
    """Write into x the least-squares model of ``points[:count]``; `table` is scratch of shape (r, r + 1)."""
    d = At.shape[0]
    for j in range(d):
        for k in range(d + 1):
            table[j, k] = 0.0
    for m in range(count):
        i = points[m]
        for j in range(d):
            a = At[j, i]
            for k in range(j + 1):
                table[j, k] += a * At[k, i]
            table[j, d] += a * b[i]
    solve_normal_equations(table, x)


@kernel
def solve_normal_equations(table: NDArray[np.float64], x: NDArray[np.float64]) -> None:
    """Solve M x = v in place; M is the lower triangle of ``table[:, :r]``, v is ``table[:, r]``.

    A variable that depends on those before it, to rounding, is set to 0.
    """
    d = x.shape[0]
    for j in range(d):
        pivot = table[j, j]
        for k in range(j):
            pivot -= table[j, k] * table[j, k] * table[k, k]
        if pivot > DEPENDENT_SQUARED * table[j, j]:
            for i in range(j + 1, d):
                value = table[i, j]
                for k in range(j):
                    value -= table[i, k] * table[j, k] * table[k, k]
                table[i, j] = value / pivot
            table[j, j] = pivot
        else:
            for i in range(j + 1, d):
                table[i, j] = 0.0
            table[j, j] = 0.0
    for j in range(d):
        x[j] = table[j, d]
        for k in range(j):
            x[j] -= table[j, k] * x[k]
    for j in range(d):
        x[j] = x[j] / table[j, j] if table[j, j] > 0.0 else 0.0
    for j in range(d - 1, -1, -1):
        for k in range(j + 1, d):
            x[j] -= table[k, j] * x[k]
        if table[j, j] == 0.0:
            x[j] = 0.0
