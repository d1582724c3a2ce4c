"""Kernels of exact stabbing: a best-first branch and bound over prisms of parameters.

A *prism* is a box of the outer parameters (sigma, w) on a face of the cube (see `stabbing_rows`), times a window of
tau. Over the box each edge of a strip moves by no more than its *radius*, so that for each point there is an
outer interval of tau that holds every tau at which the point is an inlier somewhere in the box, and an inner
one in which it is an inlier everywhere in the box. No model in the prism has more inliers than the deepest stabbing
of the outer intervals.

Two things make that cheap. The depth is counted in bins: an interval counts for every bin that it meets, so nothing
is sorted, and since the bin of a number is a monotone function of it, in floating arithmetic too, rounding cannot
lose a point. And only the bins that are deeper than the best consensus matter: the window shrinks to their hull, the
points whose outer interval misses the window are out of the whole prism, those whose inner interval holds it are
in for all of it (the prism's *base*), and children look at the others only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel
from maxcon.search.stabbing_rows import Strips

#: A box with no longer half edge is not split: its corners and centres are still exact floats at this size.
SMALLEST_HALF = 2.0**-50

#: Up to so many undecided points the best model at the centre of a box is found by comparing all pairs.
FEW = 24

#: Work for one prism, on top of one unit a point.
PRISM_WORK = 64

#: Nodes kept free for diving, when no more may be allocated: two axes of 50 halvings leave a sibling each.
RESERVE = 128

# Places in Tree.state.
BEST = 0  #     the largest consensus found (or known to be beaten), among the strips
TOP = 1  #      no open node of the queue has a larger bound
CEILING = 2  #  the largest bound of the nodes that had to be given up
NODE = 3  #     the node that the caller is asked about, or -1
FREE = 4  #     first of the freed nodes, linked
USED = 5  #     nodes ever used
STACK = 6  #    first of the nodes of a dive, linked
OPEN = 7  #     nodes in queue and stack
FILL = 8  #     arena in use
GARBAGE = 9  #  of which freed
ROOTS = 10  #   roots still to be bounded
CAPPED = 11  #  1: make do with the memory there is
EXPANDED = 12  # how many nodes have been split
N_STATE = 13

# Why `advance` came back.
PROVEN = 0
TIRED = 1  #     the budget is spent
FULL = 2  #      more memory, please
DEPENDENT = 3  # the box holds "infinitely steep" models, and its points are of lower rank: a smaller problem
TOO_SMALL = 4  # the box is too small to be split


class Tree(NamedTuple):
    """The open prisms, and scratch space.

    Attributes
    ----------
    boxes
        Shape (nodes, 8): centre of (sigma_0, sigma_1, w), half edges, window of tau.
    bound, base
        Shape (nodes,): upper bound; how many points are inliers in all of the prism.
    start, size
        Shape (nodes,): where the undecided points of the node are in `arena`; start -1: nowhere (all points).
    link
        Shape (nodes,): next node in the same list.
    head
        Shape (n + 1,): for each bound the first node of the queue that has it, last in, first out; or -1.
    arena
        Lists of points, each after a header of two: node and length.
    everything
        Shape (n,): 0 to n - 1.
    state
        Shape (N_STATE,): counters, see above.
    model
        Shape (4,): sigma, w, tau of the best model.
    box, kept, edges, bins
        The prism being bounded: shape (8,); its undecided points, shape (n,); the ends of their intervals, shape (4, n):
        lower outer, lower inner, upper inner, upper outer; and bins.
    """

    boxes: NDArray[np.float64]
    bound: NDArray[np.int64]
    base: NDArray[np.int64]
    start: NDArray[np.int64]
    size: NDArray[np.int64]
    link: NDArray[np.int64]
    head: NDArray[np.int64]
    arena: NDArray[np.int32]
    everything: NDArray[np.int32]
    state: NDArray[np.int64]
    model: NDArray[np.float64]
    box: NDArray[np.float64]
    kept: NDArray[np.int32]
    edges: NDArray[np.float64]
    bins: NDArray[np.int32]


@kernel
def _admit(
    strips: Strips,
    members: NDArray[np.int32],
    box: NDArray[np.float64],
    kept: NDArray[np.int32],
    edges: NDArray[np.float64],
) -> tuple[int, int, int, float]:
    """Keep the members that the prism leaves undecided.

    Returns how many are in for all of it, how many are kept, how many of these are regular (the first ones), and the sum
    of the radii of these.
    """
    a0, a1, low, high, pad = strips.a0, strips.a1, strips.low, strips.high, strips.pad
    c0, c1, cw, h0, h1, hw, t0, t1 = box[0], box[1], box[2], box[3], box[4], box[5], box[6], box[7]
    e0, e1, e2, e3 = edges[0], edges[1], edges[2], edges[3]
    base = 0
    m = 0
    regular = -1
    radii = 0.0
    for j in range(members.shape[0]):
        i = members[j]
        if i >= strips.n_regular and regular < 0:  # from here on all are flat: tau = 0 whatever the model
            regular = m
            t0 = t1 = 0.0
        radius = abs(a0[i]) * h0 + abs(a1[i]) * h1 + pad[i]
        shift = a0[i] * c0 + a1[i] * c1
        lower = low[i] * cw - shift
        upper = high[i] * cw - shift
        lower_radius = radius + abs(low[i]) * hw
        upper_radius = radius + abs(high[i]) * hw
        kept[m] = i
        e0[m] = lower - lower_radius
        e1[m] = lower + lower_radius
        e2[m] = upper - upper_radius
        e3[m] = upper + upper_radius
        possible = (e0[m] <= t1) & (e3[m] >= t0)
        certain = (e1[m] <= t0) & (e2[m] >= t1)
        undecided = possible & (not certain)  # without branches: which way they go cannot be predicted
        base += possible & certain
        radii += undecided * lower_radius
        m += undecided
    if regular < 0:
        regular = m
    return base, m, regular, radii


@kernel
def _narrow(
    box: NDArray[np.float64], kept: NDArray[np.int32], edges: NDArray[np.float64], m: int, regular: int
) -> tuple[int, int, int]:
    """Drop from the list what the window, now smaller, decides; return (in for all, kept, of these regular)."""
    t0, t1 = box[6], box[7]
    e0, e1, e2, e3 = edges[0], edges[1], edges[2], edges[3]
    base = 0
    n = 0
    for j in range(regular):
        kept[n] = kept[j]
        e0[n], e1[n], e2[n], e3[n] = e0[j], e1[j], e2[j], e3[j]
        possible = (e0[n] <= t1) & (e3[n] >= t0)
        certain = (e1[n] <= t0) & (e2[n] >= t1)
        base += possible & certain
        n += possible & (not certain)
    left = n
    for j in range(regular, m):
        kept[n] = kept[j]
        e0[n], e1[n], e2[n], e3[n] = e0[j], e1[j], e2[j], e3[j]
        n += 1
    return base, n, left


@kernel
def _profile(
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    n: int,
    t0: float,
    scale: float,
    n_bins: int,
    bins: NDArray[np.int32],
    need: int,
) -> tuple[int, int, int, float]:
    """Count in bins how deep n intervals lie on each other.

    Returns the greatest depth above `need`, the first and the last bin that are deeper than `need` (-1: none is), and
    the middle of the deepest ones, in bins.
    """
    for k in range(n_bins + 1):
        bins[k] = 0
    last = n_bins - 1.0
    for j in range(n):
        bins[int(min(max((lower[j] - t0) * scale, 0.0), last))] += 1
        bins[int(min(max((upper[j] - t0) * scale, 0.0), last)) + 1] -= 1
    depth = 0
    deepest = need
    first = -1
    end = -1
    begin_deepest = 0
    end_deepest = 0
    for k in range(n_bins):
        depth += bins[k]
        if depth > need:
            if first < 0:
                first = k
            end = k
            if depth > deepest:
                deepest = depth
                begin_deepest = end_deepest = k
            elif depth == deepest and end_deepest == k - 1:
                end_deepest = k
    return deepest, first, end, 0.5 * (begin_deepest + end_deepest + 1)


@kernel
def _try_centre(tree: Tree, base: int, m: int, regular: int, tau: float) -> None:
    """Count the inliers of a model at the centre of the box, at the best tau if the undecided are few; keep the best."""
    e0, e1, e2, e3 = tree.edges[0], tree.edges[1], tree.edges[2], tree.edges[3]
    box = tree.box
    depth = 0
    if regular <= FEW:
        for j in range(regular):
            bottom = e0[j] + e1[j]  # twice the lower edge at the centre
            count = 0
            ceiling = np.inf
            for k in range(regular):
                if e0[k] + e1[k] <= bottom <= e2[k] + e3[k]:
                    count += 1
                    ceiling = min(ceiling, e2[k] + e3[k])
            if count > depth:
                depth = count
                tau = 0.25 * (bottom + ceiling)
        tau = min(max(tau, box[6]), box[7])
    count = base
    for j in range(regular):
        count += (e0[j] + e1[j] <= 2.0 * tau) & (e2[j] + e3[j] >= 2.0 * tau)
    for j in range(regular, m):
        count += (e0[j] + e1[j] <= 0.0) & (e2[j] + e3[j] >= 0.0)
    if count > tree.state[BEST]:
        tree.state[BEST] = count
        tree.model[0], tree.model[1], tree.model[2], tree.model[3] = box[0], box[1], box[2], tau


@kernel
def _bound(strips: Strips, tree: Tree, members: NDArray[np.int32], base: int) -> tuple[int, int, int]:
    """Bound the prism in `tree.box`; `members` are its parent's undecided points and `base` the parent's.

    Returns the bound, the base and how many points are left in `tree.kept`. The window of `tree.box` has shrunk, and
    `tree.model` may have improved. Where the bound is not above the best, the rest is meaningless.
    """
    box, kept, edges = tree.box, tree.kept, tree.edges
    best = tree.state[BEST]
    certain, m, regular, radii = _admit(strips, members, box, kept, edges)
    base += certain
    flat = m - regular
    if base + m <= best:
        return base + m, base, m
    lower, upper = edges[0], edges[3]
    if box[6] == -np.inf and regular > 0:
        box[6], box[7] = np.inf, -np.inf
        for j in range(regular):
            box[6] = min(box[6], lower[j])
            box[7] = max(box[7], upper[j])
    bound = base + m
    tau = box[6]
    while regular > 0:
        t0, t1 = box[6], box[7]
        wanted = (
            2.0 * (t1 - t0) * regular / radii
        )  # bins of half a radius blur the edges little more than the box
        n_bins = int(max(8.0, min(wanted, 4.0 * regular, tree.bins.shape[0] - 1.0)))
        scale = n_bins / (t1 - t0)
        if not scale < np.inf:
            break
        depth, first, end, middle = _profile(
            lower, upper, regular, t0, scale, n_bins, tree.bins, best - base - flat
        )
        if first < 0:
            return best, base, m
        bound = base + flat + depth
        step = (t1 - t0) / n_bins
        tau = t0 + middle * step
        rounding = 1e-14 * (abs(t0) + abs(t1))  # that of bin edges: some 10 units
        box[6] = max(t0, t0 + first * step - rounding)
        box[7] = min(t1, t0 + (end + 1) * step + rounding)
        certain, m, regular = _narrow(box, kept, edges, m, regular)
        base += certain
        if n_bins >= wanted or box[7] - box[6] > 0.5 * (t1 - t0):
            break
    _try_centre(tree, base, m, regular, tau)
    return min(bound, base + m), base, m


@kernel
def _store(tree: Tree, bound: int, base: int, m: int, listed: bool, dive: bool) -> None:
    """Open a node for the prism in `tree.box`, in the queue or on the stack of a dive."""
    state = tree.state
    node = state[FREE]
    if node >= 0:
        state[FREE] = tree.link[node]
    else:
        node = state[USED]
        state[USED] += 1
    for j in range(8):
        tree.boxes[node, j] = tree.box[j]
    tree.bound[node] = bound
    if listed:
        fill = state[FILL]
        tree.arena[fill] = node
        tree.arena[fill + 1] = m
        for j in range(m):
            tree.arena[fill + 2 + j] = tree.kept[j]
        state[FILL] = fill + 2 + m
        tree.start[node] = fill + 2
        tree.size[node] = m
        tree.base[node] = base
    else:
        tree.start[node] = -1
        tree.size[node] = 0
        tree.base[node] = 0
    if dive:
        tree.link[node] = state[STACK]
        state[STACK] = node
    else:
        tree.link[node] = tree.head[bound]
        tree.head[bound] = node
        state[TOP] = max(state[TOP], bound)
    state[OPEN] += 1


@kernel
def _release(tree: Tree, node: int) -> None:
    """Give a node that is in no list any more, and its points, back."""
    if tree.start[node] >= 0:
        tree.state[GARBAGE] += tree.size[node] + 2
    tree.start[node] = -1
    tree.link[node] = tree.state[FREE]
    tree.state[FREE] = node


@kernel
def _compact(tree: Tree) -> None:
    """Move the lists that are in use together."""
    arena, state = tree.arena, tree.state
    read = 0
    write = 0
    while read < state[FILL]:
        node = arena[read]
        length = arena[read + 1] + 2
        if tree.start[node] == read + 2:
            tree.start[node] = write + 2
            for j in range(length):
                arena[write + j] = arena[read + j]
            write += length
        read += length
    state[FILL] = write
    state[GARBAGE] = 0


@kernel
def node_points(tree: Tree, node: int) -> NDArray[np.int32]:
    """Return the undecided points of a node."""
    if tree.start[node] < 0:
        return tree.everything
    return tree.arena[tree.start[node] : tree.start[node] + tree.size[node]]


@kernel
def dependent_rows(strips: Strips, members: NDArray[np.int32], k: int) -> tuple[bool, float, float]:
    """Whether these rows (a_i, 1), or (a_i, 0) where flat, have rank k or less, up to their rounding; k = 1 or 2.

    Returns also the direction v along which all a_i differ (k = 2), with 1 as its larger component.
    """
    a0, a1, grain = strips.a0, strips.a1, strips.grain
    far = -1
    distance = 0.0
    here = members[0]
    for i in members:
        d0, d1 = a0[i], a1[i]
        if i < strips.n_regular:
            d0, d1 = d0 - a0[here], d1 - a1[here]
            if max(abs(d0), abs(d1)) <= 4.0 * (grain[i] + grain[here]):
                continue
        if k == 1:
            return False, 1.0, 0.0
        if max(abs(d0), abs(d1)) > distance:
            far = i
            distance = max(abs(d0), abs(d1))
            v0, v1 = d0, d1
    if far < 0:
        return True, 1.0, 0.0
    if k == 1:
        return False, 1.0, 0.0
    v0, v1 = v0 / distance, v1 / distance
    error = 4.0 * (grain[here] + grain[far]) / distance
    for i in members:
        d0, d1 = a0[i], a1[i]
        if i < strips.n_regular:
            d0, d1 = d0 - a0[here], d1 - a1[here]
        tolerance = 4.0 * (grain[i] + grain[here]) + error * max(abs(d0), abs(d1))
        if abs(d0 * v1 - d1 * v0) > tolerance:
            return False, v0, v1
    return True, v0, v1


@kernel
def _solved(strips: Strips, members: NDArray[np.int32]) -> bool:
    """Whether all these points belong to one group of dependent rows that has been solved."""
    common = strips.marks[members[0]]
    for i in members:
        common &= strips.marks[i]
        if common == 0:
            return False
    return True


@kernel
def _take(tree: Tree, gap: int) -> int:
    """Take the next node out of its list: from a dive, else the one with the largest bound; -1 if none is needed."""
    state = tree.state
    while state[STACK] >= 0:
        node = state[STACK]
        state[STACK] = tree.link[node]
        state[OPEN] -= 1
        if tree.bound[node] > state[BEST]:
            return node
        _release(tree, node)
    while state[TOP] > state[BEST] + gap and tree.head[state[TOP]] < 0:
        state[TOP] -= 1
    if state[TOP] <= state[BEST] + gap:
        return -1
    node = tree.head[state[TOP]]
    tree.head[state[TOP]] = tree.link[node]
    state[OPEN] -= 1
    return node


@kernel
def _put_back(tree: Tree, node: int) -> None:
    bound = tree.bound[node]
    tree.link[node] = tree.head[bound]
    tree.head[bound] = node
    tree.state[OPEN] += 1


@kernel
def _room_for_lists(tree: Tree, n: int) -> bool:
    """Whether two more lists of n points fit; freed ones make room if they are many."""
    state = tree.state
    needed = 2 * n + 4
    if state[FILL] + needed > tree.arena.shape[0] and 4 * state[GARBAGE] >= tree.arena.shape[0]:
        _compact(tree)
    return state[FILL] + needed <= tree.arena.shape[0]


@kernel
def _split(strips: Strips, tree: Tree, node: int, axis: int, listed: bool) -> None:
    """Halve the box of a node across `axis`; open the halves that may hold something better."""
    state = tree.state
    n_nodes = tree.bound.shape[0]
    half = 0.5 * tree.boxes[node, 3 + axis]
    for side in range(2):
        for j in range(8):
            tree.box[j] = tree.boxes[node, j]
        tree.box[3 + axis] = half
        tree.box[axis] += half if side else -half
        bound, base, m = _bound(strips, tree, node_points(tree, node), tree.base[node])
        bound = min(bound, tree.bound[node])
        if bound > state[BEST]:
            _store(tree, bound, base, m, listed, state[OPEN] + 2 > n_nodes - RESERVE)
    state[EXPANDED] += 1


@kernel
def advance(strips: Strips, tree: Tree, roots: NDArray[np.float64], k: int, budget: int, gap: int) -> int:
    """Search until `budget` units of work (a point in a prism each) are spent, or there is a reason to come back.

    Parameters
    ----------
    strips, tree
        The points and the state of the search.
    roots
        Shape (faces, 8): the prisms to begin with.
    k
        How many outer parameters there are, 1 or 2.
    budget, gap
        When to come back, and which gap is small enough.
    """
    state = tree.state
    if state[NODE] >= 0:
        _release(tree, state[NODE])
        state[NODE] = -1
    work = 0
    while work < budget:
        if state[ROOTS] > 0:
            tree.box[:] = roots[roots.shape[0] - state[ROOTS]]
            state[ROOTS] -= 1
            bound, base, m = _bound(strips, tree, tree.everything, 0)
            if bound > state[BEST]:
                _store(tree, bound, base, m, True, False)
            work += tree.everything.shape[0] + PRISM_WORK
            continue
        node = _take(tree, gap)
        if node < 0:
            return PROVEN
        box = tree.boxes[node]
        if 0.0 < box[2] <= box[5]:
            points = node_points(tree, node)
            if _solved(strips, points):
                _release(tree, node)
                continue
            if dependent_rows(strips, points, k)[0]:
                state[NODE] = node
                return DEPENDENT
        axis = 0
        for j in range(1, 3):
            if box[3 + j] > box[3 + axis]:
                axis = j
        if 0.5 * box[3 + axis] < SMALLEST_HALF:
            state[NODE] = node
            return TOO_SMALL
        n = node_points(tree, node).shape[0]
        listed = _room_for_lists(tree, n)
        crowded = state[FREE] < 0 and state[USED] + 2 > tree.bound.shape[0] - RESERVE
        if state[CAPPED] == 0 and (crowded or not listed):
            _put_back(tree, node)
            return FULL
        _split(strips, tree, node, axis, listed)
        work += 2 * (n + PRISM_WORK)
        _release(tree, node)
    return TIRED


@kernel
def inliers(strips: Strips, model: NDArray[np.float64], mask: NDArray[np.bool_]) -> int:
    """Write which strips hold the model (sigma, w, tau) into `mask`; return how many do."""
    count = 0
    for i in range(mask.shape[0]):
        value = strips.a0[i] * model[0] + strips.a1[i] * model[1]
        if i < strips.n_regular:
            value += model[3]
        mask[i] = strips.low[i] * model[2] <= value <= strips.high[i] * model[2]
        count += mask[i]
    return count
