"""Kernels to step from a vertex of the engine and back: save the vertex, re-fit, look, and load it again."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import LinearRows, Workspace
from maxcon.minimax.jit import kernel
from maxcon.minimax.refits import refit_after_addition, refit_after_removal


class VertexCopies(NamedTuple):
    """Room for `levels` copies of a vertex, to go back to.

    Attributes
    ----------
    C, x, q, r
        As in `Workspace`, with a leading dimension for the level.
    """

    C: NDArray[np.float64]
    x: NDArray[np.float64]
    q: NDArray[np.int64]
    r: NDArray[np.float64]


def allocate_copies(rows: LinearRows, levels: int) -> VertexCopies:
    """Return room for `levels` vertices of `rows`."""
    d, N = rows.At.shape
    n = d + 1
    return VertexCopies(
        np.empty((levels, n, n)),
        np.empty((levels, n)),
        np.empty((levels, n), dtype=np.int64),
        np.empty((levels, N)),
    )


@kernel
def save_vertex(ws: Workspace, copies: VertexCopies, level: int) -> None:
    """Copy the vertex of `ws` to a level of `copies`; the modes of the points are not part of it."""
    n = ws.x.shape[0]
    for j in range(n):
        for k in range(n):
            copies.C[level, j, k] = ws.C[j, k]
        copies.x[level, j] = ws.x[j]
        copies.q[level, j] = ws.q[j]
    for i in range(ws.r.shape[0]):
        copies.r[level, i] = ws.r[i]


@kernel
def load_vertex(ws: Workspace, copies: VertexCopies, level: int) -> None:
    """Put a saved vertex back; the caller sets the modes to those it was saved with."""
    n = ws.x.shape[0]
    for j in range(n):
        for k in range(n):
            ws.C[j, k] = copies.C[level, j, k]
        ws.x[j] = copies.x[level, j]
        ws.q[j] = copies.q[level, j]
    for i in range(ws.r.shape[0]):
        ws.r[i] = copies.r[level, i]


@kernel
def add_point(ws: Workspace, point: int, stop_above: float) -> int:
    """`refit_after_addition` on a workspace."""
    return refit_after_addition(
        ws.At, ws.b, ws.gain, ws.cap, ws.C, ws.x, ws.q, ws.r, ws.work, ws.table, point, stop_above
    )


@kernel
def remove_point(ws: Workspace, point: int) -> int:
    """`refit_after_removal` on a workspace."""
    return refit_after_removal(ws.At, ws.b, ws.gain, ws.cap, ws.C, ws.x, ws.q, ws.r, ws.work, ws.table, point)
