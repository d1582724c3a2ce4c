"""Fundamental matrices of pairs of frames of a KITTI drive (section 4.2, right of figure 7 and figure 8)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maxcon.datasets.kitti import kitti_drive
from maxcon.datasets.location import data_folder
from maxcon.datasets.two_view_scene import synthetic_two_view
from maxcon.experiments.contenders import Contender, Instance, compete, warm_up
from maxcon.experiments.records import Run
from maxcon.problem import Consensus
from maxcon.vision.epipolar import sampson_distances
from maxcon.vision.fundamental import USUAL_THRESHOLD, fundamental_problem
from maxcon.vision.matching import match_images, read_image

#: Tells the random numbers of made pairs from those of training.
_STREAM = 7

#: An inlier is confirmed by the true F if its Sampson distance is at most so many pixels.
CONFIRMED = 2.0


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """The matches of a pair of frames, with the images and the true F where there are any."""

    x1: NDArray[np.float64]
    x2: NDArray[np.float64]
    images: tuple[NDArray[np.uint8] | None, NDArray[np.uint8] | None]
    F: NDArray[np.float64] | None


@dataclass(frozen=True)
class KittiExperiment:
    """Every contender on the SIFT matches of pairs of frames.

    Attributes
    ----------
    sequence
        The name of the drive; empty: made pairs, with as many matches as SIFT finds on a drive.
    pairs
        Step and number of the first frame of every pair.
    contenders
        What is compared.
    cache
        A folder in which matches are kept; empty for none.
    threshold, chart
        See `maxcon.vision.fundamental_problem`.
    seed
        Seeds the made pairs.
    factor
        The RANSAC variants have so many times the time of our method.
    """

    sequence: str
    pairs: tuple[tuple[int, int], ...]
    contenders: tuple[Contender, ...]
    cache: str = ""
    threshold: float = USUAL_THRESHOLD
    chart: str = "auto"
    seed: int = 0
    factor: float = 1.0
    name: str = "kitti"

    def settings(self) -> dict[str, Any]:
        """Return all that the records depend on."""
        return {
            "experiment": self.name,
            "sequence": self.sequence or "made pairs",
            "pairs": [list(pair) for pair in self.pairs],
            "threshold": self.threshold,
            "chart": self.chart,
            "seed": self.seed,
            "factor": self.factor,
            "contenders": [each.describe() for each in self.contenders],
        }

    def units(self) -> dict[str, tuple[int, ...]]:
        """Return step, first frame and number (at its step) of every pair by its name, in an order that mixes steps."""
        numbered = []
        count: dict[int, int] = {}
        for step, first in self.pairs:
            count[step] = count.get(step, -1) + 1
            numbered.append((step, first, count[step]))
        ordered = sorted(numbered, key=lambda each: (each[1] % 10, each[1], each[0]))
        return {f"step {step}, {first}": (step, first, number) for step, first, number in ordered}

    def run(self, unit: str, digest: str) -> list[Run]:
        """Return the records of a pair."""
        step, first, number = self.units()[unit]
        pair = self.matches(unit)
        posed = fundamental_problem(pair.x1, pair.x2, chart=self.chart, threshold=self.threshold, rng=self.seed)
        named = f"drive {self.sequence}, frames" if self.sequence else f"seed {[self.seed, _STREAM, step, first]},"
        where = f"{named} {first} and {first + step}"
        instance = Instance(self.name, unit, where, posed.problem, self.threshold, first, number, None, step)
        rows, results = compete(instance, self.contenders, self.factor, digest)
        return [replace(row, measures=_measures(pair, results.get(row.name))) for row in rows]

    def warm_up(self) -> None:
        """Load or compile all that runs will call."""
        scene = synthetic_two_view(30, 0.2, np.random.default_rng(0))
        problem = fundamental_problem(scene.x1, scene.x2, chart=self.chart, threshold=self.threshold).problem
        warm_up(Instance(self.name, "", "", problem, self.threshold, 0, 0), self.contenders)

    def matches(self, unit: str) -> MatchedPair:
        """Return the matches of a pair by its name."""
        step, first, _ = self.units()[unit]
        if not self.sequence:
            return _made_pair(np.random.default_rng([self.seed, _STREAM, step, first]))
        drive = kitti_drive(self.sequence)
        images = read_image(drive.images[first]), read_image(drive.images[first + step])
        found = match_images(*images, cache=self.cache or None)
        return MatchedPair(found.x1, found.x2, images, drive.fundamental(first, first + step))


def first_sequence() -> str:
    """Return the name of the first drive in the folder of the data sets; empty where there is none."""
    root = data_folder() / "kitti" / "sequences"
    names = sorted(path.name for path in root.glob("*") if (path / "image_0").is_dir()) if root.is_dir() else []
    return names[0] if names else ""


def frame_pairs(sequence: str, steps: tuple[int, ...], most: int | None) -> tuple[tuple[int, int], ...]:
    """Return step and first frame of the pairs of a drive: all, or `most` a step, spread over the drive."""
    n_frames = len(kitti_drive(sequence).images) if sequence else 51
    pairs = []
    for step in steps:
        n_pairs = max(0, n_frames - step)
        count = n_pairs if most is None else min(most, n_pairs)
        pairs += [(step, int(first)) for first in np.linspace(0, n_pairs - 1, count).round()]
    return tuple(pairs)


def unpacked(row: Run) -> NDArray[np.bool_]:
    """Return which matches are inliers, shape (N,), from a record."""
    bits = np.frombuffer(bytes.fromhex(row.measures["inliers"]), dtype=np.uint8)
    return np.unpackbits(bits, count=row.n_points).astype(np.bool_)


def _made_pair(rng: np.random.Generator) -> MatchedPair:
    """Return a pair with the number of matches and the share of wrong ones that SIFT has on a drive."""
    n_points = int(rng.integers(350, 1500))
    scene = synthetic_two_view(n_points, float(rng.uniform(0.05, 0.35)), rng, noise=0.5)
    return MatchedPair(scene.x1, scene.x2, (None, None), scene.F)


def _measures(pair: MatchedPair, result: Consensus | None) -> dict[str, Any]:
    """Return the inliers as bits, and how the true F judges them."""
    if result is None:
        return {}
    mask = result.inlier_mask
    measures: dict[str, Any] = {"inliers": np.packbits(mask).tobytes().hex()}
    if pair.F is not None and mask.any():
        distances = sampson_distances(pair.F, pair.x1[mask], pair.x2[mask])
        measures["true_sampson_pixels"] = float(np.median(distances))
        measures["confirmed"] = int((distances <= CONFIRMED).sum())
        measures["marked"] = int(mask.sum())
    return measures


def cache_folder(out: Path) -> str:
    """Return where the matches of a reproduction are kept."""
    return str(out / "matches")
