"""``maxcon train search``: the networks of the learned search, by self-imitation or from proven optima."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from maxcon.cli.errors import Failure, reported
from maxcon.cli.interrupt import noticed
from maxcon.cli.output import check_folder
from maxcon.cli.present import duration

if TYPE_CHECKING:
    from maxcon.experiments.self_imitation import TrainingProgress

#: What teaches which networks.
LEARNERS = ("dqn", "self-imitation", "optima")


def check_learner(family: str, learner: str | None) -> str:
    """Return the learner; Failure where it does not teach such networks."""
    usual = "self-imitation" if family == "search" else "dqn"
    if learner is None:
        return usual
    if (learner == "dqn") != (family != "search"):
        teaches = "the EdgeConv agents of line, plane and fundamental" if learner == "dqn" else "search"
        raise Failure(f"--learner {learner} teaches {teaches}, not {family}")
    return learner


def train_search(
    learner: str,
    seed: int,
    rounds: int,
    minutes: float | None,
    out: str | None,
    data: str | None,
    threshold: float | None,
) -> None:
    """Train, and say after each round how far it is."""
    from maxcon.experiments.search_instances import table_source  # noqa: PLC0415
    from maxcon.experiments.self_imitation import Recipe, train_search_networks  # noqa: PLC0415

    folder = check_folder(out if out is not None else f"runs/search-{learner}-seed{seed}", "--out")
    source = None
    if data is not None:
        if threshold is None:
            raise Failure("--data needs --threshold: the largest residual of an inlier in these tables")
        with reported():
            source = table_source(Path(data), threshold)
    recipe = Recipe(labels="optima" if learner == "optima" else "best")
    began = time.monotonic()
    again = f"maxcon train search --learner {learner} --seed {seed} --updates {rounds} --out {folder}"
    if data is not None:
        again += f" --data {data} --threshold {threshold:g}"

    with noticed() as interrupted:

        def show(progress: TrainingProgress) -> bool:
            gaps = progress.held_out or {}
            judged = "; held-out gap at 3 ms: " + ", ".join(f"{name} {gap:.2f}" for name, gap in gaps.items())
            left = progress.seconds / progress.round * (progress.rounds - progress.round)
            click.echo(
                f"round {progress.round} of {progress.rounds}: losses {progress.point_loss:.3f} and "
                f"{progress.peel_loss:.3f}, some {duration(left)} left{judged if gaps else ''}",
                err=True,
            )
            late = minutes is not None and time.monotonic() - began > 60.0 * minutes
            return late or interrupted.is_set()

        with reported():
            train_search_networks(folder, seed=seed, rounds=rounds, recipe=recipe, source=source, progress=show)
    weights = folder / "search.safetensors"
    if interrupted.is_set():
        click.echo(f"maxcon train: interrupted; the checkpoint is in {folder}; go on with: {again}", err=True)
        click.get_current_context().exit(130)
    click.echo(f"wrote {weights}; use it with: maxcon fit ... --method learned --option network={weights}")
