"""Agents for fundamental matrices beside simple baselines, on held-out scenes or on pairs of a KITTI drive.

    python -m maxcon.experiments.fundamental_agents scene --weights agent=FILE [--instances 30] --out DIR
    python -m maxcon.experiments.fundamental_agents kitti --data FOLDER --weights agent=FILE --out DIR

Prints the tables of the model cards: the mean number of inliers short of the best consensus known, for each agent and
for greedy and random removal as they come, and for RANSAC, LO-RANSAC and random removal again and again in the
time that the first agent took on the same instance with the same refinement. "Estimate" is theta = 0, what the chart
"auto" was rotated to, which all methods are given with the problem. Writes DIR/records.jsonl, a line a fit; instances
found there are not run again.
"""

from __future__ import annotations

import argparse
import json
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maxcon.agent.config import DataConfig
from maxcon.experiments.evaluation import REFERENCE, REFINEMENTS, Contender, Record, run_instance
from maxcon.experiments.training import TWO_VIEW_RATES
from maxcon.experiments.two_view_instances import SceneSource, best_known, open_drive, pair_matches
from maxcon.fitting import fit
from maxcon.problem import LinearProblem
from maxcon.search.anytime import make_task
from maxcon.search.refine import swap_refinement, tree_refinement
from maxcon.vision.fundamental import fundamental_problem

#: Methods that get the time of the first agent, and what keeps them from ending before.
EQUAL_TIME: dict[str, dict[str, Any]] = {
    "ransac": {"samples": 10**7},
    "lo-ransac": {"samples": 10**7},
    "random": {"tries": 10**6},
}

TITLES = {None: "before refinement", "tree": "after local tree refinement", "swap": "after swap"}


def scenes(
    config: DataConfig, rates: Sequence[int], n_points: int, n_instances: int, seed: int, folder: Path | None
) -> Iterator[tuple[int, int, LinearProblem]]:
    """Yield rate, number and problem of held-out instances: those of a rate come from ``[seed, 3, N, rate]``."""
    source = SceneSource(config, "test", folder)
    for rate in rates:
        rng = np.random.default_rng([seed, 3, n_points, rate])
        for number in range(n_instances):
            yield rate, number, source.draw(rng, n_points, rate / 100)


def drive_pairs(config: DataConfig, folder: Path | None) -> Iterator[tuple[int, int, LinearProblem]]:
    """Yield step, first frame and problem of the pairs after the frames that fine-tuning uses, all their matches."""
    drive = open_drive(config.sequence, folder)
    for step, first, matches in pair_matches(drive, config.frames, config.steps, "test"):
        posed = fundamental_problem(matches[:, :2], matches[:, 2:], chart=config.chart, threshold=config.threshold)
        yield step, first, posed.problem


def compare(
    problem: LinearProblem, threshold: float, agents: Sequence[Contender], group: int, number: int, proof: float
) -> list[Record]:
    """Return the records of one instance, all with the best consensus known.

    Parameters
    ----------
    problem, threshold
        The instance.
    agents
        At least one; the first sets the time that RANSAC and its like get.
    group, number
        What `Record` calls rate and instance; the number seeds the methods.
    proof
        Seconds that may be spent on a proof of the optimum.
    """
    goal = best_known(problem, threshold, proof)
    removal = (*agents, Contender("greedy", "greedy"), Contender("random", "random"))
    records = run_instance(problem, removal, group, number, goal, threshold)
    clock = {each.refine: each.seconds for each in records if each.name == agents[0].name}
    found = [(each.name, each.refine, each.n_inliers, each.seconds, each.error) for each in records]
    for refine in REFINEMENTS:
        for method, options in EQUAL_TIME.items():
            result = fit(
                problem, threshold, method=method, rng=number, refine=refine, time_limit=clock[refine], **options
            )
            found.append((f"{method}, equal time", refine, result.n_inliers, result.seconds, None))
    found += [
        ("estimate", refine, n, 0.0, None) for refine, n in zip(REFINEMENTS, _estimate(problem, threshold), strict=True)
    ]
    largest = goal[0] if goal[1] else max(n for _, _, n, _, _ in found)
    return [
        Record(problem.n_points, group, number, name, refine, n, largest, goal[1], seconds, error)
        for name, refine, n, seconds, error in found
    ]


