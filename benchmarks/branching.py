"""What the learned search's set and its belief save the exact searches, in nodes and in time.

    python benchmarks/branching.py [--searches partition,astar,napa,dibp] [--instances 20] [--limit 20]

Each problem is proven four times, in random order, each time from nothing: (a) by the exact search alone, which has to
find its sets itself; (b) from the best set of the classical methods; (c) from the set of the learned search; (d) from
that set, with the belief of the learned search as the order. Nodes are what the search expands (branches on); times are
CPU time on one thread and include the search for the first set. Ratios are those of the sums over the problems that all
four have proven, with standard errors; "open" tells how many each has not proven in the time.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import platform  # noqa: E402
import time  # noqa: E402
from dataclasses import dataclass  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

import maxcon  # noqa: E402
from maxcon.experiments.bench_cells import WARM_UP, Cell, Instance, make_instance  # noqa: E402
from maxcon.search.anytime import Task, make_task, run  # noqa: E402
from maxcon.search.astar import AStarStats, astar  # noqa: E402
from maxcon.search.learned import learned  # noqa: E402
from maxcon.search.partition import PartitionSearch  # noqa: E402
from maxcon.search.proposal import best_proposal  # noqa: E402

HELP = ("nothing", "classical set", "learned set", "learned set and belief")

CELLS = {
    "partition": "hyperplane/100/20 hyperplane/100/30 hyperplane/100/40 hyperplane/200/20 hyperplane/200/40 "
    "fundamental/100/20 fundamental/100/30 fundamental/100/40",
    "astar": "hyperplane/100/10 hyperplane/200/10 fundamental/100/10",
    "napa": "hyperplane/100/15 hyperplane/200/10 fundamental/100/10 fundamental/100/15 fundamental/200/10",
    "dibp": "hyperplane/100/20 hyperplane/200/15 fundamental/100/15 fundamental/100/20 fundamental/200/10 "
    "fundamental/200/15",
}

ASTAR: dict[str, dict[str, Any]] = {"astar": {}, "napa": {"napa": True}, "dibp": {"napa": True, "dibp": True}}

NAMES = {"partition": "partition", "astar": "A*", "napa": "A*-NAPA", "dibp": "A*-NAPA-DIBP"}


@dataclass(frozen=True)
class Run:
    """One proof: nodes expanded, CPU seconds, the consensus found, whether it is proven."""

    nodes: int
    seconds: float
    size: int
    proven: bool


def prove(search: str, given: int, instance: Instance, limit: float) -> Run:
    """Run a search with the help number `given`."""
    began = time.process_time()

    def new_task() -> Task:
        return make_task(instance.problem, instance.threshold, np.random.default_rng(0), limit)

    start: NDArray[np.bool_] | None = np.zeros(instance.problem.n_points, dtype=np.bool_) if given == 0 else None
    belief = np.empty(instance.problem.n_points)
    if given == 1:
        start = best_proposal(new_task())
    elif given == 2 or (given == 3 and search == "partition"):
        task = make_task(instance.problem, instance.threshold, np.random.default_rng(0))
        start = run(task, learned(task, belief=belief)).subset
    task, stats = new_task(), AStarStats()
    if search == "partition":
        partition = PartitionSearch(task, start=start, belief=belief if given == 3 else None, n_jobs=1)
        best = run(task, partition.steps())
        nodes = partition.expanded
    else:
        known = {"start": start} if given in (1, 2) else {"learned": given == 3}
        best = run(task, astar(task, improve=given > 0, stats=stats, **known, **ASTAR[search]))
        nodes = stats.expanded
    return Run(nodes, time.process_time() - began, best.size, best.subset is not None and best.gap == 0)


def ratio(above: NDArray[np.float64], below: NDArray[np.float64]) -> str:
    """Return the ratio of two sums over the same problems, with its standard error."""
    if below.sum() == 0.0:  # proven at the root
        return "-"
    value = above.sum() / below.sum()
    error = np.std(above - value * below, ddof=1) / np.sqrt(len(above)) / below.mean()
    return f"{value:.2f}+-{error:.2f}"


def cell_rows(search: str, cell: Cell, instances: int, seed: int, limit: float) -> list[str]:
    """Prove all problems of a cell and return the rows of the table."""
    runs: list[list[Run]] = []
    for number in range(instances):
        instance = make_instance(cell, number, seed)
        order = np.random.default_rng([number, 7]).permutation(4)
        found = {int(given): prove(search, int(given), instance, limit) for given in order}
        runs.append([found[given] for given in range(4)])
        sizes = {each.size for each in runs[-1] if each.proven}
        if len(sizes) > 1:
            raise RuntimeError(f"disagree on {cell.name}, problem {number}: {sizes}")
    closed = [each for each in runs if all(one.proven for one in each)]
    still_open = [sum(not each[given].proven for each in runs) for given in range(4)]
    note = f"; open: {'/'.join(map(str, still_open))}" if any(still_open) else ""
    title = f"{NAMES[search]}, {cell.name} ({len(closed)}{note})"
    if len(closed) < 2:
        return [f"| {title} | | | | | | |"]
    nodes = np.array([[one.nodes for one in each] for each in closed], dtype=float)
    seconds = np.array([[one.seconds for one in each] for each in closed])
    cells = [f"{nodes[:, k].mean():.0f}, {1e3 * seconds[:, k].mean():.1f} ms" for k in range(4)]
    cells += [f"{ratio(nodes[:, 3], nodes[:, k])}, {ratio(seconds[:, 3], seconds[:, k])}" for k in (0, 1, 2)]
    return [f"| {title} | {' | '.join(cells)} |"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--searches", default=",".join(CELLS), help="which searches, separated by commas")
    parser.add_argument("--instances", type=int, default=20, help="problems of a cell")
    parser.add_argument("--seed", type=int, default=0, help="of the problems")
    parser.add_argument("--limit", type=float, default=20.0, help="seconds for a proof")
    options = parser.parse_args()
    searches = options.searches.split(",")
    unknown = [name for name in searches if name not in CELLS]
    if unknown:
        parser.error(f"--searches must be among {', '.join(CELLS)}, but it holds {unknown[0]!r}")
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores; load {os.getloadavg()[0]:.1f}")
    print(f"Python {platform.python_version()}, numpy {np.__version__}, maxcon {maxcon.__version__}; {options}\n")
    for search in searches:
        for given in range(4):  # compiles
            prove(search, given, make_instance(Cell("hyperplane", 60, 10), 0, 0, WARM_UP), 5.0)
    columns = [f"({letter}) {name}" for letter, name in zip("abcd", HELP, strict=True)]
    print(f"| search, cell (problems) | {' | '.join(columns)} | d/a: nodes, time | d/b | d/c |")
    print("| --- |" + " ---: |" * 7)
    for search in searches:
        for name in CELLS[search].split():
            family, n_points, rate = name.split("/")
            cell = Cell(family, int(n_points), int(rate))
            for row in cell_rows(search, cell, options.instances, options.seed, options.limit):
                print(row, flush=True)


if __name__ == "__main__":
    main()
