"""``maxcon compile``: compiles the kernels ahead, so that no fit waits for them."""

from __future__ import annotations

import time

import click
from rich.text import Text

from maxcon.cli.errors import Failure
from maxcon.cli.present import console, duration


@click.command(name="compile", short_help="Compile the kernels ahead, so that no fit waits for them.")
def command() -> None:
    """Compile all that fits and proofs need, or load it where that has been done, by solving small made problems.

    Kernels are compiled when they are first called, and then kept on disk: without this command the first fit of a
    kind waits for them, and so does the first with more than 400 points, or of two views. That takes two to five
    minutes in all, once on a machine for each version of maxcon. Worth it after an installation, in a container's
    image, or before fits with time limits of milliseconds. (A process loads kernels when it first calls them, which
    takes a second in all: a program that must never wait calls maxcon.compile_kernels() when it starts.)
    """
    from numba.core import config  # noqa: PLC0415  (heavy)

    from maxcon.compiling import compile_kernels  # noqa: PLC0415

    if config.DISABLE_JIT:
        raise Failure("nothing is compiled where NUMBA_DISABLE_JIT is set")
    began = time.perf_counter()
    err = console(stderr=True)
    with err.status("compiling ...") as status:

        def show(words: str) -> None:
            if err.is_terminal:
                status.update(f"compiling: {words} ({duration(time.perf_counter() - began)} so far)")
            else:
                click.echo(f"compiling: {words}", err=True)

        seconds = compile_kernels(show)
    done = f"all kernels are ready: {duration(seconds)} of compiling and loading"
    console().print(Text(f"{done}, {duration(time.perf_counter() - began)} in all"))
