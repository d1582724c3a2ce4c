"""The data that agents are trained on and judged by while they train, drawn from the seed of the run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from maxcon.agent.config import AgentConfig
from maxcon.datasets.synthetic import THRESHOLD, mixed_rates, synthetic_hyperplane
from maxcon.experiments.evaluation import reference_consensus

if TYPE_CHECKING:
    from maxcon.agent.learn import TrainingSet
    from maxcon.agent.train import HeldOut
    from maxcon.problem import LinearProblem

#: The held-out set: outlier rates in percent, and instances at each.
HELD_OUT_RATES = (10, 20, 30, 40, 50, 60)
HELD_OUT_EACH = 32


def training_set(config: AgentConfig) -> TrainingSet:
    """Return the training instances of a run, drawn by ``default_rng([seed, 1])``."""
    from maxcon.agent.learn import prepare  # noqa: PLC0415  (brings torch)

    settings = config.train
    sample = mixed_rates(settings.n_points, settings.n_params, settings.low_rate, settings.high_rate)
    rng = np.random.default_rng([settings.seed, 1])
    return prepare([sample(rng) for _ in range(settings.n_instances)], THRESHOLD, config)


def held_out_problems(config: AgentConfig) -> list[LinearProblem]:
    """Return instances that training never sees, drawn by ``default_rng([seed, 2])``, by rising outlier rate."""
    settings = config.train
    rng = np.random.default_rng([settings.seed, 2])
    return [
        synthetic_hyperplane(rng, settings.n_points, rate / 100, settings.n_params)
        for rate in HELD_OUT_RATES
        for _ in range(HELD_OUT_EACH)
    ]


def held_out(config: AgentConfig) -> HeldOut:
    """Return the held-out instances with the consensus that each should reach."""
    from maxcon.agent.learn import prepare  # noqa: PLC0415
    from maxcon.agent.train import HeldOut  # noqa: PLC0415

    problems = held_out_problems(config)
    reference = np.array([reference_consensus(problem, THRESHOLD)[0] for problem in problems], dtype=np.int64)
    rates = np.repeat(np.array(HELD_OUT_RATES) / 100, HELD_OUT_EACH)
    return HeldOut(prepare(problems, THRESHOLD, config), reference, rates)
