"""Whether the inliers determine F: scenes of a plane and of a camera that only turns, against general ones."""

import numpy as np
import pytest

from maxcon.vision import find_fundamental, match_images, read_image
from maxcon.vision.degeneracy import degeneracy
from real_data import real_data

K = np.array([[700.0, 0.0, 600.0], [0.0, 700.0, 200.0], [0.0, 0.0, 1.0]])
TURN = np.array([[np.cos(0.1), 0.0, np.sin(0.1)], [0.0, 1.0, 0.0], [-np.sin(0.1), 0.0, np.cos(0.1)]])
STEP = np.array([0.5, 0.1, 0.3])


def views(points, step, noise, rng, n_outliers=40):
    """Return the matches of two views of points, shape (n, 3), and of so many outliers after them."""
    seen = []
    for moved in (points, points @ TURN.T + step):
        image = moved @ K.T
        x = image[:, :2] / image[:, 2:] + noise * rng.standard_normal((len(points), 2))
        seen.append(np.vstack([x, rng.uniform(0, 1000, (n_outliers, 2))]))
    return seen


def room(n_points, rng):
    return np.column_stack([rng.uniform(-4, 4, (n_points, 2)), rng.uniform(4, 20, n_points)])


def wall(n_points, rng):
    points = room(n_points, rng)
    points[:, 2] = 10 + 0.3 * points[:, 0] + 0.2 * points[:, 1]
    return points


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_scenes(noise):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        found = find_fundamental(*views(room(200, rng), STEP, noise, rng), threshold=0.01)
        assert found.degeneracy.note is None
        for points, step in ((wall(200, rng), STEP), (room(200, rng), np.zeros(3))):
            found = find_fundamental(*views(points, step, noise, rng), threshold=0.01)
            assert found.degeneracy.on_homography >= 190
            others = found.n_inliers - found.degeneracy.on_homography
            note = f"{found.degeneracy.on_homography} of the {found.n_inliers} inliers"
            assert note in found.degeneracy.note
            assert f"F rests on the other {others}" in found.degeneracy.note


@pytest.mark.parametrize("chart", ["auto", "F32=1"])
def test_the_same_image(chart):
    x = np.random.default_rng(0).uniform(0, 1000, (50, 2))
    found = find_fundamental(x, x, threshold=0.01, chart=chart)
    assert (found.degeneracy.n_inliers, found.degeneracy.on_homography, found.degeneracy.null_space) == (50, 50, 3)
    assert "they do not determine F" in found.degeneracy.note


def test_a_matrix_far_from_the_inliers_makes_no_homography_of_them():
    """Nor is one without numbers of any account."""
    rng = np.random.default_rng(0)
    found = find_fundamental(*views(room(200, rng), STEP, 0.5, rng), threshold=0.01)
    far = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 300.0]])  # rows of one image 300 pixels off
    assert degeneracy(found.problem, found.inlier_mask, [far]).note is not None
    for matrices in ([far, found.F_linear], [np.full((3, 3), np.nan), found.F]):
        judged = degeneracy(found.problem, found.inlier_mask, matrices)
        assert judged.note is None
        assert judged.on_homography < 0.5 * found.n_inliers


def test_the_same_image_without_a_matrix():
    """Where nothing of rank 2 was met there are no distances to judge by."""
    x = np.random.default_rng(0).uniform(0, 1000, (50, 2))
    found = find_fundamental(x, x, threshold=0.01)
    assert degeneracy(found.problem, found.inlier_mask, [np.full((3, 3), np.nan)]).on_homography == 50


def test_few_different_matches():
    """Seven matches, each many times: two independent F explain them, but no homography."""
    rng = np.random.default_rng(0)
    x1, x2 = (np.repeat(x, 8, axis=0) for x in views(room(7, rng), STEP, 0.0, rng, 0))
    found = find_fundamental(x1, x2, threshold=1e-6)
    assert found.n_inliers == 56
    assert found.degeneracy.null_space == 2
    assert "2 independent ones explain them without error" in found.degeneracy.note


def test_few_inliers():
    rng = np.random.default_rng(0)
    found = find_fundamental(rng.uniform(0, 1000, (12, 2)), rng.uniform(0, 1000, (12, 2)), threshold=1e-9)
    assert found.n_inliers <= 8
    assert "inliers say nothing" in found.degeneracy.note


@pytest.mark.parametrize(("first", "second", "determined"), [(0, 3, True), (10, 11, True), (5, 5, False)])
def test_a_drive(first, second, determined):
    pytest.importorskip("cv2")
    images = (real_data("kitti", "sequences", "dev", "image_0", f"{k:06d}.png") for k in (first, second))
    matches = match_images(*map(read_image, images))
    found = find_fundamental(matches.x1, matches.x2, threshold=0.01)
    assert (found.degeneracy.note is None) == determined
