"""The learned search beside the classical methods: mean gap at equal time, on held-out problems.

    python benchmarks/learned.py                          # the hard cells
    python benchmarks/learned.py --cells line:100:0.9 hyperplane:100:0.75 --methods learned gnc --budgets 1 3 10
    python benchmarks/learned.py --grid --out grid.json

A cell is family:N:rate, the family one of line, plane, hyperplane (d = 8), fundamental (chart rotated to an estimate)
and fundamental-F32 (chart F32 = 1). Each method is run with the same time limit through the package's one loop, with
swap refinement; the time counts from before the rows are whitened. The gap is to the best known: the proven optimum
for d <= 3, otherwise the best of all methods at all budgets and of each with a long one. Printed: mean gap +- its
standard error, and the mean time that was really taken, in ms, where it is more than 5% above the budget.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import gc  # noqa: E402
import json  # noqa: E402
import platform  # noqa: E402
from collections.abc import Callable, Iterator  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402

from maxcon.agent.search_networks import load_search_networks, shipped_search_networks  # noqa: E402
from maxcon.experiments.search_instances import make_problem  # noqa: E402
from maxcon.minimax.clock import processor_time, read_clock  # noqa: E402
from maxcon.problem import LinearProblem  # noqa: E402
from maxcon.search.anytime import Step, Task, make_task, run  # noqa: E402
from maxcon.search.exact import exact  # noqa: E402
from maxcon.search.gnc import gnc  # noqa: E402
from maxcon.search.learned import learned  # noqa: E402
from maxcon.search.peel import peel  # noqa: E402
from maxcon.search.refine import swap_refinement  # noqa: E402
from maxcon.search.sampling import lo_ransac  # noqa: E402

HARD = (
    *(f"hyperplane:{size}" for size in ("100:0.6", "100:0.7", "100:0.75", "200:0.75", "1000:0.5")),
    *(f"fundamental:{size}" for size in ("100:0.5", "100:0.6", "100:0.7", "200:0.7", "1000:0.5")),
    *(f"fundamental-F32:{size}" for size in ("100:0.5", "100:0.6", "100:0.7", "200:0.7", "1000:0.5")),
    *("line:100:0.9", "line:200:0.8", "line:1000:0.5"),
)

Method = Callable[[Task], Iterator[Step]]


def methods(network: str | None) -> dict[str, Method]:
    nets = shipped_search_networks() if network is None else load_search_networks(Path(network))
    return {
        "learned": lambda task: learned(task, network=nets),
        "lo-ransac": lambda task: lo_ransac(task, samples=10_000_000),
        "gnc": lambda task: gnc(task, restarts=None),
        "peel": lambda task: peel(task, restarts=None, samples=200),
        "peel-gnc": lambda task: peel(task, restarts=None, start="gnc"),
        "exact": exact,
    }


def fit(problem: LinearProblem, threshold: float, method: Method, budget: float, seed: int) -> tuple[int, float, int]:
    """Return the consensus, the seconds taken, and the proven bound."""
    fresh = LinearProblem._checked(problem.A, problem.b, problem.family)  # whitened rows are kept with the problem
    gc.disable()
    began = read_clock()
    task = make_task(fresh, threshold, np.random.default_rng(seed), budget)
    best = run(task, method(task), swap_refinement)
    seconds = read_clock() - began
    gc.enable()
    return best.size, seconds, best.upper_bound


def judge(cell: str, chosen: list[str], options: argparse.Namespace) -> list[dict[str, Any]]:
    family, n_points, rate = cell.split(":")
    table = methods(options.network)
    records = []
    for number in range(options.instances):
        stream = np.random.default_rng([options.seed, number])
        problem, threshold = make_problem(family, stream, int(n_points), float(rate))
        known = 0
        rows = []
        fit(problem, threshold, table[chosen[0]], 1e-3, 0)  # the first run of a problem finds cold caches
        for name in chosen:
            if name == "exact" and problem.n_params > 3:
                continue
            for budget in options.budgets:
                for seed in range(options.seeds):
                    size, seconds, _ = fit(problem, threshold, table[name], 1e-3 * budget, seed)
                    known = max(known, size)
                    rows.append({"cell": cell, "instance": number, "method": name, "budget": budget, "seed": seed})
                    rows[-1] |= {"size": size, "ms": 1e3 * seconds}
        long = ["exact"] if problem.n_params <= 3 else ["learned", "gnc", "lo-ransac"]
        for name in long:
            size, _, bound = fit(problem, threshold, table[name], 10.0 if name == "exact" else options.long, 1000)
            known = max(known, size)
            if name == "exact" and bound != size:
                print(f"{cell}: instance {number} was not proven")
        records += [row | {"gap": known - row["size"], "known": known} for row in rows]
    return records


def show(records: list[dict[str, Any]], budgets: list[float]) -> None:
    cell = records[0]["cell"]
    for name in dict.fromkeys(row["method"] for row in records):
        text = f"{cell:28}{name:10}"
        for budget in budgets:
            rows = [row for row in records if row["method"] == name and row["budget"] == budget]
            by_instance: dict[int, list[int]] = {}
            for row in rows:
                by_instance.setdefault(row["instance"], []).append(row["gap"])
            means = np.array([np.mean(gaps) for gaps in by_instance.values()])
            error = means.std(ddof=1) / np.sqrt(len(means)) if len(means) > 1 else 0.0
            taken = np.mean([row["ms"] for row in rows])
            late = f" ({taken:.1f})" if taken > 1.05 * budget else ""
            text += f"{means.mean():9.2f} +-{error:4.2f}{late:7}"
        print(text, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="Mean gap of the learned search and others at equal time.")
    parser.add_argument("--cells", nargs="+", default=HARD)
    parser.add_argument("--methods", nargs="+", default=["learned", "lo-ransac", "gnc", "peel", "exact"])
    parser.add_argument("--budgets", nargs="+", type=float, default=[1.0, 3.0, 10.0], help="ms")
    parser.add_argument("--instances", type=int, default=64)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--seed", type=int, default=20_000, help="of the problems; training never draws these")
    parser.add_argument("--long", type=float, default=0.1, help="seconds of the runs that only set the best known")
    parser.add_argument("--network", default=None, help="a file of search networks instead of the shipped one")
    parser.add_argument("--cpu-time", action="store_true", help="the processor's time: for a shared machine")
    parser.add_argument("--out", type=Path, default=None, help="write all records there, JSON")
    options = parser.parse_args()
    with processor_time(options.cpu_time):
        compare(options)


def compare(options: argparse.Namespace) -> None:
    print(f"{platform.processor() or platform.machine()}, one thread; {options.instances} x {options.seeds} a cell")
    print(f"{'cell':28}{'method':10}" + "".join(f"{budget:7g} ms {'':12}" for budget in options.budgets))
    warm = make_problem("hyperplane", np.random.default_rng(0), 30, 0.3, 8)
    for name in options.methods:
        if name != "exact":
            fit(*warm, methods(options.network)[name], 0.01, 0)
    records = []
    for cell in options.cells:
        found = judge(cell, options.methods, options)
        records += found
        show(found, options.budgets)
    if options.out is not None:
        options.out.write_text(json.dumps(records), encoding="utf-8")


if __name__ == "__main__":
    main()
