"""f(S) of all subsets of a few points, in exact arithmetic."""

import itertools
from fractions import Fraction

import numpy as np

import oracles


def circuits(A, b):
    """Return the smallest dependent sets of rows as bit masks, and the f(S) of each: shapes (K,), (K,), ascending.

    f(S) is the largest of those of the circuits in S, and 0 without any (the vertices of the dual polytope).
    """
    N, d = A.shape
    rows = oracles._columns_as_integers(A)
    values, masks = [], []
    for size in range(1, d + 2):
        for subset in itertools.combinations(range(N), size):
            chosen = list(subset)
            weights = oracles._dependence(rows[chosen])
            if weights is None or not all(weights):
                continue
            total = sum(Fraction(w) * Fraction(r) for w, r in zip(weights, b[chosen].tolist(), strict=True))
            values.append(float(abs(total) / sum(abs(w) for w in weights)))
            masks.append(sum(1 << i for i in chosen))
    order = np.argsort(values, kind="stable")
    return np.array(masks, dtype=np.int64)[order], np.array(values)[order]


def breakpoints_by_subsets(A, b):
    """Return the smallest f(S) of k points for k = 1 .. N."""
    N = len(b)
    masks, values = circuits(A, b)
    values = np.r_[0.0, values]
    best = np.full(N, np.inf)
    for subset in range(1, 1 << N):
        inside = np.flatnonzero((masks & ~subset) == 0)
        k = subset.bit_count() - 1
        best[k] = min(best[k], values[inside[-1] + 1] if len(inside) else 0.0)
    return best


def largest_sets(A, b, limit):
    """Return all largest sets with f(S) <= limit as rows of a boolean matrix, shape (K, N)."""
    N = len(b)
    masks, values = circuits(A, b)
    excluded = masks[values > limit]
    subsets = np.arange(1 << N, dtype=np.int64)
    feasible = np.ones(len(subsets), dtype=bool)
    for circuit in excluded:
        feasible &= (subsets & circuit) != circuit
    bits = (subsets[feasible][:, None] >> np.arange(N)) & 1
    sizes = bits.sum(axis=1)
    return bits[sizes == sizes.max()].astype(bool)
