"""Prove a claimed bound again, by solvers that share nothing with the search.

With one or two parameters: a sweep along the boundaries of the strips |a_i . theta - b_i| <= limit in the
plane of all models. With more: a mixed-integer programme for HiGHS, with numbers M that are derived from the
data. Both are slow and plain.
"""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from maxcon.certification.exact import ExactData, independent_columns, within
from maxcon.waiting import interruptible

Floats = NDArray[np.float64]

#: The number of d-subsets of a group from which a box is derived is at most this.
MOST_SUBSETS = 20_000

#: A d-subset whose matrix has a larger condition number confines nothing.
SINGULAR = 1e10

#: So many places that are too deep are looked at; if none of them is, rounding makes a decision impossible.
MOST_TRIALS = 100


@dataclass(frozen=True)
class Rerun:
    """What came of proving a bound again.

    Attributes
    ----------
    status
        "confirmed", "refuted" (a model with more inliers was found) or "unfinished".
    solver
        "sweep" or "milp".
    note
        Why it is unfinished.
    n_inliers
        Of the model that refutes the bound; 0 otherwise.
    seconds
        How long it took.
    """

    status: Literal["confirmed", "refuted", "unfinished"]
    solver: Literal["sweep", "milp"]
    note: str
    n_inliers: int
    seconds: float


class _Undecided(Exception):  # noqa: N818
    """Why no answer was reached."""


def prove_again(A: Floats, b: Floats, limit: float, bound: int, time_limit: float) -> Rerun:
    """Find out whether some model has more than `bound` points within `limit`.

    Parameters
    ----------
    A, b
        The data, shapes (N, d) and (N,).
    limit
        The largest residual of an inlier, slack included.
    bound
        The claim.
    time_limit
        Seconds.

    Returns
    -------
    Rerun
        "unfinished" where the time is over, or Ctrl-C was pressed: then a solver at work is left to its own, and ends
        with the process or at its time limit (`maxcon.waiting.solver_at_work`).
    """
    began = time.perf_counter()
    d = A.shape[1]
    solver: Literal["sweep", "milp"] = "sweep" if d <= 2 else "milp"
    try:
        if bound >= len(b):
            found = 0
        elif d <= 2:
            found = _sweep(A if d == 2 else np.hstack([A, np.zeros_like(A)]), b, limit, bound, began + time_limit)
        else:
            found = _milp(A, b, limit, bound, began + time_limit)
    except _Undecided as reason:
        return Rerun("unfinished", solver, str(reason), 0, time.perf_counter() - began)
    except KeyboardInterrupt:
        return Rerun("unfinished", solver, "stopped by Ctrl-C", 0, time.perf_counter() - began)
    return Rerun("refuted" if found else "confirmed", solver, "", found, time.perf_counter() - began)


def load_solver() -> None:
    """Import what a rerun needs ahead of it: extension modules may swallow a Ctrl-C that meets their import."""
    from scipy.optimize import linprog, milp  # noqa: F401, PLC0415  (only a rerun needs them)


# ------------------------------------------------------------------------------------------------- two
# parameters


def _sweep(A: Floats, b: Floats, limit: float, bound: int, deadline: float) -> int:
    """Return the number of inliers of a model that has more than `bound`, or 0: O(N^2 log N).

    Where the most strips overlap, their intersection is all of the plane or has a boundary, that lies on a
    boundary line of one of them. On such a line the other strips are intervals. Each is made as much longer
    as rounding may have shortened it, so that no overlap is missed; a deepest place that is over `bound`
    counts only if its model does.
    """
    flat = ~A.any(axis=1)
    always = int(np.count_nonzero(np.abs(b[flat]) <= limit))
    rows, values = A[~flat], b[~flat]
    if always > bound:
        return always
    tried = 0
    for i, side in itertools.product(range(len(rows)), (-1.0, 1.0)):
        if time.perf_counter() > deadline:
            raise _Undecided("the time limit was reached")
        low, high = _intervals(rows, values, i, side, limit)
        depth, where = _deepest(low, high)
        if depth + always <= bound:
            continue
        # That place is on the edge of strip i, and rounding may put it outside: ask for the middle of what is there.
        there = (low <= where) & (where <= high)
        tried += 1
        if tried <= MOST_TRIALS:
            model, _ = _chebyshev(rows[there], values[there])
            inliers = int(np.count_nonzero(within(A, b, model, limit)))
            if inliers > bound:
                return inliers
    if tried > 0:
        raise _Undecided("some sets of points are within rounding of the threshold")
    return 0


