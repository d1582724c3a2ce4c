"""The peel: from a good set to a larger one, by minimax fits that drop the incumbent's worst points first."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import allocate
from maxcon.minimax.linear import OK, cold_fit
from maxcon.problem.validate import check_number
from maxcon.search.anytime import Step, Task
from maxcon.search.gnc import gnc
from maxcon.search.peel_kernels import UNFINISHED, allocate_incumbent, install, peel_rounds
from maxcon.search.sampling import check_count, lo_ransac

Start = Literal["lo-ransac", "gnc"]

#: Points with residuals above this many thresholds under the incumbent are left out of the start: peeling
#: from all points found no more on any data measured, and took up to three times as long.
REACH = 2.0

#: Refits in one piece of the peel, times N: a refit goes with N, and a piece takes some 0.02 s.
PIECE = 600_000


def peel(
    task: Task,
    *,
    samples: int = 2000,
    restarts: int | None = 0,
    start: Start = "lo-ransac",
    reach: float = REACH,
) -> Iterator[Step]:
    """Find a good set by LO-RANSAC, or by graduated non-convexity, then peel.

    From the incumbent model: take the minimax fit of the points near it, and as long as that is infeasible
    remove the basis point with the largest residual under the incumbent. A basis of an infeasible set always
    holds a point that is no inlier of the incumbent, so the set reached holds all of the incumbent's inliers,
    and mostly more: where it has more, it is the next incumbent. In the end the points left out are added
    back one by one where they fit.

    Parameters
    ----------
    task
        What is fitted.
    samples
        How many samples each LO-RANSAC draws.
    restarts
        How many starts follow the first, at least 0; None for as many as the time limit allows.
    start
        "lo-ransac", or "gnc": peel each set that `gnc` yields; better where more than half the points of a
        hyperplane in many dimensions are outliers, and worse where outliers have leverage.
    reach
        How small the residual of a point under the incumbent must be, in thresholds, to count as near; at
        least 1, infinite for all points.

    Yields
    ------
    Step
        The sets of the start, and each larger set found by peeling.

    Raises
    ------
    TypeError, ValueError
        If an option has the wrong type, or is outside its range; if `restarts` is None and there is no time
        limit.
    """
    samples = check_count(samples, "samples", 1)
    reach = check_number(reach, "reach")
    if not reach >= 1.0:
        raise ValueError(f"reach must be at least 1, but it is {reach}")
    if restarts is not None:
        restarts = check_count(restarts, "restarts", 0)
    elif task.deadline == np.inf:
        raise ValueError("restarts must be a number where there is no time limit, but it is None")
    if start == "gnc":
        return _peel_each(task, gnc(task, restarts=restarts), reach)
    if start == "lo-ransac":
        return _peel_last(task, samples, restarts, reach)
    raise ValueError(f"start must be 'lo-ransac' or 'gnc', but it is {start!r}")


def peel_improve(task: Task, subset: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Peel from a feasible set until that stops improving, or the deadline comes; a `Refiner`.

    Parameters
    ----------
    task
        What is fitted.
    subset
        Shape (N,), bool: a feasible set.

    Returns
    -------
    NDArray[np.bool_]
        A feasible set at least as large; `subset` itself where none was found.
    """
    best = subset
    for step in _rounds(task, subset, REACH):
        if step.subset is not None:
            best = step.subset
        if task.over():
            break
    return best


def _peel_each(task: Task, starts: Iterator[Step], reach: float) -> Iterator[Step]:
    for step in starts:
        yield step
        if step.subset is not None:
            yield from _rounds(task, step.subset, reach)


def _peel_last(task: Task, samples: int, restarts: int | None, reach: float) -> Iterator[Step]:
    number = 0
    while restarts is None or number <= restarts:
        number += 1
        found = None
        for step in lo_ransac(task, samples=samples):
            found = step.subset if step.subset is not None else found
            yield step
        if found is not None:
            yield from _rounds(task, found, reach)


def _rounds(task: Task, subset: NDArray[np.bool_], reach: float) -> Iterator[Step]:
    """Peel from the feasible set `subset`; a step after each piece of the work, with any larger set found."""
    workspace = allocate(task.rows, subset)
    incumbent = allocate_incumbent(task.rows)
    if cold_fit(*workspace) != OK or workspace.x[-1] > task.limit:
        return
    size = int(np.count_nonzero(subset))
    install(workspace, incumbent, task.limit)
    most = max(1, PIECE // subset.shape[0])
    status = UNFINISHED
    while status == UNFINISHED:
        status = peel_rounds(workspace, incumbent, task.limit, reach, most)
        if incumbent.progress[1] > size:
            size = int(incumbent.progress[1])
            yield Step(subset=incumbent.rho <= task.limit)
        else:
            yield Step()
