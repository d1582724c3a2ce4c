"""UCLM (Probst et al. 2019) as a method: weights from one pass of a network, models from the weights.

The publication says how weights are learned; it leaves open how weights become a model. Here every model that the
weights suggest is counted, and the largest set is the result:

1. the last right singular vector of the weighted Vandermonde matrix diag(w) [A, -b] (whitened): the model of the loss;
2. the least-squares fit weighted by w^2: the same for residuals whose size is fixed by b;
3. the least-squares fits of the points of largest weight, for several numbers of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maxcon.agent.uclm import UclmNetwork, load_uclm, shipped_uclm
from maxcon.minimax import LinearRows
from maxcon.search.anytime import Step, Task
from maxcon.search.model_kernels import weighted_model
from maxcon.search.sampling import inlier_mask

#: Parts of the points of largest weight that models are fitted to.
PARTS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)


def uclm(task: Task, *, network: str | Path | UclmNetwork | None = None) -> Iterator[Step]:
    """Yield the consensus of the models that the network's weights suggest, each that is larger than those before.

    Parameters
    ----------
    task
        What is fitted.
    network
        The file of a UCLM network, or the network; None for the one shipped for this family of problems.

    Yields
    ------
    Step
        A set of points that a model explains, or an empty step after a model that explains no more. Refinement is left
        to the caller. Nothing is drawn at random, and more time does not help. The pass of the network, some 3 us a
        point, is not interrupted.

    Raises
    ------
    TypeError, ValueError
        If `network` has the wrong type, is not a UCLM network, or serves another number of parameters; if it is None
        and there is none for the family of the problem.
    """
    if network is None:
        net = shipped_uclm(task.problem)
    elif isinstance(network, UclmNetwork):
        net = network
    elif isinstance(network, (str, Path)):
        net = load_uclm(Path(network))
    else:
        raise TypeError(f"network must be a file, a UclmNetwork or None, but it is a {type(network).__name__}")
    return _propose(task, net)


def _propose(task: Task, net: UclmNetwork) -> Iterator[Step]:
    weights = net.inlier_weights(task.problem, task.rows, task.limit)
    size = 0
    for phi in suggested_models(task.rows, weights):
        mask = inlier_mask(task.rows, phi, task.limit)
        count = int(np.count_nonzero(mask))
        if count > size:
            size = count
            yield Step(subset=mask)
        else:
            yield Step()


def suggested_models(rows: LinearRows, weights: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    """Yield the models, shape (r,), that `weights`, shape (N,), suggest; the module's text says which."""
    At, b = rows.At, rows.b
    rank, N = At.shape
    vector = null_vector(rows, weights)
    if abs(vector[-1]) > 1e-9:  # else it is no model: the direction at infinity
        yield vector[:-1] / vector[-1]
    scratch, table = np.empty(N), np.empty((rank, rank + 1))
    order = np.argsort(-weights, kind="stable")
    sizes = sorted({min(N, max(rank + 1, round(part * N))) for part in PARTS})
    for size in (0, *sizes):
        if size == 0:
            w = weights**2
        else:
            w = np.zeros(N)
            w[order[:size]] = 1.0
        phi = np.zeros(rank)
        weighted_model(At, b, w, scratch, table, phi)
        if np.isfinite(phi).all():
            yield phi


def null_vector(rows: LinearRows, weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the right singular vector of diag(weights) [A, -b] with the smallest singular value, shape (r + 1,)."""
    weighted = np.vstack([rows.At, -rows.b]) * weights
    largest = float(np.abs(weighted).max(initial=0.0))
    if largest > 0.0:  # of weights near 0, too, the squares below must not vanish
        weighted /= largest
    return np.asarray(np.linalg.eigh(weighted @ weighted.T)[1][:, 0], dtype=np.float64)
