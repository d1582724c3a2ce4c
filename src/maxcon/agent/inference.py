"""The Q-network without torch: the same arithmetic, compiled, spending nothing on what a state does not change.

Per instance: the neighbour graph, and the part of the first layer that multiplies H. Per state: the rest, with every
EdgeConv split into ``p_i + max_j q_j``, and the head for the basis points only.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.agent.config import AgentConfig
from maxcon.agent.graph import neighbour_graph, point_features
from maxcon.agent.weights import load_weights
from maxcon.minimax.jit import kernel
from maxcon.problem import LinearProblem
from maxcon.tree.encoding import channel_flags

#: Slope of the leaky ReLU below 0, as in `network`.
LEAK = np.float32(0.2)

#: What torch's LayerNorm adds to the variance.
NORM_EPSILON = np.float32(1e-5)


class Parameters(NamedTuple):
    """All parameters in one array, in the order in which `q_values` reads them.

    Attributes
    ----------
    flat
        For each EdgeConv the matrix [own | other], shape (n_in, 2 n_out), the bias, and weight and bias of the norm;
        then matrix and bias of the global feature; then of each layer of the head.
    widths
        Output width of each EdgeConv.
    head
        Output width of each layer of the head, the last 1.
    global_width
        Width of the global feature.
    n_features, n_channels
        Columns of H, and of what changes with the state.
    """

    flat: NDArray[np.float32]
    widths: NDArray[np.int64]
    head: NDArray[np.int64]
    global_width: int
    n_features: int
    n_channels: int


class Scratch(NamedTuple):
    """What one instance needs: its graph, the cached part of the first layer, and room to compute in.

    Room for matrices is flat: a contiguous piece of it, reshaped, keeps the loops over columns vectorised.
    """

    graph: NDArray[np.int32]
    cached: NDArray[np.float32]
    both: NDArray[np.float32]
    features: NDArray[np.float32]
    vectors: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Agent:
    """A trained Q-network, ready to be asked.

    Attributes
    ----------
    config
        What it is made of and how it was trained.
    parameters
        For the kernels.
    """

    config: AgentConfig
    parameters: Parameters

    @classmethod
    def load(cls, path: Path) -> Agent:
        """Read an agent file; ValueError if it is none."""
        tensors, config = load_weights(path)
        return cls(config, pack(tensors, config))

    @property
    def flags(self) -> NDArray[np.bool_]:
        """Which of the channels of `maxcon.tree.encoding` it reads."""
        return channel_flags(self.config.network.channels)

    def prepare(self, problem: LinearProblem, threshold: float) -> Scratch:
        """Return what `q_values` needs to know about `problem` once.

        Parameters
        ----------
        problem
            The problem.
        threshold
            The inlier threshold, in the unit of b.

        Raises
        ------
        ValueError
            If the problem has another number of features than the agent was trained on.
        """
        H = point_features(problem, threshold, self.config.network)
        if H.shape[1] != self.parameters.n_features:
            further = 1 + self.config.network.estimate  # columns that are no column of A
            raise ValueError(
                f"problem must have {self.parameters.n_features - further} columns that vary for this agent, "
                f"but it has {H.shape[1] - further}"
            )
        return make_scratch(self.parameters, H, neighbour_graph(H, self.config.network.neighbours))


def pack(tensors: dict[str, NDArray[np.float32]], config: AgentConfig) -> Parameters:
    """Return the parameters of a network, as `save_weights` names them, for the kernels."""
    widths, head = config.network.widths, (*config.network.head, 1)
    parts: list[NDArray[np.float32]] = []
    for layer in range(len(widths)):
        name = f"edge.{layer}"
        parts += [np.concatenate([tensors[f"{name}.own.weight"].T, tensors[f"{name}.other.weight"].T], axis=1)]
        parts += [tensors[f"{name}.own.bias"], tensors[f"{name}.norm.weight"], tensors[f"{name}.norm.bias"]]
    parts += [tensors["pool.weight"].T, tensors["pool.bias"]]
    for layer in range(len(head)):
        parts += [tensors[f"head.{layer}.weight"].T, tensors[f"head.{layer}.bias"]]
    n_channels = len(config.network.channels)
    return Parameters(
        np.concatenate([np.ascontiguousarray(part, dtype=np.float32).ravel() for part in parts]),
        np.array(widths, dtype=np.int64),
        np.array(head, dtype=np.int64),
        config.network.global_width,
        tensors["edge.0.own.weight"].shape[1] - n_channels,
        n_channels,
    )


def make_scratch(parameters: Parameters, H: NDArray[np.float32], graph: NDArray[np.int32]) -> Scratch:
    """Return the scratch space of an instance, with the part of the first layer that only H decides."""
    N, m = H.shape
    first = int(parameters.widths[0])
    n_in = m + parameters.n_channels
    weights = parameters.flat[: n_in * 2 * first].reshape(n_in, 2 * first)
    cached = H @ weights[:m]
    widest = int(parameters.widths.max())
    total = int(parameters.widths.sum())
    longest = max(2 * total, total + parameters.global_width, int(parameters.head.max()))
    return Scratch(
        np.ascontiguousarray(graph, dtype=np.int32),
        np.ascontiguousarray(cached, dtype=np.float32),
        np.empty(N * 2 * widest, dtype=np.float32),
        np.empty(N * total, dtype=np.float32),
        np.empty((4, longest), dtype=np.float32),
    )


@kernel
def _add_product(X: NDArray[np.float32], W: NDArray[np.float32], Y: NDArray[np.float32]) -> None:
    """Y += X @ W, four rows of W a pass and the columns innermost, so that the loop vectorises without fastmath."""
    N, K = X.shape
    C = W.shape[1]
    for i in range(N):
        y = Y[i]
        k = 0
        while k + 3 < K:
            x0, x1, x2, x3 = X[i, k], X[i, k + 1], X[i, k + 2], X[i, k + 3]
            w0, w1, w2, w3 = W[k], W[k + 1], W[k + 2], W[k + 3]
            for c in range(C):
                y[c] += (x0 * w0[c] + x1 * w1[c]) + (x2 * w2[c] + x3 * w3[c])
            k += 4
        while k < K:
            x0 = X[i, k]
            w0 = W[k]
            for c in range(C):
                y[c] += x0 * w0[c]
            k += 1


#: OpenBLAS wakes other threads for products of more multiplications than this, and that takes longer than the product.
_ONE_THREAD = 262144


@kernel
def _product(X: NDArray[np.float32], W: NDArray[np.float32], Y: NDArray[np.float32]) -> None:
    """Y = X @ W by BLAS, in blocks of rows."""
    N, K = X.shape
    block = max(1, _ONE_THREAD // (K * W.shape[1]))
    low = 0
    while low < N:
        high = min(N, low + block)
        np.dot(X[low:high], W, Y[low:high])
        low = high


@kernel
def _neighbour_max_norm(
    both: NDArray[np.float32],
    width: int,
    graph: NDArray[np.int32],
    own_bias: NDArray[np.float32],
    weight: NDArray[np.float32],
    bias: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """out = leaky ReLU of LayerNorm of (own part + maximum over the neighbours of the other part)."""
    N = both.shape[0]
    k = graph.shape[1]
    inverse = np.float32(1.0) / np.float32(width)
    for i in range(N):
        row = out[i]
        first = both[graph[i, 0], width:]
        for c in range(width):
            row[c] = first[c]
        m = 1
        while m + 2 < k:
            one = both[graph[i, m], width:]
            two = both[graph[i, m + 1], width:]
            three = both[graph[i, m + 2], width:]
            for c in range(width):
                left = one[c] if one[c] > two[c] else two[c]
                right = three[c] if three[c] > row[c] else row[c]
                row[c] = left if left > right else right
            m += 3
        while m < k:
            one = both[graph[i, m], width:]
            for c in range(width):
                row[c] = one[c] if one[c] > row[c] else row[c]
            m += 1
        own = both[i]
        for c in range(width):
            row[c] += own[c] + own_bias[c]
        mean = _sum(row, width) * inverse
        for c in range(width):
            row[c] -= mean
        variance = _sum_of_squares(row, width) * inverse
        factor = np.float32(1.0) / np.sqrt(variance + NORM_EPSILON)
        for c in range(width):
            value = row[c] * factor * weight[c] + bias[c]
            row[c] = value if value > np.float32(0.0) else LEAK * value


@kernel
def _sum(row: NDArray[np.float32], width: int) -> np.float32:
    """Return the sum in eight strands: one strand would wait for each addition to end."""
    a0 = a1 = a2 = a3 = a4 = a5 = a6 = a7 = np.float32(0.0)
    c = 0
    while c + 7 < width:
        a0 += row[c]
        a1 += row[c + 1]
        a2 += row[c + 2]
        a3 += row[c + 3]
        a4 += row[c + 4]
        a5 += row[c + 5]
        a6 += row[c + 6]
        a7 += row[c + 7]
        c += 8
    while c < width:
        a0 += row[c]
        c += 1
    return ((a0 + a1) + (a2 + a3)) + ((a4 + a5) + (a6 + a7))


@kernel
def _sum_of_squares(row: NDArray[np.float32], width: int) -> np.float32:
    a0 = a1 = a2 = a3 = a4 = a5 = a6 = a7 = np.float32(0.0)
    c = 0
    while c + 7 < width:
        a0 += row[c] * row[c]
        a1 += row[c + 1] * row[c + 1]
        a2 += row[c + 2] * row[c + 2]
        a3 += row[c + 3] * row[c + 3]
        a4 += row[c + 4] * row[c + 4]
        a5 += row[c + 5] * row[c + 5]
        a6 += row[c + 6] * row[c + 6]
        a7 += row[c + 7] * row[c + 7]
        c += 8
    while c < width:
        a0 += row[c] * row[c]
        c += 1
    return ((a0 + a1) + (a2 + a3)) + ((a4 + a5) + (a6 + a7))


@kernel
def q_values(
    parameters: Parameters,
    scratch: Scratch,
    channels: NDArray[np.float32],
    basis: NDArray[np.int64],
    q: NDArray[np.float64],
) -> None:
    """Write the Q-value of every slot into q, shape (n,), minus infinity where a slot is empty.

    Parameters
    ----------
    parameters, scratch
        From `Agent`.
    channels
        Shape (N, n_channels), from `encode_channels`.
    basis
        Shape (n,): the basis points, -1 in empty slots.
    """
    flat = parameters.flat
    N = scratch.graph.shape[0]
    features = scratch.features[:0].reshape((0, 1))
    place = 0
    column = 0
    n_in = parameters.n_features + parameters.n_channels
    for layer in range(parameters.widths.shape[0]):
        width = parameters.widths[layer]
        matrix = flat[place : place + n_in * 2 * width].reshape((n_in, 2 * width))
        place += n_in * 2 * width
        bias = flat[place : place + width]
        weight = flat[place + width : place + 2 * width]
        shift = flat[place + 2 * width : place + 3 * width]
        place += 3 * width
        both = scratch.both[: N * 2 * width].reshape((N, 2 * width))
        if layer == 0:
            for i in range(N):
                row, known = both[i], scratch.cached[i]
                for c in range(2 * width):
                    row[c] = known[c]
            _add_product(channels, matrix[parameters.n_features :], both)
        else:
            _product(features, matrix, both)
        features = scratch.features[N * column : N * (column + width)].reshape((N, width))
        _neighbour_max_norm(both, width, scratch.graph, bias, weight, shift, features)
        column += width
        n_in = width
    _head(parameters, scratch, place, basis, q)


@kernel
def _affine(
    flat: NDArray[np.float32],
    place: int,
    n_in: int,
    n_out: int,
    x: NDArray[np.float32],
    y: NDArray[np.float32],
) -> int:
    """y = x @ matrix + bias, both read from `flat` at `place`; return the place after them."""
    bias = flat[place + n_in * n_out : place + n_in * n_out + n_out]
    for c in range(n_out):
        y[c] = bias[c]
    for k in range(n_in):
        row = flat[place + k * n_out : place + (k + 1) * n_out]
        for c in range(n_out):
            y[c] += x[k] * row[c]
    return place + n_in * n_out + n_out


@kernel
def _head(
    parameters: Parameters, scratch: Scratch, place: int, basis: NDArray[np.int64], q: NDArray[np.float64]
) -> None:
    """Pool the features into the global one and run the MLP on the basis points."""
    flat = parameters.flat
    N = scratch.graph.shape[0]
    pooled, inputs, here, there = (
        scratch.vectors[0],
        scratch.vectors[1],
        scratch.vectors[2],
        scratch.vectors[3],
    )
    total = 0
    for layer in range(parameters.widths.shape[0]):
        total += int(parameters.widths[layer])
    inverse = np.float32(1.0) / np.float32(N)
    column = 0
    for width in parameters.widths:
        features = scratch.features[N * column : N * (column + width)].reshape((N, width))
        largest, mean = pooled[column : column + width], pooled[total + column : total + column + width]
        for c in range(width):
            largest[c] = features[0, c]
            mean[c] = np.float32(0.0)
        for i in range(N):
            row = features[i]
            for c in range(width):
                largest[c] = row[c] if row[c] > largest[c] else largest[c]
                mean[c] += row[c]
        for c in range(width):
            mean[c] *= inverse
        column += width
    n_global = int(parameters.global_width)
    place = _affine(flat, place, 2 * total, n_global, pooled, here)
    for c in range(n_global):
        inputs[total + c] = here[c] if here[c] > np.float32(0.0) else LEAK * here[c]
    for slot in range(basis.shape[0]):
        if basis[slot] < 0:
            q[slot] = -np.inf
            continue
        column = 0
        for width in parameters.widths:
            start = N * column + basis[slot] * width
            for c in range(width):
                inputs[column + c] = scratch.features[start + c]
            column += width
        n_in = total + n_global
        at = place
        source, target = inputs, here
        for layer in range(parameters.head.shape[0]):
            n_out = int(parameters.head[layer])
            at = _affine(flat, at, n_in, n_out, source, target)
            if layer < parameters.head.shape[0] - 1:
                for c in range(n_out):
                    target[c] = target[c] if target[c] > np.float32(0.0) else LEAK * target[c]
            source, target = target, (there if layer % 2 == 0 else here)
            n_in = n_out
        q[slot] = source[0]
