"""Whether points exclude each other to the letter of the data, in rational arithmetic."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.rational import reduced


def excludes(A: NDArray[np.float64], b: NDArray[np.float64], points: NDArray[np.int64], limit: float) -> bool:
    """Return whether no model has all residuals of these points within the limit, as one dependence of rows shows.

    Parameters
    ----------
    A, b
        The data, shapes (N, d) and (N,).
    points
        At most d + 1 of them.
    limit
        The largest residual of an inlier.

    Returns
    -------
    False also where the rows have no dependence, or more than one.
    """
    n = len(points)
    # Columns of A are the equations for the weights y, with sum_k y[k] A[points[k]] = 0.
    solved = reduced(A[points].T.tolist())
    if len(solved) != n - 1:
        return False
    free = next(k for k in range(n) if k not in {lead for lead, _ in solved})
    y = [Fraction(0)] * n
    y[free] = Fraction(1)
    for lead, row in solved:
        y[lead] = -row[free]
    total = sum((weight * Fraction(value) for weight, value in zip(y, b[points].tolist(), strict=True)), Fraction(0))
    return abs(total) > Fraction(limit) * sum(abs(weight) for weight in y)
