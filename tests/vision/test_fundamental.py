"""The linearised fundamental matrix: charts, normalisation and the way back, compared with the bilinear form itself."""

import numpy as np
import pytest

import maxcon
from maxcon.datasets import synthetic_two_view
from maxcon.datasets.cameras import cross_matrix
from maxcon.vision import (
    CHARTS,
    enforce_rank_two,
    find_fundamental,
    fundamental_problem,
    sampson_distances,
    symmetric_epipolar_distances,
)
from maxcon.vision.estimate import robust_estimate
from maxcon.vision.estimate_kernels import null_vector, truncated_loss
from maxcon.vision.fundamental import orthogonal_directions

ALL_CHARTS = pytest.mark.parametrize("chart", list(CHARTS))


def homogeneous(x):
    return np.column_stack([x, np.ones(len(x))])


def rectified(n_points, rng, noise=0.0):
    """Matches of rectified stereo, centred: F = [e]_x has F33 = 0 in pixels and, by symmetry in y, normalised too."""
    x1 = rng.uniform(-300, 300, (n_points, 2))
    return x1, x1 - [[1.0, 0.0]] * rng.uniform(5, 80, (n_points, 1)) + rng.uniform(-noise, noise, (n_points, 2))


@ALL_CHARTS
def test_a_residual_is_the_bilinear_form_in_normalised_coordinates(chart):
    rng = np.random.default_rng(0)
    for _ in range(10):
        scene = synthetic_two_view(40, 0.4, rng)
        posed = fundamental_problem(scene.x1, scene.x2, chart=chart)
        theta = rng.standard_normal(8)
        F = posed.normalised_matrix(theta)
        h1, h2 = homogeneous(scene.x1) @ posed.T1.T, homogeneous(scene.x2) @ posed.T2.T
        expected = [abs(q @ F @ p) for p, q in zip(h1, h2, strict=True)]
        np.testing.assert_allclose(posed.problem.residuals(theta), expected, rtol=1e-9, atol=1e-12)
        # and back in pixels the form is the same up to the scale of F
        pixels = np.einsum("ni,ij,nj->n", homogeneous(scene.x2), posed.matrix(theta), homogeneous(scene.x1))
        ratio = np.abs(pixels) / expected
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-7)
        assert np.linalg.norm(posed.matrix(theta)) == pytest.approx(1.0)


