from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import pytest
from numba import config

from instances import BUILDERS, synthetic
from maxcon.problem import LinearProblem
from maxcon.search import stabbing
from maxcon.search.anytime import Best, Step, Task, make_task, run
from maxcon.search.stabbing import exact_stabbing
from maxcon.search.stabbing_kernels import PROVEN, RESERVE, USED, advance
from maxcon.search.stabbing_prism import BOX_SIZE, CENTRE, HALF, WINDOW, Prism, _compare, _profile, bound_prism
from maxcon.search.stabbing_rows import Strips, dependent_rows
from oracles import (
    brute_force_consensus,
    default_slack,
    exact_rank,
    highs_minimax,
    line_consensus_bruteforce,
    milp_consensus,
)

Floats = npt.NDArray[np.float64]

#: Without compilation the kernels take some hundred times as long: look at a part only.
SHARE = 0.3 if config.DISABLE_JIT else 1.0


def few(count: int) -> range:
    return range(max(1, round(SHARE * count)))


def task_for(A: Floats, b: Floats, threshold: float, seed: int = 0, gap: int = 0) -> Task:
    return make_task(LinearProblem(A, b), threshold, np.random.default_rng(seed), gap=gap)


def solve(A: Floats, b: Floats, threshold: float, seed: int = 0, gap: int = 0) -> Best:
    task = task_for(A, b, threshold, seed, gap)
    return run(task, exact_stabbing(task))


def assert_proven(A: Floats, b: Floats, threshold: float, consensus: int) -> Best:
    best = solve(A, b, threshold)
    assert (best.size, best.upper_bound) == (consensus, consensus)
    if best.subset is not None:
        limit = threshold + default_slack(threshold, b)
        assert highs_minimax(A[best.subset], b[best.subset]) <= limit * (1 + 1e-12)
    return best


def threshold_for(rng: np.random.Generator, b: Floats) -> float:
    """A multiple of the spread of b, or a number that makes ties where b is quantised."""
    spread = float(np.median(np.abs(b - np.median(b)))) or float(np.abs(b).max()) or 1.0
    if rng.random() < 0.4:
        return float(rng.choice([0.1, 0.25, 0.3, 0.5, 1.0, 2.0]))
    return spread * float(rng.choice([0.01, 0.1, 0.3, 1.0]))


def family_instance(name: str, rng: np.random.Generator) -> tuple[Floats, Floats, float]:
    d = int(rng.integers(1, 4))
    A, b = BUILDERS[name](rng, int(rng.integers(d + 1, 12)), d)
    A, b = A[:12, :3], b[:12]
    if len(b) <= A.shape[1]:
        A, b = np.vstack([A, A, A, A])[: A.shape[1] + 1], np.hstack([b, b, b, b])[: A.shape[1] + 1]
    return A, b, threshold_for(rng, b)


def lattice_instance(rng: np.random.Generator) -> tuple[Floats, Floats, float]:
    """Few directions, few lines, zeros, multiples: where "infinitely steep" models hold many points."""
    d = int(rng.integers(1, 4))
    N = int(rng.integers(d + 1, 13))
    A = rng.integers(-2, 3, (N, d)).astype(float)
    match int(rng.integers(0, 6)):
        case 0:
            A[:, -1] = 1.0
        case 1:
            A[:, 0] = rng.integers(0, 2, N)
            A[:, -1] = 1.0
        case 2:
            A *= rng.choice([0.0, 1.0, 1.0, 1.0], (N, d))
        case 3:
            A = rng.integers(-2, 3, (3, d))[rng.integers(0, 3, N)] * rng.choice([0.5, 1.0, 2.0, -1.0], (N, 1))
        case 4:
            A = rng.integers(0, 2, (N, d)).astype(float)
        case _:
            along, offset = rng.integers(-2, 3, (2, 2, d))
            which = rng.integers(0, 2, N)
            A = (offset[which] + rng.integers(-3, 4, (N, 1)) * along[which]).astype(float)
            A[:, -1] = 1.0
    b = rng.integers(-4, 5, N).astype(float)
    scale = 2.0 ** rng.integers(-20, 21)
    return A * 2.0 ** rng.integers(-20, 21, d), b * scale, scale * float(rng.choice([0.01, 0.25, 0.5, 1.0]))


