"""``maxcon bench``: all methods and the installed peers at equal time, and what changed between two such runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from maxcon.cli import INTERRUPTED
from maxcon.cli.errors import Failure, reported
from maxcon.cli.interrupt import deferred
from maxcon.cli.output import check_folder

if TYPE_CHECKING:
    from maxcon.experiments.bench import Settings
    from maxcon.experiments.bench_records import BenchFile, Unit

#: The exit code of a comparison in which "auto" got worse.
WORSE = 1


@click.command(name="bench", short_help="Compare all methods and other libraries at equal time.")
@click.option("--quick", "is_quick", is_flag=True, help="A small grid, for a look within minutes.")
@click.option(
    "--families", metavar="LIST", help="Among line, plane, hyperplane, fundamental, fundamental-F32.  [default: all]"
)
@click.option("--points", metavar="LIST", help="Numbers of points.  [default: 100,200,1000; quick: 100]")
@click.option(
    "--rates",
    metavar="LIST",
    help="Outlier rates in percent, or as fractions below 1; 10:60 is 10,20,...,60.  [default: those of each family, "
    "10 to 90 or 70; quick: 30,60]",
)
@click.option("--budgets", metavar="LIST", help="Milliseconds.  [default: 1,3,10,100; quick: 1,10]")
@click.option(
    "--methods", metavar="LIST", help="Our methods and peers.  [default: the usual ones, and all installed peers]"
)
@click.option("--instances", type=click.IntRange(min=1), help="Instances of each cell.  [default: 64; quick: 8]")
@click.option("--seeds", type=click.IntRange(min=1), help="Fits of each instance.  [default: 2; quick: 1]")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seeds the instances.")
@click.option("--proof-time", type=float, metavar="S", help="Seconds to prove an optimum in.  [default: 1; quick: 0.3]")
@click.option(
    "--long-time",
    type=float,
    metavar="S",
    help="Seconds of each long run for the best known where nothing is proven.  [default: 0.3; quick: 0.1]",
)
@click.option(
    "--jobs", type=click.IntRange(min=1), default=1, show_default=True, help="Instances at a time; they disturb times."
)
@click.option("--cpu-time", is_flag=True, help="Count the processor's time: for a machine that has other work, too.")
@click.option("--out", metavar="DIR", default="bench", show_default=True, help="Where all goes; called again, goes on.")
@click.option(
    "--compare", "pair", nargs=2, metavar="OLD NEW", help="Run nothing; say what changed between two folders."
)
@click.pass_context
def command(
    ctx: click.Context,
    is_quick: bool,
    families: str | None,
    points: str | None,
    rates: str | None,
    budgets: str | None,
    methods: str | None,
    instances: int | None,
    seeds: int | None,
    seed: int,
    proof_time: float | None,
    long_time: float | None,
    jobs: int,
    cpu_time: bool,
    out: str,
    pair: tuple[str, str] | None,
) -> None:
    """Compare all methods, and the robust fitting of other libraries, at equal time under one residual.

    Peers (scikit-learn, scikit-image, OpenCV, PoseLib, pycolmap) run where they are installed, with the best settings
    for each budget, found on separate instances. Records, leaderboard.md and its figures go to DIR. The whole grid
    takes hours; what was interrupted goes on when the same command is called again.

    With --compare the exit code is 1 if "auto" got worse anywhere by more than two standard errors.

    \b
    Examples:
      maxcon bench --quick
      maxcon bench --families hyperplane --points 100 --rates 70,75 --methods auto,gnc,lo-ransac --out hard
      maxcon bench --compare bench-before bench-after
    """
    if pair is not None:
        _compare(ctx, *pair)
        return
    from maxcon.experiments import bench  # noqa: PLC0415
    from maxcon.experiments.bench_records import BenchFile  # noqa: PLC0415
    from maxcon.experiments.canvas import look  # noqa: PLC0415

    settings = _settings(is_quick, families, points, rates, budgets, methods)
    settings = replace(
        settings,
        seed=seed,
        jobs=jobs,
        cpu_time=cpu_time,
        instances=settings.instances if instances is None else instances,
        seeds=settings.seeds if seeds is None else seeds,
        proof_time=settings.proof_time if proof_time is None else proof_time,
        long_time=settings.long_time if long_time is None else long_time,
    )
    with reported():
        with look():  # matplotlib is missed before the work, not after it
            pass
        bench.one_core()
        bench.check_settings(settings)
        folder = check_folder(out, "--out")
        file = BenchFile(folder, bench.header(settings))
    interrupted = _run(settings, file, mention_absent=methods is None)
    units = file.units
    if units:
        _page(folder, units)
    if interrupted:
        click.echo(f"maxcon bench: interrupted; the same command goes on from what is in {out}", err=True)
        ctx.exit(INTERRUPTED)


def _run(settings: Settings, file: BenchFile, *, mention_absent: bool) -> bool:
    """Run what is missing; return whether Ctrl-C ended that, after the instance under way.

    It says which peers are absent where no methods were asked for by name.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn  # noqa: PLC0415

    from maxcon.cli.present import console  # noqa: PLC0415
    from maxcon.experiments.bench import absent_peers, run_bench  # noqa: PLC0415

    for name, package in absent_peers().items() if mention_absent else ():
        click.echo(f"{name} is not installed and left out (pip install {package})", err=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with deferred() as stop, Progress(*columns, console=console(stderr=True), transient=True) as display:
        bar = display.add_task("calibrations", total=None)

        def advance(what: str, done: int, total: int) -> None:
            display.update(bar, description=what, completed=done, total=total)

        for _ in run_bench(settings, file, advance, stop.is_set):
            if stop.is_set():
                break
    return stop.is_set()


def _page(folder: Path, units: Sequence[Unit]) -> None:
    from maxcon.experiments.bench import absent_peers  # noqa: PLC0415
    from maxcon.experiments.bench_records import read_bench  # noqa: PLC0415
    from maxcon.experiments.bench_scores import lost_cells, summarise  # noqa: PLC0415
    from maxcon.experiments.leaderboard import family_lines, write_page  # noqa: PLC0415

    header, _ = read_bench(folder)
    scores = summarise(units)
    for line in family_lines(scores):
        click.echo(line)
    lost = len(lost_cells(scores))
    click.echo(f'"auto" is lost in {lost} cell{"s" * (lost != 1)}')
    for path in write_page(folder, header, units, absent_peers()):
        click.echo(f"wrote {path}")


def _compare(ctx: click.Context, old: str, new: str) -> None:
    from maxcon.experiments.bench_records import read_bench  # noqa: PLC0415
    from maxcon.experiments.bench_scores import AUTO, compare  # noqa: PLC0415
    from maxcon.experiments.leaderboard import change_lines  # noqa: PLC0415

    try:
        (before, first), (after, second) = read_bench(Path(old)), read_bench(Path(new))
        changes = compare(first, second)
    except (FileNotFoundError, ValueError) as error:
        raise Failure(f"--compare: {error}") from error
    if after["processor"] != before["processor"]:
        click.echo(f"{new} ran on another machine: {after['processor']}, not {before['processor']}")
    for name, version in after["versions"].items():
        if before["versions"].get(name, version) != version:
            click.echo(f"{new} ran with another {name}: {version}, not {before['versions'][name]}")
    for line in change_lines(changes):
        click.echo(line)
    if any(each.worse for each in changes if each.method == AUTO):
        click.echo(f'"{AUTO}" got worse')
        ctx.exit(WORSE)


def _settings(
    is_quick: bool,
    families: str | None,
    points: str | None,
    rates: str | None,
    budgets: str | None,
    methods: str | None,
) -> Settings:
    """Return the settings that the lists ask for; Failure if one cannot be read."""
    from maxcon.cli.evaluate import parse_rates  # noqa: PLC0415
    from maxcon.experiments.bench import Settings, quick, usual_methods  # noqa: PLC0415

    settings = quick(Settings()) if is_quick else Settings()
    if families is not None:
        settings = replace(settings, families=_listed(families, "--families"))
    if points is not None:
        words = _listed(points, "--points")
        if not all(word.isdecimal() for word in words):
            raise Failure(f"--points must list whole numbers, but it is {points!r}")
        settings = replace(settings, sizes=tuple(int(word) for word in words))
    if rates is not None:
        settings = replace(settings, rates=parse_rates(rates))
    if budgets is not None:
        try:
            numbers = tuple(float(word) for word in _listed(budgets, "--budgets"))
        except ValueError:
            raise Failure(f"--budgets must list numbers of milliseconds, but it is {budgets!r}") from None
        settings = replace(settings, budgets=tuple(sorted(set(numbers))))
    named = usual_methods() if methods is None else _listed(methods, "--methods")
    return replace(settings, methods=named)


def _listed(text: str, option: str) -> tuple[str, ...]:
    words = tuple(dict.fromkeys(word for word in text.replace(",", " ").split() if word))
    if not words:
        raise Failure(f"{option} must list at least one, but it is {text!r}")
    return words
