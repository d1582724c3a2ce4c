"""Made scenes: reproducible, with the truth about every match told right."""

import numpy as np
import pytest

from maxcon.datasets import synthetic_two_view
from maxcon.datasets.cameras import (
    camera_matrix,
    epipolar_rows,
    fundamental_from_cameras,
    hartley_transform,
    project,
    transformed,
)
from maxcon.datasets.two_view_scene import CUT, IMAGE_SIZE, NOISE, normalised_residuals, surface_points


def homogeneous(x):
    return np.column_stack([x, np.ones(len(x))])


@pytest.mark.parametrize("rate", [0.0, 0.1, 0.37, 0.5, 0.9, 1.0])
def test_labels_are_right_and_the_threshold_tells_them_apart(rate):
    rng = np.random.default_rng(0)
    for _ in range(40):
        scene = synthetic_two_view(100, rate, rng)
        assert scene.inlier_mask.sum() == 100 - round(100 * rate)
        residuals = normalised_residuals(scene.F, scene.x1, scene.x2)
        np.testing.assert_array_equal(residuals <= 0.1, scene.inlier_mask)


def test_residuals_are_the_bilinear_form_of_the_normalised_matrix():
    scene = synthetic_two_view(30, 0.5, np.random.default_rng(1))
    T1, T2 = hartley_transform(scene.x1), hartley_transform(scene.x2)
    F = np.linalg.inv(T2).T @ scene.F @ np.linalg.inv(T1)
    F /= np.linalg.norm(F)
    h1, h2 = homogeneous(scene.x1) @ T1.T, homogeneous(scene.x2) @ T2.T
    expected = [abs(q @ F @ p) for p, q in zip(h1, h2, strict=True)]
    np.testing.assert_allclose(normalised_residuals(scene.F, scene.x1, scene.x2), expected, rtol=1e-9)
    rows = epipolar_rows(transformed(T1, scene.x1), transformed(T2, scene.x2))
    np.testing.assert_allclose(np.abs(rows @ F.ravel()), expected, rtol=1e-9)


def test_without_noise_inliers_fulfil_the_epipolar_constraint():
    rng = np.random.default_rng(2)
    for _ in range(20):
        scene = synthetic_two_view(50, 0.3, rng, noise=0.0)
        error = np.einsum("ni,ij,nj->n", homogeneous(scene.x2), scene.F, homogeneous(scene.x1))
        line = homogeneous(scene.x1) @ scene.F.T
        distance = np.abs(error) / np.hypot(line[:, 0], line[:, 1])
        assert distance[scene.inlier_mask].max() < 1e-8
        assert np.linalg.norm(scene.F) == pytest.approx(1.0)
        assert np.linalg.svd(scene.F, compute_uv=False)[2] < 1e-12


def test_inliers_are_images_of_points_with_cut_noise():
    """Triangulated from the noise-free views, the points are where both cameras see them."""
    exact = synthetic_two_view(200, 0.0, np.random.default_rng(3), noise=0.0)
    noisy = synthetic_two_view(200, 0.0, np.random.default_rng(3))
    for first, second in ((exact.x1, noisy.x1), (exact.x2, noisy.x2)):
        move = second - first
        assert np.abs(move).max() <= CUT * NOISE + 1e-9
        assert move.std() == pytest.approx(NOISE, rel=0.1)
    for p, q in zip(exact.x1, exact.x2, strict=True):
        M = np.vstack([x[k] * P[2] - P[k] for x, P in ((p, exact.P1), (q, exact.P2)) for k in range(2)])
        X = np.linalg.svd(M)[2][-1]
        X = X[:3] / X[3]
        assert np.linalg.norm(X) <= 1.0 + 1e-6
        np.testing.assert_allclose(project(exact.P1, X[None])[0], p, atol=1e-6)
        np.testing.assert_allclose(project(exact.P2, X[None])[0], q, atol=1e-6)
        assert (exact.P1 @ [*X, 1.0])[2] > 0  # before both cameras
        assert (exact.P2 @ [*X, 1.0])[2] > 0


def test_all_points_lie_in_the_images():
    rng = np.random.default_rng(4)
    for _ in range(200):
        scene = synthetic_two_view(100, 0.3, rng)
        for x, margin in ((scene.x1, CUT), (scene.x2, CUT)):
            assert (x >= -margin).all()
            assert (x <= np.array(IMAGE_SIZE) + margin).all()


