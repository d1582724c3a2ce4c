"""Training as a run in a folder: logs, a progress bar with the held-out gap, checkpoints that resume exactly.

A run folder holds ``config.json``, ``log.jsonl`` (a line a report), TensorBoard's event files, ``checkpoint.pt``
(everything that changes, replaced atomically) and, when the run has ended, ``agent.safetensors``.
"""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from maxcon.agent.config import AgentConfig
from maxcon.agent.learn import Learner, TrainingSet
from maxcon.agent.weights import load_weights, save_weights
from maxcon.tree.batch import BatchEnvironment


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Instances never trained on, with the consensus that each should reach.

    Attributes
    ----------
    data
        The instances.
    reference
        Shape (M,): the optimum, or the best consensus known.
    rate
        Shape (M,): the outlier rate of each, by which the gap is reported.
    """

    data: TrainingSet
    reference: NDArray[np.int64]
    rate: NDArray[np.float64]


def held_out_gap(learner: Learner, held_out: HeldOut) -> dict[float, float]:
    """Return the mean gap of the greedy policy, before any refinement, at each outlier rate."""
    n = len(held_out.reference)
    environment = BatchEnvironment(held_out.data.instances, n)
    environment.reset(np.arange(n), np.arange(n))
    data, learner.data = learner.data, held_out.data
    try:
        with torch.no_grad():
            while not environment.done.all():
                environment.step(learner.q_values(learner.network, environment).argmax(dim=1).numpy())
    finally:
        learner.data = data
    gap = held_out.reference - environment.gain.sum(axis=1)
    return {float(rate): float(gap[held_out.rate == rate].mean()) for rate in np.unique(held_out.rate)}


def train(
    config: AgentConfig,
    data: TrainingSet,
    held_out: HeldOut,
    folder: Path,
    *,
    start: Path | None = None,
    report_every: int = 500,
    checkpoint_seconds: float = 30.0,
    progress: bool = True,
) -> Learner:
    """Train an agent, or go on with the training that `folder` holds; return it where it stands.

    Ctrl-C ends the training after the running update and keeps the checkpoint: called again, it goes on from
    there to the same result as if it had never been stopped.

    Parameters
    ----------
    config
        What is trained, and how.
    data, held_out
        Trained on, and reported on.
    folder
        Of the run; made if need be.
    start
        An agent file whose parameters a new run begins with; None to begin with random ones.
    report_every
        After how many updates the held-out gap is logged.
    checkpoint_seconds
        How often everything is saved.
    progress
        Whether to show a progress bar.

    Raises
    ------
    ValueError
        If `folder` holds a run with another configuration, or `start` holds a network of another shape, or is needed
        and absent.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return _train(config, data, held_out, folder, start, report_every, checkpoint_seconds, progress)
    finally:
        torch.set_num_threads(threads)


def _train(
    config: AgentConfig,
    data: TrainingSet,
    held_out: HeldOut,
    folder: Path,
    start: Path | None,
    report_every: int,
    checkpoint_seconds: float,
    progress: bool,
) -> Learner:
    folder.mkdir(parents=True, exist_ok=True)
    _claim(folder, config)
    learner = Learner(data, config)
    held, settings = len(learner.memory.action), config.train
    if held * settings.n_episodes < 4 * settings.batch or held <= 2 * settings.n_step:
        raise ValueError(
            "memory must hold at least 4 batches, and more than 2 * n_step steps of each of the n_episodes episodes, "
            f"but it is {settings.memory}"
        )
    if (folder / "checkpoint.pt").exists():
        load_checkpoint(learner, folder / "checkpoint.pt")
    elif start is not None:
        begin_with(learner, start)
    elif config.data.started_from:
        raise ValueError(f"start must name the agent file that the run began with, but {folder} has no checkpoint yet")
    log = _Log(folder, learner.updates)
    saved = time.perf_counter()
    losses: list[float] = []
    total = config.train.updates
    with _stop_on_interrupt() as stopped, _bar(progress, total, learner.updates) as bar:
        while learner.updates < total and not stopped.is_set():
            loss = learner.iterate()
            if np.isfinite(loss):
                losses.append(loss)
            if losses and (learner.updates % report_every == 0 or learner.updates == total):
                gaps = held_out_gap(learner, held_out)
                log.write(learner, float(np.mean(losses)), gaps)
                bar(learner.updates, gaps)
                losses.clear()
            elif learner.updates % 20 == 0:
                bar(learner.updates, None)
            if time.perf_counter() - saved > checkpoint_seconds:
                save_checkpoint(learner, folder / "checkpoint.pt")
                saved = time.perf_counter()
    save_checkpoint(learner, folder / "checkpoint.pt")
    log.close()
    if learner.updates >= total:
        save_weights(learner.network, config, folder / "agent.safetensors")
    return learner


