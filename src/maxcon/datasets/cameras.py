"""Pinhole cameras, the fundamental matrix between two of them, and Hartley's normalisation of image points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: A set of points narrower than this part of its distance from the origin holds nothing but rounding.
_NARROWEST = 1e-10


def camera_matrix(
    focal: float, centre: NDArray[np.float64], R: NDArray[np.float64], t: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return ``K [R | t]``, shape (3, 4), of a camera with square pixels.

    Parameters
    ----------
    focal
        In pixels.
    centre
        The principal point, shape (2,), in pixels.
    R, t
        Shapes (3, 3) and (3,): a point X of the world is ``R @ X + t`` before the camera.
    """
    K = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    return K @ np.column_stack([R, t])


def project(P: NDArray[np.float64], X: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the image points, shape (N, 2), of the points `X`, shape (N, 3), under camera `P`, shape (3, 4)."""
    x = X @ P[:, :3].T + P[:, 3]
    image: NDArray[np.float64] = x[:, :2] / x[:, 2:]
    return image


def cross_matrix(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix of ``w -> v x w``, shape (3, 3)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def fundamental_from_cameras(P1: NDArray[np.float64], P2: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return F of unit Frobenius norm with ``[x2, 1] @ F @ [x1, 1] == 0`` for images of the same point.

    Hartley and Zisserman, Multiple View Geometry, 2nd edition, equation 9.1: ``[e2]_x P2 P1^+``, here for two finite
    cameras.

    Raises
    ------
    ValueError
        If both cameras have the same centre: there is no fundamental matrix then.
    """
    centre = -np.linalg.solve(P1[:, :3], P1[:, 3])
    epipole = P2[:, :3] @ centre + P2[:, 3]
    size = float(np.linalg.norm(P2[:, :3] @ centre) + np.linalg.norm(P2[:, 3]))
    if not np.linalg.norm(epipole) > 1e-12 * size:
        raise ValueError("the two cameras must have different centres, but they coincide")
    # Through the plane at infinity, whose homography is P2[:, :3] @ inv(P1[:, :3]).
    F = cross_matrix(epipole / np.linalg.norm(epipole)) @ P2[:, :3] @ np.linalg.inv(P1[:, :3])
    unit: NDArray[np.float64] = F / np.linalg.norm(F)
    return unit


def hartley_transform(points: NDArray[np.float64], name: str = "points") -> NDArray[np.float64]:
    """Return T, shape (3, 3), such that ``T @ [x, y, 1]`` has its centroid at 0 and mean distance sqrt(2) from it.

    Hartley (1997), "In defense of the eight-point algorithm", with one scale for both axes. All points count,
    outliers as well.

    Parameters
    ----------
    points
        Shape (N, 2).
    name
        What errors call them.

    Raises
    ------
    ValueError
        If the points coincide: no scale makes their mean distance sqrt(2).
    """
    centroid = points.mean(axis=0)
    spread = float(np.hypot(points[:, 0] - centroid[0], points[:, 1] - centroid[1]).mean())
    if not np.isfinite(spread) or not spread > _NARROWEST * float(np.abs(centroid).max()):
        raise ValueError(
            f"{name} must be points of an image apart from each other, but their mean distance from their "
            f"centroid ({centroid[0]:g}, {centroid[1]:g}) is {spread:g}"
        )
    scale = np.sqrt(2.0) / spread
    return np.array([[scale, 0.0, -scale * centroid[0]], [0.0, scale, -scale * centroid[1]], [0.0, 0.0, 1.0]])


def transformed(T: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `points`, shape (N, 2), under a transform T of `hartley_transform`."""
    moved: NDArray[np.float64] = points * T[0, 0] + T[:2, 2]
    return moved


def epipolar_rows(u1: NDArray[np.float64], u2: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rows ``[x'x, x'y, x', y'x, y'y, y', x, y, 1]``, shape (N, 9).

    (x, y) are the points `u1` of image 1 and (x', y') those of image 2, `u2`, shape (N, 2) each. The product of a row
    with ``F.ravel()`` is ``[x', y', 1] @ F @ [x, y, 1]``.
    """
    rows = np.empty((len(u1), 9))
    rows[:, 6:8] = u1
    rows[:, 8] = 1.0
    rows[:, 0:3] = u2[:, :1] * rows[:, 6:9]
    rows[:, 3:6] = u2[:, 1:] * rows[:, 6:9]
    return rows
