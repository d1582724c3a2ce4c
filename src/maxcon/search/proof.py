"""Proofs: what every exact answer in the package goes through, from whatever is known already."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maxcon.search.anytime import Step, Task
from maxcon.search.learned import learned
from maxcon.search.partition import exact_partition
from maxcon.search.proposal import propose
from maxcon.search.refine import swap_refinement
from maxcon.search.stabbing import exact_stabbing

#: Interval stabbing branches over d - 1 parameters; beyond two it is no match for branching on points.
MOST_PARAMETERS = 3

#: So many steps of one search without news, each of some 0.02 s at most, and the other one has its turn.
PATIENCE = 25


def prove(
    task: Task, known: NDArray[np.bool_] | None = None, *, n_jobs: int = -1, max_work: int | None = None
) -> Iterator[Step]:
    """Prove how large the largest consensus is, or a bound on it.

    With up to three parameters by interval stabbing; where that ends or stalls without a proof (readings that are
    repeated and differ by just the threshold, extreme scales), it takes turns with the partition search. With more by
    the partition search, from the best set of `propose`, of the learned search and of what is known, in the order of
    the learned search's belief.

    Parameters
    ----------
    task
        What is fitted.
    known
        Shape (N,), bool: a feasible set, the best known; None or empty for none.
    n_jobs
        Threads of the partition search, see `exact_partition`.
    max_work
        What the partition search may do, see `exact_partition`.
    """
    best = np.zeros(task.problem.n_points, dtype=np.bool_)
    if known is not None and known.any():
        best = swap_refinement(task, known)
        yield Step(subset=best, refined=True)
    if task.problem.n_params <= MOST_PARAMETERS:
        yield from _take_turns(task, best, n_jobs)
        return
    belief = np.full(task.problem.n_points, 0.5)
    untimed = replace(task, deadline=np.inf)  # so that the learned search ends by itself
    for step in chain(propose(task), learned(untimed, belief_out=belief)):
        if step.subset is not None and np.count_nonzero(step.subset) > np.count_nonzero(best):
            best = step.subset
        yield step
    yield from exact_partition(task, start=best, belief=belief, n_jobs=n_jobs, max_work=max_work)


def _take_turns(task: Task, best: NDArray[np.bool_], n_jobs: int) -> Iterator[Step]:
    searches: list[Iterator[Step] | None] = [exact_stabbing(task), None]
    bound, patience, begun = task.problem.n_points, PATIENCE, False
    while True:
        for k in (0, 1):
            if k == 1 and not begun:
                searches[1], begun = exact_partition(task, start=best, n_jobs=n_jobs), True
            search, quiet = searches[k], 0
            if search is None:
                continue
            for step in search:
                quiet += 1
                if step.upper_bound is not None and step.upper_bound < bound:
                    bound, quiet = step.upper_bound, 0
                if step.subset is not None and np.count_nonzero(step.subset) > np.count_nonzero(best):
                    best, quiet = step.subset, 0
                yield step
                if quiet >= patience:
                    break
            else:
                searches[k] = None
            if np.count_nonzero(best) >= bound:
                return
        if searches == [None, None]:
            return
        patience *= 2


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
    own = replace(task, deadline=task.deadline - task.seconds_left() / 2) if task.deadline < np.inf else task
    return _in_turn(task, own, method(own, **(options or {})))


def _in_turn(task: Task, own: Task, steps: Iterator[Step]) -> Iterator[Step]:
    best, bound = np.zeros(task.problem.n_points, dtype=np.bool_), task.problem.n_points
    for step in steps:
        if step.subset is not None and np.count_nonzero(step.subset) > np.count_nonzero(best):
            best = step.subset
        bound = min(bound, bound if step.upper_bound is None else step.upper_bound)
        yield step
        if own.over():
            break
    if np.count_nonzero(best) < bound:
        yield from prove(task, best)
