"""Numbers beside points, placed so that none covers another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from maxcon.experiments.canvas import INK

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Directions in which a label may stand from its point, in the order in which they are tried.
_DIRECTIONS = np.array([(1, 1), (-1, 1), (1, -1), (-1, -1), (0, 1), (0, -1), (1, 0), (-1, 0)]) / np.array(
    [[1.35]] * 4 + [[1.0]] * 4
)

#: Gaps between marker and label that are tried, in points.
_GAPS = (4.0, 8.0, 13.0)


def number_points(
    axes: Axes,
    points: NDArray[np.float64],
    texts: Sequence[str],
    obstacles: NDArray[np.float64],
    *,
    colour: str = INK,
    size: float = 7.5,
) -> int:
    """Write each text beside its point where there is room; return how many were written.

    Parameters
    ----------
    axes
        With its limits set for good: a later change would move the points under their labels.
    points
        Shape (n, 2), in data coordinates.
    texts
        One for each point, the most important first.
    obstacles
        Shape (m, 2): all markers of the picture, which labels keep off as far as they can.
    """
    from matplotlib import patheffects  # noqa: PLC0415  (only pictures need it)

    figure = axes.get_figure(root=True)
    if figure is None or len(points) == 0:
        return 0
    figure.draw_without_rendering()  # the layout decides where the axes are, and so how far points are apart
    pixels_per_point = figure.dpi / 72.0
    at = axes.transData.transform(points)
    others = axes.transData.transform(obstacles)
    frame = axes.get_window_extent()
    taken: list[NDArray[np.float64]] = []
    legend = axes.get_legend()
    if legend is not None:
        taken.append(np.asarray(legend.get_window_extent().extents))
    written = 0
    for text, here in zip(texts, at, strict=True):
        extent = np.array([0.62 * size * len(text) + 2.0, 0.95 * size]) * pixels_per_point
        best, best_cost = None, np.inf
        for gap in _GAPS:
            for direction in _DIRECTIONS:
                centre = here + direction * (gap * pixels_per_point + 0.5 * extent)
                box = np.concatenate([centre - 0.5 * extent, centre + 0.5 * extent])
                inside = frame.x0 <= box[0] and box[2] <= frame.x1 and frame.y0 <= box[1] and box[3] <= frame.y1
                if not inside or any(_overlap(box, other) for other in taken):
                    continue
                cost = _covered(box, others, 2.5 * pixels_per_point) + 0.05 * gap
                if cost < best_cost:
                    best, best_cost = (centre, box), cost
        if best is None:
            continue
        centre, box = best
        taken.append(box)
        written += 1
        _write(axes, text, here, centre, size, colour, patheffects)
    return written


def _write(
    axes: Axes,
    text: str,
    here: NDArray[np.float64],
    centre: NDArray[np.float64],
    size: float,
    colour: str,
    patheffects: Any,
) -> None:
    back = axes.transData.inverted()
    figure = axes.get_figure(root=True)
    assert figure is not None
    offset = (centre - here) * 72.0 / figure.dpi
    label = axes.annotate(
        text,
        tuple(back.transform(here)),
        xytext=tuple(offset),
        textcoords="offset points",
        ha="center",
        va="center_baseline",
        fontsize=size,
        color=colour,
        zorder=10,
        path_effects=[patheffects.withStroke(linewidth=1.8, foreground="white")],
    )
    label.set_in_layout(False)


def _overlap(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    return bool(one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3])


def _covered(box: NDArray[np.float64], points: NDArray[np.float64], margin: float) -> int:
    """Return how many markers a label would touch."""
    x, y = points[:, 0], points[:, 1]
    hit = (x > box[0] - margin) & (x < box[2] + margin) & (y > box[1] - margin) & (y < box[3] + margin)
    return int(np.count_nonzero(hit))
