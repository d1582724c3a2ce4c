"""A KITTI pair on which "auto" and OpenCV get the same time: who finds which inliers, counted and drawn.

    python benchmarks/two_view_picture.py --out docs/figures/two-view-equal-time.png
    python benchmarks/two_view_picture.py --budget 100 --step 2
    python benchmarks/two_view_picture.py --one-way --threshold 0.003 --step 3

The pairs are the frames (i, i + step) of a drive, matched by SIFT with mutual nearest neighbours (`--one-way`: without
that) and *no* ratio test, so that half of the matches or more are wrong. Every fifth pair only calibrates OpenCV; the
others are judged.

Everyone gets the same limit of wall-clock time on one thread: `maxcon.find_fundamental` with posing the problem and the
last steps included; OpenCV's methods by the number of iterations that fits, at the threshold (pixels) that brings the
most inliers on the pairs for calibration (`maxcon.experiments.bench_calibration`). They end earlier where they hold
themselves sure. "The best of OpenCV" is, on each pair, the best of its methods, each with all of the time. Counted are

- inliers: matches within the threshold of the one linear residual that both are judged by, that of the posed problem.
  "auto" maximises it, with 8 free parameters; OpenCV's matrices have rank 2, and maximise a count in pixels. This count
  favours "auto". How much of the difference is a matter of the residual, and not of the search, is told by "swapped":
  OpenCV's inliers after our swap refinement, for which it is charged no time.
- right inliers: those of them within a pixel (Sampson) of the true epipolar geometry, by calibration and poses.
- pixels: matches within a pixel (Sampson) of the matrix of rank 2 that each returns; of "auto" its refit, of OpenCV
  that with a threshold of one pixel. This count favours OpenCV, which maximises it.

Drawn is the pair on which the difference of inliers is the median of all judged pairs (`--pair largest`: the largest).
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import gc  # noqa: E402
import platform  # noqa: E402
import textwrap  # noqa: E402
import time  # noqa: E402
from collections.abc import Sequence  # noqa: E402
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
from maxcon.experiments.bench_peers import OpenCv, Run  # noqa: E402
from maxcon.experiments.canvas import look, new_figure  # noqa: E402
from maxcon.search.anytime import make_task  # noqa: E402
from maxcon.search.refine import swap_refinement  # noqa: E402
from maxcon.vision.epipolar import sampson_distances  # noqa: E402
from maxcon.vision.fundamental import fundamental_problem  # noqa: E402
from maxcon.vision.matching import match_images, read_image  # noqa: E402

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: OpenCV's methods, as `maxcon.experiments.bench_peers` calls them.
METHODS = {
    "RANSAC": "FM_RANSAC",
    "USAC_DEFAULT": "USAC_DEFAULT",
    "USAC_FAST": "USAC_FAST",
    "USAC_ACCURATE": "USAC_ACCURATE",
    "USAC_MAGSAC": "USAC_MAGSAC",
}

#: A match is right within so many pixels of the true epipolar geometry; also the threshold of the count in pixels.
RIGHT = 1.0

#: Told apart by lightness as well as by hue.
BOTH, OURS, THEIRS, NEITHER = "#12B347", "#0B3FD1", "#E8590C", "#6B6B6B"

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Judged:
    """What one side found on a pair.

    Attributes
    ----------
    name
        Who.
    inliers
        Shape (N,): matches within the threshold of the linear residual.
    swapped
        How many inliers there are after our swap refinement.
    pixels
        How many matches are within a pixel of its matrix.
    seconds
        The time that it took.
    """

    name: str
    inliers: Mask
    swapped: int
    pixels: int
    seconds: float

    @property
    def count(self) -> int:
        """How many inliers."""
        return int(np.count_nonzero(self.inliers))


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


def run_ours(pair: Pair, options: argparse.Namespace) -> Judged:
    """Run "auto" so that posing the problem, the search and the matrix take the budget, all in all."""
    budget = 1e-3 * options.budget
    more: dict[str, Any] = {"n_jobs": 1} if options.method == "auto" else {}
    gc.disable()
    began = time.perf_counter()
    fundamental_problem(pair.x1, pair.x2, threshold=options.threshold, rng=0)
    posing = time.perf_counter() - began  # it is made again inside, but what it takes must be known before
    began = time.perf_counter()
    fit = find_fundamental(
        pair.x1,
        pair.x2,
        options.threshold,
        method=options.method,
        rng=0,
        time_limit=max(0.95 * budget - posing, 1e-3),
        refit=True,
        **more,
    )
    seconds = time.perf_counter() - began
    gc.enable()
    return Judged(options.method, fit.inlier_mask, fit.n_inliers, int(np.count_nonzero(fit.sampson <= RIGHT)), seconds)


def run_theirs(pair: Pair, name: str, run: Run, choice: Choice) -> Judged:
    """Run a method of OpenCV, and count what it found in the chart of the pair's instance, that of "auto"."""
    matrix, seconds, _ = timed(run, choice.iterations, choice.threshold)
    instance = pair.instance
    inliers = np.zeros(len(pair.x1), dtype=np.bool_)
    if matrix is None or not np.isfinite(matrix).all() or instance.posed is None:
        return Judged(name, inliers, 0, 0, seconds)
    with suppress(ValueError):  # it has no place in the chart
        inliers = instance.problem.residuals(instance.posed.parameters(matrix)) <= instance.limit
    swapped = 0
    if inliers.any():
        task = make_task(instance.problem, instance.threshold, np.random.default_rng(0))
        swapped = int(np.count_nonzero(swap_refinement(task, inliers)))
    near = int(np.count_nonzero(sampson_distances(matrix, pair.x1, pair.x2) <= RIGHT))
    return Judged(name, inliers, swapped, near, seconds)


