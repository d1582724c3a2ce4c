"""How the time to a set within 1% of the best known grows with the number of points.

    python benchmarks/growth.py
    python benchmarks/growth.py --families hyperplane --points 1000 10000 --instances 3

Hyperplanes (d = 8) and fundamental matrices (chart rotated to an estimate) with 50% outliers. Each method is driven by
the package's one loop, and the clock starts before the rows are whitened; a set counts from when the loop hands it to a
callback. Printed is the median over instances and seeds in ms, and beside it that time over N log N, 1 for the smallest
N: below 1 the time grows more slowly than N log N. "-k": k of the runs did not get there in `--long` seconds. The best
known is the best that any of the methods finds in so many seconds on this instance.

LO-RANSAC and GNC run twice, with the swap refinement of each set found, as in `maxcon.fit`, and without; the better of
the two counts, run by run. The learned search refines by itself.

"learned, found" is when the learned search itself has such a set, looked up between the calls of its kernels: it hands
sets over only at the end of a round. Then, what the methods hand over within 100 ms, in percent of the best known.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import gc  # noqa: E402
import platform  # noqa: E402
from collections.abc import Callable, Iterator  # noqa: E402
from contextlib import contextmanager  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402

from maxcon.experiments.search_instances import make_problem  # noqa: E402
from maxcon.minimax.clock import processor_time, read_clock  # noqa: E402
from maxcon.problem import LinearProblem  # noqa: E402
from maxcon.search import learned as learned_module  # noqa: E402
from maxcon.search.anytime import Progress, Step, Task, make_task, run  # noqa: E402
from maxcon.search.gnc import gnc  # noqa: E402
from maxcon.search.learned import learned  # noqa: E402
from maxcon.search.learned_memory import SIZE  # noqa: E402
from maxcon.search.refine import swap_refinement  # noqa: E402
from maxcon.search.sampling import lo_ransac  # noqa: E402

METHODS: dict[str, Callable[[Task], Iterator[Step]]] = {
    "learned": learned,
    "lo-ransac": lambda task: lo_ransac(task, samples=10_000_000),
    "gnc": lambda task: gnc(task, restarts=None),
}

FOUND = "learned, found"

#: The kernels by which the learned search gets further, as its module calls them.
KERNELS = ("begin_search", "begin_search_above", "play_parts")

#: Moments, in seconds since the start, with the sizes known then.
Trace = list[tuple[float, int]]


def fit(
    problem: LinearProblem, threshold: float, name: str, limit: float, seed: int, enough: float, refine: bool = False
) -> tuple[Trace, Trace]:
    """Run a method until it has `enough` points, or for `limit` seconds.

    Returns what it handed over, and what it knew (of the learned search only).
    """
    fresh = LinearProblem._checked(problem.A, problem.b, problem.family)  # whitened rows are kept with the problem
    handed: Trace = []
    known: Trace = []
    gc.disable()
    began = read_clock()

    def note(progress: Progress) -> bool:
        handed.append((read_clock() - began, progress.n_inliers))
        return progress.n_inliers >= enough

    with watched(known, began, fresh.n_points):
        task = make_task(fresh, threshold, np.random.default_rng(seed), limit)
        run(task, METHODS[name](task), swap_refinement if refine else None, note)
    gc.enable()
    return handed, known


@contextmanager
def watched(known: Trace, began: float, n_points: int) -> Iterator[None]:
    """Note the incumbent of the learned search after each call of its kernels on all points."""
    originals = {name: getattr(learned_module, name) for name in KERNELS}

    def wrapped(kernel: Callable[..., None]) -> Callable[..., None]:
        def call(arena: Any, *rest: Any) -> None:
            kernel(arena, *rest)
            if arena.b.shape[0] == n_points:
                known.append((read_clock() - began, int(arena.integers[SIZE])))

        return call

    for name, kernel in originals.items():
        setattr(learned_module, name, wrapped(kernel))
    try:
        yield
    finally:
        for name, kernel in originals.items():
            setattr(learned_module, name, kernel)


def fits(name: str) -> tuple[bool, ...]:
    """Return with which settings of `refine` a method is run."""
    return (False,) if name == "learned" else (False, True)


def first(trace: Trace, enough: float) -> float:
    """Return when a trace first has `enough` points, or infinity."""
    return next((seconds for seconds, size in trace if size >= enough), np.inf)


def most(trace: Trace) -> int:
    """Return the size of the last set of a trace, 0 if it has none."""
    return trace[-1][1] if trace else 0


def judge(
    family: str, n_points: int, options: argparse.Namespace
) -> tuple[dict[str, list[float]], dict[str, list[float]]]:
    """Return the times to within the tolerance, and what is had at the brief limit in percent of the best known."""
    times: dict[str, list[float]] = {name: [] for name in (*METHODS, FOUND)}
    brief: dict[str, list[float]] = {name: [] for name in METHODS}
    for number in range(options.instances):
        stream = np.random.default_rng([options.seed, number])
        problem, threshold = make_problem(family, stream, n_points, options.rate)
        known = 0
        for name in METHODS:
            for refine in fits(name):
                known = max(known, most(fit(problem, threshold, name, options.long, 1000, np.inf, refine)[0]))
        enough = (1.0 - 0.01 * options.within) * known
        for seed in range(options.seeds):
            for name in METHODS:
                traces = [fit(problem, threshold, name, options.long, seed, enough, each) for each in fits(name)]
                times[name].append(min(first(handed, enough) for handed, _ in traces))
                if name == "learned":
                    times[FOUND].append(first(traces[0][1], enough))
                if n_points == options.brief_points:
                    limit = 1e-3 * options.brief
                    sizes = [most(fit(problem, threshold, name, limit, seed, np.inf, each)[0]) for each in fits(name)]
                    brief[name].append(100.0 * max(sizes) / known)
    return times, brief


def growth_of(family: str, options: argparse.Namespace) -> None:
    units: dict[str, float] = {}
    lines = []
    for n_points in options.points:
        times, brief = judge(family, n_points, options)
        text = f"{family:14}{n_points:8}"
        for name, values in times.items():
            median = float(np.median(values))
            unit = median / (n_points * np.log(n_points))
            units.setdefault(name, unit)
            missed = np.count_nonzero(np.isinf(values))
            times_as = f"{unit / units[name]:6.2f}" if np.isfinite(unit) and np.isfinite(units[name]) else f"{'':6}"
            text += f"{1e3 * median:11.1f}{times_as}{f' -{missed}' if missed else '':4}"
        print(text, flush=True)
        for name, shares in brief.items():
            if shares:
                within = np.count_nonzero(np.array(shares) >= 100.0 - options.within)
                lines.append(
                    f"  N = {n_points} at {options.brief:g} ms, {name:9}: {np.mean(shares):6.2f}% of the best known, "
                    f"least {min(shares):.2f}%; within {options.within:g}% in {within} of {len(shares)}"
                )
    print("\n".join(lines), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="Time to within 1% of the best known as the number of points grows.")
    parser.add_argument("--families", nargs="+", default=["hyperplane", "fundamental"])
    parser.add_argument("--points", nargs="+", type=int, default=[1000, 3000, 10_000, 30_000, 100_000])
    parser.add_argument("--rate", type=float, default=0.5)
    parser.add_argument("--within", type=float, default=1.0, help="percent")
    parser.add_argument("--instances", type=int, default=3)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--long", type=float, default=3.0, help="seconds of the runs that set the best known")
    parser.add_argument("--brief", type=float, default=100.0, help="ms of what is had in a brief time")
    parser.add_argument("--brief-points", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=20_000, help="of the problems; training never draws these")
    options = parser.parse_args()
    print(
        f"{platform.processor() or platform.machine()}, one thread, CPU time; {options.rate:.0%} outliers, "
        f"{options.instances} x {options.seeds} runs; ms to within {options.within:g}% of the best known, and that "
        "over N log N"
    )
    with processor_time():
        for name in METHODS:
            for family in options.families:
                fit(*make_problem(family, np.random.default_rng(0), 1000, options.rate), name, 0.1, 0, np.inf, True)
        print(f"{'family':14}{'N':>8}" + "".join(f"{name:>17}    " for name in (*METHODS, FOUND)))
        for family in options.families:
            growth_of(family, options)


if __name__ == "__main__":
    main()
