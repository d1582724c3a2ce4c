"""The geometric polish, compared with SciPy on the same loss and with the distances themselves."""

import numpy as np
import pytest
from numba import config
from scipy.optimize import least_squares

from maxcon.datasets import synthetic_two_view
from maxcon.search.random_kernels import seed_state
from maxcon.vision import enforce_rank_two, find_fundamental, polish_fundamental, sampson_distances
from maxcon.vision.polish_kernels import (
    anneal,
    descend,
    frame_of,
    matrix_of,
    normal_equations,
    score,
    stepped,
    tangent_of,
    within,
)
from maxcon.vision.seven_point_kernels import _cubic_roots, coarse_score, company, propose, seven_point


def random_rank_two(rng, short=None):
    """A matrix of rank 2, of any scale, with second singular value `short` times the first."""
    U, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    V, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    s = np.array([1.0, rng.uniform(0.01, 1.0) if short is None else short, 0.0])
    return (U * s) @ V.T * 10.0 ** rng.uniform(-6, 6)


def random_frame(rng):
    frame = np.empty(19)
    assert frame_of(random_rank_two(rng).ravel(), frame)
    return frame


def matrix(frame):
    f = np.empty(9)
    matrix_of(frame, f)
    return f


def signed_distances(f, matches):
    """Sampson distances with the sign of the bilinear form, by the definition."""
    F = f.reshape(3, 3)
    ones = np.ones(matches.shape[1])
    p, q = np.vstack([matches[:2], ones]), np.vstack([matches[2:], ones])
    l2, l1 = F @ p, F.T @ q
    return (q * l2).sum(axis=0) / np.sqrt(l1[0] ** 2 + l1[1] ** 2 + l2[0] ** 2 + l2[1] ** 2)


def biweight(z):
    """Tukey's loss of z = (r / width)^2 and its two derivatives, as SciPy wants it."""
    inside = np.maximum(1.0 - z, 0.0)
    return np.array([(1.0 - inside**3) / 3.0, inside**2, -2.0 * inside])


def normalised_scene(n_points, rate, rng, noise=0.5):
    """A made scene in centred coordinates of size 1, its scale, the frame of its true matrix, and who is right."""
    scene = synthetic_two_view(n_points, rate, rng, noise=noise)
    scale = 1.0 / 300.0
    c1, c2 = scene.x1.mean(axis=0), scene.x2.mean(axis=0)
    matches = np.ascontiguousarray(np.hstack([(scene.x1 - c1) * scale, (scene.x2 - c2) * scale]).T)
    back1, back2 = (np.array([[1 / scale, 0, c[0]], [0, 1 / scale, c[1]], [0, 0, 1.0]]) for c in (c1, c2))
    frame = np.empty(19)
    assert frame_of(enforce_rank_two(back2.T @ scene.F @ back1).ravel(), frame)
    return matches, scale, frame, scene.inlier_mask


@pytest.mark.parametrize("short", [None, 1.0, 1e-3, 1e-9])
def test_a_frame_is_the_matrix_up_to_its_scale(short):
    rng = np.random.default_rng(0)
    for _ in range(30):
        F = random_rank_two(rng, short)
        frame = np.empty(19)
        assert frame_of(F.ravel(), frame)
        np.testing.assert_allclose(matrix(frame).reshape(3, 3), F / np.linalg.norm(F), atol=1e-12)
        for first in (0, 9):
            Q = frame[first : first + 9].reshape(3, 3)
            np.testing.assert_allclose(Q.T @ Q, np.eye(3), atol=1e-12)


def test_a_matrix_of_rank_one_or_none_has_no_frame():
    rng = np.random.default_rng(1)
    frame = np.empty(19)
    for F in (np.zeros(9), np.outer(rng.standard_normal(3), rng.standard_normal(3)).ravel(), np.eye(9)[4]):
        assert not frame_of(F, frame)


