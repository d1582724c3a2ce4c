"""Kernels that propose matrices of rank 2: the seven-point method on random matches, scored in vectors.

Matches are in the form of `maxcon.vision.polish_kernels`: shape (4, N), rows x, y, x', y'. Their order is random, so
that the first of them stand for all.
"""

from __future__ import annotations

from math import acos, cos, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel
from maxcon.search.random_kernels import draw_next
from maxcon.vision.estimate_kernels import eliminate_row, write_null_vector
from maxcon.vision.polish_kernels import anneal, descend, frame_of, matrix_of, score

#: How many matches are drawn for 7 independent ones.
_DRAWS = 21

#: A cubic whose leading coefficient is smaller than this part of all has an infinite root, and is passed over.
_INFINITE = 1e-12

#: On a part of the matches: from the first width to the second, in limits; so many steps a width, shrunk by this.
_WIDE, _NARROW, _STEPS, _SHRINKING = 7.0, 3.0, 2, 0.6

#: What has less than this part of the record is not annealed.
_WORTH = 0.6


@kernel
def coarse_score(matches: NDArray[np.float64], n_looked: int, f: NDArray[np.float64], limit: float) -> int:
    """Return how many of the first matches are within the limit, twice and four times the limit, added up."""
    near, far, farther = limit * limit, 4.0 * limit * limit, 16.0 * limit * limit
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8]
    X, Y, U, V = matches[0], matches[1], matches[2], matches[3]
    total = 0
    for i in range(n_looked):  # whole numbers add up in any order, so this loop becomes one of vectors
        x, y, u, v = X[i], Y[i], U[i], V[i]
        a0, a1, a2 = f0 * x + f1 * y + f2, f3 * x + f4 * y + f5, f6 * x + f7 * y + f8
        b0, b1 = f0 * u + f3 * v + f6, f1 * u + f4 * v + f7
        error = u * a0 + v * a1 + a2
        square = error * error
        steep = a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1
        total += 1 if square <= near * steep else 0
        total += 1 if square <= far * steep else 0
        total += 1 if square <= farther * steep else 0
    return total


@kernel
def seven_point(
    matches: NDArray[np.float64],
    pool: NDArray[np.int64],
    n_pool: int,
    state: NDArray[np.int64],
    table: NDArray[np.float64],
    places: NDArray[np.int64],
    models: NDArray[np.float64],
) -> int:
    """Write the matrices of rank 2 of seven matches drawn from the pool's first into models, shape (3, 9).

    Returns how many there are, 0 to 3. A match that says nothing new is passed over, up to 21 draws; where less than
    seven say something, as on a plane, these are some of the matrices that remain. `table` has shape (9, 9), `places`
    shape (9,).
    """
    for j in range(9):
        places[j] = j
    rank = 0
    for draw in range(min(n_pool, _DRAWS)):
        if rank == 7:
            break
        i = draw_next(state, pool, draw, n_pool)
        x, y, u, v = matches[0, i], matches[1, i], matches[2, i], matches[3, i]
        row = models[0]
        row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7], row[8] = (
            u * x,
            u * y,
            u,
            v * x,
            v * y,
            v,
            x,
            y,
            1.0,
        )
        if eliminate_row(row, rank, table, places):
            rank += 1
    p, q = models[0], models[1]
    for which in range(2):
        write_null_vector(rank, 7 + which, table, places, models[which])
    roots = models[2]
    count = _cubic_roots(_determinant(p), _mixed(p, q), _mixed(q, p), _determinant(q), roots)
    if count == 0 and rank < 7:
        return 1  # on planes every combination may have rank 2
    t0, t1, t2 = roots[0], roots[1], roots[2]
    for j in range(9):
        a, b = p[j], q[j]
        models[0, j] = a + t0 * b
        models[1, j] = a + t1 * b
        models[2, j] = a + t2 * b
    return count


@kernel
def _determinant(f: NDArray[np.float64]) -> float:
    value: float = (
        f[0] * (f[4] * f[8] - f[5] * f[7]) - f[1] * (f[3] * f[8] - f[5] * f[6]) + f[2] * (f[3] * f[7] - f[4] * f[6])
    )
    return value


@kernel
def _mixed(f: NDArray[np.float64], g: NDArray[np.float64]) -> float:
    """Return the derivative of det(f + t g) at t = 0: g times the cofactors of f."""
    value: float = (
        g[0] * (f[4] * f[8] - f[5] * f[7])
        + g[1] * (f[5] * f[6] - f[3] * f[8])
        + g[2] * (f[3] * f[7] - f[4] * f[6])
        + g[3] * (f[2] * f[7] - f[1] * f[8])
        + g[4] * (f[0] * f[8] - f[2] * f[6])
        + g[5] * (f[1] * f[6] - f[0] * f[7])
        + g[6] * (f[1] * f[5] - f[2] * f[4])
        + g[7] * (f[2] * f[3] - f[0] * f[5])
        + g[8] * (f[0] * f[4] - f[1] * f[3])
    )
    return value


