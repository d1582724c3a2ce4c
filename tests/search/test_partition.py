"""The partition search: its optimum against brute force and big-M, and its bound at any moment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from numba import config

from instances import BUILDERS, synthetic
from maxcon.minimax.clock import read_clock
from maxcon.problem import LinearProblem
from maxcon.search import partition
from maxcon.search.anytime import Best, Task, make_task, run
from maxcon.search.partition import PartitionSearch, exact_partition
from maxcon.search.partition_line import find_line, line_bound, line_intervals
from maxcon.search.partition_state import allocate_state, state_bytes
from maxcon.search.partition_tree import HEIGHT, HI, LEFT, LO, PARENT, RIGHT, SIZE, leaf_size, merge_tree
from oracles import brute_force_consensus, default_slack, highs_minimax, milp_consensus

Floats = npt.NDArray[np.float64]

compiled_only = pytest.mark.skipif(config.DISABLE_JIT, reason="takes minutes where kernels are interpreted")

#: Without compilation a few instances of each kind must do.
SHARE = 0.1 if config.DISABLE_JIT else 1.0


def few(count: int) -> range:
    return range(max(1, round(SHARE * count)))


def task_for(A: Floats, b: Floats, threshold: float, time_limit: float | None = None) -> Task:
    return make_task(LinearProblem(A, b), threshold, np.random.default_rng(0), time_limit)


def threshold_for(rng: np.random.Generator, b: Floats) -> float:
    """A multiple of the spread of b, or a number that makes ties where b is quantised."""
    spread = float(np.abs(b).max())
    return float(rng.choice([0.1, 0.5, 1.0, 2.0, 0.3 * spread + 1e-9, 0.05 * spread + 1e-9]))


def small_instance(name: str, rng: np.random.Generator) -> tuple[Floats, Floats, float]:
    d = int(rng.integers(1, 6))
    A, b = BUILDERS[name](rng, int(rng.integers(d + 1, 14)), d)
    A, b = A[:14], b[:14]
    return A, b, threshold_for(rng, b)


def assert_sound(A: Floats, b: Floats, threshold: float, best: Best, consensus: int) -> None:
    """What is claimed is feasible, and the bound holds."""
    assert best.subset is not None
    assert best.size == np.count_nonzero(best.subset) <= consensus <= best.upper_bound
    limit = threshold + default_slack(threshold, b)
    if best.size:
        assert highs_minimax(A[best.subset], b[best.subset]) <= limit * (1 + 1e-9)


@pytest.mark.parametrize("name", sorted(BUILDERS))
def test_every_family_against_brute_force(name: str) -> None:
    """With any size of the groups, from a good start or an empty one, in any order, with one thread or two."""
    for seed in few(10):
        rng = np.random.default_rng([seed, *name.encode()])
        A, b, threshold = small_instance(name, rng)
        consensus = brute_force_consensus(A, b, threshold)
        task = task_for(A, b, threshold)
        start = None if rng.random() < 0.7 else np.zeros(len(b), dtype=np.bool_)
        leaf = int(rng.choice([1, 2, 3, 5, 8, 20])) if rng.random() < 0.8 else None
        belief = None if seed % 3 else rng.random(len(b))
        best = run(task, exact_partition(task, start=start, belief=belief, leaf=leaf, n_jobs=1 + seed % 2))
        if consensus == 0:
            assert best.upper_bound == 0
            continue
        assert_sound(A, b, threshold, best, consensus)
        assert (best.size, best.upper_bound) == (consensus, consensus)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(BUILDERS))
def test_every_family_at_length(name: str) -> None:
    for seed in range(100, 200):
        rng = np.random.default_rng([seed, *name.encode()])
        A, b, threshold = small_instance(name, rng)
        task = task_for(A, b, threshold)
        best = run(task, exact_partition(task, leaf=int(rng.choice([1, 3, 5, 8, 20])), n_jobs=1))
        assert best.upper_bound == brute_force_consensus(A, b, threshold)
        assert best.size == best.upper_bound


@compiled_only
@pytest.mark.parametrize("seed", range(6))
def test_against_big_m(seed: int) -> None:
    rng = np.random.default_rng(seed)
    d = 4 + seed % 2
    A, b = synthetic(rng, 28, d, 0.25) if seed % 3 else BUILDERS["quantised_halves"](rng, 20, d)
    threshold = 0.1 if seed % 3 else 0.5
    task = task_for(A, b, threshold)
    best = run(task, exact_partition(task, n_jobs=1))
    consensus = milp_consensus(A, b, threshold)
    assert_sound(A, b, threshold, best, consensus)
    assert best.size == best.upper_bound == consensus


@compiled_only
@pytest.mark.parametrize(("N", "rate"), [(100, 0.3), (100, 0.35), (300, 0.2)])
def test_eight_dimensions_are_proven(N: int, rate: float) -> None:
    A, b = synthetic(np.random.default_rng(N), N, 8, rate)
    task = task_for(A, b, 0.1, 60)
    search = PartitionSearch(task, n_jobs=1)
    best = run(task, search.steps())
    assert best.subset is not None
    assert best.size == best.upper_bound >= round((1 - rate) * N)
    assert highs_minimax(A[best.subset], b[best.subset]) <= 0.1 * (1 + 1e-8)
    groups = search.groups()
    points = np.concatenate([each for each, _ in groups])
    assert np.array_equal(np.sort(points), np.arange(N))
    assert sum(bound for _, bound in groups) <= search.least_outliers == N - best.upper_bound
    for points, bound in groups[:2]:  # what is said of a group is true of it, by another solver
        if len(points) <= 30:
            assert len(points) - milp_consensus(A[points], b[points], 0.1) >= bound


@compiled_only
def test_threads_make_no_difference() -> None:
    A, b = synthetic(np.random.default_rng(5), 100, 8, 0.32)
    results = []
    for n_jobs in (1, 2, 3):
        task = task_for(A, b, 0.1)
        best = run(task, exact_partition(task, n_jobs=n_jobs))
        results.append((best.size, best.upper_bound, best.subset.tolist() if best.subset is not None else None))
    assert results[0] == results[1] == results[2]
    assert results[0][0] == results[0][1]


@compiled_only
def test_stopped_at_any_moment_the_bound_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some hundred stops, each after another number of steps, each step a few columns of work."""
    monkeypatch.setattr(partition, "FIRST_BUDGET", 50)
    monkeypatch.setattr(partition, "INTERVAL", 1e-9)  # so that the budget never grows
    stops = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        name = sorted(BUILDERS)[seed % len(BUILDERS)]
        A, b = synthetic(rng, 40, 5, 0.3) if seed % 3 == 0 else BUILDERS[name](rng, 14, int(rng.integers(2, 6)))
        A, b = A[:40], b[:40]
        threshold = 0.1 if seed % 3 == 0 else threshold_for(rng, b)
        whole = task_for(A, b, threshold)
        steps = list(exact_partition(whole, n_jobs=1))
        proven = [step.upper_bound for step in steps if step.upper_bound is not None]
        assert proven == sorted(proven, reverse=True)
        consensus = min([len(b), *proven])
        if len(b) <= 14:
            assert consensus == brute_force_consensus(A, b, threshold)
        for _ in range(12):
            task = task_for(A, b, threshold)
            steps_left = int(rng.integers(1, len(steps) + 1))
            best = Best(upper_bound=len(b))
            for step in exact_partition(task, n_jobs=1 + seed % 2):
                best.upper_bound = min(best.upper_bound, len(b) if step.upper_bound is None else step.upper_bound)
                if step.subset is not None:
                    best.subset, best.size = step.subset, int(np.count_nonzero(step.subset))
                steps_left -= 1
                if steps_left == 0:
                    break
            assert best.size <= consensus <= best.upper_bound
            stops += 1
    assert stops >= 300


