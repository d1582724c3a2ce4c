"""Slow, obvious versions of what maxcon computes, to compare with.

Nothing here imports maxcon. Wherever it can, an oracle is exact: a float is a dyadic rational, so Python's
integers hold the data without any rounding, and the answer is *the* answer about the floats given. That is
also the one trap: columns that are dependent on paper but not in floats (``0.1 * x`` beside ``x``) have full
rank to an exact judge, which then fits the rounding noise. `scaled_condition` tells such data apart.

Minimax fit, f(S) = min over theta of max over i in S of |a_i . theta - b_i|:

- `exact_minimax` enumerates the vertices of the dual polytope (N <= 8 or so),
- `highs_linprog` is HiGHS alone, as good as its tolerances,
- `highs_minimax` starts an exact dual simplex at HiGHS's answer: any N, exact, a few milliseconds.

Consensus, the most points with f(S) <= threshold + slack:

- `brute_force_consensus` enumerates subsets (N <= 16),
- `line_consensus_bruteforce` enumerates the vertices of the arrangement for y = m x + c (N <= 40 or so),
- `milp_consensus` is a big-M MILP by HiGHS whose answer is checked, and cut off where it cheats.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import Bounds, LinearConstraint, linprog, milp

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.object_]  # Python integers: exact, of any size


def default_slack(threshold: float, b: npt.ArrayLike) -> float:
    """Rounding allowance on top of the threshold, the same everywhere in the project."""
    return 1e-9 * threshold + 1e-12 * float(np.max(np.abs(np.asarray(b, dtype=float)), initial=0.0))


# ------------------------------------------------------------------------------------ exact integer algebra


def _as_integers(values: npt.ArrayLike) -> tuple[Integers, int]:
    """Return (integers, scale), scale a power of two, with ``values == integers / scale`` exactly."""
    array = np.asarray(values, dtype=float)
    ratios = [value.as_integer_ratio() for value in array.ravel().tolist()]
    scale = max((denominator for _, denominator in ratios), default=1)
    integers = np.empty(len(ratios), dtype=object)
    integers[:] = [numerator * (scale // denominator) for numerator, denominator in ratios]
    return integers.reshape(array.shape), scale


def _columns_as_integers(A: Floats) -> Integers:
    """Scale each column to integers by its own power of two; the column space stays the same."""
    integers = np.empty(A.shape, dtype=object)
    for j in range(A.shape[1]):
        integers[:, j] = _as_integers(A[:, j])[0]
    return integers


def _reduce(M: Integers) -> tuple[Integers, list[int], int]:
    """Fraction-free Gauss-Jordan elimination (Bareiss).

    Returns
    -------
    reduced : (rank, columns) integers
        ``reduced / p`` is the reduced row echelon form of M.
    pivots : list of int
        Its pivot columns: the columns of M that depend on none before them.
    p : int
        The common pivot: for a square, nonsingular M its determinant up to sign.
    """
    W = M.copy()
    pivots: list[int] = []
    p = 1
    for column in range(W.shape[1]):
        k = len(pivots)
        if k == W.shape[0]:
            break
        candidates = [row for row in range(k, W.shape[0]) if W[row, column] != 0]
        if not candidates:
            continue
        W[[k, candidates[0]]] = W[[candidates[0], k]]
        pivot_row = W[k].copy()
        W = (pivot_row[column] * W - np.multiply.outer(W[:, column], pivot_row)) // p  # exact division
        W[k] = pivot_row
        p = pivot_row[column]
        pivots.append(column)
    return W[: len(pivots)], pivots, p


def _inverse(M: Integers) -> tuple[Integers, int]:
    """Return (X, p), p > 0, with ``M @ X == p * identity``, all integers."""
    n = len(M)
    reduced, pivots, p = _reduce(np.hstack([M, np.eye(n, dtype=int).astype(object)]))
    if pivots != list(range(n)):
        raise ArithmeticError("the matrix is singular")
    X = reduced[:, n:]
    return (X, p) if p > 0 else (-X, -p)


def _dependence(rows: Integers) -> Integers | None:
    """Return an integer lambda != 0 with ``lambda @ rows == 0`` on the first dependent prefix, or None.

    The lambda is elementary: the rows in its support form a circuit (dependent, every proper part is not).
    """
    reduced, pivots, p = _reduce(rows.T)
    dependent = next((j for j in range(len(rows)) if j not in pivots), None)
    if dependent is None:
        return None
    vector = np.zeros(len(rows), dtype=object)
    vector[pivots] = reduced[:, dependent]  # zero at the pivots after `dependent`
    vector[dependent] = -p
    return vector


def exact_rank(A: npt.ArrayLike) -> int:
    """Rank of the floats in A, without rounding."""
    return len(_reduce(_columns_as_integers(np.asarray(A, dtype=float)))[1])


def independent_columns(A: npt.ArrayLike) -> Floats:
    """Return the columns of A that (exactly) do not depend on those before them: the same column space."""
    array = np.asarray(A, dtype=float)
    return array[:, _reduce(_columns_as_integers(array))[1]]


def scaled_condition(A: npt.ArrayLike) -> float:
    """Condition number of the independent columns of A, each divided by its largest entry.

    Beyond about 1e8 a double-precision method cannot be held to the exact answer; 1e15 and more mean
    columns that were meant to be dependent and are not.
    """
    columns = independent_columns(A)
    return float(np.linalg.cond(columns / np.abs(columns).max(axis=0))) if columns.size else 1.0


# ------------------------------------------------------------------------------------------- the minimax fit


def exact_minimax(A: npt.ArrayLike, b: npt.ArrayLike) -> Fraction:
    """Return f of all rows, exactly, by enumeration: for N <= 8 or so, d <= 3.

    The dual is: max lambda . b subject to A^T lambda = 0, sum |lambda| <= 1. The vertices of that polytope
    are 0 and the elementary vectors, whose support is a circuit of at most rank + 1 rows. So f is the largest
    |lambda . b| / sum |lambda| over the circuits, and 0 if there is none; any rank of A will do.
    """
    rows = [[Fraction(x) for x in row] for row in np.asarray(A, dtype=float).tolist()]
    right = [Fraction(x) for x in np.asarray(b, dtype=float).tolist()]
    best = Fraction(0)
    for size in range(1, len(rows[0]) + 2):
        for subset in itertools.combinations(range(len(rows)), size):
            weights = _only_dependence([rows[i] for i in subset])
            if weights is not None:
                top = abs(sum((w * right[i] for w, i in zip(weights, subset, strict=True)), Fraction(0)))
                best = max(best, top / sum((abs(w) for w in weights), Fraction(0)))
    return best


def _only_dependence(rows: list[list[Fraction]]) -> list[Fraction] | None:
    """Return the one (up to scale) vanishing combination of the rows; None if there is none, or several."""
    combinations = [[Fraction(int(i == j)) for j in range(len(rows))] for i in range(len(rows))]
    left = [(list(row), combination) for row, combination in zip(rows, combinations, strict=True)]
    for column in range(len(rows[0])):
        pivot = next((pair for pair in left if pair[0][column] != 0), None)
        if pivot is None:
            continue
        left.remove(pivot)
        for row, combination in left:
            factor = row[column] / pivot[0][column]
            row[:] = [x - factor * y for x, y in zip(row, pivot[0], strict=True)]
            combination[:] = [x - factor * y for x, y in zip(combination, pivot[1], strict=True)]
    return left[0][1] if len(left) == 1 else None


def highs_linprog(
    A: npt.ArrayLike,
    b: npt.ArrayLike,
    enforced: npt.ArrayLike | None = None,
    threshold: float | None = None,
) -> tuple[float, Floats, Floats]:
    """HiGHS alone on the minimax LP, scaled, at its tightest tolerances (1e-10 in scaled units).

    Returns
    -------
    value : float
        Its optimum; inf if it says infeasible, nan if it gives up.
    theta : (d,) floats
        Its model, nan where there is none.
    weights : (N,) floats
        |marginal| of each row.
    """
    A = np.asarray(A, dtype=float)
    b = np.asarray(b, dtype=float)
    N, d = A.shape
    held = np.zeros(N, dtype=bool) if enforced is None else np.asarray(enforced, dtype=bool)
    columns = np.abs(A).max(axis=0, initial=0.0)
    columns[columns == 0] = 1.0
    size = float(np.abs(b).max(initial=0.0)) or 1.0
    rows = np.hstack([A / columns, -(~held)[:, None].astype(float)])
    mirrored = np.hstack([-A / columns, -(~held)[:, None].astype(float)])
    allowed = np.where(held, (threshold or 0.0) / size, 0.0)
    answer = linprog(
        np.r_[np.zeros(d), 1.0],
        A_ub=np.vstack([rows, mirrored]),
        b_ub=np.r_[b / size + allowed, -b / size + allowed],
        bounds=[(None, None)] * d + [(0, None)],
        method="highs",
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )
    if answer.status != 0:
        return (math.inf if answer.status == 2 else math.nan), np.full(d, math.nan), np.zeros(N)
    marginals = np.abs(answer.ineqlin.marginals)
    return float(answer.fun) * size, answer.x[:d] * size / columns, marginals[:N] + marginals[N:]


def highs_minimax(
    A: npt.ArrayLike,
    b: npt.ArrayLike,
    enforced: npt.ArrayLike | None = None,
    threshold: float | None = None,
) -> float:
    """Return f(S), or inf if the enforced rows cannot be kept: min over theta of max |a_i . theta - b_i|.

    HiGHS stops at a tolerance, so its answer only says where an exact dual simplex starts; what that returns
    carries its own proof, and is rounded once, to the nearest float. Rows in `enforced` (bool, (N,)) must
    instead have a residual of at most `threshold`, closed and with no slack: a threshold that is itself a
    rounded f can be one rounding too small, so give it with the slack, or one on either side. With no row
    left to minimise over, f is 0.
    """
    value, _, _ = _polished(A, b, enforced, threshold)
    return math.inf if value is None else float(value)


def minimax_fit(A: npt.ArrayLike, b: npt.ArrayLike) -> tuple[float, list[int]]:
    """Return f of all rows and the rows of one basis: those with a positive dual weight."""
    value, support, _ = _polished(A, b, None, None)
    assert value is not None  # always feasible without enforced rows
    return float(value), support


def minimax_tolerance(value: float, b: npt.ArrayLike) -> float:
    """How far a double-precision f may be from the exact `value`."""
    return 1e-9 * value + 1e-12 * float(np.max(np.abs(np.asarray(b, dtype=float)), initial=0.0))


def assert_minimax_value(
    value: float,
    A: npt.ArrayLike,
    b: npt.ArrayLike,
    enforced: npt.ArrayLike | None = None,
    threshold: float | None = None,
) -> None:
    """Assert |value - f| <= 1e-9 f + 1e-12 max|b|, f by `highs_minimax`; inf must meet inf.

    With enforced rows f depends on the threshold, at times steeply: anything from f at threshold + slack to f
    at threshold - slack will do, inf included where the latter is infeasible.
    """
    about = f"(shape {np.shape(A)}, scaled condition {scaled_condition(A):.3g})"
    if enforced is None:
        low = high = highs_minimax(A, b)
    else:
        assert threshold is not None, "threshold must be given with enforced"
        slack = default_slack(threshold, b)
        low = highs_minimax(A, b, enforced, threshold + slack)
        high = highs_minimax(A, b, enforced, threshold - slack) if threshold > slack else math.inf
    if math.isinf(low):
        assert value == math.inf, f"minimax value {value!r}, but the enforced rows cannot be kept {about}"
        return
    lowest = low - minimax_tolerance(low, b)
    highest = math.inf if math.isinf(high) else high + minimax_tolerance(high, b)
    assert lowest <= value <= highest, (
        f"minimax value {value!r} is {max(low - value, value - high):.3g} away from [{low!r}, {high!r}];"
        f" allowed: {minimax_tolerance(low, b):.3g} {about}"
    )


def _polished(
    A: npt.ArrayLike, b: npt.ArrayLike, enforced: npt.ArrayLike | None, threshold: float | None
) -> tuple[Fraction | None, list[int], int]:
    """Exact (value or None if infeasible, rows with positive dual, exchanges made), started from HiGHS."""
    A = np.asarray(A, dtype=float)
    b = np.asarray(b, dtype=float)
    if enforced is not None and threshold is None:
        raise ValueError("threshold must be given with enforced")
    held = np.zeros(len(b), dtype=bool) if enforced is None else np.asarray(enforced, dtype=bool)
    if len(b) == 0:
        return Fraction(0), [], 0
    _, theta, weights = highs_linprog(A, b, enforced, threshold)
    residuals = np.nan_to_num(A @ theta - b)
    order = np.lexsort((-np.abs(residuals), -weights))  # the rows that HiGHS calls a basis come first
    return _exact_simplex(A, b, held=held, threshold=threshold or 0.0, order=order, above=residuals >= 0)


def _exact_simplex(
    A: Floats,
    b: Floats,
    *,
    held: npt.NDArray[np.bool_],
    threshold: float,
    order: npt.NDArray[np.intp],
    above: npt.NDArray[np.bool_],
) -> tuple[Fraction | None, list[int], int]:
    """Dual simplex in integers: minimise z subject to G (theta, z) <= h.

    Two constraints a row, s (a_i . theta - b_i) <= z (or <= threshold where held) with s = 1 and -1, and
    0 <= z. A basis is d + 1 independent constraints with multipliers mu >= 0, sum of mu G = (0, -1): its
    vertex is a lower bound, and the optimum once it violates nothing. `order` and `above` (the signs of the
    residuals) say where to look for the first basis; they cannot change the value.
    """
    N = len(b)
    columns = _columns_as_integers(A)
    columns = columns[:, _reduce(columns)[1]]
    right, scale = _as_integers(np.r_[b, threshold])
    b_int, threshold_int = right[:N], right[N]
    n = columns.shape[1] + 1
    G = np.zeros((2 * N + 1, n), dtype=object)
    G[:N, :-1], G[N : 2 * N, :-1] = columns, -columns
    G[:N, -1] = G[N : 2 * N, -1] = np.where(held, 0, -1)
    G[-1, -1] = -1
    allowed = threshold_int * held.astype(object)
    h = np.concatenate([b_int + allowed, allowed - b_int, np.zeros(1, dtype=object)])
    basis = _first_basis(columns, b_int, G, held=held, order=order, above=above)
    exchanges, stalled = 0, False
    while True:
        X, p = _inverse(G[basis])
        vertex = X @ h[basis]  # times p
        mu = -X[-1]  # times p: the multipliers solve mu @ G[basis] = (0, ..., 0, -1)
        assert min(mu) >= 0
        excess = G @ vertex - h * p
        violated = np.flatnonzero(excess > 0)
        if len(violated) == 0:
            support = {int(c) % N for c, m in zip(basis, mu, strict=True) if m > 0 and c < 2 * N}
            return Fraction(vertex[-1], p * scale), sorted(support), exchanges
        # the worst constraint enters; after a step of length 0 the first one does, or it might cycle (Bland)
        entering = int(violated[0] if stalled else max(violated, key=lambda c: excess[c]))
        w = G[entering] @ X
        shrinking = [k for k in range(n) if w[k] > 0]
        if not shrinking:
            return None, [], exchanges
        leaving = min(shrinking, key=lambda k: (Fraction(mu[k], w[k]), basis[k]))
        stalled = mu[leaving] == 0
        basis[leaving] = entering
        exchanges += 1


def _first_basis(
    columns: Integers,
    b_int: Integers,
    G: Integers,
    *,
    held: npt.NDArray[np.bool_],
    order: npt.NDArray[np.intp],
    above: npt.NDArray[np.bool_],
) -> list[int]:
    """Return a basis with multipliers >= 0: the first circuit of rows not held, filled up with others.

    A circuit's weights lambda, with the signs s_i = sign(lambda_i), are the multipliers, and -lambda does as
    well: take the one with the higher z, -lambda . b. Without a circuit 0 <= z takes all the weight. What
    fills up gets the multiplier 0.
    """
    N = len(columns)
    free = [int(i) for i in order if not held[i]]
    weights = _dependence(columns[free]) if free else None
    start = [2 * N]
    if weights is not None:
        if weights @ b_int[free] > 0:
            weights = -weights
        start = [i if weight > 0 else i + N for i, weight in zip(free, weights, strict=True) if weight != 0]
    candidates = start + [int(i) if above[i] else int(i) + N for i in order]
    return [candidates[k] for k in _reduce(G[candidates].T)[1]]


# ----------------------------------------------------------------------------------------------- consensus


def brute_force_consensus(A: npt.ArrayLike, b: npt.ArrayLike, threshold: float, slack: float | None = None) -> int:
    """Return the largest number of points with f(S) <= threshold + slack, exactly, for N <= 16.

    f(S) is the largest value of a circuit inside S (see `exact_minimax`; this is Helly's theorem with the
    degenerate cases in it), so S fits exactly if it holds no circuit whose value exceeds the limit. List
    those circuits, then look at all 2^N subsets. No model and no LP is computed, and nothing is rounded.
    """
    A = np.asarray(A, dtype=float)
    b = np.asarray(b, dtype=float)
    N = len(b)
    if N > 16:
        raise ValueError(f"N must be at most 16 to enumerate the subsets; got {N}")
    limit = Fraction(threshold) + Fraction(default_slack(threshold, b) if slack is None else slack)
    columns = _columns_as_integers(A)
    columns = columns[:, _reduce(columns)[1]]
    b_int, scale = _as_integers(b)
    masks = np.arange(2**N)
    fits = np.ones(2**N, dtype=bool)
    for size in range(1, columns.shape[1] + 2):
        for subset in itertools.combinations(range(N), size):
            weights = _dependence(columns[list(subset)])
            if weights is None or not all(weights):
                continue  # independent, or dependent through a smaller circuit
            if abs(weights @ b_int[list(subset)]) > limit * scale * sum(np.abs(weights)):
                bad = sum(1 << i for i in subset)
                fits &= (masks & bad) != bad
    return int(np.bitwise_count(masks[fits]).max())


def line_consensus_bruteforce(x: npt.ArrayLike, y: npt.ArrayLike, threshold: float, slack: float | None = None) -> int:
    """Return the most points with |m x + c - y| <= limit = threshold + slack, exactly: O(N^3), N <= 40 or so.

    Take the best set. If it has two different x, the lines (m, c) that fit it form a bounded polygon; at one
    of its corners two points of different x have a residual of exactly +-limit, so that line passes through
    both, each moved up or down by limit. If all its x are equal, a horizontal line through a moved point fits
    it. So trying these lines is enough. A point on the limit decides the count, so all of it is in integers.
    """
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    limit = Fraction(threshold) + Fraction(default_slack(threshold, y) if slack is None else slack)
    X, _ = _as_integers(x)
    Y, scale = _as_integers(y)
    # limit is dyadic too: bring it and y to one denominator
    Y, L = Y * limit.denominator, limit.numerator * scale
    best = 0
    for i, j in itertools.combinations(range(len(X)), 2):
        run = X[j] - X[i]
        if run == 0:
            continue
        for up_i, up_j in itertools.product((-L, L), repeat=2):
            start, end = Y[i] + up_i, Y[j] + up_j
            residuals = np.abs((end - start) * (X - X[i]) + (start - Y) * run)  # times |run|
            best = max(best, int(np.count_nonzero(residuals <= abs(run) * L)))
    for height in np.concatenate([Y - L, Y + L]):
        best = max(best, int(np.count_nonzero(np.abs(Y - height) <= L)))
    return best


def milp_consensus(
    A: npt.ArrayLike,
    b: npt.ArrayLike,
    threshold: float,
    slack: float | None = None,
    box: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
) -> int:
    """Return the largest number of points with f(S) <= threshold + slack, by a big-M MILP (HiGHS).

    Minimise the number of z_i = 1 subject to |a_i . theta - b_i| <= limit + M_i z_i, theta in a box, where
    M_i = max over the box of |a_i . theta - b_i|. The box (`theta_box`) holds a model of a best set, unless
    `box` = (low, high), for the independent columns of A, says otherwise. HiGHS lets z be 1e-6 away from an
    integer and so forgives residuals up to 1e-6 M_i: its set is checked by the exact minimax fit, and a basis
    that does not fit becomes a cut (one of these points is out) before it is solved again. Up to N = 60 for
    d <= 3, 20 for d = 8. HiGHS may print debug lines of its own.
    """
    A = independent_columns(A)
    b = np.asarray(b, dtype=float)
    N = len(b)
    limit = threshold + (default_slack(threshold, b) if slack is None else slack)
    if limit <= 0:
        raise ValueError(f"threshold + slack must be positive to scale the MILP; got {limit}")
    if A.shape[1] == 0:
        return int(np.count_nonzero(np.abs(b) <= limit))
    low, high = theta_box(A, b, limit) if box is None else (np.asarray(box[0]), np.asarray(box[1]))
    centre, half = (low + high) / 2, (high - low) / 2
    half = np.maximum(half, 1e-6 * np.abs(centre) + 1e-300)  # theta = centre + half * u, u in [-1, 1]
    rows, right = A * half / limit, (b - A @ centre) / limit
    M = np.abs(rows).sum(axis=1) + np.abs(right)
    big = np.diag(M)
    constraints = [
        LinearConstraint(np.hstack([rows, -big]), ub=right + 1),
        LinearConstraint(np.hstack([-rows, -big]), ub=1 - right),
    ]
    d = A.shape[1]
    bounds = Bounds(np.r_[-np.ones(d), np.zeros(N)], np.ones(d + N))
    while True:
        answer = milp(
            np.r_[np.zeros(d), np.ones(N)],
            integrality=np.r_[np.zeros(d), np.ones(N)],
            bounds=bounds,
            constraints=constraints,
            options={"mip_rel_gap": 0.0},
        )
        if answer.status != 0:
            raise ArithmeticError(f"HiGHS did not solve the MILP: {answer.message}")
        kept = np.flatnonzero(answer.x[d:] < 0.5)
        value, basis = minimax_fit(A[kept], b[kept])
        if value <= limit:
            return len(kept)
        cut = np.zeros(d + N)
        cut[d + kept[basis]] = 1.0
        constraints.append(LinearConstraint(cut[None, :], lb=1.0))


def theta_box(A: Floats, b: Floats, limit: float, most: int = 300_000) -> tuple[Floats, Floats]:
    """Return (low, high) between which a best set has a model; A has independent columns.

    Let K points be known to fit one model; then a best set S has at least K. Each d-subset I of S confines
    every model of S: theta is within |A_I^-1| limit of A_I^-1 b_I. S has at least C(K, d) such subsets, so
    the smallest of their upper ends is no more than the C(K, d)-th largest over all d-subsets of the data;
    the lower ends likewise. Where that is infinite, since too many A_I are singular (condition above 1e12),
    S might not span: then it still has a basic model, one with at most k coordinates other than 0 that
    k of its points determine, and the box holds the basic models of all nonsingular minors.
    """
    N, d = A.shape
    if math.comb(N, d) > most:
        raise ValueError(f"C(N, d) must be at most {most} to derive a box; got N = {N}, d = {d}: give a box")
    centres, halves = _confined(A, b, np.arange(d), limit)
    regular = np.isfinite(halves).all(axis=1)
    K = max(
        (int(np.count_nonzero(np.abs(A @ theta - b) <= 0.999 * limit)) for theta in centres[regular]),
        default=d,
    )
    rank = max(math.comb(K, d), 1) - 1
    low = np.sort(centres - halves, axis=0)[rank]
    high = -np.sort(-(centres + halves), axis=0)[rank]
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        low, high = np.zeros(d), np.zeros(d)
        for chosen in _subsets(range(d)):
            centres, halves = _confined(A, b, np.array(chosen), limit)
            regular = np.isfinite(halves).all(axis=1)
            low[chosen] = np.minimum(low[chosen], (centres - halves)[regular].min(axis=0, initial=0.0))
            high[chosen] = np.maximum(high[chosen], (centres + halves)[regular].max(axis=0, initial=0.0))
    margin = 1e-6 * (high - low) + 1e-6 * np.maximum(np.abs(low), np.abs(high))
    return low - margin, high + margin


def _subsets(items: Sequence[int]) -> Iterator[list[int]]:
    """Yield the nonempty subsets."""
    for size in range(1, len(items) + 1):
        for subset in itertools.combinations(items, size):
            yield list(subset)


def _confined(A: Floats, b: Floats, chosen: npt.NDArray[Any], limit: float) -> tuple[Floats, Floats]:
    """Centres and half widths, each (C(N, k), k), of theta[chosen] given k points within the limit."""
    k = len(chosen)
    subsets = np.array(list(itertools.combinations(range(len(b)), k)))
    blocks = A[:, chosen][subsets]
    scales = np.abs(blocks).max(axis=2, keepdims=True)
    regular = (scales > 0).all(axis=(1, 2))
    scales[scales == 0] = 1.0
    regular[regular] = np.linalg.cond((blocks / scales)[regular] / np.abs(A[:, chosen]).max(axis=0)) < 1e12
    centres, halves = np.zeros((len(subsets), k)), np.full((len(subsets), k), math.inf)
    inverses = np.linalg.inv(blocks[regular])
    centres[regular] = (inverses @ b[subsets[regular]][:, :, None])[:, :, 0]
    halves[regular] = np.abs(inverses).sum(axis=2) * limit
    return centres, halves