@kernel
def _cubic_roots(c0: float, c1: float, c2: float, c3: float, roots: NDArray[np.float64]) -> int:
    """Write the real roots of c0 + c1 t + c2 t^2 + c3 t^3 into roots, shape (3,); return how many there are."""
    roots[0], roots[1], roots[2] = 0.0, 0.0, 0.0
    size = abs(c0) + abs(c1) + abs(c2) + abs(c3)
    if abs(c3) <= _INFINITE * size:
        return 0  # one root is (nearly) infinite: another sample will do
    a, b, c = c2 / c3, c1 / c3, c0 / c3
    q = (a * a - 3.0 * b) / 9.0
    r = (2.0 * a * a * a - 9.0 * a * b + 27.0 * c) / 54.0
    if r * r < q * q * q:
        angle = acos(max(-1.0, min(1.0, r / sqrt(q * q * q))))
        size = -2.0 * sqrt(q)
        for k in range(3):
            roots[k] = size * cos((angle + (k - 1) * 2.0 * pi) / 3.0) - a / 3.0
        count = 3
    else:
        big = (abs(r) + sqrt(r * r - q * q * q)) ** (1.0 / 3.0)
        if r > 0.0:
            big = -big
        roots[0] = big + (q / big if big != 0.0 else 0.0) - a / 3.0
        count = 1
    for k in range(count):  # one step of Newton mends what cancelled
        t = roots[k]
        slope = b + t * (2.0 * a + 3.0 * t)
        if slope != 0.0:
            roots[k] = t - (c + t * (b + t * (a + t))) / slope
    return count


@kernel
def company(matches: NDArray[np.float64], n_looked: int, reach: float, apart: float, counts: NDArray[np.int64]) -> None:
    """Count for each match those of the first that are its neighbours in both images; write into counts, shape (N,).

    Neighbours differ by at most `reach` in x and in y, and by more than `apart` in one of them: a point found
    twice is no company, nor are points that all go to one. Right matches have more company than wrong ones, as
    neighbours mostly stay neighbours (Bian et al. 2017, "GMS: grid-based motion statistics").
    """
    X, Y, U, V = matches[0], matches[1], matches[2], matches[3]
    for i in range(matches.shape[1]):
        x, y, u, v = X[i], Y[i], U[i], V[i]
        total = 0
        for j in range(n_looked):  # whole numbers add up in any order, so this loop becomes one of vectors
            first = max(abs(X[j] - x), abs(Y[j] - y))
            second = max(abs(U[j] - u), abs(V[j] - v))
            total += 1 if (max(first, second) <= reach) & (min(first, second) > apart) else 0
        counts[i] = total


@kernel
def propose(
    matches: NDArray[np.float64],
    pool: NDArray[np.int64],
    n_pool: int,
    n_looked: int,
    limit: float,
    samples: int,
    state: NDArray[np.int64],
    best: NDArray[np.float64],
    scores: NDArray[np.int64],
) -> None:
    """Draw samples of seven from the pool's first and keep the models of the best coarse scores on the first matches.

    `best` has shape (k, 9); `scores`, shape (k,), are overwritten, -1 where nothing was found.
    """
    table, models = np.empty((9, 9)), np.empty((3, 9))
    places = np.empty(9, dtype=np.int64)
    scores[:] = -1
    worst = 0
    for _ in range(samples):
        for m in range(seven_point(matches, pool, n_pool, state, table, places, models)):
            value = coarse_score(matches, n_looked, models[m], limit)
            if value > scores[worst]:
                scores[worst] = value
                best[worst] = models[m]
                for k in range(scores.shape[0]):
                    if scores[k] < scores[worst]:
                        worst = k


@kernel
def sampled_round(
    matches: NDArray[np.float64],
    everything: NDArray[np.int64],
    pool: NDArray[np.int64],
    n_pool: int,
    n_looked: int,
    n_few: int,
    limit: float,
    samples: int,
    state: NDArray[np.int64],
    models: NDArray[np.float64],
    scores: NDArray[np.int64],
    best: NDArray[np.float64],
    record: NDArray[np.float64],
) -> bool:
    """Propose from samples of the pool's first, refine what scored best, keep the best; return whether it has grown.

    The best proposals descend on the first `n_few` matches, at shrinking widths; the one that then has the most
    matches within the limit is annealed on all, if it has a good part of the record. The other arguments
    are those of `propose` and of `maxcon.vision.polish_kernels.anneal`.
    """
    propose(matches, pool, n_pool, n_looked, limit, samples, state, models, scores)
    frame, leader, f = np.empty(19), np.empty(19), np.empty(9)
    most, least = -1, np.inf
    for k in range(scores.shape[0]):
        if scores[k] < 0 or not frame_of(models[k], frame):
            continue
        width = _WIDE
        while width > _NARROW:
            descend(matches, everything, n_few, frame, width * limit, _STEPS, 0.0)
            width *= _SHRINKING
        matrix_of(frame, f)
        count, loss = score(matches, f, limit)
        if count > most or (count == most and loss < least):
            most, least = count, loss
            leader[:] = frame
    if most < _WORTH * record[0]:
        return False
    return anneal(matches, leader, limit, _NARROW, everything, best, record)
