"""Kernels of RANSAC and LO-RANSAC: draw a minimal sample, score its model, optimise a new best locally.

They share `Scratch`, allocated once a search. The random state and the best model are carried by the caller,
so that a search may be cut into chunks of samples anywhere and still finds the same.
"""

from __future__ import annotations

from math import log, log1p
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import compute_residuals
from maxcon.search.lane_kernels import LANES, Lanes, allocate_lanes, solve_lanes
from maxcon.search.model_kernels import (
    count_within,
    least_squares_model,
    minimal_model,
    score,
    weighted_model,
)
from maxcon.search.random_kernels import draw_next

#: Where samples begin, few are made at once: easy problems need no more.
FIRST_LANES = 8


class Scratch(NamedTuple):
    """Arrays that the sampling kernels write to.

    Attributes
    ----------
    state
        Shape (4,): the random state.
    pool, inliers, near
        Shape (N,): point indices to draw from; `pool` is always a permutation of all.
    x, trial
        Shape (r,): models.
    r, w, weighted
        Shape (N,): residuals, weights, and weights times a column.
    table, places
        Shapes (r, r + 1) and (r,): what a model is eliminated in.
    lanes
        Samples side by side.
    lane
        Shape (2,): the next of them to be looked at, and how many there are.
    """

    state: NDArray[np.int64]
    pool: NDArray[np.int64]
    inliers: NDArray[np.int64]
    near: NDArray[np.int64]
    x: NDArray[np.float64]
    trial: NDArray[np.float64]
    r: NDArray[np.float64]
    w: NDArray[np.float64]
    weighted: NDArray[np.float64]
    table: NDArray[np.float64]
    places: NDArray[np.int64]
    lanes: Lanes
    lane: NDArray[np.int64]


def allocate_scratch(At: NDArray[np.float64], state: NDArray[np.int64]) -> Scratch:
    """Return scratch space for the whitened rows `At`, shape (r, N), and the random state."""
    d, N = At.shape
    return Scratch(
        state=state,
        pool=np.arange(N),
        inliers=np.arange(N),
        near=np.arange(N),
        x=np.zeros(d),
        trial=np.zeros(d),
        r=np.zeros(N),
        w=np.zeros(N),
        weighted=np.zeros(N),
        table=np.zeros((d, d + 1)),
        places=np.zeros(d, dtype=np.int64),
        lanes=allocate_lanes(d),
        lane=np.zeros(2, dtype=np.int64),
    )


@kernel
def next_model(At: NDArray[np.float64], b: NDArray[np.float64], scratch: Scratch, x: NDArray[np.float64]) -> None:
    """Write into x the model of the next random minimal sample; they are made in batches, each twice as large."""
    lanes, lane, state, pool = scratch.lanes, scratch.lane, scratch.state, scratch.pool
    if lane[0] == lane[1]:
        lane[0], lane[1] = 0, min(max(2 * lane[1], FIRST_LANES), LANES)
        for number in range(lane[1]):
            for k in range(x.shape[0]):
                lanes.points[k, number] = draw_next(state, pool, k, pool.shape[0])
        solve_lanes(At, b, lane[1], lanes)
    number = lane[0]
    lane[0] += 1
    if lanes.good[number]:
        for j in range(x.shape[0]):
            x[j] = lanes.models[j, number]
    else:
        minimal_model(At, b, pool, pool.shape[0], state, scratch.table, scratch.places, x)


@kernel
def samples_needed(n_inliers: int, n_points: int, n_params: int, confidence: float) -> float:
    """Return after how many minimal samples one is all inliers with probability `confidence`."""
    if confidence >= 1.0:
        return np.inf
    all_inliers = 1.0
    for k in range(n_params):
        all_inliers *= max(n_inliers - k, 0) / (n_points - k)
    if all_inliers >= 1.0:
        return 1.0
    if all_inliers <= 0.0:
        return np.inf
    return log(1.0 - confidence) / log1p(-all_inliers)


