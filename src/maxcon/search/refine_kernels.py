"""Kernels of local tree refinement (paper, Algorithm 2) and of its swap extension.

They work in place on the arrays of a `Workspace`, which tell what is in the set: a point with gain 1 and cap
0 is in, one with an infinite cap is out and may be added. Any other mode (an enforced point) is kept as it
is. Other compiled searches call `refine_kernel` or `swap_kernel` at any vertex of theirs whose gamma is
within the limit.

Why one pass is enough, where the paper loops until nothing changes: f is monotone, f(S) <= f(T) for S within
T. Let j be rejected at S, f(S + j) > threshold. Every later set T holds S, so f(T + j) >= f(S + j) >
threshold: j would be rejected again, in whatever order and however often it is tried. The end is the same as
the paper's for the same order of the points: a set to which no single point can be added.

What makes it cheap, on top of warm starts:

- The vertex is a witness: with gamma <= limit, all points whose residual at it is within the limit fit one
  model, so they are added together, without asking the simplex.
- The first dual pivot of adding j has a value that can be had without making it, and by duality that value is
  a lower bound on f(S + j). Most points are rejected by it. By the same proof the bound stays true for every
  later set.

The order in which the rest is tried: smallest bound first, then ascending index; so the result depends on
nothing but the set and the data.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import LinearRows, Workspace
from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import (
    BASIS_TOLERANCE,
    FEASIBILITY_TOLERANCE,
    OK,
    basis_points,
)
from maxcon.minimax.simplex import FREE_TOLERANCE
from maxcon.search.trial_kernels import NearRows, allocate_near, gather_near, near_forbid
from maxcon.search.vertex_kernels import (
    VertexCopies,
    add_point,
    allocate_copies,
    load_vertex,
    remove_point,
    save_vertex,
)

#: A row leaves the basis in the bound only if its coefficient is above this: below, it is rounding of a zero,
#: and ignoring it changes the bound by no more than that.
COEFFICIENT_FLOOR = 1e-13


#: Where fewer than one in so many points may still be added, their bounds are computed one by one.
FEW_OF = 4


class RefineScratch(NamedTuple):
    """Scratch space of the refinement kernels, for one problem.

    Attributes
    ----------
    copies
        Two levels: 0 for the point being tried, 1 for the set of which a point is being swapped.
    tried
        Shape (N,), bool: points that are not to be tried (again).
    fresh
        Shape (N,), bool: points added on the word of a witness, until the fit confirms it.
    waiting
        Shape (N,): the points that may still be added.
    bound, leave
        Shape (N,) each: a lower bound on f(S + i), and the basis row without which the rest proves it.
    certificate
        Shape (N, d + 1): points of the set that are infeasible together with i, then -1; for i that are out.
    before
        Shape (N, d + 1): copies of certificates.
    basis
        Shape (d + 1,): the points of a basis.
    kept, dropped, blame
        Shape (N,) each: the set of which a point is being swapped, the points that were dropped from it in
        vain, and in how many certificates each point is.
    near
        Room for trials on a few points.
    """

    copies: VertexCopies
    tried: NDArray[np.bool_]
    fresh: NDArray[np.bool_]
    waiting: NDArray[np.int64]
    bound: NDArray[np.float64]
    leave: NDArray[np.int64]
    certificate: NDArray[np.int64]
    before: NDArray[np.int64]
    basis: NDArray[np.int64]
    kept: NDArray[np.bool_]
    dropped: NDArray[np.bool_]
    blame: NDArray[np.int64]
    near: NearRows


def allocate_refinement(rows: LinearRows) -> RefineScratch:
    """Return scratch space for `refine_kernel` and `swap_kernel` on `rows`."""
    d, N = rows.At.shape
    return RefineScratch(
        allocate_copies(rows, 2),
        np.zeros(N, dtype=np.bool_),
        np.zeros(N, dtype=np.bool_),
        np.zeros(N, dtype=np.int64),
        np.zeros(N),
        np.zeros(N, dtype=np.int64),
        np.full((N, d + 1), -1, dtype=np.int64),
        np.full((N, d + 1), -1, dtype=np.int64),
        np.zeros(d + 1, dtype=np.int64),
        np.zeros(N, dtype=np.bool_),
        np.zeros(N, dtype=np.bool_),
        np.zeros(N, dtype=np.int64),
        allocate_near(rows),
    )


@kernel
def addition_bounds(ws: Workspace, bound: NDArray[np.float64], leave: NDArray[np.int64]) -> None:
    """Write a lower bound on f(S + i) for all points i: the value of the first dual pivot, which is not made.

    The row of point i is g = sum_k w[k] * row k. Entering it with multiplier t changes the multipliers of the
    basis rows to (theirs - t w), a dual solution for as long as these stay >= 0, and its value is gamma + t *
    excess: by duality a lower bound. The basis row that limits t goes to `leave`, -1 for none: the points of
    the other rows, and i, prove the bound on their own.

    All points are done together, one basis row at a time, because that vectorises; most of the cost of one
    point is that of all.
    """
    At, C, q, r = ws.At, ws.C, ws.q, ws.r
    n = q.shape[0]
    N = r.shape[0]
    w = ws.work[0, :N]
    gamma = ws.x[n - 1]
    for i in range(N):
        bound[i] = np.inf  # holds t at first
        leave[i] = -1
    for k in range(n):
        multiplier = max(C[n - 1, k], 0.0)
        for i in range(N):
            w[i] = 0.0
        for j in range(n - 1):
            a = At[j]
            c = C[j, k]
            for i in range(N):
                w[i] += c * a[i]
        if q[k] < 0 and q[k] > -n:  # a variable that nothing holds yet takes up the excess
            for i in range(N):
                if abs(w[i]) > FREE_TOLERANCE:
                    bound[i] = 0.0
                    leave[i] = -1
            continue
        for i in range(N):
            coefficient = C[n - 1, k] + (w[i] if r[i] >= 0.0 else -w[i])
            t = multiplier / coefficient if coefficient > COEFFICIENT_FLOOR else np.inf
            if t < bound[i]:
                bound[i] = t
                leave[i] = k
    for i in range(N):
        t = bound[i] if bound[i] < np.inf else 0.0
        bound[i] = gamma + t * max(abs(r[i]) - gamma, 0.0)


@kernel
def addition_bounds_of(
    ws: Workspace, points: NDArray[np.int64], count: int, bound: NDArray[np.float64], leave: NDArray[np.int64]
) -> None:
    """Do what `addition_bounds` does for ``points[:count]`` only, one point at a time: for when they are few."""
    At, C, q, r = ws.At, ws.C, ws.q, ws.r
    n = q.shape[0]
    gamma = ws.x[n - 1]
    for m in range(count):
        i = points[m]
        least, row = np.inf, -1
        free = False
        for k in range(n):
            w = 0.0
            for j in range(n - 1):
                w += C[j, k] * At[j, i]
            if q[k] < 0 and q[k] > -n:
                if abs(w) > FREE_TOLERANCE:
                    least, row, free = 0.0, -1, True
                continue
            coefficient = C[n - 1, k] + (w if r[i] >= 0.0 else -w)
            t = max(C[n - 1, k], 0.0) / coefficient if coefficient > COEFFICIENT_FLOOR else np.inf
            if not free and t < least:
                least, row = t, k
        bound[i] = gamma + (least if least < np.inf else 0.0) * max(abs(r[i]) - gamma, 0.0)
        leave[i] = row


@kernel
def _rounding(x: NDArray[np.float64]) -> float:
    """Return by how much the simplex takes a row to be kept; see `FEASIBILITY_TOLERANCE`."""
    size = 1.0
    for j in range(x.shape[0]):
        size += abs(x[j])
    return FEASIBILITY_TOLERANCE * size


@kernel
def _add_witnessed(ws: Workspace, limit: float, scratch: RefineScratch) -> int:
    """Add all points that the vertex itself keeps within the limit, and re-fit; return how many they were."""
    r, gain, cap, tried, fresh = ws.r, ws.gain, ws.cap, scratch.tried, scratch.fresh
    gamma = ws.x[ws.x.shape[0] - 1]
    safe = limit - 2.0 * _rounding(ws.x)  # at the very edge the simplex is asked, point by point
    count = 0
    farthest = -1
    for i in range(r.shape[0]):
        fresh[i] = cap[i] == np.inf and not tried[i] and abs(r[i]) <= safe
        if fresh[i]:
            count += 1
            if farthest < 0 or abs(r[i]) > abs(r[farthest]):
                farthest = i
            gain[i] = 1.0
            cap[i] = 0.0
    if count == 0 or abs(ws.r[farthest]) <= gamma:
        return count
    save_vertex(ws, scratch.copies, 0)
    if add_point(ws, farthest, np.inf) == OK and ws.x[ws.x.shape[0] - 1] <= limit:
        return count
    # Only a vertex on which rounding has gone astray gets here: believe none of it.
    load_vertex(ws, scratch.copies, 0)
    for i in range(ws.r.shape[0]):
        if scratch.fresh[i]:
            ws.gain[i] = 0.0
            ws.cap[i] = np.inf
    return 0


@kernel
def _write_certificate(
    C: NDArray[np.float64], q: NDArray[np.int64], leave: int, point: int, certificate: NDArray[np.int64]
) -> None:
    """Write into ``certificate[point]`` the points of the basis rows that prove `point` infeasible, then -1.

    If basis row `leave` >= 0 made room for it in the pivot that was not made, these are all others, since
    even a multiplier of 0 may have grown in it; with -1, at the vertex that proves it, those with a positive
    multiplier.
    """
    n = q.shape[0]
    size = 0
    for k in range(n):
        if q[k] < 0 or k == leave or q[k] >> 1 == point:
            continue
        if leave >= 0 or C[n - 1, k] > BASIS_TOLERANCE:
            certificate[point, size] = q[k] >> 1
            size += 1
    for k in range(size, n):
        certificate[point, k] = -1


@kernel
def _list_waiting(ws: Workspace, limit: float, scratch: RefineScratch) -> int:
    """Write the points that may still be added at this vertex into ``scratch.waiting``; return how many there are.

    What the bounds rule out is marked as tried, with its certificate.
    """
    cap, tried, waiting = ws.cap, scratch.tried, scratch.waiting
    bound, leave, certificate = scratch.bound, scratch.leave, scratch.certificate
    C, q = ws.C, ws.q
    N = tried.shape[0]
    margin = limit + _rounding(ws.x)
    m = 0
    for i in range(N):
        if not tried[i] and cap[i] == np.inf:
            waiting[m] = i
            m += 1
    if FEW_OF * m < N:
        addition_bounds_of(ws, waiting, m, bound, leave)
    else:
        addition_bounds(ws, bound, leave)
    count = 0
    for k in range(m):
        i = waiting[k]
        if bound[i] > margin:
            tried[i] = True
            _write_certificate(C, q, leave[i], i, certificate)
        else:
            waiting[count] = i
            count += 1
    return count


@kernel
def _most_promising(waiting: NDArray[np.int64], count: int, bound: NDArray[np.float64]) -> int:
    """Return which of ``waiting[:count]`` has the smallest bound on f(S + i), of equal ones the first point."""
    best = 0
    for k in range(1, count):
        i, other = waiting[k], waiting[best]
        if bound[i] < bound[other] or (bound[i] == bound[other] and i < other):
            best = k
    return best


@kernel
def refine_kernel(ws: Workspace, limit: float, scratch: RefineScratch) -> int:
    """Add points until none can be added (paper, Algorithm 2); return how many were.

    Parameters
    ----------
    ws
        At the vertex of its set, gamma <= limit. On return at the vertex of the larger set, gamma <= limit.
    limit
        Threshold plus slack, in the unit of the rows.
    scratch
        From `allocate_refinement`. Points with `scratch.tried` set are left out; false everywhere tries all
        that have an infinite cap. On return it is set for every point that is out, and for those that were
        tried `scratch.certificate` says why.

    Notes
    -----
    A point whose fit fails for rounding is left out, which is always sound.
    """
    return refine_by(ws, limit, scratch, 1, ws.r.shape[0])


@kernel
def refine_by(ws: Workspace, limit: float, scratch: RefineScratch, least: int, tries: int) -> int:
    """Do what `refine_kernel` does, but give up as soon as fewer than `least` points can be added in all.

    And, while more than one of these is missing, after `tries` points in a row that could not be added.
    """
    n = ws.x.shape[0]
    waiting, near, certificate = scratch.waiting, scratch.near, scratch.certificate
    added = _add_witnessed(ws, limit, scratch)
    moved = True
    count = m = failed = 0
    while True:
        if moved:
            count = _list_waiting(ws, limit, scratch)
            failed = 0
        if count < max(least - added, 1) or (failed >= tries and least - added > 1):
            return added
        if moved:
            m = gather_near(ws, near)
        best = _most_promising(waiting, count, scratch.bound)
        point = waiting[best]
        count -= 1
        waiting[best] = waiting[count]
        scratch.tried[point] = True
        if m > 0 and near_forbid(ws, limit, near, m, point):
            _write_certificate(near.C, near.q, -1, point, certificate)
            moved = False
            failed += 1
            continue
        save_vertex(ws, scratch.copies, 0)
        moved = add_point(ws, point, limit) == OK and ws.x[n - 1] <= limit
        if moved:
            added += 1 + _add_witnessed(ws, limit, scratch)
        else:
            failed += 1
            _write_certificate(ws.C, ws.q, -1, point, certificate)
            ws.gain[point] = 0.0
            ws.cap[point] = np.inf
            load_vertex(ws, scratch.copies, 0)


@kernel
def swap_kernel(ws: Workspace, limit: float, scratch: RefineScratch) -> int:
    """Refine; then drop a basis point where at least two others fit in its place, until none is worth it.

    Parameters, and what is left on return, are those of `refine_kernel`, but `scratch.tried` is cleared here.
    Returns how many points the set has more; each swap gains at least one, so there are at most N.

    Notes
    -----
    Every point j that is out has a certificate: points of S that are infeasible together with j. Dropping a
    point p of S helps only those j whose certificates hold p, so only a p in at least two certificates is
    worth trying, and only these j are tried in its place. (Dropping points of certificates that are not in
    the basis B(S) was tried: it found nothing more on the paper's synthetic data and took half as long
    again.)

    The dropped p is not tried again for its own swap, nor need it be: S takes no further point, so any set
    with p, the rest of S and a new point j holds an infeasible S + j. The final set is therefore still
    maximal.
    """
    return swap_by(ws, limit, scratch, ws.r.shape[0])


@kernel
def swap_by(ws: Workspace, limit: float, scratch: RefineScratch, tries: int) -> int:
    """Do what `swap_kernel` does, but give up on a dropped point after `tries` others in a row that do not fit."""
    N = ws.r.shape[0]
    for i in range(N):
        scratch.tried[i] = False
        scratch.dropped[i] = False
    gained = refine_kernel(ws, limit, scratch)
    changed = True
    while True:
        if changed:
            save_vertex(ws, scratch.copies, 1)
            for i in range(N):
                scratch.kept[i] = ws.gain[i] == 1.0
        point = _most_blamed(ws, scratch)
        if point < 0:
            return gained
        scratch.dropped[point] = True
        _choose_substitutes(ws, scratch, point)
        more = 0
        if remove_point(ws, point) == OK and ws.x[ws.x.shape[0] - 1] <= limit:
            more = refine_by(ws, limit, scratch, 2, tries) - 1
        changed = more > 0
        if changed:
            gained += more
            _accept_swap(ws, scratch, point)
        else:
            _undo_swap(ws, scratch)


@kernel
def _most_blamed(ws: Workspace, scratch: RefineScratch) -> int:
    """Return the basis point in most certificates, at least two, that was not dropped before; or -1."""
    cap, blame, certificate = ws.cap, scratch.blame, scratch.certificate
    for i in range(cap.shape[0]):
        blame[i] = 0
    for i in range(cap.shape[0]):
        if cap[i] == np.inf:
            for k in range(certificate.shape[1]):
                if certificate[i, k] >= 0:
                    blame[certificate[i, k]] += 1
    size = basis_points(ws.C, ws.q, scratch.basis)
    best = -1
    most = 1
    for k in range(size):
        point = scratch.basis[k]
        if scratch.blame[point] > most and scratch.kept[point] and not scratch.dropped[point]:
            best = point
            most = scratch.blame[point]
    return best


@kernel
def _choose_substitutes(ws: Workspace, scratch: RefineScratch, point: int) -> None:
    """Let only the points with `point` in their certificate be tried; keep copies of these certificates."""
    cap, tried, certificate, before = ws.cap, scratch.tried, scratch.certificate, scratch.before
    n = certificate.shape[1]
    for i in range(cap.shape[0]):
        tried[i] = True
        if cap[i] == np.inf:
            for k in range(n):
                if certificate[i, k] == point:
                    tried[i] = False
            if not tried[i]:
                for k in range(n):
                    before[i, k] = certificate[i, k]


@kernel
def _accept_swap(ws: Workspace, scratch: RefineScratch, point: int) -> None:
    """Give `point`, which is out now, the certificate of a point that has come in, the two exchanged."""
    gain, kept, dropped, certificate, before = (
        ws.gain,
        scratch.kept,
        scratch.dropped,
        scratch.certificate,
        scratch.before,
    )
    for i in range(gain.shape[0]):
        dropped[i] = False
        if gain[i] == 1.0 and not kept[i]:
            for k in range(certificate.shape[1]):
                certificate[point, k] = i if before[i, k] == point else before[i, k]


@kernel
def _undo_swap(ws: Workspace, scratch: RefineScratch) -> None:
    """Go back to the set before; of the new certificates keep those that hold for it, too."""
    load_vertex(ws, scratch.copies, 1)
    gain, cap, kept, certificate, before = ws.gain, ws.cap, scratch.kept, scratch.certificate, scratch.before
    n = certificate.shape[1]
    for i in range(gain.shape[0]):
        stale = False
        if kept[i]:
            gain[i] = 1.0
            cap[i] = 0.0
        elif gain[i] == 1.0:
            gain[i] = 0.0
            cap[i] = np.inf
            stale = True
        elif cap[i] == np.inf:
            for k in range(n):
                point = certificate[i, k]
                if point >= 0 and not (kept[point] or (gain[point] == 0.0 and cap[point] < np.inf)):
                    stale = True
                    break
        if stale:
            for k in range(n):
                certificate[i, k] = before[i, k]
