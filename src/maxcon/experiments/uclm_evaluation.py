"""Held-out results of a UCLM network beside LO-RANSAC at equal time: the tables of its model card.

``python -m maxcon.experiments.uclm_evaluation FAMILY [--network FILE] [--instances 50]`` prints them as Markdown.

Every instance is fitted by UCLM and by LO-RANSAC, without refinement and with the swap extension. LO-RANSAC gets as
much time as UCLM took on that instance with the same refinement, and draws samples until it is over; it stops between
chunks of samples, so that it can take longer. The reference is the exact method's result within its time limit, proven
optimal or not, or the best of all where that is larger.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maxcon.agent.uclm import UclmNetwork, load_uclm, shipped_uclm
from maxcon.experiments.search_instances import make_problem
from maxcon.fitting import fit
from maxcon.problem import LinearProblem
from maxcon.search.anytime import make_task, run
from maxcon.search.refine import swap_refinement
from maxcon.search.sampling import lo_ransac
from maxcon.search.uclm import uclm

#: The tables of each family: what `make_problem` calls the problems, and the outlier rates in percent.
TABLES: dict[str, tuple[str, ...]] = {
    "line": ("line",),
    "plane": ("plane",),
    "fundamental": ("fundamental", "fundamental-F32"),
}
RATES: dict[str, tuple[int, ...]] = {
    "line": (1, 10, 20, 30, 40, 50, 60, 70),
    "plane": (1, 10, 20, 30, 40, 50, 60, 70),
    "fundamental": (10, 20, 30, 40, 50, 60),
}

#: Contenders in the order of the columns of `Cell.sizes`.
CONTENDERS = ("uclm", "lo-ransac", "uclm + swap", "lo-ransac + swap")

#: More samples than any time limit here has room for.
_ENDLESS = 10**7


@dataclass(frozen=True, eq=False)
class Cell:
    """The results at one outlier rate.

    Attributes
    ----------
    rate
        Percent.
    sizes
        Shape (n, 4): the consensus of each contender on each instance.
    seconds
        Shape (n, 4): the time that it took.
    reference
        Shape (n,): the largest consensus known.
    proven
        Shape (n,), bool: whether that is the proven optimum.
    """

    rate: int
    sizes: NDArray[np.int64]
    seconds: NDArray[np.float64]
    reference: NDArray[np.int64]
    proven: NDArray[np.bool_]


def evaluate_cell(
    kind: str,
    network: UclmNetwork,
    rate: int,
    *,
    n_points: int = 100,
    instances: int = 50,
    seed: int = 0,
    proof_seconds: float = 2.0,
) -> Cell:
    """Return the results on `instances` problems drawn by ``default_rng([seed, 2, rate, number])``.

    Parameters
    ----------
    kind
        One of the families of `maxcon.experiments.search_instances`.
    network
        The network.
    rate
        The outlier rate, percent.
    n_points, instances, seed
        N, how many problems, and what they are drawn from.
    proof_seconds
        The exact method's time limit.
    """
    sizes, seconds = np.zeros((instances, 4), dtype=np.int64), np.zeros((instances, 4))
    reference, proven = np.zeros(instances, dtype=np.int64), np.zeros(instances, dtype=np.bool_)
    for number in range(instances):
        rng = np.random.default_rng([seed, 2, rate, number])
        problem, threshold = make_problem(kind, rng, n_points, rate / 100)
        for pair, refine in enumerate((None, swap_refinement)):
            for _ in range(2):  # the second time nothing is compiled, and the caches are warm
                task = make_task(problem, threshold, np.random.default_rng(number))
                sizes[number, 2 * pair], seconds[number, 2 * pair] = _timed(task, uclm(task, network=network), refine)
            task = make_task(problem, threshold, np.random.default_rng(number), float(seconds[number, 2 * pair]))
            steps = lo_ransac(task, samples=_ENDLESS)
            sizes[number, 2 * pair + 1], seconds[number, 2 * pair + 1] = _timed(task, steps, refine)
        reference[number], proven[number] = _reference(problem, threshold, proof_seconds)
        reference[number] = max(reference[number], sizes[number].max())
    return Cell(rate, sizes, seconds, reference, proven)


def _timed(task: Any, steps: Any, refine: Any) -> tuple[int, float]:
    began = time.perf_counter()
    return run(task, steps, refine).size, time.perf_counter() - began


def _reference(problem: LinearProblem, threshold: float, proof_seconds: float) -> tuple[int, bool]:
    result = fit(problem, threshold, method="exact", time_limit=proof_seconds, rng=0)
    return result.n_inliers, result.status == "optimal"


def table(cells: Sequence[Cell]) -> str:
    """Return consensus, gap and time at every rate as Markdown."""
    heads = ["", *(f"{cell.rate}%" for cell in cells)]
    rows: list[list[str]] = []

    def add(name: str, value: Callable[[Cell], str]) -> None:
        rows.append([name, *(value(cell) for cell in cells)])

    add("reference: mean consensus", lambda cell: f"{cell.reference.mean():.2f}")
    add("instances with a proven optimum", lambda cell: f"{cell.proven.sum()} of {len(cell.proven)}")
    for k, name in enumerate(CONTENDERS):
        add(f"{name}: mean consensus", lambda cell, k=k: f"{cell.sizes[:, k].mean():.2f}")  # type: ignore[misc]
    for k, name in enumerate(CONTENDERS):
        add(f"{name}: mean gap", lambda cell, k=k: f"{(cell.reference - cell.sizes[:, k]).mean():.2f}")  # type: ignore[misc]
    for k, name in enumerate(CONTENDERS):
        add(f"{name}: median ms", lambda cell, k=k: f"{1e3 * np.median(cell.seconds[:, k]):.2f}")  # type: ignore[misc]
    lines = ["| " + " | ".join(heads) + " |", "|" + " --- |" * len(heads)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def main() -> None:
    """Evaluate from the command line."""
    parser = argparse.ArgumentParser(prog="python -m maxcon.experiments.uclm_evaluation", description=__doc__)
    parser.add_argument("family", choices=list(TABLES))
    parser.add_argument("--network", type=Path, help="a network's file  [default: the shipped one]")
    parser.add_argument("--instances", type=int, default=50, help="problems at each rate")
    parser.add_argument("--points", type=int, default=100, help="N")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--proof-seconds", type=float, default=2.0)
    given = parser.parse_args()
    for kind in TABLES[given.family]:
        if given.network is None:
            problem, _ = make_problem(kind, np.random.default_rng(0), given.points, 0.1)
            network = shipped_uclm(problem)
        else:
            network = load_uclm(given.network)
        cells = [
            evaluate_cell(
                kind,
                network,
                rate,
                n_points=given.points,
                instances=given.instances,
                seed=given.seed,
                proof_seconds=given.proof_seconds,
            )
            for rate in RATES[given.family]
        ]
        print(f"{kind}, N = {given.points}, {given.instances} instances a rate\n\n{table(cells)}\n", flush=True)


if __name__ == "__main__":
    main()