def test_the_tangent_is_the_derivative_of_a_step():
    rng = np.random.default_rng(2)
    M, moved = np.empty((9, 7)), np.empty(19)
    for _ in range(20):
        frame = random_frame(rng)
        tangent_of(frame, M)
        for k in range(7):
            ends = []
            for h in (1e-6, -1e-6):
                stepped(frame, h * np.eye(7)[k], moved)
                ends.append(matrix(moved))
            np.testing.assert_allclose(M[:, k], (ends[0] - ends[1]) / 2e-6, atol=1e-9)
        stepped(frame, rng.standard_normal(7), moved)
        assert np.linalg.norm(matrix(moved)) == pytest.approx(1.0)
        assert abs(np.linalg.det(matrix(moved).reshape(3, 3))) < 1e-14
        assert np.linalg.matrix_rank(M) == 7


def test_the_normal_equations_are_those_of_the_distances():
    rng = np.random.default_rng(3)
    for case in range(10):
        matches, scale, frame, _ = normalised_scene(40, 0.3, rng)
        if case % 2:
            frame = random_frame(rng)
        f, width = matrix(frame), 4.0 * scale if case % 2 == 0 else 0.5
        chosen = rng.permutation(40)[:25]
        H, g = np.empty((9, 9)), np.empty(9)
        loss = normal_equations(matches, chosen, 25, f, width, H, g)
        r = signed_distances(f, matches[:, chosen])
        assert loss == pytest.approx(biweight((r / width) ** 2)[0].sum(), rel=1e-12)
        J = np.empty((25, 9))
        for k in range(9):
            ends = [signed_distances(f + h * np.eye(9)[k], matches[:, chosen]) for h in (1e-6, -1e-6)]
            J[:, k] = (ends[0] - ends[1]) / 2e-6
        weights = biweight((r / width) ** 2)[1]
        np.testing.assert_allclose(g, J.T @ (weights * r), atol=1e-6 * (1 + np.abs(J).max()))
        np.testing.assert_allclose(np.tril(H), np.tril((J.T * weights) @ J), atol=1e-6 * (1 + np.abs(J).max() ** 2))


def test_descending_ends_where_scipy_does():
    """The oracle knows nothing of frames: F = [p, q, a p + b q], eight numbers with the scale among them."""
    rng = np.random.default_rng(4)
    moved = np.empty(19)
    for _ in range(12):
        matches, scale, frame, _ = normalised_scene(80, 0.3, rng)
        width = 4.0 * scale
        stepped(frame, 2e-3 * rng.standard_normal(7), moved)
        F = matrix(moved).reshape(3, 3)
        a, b = np.linalg.lstsq(F[:, :2], F[:, 2], rcond=None)[0]

        def residuals(x, matches=matches):
            p, q = x[:3], x[3:6]
            return signed_distances(np.column_stack([p, q, x[6] * p + x[7] * q]).ravel(), matches)

        start = np.concatenate([F[:, 0], F[:, 1], [a, b]])
        oracle = least_squares(
            residuals, start, loss=biweight, f_scale=width, xtol=1e-12, ftol=1e-12, gtol=1e-12, x_scale="jac"
        )
        before = biweight((signed_distances(matrix(moved), matches) / width) ** 2)[0].sum()
        loss = descend(matches, np.arange(80), 80, moved, width, 200, 1e-12)
        assert loss == pytest.approx(biweight((signed_distances(matrix(moved), matches) / width) ** 2)[0].sum())
        assert loss < before
        # cost = width^2 / 2 times the loss; where the two end in different basins, ours must be no worse by much
        assert loss <= oracle.cost * 2.0 / width**2 * (1 + 1e-5) + 0.02


def test_scores_count_the_distances():
    rng = np.random.default_rng(5)
    for _ in range(10):
        matches, scale, frame, _ = normalised_scene(70, 0.4, rng)
        f = matrix(frame)
        r = np.abs(signed_distances(f, matches)) / scale
        count, loss = score(matches, f, scale)
        assert count == (r <= 1.0).sum()
        assert loss == pytest.approx(np.minimum(r**2, 1.0).sum())
        assert coarse_score(matches, 50, f, scale) == sum((r[:50] <= k).sum() for k in (1.0, 2.0, 4.0))
        pool = rng.permutation(70)
        n = within(matches, frame, scale, pool, f)
        assert set(pool[:n]) == set(np.flatnonzero(r <= 1.0))
        assert sorted(pool) == list(range(70))


