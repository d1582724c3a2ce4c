"""Two classic regression tables with outliers that nobody planted: telephone calls and stars.

Both come from Rousseeuw and Leroy (1987), *Robust Regression and Outlier Detection*, Wiley. The numbers lie
in ``tables/*.csv``; the head of each file says which two public copies they were compared with.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.problem import LinearProblem, ReadOnlyArrays, line


class _About(NamedTuple):
    """What a table's file does not hold; the fields are those of `Table`."""

    title: str
    x_label: str
    y_label: str
    source: str
    threshold: float


_ABOUT = {
    "belgian_calls": _About(
        title="Telephone calls in Belgium, 1950-73",
        x_label="year - 1900",
        y_label="calls (tens of millions)",
        source="Rousseeuw and Leroy (1987), Robust Regression and Outlier Detection, Wiley, p. 26, Table 2",
        # Minutes were recorded instead of calls in 1964-69 and in some months of 1963 and 1970. The 16 other
        # years lie within 0.1543 of one line; a 17th point (1963) needs 0.2943 and an 18th (1970) 1.004. 0.2
        # stands well between the first two: the maximum is 16, and the outliers are exactly 1963-70.
        threshold=0.2,
    ),
    "cyg_ob1": _About(
        title="Hertzsprung-Russell diagram of the star cluster CYG OB1",
        x_label="log effective temperature",
        y_label="log light intensity",
        source="Rousseeuw and Leroy (1987), Robust Regression and Outlier Detection, Wiley, p. 27, Table 3",
        # The main sequence is a broad band that no gap bounds, so this is a choice. At 0.5 the largest
        # consensus set is one only (as in 0.4998-0.511): 38 of the 43 main-sequence stars, none of the four
        # giants, slope 3.06. Larger thresholds flatten the line: at 0.6 two sets of 40 tie whose best lines
        # have slopes 2.92 and 1.56, and from 0.8274 on the best line slopes down through three giants.
        threshold=0.5,
    ),
}

#: The names that `load_table` takes.
TABLES: tuple[str, ...] = tuple(_ABOUT)


@dataclass(frozen=True, eq=False)
class Table(ReadOnlyArrays):
    """A table of points (x, y) with what is needed to plot and to fit it.

    Attributes
    ----------
    name
        One of `TABLES`.
    title
        What the table shows, in one line.
    x_label, y_label
        What the columns hold, with the unit where there is one.
    x, y
        Read-only float64 arrays of shape (N,), in the order of the published table.
    source
        The book, page and table that the numbers were published in.
    threshold
        An inlier threshold that suits the table, in the unit of y. It was chosen by looking at the residuals
        of the best lines; it is no part of the published table.
    """

    name: str
    title: str
    x_label: str
    y_label: str
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    source: str
    threshold: float


def load_table(name: str) -> Table:
    """Load a table by its name.

    Parameters
    ----------
    name
        One of `TABLES`: "belgian_calls" (N = 24) or "cyg_ob1" (N = 47).

    Returns
    -------
    Table
        The points, shape (N,) each, with labels, source and a threshold in the unit of y.

    Raises
    ------
    ValueError
        If there is no table of that name; the message lists the names.
    """
    if name not in TABLES:
        raise ValueError(f"name must be one of {', '.join(map(repr, TABLES))}, but it is {name!r}")
    # Opened as a resource, not by path: an installed package may lie in an archive.
    with (files("maxcon.datasets") / "tables" / f"{name}.csv").open("r", encoding="utf-8") as stream:
        columns = np.loadtxt(stream, dtype=np.float64, comments="#", delimiter=",", ndmin=2, unpack=True)
    # Copies, because the rows of `columns` are strided views of one array that could still be written to.
    x, y = (np.array(column, order="C") for column in columns)
    return Table(name=name, x=x, y=y, **_ABOUT[name]._asdict())


def belgian_calls() -> LinearProblem:
    """Pose the Belgian telephone calls of 1950-73 as a line, ``calls = slope * year + intercept``.

    Returns
    -------
    LinearProblem
        N = 24, d = 2. The year runs from 50 to 73; b and the residual are in tens of millions of calls. In
        the years 1964-69, and in some months of 1963 and 1970, minutes were recorded instead of calls.

    Notes
    -----
    Source: Rousseeuw and Leroy (1987), *Robust Regression and Outlier Detection*, Wiley, p. 26, Table 2.
    ``load_table("belgian_calls")`` has labels and a threshold.
    """
    table = load_table("belgian_calls")
    return line(table.x, table.y)


def cyg_ob1() -> LinearProblem:
    """Pose the 47 stars of CYG OB1 as a line, ``log light = slope * log temperature + intercept``.

    Returns
    -------
    LinearProblem
        N = 47, d = 2. b and the residual are decimal logarithms of the light intensity. Points 10, 19, 29 and
        33, counted from 0, are giants, far from every line along the main sequence; they turn the slope of
        least squares negative.

    Notes
    -----
    Source: Rousseeuw and Leroy (1987), *Robust Regression and Outlier Detection*, Wiley, p. 27, Table 3.
    ``load_table("cyg_ob1")`` has labels and a threshold.
    """
    table = load_table("cyg_ob1")
    return line(table.x, table.y)
