"""The arrays that the kernels of one problem share, allocated once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.rows import LinearRows


class Workspace(NamedTuple):
    """Rows, modes, vertex and scratch space, in the order in which every kernel takes them.

    ``cold_fit(*workspace)`` solves; ``refit_after_removal(*workspace, point)`` removes a point.

    Attributes
    ----------
    At, b
        The whitened rows, shapes (d, N) and (N,).
    gain, cap
        The mode of each point: its residual must be at most ``gain * gamma + cap``.
    C, x, q, r
        The vertex: inverse of the tight rows, parameters and gamma, names of the tight rows, residuals.
    work, table
        Scratch space, shapes (3, max(N, d + 1)) and (d + 3, d + 1).
    """

    At: NDArray[np.float64]
    b: NDArray[np.float64]
    gain: NDArray[np.float64]
    cap: NDArray[np.float64]
    C: NDArray[np.float64]
    x: NDArray[np.float64]
    q: NDArray[np.int64]
    r: NDArray[np.float64]
    work: NDArray[np.float64]
    table: NDArray[np.float64]


def allocate(rows: LinearRows, subset: NDArray[np.bool_] | None = None) -> Workspace:
    """Return a workspace for `rows` in which the points of `subset` (None: all) are in the minimax fit."""
    d, N = rows.At.shape
    n = d + 1
    gain, cap = np.ones(N), np.zeros(N)
    if subset is not None:
        gain[~subset] = 0.0
        cap[~subset] = np.inf
    return Workspace(
        rows.At,
        rows.b,
        gain,
        cap,
        np.zeros((n, n)),
        np.zeros(n),
        np.zeros(n, dtype=np.int64),
        np.zeros(N),
        np.zeros((3, max(N, n))),
        np.zeros((n + 2, n)),
    )