@kernel
def _select_within(r: NDArray[np.float64], reach: float, points: NDArray[np.int64]) -> int:
    """Write the points with residuals at most `reach` into `points`; return how many there are."""
    count = 0
    for i in range(r.shape[0]):
        if abs(r[i]) <= reach:
            points[count] = i
            count += 1
    return count


@kernel
def shrinking_least_squares(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    limit: float,
    wide: float,
    steps: int,
    most: int,
    scratch: Scratch,
    x: NDArray[np.float64],
    best: NDArray[np.float64],
    size: int,
) -> int:
    """Fit the points within a threshold that shrinks from ``wide * limit`` to limit; keep the best model.

    Starts from model x, which it moves. No fit uses more than `most` points, drawn anew each time. `size` is
    the consensus of `best`; returns the new one.
    """
    r, w, near = scratch.r, scratch.w, scratch.near
    compute_residuals(At, b, x, r)
    for step in range(steps):
        reach = limit * (wide + (1.0 - wide) * step / max(steps - 1, 1))
        n_near = count_within(r, reach)
        if n_near <= most:
            for i in range(r.shape[0]):
                w[i] = 1.0 if abs(r[i]) <= reach else 0.0
            weighted_model(At, b, w, scratch.weighted, scratch.table, x)
        else:
            _select_within(r, reach, near)
            for m in range(most):
                draw_next(scratch.state, near, m, n_near)
            least_squares_model(At, b, near, most, scratch.table, x)
        compute_residuals(At, b, x, r)
        count = count_within(r, limit)
        if count > size:
            size = count
            for j in range(x.shape[0]):
                best[j] = x[j]
    return size


@kernel
def optimise_locally(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    limit: float,
    inner: int,
    inner_size: int,
    wide: float,
    steps: int,
    most: int,
    scratch: Scratch,
    best: NDArray[np.float64],
    size: int,
) -> int:
    """Improve model `best` of consensus `size` in place; return its new consensus. See `lo_ransac`."""
    d = At.shape[0]
    trial, inliers = scratch.trial, scratch.inliers
    for j in range(d):
        trial[j] = best[j]
    size = shrinking_least_squares(At, b, limit, wide, steps, most, scratch, trial, best, size)
    n_inliers = 0
    for _ in range(inner):
        if n_inliers != size:  # a new best: draw from its inliers
            compute_residuals(At, b, best, scratch.r)
            n_inliers = _select_within(scratch.r, limit, inliers)
        count = min(inner_size, n_inliers // 2)
        if count < d:
            break
        for m in range(count):
            draw_next(scratch.state, inliers, m, n_inliers)
        least_squares_model(At, b, inliers, count, scratch.table, trial)
        size = shrinking_least_squares(At, b, limit, wide, steps, most, scratch, trial, best, size)
    return size


@kernel
def sample(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    limit: float,
    confidence: float,
    first: int,
    last: int,
    inner: int,
    inner_size: int,
    wide: float,
    steps: int,
    most: int,
    pause: bool,
    scratch: Scratch,
    best: NDArray[np.float64],
    size: int,
) -> tuple[int, int, bool]:
    """Draw minimal samples number `first` to ``last - 1``; stop where `confidence` is reached.

    `size` is the consensus of model `best`, -1 if there is none yet. With ``steps > 0`` every new best is
    optimised locally; with `pause` the chunk ends there. Returns the new size, how many samples have been
    drawn in all, and whether that is enough for the confidence.
    """
    d, N = At.shape
    x = scratch.x
    needed = samples_needed(size, N, d, confidence)
    for drawn in range(first, last):
        if drawn >= needed:
            return size, drawn, True
        next_model(At, b, scratch, x)
        count = score(At, b, x, limit, size, scratch.r)
        if count > size:
            size = count
            for j in range(d):
                best[j] = x[j]
            if steps > 0:
                size = optimise_locally(At, b, limit, inner, inner_size, wide, steps, most, scratch, best, size)
            needed = samples_needed(size, N, d, confidence)
            if pause:
                return size, drawn + 1, drawn + 1 >= needed
    return size, last, last >= needed
