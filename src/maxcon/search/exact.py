"""The proven optimum by the method that serves the number of parameters."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from maxcon.search.anytime import Step, Task
from maxcon.search.partition import check_jobs, exact_partition
from maxcon.search.proposal import propose
from maxcon.search.stabbing import exact_stabbing

#: Interval stabbing branches over d - 1 parameters; beyond two it is no match for branching on points.
MOST_PARAMETERS = 3


def exact(task: Task, *, n_jobs: int = -1) -> Iterator[Step]:
    """Yield ever better sets and bounds until the largest consensus is proven.

    With up to three parameters by branch and bound over all but one of them (`exact_stabbing`); with more by branch and
    bound over points under the partition bound (`exact_partition`), from the best set of `propose`.

    Parameters
    ----------
    task
        What is fitted.
    n_jobs
        How many threads to use with more than three parameters; -1 for one a core. The result is the same.

    Raises
    ------
    TypeError, ValueError
        If `n_jobs` is not -1 or a whole number of at least 1.
    """
    check_jobs(n_jobs)
    if task.problem.n_params <= MOST_PARAMETERS:
        return exact_stabbing(task)
    return _from_proposal(task, n_jobs)


def _from_proposal(task: Task, n_jobs: int) -> Iterator[Step]:
    best = np.zeros(task.problem.n_points, dtype=np.bool_)
    for step in propose(task):
        if step.subset is not None:
            best = step.subset
        yield step
    yield from exact_partition(task, start=best, n_jobs=n_jobs)
