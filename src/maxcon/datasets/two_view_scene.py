"""Two views of a made scene, for want of ModelNet40: the paper's protocol (section 4.2) on shapes of our own.

To the letter: points on the surface of an object are projected on two image planes with different focal lengths
and extrinsics; N = 100 matches, 10-50% of them outliers; threshold 0.1. What the paper leaves open is
chosen here:

- *Object*: 2 to 5 boxes, ellipsoids, cylinders and cones of random size, pose and place, scaled into the unit ball
  about their centroid. Points are spread evenly over the parameters of each surface. Nothing is hidden:
  a point that its object covers is seen all the same, as in a point cloud.
- *Cameras*: 640 x 480 pixels, principal point in the middle, square pixels. The first looks at the object from a
  random direction, 2 to 4 units away; the second from 10 to 50 degrees aside, 2 to 4 units away, so that the two
  differ in scale too. Each is aimed up to 0.1 units beside the centre and rolled: by any angle the first, by up
  to 15 degrees more the second. The unit ball fills 60 to 95% of the image's height, which sets the focal lengths.
- *Noise*: all points are moved by Gaussian noise of 1 pixel in each coordinate, cut at 3. The inliers obey the
  threshold: the algebraic residual under the true F, scaled to unit norm in Hartley-normalised coordinates, is at
  most 0.1. Where one is above, the noise of the instance is halved until none is (rare at 0.1: with 1 pixel the
  largest of 50 is about 0.03). A chart that scales F otherwise, as F32 = 1 does, has larger residuals.
- *Outliers*: ``round(rate * N)`` matches, chosen at random; their point in image 2 is replaced by one uniform over
  the image, drawn again while its residual is at most the threshold. As in the protocol for lines, an outlier is so
  an outlier of the truth. Near an epipole every point of image 2 is within the threshold: after 10 draws the point
  in image 1 is drawn from the whole image, too.
- *Normalisation*: of all points, outliers included, since a fit knows no better.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maxcon.datasets.cameras import (
    camera_matrix,
    epipolar_rows,
    fundamental_from_cameras,
    hartley_transform,
    project,
    transformed,
)

#: The inlier threshold of the protocol: algebraic, in Hartley-normalised coordinates.
THRESHOLD = 0.1

#: Width and height of both images, pixels.
IMAGE_SIZE = (640, 480)

#: The standard deviation of an inlier's noise in each coordinate, pixels, and where it is cut, in deviations.
NOISE, CUT = 1.0, 3.0

_DISTANCES = (2.0, 4.0)
_ASIDE = (np.radians(10.0), np.radians(50.0))
_ROLL = np.radians(15.0)
_AIM = 0.1
_FILL = (0.60, 0.95)

#: How often noise is halved before there is none, and how often outliers are drawn again before it is given up.
_HALVINGS, _DRAWS = 30, 200

#: Draws after which an outlier's point in image 1 is drawn, too.
_PATIENCE = 10


@dataclass(frozen=True, eq=False)
class TwoViewScene:
    """Matches between two images of a scene, with the truth about them.

    Attributes
    ----------
    x1, x2
        Shape (N, 2): the matched points in image 1 and image 2, pixels.
    inlier_mask
        Shape (N,), bool: which matches are images of the same point.
    F
        Shape (3, 3): the true fundamental matrix, unit Frobenius norm, ``[x2, 1] @ F @ [x1, 1]`` = 0.
    P1, P2
        Shape (3, 4): the cameras.
    image_size
        Width and height of both images, pixels.
    """

    x1: NDArray[np.float64]
    x2: NDArray[np.float64]
    inlier_mask: NDArray[np.bool_]
    F: NDArray[np.float64]
    P1: NDArray[np.float64]
    P2: NDArray[np.float64]
    image_size: tuple[int, int]


def synthetic_two_view(
    n_points: int,
    outlier_rate: float,
    rng: np.random.Generator,
    *,
    noise: float = NOISE,
    threshold: float = THRESHOLD,
) -> TwoViewScene:
    """Return the matches of two random views of a random object; the module's text says how all is chosen.

    Parameters
    ----------
    n_points
        How many matches (N), at least 9.
    outlier_rate
        The part of the matches that are outliers, 0 to 1.
    rng
        Draws everything.
    noise
        The standard deviation of an inlier's noise in each coordinate, pixels; 0 for none.
    threshold
        Keeps inliers and outliers apart (see the module's text): algebraic, normalised, f of unit norm.

    Raises
    ------
    ValueError
        If a number is out of its range; the message names it.
    """
    check_scene(n_points, outlier_rate, noise, threshold)
    return view_points(surface_points(n_points, rng), outlier_rate, rng, noise=noise, threshold=threshold)


def check_scene(n_points: Any, outlier_rate: Any, noise: Any, threshold: Any) -> None:
    """Raise a ValueError that names what is out of its range."""
    if n_points < 9:
        raise ValueError(f"n_points must be at least 9, but it is {n_points}")
    if not 0.0 <= outlier_rate <= 1.0:
        raise ValueError(f"outlier_rate must be between 0 and 1, but it is {outlier_rate}")
    if not 0.0 <= noise < np.inf:
        raise ValueError(f"noise must be at least 0 and finite, but it is {noise}")
    if not 0.0 < threshold <= 0.2:
        raise ValueError(
            f"threshold must be above 0 and at most 0.2, beyond which few matches are outliers, but it is {threshold}"
        )


def view_points(
    points: NDArray[np.float64],
    outlier_rate: float,
    rng: np.random.Generator,
    *,
    noise: float = NOISE,
    threshold: float = THRESHOLD,
) -> TwoViewScene:
    """Return the matches of two random views of `points`, shape (N, 3), which lie in the unit ball."""
    P1, P2 = _two_cameras(rng)
    F = fundamental_from_cameras(P1, P2)
    n_points = len(points)
    inlier = np.ones(n_points, dtype=np.bool_)
    inlier[rng.permutation(n_points)[: round(outlier_rate * n_points)]] = False
    outlier = np.flatnonzero(~inlier)

    exact = np.hstack([project(P1, points), project(P2, points)])
    moved = np.clip(rng.standard_normal((n_points, 4)), -CUT, CUT) * noise
    x = exact + moved
    x[outlier, 2:] = rng.uniform((0.0, 0.0), IMAGE_SIZE, (len(outlier), 2))
    halvings = 0
    freed = np.zeros(n_points, dtype=np.bool_)  # outliers that keep no point of the object
    for draw in range(_HALVINGS + _DRAWS):
        within = normalised_residuals(F, x[:, :2], x[:, 2:]) <= threshold
        wrong = outlier[within[outlier]]
        noisy = not within[inlier].all()
        if not noisy and len(wrong) == 0:
            return TwoViewScene(
                np.ascontiguousarray(x[:, :2]), np.ascontiguousarray(x[:, 2:]), inlier, F, P1, P2, IMAGE_SIZE
            )
        if noisy:
            halvings += 1
            moved *= 0.5 if halvings < _HALVINGS else 0.0
            x[~freed, :2] = exact[~freed, :2] + moved[~freed, :2]
            x[inlier, 2:] = exact[inlier, 2:] + moved[inlier, 2:]
        x[wrong, 2:] = rng.uniform((0.0, 0.0), IMAGE_SIZE, (len(wrong), 2))
        if draw >= _PATIENCE:
            freed[wrong] = True
            x[wrong, :2] = rng.uniform((0.0, 0.0), IMAGE_SIZE, (len(wrong), 2))
    raise ArithmeticError(
        f"{_HALVINGS + _DRAWS} draws found no matches of these views that the threshold {threshold} tells apart"
    )


def normalised_residuals(
    F: NDArray[np.float64], x1: NDArray[np.float64], x2: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return ``|phi . f|``, shape (N,), f the `F` of pixels in Hartley-normalised coordinates, scaled to unit norm."""
    T1, T2 = hartley_transform(x1, "x1"), hartley_transform(x2, "x2")
    normalised = np.linalg.inv(T2).T @ F @ np.linalg.inv(T1)
    normalised /= np.sqrt((normalised**2).sum())
    return np.abs(epipolar_rows(transformed(T1, x1), transformed(T2, x2)) @ normalised.ravel())


def surface_points(n_points: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return points on 2 to 5 random shapes, shape (N, 3), in the unit ball about their centroid."""
    n_shapes = int(rng.integers(2, 6))
    kind = rng.integers(0, 4, n_shapes)
    half = rng.uniform(0.2, 1.0, (n_shapes, 3))
    place = rng.uniform(-1.0, 1.0, (n_shapes, 3))
    turn = _rotations(rng.standard_normal((n_shapes, 4)))
    shape = rng.integers(0, n_shapes, n_points)
    local = _on_unit_shape(kind[shape], rng.random((n_points, 3))) * half[shape]
    points = np.einsum("nij,nj->ni", turn[shape], local) + place[shape]
    return into_unit_ball(points)


def into_unit_ball(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `points`, shape (N, 3), with their centroid at 0 and the farthest from it at distance 1."""
    centred = points - points.mean(axis=0)
    radius = float(np.sqrt((centred**2).sum(axis=1).max()))
    scaled: NDArray[np.float64] = centred / radius
    return scaled


def _on_unit_shape(kind: NDArray[np.int64], u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a point on a box (kind 0), a sphere (1), a cylinder (2) or a cone (3) for each u in [0, 1)^3.

    All fill [-1, 1]^3. Cylinder and cone are open at their ends; the cone's tip is at z = 1.
    """
    angle = 2.0 * np.pi * u[:, 0]
    z = 2.0 * u[:, 1] - 1.0
    width = np.where(kind == 1, np.sqrt(1.0 - z * z), np.where(kind == 3, 0.5 * (1.0 - z), 1.0))
    points = np.column_stack([width * np.cos(angle), width * np.sin(angle), z])
    box = np.flatnonzero(kind == 0)
    face = (6.0 * u[box, 2]).astype(np.int64)
    flat = 2.0 * u[box] - 1.0
    flat[np.arange(len(box)), face % 3] = np.where(face < 3, -1.0, 1.0)
    free = 6.0 * u[box, 2] - face  # the third number chose the face; what is left of it is uniform again
    third = np.flatnonzero(face % 3 != 2)
    flat[third, 2] = 2.0 * free[third] - 1.0
    points[box] = flat
    return points


def _rotations(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rotation matrices, shape (k, 3, 3), of quaternions of any length, shape (k, 4)."""
    w, x, y, z = (q / np.sqrt((q**2).sum(axis=1, keepdims=True))).T
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)


def _two_cameras(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return two cameras that look at the unit ball from different places with different focal lengths."""
    axes = _rotations(rng.standard_normal((1, 4)))[0]
    aside = rng.uniform(*_ASIDE)
    distance = rng.uniform(*_DISTANCES, 2)
    fill = rng.uniform(*_FILL, 2)
    aim = rng.uniform(-_AIM, _AIM, (2, 3))
    roll = rng.uniform((-np.pi, -_ROLL), (np.pi, _ROLL))
    # Both look from the plane of the first two axes, so that the second is `aside` from the first in any direction.
    towards = (axes[0], np.cos(aside) * axes[0] + np.sin(aside) * axes[1])
    first = _camera(towards[0], axes[2], distance[0], fill[0], aim[0], roll[0])
    second = _camera(towards[1], axes[2], distance[1], fill[1], aim[1], roll[0] + roll[1])
    return first, second


def _camera(
    towards: NDArray[np.float64],
    up: NDArray[np.float64],
    distance: float,
    fill: float,
    aim: NDArray[np.float64],
    roll: float,
) -> NDArray[np.float64]:
    """Return a camera at ``distance * towards`` that looks at `aim`, turned by `roll` from `up`."""
    position = distance * towards
    forward = aim - position
    forward /= np.sqrt(forward @ forward)
    right = np.array(
        [
            up[1] * forward[2] - up[2] * forward[1],
            up[2] * forward[0] - up[0] * forward[2],
            up[0] * forward[1] - up[1] * forward[0],
        ]
    )
    right /= np.sqrt(right @ right)
    down = np.array(
        [
            forward[1] * right[2] - forward[2] * right[1],
            forward[2] * right[0] - forward[0] * right[2],
            forward[0] * right[1] - forward[1] * right[0],
        ]
    )
    R = np.array([np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right, forward])
    # A ball of radius 1 + the miss of the aim, seen from so far, must not stick out of the image.
    focal = fill * 0.5 * IMAGE_SIZE[1] * np.sqrt(distance**2 - 1.0) / (1.0 + _AIM)
    centre = 0.5 * np.array(IMAGE_SIZE, dtype=np.float64)
    return camera_matrix(float(focal), centre, R, -R @ position)
