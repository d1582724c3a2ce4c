"""The method "exact": the proven optimum, however long it takes."""

from __future__ import annotations

from collections.abc import Iterator

from maxcon.search.anytime import Step, Task
from maxcon.search.partition import check_jobs
from maxcon.search.proof import prove


def exact(task: Task, *, n_jobs: int = -1) -> Iterator[Step]:
    """Yield ever better sets and bounds until the largest consensus is proven.

    With up to three parameters by branch and bound over all but one of them (`exact_stabbing`); with more by branch and
    bound over points under the partition bound (`exact_partition`).

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
    return prove(task, n_jobs=n_jobs)
