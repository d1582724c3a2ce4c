"""Distances of matches from the epipolar geometry of a fundamental matrix, in pixels, and its rank."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maxcon.problem.validate import check_array, check_number


def check_points(value: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return image points as an array of shape (N, 2).

    Raises
    ------
    TypeError, ValueError
        If they are no finite real numbers of that shape; the message names the argument.
    """
    points = check_array(value, name, 2)
    if points.shape[1] != 2:
        raise ValueError(f"{name} must have shape (N, 2), a row (x, y) a point, but its shape is {points.shape}")
    return points


def check_matches(x1: ArrayLike, x2: ArrayLike, least: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return matches as two arrays of shape (N, 2), N >= `least`; TypeError or ValueError otherwise.

    OpenCV's points, of shape (N, 1, 2), are taken as well.
    """
    first, second = check_points(_flat(x1), "x1"), check_points(_flat(x2), "x2")
    if first.shape != second.shape:
        raise ValueError(
            f"x2 must have one row for each row of x1, shape {first.shape}, but its shape is {second.shape}"
        )
    if len(first) < least:
        raise ValueError(f"x1 and x2 must hold at least {least} matches, but they hold {len(first)}")
    return first, second


def _flat(points: Any) -> Any:
    """Return points of shape (N, 1, 2) as of shape (N, 2), and anything else as it is."""
    shape = np.shape(points) if isinstance(points, (np.ndarray, list, tuple)) and len(points) > 0 else ()
    return np.asarray(points)[:, 0] if len(shape) == 3 and shape[1:] == (1, 2) else points


def check_matrix(value: ArrayLike, name: str = "F") -> NDArray[np.float64]:
    """Return a 3x3 matrix that is not zero; TypeError or ValueError otherwise."""
    F = check_array(value, name, 2)
    if F.shape != (3, 3):
        raise ValueError(f"{name} must have shape (3, 3), but its shape is {F.shape}")
    if not F.any():
        raise ValueError(f"{name} must not be zero, but all of its entries are")
    return F


def check_pixels(value: Any) -> float:
    """Return a threshold in pixels as a float; TypeError or ValueError if it is no positive finite number."""
    pixels = check_number(value, "pixels")
    if not (pixels > 0 and math.isfinite(pixels)):
        raise ValueError(f"pixels must be a positive finite number, but it is {pixels}")
    return pixels


def sampson_distances(F: ArrayLike, x1: ArrayLike, x2: ArrayLike) -> NDArray[np.float64]:
    """Return each match's first-order distance from the epipolar constraint.

    With ``l2 = F [x1, 1]`` and ``l1 = F^T [x2, 1]`` this is
    ``|[x2, 1] . l2| / sqrt(l1[0]^2 + l1[1]^2 + l2[0]^2 + l2[1]^2)``, the square root of equation 11.9 of Hartley and
    Zisserman, 2nd edition: how far the two points of the match must move, together, to fulfil the
    constraint, to first order.

    Parameters
    ----------
    F
        Shape (3, 3), of any scale: from image 1 to image 2, in pixels.
    x1, x2
        Shape (N, 2) each, pixels.

    Returns
    -------
    numpy.ndarray
        Shape (N,), in pixels. A match of both epipoles has the distance 0.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of this kind; the message names it.
    """
    error, l1, l2 = _lines(F, x1, x2)
    steep = np.sqrt(l1 + l2)
    return np.divide(np.abs(error), steep, out=np.zeros_like(error), where=steep > 0)


def symmetric_epipolar_distances(F: ArrayLike, x1: ArrayLike, x2: ArrayLike) -> NDArray[np.float64]:
    """Return ``sqrt(d1^2 + d2^2)``: each match's distances from its two epipolar lines, together.

    d2 is the distance of x2 from the line of x1 in image 2, d1 that of x1 from the line of x2 in image 1: the square
    root of equation 11.10 of Hartley and Zisserman, 2nd edition.

    Parameters
    ----------
    F
        Shape (3, 3), of any scale: from image 1 to image 2, in pixels.
    x1, x2
        Shape (N, 2) each, pixels.

    Returns
    -------
    numpy.ndarray
        Shape (N,), in pixels. It is infinite where one point is an epipole, which has no line, and the other point
        does not make up for it.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of this kind; the message names it.
    """
    error, l1, l2 = _lines(F, x1, x2)
    error = np.abs(error)
    without = np.where(error > 0, np.inf, 0.0)
    d1 = np.divide(error, np.sqrt(l1), out=without.copy(), where=l1 > 0)
    d2 = np.divide(error, np.sqrt(l2), out=without.copy(), where=l2 > 0)
    return np.hypot(d1, d2)


def enforce_rank_two(F: ArrayLike) -> NDArray[np.float64]:
    """Return the matrix of rank 2 (or less) that is nearest to `F` in Frobenius norm, shape (3, 3).

    A fundamental matrix has rank 2; its linear fit in general has rank 3. "Nearest" depends on the coordinates, so
    `find_fundamental` does this in normalised ones.

    Raises
    ------
    TypeError, ValueError
        If `F` is not a finite 3x3 matrix, or zero.
    """
    U, s, Vt = np.linalg.svd(check_matrix(F))
    nearest: NDArray[np.float64] = (U[:, :2] * s[:2]) @ Vt[:2]
    return nearest


def _lines(
    F: ArrayLike, x1: ArrayLike, x2: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return x2 . F x1, and of the epipolar lines in image 1 and in image 2 the squared length of the normal."""
    matrix = check_matrix(F)
    first, second = check_matches(x1, x2, 1)
    matrix = matrix / np.abs(matrix).max()
    ones = np.ones((len(first), 1))
    lines2 = np.hstack([first, ones]) @ matrix.T
    lines1 = np.hstack([second, ones]) @ matrix
    error = (lines2[:, :2] * second).sum(axis=1) + lines2[:, 2]
    return error, (lines1[:, :2] ** 2).sum(axis=1), (lines2[:, :2] ** 2).sum(axis=1)
