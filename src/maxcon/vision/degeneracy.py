"""Whether matches determine a fundamental matrix: those of one plane, or of a camera that only turned, do not."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from maxcon.vision.epipolar import sampson_distances
from maxcon.vision.fundamental import FundamentalProblem

#: From this share of the inliers on, one homography that explains them is worth a note.
NEARLY_ALL = 0.9

#: A homography explains a match whose transfer error is at most so many median Sampson distances: were the errors of
#: all coordinates normal and equal, 98% of the matches of a plane.
ERRORS = 6.0

#: Or, where the matches have no errors, this, in units of the mean distance of the points of image 2 to their centroid.
LEAST_ERROR = 1e-3

#: Random samples of four matches: where 90% are explained, all of so many have an outlier in one of 10^29 cases.
N_SAMPLES = 64

#: Directions of F with singular values below this, relative to the largest, are left open by the matches.
RANK_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Degeneracy:
    """How well the inliers determine F.

    Attributes
    ----------
    n_inliers
        The number of inliers.
    null_space
        The dimension of the space of all F, of any rank, that explain the inliers without error: 0 or 1 usually, above
        1 where they leave F open.
    on_homography
        How many inliers one homography explains, as far as found: all those on one plane, or all where the camera has
        only turned, or the images are the same.
    """

    n_inliers: int
    null_space: int
    on_homography: int

    @property
    def note(self) -> str | None:
        """What there is to say against F, in words; None if nothing."""
        if self.n_inliers <= 8:
            return f"any 8 matches have an F that explains them: {self.n_inliers} inliers say nothing"
        if self.on_homography >= NEARLY_ALL * self.n_inliers:
            others = self.n_inliers - self.on_homography
            return (
                f"one homography explains {self.on_homography} of the {self.n_inliers} inliers (points of one plane, a "
                "camera that only turned, or the same image): "
                + (f"F rests on the other {others}" if others else "they do not determine F")
            )
        if self.null_space > 1:
            return f"the inliers do not determine F: {self.null_space} independent ones explain them without error"
        return None


def degeneracy(
    posed: FundamentalProblem, inlier_mask: NDArray[np.bool_], matrices: Iterable[NDArray[np.float64]]
) -> Degeneracy:
    """Find out how well the inliers determine F.

    Parameters
    ----------
    posed
        The problem.
    inlier_mask
        Shape (N,), bool.
    matrices
        Fits of F, shape (3, 3) each, in pixels; those with NaN are passed over. The smallest of the inliers' median
        Sampson distances from them is taken as a measure of the errors of their coordinates: a matrix that is polished
        for other matches may be far from most inliers, and then any homography would do.

    Notes
    -----
    With more than 90% of the inliers on a plane, the F of the most inliers may well be wrong (Chum, Werner & Matas,
    Two-view geometry estimation unaffected by a dominant plane, CVPR 2005).
    """
    A, b = posed.problem.A[inlier_mask], posed.problem.b[inlier_mask]
    if len(A) <= 8:
        return Degeneracy(len(A), 9 - len(A), 0)
    # Back from the chart: the rows of the eight-point algorithm.
    rows = A @ posed.directions.T - np.outer(b, posed.base)
    sizes = np.linalg.svd(rows, compute_uv=False)
    open_directions = int(np.count_nonzero(sizes <= RANK_TOLERANCE * sizes[0]))
    to, of = rows[:, [2, 5]], rows[:, [6, 7]]  # the normalised points of image 2 and image 1
    x1, x2 = ((moved - T[:2, 2]) / T[0, 0] for T, moved in ((posed.T1, of), (posed.T2, to)))  # back to pixels
    medians = [np.median(sampson_distances(F, x1, x2)) for F in matrices if np.isfinite(F).all()]
    limit = max(ERRORS * min(medians, default=0.0) * posed.T2[0, 0], LEAST_ERROR * np.sqrt(2.0))
    return Degeneracy(len(A), open_directions, _most_explained(of, to, float(limit)))


def _most_explained(of: NDArray[np.float64], to: NDArray[np.float64], limit: float) -> int:
    """Return how many of the points `of` the best of many homographies takes to within `limit` of the points `to`."""
    ones = np.ones((len(of), 1))
    nothing = np.zeros((len(of), 3))
    first = np.hstack([of, ones])
    equations = np.stack(
        [np.hstack([first, nothing, -to[:, :1] * first]), np.hstack([nothing, first, -to[:, 1:] * first])], axis=1
    )
    rng = np.random.default_rng(0)
    samples = np.stack([rng.choice(len(of), 4, replace=False) for _ in range(N_SAMPLES)])
    close = _close(_homographies(equations[samples].reshape(N_SAMPLES, 8, 9)), first, to, limit)
    best = close[close.sum(axis=1).argmax()]
    for _ in range(5):  # again from all that it explains, as long as that gains
        if best.sum() < 4:
            break
        (again,) = _close(_homographies(equations[best].reshape(1, -1, 9)), first, to, limit)
        if again.sum() <= best.sum():
            break
        best = again
    return int(best.sum())


def _homographies(equations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the homographies of least error, shape (K, 3, 3), for equations of shape (K, rows, 9)."""
    matrices: NDArray[np.float64] = np.linalg.eigh(equations.transpose(0, 2, 1) @ equations)[1][:, :, 0]
    return matrices.reshape(-1, 3, 3)


def _close(
    homographies: NDArray[np.float64], first: NDArray[np.float64], to: NDArray[np.float64], limit: float
) -> NDArray[np.bool_]:
    """Return which points each homography takes to where they should be, shape (K, n)."""
    taken = np.einsum("kij,nj->kni", homographies, first)
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = np.linalg.norm(taken[:, :, :2] / taken[:, :, 2:] - to, axis=2)
        close: NDArray[np.bool_] = errors <= limit
    return close
