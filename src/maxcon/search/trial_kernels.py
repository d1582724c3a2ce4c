"""May this point be added? Asked of the points of S near the vertex's edge first, copied side by side.

Most points that are tried cannot be added, and what stands against one is a few points of S with large residuals.
If S's points with such residuals are infeasible together with it, so is S; only where they are not must the fit of
all of S be asked. The copies are a fraction of S, so that a trial costs that fraction.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import LinearRows, Workspace
from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import INFEASIBLE, STOPPED, dual_simplex

#: A point of S is near where its residual is above this part of gamma. Between 0.4 and 0.8 it makes no difference.
NEAR = 0.6


class NearRows(NamedTuple):
    """Room for the near points of S, and for the one that is tried.

    Attributes
    ----------
    points, place
        Shapes (N,): ``points[:m]`` are the near points, ``place[points[k]] == k``.
    At, b, gain, cap, r
        Shapes (d N,) and (N,): their rows, in column m that of the point that is tried.
    C, x, q
        Shapes (d + 1, d + 1), (d + 1,), (d + 1,): the vertex of the trial; afterwards `q` names points of the problem.
    """

    points: NDArray[np.int64]
    place: NDArray[np.int64]
    At: NDArray[np.float64]
    b: NDArray[np.float64]
    gain: NDArray[np.float64]
    cap: NDArray[np.float64]
    r: NDArray[np.float64]
    C: NDArray[np.float64]
    x: NDArray[np.float64]
    q: NDArray[np.int64]


def allocate_near(rows: LinearRows) -> NearRows:
    """Return room for the trials on `rows`."""
    d, N = rows.At.shape
    n = d + 1
    return NearRows(
        np.zeros(N, dtype=np.int64),
        np.zeros(N, dtype=np.int64),
        np.zeros(d * N),
        np.zeros(N),
        np.zeros(N),
        np.zeros(N),
        np.zeros(N),
        np.zeros((n, n)),
        np.zeros(n),
        np.zeros(n, dtype=np.int64),
    )


@kernel
def gather_near(ws: Workspace, near: NearRows) -> int:
    """Copy the rows of the near points of the set in `ws`, at its vertex; return how many.

    Returns 0, for "ask all of S", where there is no room for one more, or a tight row is not among them.
    """
    At, b, gain, cap, r, q = ws.At, ws.b, ws.gain, ws.cap, ws.r, ws.q
    points, place = near.points, near.place
    d, N = At.shape
    edge = NEAR * ws.x[d]
    m = 0
    for i in range(N):
        if cap[i] < np.inf and abs(r[i]) >= edge:
            points[m] = i
            place[i] = m
            m += 1
    if m == N:
        return 0
    for k in range(d + 1):
        if q[k] >= 0:
            i = q[k] >> 1
            if not (cap[i] < np.inf and abs(r[i]) >= edge):
                return 0
    rows = near.At[: d * (m + 1)].reshape(d, m + 1)
    for j in range(d):
        a, target = At[j], rows[j]
        for k in range(m):
            target[k] = a[points[k]]
    for k in range(m):
        i = points[k]
        near.b[k] = b[i]
        near.gain[k] = gain[i]
        near.cap[k] = cap[i]
    return m


@kernel
def near_forbid(ws: Workspace, limit: float, near: NearRows, m: int, point: int) -> bool:
    """Whether ``near.points[:m]`` and `point` together have a gamma above `limit`; `ws` is left as it is.

    If so, ``near.C`` and ``near.q`` hold the vertex that proves it.
    """
    d = ws.At.shape[0]
    n = d + 1
    C, x, q = near.C, near.x, near.q
    rows = near.At[: d * (m + 1)].reshape(d, m + 1)
    for j in range(d):
        rows[j, m] = ws.At[j, point]
    near.b[m], near.gain[m], near.cap[m] = ws.b[point], 1.0, 0.0
    for j in range(n):
        for k in range(n):
            C[j, k] = ws.C[j, k]
        x[j] = ws.x[j]
        name = ws.q[j]
        q[j] = name if name < 0 else 2 * near.place[name >> 1] + (name & 1)
    end = m + 1
    status = dual_simplex(
        rows, near.b[:end], near.gain[:end], near.cap[:end], C, x, q, near.r[:end], ws.work, ws.table, limit, False
    )
    if status not in (STOPPED, INFEASIBLE):
        return False
    for k in range(n):
        if q[k] >= 0:
            place = q[k] >> 1
            q[k] = 2 * (point if place == m else near.points[place]) + (q[k] & 1)
    return True
