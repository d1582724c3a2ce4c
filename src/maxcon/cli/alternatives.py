"""``maxcon alternatives``: all largest consensus sets, and the points that they share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import click
import numpy as np
from numba.core.event import install_recorder
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from maxcon.cli import INTERRUPTED
from maxcon.cli.curve import result_json
from maxcon.cli.errors import reported
from maxcon.cli.interrupt import noticed
from maxcon.cli.options import table_options
from maxcon.cli.output import check_output, write_output
from maxcon.cli.present import LISTED_OUTLIERS, borderless, console, duration, equation, number, runs_of
from maxcon.cli.tables import choose_columns, pose, read_table

if TYPE_CHECKING:
    from maxcon.problem import LinearProblem
    from maxcon.search.alternatives import AlternativeOptima

#: So many sets are shown; JSON has all.
SHOWN = 10


@click.command(name="alternatives", short_help="List all largest consensus sets.")
@table_options
@click.option(
    "--threshold",
    required=True,
    type=float,
    metavar="E",
    help="The largest residual of an inlier, in the unit of the dependent column.",
)
@click.option("--limit", type=click.IntRange(min=1), default=1000, show_default=True, help="List so many sets at most.")
@click.option("--time-limit", type=float, metavar="SECONDS", help="Stop then with what is known so far.")
@click.option("--json", "json_out", metavar="OUT", help="Write the result as JSON; - is standard output.")
def command(
    file: str,
    model: str,
    threshold: float,
    columns: str | None,
    header: bool | None,
    limit: int,
    time_limit: float | None,
    json_out: str | None,
) -> None:
    """List all largest sets of points in FILE that one model explains, and tell which points they share.

    FILE is read as `maxcon fit` reads it. `maxcon fit` returns one largest consensus set; where others are as large,
    their models may differ by far, and only the points that are in all of them are inliers beyond doubt. Where the time
    ends before the largest consensus is proven, the best set found is shown, and none is looked for beside it.

    The JSON object holds the file, the model's family, the columns and every field of maxcon.AlternativeOptima:
    n_inliers, upper_bound, proven, masks, models, values, complete, in_all, in_none, varying, threshold, seconds.

    \b
    Examples:
      maxcon alternatives stars.csv --model line --threshold 0.6
      maxcon alternatives points.npy --model plane --threshold 0.1 --limit 50 --json - | jq .in_all
    """
    if json_out is not None:
        check_output(json_out, "--json")
    table = read_table(file, header)
    used = choose_columns(table, columns, model)
    problem = pose(table, used, model)
    names = [table.names[column] for column in used]
    with noticed() as interrupted, install_recorder("numba:compile") as compilations:
        answer = _search(problem, threshold, limit, time_limit)
    if json_out is not None:
        about = {"file": table.source, "family": model, "columns": names}
        write_output(json_out, result_json(about, answer))
    if json_out != "-":
        notes = ["compiling not counted"] * bool(compilations.buffer) + ["stopped by Ctrl-C"] * interrupted.is_set()
        _show(answer, names, f"{model} through {table.source}, threshold {threshold:g}", limit, notes)
        if json_out is not None:
            click.echo(f"wrote {json_out}")
    if interrupted.is_set():
        click.get_current_context().exit(INTERRUPTED)


def _search(problem: LinearProblem, threshold: float, limit: int, time_limit: float | None) -> AlternativeOptima:
    """Search, showing on a terminal how far it is."""
    from maxcon.search.alternatives import alternative_optima  # noqa: PLC0415

    with console(stderr=True).status("searching ...") as status:

        def show(found: int) -> None:
            status.update(f"searching: {found} set{'s' * (found != 1)} found")

        with reported():
            return alternative_optima(problem, threshold, limit=limit, time_limit=time_limit, callback=show)


def _show(answer: AlternativeOptima, names: Sequence[str], heading: str, limit: int, notes: list[str]) -> None:
    out = console()
    out.print(Text(heading, style="bold"))
    N = answer.masks.shape[1]
    table = borderless()
    size = f"{answer.n_inliers} of {N} ({answer.n_inliers / N:.1%}), "
    if answer.proven:
        table.add_row("consensus", f"{size}proven to be the largest")
    else:
        text = f"{size}not proven to be the largest: at most {answer.upper_bound} are possible"
        table.add_row("consensus", Text(text, style="yellow"))
    table.add_row("sets", _sets(answer, limit))
    for label, mask in (("in all", answer.in_all), ("in none", answer.in_none), ("varying", answer.varying)):
        table.add_row(label, rows(mask))
    if answer.unknown.any():
        table.add_row("unknown", Text(f"{rows(answer.unknown)}: not settled in time", style="yellow"))
    table.add_row("time", ", ".join([duration(answer.seconds), *notes]))
    out.print(table)
    if answer.n_found > 1:
        out.print()
        out.print(_models(answer, names))
    if answer.n_found > SHOWN:
        out.print(f"({answer.n_found - SHOWN} more; --json lists them)")


def _sets(answer: AlternativeOptima, limit: int) -> Text:
    if answer.n_inliers == 0:
        return Text("none: no model explains even one point within the threshold", style="red")
    if not answer.proven:
        return Text("not looked for: first the largest consensus must be proven, which takes more time", style="yellow")
    if not answer.complete:
        why = " (--limit ended the list)" if answer.n_found >= limit else ""
        return Text(f"{answer.n_found} found, there may be more{why}", style="yellow")
    return Text("one only" if answer.n_found == 1 else f"{answer.n_found}, no others", style="green")


def rows(mask: NDArray[np.bool_]) -> str:
    """Return how many points these are, and their rows of data, if they are not too many to read."""
    count = int(np.count_nonzero(mask))
    points = f"{count} point{'s' * (count != 1)}"
    if not 0 < count <= LISTED_OUTLIERS:
        return points
    return f"{points}: row{'s' * (count > 1)} {runs_of(np.flatnonzero(mask) + 1)}"


def _models(answer: AlternativeOptima, names: Sequence[str]) -> Table:
    """Return the table of sets: the model of each, and which of the varying points it has."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("set", justify="right", style="bold")
    table.add_column("model")
    table.add_column("largest residual", justify="right")
    table.add_column("has, of those that vary", overflow="fold")
    for k in range(min(answer.n_found, SHOWN)):
        own = np.flatnonzero(answer.masks[k] & answer.varying) + 1
        which = f"row{'s' * (len(own) > 1)} {runs_of(own)}" if len(own) <= LISTED_OUTLIERS else f"{len(own)} rows"
        table.add_row(str(k + 1), Text(equation(answer.models[k], names)), number(answer.values[k]), which)
    return table
