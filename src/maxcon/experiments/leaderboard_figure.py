"""The figures of the leaderboard: mean gap against measured time, a panel a cell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from maxcon.experiments.bench import OURS
from maxcon.experiments.bench_scores import CellKey, Score
from maxcon.experiments.canvas import BLUE, GREEN, GREY, INK, ORANGE, PURPLE, SKY, VERMILLION, look, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

#: Colour, marker and line of our methods.
_LOOKS = {
    "auto": (VERMILLION, "D", "-"),
    "learned": ("#8B3A00", "P", "-"),
    "exact": (INK, "s", "--"),
    "lo-ransac": (GREEN, ">", "-"),
    "gnc": (BLUE, "o", "-"),
    "peel": (PURPLE, "p", "-"),
    "agent": (SKY, "o", ":"),
    "uclm": (ORANGE, "X", ":"),
}

#: Muted looks for peers, of which different ones are drawn on each page.
_PEER_LOOKS = ((GREY, "^", "-."), ("#A08A4F", "v", "-."), ("#5E7F99", "<", "-."), ("#A56F86", "*", "-."))

#: How many rates have a panel, and how many peers are drawn: the best of them.
_COLUMNS, _PEERS = 4, len(_PEER_LOOKS)

#: Gaps below are drawn on a linear scale, so that 0 has a place.
_LINEAR = 0.1


def draw_family(scores: Sequence[Score], family: str) -> Figure:
    """Return the figure of a family: a row for each N, a column for each of up to four outlier rates.

    Raises
    ------
    ModuleNotFoundError
        If matplotlib is not installed.
    ValueError
        If there are no scores of the family.
    """
    mine = [each for each in scores if each.cell[0] == family]
    if not mine:
        raise ValueError(f"scores must hold some of the family {family!r}, but they hold none")
    sizes = sorted({each.cell[1] for each in mine})
    rates = _spread(sorted({each.cell[2] for each in mine}), _COLUMNS)
    drawn = _drawn(mine)
    with look():
        figure = new_figure(1.6 + 3.0 * len(rates), 1.5 + 2.5 * len(sizes))
        panels = figure.subplots(len(sizes), len(rates), squeeze=False, sharex=True)
        handles: dict[str, Line2D] = {}
        for row, n_points in zip(panels, sizes, strict=True):
            for axes, rate in zip(row, rates, strict=True):
                handles |= _panel(axes, mine, (family, n_points, rate), drawn)
        for axes in panels[-1]:
            axes.set_xlabel("median time of a fit (ms)")
        for axes in panels[:, 0]:
            axes.set_ylabel("mean gap (inliers)")
        heading = f"{family}: inliers missing to the best known (0 is best) against time\n"
        figure.suptitle(heading + _about(mine, drawn), x=0.01, ha="left", fontsize="medium")
        names = [name for name in drawn if name in handles]
        figure.legend(
            [handles[name] for name in names],
            names,
            loc="outside lower center",
            ncols=min(len(names), 2 * len(rates)),
            frameon=False,
        )
    return figure


def _about(scores: Sequence[Score], drawn: Sequence[str]) -> str:
    """Return what the points are, and who is in the tables only."""
    counts = sorted({len(each.gaps) for each in scores})
    number = f"{counts[0]} to {counts[-1]}" if len(counts) > 1 else f"{counts[0]}"
    left_out = len({each.method for each in scores} - set(drawn))
    more = f"; {left_out} more methods are in the tables" if left_out else ""
    return f"means over {number} problems, bars: standard errors; dashed: the budgets{more}"


def _panel(axes: Axes, scores: Sequence[Score], cell: CellKey, drawn: Sequence[str]) -> dict[str, Line2D]:
    handles = {}
    top = 1.0
    peers = [name for name in drawn if name not in _LOOKS]
    for name in drawn:
        points = sorted((each for each in scores if each.cell == cell and each.method == name), key=lambda s: s.budget)
        if not points:
            continue
        colour, marker, line = _LOOKS[name] if name in _LOOKS else _PEER_LOOKS[peers.index(name)]
        means = [each.mean for each in points]
        errors = np.nan_to_num([each.error for each in points])
        container = axes.errorbar(
            [each.ms for each in points],
            means,
            yerr=errors,
            color=colour,
            marker=marker,
            linestyle=line,
            markersize=6 if name == "auto" else 4.5,
            linewidth=2.2 if name == "auto" else 1.2,
            elinewidth=0.8,
            zorder=4 if name == "auto" else 3,
            label=name,
        )
        handles[name] = container.lines[0]
        top = max(top, *means)
    axes.set_xscale("log")
    axes.set_yscale("symlog", linthresh=_LINEAR, linscale=0.5)
    axes.set_ylim(-0.03, 1.8 * top)
    ticks = [tick for tick in (0, 0.1, 0.3, 1, 3, 10, 30, 100, 300) if tick <= 1.8 * top]
    axes.set_yticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    axes.set_yticks([], minor=True)
    budgets = {each.budget for each in scores}
    for budget in budgets:
        axes.axvline(budget, color="#CCCCCC", linewidth=0.8, linestyle=(0, (2, 2)), zorder=1)
    axes.set_xticks([], minor=True)
    low, high = axes.get_xlim()
    shown = [tick for tick in sorted(budgets | {0.01, 0.1, 1.0, 10.0, 100.0, 1000.0}) if low <= tick <= high]
    axes.set_xticks(shown, labels=[f"{tick:g}" for tick in shown])
    axes.set_title(f"N = {cell[1]}, {cell[2]}% outliers")
    return handles


def _drawn(scores: Sequence[Score]) -> list[str]:
    """Return the methods to draw: ours that have a look, and the peers with the least gaps."""
    present = dict.fromkeys(each.method for each in scores)
    peers = [name for name in present if name not in OURS]
    mean = {name: float(np.mean([each.mean for each in scores if each.method == name])) for name in peers}
    best = sorted(peers, key=lambda name: mean[name])[:_PEERS]
    return [name for name in present if name in _LOOKS or name in best]


def _spread(values: Sequence[int], most: int) -> list[int]:
    """Return at most so many of the values, evenly spread, the last one among them."""
    if len(values) <= most:
        return list(values)
    places = np.unique(np.round(np.linspace(0, len(values) - 1, most)).astype(int))
    return [values[place] for place in places]
