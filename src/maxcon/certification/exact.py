"""What a checker needs in exact arithmetic: floats are dyadic rationals, so Python's integers hold the data unrounded.

Nothing here knows how a set of points was found; it only decides whether one model can explain it, and who is
within the limit of a given model.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray


class ExactData:
    """The rows (a_i, b_i) as integers, made when they are first asked for.

    Column j of A is its integers divided by a power of two of its own (which changes no dependence of rows),
    b its integers divided by `unit`.
    """

    def __init__(self, A: NDArray[np.float64], b: NDArray[np.float64]) -> None:
        self._A, self._b = A, b
        self._column_units = [_unit(A[:, j]) for j in range(A.shape[1])]
        self.unit = _unit(b)
        self._rows: dict[int, list[int]] = {}

    def row(self, i: int) -> list[int]:
        """Return the integers of a_i and, last, of b_i."""
        row = self._rows.get(i)
        if row is None:
            values = [*self._A[i].tolist(), float(self._b[i])]
            units = [*self._column_units, self.unit]
            row = self._rows[i] = [_scaled(value, unit) for value, unit in zip(values, units, strict=True)]
        return row

    def multipliers(self, points: Sequence[int]) -> list[int] | None:
        """Return integers y, not all 0, with ``sum_k y[k] a[points[k]] = 0``; None unless unique but for scale.

        Fraction-free elimination (Bareiss 1968, "Sylvester's identity and multistep integer-preserving
        Gaussian elimination") of the rows with their names beside them.
        """
        n, d = len(points), len(self._column_units)
        M = [[*self.row(point)[:d], *(int(k == j) for j in range(n))] for k, point in enumerate(points)]
        last, rank = 1, 0
        for column in range(d):
            chosen = next((k for k in range(rank, n) if M[k][column] != 0), -1)
            if chosen < 0:
                continue
            M[rank], M[chosen] = M[chosen], M[rank]
            head = M[rank]
            p = head[column]
            for k in range(rank + 1, n):
                row = M[k]
                c = row[column]
                M[k] = [(p * x - c * y) // last for x, y in zip(row, head, strict=True)]  # divides exactly
            last = p
            rank += 1
        return M[rank][d:] if rank == n - 1 else None

    def least_maximum(self, points: Sequence[int]) -> Fraction | None:
        """Return what the largest residual of these points is at least, whatever the model; None if unknown.

        With y from `multipliers`, ``|sum y_k b_k| = |sum y_k (a_k . theta - b_k)| <= sum |y_k| max_k |r_k|``:
        weak duality of the minimax fit, with the dual multipliers ``|y_k| / sum |y|`` and the signs of y.
        """
        y = self.multipliers(points)
        if y is None:
            return None
        total = sum(k * self.row(point)[-1] for k, point in zip(y, points, strict=True))
        return Fraction(abs(total), sum(map(abs, y)) * self.unit)


def _unit(values: NDArray[np.float64]) -> int:
    """Return the smallest power of two that makes all of these floats integers."""
    return max((value.as_integer_ratio()[1] for value in values.tolist()), default=1)


def _scaled(value: float, unit: int) -> int:
    numerator, denominator = value.as_integer_ratio()
    return numerator * (unit // denominator)


def within(
    A: NDArray[np.float64], b: NDArray[np.float64], model: NDArray[np.float64], limit: float
) -> NDArray[np.bool_]:
    """Return which points have ``|a_i . model - b_i| <= limit``, decided exactly, shape (N,).

    Floating point decides where it is sure; what is within its own error of the limit is computed again in
    rationals.
    """
    n_terms = A.shape[1] + 2
    with np.errstate(over="ignore", invalid="ignore"):
        residuals = np.abs(A @ model - b)
        sizes = np.abs(A) @ np.abs(model) + np.abs(b) + limit
        error = 2 * n_terms * np.finfo(np.float64).eps * sizes + np.finfo(np.float64).tiny
        inside: NDArray[np.bool_] = residuals + error <= limit
        doubtful = ~inside & ~(residuals - error > limit)
    theta = [Fraction(value) for value in model.tolist()]
    for i in np.flatnonzero(doubtful):
        products = (Fraction(a) * t for a, t in zip(A[i].tolist(), theta, strict=True))
        inside[i] = abs(sum(products, -Fraction(float(b[i])))) <= Fraction(limit)
    return inside


def independent_columns(A: NDArray[np.float64]) -> list[int]:
    """Return the columns of A that do not depend on those before them, exactly: the others change no residual."""
    pivots: dict[int, list[Fraction]] = {}
    for values in A.tolist():
        row = [Fraction(value) for value in values]
        for column, head in sorted(pivots.items()):
            if row[column]:
                factor = row[column] / head[column]
                row = [x - factor * y for x, y in zip(row, head, strict=True)]
        leading = next((column for column, value in enumerate(row) if value), None)
        if leading is not None:
            pivots[leading] = row
            if len(pivots) == len(row):
                break
    return sorted(pivots)
