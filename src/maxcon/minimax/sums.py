"""Sums and maxima over many points, made so that they fill vector registers.

The sums are the only kernels whose additions the compiler may reorder.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel, sum_kernel


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


@kernel
def largest_size(x: NDArray[np.float64]) -> float:
    """Return the largest |x[i]|, 0 of nothing; all must be finite."""
    # The order of positive floats is the order of their bits, and a maximum of integers vectorises.
    bits = x.view(np.int64)
    most = np.int64(0)
    for i in range(bits.shape[0]):
        most = max(most, bits[i] & 0x7FFFFFFFFFFFFFFF)
    for i in range(bits.shape[0]):
        if bits[i] & 0x7FFFFFFFFFFFFFFF == most:
            return abs(float(x[i]))
    return 0.0
