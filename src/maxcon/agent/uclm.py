"""UCLM: a PointNet-like network that says how much each point counts as an inlier (Probst et al. 2019).

Probst, Paudel, Chhatkuli and Van Gool, "Unsupervised learning of consensus maximization for 3D vision problems",
CVPR 2019. All points go in at once, and a weight in (0, 1) comes out for each: one pass, no search. Training, without
labels, is in `maxcon.experiments.uclm_training`; `maxcon.search.uclm` makes sets of the weights.

What the publication leaves open for linear problems, or what belongs to other data, is chosen here:

- *What a point is.* Its row of A and its b, posed so that weights do not hang on units or on the origin of the
  parameters: the columns of A made orthonormal from the last (the intercept) to the first, and b less its least-squares
  fit; besides, the logarithms of |b| in thresholds and of the leverage, and of the RMS of b (see `describe_points`).
- *Layers.* Three shared by all points, each with context normalisation (Yi et al. 2018: every channel has mean 0 and
  variance 1 over the points), a maximum over the points (PointNet's), which all later layers see, three more shared
  layers and a sigmoid. Much smaller than PointNet: 24,000 parameters, 0.2 ms for 100 points.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save

from maxcon.minimax import LinearRows
from maxcon.minimax.jit import kernel
from maxcon.problem import LinearProblem

#: What a hidden unit lets through of a negative value.
LEAK = 0.1

#: What keeps context normalisation from dividing by 0.
CONTEXT_FLOOR = 1e-3

#: Inputs of a point besides its d coordinates.
EXTRA_INPUTS = 4

#: A column of A whose part orthogonal to those before it is smaller than this, relative to its length, is left out.
DEPENDENT = 1e-10

_FOLDER = Path(str(resources.files("maxcon.agent"))) / "shipped_uclm"
_KIND = "uclm"


def layer_shapes(n_params: int, width: int) -> dict[str, tuple[int, int]]:
    """Return inputs and outputs of each layer for problems with `n_params` parameters."""
    return {
        "first": (n_params + EXTRA_INPUTS, width),
        "second": (width, width),
        "third": (width, 2 * width),
        "local": (3 * width, width),
        "scene": (2 * width, width),
        "fifth": (width, width),
        "sixth": (width, width),
        "weight": (width, 1),
    }


@dataclass(frozen=True, eq=False)
class UclmNetwork:
    """A trained network.

    Attributes
    ----------
    n_params
        How many parameters (d) the problems have that it serves.
    width
        Channels of a hidden layer.
    tensors
        float32: ``<layer>.matrix`` of shape (inputs, outputs) and ``<layer>.bias`` for each of `layer_shapes`.
    """

    n_params: int
    width: int
    tensors: Mapping[str, NDArray[np.float32]]

    def __post_init__(self) -> None:
        """Refuse tensors that do not fit together."""
        shapes = layer_shapes(self.n_params, self.width)
        for name, (inputs, outputs) in shapes.items():
            for part, shape in ((f"{name}.matrix", (inputs, outputs)), (f"{name}.bias", (outputs,))):
                tensor = self.tensors.get(part)
                if tensor is None or tensor.shape != shape or tensor.dtype != np.float32:
                    was = "missing" if tensor is None else f"{tensor.dtype} of shape {tensor.shape}"
                    raise ValueError(f"tensors must hold {part!r}, float32 of shape {shape}, but it is {was}")
                if not np.isfinite(tensor).all():
                    raise ValueError(f"tensors must be finite, but {part!r} holds NaN or infinity")
        if unknown := set(self.tensors) - {f"{name}.{part}" for name in shapes for part in ("matrix", "bias")}:
            raise ValueError(f"tensors must hold the layers of this network alone, but there is {min(unknown)!r}")

    def logits(self, inputs: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the logit of the weight of each point, shape (N,), from `inputs`, shape (N, d + 4)."""
        near = _hidden(_context(self._affine(inputs, "first")))
        near = _hidden(_context(self._affine(near, "second")))
        far = _hidden(_context(self._affine(near, "third")))
        scene = self._affine(far.max(axis=0), "scene")
        hidden = _hidden(_context(self._affine(np.concatenate([near, far], axis=1), "local")) + scene)
        hidden = hidden + _hidden(_context(self._affine(hidden, "fifth")))
        hidden = hidden + _hidden(_context(self._affine(hidden, "sixth")))
        return self._affine(hidden, "weight")[:, 0]

    def inlier_weights(self, problem: LinearProblem, rows: LinearRows, limit: float) -> NDArray[np.float64]:
        """Return the weight of each point, shape (N,), in [0, 1].

        Parameters
        ----------
        problem, rows
            The problem and its whitened rows.
        limit
            The largest residual of an inlier, in the unit of `rows`.

        Raises
        ------
        ValueError
            If the network serves another number of parameters.
        """
        if problem.n_params != self.n_params:
            raise ValueError(
                f"problem must have the {self.n_params} parameters that the UCLM network was trained for, "
                f"but it has {problem.n_params}"
            )
        z = self.logits(describe_points(problem, rows, limit)).astype(np.float64)
        return 0.5 + 0.5 * np.tanh(0.5 * z)  # the sigmoid, without overflow

    def _affine(self, x: NDArray[np.float32], layer: str) -> NDArray[np.float32]:
        product: NDArray[np.float32] = x @ self.tensors[f"{layer}.matrix"] + self.tensors[f"{layer}.bias"]
        return product


