"""``maxcon train``: makes an agent, from random instances and without labels."""

from __future__ import annotations

import _thread
import json
import shlex
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click
import numpy as np

from maxcon.agent.config import AgentConfig, paper, shipped
from maxcon.cli.errors import Failure, reported
from maxcon.cli.interrupt import deferred
from maxcon.cli.output import check_folder
from maxcon.cli.present import console

if TYPE_CHECKING:
    from maxcon.agent.learn import Learner
    from maxcon.problem import LinearProblem

#: Parameters of the models of each family.
N_PARAMS = {"line": 2, "plane": 3}

#: Settings that have an option or argument of their own.
_FIXED = {"n_params", "seed", "updates"}


class _HeldOut(NamedTuple):
    """Instances never trained on, the outlier rate of each in percent, and what `reference_consensus` says of it."""

    problems: list[LinearProblem]
    rates: list[int]
    references: list[tuple[int, bool, float]]


@click.command(name="train", short_help="Train an agent.")
@click.argument("family", type=click.Choice(list(N_PARAMS)))
@click.option("--seed", type=click.IntRange(min=0), help="Seeds everything.  [default: 0]")
@click.option("--updates", type=click.IntRange(min=1), help="How many gradient steps to make.")
@click.option(
    "--minutes", type=click.FloatRange(min=0, min_open=True), help="Stop after so long; called again, it goes on."
)
@click.option(
    "--out", metavar="DIR", help="The folder of the run.  [default: runs/FAMILY-seedSEED, with -paper for --paper]"
)
@click.option("--paper", "as_paper", is_flag=True, help="Train strictly as the paper writes, without any departure.")
@click.option(
    "--set", "changes", multiple=True, metavar="KEY=VALUE", help="Change a setting of the agent; may be repeated."
)
def command(
    family: str,
    seed: int | None,
    updates: int | None,
    minutes: float | None,
    out: str | None,
    as_paper: bool,
    changes: tuple[str, ...],
) -> None:
    """Train an agent for lines or planes on random instances of the paper's protocol.

    DIR gets config.json, log.jsonl, TensorBoard events, checkpoint.pt and, at the end, agent.safetensors, which
    `maxcon fit --method agent --option weights=FILE` and `maxcon evaluate --weights NAME=FILE` take. Ctrl-C
    keeps the checkpoint. Where DIR holds a run, that run goes on, to the same end as if it had not been stopped.

    \b
    Examples:
      maxcon train line
      maxcon train plane --seed 1 --set n_points=200 --out runs/big
      maxcon train line --out runs/line-seed0        (goes on with what was stopped)
    """
    for module in ("torch", "tensorboard"):
        if find_spec(module) is None:
            raise Failure(f"training needs {module}, which is not installed: pip install 'maxcon[train]'")
    config, folder = _run(family, seed, updates, out, as_paper, changes)
    learner, held_out = _train(config, folder, minutes, family)
    total = config.train.updates
    again = f"maxcon train {family} --out {shlex.quote(str(folder))}"
    if learner is None or (learner.updates < total and minutes is None):
        done = 0 if learner is None else learner.updates
        kept = f"the checkpoint is in {folder}" if learner is not None else "there is no checkpoint yet"
        click.echo(f"maxcon train: interrupted after {done} of {total} updates; {kept}; go on with: {again}", err=True)
        click.get_current_context().exit(130)
    weights = folder / "agent.safetensors"
    if learner.updates < total:
        from maxcon.agent.weights import save_weights  # noqa: PLC0415

        save_weights(learner.network, config, weights)
        click.echo(f"stopped after {minutes:g} minutes and {learner.updates} of {total} updates; go on with: {again}")
    _report(held_out, weights, family, config)
    click.echo(f"wrote {weights}")


def parse_settings(pairs: tuple[str, ...]) -> dict[str, Any]:
    """Return KEY=VALUE pairs as settings, each of the type of its default.

    Raises
    ------
    Failure
        If there is no such setting, or the value is none of its type.
    """
    defaults = AgentConfig().to_dict()
    known = defaults["network"] | defaults["train"]
    settings: dict[str, Any] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals:
            raise Failure(f"--set must be KEY=VALUE, but it is {pair!r}")
        if key in _FIXED:
            instead = "FAMILY" if key == "n_params" else f"--{key}"
            raise Failure(f"--set {key}: {instead} gives it")
        if key not in known:
            raise Failure(f"--set: there is no setting {key!r}; settings are {', '.join(sorted(set(known) - _FIXED))}")
        settings[key] = _typed(key, value, known[key])
    return settings


def _typed(key: str, value: str, default: Any) -> Any:
    """Return `value` as what `default` is; lists are separated by commas."""
    try:
        if isinstance(default, bool):
            return {"true": True, "false": False}[value.lower()]
        if isinstance(default, int):
            return int(value)
        if isinstance(default, float):
            return float(value)
        items = [item.strip() for item in value.strip("[]()").split(",") if item.strip()]
        return tuple(int(item) for item in items) if isinstance(default[0], int) else tuple(items)
    except (ValueError, KeyError):
        kinds = {bool: "true or false", int: "a whole number", float: "a number"}
        kind = kinds.get(type(default)) or f"a list such as {','.join(map(str, default))}"
        raise Failure(f"--set {key} must be {kind}, but it is {value!r}") from None


