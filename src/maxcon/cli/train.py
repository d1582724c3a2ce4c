"""``maxcon train``: makes an agent, from random instances and without labels."""

from __future__ import annotations

import _thread
import hashlib
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

from maxcon.agent.config import AgentConfig, fine_tuning, fundamental, paper, shipped
from maxcon.cli.errors import Failure, reported
from maxcon.cli.interrupt import deferred
from maxcon.cli.output import check_folder
from maxcon.cli.present import console
from maxcon.cli.train_search import LEARNERS, check_learner, train_search

if TYPE_CHECKING:
    from maxcon.agent.learn import Learner
    from maxcon.problem import LinearProblem

#: Parameters of the models of each family.
N_PARAMS = {"line": 2, "plane": 3, "fundamental": 8}

#: Rounds that the shipped networks of the learned search were trained for.
SEARCH_ROUNDS = 120

#: Settings that have an option or argument of their own.
_FIXED = {"n_params": "FAMILY", "seed": "--seed", "updates": "--updates", "source": "--data", "started_from": "--from"}


class _HeldOut(NamedTuple):
    """Instances never trained on, the outlier rate of each in percent, and what `reference_consensus` says of it."""

    problems: list[LinearProblem]
    rates: list[int]
    references: list[tuple[int, bool, float]]


@click.command(name="train", short_help="Train an agent.")
@click.argument("family", type=click.Choice([*N_PARAMS, "search"]))
@click.option(
    "--learner",
    "teacher",
    type=click.Choice(LEARNERS),
    help="What teaches: the paper's DQN; for the search, imitation of the best sets known, or of proven optima.  "
    "[default: dqn; for the search self-imitation]",
)
@click.option("--seed", type=click.IntRange(min=0), help="Seeds everything.  [default: 0]")
@click.option("--updates", type=click.IntRange(min=1), help="How many gradient steps to make; rounds for the search.")
@click.option(
    "--minutes", type=click.FloatRange(min=0, min_open=True), help="Stop after so long; called again, it goes on."
)
@click.option(
    "--out",
    metavar="DIR",
    help="The folder of the run.  [default: runs/FAMILY-seedSEED, with -paper for --paper, -tuned for --from]",
)
@click.option("--paper", "as_paper", is_flag=True, help="Train strictly as the paper writes, without any departure.")
@click.option(
    "--data",
    metavar="FOLDER",
    help="Fundamental matrices from a KITTI odometry folder (matches of frame pairs) or from ModelNet40 (meshes); for "
    "the search, your own tables (.npy, .csv: A, with a column of ones for an intercept, beside b, as `maxcon fit-pair "
    "--rows` writes).  [default: made data]",
)
@click.option(
    "--threshold", type=float, metavar="E", help="Of the tables of --data: the largest residual of an inlier."
)
@click.option(
    "--from",
    "start",
    metavar="WEIGHTS",
    help="Fine-tune an agent: a file, or the name of a shipped one; network and settings are its own.",
)
@click.option(
    "--set", "changes", multiple=True, metavar="KEY=VALUE", help="Change a setting of the agent; may be repeated."
)
def command(
    family: str,
    teacher: str | None,
    seed: int | None,
    updates: int | None,
    minutes: float | None,
    out: str | None,
    as_paper: bool,
    data: str | None,
    threshold: float | None,
    start: str | None,
    changes: tuple[str, ...],
) -> None:
    """Train an agent for lines, planes or fundamental matrices, or the networks of the learned search.

    Lines and planes come from random instances of the paper's protocol.

    For an agent DIR gets config.json, log.jsonl, TensorBoard events, checkpoint.pt and, at the end, agent.safetensors,
    which `maxcon fit --method agent --option weights=FILE` and `maxcon evaluate --weights NAME=FILE` take. Ctrl-C
    keeps the checkpoint. Where DIR holds a run, that run goes on, to the same end as if it had not been stopped.

    Fundamental matrices (d = 8) come from made scenes with 10 to 50% outliers, threshold 0.1, in the chart "auto". With
    --data they come from the training meshes of ModelNet40, or from pairs of frames of a KITTI drive at the threshold
    0.01: frames 0 to 24 train, later ones are held out (--set frames=0,24 --set steps=1,3 --set sequence=NAME).
    No label is used anywhere.

    FAMILY "search" trains the two small networks of the method "learned", for all families at once, by imitation of the
    best sets that anything has found, or with --learner optima of those that are proven to be the largest. DIR gets
    checkpoint.pt, from which it goes on as well, and after every round search.safetensors, which
    `maxcon fit --method learned --option network=FILE` takes. It has no settings to change with --set, no --from and
    no --paper.

    \b
    Examples:
      maxcon train line
      maxcon train plane --seed 1 --set n_points=200 --out runs/big
      maxcon train line --out runs/line-seed0        (goes on with what was stopped)
      maxcon train fundamental --from fundamental --data kitti
      maxcon train search --updates 120
    """
    for module in ("torch", "tensorboard"):
        if find_spec(module) is None:
            raise Failure(f"training needs {module}, which is not installed: pip install 'maxcon[train]'")
    chosen = check_learner(family, teacher)
    if family == "search":
        if as_paper or start is not None or changes:
            raise Failure("--paper, --from and --set are for agents, not for the search")
        train_search(chosen, seed or 0, updates or SEARCH_ROUNDS, minutes, out, data, threshold)
        return
    if threshold is not None:
        raise Failure("--threshold is for the tables of the search; for agents it is --set threshold=E")
    place = _Place(*_data_folder(family, data), _weights(start, as_paper))
    config, folder = _run(family, seed, updates, out, as_paper, place, changes)
    learner, held_out = _train(config, folder, minutes, family, place)
    total = config.train.updates
    given = "".join(f" {name} {shlex.quote(value)}" for name, value in (("--data", data), ("--from", start)) if value)
    again = f"maxcon train {family}{given} --out {shlex.quote(str(folder))}"
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