@pytest.mark.parametrize("name", BUILDERS)
def test_family_matches_enumeration(name: str) -> None:
    for seed in few(10):
        A, b, threshold = family_instance(name, np.random.default_rng([seed, *name.encode()]))
        assert_proven(A, b, threshold, brute_force_consensus(A, b, threshold))


@pytest.mark.parametrize("seed", few(10))
def test_lattice_matches_enumeration(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in few(30):
        A, b, threshold = lattice_instance(rng)
        assert_proven(A, b, threshold, brute_force_consensus(A, b, threshold))


@pytest.mark.slow
@pytest.mark.parametrize("name", [*BUILDERS, "lattice"])
def test_many_match_enumeration(name: str) -> None:
    for seed in range(1000, 1100):
        rng = np.random.default_rng([seed, *name.encode()])
        A, b, threshold = lattice_instance(rng) if name == "lattice" else family_instance(name, rng)
        assert_proven(A, b, threshold, brute_force_consensus(A, b, threshold))


@pytest.mark.parametrize("seed", few(6))
def test_copies_multiply_the_consensus(seed: int) -> None:
    """Forty copies of each point: enough points for bins, and the answer is known from one copy."""
    rng = np.random.default_rng(seed)
    for _ in few(8):
        A, b, threshold = lattice_instance(rng)
        consensus = 40 * brute_force_consensus(A, b, threshold)
        order = rng.permutation(40 * len(b))
        assert_proven(np.repeat(A, 40, axis=0)[order], np.repeat(b, 40)[order], threshold, consensus)


@pytest.mark.parametrize("seed", few(40))
def test_line_matches_enumeration(seed: int) -> None:
    rng = np.random.default_rng(seed)
    N = int(rng.integers(20, 41))
    x = rng.integers(-6, 7, N) / 2.0 if seed % 2 else rng.uniform(-1, 1, N)
    y = np.round(2 * x + rng.uniform(-2, 2, N), 1 if seed % 4 < 2 else 9)
    threshold = float(rng.choice([0.05, 0.1, 0.3]))
    assert_proven(np.column_stack([x, np.ones(N)]), y, threshold, line_consensus_bruteforce(x, y, threshold))


@pytest.mark.parametrize("seed", few(5))
def test_plane_matches_milp(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, b = synthetic(rng, 24, 3, 0.4) if seed % 2 else BUILDERS["uniform_noise"](rng, 18, 3)
    assert_proven(A, b, 0.1, milp_consensus(A, b, 0.1))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(30))
def test_more_planes_match_milp(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    A, b = synthetic(rng, 40, 3, 0.5) if seed % 2 else BUILDERS["quantised_halves"](rng, 24, 3)
    assert_proven(A, b, 0.1, milp_consensus(A, b, 0.1))


@pytest.mark.parametrize("rate", [0.1, 0.5, 0.8])
@pytest.mark.parametrize("d", [2, 3])
def test_planted_model_is_found(d: int, rate: float) -> None:
    """Too large to enumerate; but what was planted is known, and no method may prove less."""
    for seed in few(60):
        rng = np.random.default_rng([seed, d])
        N = int(rng.choice([40, 100, 250]))
        A, b = synthetic(rng, N, d, rate)
        best = solve(A, b, 0.1, seed)
        assert best.gap == 0
        assert best.size >= N - round(rate * N)


@pytest.mark.parametrize("d", [2, 3])
def test_steep_models_are_not_missed(d: int) -> None:
    """A slope of a million beside a vertical stack of points that no model holds."""
    rng = np.random.default_rng(d)
    A = np.column_stack([*(1e-6 * rng.uniform(-1, 1, (d - 1, 20))), np.ones(20)])
    b = A @ np.array([1e6, -2e6, 0.5])[-d:] + rng.uniform(-0.1, 0.1, 20)
    stack = np.column_stack([np.full((30, d - 1), 0.5), np.ones(30)])
    heights = np.arange(30.0)
    assert_proven(np.vstack([A, stack]), np.hstack([b, heights]), 0.1, 20)


@pytest.mark.parametrize("d", [2, 3])
def test_vertical_stacks(d: int) -> None:
    """Infinitely steep models hold far more points than any model: all of a vertical line or plane."""
    rng = np.random.default_rng(d)
    N = 60
    x = np.where(rng.random(N) < 0.9, 3.0, rng.integers(-8, 9, N)) if d == 2 else rng.integers(-8, 9, N).astype(float)
    z = np.where(np.arange(N) < 15, 2.0 * x, rng.integers(-900, 900, N))
    if d == 2:
        assert_proven(np.column_stack([x, np.ones(N)]), z, 0.25, line_consensus_bruteforce(x, z, 0.25))
        return
    A = np.column_stack([x, 3.0 * x + 1.0, np.ones(N)])  # of rank 2: one plane
    line = line_consensus_bruteforce(x, z, 0.25)
    assert_proven(A, z, 0.25, line)
    A, z = np.vstack([A, [0.0, 5.0, 1.0]]), np.append(z, 777.0)
    assert_proven(A, z, 0.25, line + 1)  # a plane through that line and one more point


@pytest.mark.parametrize("gap", [2e-8, 2e-10])
def test_parallel_strips_that_just_fail_to_meet(gap: float) -> None:
    """Two points at the same x, further apart than twice the limit by `gap`: the slack decides."""
    A = np.array([[0.0, 1.0], [0.0, 1.0], [1.0, 1.0], [3.0, 1.0]])
    b = np.array([0.0, 1.0 + gap, 5.0, -7.0])
    want = brute_force_consensus(A, b, 0.5)
    assert want == (2 if gap > 1e-9 else 3)
    assert_proven(A, b, 0.5, want)


@pytest.mark.parametrize("fits", [256, 0])
def test_dependent_strips_that_just_fail_to_meet(monkeypatch: pytest.MonkeyPatch, fits: int) -> None:
    """Three points on a line, together too far off by 1e-8 only, over a long range of planes: the engine decides.

    Without it, the bound stays where it is.
    """
    monkeypatch.setattr(stabbing, "FITS", fits)
    A = np.array([[0, 0, 1], [1, 0, 1], [2, 0, 1], [0, 1, 1], [5, 2, 1]], dtype=float)
    b = np.array([0.0, 1.0 + 2e-8, 0.0, 500.0, -700.0])
    consensus = brute_force_consensus(A, b, 0.5)
    best = solve(A, b, 0.5)
    assert best.size == consensus == 3
    assert best.upper_bound == (3 if fits else 4)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_everything_or_nothing(d: int) -> None:
    rng = np.random.default_rng(d)
    A, b = rng.uniform(-1, 1, (30, d)), rng.uniform(-1, 1, 30)
    assert_proven(A, b, 10.0, 30)
    zero = np.zeros_like(A)
    assert_proven(zero, b, 0.5, int(np.count_nonzero(np.abs(b) <= 0.5)))
    nothing = solve(zero, b + 3.0, 0.5)
    assert nothing.subset is None
    assert nothing.upper_bound == 0
    A[:10] = 0.0  # with some rows 0, of which some are always inliers
    b[:5], b[5:10] = 0.05, 7.0
    best = solve(A, b, 0.1)
    assert best.subset is not None
    assert best.subset[:5].all()
    assert not best.subset[5:10].any()
    assert best.size == best.upper_bound == 5 + solve(A[10:], b[10:], 0.1).size


def steps_of(task: Task) -> Iterator[Step]:
    bound = task.problem.n_points
    for step in exact_stabbing(task):
        assert step.upper_bound is not None
        assert step.upper_bound <= bound
        bound = step.upper_bound
        yield step


@pytest.mark.parametrize("seed", few(30))
def test_every_step_is_valid(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    """Stopped after any prism, the bound holds, has never risen, and the set is feasible."""
    monkeypatch.setattr(stabbing, "BUDGET", 1)
    rng = np.random.default_rng(seed)
    if seed % 2:
        A, b, threshold = lattice_instance(rng)
    else:
        A, b = BUILDERS["uniform_noise"](rng, 12, 2 + seed % 4 // 2)
        threshold = 0.1
    consensus = brute_force_consensus(A, b, threshold)
    sizes = [0]
    for step in steps_of(task_for(A, b, threshold)):
        assert step.upper_bound is not None
        assert step.upper_bound >= consensus
        if step.subset is not None:
            sizes.append(int(np.count_nonzero(step.subset)))
            assert sizes[-1] <= consensus
            limit = threshold + default_slack(threshold, b)
            assert highs_minimax(A[step.subset], b[step.subset]) <= limit * (1 + 1e-12)
    assert step.upper_bound == max(sizes) == consensus


@pytest.mark.parametrize(
    ("nodes", "lists"), [(1100, (32, 0)), (4096, (6, 0)), (1100, (6, 0))], ids=["nodes", "lists", "both"]
)
@pytest.mark.parametrize("d", [2, 3])
def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch, d: int, nodes: int, lists: tuple[int, int]) -> None:
    """Out of memory, it goes depth-first and without lists, to the same end."""
    A, b = BUILDERS["uniform_noise"](np.random.default_rng(7), 20 if config.DISABLE_JIT else 60, d)
    expected = solve(A, b, 0.02)
    for name, value in [("FIRST_NODES", nodes), ("MOST_NODES", nodes), ("FIRST_LISTS", lists), ("MOST_LISTS", lists)]:
        monkeypatch.setattr(stabbing, name, value)
    task = task_for(A, b, 0.02)
    search = stabbing._Search(task)
    best = run(task, search.steps())
    assert best.size == best.upper_bound == expected.size
    assert len(search.tree.bound) == nodes
    if nodes < 2 * RESERVE:  # the queue is full early on, and a dive takes few more
        assert search.tree.state[USED] < nodes - RESERVE + 200
    assert len(search.tree.arena) == lists[0] * len(b)


def test_bound_is_honest_where_a_dive_runs_out_of_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stabbing, "FIRST_NODES", 8)
    monkeypatch.setattr(stabbing, "MOST_NODES", 8)
    A, b = BUILDERS["uniform_noise"](np.random.default_rng(7), 14, 3)
    consensus = brute_force_consensus(A, b, 0.02)
    best = solve(A, b, 0.02)
    assert best.size <= consensus <= best.upper_bound
    assert best.gap > 0


@pytest.mark.parametrize("d", [2, 3])
def test_stops_at_the_gap_asked_for(d: int) -> None:
    A, b = synthetic(np.random.default_rng(3), 60, d, 0.8)
    exact = solve(A, b, 0.1)
    loose = solve(A, b, 0.1, gap=5)
    assert exact.gap == 0
    assert loose.gap <= 5
    assert loose.size <= exact.size <= loose.upper_bound


def test_same_seed_same_set() -> None:
    A, b = synthetic(np.random.default_rng(3), 80, 3, 0.6)
    first, second = solve(A, b, 0.1, seed=5), solve(A, b, 0.1, seed=5)
    assert first.subset is not None
    assert second.subset is not None
    assert (first.subset == second.subset).all()
    assert {solve(A, b, 0.1, seed=seed).size for seed in range(5)} == {first.size}


def test_more_than_three_parameters_are_refused() -> None:
    A, b = BUILDERS["random_instance"](np.random.default_rng(0), 20, 4)
    with pytest.raises(ValueError, match="at most 3 independent parameters, but this problem has 4"):
        solve(A, b, 0.1)
    A[:, 3] = A[:, 0] + 2.0 * A[:, 1]  # dependent, not in floats but within the engine's rank tolerance
    assert solve(A, b, 0.1).gap == 0


def some_strips(rng: np.random.Generator, n: int, k: int) -> Strips:
    flat = int(rng.integers(0, n // 4 + 1))
    a0, a1 = rng.normal(size=(2, n))
    if k == 1:
        a1[:] = 0.0
    y, reach = rng.normal(size=n), rng.uniform(0.01, 0.5, n)
    if rng.random() < 0.5:
        a0, a1, y = np.round(a0), np.round(a1), np.round(y)
    rounding = np.full(n, 1e-13)
    return Strips(a0, a1, y - reach, y + reach, rounding, rounding, n - flat)


@pytest.mark.parametrize("seed", few(200))
def test_prism_bound_holds_for_models_in_it(seed: int) -> None:
    """No model of a prism has more inliers than its bound; those above the best are left in its window."""
    rng = np.random.default_rng(seed)
    n, k = int(rng.choice([8, 30, 200])), int(rng.integers(1, 3))
    strips = some_strips(rng, n, k)
    prism = Prism(
        np.zeros(BOX_SIZE),
        np.empty(n + 1, dtype=np.int32),
        np.empty((4, n + 1)),
        np.empty(4 * n + 9, dtype=np.int32),
        np.array([int(rng.integers(0, n // 3))]),
        np.zeros(4),
    )
    centre, half = rng.uniform(-1, 1, 3), 2.0 ** rng.integers(-8, 0, 3)
    half[k:2] = 0.0
    if rng.random() < 0.5:
        centre[2], half[2] = 1.0, 0.0
    else:
        centre[2], half[0] = half[2] * rng.choice([1.0, 3.0]), 0.0
    prism.box[CENTRE : CENTRE + 3], prism.box[HALF : HALF + 3] = centre, half
    window = (-np.inf, np.inf) if rng.random() < 0.5 else tuple(np.sort(rng.normal(size=2)))
    prism.box[WINDOW : WINDOW + 2] = window
    best = int(prism.best[0])
    bound, base, m = bound_prism(strips, prism, np.arange(n, dtype=np.int32), 0)
    kept = set(prism.kept[:m].tolist())
    regular = np.arange(n) < strips.n_regular
    for _ in range(200):
        sigma0, sigma1, w = centre + half * rng.choice([rng.uniform(-1, 1, 3), rng.choice([-1.0, 1.0], 3)])
        shift = strips.a0 * sigma0 + strips.a1 * sigma1
        edges = np.hstack([strips.low * w - shift, strips.high * w - shift])
        tau = float(rng.choice(edges)) if np.isinf(window[0]) or rng.random() < 0.5 else rng.uniform(*window)
        if not window[0] <= tau <= window[1]:
            continue
        value = shift + np.where(regular, tau, 0.0)
        holding = (strips.low * w <= value) & (value <= strips.high * w)
        count = int(np.count_nonzero(holding))
        assert count <= max(bound, best)
        if bound > best and count > best and holding[regular].any():  # else it can as well be in the window
            assert prism.box[WINDOW] - 1e-12 <= tau <= prism.box[WINDOW + 1] + 1e-12
            assert base <= count <= base + len(kept.intersection(np.flatnonzero(holding).tolist()))
    assert best <= prism.best[0] <= max(bound, best)


def test_corner_of_a_prism_is_searched() -> None:
    """One point is undecided, so the undecided are dependent; but together with the base they are not."""
    a0, low = np.array([0.0] * 5 + [1.0]), np.array([-1.0] * 5 + [0.17])
    strips = Strips(a0, np.zeros(6), low, low + 2.0, np.full(6, 1e-15), np.full(6, 1e-15), 6)
    prism = Prism(
        np.zeros(BOX_SIZE),
        np.empty(7, dtype=np.int32),
        np.empty((4, 7)),
        np.empty(40, dtype=np.int32),
        np.array([5]),
        np.zeros(4),
    )
    root = np.array([[0.0, 0.0, 1.0, 0.1, 0.0, 0.0, -0.1, 0.1]])
    assert advance(strips, prism, stabbing._new_tree(6, 1), root, 1, 100_000, 0) == PROVEN
    assert prism.best[0] == 6
    sigma, _, w, tau = prism.model
    assert w == 1.0
    assert sigma + tau >= 0.17


def test_dependent_rows() -> None:
    def dependent(a0: list[float], a1: list[float], k: int, flat: int = 0) -> bool:
        n = len(a0)
        strips = Strips(np.array(a0, dtype=float), np.array(a1, dtype=float), *np.zeros((4, n)), n - flat)
        return bool(dependent_rows(strips, np.arange(n, dtype=np.int32), k))

    assert dependent([2, 2, 2], [0, 0, 0], 1)
    assert not dependent([2, 2, 3], [0, 0, 0], 1)
    assert not dependent([2, 2, 3], [0, 0, 0], 1, flat=1)
    assert dependent([2, 1], [0, 0], 1, flat=2)
    assert dependent([0, -2, -4], [0, -1, -2], 2)
    assert dependent([5, 5, 5], [0, -1, -2], 2)
    assert dependent([1, 1, -4], [1, 1, 0], 2, flat=1)
    assert not dependent([0, -2, -4], [0, -1, -3], 2)
    assert not dependent([0, -2, 1], [0, -1, 1], 2, flat=1)
    assert dependent([0, -2, 2], [0, -1, 1], 2, flat=1)
    assert dependent([0, -2, 2], [0, 1, 1], 2, flat=3)


@pytest.mark.parametrize("seed", few(60))
def test_dependent_rows_match_the_exact_rank(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, b, threshold = lattice_instance(rng)
    search = stabbing._Search(task_for(A, b, threshold))
    for size in (2, 3, 3, 4, 4):
        if search.k == 0 or len(search.points) < size:
            return
        members = np.sort(rng.choice(len(search.points), size, replace=False)).astype(np.int32)
        rank = exact_rank(A[search.points[members]])
        assert dependent_rows(search.strips, members, search.k) == (rank <= search.k)


@pytest.mark.parametrize("seed", few(100))
def test_depth_of_intervals(seed: int) -> None:
    """Bins may count too much, never too little, and the hull of what is deep enough is kept."""
    rng = np.random.default_rng(seed)
    n, n_bins = int(rng.integers(1, 30)), int(rng.integers(8, 40))
    t0, t1 = 0.0, float(rng.choice([1.0, 0.3, 7.0]))
    low = rng.uniform(-0.5, 1.0, n) if seed % 2 else rng.integers(-2, 5, n) / 4.0
    low, high = t1 * low, t1 * (low + np.abs(rng.normal(size=n)) / 2 * rng.integers(0, 2, n))
    inside = (low <= t1) & (high >= t0)
    low, high = low[inside], high[inside]
    places = np.unique(np.clip(np.hstack([low, high]), t0, t1))
    depths = np.array([np.count_nonzero((low <= t) & (t <= high)) for t in places], dtype=int)
    need = int(rng.integers(-1, 4))
    edges = np.vstack([low, low, high, high])
    exact, begin, end = _compare(edges, len(low), t0, t1, need)
    assert exact == depths.max(initial=0)
    counted, bin_begin, bin_end, _ = _profile(edges, len(low), t0, t1, n_bins, np.empty(50, dtype=np.int32), need)
    assert counted >= max(exact, need)
    for t in places[depths > need]:
        assert begin <= t <= end
        assert bin_begin <= t <= bin_end