def test_focal_lengths_and_poses_differ():
    rng = np.random.default_rng(5)
    focals, angles = [], []
    for _ in range(50):
        scene = synthetic_two_view(9, 0.0, rng)
        rotations = []
        for P in (scene.P1, scene.P2):
            R = np.linalg.solve(camera_matrix(1.0, np.zeros(2), np.eye(3), np.zeros(3))[:, :3], P[:, :3])
            focal = np.linalg.norm(np.cross(P[0, :3], P[2, :3]))
            rotations.append(P[:, :3])
            focals.append(focal)
            assert R.shape == (3, 3)
        axis1, axis2 = (M[2] / np.linalg.norm(M[2]) for M in rotations)
        angles.append(np.degrees(np.arccos(np.clip(axis1 @ axis2, -1, 1))))
    focals = np.array(focals).reshape(-1, 2)
    assert np.abs(np.diff(np.log(focals), axis=1)).mean() > 0.15
    assert min(angles) > 3.0
    assert max(angles) < 60.0


def test_the_surface_is_no_plane_and_fills_the_unit_ball():
    rng = np.random.default_rng(6)
    for _ in range(100):
        points = surface_points(100, rng)
        size = np.linalg.norm(points, axis=1)
        assert size.max() == pytest.approx(1.0)
        np.testing.assert_allclose(points.mean(axis=0), 0.0, atol=1e-12)
        assert np.linalg.svd(points, compute_uv=False)[2] > 0.5


def test_matches_determine_f_well():
    """The second smallest singular value of the rows of the inliers stays away from 0: the scene is not degenerate."""
    rng = np.random.default_rng(7)
    second = []
    for _ in range(200):
        scene = synthetic_two_view(100, 0.0, rng)
        rows = epipolar_rows(*(transformed(hartley_transform(points), points) for points in (scene.x1, scene.x2)))
        values = np.linalg.svd(rows, compute_uv=False) / 10.0
        second.append(values[-2] / values[-1])
    assert np.median(second) > 5.0


def test_equal_generators_give_equal_scenes():
    first, second, third = (synthetic_two_view(50, 0.4, np.random.default_rng(seed)) for seed in (8, 8, 9))
    for name in ("x1", "x2", "inlier_mask", "F", "P1", "P2"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    assert not np.array_equal(first.x1, third.x1)


def test_outliers_near_an_epipole_are_no_trouble():
    """With seed 367 an epipole lies amid the object, where no point of image 2 alone would make an outlier."""
    for seed in (*range(30), 367):
        scene = synthetic_two_view(1000, 0.5, np.random.default_rng(seed))
        residuals = normalised_residuals(scene.F, scene.x1, scene.x2)
        np.testing.assert_array_equal(residuals <= 0.1, scene.inlier_mask)
    epipole = np.linalg.svd(scene.F)[2][2]
    assert np.linalg.norm(scene.x1 - epipole[:2] / epipole[2], axis=1).min() < 20.0


@pytest.mark.parametrize(("noise", "threshold"), [(30.0, 0.1), (1e6, 0.1), (1.0, 1e-3), (1.0, 1e-9)])
def test_much_noise_is_halved_until_the_inliers_obey(noise, threshold):
    scene = synthetic_two_view(60, 0.5, np.random.default_rng(10), noise=noise, threshold=threshold)
    residuals = normalised_residuals(scene.F, scene.x1, scene.x2)
    np.testing.assert_array_equal(residuals <= threshold, scene.inlier_mask)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n_points": 8}, "n_points must be at least 9, but it is 8"),
        ({"outlier_rate": 1.1}, "outlier_rate must be between 0 and 1, but it is 1.1"),
        ({"outlier_rate": float("nan")}, "outlier_rate must be between 0 and 1, but it is nan"),
        ({"noise": -1.0}, "noise must be at least 0 and finite, but it is -1.0"),
        ({"threshold": 0.0}, "threshold must be above 0 and at most 0.2"),
        ({"threshold": 0.5}, "threshold must be above 0 and at most 0.2"),
    ],
)
def test_errors_name_the_argument(change, message):
    arguments = {"n_points": 20, "outlier_rate": 0.2, "rng": np.random.default_rng(0)} | change
    with pytest.raises(ValueError, match=message):
        synthetic_two_view(**arguments)


def test_cameras_at_one_place_have_no_fundamental_matrix():
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    P1 = camera_matrix(500.0, np.array([320.0, 240.0]), np.eye(3), np.array([1.0, 2.0, 3.0]))
    P2 = camera_matrix(600.0, np.array([320.0, 240.0]), R, R @ [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="the two cameras must have different centres"):
        fundamental_from_cameras(P1, P2)
