"""The grid of the benchmark: cells (family, N, outlier rate), and the held-out instances of each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from maxcon.datasets.synthetic import THRESHOLD, synthetic_hyperplane
from maxcon.datasets.two_view_scene import synthetic_two_view
from maxcon.experiments.search_instances import CHART_SAMPLES
from maxcon.problem import LinearProblem
from maxcon.vision.fundamental import FundamentalProblem, fundamental_problem

#: The number of parameters of each family, in the order of the page.
N_PARAMS = {"line": 2, "plane": 3, "hyperplane": 8, "fundamental": 8, "fundamental-F32": 8}

#: The chart of each family of two-view problems.
CHARTS = {"fundamental": "auto", "fundamental-F32": "F32=1"}

#: Outlier rates in percent, where none are asked for.
RATES: Mapping[str, tuple[int, ...]] = {
    "line": (10, 20, 30, 40, 50, 60, 70, 80, 90),
    "plane": (10, 20, 30, 40, 50, 60, 70, 80, 90),
    "hyperplane": (10, 20, 30, 40, 50, 60, 70, 75),
    "fundamental": (10, 20, 30, 40, 50, 60, 70),
    "fundamental-F32": (10, 20, 30, 40, 50, 60, 70),
}

#: Streams of random numbers: of what is judged, of what peers are calibrated on, and of what warms up.
JUDGED, CALIBRATION, WARM_UP = 51, 52, 53


@dataclass(frozen=True)
class Cell:
    """A family of problems, how many points, and how many of these are outliers, in percent."""

    family: str
    n_points: int
    rate: int

    @property
    def name(self) -> str:
        """Tells the cell from all others: "line/100/50"."""
        return f"{self.family}/{self.n_points}/{self.rate}"


@dataclass(frozen=True, eq=False)
class Instance:
    """A problem of a cell.

    Attributes
    ----------
    cell, number
        Which one it is.
    problem, threshold
        The question that everyone is asked.
    x1, x2
        Shape (N, 2): the matches in pixels; None where the problem is no two-view problem.
    posed
        The chart of a two-view problem, by which a matrix becomes parameters.
    """

    cell: Cell
    number: int
    problem: LinearProblem
    threshold: float
    x1: NDArray[np.float64] | None = None
    x2: NDArray[np.float64] | None = None
    posed: FundamentalProblem | None = None

    @property
    def limit(self) -> float:
        """The largest residual of an inlier: the threshold with the slack for rounding."""
        return self.problem.inlier_limit(self.threshold)

    def count(self, theta: NDArray[np.float64] | None) -> int:
        """Return how many points parameters `theta`, shape (d,), explain; 0 without a (finite) model."""
        if theta is None or not np.isfinite(theta).all():
            return 0
        return int(np.count_nonzero(self.problem.residuals(theta) <= self.limit))

    def count_model(self, model: NDArray[np.float64] | None) -> int:
        """Return how many points a peer's model explains: parameters, shape (d,), or F in pixels, shape (3, 3)."""
        if model is None or not np.isfinite(model).all():
            return 0
        if self.posed is None:
            return self.count(model)
        try:
            return self.count(self.posed.parameters(model))
        except (ValueError, np.linalg.LinAlgError):  # a matrix that has no place in the chart explains nothing there
            return 0


def make_instance(cell: Cell, number: int, seed: int, stream: int = JUDGED) -> Instance:
    """Return instance `number` of a cell.

    Drawn by ``default_rng([seed, stream, family, N, rate, number])``: no two streams share an instance, and training
    draws from none of them. Two-view problems in the chart "auto" are posed with a rough estimate, as in training.

    Raises
    ------
    ValueError
        If there is no such family, or it cannot have so many points.
    """
    if cell.family not in N_PARAMS:
        raise ValueError(f"family must be one of {', '.join(N_PARAMS)}, but it is {cell.family!r}")
    place = list(N_PARAMS).index(cell.family)
    rng = np.random.default_rng([seed, stream, place, cell.n_points, cell.rate, number])
    if cell.family not in CHARTS:
        problem = synthetic_hyperplane(rng, cell.n_points, cell.rate / 100, N_PARAMS[cell.family])
        return Instance(cell, number, problem, THRESHOLD)
    scene = synthetic_two_view(cell.n_points, cell.rate / 100, rng)
    chart = CHARTS[cell.family]
    posed = fundamental_problem(scene.x1, scene.x2, chart=chart, threshold=THRESHOLD, rng=rng, samples=CHART_SAMPLES)
    return Instance(cell, number, posed.problem, THRESHOLD, scene.x1, scene.x2, posed)


def grid(families: Iterable[str], sizes: Iterable[int], rates: Iterable[int] | None = None) -> tuple[Cell, ...]:
    """Return all cells, those of a family together.

    Parameters
    ----------
    families
        Names from `N_PARAMS`.
    sizes
        Numbers of points (N).
    rates
        Outlier rates in percent, the same for all families; None for `RATES`.

    Raises
    ------
    ValueError
        If a family is unknown, or a number is out of its range; the message names it.
    """
    sizes, asked = tuple(sizes), None if rates is None else tuple(rates)
    cells = []
    for family in families:
        if family not in N_PARAMS:
            raise ValueError(f"families must be among {', '.join(N_PARAMS)}, but they hold {family!r}")
        least = N_PARAMS[family] + 1
        for n_points in sizes:
            if n_points < least:
                raise ValueError(
                    f"points must be at least d + 1 = {least} for the family {family!r}, but they hold {n_points}"
                )
            for rate in RATES[family] if asked is None else asked:
                if not 0 <= rate <= 99:
                    raise ValueError(f"rates must be from 0 to 99 percent, but they hold {rate}")
                cells.append(Cell(family, n_points, rate))
    return tuple(dict.fromkeys(cells))
