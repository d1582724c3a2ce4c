"""The bound on anyone's result, proofs after other methods, and the certificate file at the front door."""

import signal
import threading
import time

import numpy as np
import pytest

import maxcon
from instances import BUILDERS, synthetic
from maxcon.certification import load, verify
from maxcon.datasets.synthetic import synthetic_hyperplane
from oracles import brute_force_consensus, default_slack


def count(problem, model, threshold):
    return int(
        np.count_nonzero(problem.residuals(np.asarray(model)) <= threshold + default_slack(threshold, problem.b))
    )


@pytest.mark.parametrize("name", ["random_instance", "quantised", "duplicate_rows", "dependent_column", "leverage"])
def test_anyones_model_and_mask(name):
    for seed in range(8):
        rng = np.random.default_rng([seed, *name.encode()])
        A, b = BUILDERS[name](rng, 12, int(rng.integers(1, 6)))
        A, b = A[:13], b[:13]
        problem = maxcon.LinearProblem(A, b)
        threshold = float(rng.choice([0.1, 0.5, 1.0]))
        best = brute_force_consensus(A, b, threshold)
        model = np.linalg.lstsq(A, b)[0] + rng.choice([0.0, 0.3]) * rng.standard_normal(A.shape[1])
        given = maxcon.certify(problem, threshold, model)
        assert np.array_equal(given.model, model)
        assert given.n_inliers == count(problem, model, threshold)
        assert given.upper_bound == best
        assert given.gap == best - given.n_inliers
        expected = ("infeasible" if best == 0 else "optimal") if given.gap == 0 else "bounded"
        assert given.status == (expected if best < len(b) or given.gap == 0 else "heuristic")
        assert given.method == "given"
        mask = rng.random(len(b)) < 0.5
        mask[rng.integers(len(b))] = True
        judged = maxcon.certify(problem, threshold, mask)
        assert judged.upper_bound == best
        part = brute_force_consensus(A[mask], b[mask], threshold)
        assert judged.n_inliers <= part
        assert not judged.inlier_mask[~mask].any()
        if part == mask.sum():  # a set that one model explains counts in full
            assert judged.n_inliers == part


def test_the_optimum_is_recognised_and_a_poor_model_is_not():
    problem = synthetic_hyperplane(np.random.default_rng(3), 80, 0.25, 6)
    best = maxcon.fit(problem, 0.1, method="exact")
    assert best.status == "optimal"
    again = maxcon.certify(problem, 0.1, best.model)
    assert (again.n_inliers, again.gap, again.status) == (best.n_inliers, 0, "optimal")
    poor = maxcon.certify(problem, 0.1, np.zeros(6))
    assert poor.n_inliers < best.n_inliers == poor.upper_bound
    loose = maxcon.certify(problem, 0.1, best.inlier_mask, gap=80)
    assert loose.n_inliers == best.n_inliers
    assert loose.upper_bound >= best.n_inliers


@pytest.mark.parametrize("method", ["ransac", "gnc", "greedy", "auto"])
def test_a_proof_follows_any_method(method):
    problem = synthetic_hyperplane(np.random.default_rng(0), 60, 0.2, 5)
    best = maxcon.fit(problem, 0.1, method="exact")
    result = maxcon.fit(problem, 0.1, method=method, certify=True)
    assert (result.n_inliers, result.status, result.method) == (best.n_inliers, "optimal", method)
    lines = synthetic_hyperplane(np.random.default_rng(0), 60, 0.5, 2)
    assert maxcon.fit(lines, 0.1, method="ransac", samples=5, certify=True).status == "optimal"
    assert maxcon.fit(lines, 0.1, method="ransac", samples=5).status == "heuristic"


def test_a_time_limit_leaves_a_bound():
    problem = synthetic_hyperplane(np.random.default_rng(0), 100, 0.5, 8)
    maxcon.fit(problem, 0.1)  # kernels are compiled
    for options in ({}, {"method": "peel", "restarts": None}):
        began = time.perf_counter()
        result = maxcon.fit(problem, 0.1, certify=True, time_limit=0.5, **options)
        assert time.perf_counter() - began < 5
        assert result.status == "bounded"
        assert 50 <= result.n_inliers < result.upper_bound < 100
    assert maxcon.certify(problem, 0.1, result.inlier_mask, time_limit=0.5).upper_bound < 100


def test_without_a_time_limit_auto_ends_by_itself_and_repeats_itself():
    problem = synthetic_hyperplane(np.random.default_rng(1), 100, 0.5, 8)
    first, second = maxcon.fit(problem, 0.1), maxcon.fit(problem, 0.1)
    assert first.status == "bounded"
    assert first.upper_bound == second.upper_bound < 100
    assert np.array_equal(first.inlier_mask, second.inlier_mask)