@compiled_only
def test_an_allowance_of_work_ends_at_the_same_place() -> None:
    A, b = synthetic(np.random.default_rng(2), 100, 8, 0.45)
    results = []
    for _ in range(2):
        task = task_for(A, b, 0.1)
        search = PartitionSearch(task, n_jobs=1, max_work=300_000)
        best = run(task, search.steps())
        results.append((best.size, best.upper_bound, search._work(), search.expanded))
    assert results[0] == results[1]
    assert 100 < results[0][3] < results[0][2]
    assert best.size < best.upper_bound < 100
    task = task_for(A, b, 0.1)
    more = run(task, exact_partition(task, n_jobs=1, max_work=3_000_000))
    assert more.size <= more.upper_bound < best.upper_bound


@compiled_only
@pytest.mark.parametrize("n_jobs", [1, 2])
def test_memory_ends_the_search_with_its_bound(monkeypatch: pytest.MonkeyPatch, n_jobs: int) -> None:
    A, b = synthetic(np.random.default_rng(2), 60, 5, 0.5)
    monkeypatch.setattr(partition, "MOST_BYTES", 3_000_000)
    task = task_for(A, b, 0.1, 20)
    best = run(task, exact_partition(task, n_jobs=n_jobs))
    assert 0 < best.size <= best.upper_bound <= 60
    monkeypatch.setattr(partition, "MOST_BYTES", 10)
    task = task_for(A, b, 0.1)
    best = run(task, exact_partition(task, n_jobs=n_jobs))
    assert 0 < best.size < best.upper_bound == 60


