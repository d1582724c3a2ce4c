"""A* tree search: the same optimum as enumerating subsets, plain and accelerated, and honest when it is stopped."""

import heapq
import itertools
import os
from pathlib import Path

import numpy as np
import pytest
from numba import config

from instances import BUILDERS, synthetic
from maxcon.experiments.bench_cells import Cell, make_instance
from maxcon.minimax import allocate, linear_rows
from maxcon.minimax.linear import INFEASIBLE, OK, cold_fit
from maxcon.problem import LinearProblem
from maxcon.search import astar as astar_module
from maxcon.search.anytime import Best, Task, make_task, run
from maxcon.search.astar import AStarStats, astar, astar_napa, astar_napa_dibp
from maxcon.search.astar_nodes import MADE, allocate_nodes, enlarged, find, make, pop, push
from maxcon.search.insertion_kernels import FEWEST, allocate_insertion, insertion_bound
from maxcon.search.learned import learned
from maxcon.search.sweep import exact_sweep
from oracles import brute_force_consensus, highs_minimax

compiled_only = pytest.mark.skipif(config.DISABLE_JIT, reason="takes minutes where kernels are interpreted")

VARIANTS = {"astar": astar, "astar-napa": astar_napa, "astar-napa-dibp": astar_napa_dibp}


def task_of(A, b, threshold, **limits) -> Task:
    return make_task(LinearProblem(A, b), threshold, np.random.default_rng(0), **limits)


def solve(task: Task, method=astar_napa_dibp, **options) -> tuple[Best, AStarStats]:
    stats = AStarStats()
    best = run(task, method(task, stats=stats, **options))
    return best, stats


def small_instance(name: str, seed: int, most: int = 14):
    """Draw up to `most` points of a family, d in 1..4, and a threshold; round ones make quantised data tie."""
    rng = np.random.default_rng([seed, len(name)])
    d = int(rng.integers(1, 5))
    A, b = BUILDERS[name](rng, int(rng.integers(d + 1, most + 1)), d)
    A, b = A[:most], b[:most]
    some = rng.uniform(0.01, 0.5) * np.abs(b).max() + 1e-12
    return A, b, float(rng.choice([0.05, 0.1, 0.5, 1.0, 1.5, 2.0, some]))


def compare(name: str, seed: int) -> None:
    A, b, threshold = small_instance(name, seed)
    expected = brute_force_consensus(A, b, threshold)
    task = task_of(A, b, threshold)
    others = {
        "astar-dibp": lambda task, **options: astar(task, dibp=True, **options),
        "learned": lambda task, **options: astar(task, learned=True, **options),
        "learned-dibp": lambda task, **options: astar_napa_dibp(task, learned=True, **options),
    }
    for variant, method in (VARIANTS | others).items():
        best, stats = solve(task, method)
        assert (best.size, best.upper_bound) == (expected, expected), (name, seed, variant, stats)
        assert stats.stopped == ""
        assert stats.outliers == stats.proven == len(b) - expected


@pytest.mark.parametrize("name", BUILDERS)
def test_every_family(name):
    for seed in range(8):
        compare(name, seed)


@pytest.mark.slow
@pytest.mark.parametrize("name", BUILDERS)
def test_every_family_at_length(name):
    for seed in range(100, 150):
        compare(name, seed)


@pytest.mark.parametrize("rate", [0.2, 0.4])
def test_lines_as_the_sweep(rate):
    for seed in range(3):
        A, b = synthetic(np.random.default_rng(seed), 60, 2, rate)
        task = task_of(A, b, 0.1)
        expected = run(task, exact_sweep(task)).size
        for method in VARIANTS.values():
            best, _ = solve(task, method)
            assert best.size == best.upper_bound == expected
            assert highs_minimax(A[best.subset], b[best.subset]) <= 0.1 * (1 + 1e-8)


def test_variants_agree_in_eight_dimensions():
    for seed in range(2):
        A, b = synthetic(np.random.default_rng(seed), 100, 8, 0.12)
        found = {solve(task_of(A, b, 0.1), method)[0].size for method in VARIANTS.values()}
        bounds = {solve(task_of(A, b, 0.1), method)[0].upper_bound for method in VARIANTS.values()}
        assert len(found) == 1
        assert found == bounds


# ------------------------------------------------------------------------------------------ node counts


@pytest.mark.parametrize("name", BUILDERS)
def test_acceleration_makes_no_more_nodes_from_the_same_incumbent(name):
    """Given a best set to start with, so that no variant is lucky with the sets that it happens to meet."""
    for seed in range(6):
        A, b, threshold = small_instance(name, seed, 22)
        task = task_of(A, b, threshold)
        first, _ = solve(task)
        assert first.gap == 0
        if first.subset is None:
            continue
        _, plain = solve(task, astar, start=first.subset, node_limit=2000)
        for method in (astar_napa, astar_napa_dibp):
            _, stats = solve(task, method, start=first.subset, node_limit=10_000)
            if plain.stopped == "":
                assert stats.unique <= plain.unique, (name, seed)
                assert stats.expanded <= plain.expanded, (name, seed)


