"""Fundamental matrices to train on and to judge by: made scenes, ModelNet40 meshes, and matches of a KITTI drive.

Nothing of what is drawn here says which match is right: an instance is its linear problem and nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from maxcon.agent.config import DataConfig
from maxcon.datasets.kitti import KittiDrive, kitti_drive
from maxcon.datasets.location import data_folder
from maxcon.datasets.modelnet import Mesh, load_off, modelnet_files, modelnet_two_view
from maxcon.datasets.two_view_scene import synthetic_two_view
from maxcon.fitting import fit
from maxcon.vision.fundamental import fundamental_problem

if TYPE_CHECKING:
    from maxcon.problem import LinearProblem

#: Seconds that a proof of the optimum may take where the consensus to reach is sought.
PROOF_SECONDS = 0.5

#: Pairs of frames with fewer matches than this many times the size of an instance are left out.
_LEAST_CHOICE = 1.5


class SceneSource:
    """Two views of made scenes or of meshes, at an outlier rate of one's choice (paper, section 4.2).

    Parameters
    ----------
    config
        Chart and threshold; where the source is "modelnet", its meshes are used.
    split
        "train" or "test": of the meshes. Made scenes are told apart by the generator's seed alone.
    folder
        The folder ModelNet40; None for the one in the folder of the data sets.

    Raises
    ------
    FileNotFoundError
        If there are no meshes; the message says how to obtain them.
    """

    def __init__(self, config: DataConfig, split: str, folder: Path | None = None) -> None:
        self.config = config
        files = modelnet_files("test" if split == "test" else "train", folder) if config.source == "modelnet" else []
        self.meshes: list[Mesh] = [load_off(file) for file in files]

    def draw(self, rng: np.random.Generator, n_points: int, outlier_rate: float) -> LinearProblem:
        """Return an instance of `n_points` matches."""
        threshold = self.config.threshold
        if self.meshes:
            mesh = self.meshes[int(rng.integers(len(self.meshes)))]
            scene = modelnet_two_view(mesh, n_points, outlier_rate, rng, threshold=threshold)
        else:
            scene = synthetic_two_view(n_points, outlier_rate, rng, threshold=threshold)
        posed = fundamental_problem(scene.x1, scene.x2, chart=self.config.chart, threshold=threshold)
        return posed.problem


class DriveSource:
    """Random matches of random pairs of frames of a drive: as many from every pair, whatever it has.

    Parameters
    ----------
    config
        Which drive, frames, steps, chart and threshold.
    split
        "train": the pairs within ``config.frames``; "test": the pairs whose frames both come later.
    n_points
        The size of an instance; pairs with less than half as many matches again are left out.
    folder
        With ``sequences``; None for ``kitti`` in the folder of the data sets.

    Raises
    ------
    FileNotFoundError
        If there is no drive; the message says how to obtain one.
    ValueError
        If there are several drives and `config` names none, or no pair of frames has enough matches.
    """

    def __init__(self, config: DataConfig, split: str, n_points: int, folder: Path | None = None) -> None:
        self.config, self.n_points = config, n_points
        drive = open_drive(config.sequence, folder)
        found = [matches for _, _, matches in pair_matches(drive, config.frames, config.steps, split)]
        self.pairs = [each for each in found if len(each) >= _LEAST_CHOICE * n_points]
        if not self.pairs:
            raise ValueError(
                f"frames must hold pairs of at least {_LEAST_CHOICE * n_points:.0f} matches for instances of "
                f"{n_points}, but of the {len(found)} pairs for {split}ing none has so many"
            )

    def draw(self, rng: np.random.Generator) -> LinearProblem:
        """Return an instance."""
        matches = self.pairs[int(rng.integers(len(self.pairs)))]
        some = matches[rng.choice(len(matches), self.n_points, replace=False)]
        posed = fundamental_problem(some[:, :2], some[:, 2:], chart=self.config.chart, threshold=self.config.threshold)
        return posed.problem


def open_drive(sequence: str, folder: Path | None) -> KittiDrive:
    """Return a drive by its name, or the only one that there is where the name is empty.

    Raises
    ------
    FileNotFoundError, ValueError
        As for `DriveSource`.
    """
    root = folder if folder is not None else data_folder() / "kitti"
    names = sorted(each.name for each in (root / "sequences").glob("*") if each.is_dir())
    if not sequence and len(names) > 1:
        raise ValueError(f"sequence must name one of the drives {', '.join(names)}, but it is empty")
    return kitti_drive(sequence or (names[0] if names else "00"), folder=folder)


def pair_matches(
    drive: KittiDrive, frames: tuple[int, ...], steps: tuple[int, ...], split: str
) -> Iterator[tuple[int, int, NDArray[np.float64]]]:
    """Yield step, first frame and the SIFT matches, shape (N, 4) in pixels, of the pairs of a split.

    Raises
    ------
    ValueError
        If `frames` are not the first and the last of a range in the drive.
    """
    from maxcon.vision.matching import match_images, read_image  # noqa: PLC0415  (OpenCV)

    last = len(drive.images) - 1
    if len(frames) != 2 or not 0 <= frames[0] < frames[1] <= last:
        raise ValueError(f"frames must be the first and the last of those to use, within 0 and {last}, not {frames}")
    low, high = frames if split == "train" else (frames[1] + 1, last)
    for step in steps:
        for pair in drive.pairs(step) if low + step <= high else []:
            if low <= pair.first and pair.second <= high:
                matches = match_images(read_image(pair.image1), read_image(pair.image2))
                yield step, pair.first, np.hstack([matches.x1, matches.x2])


def best_known(problem: LinearProblem, threshold: float, seconds: float = PROOF_SECONDS) -> tuple[int, bool, float]:
    """Return the largest consensus known, whether it is proven to be the largest, and the seconds that it took.

    The exact method within `seconds`, and where that proves nothing LO-RANSAC and graduated non-convexity besides.
    """
    exact = fit(problem, threshold, method="exact", time_limit=seconds)
    if exact.status == "optimal":
        return exact.n_inliers, True, exact.seconds
    others = [fit(problem, threshold, method=method, rng=0) for method in ("lo-ransac", "gnc")]
    found = [exact, *others]
    return max(each.n_inliers for each in found), False, sum(each.seconds for each in found)
