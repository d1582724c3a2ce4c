"""The trajectories of A* and of the agent on small line problems (figure 1)."""

from __future__ import annotations

import heapq
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from maxcon.datasets.synthetic import THRESHOLD, synthetic_hyperplane
from maxcon.experiments.contenders import ASTAR, Contender, Instance, compete, warm_up
from maxcon.experiments.records import Run
from maxcon.minimax import Workspace, allocate
from maxcon.minimax.linear import OK, cold_fit
from maxcon.problem import LinearProblem
from maxcon.search.anytime import Task, make_task
from maxcon.search.insertion_kernels import Insertion, allocate_insertion, free_basis, insertion_bound

#: Tells the random numbers of these instances from those of training.
_STREAM = 8

#: Sets that A* may make on a small problem; a picture of more says nothing.
_ROOM = 20_000


@dataclass(frozen=True)
class TrajectoryExperiment:
    """A* step by step, and every contender, on small line problems.

    Attributes
    ----------
    n_points, n_outliers, n_instances
        How many points a problem has, how many of them are made outliers, and how many problems there are.
    contenders
        A* must be among them.
    seed
        Instance i comes from ``default_rng([seed, 8, N, i])``.
    """

    contenders: tuple[Contender, ...]
    n_points: int = 30
    n_outliers: int = 12
    n_instances: int = 100
    seed: int = 0
    name: str = "trajectory"

    def settings(self) -> dict[str, Any]:
        """Return all that the records depend on."""
        return {
            "experiment": self.name,
            "n_points": self.n_points,
            "n_outliers": self.n_outliers,
            "instances": self.n_instances,
            "seed": self.seed,
            "contenders": [each.describe() for each in self.contenders],
        }

    def units(self) -> dict[str, tuple[int, ...]]:
        """Return the number of every instance by its name."""
        return {f"instance {number}": (number,) for number in range(self.n_instances)}

    def run(self, unit: str, digest: str) -> list[Run]:
        """Return the records of an instance, with what each method removed, in its order."""
        instance = self.instance(unit)
        rows, results = compete(instance, self.contenders, 1.0, digest)
        traced = []
        for row in rows:
            measures: dict[str, Any] = {}
            if row.name in results:
                measures["outliers"] = np.flatnonzero(~results[row.name].inlier_mask).tolist()
                measures["path"] = results[row.name].path.tolist()
            if row.name == ASTAR and row.done:
                measures |= trace_astar(instance.problem, THRESHOLD)
            traced.append(replace(row, measures=measures))
        return traced

    def warm_up(self) -> None:
        """Load or compile all that runs will call."""
        problem = synthetic_hyperplane(np.random.default_rng(0), 15, 0.3, 2)
        warm_up(Instance(self.name, "", "", problem, THRESHOLD, 0, 0), self.contenders)
        trace_astar(problem, THRESHOLD)

    def instance(self, unit: str) -> Instance:
        """Return an instance by its name."""
        (number,) = self.units()[unit]
        seed = [self.seed, _STREAM, self.n_points, number]
        rate = self.n_outliers / self.n_points
        problem = synthetic_hyperplane(np.random.default_rng(seed), self.n_points, rate, 2)
        return Instance(self.name, unit, f"seed {seed}", problem, THRESHOLD, number, number, round(100 * rate))


def trace_astar(problem: LinearProblem, threshold: float) -> dict[str, Any]:
    """Return which sets A* visits, in order.

    A* as Chin et al. 2015 describe it: the set with the smallest e = level + h is expanded next (of equal ones that
    with the smallest f, of equal ones again the one made first), and the search ends when that set is feasible. The
    method "astar" has the same heuristic h, but ends sooner: as soon as a model met on the way cannot be improved.

    Returns
    -------
    "nodes": a list of [parent, point], one for every set that the search makes, the root first with [-1, -1]: the
    number of the set it comes from, and the point that was removed from that. "expanded": the numbers of the sets
    that were taken from the queue, in order; the last one is feasible, and optimal. "trace_seconds": what that took,
    most of it in Python.

    Raises
    ------
    ArithmeticError
        If the search does not end within 20,000 sets, or a fit does not converge.
    """
    began = time.perf_counter()
    task = make_task(problem, threshold, np.random.default_rng(0))
    scratch = allocate_insertion(task.rows)
    nodes, expanded = [[-1, -1]], []
    removed = {0: frozenset[int]()}
    known = {removed[0]}
    e, f = _bounds(task, removed[0], scratch)
    queue = [(e, f, 0)]
    while True:
        e, f, node = heapq.heappop(queue)
        expanded.append(node)
        if f <= task.limit:
            break
        for point in _basis(task, removed[node], scratch):
            child = removed[node] | {point}
            if child in known:
                continue
            if len(nodes) == _ROOM:
                raise ArithmeticError(f"A* did not end within {_ROOM} sets; fewer points or outliers make a picture")
            known.add(child)
            removed[len(nodes)] = child
            e_child, f_child = _bounds(task, child, scratch)
            heapq.heappush(queue, (max(e, e_child), f_child, len(nodes)))
            nodes.append([node, point])
    return {"nodes": nodes, "expanded": expanded, "trace_seconds": time.perf_counter() - began}


def _bounds(task: Task, removed: frozenset[int], scratch: Insertion) -> tuple[int, float]:
    """Return e and f (in the unit of the rows) of a set, named by the points that it lacks."""
    workspace = _fitted(task, removed)
    f = float(workspace.x[-1])
    if f <= task.limit:
        return len(removed), f
    left = task.problem.n_points - len(removed)
    return len(removed) + max(1, int(insertion_bound(workspace, task.limit, left, scratch))), f


def _basis(task: Task, removed: frozenset[int], scratch: Insertion) -> list[int]:
    size = free_basis(_fitted(task, removed), scratch.basis)
    return sorted(int(point) for point in scratch.basis[:size])


def _fitted(task: Task, removed: frozenset[int]) -> Workspace:
    mask = np.ones(task.problem.n_points, dtype=np.bool_)
    mask[list(removed)] = False
    workspace = allocate(task.rows, mask)
    if cold_fit(*workspace) != OK:
        raise ArithmeticError("a minimax fit did not converge; please report the data")
    return workspace
