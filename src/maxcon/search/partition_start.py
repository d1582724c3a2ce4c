"""A first incumbent for the partition search where the caller has none: continuation, samples, peeling.

Good enough to deal points into groups by; the search improves it where a model it meets is better.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import LinearRows, allocate
from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import BASIS_TOLERANCE, OK, cold_fit, refit_after_removal
from maxcon.minimax.workspace import Workspace


@kernel
def _peel(w: Workspace, rank: NDArray[np.float64], limit: float) -> bool:
    """Remove the basis point with the largest rank until the rest is feasible; False if the arithmetic fails."""
    n = w.x.shape[0]
    status = cold_fit(w.At, w.b, w.gain, w.cap, w.C, w.x, w.q, w.r, w.work, w.table)
    for _ in range(w.b.shape[0]):
        if status != OK:
            return False
        if w.x[n - 1] <= limit:
            return True
        worst, worst_rank = -1, -1.0
        for k in range(n):
            if w.q[k] >= 0 and w.C[n - 1, k] > BASIS_TOLERANCE and rank[w.q[k] >> 1] > worst_rank:
                worst = w.q[k] >> 1
                worst_rank = rank[worst]
        if worst < 0:
            return False
        status = refit_after_removal(w.At, w.b, w.gain, w.cap, w.C, w.x, w.q, w.r, w.work, w.table, worst)
    return False


def _residuals(rows: LinearRows, models: NDArray[np.float64]) -> NDArray[np.float64]:
    residuals: NDArray[np.float64] = np.abs(rows.b - models @ rows.At)
    return residuals


def _continuation(rows: LinearRows, limit: float, n_steps: int = 30) -> NDArray[np.float64]:
    """Return the model of a Geman-McClure fit whose scale falls to the limit (graduated non-convexity)."""
    d = rows.At.shape[0]
    phi = np.zeros(d)
    residuals = np.abs(rows.b)
    scale = max(float(residuals.max()), limit)
    shrink = (limit / scale) ** (1.0 / max(n_steps - 10, 1))
    for _ in range(n_steps):
        weights = 1.0 / (1.0 + (residuals / scale) ** 2) ** 2
        weighted = rows.At * weights
        normal = weighted @ rows.At.T + 1e-12 * np.trace(weighted @ rows.At.T) * np.eye(d)
        phi = np.linalg.solve(normal, weighted @ rows.b) if d else phi
        residuals = _residuals(rows, phi)
        scale = max(scale * shrink, limit)
    return phi


def _sampled(rows: LinearRows, limit: float, n_samples: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return models through random d-subsets, the best few by truncated residuals, shape (<= 5, d)."""
    d, N = rows.At.shape
    samples = rng.integers(0, N, (n_samples, d))
    matrices = np.ascontiguousarray(rows.At.T[samples])
    regular = np.abs(np.linalg.det(matrices)) > 1e-9
    models = np.linalg.solve(matrices[regular], rows.b[samples[regular]][:, :, None])[:, :, 0]
    scores = np.minimum(_residuals(rows, models), 2 * limit).sum(axis=1)
    return models[np.argsort(scores, kind="stable")[:5]]


def peeled_start(rows: LinearRows, limit: float, rng: np.random.Generator, n_samples: int = 300) -> NDArray[np.bool_]:
    """Return a feasible set, bool (N,): the best that peeling finds from a continuation and a few samples."""
    d, N = rows.At.shape
    models = np.zeros((1, d))
    if d:
        models = np.vstack([models, _continuation(rows, limit), _sampled(rows, limit, n_samples, rng)])
    counts = (_residuals(rows, models) <= limit).sum(axis=1)
    best = np.zeros(N, dtype=np.bool_)
    for start in np.argsort(-counts, kind="stable")[:3]:
        rank = _residuals(rows, models[start])
        size = 0
        while True:
            workspace = allocate(rows)
            if not _peel(workspace, rank, limit):
                break
            rank = _residuals(rows, workspace.x[:d])
            inside = rank <= limit
            if np.count_nonzero(inside) > best.sum():
                best = inside
            if np.count_nonzero(inside) <= size:
                break
            size = int(np.count_nonzero(inside))
    return best
