"""The one loop of every search: steps in, best so far out, whatever stops it.

A method is a generator of `Step`s (see `Method`). This loop keeps the best set and the best bound, refines what it
is handed, and stops on a proof, the target gap, the time limit, the callback's word or Ctrl-C. A method that
computes for long yields at least every few hundredths of a second, an empty Step if it has nothing new.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import LinearRows, linear_rows
from maxcon.minimax.clock import read_clock
from maxcon.minimax.jit import compile_seconds, working_clock
from maxcon.problem import LinearProblem


@dataclass(frozen=True, eq=False)
class Task:
    """What a method is given: the problem in the engine's terms, random numbers and a clock.

    Attributes
    ----------
    problem, rows
        The problem, and its whitened rows for the kernels.
    threshold
        The user's inlier threshold, in the unit of b.
    limit
        Threshold plus the slack for rounding, in the unit of `rows`: a set S is feasible where gamma <= limit.
    rng
        The only source of random numbers.
    deadline
        The `read_clock` at which to stop, or infinity; ask `over` and `seconds_left`, which know what does not count.
        The loop stops a method between steps; a method need look at it only to size a long step.
    gap
        The gap at which the search may stop.
    compiled
        What `compile_seconds` said when the deadline was set: kernels compiled or loaded since do not count.
    """

    problem: LinearProblem
    rows: LinearRows
    threshold: float
    limit: float
    rng: np.random.Generator
    deadline: float = np.inf
    gap: int = 0
    compiled: float = 0.0

    def seconds_left(self) -> float:
        """Return the seconds until the deadline, or infinity."""
        return self.deadline + compile_seconds() - self.compiled - read_clock()

    def over(self) -> bool:
        """Whether the time is over."""
        return self.deadline < np.inf and self.seconds_left() <= 0.0


@dataclass(frozen=True, eq=False)
class Step:
    """News from a method; every field may be absent.

    Attributes
    ----------
    subset
        Shape (N,), bool: a set S with f(S) <= threshold (a larger one than any yielded before, or a new one to refine).
    path
        The points removed to reach `subset`, in order, where the method removes points one by one.
    upper_bound
        A proven upper bound on the consensus.
    refined
        The method has refined `subset` itself, or finds the optimum without; it is taken as it is.
    settled
        The method expects little more of itself: whoever has another one may turn to it, and come back.
    """

    subset: NDArray[np.bool_] | None = None
    path: NDArray[np.int64] | None = None
    upper_bound: int | None = None
    refined: bool = False
    settled: bool = False


class Method(Protocol):
    """A way to a consensus: a generator function; its keyword arguments are the method's options."""

    def __call__(self, task: Task, **options: Any) -> Iterator[Step]:
        """Yield steps until there is nothing left to do."""
        ...


class Refiner(Protocol):
    """An improver of feasible sets: returns a feasible superset, or a larger set."""

    def __call__(self, task: Task, subset: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return a feasible set at least as large as `subset`."""
        ...


@dataclass(frozen=True)
class Progress:
    """What a callback is told: the consensus found and the bound proven so far."""

    n_inliers: int
    upper_bound: int
    seconds: float


@dataclass
class Best:
    """The best so far."""

    upper_bound: int
    subset: NDArray[np.bool_] | None = None
    size: int = 0
    path: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    interrupted: bool = False

    @property
    def gap(self) -> int:
        """How many inliers the best possible set may have more."""
        return self.upper_bound - self.size


def make_task(
    problem: LinearProblem,
    threshold: float,
    rng: np.random.Generator,
    time_limit: float | None = None,
    gap: int = 0,
) -> Task:
    """Return the task for `problem`: whitened rows, the limit on gamma in their unit, the deadline."""
    compiled = compile_seconds()
    deadline = np.inf if time_limit is None else read_clock() + time_limit
    rows = linear_rows(problem)
    limit = problem.inlier_limit(threshold) / rows.scale
    return Task(problem, rows, threshold, limit, rng, deadline, gap, compiled)


def run(
    task: Task,
    steps: Iterator[Step],
    refine: Refiner | None = None,
    callback: Callable[[Progress], object] | None = None,
) -> Best:
    """Drive `steps` to its end, or until the gap, the deadline, the callback (a true value) or Ctrl-C stops it.

    Kernels that are compiled on the way, once on a machine, do not count against the deadline.
    """
    began = working_clock()
    best = Best(upper_bound=task.problem.n_points)
    try:
        for step in steps:
            news = False
            if step.upper_bound is not None and step.upper_bound < best.upper_bound:
                best.upper_bound, news = step.upper_bound, True
            if step.subset is not None:
                subset = step.subset if refine is None or step.refined else refine(task, step.subset)
                size = int(np.count_nonzero(subset))
                if best.subset is None or size > best.size:
                    best.subset, best.size, news = subset, size, True
                    if step.path is not None:
                        best.path = step.path
            if callback is not None and news:
                seconds = working_clock() - began
                if callback(Progress(best.size, best.upper_bound, seconds)):
                    break
            if (best.subset is not None and best.gap <= task.gap) or task.over():
                break
    except KeyboardInterrupt:
        best.interrupted = True
    return best
