"""Kernels of the robust estimate that a chart is rotated to: null vectors of random matches, scored in any direction.

They work on the rows ``[x'x, x'y, x', y'x, y'y, y', x, y, 1]`` of the matches and on 9-vectors f of unit norm with
residuals ``row . f``: no entry of f is singled out, so nothing here depends on a chart.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel
from maxcon.search.random_kernels import draw_next

#: A row counts as dependent on those before it where elimination leaves less than this of its largest entry.
_DEPENDENT = 1e-9

#: Matches scored before asking whether a model can still win.
_BLOCK = 64

#: How many matches are drawn for 8 independent ones.
_DRAWS = 24


@kernel
def eliminate_row(row: NDArray[np.float64], rank: int, table: NDArray[np.float64], places: NDArray[np.int64]) -> bool:
    """Write a row, shape (9,), freed of the `rank` rows before it, into ``table[rank]``; False if it depends on them.

    `places` tells which column has gone where; it starts as 0, 1, 2, ...
    """
    length = 0.0
    for j in range(9):
        table[rank, j] = row[places[j]]
        length = max(length, abs(table[rank, j]))
    for k in range(rank):
        c = table[rank, k]
        for j in range(k + 1, 9):
            table[rank, j] -= c * table[k, j]
    place = rank
    largest = 0.0
    for j in range(rank, 9):
        if abs(table[rank, j]) > largest:
            largest = abs(table[rank, j])
            place = j
    if largest <= _DEPENDENT * length:
        return False
    if place != rank:
        places[rank], places[place] = places[place], places[rank]
        for k in range(rank + 1):
            table[k, rank], table[k, place] = table[k, place], table[k, rank]
    pivot = table[rank, rank]
    for j in range(rank + 1, 9):
        table[rank, j] /= pivot
    return True


@kernel
def write_null_vector(
    rank: int, free: int, table: NDArray[np.float64], places: NDArray[np.int64], f: NDArray[np.float64]
) -> float:
    """Write the f on which the `rank` rows of `table` vanish, 1 in column `free` >= rank and 0 in the other free ones.

    The rows, made by `eliminate_row`, are unit upper triangular. Returns the square of its length.
    """
    for j in range(rank, 9):
        f[places[j]] = 0.0
    f[places[free]] = 1.0
    square = 1.0
    for k in range(rank - 1, -1, -1):
        value = -table[k, free]
        for j in range(k + 1, rank):
            value -= table[k, j] * f[places[j]]
        f[places[k]] = value
        square += value * value
    return square


@kernel
def null_vector(
    rows: NDArray[np.float64],
    pool: NDArray[np.int64],
    state: NDArray[np.int64],
    table: NDArray[np.float64],
    places: NDArray[np.int64],
    f: NDArray[np.float64],
) -> None:
    """Write into f, shape (9,), a unit vector on which 8 independent rows, drawn at random, vanish.

    A row that depends on those before it is passed over, up to 24 draws; should fewer than 8 be found, f is one of
    the vectors that remain. `table` has shape (9, 9), `places` shape (9,).
    """
    n_points = rows.shape[0]
    for j in range(9):
        places[j] = j
    rank = 0
    for draw in range(min(n_points, _DRAWS)):
        if rank == 8:
            break
        point = draw_next(state, pool, draw, n_points)
        if eliminate_row(rows[point], rank, table, places):
            rank += 1
    length = sqrt(write_null_vector(rank, 8, table, places, f))
    for j in range(9):
        f[j] /= length


@kernel
def truncated_loss(rows: NDArray[np.float64], f: NDArray[np.float64], scale: float, to_beat: float) -> float:
    """Return the sum of ``min((row . f / scale)^2, 1)``, or some number >= `to_beat` once it cannot be less."""
    n_points = rows.shape[0]
    factor = 1.0 / (scale * scale)
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8]
    loss = 0.0
    for first in range(0, n_points, _BLOCK):
        for i in range(first, min(first + _BLOCK, n_points)):
            row = rows[i]
            r = f0 * row[0] + f1 * row[1] + f2 * row[2] + f3 * row[3] + f4 * row[4]
            r += f5 * row[5] + f6 * row[6] + f7 * row[7] + f8 * row[8]
            loss += min(r * r * factor, 1.0)
        if loss >= to_beat:
            return loss
    return loss


@kernel
def best_of_samples(
    rows: NDArray[np.float64],
    scale: float,
    samples: int,
    state: NDArray[np.int64],
    pool: NDArray[np.int64],
    best: NDArray[np.float64],
    losses: NDArray[np.float64],
) -> None:
    """Draw `samples` models and keep those of the least `truncated_loss`.

    `best`, shape (k, 9), and `losses`, shape (k,), hold the best so far, in no order; fresh `losses` are infinite.
    """
    table = np.empty((9, 9))
    places = np.empty(9, dtype=np.int64)
    f = np.empty(9)
    worst = 0
    for k in range(losses.shape[0]):
        if losses[k] > losses[worst]:
            worst = k
    for _ in range(samples):
        null_vector(rows, pool, state, table, places, f)
        loss = truncated_loss(rows, f, scale, losses[worst])
        if loss < losses[worst]:
            losses[worst] = loss
            for j in range(9):
                best[worst, j] = f[j]
            for k in range(losses.shape[0]):
                if losses[k] > losses[worst]:
                    worst = k
