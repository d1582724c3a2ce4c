"""The figure of a consensus curve: steps, what is not proven, and the knees."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from maxcon.experiments.canvas import BLUE, GREY, INK, VERMILLION, look, new_figure
from maxcon.search.threshold_curve import ConsensusCurve

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Thresholds are drawn on a logarithmic axis where the largest is so many times that at half the height.
LOG_FROM = 20.0

#: Breakpoints below so small a part of that at half the height are left out of a logarithmic picture.
LEAST_SHOWN = 1e-3


def draw_curve(curve: ConsensusCurve, unit: str = "", title: str = "") -> Figure:
    """Return the figure of a curve.

    Parameters
    ----------
    curve
        What to draw.
    unit
        The unit of the threshold, or the name of what it is in the unit of; "" for none.
    title
        A line above the figure.

    Raises
    ------
    ModuleNotFoundError
        If matplotlib is not installed.
    """
    with look():
        from matplotlib.ticker import MaxNLocator  # noqa: PLC0415  (only pictures need it)

        figure = new_figure(7.6, 4.8)
        axes = figure.subplots()
        left, right, logarithmic = _range(curve)
        if logarithmic:
            axes.set_xscale("log")
        axes.set_xlim(left, right)
        axes.set_ylim(0.0, 1.08 * curve.n_points)
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        _draw_all_points(axes, curve)
        _draw_steps(axes, curve, left, right)
        _mark_knees(axes, curve, left, right)
        of = f", in {unit}" if unit else ""
        axes.set(xlabel=f"threshold{of}{'  (log scale)' if logarithmic else ''}", ylabel="consensus (inliers)")
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
        figure.suptitle(f"{title}\n{numbers(curve)}".strip(), x=0.01, ha="left", fontsize=11, fontweight="bold")
        return figure


def numbers(curve: ConsensusCurve) -> str:
    """Return in one line what the curve comes to."""
    proof = "proven" if curve.complete else "not all of it proven"
    if len(curve.counts) == 0:
        return f"{curve.n_at_low} of {curve.n_points} points throughout, {proof}"
    places = curve.knees() if len(curve.knees()) else [len(curve.counts) - 1]
    within = [f"{curve.counts[place]} within {curve.thresholds[place]:.3g}" for place in places]
    return f"{', '.join(within).replace(' ', f' of {curve.n_points} points ', 1)}; {proof}"


def _range(curve: ConsensusCurve) -> tuple[float, float, bool]:
    """Return the first and the last threshold to show, and whether on a logarithmic axis."""
    positive = curve.thresholds[curve.thresholds > 2e-12 * curve.scale]  # others are zero but for rounding
    if len(positive) == 0:
        end = curve.high if np.isfinite(curve.high) else max(2.0 * curve.low, 1e-3 * curve.scale, 1e-3)
        return curve.low, float(end), False
    middle = float(np.median(positive))
    right = curve.high if np.isfinite(curve.high) else 1.15 * float(positive[-1])
    if right <= LOG_FROM * middle:
        return curve.low, right, False
    first = 0.8 * float(positive[positive >= LEAST_SHOWN * middle][0])
    return max(curve.low, first), right, True


def _draw_all_points(axes: Axes, curve: ConsensusCurve) -> None:
    axes.axhline(curve.n_points, color=GREY, linewidth=0.8, linestyle=(0, (4, 3)))
    axes.annotate(
        f"all {curve.n_points} points",
        (0.0, curve.n_points),
        (4, 3),
        ("axes fraction", "data"),
        "offset points",
        fontsize=8,
        color=GREY,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0},
    )


def _draw_steps(axes: Axes, curve: ConsensusCurve, left: float, right: float) -> None:
    x, known = _steps(curve, curve.thresholds, left, right)
    if not curve.complete:
        bound_x, bound = _steps(curve, curve.proven_to, left, right)
        both = np.union1d(x, bound_x)
        axes.fill_between(
            both,
            _at(x, known, both),
            _at(bound_x, bound, both),
            step="post",
            color=VERMILLION,
            alpha=0.22,
            linewidth=0,
            label="possible, as far as is proven",
        )
    label = "largest consensus, proven" if curve.complete else "largest consensus known"
    axes.step(x, known, where="post", color=BLUE, linewidth=1.6, label=label)


def _steps(
    curve: ConsensusCurve, values: NDArray[np.float64], left: float, right: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners of the steps within the range: thresholds, and the consensus from there on."""
    counts = curve.n_at_low + np.arange(len(values) + 1)
    before, after = (int(np.searchsorted(values, end, side="right")) for end in (left, right))
    x = np.r_[left, values[before:after], right]
    y = np.r_[counts[before : after + 1], counts[after]].astype(np.float64)
    return x, y


def _at(x: NDArray[np.float64], y: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the height of steps at some places."""
    return y[np.maximum(np.searchsorted(x, places, side="right") - 1, 0)]


def _mark_knees(axes: Axes, curve: ConsensusCurve, left: float, right: float) -> None:
    """Mark the knees, and write beside them what they are, where the curve does not run."""
    label = "knee: less loses many points, more wins few"
    for knee in curve.knees():
        threshold, count = float(curve.thresholds[knee]), int(curve.counts[knee])
        if not left <= threshold <= right:
            continue
        axes.plot(threshold, count, "o", markersize=6, color=VERMILLION, zorder=5, label=label)
        label = "_listed once"
        # The curve only rises: it runs neither above a point on its left, nor below one on its right.
        across = axes.transAxes.inverted().transform(axes.transData.transform((threshold, count)))[0]
        place, side = ((8.0, -11.0), "left") if across < 0.25 else ((-7.0, 5.0), "right")
        axes.annotate(
            f"{count} within {threshold:.3g}",
            (threshold, count),
            place,
            "data",
            "offset points",
            ha=side,
            fontsize=8,
            color=INK,
            zorder=6,
        )
