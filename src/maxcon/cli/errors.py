"""Errors of the user's making: one line on stderr and exit code 2."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import click


class Failure(click.ClickException):
    """An error that one line explains; the command line reports it and ends with exit code 2."""

    exit_code = 2

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.ctx = click.get_current_context(silent=True)


@contextmanager
def reported() -> Iterator[None]:
    """Report what the library says about its arguments, and missing extras, as a `Failure`.

    Only for calls whose arguments come from the user: elsewhere a ValueError is a mistake of ours, and shows its
    traceback.
    """
    try:
        yield
    except (ValueError, TypeError, ArithmeticError, ImportError) as error:
        raise Failure(str(error)) from error