def test_the_rows_of_f32_are_those_of_the_tree_search_authors():
    """[x'x, x'y, x', y'x, y'y, y', x, 1] . theta = -y."""
    scene = synthetic_two_view(12, 0.0, np.random.default_rng(1))
    posed = fundamental_problem(scene.x1, scene.x2, chart="F32=1")
    (x, y, _), (u, v, _) = ((homogeneous(points) @ T.T).T for points, T in ((scene.x1, posed.T1), (scene.x2, posed.T2)))
    expected = np.column_stack([u * x, u * y, u, v * x, v * y, v, x, np.ones(12)])
    np.testing.assert_allclose(posed.problem.A, expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(posed.problem.b, -y, atol=1e-12)
    posed = fundamental_problem(scene.x1, scene.x2, chart="F33=1")
    np.testing.assert_allclose(posed.problem.A[:, 6:], np.column_stack([x, y]), atol=1e-12)
    np.testing.assert_array_equal(posed.problem.b, -np.ones(12))
    assert posed.normalised_matrix(np.zeros(8))[2, 2] == 1.0


def test_normalisation_is_hartleys():
    scene = synthetic_two_view(30, 0.5, np.random.default_rng(2))
    posed = fundamental_problem(scene.x1 + 1e5, scene.x2)
    for T, x in ((posed.T1, scene.x1 + 1e5), (posed.T2, scene.x2)):
        moved = homogeneous(x) @ T.T
        np.testing.assert_allclose(moved[:, :2].mean(axis=0), 0.0, atol=1e-9)
        assert np.linalg.norm(moved[:, :2], axis=1).mean() == pytest.approx(np.sqrt(2.0))
        assert T[0, 0] == T[1, 1]
        np.testing.assert_array_equal(T[2], [0.0, 0.0, 1.0])


@ALL_CHARTS
def test_parameters_and_matrix_are_inverse(chart):
    rng = np.random.default_rng(3)
    for _ in range(10):
        scene = synthetic_two_view(30, 0.2, rng)
        posed = fundamental_problem(scene.x1, scene.x2, chart=chart)
        theta = rng.standard_normal(8)
        np.testing.assert_allclose(posed.parameters(-3.0 * posed.matrix(theta)), theta, rtol=1e-6, atol=1e-8)
        signed = scene.F * np.sign(scene.F.flat[np.argmax(np.abs(scene.F))])
        np.testing.assert_allclose(posed.matrix(posed.parameters(scene.F)), signed, atol=1e-9)


@ALL_CHARTS
@pytest.mark.parametrize("seed", range(4))
def test_every_chart_recovers_f_from_noise_free_matches(chart, seed):
    scene = synthetic_two_view(60, 0.2, np.random.default_rng(seed), noise=0.0)
    found = find_fundamental(scene.x1, scene.x2, 1e-7, chart=chart, method="lo-ransac")
    np.testing.assert_array_equal(found.inlier_mask, scene.inlier_mask)
    assert sampson_distances(found.F, scene.x1, scene.x2)[scene.inlier_mask].max() < 1e-3
    signed = scene.F * np.sign(scene.F.flat[np.argmax(np.abs(scene.F))])
    np.testing.assert_allclose(found.F, signed, atol=1e-5)


def test_f33_is_ill_posed_for_rectified_stereo_and_the_others_are_not():
    rng = np.random.default_rng(5)
    x1, x2 = rectified(80, rng, noise=0.3)
    x2[:16] = rng.uniform(-300, 300, (16, 2))
    counts = {chart: find_fundamental(x1, x2, 0.01, chart=chart, method="peel").n_inliers for chart in CHARTS}
    assert counts["auto"] >= 64
    assert counts["F32=1"] >= 60
    assert counts["F33=1"] < 50
    exact = fundamental_problem(np.vstack([x1, -x1]), np.vstack([x2, -x2]), chart="F33=1")
    with pytest.raises(ValueError, match=r"F must have a place in the chart 'F33=1'"):
        exact.parameters(cross_matrix(np.array([1.0, 0.0, 0.0])))


def test_f32_fails_for_cameras_one_above_the_other_and_auto_does_not():
    rng = np.random.default_rng(6)
    x1, x2 = (points[:, ::-1] for points in rectified(80, rng, noise=0.3))
    x2 = x2.copy()
    x2[:16] = rng.uniform(-300, 300, (16, 2))
    assert find_fundamental(x1, x2, 0.01, method="peel").n_inliers >= 64
    assert find_fundamental(x1, x2, 0.01, chart="F32=1", method="peel").n_inliers < 50


@pytest.mark.parametrize("rate", [0.0, 0.2, 0.4, 0.6])
def test_the_estimate_is_near_the_truth(rate):
    """Its angle to the true f is what the chart "auto" costs: residuals are 1 / cos as large."""
    rng = np.random.default_rng(7)
    cosines = []
    for _ in range(10):
        scene = synthetic_two_view(100, rate, rng)
        posed = fundamental_problem(scene.x1, scene.x2, threshold=0.02, rng=1)
        f = (np.linalg.inv(posed.T2).T @ scene.F @ np.linalg.inv(posed.T1)).ravel()
        cosines.append(abs(posed.base @ f) / np.linalg.norm(f))
    assert np.median(cosines) > 0.98


def test_the_chart_of_auto_is_an_orthonormal_change_of_coordinates():
    rng = np.random.default_rng(8)
    axes = [*np.eye(9), *(-np.eye(9)), *rng.standard_normal((20, 9))]
    for vector in axes:
        base = vector / np.linalg.norm(vector)
        Q = np.column_stack([base, orthogonal_directions(base)])
        np.testing.assert_allclose(Q.T @ Q, np.eye(9), atol=1e-14)


def test_equal_seeds_give_equal_problems_and_the_seed_matters():
    scene = synthetic_two_view(50, 0.5, np.random.default_rng(9))
    first, second = (fundamental_problem(scene.x1, scene.x2, rng=4) for _ in range(2))
    np.testing.assert_array_equal(first.base, second.base)
    np.testing.assert_array_equal(first.problem.A, second.problem.A)
    drawn = fundamental_problem(scene.x1, scene.x2, rng=np.random.default_rng(4))
    np.testing.assert_array_equal(first.base, drawn.base)
    scene = synthetic_two_view(50, 0.8, np.random.default_rng(9))
    few = [fundamental_problem(scene.x1, scene.x2, rng=seed, samples=20).base for seed in range(20)]
    assert not all(np.allclose(few[0], base) for base in few)


def test_null_vectors_vanish_on_the_rows_that_were_drawn():
    rng = np.random.default_rng(10)
    table, places, f = np.empty((9, 9)), np.empty(9, dtype=np.int64), np.empty(9)
    for case in range(60):
        rows = rng.standard_normal((8, 9))
        if case % 3 == 1:
            rows = np.round(2 * rows)  # ties and zeros
        if case % 3 == 2:
            rows[4:] = rows[:4]  # half of them duplicates: some null vector of four
        state = rng.integers(0, 2**32, 4)
        null_vector(rows, np.arange(8), state, table, places, f)
        assert np.linalg.norm(f) == pytest.approx(1.0)
        assert np.abs(rows @ f).max() < 1e-9


def test_the_truncated_loss_is_exact_below_and_stops_above():
    rng = np.random.default_rng(11)
    rows, f = rng.standard_normal((300, 9)), rng.standard_normal(9)
    f /= np.linalg.norm(f)
    exact = np.minimum((rows @ f / 0.5) ** 2, 1.0).sum()
    assert truncated_loss(rows, f, 0.5, np.inf) == pytest.approx(exact)
    assert exact / 2 <= truncated_loss(rows, f, 0.5, exact / 2) <= exact + 1e-9


def test_the_estimate_has_at_most_the_loss_of_its_best_sample():
    rng = np.random.default_rng(12)
    scene = synthetic_two_view(60, 0.4, rng)
    posed = fundamental_problem(scene.x1, scene.x2, chart="F33=1")
    rows = np.insert(posed.problem.A, 8, 1.0, axis=1)
    losses = [
        truncated_loss(rows, robust_estimate(rows, 0.05, np.random.default_rng(0), samples), 0.05, np.inf)
        for samples in (1, 4000)
    ]
    table, places, f = np.empty((9, 9)), np.empty(9, dtype=np.int64), np.empty(9)
    pool, state = np.arange(60), np.array([1, 2, 3, 4])
    sampled = np.inf
    for _ in range(2000):
        null_vector(rows, pool, state, table, places, f)
        sampled = min(sampled, truncated_loss(rows, f, 0.05, np.inf))
    assert losses[1] < sampled
    assert losses[1] < losses[0]


def test_the_chart_of_auto_is_rotated_to_an_estimate_that_is_given():
    scene = synthetic_two_view(50, 0.5, np.random.default_rng(18))
    posed = fundamental_problem(scene.x1, scene.x2, estimate=-3.0 * scene.F)
    np.testing.assert_allclose(posed.matrix(np.zeros(8)), posed.to_pixels(posed.normalised_matrix(np.zeros(8))))
    assert abs((posed.matrix(np.zeros(8)) * scene.F).sum()) == pytest.approx(1.0)
    assert np.linalg.norm(posed.base) == pytest.approx(1.0)
    same = [fundamental_problem(scene.x1, scene.x2, chart="F32=1", estimate=each) for each in (None, scene.F)]
    np.testing.assert_array_equal(same[0].problem.A, same[1].problem.A)
    with pytest.raises(ValueError, match="estimate must not be zero"):
        fundamental_problem(scene.x1, scene.x2, estimate=np.zeros((3, 3)))


def test_the_result_is_of_rank_two_in_pixels_with_its_distances():
    scene = synthetic_two_view(80, 0.3, np.random.default_rng(13))
    found = find_fundamental(scene.x1, scene.x2, 0.05, method="peel", rng=3, pixels=None)
    s = np.linalg.svd(found.F, compute_uv=False)
    assert s[2] < 1e-12 * s[0]
    assert np.linalg.norm(found.F) == pytest.approx(1.0)
    np.testing.assert_allclose(found.sampson, sampson_distances(found.F, scene.x1, scene.x2))
    np.testing.assert_allclose(found.symmetric, symmetric_epipolar_distances(found.F, scene.x1, scene.x2))
    assert found.n_inliers == found.inlier_mask.sum() >= scene.inlier_mask.sum()
    assert found.median_sampson == np.median(found.sampson[found.inlier_mask])
    assert found.chart == "auto"
    assert "auto" in repr(found)
    # the rank is enforced in normalised coordinates, and in the last step only
    normalised = found.problem.normalised_matrix(found.consensus.model)
    np.testing.assert_allclose(found.F, found.problem.to_pixels(enforce_rank_two(normalised)), atol=1e-15)
    assert np.linalg.svd(normalised, compute_uv=False)[2] > 1e-6
    direct = maxcon.fit(found.problem.problem, 0.05, method="peel", rng=3)
    np.testing.assert_array_equal(direct.inlier_mask, found.inlier_mask)


def test_a_refit_fits_the_inliers_better_in_the_mean():
    scene = synthetic_two_view(100, 0.3, np.random.default_rng(14))
    first = find_fundamental(scene.x1, scene.x2, 0.03, method="peel", pixels=None)
    second = find_fundamental(scene.x1, scene.x2, 0.03, method="peel", refit=True, pixels=None)
    np.testing.assert_array_equal(first.inlier_mask, second.inlier_mask)
    inlier = first.inlier_mask & scene.inlier_mask
    assert np.linalg.norm(second.sampson[inlier]) < np.linalg.norm(first.sampson[inlier])


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"x1": np.zeros((8, 2)), "x2": np.zeros((8, 2))}, ValueError, "x1 and x2 must hold at least 9 matches"),
        ({"x1": np.ones((20, 2))}, ValueError, "x1 must be points of an image apart from each other"),
        ({"x2": np.ones((20, 2))}, ValueError, "x2 must be points of an image apart from each other"),
        ({"x2": np.ones((19, 2))}, ValueError, "x2 must have one row for each row of x1"),
        ({"x1": np.ones((20, 3))}, ValueError, r"x1 must have shape \(N, 2\)"),
        ({"x1": np.full((20, 2), np.nan)}, ValueError, "x1 must be finite"),
        ({"chart": "F11=1"}, ValueError, "chart must be one of 'auto', 'F32=1', 'F33=1', but it is 'F11=1'"),
        ({"chart": ["auto"]}, ValueError, "chart must be one of"),
        ({"threshold": 0.0}, ValueError, "threshold must be a positive finite number"),
        ({"samples": 0}, ValueError, "samples must be at least 1"),
        ({"pixels": -1.0}, ValueError, "pixels must be a positive finite number, but it is -1.0"),
        ({"pixels": "1"}, TypeError, "pixels must be a number"),
        ({"time_limit": 0}, ValueError, "time_limit must be a positive number of seconds or None, but it is 0"),
        ({"rng": "seed"}, TypeError, "rng must be an integer"),
        ({"method": "luck"}, ValueError, "method must be .*one of"),
        ({"depth": 3}, TypeError, "unknown option 'depth'"),
    ],
)
def test_errors_name_the_argument(change, error, message):
    rng = np.random.default_rng(0)
    arguments = {"x1": rng.random((20, 2)), "x2": rng.random((20, 2)), "threshold": 0.1, "method": "ransac"} | change
    with pytest.raises(error, match=message):
        find_fundamental(**arguments)


def test_what_is_frozen_stays_so():
    scene = synthetic_two_view(20, 0.0, np.random.default_rng(0))
    found = find_fundamental(scene.x1, scene.x2, 0.1, method="ransac")
    for array in (
        found.F,
        found.F_linear,
        found.problem.T1,
        found.problem.base,
        found.problem.directions,
        found.problem.problem.A,
    ):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0
    with pytest.raises(AttributeError):
        found.F = None


def test_duplicate_and_quantised_matches_are_no_trouble():
    rng = np.random.default_rng(15)
    scene = synthetic_two_view(40, 0.3, rng)
    x1, x2 = np.round(scene.x1 / 40) * 40, np.round(scene.x2 / 40) * 40
    for chart in CHARTS:
        found = find_fundamental(np.vstack([x1, x1]), np.vstack([x2, x2]), 0.05, chart=chart, method="lo-ransac")
        assert found.n_inliers >= 16
        np.testing.assert_array_equal(found.inlier_mask[:40], found.inlier_mask[40:])
    line = np.column_stack([np.arange(20.0), 2 * np.arange(20.0)])  # collinear in both images: F is not unique
    found = find_fundamental(line, line + 1.0, 0.01, method="lo-ransac")
    assert found.n_inliers == 20
