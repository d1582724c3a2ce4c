"""``maxcon demo``: the two classic tables, fitted by least squares, by the agent and exactly."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from numpy.typing import NDArray
from rich.table import Table as RichTable
from rich.text import Text

from maxcon.cli.errors import reported
from maxcon.cli.output import check_folder, write_output
from maxcon.cli.present import console, duration, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from maxcon.datasets import Table
    from maxcon.problem import Consensus, LinearProblem

#: The name of the picture.
PICTURE = "demo.png"

#: Walks of the agent: the first takes the best action everywhere, the others draw actions by their Q-values.
WALKS = 16


@dataclass(frozen=True, eq=False)
class _Result:
    """What was made of one table."""

    table: Table
    problem: LinearProblem
    least_squares: NDArray[np.float64]
    least_squares_seconds: float
    walk: Consensus
    refined: Consensus
    walks: Consensus
    exact: Consensus


@click.command(name="demo", short_help="Fit two classic tables, and draw them.")
@click.option("--out", default=".", show_default=True, metavar="DIR", help=f"Where to write {PICTURE}.")
@click.option("--weights", metavar="FILE", help="An agent file instead of the agent that ships with the package.")
def command(out: str, weights: str | None) -> None:
    """Fit two classic tables with outliers: by least squares, by the learned agent, and exactly.

    The tables are the telephone calls in Belgium, 1950-73, and the stars of the cluster CYG OB1 (Rousseeuw and
    Leroy, 1987). Least squares follows the outliers; the agent removes them one by one.
    """
    from maxcon.datasets import TABLES, load_table  # noqa: PLC0415

    folder = check_folder(out, "--out")
    with console(stderr=True).status("fitting ..."), reported():
        results = [_fit(load_table(name), weights) for name in TABLES]
    _show(results)
    try:
        from maxcon.experiments.canvas import picture  # noqa: PLC0415

        content = picture(_draw(results), "png")
    except ModuleNotFoundError as error:
        click.echo(f"no picture was drawn: {error}", err=True)
        return
    write_output(folder / PICTURE, content)
    click.echo(f"wrote {folder / PICTURE}")


def _fit(table: Table, weights: str | None) -> _Result:
    import maxcon  # noqa: PLC0415

    problem = maxcon.line(table.x, table.y)
    options: dict[str, Any] = {} if weights is None else {"weights": weights}
    for _ in range(2):  # the first time loads or compiles the kernels; the second is timed
        began = time.perf_counter()
        least_squares = np.asarray(np.linalg.lstsq(problem.A, problem.b, rcond=None)[0], dtype=np.float64)
        seconds = time.perf_counter() - began
        walk = maxcon.fit(problem, table.threshold, method="agent", refine=None, **options)
        refined = maxcon.fit(problem, table.threshold, method="agent", refine="swap", **options)
        walks = maxcon.fit(problem, table.threshold, method="agent", refine="swap", tries=WALKS, **options)
        exact = maxcon.fit(problem, table.threshold, method="exact")
    return _Result(table, problem, least_squares, seconds, walk, refined, walks, exact)


def _show(results: Sequence[_Result]) -> None:
    table = RichTable(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("method")
    table.add_column("slope", justify="right")
    table.add_column("intercept", justify="right")
    table.add_column("inliers", justify="right")
    table.add_column("gap", justify="right")
    table.add_column("proven")
    table.add_column("time", justify="right")
    for position, each in enumerate(results):
        if position:
            table.add_row()
        N, best = each.problem.n_points, each.exact.n_inliers
        table.add_row(Text(each.table.name, style="bold"))
        within = _inliers(each.problem, each.least_squares, each.table.threshold)
        table.add_row(
            "  least squares",
            *map(number, each.least_squares),
            f"{within} of {N}",
            str(best - within),
            "no",
            duration(each.least_squares_seconds),
        )
        for name, consensus in (
            ("  agent", each.walk),
            ("  agent, refined", each.refined),
            (f"  agent, {WALKS} walks, refined", each.walks),
            ("  exact", each.exact),
        ):
            proven = consensus.status == "optimal"
            table.add_row(
                name,
                *map(number, consensus.model),
                f"{consensus.n_inliers} of {N}",
                str(best - consensus.n_inliers),
                Text("yes", style="green") if proven else "no",
                duration(consensus.seconds),
            )
    out = console()
    for each in results:
        what = f"{each.table.y_label} against {each.table.x_label}, threshold {each.table.threshold:g}"
        out.print(Text.assemble((each.table.name, "bold"), f"  {each.table.title}"), soft_wrap=True)
        out.print(Text(f"  {each.problem.n_points} points: {what}", style="dim"), soft_wrap=True)
    out.print()
    out.print(table)
    out.print()


def _inliers(problem: LinearProblem, model: NDArray[np.float64], threshold: float) -> int:

    limit = problem.inlier_limit(threshold)
    return int(np.count_nonzero(problem.residuals(model) <= limit))


def _draw(results: Sequence[_Result]) -> Figure:
    from maxcon.cli.picture import draw_line, number_removals  # noqa: PLC0415
    from maxcon.experiments.canvas import GREEN, GREY, PURPLE, look, new_figure  # noqa: PLC0415

    with look():
        figure = new_figure(12.0, 5.7)
        panels = figure.subplots(1, len(results))
        for axes, each in zip(panels, results, strict=True):
            draw_line(axes, each.problem, each.walks, label=f"agent, {WALKS} walks: {each.walks.n_inliers} inliers")
            ends = np.array(axes.get_xlim())
            axes.plot(
                ends,
                np.polyval(each.least_squares, ends),
                color=GREY,
                linestyle="--",
                linewidth=1.3,
                zorder=2,
                label=f"least squares: {_inliers(each.problem, each.least_squares, each.table.threshold)}",
            )
            for other, colour, style, label in (
                (each.refined, PURPLE, ":", "agent, one walk"),
                (each.exact, GREEN, "-.", "exact optimum"),
            ):
                if not np.array_equal(other.inlier_mask, each.walks.inlier_mask):
                    axes.plot(
                        ends,
                        np.polyval(other.model, ends),
                        color=colour,
                        linestyle=style,
                        linewidth=1.5,
                        zorder=3,
                        label=f"{label}: {other.n_inliers}",
                    )
            short = each.exact.n_inliers - each.walks.n_inliers
            found = f"{each.walks.n_inliers} of {each.problem.n_points} points within {each.table.threshold:g}"
            verdict = "the proven optimum" if short == 0 else f"{short} short of the optimum"
            axes.set_title(f"{each.table.title}\n{found}: {verdict}")
            axes.set(xlabel=each.table.x_label, ylabel=each.table.y_label)
            axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, frameon=False)
            number_removals(axes, np.column_stack([each.table.x, each.table.y]), each.walks)
    return figure
