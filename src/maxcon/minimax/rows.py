"""Where the rows of a linear problem come from: its data, whitened and scaled once.

The engine works on ``|At[:, i] . phi - b[i]|`` in which the columns of A are orthogonal with entries of order 1
(a QR decomposition with column pivoting, columns of zero rank dropped) and b is the residual of the least-squares
fit, scaled to at most 1. No input is then badly scaled: years beside an intercept, 1e-6 beside 1e6.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel
from maxcon.minimax.sums import dot, largest_size
from maxcon.problem import LinearProblem

#: A column whose part orthogonal to the others is smaller than this, relative to its length, has no rank:
#: the parts of exactly dependent columns come out at up to a few hundred units of rounding.
RANK_TOLERANCE = 1e-13

#: Residuals smaller than this part of max|b| are not told apart: it is less than the slack of every inlier.
BELOW_SLACK = 1e-13


@dataclass(frozen=True, eq=False)
class LinearRows:
    """The whitened rows of a `LinearProblem`.

    Attributes
    ----------
    At
        Shape (r, N), C-contiguous: one row for each of the r <= d independent directions, so that loops over
        the points run through memory.
    b
        Shape (N,), at most 1 in size.
    scale
        A residual of the problem is this many times the residual of these rows.
    to_model
        Shape (d, r): ``model = origin + to_model @ phi``.
    origin
        Shape (d,): the least-squares fit.
    """

    At: NDArray[np.float64]
    b: NDArray[np.float64]
    scale: float
    to_model: NDArray[np.float64]
    origin: NDArray[np.float64]

    def model(self, phi: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the model of the problem for parameters `phi` of these rows."""
        return self.origin + self.to_model @ phi[: self.At.shape[0]]


_known: WeakKeyDictionary[LinearProblem, LinearRows] = WeakKeyDictionary()


def linear_rows(problem: LinearProblem) -> LinearRows:
    """Return the whitened rows of `problem`; made once, and kept for as long as the problem lives."""
    rows = _known.get(problem)
    if rows is None:
        rows = _known[problem] = whiten(problem.A, problem.b)
    return rows


def whiten(A: NDArray[np.float64], b: NDArray[np.float64]) -> LinearRows:
    """Return the whitened rows of A, shape (N, d), and b, shape (N,); any N >= 1."""
    n_points, n_params = A.shape
    At, to_model = np.empty((n_params, n_points)), np.zeros((n_params, n_params))
    origin, rest = np.zeros(n_params), np.empty(n_points)
    scratch = np.empty((3, max(n_params, 2), max(n_params, 2)))
    rank, size = _whiten(A, b, At, to_model, origin, rest, np.empty(n_params), scratch)
    # Where b is linear in A but for rounding, its rounding is not blown up to order 1.
    size = max(size, BELOW_SLACK * float(np.abs(b).max()))
    scale = 2.0 ** math.ceil(math.log2(size)) if size > 1e-300 else 1.0
    rest /= scale
    return LinearRows(At[:rank], rest, scale, np.ascontiguousarray(to_model[:, :rank]) * scale, origin)


@kernel
def _whiten(
    A: NDArray[np.float64],
    b: NDArray[np.float64],
    W: NDArray[np.float64],
    to_model: NDArray[np.float64],
    origin: NDArray[np.float64],
    rest: NDArray[np.float64],
    shifts: NDArray[np.float64],
    scratch: NDArray[np.float64],
) -> tuple[int, float]:
    """Whiten A into the first rows of W; return the rank and the largest |rest|.

    QR by Gram-Schmidt with column pivoting, every column orthogonalised twice ("twice is enough": Giraud, Langou and
    Rozloznik 2005), so that the rows of W are orthogonal to rounding.
    """
    N, d = A.shape
    R, inverse, lengths, order = scratch[0], scratch[1], scratch[2, 0], scratch[2, 1]
    for j in range(d):
        column = W[j]
        for i in range(N):
            column[i] = A[i, j]
    constant = -1  # an intercept
    for j in range(d):
        if W[j, 0] != 0.0 and _is_constant(W[j]):
            constant = j
    for j in range(d):
        # Beside an intercept, columns may be shifted; years and time stamps then lose nothing to their offset.
        column, shift = W[j], W[j, 0] if constant >= 0 and j != constant else 0.0
        shifts[j] = shift
        for i in range(N):
            column[i] -= shift
        largest = largest_size(column)
        unit = 1.0  # a power of two: scaling by it is exact
        if largest > 0.0:
            unit = 2.0 ** min(max(float(np.round(np.log2(largest))), -1000.0), 1000.0)  # 1 / unit must be finite
        _scale(column, 1.0 / unit)
        length = np.sqrt(dot(column, column))
        length = length if length > 0.0 else 1.0
        _scale(column, 1.0 / length)
        lengths[j] = length * unit
        order[j] = j
        for k in range(d):
            R[j, k] = 0.0
    rank, first = d, 0.0
    for k in range(d):
        best, most = k, -1.0
        for j in range(k, d):
            square = dot(W[j], W[j])
            if square > most:
                best, most = j, square
        if best != k:
            for i in range(N):
                W[k, i], W[best, i] = W[best, i], W[k, i]
            order[k], order[best] = order[best], order[k]
            for i in range(k):
                R[i, k], R[i, best] = R[i, best], R[i, k]
        for j in range(k):
            along = dot(W[j], W[k])
            R[j, k] += along
            _subtract(W[k], along, W[j])
        size = np.sqrt(dot(W[k], W[k]))
        if k == 0:
            first = size
        if not size > RANK_TOLERANCE * max(first, 1e-300):
            rank = k
            break
        R[k, k] = size
        _scale(W[k], 1.0 / size)
        for j in range(k + 1, d):
            along = dot(W[k], W[j])
            R[k, j] = along
            _subtract(W[j], along, W[k])

    # to_model = R^-1 with its rows in the order of the columns of A, scaled.
    root = np.sqrt(float(N))
    for k in range(rank):
        for j in range(rank):
            inverse[j, k] = 0.0
        inverse[k, k] = 1.0 / R[k, k]
        for j in range(k - 1, -1, -1):
            total = 0.0
            for i in range(j + 1, k + 1):
                total += R[j, i] * inverse[i, k]
            inverse[j, k] = -total / R[j, j]
    for j in range(rank):
        column = int(order[j])
        for k in range(rank):
            to_model[column, k] = inverse[j, k] * root / lengths[column]
    for k in range(rank):
        along = dot(W[k], b)
        _scale(W[k], root)
        for j in range(d):
            origin[j] += to_model[j, k] * along / root
    for i in range(N):
        total = b[i]
        for j in range(d):
            total -= (A[i, j] - shifts[j]) * origin[j]
        rest[i] = total
    largest = largest_size(rest)
    if constant >= 0:  # from shifted columns to those of A
        for j in range(d):
            part = shifts[j] / A[0, constant]
            origin[constant] -= part * origin[j]
            for k in range(rank):
                to_model[constant, k] -= part * to_model[j, k]
    return rank, largest


@kernel
def _is_constant(x: NDArray[np.float64]) -> bool:
    same = True
    for i in range(1, x.shape[0]):
        same = same and x[i] == x[0]
        if not same:
            break
    return same


@kernel
def _scale(x: NDArray[np.float64], factor: float) -> None:
    for i in range(x.shape[0]):
        x[i] *= factor


@kernel
def _subtract(x: NDArray[np.float64], factor: float, y: NDArray[np.float64]) -> None:
    """Subtract a multiple of y from x."""
    for i in range(x.shape[0]):
        x[i] -= factor * y[i]
