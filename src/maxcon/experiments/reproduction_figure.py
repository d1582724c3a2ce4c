"""What the figures of the reproduction share: a colour and a mark for each method, boxes, and lines of times."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from maxcon.experiments.canvas import BLUE, GREEN, GREY, INK, ORANGE, PALE, PURPLE, SKY, VERMILLION
from maxcon.experiments.contenders import (
    AGENT,
    ASTAR,
    AUTO,
    AUTO_LONG,
    AUTO_UCLM,
    DIBP,
    IN_AUTO_TIME,
    LEARNED,
    LO,
    LO_SWAP,
    PAPER,
    RANSAC,
    RB,
    RB_TREE,
    TUNED,
    UCLM,
    UCLM_SWAP,
)
from maxcon.experiments.records import EXACT, Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

Line = Literal["-", "--", ":", "-."]

#: Colour, marker and line of every method, the same in all figures.
LOOKS: dict[str, tuple[str, str, Line]] = {
    EXACT: (INK, "s", "--"),
    ASTAR: (GREY, "^", ":"),
    DIBP: (GREY, "v", "--"),
    PAPER: (SKY, "o", "-"),
    AGENT: (BLUE, "o", "-"),
    TUNED: (BLUE, "h", ":"),
    AUTO: (VERMILLION, "D", "-"),
    AUTO_UCLM: (VERMILLION, "d", "-."),
    AUTO_LONG: (VERMILLION, "D", ":"),
    LEARNED: ("#8B3A00", "P", "-"),
    UCLM: ("#6A3D9A", "X", "-"),
    UCLM_SWAP: ("#A78BD4", "X", ":"),
    RB: ("#A6A6A6", ".", "-"),
    RB_TREE: ("#A6A6A6", ".", ":"),
    RANSAC: (ORANGE, "<", "-"),
    LO: (GREEN, ">", "-"),
    LO_SWAP: (PURPLE, "p", "-"),
    RANSAC + IN_AUTO_TIME: (ORANGE, "<", ":"),
    LO + IN_AUTO_TIME: (GREEN, ">", ":"),
    LO_SWAP + IN_AUTO_TIME: (PURPLE, "p", ":"),
}

#: Share of the room of a cell that its boxes take.
_ROOM = 0.84


def present(records: Sequence[Run], names: Sequence[str]) -> list[str]:
    """Return those of `names` of which there is a result."""
    known = {each.name for each in records if each.done}
    return [name for name in names if name in known]


def absent(records: Sequence[Run], names: Sequence[str]) -> list[str]:
    """Return those of `names` that are recorded as not installed."""
    missing = {each.name for each in records if each.status == "not installed"}
    return [name for name in names if name in missing]


def boxes(
    axes: Axes,
    records: Sequence[Run],
    names: Sequence[str],
    cells: Sequence[Any],
    cell_of: Callable[[Run], Any],
    value_of: Callable[[Run], float],
) -> None:
    """Draw a box plot of a value for each cell and method, the methods of a cell side by side, with their means."""
    step = _ROOM / len(names)
    for place, name in enumerate(names):
        values = [
            [value_of(each) for each in records if each.name == name and each.done and cell_of(each) == cell]
            for cell in cells
        ]
        where = np.arange(len(cells)) + (place - 0.5 * (len(names) - 1)) * step
        colour = LOOKS[name][0]
        axes.boxplot(
            values,
            positions=where,
            widths=0.8 * step,
            patch_artist=True,
            manage_ticks=False,
            boxprops={"facecolor": colour + "55", "edgecolor": colour, "linewidth": 0.9},
            medianprops={"color": colour, "linewidth": 2.2, "solid_capstyle": "butt"},
            whiskerprops={"color": colour, "linewidth": 0.9},
            capprops={"color": colour, "linewidth": 0.9},
            flierprops={"marker": ".", "markersize": 3.5, "markerfacecolor": colour, "markeredgecolor": "none"},
        )
        means = [float(np.mean(each)) if each else np.nan for each in values]
        axes.plot(
            where, means, linestyle="none", marker="D", markersize=3.2, mfc="white", mec=colour, mew=0.9, zorder=5
        )
    axes.set_xlim(-0.5, len(cells) - 0.5)
    for boundary in np.arange(len(cells) - 1) + 0.5:
        axes.axvline(boundary, color=PALE, linewidth=0.7)
    axes.grid(visible=False, axis="x")


def distance_axis(axes: Axes, top: float) -> None:
    """Make the axis of a distance to the optimum linear up to 1 and logarithmic above: most are 0, some are dozens."""
    axes.set_yscale("symlog", linthresh=1.0, linscale=0.6)
    axes.set_ylim(-0.25, 1.6 * max(top, 1.0))
    ticks = [0] + [tick for tick in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000) if tick <= 1.6 * max(top, 1.0)]
    axes.set_yticks(ticks, labels=[str(tick) for tick in ticks])
    axes.set_yticks([], minor=True)


def time_lines(axes: Axes, records: Sequence[Run], names: Sequence[str], rates: Sequence[int]) -> None:
    """Draw the median time against the outlier rate; a hollow mark where some runs were stopped by their time limit."""
    for name in names:
        rows = [each for each in records if each.name == name and each.done]
        colour, marker, line = LOOKS[name]
        cells = [[each for each in rows if each.rate == rate] for rate in rates]
        medians = [float(np.median([each.seconds for each in cell])) if cell else np.nan for cell in cells]
        axes.plot(rates, medians, color=colour, linestyle=line, linewidth=1.4)
        for rate, median, cell in zip(rates, medians, cells, strict=True):
            stopped = any(was_stopped(each) for each in cell)
            axes.plot(
                rate,
                median,
                marker=marker,
                markersize=5,
                mec=colour,
                mfc="white" if stopped else colour,
                linestyle="none",
            )
    axes.set_yscale("log")
    axes.set_xticks(list(rates))
    axes.set_xlabel("outliers (%)")
    axes.set_ylabel("median time of a fit")
    log_ticks(axes)


def was_stopped(row: Run) -> bool:
    """Return whether the time limit ended a method that proves before its proof."""
    return row.settings["budget"] is None and row.settings["time_limit"] is not None and row.status != "optimal"


def log_ticks(axes: Axes) -> None:
    """Label the decades of a logarithmic axis of seconds in ms and s."""
    low, high = axes.get_ylim()
    decades = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    ticks = [10.0**decade for decade in decades if low <= 10.0**decade <= high]
    labels = [f"{1e6 * t:g} µs" if t < 9e-4 else f"{1e3 * t:g} ms" if t < 0.9 else f"{t:g} s" for t in ticks]
    axes.set_yticks(ticks, labels=labels)


def handle(name: str) -> Line2D:
    """Return what stands for a method in a legend."""
    from matplotlib.lines import Line2D  # noqa: PLC0415  (only pictures need it)

    colour, marker, line = LOOKS[name]
    return Line2D([], [], color=colour, linestyle=line, marker=marker, markersize=5, linewidth=1.4)


def multiples(records: Sequence[Run], names: Sequence[str]) -> str:
    """Return a sentence on how much time the methods of `names` had, compared with ours."""
    rows = [each for each in records if each.name in names and each.multiple is not None]
    if not rows:
        return ""
    payers = " or ".join(sorted({str(each.settings["budget"]) for each in rows}))
    values = np.array([each.multiple for each in rows], dtype=np.float64)
    low, middle, high = np.percentile(values, [5, 50, 95])
    return (
        f"{', '.join(present(rows, names))}: {middle:.2f} times the time of {payers} in the median "
        f"({low:.2f} to {high:.2f} in 90% of the runs)"
    )


def legend(figure: Figure, names: Sequence[str], marks: Sequence[str], text: str, columns: int = 7) -> None:
    """Draw the legend below a figure: the methods, the marks "median", "mean" and "stopped", and a text over them."""
    from matplotlib.lines import Line2D  # noqa: PLC0415  (only pictures need it)

    known = {
        "median": Line2D([], [], color=GREY, linewidth=2.2),
        "mean": Line2D([], [], linestyle="none", marker="D", markersize=3.6, mfc="white", mec=GREY),
        "some runs stopped by their time limit": Line2D(
            [], [], linestyle="none", marker="o", markersize=5, mfc="white", mec=GREY
        ),
    }
    figure.legend(
        [*map(handle, names), *(known[mark] for mark in marks)],
        [*names, *marks],
        loc="outside lower left",
        ncols=columns,
        frameon=False,
        title=text,
        title_fontsize=7.5,
        alignment="left",
    )


#: The marks of `legend`.
MEDIAN, MEAN, STOPPED = "median", "mean", "some runs stopped by their time limit"


def footnote(records: Sequence[Run], names: Sequence[str], notes: Sequence[str]) -> str:
    """Return the text below a figure: notes, what is not installed, and the machine."""
    missing = list(dict.fromkeys(absent(records, names)))
    lines = [note for note in notes if note]
    if missing:
        lines.append(f"not installed, so not shown: {', '.join(missing)}")
    machines = sorted({each.processor for each in records})
    versions = sorted({each.versions.get("maxcon", "?") for each in records})
    lines.append(f"maxcon {', '.join(versions)} on {'; '.join(machines)}")
    return "\n".join(lines)