def _intervals(A: Floats, b: Floats, i: int, side: float, limit: float) -> tuple[Floats, Floats]:
    """Return where strips begin and end on a boundary line of strip i; one that never meets it begins at inf."""
    eps = float(np.finfo(np.float64).eps)
    along = np.array([-A[i, 1], A[i, 0]])
    point = A[i] * ((b[i] + side * limit) / float(A[i] @ A[i]))
    offset = A @ point - b
    offset_error = 8 * eps * (np.abs(A) @ np.abs(point) + np.abs(b) + limit)
    slope = A @ along
    slope_error = 4 * eps * (np.abs(A) @ np.abs(along))
    for j in np.flatnonzero(np.abs(slope) <= slope_error):
        exact = sum(Fraction(x) * Fraction(t) for x, t in zip(A[j].tolist(), along.tolist(), strict=True))
        slope[j], slope_error[j] = float(exact), eps * abs(float(exact))
    parallel = slope == 0.0
    inside = parallel & (np.abs(offset) <= limit + offset_error)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ends = np.stack([-limit - offset, limit - offset]) / slope
        pad = (offset_error + np.abs(ends) * slope_error) / np.abs(slope) * (1 + 8 * eps) + 4 * eps * np.abs(ends)
        low, high = (ends - pad).min(axis=0), (ends + pad).max(axis=0)
    low[parallel], high[parallel] = np.inf, -np.inf
    low[inside], high[inside] = -np.inf, np.inf
    low[i], high[i] = -np.inf, np.inf
    return low, high


def _deepest(low: Floats, high: Floats) -> tuple[int, float]:
    """Return how many closed intervals share a number, and the middle of where they do."""
    real = low <= high
    begins, ends = np.sort(low[real]), np.sort(high[real])
    depth = np.arange(1, len(begins) + 1) - np.searchsorted(ends, begins, side="left")
    best = int(np.argmax(depth))
    start = begins[best]
    end = ends[np.searchsorted(ends, start, side="left")]
    if math.isinf(start) or math.isinf(end):
        finite = start if math.isfinite(start) else end
        return int(depth[best]), float(finite) if math.isfinite(finite) else 0.0
    return int(depth[best]), float(0.5 * start + 0.5 * end)


# ------------------------------------------------------------------------------------------------- more
# parameters


def _milp(A: Floats, b: Floats, limit: float, bound: int, deadline: float) -> int:
    """Return the number of inliers of a model that has more than `bound`, or 0, by a mixed-integer programme.

    Point i may be out (z_i = 1), at most N - bound - 1 points are, and ``|a_i . theta - b_i| <= limit + M_i
    z_i``, theta in the box of `_box`, in which M_i is the largest residual. HiGHS lets a z be 1e-6 away from
    an integer, which forgives residuals of 1e-6 M_i: the set that it finds is fitted, and a basis that proves
    it infeasible becomes a cut.
    """
    from scipy.optimize import Bounds, LinearConstraint, milp  # noqa: PLC0415  (only a rerun needs it)

    columns = independent_columns(A)
    A = A[:, columns]
    N, d = A.shape
    if d == 0:
        inliers = int(np.count_nonzero(np.abs(b) <= limit))
        return inliers if inliers > bound else 0
    low, high = _box(A, b, limit, bound + 1)
    centre, half = (low + high) / 2, (high - low) / 2
    half = np.maximum(half, 1e-6 * np.abs(centre) + 1e-300)
    rows, right = A * half / limit, (b - A @ centre) / limit
    big = np.diag(np.abs(rows).sum(axis=1) + np.abs(right))
    count = np.r_[np.zeros(d), np.ones(N)]
    constraints = [
        LinearConstraint(np.hstack([rows, -big]), ub=right + 1),
        LinearConstraint(np.hstack([-rows, -big]), ub=1 - right),
        LinearConstraint(count[None, :], ub=N - bound - 1),
    ]
    bounds = Bounds(np.r_[-np.ones(d), np.zeros(N)], np.ones(d + N))
    exact = ExactData(A, b)
    while True:
        left = deadline - time.perf_counter()
        if left <= 0:
            raise _Undecided("the time limit was reached")
        solve = partial(milp, count, integrality=count, bounds=bounds, constraints=tuple(constraints))
        answer = interruptible(partial(solve, options={"time_limit": left}))
        if answer.status == 2:
            return 0
        if answer.x is None:
            reached = "the time limit was reached" if answer.status == 1 else f"HiGHS gave up: {answer.message}"
            raise _Undecided(reached)
        kept = np.flatnonzero(answer.x[d:] < 0.5)
        theta, basis = _chebyshev(A[kept], b[kept])
        inliers = int(np.count_nonzero(within(A, b, theta, limit)))
        if inliers > bound:
            return inliers
        refuted = kept[basis]
        least = exact.least_maximum(refuted.tolist())
        if least is None or least <= limit:
            raise _Undecided("some sets of points are within rounding of the threshold")
        cut = np.zeros(d + N)
        cut[d + refuted] = 1.0
        constraints.append(LinearConstraint(cut[None, :], lb=1.0))


