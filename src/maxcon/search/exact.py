"""The proven optimum by the method that serves the number of parameters."""

from __future__ import annotations

from collections.abc import Iterator

from maxcon.search.anytime import Step, Task
from maxcon.search.stabbing import exact_stabbing

#: Interval stabbing branches over d - 1 parameters; beyond two it is no match for branching on points.
MOST_PARAMETERS = 3


def exact(task: Task) -> Iterator[Step]:
    """Yield ever better sets and bounds until the largest consensus is proven.

    Raises
    ------
    ValueError
        If the problem has more than three parameters.
    """
    if task.problem.n_params > MOST_PARAMETERS:
        raise ValueError(
            f"method 'exact' needs a problem with at most {MOST_PARAMETERS} parameters, "
            f"but this one has {task.problem.n_params}"
        )
    return exact_stabbing(task)
