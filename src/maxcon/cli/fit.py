"""``maxcon fit``: from a file of numbers to a fitted model."""

from __future__ import annotations

import inspect
import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from numba.core.event import install_recorder
from rich.text import Text

from maxcon.cli import INTERRUPTED
from maxcon.cli.errors import Failure, reported
from maxcon.cli.interrupt import noticed
from maxcon.cli.options import search_options, table_options
from maxcon.cli.output import PICTURES, check_matplotlib, check_output, write_output
from maxcon.cli.present import consensus_json, consensus_table, console, parameters
from maxcon.cli.tables import choose_columns, pose, read_table

if TYPE_CHECKING:
    from maxcon.problem import Consensus, LinearProblem


@click.command(name="fit", short_help="Fit a line, plane or hyperplane to a file of points.")
@table_options
@click.option(
    "--threshold",
    required=True,
    type=float,
    metavar="E",
    help="The largest residual of an inlier, in the unit of the dependent column.",
)
@search_options
@click.option(
    "--certificate",
    metavar="OUT",
    help="Write a certificate (JSON), which `maxcon verify` checks; implies --certify.",
)
@click.option("--json", "json_out", metavar="OUT", help="Write the result as JSON; - is standard output.")
@click.option(
    "--plot",
    "plot_out",
    metavar="OUT",
    help="Draw the fit as .png, .svg or .pdf; - writes a PNG to standard output.",
)
def command(
    file: str,
    model: str,
    threshold: float,
    columns: str | None,
    header: bool | None,
    method: str,
    refine: str,
    seed: int,
    time_limit: float | None,
    gap: int,
    certify: bool,
    certificate: str | None,
    options: tuple[str, ...],
    json_out: str | None,
    plot_out: str | None,
) -> None:
    """Fit a line, plane or hyperplane to the points in FILE, despite its outliers.

    FILE is a table with one point a row: CSV text (cells separated by commas, semicolons, tabs or blanks; a header
    is optional; lines that start with # are skipped) or a 2-D NPY array. "-" reads standard input; belgian_calls
    and cyg_ob1 are tables that come with the package. The last
    column is the dependent one: a line takes 2 columns (x, y), a plane 3 (x, y, z), a hyperplane all. The
    residual of a point is measured along the dependent column.

    The JSON object holds the file, the model's family, the columns, the parameters by name (line: slope,
    intercept; plane: p, q, intercept; hyperplane: coef, intercept) and every field of maxcon.Consensus: model,
    inlier_mask, n_inliers, upper_bound, gap, status, residuals, basis, path, threshold, method, seed, seconds.
    Indices in it count the rows of data from 0; NaN is written as null.

    \b
    Examples:
      maxcon fit calls.csv --model line --threshold 0.2
      maxcon fit stars.csv --model line --threshold 0.5 --columns log_te,log_light --plot stars.png
      maxcon fit points.npy --model plane --threshold 0.1 --method agent --json - | jq .parameters
      maxcon fit points.npy --model hyperplane --threshold 0.1 --certify --time-limit 5
      maxcon fit belgian_calls --model line --threshold 0.2 --certificate calls.cert.json
    """
    if json_out == "-" and plot_out == "-":
        raise Failure("--json and --plot cannot both go to standard output")
    chosen = parse_options(options)
    check_options(method, chosen)
    check_certificate(certificate)
    if json_out is not None:
        check_output(json_out, "--json")
    if plot_out is not None:
        check_output(plot_out, "--plot", PICTURES)
        check_matplotlib()
    table = read_table(file, header)
    used = choose_columns(table, columns, model)
    problem = pose(table, used, model)
    names = [table.names[column] for column in used]
    refiner = None if refine == "none" else refine
    with noticed() as interrupted, install_recorder("numba:compile") as compilations:
        fit = partial(_fit, problem, threshold, method=method, rng=seed, time_limit=time_limit, refine=refiner, gap=gap)
        consensus = fit(certify=certify or certificate is not None, **chosen)
        claimed = None if certificate is None else write_proof(certificate, problem, consensus)

    about = f"{model.capitalize()} through {Path(table.source).name}"
    if plot_out is not None:
        write_output(plot_out, _picture(problem, consensus, names, about, plot_out))
    if json_out is not None:
        write_output(json_out, _json(consensus, table.source, model, names))
    if "-" not in (json_out, plot_out):
        notes = ["compiling not counted"] * bool(compilations.buffer) + ["stopped by Ctrl-C"] * interrupted.is_set()
        _show(consensus, names, f"{model} through {table.source}, threshold {threshold:g}", refiner, notes)
        for out in (json_out, plot_out):
            if out is not None:
                click.echo(f"wrote {out}")
        if claimed is not None:
            click.echo(f"wrote {certificate}: {claimed}")
    if interrupted.is_set():
        click.get_current_context().exit(INTERRUPTED)


