"""Where the rows of a linear problem come from: its data, whitened and scaled once.

The engine works on ``|At[:, i] . phi - b[i]|`` in which the columns of A are orthogonal with entries of order 1
(a QR decomposition with column pivoting, columns of zero rank dropped) and b is the residual of the least-squares
fit, scaled to at most 1. No input is then badly scaled: years beside an intercept, 1e-6 beside 1e6.
"""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from maxcon.problem import LinearProblem

#: A column whose part orthogonal to the others is smaller than this, relative to its length, has no rank:
#: the parts of exactly dependent columns come out at up to a few hundred units of rounding.
RANK_TOLERANCE = 1e-13


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
    sizes = np.abs(A).max(axis=0)  # powers of two: scaling by them is exact
    sizes = np.where(sizes > 0, np.exp2(np.round(np.log2(np.where(sizes > 0, sizes, 1.0)))), 1.0)
    lengths = np.sqrt(((A / sizes) ** 2).sum(axis=0))
    lengths = np.where(lengths > 0, lengths, 1.0) * sizes
    Q, R, order = scipy.linalg.qr(A / lengths, mode="economic", pivoting=True, check_finite=False)
    diagonal = np.abs(np.diag(R))
    rank = int(np.count_nonzero(diagonal > RANK_TOLERANCE * max(diagonal[0], 1e-300)))
    root = np.sqrt(n_points)
    At = np.ascontiguousarray(Q[:, :rank].T) * root

    to_model = np.zeros((n_params, rank))
    if rank:
        to_model[order[:rank]] = scipy.linalg.lapack.dtrtri(R[:rank, :rank])[0]  # R is regular: its diagonal is
        to_model *= root / lengths[:, None]
    origin = to_model @ (At @ b) / n_points
    rest = b - A @ origin
    size = float(np.abs(rest).max())
    scale = float(np.exp2(np.ceil(np.log2(size)))) if size > 1e-300 else 1.0
    return LinearRows(At, np.ascontiguousarray(rest / scale), scale, to_model * scale, origin)
