"""RANSAC, LO-RANSAC, the kernels that they share with other searches, and the random numbers of kernels."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time

import numpy as np
import pytest
from numba import config

import oracles
from instances import BUILDERS, synthetic
from maxcon.minimax.linear import compute_residuals
from maxcon.problem import LinearProblem
from maxcon.search.anytime import make_task, run
from maxcon.search.model_kernels import least_squares_model, minimal_model, score, weighted_model
from maxcon.search.random_kernels import draw_next, next_bits, random_below, random_unit, seed_state
from maxcon.search.sampling import inlier_mask, lo_ransac, ransac
from maxcon.search.sampling_kernels import allocate_scratch, sample, samples_needed

METHODS = {"ransac": ransac, "lo_ransac": lo_ransac}

compiled_only = pytest.mark.skipif(config.DISABLE_JIT, reason="takes minutes where kernels are interpreted")


def task_for(A, b, threshold, seed=0, time_limit=None):
    return make_task(LinearProblem(A, b), threshold, np.random.default_rng(seed), time_limit)


def thresholds(A, b):
    """A third of f(all points), and where that is 0 a tenth; and 1, which integers and halves hit exactly."""
    value = oracles.highs_linprog(A, b)[0]
    return (0.3 * value if value > 1e-9 else 0.1, 1.0)


# ------------------------------------------------------------------------------------------ random numbers


def sfc32(state):
    """The generator, in unbounded integers."""
    a, b, c, counter = (int(word) for word in state)
    while True:
        bits = (a + b + counter) % 2**32
        counter = (counter + 1) % 2**32
        a = b ^ (b >> 9)
        b = (c + (c << 3)) % 2**32
        c = ((c << 21) % 2**32 + (c >> 11) + bits) % 2**32
        yield bits


@pytest.mark.parametrize("words", [(1, 2, 3, 4), (0, 0, 0, 0), (2**32 - 1,) * 4])
def test_random_bits_are_those_of_integers(words):
    state = np.array(words, dtype=np.int64)
    expected = sfc32(words)
    for _ in range(1000):
        assert int(next_bits(state)) == next(expected)


def test_random_states_are_seeded_by_the_generator():
    states = [seed_state(np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert np.array_equal(states[0], states[1])
    assert not np.array_equal(states[0], states[2])


def test_random_integers_are_uniform():
    state = seed_state(np.random.default_rng(0))
    n, draws = 7, 21_000
    counts = np.bincount([random_below(state, n) for _ in range(draws)], minlength=n)
    assert len(counts) == n
    assert ((counts - draws / n) ** 2 / (draws / n)).sum() < 22.5  # chi-squared, 6 degrees of freedom: p = 0.001
    units = np.array([random_unit(state) for _ in range(draws)])
    assert units.min() >= 0
    assert units.max() < 1
    assert abs(units.mean() - 0.5) < 4 / math.sqrt(12 * draws)


def test_samples_are_distinct_and_uniform():
    state = seed_state(np.random.default_rng(3))
    pool = np.arange(5)
    counts = np.zeros((5, 5))
    for _ in range(6000):
        drawn = [draw_next(state, pool, place, 5) for place in range(3)]
        assert len(set(drawn)) == 3
        counts[drawn[0], drawn[2]] += 1
    assert sorted(pool) == [0, 1, 2, 3, 4]
    off = counts[~np.eye(5, dtype=bool)]
    assert counts.trace() == 0
    assert ((off - 300) ** 2 / 300).sum() < 43.8  # 19 degrees of freedom: p = 0.001


SCRIPT = """
import numpy as np
from maxcon.problem import LinearProblem
from maxcon.search.anytime import make_task, run
from maxcon.search.gnc import gnc
from maxcon.search.peel import peel
from maxcon.search.sampling import lo_ransac, ransac
rng = np.random.default_rng(5)
A = np.hstack([rng.uniform(-1, 1, (30, 2)), np.ones((30, 1))])
b = A @ rng.uniform(-1, 1, 3) + rng.uniform(-0.1, 0.1, 30)
b[:12] += rng.uniform(-5, 5, 12)
problem = LinearProblem(A, b)
for method, options in (
    (ransac, {"samples": 60}), (lo_ransac, {"samples": 30, "inner": 5}), (gnc, {"restarts": 3}), (peel,
    {"samples": 20})
):
    task = make_task(problem, 0.1, np.random.default_rng(7))
    for step in method(task, **options):
        print("" if step.subset is None else np.flatnonzero(step.subset))