def test_cubic_roots_are_numpys():
    rng = np.random.default_rng(6)
    roots = np.empty(3)
    for case in range(300):
        if case % 3 == 0:
            c = rng.standard_normal(4) * 10.0 ** rng.uniform(-3, 3)
        else:
            known = rng.standard_normal(3) * 10.0 ** rng.uniform(-2, 2)
            if case % 3 == 2:
                known[1] = known[0] + rng.uniform(0.05, 1) * abs(known[0])
            c = np.polynomial.polynomial.polyfromroots(known) * rng.standard_normal()
        found = np.sort(roots[: _cubic_roots(*c, roots)])
        expected = np.roots(c[::-1])
        expected = np.sort(expected[np.abs(expected.imag) < 1e-9 * (1 + np.abs(expected))].real)
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)
    assert _cubic_roots(1.0, 2.0, 3.0, 0.0, roots) == 0
    assert _cubic_roots(0.0, 0.0, 0.0, 0.0, roots) == 0


def test_seven_points_are_solved_by_every_matrix_that_has_rank_two():
    rng = np.random.default_rng(7)
    table, places, models = np.empty((9, 9)), np.empty(9, dtype=np.int64), np.empty((3, 9))
    for case in range(100):
        matches = rng.standard_normal((4, 7))
        if case % 2:
            matches = np.round(3 * matches)  # ties
        state = seed_state(rng)
        n = seven_point(matches, np.arange(7), 7, state, table, places, models)
        rows = np.vstack([matches[2] * matches[0], matches[2] * matches[1], matches[2], matches[3] * matches[0]])
        rows = np.vstack([rows, matches[3] * matches[1], matches[3], matches[0], matches[1], np.ones(7)]).T
        if case % 2 == 0:
            null = np.linalg.svd(rows)[2][7:].reshape(2, 3, 3)
            t = np.linspace(-1, 1, 4)
            cubic = np.polyfit(t, [np.linalg.det(null[0] + each * null[1]) for each in t], 3)
            assert n == sum(abs(root.imag) < 1e-9 for root in np.roots(cubic))
        for model in models[:n]:
            f = model / np.linalg.norm(model)
            assert np.abs(rows @ f).max() < 1e-9 * np.abs(rows).max()
            assert np.linalg.svd(f.reshape(3, 3), compute_uv=False)[2] < 1e-9


def test_too_few_different_points_give_some_matrix_that_vanishes_on_them():
    state, table, places = np.array([1, 2, 3, 4]), np.empty((9, 9)), np.empty(9, dtype=np.int64)
    models, rng = np.empty((3, 9)), np.random.default_rng(8)
    for different in (2, 4, 6):
        points = rng.standard_normal((4, different))
        matches = np.ascontiguousarray(np.hstack([points, points, points, points]))
        n = seven_point(matches, np.arange(matches.shape[1]), matches.shape[1], state, table, places, models)
        assert n > 0
        for f in models[:n]:
            assert np.abs(f).max() > 0
            assert np.abs(signed_distances(f, points)).max() < 1e-9


def test_company_counts_neighbours_in_both_images():
    rng = np.random.default_rng(22)
    matches, _, _, right = normalised_scene(200, 0.5, rng, noise=0.0)
    matches[:, 40] = matches[:, 41]  # found twice
    matches[2:, 42] = matches[2:, 43]  # two that go to one
    counts = np.empty(200, dtype=np.int64)
    company(matches, 150, 0.2, 1e-9, counts)
    expected = [
        sum(
            max(np.abs(matches[:2, i] - matches[:2, j]).max(), np.abs(matches[2:, i] - matches[2:, j]).max()) <= 0.2
            and min(np.abs(matches[:2, i] - matches[:2, j]).max(), np.abs(matches[2:, i] - matches[2:, j]).max()) > 1e-9
            for j in range(150)
        )
        for i in range(200)
    ]
    np.testing.assert_array_equal(counts, expected)
    assert counts[right].mean() > 3 * counts[~right].mean()