def _chebyshev(A: Floats, b: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Return a model with the smallest largest residual, and the points whose multipliers are not 0, by HiGHS."""
    from scipy.optimize import linprog  # noqa: PLC0415

    N, d = A.shape
    sizes = np.abs(A).max(axis=0)
    sizes[sizes == 0] = 1.0
    unit = float(np.abs(b).max()) or 1.0
    ones = np.ones((N, 1))
    answer: Any = linprog(
        np.r_[np.zeros(d), 1.0],
        A_ub=np.block([[A / sizes, -ones], [-A / sizes, -ones]]),
        b_ub=np.r_[b, -b] / unit,
        bounds=[(None, None)] * d + [(0, None)],
        method="highs",
    )
    if answer.status != 0:
        raise _Undecided(f"HiGHS gave up: {answer.message}")
    weights = np.abs(answer.ineqlin.marginals)
    return answer.x[:d] * unit / sizes, np.flatnonzero(weights[:N] + weights[N:] > 1e-9)


def _box(A: Floats, b: Floats, limit: float, n_inliers: int) -> tuple[Floats, Floats]:
    """Return (low, high) between which every model with so many inliers lies, shape (d,) each.

    Deal the points into g groups of s. One of them has at most ``(N - n_inliers) // g`` outliers, and so at
    least ``m = s - (N - n_inliers) // g`` inliers. Any d inliers confine the model, to within ``|A_I^-1|
    limit`` of ``A_I^-1 b_I``; of the C(s, d) such subsets of the group at least C(m, d) are right, so that
    the model lies below the C(m, d)-th largest of their upper ends. The box holds what follows for each of
    the groups.
    """
    N, d = A.shape
    best: tuple[float, int] | None = None
    for s in range(d, N + 1):
        if math.comb(s, d) > MOST_SUBSETS:
            break
        m = s - (N - n_inliers) // (N // s)
        if m >= d:
            share = math.comb(m, d) / math.comb(s, d)
            best = max(best, (share, s)) if best is not None else (share, s)
    if best is None:
        raise _Undecided(f"so few inliers ({n_inliers} of {N}) confine no model, and without a box there is no MILP")
    s = best[1]
    m = s - (N - n_inliers) // (N // s)
    rank = math.comb(m, d) - 1
    chosen = np.array(list(itertools.combinations(range(s), d)))
    low, high = np.full(d, np.inf), np.full(d, -np.inf)
    order = np.random.default_rng(0).permutation(N)
    for first in range(0, (N // s) * s, s):
        centres, halves = _confined(A, b, order[first : first + s][chosen], limit)
        low = np.minimum(low, np.sort(centres - halves, axis=0)[rank])
        high = np.maximum(high, -np.sort(-(centres + halves), axis=0)[rank])
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise _Undecided("too many subsets of the points confine no model, and without a box there is no MILP")
    margin = 1e-6 * (high - low) + 1e-6 * np.maximum(np.abs(low), np.abs(high))
    return low - margin, high + margin


def _confined(A: Floats, b: Floats, subsets: NDArray[np.intp], limit: float) -> tuple[Floats, Floats]:
    """Return centre and half width of the models for which all d points of a subset are inliers, shape (n, d) each."""
    sizes = np.abs(A).max(axis=0)
    blocks = A[subsets] / sizes
    lengths = np.abs(blocks).max(axis=2)
    lengths[lengths == 0] = 1.0
    regular = np.linalg.cond(blocks / lengths[:, :, None]) < SINGULAR
    centres, halves = np.zeros(subsets.shape), np.full(subsets.shape, np.inf)
    inverses = np.linalg.inv(blocks[regular])
    centres[regular] = (inverses @ b[subsets[regular]][:, :, None])[:, :, 0] / sizes
    halves[regular] = np.abs(inverses).sum(axis=2) * limit / sizes
    return centres, halves
