"""Rows of a linear problem as strips, the form in which exact stabbing takes them.

Of the r <= 3 independent columns of A one is singled out, the stabbing column c; its parameter is t. Divided by
c_i, point i is an inlier where ``|x_i . s + t - y_i| <= l_i``, with k = r - 1 parameters s: a strip of the (s, t)
space. Points with c_i = 0 are strips too, but do not depend on t: *flat* ones. A point whose row is 0 is an
inlier always or never.

A change of parameters makes the numbers tame: x is centred at a median; s and t are counted from a model that
was sampled, which is the first incumbent, and s in units that are powers of two; of two correlated columns one
loses its regression on the other. And parameters without bounds become homogeneous: a model (s, t) is any
positive multiple (sigma, tau, w) of (s, t, 1), and the one is taken at which the largest of |sigma_j| and w is 1. So
point i is an inlier where ``w low_i <= a_i . sigma + tau <= w high_i``, and (sigma, w) is on the faces of a
cube; w = 0 stands for "infinitely steep".

What rounding does. Every number is computed from the floats of A and b, one point at a time, by a handful of
operations, each of which is off by at most u = 2^-53 times its result. `grain` and `pad` are 2^-48 = 32 u times the
sum of the sizes of all that is added on the way to a_i, and to low_i and high_i. As |sigma_j| <= 1, an edge that
is moved out by ``grain + w pad`` is outside of where exact arithmetic would put it, its own evaluation
included. All of this depends on the point alone, so that duplicates stay duplicates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel

#: 32 units of rounding; the longest chain of operations from the data to an edge has about 20.
ROUNDING = 2.0**-48

#: Rows with larger (or thresholds with smaller) numbers than this after the division by c_i are left out of the
#: search, and counted as inliers of everything in the bound.
EXTREME = 1e100

#: How many minimal samples are tried for the first incumbent, on at most three times as many points.
SAMPLES = 64

#: A sampled model whose values are so many times as large as the data is not used.
STEEP = 16.0


class Strips(NamedTuple):
    """The strips ``w low <= a0 sigma_0 + a1 sigma_1 + tau <= w high``; the last ones are flat: no tau.

    Attributes
    ----------
    a0, a1, low, high
        Shape (n,) each; a1 = 0 where k = 1.
    pad, grain
        Shape (n,) each: rounding can have moved an edge by ``grain + w pad``, by `grain` because of a_i. Rows that
        differ by no more than their grain are equal.
    n_regular
        How many are not flat; these come first.
    """

    a0: NDArray[np.float64]
    a1: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    pad: NDArray[np.float64]
    grain: NDArray[np.float64]
    n_regular: int


@kernel
def stabbing_column(A: NDArray[np.float64], columns: NDArray[np.int64]) -> tuple[int, bool]:
    """Return which of `columns` to stab along, as a place in `columns`, and whether it is constant.

    A constant one if there is one; else the one with the fewest entries that are small or 0, since dividing by
    those makes wide strips, which bound poorly.
    """
    N = A.shape[0]
    best = 0
    fewest = N + 1
    for k in range(columns.shape[0]):
        j = columns[k]
        largest = 0.0
        constant = True
        for i in range(N):
            largest = max(largest, abs(A[i, j]))
            constant = constant and A[i, j] == A[0, j]
        if constant:
            return k, True
        small = 0
        for i in range(N):
            small += abs(A[i, j]) < 0.125 * largest
        if small < fewest:
            fewest = small
            best = k
    return best, False


@kernel
def _power_of_two(x: float) -> float:
    """Return the power of two nearest to x > 0, within 2^-200 to 2^200."""
    exponent = float(np.round(np.log2(x)))
    return float(2.0 ** min(max(exponent, -200.0), 200.0))


@kernel
def _middle(values: NDArray[np.float64]) -> float:
    """Return the median of the entries (it sorts them)."""
    for j in range(1, values.shape[0]):
        value = values[j]
        k = j
        while k > 0 and values[k - 1] > value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value
    return float(values[values.shape[0] // 2])


@kernel
def _divide(
    A: NDArray[np.float64],
    b: NDArray[np.float64],
    limit: float,
    columns: NDArray[np.int64],
    constant: bool,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    reach: NDArray[np.float64],
    order: NDArray[np.int64],
) -> tuple[int, int, int, int]:
    """Write x, y, l (`reach`) and the point of each strip (`order`); return what `make_strips` returns."""
    N = A.shape[0]
    k = columns.shape[0] - 1
    scale = np.ones(3)
    for j in range(k + 1):
        largest = 0.0
        for i in range(N):
            largest = max(largest, abs(A[i, columns[j]]))
        scale[j] = 1.0 / _power_of_two(largest) if largest > 0.0 else 1.0
    largest = limit
    for i in range(N):
        largest = max(largest, abs(b[i]))
    to_y = 1.0 / _power_of_two(largest)

    n = 0
    n_regular = 0
    always = 0
    left_out = 0
    for flat in range(2):
        for i in range(N):
            c = 1.0 if constant else A[i, columns[k]] * scale[k]
            if (c == 0.0) != (flat == 1):
                continue
            if flat:
                c = 1.0
            size = 0.0
            for j in range(k):
                x[j, n] = A[i, columns[j]] * scale[j] / c
                size = max(size, abs(x[j, n]))
            y[n] = b[i] * to_y / c
            reach[n] = limit * to_y / abs(c)
            if flat and size == 0.0:
                if abs(b[i]) <= limit:
                    always += 1
                    order[N - always] = i
            elif not (max(size, abs(y[n])) < EXTREME and 1.0 / EXTREME < reach[n] < EXTREME):
                left_out += 1
            else:
                order[n] = i
                n += 1
        if flat == 0:
            n_regular = n
    return n_regular, n, always, left_out


@kernel
def _centre(
    row: NDArray[np.float64],
    n_regular: int,
    exact: bool,
    draws: NDArray[np.float64],
    size: NDArray[np.float64],
) -> None:
    """Centre the regular part of a column at a sampled median; write the sizes of what was rounded to `size`."""
    values = np.empty(SAMPLES)
    for q in range(SAMPLES):
        values[q] = row[int(draws[q, 0] * n_regular)]
    centre = _middle(values)
    for i in range(row.shape[0]):
        size[i] = abs(row[i])
        if i < n_regular:
            row[i] -= centre
            size[i] = abs(row[i]) if exact else size[i] + abs(centre)


@kernel
def _decorrelate(
    x: NDArray[np.float64], n: int, n_regular: int, draws: NDArray[np.float64], size: NDArray[np.float64]
) -> None:
    """Subtract a multiple of column 1 from column 0 where they correlate: narrow valleys make many boxes.

    The factor has 8 bits, so that data on a grid stay on a grid.
    """
    xx = xy = yy = 0.0
    for q in range(SAMPLES):
        i = int(draws[q, 1] * n_regular)
        xx += x[0, i] * x[0, i]
        xy += x[0, i] * x[1, i]
        yy += x[1, i] * x[1, i]
    if not (0.5 * xx * yy < xy * xy < np.inf):
        return
    factor = xy / yy
    unit = _power_of_two(abs(factor)) / 256.0
    factor = np.round(factor / unit) * unit
    for i in range(n):
        step = factor * x[1, i]
        x[0, i] -= step
        size[i] += abs(step)


@kernel
def _sample_model(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    reach: NDArray[np.float64],
    k: int,
    n_regular: int,
    draws: NDArray[np.float64],
    model: NDArray[np.float64],
) -> None:
    """Write the best (s_0, s_1, t) of some minimal samples of regular strips into `model`."""
    tested = min(n_regular, 3 * SAMPLES)
    x0, x1, yt, lt = np.empty(tested), np.empty(tested), np.empty(tested), np.empty(tested)
    width0 = width1 = height = 0.0
    for e in range(tested):
        i = e if tested == n_regular else int(draws[e // 3, e % 3] * n_regular)
        x0[e], x1[e], yt[e], lt[e] = x[0, i], x[1, i], y[i], reach[i]
        width0 = max(width0, abs(x0[e]))
        width1 = max(width1, abs(x1[e]))
        height = max(height, abs(yt[e]), lt[e])
    values = np.empty(SAMPLES)
    for q in range(SAMPLES):
        values[q] = y[int(draws[q, 0] * n_regular)]
    model[0] = model[1] = 0.0
    model[2] = _middle(values)
    best = 0
    for q in range(SAMPLES):
        i = int(draws[q, 0] * n_regular)
        j = int(draws[q, 1] * n_regular)
        m = int(draws[q, 2] * n_regular)
        p0, p1, py = x[0, j] - x[0, i], x[1, j] - x[1, i], y[j] - y[i]
        q0, q1, qy = x[0, m] - x[0, i], x[1, m] - x[1, i], y[m] - y[i]
        if k == 1:
            q0, q1, qy = 0.0, 1.0, 0.0
        run = p0 * q1 - p1 * q0
        if run == 0.0:
            continue
        s0 = (py * q1 - p1 * qy) / run
        s1 = (p0 * qy - py * q0) / run
        t = y[i] - s0 * x[0, i] - s1 * x[1, i]
        if not (abs(s0) * width0 + abs(s1) * width1 + abs(t) <= STEEP * height):
            continue  # of a singular sample, or nearly so: moving to it would amplify rounding
        count = 0
        for e in range(tested):
            count += abs(yt[e] - s0 * x0[e] - s1 * x1[e] - t) <= lt[e]
        if count > best:
            best = count
            model[0], model[1], model[2] = s0, s1, t


@kernel
def _unit(row: NDArray[np.float64], n_regular: int, height: float, draws: NDArray[np.float64]) -> float:
    """Return the unit of a parameter: a power of two, a change by which moves most edges by about `height`."""
    values = np.empty(SAMPLES)
    for q in range(SAMPLES):
        values[q] = abs(row[int(draws[q, 1] * n_regular)])
    spread = _middle(values)
    if spread == 0.0:
        for i in range(row.shape[0]):
            spread = max(spread, abs(row[i]))
    return _power_of_two(height / spread) if spread > 0.0 else 1.0


@kernel
def make_strips(
    A: NDArray[np.float64],
    b: NDArray[np.float64],
    limit: float,
    columns: NDArray[np.int64],
    constant: bool,
    draws: NDArray[np.float64],
    fields: NDArray[np.float64],
    order: NDArray[np.int64],
) -> tuple[int, int, int, int]:
    """Fill `fields` and `order`; the sampled model becomes sigma = 0, w = 1, tau = 0.

    Parameters
    ----------
    A, b, limit
        The data, shapes (N, d) and (N,), and the largest residual of an inlier.
    columns
        The r <= 3 independent columns of A, the stabbing column last.
    constant
        Whether that one is constant.
    draws
        Shape (SAMPLES, 3): random numbers in [0, 1).
    fields
        Output, shape (6, N): the arrays of `Strips`, in their order, as long as there are strips.
    order
        Output, shape (N,): the point of each strip.

    Returns
    -------
    The number of regular strips, of strips, of points that are always inliers (their indices are at the end of
    `order`), and of points left out because their numbers are extreme.
    """
    N = A.shape[0]
    k = columns.shape[0] - 1
    x, size = np.zeros((2, N)), np.zeros((2, N))
    y, reach = np.empty(N), np.empty(N)
    n_regular, n, always, left_out = _divide(A, b, limit, columns, constant, x, y, reach, order)
    model = np.zeros(3)
    if n_regular > 0:
        for j in range(k):
            _centre(x[j, :n], n_regular, constant, draws, size[j])
        if k == 2:
            _decorrelate(x, n, n_regular, draws, size[0])
        _sample_model(x, y, reach, k, n_regular, draws, model)

    a0, a1, low, high, pad, grain = fields[0], fields[1], fields[2], fields[3], fields[4], fields[5]
    for i in range(n):
        offset = model[2] if i < n_regular else 0.0
        pad[i] = abs(y[i]) + abs(offset) + reach[i]
        y[i] -= offset
        for j in range(k):
            y[i] -= x[j, i] * model[j]
            pad[i] += (abs(x[j, i]) + size[j, i]) * abs(model[j])
    unit0 = unit1 = 1.0
    if n_regular > 0:
        values = np.empty(SAMPLES)
        for q in range(SAMPLES):
            i = int(draws[q, 2] * n_regular)
            values[q] = max(abs(y[i]), 2.0 * reach[i])
        height = _middle(values)
        unit0 = _unit(x[0, :n], n_regular, height, draws)
        unit1 = _unit(x[1, :n], n_regular, height, draws)
    for i in range(n):
        a0[i] = x[0, i] * unit0
        a1[i] = x[1, i] * unit1
        low[i] = y[i] - reach[i]
        high[i] = y[i] + reach[i]
        grain[i] = ROUNDING * (size[0, i] * unit0 + size[1, i] * unit1)
        pad[i] = ROUNDING * (pad[i] + abs(y[i]))
    return n_regular, n, always, left_out


@kernel
def dependent_rows(strips: Strips, members: NDArray[np.int32], k: int) -> bool:
    """Whether the rows (a_i, 1), or (a_i, 0) where flat, of `members` (regular ones first) have rank k or less.

    Up to their rounding; k = 1 or 2.
    """
    a0, a1, grain = strips.a0, strips.a1, strips.grain
    here = members[0]
    if here >= strips.n_regular:
        return True
    far = -1
    distance = 0.0
    v0, v1 = 1.0, 0.0
    for i in members:  # how far do the a_i go from the first one?
        d0, d1 = a0[i], a1[i]
        if i < strips.n_regular:
            d0, d1 = d0 - a0[here], d1 - a1[here]
            if max(abs(d0), abs(d1)) <= 4.0 * (grain[i] + grain[here]):
                continue
        if k == 1:
            return False
        if max(abs(d0), abs(d1)) > distance:
            far = i
            distance = max(abs(d0), abs(d1))
            v0, v1 = d0, d1
    if far < 0:
        return True
    v0, v1 = v0 / distance, v1 / distance
    error = 4.0 * (grain[here] + grain[far]) / distance
    for i in members:  # and do all go in that direction?
        d0, d1 = a0[i], a1[i]
        if i < strips.n_regular:
            d0, d1 = d0 - a0[here], d1 - a1[here]
        tolerance = 4.0 * (grain[i] + grain[here]) + error * max(abs(d0), abs(d1))
        if abs(d0 * v1 - d1 * v0) > tolerance:
            return False
    return True