@pytest.mark.parametrize(("N", "d", "rate"), [(100, 2, 0.3), (50, 3, 0.3), (50, 4, 0.2), (100, 8, 0.1)])
def test_acceleration_makes_no_more_nodes_on_the_papers_data(N, d, rate):
    unique = dict.fromkeys(VARIANTS, 0)
    for seed in range(8):
        A, b = synthetic(np.random.default_rng(seed), N, d, rate)
        task = task_of(A, b, 0.1)
        stats = {name: solve(task, method)[1] for name, method in VARIANTS.items()}
        for name in unique:
            unique[name] += stats[name].unique
            assert stats[name].unique <= stats["astar"].unique
            assert stats[name].expanded <= stats["astar"].expanded
    assert unique["astar-napa-dibp"] < unique["astar-napa"] <= unique["astar"]


@compiled_only
def test_the_belief_saves_nodes_on_two_view_problems():
    """From the same set: what is gained is gained by the order in which the heuristic puts points back."""
    expanded = np.zeros(2)
    for number in range(4):
        instance = make_instance(Cell("fundamental", 100, 15), number, 0)
        start = run(task := make_task(instance.problem, instance.threshold, np.random.default_rng(0)), learned(task))
        for k, options in enumerate(({"start": start.subset}, {"learned": True})):
            task = make_task(instance.problem, instance.threshold, np.random.default_rng(0))
            best, stats = solve(task, astar_napa, **options)
            assert best.size == best.upper_bound == start.size
            expanded[k] += stats.expanded
    assert expanded[1] <= 0.75 * expanded[0]


def test_counts_add_up():
    A, b = synthetic(np.random.default_rng(0), 50, 3, 0.3)
    for method in (astar, astar_napa):
        _, stats = solve(task_of(A, b, 0.1), method)
        assert stats.expanded >= 1
        # the root, and each child looked at but those left out; in the last expansion some are not needed
        assert stats.unique <= 1 + stats.generated - stats.repeated - stats.non_adjacent
        assert stats.unique >= 1 + stats.generated - stats.repeated - stats.non_adjacent - 4
        assert stats.attempts == stats.pruned == 0
    _, stats = solve(task_of(A, b, 0.1))
    assert stats.attempts >= stats.expanded
    assert stats.pruned > 0


def test_the_same_search_however_it_is_cut_up(monkeypatch):
    A, b = synthetic(np.random.default_rng(3), 50, 3, 0.35)
    task = task_of(A, b, 0.1)
    whole = {name: solve(task, method)[1] for name, method in VARIANTS.items()}
    assert {name: solve(task, method)[1] for name, method in VARIANTS.items()} == whole
    monkeypatch.setattr(astar_module, "FIRST_FITS", 1)
    monkeypatch.setattr(astar_module, "PAUSE", 0.0)
    monkeypatch.setattr(astar_module, "FIRST_NODES", 8)
    assert {name: solve(task, method)[1] for name, method in VARIANTS.items()} == whole


@pytest.mark.parametrize("method", VARIANTS.values())
def test_duplicates(method):
    """Each point twice: a rule that leaves out children on a tie would leave out all of them."""
    A, b = synthetic(np.random.default_rng(5), 20, 2, 0.3)
    task = task_of(A, b, 0.1)
    expected = run(task, exact_sweep(task)).size
    best, _ = solve(task_of(np.vstack([A, A]), np.r_[b, b], 0.1), method)
    assert best.size == best.upper_bound == 2 * expected


# ------------------------------------------------------------------------------------- stopped early


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_stopped_search_has_a_valid_bound(variant, monkeypatch):
    """Every bound on the way is true, the bounds only fall, and every set is feasible, wherever one stops."""
    monkeypatch.setattr(astar_module, "FIRST_FITS", 1)
    monkeypatch.setattr(astar_module, "PAUSE", 0.0)
    stops = 0
    for k, name in enumerate(
        ["synthetic_some", "quantised", "duplicate_a", "two_structures", "tenths", "opposite_rows"]
    ):
        for seed in range(3):
            A, b, threshold = small_instance(name, 100 * k + seed, 13)
            expected = brute_force_consensus(A, b, threshold)
            task = task_of(A, b, threshold)
            last, size = len(b), 0
            for step in VARIANTS[variant](task, improve=seed > 0):
                stops += 1
                assert expected <= step.upper_bound <= last
                last = step.upper_bound
                if step.subset is not None:
                    assert size < np.count_nonzero(step.subset) <= expected
                    size = np.count_nonzero(step.subset)
                    value = highs_minimax(A[step.subset], b[step.subset])
                    assert value <= task.limit * task.rows.scale * (1 + 1e-12) + 1e-13 * task.problem.scale
            assert (size, last) == (expected, expected)
    assert stops > 100