class _Place(NamedTuple):
    """What training takes from the disk: the kind of the data, their folder, and the weights to begin with."""

    source: str | None
    folder: Path | None
    start: Path | None


def _data_folder(family: str, data: str | None) -> tuple[str | None, Path | None]:
    """Return what kind of data is in the folder of --data, and the folder; Failure if it is none that is known."""
    if data is None:
        return None, None
    if family != "fundamental":
        raise Failure(f"--data is for fundamental matrices, not for a {family}")
    folder = Path(data)
    if (folder / "sequences").is_dir():
        return "kitti", folder
    if any(folder.glob("*/train/*.off")):
        return "modelnet", folder
    raise Failure(
        f"--data must hold sequences/NAME/image_0/*.png (KITTI odometry) or CLASS/train/*.off (ModelNet40), "
        f"but {data!r} {'does not' if folder.is_dir() else 'is no folder'}"
    )


def _weights(start: str | None, as_paper: bool) -> Path | None:
    """Return the agent file to begin with."""
    if start is None:
        return None
    if as_paper:
        raise Failure("--from brings its own settings: it cannot be used with --paper")
    from maxcon.agent.shipped import agent_file  # noqa: PLC0415

    return agent_file(start)


def parse_settings(pairs: tuple[str, ...]) -> dict[str, Any]:
    """Return KEY=VALUE pairs as settings, each of the type of its default.

    Raises
    ------
    Failure
        If there is no such setting, or the value is none of its type.
    """
    defaults = AgentConfig().to_dict()
    known = defaults["network"] | defaults["train"] | defaults["data"]
    settings: dict[str, Any] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals:
            raise Failure(f"--set must be KEY=VALUE, but it is {pair!r}")
        if key in _FIXED:
            raise Failure(f"--set {key}: {_FIXED[key]} gives it")
        if key not in known:
            raise Failure(
                f"--set: there is no setting {key!r}; settings are {', '.join(sorted(set(known) - set(_FIXED)))}"
            )
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
        if isinstance(default, str):
            return value
        items = [item.strip() for item in value.strip("[]()").split(",") if item.strip()]
        return tuple(int(item) for item in items) if isinstance(default[0], int) else tuple(items)
    except (ValueError, KeyError):
        kinds = {bool: "true or false", int: "a whole number", float: "a number"}
        kind = kinds.get(type(default)) or f"a list such as {','.join(map(str, default))}"
        raise Failure(f"--set {key} must be {kind}, but it is {value!r}") from None


def _run(
    family: str,
    seed: int | None,
    updates: int | None,
    out: str | None,
    as_paper: bool,
    place: _Place,
    changes: tuple[str, ...],
) -> tuple[AgentConfig, Path]:
    """Return configuration and folder; a folder that holds a run gives the configuration, unless told otherwise."""
    n_params = N_PARAMS[family]
    kind = "-paper" * as_paper + "-tuned" * (place.start is not None)
    folder = check_folder(out if out is not None else f"runs/{family}{kind}-seed{seed or 0}", "--out")
    known = folder / "config.json"
    if known.exists() and not (as_paper or changes or seed is not None or updates is not None):
        with reported():
            config = AgentConfig.from_dict(json.loads(known.read_text(encoding="utf-8")))
        if config.train.n_params != n_params:
            raise Failure(f"--out: {str(folder)!r} holds a run for d = {config.train.n_params}, not for a {family}")
        if config.data.source in ("kitti", "modelnet") and place.source != config.data.source:
            raise Failure(f"--data must name the folder of {config.data.source} again to go on with {str(folder)!r}")
        if place.start is not None and _digest(place.start) != config.data.started_from:
            raise Failure(f"--from: {str(folder)!r} holds a run that did not begin with {str(place.start)!r}")
        return config, folder
    config = _new_run(family, seed or 0, as_paper, place)
    with reported():
        config = config.override(**parse_settings(changes))
    return (config if updates is None else config.override(updates=updates)), folder


