"""Graduated non-convexity against its definition in NumPy, and against exact optima."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numba import config

import oracles
from instances import BUILDERS, synthetic
from maxcon.problem import LinearProblem
from maxcon.search.anytime import make_task, run
from maxcon.search.gnc import gnc
from maxcon.search.gnc_kernels import descend, global_start, least_absolute_model, local_start, smallest
from maxcon.search.random_kernels import seed_state
from maxcon.search.sampling_kernels import allocate_scratch

compiled_only = pytest.mark.skipif(config.DISABLE_JIT, reason="takes minutes where kernels are interpreted")


def task_for(A, b, threshold, seed=0, time_limit=None):
    return make_task(LinearProblem(A, b), threshold, np.random.default_rng(seed), time_limit)


def scratch_for(rows):
    return allocate_scratch(rows.At, seed_state(np.random.default_rng(0)))


def size_found(task, **options):
    return run(task, gnc(task, **options)).size


def naive_descent(A, b, c, x, mu, shrink):
    """Yang et al. 2020, section III: weights of Geman-McClure, mu down to 1; the best count on the way."""
    r = b - A @ x
    best, model = -1, x
    while True:
        w = (mu * c**2 / (r**2 + mu * c**2)) ** 2
        root = np.sqrt(w)
        x = np.linalg.lstsq(A * root[:, None], b * root, rcond=None)[0]
        r = b - A @ x
        count = int(np.count_nonzero(np.abs(r) <= c))
        if count > best:
            best, model = count, x
        if mu <= 1:
            return best, model
        mu = max(mu / shrink, 1.0)


@pytest.mark.parametrize(("d", "rate"), [(1, 0.3), (2, 0.5), (3, 0.7), (8, 0.4)])
def test_descents_follow_the_definition(d, rate):
    for seed in range(10):
        rows = (task := task_for(*synthetic(np.random.default_rng(seed), 80, d, rate), 0.1)).rows
        scratch = scratch_for(rows)
        x, best = np.zeros(d), np.zeros(d)
        mu = global_start(rows.At, rows.b, task.limit, scratch, x)
        assert mu == pytest.approx(2 * np.abs(rows.b).max() ** 2 / task.limit**2)
        expected, model = naive_descent(rows.At.T, rows.b, task.limit, x, mu, 1.4)
        size, control = -1, mu
        while control > 0:  # in pieces of seven fits: the cuts must not show
            size, control = descend(rows.At, rows.b, task.limit, control, 1.4, 7, scratch, x, best, size)
        assert size == expected
        assert best == pytest.approx(model, abs=1e-9)


def test_local_descents_start_at_the_median():
    rows = (task := task_for(*synthetic(np.random.default_rng(0), 81, 3, 0.7), 0.1)).rows
    x = np.array([0.3, -0.2, 0.1])
    r = np.abs(rows.b - rows.At.T @ x)
    control = local_start(rows.At, rows.b, task.limit, scratch_for(rows), x)
    assert control == pytest.approx((np.median(r) / task.limit) ** 2)
    assert control > 4
    assert local_start(rows.At, rows.b, 10.0, scratch_for(rows), x) == 4


def test_least_absolute_models_approach_the_l1_fit():
    rows = task_for(*synthetic(np.random.default_rng(3), 60, 3, 0.3), 0.1).rows
    x = np.zeros(3)
    least_absolute_model(rows.At, rows.b, 1e-6, 200, scratch_for(rows), x)
    objective = np.abs(rows.b - rows.At.T @ x).sum()
    rng = np.random.default_rng(0)
    for size in (1e-1, 1e-2, 1e-3):  # convex: no nearby model may be better
        for _ in range(50):
            other = x + size * rng.standard_normal(3)
            assert np.abs(rows.b - rows.At.T @ other).sum() >= objective * (1 - 1e-7)


def test_selection_is_that_of_a_sorted_array():
    rng = np.random.default_rng(0)
    for n in (1, 2, 3, 10, 101):
        for values in (
            rng.random(n),
            rng.integers(0, 3, n).astype(float),
            np.zeros(n),
            np.arange(n, 0.0, -1.0),
        ):
            for k in {0, n // 2, n - 1}:
                assert smallest(values.copy(), k) == np.sort(values)[k]


@pytest.mark.parametrize("name", BUILDERS)
def test_never_above_the_optimum_and_always_feasible(name):
    rng = np.random.default_rng(12)
    for d, N in ((1, 8), (2, 10), (3, 11)):
        A, b = BUILDERS[name](rng, N, d)
        value = oracles.highs_linprog(A, b)[0]
        for threshold in (0.3 * value if value > 1e-9 else 0.1, 1.0):
            optimum = oracles.brute_force_consensus(A, b, threshold)
            limit = threshold + oracles.default_slack(threshold, b)
            seen = set()
            for step in gnc(task_for(A, b, threshold), restarts=20):
                if step.subset is None:
                    continue
                assert 0 < step.subset.sum() <= optimum
                assert oracles.highs_minimax(A[step.subset], b[step.subset]) <= limit * (1 + 1e-12)
                assert step.subset.tobytes() not in seen
                seen.add(step.subset.tobytes())


@pytest.mark.parametrize(("d", "rate"), [(2, 0.3), (2, 0.7), (3, 0.5), (8, 0.5), (8, 0.6)])
def test_recall_without_leverage(d, rate):
    """Two descents find all but a few of the inliers, up to 60% of outliers in eight dimensions."""
    instances = (synthetic(np.random.default_rng(seed), 100, d, rate) for seed in range(20))
    sizes = [size_found(task_for(A, b, 0.1)) for A, b in instances]
    assert np.mean(sizes) >= round(100 * (1 - rate)) - 3


@compiled_only
def test_restarts_help_where_outliers_rule():
    few, many = [], []
    for seed in range(10):
        A, b = synthetic(np.random.default_rng(seed), 100, 8, 0.75)
        few.append(size_found(task_for(A, b, 0.1), restarts=0))
        many.append(size_found(task_for(A, b, 0.1), restarts=100))
    assert all(more >= less for more, less in zip(many, few, strict=True))
    assert np.mean(many) > np.mean(few) + 1


def test_exact_data_and_one_far_outlier():
    """b is linear but for one point: the others fit exactly, however small the threshold."""
    A, b = BUILDERS["linear_but_one"](np.random.default_rng(0), 40, 4)
    for threshold in (1e-3, 1e-6, 1e-9):
        assert size_found(task_for(A, b, threshold)) == 39


def test_restarts_go_on_until_the_time_is_over():
    A, b = synthetic(np.random.default_rng(0), 100, 3, 0.6)
    task = task_for(A, b, 0.1, time_limit=0.05)
    count = 0
    for _ in gnc(task, restarts=None):
        count += 1
        if count == 200:  # far more than any fixed number of restarts would give by default
            break
    assert count == 200
    assert run(task, gnc(task, restarts=None)).size >= 38  # ends: the loop watches the clock


def test_seeds_decide():
    A, b = synthetic(np.random.default_rng(1), 100, 8, 0.75)

    def masks(seed):
        return [s.subset.tobytes() for s in gnc(task_for(A, b, 0.1, seed), restarts=20) if s.subset is not None]

    assert masks(1) == masks(1)
    assert masks(1) != masks(2)


def test_no_parameters_and_no_inliers():
    b = np.array([1.0, 2.0, 2.0, -3.0])
    assert size_found(task_for(np.zeros((4, 2)), b, 2.0)) == 3
    assert size_found(task_for(np.zeros((4, 2)), b, 0.5)) == 0


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"restarts": -1}, ValueError, "restarts must be at least 0"),
        ({"restarts": 1.5}, TypeError, "restarts must be an integer"),
        ({"restarts": None}, ValueError, "restarts must be a number where there is no time limit"),
        ({"shrink": 1.0}, ValueError, "shrink must be above 1"),
        ({"shrink": math.inf}, ValueError, "shrink must be above 1 and finite"),
        ({"shrink": "slow"}, TypeError, "shrink must be a number"),
    ],
)
def test_options_are_checked(options, error, match):
    A, b = synthetic(np.random.default_rng(0), 20, 2, 0.2)
    with pytest.raises(error, match=match):
        gnc(task_for(A, b, 0.1), **options)