def test_nothing_fits_and_everything_fits() -> None:
    A = np.ones((6, 4))
    task = task_for(A, np.arange(6.0), 10.0)
    best = run(task, exact_partition(task, n_jobs=1))
    assert (best.size, best.upper_bound) == (6, 6)
    task = task_for(np.zeros((5, 4)), np.array([3.0, -4.0, 5.0, 6.0, 9.0]), 1.0)
    best = run(task, exact_partition(task, n_jobs=1))
    assert (best.size, best.upper_bound) == (0, 0)
    task = task_for(np.zeros((5, 4)), np.array([3.0, -4.0, 0.5, 6.0, 9.0]), 1.0)
    best = run(task, exact_partition(task, n_jobs=1))
    assert (best.size, best.upper_bound) == (1, 1)


def test_options() -> None:
    task = task_for(np.eye(5, 4), np.zeros(5), 1.0)
    with pytest.raises(ValueError, match=r"start must be a boolean mask of shape \(5,\), but it is int"):
        exact_partition(task, start=np.zeros(5, dtype=np.int64))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"^belief must have the shape \(5,\), but its shape is \(4,\)$"):
        exact_partition(task, belief=np.zeros(4))
    for wrong in (1.5, -0.25, np.nan):
        belief = np.array([0.0, 1.0, 0.5, wrong, wrong])
        said = rf"^belief must be probabilities from 0 to 1, but 2 of .* are not; the first is {wrong} at belief\[3\]$"
        with pytest.raises(ValueError, match=said):
            exact_partition(task, belief=belief)
    with pytest.raises(ValueError, match="leaf must be at least 1, but it is 0"):
        exact_partition(task, leaf=0)
    with pytest.raises(ValueError, match="n_jobs must be -1 or at least 1, but it is 0"):
        exact_partition(task, n_jobs=0)
    with pytest.raises(TypeError, match=r"n_jobs must be a whole number, but it is 1\.5"):
        exact_partition(task, n_jobs=1.5)  # type: ignore[arg-type]


# ----------------------------------------------------------------------------------------------- the parts