def _new_run(family: str, seed: int, as_paper: bool, place: _Place) -> AgentConfig:
    """Return the configuration of a run before any setting is changed."""
    n_params = N_PARAMS[family]
    config = (paper if as_paper else shipped)(n_params, seed)
    if place.start is not None:
        from maxcon.agent.weights import load_weights  # noqa: PLC0415

        with reported():
            _, before = load_weights(place.start)
        if before.train.n_params != n_params:
            raise Failure(f"--from: {str(place.start)!r} was trained for d = {before.train.n_params}, not a {family}")
        config = fine_tuning(before, seed).override(started_from=_digest(place.start))
        if place.source == "kitti":
            config = config.override(threshold=0.01)
        return config if place.source is None else config.override(source=place.source)
    return fundamental(config, place.source or "scene") if family == "fundamental" else config


def _digest(file: Path) -> str:
    """Return the SHA-256 digest of an agent file, by which a run knows what it began with."""
    if not file.is_file():
        raise Failure(f"--from must name an agent file, but there is no file {str(file)!r}")
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _train(
    config: AgentConfig, folder: Path, minutes: float | None, family: str, place: _Place
) -> tuple[Learner | None, _HeldOut]:
    """Draw the instances and train; the learner is None if Ctrl-C came before the training began."""
    from maxcon.agent.learn import prepare  # noqa: PLC0415  (brings torch)
    from maxcon.agent.train import HeldOut, train  # noqa: PLC0415
    from maxcon.experiments.training import training_set  # noqa: PLC0415

    note = console(stderr=True)
    with deferred() as stop, reported(), _found():
        with note.status("drawing the training set ..."):
            data = training_set(config, place.folder)
        with note.status("solving the held-out instances ..."):
            known = _held_out(config, place.folder, stop)
            reference = np.array([goal for goal, _, _ in known.references], dtype=np.int64)
            rates = np.array(known.rates) / 100
            held_out = HeldOut(prepare(known.problems, config.data.threshold, config), reference, rates)
    if stop.is_set():
        return None, known
    what = (
        "going on with the run" if (folder / "checkpoint.pt").exists() else f"training an agent for {_plural(family)}"
    )
    click.echo(f"{what}: {config.train.updates} updates, folder {folder}", err=True)
    with reported(), _alarm(minutes):
        return train(config, data, held_out, folder, start=place.start), known


def _plural(family: str) -> str:
    return "fundamental matrices" if family == "fundamental" else f"{family}s"


@contextmanager
def _found() -> Iterator[None]:
    """Report data that are not there as a `Failure`."""
    try:
        yield
    except FileNotFoundError as error:
        raise Failure(str(error)) from error


def _held_out(config: AgentConfig, folder: Path | None, stop: threading.Event) -> _HeldOut:
    """Draw instances that training never sees, and find the consensus that each should reach."""
    from maxcon.experiments import training  # noqa: PLC0415

    problems = training.held_out_problems(config, folder)
    nothing = (0, False, 0.0)  # after Ctrl-C the references are not used, and a fit would not be finished
    references = [nothing if stop.is_set() else training.reference(problem, config) for problem in problems]
    rates = training.held_out_rates(config, problems, [goal for goal, _, _ in references])
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
        run_instance(
            held_out.problems[0], (agent,), 0, 0, held_out.references[0]
        )  # loads the kernels, so that no time includes that
        for number, problem in enumerate(held_out.problems):
            if stop.is_set():
                break
            rate, goal = held_out.rates[number], held_out.references[number]
            records += run_instance(problem, (agent,), rate, number, goal, config.data.threshold)
    rows = [each for each in summarise(records) if each.name == "agent"]
    each = len(held_out.rates) // len(set(held_out.rates))
    many = (
        f"{len(held_out.rates)} held-out instances"
        if config.data.source == "kitti"
        else f"{each} held-out instances a rate"
    )
    title = f"{family}, N = {config.train.n_points}, {many}"
    console().print(gap_table(rows, title))
