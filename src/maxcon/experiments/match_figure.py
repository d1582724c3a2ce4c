"""The qualitative picture of KITTI: the inliers of three methods on one pair of frames, one above the other.

Both ends of a match are drawn into the first image: where the camera moves little from frame to frame, right matches
are short and flow together, and wrong ones stand out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from maxcon.experiments.canvas import look, new_figure
from maxcon.experiments.contenders import AGENT, AUTO, LO, PAPER, RANSAC, UCLM
from maxcon.experiments.kitti_experiment import CONFIRMED, MatchedPair, unpacked
from maxcon.experiments.records import Run
from maxcon.experiments.reproduction_figure import present

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Told apart by lightness as well as by hue.
_INLIER, _OUTLIER, _FALSE = "#12B347", "#C4122F", "#0B3FD1"


def chosen_unit(records: Sequence[Run]) -> str | None:
    """Return the pair that is shown: of the largest step, the one on which RANSAC misses a median number of inliers.

    None where RANSAC has no result.
    """
    rows = [each for each in records if each.name == RANSAC and each.done]
    if not rows:
        return None
    step = max(each.step or 0 for each in rows)
    ordered = sorted((each.short, each.unit) for each in rows if (each.step or 0) == step)
    return ordered[len(ordered) // 2][1]


def shown_methods(records: Sequence[Run]) -> list[str]:
    """Return the three methods that are shown: ours, RANSAC, and UCLM, each or else its nearest substitute."""
    ours = present(records, (AGENT, PAPER, AUTO))[:1]
    return ours + present(records, (RANSAC,)) + present(records, (UCLM, LO))[:1]


def draw_matches_of(records: Sequence[Run], unit: str, pair: MatchedPair) -> Figure:
    """Return the picture.

    Parameters
    ----------
    records
        Of the experiment "kitti".
    unit
        From `chosen_unit`.
    pair
        Its matches and images.

    Raises
    ------
    ModuleNotFoundError
        If matplotlib is not installed.
    """
    rows = {each.name: each for each in records if each.unit == unit}
    names = shown_methods([each for each in records if each.unit == unit])
    image = _canvas(pair)
    height, width = image.shape
    with look():
        inches = 11.0
        figure = new_figure(inches, len(names) * (inches * height / width + 0.3) + 0.85)
        for axes, name in zip(figure.subplots(len(names), 1, squeeze=False)[:, 0], names, strict=True):
            row = rows[name]
            axes.imshow(102.0 + 0.6 * image, cmap="gray", vmin=0, vmax=255, interpolation="antialiased", zorder=1)
            _lines(axes, pair, unpacked(row))
            axes.set_xlim(-0.5, width - 0.5)
            axes.set_ylim(height - 0.5, -0.5)
            axes.set_aspect("equal")
            axes.axis("off")
            axes.set_title(_caption(row), fontsize=9)
        sample = next(iter(rows.values()))
        figure.suptitle(
            f"{sample.instance}: {sample.n_points} matches, at most {sample.upper_bound} inliers are possible",
            x=0.01,
            ha="left",
            fontweight="bold",
        )
        _legend(figure)
    return figure


def _caption(row: Run) -> str:
    text = f"{row.name}: {row.consensus} inliers"
    if "confirmed" in row.measures:
        n_marked = row.measures["marked"]
        text += (
            f"; under the true F {row.measures['confirmed']} of {n_marked} within {CONFIRMED:g} pixels, median "
            f"{row.measures['true_sampson_pixels']:.2f} pixels (Sampson)"
        )
    return text


def _lines(axes: Axes, pair: MatchedPair, mask: NDArray[np.bool_]) -> None:
    """Draw outliers, inliers, and those of them that the true F refutes, from image 1 (no mark) to image 2 (a dot)."""
    from matplotlib.collections import LineCollection  # noqa: PLC0415  (only pictures need it)

    false = mask & refuted(pair)
    for chosen, colour, width, zorder in (
        (~mask, _OUTLIER, 0.7, 3),
        (mask & ~false, _INLIER, 0.9, 4),
        (false, _FALSE, 1.4, 5),
    ):
        segments = np.stack([pair.x1[chosen], pair.x2[chosen]], axis=1)
        axes.add_collection(
            LineCollection(list(segments), colors=colour, linewidths=width, alpha=0.85, zorder=zorder), autolim=False
        )
        ends = pair.x2[chosen]
        axes.scatter(ends[:, 0], ends[:, 1], s=5, c=colour, linewidths=0, zorder=zorder + 3)


def refuted(pair: MatchedPair) -> NDArray[np.bool_]:
    """Return which matches are not within `CONFIRMED` pixels of the true F, shape (N,); none where nobody knows it."""
    from maxcon.vision.epipolar import sampson_distances  # noqa: PLC0415  (of this picture alone)

    if pair.F is None:
        return np.zeros(len(pair.x1), dtype=np.bool_)
    return sampson_distances(pair.F, pair.x1, pair.x2) > CONFIRMED


def _legend(figure: Figure) -> None:
    from matplotlib.lines import Line2D  # noqa: PLC0415

    figure.legend(
        [Line2D([], [], color=colour, marker="o", markersize=4) for colour in (_INLIER, _FALSE, _OUTLIER)],
        ["inlier", f"inlier more than {CONFIRMED:g} pixels off under the true F", "outlier"],
        loc="outside lower left",
        ncols=3,
        frameon=False,
        title="from the point in the first frame to its match in the second (dot), both drawn into the first frame",
        title_fontsize=7.5,
        alignment="left",
    )


def _canvas(pair: MatchedPair) -> NDArray[np.uint8]:
    """Return the first image, or a blank one that holds the points of both."""
    if pair.images[0] is not None:
        return pair.images[0]
    width, height = np.ceil(np.vstack([pair.x1, pair.x2]).max(axis=0)).clip(1, None).astype(np.int64) + 1
    return np.full((height, width), 255, dtype=np.uint8)
