"""Kernels of the peel: remove basis points, worst under the incumbent first, until feasible; then add back.

They work on the arrays of a `Workspace` and on an `Incumbent`, and can be cut short after any number of
refits and called again to go on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import LinearRows, Workspace
from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import BASIS_TOLERANCE, FAILED, OK, cold_fit, compute_residuals
from maxcon.search.model_kernels import count_within
from maxcon.search.refine_kernels import RefineScratch, allocate_refinement, refine_kernel
from maxcon.search.vertex_kernels import remove_point

UNFINISHED = 4  # as many refits were made as were allowed

# What comes next, in ``progress[0]``
_START, _PEEL = 0, 1


class Incumbent(NamedTuple):
    """The best set so far, how far its round has come, and scratch space.

    Attributes
    ----------
    rho
        Shape (N,): the sizes of the residuals of the incumbent model.
    progress
        Shape (2,): what comes next, and the incumbent's consensus.
    scratch
        What `refine_kernel` needs.
    """

    rho: NDArray[np.float64]
    progress: NDArray[np.int64]
    scratch: RefineScratch


def allocate_incumbent(rows: LinearRows) -> Incumbent:
    """Return an incumbent without inliers, to be set by `install`."""
    return Incumbent(np.zeros(rows.b.shape[0]), np.zeros(2, dtype=np.int64), allocate_refinement(rows))


@kernel
def install(ws: Workspace, incumbent: Incumbent, limit: float) -> bool:
    """Make the model at the vertex the incumbent if it has more inliers than the present one."""
    r, rho, progress = ws.r, incumbent.rho, incumbent.progress
    compute_residuals(ws.At, ws.b, ws.x, r)
    count = count_within(r, limit)
    if count <= progress[1]:
        return False
    progress[1] = count
    for i in range(r.shape[0]):
        rho[i] = abs(r[i])
    return True


@kernel
def include_within(ws: Workspace, rho: NDArray[np.float64], reach: float) -> int:
    """Fit, from cold, the points whose incumbent residual is at most `reach`, and no others."""
    gain, cap = ws.gain, ws.cap
    for i in range(rho.shape[0]):
        inside = rho[i] <= reach
        gain[i] = 1.0 if inside else 0.0
        cap[i] = 0.0 if inside else np.inf
    return cold_fit(*ws)


@kernel
def peel_down(ws: Workspace, rho: NDArray[np.float64], limit: float, most: int) -> tuple[int, int]:
    """Remove the basis point with the largest incumbent residual until gamma <= limit, at most `most` times.

    Returns OK, FAILED or UNFINISHED, and how many points were removed. Every basis of an infeasible set holds
    a point that is no inlier of the incumbent: none but such points are removed, and all inliers of the
    incumbent remain.
    """
    C, x, q = ws.C, ws.x, ws.q
    n = x.shape[0]
    for removed in range(most):
        if x[n - 1] <= limit:
            return OK, removed
        point = -1
        for k in range(n):
            held = q[k] >= 0 and C[n - 1, k] > BASIS_TOLERANCE
            if held and (point < 0 or rho[q[k] >> 1] > rho[point]):
                point = q[k] >> 1
        if point < 0 or remove_point(ws, point) != OK:
            return FAILED, removed
    return (OK if x[n - 1] <= limit else UNFINISHED), most


@kernel
def peel_rounds(ws: Workspace, incumbent: Incumbent, limit: float, reach: float, most: int) -> int:
    """Peel until the incumbent stops improving: OK. After about `most` refits: UNFINISHED, call again.

    A round starts from all points with incumbent residuals up to ``reach * limit``, peels down, and makes the
    fit reached the incumbent if it has more inliers. If not, the points left out are added back where they
    fit; if that does not help either, the rounds are over. FAILED where a refit failed: the incumbent stays
    what it is.
    """
    progress, rho, scratch = incumbent.progress, incumbent.rho, incumbent.scratch
    left = most
    while True:
        if progress[0] == _START:
            if include_within(ws, rho, reach * limit) != OK:
                return FAILED
            progress[0] = _PEEL
            left -= 1
        status, removed = peel_down(ws, rho, limit, max(left, 1))
        left -= removed
        if status != OK:
            return status
        if not install(ws, incumbent, limit):
            for i in range(rho.shape[0]):
                scratch.tried[i] = False
            refine_kernel(ws, limit, scratch)
            if not install(ws, incumbent, limit):
                return OK
        progress[0] = _START
        if left <= 0:
            return UNFINISHED
