"""Linear residuals |a_i . theta - b_i|: the problem class, and builders for lines and (hyper)planes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maxcon.problem.frozen import ReadOnlyArrays
from maxcon.problem.tolerance import inlier_slack
from maxcon.problem.validate import check_array, check_model


@dataclass(frozen=True, eq=False, init=False)
class LinearProblem(ReadOnlyArrays):
    """Points with the residual ``|A[i] @ model - b[i]|`` (paper, section 2.1).

    Parameters
    ----------
    A
        Shape (N, d), one row a point.
    b
        Shape (N,), in the unit of the residual and of the threshold.

    Attributes
    ----------
    A, b
        Read-only float64 copies of the data.
    family
        What kind of model this is: "line", "plane", "hyperplane" or "linear".

    Raises
    ------
    TypeError
        If `A` or `b` do not hold real numbers.
    ValueError
        If an entry is NaN or infinite, the shapes do not fit, or N < d + 1.
    """

    A: NDArray[np.float64]
    b: NDArray[np.float64]
    family: str

    def __init__(self, A: ArrayLike, b: ArrayLike) -> None:
        rows = check_array(A, "A", 2)
        values = check_array(b, "b", 1)
        n_points, n_params = rows.shape
        if values.shape != (n_points,):
            raise ValueError(f"b must have one entry for each row of A, ({n_points},), but its shape is {values.shape}")
        _check_enough_points(n_points, n_params, "A")
        self._set(rows, values, "linear")

    def _set(self, A: NDArray[np.float64], b: NDArray[np.float64], family: str) -> None:
        for name, value in (("A", A), ("b", b), ("family", family)):
            object.__setattr__(self, name, value)
        self._freeze_arrays()

    @classmethod
    def _checked(cls, A: NDArray[np.float64], b: NDArray[np.float64], family: str) -> LinearProblem:
        """Build from arrays that a builder of this file has checked already."""
        problem = cls.__new__(cls)
        problem._set(A, b, family)
        return problem

    @property
    def n_points(self) -> int:
        """How many points there are (N)."""
        return int(self.A.shape[0])

    @property
    def n_params(self) -> int:
        """How many parameters a model has (d)."""
        return int(self.A.shape[1])

    @property
    def scale(self) -> float:
        """``max|b|``: the size of the numbers that a residual is a difference of."""
        return float(np.abs(self.b).max())

    def inlier_limit(self, threshold: float) -> float:
        """Return the largest residual that counts as an inlier: the threshold with the slack for rounding."""
        return threshold + inlier_slack(threshold, self.scale)

    def same_data(self, other: LinearProblem) -> bool:
        """Whether another problem has the same A and b."""
        return self is other or (np.array_equal(self.A, other.A) and np.array_equal(self.b, other.b))

    def residuals(self, model: ArrayLike) -> NDArray[np.float64]:
        """Return ``|A @ model - b|``, shape (N,), in the unit of b.

        Raises
        ------
        ValueError
            If `model` is not of shape (d,) or not finite.
        """
        return np.abs(self.A @ check_model(model, self.n_params) - self.b)

    def __repr__(self) -> str:
        return f"LinearProblem(N={self.n_points}, d={self.n_params}, family={self.family!r})"


def _check_enough_points(n_points: int, n_params: int, name: str) -> None:
    if n_points < n_params + 1:
        raise ValueError(
            f"{name} must hold at least d + 1 = {n_params + 1} points for a model with {n_params} parameters, "
            f"but it holds {n_points}"
        )


def _check_same_length(first: NDArray[np.float64], name: str, n_points: int, other: str) -> None:
    if first.shape != (n_points,):
        raise ValueError(f"{name} must have as many entries as {other}, {n_points}, but its shape is {first.shape}")


def line(x: ArrayLike, y: ArrayLike) -> LinearProblem:
    """Pose the line ``y = slope * x + intercept`` with vertical residuals; model = [slope, intercept].

    Parameters
    ----------
    x, y
        Shape (N,) each.

    Raises
    ------
    TypeError, ValueError
        As `LinearProblem`; the message names x or y.
    """
    xs, ys = check_array(x, "x", 1), check_array(y, "y", 1)
    _check_same_length(ys, "y", len(xs), "x")
    _check_enough_points(len(xs), 2, "x")
    return LinearProblem._checked(np.column_stack([xs, np.ones(len(xs))]), ys, "line")


def plane(x: ArrayLike, y: ArrayLike, z: ArrayLike) -> LinearProblem:
    """Pose the plane ``z = p * x + q * y + intercept``, vertical residuals; model = [p, q, intercept].

    Parameters
    ----------
    x, y, z
        Shape (N,) each.

    Raises
    ------
    TypeError, ValueError
        As `LinearProblem`; the message names x, y or z.
    """
    xs, ys, zs = check_array(x, "x", 1), check_array(y, "y", 1), check_array(z, "z", 1)
    _check_same_length(ys, "y", len(xs), "x")
    _check_same_length(zs, "z", len(xs), "x")
    _check_enough_points(len(xs), 3, "x")
    return LinearProblem._checked(np.column_stack([xs, ys, np.ones(len(xs))]), zs, "plane")


def hyperplane(X: ArrayLike, y: ArrayLike) -> LinearProblem:
    """Pose the hyperplane ``y = X @ coef + intercept``; model = [*coef, intercept].

    Parameters
    ----------
    X
        Shape (N, k); the model then has d = k + 1 parameters.
    y
        Shape (N,).

    Raises
    ------
    TypeError, ValueError
        As `LinearProblem`; the message names X or y.
    """
    rows, ys = check_array(X, "X", 2), check_array(y, "y", 1)
    _check_same_length(ys, "y", len(rows), "X has rows")
    _check_enough_points(rows.shape[0], rows.shape[1] + 1, "X")
    return LinearProblem._checked(np.column_stack([rows, np.ones(len(rows))]), ys, "hyperplane")