def begin_with(learner: Learner, weights: Path) -> None:
    """Put the parameters of an agent file into both networks of `learner`; ValueError if they do not fit."""
    tensors, config = load_weights(weights)
    if config.network != learner.config.network:
        raise ValueError(f"start must hold a network of {learner.config.network}, but it holds one of {config.network}")
    known = {name: tuple(value.shape) for name, value in learner.network.state_dict().items()}
    if {name: value.shape for name, value in tensors.items()} != known:
        raise ValueError(f"start must hold a network for d = {learner.config.train.n_params}, but {weights} does not")
    for network in (learner.network, learner.target):
        network.load_state_dict({name: torch.from_numpy(value.copy()) for name, value in tensors.items()})


def save_checkpoint(learner: Learner, path: Path) -> None:
    """Write everything that changes during training; a kill at any moment leaves the old file or the new one."""
    state = {
        "updates": learner.updates,
        "network": learner.network.state_dict(),
        "target": learner.target.state_dict(),
        "optimizer": learner.optimizer.state_dict(),
        "rng": learner.rng.bit_generator.state,
        "environment": _tensors(learner.environment.snapshot()),
        "memory": _tensors(learner.memory.snapshot()),
    }
    part = path.with_suffix(".part")
    torch.save(state, part)
    os.replace(part, path)


def load_checkpoint(learner: Learner, path: Path) -> None:
    """Put `learner` back where `save_checkpoint` found it."""
    state: dict[str, Any] = torch.load(path, weights_only=True)
    learner.updates = state["updates"]
    learner.network.load_state_dict(state["network"])
    learner.target.load_state_dict(state["target"])
    learner.optimizer.load_state_dict(state["optimizer"])
    learner.rng.bit_generator.state = state["rng"]
    learner.environment.restore({name: value.numpy() for name, value in state["environment"].items()})
    learner.memory.restore({name: value.numpy() for name, value in state["memory"].items()})


def _tensors(arrays: dict[str, NDArray[Any]]) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in arrays.items()}


def _claim(folder: Path, config: AgentConfig) -> None:
    """Write the configuration into a new run folder, or make sure that an old one has the same."""
    path = folder / "config.json"
    text = json.dumps(config.to_dict(), indent=2, sort_keys=True)
    if path.exists():
        before = json.loads(json.dumps(AgentConfig.from_dict(json.loads(path.read_text("utf-8"))).to_dict()))
        after = json.loads(text)
        for part in sorted(after):
            for name, value in after[part].items():
                if (was := before[part][name]) != value:
                    raise ValueError(
                        f"folder holds a run with another configuration ({path}): its {name} is {was}, not {value}; "
                        "name a new folder"
                    )
    else:
        path.write_text(text, encoding="utf-8")


class _Log:
    """TensorBoard events and JSON lines; lines later than the checkpoint that is resumed from are dropped."""

    def __init__(self, folder: Path, updates: int) -> None:
        from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415  (a second to import)

        self.path = folder / "log.jsonl"
        if self.path.exists():
            lines = self.path.read_text(encoding="utf-8").splitlines()
            part = self.path.with_suffix(".part")
            part.write_text("".join(line + "\n" for line in lines if _reported(line) <= updates), encoding="utf-8")
            os.replace(part, self.path)
        self.board = SummaryWriter(str(folder), purge_step=updates + 1)
        self.began = time.perf_counter()

    def write(self, learner: Learner, loss: float, gaps: dict[float, float]) -> None:
        entry = {
            "updates": learner.updates,
            "seconds": round(time.perf_counter() - self.began, 1),
            "loss": loss,
            "gap": {f"{rate:.2f}": gap for rate, gap in gaps.items()},
        }
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")
        self.board.add_scalar("loss", loss, learner.updates)
        for rate, gap in gaps.items():
            self.board.add_scalar(f"held-out gap/{rate:.2f}", gap, learner.updates)

    def close(self) -> None:
        self.board.close()


def _reported(line: str) -> float:
    """Return after how many updates a line was written; infinity for a line that a kill cut short."""
    try:
        return float(json.loads(line)["updates"])
    except (json.JSONDecodeError, KeyError):
        return float("inf")


@contextmanager
def _bar(show: bool, total: int, done: int) -> Iterator[Any]:
    columns = (
        TextColumn("training"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f} updates"),
        TimeRemainingColumn(),
        TextColumn("held-out gap {task.fields[gap]}"),
    )
    with Progress(*columns, disable=not show) as display:
        task = display.add_task("training", total=total, completed=done, gap="-")

        def advance(updates: int, gaps: dict[float, float] | None) -> None:
            display.update(task, completed=updates)
            if gaps is not None:
                display.update(task, gap=" / ".join(f"{gap:.1f}" for gap in gaps.values()))

        yield advance


@contextmanager
def _stop_on_interrupt() -> Iterator[threading.Event]:
    """Turn Ctrl-C into a flag, so that no update is cut in half."""
    stopped = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stopped
        return
    before = signal.signal(signal.SIGINT, lambda *_: stopped.set())
    try:
        yield stopped
    finally:
        signal.signal(signal.SIGINT, before)