def settings(pairs: list[Pair], options: argparse.Namespace) -> dict[str, tuple[OpenCv, Choice, Choice]]:
    """Return for each method of OpenCV its settings for most inliers, and those for most matches within a pixel."""
    chosen = {}
    instances, budget = [each.instance for each in pairs], 1e-3 * options.budget
    for name, flag in METHODS.items():
        peer = OpenCv(name=name, flag=flag)
        most = calibrate(peer, instances, [budget])[budget]
        pixel = calibrate(replace(peer, thresholds=(RIGHT,)), instances, [budget])[budget]
        chosen[name] = (peer, most, pixel)
        print(
            f"  {name:14} threshold {most.threshold:4g} px, {most.iterations:7} iterations, "
            f"{1e3 * most.seconds:6.1f} ms on the pairs for calibration",
            flush=True,
        )
    return chosen


def compare(values: Sequence[int], name: str) -> str:
    """Return how a list of differences (ours less theirs) reads."""
    differences = np.array(values)
    return (
        f"{name:52} {differences.mean():+8.2f} +-{differences.std(ddof=1) / np.sqrt(len(differences)):5.2f}   "
        f"{np.count_nonzero(differences > 0):3} / {np.count_nonzero(differences == 0):3} / "
        f"{np.count_nonzero(differences < 0):3}"
    )


