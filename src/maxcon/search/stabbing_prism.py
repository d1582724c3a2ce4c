"""Kernels of exact stabbing: how many inliers a model in one prism can have.

A *prism* is a box of the outer parameters (sigma, w) on a face of the cube (see `stabbing_rows`), times a window
of tau. Over the box each edge of a strip moves by no more than its *radius*. So each point has an outer
interval, which holds every tau at which it is an inlier somewhere in the box, and an inner interval, in which it is
an inlier everywhere in the box. No model in the prism has more inliers than the deepest stabbing of the outer
intervals.

Two things make that cheap. The depth is counted in bins: an interval counts for every bin that it meets, so
nothing is sorted; and since the bin of a number is a monotone function of it, in floating arithmetic too, rounding
cannot lose a point. And only the bins that are deeper than the best consensus matter: the window shrinks to their
hull; points whose outer interval misses the window are out of all of the prism, those whose inner interval
holds it are in for all of it (they make its *base*), and the parts of the prism look at the others only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel
from maxcon.search.stabbing_rows import Strips

#: Up to so many undecided points the depth is found by comparing all pairs: exact, and no slower than bins.
FEW = 24

#: The error of what is made for a prism (edges of bins, the slope to stab along), relative to the numbers that it is
#: made of: that of some 10 operations, and room.
OWN_ROUNDING = 1e-14

#: A window that is no longer than this is a point.
TINY = 1e-290

#: A box is too small to be split where its size moves the edges by so much less than rounding may have done.
TOO_FINE = 2.0**-6

#: Half an edge of a box, relative to its centre, is at least this: so all centres and corners are exact floats.
EXACT = 2.0**-50

#: A window so many times as wide as an average radius (or with bins so many times as wide as they should be) is halved
#: instead of the box: then narrow peaks of the depth lie far apart in it, and smaller boxes gain nothing.
COARSE = 16.0

# Places in a box.
CENTRE, HALF, WINDOW = 0, 3, 6  # (sigma_0, sigma_1, w), three half edges, two ends of the window
SPREAD, AXIS = 8, 9  # how coarse the window is, and the axis that moves the edges most (-1: none enough)
DOUBT = 10  # how often the prism has been split since nothing but all of its points could beat the best
BOX_SIZE = 11

#: The window of tau as an axis to split across.
TAU = 3


class Prism(NamedTuple):
    """The prism that is being bounded, and the best model so far.

    Attributes
    ----------
    box
        Shape (BOX_SIZE,): see the places above.
    kept
        Shape (n,): its undecided points, regular ones first.
    edges
        Shape (4, n): the ends of their intervals: lower outer, lower inner, upper inner, upper outer.
    bins
        Scratch space.
    best
        Shape (1,): the largest consensus found, or known to be beaten, among the strips.
    model
        Shape (4,): sigma_0, sigma_1, w and tau of the best model.
    """

    box: NDArray[np.float64]
    kept: NDArray[np.int32]
    edges: NDArray[np.float64]
    bins: NDArray[np.int32]
    best: NDArray[np.int64]
    model: NDArray[np.float64]


@kernel
def _enclose(
    strips: Strips, members: NDArray[np.int32], box: NDArray[np.float64], edges: NDArray[np.float64]
) -> tuple[float, float, float, float]:
    """Write the ends of the intervals of `members` over the box.

    Returns what sigma_0, sigma_1, w and rounding contribute to the sum of the radii.
    """
    a0, a1, low, high = strips.a0, strips.a1, strips.low, strips.high
    pad, grain = strips.pad, strips.grain
    c0, c1, cw = box[CENTRE], box[CENTRE + 1], box[CENTRE + 2]
    h0, h1, hw = box[HALF], box[HALF + 1], box[HALF + 2]
    e0, e1, e2, e3 = edges[0], edges[1], edges[2], edges[3]
    by0 = by1 = byw = by_rounding = 0.0
    for j in range(members.shape[0]):
        i = members[j]
        r0 = abs(a0[i]) * h0
        r1 = abs(a1[i]) * h1
        rw = abs(low[i]) * hw
        rounding = grain[i] + pad[i] * (cw + hw)
        shift = a0[i] * c0 + a1[i] * c1
        lower = low[i] * cw - shift
        upper = high[i] * cw - shift
        radius = r0 + r1 + rounding
        upper_radius = radius + abs(high[i]) * hw
        radius += rw
        e0[j] = lower - radius
        e1[j] = lower + radius
        e2[j] = upper - upper_radius
        e3[j] = upper + upper_radius
        by0 += r0
        by1 += r1
        byw += rw
        by_rounding += rounding
    return by0, by1, byw, by_rounding


@kernel
def _sift(
    kept: NDArray[np.int32],
    edges: NDArray[np.float64],
    first: int,
    last: int,
    to: int,
    t0: float,
    t1: float,
) -> tuple[int, int]:
    """Move those of the places first to last - 1 that [t0, t1] leaves undecided to place `to` and on.

    Returns how many are in for all of [t0, t1], and the place after the last one moved.
    """
    e0, e1, e2, e3 = edges[0], edges[1], edges[2], edges[3]
    base = 0
    for j in range(first, last):
        x0, x1, x2, x3 = e0[j], e1[j], e2[j], e3[j]
        kept[to] = kept[j]
        e0[to], e1[to], e2[to], e3[to] = x0, x1, x2, x3
        possible = (x0 <= t1) & (x3 >= t0)
        certain = (x1 <= t0) & (x2 >= t1)
        base += possible & certain
        to += possible & (not certain)  # without branches: which way they go cannot be predicted
    return base, to


@kernel
def _narrow(prism: Prism, m: int, regular: int) -> tuple[int, int, int]:
    """Drop from the list what the window decides; return (in for all of the prism, kept, of these regular)."""
    box, kept, edges = prism.box, prism.kept, prism.edges
    base, left = _sift(kept, edges, 0, regular, 0, box[WINDOW], box[WINDOW + 1])
    flat_base, n = _sift(kept, edges, regular, m, left, 0.0, 0.0)  # the flat ones know no window: tau = 0
    return base + flat_base, n, left


@kernel
def _profile(
    edges: NDArray[np.float64],
    n: int,
    t0: float,
    t1: float,
    n_bins: int,
    bins: NDArray[np.int32],
    need: int,
) -> tuple[int, float, float, float]:
    """Count in bins how deep n outer intervals lie on each other in [t0, t1].

    Returns the depth, the hull of the bins deeper than `need` (widened for rounding), and the middle of the deepest.
    Where none is deeper, the depth is `need` and the rest meaningless.
    """
    for k in range(n_bins + 1):
        bins[k] = 0
    lower, upper = edges[0], edges[3]
    scale = n_bins / (t1 - t0)
    last = n_bins - 1.0
    for j in range(n):
        bins[int(min(max((lower[j] - t0) * scale, 0.0), last))] += 1
        bins[int(min(max((upper[j] - t0) * scale, 0.0), last)) + 1] -= 1
    depth = 0
    deepest = need
    begin = -1
    end = -1
    deepest_begin = 0
    deepest_end = 0
    for k in range(n_bins):
        depth += bins[k]
        if depth > need:
            if begin < 0:
                begin = k
            end = k
            if depth > deepest:
                deepest = depth
                deepest_begin = deepest_end = k
            elif depth == deepest and deepest_end == k - 1:
                deepest_end = k
    step = (t1 - t0) / n_bins
    rounding = OWN_ROUNDING * (abs(t0) + abs(t1))
    hull_begin = max(t0, t0 + begin * step - rounding)
    hull_end = min(t1, t0 + (end + 1) * step + rounding)
    return deepest, hull_begin, hull_end, t0 + 0.5 * (deepest_begin + deepest_end + 1) * step


@kernel
def _compare(edges: NDArray[np.float64], n: int, t0: float, t1: float, need: int) -> tuple[int, float, float]:
    """Find how deep n outer intervals lie on each other in [t0, t1] by comparing all pairs.

    Returns the depth, and the hull of where they are deeper than `need`.
    """
    lower, upper = edges[0], edges[3]
    deepest = 0
    hull_begin, hull_end = (t0, t1) if need < 0 else (np.inf, -np.inf)
    for j in range(n):
        begin = max(lower[j], t0)
        end = min(upper[j], t1)
        at_begin = 0
        at_end = 0
        for k in range(n):
            at_begin += (lower[k] <= begin) & (upper[k] >= begin)
            at_end += (lower[k] <= end) & (upper[k] >= end)
        deepest = max(deepest, at_begin)
        if at_begin > need:
            hull_begin = min(hull_begin, begin)
        if at_end > need:
            hull_end = max(hull_end, end)
    return deepest, hull_begin, hull_end


@kernel
def _try_centre(prism: Prism, base: int, m: int, regular: int, tau: float) -> float:
    """Count the inliers at the centre of the box, at the best tau where few are undecided; keep the best model."""
    e0, e1, e2, e3 = prism.edges[0], prism.edges[1], prism.edges[2], prism.edges[3]
    box = prism.box
    if regular <= FEW:
        depth = 0
        for j in range(regular):
            bottom = e0[j] + e1[j]  # twice the lower edge at the centre
            count = 0
            top = np.inf
            for k in range(regular):
                if e0[k] + e1[k] <= bottom <= e2[k] + e3[k]:
                    count += 1
                    top = min(top, e2[k] + e3[k])
            if count > depth:
                depth = count
                tau = 0.25 * (bottom + top)
        tau = min(max(tau, box[WINDOW]), box[WINDOW + 1])
    count = base
    for j in range(regular):
        count += (e0[j] + e1[j] <= 2.0 * tau) & (e2[j] + e3[j] >= 2.0 * tau)
    for j in range(regular, m):
        count += (e0[j] + e1[j] <= 0.0) & (e2[j] + e3[j] >= 0.0)
    if count > prism.best[0]:
        prism.best[0] = count
        for j in range(3):
            prism.model[j] = box[CENTRE + j]
        prism.model[3] = tau
    return tau


@kernel
def _sheared_depth(strips: Strips, prism: Prism, regular: int, tau: float) -> int:
    """Bound the depth of the few regular undecided points by stabbing along with the box, not straight through it.

    Any affine function of (sigma, w) may be added to tau. Here it is the one that goes with the average row and with
    what is at tau, so that edges there of strips with nearly equal rows hardly move. To tell such strips apart,
    small boxes alone do not help. Spends the inner ends of the intervals.
    """
    box, kept, edges = prism.box, prism.kept, prism.edges
    c0, c1, cw = box[CENTRE], box[CENTRE + 1], box[CENTRE + 2]
    h0, h1, hw = box[HALF], box[HALF + 1], box[HALF + 2]
    m0 = m1 = 0.0
    for j in range(regular):
        i = kept[j]
        m0 += strips.a0[i]
        m1 += strips.a1[i]
    m0 /= regular
    m1 /= regular
    height = (tau + m0 * c0 + m1 * c1) / cw
    rounding = OWN_ROUNDING * (abs(m0) * h0 + abs(m1) * h1 + abs(height) * hw)
    lower, upper = edges[1], edges[2]
    for j in range(regular):
        i = kept[j]
        radius = abs(strips.a0[i] - m0) * h0 + abs(strips.a1[i] - m1) * h1
        radius += rounding + 2.0 * (strips.grain[i] + strips.pad[i] * (cw + hw))
        lower[j] = 0.5 * (edges[0, j] + edges[1, j]) - radius - abs(strips.low[i] - height) * hw
        upper[j] = 0.5 * (edges[2, j] + edges[3, j]) + radius + abs(strips.high[i] - height) * hw
    deepest = 0
    for j in range(regular):
        count = 0
        for k in range(regular):
            count += (lower[k] <= lower[j]) & (upper[k] >= lower[j])
        deepest = max(deepest, count)
    return deepest


@kernel
def _open_window(prism: Prism, regular: int) -> None:
    """Where the window is the whole line, close it around the outer intervals."""
    box, lower, upper = prism.box, prism.edges[0], prism.edges[3]
    if box[WINDOW] == -np.inf and regular > 0:
        box[WINDOW], box[WINDOW + 1] = np.inf, -np.inf
        for j in range(regular):
            box[WINDOW] = min(box[WINDOW], lower[j])
            box[WINDOW + 1] = max(box[WINDOW + 1], upper[j])


@kernel
def bound_prism(strips: Strips, prism: Prism, members: NDArray[np.int32], base: int) -> tuple[int, int, int]:
    """Bound the consensus of the models in ``prism.box``.

    Parameters
    ----------
    strips
        All points.
    prism
        The box and its window, and scratch space.
    members, base
        The undecided points of a prism that holds this one, and how many are in for all of that.

    Returns
    -------
    The bound; and, where it is above the best, the base of this prism and how many undecided points `prism.kept`
    holds. Then the window has shrunk to where the best can be beaten, and the model at the centre has been tried.
    """
    box, edges = prism.box, prism.edges
    best = prism.best[0]
    m = members.shape[0]
    regular = m
    while regular > 0 and members[regular - 1] >= strips.n_regular:
        regular -= 1
    by0, by1, byw, by_rounding = _enclose(strips, members, box, edges)
    prism.kept[:m] = members
    radius = (by0 + by1 + byw + by_rounding) / m
    box[AXIS] = 2.0 if byw >= max(by0, by1) else (1.0 if by1 > by0 else 0.0)
    if by0 + by1 + byw < TOO_FINE * by_rounding:
        box[AXIS] = -1.0
    certain, m, regular = _narrow(prism, m, regular)
    base += certain
    bound = base + m
    if bound <= best:
        return bound, base, m
    _open_window(prism, regular)
    flat = m - regular
    tau = box[WINDOW]
    box[SPREAD] = 0.0
    while regular > 0:
        t0, t1 = box[WINDOW], box[WINDOW + 1]
        need = best - base - flat
        last_round = True
        if regular <= FEW:
            depth, begin, end = _compare(edges, regular, t0, t1, need)
            box[SPREAD] = (end - begin) / radius
        else:
            wanted = 2.0 * (t1 - t0) / radius  # bins of half a radius blur the edges little more than the box
            n_bins = int(max(8.0, min(wanted, 4.0 * regular, prism.bins.shape[0] - 1.0)))
            if not t1 - t0 > TINY:
                break
            depth, begin, end, tau = _profile(edges, regular, t0, t1, n_bins, prism.bins, need)
            box[SPREAD] = wanted / n_bins
            last_round = n_bins >= wanted or end - begin > 0.5 * (t1 - t0)
        if depth <= need:
            return best, base, m
        bound = base + flat + depth
        box[WINDOW], box[WINDOW + 1] = begin, end
        certain, m, regular = _narrow(prism, m, regular)
        base += certain
        flat = m - regular
        if last_round:
            break
    tau = _try_centre(prism, base, m, regular, tau)
    bound = min(bound, base + m)
    if bound > prism.best[0] and 0 < regular <= FEW:
        bound = min(bound, base + flat + _sheared_depth(strips, prism, regular, tau))
    return bound, base, m


@kernel
def split_axis(box: NDArray[np.float64]) -> int:
    """Return the axis across which to split a prism: 0 to 2 of its box, TAU for its window, -1 if it is too small."""
    middle = 0.5 * (box[WINDOW] + box[WINDOW + 1])
    if box[SPREAD] > COARSE and box[WINDOW] < middle < box[WINDOW + 1]:
        return TAU
    axis = int(box[AXIS])
    if axis >= 0 and 0.5 * box[HALF + axis] < EXACT * abs(box[CENTRE + axis]):
        return -1
    return axis


@kernel
def take_part(box: NDArray[np.float64], axis: int, side: int, part: NDArray[np.float64]) -> None:
    """Write one half (side 0 or 1) of a prism, split across `axis`, into `part`."""
    for j in range(BOX_SIZE):
        part[j] = box[j]
    if axis == TAU:
        part[WINDOW + 1 - side] = 0.5 * (box[WINDOW] + box[WINDOW + 1])
    else:
        half = 0.5 * box[HALF + axis]
        part[HALF + axis] = half
        part[CENTRE + axis] += half if side else -half


@kernel
def inliers(strips: Strips, model: NDArray[np.float64], mask: NDArray[np.bool_]) -> None:
    """Write which strips hold the model (sigma_0, sigma_1, w, tau), up to their rounding, into `mask`."""
    for i in range(mask.shape[0]):
        value = strips.a0[i] * model[0] + strips.a1[i] * model[1]
        if i < strips.n_regular:
            value += model[3]
        rounding = strips.grain[i] + strips.pad[i] * model[2]
        mask[i] = strips.low[i] * model[2] - rounding <= value <= strips.high[i] * model[2] + rounding