def parse_options(pairs: tuple[str, ...]) -> dict[str, Any]:
    """Return KEY=VALUE pairs as a dictionary; a value is read as JSON where it is that, else as text."""
    options: dict[str, Any] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or not key.strip():
            raise Failure(f"--option must be KEY=VALUE, but it is {pair!r}")
        try:
            options[key.strip()] = json.loads(value)
        except json.JSONDecodeError:
            options[key.strip()] = value
    return options


def check_options(method: str, options: dict[str, Any]) -> None:
    """Make sure that each option is of the type of its default; Failure otherwise.

    Methods check the range of their options; that an option is a number is up to who reads it from text.
    """
    from maxcon.fitting import METHODS  # noqa: PLC0415

    if method not in METHODS:  # an error that the fit reports
        return
    defaults = {name: each.default for name, each in inspect.signature(METHODS[method].load()).parameters.items()}
    kinds = {int: ((int,), "a whole number"), float: ((int, float), "a number"), str: ((str,), "a word")}
    for name, value in options.items():
        types, kind = kinds.get(type(defaults.get(name)), ((object,), ""))
        if not isinstance(value, types) or (types != (object,) and isinstance(value, bool)):
            raise Failure(f"--option {name} must be {kind}, but it is {value!r}")


def _fit(problem: LinearProblem, threshold: float, **arguments: Any) -> Consensus:
    """Fit, showing on a terminal how far it is."""
    import maxcon  # noqa: PLC0415

    with console(stderr=True).status("fitting ...") as status:

        def show(progress: Any) -> None:
            status.update(f"fitting: {progress.n_inliers} inliers found, at most {progress.upper_bound} possible")

        with reported():
            return maxcon.fit(problem, threshold, callback=show, **arguments)


def check_certificate(out: str | None) -> None:
    """Make sure that a certificate can be written there; Failure otherwise."""
    if out == "-":
        raise Failure("--certificate must be a file, but it is -")
    if out is not None:
        check_output(out, "--certificate")


def write_proof(out: str, problem: LinearProblem, consensus: Consensus) -> str:
    """Write a certificate; return what it claims and proves, in words."""
    import maxcon  # noqa: PLC0415

    with console(stderr=True).status("writing the certificate ..."), reported():
        written = maxcon.write_certificate(out, consensus)
    proven = problem.n_points - sum(group.needed for group in written.groups)
    if proven <= written.upper_bound:
        return f"proves that no model has more than {proven} inliers"
    return f"claims that no model has more than {written.upper_bound} inliers, and proves it for {proven}"


def _show(consensus: Consensus, names: list[str], heading: str, refine: str | None, notes: list[str]) -> None:
    out = console()
    out.print(Text(heading, style="bold"))
    out.print(consensus_table(consensus, names, refine, notes))


def _json(consensus: Consensus, source: str, model: str, names: list[str]) -> bytes:
    about = {
        "file": source,
        "family": model,
        "columns": names,
        "parameters": parameters(consensus.model, model),
    }
    return consensus_json(consensus, about)


def _picture(problem: LinearProblem, consensus: Consensus, names: list[str], title: str, out: str) -> bytes:
    from maxcon.cli.picture import draw_fit  # noqa: PLC0415
    from maxcon.experiments.canvas import picture  # noqa: PLC0415

    kind = "png" if out == "-" else Path(out).suffix[1:].lower()
    return picture(draw_fit(problem, consensus, names, title), kind)
