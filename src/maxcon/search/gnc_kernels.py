"""Kernels of graduated non-convexity: iteratively reweighted least squares under a loss that turns robust."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import compute_residuals
from maxcon.search.model_kernels import count_within, minimal_model, weighted_model
from maxcon.search.sampling_kernels import Scratch


@kernel
def least_absolute_model(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    floor: float,
    steps: int,
    scratch: Scratch,
    x: NDArray[np.float64],
) -> None:
    """Move x towards the L1 fit: weights 1 / max(|r|, floor), `steps` times (Schlossmacher 1973)."""
    r, w = scratch.r, scratch.w
    for _ in range(steps):
        compute_residuals(At, b, x, r)
        for i in range(r.shape[0]):
            w[i] = 1.0 / max(abs(r[i]), floor)
        weighted_model(At, b, w, scratch.weighted, scratch.table, x)


@kernel
def random_model(At: NDArray[np.float64], b: NDArray[np.float64], scratch: Scratch, x: NDArray[np.float64]) -> None:
    """Write the model of a random minimal sample into x."""
    minimal_model(At, b, scratch.pool, scratch.pool.shape[0], scratch.state, scratch.table, scratch.places, x)


@kernel
def smallest(values: NDArray[np.float64], k: int) -> float:
    """Return the k-th smallest (from 0) of `values`, which it reorders (Hoare's selection)."""
    low, high = 0, values.shape[0] - 1
    while low < high:
        middle = values[(low + high) >> 1]
        i, j = low, high
        while i <= j:
            while values[i] < middle:
                i += 1
            while values[j] > middle:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    chosen: float = values[k]
    return chosen


@kernel
def global_start(
    At: NDArray[np.float64], b: NDArray[np.float64], limit: float, scratch: Scratch, x: NDArray[np.float64]
) -> float:
    """Return the control parameter at which even the largest residual at x counts: 2 max(r)^2 / limit^2."""
    r = scratch.r
    compute_residuals(At, b, x, r)
    largest = 0.0
    for i in range(r.shape[0]):
        largest = max(largest, abs(r[i]))
    return 2.0 * (largest / limit) ** 2


@kernel
def local_start(
    At: NDArray[np.float64], b: NDArray[np.float64], limit: float, scratch: Scratch, x: NDArray[np.float64]
) -> float:
    """Return the control parameter at which half the points weigh at least a quarter, at least 4."""
    r, sizes = scratch.r, scratch.w
    compute_residuals(At, b, x, r)
    for i in range(r.shape[0]):
        sizes[i] = abs(r[i])
    return max((smallest(sizes, r.shape[0] // 2) / limit) ** 2, 4.0)


@kernel
def write_weights(r: NDArray[np.float64], s: float, w: NDArray[np.float64]) -> None:
    """Write the Geman-McClure weight (s / (r^2 + s))^2 of each residual."""
    for i in range(r.shape[0]):
        share = s / (r[i] * r[i] + s)
        w[i] = share * share


@kernel
def descend(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    limit: float,
    control: float,
    shrink: float,
    steps: int,
    scratch: Scratch,
    x: NDArray[np.float64],
    best: NDArray[np.float64],
    size: int,
) -> tuple[int, float]:
    """Refit x with Geman-McClure weights while `control` shrinks to 1, for at most `steps` fits.

    The weight of a residual r is (s / (r^2 + s))^2 with s = control limit^2. The best model on the way goes
    to `best`; `size` is its consensus. Returns the new size and the control parameter to go on from, 0 where
    the descent is over.
    """
    r, w = scratch.r, scratch.w
    compute_residuals(At, b, x, r)
    for _ in range(steps):
        write_weights(r, control * limit * limit, w)
        weighted_model(At, b, w, scratch.weighted, scratch.table, x)
        compute_residuals(At, b, x, r)
        count = count_within(r, limit)
        if count > size:
            size = count
            for j in range(x.shape[0]):
                best[j] = x[j]
        if control <= 1.0:
            return size, 0.0
        control = max(control / shrink, 1.0)
    return size, control
