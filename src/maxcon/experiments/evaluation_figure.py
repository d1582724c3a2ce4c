"""The figure of an evaluation: box plots of the distance to the optimum, with run times beside them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from maxcon.experiments.canvas import GREY, INK, PALE, SERIES, look, new_figure
from maxcon.experiments.evaluation import REFERENCE, Record, Settings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

#: Share of the room of an outlier rate that the boxes take.
_ROOM = 0.8


def draw_evaluation(records: Sequence[Record], settings: Settings, n_points: int) -> Figure:
    """Return the figure for one N: distance before and after refinement, and time against outlier rate.

    Raises
    ------
    ModuleNotFoundError
        If matplotlib is not installed.
    """
    cell = [each for each in records if each.n_points == n_points]
    names = [contender.name for contender in settings.contenders]
    proven = all(each.proven for each in cell)
    goal = "optimum" if proven else "best known"
    with look():
        from matplotlib.lines import Line2D  # noqa: PLC0415  (only pictures need it)

        figure = new_figure(13.0, 4.3)
        before, after, times = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 0.9))
        after.sharey(before)
        _boxes(before, cell, names, None)
        _boxes(after, cell, names, "swap")
        before.set(title="before refinement", ylabel=f"inliers short of the {goal}")
        after.set(title="after refinement (swap)")
        handles = [_times(times, cell, name, SERIES[i % len(SERIES)]) for i, name in enumerate(names)]
        handles.append(_reference_times(times, cell))
        times.set(
            title="time a fit, refinement included",
            xlabel="outliers (%)",
            ylabel="mean time (ms)",
            yscale="log",
        )
        times.set_xticks(sorted({each.rate for each in cell}))
        _plain_ticks(times)
        handles += [
            Line2D([], [], color=GREY, linewidth=2.2),
            Line2D([], [], linestyle="none", marker="D", markersize=3.6, mfc="white", mec=GREY),
        ]
        labels = [*names, goal, "median", "mean"]
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
        figure.suptitle(
            f"{settings.family.capitalize()} fitting, N = {n_points}, {settings.n_instances} held-out instances a rate",
            x=0.01,
            ha="left",
            fontweight="bold",
        )
    return figure


def _boxes(axes: Axes, cell: Sequence[Record], names: Sequence[str], refine: str | None) -> None:
    rates = sorted({each.rate for each in cell})
    step = _ROOM / len(names)
    top = 1.0
    for series, name in enumerate(names):
        gaps = [[r.gap for r in cell if (r.name, r.refine, r.rate) == (name, refine, rate)] for rate in rates]
        where = np.arange(len(rates)) + (series - 0.5 * (len(names) - 1)) * step
        colour = SERIES[series % len(SERIES)]
        axes.boxplot(
            gaps,
            positions=where,
            widths=0.82 * step,
            patch_artist=True,
            manage_ticks=False,
            boxprops={"facecolor": colour + "55", "edgecolor": colour, "linewidth": 0.9},
            medianprops={"color": colour, "linewidth": 2.2, "solid_capstyle": "butt"},
            whiskerprops={"color": colour, "linewidth": 0.9},
            capprops={"color": colour, "linewidth": 0.9},
            flierprops={
                "marker": ".",
                "markersize": 3.5,
                "markerfacecolor": colour,
                "markeredgecolor": "none",
            },
        )
        means = [float(np.mean(each)) if each else np.nan for each in gaps]
        axes.plot(
            where,
            means,
            linestyle="none",
            marker="D",
            markersize=3.6,
            mfc="white",
            mec=colour,
            mew=1.0,
            zorder=5,
        )
        top = max(top, *(max(each, default=0) for each in gaps))
    # Most gaps after refinement are 0, some before it are dozens: linear up to 1, logarithmic above.
    axes.set_yscale("symlog", linthresh=1.0, linscale=0.6)
    axes.set_ylim(-0.25, 1.6 * top)
    ticks = [0] + [tick for tick in (1, 2, 5, 10, 20, 50, 100, 200, 500) if tick <= 1.6 * top]
    axes.set_yticks(ticks, labels=[str(tick) for tick in ticks])
    axes.set_yticks([], minor=True)
    axes.set_xticks(np.arange(len(rates)), labels=[str(rate) for rate in rates])
    axes.set_xlim(-0.5, len(rates) - 0.5)
    for boundary in np.arange(len(rates) - 1) + 0.5:
        axes.axvline(boundary, color=PALE, linewidth=0.7)
    axes.grid(visible=False, axis="x")
    axes.set_xlabel("outliers (%)")


def _times(axes: Axes, cell: Sequence[Record], name: str, colour: str) -> Line2D:
    rates = sorted({each.rate for each in cell})
    ms = [
        1e3 * np.mean([r.seconds for r in cell if (r.name, r.refine, r.rate) == (name, "swap", rate)]) for rate in rates
    ]
    (handle,) = axes.plot(rates, ms, color=colour, marker="o", markersize=4.5, linewidth=1.5)
    return handle


def _reference_times(axes: Axes, cell: Sequence[Record]) -> Line2D:
    rates = sorted({each.rate for each in cell})
    ms = [1e3 * np.mean([r.seconds for r in cell if (r.name, r.rate) == (REFERENCE, rate)]) for rate in rates]
    (handle,) = axes.plot(rates, ms, color=INK, linestyle="--", marker="s", markersize=3.5, linewidth=1.2, mfc=GREY)
    return handle


def _plain_ticks(axes: Axes) -> None:
    """Label a logarithmic axis 0.1, 0.2, 0.5, 1, ... instead of by powers."""
    low, high = axes.get_ylim()
    decades = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    digits = (1, 2, 5) if len(decades) <= 4 else (1,)
    ticks = [digit * 10.0**decade for decade in decades for digit in digits]
    ticks = [tick for tick in ticks if low <= tick <= high]
    axes.set_yticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    axes.set_yticks([], minor=True)
