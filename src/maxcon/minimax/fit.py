"""f(S) and B(S): the public minimax fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maxcon.minimax.linear import OK, basis_points, cold_fit
from maxcon.minimax.rows import linear_rows, whiten
from maxcon.minimax.workspace import allocate
from maxcon.problem import LinearProblem, ReadOnlyArrays, check_indices


@dataclass(frozen=True, eq=False)
class MinimaxFit(ReadOnlyArrays):
    """The Chebyshev fit of a set of points S (paper, equation 4).

    Attributes
    ----------
    model
        Shape (d,): minimises the largest residual over S.
    value
        f(S): that largest residual, in the unit of b.
    basis
        Indices of the points that hold the fit in place, ascending, at most d + 1: their value alone is f(S), so
        that only removing one of them can lower it (and does, unless another point ties with it).
    """

    model: NDArray[np.float64]
    value: float
    basis: NDArray[np.int64]


def minimax_fit(problem: LinearProblem, subset: ArrayLike | None = None) -> MinimaxFit:
    """Minimise the largest residual over the points of `subset`.

    Parameters
    ----------
    problem
        The points.
    subset
        A boolean mask of shape (N,), or indices; None for all points. One point is enough.

    Raises
    ------
    TypeError
        If `problem` is not a `LinearProblem`, or `subset` is neither boolean nor integer.
    ValueError
        If `subset` is empty, or names points twice or that do not exist.

    Notes
    -----
    Solved exactly, to rounding, by a dual simplex (Stiefel's exchange; Stiefel 1960, "Note on Jordan elimination,
    linear programming and Tchebycheff approximation") on whitened rows. Of several minimisers one is returned.
    """
    if not isinstance(problem, LinearProblem):
        raise TypeError(f"problem must be a LinearProblem, but it is a {type(problem).__name__}")
    mask = check_indices(subset, problem.n_points)
    rows = linear_rows(problem)
    workspace = allocate(rows, mask)
    names = np.arange(problem.n_points)
    if cold_fit(*workspace) != OK:
        # A few points of a narrow range: whitened with the others, their rows are dependent but for rounding.
        names = np.flatnonzero(mask)
        rows = whiten(problem.A[mask], problem.b[mask])
        workspace = allocate(rows)
        if cold_fit(*workspace) != OK:
            raise ArithmeticError("the minimax fit did not converge; please report the data that made this happen")
    basis = np.empty(workspace.q.shape[0], dtype=np.int64)
    size = basis_points(workspace.C, workspace.q, basis)
    model = rows.model(workspace.x)
    value = float(np.abs(problem.A[mask] @ model - problem.b[mask]).max())
    return MinimaxFit(model, value, names[basis[:size]])
