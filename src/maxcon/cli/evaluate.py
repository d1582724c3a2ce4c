"""``maxcon evaluate``: every method on held-out instances, against the optimum."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from maxcon.cli import INTERRUPTED
from maxcon.cli.errors import Failure, reported
from maxcon.cli.interrupt import deferred
from maxcon.cli.output import check_folder, check_output, write_output

if TYPE_CHECKING:
    from maxcon.experiments.evaluation import Contender, Record, RecordFile, Settings

#: Options that take a list.
_LISTS = ("--n-points", "--n", "--rates", "--methods")


class _WithLists(click.Command):
    """A command in which ``--n 100 200`` is short for ``--n 100,200``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        joined: list[str] = []
        inside = False  # whether the last word was a value of a list
        for word in args:
            if inside and not word.startswith("-") and joined[-1] not in _LISTS:
                joined[-1] += f",{word}"
            else:
                inside = word in _LISTS or (inside and not word.startswith("-"))
                joined.append(word)
        return super().parse_args(ctx, joined)


@click.command(name="evaluate", cls=_WithLists, short_help="Compare methods on held-out instances.")
@click.argument("family", type=click.Choice(["line", "plane"]))
@click.option(
    "--n-points", "--n", "sizes", default="100,200", show_default=True, metavar="LIST", help="Numbers of points."
)
@click.option(
    "--rates",
    default="10:60",
    show_default=True,
    metavar="LIST",
    help="Outlier rates in percent, or as fractions below 1; 10:60 is 10,20,...,60 and 10:60:25 is 10,35,60.",
)
@click.option(
    "--instances", type=click.IntRange(min=1), default=100, show_default=True, help="Instances for each N and rate."
)
@click.option("--methods", default="agent,greedy,random", show_default=True, metavar="LIST", help="Methods to compare.")
@click.option(
    "--weights",
    multiple=True,
    metavar="NAME=FILE",
    help="Also evaluate the agent in FILE, as NAME; may be repeated.",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seeds the instances.")
@click.option(
    "--out",
    metavar="DIR",
    help="Write settings.json, records.jsonl (a line a fit) and a figure for each N here; called again, goes on.",
)
@click.option(
    "--json", "json_out", metavar="OUT", help="Write settings, machine and table as JSON; - is standard output."
)
def command(
    family: str,
    sizes: str,
    rates: str,
    instances: int,
    methods: str,
    weights: tuple[str, ...],
    seed: int,
    out: str | None,
    json_out: str | None,
) -> None:
    """Compare methods on held-out random lines or planes, against the optimum.

    The instances follow the paper's protocol (threshold 0.1, outliers up to 5) and are none that training saw. Each
    is fitted without refinement, with local tree refinement and with swaps.

    \b
    Examples:
      maxcon evaluate line --rates 10:80 --out results
      maxcon evaluate plane --n 100 200 --instances 20 --weights mine=runs/plane-seed1/agent.safetensors
    """
    from maxcon.experiments.evaluation import RecordFile, Settings  # noqa: PLC0415

    settings = Settings(
        family, _sizes(sizes, family), parse_rates(rates), instances, _contenders(methods, weights, family), seed
    )
    if json_out is not None:
        check_output(json_out, "--json")
    file = None
    if out is not None:
        folder = check_folder(out, "--out")
        with reported():
            file = RecordFile(folder, settings)
    records = _evaluate(settings, file, out)
    if json_out is not None:
        write_output(json_out, _json(settings, records))
    if json_out != "-":
        _show(settings, records)
        if out is not None:
            _draw(settings, records, Path(out))


def _evaluate(settings: Settings, file: RecordFile | None, out: str | None) -> list[Record]:
    """Return all records; on Ctrl-C end the command after the running instance."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn  # noqa: PLC0415

    from maxcon.cli.present import console  # noqa: PLC0415
    from maxcon.experiments.evaluation import evaluate  # noqa: PLC0415

    columns = (TextColumn("instances"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    records = list(file.done) if file is not None else []
    with deferred() as stop, Progress(*columns, console=console(stderr=True), transient=True) as display:
        bar = display.add_task("instances", total=None)

        def advance(done: int, total: int) -> None:
            display.update(bar, completed=done, total=total)

        with reported():
            for some in evaluate(settings, done=tuple(records), progress=advance):
                if stop.is_set():
                    break
                records += some
                if file is not None:
                    file.add(some)
    if stop.is_set():
        note = (
            f"; the same command goes on from what is in {out}" if out is not None else ", nothing was kept (no --out)"
        )
        click.echo(f"maxcon evaluate: interrupted{note}", err=True)
        click.get_current_context().exit(INTERRUPTED)
    order = {name: i for i, name in enumerate(dict.fromkeys(each.name for each in records))}
    return sorted(records, key=lambda each: (each.n_points, each.rate, order[each.name]))


def _show(settings: Settings, records: Sequence[Record]) -> None:
    from maxcon.cli.gaps import gap_table  # noqa: PLC0415
    from maxcon.cli.present import console  # noqa: PLC0415
    from maxcon.experiments.evaluation import summarise  # noqa: PLC0415

    rows = summarise(records)
    out = console()
    for n_points in settings.sizes:
        title = f"{settings.family}, N = {n_points}, {settings.n_instances} held-out instances a rate"
        out.print(gap_table([each for each in rows if each.n_points == n_points], title))


def _draw(settings: Settings, records: Sequence[Record], folder: Path) -> None:
    from maxcon.experiments.canvas import picture  # noqa: PLC0415
    from maxcon.experiments.evaluation_figure import draw_evaluation  # noqa: PLC0415

    for n_points in settings.sizes:
        path = folder / f"{settings.family}-{n_points}.png"
        with reported():
            content = picture(draw_evaluation(records, settings, n_points), "png")
        write_output(path, content)
        click.echo(f"wrote {path}")
    click.echo(f"wrote {folder / 'records.jsonl'}")


def _json(settings: Settings, records: Sequence[Record]) -> bytes:
    from maxcon.cli.present import plain  # noqa: PLC0415
    from maxcon.experiments.evaluation import machine, summarise  # noqa: PLC0415

    result: dict[str, Any] = {
        "settings": asdict(settings),
        "machine": machine(),
        "table": [asdict(each) for each in summarise(records)],
    }
    return (json.dumps(plain(result), indent=2, allow_nan=False) + "\n").encode()


def _words(text: str) -> list[str]:
    return [word for word in text.replace(",", " ").split() if word]


def _sizes(text: str, family: str) -> tuple[int, ...]:
    from maxcon.experiments.evaluation import N_PARAMS  # noqa: PLC0415

    least = N_PARAMS[family] + 1
    sizes = []
    for word in _words(text):
        if not word.isdecimal() or int(word) < least:
            raise Failure(
                f"--n-points must list whole numbers of at least {least} for a {family}, but it holds {word!r}"
            )
        sizes.append(int(word))
    if not sizes:
        raise Failure("--n-points must list at least one number")
    return tuple(dict.fromkeys(sizes))


def parse_rates(text: str) -> tuple[int, ...]:
    """Return outlier rates in whole percent from numbers and ranges, each in percent or as fractions below 1."""
    rates: list[int] = []
    for word in _words(text):
        ends = [_percent(part, word) for part in word.split(":")]
        if len(ends) > 3 or (len(ends) == 3 and ends[2] == 0):
            raise Failure(f"--rates: {word!r} is not a rate, low:high or low:high:step")
        if len(ends) == 1:
            rates += ends
        else:
            rates += range(ends[0], ends[1] + 1, ends[2] if len(ends) == 3 else 10)
    if not rates:
        raise Failure("--rates must list at least one rate")
    return tuple(sorted(set(rates)))


def _percent(part: str, word: str) -> int:
    try:
        value = float(part)
    except ValueError:
        raise Failure(f"--rates: {word!r} is not a rate, low:high or low:high:step") from None
    percent = 100.0 * value if 0 < value < 1 else value
    if not (0 <= percent < 100 and abs(percent - round(percent)) < 1e-6):
        raise Failure(f"--rates must be whole percents from 0 to 99, or fractions below 1, but {word!r} is not")
    return round(percent)


def _contenders(methods: str, weights: Sequence[str], family: str) -> tuple[Contender, ...]:
    """Return the methods to compare; Failure if one is unknown, named twice, or an agent file is not for the family."""
    from maxcon.agent.weights import load_weights  # noqa: PLC0415
    from maxcon.experiments.evaluation import N_PARAMS, REFERENCE, Contender  # noqa: PLC0415
    from maxcon.fitting import METHODS  # noqa: PLC0415

    contenders = []
    for name in _words(methods):
        if name not in METHODS:
            raise Failure(f"--methods must be among {', '.join(METHODS)}, but it holds {name!r}")
        contenders.append(Contender(name, name))
    for pair in weights:
        name, equals, file = pair.partition("=")
        if not (name and equals and file):
            raise Failure(f"--weights must be NAME=FILE, but it is {pair!r}")
        with reported():
            _, config = load_weights(Path(file))
        if config.train.n_params != N_PARAMS[family]:
            raise Failure(f"--weights: {file!r} was trained for d = {config.train.n_params}, not for a {family}")
        contenders.append(Contender(name, "agent", {"weights": file}))
    names = [each.name for each in contenders]
    for name in names:
        if names.count(name) > 1:
            raise Failure(f"two methods are named {name!r}; give the agent another NAME")
        if name == REFERENCE:
            raise Failure(f"--weights: {name!r} is what the records call the optimum; give the agent another NAME")
    if not contenders:
        raise Failure("--methods must list at least one method")
    return tuple(contenders)
