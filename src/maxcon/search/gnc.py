"""Graduated non-convexity: from a convex loss to a robust one, with least squares all the way."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from maxcon.problem.validate import check_number
from maxcon.search.anytime import Step, Task
from maxcon.search.gnc_kernels import descend, global_start, least_absolute_model, local_start, random_model
from maxcon.search.random_kernels import seed_state
from maxcon.search.sampling import check_count, inlier_mask
from maxcon.search.sampling_kernels import Scratch, allocate_scratch

#: Reweightings of the L1 start; more change the start, but not where the descent ends.
L1_STEPS = 12

#: What a piece of a descent may take, in seconds; one fit goes with N r^2.
PIECE_SECONDS = 0.02


def gnc(task: Task, *, restarts: int | None = 1, shrink: float = 1.4) -> Iterator[Step]:
    """Minimise the Geman-McClure loss while it turns from convex to robust; restart from elsewhere.

    The loss of a residual r is mu c^2 r^2 / (mu c^2 + r^2), c the threshold (Black and Rangarajan 1996; Yang,
    Antonante, Tzoumas and Carlone 2020, "Graduated non-convexity for robust spatial perception"). The control
    parameter mu starts at 2 max(r)^2 / c^2, where the loss is convex but for the largest residuals, and is
    divided by `shrink` after each weighted least-squares fit until it is 1. Every model on the way is
    counted, and the best of the descent is what it finds.

    The first descent starts at the least-squares fit of all points. The next starts at the L1 fit, those
    after it at models of random minimal samples: there mu starts at median(|r|)^2 / c^2, so that the start
    decides which minimum the descent runs into.

    Parameters
    ----------
    task
        What is fitted.
    restarts
        How many descents follow the first, at least 0; None for as many as the time limit allows.
    shrink
        What mu is divided by, above 1.

    Yields
    ------
    Step
        After each descent, with the inliers that it found, if these are a new set and fewer than the most
        found by at most r (the rank of A): refinement may turn the smaller set into the larger one.

    Raises
    ------
    TypeError, ValueError
        If an option is not a number, or outside its range; if `restarts` is None and there is no time limit.
    """
    shrink = check_number(shrink, "shrink")
    if not 1.0 < shrink < np.inf:
        raise ValueError(f"shrink must be above 1 and finite, but it is {shrink}")
    if restarts is None:
        if task.deadline == np.inf:
            raise ValueError("restarts must be a number where there is no time limit, but it is None")
        descents = np.inf
    else:
        descents = 1.0 + check_count(restarts, "restarts", 0)
    return _descents(task, descents, shrink)


def _descents(task: Task, descents: float, shrink: float) -> Iterator[Step]:
    rows = task.rows
    rank = rows.At.shape[0]
    scratch = allocate_scratch(rows.At, seed_state(task.rng))
    x, best = np.zeros(rank), np.zeros(rank)
    most, number = 1, 0
    seen: set[bytes] = set()
    fits = _fits_in_a_piece(rows.At)
    while number < descents:
        control = _start(task, number, scratch, x)
        number += 1
        size = -1
        while control > 0.0:
            size, control = descend(rows.At, rows.b, task.limit, control, shrink, fits, scratch, x, best, size)
            if control > 0.0:
                yield Step()
        mask = inlier_mask(rows, best, task.limit)
        key = np.packbits(mask).tobytes()
        most = max(most, size)
        if size < max(most - rank, 1) or key in seen:
            yield Step()
            continue
        seen.add(key)
        yield Step(subset=mask)


def _start(task: Task, number: int, scratch: Scratch, x: NDArray[np.float64]) -> float:
    """Write where descent `number` starts into x; return the control parameter to start with."""
    At, b = task.rows.At, task.rows.b
    if number < 2:
        x[:] = 0.0  # the least-squares fit
    if number == 0:
        return float(max(global_start(At, b, task.limit, scratch, x), 1.0))
    if number == 1:
        least_absolute_model(At, b, 0.1 * task.limit, L1_STEPS, scratch, x)
    else:
        random_model(At, b, scratch, x)
    return float(local_start(At, b, task.limit, scratch, x))


def _fits_in_a_piece(At: NDArray[np.float64]) -> int:
    rank, n_points = At.shape
    return max(1, int(PIECE_SECONDS / (1e-7 + 2.5e-10 * n_points * (rank + 2) ** 2)))
