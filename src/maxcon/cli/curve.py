"""``maxcon curve``: how many points a model can explain, for every threshold."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from numba.core.event import install_recorder
from rich.table import Table
from rich.text import Text

from maxcon.cli import INTERRUPTED
from maxcon.cli.errors import Failure, reported
from maxcon.cli.interrupt import noticed
from maxcon.cli.options import table_options
from maxcon.cli.output import PICTURES, check_matplotlib, check_output, write_output
from maxcon.cli.present import borderless, console, duration, number, plain
from maxcon.cli.tables import choose_columns, pose, read_table
from maxcon.problem.tolerance import ABSOLUTE_SLACK

if TYPE_CHECKING:
    from maxcon.problem import LinearProblem
    from maxcon.search.threshold_curve import ConsensusCurve

#: Where there is no terminal, a line says after so many seconds how far it is, and again.
SILENCE = 5.0

#: So many breakpoints are shown, about; of more, an even choice. JSON has all.
SHOWN = 20


@click.command(name="curve", short_help="Show the largest consensus for every threshold.")
@table_options
@click.option(
    "--from",
    "low",
    type=click.FloatRange(min=0),
    default=0.0,
    metavar="E",
    help="The smallest threshold.  [default: 0]",
)
@click.option("--to", "high", type=float, metavar="E", help="The largest threshold.  [default: that of all points]")
@click.option("--time-limit", type=float, metavar="SECONDS", help="Stop then with what is known so far.")
@click.option("--json", "json_out", metavar="OUT", help="Write the curve as JSON; - is standard output.")
@click.option(
    "--plot", "plot_out", metavar="OUT", help="Draw the curve as .png, .svg or .pdf; - writes a PNG to standard output."
)
def command(
    file: str,
    model: str,
    columns: str | None,
    header: bool | None,
    low: float,
    high: float | None,
    time_limit: float | None,
    json_out: str | None,
    plot_out: str | None,
) -> None:
    """Show, for every threshold, the most points in FILE that one model explains, exactly.

    FILE is read as `maxcon fit` reads it. The model may have up to three parameters: a line, a plane, or a hyperplane
    over one or two columns. The table lists from which threshold on a consensus is reached, and which thresholds are
    knees: where less would lose many points and more would win few. (Knees depend on the range from --from to --to:
    nothing outside is looked at, and the first tenth of the points and the last breakpoint in it are none.)

    Lines take milliseconds. Planes of hundreds of points take minutes, most of them for the smallest thresholds: give
    --from, or --time-limit, after which the table shows what is proven and, beside it, what is possible at most.

    The JSON object holds the file, the model's family, the columns, the positions of the knees and every field of
    maxcon.ConsensusCurve: counts, thresholds, proven_to, models, n_at_low, low, high, n_points, scale, complete,
    seconds. Infinity is written as null.

    \b
    Examples:
      maxcon curve calls.csv --model line
      maxcon curve stars.csv --model line --columns log_te,log_light --plot curve.png
      maxcon curve points.npy --model plane --from 0.01 --to 1 --json - | jq .thresholds
    """
    if json_out == "-" and plot_out == "-":
        raise Failure("--json and --plot cannot both go to standard output")
    if high is not None and not low < high:
        raise Failure(f"--from must be less than --to, but they are {low:g} and {high:g}")
    if json_out is not None:
        check_output(json_out, "--json")
    if plot_out is not None:
        check_output(plot_out, "--plot", PICTURES)
        check_matplotlib()
    table = read_table(file, header)
    used = choose_columns(table, columns, model)
    problem = pose(table, used, model)
    names = [table.names[column] for column in used]
    with noticed() as interrupted, install_recorder("numba:compile") as compilations:
        curve = _compute(problem, (low, np.inf if high is None else high), time_limit)
    if plot_out is not None:
        title = f"Consensus of a {model} through {Path(table.source).name}"
        write_output(plot_out, _picture(curve, names[-1], title, plot_out))
    if json_out is not None:
        about = {"file": table.source, "family": model, "columns": names, "knees": curve.knees()}
        write_output(json_out, result_json(about, curve))
    if "-" not in (json_out, plot_out):
        notes = ["compiling not counted"] * bool(compilations.buffer) + ["stopped by Ctrl-C"] * interrupted.is_set()
        _show(curve, f"{model} through {table.source}", notes)
        for out in (json_out, plot_out):
            if out is not None:
                click.echo(f"wrote {out}")
    if interrupted.is_set():
        click.get_current_context().exit(INTERRUPTED)


def result_json(about: Mapping[str, Any], result: Any) -> bytes:
    """Return a JSON object: `about`, then every field of the result; one line a key, NaN and infinity as null."""
    record = dict(about) | {field.name: getattr(result, field.name) for field in fields(result)}
    lines = [f"  {json.dumps(key)}: {json.dumps(plain(value), allow_nan=False)}" for key, value in record.items()]
    return ("{\n" + ",\n".join(lines) + "\n}\n").encode()


def _compute(problem: LinearProblem, thresholds: tuple[float, float], time_limit: float | None) -> ConsensusCurve:
    """Compute the curve, showing how far it is: a terminal always, anything else now and then."""
    from maxcon.search.threshold_curve import consensus_curve  # noqa: PLC0415

    err = console(stderr=True)
    began = said = time.monotonic()
    with err.status("searching ...") as status:

        def show(done: int, total: int) -> None:
            nonlocal said
            now = time.monotonic()
            words = f"searching: {done} of {total} breakpoints proven, {duration(now - began)} so far"
            status.update(words)
            if not err.is_terminal and now - said >= SILENCE:
                said = now
                click.echo(words, err=True)

        with reported():
            return consensus_curve(problem, thresholds, time_limit=time_limit, callback=show)


def _show(curve: ConsensusCurve, heading: str, notes: list[str]) -> None:
    out = console()
    out.print(Text(heading, style="bold"))
    about = borderless()
    about.add_row("points", str(curve.n_points))
    if curve.low > 0:
        about.add_row(f"within {number(curve.low)}", str(curve.n_at_low))
    if curve.complete:
        about.add_row("proof", Text("proven: no model does better at any of these thresholds", style="green"))
    else:
        text = 'not all proven: more than "consensus" may be possible, up to "at most"'
        about.add_row("proof", Text(text, style="yellow"))
    about.add_row("time", ", ".join([duration(curve.seconds), *notes]))
    out.print(about)
    if len(curve.counts) > 0:
        breakpoints = _table(curve)
        out.print()
        out.print(breakpoints)
        if len(breakpoints.rows) < len(curve.counts):
            out.print(f"({len(curve.counts)} breakpoints in all; --json lists them)")


def _table(curve: ConsensusCurve) -> Table:
    """Return the table of breakpoints: an even choice, the knees and the last; of equal ones the largest consensus."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("consensus", justify="right", style="bold")
    table.add_column("share", justify="right")
    table.add_column("from threshold", justify="right")
    if not curve.complete:
        table.add_column("at most", justify="right")
    table.add_column("")
    last = len(curve.counts) - 1
    knees = curve.knees()
    even = np.unique(np.linspace(0, last, min(SHOWN, last + 1)).round().astype(np.int64))
    highest = np.searchsorted(curve.thresholds, curve.thresholds[even], side="right") - 1
    for place in np.union1d(highest, knees):
        count, threshold = int(curve.counts[place]), float(curve.thresholds[place])
        bound = [] if curve.complete else [str(curve.upper_bound(min(threshold, curve.high)))]
        remark = "knee" if place in knees else ""
        shown = threshold if threshold > 2.0 * ABSOLUTE_SLACK * curve.scale else 0.0  # zero but for rounding
        table.add_row(str(count), f"{count / curve.n_points:.0%}", number(shown), *bound, remark)
    return table


def _picture(curve: ConsensusCurve, unit: str, title: str, out: str) -> bytes:
    from maxcon.experiments.canvas import picture  # noqa: PLC0415
    from maxcon.experiments.curve_figure import draw_curve  # noqa: PLC0415

    kind = "png" if out == "-" else Path(out).suffix[1:].lower()
    return picture(draw_curve(curve, unit, title), kind)