def draw(pair: Pair, ours: Judged, theirs: Judged, rule: str) -> Figure:
    """Return the picture: both ends of each match in the first frame, coloured by who finds it."""
    from matplotlib.collections import LineCollection  # noqa: PLC0415  (only the picture needs it)

    image = read_image(pair.frames.image1)
    height, width = image.shape
    mine, other = ours.inliers, theirs.inliers
    groups = (
        (~mine & ~other, NEITHER, 0.5, 0.35, "neither"),
        (mine & other, BOTH, 0.8, 0.8, "both"),
        (mine & ~other, OURS, 1.7, 1.0, "only maxcon"),
        (other & ~mine, THEIRS, 1.7, 1.0, "only OpenCV"),
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
            f"Frames {pair.frames.first} and {pair.frames.second}, {len(mine)} matches, no ratio test: "
            f"maxcon {ours.count} inliers ({1e3 * ours.seconds:.0f} ms), "
            f"OpenCV {theirs.name} {theirs.count} ({1e3 * theirs.seconds:.0f} ms)",
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
    parser = argparse.ArgumentParser(description='"auto" and OpenCV at equal time on pairs of a KITTI drive.')
    parser.add_argument("--drive", default="dev")
    parser.add_argument("--method", choices=("auto", "learned"), default="auto", help="ours")
    parser.add_argument("--step", type=int, default=4, help="frames between the two of a pair")
    parser.add_argument("--ratio", type=float, default=1.0, help="of the ratio test; 1 for none")
    parser.add_argument("--one-way", action="store_true", help="nearest neighbours that need not be mutual")
    parser.add_argument("--threshold", type=float, default=0.01, help="the paper's on KITTI, normalised")
    parser.add_argument("--budget", type=float, default=30.0, help="ms for everyone")
    parser.add_argument(
        "--cpu-time", action="store_true", help="count the process's time: for a machine that is shared"
    )
    parser.add_argument("--pair", choices=("median", "largest"), default="median", help="which pair is drawn")
    parser.add_argument("--cache", type=Path, default=None, help="a folder in which matches are kept")
    parser.add_argument("--out", type=Path, default=None, help="write the picture there, PNG")
    return parser.parse_args()


def main() -> None:
    options = parse()
    if options.cpu_time:
        time.perf_counter = time.process_time
    pairs = [load_pair(each, options) for each in kitti_drive(options.drive).pairs(options.step)]
    judged, kept = [each for k, each in enumerate(pairs) if k % 5], pairs[::5]
    sizes, shares = [len(each.x1) for each in judged], [each.share for each in judged]
    print(
        f"{platform.processor() or platform.machine()}, one thread; {len(judged)} pairs, step {options.step}, ratio "
        f"{options.ratio:g}{', one way' * options.one_way}, threshold {options.threshold:g}, {options.budget:g} ms; "
        f"{min(sizes)} to {max(sizes)} matches, right {100 * min(shares):.0f}% to {100 * max(shares):.0f}%, mean "
        f"{100 * np.mean(shares):.0f}%"
    )
    chosen = settings(kept, options)
    run_ours(kept[0], options)
    rows: list[tuple[Pair, Judged, dict[str, Judged], dict[str, Judged]]] = []
    for pair in judged:
        ours = run_ours(pair, options)
        runs = {name: (peer.prepare(pair.instance, 0), most, pixel) for name, (peer, most, pixel) in chosen.items()}
        theirs = {name: run_theirs(pair, name, run, most) for name, (run, most, _) in runs.items()}
        near = {name: run_theirs(pair, name, run, pixel) for name, (run, _, pixel) in runs.items()}
        rows.append((pair, ours, theirs, near))
    report(rows)
    differences = [ours.count - best_of(theirs).count for _, ours, theirs, _ in rows]
    swapped = [ours.count - max(each.swapped for each in theirs.values()) for _, ours, theirs, _ in rows]
    right = [right_of(pair, ours) - right_of(pair, best_of(theirs)) for pair, ours, theirs, _ in rows]
    order = np.argsort(differences, kind="stable")
    place = int(order[-1] if options.pair == "largest" else order[len(order) // 2])
    pair, ours, theirs, _ = rows[place]
    rule = (
        f"The pair with the {options.pair} difference of {len(rows)}, within {options.budget:g} ms: mean difference "
        f"{np.mean(differences):+.1f} inliers, maxcon ahead on {sum(x > 0 for x in differences)}, equal on "
        f"{sum(x == 0 for x in differences)}, behind on {sum(x < 0 for x in differences)}. OpenCV: the best of its "
        f"{len(METHODS)} methods on each pair, which stop early where they are sure; after our swap refinement of what "
        f"they found, the difference is {np.mean(swapped):+.1f}; that of right matches is {np.mean(right):+.1f}."
    )
    print(f"drawn: frames {pair.frames.first} and {pair.frames.second}. {rule}")
    if options.out is not None:
        draw(pair, ours, best_of(theirs), rule).savefig(options.out, dpi=150)


def best_of(theirs: dict[str, Judged]) -> Judged:
    return max(theirs.values(), key=lambda each: each.count)


def report(rows: list[tuple[Pair, Judged, dict[str, Judged], dict[str, Judged]]]) -> None:
    """Print the means, and how "auto" compares on the single pairs."""
    print(f"{'mean over the pairs':20} {'inliers':>8} {'swapped':>8} {'right':>8} {'pixels':>8} {'ms (median)':>12}")
    ours = [(pair, judged) for pair, judged, _, _ in rows]
    show(ours[0][1].name, ours, [judged.pixels for _, judged in ours])
    for name in rows[0][2]:
        show(name, [(pair, found[name]) for pair, _, found, _ in rows], [near[name].pixels for *_, near in rows])
    print(f"{ours[0][1].name + ' less ...':52} {'mean':>8} {'':9} ahead / equal / behind")
    for name in rows[0][2]:
        print(compare([judged.count - found[name].count for _, judged, found, _ in rows], f"{name}: inliers"))
    best = [best_of(found) for _, _, found, _ in rows]
    print(compare([a.count - b.count for (_, a), b in zip(ours, best, strict=True)], "best of OpenCV: inliers"))
    swapped = [max(each.swapped for each in found.values()) for _, _, found, _ in rows]
    print(compare([a.count - b for (_, a), b in zip(ours, swapped, strict=True)], "best of OpenCV, swapped: inliers"))
    right = [max(right_of(pair, each) for each in found.values()) for pair, _, found, _ in rows]
    mine = [right_of(pair, judged) for pair, judged in ours]
    print(compare([a - b for a, b in zip(mine, right, strict=True)], "best of OpenCV: right inliers"))
    pixels = [max(each.pixels for each in near.values()) for *_, near in rows]
    print(compare([a.pixels - b for (_, a), b in zip(ours, pixels, strict=True)], "best of OpenCV: pixels"))


def right_of(pair: Pair, judged: Judged) -> int:
    return int(np.count_nonzero(judged.inliers & pair.right))


def show(name: str, found: list[tuple[Pair, Judged]], pixels: list[int]) -> None:
    inliers, swapped = [each.count for _, each in found], [each.swapped for _, each in found]
    right, seconds = [right_of(pair, each) for pair, each in found], [each.seconds for _, each in found]
    print(
        f"{name:20} {np.mean(inliers):8.1f} {np.mean(swapped):8.1f} {np.mean(right):8.1f} {np.mean(pixels):8.1f} "
        f"{1e3 * np.median(seconds):12.1f}"
    )


if __name__ == "__main__":
    main()
