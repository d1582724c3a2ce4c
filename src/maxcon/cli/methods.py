"""``maxcon methods``: the ways to a consensus, with their options."""

from __future__ import annotations

import inspect

import click
from rich.table import Table


@click.command(name="methods", short_help="List the methods and their options.")
def command() -> None:
    """List the methods of `maxcon fit --method` and their options."""
    from maxcon.cli.present import console  # noqa: PLC0415  (brings NumPy and SciPy, which --help can do without)
    from maxcon.fitting import METHODS  # noqa: PLC0415

    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("method", style="bold")
    table.add_column("what it does")
    table.add_column("options (--option KEY=VALUE)")
    for name, entry in METHODS.items():
        described = inspect.signature(entry.load()).parameters
        options = ", ".join(f"{each.name}={each.default}" for each in list(described.values())[1:])
        table.add_row(name, entry.summary, options)
    console().print(table)
