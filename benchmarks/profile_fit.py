"""One fit of the learned search, taken apart: what each part takes, and what its arithmetic alone would take.

    python benchmarks/profile_fit.py
    python benchmarks/profile_fit.py --cells hyperplane:1000:0.5 --instances 5 --rounds 2

The parts are called one by one, in the order and with the random numbers of `maxcon.search.learned.learned` without a
time limit (checked: the consensus must be that of `learned(task, rounds=...)`). A part's time is the best of
`--repeats` runs; printed is the median over the instances.

The floor of a part is its number of multiply-adds over the fastest rate at which a kernel of the package does them on
1000 points in the cache, measured in the same run: `dot`, residuals with d = 8, or the point network.

The multiply-adds are counted, not estimated: a second process plays the same fits with the kernels as plain Python, in
which the functions below are wrapped by counters (the consensus after each part must be the same again). All loops over
the points go through them, but for comparisons, copies and counts. N is the number of points that a call looks at (of a
walk those of its set), d the number of parameters, n = d + 1.

    whitening: shift, scale and measure the columns (3 d),   N (8 d + d (d + 1) / 2 + 2 d (d - 1))
        pivot by length, orthogonalise twice, scale twice,
        least-squares fit and its residuals (5 d)
    residuals of a model, or rates along a direction         N d
    the most violated point; a primal pivot beside rates     N; 5 N
    change, coefficients, inverse, refinement of a basis     n^2; n^2; 2 n^3; n d
    a weighted fit: weights, weighted rows, equations        N (d (d + 1) / 2 + 2 d + 2) + d^3 / 3
    a least-squares fit of m points                          m (d (d + 1) / 2 + d) + d^3 / 3
    the model of a minimal sample                            d^3 / 3 + d^2
    score of a model; its vote                               3 N; N, 2 N where it is the best so far
    the point network, the peel network for one point        N times, once the number of weights
    sizes, ranks, leverages, weights of the draw             6 N; 2 N; N d; 2 N
    beliefs from logits, features of votes                   5 N
    bounds for adding N points                               N n (d + 2)

A division, root, logarithm, power or exponential counts as one multiply-add, though it takes 4 to 40 times as long, and
comparisons, copies, random numbers and memory as nothing: a floor, not a target.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import gc  # noqa: E402
import json  # noqa: E402
import platform  # noqa: E402
import subprocess  # noqa: E402
import sys  # noqa: E402
from collections.abc import Callable  # noqa: E402
from typing import Any  # noqa: E402

import numba  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from maxcon.agent.search_networks import shipped_search_networks  # noqa: E402
from maxcon.experiments.search_instances import make_problem  # noqa: E402
from maxcon.minimax.clock import processor_time, read_clock  # noqa: E402
from maxcon.minimax.rows import whiten  # noqa: E402
from maxcon.minimax.sums import dot  # noqa: E402
from maxcon.problem import LinearProblem  # noqa: E402
from maxcon.search import learned as method  # noqa: E402
from maxcon.search.anytime import Task, make_task  # noqa: E402
from maxcon.search.belief import MOST_LACK, TEMPERATURES  # noqa: E402
from maxcon.search.learned_kernels import (  # noqa: E402
    WALK_INCUMBENT,
    begin_search,
    begin_search_above,
    begin_search_belief,
    finish_search,
    play_coarse_round,
    play_parts,
)
from maxcon.search.learned_memory import N_COUNTS, ROUND, SIZE, allocate_arena  # noqa: E402
from maxcon.search.learned_settings import Settings  # noqa: E402
from maxcon.search.random_kernels import seed_state  # noqa: E402

#: The parts of a round, in the order of `maxcon.search.learned_kernels.play`.
PARTS = (
    "propose",
    "walk from the best proposal",
    "walk from the second",
    "walk from the incumbent",
    "walks from variations",
    "update the belief",
    "swap",
)

#: What is done only to time whitening by itself; left out.
AGAIN = "whiten again, for the task"

#: Below this floor, in ms, a part does nothing but be called (some 0.01 ms from Python): no ratio is printed.
LEAST_FLOOR = 0.005

#: Called after each part with its name and the consensus so far.
Log = Callable[[str, int], None]


def play_fit(problem: LinearProblem, threshold: float, rounds: int, log: Log) -> int:
    """Do what `learned` does without a time limit, part by part; return the consensus."""
    nets, settings = shipped_search_networks(), Settings()
    fresh = LinearProblem._checked(problem.A, problem.b, problem.family)  # whitened rows are kept with the problem
    whiten(fresh.A, fresh.b)
    log("whiten", 0)
    task = make_task(fresh, threshold, np.random.default_rng(0))
    log(AGAIN, 0)
    N = fresh.n_points
    sizes = method.sizes_of(task.rows)
    coarse = None
    for size in reversed(sizes):
        level = "" if size == N else f", {size} points"
        rows = task.rows if size == N else method._some(task.rows, task.rng.choice(N, size, replace=False))
        arena = allocate_arena(rows, seed_state(task.rng), nets.points, nets.peel)
        counts = arena.integers[:N_COUNTS]
        log(f"rows and memory{level}", 0)
        if coarse is None:
            begin_search(arena, task.limit)
            log(f"root{level}", int(counts[SIZE]))
        else:
            afresh = not method._agrees(coarse.integers)
            begin_search_above(arena, task.limit, coarse, settings, afresh)
            log(f"root above{level}", int(counts[SIZE]))
            play_parts(arena, task.limit, settings, WALK_INCUMBENT, WALK_INCUMBENT + 1)
            log(f"its walk{level}", int(counts[SIZE]))
            if size < N:
                begin_search_belief(arena, task.limit)
                log(f"its belief{level}", int(counts[SIZE]))
        if size < N:
            while counts[ROUND] < method.COARSE_ROUNDS and not (counts[ROUND] > 0 and method._agrees(counts)):
                play_coarse_round(arena, task.limit, settings)
            log(f"rounds until it agrees{level}", int(counts[SIZE]))
        coarse = arena
    if len(sizes) > 1:
        begin_search_belief(arena, task.limit)
        log("first belief", int(counts[SIZE]))
    for number in range(rounds):
        for part in method.PIECES if len(sizes) > 1 else range(len(PARTS)):
            play_parts(arena, task.limit, settings, part, part + 1)
            log(f"{number + 1}: {PARTS[part]}", int(counts[SIZE]))
    finish_search(arena, task.limit)
    log("last swap", int(counts[SIZE]))
    return int(counts[SIZE])


def instances(cell: str, count: int, seed: int) -> list[tuple[LinearProblem, float]]:
    family, n_points, rate = cell.split(":")
    return [
        make_problem(family, np.random.default_rng([seed, number]), int(n_points), float(rate))
        for number in range(count)
    ]


# ---- counting: in a process of its own, with kernels as plain Python ----


class Counter:
    """The multiply-adds so far."""

    total = 0.0


def _columns(At: NDArray[np.float64], x: Any, r: NDArray[np.float64]) -> float:
    return float(At.shape[0] * r.shape[0])


def _vote(votes: Any, totals: Any, tops: Any, ballot: int, score: float, near: NDArray[np.float64]) -> float:
    lack = TEMPERATURES[ballot] * (tops[ballot] - score)
    return 0.0 if lack > MOST_LACK else near.shape[0] * (2.0 if lack < 0.0 else 1.0)


def _weighted(At: NDArray[np.float64], *rest: Any) -> float:
    d, N = At.shape
    return float(N * (d + 2.0))  # the products of the normal equations are counted by `dot`


def _least_squares(At: NDArray[np.float64], b: Any, points: Any, count: int, *rest: Any) -> float:
    d = At.shape[0]
    return float(count * (d * (d + 1) / 2.0 + d))


def _eliminate(At: NDArray[np.float64], b: Any, point: int, rank: int, *rest: Any) -> float:
    d = At.shape[0]
    return float(rank * d - rank * (rank - 1) / 2.0 + (d - rank))


def _lanes(At: NDArray[np.float64], b: Any, count: int, lanes: Any) -> float:
    d = At.shape[0]
    return float(count * (d**3 / 3.0 + d * d))


#: Module, function, multiply-adds of a call, and whether it calls no other kernel: then it may be compiled on its own.
COUNTED: tuple[tuple[str, str, Callable[..., float], bool], ...] = (
    ("minimax.linear", "_subtract_product", _columns, True),
    ("minimax.linear", "_most_violated", lambda r, *rest: r.shape[0], True),
    ("minimax.linear", "relax_row", lambda At, *rest: 5.0 * At.shape[1], False),
    ("minimax.linear", "refine_vertex", lambda At, b, gain, cap, C, x, *rest: x.shape[0] * (x.shape[0] - 1.0), False),
    ("minimax.simplex", "pivot", lambda C, w, leave: w.shape[0] ** 2.0, True),
    ("minimax.simplex", "coefficients", lambda C, g, w: w.shape[0] ** 2.0, True),
    ("minimax.simplex", "invert", lambda G, C: 2.0 * C.shape[0] ** 3, True),
    ("minimax.sums", "dot", lambda x, y: x.shape[0], True),
    ("minimax.sums", "total_of", lambda x: 0.0, True),  # counted by those who call it
    ("search.model_kernels", "weighted_model", _weighted, False),
    ("search.model_kernels", "solve_normal_equations", lambda table, x: x.shape[0] ** 3 / 3.0, True),
    ("search.model_kernels", "least_squares_model", _least_squares, False),
    ("search.model_kernels", "eliminate_point", _eliminate, True),
    ("search.model_kernels", "substitute_back", lambda rank, *rest: 0.5 * rank * rank, True),
    ("search.belief", "nearness", lambda r, *rest: 3.0 * r.shape[0], False),
    ("search.lane_kernels", "solve_lanes", _lanes, False),
    ("search.belief", "cast_vote", _vote, False),
    ("search.belief_proposals", "accumulate_weights", lambda p, *rest: 2.0 * p.shape[0], True),
    ("search.belief", "update_belief", lambda net, number, belief: 5.0 * belief.p.shape[0], False),
    ("agent.perceptron", "evaluate_columns", lambda net, x, h, out: float(net.weights.shape[0] * out.shape[0]), True),
    ("agent.perceptron", "evaluate_row", lambda net, *rest: float(net.weights.shape[0]), True),
    ("agent.point_features", "write_sizes", lambda r, *rest: 6.0 * r.shape[0], False),
    ("agent.point_features", "write_ranks", lambda sizes, *rest: 2.0 * sizes.shape[0], False),
    ("agent.point_features", "write_root_features", lambda At, *rest: float(At.shape[0] * At.shape[1]), False),
    (
        "search.refine_kernels",
        "addition_bounds",
        lambda ws, *rest: float(ws.r.shape[0] * ws.x.shape[0] * (ws.x.shape[0] + 1)),
        False,
    ),
    (
        "search.refine_kernels",
        "addition_bounds_of",
        lambda ws, points, count, *rest: float(count * ws.x.shape[0] * (ws.x.shape[0] + 1)),
        False,
    ),
    ("minimax.rows", "_whiten", lambda A, *rest: whitening(*A.shape), False),
)


def whitening(N: int, d: int) -> float:
    return N * (8.0 * d + d * (d + 1) / 2.0 + 2.0 * d * (d - 1))


def install_counters() -> None:
    """Wrap the functions above wherever they are known by name."""
    os.environ.pop("NUMBA_DISABLE_JIT")
    numba.config.DISABLE_JIT = 0
    modules = [module for name, module in list(sys.modules.items()) if name.startswith("maxcon.")]
    for home, name, multiply_adds, alone in COUNTED:
        original = getattr(sys.modules[f"maxcon.{home}"], name)
        liberties = {"reassoc"} if home == "minimax.sums" else False  # as `sum_kernel`
        inner = numba.njit(error_model="numpy", fastmath=liberties)(original) if alone else original
        wrapped = counted(inner, multiply_adds, quiet=name == "_whiten")
        for module in modules:
            if getattr(module, name, None) is original:
                setattr(module, name, wrapped)


def counted(inner: Callable[..., Any], multiply_adds: Callable[..., float], quiet: bool) -> Callable[..., Any]:
    """Return `inner` with a counter; `quiet`: what it calls is in its own number."""

    def call(*arguments: Any) -> Any:
        more = Counter.total + multiply_adds(*arguments)
        if not quiet:
            Counter.total = more
            return inner(*arguments)
        result = inner(*arguments)
        Counter.total = more
        return result

    return call


def count(options: argparse.Namespace) -> None:
    """Print, as JSON, for each cell and instance the parts with their multiply-adds and the consensus after them."""
    install_counters()
    found: dict[str, list[list[tuple[str, float, int]]]] = {}
    for cell in options.cells:
        found[cell] = []
        for problem, threshold in instances(cell, options.instances, options.seed):
            parts: list[tuple[str, float, int]] = []

            def log(name: str, size: int, parts: list[tuple[str, float, int]] = parts) -> None:
                parts.append((name, Counter.total, size))
                Counter.total = 0.0

            Counter.total = 0.0
            play_fit(problem, threshold, options.rounds, log)
            found[cell].append(parts)
    print(json.dumps(found))


def counts_of_another_process(options: argparse.Namespace) -> dict[str, list[list[list[Any]]]]:
    command = [sys.executable, __file__, "--count", "--cells", *options.cells, "--seed", str(options.seed)]
    command += ["--instances", str(options.instances), "--rounds", str(options.rounds)]
    done = subprocess.run(
        command, env=os.environ | {"NUMBA_DISABLE_JIT": "1"}, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"counting failed: {done.stderr}")
    found: dict[str, list[list[list[Any]]]] = json.loads(done.stdout)
    return found


# ---- timing ----


def rates() -> dict[str, float]:
    """Return the multiply-adds a second of `dot`, of residuals with d = 8, and of the point network; 1000 points."""
    from maxcon.agent.perceptron import BLOCK, evaluate_columns  # noqa: PLC0415  (replaced where things are counted)
    from maxcon.minimax.linear import compute_residuals  # noqa: PLC0415

    @numba.njit(error_model="numpy")  # type: ignore[untyped-decorator]
    def dots(x: NDArray[np.float64], y: NDArray[np.float64], calls: int) -> float:
        total = 0.0
        for k in range(calls):
            x[k % x.shape[0]] += 1e-12  # so that no call can be left out
            total += dot(x, y)
        return total

    @numba.njit(error_model="numpy")  # type: ignore[untyped-decorator]
    def passes(
        At: NDArray[np.float64], b: NDArray[np.float64], x: NDArray[np.float64], r: NDArray[np.float64], calls: int
    ) -> None:
        for k in range(calls):
            x[k % x.shape[0]] += 1e-12
            compute_residuals(At, b, x, r)

    stream = np.random.default_rng(0)
    N, d, calls, net = 1000, 8, 4000, shipped_search_networks().points
    one, two, At, x, r = stream.random(N), stream.random(N), stream.random((d, N)), stream.random(d), np.empty(N)
    features, hidden = stream.random((net.widths[0], N)), np.empty((2, net.widths.max(), BLOCK))
    work: dict[str, tuple[Callable[[], object], int]] = {
        "dot": (lambda: dots(one, two, calls), N * calls),
        "residuals": (lambda: passes(At, two, x, r, calls // d), N * d * (calls // d)),
        "network": (lambda: evaluate_columns(net, features, hidden, r), N * net.weights.shape[0]),
    }
    fastest = dict.fromkeys(work, 0.0)
    for _ in range(40):
        for name, (call, multiply_adds) in work.items():
            began = read_clock()
            call()
            fastest[name] = max(fastest[name], multiply_adds / (read_clock() - began))
    return fastest


def time_parts(problem: LinearProblem, threshold: float, rounds: int, repeats: int) -> list[tuple[str, float, int]]:
    """Return name, least seconds, and consensus of each part."""
    runs: list[list[tuple[str, float, int]]] = []
    for _ in range(repeats):
        parts: list[tuple[str, float, int]] = []
        gc.disable()
        last = read_clock()

        def log(name: str, size: int, parts: list[tuple[str, float, int]] = parts) -> None:
            nonlocal last
            now = read_clock()
            parts.append((name, now - last, size))
            last = read_clock()

        play_fit(problem, threshold, rounds, log)
        gc.enable()
        runs.append(parts)
    least = np.min([[seconds for _, seconds, _ in parts] for parts in runs], axis=0)
    return [(name, float(seconds), size) for (name, _, size), seconds in zip(runs[0], least, strict=True)]


def whole(problem: LinearProblem, threshold: float, rounds: int, repeats: int) -> tuple[float, int]:
    """Return the least seconds of the method itself, with its whitening, and the consensus."""
    least, size = np.inf, 0
    for _ in range(repeats):
        fresh = LinearProblem._checked(problem.A, problem.b, problem.family)
        gc.disable()
        began = read_clock()
        task: Task = make_task(fresh, threshold, np.random.default_rng(0))
        steps = [step.subset for step in method.learned(task, rounds=rounds) if step.subset is not None]
        least = min(least, read_clock() - began)
        gc.enable()
        size = int(np.count_nonzero(steps[-1]))
    return least, size


def show(cell: str, options: argparse.Namespace, counts: list[list[list[Any]]], speed: float) -> None:
    timed = []
    fits = []
    for problem, threshold in instances(cell, options.instances, options.seed):
        timed.append(time_parts(problem, threshold, options.rounds, options.repeats))
        fits.append(whole(problem, threshold, options.rounds, options.repeats))
    same = [[(a[0], a[2]) for a in one] == [(b[0], b[2]) for b in two] for one, two in zip(timed, counts, strict=True)]
    sound = [parts[-1][2] == size for parts, (_, size) in zip(timed, fits, strict=True)]
    print(f"\n{cell}: the same consensus after every part where it was counted in {sum(same)} of {len(same)}; ", end="")
    print(f"at the end that of learned(rounds={options.rounds}) in {sum(sound)} of {len(sound)}")
    print(f"{'part':40} {'ms':>8} {'floor ms':>9} {'ratio':>6} {'inliers':>8}")
    for place, (name, _, _) in enumerate(timed[0]):
        if name == AGAIN:
            continue
        ms = 1e3 * float(np.median([parts[place][1] for parts in timed]))
        floor = 1e3 * float(np.median([parts[place][1] for parts in counts])) / speed
        size = float(np.mean([parts[place][2] for parts in timed]))
        ratio = f"{ms / floor:6.1f}" if floor > LEAST_FLOOR else f"{'-':>6}"
        print(f"{name:40} {ms:8.3f} {floor:9.3f} {ratio} " + (f"{size:8.1f}" if size else f"{'-':>8}"))
    ms = 1e3 * float(np.median([sum(part[1] for part in parts if part[0] != AGAIN) for parts in timed]))
    floor = 1e3 * float(np.median([sum(part[1] for part in parts if part[0] != AGAIN) for parts in counts])) / speed
    print(f"{'all of them (median of the sums)':40} {ms:8.3f} {floor:9.3f} {ms / floor:6.1f}")
    print(f"{'the method itself, in one':40} {1e3 * float(np.median([seconds for seconds, _ in fits])):8.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description="The parts of one fit of the learned search beside their floors.")
    parser.add_argument("--cells", nargs="+", default=["hyperplane:1000:0.5", "fundamental:1000:0.5"])
    parser.add_argument("--instances", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--seed", type=int, default=20_000, help="of the problems; training never draws these")
    parser.add_argument("--count", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.count:
        count(options)
        return
    print(f"{platform.processor() or platform.machine()}, one thread, CPU time; {options.instances} instances a cell")
    counts = counts_of_another_process(options)
    with processor_time():
        measured = rates()
        print("multiply-adds a ns: " + ", ".join(f"{name} {1e-9 * value:.2f}" for name, value in measured.items()))
        for cell in options.cells:
            show(cell, options, counts[cell], max(measured.values()))


if __name__ == "__main__":
    main()
