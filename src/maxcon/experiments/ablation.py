"""What each departure from the paper bought: the shipped line agent with one switched off at a time, over three seeds.

    python -m maxcon.experiments.ablation --out runs/ablation [--updates 4000] [--seeds 0,1,2] [--only NAME]

Trains what DIR does not hold yet (a killed run goes on), then prints docs/deviations.md's table.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from maxcon.agent.config import AgentConfig, paper, shipped
from maxcon.experiments.evaluation import Contender, Settings, instances, run_instance, summarise
from maxcon.experiments.training import held_out, training_set
from maxcon.tree.encoding import PAPER_CHANNELS

#: What is switched off, by the name of the row; the number is that of docs/deviations.md.
VARIANTS: dict[str, dict[str, Any]] = {
    "full": {},
    "no_channels": {"channels": PAPER_CHANNELS},
    "no_canonical": {"canonical": False},
    "no_side": {"n_episodes": 1},
    "no_target": {"target_every": 0},
    "no_nstep": {"n_step": 1},
    "no_double": {"double": False},
}

TITLES = {
    "full": "shipped settings",
    "no_channels": "without 1, channels",
    "no_canonical": "without 2, unit-free H",
    "no_side": "without 3, episodes side by side",
    "no_target": "without 4, target network",
    "no_nstep": "without 5, 5-step returns",
    "no_double": "without 6, double Q-learning",
    "paper": "the paper's: without 1 to 6",
}

RATES = (10, 20, 30, 40, 50, 60)


def configuration(variant: str, seed: int, updates: int) -> AgentConfig:
    """Return the configuration of one run."""
    base = paper(2, seed) if variant == "paper" else shipped(2, seed)
    return base.override(updates=updates, **VARIANTS.get(variant, {}))


def train_all(folder: Path, variants: list[str], seeds: list[int], updates: int) -> None:
    """Train every run that `folder` does not hold yet."""
    from maxcon.agent.train import train  # noqa: PLC0415  (brings torch)

    for seed in seeds:
        for variant in variants:
            run = folder / f"{variant}_s{seed}"
            if not (run / "agent.safetensors").exists():
                config = configuration(variant, seed, updates)
                train(config, training_set(config), held_out(config), run)


def table(folder: Path, variants: list[str], seeds: list[int], n_instances: int) -> str:
    """Return the mean gaps of all runs as Markdown: before refinement at each rate, by seed; after swap over all."""
    head = ["agent", *(f"{rate}%" for rate in RATES), "mean of each seed", "after swap"]
    lines = ["| " + " | ".join(head) + " |", "| " + " | ".join(["---"] * len(head)) + " |"]
    for variant in variants:
        before, after = np.zeros((len(seeds), len(RATES))), np.zeros((len(seeds), len(RATES)))
        for i, seed in enumerate(seeds):
            weights = str(folder / f"{variant}_s{seed}" / "agent.safetensors")
            contenders = (Contender("agent", "agent", {"weights": weights}),)
            settings = Settings("line", (100,), RATES, n_instances, contenders, seed=100)
            for j, rate in enumerate(RATES):
                records = [
                    record
                    for number, problem in enumerate(instances(settings, 100, rate))
                    for record in run_instance(problem, contenders, rate, number)
                ]
                gap = {row.refine: row.mean_gap for row in summarise(records) if row.name == "agent"}
                before[i, j], after[i, j] = gap[None], gap["swap"]
        cells = [f"{value:.2f}" for value in before.mean(axis=0)]
        seeds_cell = " / ".join(f"{value:.2f}" for value in before.mean(axis=1))
        lines.append(f"| {TITLES[variant]} | " + " | ".join(cells) + f" | {seeds_cell} | {after.mean():.2f} |")
    return "\n".join(lines)


def main() -> None:
    """Train and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--updates", type=int, default=4000)
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--instances", type=int, default=50, help="held-out instances a rate")
    parser.add_argument("--only", choices=list(TITLES), action="append", help="only these rows")
    arguments = parser.parse_args()
    seeds = [int(seed) for seed in arguments.seeds.split(",")]
    variants = arguments.only or list(TITLES)
    train_all(arguments.out, variants, seeds, arguments.updates)
    print(table(arguments.out, variants, seeds, arguments.instances))


if __name__ == "__main__":
    main()
