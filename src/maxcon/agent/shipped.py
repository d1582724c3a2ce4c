"""The agents in the wheel: one safetensors file and one model card each.

An agent that has the name of a family of problems serves it; the others, such as "fundamental-paper", are asked for.
"""

from __future__ import annotations

from functools import cache
from importlib import resources
from pathlib import Path

from maxcon.agent.inference import Agent
from maxcon.problem import LinearProblem

#: Where the agent files and their cards lie.
_FOLDER = Path(str(resources.files("maxcon.agent"))) / "shipped_agents"


def agent_names() -> tuple[str, ...]:
    """Return the names of the shipped agents."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.safetensors")))


def agent_path(name: str) -> Path:
    """Return the file of a shipped agent.

    Raises
    ------
    ValueError
        If there is no agent of this name.
    """
    if name not in agent_names():
        raise ValueError(f"name must be one of {', '.join(agent_names())}, but it is {name!r}")
    return _FOLDER / f"{name}.safetensors"


def agent_file(weights: str | Path) -> Path:
    """Return the file that is meant: `weights`, or the shipped agent of that name where there is no such file."""
    path = Path(weights)
    return agent_path(str(weights)) if str(weights) in agent_names() and not path.exists() else path


def model_card(name: str) -> str:
    """Return the model card of a shipped agent, Markdown; ValueError if there is no agent of this name."""
    return agent_path(name).with_suffix(".md").read_text(encoding="utf-8")


def shipped_agent(problem: LinearProblem) -> Agent:
    """Return the agent for the family of `problem`.

    Raises
    ------
    ValueError
        If none is shipped for it.
    """
    families = [name for name in agent_names() if "-" not in name]
    if problem.family not in families:
        raise ValueError(
            f"method 'agent' has shipped agents for the families {', '.join(families)}, but the problem is of "
            f"the family {problem.family!r}: pass weights=FILE of an agent trained for it, or use another method"
        )
    return _load(problem.family)


@cache
def _load(name: str) -> Agent:
    return Agent.load(agent_path(name))
