"""Kernels that make the models of many minimal samples at once: sample l is lane l of every loop.

The equations of one sample are too few for a vector register to be worth filling; those of `LANES` samples side by
side are solved six times as fast. No rows are exchanged for that. A lane whose elimination meets a small pivot is
marked, and its caller makes that model one by one (`eliminate_point`, which looks for the largest).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel

#: Samples side by side. Their equations, with eight parameters 36 KB, stay in the near caches.
LANES = 64

#: A pivot below this is small: whitened rows have entries of order 1.
SMALL_PIVOT = 1e-6


class Lanes(NamedTuple):
    """Samples side by side.

    Attributes
    ----------
    points
        Shape (r, LANES): the points of each sample.
    table
        Shape (r, r + 1, LANES): their equations.
    models
        Shape (r, LANES).
    good
        Shape (LANES,): whether the model of a lane can be used.
    """

    points: NDArray[np.int64]
    table: NDArray[np.float64]
    models: NDArray[np.float64]
    good: NDArray[np.bool_]


def allocate_lanes(d: int) -> Lanes:
    """Return the memory for samples of `d` points."""
    return Lanes(
        np.zeros((d, LANES), dtype=np.int64),
        np.zeros((d, d + 1, LANES)),
        np.zeros((d, LANES)),
        np.zeros(LANES, dtype=np.bool_),
    )


@kernel
def solve_lanes(At: NDArray[np.float64], b: NDArray[np.float64], count: int, lanes: Lanes) -> None:
    """Write the models through the points of the first `count` lanes (Gauss elimination without pivoting)."""
    points, table, models, good = lanes
    d = At.shape[0]
    for lane in range(count):
        good[lane] = True
    for k in range(d):
        row = points[k]
        for j in range(d + 1):
            source, entry = (At[j] if j < d else b), table[k, j]
            for lane in range(count):
                entry[lane] = source[row[lane]]
    for k in range(d):
        inverse = table[k, k]
        for lane in range(count):
            if abs(inverse[lane]) < SMALL_PIVOT:
                good[lane] = False
                inverse[lane] = 1.0
            inverse[lane] = 1.0 / inverse[lane]
        for i in range(k + 1, d):
            factor = table[i, k]
            for lane in range(count):
                factor[lane] *= inverse[lane]
            for j in range(k + 1, d + 1):
                _subtract_lanes(table[i, j], factor, table[k, j], count)
    for k in range(d - 1, -1, -1):
        x, inverse, value = models[k], table[k, k], table[k, d]
        for j in range(k + 1, d):
            _subtract_lanes(value, table[k, j], models[j], count)
        for lane in range(count):
            x[lane] = value[lane] * inverse[lane]


@kernel
def _subtract_lanes(
    target: NDArray[np.float64], factor: NDArray[np.float64], other: NDArray[np.float64], count: int
) -> None:
    for lane in range(count):
        target[lane] -= factor[lane] * other[lane]
