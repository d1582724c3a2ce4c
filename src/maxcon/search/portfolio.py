"""What "auto" does: prove where that is cheap; otherwise the best proposals, then the exact search for a while."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from maxcon.search.anytime import Step, Task
from maxcon.search.exact import MOST_PARAMETERS, exact
from maxcon.search.partition import check_jobs, exact_partition
from maxcon.search.proposal import propose

#: Where no time is given, the exact search beyond three parameters ends after so much work, in columns of linear
#: programmes: some 30 ms, which prove 20 to 30 outliers of 100 with eight parameters.
BRIEF_WORK = 1_000_000


def auto(task: Task, *, n_jobs: int = -1) -> Iterator[Step]:
    """Yield ever better sets and bounds, by the methods that the problem and the time call for.

    - Up to three parameters: the exact search, at any rate of outliers; it costs less than sampling.
    - More, with a time limit: the best proposal, then the exact search until a proof or the time limit.
    - More, without one: the same, but the exact search ends by itself after a fixed amount of work (some 30 ms), so
      that the same data get the same answer; ``method="exact"`` goes on to the proof.

    Parameters
    ----------
    task
        What is fitted.
    n_jobs
        How many threads the exact search may use where there is a time limit; -1 for one a core.

    Raises
    ------
    TypeError, ValueError
        If `n_jobs` is not -1 or a whole number of at least 1.
    """
    check_jobs(n_jobs)
    if task.problem.n_params <= MOST_PARAMETERS or task.deadline < np.inf:
        return exact(task, n_jobs=n_jobs)
    return _brief(task)


def _brief(task: Task) -> Iterator[Step]:
    best = np.zeros(task.problem.n_points, dtype=np.bool_)
    for step in propose(task):
        if step.subset is not None:
            best = step.subset
        yield step
    yield from exact_partition(task, start=best, n_jobs=1, max_work=BRIEF_WORK)
