"""Sums over many points: the only kernels whose additions the compiler may reorder."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import sum_kernel


@sum_kernel
def dot(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Return x . y."""
    total = 0.0
    for i in range(x.shape[0]):
        total += x[i] * y[i]
    return total


@sum_kernel
def total_of(x: NDArray[np.float64]) -> float:
    """Return the sum of x."""
    total = 0.0
    for i in range(x.shape[0]):
        total += x[i]
    return total
