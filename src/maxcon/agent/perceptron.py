"""Small multilayer perceptrons: compiled inference on plain arrays, and a pair of them in one safetensors file.

A perceptron here has leaky ReLU hidden layers and one output, a logit. Its weights lie in one flat float64 array,
layer after layer, each as a matrix (inputs, outputs) followed by its biases.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save

from maxcon.minimax.jit import kernel

#: What a hidden unit lets through of a negative value.
LEAK = 0.1

#: Points that go through the layers together: their activations stay in the nearest cache.
BLOCK = 128


class Perceptron(NamedTuple):
    """Weights and layer widths.

    Attributes
    ----------
    weights
        Flat, float64.
    widths
        int64: inputs, hidden widths, 1.
    """

    weights: NDArray[np.float64]
    widths: NDArray[np.int64]


def perceptron(matrices: list[NDArray[np.float64]], biases: list[NDArray[np.float64]]) -> Perceptron:
    """Pack matrices of shape (inputs, outputs) and biases of shape (outputs,).

    Raises
    ------
    ValueError
        If the shapes do not chain, the last layer has more than one output, or a number is not finite.
    """
    widths = [matrices[0].shape[0]] if matrices else []
    parts: list[NDArray[np.float64]] = []
    for number, (matrix, bias) in enumerate(zip(matrices, biases, strict=True)):
        if matrix.ndim != 2 or matrix.shape[0] != widths[-1] or bias.shape != (matrix.shape[1],):
            raise ValueError(
                f"layer {number} must take {widths[-1]} inputs and have one bias an output, but its matrix has the "
                f"shape {matrix.shape} and its biases {bias.shape}"
            )
        widths.append(matrix.shape[1])
        parts += [np.asarray(matrix, dtype=np.float64).ravel(), np.asarray(bias, dtype=np.float64)]
    if len(widths) < 2 or widths[-1] != 1:
        raise ValueError(f"a perceptron must have layers and end in one output, but its widths are {widths}")
    weights = np.ascontiguousarray(np.concatenate(parts))
    if not np.isfinite(weights).all():
        raise ValueError("the weights of a perceptron must be finite, but they hold NaN or infinity")
    return Perceptron(weights, np.array(widths, dtype=np.int64))


def random_perceptron(widths: tuple[int, ...], rng: np.random.Generator) -> Perceptron:
    """Return random weights of He's scale (He et al. 2015) with a small last layer: logits near 0."""
    matrices = [
        rng.normal(0.0, np.sqrt(2.0 / fan_in) if width > 1 else 0.1 / np.sqrt(fan_in), (fan_in, width))
        for fan_in, width in pairwise(widths)
    ]
    return perceptron(matrices, [np.zeros(width) for width in widths[1:]])


