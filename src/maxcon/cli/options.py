"""Options that several commands share, word for word."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

F = TypeVar("F", bound=Callable[..., Any])

#: Whether the first line of a CSV file is a header.
header_option = click.option(
    "--header/--no-header",
    default=None,
    help="Whether the first line of CSV text is a header. Default: if it has no number.",
)

#: Which table is fitted, by what, and with which of its columns.
_TABLE = (
    click.argument("file"),
    click.option("--model", required=True, type=click.Choice(["line", "plane", "hyperplane"]), help="What to fit."),
    click.option(
        "--columns",
        metavar="LIST",
        help="Names or numbers (from 1) of the columns to use, separated by commas, the dependent one last. "
        "Default: all columns.",
    ),
    header_option,
)

#: How `maxcon.fit` searches.
_SEARCH = (
    click.option(
        "--method",
        default="auto",
        show_default=True,
        metavar="NAME",
        help="How to search; `maxcon methods` lists them.",
    ),
    click.option(
        "--refine",
        type=click.Choice(["tree", "swap", "none"]),
        default="swap",
        show_default=True,
        help="How to improve what the search finds: local tree refinement, the same with swaps, or not at all.",
    ),
    click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seeds the random numbers."),
    click.option("--time-limit", type=float, metavar="SECONDS", help="Stop then with the best found so far."),
    click.option(
        "--gap",
        type=click.IntRange(min=0),
        default=0,
        show_default=True,
        help="Stop when the best found is proven to be within so many inliers of the largest possible.",
    ),
    click.option(
        "--certify",
        is_flag=True,
        help="Prove how good the result is, after any method, until the optimum is proven or the time is over.",
    ),
    click.option(
        "--option",
        "options",
        multiple=True,
        metavar="KEY=VALUE",
        help="An option of the method; may be repeated.",
    ),
)


def table_options(command: F) -> F:
    """Give a command the argument FILE and the options --model and --columns."""
    return _apply(_TABLE, command)


def search_options(command: F) -> F:
    """Give a command --method, --refine, --seed, --time-limit, --gap, --certify and --option."""
    return _apply(_SEARCH, command)


def _apply(decorators: tuple[Callable[[F], F], ...], command: F) -> F:
    for decorator in reversed(decorators):
        command = decorator(command)
    return command
