"""The state as numbers: the paper's matrix S = [H b v] (section 3.3), and further channels of what the fit gives away.

H describes the data and stays as it is during an episode. The channels change with every removal: b marks the basis
and v the removed points, +1 or -1 (equations 9 and 10).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import minimax_fit
from maxcon.minimax.jit import kernel
from maxcon.problem import LinearProblem

#: The channels of a state, in the order in which they are encoded; "basis" and "removed" are the paper's b and v.
CHANNELS = ("basis", "removed", "ratio", "level", "multiplier")

#: The paper's channels.
PAPER_CHANNELS = ("basis", "removed")

#: A removed point may lie many times f(S) away; beyond this the network need not know how far.
LARGEST_RATIO = 3.0


def raw_features(problem: LinearProblem) -> NDArray[np.float32]:
    """Return H as in the paper, ``h(x_i) = [a_i b_i]``: shape (N, k + 1), constant columns of A left out."""
    return np.column_stack([_varying_columns(problem.A), problem.b]).astype(np.float32)


def canonical_features(problem: LinearProblem) -> NDArray[np.float32]:
    """Return an H that does not depend on the units of the data: shape (N, k + 1).

    The columns of A are centred and scaled to unit variance; instead of b_i stands the signed residual of the minimax
    fit of all points, relative to its largest, which is the same for ``b`` and ``scale * b + A @ anything``.
    """
    columns = _varying_columns(problem.A)
    columns = columns / np.abs(columns).max(axis=0)
    columns = (columns - columns.mean(axis=0)) / columns.std(axis=0)
    fit = minimax_fit(problem)
    signed = problem.b - problem.A @ fit.model
    return np.column_stack([columns, signed / max(fit.value, np.finfo(float).tiny)]).astype(np.float32)


def estimate_feature(problem: LinearProblem, threshold: float) -> NDArray[np.float32]:
    """Return ``b_i / (|b_i| + threshold)``, shape (N, 1): the residual of theta = 0, in thresholds, squashed.

    It says something where theta = 0 is an estimate, as in the chart "auto" of a fundamental matrix.
    """
    return (problem.b / (np.abs(problem.b) + threshold))[:, None].astype(np.float32)


def _varying_columns(A: NDArray[np.float64]) -> NDArray[np.float64]:
    return A[:, np.ptp(A, axis=0) > 0]


@kernel
def encode_channels(
    r: NDArray[np.float64],
    gamma: float,
    limit: float,
    gain: NDArray[np.float64],
    basis: NDArray[np.int64],
    multipliers: NDArray[np.float64],
    flags: NDArray[np.bool_],
    out: NDArray[np.float32],
) -> None:
    """Write the channels of one state into `out`, shape (N, number of true flags).

    Parameters
    ----------
    r, gamma, limit
        Signed residuals of the fit, f(S), and the threshold, in one unit.
    gain
        1 for the points of S, 0 for the removed ones.
    basis, multipliers
        The basis points, -1 where there are fewer than slots, and the dual multiplier of each.
    flags
        Which of `CHANNELS` to write.
    """
    N = r.shape[0]
    column = 0
    if flags[0]:
        for i in range(N):
            out[i, column] = -1.0
        for point in basis:
            if point >= 0:
                out[point, column] = 1.0
        column += 1
    if flags[1]:
        for i in range(N):
            out[i, column] = 1.0 if gain[i] == 0.0 else -1.0
        column += 1
    if flags[2]:
        inverse = 1.0 / max(gamma, 1e-300)
        for i in range(N):
            out[i, column] = max(-LARGEST_RATIO, min(LARGEST_RATIO, r[i] * inverse))
        column += 1
    if flags[3]:
        level = np.log(max(gamma, 1e-300) / limit) / 3.0
        level = max(-2.0, min(4.0, level))
        for i in range(N):
            out[i, column] = level
        column += 1
    if flags[4]:
        for i in range(N):
            out[i, column] = 0.0
        for slot in range(basis.shape[0]):
            if basis[slot] >= 0:
                out[basis[slot], column] = multipliers[slot]


def channel_flags(channels: tuple[str, ...]) -> NDArray[np.bool_]:
    """Return which of `CHANNELS` are in `channels`; ValueError if one is unknown."""
    unknown = set(channels) - set(CHANNELS)
    if unknown:
        raise ValueError(f"channels must be among {', '.join(CHANNELS)}, but there is {', '.join(sorted(unknown))}")
    return np.array([name in channels for name in CHANNELS], dtype=np.bool_)