@pytest.fixture
def sigint():
    """Let SIGINT interrupt, which in the background job of a shell it does not."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="sends a signal to this process")
@pytest.mark.usefixtures("sigint")
@pytest.mark.parametrize("n_jobs", [1, 2])
def test_ctrl_c_at_many_moments_leaves_a_set_and_a_bound(n_jobs):
    problem = synthetic_hyperplane(np.random.default_rng(1), 100, 0.5, 8)
    best = maxcon.fit(problem, 0.1, time_limit=2)
    for delay in np.random.default_rng(0).uniform(0.0005, 0.15, 12):
        inside = threading.Event()

        def interrupt(delay=delay, inside=inside):
            inside.wait(10)
            time.sleep(delay)
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

        def begun(_, inside=inside):
            inside.set()

        thread = threading.Thread(target=interrupt)
        thread.start()
        result = maxcon.fit(problem, 0.1, method="exact", n_jobs=n_jobs, callback=begun)
        thread.join()
        assert result.status in {"bounded", "heuristic"}
        assert 8 < result.n_inliers <= best.upper_bound
        assert result.upper_bound >= best.n_inliers


def test_explain_from_the_result():
    problem = synthetic_hyperplane(np.random.default_rng(0), 30, 0.3, 2)
    result = maxcon.fit(problem, 0.1)
    outlier = int(np.flatnonzero(~result.inlier_mask)[0])
    answer = result.explain(outlier)
    assert isinstance(answer, maxcon.Explanation)
    assert answer.point == outlier
    assert answer.proven
    assert answer.consensus_with_point + answer.lost == result.n_inliers
    with pytest.raises(ValueError, match="is one"):
        result.explain(int(np.flatnonzero(result.inlier_mask)[0]))


def test_explain_beyond_three_parameters_is_exact():
    A, b = synthetic(np.random.default_rng(0), 11, 4, 0.3)
    problem = maxcon.LinearProblem(A, b)
    result = maxcon.fit(problem, 0.1, method="exact")
    for point in np.flatnonzero(~result.inlier_mask):
        answer = result.explain(int(point))
        rows = np.r_[np.arange(11), np.full(5, point)]
        with_point = brute_force_consensus(A[rows], b[rows], 0.1) - 5
        if answer.consensus_with_point >= 11 - 5:  # else five copies need not be worth it
            assert answer.consensus_with_point == with_point
        assert answer.proven


def test_certificate_file(tmp_path):
    path = tmp_path / "fit.cert.json"
    problem = synthetic_hyperplane(np.random.default_rng(0), 80, 0.2, 4)
    result = maxcon.fit(problem, 0.1, method="exact")
    written = maxcon.write_certificate(path, result)
    report = verify(load(path), problem.A, problem.b)
    assert report.accepted
    assert report.n_inliers == result.n_inliers
    assert report.claimed_bound == written.upper_bound == result.upper_bound
    assert result.upper_bound <= report.proven_bound < 80
    hopeless = maxcon.LinearProblem(np.zeros((3, 2)), [3.0, 4.0, 5.0])
    maxcon.write_certificate(path, maxcon.fit(hopeless, 0.1))
    assert verify(load(path), hopeless.A, hopeless.b).accepted


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (
            {"model_or_mask": [1.0, 2.0, 3.0]},
            ValueError,
            r"model_or_mask must have shape \(2,\), but its shape is \(3,\)",
        ),
        ({"model_or_mask": np.full(20, 0.5)}, ValueError, "model_or_mask must hold 0 and 1 only if it is a mask"),
        ({"model_or_mask": [3, 5, 8]}, ValueError, "of indices, make a mask"),
        ({"model_or_mask": np.zeros(20, dtype=bool)}, ValueError, "model_or_mask must"),
        ({"model_or_mask": np.ones(19, dtype=bool)}, ValueError, r"model_or_mask must have shape \(20,\)"),
        ({"model_or_mask": "best"}, TypeError, "model_or_mask must hold real numbers"),
        ({"threshold": 0}, ValueError, "threshold must be a positive finite number"),
        ({"time_limit": 0}, ValueError, "time_limit must be a positive number of seconds or None"),
        ({"gap": 0.5}, TypeError, "gap must be a whole number"),
        ({"gap": -1}, ValueError, "gap must be at least 0"),
        ({"callback": 3}, TypeError, "callback must be callable"),
        ({"problem": "points"}, TypeError, "problem must be a LinearProblem"),
    ],
)
def test_wrong_arguments(arguments, error, message):
    problem = synthetic_hyperplane(np.random.default_rng(0), 20, 0.3, 2)
    arguments = {"problem": problem, "threshold": 0.1, "model_or_mask": [0.0, 0.0]} | arguments
    with pytest.raises(error, match=message):
        maxcon.certify(**arguments)
    with pytest.raises(TypeError, match="certify must be True or False"):
        maxcon.fit(problem, 0.1, certify=1)
    with pytest.raises(TypeError, match="consensus must be a Consensus"):
        maxcon.write_certificate("x", None)
    with pytest.raises(ValueError, match="time_limit must be"):
        maxcon.write_certificate("x", None, time_limit=-1)


def test_results_of_other_origin_as_their_makers_give_them():
    problem = synthetic_hyperplane(np.random.default_rng(0), 40, 0.3, 2)
    best = maxcon.fit(problem, 0.1)
    mask = best.inlier_mask
    for given in (best, mask, mask.astype(np.uint8), mask.astype(np.uint8)[:, None], mask.tolist()):
        assert maxcon.certify(problem, 0.1, given).n_inliers == best.n_inliers
    two = np.zeros(40, dtype=bool)
    two[:2] = True
    assert maxcon.certify(problem, 1e-9, two).n_inliers >= 1


def test_a_refuted_bound_proves_nothing():
    """Rows on which rounding is larger than the threshold: a model explains what was 'proven' impossible."""
    i = np.arange(12.0)
    problem = maxcon.LinearProblem(np.column_stack([2.0**52 + 64 * i, 2.0**51 + 32 * i, i]), i)
    given = maxcon.certify(problem, 0.25, [0.0, 0.0, 1.0])
    assert given.n_inliers == 12
    assert given.upper_bound == 12


def test_time_stamps_lose_nothing_to_their_offset():
    stamps, values = 1.7e18 + 1024 * np.arange(40.0), np.arange(40.0)
    result = maxcon.fit(maxcon.line(stamps, values), 0.25)
    assert (result.n_inliers, result.status) == (40, "optimal")


def test_columns_that_only_nearly_depend_on_each_other_prove_nothing():
    stamps = 1.7e18 + 1024 * np.arange(40.0)
    A = np.column_stack([stamps, 2 * stamps + 1e3 * np.arange(40.0) ** 2])
    values = np.arange(40.0) ** 2
    result = maxcon.fit(maxcon.LinearProblem(A, values), 0.25)
    assert result.status == "heuristic"
    exactly = maxcon.fit(maxcon.LinearProblem(np.column_stack([stamps, 2 * stamps]), values), 0.25)
    assert exactly.status == "optimal"


def test_repeated_readings_that_differ_by_just_the_threshold():
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 4)).repeat(3, axis=1)
    z = np.float32(0.1 * rng.integers(-3, 4, 12)).astype(float)
    result = maxcon.fit(maxcon.plane(x, y, z), 0.05, time_limit=20)
    assert (result.n_inliers, result.status) == (
        brute_force_consensus(np.column_stack([x, y, np.ones(12)]), z, 0.05),
        "optimal",
    )


def test_tiny_numbers_are_proven_too():
    y = np.array([0, 1, 2, 3, 9, -4.0]) * 1e-150
    result = maxcon.fit(maxcon.line(np.arange(6.0), y), 1e-151)
    assert (result.n_inliers, result.status) == (4, "optimal")


def test_what_is_of_another_problem_is_refused():
    x = np.arange(12.0)
    result = maxcon.fit(maxcon.line(x, x), 0.1)
    other = maxcon.line(x, np.r_[x[:3], 50 * np.sin(x[3:])])
    with pytest.raises(ValueError, match="of other data"):
        maxcon.alternative_optima(other, 0.1, result)


@pytest.mark.parametrize(("n_points", "n_params", "threshold"), [(200, 3, 1e-6), (200, 4, 1e-4), (300, 8, 1e-3)])
def test_hardly_any_inliers(n_points, n_params, threshold):
    """More than 95% of the points are out: the first groups are dealt all the same."""
    rng = np.random.default_rng(n_params)
    problem = maxcon.LinearProblem(rng.normal(size=(n_points, n_params)), rng.normal(size=n_points))
    for options in ({"time_limit": 1.0}, {"method": "exact", "time_limit": 1.0, "n_jobs": 1}):
        result = maxcon.fit(problem, threshold, **options)
        assert n_params <= result.n_inliers <= result.upper_bound <= n_points


def test_a_mask_is_judged_as_given():
    problem = synthetic_hyperplane(np.random.default_rng(0), 60, 0.3, 2)
    best = maxcon.fit(problem, 0.1)
    some = best.inlier_mask & (np.arange(60) % 3 > 0)
    judged = maxcon.certify(problem, 0.1, some)
    assert judged.n_inliers == some.sum()
    assert np.array_equal(judged.inlier_mask, some)
    assert judged.gap == best.n_inliers - some.sum()
    random = np.random.default_rng(1).random(60) < 0.5
    assert maxcon.certify(problem, 0.1, random).inlier_mask[~random].sum() == 0
