import math

import numpy as np
import pytest

from maxcon.datasets import synthetic_two_view
from maxcon.vision import enforce_rank_two, fundamental_problem, sampson_distances, symmetric_epipolar_distances


def slow_distances(F, p, q):
    """Sampson and symmetric epipolar distance of one match, from their definitions, entry by entry."""
    h1, h2 = [*p, 1.0], [*q, 1.0]
    l2 = [sum(F[i][j] * h1[j] for j in range(3)) for i in range(3)]
    l1 = [sum(F[i][j] * h2[i] for i in range(3)) for j in range(3)]
    error = sum(h2[i] * l2[i] for i in range(3))
    sampson = abs(error) / math.sqrt(l1[0] ** 2 + l1[1] ** 2 + l2[0] ** 2 + l2[1] ** 2)
    d1, d2 = abs(error) / math.hypot(l1[0], l1[1]), abs(error) / math.hypot(l2[0], l2[1])
    return sampson, math.sqrt(d1**2 + d2**2)


def test_distances_agree_with_their_definitions():
    rng = np.random.default_rng(0)
    for _ in range(20):
        F = rng.standard_normal((3, 3)) * 10.0 ** rng.uniform(-8, 8)
        x1, x2 = rng.uniform(0, 500, (2, 15, 2))
        expected = np.array([slow_distances(F.tolist(), p, q) for p, q in zip(x1, x2, strict=True)])
        np.testing.assert_allclose(sampson_distances(F, x1, x2), expected[:, 0], rtol=1e-9)
        np.testing.assert_allclose(symmetric_epipolar_distances(F, x1, x2), expected[:, 1], rtol=1e-9)


def test_sampson_is_the_least_move_to_first_order():
    """Moved by the gradient of the constraint, a match fulfils it, and the move is the Sampson distance."""
    scene = synthetic_two_view(60, 0.0, np.random.default_rng(3), noise=0.5)
    F, x1, x2 = scene.F, scene.x1, scene.x2
    h1, h2 = np.column_stack([x1, np.ones(60)]), np.column_stack([x2, np.ones(60)])
    gradient = np.hstack([(h2 @ F)[:, :2], (h1 @ F.T)[:, :2]])
    error = np.einsum("ni,ij,nj->n", h2, F, h1)
    move = -gradient * (error / (gradient**2).sum(axis=1))[:, None]
    np.testing.assert_allclose(np.linalg.norm(move, axis=1), sampson_distances(F, x1, x2), rtol=1e-9)
    assert sampson_distances(F, x1 + move[:, :2], x2 + move[:, 2:]).max() < 0.02
    assert sampson_distances(F, x1, x2).max() > 0.5


def test_a_match_on_a_line_has_distance_zero_and_epipoles_are_no_trouble():
    F = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # rectified stereo: y' = y
    x1, x2 = np.array([[3.0, 7.0], [3.0, 7.0]]), np.array([[-5.0, 7.0], [0.0, 9.0]])
    np.testing.assert_allclose(sampson_distances(F, x1, x2), [0.0, math.sqrt(2.0)])
    np.testing.assert_allclose(symmetric_epipolar_distances(F, x1, x2), [0.0, math.sqrt(8.0)])
    ahead = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])  # both epipoles at the origin
    origin = np.zeros((1, 2))
    assert sampson_distances(ahead, origin, origin) == [0.0]
    assert symmetric_epipolar_distances(ahead, origin, origin) == [0.0]
    sheared = ahead + np.diag([0.0, 0.0, 1.0])
    assert symmetric_epipolar_distances(sheared, origin, origin) == [np.inf]


def test_distances_ignore_the_scale_of_f():
    scene = synthetic_two_view(30, 0.3, np.random.default_rng(1))
    for distances in (sampson_distances, symmetric_epipolar_distances):
        np.testing.assert_allclose(
            distances(scene.F, scene.x1, scene.x2), distances(-1e200 * scene.F, scene.x1, scene.x2), rtol=1e-9
        )


def test_rank_two_is_the_nearest():
    rng = np.random.default_rng(2)
    for _ in range(20):
        F = rng.standard_normal((3, 3))
        nearest = enforce_rank_two(F)
        s = np.linalg.svd(nearest, compute_uv=False)
        assert s[2] < 1e-14
        distance = np.linalg.norm(F - nearest)
        np.testing.assert_allclose(distance, np.linalg.svd(F, compute_uv=False)[2])
        for _ in range(50):  # no other singular matrix is nearer: F with a column made dependent on the others
            other = F + 0.3 * rng.standard_normal((3, 3))
            other[:, 2] = other[:, :2] @ rng.standard_normal(2)
            assert np.linalg.norm(F - other) >= distance


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((np.ones((2, 3)), [[0, 0]], [[0, 0]]), ValueError, r"F must have shape \(3, 3\), but its shape is \(2, 3\)"),
        ((np.zeros((3, 3)), [[0, 0]], [[0, 0]]), ValueError, "F must not be zero"),
        ((np.eye(3) * np.nan, [[0, 0]], [[0, 0]]), ValueError, "F must be finite"),
        ((np.eye(3), [[0, 0, 1]], [[0, 0]]), ValueError, r"x1 must have shape \(N, 2\)"),
        ((np.eye(3), [[0, 0]], [[0, 0], [1, 1]]), ValueError, "x2 must have one row for each row of x1"),
        ((np.eye(3), [["a", "b"]], [[0, 0]]), TypeError, "x1 must hold real numbers"),
        ((np.eye(3), [[0, np.inf]], [[0, 0]]), ValueError, "x1 must be finite"),
    ],
)
def test_errors_name_the_argument(arguments, error, message):
    for distances in (sampson_distances, symmetric_epipolar_distances):
        with pytest.raises(error, match=message):
            distances(*arguments)


def test_points_as_opencv_has_them():
    """Shape (N, 1, 2), as arrays or lists, is taken by everything that takes matches; any other third axis is not."""
    scene = synthetic_two_view(30, 0.2, np.random.default_rng(2))
    x1, x2 = scene.x1[:, None, :], scene.x2[:, None, :].astype(np.float32)
    for distances in (sampson_distances, symmetric_epipolar_distances):
        expected = distances(scene.F, scene.x1, x2[:, 0])
        np.testing.assert_array_equal(distances(scene.F, x1, x2), expected)
        np.testing.assert_array_equal(distances(scene.F, x1.tolist(), x2), expected)
    expected = fundamental_problem(scene.x1, scene.x2, chart="F32=1")
    np.testing.assert_array_equal(
        fundamental_problem(x1, scene.x2, chart="F32=1").problem.A,
        expected.problem.A,
    )
    for wrong in (scene.x1[:, :, None], np.stack([scene.x1, scene.x1], axis=1), x1[:, :, :, None], x1[:, :, :1]):
        with pytest.raises(ValueError, match="x1 must "):
            sampson_distances(scene.F, wrong, scene.x2)
