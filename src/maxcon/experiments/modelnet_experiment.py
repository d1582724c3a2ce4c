"""Fundamental matrices of two views of ModelNet40's meshes (section 4.2, left of figure 7)."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from maxcon.datasets.modelnet import Mesh, load_off, modelnet_files, modelnet_two_view
from maxcon.datasets.two_view_scene import THRESHOLD, TwoViewScene, synthetic_two_view
from maxcon.experiments.contenders import Contender, Instance, compete, warm_up
from maxcon.experiments.records import Run
from maxcon.vision.fundamental import fundamental_problem

#: Tells the random numbers of these instances from those of training.
_STREAM = 6


@dataclass(frozen=True)
class ModelnetExperiment:
    """Every contender on matches of two views of the test meshes.

    Attributes
    ----------
    meshes
        The files of the test meshes, taken in turn; none: shapes of our own.
    rates, n_instances
        Outlier rates in percent, and how many instances each has.
    contenders
        What is compared.
    n_points
        Matches (N).
    chart
        How the scale of F is fixed, see `maxcon.vision.fundamental_problem`.
    seed
        Instance i of a rate comes from ``default_rng([seed, 6, N, rate, i])``, whoever runs it and when.
    factor
        The RANSAC variants have so many times the time of our method.
    """

    meshes: tuple[str, ...]
    rates: tuple[int, ...]
    n_instances: int
    contenders: tuple[Contender, ...]
    n_points: int = 100
    chart: str = "auto"
    seed: int = 0
    factor: float = 1.0
    name: str = "modelnet"

    def settings(self) -> dict[str, Any]:
        """Return all that the records depend on."""
        return {
            "experiment": self.name,
            "meshes": [Path(mesh).stem for mesh in self.meshes] or "shapes of our own",
            "n_points": self.n_points,
            "rates": list(self.rates),
            "instances": self.n_instances,
            "threshold": THRESHOLD,
            "chart": self.chart,
            "seed": self.seed,
            "factor": self.factor,
            "contenders": [each.describe() for each in self.contenders],
        }

    def units(self) -> dict[str, tuple[int, ...]]:
        """Return rate and number of every instance by its name: first one of every rate, then another."""
        return {f"{rate}%, {number}": (rate, number) for number in range(self.n_instances) for rate in self.rates}

    def run(self, unit: str, digest: str) -> list[Run]:
        """Return the records of an instance."""
        rows, _ = compete(self.instance(unit), self.contenders, self.factor, digest)
        return rows

    def warm_up(self) -> None:
        """Load or compile all that runs will call."""
        scene = synthetic_two_view(30, 0.2, np.random.default_rng(0))
        problem = fundamental_problem(scene.x1, scene.x2, chart=self.chart, threshold=THRESHOLD).problem
        warm_up(Instance(self.name, "", "", problem, THRESHOLD, 0, 0), self.contenders)

    def instance(self, unit: str) -> Instance:
        """Return an instance by its name."""
        rate, number = self.units()[unit]
        seed = [self.seed, _STREAM, self.n_points, rate, number]
        scene, mesh = self._scene(rate, number, np.random.default_rng(seed))
        posed = fundamental_problem(scene.x1, scene.x2, chart=self.chart, threshold=THRESHOLD, rng=number)
        return Instance(self.name, unit, f"{mesh}, seed {seed}", posed.problem, THRESHOLD, number, number, rate)

    def _scene(self, rate: int, number: int, rng: np.random.Generator) -> tuple[TwoViewScene, str]:
        if not self.meshes:
            return synthetic_two_view(self.n_points, rate / 100, rng), "shapes of our own"
        mesh = _mesh(self.meshes[number % len(self.meshes)])
        return modelnet_two_view(mesh, self.n_points, rate / 100, rng), mesh.name


def held_out_meshes() -> tuple[str, ...]:
    """Return the files of the test meshes; none where the data are absent."""
    try:
        return tuple(str(file) for file in modelnet_files("test"))
    except FileNotFoundError:
        return ()


@functools.lru_cache(maxsize=64)
def _mesh(file: str) -> Mesh:
    return load_off(file)