def test_improbable_points_come_first_and_small_residuals_are_told_apart() -> None:
    """Whitened residuals are relative to the largest |b|, here that of one point: the others' are below 1e-16."""
    rng = np.random.default_rng(0)
    A, b = rng.standard_normal((40, 4)), 1e-18 * rng.standard_normal(40)
    b[0] = 1.0
    task = task_for(A, b, 1e-3)
    start = np.arange(40) > 0
    belief = rng.random(40)
    search = PartitionSearch(task, start=start, belief=belief, n_jobs=1)
    assert [step.upper_bound for step in search.steps()][-1] == 39
    assert search._tree is not None
    rank = np.empty(40)
    rank[search._tree.order] = search._states[0].rank
    residuals = search._residuals_of_fit(start)
    assert 0 < np.sort(residuals)[-2] < 1e-16
    probable = belief > 0.5
    expected = np.lexsort((np.where(probable, -belief, residuals), ~probable))
    assert np.array_equal(np.argsort(rank, kind="stable"), expected)
    assert rank.min() > -1.0  # as branching takes it


def test_the_unit_of_the_data_does_not_matter() -> None:
    """The rows are whitened: not even that of b alone."""
    A, b = synthetic(np.random.default_rng(3), 60, 4, 0.3)
    belief = np.random.default_rng(4).random(60)
    nodes = []
    for unit in (1.0, 2.0**-66, 2.0**66):
        search = PartitionSearch(task_for(A, unit * b, 0.1 * unit), belief=belief, n_jobs=1)
        list(search.steps())
        nodes.append((search.expanded, search.least_outliers, search.n_outliers))
    assert nodes[0] == nodes[1] == nodes[2]
    assert nodes[0][0] > 0


@pytest.mark.parametrize(("N", "leaf"), [(1, 1), (7, 3), (100, 17), (1000, 20), (33, 100)])
def test_merge_tree(N: int, leaf: int) -> None:
    residuals = np.random.default_rng(N).random(N)
    tree = merge_tree(residuals, leaf)
    assert np.array_equal(np.sort(tree.order), np.arange(N))
    assert len(tree.groups) == max(1, round(N / leaf))
    sizes = [len(group) for group in tree.groups]
    assert max(sizes) - min(sizes) <= 1
    worst = np.argsort(-residuals)[: len(sizes)]
    assert all(np.isin(worst, group).sum() == 1 for group in tree.groups)  # each has its share of outliers
    for t, row in enumerate(tree.nodes):
        if row[LEFT] < 0:
            assert row[SIZE] == 1
            assert row[HEIGHT] == 0
            assert (tree.leaf_of[row[LO] : row[HI]] == t).all()
            continue
        left, right = tree.nodes[row[LEFT]], tree.nodes[row[RIGHT]]
        assert left[PARENT] == right[PARENT] == t
        assert (row[LO], left[HI], row[HI]) == (left[LO], right[LO], right[HI])
        assert row[SIZE] == 1 + left[SIZE] + right[SIZE]
        assert row[RIGHT] == row[LEFT] + left[SIZE] == t + 1 + left[SIZE]


def test_leaf_size_is_in_range() -> None:
    for N, d, outliers in [(10, 8, 1), (100, 8, 0), (1000, 8, 300), (5, 1, 5)]:
        assert 1 <= leaf_size(N, d, outliers) <= N


