"""The data that agents are trained on and judged by while they train, drawn from the seed of the run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from maxcon.agent.config import AgentConfig
from maxcon.datasets.synthetic import THRESHOLD, mixed_rates, synthetic_hyperplane
from maxcon.experiments.evaluation import reference_consensus

if TYPE_CHECKING:
    from maxcon.agent.learn import TrainingSet
    from maxcon.agent.train import HeldOut
    from maxcon.problem import LinearProblem

#: The held-out set of lines and planes: outlier rates in percent, and instances at each.
HELD_OUT_RATES = (10, 20, 30, 40, 50, 60)
HELD_OUT_EACH = 32

#: The same of fundamental matrices, whose best consensus takes seconds to find.
TWO_VIEW_RATES = (10, 20, 30, 40, 50)
TWO_VIEW_EACH = 16

#: Where training instances may come from.
SOURCES = ("hyperplane", "scene", "modelnet", "kitti")


def training_set(config: AgentConfig, folder: Path | None = None) -> TrainingSet:
    """Return the training instances of a run, drawn by ``default_rng([seed, 1])``.

    Parameters
    ----------
    config
        What is drawn, and how many.
    folder
        The data set, for the sources "modelnet" and "kitti"; None for that in the folder of the data sets.

    Raises
    ------
    FileNotFoundError
        If the data set is absent; the message says how to obtain it.
    ValueError
        If the source is unknown, the data do not do, or the network asks for an estimate where there is none.
    """
    from maxcon.agent.learn import prepare  # noqa: PLC0415  (brings torch)

    return prepare(training_problems(config, folder), config.data.threshold, config)


def training_problems(config: AgentConfig, folder: Path | None = None) -> list[LinearProblem]:
    """Return what `training_set` prepares."""
    settings = config.train
    rng = np.random.default_rng([settings.seed, 1])
    each = range(settings.n_instances)
    if _source(config) == "hyperplane":
        sample = mixed_rates(settings.n_points, settings.n_params, settings.low_rate, settings.high_rate)
        return [sample(rng) for _ in each]
    from maxcon.experiments.two_view_instances import DriveSource, SceneSource  # noqa: PLC0415  (only these need it)

    if config.data.source == "kitti":
        drive = DriveSource(config.data, "train", settings.n_points, folder)
        return [drive.draw(rng) for _ in each]
    scenes = SceneSource(config.data, "train", folder)
    return [scenes.draw(rng, settings.n_points, rng.uniform(settings.low_rate, settings.high_rate)) for _ in each]


def held_out_problems(config: AgentConfig, folder: Path | None = None) -> list[LinearProblem]:
    """Return instances that training never sees, drawn by ``default_rng([seed, 2])``, by rising outlier rate.

    Of a drive: pairs of later frames, at whatever rate they have.
    """
    settings = config.train
    rng = np.random.default_rng([settings.seed, 2])
    if _source(config) == "hyperplane":
        return [
            synthetic_hyperplane(rng, settings.n_points, rate / 100, settings.n_params)
            for rate in HELD_OUT_RATES
            for _ in range(HELD_OUT_EACH)
        ]
    from maxcon.experiments.two_view_instances import DriveSource, SceneSource  # noqa: PLC0415

    rates = [rate for rate in TWO_VIEW_RATES for _ in range(TWO_VIEW_EACH)]
    if config.data.source == "kitti":
        drive = DriveSource(config.data, "test", settings.n_points, folder)
        return [drive.draw(rng) for _ in rates]
    scenes = SceneSource(config.data, "test", folder)
    return [scenes.draw(rng, settings.n_points, rate / 100) for rate in rates]


def reference(problem: LinearProblem, config: AgentConfig) -> tuple[int, bool, float]:
    """Return the consensus to reach, whether it is proven to be the largest, and the seconds that it took."""
    if config.data.source == "hyperplane":
        return reference_consensus(problem, THRESHOLD)
    from maxcon.experiments.two_view_instances import best_known  # noqa: PLC0415

    return best_known(problem, config.data.threshold)


def held_out_rates(config: AgentConfig, problems: list[LinearProblem], consensus: list[int]) -> list[int]:
    """Return the outlier rate of each held-out instance in percent.

    Of a drive, where none was chosen: that of the consensus to reach, in steps of 10.
    """
    if config.data.source == "kitti":
        shares = [1.0 - n / problem.n_points for n, problem in zip(consensus, problems, strict=True)]
        return [10 * round(10 * share) for share in shares]
    rates, each = (
        (HELD_OUT_RATES, HELD_OUT_EACH) if config.data.source == "hyperplane" else (TWO_VIEW_RATES, TWO_VIEW_EACH)
    )
    return [rate for rate in rates for _ in range(each)]


def held_out(config: AgentConfig, folder: Path | None = None) -> HeldOut:
    """Return the held-out instances with the consensus that each should reach."""
    from maxcon.agent.learn import prepare  # noqa: PLC0415
    from maxcon.agent.train import HeldOut  # noqa: PLC0415

    problems = held_out_problems(config, folder)
    consensus = [reference(problem, config)[0] for problem in problems]
    rates = np.array(held_out_rates(config, problems, consensus)) / 100
    return HeldOut(prepare(problems, config.data.threshold, config), np.array(consensus, dtype=np.int64), rates)


def _source(config: AgentConfig) -> str:
    if config.data.source not in SOURCES:
        raise ValueError(f"source must be one of {', '.join(SOURCES)}, but it is {config.data.source!r}")
    chart = "" if config.data.source == "hyperplane" else config.data.chart
    if config.network.estimate and chart != "auto":
        raise ValueError("estimate must be false but for the chart 'auto': elsewhere theta = 0 is no estimate")
    return config.data.source
