"""The figures of line and plane fitting: distance to the optimum at every outlier rate beside run times."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from maxcon.experiments.canvas import look, new_figure
from maxcon.experiments.contenders import AGENT, ASTAR, AUTO, DIBP, LEARNED, LO, LO_SWAP, PAPER, RANSAC, RB
from maxcon.experiments.records import EXACT, Run
from maxcon.experiments.reproduction_figure import (
    MEAN,
    MEDIAN,
    STOPPED,
    boxes,
    distance_axis,
    footnote,
    legend,
    multiples,
    present,
    time_lines,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: What the boxes are of, in their order.
_BOXES = (PAPER, AGENT, AUTO, LEARNED, RB, RANSAC, LO, LO_SWAP)

#: Whose time is drawn: the RANSACs have the agent's by construction.
_TIMES = (EXACT, ASTAR, DIBP, PAPER, AGENT, AUTO, LEARNED, RB)


def draw_synthetic(records: Sequence[Run], n_points: int) -> Figure:
    """Return the figure for one N from the records of an experiment "line" or "plane".

    Raises
    ------
    ModuleNotFoundError
        If matplotlib is not installed.
    """
    cell = [each for each in records if each.n_points == n_points]
    rates = sorted({each.rate for each in cell if each.rate is not None})
    shown, timed = present(cell, _BOXES), present(cell, _TIMES)
    proven = all(each.proven for each in cell)
    runs = len({each.unit for each in cell}) / max(1, len(rates))
    with look():
        figure = new_figure(14.0, 5.6)
        left, right = figure.subplots(1, 2, width_ratios=(1.75, 1.0))
        boxes(left, cell, shown, rates, lambda row: row.rate, lambda row: row.short)
        distance_axis(left, max((each.short for each in cell if each.name in shown and each.done), default=1))
        left.set_xticks(range(len(rates)), labels=[str(rate) for rate in rates])
        left.set(
            title=f"distance to the {'proven optimum' if proven else 'largest consensus known'}",
            xlabel="outliers (%)",
            ylabel="inliers missing",
        )
        time_lines(right, cell, timed, rates)
        right.set_title("time, refinement included")
        family = cell[0].experiment if cell else ""
        figure.suptitle(
            f"{family.capitalize()} fitting, N = {n_points}, {runs:.3g} instances a rate",
            x=0.01,
            ha="left",
            fontweight="bold",
        )
        notes = (multiples(cell, (RANSAC, LO, LO_SWAP)), "A* runs on the first instances of each rate only")
        names = list(dict.fromkeys((*timed, *shown)))
        legend(figure, names, (MEDIAN, MEAN, STOPPED), footnote(cell, (*_TIMES, *_BOXES), notes))
    return figure