def test_proposals_are_the_best_of_what_was_drawn():
    rng = np.random.default_rng(9)
    matches, scale, _, _ = normalised_scene(60, 0.3, rng)
    best, scores = np.empty((4, 9)), np.empty(4, dtype=np.int64)
    state = seed_state(rng)
    again = state.copy()
    propose(matches, np.arange(60), 60, 60, scale, 200, state, best, scores)
    table, places, models = np.empty((9, 9)), np.empty(9, dtype=np.int64), np.empty((3, 9))
    pool, values = np.arange(60), []
    for _ in range(200):
        n = seven_point(matches, pool, 60, again, table, places, models)
        for f in models[:n]:
            r = np.abs(signed_distances(f, matches)) / scale
            values.append(sum((r <= k).sum() for k in (1.0, 2.0, 4.0)))
    np.testing.assert_array_equal(np.sort(scores)[::-1], np.sort(values)[::-1][:4])


def test_annealing_keeps_the_best_it_meets():
    rng = np.random.default_rng(10)
    for _ in range(5):
        matches, scale, truth, right = normalised_scene(100, 0.4, rng)
        frame, best, record = np.empty(19), np.empty(19), np.array([-1.0, np.inf])
        stepped(truth, 1e-3 * rng.standard_normal(7), frame)
        assert anneal(matches, frame, scale, 7.0, np.arange(100), best, record)
        count, loss = score(matches, matrix(best), scale)
        assert (count, loss) == tuple(record)
        assert count >= 0.8 * right.sum()
        kept = best.copy()
        assert not anneal(matches, random_frame(rng), scale, 7.0, np.arange(100), best, record)
        np.testing.assert_array_equal(kept, best)


def counts(F, scene, pixels=1.0):
    return int((sampson_distances(F, scene.x1, scene.x2) <= pixels).sum())


@pytest.mark.parametrize("rate", [0.0, 0.3, 0.6])
def test_it_has_at_least_the_matches_of_the_truth_and_rank_two(rate):
    rng, gains = np.random.default_rng(11), []
    for _ in range(6):
        scene = synthetic_two_view(120, rate, rng)
        F = polish_fundamental(None, scene.x1, scene.x2)
        s = np.linalg.svd(F, compute_uv=False)
        assert s[2] < 1e-13 * s[0]
        assert s[1] > 1e-9 * s[0]
        assert np.linalg.norm(F) == pytest.approx(1.0)
        assert F.flat[np.argmax(np.abs(F))] > 0
        gains.append(counts(F, scene) - counts(scene.F, scene))
    assert min(gains) >= -1  # local optimisation promises nothing
    assert np.mean(gains) >= 1


def test_it_never_loses_against_its_starts():
    rng = np.random.default_rng(12)
    for _ in range(10):
        scene = synthetic_two_view(60, 0.3, rng)
        starts = np.stack([enforce_rank_two(scene.F + 1e-5 * rng.standard_normal((3, 3))) for _ in range(3)])
        alone = polish_fundamental(starts, scene.x1, scene.x2, patience=0)
        most = counts(alone, scene)
        for start in starts:
            assert most >= counts(start, scene)
            assert most >= counts(polish_fundamental(start, scene.x1, scene.x2, patience=0), scene)
        assert counts(polish_fundamental(starts, scene.x1, scene.x2), scene) >= most


def test_exact_matches_are_fitted_exactly():
    for seed in range(5):
        scene = synthetic_two_view(50, 0.3, np.random.default_rng(seed), noise=0.0)
        F = polish_fundamental(None, scene.x1, scene.x2, pixels=0.01)
        assert sampson_distances(F, scene.x1, scene.x2)[scene.inlier_mask].max() < 1e-6


