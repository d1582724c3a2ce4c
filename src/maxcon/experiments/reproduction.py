"""Section 4 of the paper, experiment by experiment: what is run in full and in brief, how it is run, and where it goes.

A reproduction is a folder: ``records/NAME.jsonl`` with a row a run, ``figures/NAME.png`` drawn from them, and
``summary.md`` with every claim of the paper beside the numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from maxcon.experiments.contenders import ASTAR, OURS, synthetic_contenders, two_view_contenders
from maxcon.experiments.distribution import distribute
from maxcon.experiments.kitti_experiment import KittiExperiment, cache_folder, first_sequence, frame_pairs
from maxcon.experiments.modelnet_experiment import ModelnetExperiment, held_out_meshes
from maxcon.experiments.records import EXACT, RecordFile, Run
from maxcon.experiments.synthetic_experiment import SyntheticExperiment
from maxcon.experiments.trajectory_experiment import TrajectoryExperiment

#: The experiments, in the order of the paper.
PARTS = ("line", "plane", "modelnet", "kitti", "trajectory")

#: The agents that may be given, with the number of parameters that they are trained for.
AGENTS = {
    "line": 2,
    "line-paper": 2,
    "plane": 3,
    "plane-paper": 3,
    "fundamental": 8,
    "fundamental-paper": 8,
    "fundamental-kitti": 8,
}


@dataclass(frozen=True)
class Scale:
    """How much is run.

    Attributes
    ----------
    sizes, rates, instances
        Of lines and planes: numbers of points, outlier rates in percent, instances for each pair of them.
    modelnet_rates, modelnet_instances
        The same of ModelNet40.
    steps, pairs
        Of KITTI: steps between frames, and how many pairs a step; None for all.
    trajectories
        Small line problems.
    proof_time
        Seconds that the exact method has for an instance.
    astar_time, astar_first
        Seconds that A* has for an instance, and on how many instances of a cell it runs.
    factor
        RANSAC variants have so many times the time of our method.
    """

    sizes: tuple[int, ...] = (100, 200)
    rates: tuple[int, ...] = (10, 20, 30, 40, 50, 60, 70, 80)
    instances: int = 100
    modelnet_rates: tuple[int, ...] = (10, 20, 30, 40, 50)
    modelnet_instances: int = 100
    steps: tuple[int, ...] = (1, 3)
    pairs: int | None = None
    trajectories: int = 100
    proof_time: float = 600.0
    astar_time: float = 10.0
    astar_first: int = 10
    factor: float = 1.0


#: As in the paper.
FULL = Scale()

#: A taste: minutes on two cores.
QUICK = Scale(
    rates=(10, 40, 60, 80),
    instances=10,
    modelnet_rates=(10, 30, 50),
    modelnet_instances=6,
    pairs=6,
    trajectories=40,
    proof_time=30.0,
    astar_time=1.0,
    astar_first=2,
)


class Experiment(Protocol):
    """What can be reproduced."""

    @property
    def name(self) -> str:
        """Of the experiment and its files."""
        ...

    def settings(self) -> dict[str, Any]:
        """Return all that the records depend on."""
        ...

    def units(self) -> Mapping[str, tuple[int, ...]]:
        """Return the instances by their names."""
        ...

    def run(self, unit: str, digest: str) -> list[Run]:
        """Return the records of an instance."""
        ...

    def warm_up(self) -> None:
        """Load or compile all that runs will call."""
        ...


def plan(
    part: str,
    scale: Scale,
    out: Path,
    *,
    seed: int = 0,
    weights: Mapping[str, str] | None = None,
    made: bool = False,
    sequence: str | None = None,
) -> Experiment:
    """Return the experiment of a part.

    Parameters
    ----------
    part
        One of `PARTS`.
    scale
        How much of it.
    out
        The folder of the reproduction, where matches of images are kept, too.
    seed
        Seeds all instances.
    weights
        Agent files by the name of the agent, one of `AGENTS`.
    made
        Use made scenes even where the real data are there.
    sequence
        The drive of KITTI; None for the first there is.

    Raises
    ------
    ValueError
        If there is no such part.
    FileNotFoundError
        If there is no such drive.
    """
    if part not in PARTS:
        raise ValueError(f"part must be one of {', '.join(PARTS)}, but it is {part!r}")
    files = dict(weights or {})
    limits = scale.proof_time, scale.astar_time, scale.astar_first
    if part == "modelnet":
        meshes = () if made else held_out_meshes()
        contenders = two_view_contenders(*limits, files)
        return ModelnetExperiment(
            meshes, scale.modelnet_rates, scale.modelnet_instances, contenders, seed=seed, factor=scale.factor
        )
    if part == "kitti":
        drive = "" if made else first_sequence() if sequence is None else sequence
        pairs = frame_pairs(drive, scale.steps, scale.pairs)
        contenders = two_view_contenders(*limits, files, tuned=True)
        return KittiExperiment(drive, pairs, contenders, cache_folder(out), seed=seed, factor=scale.factor)
    if part == "trajectory":
        contenders = synthetic_contenders("line", *limits, files)
        shown = tuple(replace(each, first=None) for each in contenders if each.name in (EXACT, ASTAR, *OURS))
        return TrajectoryExperiment(shown, n_instances=scale.trajectories, seed=seed)
    contenders = synthetic_contenders(part, *limits, files)
    return SyntheticExperiment(part, scale.sizes, scale.rates, scale.instances, contenders, seed, scale.factor)


def runs_on(experiment: Experiment) -> str:
    """Return in words what the instances of an experiment are made of."""
    if isinstance(experiment, ModelnetExperiment):
        n_meshes = len(experiment.meshes)
        return f"{n_meshes} test meshes of ModelNet40" if n_meshes else "made scenes (ModelNet40 is not there)"
    if isinstance(experiment, KittiExperiment):
        return f"KITTI drive {experiment.sequence!r}" if experiment.sequence else "made pairs (KITTI is not there)"
    return "the paper's synthetic protocol"


def open_records(experiment: Experiment, out: Path) -> RecordFile:
    """Return the records of an experiment in a folder, made if need be.

    Raises
    ------
    ValueError
        If they are those of other settings.
    """
    folder = out / "records"
    folder.mkdir(parents=True, exist_ok=True)
    return RecordFile(folder, experiment.name, experiment.settings())


def reproduce(
    experiment: Experiment,
    records: RecordFile,
    *,
    backend: str = "loky",
    jobs: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Generator[list[Run], None, None]:
    """Run what the records lack, and add it to them; yield the rows of one instance after the other.

    Parameters
    ----------
    experiment, records
        From `plan` and `open_records`.
    backend, jobs, scheduler
        See `maxcon.experiments.distribution.distribute`. The instances and all random numbers are the same whatever
        these are; so are the results but for what hangs on the clock.
    progress
        Called with the number of instances done and of all instances.
    """
    units, known = experiment.units(), records.units
    todo = [_Work(experiment, unit, records.digest) for unit in units if unit not in known]
    done = len(units) - len(todo)
    if progress is not None:
        progress(done, len(units))
    for rows in distribute(_run, todo, backend=backend, jobs=jobs, scheduler=scheduler):
        records.add(rows)
        done += 1
        if progress is not None:
            progress(done, len(units))
        yield rows


@dataclass(frozen=True)
class _Work:
    """A unit of work as it travels to a worker."""

    experiment: Experiment
    unit: str
    digest: str


#: Experiments that this process is warm for, by the digest of their settings.
_warm: set[str] = set()


def _run(work: _Work) -> list[Run]:
    if work.digest not in _warm:
        work.experiment.warm_up()
        _warm.add(work.digest)
    return work.experiment.run(work.unit, work.digest)
