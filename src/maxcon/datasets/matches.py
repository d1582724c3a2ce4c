"""Files of matches that others published: ``*_pts.txt`` tables, and the MATLAB files of A*-NAPA-DIBP."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maxcon.datasets.location import data_folder, required

_OBTAIN = (
    "take the matches of AdelaideRMF (Wong et al. 2011) and of Kusvod2, homogr and EVD (Lebeda et al. 2012) from the "
    "pages of their authors, and KITTI_417_420.mat from the code of Cai et al. 2019, 'Consensus maximization tree "
    "search revisited'."
)
_LAYOUT = "two_view/{fundamental,homography}/NAME_pts.txt and two_view/mat/NAME.mat"


@dataclass(frozen=True, eq=False)
class MatchTable:
    """Matches of two images, from a file.

    Attributes
    ----------
    name
        The file's, without its ending.
    x1, x2
        Shape (N, 2): the matched points of image 1 and image 2, pixels.
    labels
        Shape (N,), what the file says of each match, or None where it says nothing. In AdelaideRMF 0 is an outlier and
        1, 2, ... a plane of the scene. In Kusvod2 and with the homographies 1 is a match checked by hand, to score a
        model by and not to fit, and 0 a match to fit.
    image1, image2
        Shape (height, width), uint8, or None where the file holds no images.
    """

    name: str
    x1: NDArray[np.float64]
    x2: NDArray[np.float64]
    labels: NDArray[np.int64] | None = None
    image1: NDArray[np.uint8] | None = None
    image2: NDArray[np.uint8] | None = None


def two_view_folder() -> Path:
    """Return the folder of the published matches, ``two_view`` in the folder of the data sets.

    Raises
    ------
    FileNotFoundError
        If it is absent; the message says how to obtain the data.
    """
    return required(data_folder() / "two_view", "the folder of published matches", _OBTAIN, _LAYOUT)


def load_points(file: str | Path) -> MatchTable:
    """Read a ``*_pts.txt`` table.

    Its rows are ``x1 y1 1 x2 y2 1 label``, or of nine words ``x1 y1 x2 y2 ratio1 ratio2 detector descriptor label``.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no such table; the message says what is wrong.
    """
    path = Path(file)
    rows = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        if line.strip():
            rows.append(_row(line.split(), f"{path}, line {number}"))
    if not rows:
        raise ValueError(f"{path} must hold at least one match, but it is empty")
    table = np.array(rows)
    x1, x2 = np.ascontiguousarray(table[:, :2]), np.ascontiguousarray(table[:, 2:4])
    return MatchTable(path.stem, x1, x2, table[:, 4].astype(np.int64))


def _row(words: list[str], where: str) -> list[float]:
    """Return x1, y1, x2, y2 and label of a row of a table."""
    used = {7: (0, 1, 3, 4, 6), 9: (0, 1, 2, 3, 8)}.get(len(words), ())
    try:
        values = [float(words[k]) for k in used]
        ones = [float(words[k]) for k in (2, 5)] if len(words) == 7 else []
    except ValueError:
        values, ones = [], []
    if not values or not np.isfinite(values).all() or values[-1] % 1 or any(one != 1.0 for one in ones):
        raise ValueError(
            f"{where} must be 'x1 y1 1 x2 y2 1 label' or 'x1 y1 x2 y2 ratio1 ratio2 detector descriptor label', "
            f"but it is {' '.join(words)[:60]!r}"
        )
    return values


def load_mat(file: str | Path) -> MatchTable:
    """Read a MATLAB 5 file of the authors of A*-NAPA-DIBP: a struct ``data`` with ``matches`` (X1, X2, im1, im2).

    X1 and X2 are homogeneous points in pixels, 3 x N; the images may be absent.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no such file; the message says what is missing.
    """
    from scipy.io import loadmat  # noqa: PLC0415  (imported for this alone)
    from scipy.io.matlab import MatReadError  # noqa: PLC0415

    path = Path(file)
    try:
        content = loadmat(str(path), appendmat=False, squeeze_me=True, struct_as_record=False)
    except (ValueError, TypeError, NotImplementedError, MatReadError, EOFError) as error:
        raise ValueError(f"{path} must be a MATLAB 5 file, but it cannot be read: {error}") from None
    matches: Any = getattr(content.get("data"), "matches", None)
    if not hasattr(matches, "X1") or not hasattr(matches, "X2"):
        raise ValueError(f"{path} must hold a struct 'data' with 'matches.X1' and 'matches.X2', but it holds none")
    x1, x2 = _inhomogeneous(matches.X1, f"{path}: X1"), _inhomogeneous(matches.X2, f"{path}: X2")
    if x1.shape != x2.shape:
        raise ValueError(f"{path} must hold as many points in X2 as in X1, {len(x1)}, but it holds {len(x2)}")
    images = [_grey(getattr(matches, name, None)) for name in ("im1", "im2")]
    return MatchTable(path.stem, x1, x2, None, *images)


def _inhomogeneous(value: Any, name: str) -> NDArray[np.float64]:
    X = np.asarray(value, dtype=np.float64)
    if X.ndim != 2 or X.shape[0] != 3 or not np.isfinite(X).all() or not X[2].all():
        raise ValueError(f"{name} must be finite homogeneous points, 3 x N, but its shape is {X.shape}")
    return np.ascontiguousarray((X[:2] / X[2]).T)


def _grey(image: Any) -> NDArray[np.uint8] | None:
    """Return an image as grey levels 0 to 255; the files hold them as 0 to 1, or as 0 to 255, with 1 or 3 channels."""
    if image is None or np.ndim(image) not in (2, 3):
        return None
    levels = np.asarray(image, dtype=np.float64)
    if levels.ndim == 3:
        levels = levels.mean(axis=2)
    if levels.max() <= 1.0:
        levels = 255.0 * levels
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)