def test_units_scales_and_signs_do_not_matter():
    scene = synthetic_two_view(80, 0.4, np.random.default_rng(13))
    start = scene.F + 1e-6 * np.random.default_rng(0).standard_normal((3, 3))
    F = polish_fundamental(start, scene.x1, scene.x2, rng=3)
    np.testing.assert_array_equal(F, polish_fundamental(start, scene.x1, scene.x2, rng=3))
    np.testing.assert_array_equal(F, polish_fundamental(start, scene.x1, scene.x2, rng=np.random.default_rng(3)))
    assert counts(polish_fundamental(-1e-7 * start, scene.x1, scene.x2, rng=3), scene) == counts(F, scene)
    unit = np.diag([1e-3, 1e-3, 1.0])  # kilopixels
    small = polish_fundamental(
        np.linalg.inv(unit) @ start @ np.linalg.inv(unit), 1e-3 * scene.x1, 1e-3 * scene.x2, 1e-3, rng=3
    )
    assert (sampson_distances(small, 1e-3 * scene.x1, 1e-3 * scene.x2) <= 1e-3).sum() == counts(F, scene)


def test_planes_lines_ties_and_few_matches_are_no_trouble():
    rng = np.random.default_rng(14)
    grid = rng.uniform(0, 640, (60, 2))
    homography = np.array([[1.1, 0.1, 5.0], [-0.05, 0.95, 20.0], [1e-4, 2e-4, 1.0]])
    image = np.column_stack([grid, np.ones(60)]) @ homography.T
    image = image[:, :2] / image[:, 2:]  # exactly a plane: F = [e]_x H for any e
    noisy = image + rng.normal(0, 0.3, image.shape)
    line = np.column_stack([np.arange(20.0), 2 * np.arange(20.0)])
    same = np.repeat(grid[:2], 10, axis=0)
    cases = [(grid, image), (grid, noisy), (line, line + 1.0), (same, same + 3.0), (grid, grid)]
    cases += [(grid[:8], noisy[:8]), (np.round(grid / 80) * 80, np.round(noisy / 80) * 80)]
    starts = np.stack([random_rank_two(rng), np.outer([1.0, 2, 3], [1.0, 1, 1]), rng.standard_normal((3, 3))])
    for x1, x2 in cases:
        for start in (None, starts):
            F = polish_fundamental(start, x1, x2)
            if start is None and np.isnan(F).any():
                continue
            s = np.linalg.svd(F, compute_uv=False)
            assert s[2] < 1e-12 * s[0]
            assert np.linalg.norm(F) == pytest.approx(1.0)
            if x2 is not cases[-1][1]:  # the last is rounded by far more than a pixel
                assert (sampson_distances(F, x1, x2) <= 1.0).sum() >= len(x1) - 1


def test_where_nothing_has_rank_two_there_is_no_matrix():
    line = np.column_stack([np.arange(20.0), 2 * np.arange(20.0)])
    assert np.isnan(polish_fundamental(np.ones((3, 3)), line, line + 1.0, patience=0)).all()
    assert np.isnan(polish_fundamental(None, line, line + 1.0, patience=0)).all()


def test_a_time_limit_ends_what_patience_would_not():
    scene = synthetic_two_view(100, 0.5, np.random.default_rng(15))
    F = polish_fundamental(None, scene.x1, scene.x2, time_limit=0.2, patience=10**9)
    assert counts(F, scene) > 0
    assert counts(polish_fundamental(None, scene.x1, scene.x2, time_limit=1e-9), scene) >= 7  # one round, to have any
    start = polish_fundamental(scene.F, scene.x1, scene.x2, time_limit=1e-9)
    np.testing.assert_array_equal(start, polish_fundamental(scene.F, scene.x1, scene.x2, patience=0))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"F": np.zeros((3, 3))}, ValueError, "F must not be zero"),
        ({"F": np.ones((3, 4))}, ValueError, r"F must have shape \(3, 3\) or \(k, 3, 3\), but its shape is \(3, 4\)"),
        ({"F": np.ones(9)}, ValueError, "F must have 2 dimensions"),
        ({"F": np.full((3, 3), np.nan)}, ValueError, "F must be finite"),
        ({"x1": np.zeros((7, 2)), "x2": np.zeros((7, 2))}, ValueError, "x1 and x2 must hold at least 8 matches"),
        ({"x1": np.ones((20, 2))}, ValueError, "x1 must be points of an image apart from each other"),
        ({"pixels": 0.0}, ValueError, "pixels must be a positive finite number, but it is 0.0"),
        ({"pixels": np.inf}, ValueError, "pixels must be a positive finite number"),
        ({"pixels": "1"}, TypeError, "pixels must be a number"),
        ({"patience": -1}, ValueError, "patience must be at least 0"),
        ({"patience": 2.5}, TypeError, "patience must be an integer"),
        ({"time_limit": 0.0}, ValueError, "time_limit must be a positive number"),
        ({"rng": "seed"}, TypeError, "rng must be an integer"),
    ],
)
def test_errors_name_the_argument(change, error, message):
    rng = np.random.default_rng(0)
    arguments = {"F": np.eye(3), "x1": rng.random((20, 2)), "x2": rng.random((20, 2))} | change
    with pytest.raises(error, match=message):
        polish_fundamental(**arguments)