"""


def test_compiled_and_interpreted_kernels_find_the_same():
    def output(disable):
        environment = {**os.environ, "NUMBA_DISABLE_JIT": disable, "PYTHONWARNINGS": "error"}
        return subprocess.run(
            [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=True
        ).stdout

    assert output("0") == output("1") != ""


# ------------------------------------------------------------------------------------------ models and counts


def scratch_for(rows, seed=0):
    return allocate_scratch(rows.At, seed_state(np.random.default_rng(seed)))


def draw_model(rows, scratch):
    """A minimal model and its residuals."""
    x = np.empty(rows.At.shape[0])
    minimal_model(rows.At, rows.b, scratch.pool, len(scratch.pool), scratch.state, scratch.table, scratch.places, x)
    return x, rows.b - rows.At.T @ x


def test_minimal_models_pass_through_their_points():
    A, b = synthetic(np.random.default_rng(0), 40, 5, 0.3)
    rows = task_for(A, b, 0.1).rows
    scratch = scratch_for(rows)
    for _ in range(200):
        _, r = draw_model(rows, scratch)
        assert np.abs(r[scratch.pool[:5]]).max() < 1e-9
        assert sorted(scratch.pool) == list(range(40))


@pytest.mark.parametrize(
    "name",
    ["quantised", "duplicate_rows", "duplicate_a", "collinear_most", "one_x", "zero_rows", "low_dimensional"],
)
def test_minimal_models_pass_over_dependent_points(name):
    """Every model passes through as many independent points as its draws offer."""
    rng = np.random.default_rng(1)
    for d in (2, 3, 4):
        A, b = BUILDERS[name](rng, 30, d)
        rows = task_for(A, b, 0.1).rows
        rank = rows.At.shape[0]
        scratch = scratch_for(rows)
        for _ in range(50):
            _, r = draw_model(rows, scratch)
            drawn = scratch.pool[: 2 * rank + 8]
            hit = drawn[np.abs(r[drawn]) < 1e-7]
            offered = np.linalg.matrix_rank(rows.At[:, drawn], tol=1e-7)
            assert np.linalg.matrix_rank(rows.At[:, hit], tol=1e-7) == offered


@pytest.mark.parametrize("name", ["random_instance", "quantised", "one_x", "leverage", "clustered"])
def test_weighted_models_minimise_the_weighted_squares(name):
    rng = np.random.default_rng(2)
    for d in (1, 2, 5, 8):
        A, b = BUILDERS[name](rng, 33, d)
        rows = task_for(A, b, 0.1).rows
        rank, N = rows.At.shape
        table, x = np.empty((rank, rank + 1)), np.empty(rank)
        for kept in (N, max(rank + 1, N // 2), max(1, rank - 1)):
            w = np.where(np.arange(N) < kept, rng.uniform(0.1, 1.0, N), 0.0)
            root = np.sqrt(w)
            best = np.linalg.lstsq(rows.At.T * root[:, None], rows.b * root, rcond=None)[0]
            weighted_model(rows.At, rows.b, w, np.empty(N), table, x)
            least = (w * (rows.b - rows.At.T @ best) ** 2).sum()
            assert (w * (rows.b - rows.At.T @ x) ** 2).sum() <= least * (1 + 1e-9) + 1e-14
        points = rng.permutation(N)
        least_squares_model(rows.At, rows.b, points, N // 2, table, x)
        half = points[: N // 2]
        best = np.linalg.lstsq(rows.At.T[half], rows.b[half], rcond=None)[0]
        least = ((rows.b - rows.At.T @ best)[half] ** 2).sum()
        assert ((rows.b - rows.At.T @ x)[half] ** 2).sum() <= least * (1 + 1e-9) + 1e-14


@pytest.mark.parametrize("N", [20, 511, 512, 513, 2000])
def test_scores_are_counts_until_the_model_cannot_win(N):
    rng = np.random.default_rng(N)
    for d in (1, 3, 8):
        rows = task_for(*synthetic(rng, N, d, 0.4), 0.1).rows
        x = 0.1 * rng.standard_normal(d)
        count = int(np.count_nonzero(np.abs(rows.b - rows.At.T @ x) <= 0.2))
        r = np.empty(N)
        assert score(rows.At, rows.b, x, 0.2, -1, r) == count
        assert score(rows.At, rows.b, x, 0.2, count - 1, r) == count
        for to_beat in (count, count + 5, N):
            assert score(rows.At, rows.b, x, 0.2, to_beat, r) <= to_beat


def test_samples_needed_for_a_confidence():
    for n_inliers, n_points, n_params in ((50, 100, 2), (30, 100, 8), (10, 12, 3)):
        share = math.comb(n_inliers, n_params) / math.comb(n_points, n_params)
        assert samples_needed(n_inliers, n_points, n_params, 0.99) == pytest.approx(
            math.log(0.01) / math.log(1 - share), rel=1e-9
        )
    assert samples_needed(20, 20, 3, 0.99) == 1
    assert samples_needed(2, 20, 3, 0.99) == math.inf
    assert samples_needed(20, 20, 3, 1.0) == math.inf


def test_sampling_stops_when_confident():
    A, b = synthetic(np.random.default_rng(0), 100, 2, 0.1)
    task = task_for(A, b, 0.1)
    data = (task.rows.At, task.rows.b, task.limit, 0.99)
    settings = (0, 10_000, 0, 0, 1.0, 0, 0, False)
    size, drawn, confident = sample(*data, *settings, scratch_for(task.rows), np.zeros(2), -1)
    assert confident
    assert drawn == math.ceil(samples_needed(size, 100, 2, 0.99)) < 20


@pytest.mark.parametrize(("local", "pause"), [((0, 0, 1.0, 0, 0), False), ((5, 14, 1.5, 4, 21), True)])
def test_chunks_do_not_change_what_is_found(local, pause):
    A, b = synthetic(np.random.default_rng(4), 100, 3, 0.6)
    task = task_for(A, b, 0.1)
    data = (task.rows.At, task.rows.b, task.limit, 1.0)
    found = []
    for ends, pausing in (((300,), False), ((1, 2, 150, 299, 300), False), ((300,), pause)):
        scratch, best, size, drawn = scratch_for(task.rows), np.zeros(3), -1, 0
        for last in ends:
            while drawn < last:
                settings = (drawn, last, *local, pausing)
                size, drawn, confident = sample(*data, *settings, scratch, best, size)
                assert not confident
        assert size == inlier_mask(task.rows, best, task.limit).sum()
        found.append((size, *best))
    assert found[0] == found[1] == found[2]


# ---------------------------------------------------------------------------------------------- the methods


@pytest.mark.parametrize("name", BUILDERS)
def test_never_above_the_optimum_and_always_feasible(name):
    rng = np.random.default_rng(11)
    for d, N in ((1, 8), (2, 10), (3, 11)):
        A, b = BUILDERS[name](rng, N, d)
        for threshold in thresholds(A, b):
            optimum = oracles.brute_force_consensus(A, b, threshold)
            limit = threshold + oracles.default_slack(threshold, b)
            for method in METHODS.values():
                best = 0
                for step in method(task_for(A, b, threshold), samples=300):
                    if step.subset is None:
                        continue
                    size = int(step.subset.sum())
                    assert best < size <= optimum
                    best = size
                    value = oracles.highs_minimax(A[step.subset], b[step.subset])
                    assert value <= limit * (1 + 1e-12)
                assert best > 0 or optimum == 0 or not A.any()


@compiled_only
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("d", "rate", "short"), [(2, 0.3, (4, 1)), (2, 0.7, (4, 1)), (3, 0.5, (8, 2)), (8, 0.2, (20, 4))]
)
def test_recall_on_easy_data(method, d, rate, short):
    """1000 samples find all but a few of the inliers: LO-RANSAC many more of them than RANSAC."""
    sizes, inliers = [], round(100 * (1 - rate))
    for seed in range(20):
        task = task_for(*synthetic(np.random.default_rng(seed), 100, d, rate), 0.1)
        sizes.append(run(task, METHODS[method](task, samples=1000)).size)
    assert np.mean(sizes) >= inliers - short[method == "lo_ransac"]


@pytest.mark.parametrize("method", METHODS)
def test_duplicates_do_not_starve_the_sampler(method):
    """Of 60 points 54 are copies of two: three points drawn blindly are independent 1 time in 4."""
    rng = np.random.default_rng(0)
    A = np.vstack([np.tile([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]], (27, 1)), rng.standard_normal((6, 3))])
    model = np.array([1.0, 2.0, -1.0])
    b = A @ model
    b[54:57] += 3.0
    task = task_for(A, b, 0.01)
    assert run(task, METHODS[method](task, samples=60)).size == 57


@pytest.mark.parametrize("method", METHODS)
def test_seeds_decide(method):
    A, b = BUILDERS["uniform_noise"](np.random.default_rng(1), 100, 4)

    def masks(seed):
        steps = METHODS[method](task_for(A, b, 0.1, seed), samples=100)
        return [step.subset.tobytes() for step in steps if step.subset is not None]

    assert masks(1) == masks(1)
    assert masks(1) != masks(2)


@pytest.mark.parametrize("method", METHODS)
def test_no_parameters_and_no_inliers(method):
    b = np.array([1.0, 2.0, 2.0, -3.0])
    task = task_for(np.zeros((4, 2)), b, 2.0)
    assert run(task, METHODS[method](task)).size == 3
    task = task_for(np.zeros((4, 2)), b, 0.5)
    assert run(task, METHODS[method](task)).subset is None


@compiled_only
@pytest.mark.parametrize("method", METHODS)
def test_the_deadline_stops_a_long_search(method):
    A, b = synthetic(np.random.default_rng(1), 5000, 8, 0.6)
    run(task_for(A, b, 0.1), METHODS[method](task_for(A, b, 0.1), samples=1))  # compiled before the clock runs
    task = task_for(A, b, 0.1, time_limit=0.05)
    began = time.perf_counter()
    best = run(task, METHODS[method](task, samples=10**8))
    assert time.perf_counter() - began < 2
    assert best.size >= 8


@pytest.mark.parametrize(
    ("method", "options", "error", "match"),
    [
        ("ransac", {"samples": 0}, ValueError, "samples must be at least 1"),
        ("ransac", {"samples": 2.5}, TypeError, "samples must be an integer"),
        ("ransac", {"samples": True}, TypeError, "samples must be an integer"),
        ("ransac", {"confidence": 1.0}, ValueError, "confidence must lie between 0 and 1"),
        ("ransac", {"confidence": "high"}, TypeError, "confidence must be a number"),
        ("lo_ransac", {"inner": -1}, ValueError, "inner must be at least 0"),
        ("lo_ransac", {"steps": 0}, ValueError, "steps must be at least 1"),
        ("lo_ransac", {"wide": 0.5}, ValueError, "wide must be at least 1"),
        ("lo_ransac", {"wide": math.nan}, ValueError, "wide must be at least 1"),
    ],
)
def test_options_are_checked(method, options, error, match):
    A, b = synthetic(np.random.default_rng(0), 20, 2, 0.2)
    with pytest.raises(error, match=match):
        METHODS[method](task_for(A, b, 0.1), **options)


def test_inlier_masks_agree_with_the_residuals():
    A, b = synthetic(np.random.default_rng(0), 50, 3, 0.2)
    task = task_for(A, b, 0.1)
    x = np.array([0.1, -0.2, 0.05])
    r = np.empty(50)
    compute_residuals(task.rows.At, task.rows.b, x, r)
    mask = inlier_mask(task.rows, x, 0.3)
    assert np.array_equal(mask, np.abs(task.rows.b - task.rows.At.T @ x) <= 0.3)
    assert np.array_equal(mask, np.abs(r) <= 0.3)
