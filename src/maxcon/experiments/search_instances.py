"""Random problems for training and judging the learned search: four families at any rate, N and d."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maxcon.datasets.synthetic import THRESHOLD, synthetic_hyperplane
from maxcon.datasets.two_view_scene import synthetic_two_view
from maxcon.problem import LinearProblem, check_threshold
from maxcon.vision.fundamental import fundamental_problem

#: Lines, planes, hyperplanes with 4 to 9 parameters, and fundamental matrices in two charts.
FAMILIES = ("line", "plane", "hyperplane", "fundamental", "fundamental-F32")

#: How often each is drawn in training, relative to each other: by how much there is to learn.
WEIGHTS = {"line": 1.0, "plane": 1.0, "hyperplane": 2.0, "fundamental": 2.0, "fundamental-F32": 2.0}

#: Random samples behind the chart "auto" of training problems: a rough estimate is enough to place the chart.
CHART_SAMPLES = 400


@dataclass(frozen=True)
class Ranges:
    """What training problems are drawn from.

    Attributes
    ----------
    rates
        The least and the largest outlier rate of lines and planes.
    high_rates
        The same where d >= 4: above, nobody finds the sets that were planted, and there is nothing to learn.
    few, many
        Ranges of N; two thirds of the problems have few points.
    """

    rates: tuple[float, float] = (0.3, 0.9)
    high_rates: tuple[float, float] = (0.3, 0.8)
    few: tuple[int, int] = (50, 200)
    many: tuple[int, int] = (200, 600)


def make_problem(
    family: str, rng: np.random.Generator, n_points: int, rate: float, n_params: int = 8
) -> tuple[LinearProblem, float]:
    """Return a random problem and its threshold.

    Parameters
    ----------
    family
        One of `FAMILIES`.
    rng
        Draws everything.
    n_points, rate
        N and the outlier rate.
    n_params
        The number of parameters of a hyperplane.

    Raises
    ------
    ValueError
        If the family is unknown.
    """
    if family in {"line", "plane", "hyperplane"}:
        d = {"line": 2, "plane": 3, "hyperplane": n_params}[family]
        return synthetic_hyperplane(rng, n_points, rate, d), THRESHOLD
    if family not in FAMILIES:
        raise ValueError(f"family must be one of {', '.join(FAMILIES)}, but it is {family!r}")
    scene = synthetic_two_view(n_points, rate, rng)
    chart = "auto" if family == "fundamental" else "F32=1"
    posed = fundamental_problem(scene.x1, scene.x2, chart=chart, threshold=THRESHOLD, rng=rng, samples=CHART_SAMPLES)
    return posed.problem, THRESHOLD


def draw_problem(families: Sequence[str], rng: np.random.Generator, ranges: Ranges) -> tuple[LinearProblem, float]:
    """Return a random training problem of one of the families, with its threshold."""
    weights = np.array([WEIGHTS[family] for family in families])
    family = families[int(rng.choice(len(families), p=weights / weights.sum()))]
    few = rng.random() < 2.0 / 3.0
    low, high = ranges.few if few else ranges.many
    n_points = int(np.exp(rng.uniform(np.log(low), np.log(high))))
    low_rate, high_rate = ranges.rates if family in {"line", "plane"} else ranges.high_rates
    rate = float(rng.uniform(low_rate, high_rate))
    problem, threshold = make_problem(family, rng, n_points, rate, int(rng.integers(4, 10)))
    if family.startswith("fundamental"):
        threshold *= float(np.exp(rng.uniform(np.log(0.3), 0.0)))
    return problem, threshold


def _read_csv(file: Path) -> NDArray[np.float64]:
    """Return the numbers of a file with commas; a first line in which nothing is a number is a header."""
    lines = [line for line in file.read_text(encoding="utf-8-sig").splitlines() if line.partition("#")[0].strip()]
    if lines and not any(_is_number(cell) for cell in lines[0].split(",")):
        lines = lines[1:]
    if not lines:
        raise ValueError("it holds no data")
    return np.loadtxt(lines, delimiter=",", ndmin=2)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def table_source(folder: Path, threshold: float) -> Callable[[np.random.Generator], tuple[LinearProblem, float]]:
    """Return what draws problems from one's own tables: random rows of a random table.

    Parameters
    ----------
    folder
        Holds ``.npy`` or ``.csv`` files: A beside b, a point a row; for an intercept, A has a column of ones. CSV
        has commas, and may have a header without numbers.
    threshold
        The largest residual of an inlier in all of them.

    Raises
    ------
    ValueError
        If there is no such folder or no such file, or one is no table of finite numbers with at least d + 2 rows.
    """
    threshold = check_threshold(threshold)
    if not folder.is_dir():
        raise ValueError(f"data must be a folder with .npy or .csv tables, but there is no folder {str(folder)!r}")
    tables = []
    for file in sorted([*folder.glob("*.npy"), *folder.glob("*.csv")]):
        try:
            table = np.load(file) if file.suffix == ".npy" else _read_csv(file)
        except (ValueError, OSError) as error:
            raise ValueError(f"{file.name} must be a table of numbers: {error}") from None
        if table.ndim != 2 or table.shape[1] < 2 or len(table) <= table.shape[1] or not np.isfinite(table).all():
            raise ValueError(f"{file.name} must hold more rows than columns of finite numbers, but it is {table.shape}")
        tables.append(table.astype(np.float64))
    if not tables:
        raise ValueError(f"data must be a folder with .npy or .csv tables, but {str(folder)!r} has none")

    def draw(rng: np.random.Generator) -> tuple[LinearProblem, float]:
        table = tables[int(rng.integers(len(tables)))]
        most = min(len(table), Ranges().many[1])
        n_points = int(rng.integers(min(max(50, table.shape[1] + 1), most), most + 1))
        rows = rng.choice(len(table), n_points, replace=False)
        return LinearProblem(table[rows, :-1], table[rows, -1]), threshold

    return draw
