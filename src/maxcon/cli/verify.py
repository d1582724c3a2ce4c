"""``maxcon verify``: check a certificate against the data that it is about."""

from __future__ import annotations

import json
from dataclasses import asdict

import click
from rich.text import Text

from maxcon.certification import Certificate, CertificateError, VerificationReport, load, verify
from maxcon.certification.rerun import load_solver
from maxcon.cli import INTERRUPTED
from maxcon.cli.errors import Failure
from maxcon.cli.interrupt import deferred, noticed
from maxcon.cli.options import header_option
from maxcon.cli.output import check_output, write_output
from maxcon.cli.present import borderless, console, duration, plain
from maxcon.cli.tables import N_COLUMNS, choose_columns, pose, read_table
from maxcon.problem import LinearProblem

#: The exit codes where a certificate is refused, and where it is accepted but its claim is not proven.
REFUSED, UNPROVEN = 1, 3


@click.command(name="verify", short_help="Check a certificate against its data.")
@click.argument("cert")
@click.argument("data")
@click.option(
    "--model",
    type=click.Choice(["line", "plane", "hyperplane", "linear"]),
    help="What was fitted. Default: as the certificate says.",
)
@click.option(
    "--columns",
    metavar="LIST",
    help="Names or numbers (from 1) of the columns that were fitted, separated by commas, the dependent one last. "
    "Default: all columns.",
)
@header_option
@click.option(
    "--threshold", type=float, metavar="E", help="Refuse a certificate that is about another threshold than this."
)
@click.option(
    "--rerun",
    is_flag=True,
    help="Also prove the claimed bound again, by a solver that shares nothing with the search.",
)
@click.option(
    "--time-limit",
    type=click.FloatRange(min=0, min_open=True),
    default=60.0,
    show_default=True,
    metavar="SECONDS",
    help="Stop the rerun then.",
)
@click.option("--json", "json_out", metavar="OUT", help="Write the report as JSON; - is standard output.")
def command(
    cert: str,
    data: str,
    model: str | None,
    columns: str | None,
    header: bool | None,
    threshold: float | None,
    rerun: bool,
    time_limit: float,
    json_out: str | None,
) -> None:
    """Check the certificate in the file CERT against the points in the table DATA.

    The inliers are recounted from the model, and the upper bound is re-derived from the groups of points in
    the file, in exact arithmetic, by code that shares nothing with the search. Where the file proves less
    than is claimed, both bounds are shown; --rerun then proves the claim again: with one or two parameters by
    a sweep, with more by a mixed-integer programme, which can take long.

    DATA is a table as `maxcon fit` reads it; "-" reads standard input. Points are counted from 0. The exit
    code is 0 if the certificate is accepted, 1 if it is refused, 2 if something could not be read, and 3 if it is
    accepted but its claim is proven neither by the file nor by --rerun; Ctrl-C ends a rerun, shows the rest, and gives
    130. (The seal of a file guards against accidents; a false claim is found out by what the file proves.)

    \b
    Examples:
      maxcon verify calls.cert.json calls.csv
      maxcon verify stars.cert.json stars.csv --columns log_te,log_light --rerun
    """
    if json_out is not None:
        check_output(json_out, "--json")
    certificate = _load(cert)
    stopped = False
    if isinstance(certificate, str):
        report = _unreadable(certificate)
    else:
        problem = _pose(data, columns, header, model or certificate.family)
        if rerun:
            _load_solver()
        with noticed() as interrupted, console(stderr=True).status("checking ..."):
            report = verify(certificate, problem.A, problem.b, threshold=threshold, rerun=rerun, time_limit=time_limit)
        stopped = interrupted.is_set()
    if json_out is not None:
        record = {"certificate": cert, "data": data, **asdict(report), "bound": report.bound}
        lines = [f"  {json.dumps(key)}: {json.dumps(plain(value))}" for key, value in record.items()]
        write_output(json_out, ("{\n" + ",\n".join(lines) + "\n}\n").encode())
    if json_out != "-":
        _show(report, None if isinstance(certificate, str) else certificate, f"{cert} about {data}")
    if not report.accepted:
        click.get_current_context().exit(REFUSED)
    if stopped:
        click.get_current_context().exit(INTERRUPTED)
    if not report.claim_confirmed:
        click.get_current_context().exit(UNPROVEN)


def _load_solver() -> None:
    """Import the solver of a rerun, and only then heed a Ctrl-C that came meanwhile."""
    with deferred() as asked:
        load_solver()
    if asked.is_set():
        raise click.Abort


def _load(cert: str) -> Certificate | str:
    """Return the certificate, or what is wrong with it."""
    try:
        return load(cert)
    except CertificateError as error:
        return str(error)
    except FileNotFoundError:
        raise Failure(f"there is no file {cert!r}") from None
    except OSError as error:
        raise Failure(f"cannot read {cert!r}: {error.strerror}") from None


def _unreadable(reason: str) -> VerificationReport:
    return VerificationReport(False, reason, 0, 0, 0, 0, 0, 0, None, 0.0)


def _pose(data: str, columns: str | None, header: bool | None, family: str) -> LinearProblem:
    table = read_table(data, header)
    if family in N_COLUMNS:
        return pose(table, choose_columns(table, columns, family), family)
    values = table.numbers(choose_columns(table, columns, "hyperplane"))  # like one, but for the intercept
    if len(values) < values.shape[1]:
        raise Failure(f"a model with {values.shape[1] - 1} parameters needs at least {values.shape[1]} rows of data")
    return LinearProblem(values[:, :-1], values[:, -1])


def _show(report: VerificationReport, certificate: Certificate | None, heading: str) -> None:
    out = console()
    out.print(Text(heading, style="bold"))
    table = borderless()
    if report.accepted:
        table.add_row("certificate", Text("accepted", style="green"))
        table.add_row("inliers", f"{report.n_inliers} of {report.n_points}, recounted from the model")
        groups = _counted(report.n_groups, "group", "disjoint groups")
        proven = f"no model has more than {report.proven_bound} inliers"
        table.add_row("the file proves", f"{proven} ({_counted(report.n_bases, 'basis', 'bases')} in {groups})")
        table.add_row("the claim", _claim(report))
    else:
        table.add_row("certificate", Text("refused", style="red"))
        table.add_row("because", Text(report.reason))
    if certificate is not None:
        about = f"threshold {certificate.threshold:g}; claimed by {certificate.package}, method {certificate.method}"
        text = f"{certificate.family}, {about}, {duration(certificate.seconds)}"
        table.add_row("it is about", Text("".join(each if each.isprintable() else "?" for each in text)))
    table.add_row("time", duration(report.seconds))
    out.print(table)


def _counted(number: int, one: str, many: str) -> str:
    return f"{number} {one if number == 1 else many}"


def _claim(report: VerificationReport) -> Text:
    """Return whether the claimed bound is proven, and by what."""
    claim = f"no model has more than {report.claimed_bound} inliers"
    by = ["the file"] if report.proven_bound <= report.claimed_bound else []
    rerun = report.rerun
    if rerun is not None and rerun.status == "confirmed":
        by.append(f"another solver ({rerun.solver}, {duration(rerun.seconds)})")
    if by:
        return Text(f"{claim}: proven by {' and by '.join(by)}", style="green")
    why = "--rerun tries to prove it by another solver" if rerun is None else f"nor by the rerun: {rerun.note}"
    return Text(f"{claim}: not proven by the file ({why})", style="yellow")
