"""Lines and planes from the paper's synthetic protocol (section 4.1, figures 5 and 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from maxcon.datasets.synthetic import THRESHOLD, synthetic_hyperplane
from maxcon.experiments.contenders import Contender, Instance, compete, warm_up
from maxcon.experiments.evaluation import N_PARAMS
from maxcon.experiments.records import Run

#: Tells the random numbers of these instances from those of training and of ``maxcon evaluate``.
_STREAM = 5


@dataclass(frozen=True)
class SyntheticExperiment:
    """Every contender on held-out lines or planes.

    Attributes
    ----------
    name
        "line" or "plane".
    sizes, rates, n_instances
        Numbers of points, outlier rates in percent, and how many instances each cell of the two has.
    contenders
        What is compared.
    seed
        Instance i of N and rate comes from ``default_rng([seed, 5, d, N, rate, i])``, whoever runs it and when.
    factor
        The RANSAC variants have so many times the time of our method.
    """

    name: str
    sizes: tuple[int, ...]
    rates: tuple[int, ...]
    n_instances: int
    contenders: tuple[Contender, ...]
    seed: int = 0
    factor: float = 1.0

    def settings(self) -> dict[str, Any]:
        """Return all that the records depend on."""
        return {
            "experiment": self.name,
            "sizes": list(self.sizes),
            "rates": list(self.rates),
            "instances": self.n_instances,
            "seed": self.seed,
            "factor": self.factor,
            "contenders": [each.describe() for each in self.contenders],
        }

    def units(self) -> dict[str, tuple[int, ...]]:
        """Return N, rate and number of every instance by its name: first one of every cell, then another."""
        return {
            f"N={n_points}, {rate}%, {number}": (n_points, rate, number)
            for number in range(self.n_instances)
            for n_points in self.sizes
            for rate in self.rates
        }

    def run(self, unit: str, digest: str) -> list[Run]:
        """Return the records of an instance."""
        rows, _ = compete(self.instance(unit), self.contenders, self.factor, digest)
        return rows

    def warm_up(self) -> None:
        """Load or compile all that runs will call."""
        problem = synthetic_hyperplane(np.random.default_rng(0), 30, 0.3, N_PARAMS[self.name])
        warm_up(Instance(self.name, "", "", problem, THRESHOLD, 0, 0), self.contenders)

    def instance(self, unit: str) -> Instance:
        """Return an instance by its name."""
        n_points, rate, number = self.units()[unit]
        n_params = N_PARAMS[self.name]
        seed = [self.seed, _STREAM, n_params, n_points, rate, number]
        problem = synthetic_hyperplane(np.random.default_rng(seed), n_points, rate / 100, n_params)
        return Instance(self.name, unit, f"seed {seed}", problem, THRESHOLD, number, number, rate)