@pytest.mark.skipif(bool(config.DISABLE_JIT), reason="takes minutes where kernels are interpreted")
@pytest.mark.parametrize("chart", ["auto", "F32=1"])
@pytest.mark.parametrize("rate", [0.2, 0.5])
def test_find_fundamental_polishes_and_keeps_the_consensus(rate, chart):
    rng = np.random.default_rng(16)
    gains = []
    for _ in range(6):
        scene = synthetic_two_view(100, rate, rng)
        found = find_fundamental(scene.x1, scene.x2, 0.03, method="peel", rng=1, chart=chart)
        plain = find_fundamental(scene.x1, scene.x2, 0.03, method="peel", rng=1, chart=chart, pixels=None)
        if chart != "auto":  # the same linear problem, for "auto" is rotated to what the polish makes of samples
            np.testing.assert_array_equal(found.inlier_mask, plain.inlier_mask)
            np.testing.assert_array_equal(found.F_linear, plain.F)
        np.testing.assert_array_equal(plain.F_linear, plain.F)
        residuals = found.problem.problem.residuals(found.consensus.model)
        np.testing.assert_array_equal(found.inlier_mask, residuals <= found.problem.problem.inlier_limit(0.03))
        np.testing.assert_array_equal(found.within(), sampson_distances(found.F, scene.x1, scene.x2) <= 1.0)
        assert found.within(2.0).sum() >= found.within().sum() >= counts(scene.F, scene) - 1
        assert found.within().sum() >= counts(found.F_linear, scene)
        assert found.pixels == 1.0
        gains.append(found.within().sum() - plain.within(1.0).sum())
        with pytest.raises(ValueError, match="pixels must be given where F was not polished"):
            plain.within()
    assert min(gains) >= 0
    assert np.mean(gains) > 5


def test_a_threshold_in_the_wrong_unit_does_not_spoil_the_consensus():
    scene = synthetic_two_view(80, 0.4, np.random.default_rng(19))
    for unit, chosen in (
        (1e-3, 1.0),
        (1.0, 1e-9),
    ):  # everything is within a thousand pixels, nothing within a billionth
        found = find_fundamental(unit * scene.x1, unit * scene.x2, 0.03, method="peel", pixels=chosen)
        plain = find_fundamental(unit * scene.x1, unit * scene.x2, 0.03, method="peel", pixels=None)
        np.testing.assert_array_equal(found.inlier_mask, plain.inlier_mask)
        np.testing.assert_array_equal(found.problem.base, plain.problem.base)


def test_few_matches_are_polished_too():
    rng = np.random.default_rng(20)
    for n_points in (9, 10, 13):
        scene = synthetic_two_view(n_points, 0.0, rng)
        found = find_fundamental(scene.x1, scene.x2, 0.05, method="peel")
        assert found.within().sum() >= 8
        assert np.linalg.svd(found.F, compute_uv=False)[2] < 1e-12


def test_a_short_time_limit_leaves_something_for_all_parts():
    scene = synthetic_two_view(100, 0.5, np.random.default_rng(17))
    for limit in (1e-6, 0.02, 0.2):
        found = find_fundamental(scene.x1, scene.x2, 0.02, method="learned", time_limit=limit)
        assert found.within().sum() >= counts(found.F_linear, scene) > 0
        assert found.n_inliers >= 8