def _estimate(problem: LinearProblem, threshold: float) -> list[int]:
    """Return the consensus of theta = 0, and of its inliers after each refinement."""
    task = make_task(problem, threshold, np.random.default_rng(0))
    inliers: NDArray[np.bool_] = np.abs(problem.b) <= threshold
    return [int(inliers.sum()), *(int(refine(task, inliers).sum()) for refine in (tree_refinement, swap_refinement))]


def table(records: Sequence[Record], groups: Sequence[int], heading: str) -> str:
    """Return mean gaps as Markdown, a row for each method and refinement, a column for each group."""
    lines = ["| " + " | ".join([heading, *(str(group) for group in groups)]) + " |"]
    lines.append("| --- " * (1 + len(groups)) + "|")
    cells: dict[tuple[str, str | None], list[str]] = {}
    for group in groups:
        some = [each for each in records if each.rate == group]
        for name, refine in dict.fromkeys((each.name, each.refine) for each in some):
            mine = [each for each in some if (each.name, each.refine) == (name, refine)]
            if name == REFERENCE:
                text = (
                    f"{np.mean([each.reference for each in mine]):.1f} ({100 * np.mean([e.proven for e in mine]):.0f}%)"
                )
            else:
                milliseconds = 1e3 * np.mean([each.seconds for each in mine])
                text = f"{np.mean([each.gap for each in mine]):.2f}" + (
                    f" ({milliseconds:.0f} ms)" if milliseconds else ""
                )
            cells.setdefault((name, refine), []).append(text)
    for (name, refine), row in cells.items():
        title = "best consensus known (proven)" if name == REFERENCE else f"{name}, {TITLES[refine]}"
        lines.append("| " + " | ".join([title, *row]) + " |")
    return "\n".join(lines)


def _done(path: Path, agents: Sequence[Contender]) -> list[Record]:
    """Return the records of complete instances, and drop what a kill left of another from the file."""
    lines = path.read_text(encoding="utf-8").splitlines()
    records = [Record(**json.loads(line)) for line in lines if line.endswith("}")]
    asked = {each.name for each in agents}
    known = {"greedy", "random", "estimate", REFERENCE, *(f"{method}, equal time" for method in EQUAL_TIME)}
    if (there := {each.name for each in records} - known) and there != asked:
        raise ValueError(
            f"{path} holds records of the agents {sorted(there)}, not {sorted(asked)}; name another folder"
        )
    complete = (len(asked) + len(known) - 1) * len(REFINEMENTS) + 1
    count = Counter((each.rate, each.instance) for each in records)
    kept = [each for each in records if count[each.rate, each.instance] == complete]
    if len(kept) < len(lines):
        part = path.with_suffix(".part")
        part.write_text("".join(json.dumps(asdict(each)) + "\n" for each in kept), encoding="utf-8")
        os.replace(part, path)
    return kept


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what the folder does not hold yet, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", choices=["scene", "modelnet", "kitti"])
    parser.add_argument("--weights", action="append", required=True, metavar="NAME=FILE", help="an agent file; repeat")
    parser.add_argument("--out", type=Path, required=True, help="folder of the records")
    parser.add_argument("--data", type=Path, help="folder ModelNet40, or of the KITTI odometry layout")
    parser.add_argument("--n-points", type=int, default=100)
    parser.add_argument("--instances", type=int, default=30, help="held-out scenes a rate")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--proof", type=float, default=2.0, help="seconds for a proof of the optimum")
    given = parser.parse_args(arguments)
    agents = [
        Contender(name, "agent", {"weights": file}) for name, _, file in (each.partition("=") for each in given.weights)
    ]
    if given.source == "kitti":
        config = DataConfig(source="kitti", threshold=0.01)
        groups: tuple[int, ...] = config.steps
        instances = drive_pairs(config, given.data)
    else:
        config, groups = DataConfig(source=given.source), TWO_VIEW_RATES
        instances = scenes(config, groups, given.n_points, given.instances, given.seed, given.data)
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / "records.jsonl"
    records = _done(path, agents) if path.exists() else []
    known = {(each.rate, each.instance) for each in records}
    for group, number, problem in instances:
        if (group, number) in known:
            continue
        if not records:
            compare(problem, config.threshold, agents, group, number, given.proof)  # loads the kernels
        some = compare(problem, config.threshold, agents, group, number, given.proof)
        with path.open("a", encoding="utf-8") as file:
            file.write("".join(json.dumps(asdict(each)) + "\n" for each in some))
        records += some
    print(
        table(
            records,
            groups,
            "mean gap (mean time), frames apart" if given.source == "kitti" else "mean gap (mean time), outliers %",
        )
    )


if __name__ == "__main__":
    main()
