"""The figure of KITTI: distributions of the consensus over the pairs of a drive, at each step between frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from maxcon.experiments.canvas import look, new_figure
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
    TUNED,
    UCLM,
    UCLM_SWAP,
)
from maxcon.experiments.records import EXACT, Run
from maxcon.experiments.reproduction_figure import (
    LOOKS,
    MEAN,
    MEDIAN,
    boxes,
    distance_axis,
    footnote,
    legend,
    log_ticks,
    multiples,
    present,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SHOWN = (EXACT, PAPER, AGENT, TUNED, AUTO, LEARNED, UCLM, UCLM_SWAP, RANSAC, LO, LO_SWAP)
_TIMES = (EXACT, DIBP, PAPER, AGENT, TUNED, AUTO, LEARNED, UCLM, RB)


def draw_kitti(records: Sequence[Run]) -> Figure:
    """Return the figure: consensus, distance to the optimum, and time of every method at every step.

    Raises
    ------
    ModuleNotFoundError
        If matplotlib is not installed.
    """
    steps = sorted({each.step for each in records if each.step is not None})
    shown, timed = present(records, _SHOWN), present(records, _TIMES)
    pairs = {step: len({each.unit for each in records if each.step == step}) for step in steps}
    n_proven = len({each.unit for each in records if each.proven})
    labels = [f"step {step}, {pairs[step]} pairs" for step in steps]
    made = any(each.instance.startswith("seed") for each in records)
    with look():
        figure = new_figure(15.0, 5.6)
        left, middle, right = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 0.8))
        boxes(left, records, shown, steps, lambda row: row.step, lambda row: row.consensus)
        left.set(title="consensus", ylabel="inliers")
        left.set_ylim(bottom=0)
        ours = [name for name in shown if name != EXACT]
        boxes(middle, records, ours, steps, lambda row: row.step, lambda row: row.short)
        distance_axis(middle, max((each.short for each in records if each.name in ours and each.done), default=1))
        goal = "proven optimum" if n_proven == sum(pairs.values()) else f"best known ({n_proven} proven)"
        middle.set(title=f"distance to the {goal}", ylabel="inliers missing")
        for axes in (left, middle):
            axes.set_xticks(range(len(steps)), labels=labels)
        _times(right, records, timed, steps)
        right.set_title("time, refinement included")
        right.set_xticks(range(len(steps)), labels=labels)
        where = "made pairs (no KITTI)" if made else f"KITTI {records[0].instance.partition(',')[0]}"
        threshold = records[0].settings["threshold"]
        figure.suptitle(f"Fundamental matrix, {where}, threshold {threshold:g}", x=0.01, ha="left", fontweight="bold")
        notes = (
            multiples(records, (RANSAC, LO, LO_SWAP)),
            multiples(records, (AUTO_LONG,)),
            "A* runs on the first pairs only",
        )
        names = list(dict.fromkeys((*timed, *shown)))
        legend(figure, names, (MEDIAN, MEAN), footnote(records, (*_TIMES, *_SHOWN), notes), 8)
    return figure


def _times(axes: Axes, records: Sequence[Run], names: Sequence[str], steps: Sequence[int]) -> None:
    """Draw the time of every run, the methods of a step side by side, with their medians."""
    for place, name in enumerate(names):
        colour, marker, _ = LOOKS[name]
        for column, step in enumerate(steps):
            seconds = [each.seconds for each in records if each.name == name and each.step == step and each.done]
            if not seconds:
                continue
            where = column + 0.84 * ((place + 0.5) / len(names) - 0.5)
            axes.plot([where] * len(seconds), seconds, ".", markersize=3, color=colour, alpha=0.5)
            axes.plot(where, float(np.median(seconds)), marker, markersize=6, mfc=colour, mec="white", mew=0.6)
    axes.set_yscale("log")
    axes.set_xlim(-0.5, len(steps) - 0.5)
    axes.set_ylabel("time of a fit; large: median")
    axes.grid(visible=False, axis="x")
    log_ticks(axes)
