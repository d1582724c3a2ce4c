"""KITTI odometry (Geiger et al. 2012): pairs of frames of a drive, with calibration and poses.

The layout is that of the odometry benchmark: ``sequences/00/image_0/000000.png``, ``sequences/00/calib.txt`` and
``poses/00.txt``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maxcon.datasets.cameras import fundamental_from_cameras
from maxcon.datasets.location import data_folder, required

_OBTAIN = (
    "download 'odometry data set (grayscale)', 'calibration files' and 'ground truth poses' from the page of the KITTI "
    "visual odometry benchmark (www.cvlibs.net/datasets/kitti/eval_odometry.php, CC BY-NC-SA 3.0) and unpack them."
)
_LAYOUT = "kitti/sequences/SEQUENCE/image_0/000000.png, kitti/sequences/SEQUENCE/calib.txt and kitti/poses/SEQUENCE.txt"


@dataclass(frozen=True, eq=False)
class FramePair:
    """Two frames of a drive.

    Attributes
    ----------
    first, second
        The numbers of the frames, from 0.
    image1, image2
        The files of the images.
    F
        Shape (3, 3): the fundamental matrix from calibration and poses, unit Frobenius norm; None where the drive
        has no poses, or the car stood still.
    """

    first: int
    second: int
    image1: Path
    image2: Path
    F: NDArray[np.float64] | None


@dataclass(frozen=True, eq=False)
class KittiDrive:
    """A drive of the odometry benchmark.

    Attributes
    ----------
    name
        Of the sequence, such as "00".
    images
        The files of the frames of one camera, in order.
    P
        Shape (3, 4): the projection matrix of that camera (rectified, pixels), from calib.txt.
    poses
        Shape (n, 3, 4), for each frame camera 0 to world, metres; None where the benchmark keeps them to itself.
    """

    name: str
    images: tuple[Path, ...]
    P: NDArray[np.float64]
    poses: NDArray[np.float64] | None

    def pairs(self, step: int = 1) -> list[FramePair]:
        """Return the pairs of frames (0, step), (1, 1 + step), ...

        Raises
        ------
        ValueError
            If `step` is no whole number of at least 1 and below the number of frames.
        """
        if isinstance(step, bool) or not isinstance(step, (int, np.integer)) or not 1 <= step < len(self.images):
            raise ValueError(f"step must be a whole number from 1 to {len(self.images) - 1}, but it is {step!r}")
        return [
            FramePair(i, i + step, self.images[i], self.images[i + step], self.fundamental(i, i + step))
            for i in range(len(self.images) - step)
        ]

    def camera(self, frame: int) -> NDArray[np.float64]:
        """Return the camera of a frame in the world, shape (3, 4).

        Raises
        ------
        ValueError
            If the drive has no poses.
        IndexError
            If it has no such frame.
        """
        if self.poses is None:
            raise ValueError(f"drive {self.name!r} has no poses")
        R, t = self.poses[frame, :, :3], self.poses[frame, :, 3]
        world_to_camera = np.eye(4)
        world_to_camera[:3, :3], world_to_camera[:3, 3] = R.T, -R.T @ t
        camera: NDArray[np.float64] = self.P @ world_to_camera
        return camera

    def fundamental(self, first: int, second: int) -> NDArray[np.float64] | None:
        """Return the fundamental matrix between two frames, or None where it is not known or the car stood still."""
        if self.poses is None:
            return None
        try:
            return fundamental_from_cameras(self.camera(first), self.camera(second))
        except ValueError:
            return None


def kitti_drive(sequence: str, *, folder: str | Path | None = None, camera: int = 0) -> KittiDrive:
    """Open a drive.

    Parameters
    ----------
    sequence
        Its name: "00" to "21" in the benchmark.
    folder
        The folder with ``sequences`` and ``poses``; None for ``kitti`` in the folder of the data sets (see
        `maxcon.datasets.data_folder`).
    camera
        0 or 1, grey left or right; 2 or 3, colour.

    Raises
    ------
    FileNotFoundError
        If the folder, the images or the calibration are absent; the message says how to obtain them.
    ValueError
        If there is no such camera, or a file is damaged.
    """
    if camera not in (0, 1, 2, 3):
        raise ValueError(f"camera must be 0, 1, 2 or 3, but it is {camera!r}")
    root = Path(folder) if folder is not None else data_folder() / "kitti"
    drive = required(root / "sequences" / sequence, f"the KITTI drive {sequence!r}", _OBTAIN, _LAYOUT)
    images = tuple(sorted((drive / f"image_{camera}").glob("*.png")))
    if len(images) < 2:
        raise FileNotFoundError(
            f"{drive / f'image_{camera}'} holds {len(images)} PNG images, which makes no pair. "
            f"To obtain them: {_OBTAIN}"
        )
    P = _calibration(drive / "calib.txt", f"P{camera}")
    return KittiDrive(sequence, images, P, _poses(root / "poses" / f"{sequence}.txt", len(images)))


def _calibration(file: Path, key: str) -> NDArray[np.float64]:
    if not file.is_file():
        raise FileNotFoundError(f"{file} is absent. To obtain it: {_OBTAIN}")
    for text in file.read_text(encoding="utf-8").splitlines():
        name, _, numbers = text.partition(":")
        if name.strip() == key:
            return _matrix(numbers, f"{file}, row {key}")
    raise ValueError(f"{file} must have a row {key}, but it has none")


def _poses(file: Path, n_frames: int) -> NDArray[np.float64] | None:
    if not file.is_file():
        return None
    rows = [text for text in file.read_text(encoding="utf-8").splitlines() if text.strip()]
    if len(rows) < n_frames:
        raise ValueError(f"{file} must have a pose for each of the {n_frames} frames, but it has {len(rows)} rows")
    return np.array([_matrix(text, f"{file}, row {i}") for i, text in enumerate(rows[:n_frames], 1)])


def _matrix(text: str, where: str) -> NDArray[np.float64]:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.empty(0)
    if values.shape != (12,) or not np.isfinite(values).all():
        raise ValueError(f"{where} must hold the 12 numbers of a 3x4 matrix, but it is {text.strip()[:60]!r}")
    return values.reshape(3, 4)
