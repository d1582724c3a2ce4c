"""Pictures of a fit: the points, the model with its threshold band, and the order in which points were removed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from maxcon.cli.labels import number_points
from maxcon.experiments.canvas import BLUE, INK, ORANGE, SKY, VERMILLION, look, new_figure
from maxcon.problem import Consensus, LinearProblem

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: So many removals are numbered; all of them would hide the points.
NUMBERED = 30

#: The band within the threshold.
_BAND: dict[str, Any] = {"alpha": 0.16, "linewidth": 0, "zorder": 1}

#: How inliers, outliers and points that were removed but are inliers after all look, and what they are called.
_KINDS: tuple[tuple[dict[str, Any], str], ...] = (
    ({"marker": "o", "s": 22, "c": BLUE, "linewidths": 0.5, "edgecolors": "white", "zorder": 4}, "inlier"),
    ({"marker": "X", "s": 30, "c": VERMILLION, "linewidths": 0.5, "edgecolors": "white", "zorder": 5}, "outlier"),
    (
        {"marker": "o", "s": 28, "c": SKY, "linewidths": 1.3, "edgecolors": ORANGE, "zorder": 6},
        "removed, then regained",
    ),
)


def draw_fit(problem: LinearProblem, consensus: Consensus, names: Sequence[str], title: str) -> Figure:
    """Return the picture of a fit: a line as it is, a plane in space, and of all else the residuals.

    Parameters
    ----------
    problem, consensus
        What was fitted, and the result.
    names
        Of the columns, the dependent one last.
    title
        What was fitted to what, without numbers.

    Raises
    ------
    ModuleNotFoundError
        If matplotlib is not installed.
    """
    with look():
        if problem.n_params == 2:
            figure = new_figure(7.6, 5.4)
            axes = figure.subplots()
            draw_line(axes, problem, consensus)
            axes.set(xlabel=names[0], ylabel=names[1])
            points = np.column_stack([problem.A[:, 0], problem.b])
        elif problem.n_params == 3:
            figure = new_figure(15.0, 5.2)
            grid = figure.add_gridspec(1, 4, width_ratios=(1.1, 0.06, 1.0, 1.0))  # a gap: 3-D labels stick out
            _draw_plane(figure.add_subplot(grid[0], projection="3d"), problem, consensus, names)
            axes = figure.add_subplot(grid[2])
            points = _draw_fitted(axes, problem, consensus, names[-1])
            _draw_sorted(figure.add_subplot(grid[3]), consensus, names[-1])
        else:
            figure = new_figure(11.0, 5.2)
            axes, beside = figure.subplots(1, 2)
            points = _draw_fitted(axes, problem, consensus, names[-1])
            _draw_sorted(beside, consensus, names[-1])
        figure.suptitle(f"{title}\n{numbers(consensus)}", x=0.01, ha="left", fontsize=11, fontweight="bold")
        # Below the panels, where it cannot hide a point.
        columns = 3 if problem.n_params == 2 else 6
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)
        number_removals(axes, points, consensus)
        return figure


def draw_line(axes: Axes, problem: LinearProblem, consensus: Consensus, label: str = "model") -> None:
    """Draw points, line and threshold band of a problem with two parameters; set the limits of the axes for good."""
    x, y = problem.A[:, 0], problem.b
    margin = 0.05 * (float(np.ptp(x)) or 1.0)
    ends = np.array([x.min() - margin, x.max() + margin])
    if consensus.status != "infeasible":
        slope, intercept = consensus.model
        level = slope * ends + intercept
        threshold = consensus.threshold
        axes.plot(ends, level, color=BLUE, linewidth=1.6, zorder=3, label=label)
        axes.fill_between(
            ends, level - threshold, level + threshold, color=BLUE, **_BAND, label=f"threshold ±{threshold:g}"
        )
    _scatter(axes, x, y, consensus)
    height = 0.06 * (float(np.ptp(y)) or 1.0)
    axes.set_xlim(*ends)
    axes.set_ylim(y.min() - height, y.max() + height)


def number_removals(axes: Axes, points: NDArray[np.float64], consensus: Consensus) -> None:
    """Write the order of removal beside the points; to be called when all else is drawn."""
    path = consensus.path[:NUMBERED]
    number_points(axes, points[path], [str(step) for step in range(1, len(path) + 1)], points)


def numbers(consensus: Consensus) -> str:
    """Return the result in one line."""
    count = f"{consensus.n_inliers} of {len(consensus.inlier_mask)} points within {consensus.threshold:g}"
    proof = {
        "optimal": "proven optimal",
        "bounded": f"at most {consensus.upper_bound} are possible",
        "heuristic": "not proven optimal",
        "infeasible": "no model",
    }[consensus.status]
    return f"{count}, {proof} ({consensus.method})"


def _groups(consensus: Consensus) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return who is an inlier all along, who an outlier, and who was removed but regained."""
    removed = np.zeros(len(consensus.inlier_mask), dtype=np.bool_)
    removed[consensus.path] = True
    regained = removed & consensus.inlier_mask
    return consensus.inlier_mask & ~regained, ~consensus.inlier_mask, regained


