"""What the peel network sees of each basis point: twelve numbers that the fit gives away, in units of the limit."""

from __future__ import annotations

from math import log

import numpy as np
from numpy.typing import NDArray

from maxcon.agent.point_features import BEST_MEMBER, BEST_SIZE, LEVERAGE, log_size
from maxcon.minimax.jit import kernel

#: The features, in order.
PEEL_FEATURES = (
    "log f(S) over the limit",
    "share of the points in S",
    "dual multiplier",
    "size of the proposal's residual",
    "the same, relative to the basis",
    "logit of the point",
    "the same, relative to the basis",
    "size of the incumbent's residual",
    "member of the incumbent",
    "share of the proposal's inliers",
    "sign agreement with the proposal",
    "leverage",
)
N_PEEL_FEATURES = len(PEEL_FEATURES)


@kernel
def write_peel_features(
    basis: NDArray[np.int64],
    size: int,
    multipliers: NDArray[np.float64],
    sides: NDArray[np.float64],
    gamma: float,
    limit: float,
    share: float,
    proposal: NDArray[np.float64],
    proposal_share: float,
    logit: NDArray[np.float64],
    point_features: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Write the features of ``basis[:size]`` into the rows of `out`, shape (d + 1, 12).

    Parameters
    ----------
    basis, multipliers, sides
        Shape (d + 1,) each: the basis points, their multipliers, and the signs of their residuals.
    gamma, share
        f(S), in the unit of `limit`, and |S| / N.
    proposal, proposal_share
        Shape (N,): the residuals of the proposal, and the share of its inliers.
    logit, point_features
        Shapes (N,) and (18, N): what is believed and known of the points.
    """
    level = log(gamma / limit)
    mean_size = 0.0
    mean_logit = 0.0
    for k in range(size):
        i = basis[k]
        row = out[k]
        row[0] = level
        row[1] = share
        row[2] = multipliers[k] * (0.5 * out.shape[0])
        row[3] = log_size(proposal[i], limit)
        row[5] = 0.25 * min(max(logit[i], -12.0), 12.0)
        row[7] = point_features[BEST_SIZE, i]
        row[8] = point_features[BEST_MEMBER, i]
        row[9] = proposal_share
        row[10] = sides[k] * min(max(proposal[i] / limit, -2.0), 2.0)
        row[11] = point_features[LEVERAGE, i]
        mean_size += row[3]
        mean_logit += row[5]
    for k in range(size):
        out[k, 4] = out[k, 3] - mean_size / size
        out[k, 6] = out[k, 5] - mean_logit / size
