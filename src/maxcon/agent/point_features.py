"""What the point network sees of each point: eighteen numbers that mean the same whatever N, d and the threshold.

Residuals are in units of the limit (the threshold with its slack), counts are shares of N, ranks lie in [0, 1].
"""

from __future__ import annotations

from math import log, log1p

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel

#: The features, in the order of the rows of the matrix (18, N).
POINT_FEATURES = (
    "size of the L1 residual",
    "rank of the L1 residual",
    "size of the Geman-McClure residual",
    "weight of the Geman-McClure residual",
    "leverage",
    "raw votes",
    "refined votes, soft",
    "refined votes, sharp",
    "size of the incumbent residual",
    "member of the incumbent",
    "rank of the incumbent residual",
    "weight of the incumbent residual",
    "share of the incumbent",
    "share of the Geman-McClure model",
    "share of the L1 model",
    "log of the round",
    "number of parameters",
    "log of the number of points",
)
L1_SIZE, L1_RANK, GNC_SIZE, GNC_WEIGHT, LEVERAGE = 0, 1, 2, 3, 4
RAW_VOTES, SOFT_VOTES, SHARP_VOTES = 5, 6, 7
BEST_SIZE, BEST_MEMBER, BEST_RANK, BEST_WEIGHT = 8, 9, 10, 11
BEST_SHARE, GNC_SHARE, L1_SHARE, ROUND, PARAMETERS, POINTS = 12, 13, 14, 15, 16, 17
N_POINT_FEATURES = len(POINT_FEATURES)

#: Ranks are read off a histogram of the log-sizes with so many bins over [`LEAST_SIZE`, `LARGEST_SIZE`].
BINS = 256

#: The floor under a residual in units of the limit, and the ceiling.
FLOOR, CEILING = 0.05, 1e4
LEAST_SIZE, LARGEST_SIZE = 0.5 * log(FLOOR), 0.5 * log(CEILING + FLOOR)


@kernel
def log_size(residual: float, limit: float) -> float:
    """Return the size of a residual on a log scale: 0 at about the limit, 1.15 at ten times, never below -1.5."""
    return 0.5 * log(min(abs(residual) / limit, CEILING) + FLOOR)


@kernel
def robust_weight(residual: float, limit: float) -> float:
    """Return the Geman-McClure weight of a residual, 1 at 0 and a quarter at the limit."""
    ratio = min(abs(residual) / limit, CEILING)
    share = 1.0 / (1.0 + ratio * ratio)
    return float(share * share)


@kernel
def write_ranks(sizes: NDArray[np.float64], bins: NDArray[np.int64], ranks: NDArray[np.float64]) -> None:
    """Write which part of the points has a smaller log-size, by bins: equal ones share their middle rank."""
    N = sizes.shape[0]
    scale = (BINS - 1) / (LARGEST_SIZE - LEAST_SIZE)
    for k in range(BINS):
        bins[k] = 0
    for i in range(N):
        bins[int((sizes[i] - LEAST_SIZE) * scale)] += 1
    below = 0
    for k in range(BINS):
        count = bins[k]
        bins[k] = 2 * below + count
        below += count
    for i in range(N):
        ranks[i] = bins[int((sizes[i] - LEAST_SIZE) * scale)] / (2.0 * N)


@kernel
def write_sizes(
    r: NDArray[np.float64], limit: float, sizes: NDArray[np.float64], weights: NDArray[np.float64]
) -> float:
    """Write the log-sizes and robust weights of residuals r; return the share of them within the limit."""
    N = r.shape[0]
    count = 0
    for i in range(N):
        sizes[i] = log_size(r[i], limit)
        weights[i] = robust_weight(r[i], limit)
        count += abs(r[i]) <= limit
    return float(count / N)


@kernel
def write_root_features(
    At: NDArray[np.float64],
    r_l1: NDArray[np.float64],
    r_gnc: NDArray[np.float64],
    limit: float,
    bins: NDArray[np.int64],
    features: NDArray[np.float64],
) -> None:
    """Write what does not change during a search: the rows of the L1 and Geman-McClure models, leverage, sizes.

    In whitened rows At, of orthogonal columns of length sqrt(N), the leverage of a point is its squared length
    over N.
    """
    d, N = At.shape
    l1_share = write_sizes(r_l1, limit, features[L1_SIZE], features[L1_RANK])
    write_ranks(features[L1_SIZE], bins, features[L1_RANK])
    gnc_share = write_sizes(r_gnc, limit, features[GNC_SIZE], features[GNC_WEIGHT])
    leverage = features[LEVERAGE]
    for i in range(N):
        leverage[i] = 0.0
    for j in range(d):
        a = At[j]
        for i in range(N):
            leverage[i] += a[i] * a[i]
    for i in range(N):
        leverage[i] = 0.5 * log(leverage[i] / max(d, 1) + 0.01)
        features[L1_SHARE, i] = l1_share
        features[GNC_SHARE, i] = gnc_share
        features[PARAMETERS, i] = d / 8.0
        features[POINTS, i] = 0.25 * log(N / 100.0)


@kernel
def write_best_features(
    r: NDArray[np.float64],
    member: NDArray[np.bool_],
    limit: float,
    bins: NDArray[np.int64],
    features: NDArray[np.float64],
) -> None:
    """Write the rows of the incumbent: residuals r of its model, and the points that it holds."""
    N = r.shape[0]
    write_sizes(r, limit, features[BEST_SIZE], features[BEST_WEIGHT])
    write_ranks(features[BEST_SIZE], bins, features[BEST_RANK])
    count = 0
    for i in range(N):
        features[BEST_MEMBER, i] = 1.0 if member[i] else 0.0
        count += member[i]
    for i in range(N):
        features[BEST_SHARE, i] = count / N


@kernel
def write_round_features(
    votes: NDArray[np.float64], totals: NDArray[np.float64], number: int, features: NDArray[np.float64]
) -> None:
    """Write the rows of the votes, sums of shape (3, N) with their totals, and of the round's number."""
    N = votes.shape[1]
    for k in range(3):
        scale = 1.0 / totals[k] if totals[k] > 0.0 else 0.0
        row, sums = features[RAW_VOTES + k], votes[k]
        for i in range(N):
            row[i] = sums[i] * scale
    age = 0.5 * log1p(number)
    for i in range(N):
        features[ROUND, i] = age
