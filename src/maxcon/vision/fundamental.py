"""The linearised fundamental matrix: matches of two images as a `LinearProblem`, in a chart of one's choice."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maxcon.datasets.cameras import epipolar_rows, hartley_transform, transformed
from maxcon.problem import LinearProblem, ReadOnlyArrays, check_threshold
from maxcon.problem.validate import check_model
from maxcon.search.sampling import check_count
from maxcon.vision.epipolar import check_matches, check_matrix
from maxcon.vision.estimate import robust_estimate

#: The charts, and which entry of F is 1 there (counted from 0, row by row).
CHARTS: dict[str, int | None] = {"auto": None, "F32=1": 7, "F33=1": 8}

#: What `LinearProblem.family` says of a chart: agents are trained for one chart, and serve no other.
FAMILIES = {"auto": "fundamental", "F32=1": "fundamental F32=1", "F33=1": "fundamental F33=1"}

#: 8 matches are fitted exactly by some F, so that a consensus says something only of more.
LEAST_MATCHES = 9

#: The threshold of the paper on real images, at which "auto" estimates if it is told no other.
USUAL_THRESHOLD = 0.01

#: Random samples behind the chart "auto", at most.
SAMPLES = 20_000


@dataclass(frozen=True, eq=False)
class FundamentalProblem(ReadOnlyArrays):
    """Matches as linear residuals: `problem`, and the way back from its parameters to a matrix in pixels.

    A row of the nine products of a match ``phi = [x'x, x'y, x', y'x, y'y, y', x, y, 1]`` of normalised coordinates
    makes ``phi . f = [x', y', 1] @ F @ [x, y, 1]`` with f the rows of F one after another. In a chart
    ``f = base + directions @ theta``, so that ``|phi . f|`` is the linear residual ``|A . theta - b|`` with
    ``A = phi @ directions`` and ``b = -phi @ base``.

    Attributes
    ----------
    problem
        The `maxcon.LinearProblem`, N matches and d = 8 parameters. Residual and threshold are algebraic, in
        Hartley-normalised coordinates, with f scaled as the chart says; they have no unit.
    chart
        "F32=1", "F33=1" or "auto".
    T1, T2
        Shape (3, 3): normalise the points of image 1 and of image 2.
    base
        Shape (9,), of unit norm: the f of theta = 0. In the chart "auto" it is the estimate that was rotated to.
    directions
        Shape (9, 8): orthonormal, and orthogonal to `base`.
    """

    problem: LinearProblem
    chart: str
    T1: NDArray[np.float64]
    T2: NDArray[np.float64]
    base: NDArray[np.float64]
    directions: NDArray[np.float64]

    def normalised_matrix(self, theta: ArrayLike) -> NDArray[np.float64]:
        """Return the F of parameters `theta`, shape (8,), in normalised coordinates, shape (3, 3), scaled as the chart.

        Raises
        ------
        TypeError, ValueError
            If `theta` is not of shape (8,) or not finite.
        """
        f: NDArray[np.float64] = self.base + self.directions @ check_model(theta, 8)
        return f.reshape(3, 3)

    def to_pixels(self, F: ArrayLike) -> NDArray[np.float64]:
        """Return an F of normalised coordinates as one of pixels, shape (3, 3), of unit Frobenius norm.

        Its sign makes the entry of largest size positive.

        Raises
        ------
        TypeError, ValueError
            If `F` is not a finite 3x3 matrix, or zero.
        """
        pixels = self.T2.T @ check_matrix(F) @ self.T1
        pixels /= np.linalg.norm(pixels)
        signed: NDArray[np.float64] = pixels * np.sign(pixels.flat[np.argmax(np.abs(pixels))])
        return signed

    def matrix(self, theta: ArrayLike) -> NDArray[np.float64]:
        """Return the F of parameters `theta`, shape (8,), in pixels: shape (3, 3), unit Frobenius norm, any rank.

        Raises
        ------
        TypeError, ValueError
            If `theta` is not of shape (8,) or not finite.
        """
        return self.to_pixels(self.normalised_matrix(theta))

    def parameters(self, F: ArrayLike) -> NDArray[np.float64]:
        """Return the parameters, shape (8,), of a matrix `F` in pixels, of any scale.

        Raises
        ------
        TypeError, ValueError
            If `F` is not a finite 3x3 matrix, or zero, or has no place in this chart: "F32=1" has none for a
            matrix with (in normalised coordinates) F32 = 0, "F33=1" none for F33 = 0.
        """
        matrix = np.linalg.solve(self.T2.T, check_matrix(F)) @ np.linalg.inv(self.T1)
        f = matrix.ravel() / np.linalg.norm(matrix)
        along = float(self.base @ f)
        if abs(along) < 1e-12:
            raise ValueError(f"F must have a place in the chart {self.chart!r}, but its entry there is 0 ({along:.1e})")
        theta: NDArray[np.float64] = self.directions.T @ f / along
        return theta

    def __repr__(self) -> str:
        return f"FundamentalProblem(N={self.problem.n_points}, chart={self.chart!r})"


def fundamental_problem(
    x1: ArrayLike,
    x2: ArrayLike,
    *,
    chart: str = "auto",
    threshold: float = USUAL_THRESHOLD,
    rng: int | np.random.Generator | None = None,
    samples: int = SAMPLES,
    estimate: ArrayLike | None = None,
) -> FundamentalProblem:
    """Pose the fundamental matrix of matches as a problem with linear residuals (paper, section 4.2).

    The points of each image are normalised (Hartley 1997: centroid 0, mean distance sqrt(2)), outliers included.
    F has a free scale, and the chart fixes it:

    - "F32=1": the coefficient of y (image 1) is 1. A match (x, y), (x', y') becomes the row
      ``[x'x, x'y, x', y'x, y'y, y', x, 1]`` and b = -y; theta is F11, F12, F13, F21, F22, F23, F31, F33. This is
      what the code of A*-NAPA-DIBP (Cai et al. 2019) fits. Bad where F32 is near 0: cameras one above the other,
      or motion straight ahead with the epipole at the centroid.
    - "F33=1": theta is the first eight entries of F, b = -1. *Ill-posed* where the two centroids (nearly)
      correspond, for F33 is then 0 in normalised coordinates: rectified stereo, motion straight ahead. There
      theta = 0 has the residual 1 at every match, large entries are needed to do better, and the true consensus
      is lost.
    - "auto": f = f0 + Q theta with a robust estimate f0 of unit norm (see `maxcon.vision.estimate`) and an
      orthonormal basis Q of the directions orthogonal to it. theta = 0 is the estimate, and near it the residual
      is that of an f of unit norm: no F is badly placed if the estimate is not. f0 depends on the threshold and
      on `rng`, or is given as `estimate`.

    The chart is a part of the question: at the same threshold, another chart asks for another consensus, since
    it scales f otherwise. As ``|f| >= 1`` in each chart, residuals are never less than those of f scaled to unit
    norm; they are ``1 / |F32|``, ``1 / |F33|`` and ``1 / (f0 . f)`` times as large, for f of unit norm.

    Parameters
    ----------
    x1, x2
        Shape (N, 2) each, N >= 9, in pixels: ``x1[i]`` of image 1 is matched to ``x2[i]`` of image 2.
    chart
        "auto", "F32=1" or "F33=1".
    threshold
        The scale of the estimate behind "auto": best the threshold that the fit will use. Other charts ignore it.
    rng
        A seed or a NumPy generator, for the estimate behind "auto"; None stands for the seed 0.
    samples
        How many random samples the estimate behind "auto" draws at most, at least 1; it stops at a confidence of 99%.
    estimate
        A matrix in pixels, shape (3, 3), that the chart "auto" is rotated to; None: it is estimated. Other charts
        ignore it.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of this kind, the points of an image coincide, or N < 9; the message names it.
    """
    first, second = check_matches(x1, x2, LEAST_MATCHES)
    check_chart(chart)
    T1, T2 = hartley_transform(first, "x1"), hartley_transform(second, "x2")
    rows = epipolar_rows(transformed(T1, first), transformed(T2, second))
    one = CHARTS[chart]
    if one is None:
        scale, samples = check_threshold(threshold), check_count(samples, "samples", 1)
        if estimate is None:
            base = robust_estimate(rows, scale, check_generator(rng), samples)
        else:
            base = _unit(np.linalg.solve(T2.T, check_matrix(estimate, "estimate")) @ np.linalg.inv(T1))
        directions = orthogonal_directions(base)
        problem = LinearProblem(rows @ directions, -(rows @ base))
    else:
        base = np.eye(9)[one]
        directions = np.delete(np.eye(9), one, axis=1)
        problem = LinearProblem(np.delete(rows, one, axis=1), -rows[:, one])
    problem = LinearProblem._checked(problem.A, problem.b, FAMILIES[chart])
    return FundamentalProblem(problem, chart, T1, T2, base, directions)


def check_chart(chart: Any) -> None:
    """Raise a ValueError if this is no chart."""
    if not isinstance(chart, str) or chart not in CHARTS:
        raise ValueError(f"chart must be one of {', '.join(map(repr, CHARTS))}, but it is {chart!r}")


def orthogonal_directions(base: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an orthonormal basis, shape (9, 8), of what is orthogonal to the unit vector `base`, shape (9,).

    The columns but one of the Householder reflection that takes an axis to `base`.
    """
    axis = int(np.argmax(np.abs(base)))
    v = base.copy()
    v[axis] += np.copysign(1.0, base[axis])
    reflection = np.eye(9) - np.outer(v, v) * (2.0 / (v @ v))
    return np.ascontiguousarray(np.delete(reflection, axis, axis=1))


def _unit(F: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the entries of a matrix at unit norm, shape (9,), the largest of them positive."""
    f = F.ravel() / np.linalg.norm(F)
    unit: NDArray[np.float64] = f * np.sign(f[np.argmax(np.abs(f))])
    return unit


def check_generator(rng: Any) -> np.random.Generator:
    """Return a NumPy generator from one, a seed or None (the seed 0); TypeError or ValueError otherwise."""
    if isinstance(rng, np.random.Generator):
        return rng
    if rng is None:
        return np.random.default_rng(0)
    return np.random.default_rng(check_count(rng, "rng", 0))
