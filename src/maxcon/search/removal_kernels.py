"""Kernels of the descents through the tree: remove basis points, one at a time, until the set is feasible.

A state is a set S at the vertex of its minimax fit; an action removes one of its basis points (paper, section
3.1).

A set with f(S) > limit always has an action: the multipliers of the tight rows sum to 1. The row ``gamma >=
0`` is not among these, since gamma > limit > 0, and artificial rows of free variables have multiplier 0; so
at most d + 1 points share the 1, and one of them has at least 1 / (d + 1). Rounding would have to defeat
that; it counts as FAILED.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import Workspace
from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import FAILED, OK, STOPPED, basis_points
from maxcon.search.vertex_kernels import VertexCopies, load_vertex, remove_point, save_vertex


@kernel
def greedy_kernel(
    ws: Workspace,
    limit: float,
    copies: VertexCopies,
    basis: NDArray[np.int64],
    path: NDArray[np.int64],
    n_removed: int,
    budget: int,
) -> tuple[int, int]:
    """Remove at each state the basis point whose child has the smallest f; of equal ones the lowest index.

    Parameters
    ----------
    ws
        At the vertex of a state; on return at that of the last.
    limit
        Threshold plus slack, in the unit of the rows.
    copies
        Two levels: the parent, and its best child so far.
    basis
        Scratch space, shape (d + 1,).
    path
        Shape (N,): the removed points in order, `n_removed` of them so far.
    budget
        At most so many removals now.

    Returns
    -------
    status, n_removed
        OK: feasible. STOPPED: the budget is spent; call again to go on. FAILED: a fit did not converge.
    """
    n = ws.x.shape[0]
    for _ in range(budget):
        if ws.x[n - 1] <= limit:
            return OK, n_removed
        size = basis_points(ws.C, ws.q, basis)
        if size == 0:
            return FAILED, n_removed
        save_vertex(ws, copies, 0)
        best = -1
        least = np.inf
        for k in range(size):
            point = basis[k]
            if remove_point(ws, point) != OK:
                return FAILED, n_removed
            if best < 0 or ws.x[n - 1] < least:
                best = point
                least = ws.x[n - 1]
                if k + 1 < size:
                    save_vertex(ws, copies, 1)
            if k + 1 < size or best != point:
                ws.gain[point] = 1.0
                ws.cap[point] = 0.0
                load_vertex(ws, copies, 0 if k + 1 < size else 1)
        ws.gain[best] = 0.0
        ws.cap[best] = np.inf
        path[n_removed] = best
        n_removed += 1
    return (OK if ws.x[n - 1] <= limit else STOPPED), n_removed


@kernel
def random_kernel(
    ws: Workspace,
    limit: float,
    uniforms: NDArray[np.float64],
    basis: NDArray[np.int64],
    path: NDArray[np.int64],
    n_removed: int,
    budget: int,
) -> tuple[int, int]:
    """Remove at each state a basis point at random (the paper's random baseline, section 4).

    Parameters and returns are those of `greedy_kernel`; `uniforms`, shape (N,), holds random numbers in [0,
    1), one for each removal.
    """
    n = ws.x.shape[0]
    for _ in range(budget):
        if ws.x[n - 1] <= limit:
            return OK, n_removed
        size = basis_points(ws.C, ws.q, basis)
        if size == 0:
            return FAILED, n_removed
        point = basis[min(int(uniforms[n_removed] * size), size - 1)]
        if remove_point(ws, point) != OK:
            return FAILED, n_removed
        path[n_removed] = point
        n_removed += 1
    return (OK if ws.x[n - 1] <= limit else STOPPED), n_removed