def layers(net: Perceptron) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return the matrix and the biases of each layer, copied."""
    found, start = [], 0
    for fan_in, width in pairwise(net.widths.tolist()):
        middle, end = start + fan_in * width, start + (fan_in + 1) * width
        found.append((net.weights[start:middle].reshape(fan_in, width).copy(), net.weights[middle:end].copy()))
        start = end
    return found


@kernel
def evaluate_columns(
    net: Perceptron,
    inputs: NDArray[np.float64],
    hidden: NDArray[np.float64],
    outputs: NDArray[np.float64],
) -> None:
    """Write the logit of each column of `inputs`, shape (inputs, N), into `outputs`, shape (N,).

    `hidden` is scratch of shape (2, W, BLOCK), W the largest width. Made for many columns: the loops over
    the columns vectorise, with two units and four inputs a pass, since memory traffic is what costs.
    """
    weights, widths = net
    N = outputs.shape[0]
    depth = widths.shape[0] - 1
    for first in range(0, N, BLOCK):
        m = min(BLOCK, N - first)
        start = 0
        for layer in range(depth):
            fan_in, width = widths[layer], widths[layer + 1]
            bias = start + fan_in * width
            base = first if layer == 0 else 0
            source = inputs if layer == 0 else hidden[1 - (layer & 1)]
            target = hidden[layer & 1]
            for j in range(0, width, 2):
                two = j + 1 < width
                # Rows first, then their parts: so the compiler knows that they are contiguous.
                t0, t1 = target[j][:m], target[j + 1 if two else j][:m]
                for i in range(m):
                    t0[i] = weights[bias + j]
                if two:
                    for i in range(m):
                        t1[i] = weights[bias + j + 1]
                k = 0
                while k < fan_in:
                    a = start + k * width + j
                    if not (two and k + 3 < fan_in):
                        h0, c0 = source[k][base : base + m], weights[a]
                        for i in range(m):
                            t0[i] += c0 * h0[i]
                        if two:
                            e0 = weights[a + 1]
                            for i in range(m):
                                t1[i] += e0 * h0[i]
                        k += 1
                        continue
                    h0, h1 = source[k][base : base + m], source[k + 1][base : base + m]
                    h2, h3 = source[k + 2][base : base + m], source[k + 3][base : base + m]
                    c0, c1, c2, c3 = weights[a], weights[a + width], weights[a + 2 * width], weights[a + 3 * width]
                    a += 1
                    e0, e1, e2, e3 = weights[a], weights[a + width], weights[a + 2 * width], weights[a + 3 * width]
                    for i in range(m):
                        x0, x1, x2, x3 = h0[i], h1[i], h2[i], h3[i]
                        t0[i] += (c0 * x0 + c1 * x1) + (c2 * x2 + c3 * x3)
                        t1[i] += (e0 * x0 + e1 * x1) + (e2 * x2 + e3 * x3)
                    k += 4
                if layer < depth - 1:
                    for i in range(m):
                        t0[i] = max(t0[i], LEAK * t0[i])
                    if two:
                        for i in range(m):
                            t1[i] = max(t1[i], LEAK * t1[i])
            start = bias + width
        last = hidden[(depth - 1) & 1, 0]
        for i in range(m):
            outputs[first + i] = last[i]


@kernel
def evaluate_row(net: Perceptron, inputs: NDArray[np.float64], hidden: NDArray[np.float64]) -> float:
    """Return the logit of one input vector; `hidden` is scratch of shape (2, W), W the largest hidden width.

    Made for few inputs: the loops over the units vectorise.
    """
    weights, widths = net
    depth = widths.shape[0] - 1
    start = 0
    for layer in range(depth):
        fan_in, width = widths[layer], widths[layer + 1]
        bias = start + fan_in * width
        if layer == depth - 1:
            total = weights[bias]
            for k in range(fan_in):
                total += (inputs[k] if layer == 0 else hidden[1 - (layer & 1), k]) * weights[start + k]
            return float(total)
        target = hidden[layer & 1]
        for j in range(width):
            target[j] = weights[bias + j]
        for k in range(fan_in):
            value = inputs[k] if layer == 0 else hidden[1 - (layer & 1), k]
            row = weights[start + k * width : start + (k + 1) * width]
            for j in range(width):
                target[j] += value * row[j]
        for j in range(width):
            target[j] = max(target[j], LEAK * target[j])
        start = bias + width
    return 0.0


def save_perceptrons(nets: Mapping[str, Perceptron], path: Path, notes: Mapping[str, str] | None = None) -> None:
    """Write perceptrons by name, as float32, and notes (strings) into one file, replacing `path` atomically."""
    tensors = {}
    for name, net in nets.items():
        for number, (matrix, bias) in enumerate(layers(net)):
            tensors[f"{name}.{number}.weight"] = matrix.astype(np.float32)
            tensors[f"{name}.{number}.bias"] = bias.astype(np.float32)
    part = path.with_suffix(".part")
    part.write_bytes(save(tensors, dict(notes or {})))
    os.replace(part, path)


def load_perceptrons(path: Path, widths: Mapping[str, int]) -> dict[str, Perceptron]:
    """Return the perceptrons called by the keys of `widths`, each with so many inputs.

    Raises
    ------
    ValueError
        If there is no such file, or it does not hold them.
    """
    try:
        with safe_open(str(path), framework="numpy") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise ValueError(f"network must name a file, but there is no file {str(path)!r}") from None
    except Exception as error:  # safetensors raises a class of its own for each broken header
        raise ValueError(f"network must be a safetensors file, but {str(path)!r} is not: {error}") from None
    nets: dict[str, Perceptron] = {}
    for name, n_inputs in widths.items():
        matrices: list[NDArray[np.float64]] = []
        biases: list[NDArray[np.float64]] = []
        while f"{name}.{len(matrices)}.weight" in tensors and f"{name}.{len(matrices)}.bias" in tensors:
            biases.append(tensors[f"{name}.{len(matrices)}.bias"].astype(np.float64))
            matrices.append(tensors[f"{name}.{len(matrices)}.weight"].astype(np.float64))
        if not matrices:
            raise ValueError(f"network must hold the perceptron {name!r}, but {str(path)!r} does not")
        try:
            nets[name] = perceptron(matrices, biases)
        except ValueError as error:
            raise ValueError(f"network must hold sound perceptrons, but {name!r} of {str(path)!r}: {error}") from None
        if nets[name].widths[0] != n_inputs:
            raise ValueError(
                f"network must hold a perceptron {name!r} of {n_inputs} inputs, but in {str(path)!r} it has "
                f"{nets[name].widths[0]}: it belongs to another version of maxcon"
            )
    return nets