def describe_points(problem: LinearProblem, rows: LinearRows, limit: float) -> NDArray[np.float32]:
    """Return what the network is told of each point, shape (N, d + 4).

    The columns are: the d orthonormal coordinates of its row of A, of RMS 1 (0 where A has no rank); its residual to
    the least-squares fit, by the RMS; the same in thresholds, as ``sign(b) log(1 + |b| / limit) / 3``; the logarithm
    of its leverage by the mean; the logarithm of that RMS in thresholds, by 3, the same for all points.
    """
    N, d = problem.A.shape
    frame = np.empty((d, N))
    _orthonormal_from_last(problem.A, frame)
    size = max(float(np.sqrt(np.mean(rows.b**2))), 1e-6 * limit)
    leverage = np.sum(frame**2, axis=0) / d
    inputs = np.empty((N, d + EXTRA_INPUTS), dtype=np.float32)
    inputs[:, :d] = frame.T
    inputs[:, d] = rows.b / size
    inputs[:, d + 1] = np.sign(rows.b) * np.log1p(np.abs(rows.b) / limit) / 3.0
    inputs[:, d + 2] = np.log(leverage + 1e-6)
    inputs[:, d + 3] = np.log(size / limit) / 3.0
    return inputs


@kernel
def _orthonormal_from_last(A: NDArray[np.float64], frame: NDArray[np.float64]) -> None:
    """Write the columns of A, orthogonal to those after them and of RMS 1, into the rows of `frame`.

    Gram-Schmidt, every column orthogonalised twice. The order is fixed, unlike that of the engine's whitening, so that
    the same coordinate means the same in every problem. Columns without a part of their own become 0.
    """
    N, d = A.shape
    for j in range(d - 1, -1, -1):
        q = frame[j]
        largest = 0.0
        for i in range(N):
            largest = max(largest, abs(A[i, j]))
        if largest == 0.0:
            largest = 1.0
        square = 0.0
        for i in range(N):
            q[i] = A[i, j] / largest
            square += q[i] * q[i]
        whole = square
        for _ in range(2):
            for k in range(j + 1, d):
                along = 0.0
                for i in range(N):
                    along += frame[k, i] * q[i]
                along /= N
                for i in range(N):
                    q[i] -= along * frame[k, i]
        square = 0.0
        for i in range(N):
            square += q[i] * q[i]
        factor = 0.0
        if square > DEPENDENT * DEPENDENT * whole:
            factor = np.sqrt(N / square)
        for i in range(N):
            q[i] *= factor


def _context(x: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return every channel with mean 0 and variance (nearly) 1 over the points."""
    centred = x - x.mean(axis=0)
    spread = np.sqrt(np.mean(centred * centred, axis=0)) + np.float32(CONTEXT_FLOOR)
    normalised: NDArray[np.float32] = centred / spread
    return normalised


def _hidden(x: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the leaky ReLU."""
    hidden: NDArray[np.float32] = np.maximum(x, np.float32(LEAK) * x)
    return hidden


def save_uclm(network: UclmNetwork, path: Path, notes: Mapping[str, str] | None = None) -> None:
    """Write the network into a safetensors file, replacing it atomically; `notes` go into its header."""
    header = {"config": json.dumps({"kind": _KIND, "n_params": network.n_params, "width": network.width})}
    part = path.with_suffix(".part")
    part.write_bytes(save(dict(network.tensors), {**dict(notes or {}), **header}))
    os.replace(part, path)


def load_uclm(path: Path) -> UclmNetwork:
    """Return the network in a file.

    Raises
    ------
    ValueError
        If there is no such file, or it does not hold a UCLM network of this version.
    """
    try:
        with safe_open(str(path), framework="numpy") as file:
            metadata = file.metadata() or {}
            tensors: dict[str, NDArray[Any]] = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise ValueError(f"network must name a file, but there is no file {str(path)!r}") from None
    except Exception as error:  # safetensors raises a class of its own for each broken header
        raise ValueError(f"network must be a safetensors file, but {str(path)!r} is not: {error}") from None
    try:
        config = json.loads(metadata["config"])
        if config["kind"] != _KIND:
            raise ValueError(f"it is a network of the kind {config['kind']!r}")
        n_params, width = config["n_params"], config["width"]
        if not (isinstance(n_params, int) and isinstance(width, int) and n_params > 0 and width > 0):
            raise ValueError(f"n_params and width must be positive integers, but they are {n_params!r} and {width!r}")
        return UclmNetwork(n_params, width, tensors)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"network must be a UCLM network of this version of maxcon, but {str(path)!r} is not: {error}"
        ) from None


def uclm_names() -> tuple[str, ...]:
    """Return the names of the shipped networks."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.safetensors")))


def shipped_uclm(problem: LinearProblem) -> UclmNetwork:
    """Return the network for the family of `problem`.

    Fundamental matrices in any chart ("fundamental", "fundamental F32=1", ...) share one network; a problem of the
    family "linear" with 8 parameters is taken for one of them.

    Raises
    ------
    ValueError
        If none is shipped for it.
    """
    name = problem.family.split(" ")[0]
    if name == "linear" and problem.n_params == 8:
        name = "fundamental"
    if name not in uclm_names():
        raise ValueError(
            f"method 'uclm' has shipped networks for the families {', '.join(uclm_names())}, but the problem is of the "
            f"family {problem.family!r} with {problem.n_params} parameters: pass network=FILE of one trained for it, "
            "or use another method"
        )
    return _load(name)


@cache
def _load(name: str) -> UclmNetwork:
    return load_uclm(_FOLDER / f"{name}.safetensors")
