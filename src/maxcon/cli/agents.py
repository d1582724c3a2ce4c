"""``maxcon agents``: the trained agents in the package, and their model cards."""

from __future__ import annotations

import json
from typing import Any

import click
from rich.markdown import Markdown
from rich.table import Table

from maxcon.cli.errors import reported


@click.command(name="agents", short_help="List the trained agents, or show a model card.")
@click.argument("name", required=False)
@click.option("--json", "as_json", is_flag=True, help="Print JSON, with the whole configuration of each agent.")
def command(name: str | None, as_json: bool) -> None:
    """List the agents that ship with the package, or print the model card of the agent NAME."""
    from maxcon.agent.shipped import agent_names, model_card  # noqa: PLC0415
    from maxcon.cli.present import console  # noqa: PLC0415

    names = agent_names()
    card = None
    if name is not None:
        with reported():
            card = model_card(name)
        names = (name,)
    if as_json:
        click.echo(json.dumps([_facts(each) | {"card": model_card(each)} for each in names], indent=2))
    elif card is not None:
        out = console()
        out.print(Markdown(card) if out.is_terminal else card, markup=False, soft_wrap=not out.is_terminal)
    elif not names:
        click.echo("this copy of maxcon ships no agents; `maxcon train line` makes one")
    else:
        console().print(_table([_facts(each) for each in names]))
        click.echo("\n`maxcon agents NAME` prints the model card: how the agent was trained, and how well it does.")


def _facts(name: str) -> dict[str, Any]:
    from maxcon.agent.shipped import agent_path  # noqa: PLC0415
    from maxcon.agent.weights import load_weights  # noqa: PLC0415

    path = agent_path(name)
    tensors, config = load_weights(path)
    return {
        "name": name,
        "bytes": path.stat().st_size,
        "parameters": sum(int(tensor.size) for tensor in tensors.values()),
        "config": config.to_dict(),
    }


def _table(agents: list[dict[str, Any]]) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("agent", style="bold")
    for title in ("size", "parameters", "trained on N", "d", "outliers", "updates", "seed"):
        table.add_column(title, justify="right")
    for agent in agents:
        train = agent["config"]["train"]
        table.add_row(
            agent["name"],
            f"{agent['bytes'] / 1024:.0f} KB",
            f"{agent['parameters']:,}",
            str(train["n_points"]),
            str(train["n_params"]),
            f"{train['low_rate']:.0%} to {train['high_rate']:.0%}",
            f"{train['updates']:,}",
            str(train["seed"]),
        )
    return table