def _scatter(axes: Axes, x: NDArray[np.float64], y: NDArray[np.float64], consensus: Consensus) -> None:
    for mask, (style, label) in zip(_groups(consensus), _KINDS, strict=True):
        if mask.any():
            axes.scatter(x[mask], y[mask], label=f"{label}: {int(mask.sum())}", **style)
    if len(consensus.path) > 0:
        first = f" (first {NUMBERED})" if len(consensus.path) > NUMBERED else ""
        axes.plot(
            [],
            [],
            linestyle="none",
            marker="$1$",
            markersize=5,
            markeredgewidth=0.2,
            color=INK,
            label=f"order of removal{first}",
        )


def _draw_plane(space: Any, problem: LinearProblem, consensus: Consensus, names: Sequence[str]) -> None:
    """Draw points and plane in space, seen almost along the plane, so that outliers stand out from it."""
    x, y, z = problem.A[:, 0], problem.A[:, 1], problem.b
    for mask, (style, _) in zip(_groups(consensus), _KINDS, strict=True):
        if mask.any():
            space.scatter(x[mask], y[mask], z[mask], depthshade=False, **style)
    if consensus.status != "infeasible":
        p, q, intercept = consensus.model
        xs, ys = np.meshgrid(np.linspace(x.min(), x.max(), 9), np.linspace(y.min(), y.max(), 9))
        for shift, alpha in ((-consensus.threshold, 0.10), (0.0, 0.28), (consensus.threshold, 0.10)):
            space.plot_surface(
                xs, ys, p * xs + q * ys + intercept + shift, color=BLUE, alpha=alpha, linewidth=0, shade=False
            )
        # Along a level direction of the plane (scaled as the box of the axes is) it is seen edge-on.
        rise = np.array([p * np.ptp(x), q * np.ptp(y)])
        azimuth = np.degrees(np.arctan2(-rise[0], rise[1])) if rise.any() else -60.0
        space.view_init(elev=8, azim=float(azimuth))
    space.set(xlabel=names[0], ylabel=names[1], zlabel=names[2])
    space.locator_params(nbins=4)
    space.set_box_aspect((4.0, 4.0, 3.0), zoom=1.1)


def _draw_sorted(axes: Axes, consensus: Consensus, name: str) -> None:
    """Draw all residuals in ascending order: how clearly the threshold parts the points."""
    residuals = np.where(np.isfinite(consensus.residuals), consensus.residuals, 0.0)
    order = np.argsort(residuals, kind="stable")
    rank = np.empty(len(order))
    rank[order] = np.arange(1, len(order) + 1)
    axes.axhspan(0.0, consensus.threshold, color=BLUE, **_BAND)
    axes.axhline(consensus.threshold, color=BLUE, linewidth=1.0)
    _scatter(axes, rank, residuals, consensus)
    axes.set(xlabel="points, from the smallest residual up", ylabel=f"residual, in {name}", title="sorted residuals")
    axes.set_xlim(0, len(order) + 1)
    _scale_residuals(axes, consensus.threshold, residuals)


def _draw_fitted(axes: Axes, problem: LinearProblem, consensus: Consensus, name: str) -> NDArray[np.float64]:
    """Draw signed residuals against fitted values, the view of a hyperplane from within it; return the points drawn."""
    model = np.where(np.isfinite(consensus.model), consensus.model, 0.0)
    fitted = problem.A @ model
    residuals = problem.b - fitted
    threshold = consensus.threshold
    axes.axhline(0.0, color=BLUE, linewidth=1.6, zorder=3, label="model")
    axes.axhspan(-threshold, threshold, color=BLUE, **_BAND, label=f"threshold ±{threshold:g}")
    _scatter(axes, fitted, residuals, consensus)
    axes.set(xlabel=f"fitted {name}", ylabel=f"{name} - fitted {name}", title="residuals against fitted values")
    _scale_residuals(axes, threshold, residuals)
    return np.column_stack([fitted, residuals])


def _scale_residuals(axes: Axes, threshold: float, residuals: NDArray[np.float64]) -> None:
    """Scale residuals linearly within the threshold and logarithmically above, if they span more than both can show."""
    low, high = float(residuals.min()), float(residuals.max())
    largest = max(high, -low)
    if largest <= 5.0 * threshold:
        axes.set_ylim(0.0 if low >= 0 else None, None)
        return
    axes.set_ylabel(f"{axes.get_ylabel()}  (log scale beyond the threshold)")
    axes.set_yscale("symlog", linthresh=threshold, linscale=1.0)
    axes.set_ylim(0.0 if low >= 0 else -1.7 * max(-low, threshold), 1.7 * max(high, threshold))
    first = int(np.floor(np.log10(2.0 * threshold))) + 1
    levels = [threshold, *(10.0**power for power in range(first, int(np.floor(np.log10(largest))) + 1))]
    ticks = [0.0, *levels] if low >= 0 else [*(-level for level in reversed(levels)), 0.0, *levels]
    axes.set_yticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    axes.set_yticks([], minor=True)