def _run(
    family: str, seed: int | None, updates: int | None, out: str | None, as_paper: bool, changes: tuple[str, ...]
) -> tuple[AgentConfig, Path]:
    """Return configuration and folder; a folder that holds a run gives the configuration, unless told otherwise."""
    n_params = N_PARAMS[family]
    config = (paper if as_paper else shipped)(n_params, seed or 0)
    with reported():
        config = config.override(**parse_settings(changes))
    if updates is not None:
        config = config.override(updates=updates)
    name = out if out is not None else f"runs/{family}{'-paper' * as_paper}-seed{seed or 0}"
    folder = check_folder(name, "--out")
    known = folder / "config.json"
    if known.exists() and not (as_paper or changes or seed is not None or updates is not None):
        with reported():
            config = AgentConfig.from_dict(json.loads(known.read_text(encoding="utf-8")))
        if config.train.n_params != n_params:
            raise Failure(f"--out: {str(folder)!r} holds a run for d = {config.train.n_params}, not for a {family}")
    return config, folder


def _train(config: AgentConfig, folder: Path, minutes: float | None, family: str) -> tuple[Learner | None, _HeldOut]:
    """Draw the instances and train; the learner is None if Ctrl-C came before the training began."""
    from maxcon.agent.learn import prepare  # noqa: PLC0415  (brings torch)
    from maxcon.agent.train import HeldOut, train  # noqa: PLC0415
    from maxcon.datasets.synthetic import THRESHOLD  # noqa: PLC0415
    from maxcon.experiments.training import training_set  # noqa: PLC0415

    note = console(stderr=True)
    with deferred() as stop, reported():
        with note.status("drawing the training set ..."):
            data = training_set(config)
        with note.status("solving the held-out instances ..."):
            known = _held_out(config, stop)
            reference = np.array([goal for goal, _, _ in known.references], dtype=np.int64)
            rates = np.array(known.rates) / 100
            held_out = HeldOut(prepare(known.problems, THRESHOLD, config), reference, rates)
    if stop.is_set():
        return None, known
    what = "going on with the run" if (folder / "checkpoint.pt").exists() else f"training an agent for {family}s"
    click.echo(f"{what}: {config.train.updates} updates, folder {folder}", err=True)
    with reported(), _alarm(minutes):
        return train(config, data, held_out, folder), known


def _held_out(config: AgentConfig, stop: threading.Event) -> _HeldOut:
    """Draw instances that training never sees, and find the consensus that each should reach."""
    from maxcon.datasets.synthetic import THRESHOLD  # noqa: PLC0415
    from maxcon.experiments import training  # noqa: PLC0415
    from maxcon.experiments.evaluation import reference_consensus  # noqa: PLC0415

    problems = training.held_out_problems(config)
    rates = [rate for rate in training.HELD_OUT_RATES for _ in range(training.HELD_OUT_EACH)]
    nothing = (0, False, 0.0)  # after Ctrl-C the references are not used, and a fit would not be finished
    references = [nothing if stop.is_set() else reference_consensus(problem, THRESHOLD) for problem in problems]
    return _HeldOut(problems, rates, references)


@contextmanager
def _alarm(minutes: float | None) -> Iterator[None]:
    """Press Ctrl-C after so many minutes: training ends as it does for a person, with a checkpoint."""
    if minutes is None:
        yield
        return
    deadline = time.monotonic() + 60.0 * minutes
    usual = signal.getsignal(signal.SIGINT)
    over = threading.Event()

    def watch() -> None:
        # Before the training has put its own handler in place, Ctrl-C would break off whatever is going on.
        while not over.wait(0.05):
            if time.monotonic() >= deadline and signal.getsignal(signal.SIGINT) is not usual:
                _thread.interrupt_main()
                return

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()


def _report(held_out: _HeldOut, weights: Path, family: str, config: AgentConfig) -> None:
    """Print the gaps of the trained agent on the held-out instances, as a user's fits with it would have them."""
    from maxcon.cli.gaps import gap_table  # noqa: PLC0415
    from maxcon.experiments.evaluation import Contender, run_instance, summarise  # noqa: PLC0415

    agent = Contender("agent", "agent", {"weights": str(weights)})
    records = []
    with console(stderr=True).status("evaluating ..."), deferred() as stop:
        run_instance(held_out.problems[0], (agent,), 0, 0)  # loads the kernels, so that no time includes that
        for number, problem in enumerate(held_out.problems):
            if stop.is_set():
                break
            rate, goal = held_out.rates[number], held_out.references[number]
            records += run_instance(problem, (agent,), rate, number, goal)
    rows = [each for each in summarise(records) if each.name == "agent"]
    each = len(held_out.rates) // len(set(held_out.rates))
    title = f"{family}, N = {config.train.n_points}, {each} held-out instances a rate"
    console().print(gap_table(rows, title))
