"""The command line: parse, call, show. Each command is a file of its own, imported when it is called."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import click

from maxcon import __version__

#: The commands in the order of the help; ``maxcon.cli.NAME`` holds ``command`` (a dash in NAME is _).
_COMMANDS = (
    "fit",
    "fit-pair",
    "curve",
    "alternatives",
    "verify",
    "demo",
    "methods",
    "compile",
    "agents",
    "train",
    "evaluate",
    "bench",
    "reproduce",
)

#: What a shell expects of a program that Ctrl-C ended.
INTERRUPTED = 130


class _Commands(click.Group):
    """A group that imports a command when it is asked for, and reports every error in one line."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _COMMANDS:
            return None
        command: click.Command = import_module(f"maxcon.cli.{cmd_name.replace('-', '_')}").command
        return command

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        **extra: Any,
    ) -> Any:
        if not standalone_mode:
            return super().main(args, prog_name, complete_var, standalone_mode=False, **extra)
        for stream in (
            sys.stdout,
            sys.stderr,
        ):  # a terminal that lacks a character gets a "?", not a traceback
            if hasattr(stream, "reconfigure"):
                stream.reconfigure(errors="replace")
        try:
            code = super().main(args, prog_name or "maxcon", complete_var, standalone_mode=False, **extra)
        except click.Abort:
            click.echo("maxcon: interrupted", err=True)
            sys.exit(INTERRUPTED)
        except click.ClickException as error:
            click.echo(_one_line(error), err=True)
            sys.exit(2)
        sys.exit(code if isinstance(code, int) else 0)


def _one_line(error: click.ClickException) -> str:
    ctx = getattr(error, "ctx", None) or click.get_current_context(silent=True)
    command = ctx.command_path if ctx is not None else "maxcon"
    message = " ".join(error.format_message().split())
    if isinstance(error, click.UsageError):
        message = f"{message.rstrip('.')} (see {command} --help)"
    return f"{command}: error: {message}"


@click.group(
    "maxcon",
    cls=_Commands,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, prog_name="maxcon")
@click.pass_context
def main(ctx: click.Context) -> None:
    """Fit lines, planes and hyperplanes to data with outliers.

    The model returned explains as many points as possible within a threshold; where it can be proven that no
    model explains more, the answer says so.
    """
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())
