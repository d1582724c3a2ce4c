"""``maxcon reproduce``: the experiments of the paper, each by one command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from maxcon.cli import INTERRUPTED
from maxcon.cli.errors import Failure, reported
from maxcon.cli.interrupt import deferred
from maxcon.cli.output import check_folder

if TYPE_CHECKING:
    from maxcon.experiments.records import RecordFile
    from maxcon.experiments.reproduction import Experiment, Scale

#: `maxcon.experiments.reproduction.PARTS` and `maxcon.experiments.distribution.BACKENDS`, here so that --help need not
#: load the engine.
_PARTS = ("line", "plane", "modelnet", "kitti", "trajectory")
_BACKENDS = ("loky", "dask", "ray", "sequential")


@click.command(name="reproduce", short_help="Run the paper's experiments and check its claims.")
@click.argument("part", type=click.Choice([*_PARTS, "all"]))
@click.option("--quick", is_flag=True, help="A taste of every experiment: minutes instead of hours.")
@click.option(
    "--out",
    default="reproduction",
    show_default=True,
    metavar="DIR",
    help="Where records, figures and summary.md go; called again with the same settings, the command goes on.",
)
@click.option(
    "--backend",
    type=click.Choice(_BACKENDS),
    default="loky",
    show_default=True,
    help="What does the work: processes of this machine, a cluster of Dask or Ray, or this process alone.",
)
@click.option("--jobs", type=click.IntRange(min=1), default=2, show_default=True, help="Instances at a time.")
@click.option(
    "--scheduler", metavar="ADDRESS", help="A running cluster of Dask or Ray; without it one is started here."
)
@click.option("--instances", type=click.IntRange(min=1), metavar="K", help="Instances of each cell, or pairs a step.")
@click.option("--rates", metavar="LIST", help="Outlier rates in percent of lines, planes and ModelNet40.")
@click.option("--time-limit", type=float, metavar="SECONDS", help="What the exact method has for an instance.")
@click.option("--astar-time-limit", type=float, metavar="SECONDS", help="What A* has for an instance.")
@click.option(
    "--ransac-time", type=float, metavar="FACTOR", help="RANSAC variants have so many times our method's time."
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seeds all instances.")
@click.option(
    "--weights",
    multiple=True,
    metavar="AGENT=FILE",
    help="The agent file of line, line-paper, plane, plane-paper, fundamental, fundamental-paper or "
    "fundamental-kitti; may be repeated. Without it, the agent that is shipped.",
)
@click.option("--made", is_flag=True, help="Use made scenes even where ModelNet40 and KITTI are there.")
@click.option("--sequence", metavar="NAME", help="The drive of KITTI; without it the first there is.")
def command(
    part: str,
    quick: bool,
    out: str,
    backend: str,
    jobs: int,
    scheduler: str | None,
    instances: int | None,
    rates: str | None,
    time_limit: float | None,
    astar_time_limit: float | None,
    ransac_time: float | None,
    seed: int,
    weights: tuple[str, ...],
    made: bool,
    sequence: str | None,
) -> None:
    """Run an experiment of the paper's section 4, or all of them, and hold the paper to what it claims.

    Writes DIR/records (a line a run), DIR/figures (drawn from the records) and DIR/summary.md (claim by claim).
    ModelNet40 and KITTI are looked for in the folder that MAXCON_DATA names; without them, made scenes take their
    place.

    \b
    Examples:
      maxcon reproduce all --quick --out results
      maxcon reproduce kitti --time-limit 60 --jobs 4
      maxcon reproduce line --backend dask --scheduler tcp://10.0.0.1:8786
    """
    from maxcon.experiments.reproduction import plan, runs_on  # noqa: PLC0415

    if scheduler is not None and backend not in ("dask", "ray"):
        raise Failure(f"--scheduler is for the backends dask and ray, but the backend is {backend}")
    scale = _scale(quick, instances, rates, time_limit, astar_time_limit, ransac_time)
    files = _weights(weights)
    folder = check_folder(out, "--out")
    _check_pictures()
    _check_extras(backend)
    parts = _PARTS if part == "all" else (part,)
    experiments: list[tuple[Experiment, RecordFile]] = []
    for name in parts:  # all of them before the first runs, so that what is wrong with the last is told at once
        with reported():
            try:
                experiment = plan(name, scale, folder, seed=seed, weights=files, made=made, sequence=sequence)
            except FileNotFoundError as error:
                raise Failure(str(error)) from None
            experiments.append((experiment, _records(experiment, folder)))
    for experiment, records in experiments:
        n_units = len(experiment.units())
        click.echo(f"{experiment.name}: {n_units} instance{'s' * (n_units != 1)}, {runs_on(experiment)}")
        _tell_missing(experiment)
        _run(experiment, records, backend, jobs, scheduler, out)
    _summarise(folder)


def _records(experiment: Experiment, folder: Path) -> RecordFile:
    from maxcon.experiments.reproduction import open_records  # noqa: PLC0415

    return open_records(experiment, folder)


def _run(experiment: Experiment, records: RecordFile, backend: str, jobs: int, scheduler: str | None, out: str) -> None:
    """Run what is missing; on Ctrl-C end the command after the instances that are done."""
    from rich.progress import (  # noqa: PLC0415
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from maxcon.cli.present import console  # noqa: PLC0415
    from maxcon.experiments.reproduction import reproduce  # noqa: PLC0415

    columns = (
        TextColumn(experiment.name),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("elapsed"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    # Instances differ in time by hundreds of times: an estimate from the last few would jump.
    shown = Progress(*columns, console=console(stderr=True), transient=True, speed_estimate_period=900)
    with deferred() as stop, shown as display:
        bar = display.add_task(experiment.name, total=None)

        def advance(done: int, total: int) -> None:
            display.update(bar, completed=done, total=total)

        run = reproduce(experiment, records, backend=backend, jobs=jobs, scheduler=scheduler, progress=advance)
        try:
            for _ in run:
                if stop.is_set():
                    run.close()
                    break
        except ImportError as error:  # an extra that only the workers find absent
            raise Failure(str(error)) from error
        except OSError as error:
            if scheduler is None:
                raise
            raise Failure(f"--scheduler: no cluster answers at {scheduler}: {error}") from error
    if stop.is_set():
        click.echo(f"maxcon reproduce: interrupted; the same command goes on from what is in {out}", err=True)
        click.get_current_context().exit(INTERRUPTED)


def _summarise(folder: Path) -> None:
    from maxcon.experiments.summary import overview, summarise_folder  # noqa: PLC0415

    for path in summarise_folder(folder):
        click.echo(f"wrote {path}")
    for line in overview(folder):
        click.echo(line)


def _tell_missing(experiment: Any) -> None:
    for each in experiment.contenders:
        if each.missing is not None:
            click.echo(f"  {each.name} is left out, {each.missing}")


def _scale(
    quick: bool,
    instances: int | None,
    rates: str | None,
    time_limit: float | None,
    astar_time_limit: float | None,
    ransac_time: float | None,
) -> Scale:
    from maxcon.cli.evaluate import parse_rates  # noqa: PLC0415
    from maxcon.experiments.reproduction import FULL, QUICK  # noqa: PLC0415

    scale = QUICK if quick else FULL
    if instances is not None:
        scale = replace(
            scale, instances=instances, modelnet_instances=instances, pairs=instances, trajectories=instances
        )
    if rates is not None:
        chosen = parse_rates(rates)
        scale = replace(scale, rates=chosen, modelnet_rates=chosen)
    for option, name, value in (
        ("--time-limit", "proof_time", time_limit),
        ("--astar-time-limit", "astar_time", astar_time_limit),
        ("--ransac-time", "factor", ransac_time),
    ):
        if value is not None:
            if not 0.0 < value < float("inf"):
                raise Failure(f"{option} must be positive and finite, but it is {value:g}")
            scale = replace(scale, **{name: value})  # type: ignore[arg-type]
    return scale


def _weights(given: Sequence[str]) -> dict[str, str]:
    """Return agent files by the name of the agent; Failure if one is unknown, or no agent for that family."""
    from maxcon.agent.weights import load_weights  # noqa: PLC0415
    from maxcon.experiments.reproduction import AGENTS  # noqa: PLC0415

    files: dict[str, str] = {}
    for pair in given:
        name, equals, file = pair.partition("=")
        if name not in AGENTS or not (equals and file):
            raise Failure(f"--weights must be AGENT=FILE with AGENT one of {', '.join(AGENTS)}, but it is {pair!r}")
        with reported():
            _, config = load_weights(Path(file))
        if config.train.n_params != AGENTS[name]:
            raise Failure(f"--weights: {file!r} was trained for d = {config.train.n_params}, not for {name}")
        files[name] = str(Path(file).resolve())
    return files


def _check_pictures() -> None:
    from maxcon.experiments.canvas import look  # noqa: PLC0415

    with reported(), look():
        pass


def _check_extras(backend: str) -> None:
    from maxcon.experiments.distribution import check_backend  # noqa: PLC0415

    with reported():
        check_backend(backend)
