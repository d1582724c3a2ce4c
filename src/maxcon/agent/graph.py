"""The features H, the neighbour graph on them and the maximum over neighbours: what EdgeConv does besides multiplying.

An EdgeConv with one linear layer, ``max_j W [x_i, x_j - x_i] + b`` over the neighbours j (Wang et al. 2019), splits
into ``p_i + max_j q_j`` with ``p = x (W1 - W2) + b`` and ``q = x W2``; LayerNorm and leaky ReLU follow.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from maxcon.agent.config import NetworkConfig
from maxcon.minimax.jit import kernel
from maxcon.problem import LinearProblem
from maxcon.tree.encoding import canonical_features, estimate_feature, raw_features


def point_features(problem: LinearProblem, threshold: float, config: NetworkConfig) -> NDArray[np.float32]:
    """Return H, shape (N, features): what a network of this configuration reads of a problem, whatever the state."""
    H = canonical_features(problem) if config.canonical else raw_features(problem)
    return np.hstack([H, estimate_feature(problem, threshold)]) if config.estimate else H


def neighbour_graph(H: NDArray[np.float32], neighbours: int) -> NDArray[np.int32]:
    """Return the indices of the nearest points in H, the point itself included: shape (N, neighbours).

    Where there are fewer points than `neighbours`, rows are padded with the point itself, which changes no maximum.
    """
    N = len(H)
    k = min(neighbours, N)
    graph = np.tile(np.arange(N, dtype=np.int32)[:, None], (1, neighbours))
    graph[:, :k] = cKDTree(H).query(H, k=np.arange(1, k + 1))[1]
    missing = ~(graph == np.arange(N)[:, None]).any(axis=1)  # among more than k equal points
    graph[missing, 0] = np.flatnonzero(missing)
    return graph


@kernel
def neighbour_max(q: NDArray[np.float32], graph: NDArray[np.int32], out: NDArray[np.float32]) -> None:
    """Write ``out[i] = max over j in graph[i] of q[j]``, column by column; shapes (N, C), (N, k), (N, C)."""
    N, C = q.shape
    k = graph.shape[1]
    for i in range(N):
        first = q[graph[i, 0]]
        row = out[i]
        for c in range(C):
            row[c] = first[c]
        for m in range(1, k):
            other = q[graph[i, m]]
            for c in range(C):
                row[c] = other[c] if other[c] > row[c] else row[c]


@kernel
def batched_neighbour_max(
    q: NDArray[np.float32],
    graph: NDArray[np.int32],
    out: NDArray[np.float32],
    which: NDArray[np.int32],
) -> None:
    """Do `neighbour_max` for a batch, shapes (B, N, C), and note in `which` the neighbour that was largest."""
    B, N, C = q.shape
    k = graph.shape[2]
    for s in range(B):
        for i in range(N):
            j = graph[s, i, 0]
            for c in range(C):
                out[s, i, c] = q[s, j, c]
                which[s, i, c] = j
            for m in range(1, k):
                j = graph[s, i, m]
                for c in range(C):
                    larger = q[s, j, c] > out[s, i, c]
                    out[s, i, c] = q[s, j, c] if larger else out[s, i, c]
                    which[s, i, c] = j if larger else which[s, i, c]


@kernel
def scatter_gradient(gradient: NDArray[np.float32], which: NDArray[np.int32], out: NDArray[np.float32]) -> None:
    """Add each gradient to the neighbour that was largest: the backward pass of `batched_neighbour_max`."""
    B, N, C = gradient.shape
    for s in range(B):
        for i in range(N):
            for c in range(C):
                out[s, which[s, i, c], c] += gradient[s, i, c]