@pytest.mark.parametrize("seed", range(20))
def test_bound_from_a_line_holds(seed: int) -> None:
    """With d - 1 points enforced: no model that keeps them has fewer outliers than the intervals say."""
    rng = np.random.default_rng(seed)
    d, N, limit = int(rng.integers(2, 6)), 30, 0.3
    A = rng.standard_normal((N, d))
    model = rng.standard_normal(d)
    b = A @ model + rng.uniform(-limit, limit, N) + (rng.random(N) < 0.4) * rng.normal(0, 3, N)
    enforced = np.flatnonzero(np.abs(A @ model - b) <= limit)[: d - 1].astype(np.int64)
    line, places = np.zeros((2 * d + 3, d)), np.zeros(d + 1, dtype=np.int64)
    At = np.ascontiguousarray(A.T)
    assert find_line(At, b, enforced, d - 1, line, places) == d - 1
    left, right, work = np.zeros(N), np.zeros(N), np.zeros((3, N))
    line_intervals(At, b, limit, line, left, right, work)
    gain = np.ones(N)
    cap = np.zeros(N)
    gain[enforced], cap[enforced] = 0.0, limit
    lower = line_bound(gain, cap, left, right, work, 0, 1000)
    least = N
    u = line[2 * d]
    for _ in range(4000):  # models that keep the enforced points
        candidate = model + u * rng.normal(0, 0.5) * (1 + 10 * (rng.random() < 0.2)) + 0.05 * rng.standard_normal(d)
        residuals = np.abs(A @ candidate - b)
        if (residuals[enforced] <= limit).all():
            free = np.delete(residuals, enforced)
            least = min(least, int(np.count_nonzero(free > limit)))
    assert lower <= least
    copies = N + 1  # of each enforced point: a best set has them all
    rows = np.r_[np.arange(N), np.repeat(enforced, copies)]
    span = np.abs(model).max() + 5.0
    box = np.full(d, -span), np.full(d, span)
    inliers = milp_consensus(A[rows], b[rows], limit, box=box) - copies * (d - 1)
    assert lower <= N - inliers


def test_no_line_from_dependent_points() -> None:
    A = np.array([[1.0, 2.0, 0.0], [2.0, 4.0, 0.0], [0.0, 0.0, 1.0]])
    line, places = np.zeros((9, 3)), np.zeros(4, dtype=np.int64)
    At = np.ascontiguousarray(A.T)
    assert find_line(At, np.zeros(3), np.array([0, 1]), 2, line, places) == -1
    assert find_line(At, np.zeros(3), np.array([0, 1, 2]), 3, line, places) == 3
    assert places[:2].tolist() == [0, 2]


@compiled_only
def test_little_work_is_begun_where_little_time_is_left(monkeypatch):
    """So that a time limit is not passed by the whole of what an undisturbed search does between two looks."""
    advance, asked = partition.advance, []

    def noted(state, budget):
        asked.append(budget)
        return advance(state, budget)

    monkeypatch.setattr(partition, "advance", noted)
    A, b = synthetic(np.random.default_rng(0), 100, 8, 0.4)
    for left, most in ((0.0, partition.LEAST_BUDGET), (np.inf, np.inf)):
        monkeypatch.setattr(Task, "seconds_left", lambda self, left=left: left)
        asked.clear()
        for _ in zip(range(50), exact_partition(task_for(A, b, 0.1), n_jobs=1), strict=False):
            pass
        assert len(asked) > 5
        assert max(asked) <= most
    assert max(asked) > 10 * partition.LEAST_BUDGET


def test_the_memory_of_a_state_is_reckoned_with_all_its_models() -> None:
    """Each node keeps three models at least, however many nodes and points there are."""
    for n_points in (300, 3000, 12_000):
        A, b = synthetic(np.random.default_rng(0), n_points, 3, 0.3)
        tree = merge_tree(np.abs(b), 7)
        rows = task_for(A, b, 0.1).rows
        taken = sum(array.nbytes for array in allocate_state(rows.At, rows.b, 0.1, tree, np.abs(b)))
        assert 0.7 * taken < state_bytes(3, n_points, tree) < 1.5 * taken


def test_no_deal_is_begun_that_would_not_end_in_the_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    A, b = synthetic(np.random.default_rng(0), 500, 5, 0.3)
    task = replace(task_for(A, b, 0.1), deadline=read_clock() + 60.0)
    monkeypatch.setattr(partition, "FILL_RATE", 1.0)
    monkeypatch.setattr(partition, "allocate_state", lambda *_: pytest.fail("a deal was begun"))
    steps = list(exact_partition(task, start=np.abs(b - A @ np.linalg.lstsq(A, b, rcond=None)[0]) < 0.01, n_jobs=1))
    assert steps[-1].upper_bound == 500
