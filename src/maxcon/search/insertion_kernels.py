"""Kernels of the A* heuristic: a bound on the outliers of a set by minimax fits that lose and regain points.

The heuristic is that of Chin, Purkait, Eriksson and Suter, "Efficient globally optimal consensus maximisation
with tree search" (CVPR 2015; the one with re-insertion). Remove the basis of the set, again and again, until
the rest fits; then put the removed points back one by one, and wherever that spoils the fit, count 1 and
remove the basis that proves it. The bases counted are infeasible and share no point, and each holds at least
one outlier of any model: so the count is admissible, whatever happened before. As in the code that its
authors and Cai et al. published, a removed point whose residual falls within f on the way is put back at
once.

The same on a set of which some points are *enforced*, that is, known inliers, bounds what the set costs under
that condition: the bases then are those of the constrained fits, and their enforced points are not counted
as used.

Where it is known which points are probably outliers, these are removed first of all, and everything is put back by
rising doubt: each basis counted then uses up one probable outlier, where a basis of all points can use up d + 1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import LinearRows, Workspace
from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import BASIS_TOLERANCE, OK, cold_fit, compute_residuals, refine_vertex
from maxcon.minimax.simplex import leaving_row, pivot, row_to_relax, start

#: Two values tie unless they are further apart than this, relative to the larger, plus this times the size of
#: the vertex: some ten thousand times what rounding can do.
TIE, TIE_AT_VERTEX = 1e-9, 1e-12

#: The share of a tie by which a residual may exceed what it is compared with, for rounding.
LEEWAY = 0.01

#: Places in `Insertion.counts`.
FEWEST, FITS = 0, 1


class Insertion(NamedTuple):
    """The best model met, and scratch space.

    Attributes
    ----------
    inliers
        Shape (N,), bool: the largest feasible set met.
    rho
        Shape (N,): the sizes of the residuals of its model.
    counts
        Shape (2,): how many points are outside that set (N before the first), and how many fits were made.
    out, basis, model
        Shapes (N,), (d + 1,) and (d + 1,): scratch.
    doubt
        Shape (N,): how probable it is that the point is an outlier, from 0 to 1; shape (0,): nothing is believed.
    """

    inliers: NDArray[np.bool_]
    rho: NDArray[np.float64]
    counts: NDArray[np.int64]
    out: NDArray[np.int64]
    basis: NDArray[np.int64]
    model: NDArray[np.float64]
    doubt: NDArray[np.float64]


def allocate_insertion(rows: LinearRows, believing: bool = False) -> Insertion:
    """Return what the kernels need, with no set met yet; `believing`: room for doubts, all of them 0."""
    d, N = rows.At.shape
    return Insertion(
        np.zeros(N, dtype=np.bool_),
        np.abs(rows.b),
        np.array([N, 0], dtype=np.int64),
        np.zeros(N, dtype=np.int64),
        np.zeros(d + 1, dtype=np.int64),
        np.zeros(d + 1),
        np.zeros(N if believing else 0),
    )


@kernel
def tie_width(x: NDArray[np.float64]) -> float:
    """Return how far from gamma a residual or another gamma must be to differ from it for certain."""
    size = 1.0
    for j in range(x.shape[0]):
        size += abs(x[j])
    return float(TIE * abs(x[x.shape[0] - 1]) + TIE_AT_VERTEX * size)


@kernel
def note_model(ws: Workspace, limit: float, scratch: Insertion) -> None:
    """Keep the model at the vertex if it has more inliers than the best one so far.

    Where gamma is within the limit, the points of the fit are inliers, whatever rounding says of the last bit.
    """
    gain, r, counts = ws.gain, ws.r, scratch.counts
    N = r.shape[0]
    feasible = ws.x[ws.x.shape[0] - 1] <= limit
    outside = 0
    for i in range(N):
        outside += not (abs(r[i]) <= limit or (feasible and gain[i] == 1.0))
    if outside >= counts[FEWEST]:
        return
    counts[FEWEST] = outside
    for i in range(N):
        scratch.rho[i] = abs(r[i])
        scratch.inliers[i] = abs(r[i]) <= limit or (feasible and gain[i] == 1.0)


@kernel
def free_basis(ws: Workspace, basis: NDArray[np.int64]) -> int:
    """Write the basis points that are not enforced into `basis`, ascending; return how many there are."""
    C, q, gain = ws.C, ws.q, ws.gain
    n = q.shape[0]
    size = 0
    for k in range(n):
        if q[k] < 0 or C[n - 1, k] <= BASIS_TOLERANCE or gain[q[k] >> 1] != 1.0:
            continue
        point = q[k] >> 1
        known = False  # both sides of one point may be tight
        place = size
        for m in range(size):
            known = known or basis[m] == point
            if basis[m] > point:
                place = min(place, m)
        if known:
            continue
        for m in range(size, place, -1):
            basis[m] = basis[m - 1]
        basis[place] = point
        size += 1
    return size


@kernel
def _most_above(
    r: NDArray[np.float64],
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    limit: float,
    excess: NDArray[np.float64],
) -> int:
    """Return the point whose residual is above the limit by the most, or -1; a removed point never is."""
    N = r.shape[0]
    for i in range(N):
        excess[i] = abs(r[i]) - (gain[i] * limit + cap[i])
    bits = excess.view(np.int64)  # positive floats are in the order of their bits, and this loop vectorises
    most = np.int64(0)
    for i in range(N):
        most = max(most, bits[i])
    if most > 0:
        for i in range(N):
            if bits[i] == most:
                return i
    return -1


@kernel
def _enter(
    At: NDArray[np.float64],
    C: NDArray[np.float64],
    x: NDArray[np.float64],
    q: NDArray[np.int64],
    w: NDArray[np.float64],
    point: int,
    residual: float,
    gain: float,
    cap: float,
) -> bool:
    """Make the row of a violated point tight, by one dual pivot; False where there is none."""
    n = x.shape[0]
    sign = -1.0 if residual < 0.0 else 1.0
    for k in range(n):
        w[k] = gain * C[n - 1, k]
    for j in range(n - 1):
        a = sign * At[j, point]
        for k in range(n):
            w[k] += a * C[j, k]
    leave = leaving_row(C, q, w, False)
    if leave < 0:
        return False
    step = abs(residual) - (gain * x[n - 1] + cap)
    pivot(C, w, leave)
    for j in range(n):
        x[j] += step * C[j, leave]
    q[leave] = 2 * point + (1 if sign < 0.0 else 0)
    return True


@kernel
def _fit_within(ws: Workspace, limit: float) -> int:
    """Find a model of the set within the limit or, where there is none, the fit that proves it.

    Parameters
    ----------
    ws
        At any vertex with multipliers of the right sign.
    limit
        Threshold plus slack, in the unit of the rows.

    Returns
    -------
    OK: with gamma <= limit, all residuals are within the limit (but the fit may be better), else the vertex is
    that of the minimax fit. FAILED where rounding prevents both.

    Notes
    -----
    gamma never falls on the way. Pivots look for points above the limit, not above gamma, so that they end
    as soon as a model is found.
    """
    At, b, gain, cap, C, x, q, r = ws.At, ws.b, ws.gain, ws.cap, ws.C, ws.x, ws.q, ws.r
    n = x.shape[0]
    w = ws.table[0]
    excess = ws.work[0, : r.shape[0]]
    for count in range(10 * n + 100):
        compute_residuals(At, b, x, r)
        gamma = x[n - 1]
        point = _most_above(r, gain, cap, max(gamma, limit), excess)
        if point < 0 or excess[point] <= LEEWAY * tie_width(x):
            if gamma <= limit:
                return OK
            if not refine_vertex(At, b, gain, cap, C, x, q, ws.table, False):
                break
            if row_to_relax(C, q, False) >= 0 or x[n - 1] <= limit:
                break
            return OK
        if count % 30 == 29 and not refine_vertex(At, b, gain, cap, C, x, q, ws.table, True):
            break
        if not _enter(At, C, x, q, w, point, r[point], gain[point], cap[point]):
            break
    return cold_fit(*ws)


@kernel
def _begin_at(ws: Workspace, model: NDArray[np.float64]) -> None:
    """Put the all-artificial vertex at a model: gamma is 0, and no point holds it, so that any may be removed."""
    start(ws.C, ws.x, ws.q)
    for j in range(model.shape[0] - 1):
        ws.x[j] = model[j]
    compute_residuals(ws.At, ws.b, ws.x, ws.r)


@kernel
def take_out(ws: Workspace, basis: NDArray[np.int64], size: int) -> None:
    """Remove the points ``basis[:size]``; the vertex is none then."""
    for k in range(size):
        ws.gain[basis[k]] = 0.0
        ws.cap[basis[k]] = np.inf


@kernel
def _remove_doubtful(ws: Workspace, limit: float, scratch: Insertion) -> int:
    """Remove the points that are probably outliers; return how many are in `out` then, -1 if the fit failed."""
    gain, out, doubt = ws.gain, scratch.out, scratch.doubt
    n_out = 0
    for i in range(doubt.shape[0]):
        if doubt[i] > 0.5 and gain[i] == 1.0:
            out[n_out] = i
            n_out += 1
    if n_out == 0:
        return 0
    take_out(ws, out, n_out)
    for j in range(ws.x.shape[0]):
        scratch.model[j] = ws.x[j]
    _begin_at(ws, scratch.model)
    scratch.counts[FITS] += 1
    return n_out if _fit_within(ws, limit) == OK else -1


@kernel
def _sort_by_doubt(out: NDArray[np.int64], n_out: int, doubt: NDArray[np.float64]) -> None:
    for m in range(1, n_out):
        i = out[m]
        k = m
        while k > 0 and doubt[out[k - 1]] > doubt[i]:
            out[k] = out[k - 1]
            k -= 1
        out[k] = i


@kernel
def _remove_bases(ws: Workspace, limit: float, n_out: int, scratch: Insertion) -> int:
    """Remove bases until the rest fits; return how many points are in `out` then, -1 if a fit failed.

    `n_out` points are there before.
    """
    gain, cap, x, r, out = ws.gain, ws.cap, ws.x, ws.r, scratch.out
    n = x.shape[0]
    lowest = np.inf
    for count in range(2 * r.shape[0] + 1):
        gamma = x[n - 1]
        if gamma <= limit:
            return n_out
        size = free_basis(ws, scratch.basis)
        if size == 0:
            return -1
        # Only while f falls, and for N rounds: so the loop ends, where ties could send it round in a circle.
        if gamma < lowest - tie_width(x) and count < r.shape[0]:
            lowest = gamma
            kept = 0
            for m in range(n_out):
                i = out[m]
                if abs(r[i]) <= gamma:
                    gain[i] = 1.0
                    cap[i] = 0.0
                else:
                    out[kept] = i
                    kept += 1
            n_out = kept
        for k in range(size):
            out[n_out] = scratch.basis[k]
            n_out += 1
        scratch.counts[FITS] += 1
        take_out(ws, scratch.basis, size)
        for j in range(n):
            scratch.model[j] = x[j]
        _begin_at(ws, scratch.model)
        if _fit_within(ws, limit) != OK:
            return -1
    return -1


@kernel
def insertion_bound(ws: Workspace, limit: float, enough: int, scratch: Insertion) -> int:
    """Return a lower bound on how many points must leave the set before it fits, no more than `enough`.

    Parameters
    ----------
    ws
        At the vertex of the set: points with gain 1, among enforced ones with gain 0 and a finite cap, which
        are not to leave. Spoilt.
    limit
        Threshold plus slack, in the unit of the rows.
    enough
        Where to stop counting, at least 1.
    scratch
        Two models met on the way are noted: where the rest fits for the first time, and the last.

    Notes
    -----
    A point put back that is within the limit at the vertex needs no fit: that vertex is a model of the larger
    set, and stays a start for the dual simplex. A fit that fails ends the count early.
    """
    gain, cap, x, r, out = ws.gain, ws.cap, ws.x, ws.r, scratch.out
    n = x.shape[0]
    n_out = _remove_doubtful(ws, limit, scratch)
    if n_out >= 0:
        n_out = _remove_bases(ws, limit, n_out, scratch)
    if n_out < 0:
        return 0
    note_model(ws, limit, scratch)
    if scratch.doubt.shape[0] > 0:
        _sort_by_doubt(out, n_out, scratch.doubt)
    count = 0
    for m in range(n_out):
        i = out[m]
        gain[i] = 1.0
        cap[i] = 0.0
        if abs(r[i]) <= limit:
            continue
        for j in range(n):
            scratch.model[j] = x[j]
        scratch.counts[FITS] += 1
        if _fit_within(ws, limit) != OK:
            return count
        if x[n - 1] <= limit:
            continue
        size = free_basis(ws, scratch.basis)
        if size == 0:
            return count
        count += 1
        if count >= enough:
            return count
        take_out(ws, scratch.basis, size)
        gain[i] = 0.0  # as a point of that basis, unless rounding hides it
        cap[i] = np.inf
        _begin_at(ws, scratch.model)
    note_model(ws, limit, scratch)
    return count
