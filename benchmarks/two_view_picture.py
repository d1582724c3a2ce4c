"""KITTI pairs on which "auto" and its peers get the same time: who finds which matches, counted and drawn.

    python benchmarks/two_view_picture.py --step 4 --one-way --budget 10 --out docs/figures/two-view-equal-time.png
    python benchmarks/two_view_picture.py --step 4 --budget 30
    python benchmarks/two_view_picture.py --step 8 --budget 10 --every 2

The pairs are the frames (i, i + step) of a drive, matched by SIFT with mutual nearest neighbours (`--one-way`: without
that, so that two matches of three and more are wrong) and *no* ratio test. Every fifth pair only calibrates the peers;
the others are judged.

Everyone gets the same limit of wall-clock time on one thread (`--cpu-time`: of the process's). Ours is one call of
`maxcon.find_fundamental` with that limit: posing the problem, search and polish. The peers are OpenCV's methods and,
where they are installed, PoseLib and COLMAP. Each gets the number of iterations that fits, at the threshold in pixels
that brings most on the pairs for calibration (`maxcon.experiments.bench_calibration`), once for either count below; and
where it ends early, because it holds itself sure, it is called again with the matches in another order (or another
seed) as long as its last call would still fit, and the best of its results counts. Choosing that is not charged. "The
best peer" is, on each pair, the best of the peers, each with all of the time.

- pixels: matches within a pixel (Sampson) of the matrix of rank 2 that each returns. This is what the pairs are judged
  by: it is what the peers are made for, and what the polish of ours maximises.
- right: those of them within a pixel of the true epipolar geometry, by calibration and poses.
- linear: matches within the threshold of the linear residual, with 8 free parameters, in the chart of our fit. "auto"
  maximises it and no peer does: it favours "auto". "swapped": the peers' sets after our swap refinement, for which they
  are charged no time.

Drawn is the pair on which the difference in pixels, ours less the best peer's, is the median of all judged pairs.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import gc  # noqa: E402
import platform  # noqa: E402
import textwrap  # noqa: E402
from collections.abc import Callable, Sequence  # noqa: E402
from contextlib import suppress  # noqa: E402
from dataclasses import dataclass, replace  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import TYPE_CHECKING, Any  # noqa: E402

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from maxcon import find_fundamental  # noqa: E402
from maxcon.datasets.kitti import FramePair, kitti_drive  # noqa: E402
from maxcon.experiments.bench_calibration import Choice, calibrate, timed  # noqa: E402
from maxcon.experiments.bench_cells import Cell, Instance  # noqa: E402
from maxcon.experiments.bench_peers import OpenCv, Peer, PoseLib, PyColmap, installed  # noqa: E402
from maxcon.experiments.canvas import look, new_figure  # noqa: E402
from maxcon.minimax.clock import processor_time, read_clock  # noqa: E402
from maxcon.search.anytime import make_task  # noqa: E402
from maxcon.search.refine import swap_refinement  # noqa: E402
from maxcon.vision.epipolar import sampson_distances  # noqa: E402
from maxcon.vision.fundamental import FundamentalProblem, fundamental_problem  # noqa: E402
from maxcon.vision.matching import match_images, read_image  # noqa: E402

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: All peers; those that are not installed are left out, with a note.
PEERS: tuple[Peer, ...] = (
    OpenCv(name="OpenCV RANSAC", flag="FM_RANSAC"),
    OpenCv(name="OpenCV USAC_DEFAULT", flag="USAC_DEFAULT"),
    OpenCv(name="OpenCV USAC_FAST", flag="USAC_FAST"),
    OpenCv(name="OpenCV USAC_ACCURATE", flag="USAC_ACCURATE"),
    OpenCv(name="OpenCV USAC_MAGSAC", flag="USAC_MAGSAC"),
    PoseLib(name="PoseLib"),
    PyColmap(name="COLMAP"),
)

#: A match is right within so many pixels of the true epipolar geometry; also the threshold of the count in pixels.
RIGHT = 1.0

#: A peer is called at most so often on a pair.
CALLS = 200

#: Told apart by lightness as well as by hue.
BOTH, OURS, THEIRS, NEITHER = "#12B347", "#0B3FD1", "#E8590C", "#6B6B6B"

Mask = NDArray[np.bool_]
Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Judged:
    """What one side found on a pair.

    Attributes
    ----------
    name
        Who.
    near
        Shape (N,): matches within a pixel of its matrix.
    linear, swapped
        How many inliers the linear residual has for it; how many after our swap refinement.
    seconds
        The time that it took.
    """

    name: str
    near: Mask
    linear: int
    swapped: int
    seconds: float

    @property
    def pixels(self) -> int:
        """How many matches are within a pixel."""
        return int(np.count_nonzero(self.near))


@dataclass(frozen=True, eq=False)
class Pair:
    """A pair of frames: its matches as an instance of the benchmark, and which of them are right."""

    frames: FramePair
    instance: Instance
    x1: NDArray[np.float64]
    x2: NDArray[np.float64]
    right: Mask

    @property
    def share(self) -> float:
        """The share of right matches."""
        return float(np.mean(self.right))


class PixelInstance(Instance):
    """An instance whose models are counted in pixels: peers are calibrated for it like for the linear count."""

    def count_model(self, model: Matrix | None) -> int:
        """Return how many matches are within a pixel of a matrix."""
        if model is None or not np.isfinite(model).all() or self.x1 is None or self.x2 is None:
            return 0
        return int(np.count_nonzero(sampson_distances(model, self.x1, self.x2) <= RIGHT))


def in_pixels(instance: Instance) -> PixelInstance:
    return PixelInstance(**{name: getattr(instance, name) for name in Instance.__dataclass_fields__})


def load_pair(frames: FramePair, options: argparse.Namespace) -> Pair:
    matches = match_images(
        read_image(frames.image1),
        read_image(frames.image2),
        ratio=options.ratio,
        mutual=not options.one_way,
        cache=options.cache,
    )
    posed = fundamental_problem(matches.x1, matches.x2, threshold=options.threshold, rng=0)
    cell = Cell("fundamental", len(matches.x1), 0)
    instance = Instance(cell, frames.first, posed.problem, options.threshold, matches.x1, matches.x2, posed)
    if frames.F is None:
        raise ValueError("the drive must have poses, by which matches are judged, but it has none")
    right = sampson_distances(frames.F, matches.x1, matches.x2) <= RIGHT
    return Pair(frames, instance, matches.x1, matches.x2, right)


def run_ours(pair: Pair, options: argparse.Namespace) -> tuple[Judged, FundamentalProblem]:
    """Run "auto" so that posing the problem, the search and the polish take the budget; return its chart as well."""
    more: dict[str, Any] = {"n_jobs": 1} if options.method == "auto" else {}
    gc.disable()
    began = read_clock()
    fit = find_fundamental(
        pair.x1,
        pair.x2,
        options.threshold,
        method=options.method,
        rng=0,
        time_limit=0.95e-3 * options.budget,
        pixels=RIGHT,
        **more,
    )
    seconds = read_clock() - began
    gc.enable()
    return Judged(options.method, fit.sampson <= RIGHT, fit.n_inliers, fit.n_inliers, seconds), fit.problem


def run_theirs(
    peer: Peer, instance: Instance, choice: Choice, budget: float, count: Callable[[Matrix | None], int]
) -> tuple[Matrix | None, float]:
    """Call a peer until another call would not fit; return its best matrix, by `count`, and the seconds in all."""
    best, most, total = None, -1, 0.0
    for seed in range(CALLS):
        matrix, seconds, _ = timed(peer.prepare(instance, seed), choice.iterations, choice.threshold)
        total += seconds
        if count(matrix) > most:
            best, most = matrix, count(matrix)
        if total + seconds > budget:
            break
    return best, total


def judge(
    pair: Pair, peer: Peer, linear: Choice, pixel: Choice, posed: FundamentalProblem, options: argparse.Namespace
) -> Judged:
    """Run a peer twice, for either count, and judge it by that; the linear one is in the chart `posed`."""
    budget, instance = 1e-3 * options.budget, replace(pair.instance, problem=posed.problem, posed=posed)
    nearest = in_pixels(instance)
    matrix, seconds = run_theirs(peer, nearest, pixel, budget, nearest.count_model)
    near = np.zeros(len(pair.x1), dtype=np.bool_)
    if matrix is not None and np.isfinite(matrix).all():
        near = sampson_distances(matrix, pair.x1, pair.x2) <= RIGHT
    matrix, _ = run_theirs(peer, instance, linear, budget, instance.count_model)
    inliers = np.zeros(len(pair.x1), dtype=np.bool_)
    if matrix is not None and np.isfinite(matrix).all():
        with suppress(ValueError):  # it has no place in the chart
            inliers = instance.problem.residuals(posed.parameters(matrix)) <= instance.limit
    swapped = 0
    if inliers.any():
        task = make_task(instance.problem, instance.threshold, np.random.default_rng(0))
        swapped = int(np.count_nonzero(swap_refinement(task, inliers)))
    return Judged(peer.name, near, int(np.count_nonzero(inliers)), swapped, seconds)


def settings(pairs: list[Pair], options: argparse.Namespace) -> list[tuple[Peer, Choice, Choice]]:
    """Return the installed peers, each with its settings for the linear count and for the count in pixels."""
    chosen = []
    linear, budget = [each.instance for each in pairs], 1e-3 * options.budget
    pixel: list[Instance] = [in_pixels(each) for each in linear]
    for peer in PEERS:
        if installed(peer) is None:
            print(f"  {peer.name}: not installed")
            continue
        choices = [calibrate(peer, instances, [budget])[budget] for instances in (linear, pixel)]
        chosen.append((peer, choices[0], choices[1]))
        for choice, name in zip(choices, ("linear", "pixels"), strict=True):
            print(
                f"  {peer.name:20} for {name}: threshold {choice.threshold:4g} px, {choice.iterations:7} iterations, "
                f"{1e3 * choice.seconds:6.1f} ms, {choice.inliers:.1f} on the pairs for calibration",
                flush=True,
            )
    return chosen


def compare(values: Sequence[int], name: str) -> str:
    """Return how a list of differences (ours less theirs) reads."""
    differences = np.array(values)
    return (
        f"{name:40} {differences.mean():+8.2f} +-{differences.std(ddof=1) / np.sqrt(len(differences)):5.2f}   "
        f"{np.count_nonzero(differences > 0):3} / {np.count_nonzero(differences == 0):3} / "
        f"{np.count_nonzero(differences < 0):3}   ({np.median(differences):+g})"
    )


def draw(pair: Pair, ours: Judged, theirs: Judged, rule: str) -> Figure:
    """Return the picture: both ends of each match in the first frame, coloured by who finds it."""
    from matplotlib.collections import LineCollection  # noqa: PLC0415  (only the picture needs it)

    image = read_image(pair.frames.image1)
    height, width = image.shape
    mine, other = ours.near, theirs.near
    groups = (
        (~mine & ~other, NEITHER, 0.5, 0.35, "neither"),
        (mine & other, BOTH, 0.8, 0.8, "both"),
        (mine & ~other, OURS, 1.7, 1.0, "only maxcon"),
        (other & ~mine, THEIRS, 1.7, 1.0, f"only {theirs.name}"),
    )
    with look():
        inches = 11.0
        figure = new_figure(inches, 2 * inches * height / width + 1.5)
        for axes, shown in zip(figure.subplots(2, 1), ((0, 1), (2, 3)), strict=True):
            axes.imshow(115.0 + 0.55 * image, cmap="gray", vmin=0, vmax=255, interpolation="antialiased", zorder=1)
            for place in shown:
                mask, colour, line, alpha, label = groups[place]
                right = int(np.count_nonzero(mask & pair.right))
                text = f"{label}: {np.count_nonzero(mask)} matches, {right} of them right"
                segments = np.stack([pair.x1[mask], pair.x2[mask]], axis=1)
                axes.add_collection(
                    LineCollection(list(segments), colors=colour, linewidths=line, alpha=alpha, zorder=3 + place),
                    autolim=False,
                )
                ends = pair.x2[mask]
                axes.scatter(
                    ends[:, 0], ends[:, 1], s=4 + 6 * line, c=colour, alpha=alpha, linewidths=0, zorder=7, label=text
                )
            axes.set_xlim(-0.5, width - 0.5)
            axes.set_ylim(height - 0.5, -0.5)
            axes.set_aspect("equal")
            axes.axis("off")
            handles = axes.get_legend_handles_labels()
            axes.legend(*handles, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False, markerscale=1.6)
        figure.suptitle(
            f"Frames {pair.frames.first} and {pair.frames.second}, {len(mine)} matches, {100 * pair.share:.0f}% right. "
            f"Within {RIGHT:g} pixel of F: maxcon {ours.pixels} ({1e3 * ours.seconds:.0f} ms), "
            f"{theirs.name} {theirs.pixels} ({1e3 * theirs.seconds:.0f} ms)",
            fontsize=10.5,
            fontweight="bold",
            x=0.01,
            ha="left",
        )
        figure.supxlabel(
            "Each match is a line from its point in the first frame to its point in the second (dot), both drawn into "
            f"the first. Right: within {RIGHT:g} pixel of the true epipolar geometry.\n"
            + "\n".join(textwrap.wrap(rule, 170)),
            fontsize=7.5,
            x=0.01,
            ha="left",
        )
    return figure


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description='"auto" and its peers at equal time on pairs of a KITTI drive.')
    parser.add_argument("--drive", default="dev")
    parser.add_argument("--method", choices=("auto", "learned"), default="auto", help="ours")
    parser.add_argument("--step", type=int, default=4, help="frames between the two of a pair")
    parser.add_argument("--ratio", type=float, default=1.0, help="of the ratio test; 1 for none")
    parser.add_argument("--one-way", action="store_true", help="nearest neighbours that need not be mutual")
    parser.add_argument("--threshold", type=float, default=0.01, help="the paper's on KITTI, normalised")
    parser.add_argument("--budget", type=float, default=10.0, help="ms for everyone")
    parser.add_argument("--every", type=int, default=1, help="only every so many pairs, to be quicker")
    parser.add_argument(
        "--cpu-time", action="store_true", help="count the process's time: for a machine that is shared"
    )
    parser.add_argument("--cache", type=Path, default=None, help="a folder in which matches are kept")
    parser.add_argument("--out", type=Path, default=None, help="write the picture there, PNG")
    return parser.parse_args()


def main() -> None:
    options = parse()
    with processor_time(options.cpu_time):
        compare_on_pairs(options)


def compare_on_pairs(options: argparse.Namespace) -> None:
    frames = kitti_drive(options.drive).pairs(options.step)[:: options.every]
    pairs = [load_pair(each, options) for each in frames]
    judged, kept = [each for k, each in enumerate(pairs) if k % 5], pairs[::5]
    sizes, shares = [len(each.x1) for each in judged], [each.share for each in judged]
    print(
        f"{platform.processor() or platform.machine()}, one thread; {len(judged)} pairs, step {options.step}, ratio "
        f"{options.ratio:g}{', one way' * options.one_way}, threshold {options.threshold:g}, {options.budget:g} ms; "
        f"{min(sizes)} to {max(sizes)} matches, right {100 * min(shares):.0f}% to {100 * max(shares):.0f}%, mean "
        f"{100 * np.mean(shares):.0f}%"
    )
    chosen = settings(kept, options)
    for pair in kept:  # what is compiled or loaded on first use
        run_ours(pair, options)
    rows: list[tuple[Pair, Judged, list[Judged]]] = []
    for pair in judged:
        ours, posed = run_ours(pair, options)
        theirs = [judge(pair, peer, linear, pixel, posed, options) for peer, linear, pixel in chosen]
        rows.append((pair, ours, theirs))
    report(rows)
    differences = [ours.pixels - best_of(theirs).pixels for _, ours, theirs in rows]
    right = [right_of(pair, ours) - right_of(pair, best_of(theirs)) for pair, ours, theirs in rows]
    order = np.argsort(differences, kind="stable")
    pair, ours, theirs = rows[int(order[len(order) // 2])]
    rule = (
        f"The pair with the median difference of {len(rows)}, within {options.budget:g} ms: mean difference "
        f"{np.mean(differences):+.1f} matches, maxcon ahead on {sum(x > 0 for x in differences)}, equal on "
        f"{sum(x == 0 for x in differences)}, behind on {sum(x < 0 for x in differences)}; mean difference of right "
        f"matches {np.mean(right):+.1f}. The other is, on each pair, the best of {len(theirs)} methods of OpenCV, "
        "PoseLib and COLMAP at their best thresholds, each called again while time is left."
    )
    print(f"drawn: frames {pair.frames.first} and {pair.frames.second}. {rule}")
    if options.out is not None:
        draw(pair, ours, best_of(theirs), rule).savefig(options.out, dpi=150)


def best_of(theirs: list[Judged]) -> Judged:
    return max(theirs, key=lambda each: each.pixels)


def report(rows: list[tuple[Pair, Judged, list[Judged]]]) -> None:
    """Print the means, and how "auto" compares on the single pairs."""
    print(
        f"{'mean over the pairs':20} {'pixels':>8} {'right':>8} {'linear':>8} {'swapped':>8} {'ms (median, most)':>18}"
    )
    mine = [judged for _, judged, _ in rows]
    everyone = [mine, *([theirs[k] for *_, theirs in rows] for k in range(len(rows[0][2])))]
    right = [[right_of(row[0], each) for row, each in zip(rows, found, strict=True)] for found in everyone]
    for found, good in zip(everyone, right, strict=True):
        milliseconds = [1e3 * each.seconds for each in found]
        means = (np.mean([getattr(each, name) for each in found]) for name in ("pixels", "linear", "swapped"))
        pixels, linear, swapped = means
        print(
            f"{found[0].name:20} {pixels:8.1f} {np.mean(good):8.1f} {linear:8.1f} {swapped:8.1f} "
            f"{np.median(milliseconds):12.1f} {max(milliseconds):5.1f}"
        )
    print(f"{mine[0].name + ' less ...':40} {'mean':>8} {'':9} ahead / equal / behind (median)")
    for found in everyone[1:]:
        print(compare([a.pixels - b.pixels for a, b in zip(mine, found, strict=True)], f"{found[0].name}: pixels"))
    for name in ("pixels", "linear", "swapped"):
        best = [max(getattr(each, name) for each in theirs) for *_, theirs in rows]
        own = [getattr(each, name) for each in mine]
        print(compare([a - b for a, b in zip(own, best, strict=True)], f"best peer: {name}"))
    best_right = np.max(right[1:], axis=0)
    print(compare(list(np.array(right[0]) - best_right), "most right of any peer: right"))
    of_best = [right_of(pair, best_of(theirs)) for pair, _, theirs in rows]
    print(compare(list(np.array(right[0]) - of_best), "best peer by pixels: right"))


def right_of(pair: Pair, judged: Judged) -> int:
    return int(np.count_nonzero(judged.near & pair.right))


if __name__ == "__main__":
    main()