def test_stops_at_random_nodes():
    rng = np.random.default_rng(0)
    for seed in range(4):
        A, b = synthetic(np.random.default_rng(seed), 60, 2, 0.4)
        task = task_of(A, b, 0.1)
        expected = run(task, exact_sweep(task)).size
        for name, method in VARIANTS.items():
            for limit in rng.integers(1, 60, 4):
                best, stats = solve(task, method, node_limit=int(limit))
                assert best.size <= expected <= best.upper_bound, (name, limit)
                assert stats.unique <= limit + 2
                assert (stats.stopped == "node_limit") == (best.gap > 0)


def test_a_time_limit_leaves_a_set_and_a_bound():
    A, b = synthetic(np.random.default_rng(0), 100, 8, 0.4)
    task = task_of(A, b, 0.1, time_limit=0.2)
    best, stats = solve(task)
    assert 60 <= best.size < best.upper_bound < 100
    assert stats.proven == 100 - best.upper_bound > 8


def test_memory_ends_the_search_with_its_bound(monkeypatch):
    monkeypatch.setattr(astar_module, "FIRST_NODES", 16)
    A, b = synthetic(np.random.default_rng(0), 50, 3, 0.4)
    task = task_of(A, b, 0.1)
    whole, all_of_it = solve(task, astar_napa)
    assert all_of_it.unique > 500
    best, stats = solve(task, astar_napa, memory_limit=20_000)
    assert stats.stopped == "memory_limit"
    assert 16 < stats.unique < 500
    assert best.size <= whole.size < best.upper_bound < 50
    assert solve(task, astar_napa, memory_limit=0)[1].unique <= 16


# ------------------------------------------------------------------------------------------- the parts


def feasible_counts(rows, limit):
    """Every subset (as bits) that fits within the limit."""
    N = rows.b.shape[0]
    fits = np.zeros(2**N, dtype=bool)
    for bits in range(2**N):
        mask = (bits >> np.arange(N)) & 1 == 1
        workspace = allocate(rows, mask)
        assert cold_fit(*workspace) == OK
        fits[bits] = workspace.x[-1] <= limit
    return fits


@pytest.mark.parametrize("name", ["synthetic_some", "quantised", "duplicate_a", "uniform_noise", "collinear_most"])
def test_heuristic_is_admissible(name):
    """With and without enforced points and doubts it is at most the fewest points that must go, and 1 if any must."""
    for seed in range(2):
        rng = np.random.default_rng([seed, len(name)])
        A, b = BUILDERS[name](rng, 9, 2)
        threshold = 0.3 * float(np.abs(b).max()) + 1e-9
        task = task_of(A, b, threshold)
        fits = feasible_counts(task.rows, task.limit)
        for _ in range(40):
            inside = rng.random(9) < 0.8
            enforced = inside & (rng.random(9) < 0.25)
            workspace = allocate(task.rows, inside)
            workspace.gain[enforced] = 0.0
            workspace.cap[enforced] = task.limit
            set_bits, must = (int(mask @ (1 << np.arange(9))) for mask in (inside, enforced))
            rest = [s for s in range(512) if s & ~set_bits == 0 and s & must == must and fits[s]]
            status = cold_fit(*workspace)
            if not rest:
                assert status == INFEASIBLE
                continue
            assert status == OK
            fewest = int(inside.sum()) - max(s.bit_count() for s in rest)
            scratch = allocate_insertion(task.rows, believing=bool(rng.random() < 0.7))
            scratch.doubt[:] = rng.integers(0, 5, len(scratch.doubt)) / 4
            bound = insertion_bound(workspace, task.limit, 100, scratch)
            assert bound <= fewest
            assert (bound >= 1) == (fewest >= 1)
            met = int(scratch.inliers @ (1 << np.arange(9)))
            assert fits[met]
            assert scratch.counts[FEWEST] == 9 - met.bit_count()


def test_heuristic_ends_where_ties_abound():
    """All points on a lattice, duplicates, half of them far away: the points put back do not go round in a circle."""
    rng = np.random.default_rng(0)
    for d in (1, 2, 3):
        A = rng.integers(-1, 2, (200, d)).astype(float)
        b = rng.integers(-3, 4, 200).astype(float)
        rows = linear_rows(LinearProblem(A, b))
        workspace = allocate(rows)
        assert cold_fit(*workspace) == OK
        scratch = allocate_insertion(rows)
        assert insertion_bound(workspace, 0.5 / rows.scale, 1000, scratch) >= 10


