"""A good set of inliers in a few milliseconds: what an exact search starts from."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from maxcon.search.anytime import Step, Task
from maxcon.search.peel import peel
from maxcon.search.refine import swap_refinement

#: Descents of graduated non-convexity and samples of LO-RANSAC. The two fail on different data: the first where
#: outliers have leverage, the second where most points of a hyperplane in many dimensions are outliers.
DESCENTS, SAMPLES = 10, 2000


def propose(task: Task) -> Iterator[Step]:
    """Yield the sets that peeling finds from graduated non-convexity, then from LO-RANSAC, each refined with swaps.

    Parameters
    ----------
    task
        What is fitted.

    Yields
    ------
    Step
        Each set that is larger than those before it; an empty step for other news.
    """
    size = 0
    for steps in (peel(task, start="gnc", restarts=DESCENTS), peel(task, start="lo-ransac", samples=SAMPLES)):
        for step in steps:
            if step.subset is None or np.count_nonzero(step.subset) + task.rows.At.shape[0] < size:
                yield Step()
                continue
            subset = swap_refinement(task, step.subset)
            if np.count_nonzero(subset) > size:
                size = int(np.count_nonzero(subset))
                yield Step(subset=subset, refined=True)
            else:
                yield Step()


def best_proposal(task: Task) -> NDArray[np.bool_]:
    """Return the largest set that `propose` yields, shape (N,), bool; empty if there is none."""
    best = np.zeros(task.problem.n_points, dtype=np.bool_)
    for step in propose(task):
        if step.subset is not None:
            best = step.subset
    return best
