"""The exact sweep for two parameters, against enumerating subsets and the vertices of the arrangement."""

import time

import numpy as np
import pytest

from instances import BUILDERS, synthetic
from maxcon.problem import LinearProblem, inlier_slack
from maxcon.search import sweep
from maxcon.search.anytime import Best, Task, make_task, run
from maxcon.search.sweep import exact_sweep
from oracles import brute_force_consensus, highs_minimax, line_consensus_bruteforce, milp_consensus


def swept(task: Task) -> Best:
    """Run the sweep, and check that what it found is feasible."""
    best = run(task, exact_sweep(task))
    if best.subset is not None:
        assert best.size == np.count_nonzero(best.subset)
        value = highs_minimax(task.problem.A[best.subset], task.problem.b[best.subset])
        assert value <= task.limit * task.rows.scale * (1 + 1e-12) + 1e-13 * task.problem.scale
    return best


def task_of(A: np.ndarray, b: np.ndarray, threshold: float) -> Task:
    return make_task(LinearProblem(A, b), threshold, np.random.default_rng(0))


def compare(name: str, seed: int) -> None:
    """Compare with all subsets on one instance of a family; thresholds at which quantised data tie."""
    rng = np.random.default_rng([seed, len(name)])
    A, b = BUILDERS[name](rng, int(rng.integers(3, 12)), 2)
    A, b = A[:12], b[:12]
    threshold = float(rng.choice([0.05, 0.1, 0.5, 1.0, 1.5, 2.0, rng.uniform(0.01, 0.5) * np.abs(b).max() + 1e-12]))
    task = task_of(A, b, threshold)
    best = swept(task)
    expected = brute_force_consensus(A, b, threshold, inlier_slack(threshold, task.problem.scale))
    assert (best.size, best.upper_bound) == (expected, expected), (name, seed, threshold)


@pytest.mark.parametrize("name", BUILDERS)
def test_every_family(name):
    for seed in range(12):
        compare(name, seed)


@pytest.mark.slow
@pytest.mark.parametrize("name", BUILDERS)
def test_every_family_at_length(name):
    for seed in range(100, 600):
        compare(name, seed)


@pytest.mark.parametrize("rate", [0.1, 0.5, 0.8])
def test_lines(rate):
    for seed in range(3):
        A, b = synthetic(np.random.default_rng(seed), 30, 2, rate)
        best = swept(task_of(A, b, 0.1))
        assert best.size == best.upper_bound == line_consensus_bruteforce(A[:, 0], b, 0.1)


def test_lines_with_ties():
    """Points on a lattice, residuals at exactly the threshold everywhere."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        x, y = rng.integers(-4, 5, 24).astype(float), rng.integers(-6, 7, 24) / 2.0
        best = swept(task_of(np.column_stack([x, np.ones(24)]), y, 0.5))
        assert best.size == best.upper_bound == line_consensus_bruteforce(x, y, 0.5)


def test_without_intercept_against_milp():
    for seed in range(3):
        A, b = BUILDERS["random_instance"](np.random.default_rng(seed), 40, 2)
        best = swept(task_of(A, b, 0.1))
        assert best.size == best.upper_bound == milp_consensus(A, b, 0.1)


def test_no_point_is_feasible():
    best = swept(task_of(np.zeros((3, 2)), np.array([2.0, -3.0, 4.0]), 1.0))
    assert best.subset is None
    assert best.upper_bound == 0


def test_rank_zero_and_one():
    assert swept(task_of(np.zeros((4, 2)), np.array([0.5, 1.0, 2.0, -1.0]), 1.0)).size == 3
    A = np.outer([1.0, 2.0, -1.0, 0.0, 4.0], [3.0, 6.0])
    best = swept(task_of(A, np.array([1.0, 2.0, -1.0, 0.25, 40.0]), 0.25))
    assert best.size == best.upper_bound == 4


def test_zero_rows_have_no_boundary():
    """Zero rows whose whitened rows a QR decomposition leaves at 1e-16 instead."""
    A = np.zeros((6, 2))
    A[3], A[5] = (1.181122042014593, 0.48882921024838943), (-0.6299454808820882, -0.6335247582499819)
    best = swept(task_of(A, np.array([0.22, 1.65, -4.83, 1.01, 0.995, -1.17]), 1.5))
    assert best.size == best.upper_bound == 4


def test_all_points_fit():
    A, b = synthetic(np.random.default_rng(0), 50, 2, 0.0)
    best = swept(task_of(A, b, 0.1))
    assert best.size == best.upper_bound == 50


def test_just_above_the_limit_is_not_an_inlier():
    """f of the whole is above the limit by less than the sweep is wide: found is what the fit allows."""
    A = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    height = 1.0 + 1.2e-9
    task = task_of(A, np.array([height, -height, 5.0, 5.0]), 1.0)
    best = swept(task)
    assert best.size == 3
    assert best.upper_bound in (3, 4)


def test_pauses_change_nothing(monkeypatch):
    A, b = synthetic(np.random.default_rng(1), 60, 2, 0.5)
    task = task_of(A, b, 0.1)
    whole = swept(task)
    monkeypatch.setattr(sweep, "WORK_PER_YIELD", 1)
    steps = list(exact_sweep(task))
    assert len(steps) == 2 * 60 + 2  # theta = 0, the lines, the bound
    sizes = [int(step.subset.sum()) for step in steps if step.subset is not None]
    assert sizes == sorted(set(sizes))
    assert sizes[-1] == whole.size
    assert [step.upper_bound for step in steps if step.upper_bound is not None] == [whole.size]


def test_time_limit_leaves_a_set_without_a_proof(monkeypatch):
    monkeypatch.setattr(sweep, "WORK_PER_YIELD", 1)
    A, b = synthetic(np.random.default_rng(1), 60, 2, 0.5)
    task = make_task(LinearProblem(A, b), 0.1, np.random.default_rng(0), time_limit=0.0)
    assert task.deadline <= time.perf_counter()
    best = swept(task)
    assert best.upper_bound == 60
    assert best.size < 60


@pytest.mark.parametrize("d", [1, 3])
def test_two_parameters_only(d):
    A, b = BUILDERS["random_instance"](np.random.default_rng(0), 10, d)
    with pytest.raises(ValueError, match="2 parameters"):
        exact_sweep(task_of(A, b, 0.1))
