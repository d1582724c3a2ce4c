"""Proof after the fact: the exact search, from what another method has found."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maxcon.search.anytime import Step, Task
from maxcon.search.exact import MOST_PARAMETERS, exact
from maxcon.search.partition import exact_partition
from maxcon.search.portfolio import auto
from maxcon.search.proposal import propose
from maxcon.search.refine import swap_refinement
from maxcon.search.stabbing import exact_stabbing


def then_prove(
    task: Task, method: Callable[..., Iterator[Step]], options: Mapping[str, Any] | None = None
) -> Iterator[Step]:
    """Yield the steps of a method, in half of the time that is left, then those of a proof.

    Parameters
    ----------
    task
        What is fitted.
    method, options
        A method of the table, and its options.
    """
    options = options or {}
    if method in (auto, exact):  # they spend their time on a proof anyway
        return exact(task, **options)
    now = time.perf_counter()
    own = replace(task, deadline=now + (task.deadline - now) / 2)
    return _in_turn(task, own, method(own, **options))


def _in_turn(task: Task, own: Task, steps: Iterator[Step]) -> Iterator[Step]:
    best = np.zeros(task.problem.n_points, dtype=np.bool_)
    for step in steps:
        if step.subset is not None and np.count_nonzero(step.subset) > np.count_nonzero(best):
            best = step.subset
        yield step
        if time.perf_counter() >= own.deadline:
            break
    yield from prove(task, best)


def prove(task: Task, known: NDArray[np.bool_]) -> Iterator[Step]:
    """Prove how large the largest consensus is, or a bound on it.

    Parameters
    ----------
    task
        What is fitted.
    known
        Shape (N,), bool: a feasible set, the best known; it may be empty.
    """
    if task.problem.n_params <= MOST_PARAMETERS:
        yield from exact_stabbing(task)
        return
    best = swap_refinement(task, known) if known.any() else known
    for step in propose(task):
        if step.subset is not None and np.count_nonzero(step.subset) > np.count_nonzero(best):
            best = step.subset
        yield step
    yield from exact_partition(task, start=best)
