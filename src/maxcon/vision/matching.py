"""Matches from images: SIFT (Lowe 2004) by OpenCV, the ratio test, and mutual nearest neighbours."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maxcon.problem.validate import check_number
from maxcon.search.sampling import check_count

#: Lowe's threshold on (distance to the nearest) / (distance to the second nearest).
RATIO = 0.8

#: Stamped into cached matches: a change here, or of OpenCV, makes them anew.
_CACHE_VERSION = 1


@dataclass(frozen=True, eq=False)
class ImageMatches:
    """Putative matches of two images.

    Attributes
    ----------
    x1, x2
        Shape (N, 2): the matched points of image 1 and image 2 in pixels, the centre of the pixel at the top left
        at (0, 0).
    ratio
        Shape (N,): the distance of the descriptors over that to the second nearest, ascending: the best come first.
    n_keypoints
        How many keypoints each image has.
    """

    x1: NDArray[np.float64]
    x2: NDArray[np.float64]
    ratio: NDArray[np.float64]
    n_keypoints: tuple[int, int]


def load_opencv() -> ModuleType:
    """Return OpenCV.

    Raises
    ------
    ModuleNotFoundError
        If it is not installed; the message says how to install it.
    """
    try:
        import cv2  # noqa: PLC0415  (only images need it)
    except ImportError:
        raise ModuleNotFoundError("images need OpenCV, which is not installed: pip install 'maxcon[vision]'") from None
    return cv2


def read_image(file: str | Path) -> NDArray[np.uint8]:
    """Return an image file as grey levels, shape (height, width).

    Raises
    ------
    ModuleNotFoundError
        If OpenCV is not installed.
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no image that OpenCV can read.
    """
    cv2 = load_opencv()
    content = np.frombuffer(Path(file).read_bytes(), dtype=np.uint8)
    try:
        image = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE) if content.size else None
    except cv2.error:
        image = None
    if image is None:
        raise ValueError(f"{file} must be an image (PNG, JPEG, TIFF, PGM, ...), but it cannot be read as one")
    return np.ascontiguousarray(image, dtype=np.uint8)


def grey_levels(image: ArrayLike, name: str = "image") -> NDArray[np.uint8]:
    """Return an image as grey levels, shape (height, width), uint8.

    Parameters
    ----------
    image
        Shape (height, width) or (height, width, 3 or 4), RGB; integers from 0 to 255, or floats from 0 to 1.
    name
        What errors call it.

    Raises
    ------
    TypeError
        If it holds other things than numbers.
    ValueError
        If its shape or its range is another.
    """
    levels = np.asarray(image)
    if levels.dtype.kind not in "uif":
        raise TypeError(f"{name} must hold grey levels or colours, but its dtype is {levels.dtype}")
    if levels.ndim not in (2, 3) or (levels.ndim == 3 and levels.shape[2] not in (3, 4)) or levels.size == 0:
        raise ValueError(f"{name} must have shape (height, width) or (height, width, 3), but it is {levels.shape}")
    top = 1.0 if levels.dtype.kind == "f" else 255.0
    if not (levels.min() >= 0 and levels.max() <= top):
        raise ValueError(f"{name} must lie in 0 to {top:g}, but it spans {levels.min()} to {levels.max()}")
    if levels.ndim == 3:
        levels = levels[..., :3] @ np.array([0.299, 0.587, 0.114])  # Rec. 601, as OpenCV's own conversion
    return np.ascontiguousarray(np.rint(levels * (255.0 / top)), dtype=np.uint8)


def match_images(
    image1: ArrayLike,
    image2: ArrayLike,
    *,
    ratio: float = RATIO,
    mutual: bool = True,
    max_keypoints: int | None = None,
    cache: str | Path | None = None,
) -> ImageMatches:
    """Match the SIFT keypoints of two images.

    A match is a keypoint of image 1 with the nearest descriptor of image 2 if that is nearer than `ratio` times the
    second nearest (Lowe 2004, section 7.1) and, with `mutual`, has that keypoint of image 1 as its own nearest.
    Matches at the same two places (a keypoint may have several orientations) count once. Nothing is random.

    Parameters
    ----------
    image1, image2
        Grey levels or RGB, see `grey_levels`; `read_image` reads files.
    ratio
        Above 0 and at most 1; 1 turns the test off.
    mutual
        Whether the two must be each other's nearest.
    max_keypoints
        Keep so many keypoints an image, those of the highest contrast; None for all.
    cache
        A folder in which matches are kept, by a digest of images and settings; None for none.

    Raises
    ------
    ModuleNotFoundError
        If OpenCV is not installed.
    TypeError, ValueError
        If an argument is not of this kind; the message names it.
    """
    cv2 = load_opencv()
    first, second = grey_levels(image1, "image1"), grey_levels(image2, "image2")
    ratio = check_number(ratio, "ratio")
    if not 0.0 < ratio <= 1.0:
        raise ValueError(f"ratio must be above 0 and at most 1, but it is {ratio}")
    most = 0 if max_keypoints is None else check_count(max_keypoints, "max_keypoints", 1)
    if cache is None:
        return _match(cv2, first, second, ratio, bool(mutual), most)
    file = Path(cache) / f"{_digest(cv2, first, second, ratio, bool(mutual), most)}.npz"
    known = _read_cached(file)
    if known is not None:
        return known
    matches = _match(cv2, first, second, ratio, bool(mutual), most)
    _write_cached(file, matches)
    return matches


def _match(
    cv2: Any, image1: NDArray[np.uint8], image2: NDArray[np.uint8], ratio: float, mutual: bool, most: int
) -> ImageMatches:
    sift = cv2.SIFT_create(nfeatures=most)
    keypoints1, descriptors1 = sift.detectAndCompute(image1, None)
    keypoints2, descriptors2 = sift.detectAndCompute(image2, None)
    counts = (len(keypoints1), len(keypoints2))
    if min(counts) < 2:
        return ImageMatches(np.empty((0, 2)), np.empty((0, 2)), np.empty(0), counts)
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    nearest = matcher.knnMatch(descriptors1, descriptors2, k=2)
    index = np.array([pair[0].trainIdx for pair in nearest])
    distance = np.array([[each.distance for each in pair] for pair in nearest])
    shares = np.divide(distance[:, 0], distance[:, 1], out=np.ones(len(nearest)), where=distance[:, 1] > 0)
    keep = (shares < ratio) if ratio < 1.0 else np.ones(len(nearest), dtype=np.bool_)
    if mutual:
        back = np.array([found.trainIdx for found in matcher.match(descriptors2, descriptors1)])
        keep &= back[index] == np.arange(len(index))
    chosen = np.flatnonzero(keep)
    chosen = chosen[np.argsort(shares[chosen], kind="stable")]
    x1 = np.array([keypoint.pt for keypoint in keypoints1], dtype=np.float64)[chosen]
    x2 = np.array([keypoint.pt for keypoint in keypoints2], dtype=np.float64)[index[chosen]]
    once = np.sort(np.unique(np.hstack([x1, x2]), axis=0, return_index=True)[1])
    return ImageMatches(np.ascontiguousarray(x1[once]), np.ascontiguousarray(x2[once]), shares[chosen][once], counts)


def _digest(cv2: Any, image1: NDArray[np.uint8], image2: NDArray[np.uint8], *settings: object) -> str:
    stamp = hashlib.sha256(repr((_CACHE_VERSION, cv2.__version__, image1.shape, image2.shape, settings)).encode())
    stamp.update(image1.tobytes())
    stamp.update(image2.tobytes())
    return stamp.hexdigest()


def _read_cached(file: Path) -> ImageMatches | None:
    """Return cached matches, or None where there are none; a damaged file counts as none."""
    try:
        with file.open("rb") as stream, np.load(stream) as kept:
            counts = kept["n_keypoints"]
            return ImageMatches(kept["x1"], kept["x2"], kept["ratio"], (int(counts[0]), int(counts[1])))
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return None


def _write_cached(file: Path, matches: ImageMatches) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f".{file.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as stream:
            np.savez(stream, x1=matches.x1, x2=matches.x2, ratio=matches.ratio, n_keypoints=matches.n_keypoints)
        os.replace(part, file)
    finally:
        part.unlink(missing_ok=True)
