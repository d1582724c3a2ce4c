"""The picture of a matched pair: both images, with lines between matched points in green and in red."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from maxcon.experiments.canvas import INK, look, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Told apart by lightness as well as by hue: a dark red and a bright green.
INLIER, OUTLIER = "#12B347", "#C4122F"

#: More lines than this, of inliers or of outliers, hide each other and the images.
LINES = 100

#: Images wider than so many times their height go one above the other, else side by side.
_WIDE = 1.7

#: The gap between the images, as a part of their smaller side.
_GAP = 0.04

#: How much of the images' contrast is left: lines must stand out from them.
_CONTRAST = 0.6


def draw_matches(
    x1: NDArray[np.float64],
    x2: NDArray[np.float64],
    inlier_mask: NDArray[np.bool_],
    image1: NDArray[np.uint8] | None,
    image2: NDArray[np.uint8] | None,
    title: str,
    caption: str,
) -> Figure:
    """Return the picture of a matched pair.

    Parameters
    ----------
    x1, x2
        Shape (N, 2) each, pixels.
    inlier_mask
        Shape (N,), bool. Every match is a pair of dots; of inliers and of outliers, each, at most 100, spread over
        image 1, are joined by lines.
    image1, image2
        Grey levels, shape (height, width); None for a blank sheet that holds the points.
    title, caption
        What was fitted, and the result.

    Raises
    ------
    ModuleNotFoundError
        If matplotlib is not installed.
    """
    first, second = _canvas(image1, x1), _canvas(image2, x2)
    height, width = np.maximum(first.shape, second.shape)
    above = width > _WIDE * height
    gap = round(_GAP * min(height, width)) + 1
    shift = np.array([0, first.shape[0] + gap] if above else [first.shape[1] + gap, 0])
    total = np.maximum(first.shape[::-1], second.shape[::-1] + shift)
    inches = 10.0 if above else 13.0
    with look():
        figure = new_figure(inches, inches * total[1] / total[0] + 0.95)
        axes = figure.subplots()
        _show(axes, first, np.zeros(2, dtype=np.int64))
        _show(axes, second, shift)
        moved = x2 + shift
        for mask, colour, above_all, name in (
            (inlier_mask, INLIER, 3, "inlier"),
            (~inlier_mask, OUTLIER, 4, "outlier"),
        ):
            if mask.any():
                label = _draw_lines(axes, x1[mask], moved[mask], colour, above_all, name)
                ends = np.vstack([x1[mask], moved[mask]])
                axes.scatter(ends[:, 0], ends[:, 1], s=5, c=colour, linewidths=0, zorder=above_all + 2, label=label)
        axes.set_xlim(-0.5, total[0] - 0.5)
        axes.set_ylim(total[1] - 0.5, -0.5)
        axes.set_aspect("equal")
        axes.axis("off")
        axes.set_title(caption, fontsize=9, fontweight="normal", color=INK)
        figure.suptitle(title, fontsize=11, fontweight="bold", x=0.005, ha="left")
        if len(x1):
            figure.legend(loc="outside lower left", ncols=2, markerscale=3, frameon=False, fontsize=9)
        return figure


def spread(points: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """Return the indices of at most `most` of the points, shape (N, 2), each the farthest from those before it."""
    if len(points) <= most:
        return np.arange(len(points))
    chosen = [0]
    nearest = np.full(len(points), np.inf)
    while len(chosen) < most:
        nearest = np.minimum(nearest, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(np.argmax(nearest)))
    return np.array(chosen)


def _draw_lines(
    axes: Axes, start: NDArray[np.float64], end: NDArray[np.float64], colour: str, zorder: int, name: str
) -> str:
    """Draw the lines of matches, fainter where there are many; return their label."""
    from matplotlib.collections import LineCollection  # noqa: PLC0415

    chosen = spread(start, LINES)
    segments = np.stack([start[chosen], end[chosen]], axis=1)
    alpha = float(np.clip(9.0 / np.sqrt(len(chosen) + 1.0), 0.45, 0.85))
    axes.add_collection(
        LineCollection(list(segments), colors=colour, linewidths=0.6, alpha=alpha, zorder=zorder), autolim=False
    )
    some = f", {len(chosen)} of them as lines" if len(chosen) < len(start) else ""
    return f"{len(start)} {name}{'s' * (len(start) != 1)}{some}"


def _show(axes: Axes, image: NDArray[np.uint8], corner: NDArray[np.int64]) -> None:
    height, width = image.shape
    x, y = corner
    extent = (x - 0.5, x + width - 0.5, y + height - 0.5, y - 0.5)
    faded = 255.0 * (1.0 - _CONTRAST) + _CONTRAST * image
    axes.imshow(faded, cmap="gray", vmin=0, vmax=255, extent=extent, interpolation="antialiased", zorder=1)


def _canvas(image: NDArray[np.uint8] | None, points: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return the image, or a blank one that holds the points."""
    if image is not None:
        return image
    width, height = np.ceil(points.max(axis=0)).clip(1, None).astype(np.int64) + 1
    return np.full((height, width), 255, dtype=np.uint8)
