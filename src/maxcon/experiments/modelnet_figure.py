"""The figure of ModelNet40: consensus at every outlier rate beside run times."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from maxcon.experiments.canvas import INK, look, new_figure
from maxcon.experiments.contenders import (
    AGENT,
    AUTO,
    AUTO_LONG,
    DIBP,
    LEARNED,
    LO,
    LO_SWAP,
    PAPER,
    RANSAC,
    RB,
    UCLM,
    UCLM_SWAP,
)
from maxcon.experiments.records import EXACT, Run
from maxcon.experiments.reproduction_figure import (
    LOOKS,
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
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SHOWN = (PAPER, AGENT, AUTO, LEARNED, UCLM, UCLM_SWAP, RANSAC, LO, LO_SWAP)
_TIMES = (EXACT, DIBP, PAPER, AGENT, AUTO, LEARNED, UCLM, RB)


def draw_modelnet(records: Sequence[Run]) -> Figure:
    """Return the figure: mean consensus, distance to the optimum, and time, each against the outlier rate.

    Raises
    ------
    ModuleNotFoundError
        If matplotlib is not installed.
    """
    rates = sorted({each.rate for each in records if each.rate is not None})
    shown, timed = present(records, _SHOWN), present(records, _TIMES)
    n_units = len({each.unit for each in records})
    n_proven = len({each.unit for each in records if each.proven})
    made = any("shapes of our own" in each.instance for each in records)
    with look():
        figure = new_figure(15.0, 5.6)
        left, middle, right = figure.subplots(1, 3, width_ratios=(0.9, 1.3, 0.9))
        _means(left, records, shown, rates)
        boxes(middle, records, shown, rates, lambda row: row.rate, lambda row: row.short)
        distance_axis(middle, max((each.short for each in records if each.name in shown and each.done), default=1))
        middle.set_xticks(range(len(rates)), labels=[str(rate) for rate in rates])
        goal = "proven optimum" if n_proven == n_units else f"best known, proven for {n_proven} of {n_units}"
        middle.set(title=f"distance to the {goal}", xlabel="outliers (%)", ylabel="inliers missing")
        time_lines(right, records, timed, rates)
        right.set_title("time, refinement included")
        where = "made scenes (no ModelNet40)" if made else "ModelNet40, test meshes"
        N = records[0].n_points if records else 0
        figure.suptitle(
            f"Fundamental matrix, {where}, N = {N}, threshold 0.1, {n_units / max(1, len(rates)):.3g} instances a rate",
            x=0.01,
            ha="left",
            fontweight="bold",
        )
        notes = (
            multiples(records, (RANSAC, LO, LO_SWAP)),
            multiples(records, (AUTO_LONG,)),
            "bars: standard error of the mean; A* runs on the first instances of each rate only",
        )
        names = list(dict.fromkeys((*timed, *shown)))
        legend(figure, names, (MEDIAN, MEAN, STOPPED), footnote(records, (*_TIMES, *_SHOWN), notes), 8)
    return figure


def _means(axes: Axes, records: Sequence[Run], names: Sequence[str], rates: Sequence[int]) -> None:
    """Draw mean consensus with standard errors, a little aside of each other, and the optimum as a step over each."""
    span = 0.6 * min(np.diff(rates), default=10)
    for place, name in enumerate(names):
        colour, marker, _ = LOOKS[name]
        cells = [
            [each.consensus for each in records if each.name == name and each.done and each.rate == rate]
            for rate in rates
        ]
        mean = [float(np.mean(cell)) if cell else np.nan for cell in cells]
        error = [float(np.std(cell, ddof=1) / np.sqrt(len(cell))) if len(cell) > 1 else 0.0 for cell in cells]
        where = np.array(rates) + span * (place / max(1, len(names) - 1) - 0.5)
        axes.errorbar(
            where,
            mean,
            yerr=error,
            color=colour,
            marker=marker,
            markersize=5,
            linestyle="none",
            elinewidth=1,
            capsize=2,
        )
    bounds = [[each.best for each in records if each.rate == rate and each.name == names[0]] for rate in rates]
    for rate, cell in zip(rates, bounds, strict=True):
        axes.hlines(float(np.mean(cell)), rate - 0.6 * span, rate + 0.6 * span, color=INK, linestyle="--", linewidth=1)
    axes.set_xticks(list(rates))
    axes.set(title="mean consensus (dashes: the optimum)", xlabel="outliers (%)", ylabel="inliers")