def test_queue_and_table():
    rng = np.random.default_rng(0)
    nodes = allocate_nodes(20, 4)
    expected, sets = [], {}
    for number in range(300):
        if number == len(nodes.key):
            nodes = enlarged(nodes, 2 * number)
        removed = rng.integers(0, 256, 3).astype(np.uint8)
        key = int(rng.integers(0, 8))  # keys collide all the time
        assert find(nodes, removed, key) == sets.get((key, removed.tobytes()), -1)
        level, bound, value = 1, int(rng.integers(0, 5)), float(rng.integers(0, 5))
        node = make(nodes, removed, key, level, bound, value)
        sets.setdefault((key, removed.tobytes()), node)
        push(nodes, node)
        heapq.heappush(expected, (bound, value, node))
        if rng.random() < 0.3:
            assert pop(nodes) == heapq.heappop(expected)[2]
    assert nodes.sizes[MADE] == 300
    while expected:
        assert pop(nodes) == heapq.heappop(expected)[2]


def test_options():
    task = task_of(*synthetic(np.random.default_rng(0), 20, 2, 0.3), 0.1)
    for options, error, message in [
        ({"napa": 1}, TypeError, "napa must be True or False"),
        ({"dibp": "yes"}, TypeError, "dibp must be True or False"),
        ({"improve": None}, TypeError, "improve must be True or False"),
        ({"learned": 1}, TypeError, "learned must be True or False"),
        ({"node_limit": 0}, ValueError, "node_limit must be at least 1"),
        ({"node_limit": 1.5}, TypeError, "node_limit must be an integer"),
        ({"memory_limit": -1}, ValueError, "memory_limit must be at least 0"),
        ({"stats": {}}, TypeError, "stats must be an AStarStats"),
        ({"start": np.ones(20, dtype=bool)}, ValueError, "start must be feasible"),
        ({"start": np.ones(3, dtype=bool)}, ValueError, "start must have shape"),
    ]:
        with pytest.raises(error, match=message):
            astar(task, **options)


def test_nothing_fits_and_everything_fits():
    best, stats = solve(task_of(np.zeros((3, 2)), np.array([2.0, -3.0, 4.0]), 1.0))
    assert best.subset is None
    assert (best.upper_bound, stats.outliers) == (0, 3)
    A, b = synthetic(np.random.default_rng(0), 50, 3, 0.0)
    best, stats = solve(task_of(A, b, 0.1))
    assert best.size == best.upper_bound == 50
    assert (stats.unique, stats.expanded) == (1, 0)


# --------------------------------------------------------------------------------------------- real data


def kitti_pair():
    """KITTI_417_420.mat with F32 = 1, as the authors of A*-NAPA-DIBP pose it: N = 385, d = 8."""
    folder = Path(os.environ.get("MAXCON_DATA", Path(__file__).parents[2] / ".." / "shared" / "data"))
    path = folder / "two_view" / "mat" / "KITTI_417_420.mat"
    if not path.exists():
        pytest.skip(f"needs {path.name} in the folder that MAXCON_DATA names, under two_view/mat")
    from scipy.io import loadmat  # noqa: PLC0415

    data = loadmat(path, squeeze_me=True, struct_as_record=False)["data"]
    (x, y), (u, v) = data.x1[:2], data.x2[:2]
    return np.column_stack([u * x, u * y, u, v * x, v * y, v, x, np.ones_like(x)]), -y


@pytest.mark.slow
@pytest.mark.parametrize(("threshold", "outliers", "most_nodes"), [(0.03, 19, 132), (0.02, 25, 400)])
def test_kitti(threshold, outliers, most_nodes):
    """At .03 the published code makes 132 unique nodes."""
    A, b = kitti_pair()
    for improve in (True, False):
        best, stats = solve(task_of(A, b, threshold), improve=improve)
        assert len(b) - best.size == len(b) - best.upper_bound == outliers
        assert stats.unique <= most_nodes


@pytest.mark.slow
def test_napa_against_plain_on_many_ties():
    """Quantised data with all points repeated, where only the careful reading of "adjacent" is safe."""
    for seed, d in itertools.product(range(60), (1, 2, 3)):
        rng = np.random.default_rng([seed, d])
        A = rng.integers(-2, 3, (7, d)).astype(float)
        b = rng.integers(-2, 3, 7).astype(float)
        A, b = np.vstack([A, A]), np.r_[b, b]
        expected = brute_force_consensus(A, b, 0.5)
        for method in VARIANTS.values():
            best, _ = solve(task_of(A, b, 0.5), method)
            assert best.size == best.upper_bound == expected
