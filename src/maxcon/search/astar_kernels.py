"""Kernels of A* tree search: take the best node from the queue, make its children, bound them, queue them.

A node is a set S, named by the points that are removed from it; its level is their number. Every basis of an
infeasible S holds a point that the best set within S lacks, so the children S - i, one for each basis point
i, lead to everything that S leads to.

`advance` works in strides of one bound each at most, and may be cut short between any two of them, so that a
caller can look at the clock: *open* a node, that is, fit it and its children; *attempt* to prune branches,
once for each number of enforced points; *bound* a child and queue it, once for each child. Before any of
these, a new best set is refined.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import LinearRows, Workspace, allocate
from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import INFEASIBLE, OK, cold_fit
from maxcon.search.astar_nodes import MADE, QUEUED, Nodes, find, make, pop, push
from maxcon.search.insertion_kernels import (
    FEWEST,
    FITS,
    Insertion,
    allocate_insertion,
    free_basis,
    insertion_bound,
    note_model,
    tie_width,
)
from maxcon.search.refine_kernels import RefineScratch, allocate_refinement, swap_kernel
from maxcon.search.vertex_kernels import VertexCopies, allocate_copies, load_vertex, remove_point, save_vertex

#: What `advance` returns: call again; proven; no room for another node's children; as many nodes as allowed.
PAUSED, FINISHED, FULL, COUNTED_OUT = 0, 1, 2, 3

#: Places in `Search.state`: what comes next; at which node; at which of its children; how many of them are
#: new; how many were met before; the smallest e of a node that could not be opened, for rounding; how many
#: points are outside the set that was refined last.
STAGE, NODE, PLACE, CHILDREN, COVERED, STUCK, REFINED = 0, 1, 2, 3, 4, 5, 6
N_STATE = 7

#: What comes next.
_OPEN, _ATTEMPT, _BOUND = 0, 1, 2

#: Places in `Search.tally`.
EXPANDED, GENERATED, REPEATED, NON_ADJACENT, ATTEMPTS, PRUNED = 0, 1, 2, 3, 4, 5
N_TALLY = 6


class Children(NamedTuple):
    """The children of the node in hand; one row for each basis point.

    Attributes
    ----------
    point
        Shape (d + 1,): the basis points whose children are new, in the order of branching; `copy` says in
        which row and which vertex copy the child is.
    covered
        Shape (d + 1,): the basis points whose children were met before.
    copy
        Shape (d + 1,).
    removed, key, level, value
        As in `Nodes`.
    """

    point: NDArray[np.int64]
    covered: NDArray[np.int64]
    copy: NDArray[np.int64]
    removed: NDArray[np.uint8]
    key: NDArray[np.int64]
    level: NDArray[np.int64]
    value: NDArray[np.float64]


class Search(NamedTuple):
    """The state of a search, all of it.

    Attributes
    ----------
    ws, scratch, copies, refinement
        Workspace of the fits; the best model met and scratch space; the vertices of the children; what
        refining the best set needs.
    nodes, children
        The tree, and the children in hand.
    names
        Shape (N,): random numbers; the exclusive or of those of a set is its hash value.
    state, tally
        Shapes (N_STATE,) and (N_TALLY,): where the search stands, and what it has done.
    """

    ws: Workspace
    scratch: Insertion
    copies: VertexCopies
    refinement: RefineScratch
    nodes: Nodes
    children: Children
    names: NDArray[np.int64]
    state: NDArray[np.int64]
    tally: NDArray[np.int64]


def allocate_search(rows: LinearRows, nodes: Nodes, believing: bool = False) -> Search:
    """Return a search that has not begun; `believing`: with room for doubts, see `Insertion`."""
    d, N = rows.At.shape
    n = d + 1
    state = np.zeros(N_STATE, dtype=np.int64)
    state[STUCK] = state[REFINED] = N
    point, covered, copy, key, level = (np.zeros(n, dtype=np.int64) for _ in range(5))
    removed = np.zeros((n, nodes.removed.shape[1]), dtype=np.uint8)
    children = Children(point, covered, copy, removed, key, level, np.zeros(n))
    names = np.random.default_rng(0).integers(0, 2**63 - 1, size=(N,))  # any numbers will do
    tally = np.zeros(N_TALLY, dtype=np.int64)
    return Search(
        allocate(rows),
        allocate_insertion(rows, believing),
        allocate_copies(rows, n + 1),
        allocate_refinement(rows),
        nodes,
        children,
        names,
        state,
        tally,
    )


@kernel
def _set_modes(ws: Workspace, removed: NDArray[np.uint8]) -> None:
    for i in range(ws.r.shape[0]):
        out = (removed[i >> 3] >> (i & 7)) & 1
        ws.gain[i] = 0.0 if out else 1.0
        ws.cap[i] = np.inf if out else 0.0


@kernel
def plant(search: Search, limit: float) -> int:
    """Make the root, all points, and put it into the queue; FAILED where its fit fails."""
    ws, nodes, scratch = search.ws, search.nodes, search.scratch
    scratch.counts[FITS] += 1
    status = cold_fit(*ws)
    if status != OK:
        return status
    value = ws.x[ws.x.shape[0] - 1]
    note_model(ws, limit, scratch)
    bound = 0
    if value > limit:
        bound = max(insertion_bound(ws, limit, scratch.counts[FEWEST] + 1, scratch), 1)
    root = make(nodes, nodes.removed[0], 0, 0, bound, value)
    if bound < scratch.counts[FEWEST]:
        push(nodes, root)
    return OK


@kernel
def proven_outliers(search: Search) -> int:
    """Return how many outliers every set has, as far as is known now."""
    nodes, state = search.nodes, search.state
    least = min(search.scratch.counts[FEWEST], state[STUCK])
    if nodes.sizes[QUEUED] > 0:
        least = min(least, nodes.bound[nodes.queue[0]])
    if state[STAGE] != _OPEN:
        least = min(least, nodes.bound[state[NODE]])
    return int(least)


@kernel
def _refine(search: Search, limit: float) -> None:
    """Refine the best set known by swaps."""
    ws, scratch = search.ws, search.scratch
    for i in range(ws.r.shape[0]):
        ws.gain[i] = 1.0 if scratch.inliers[i] else 0.0
        ws.cap[i] = 0.0 if scratch.inliers[i] else np.inf
    if cold_fit(*ws) == OK and ws.x[ws.x.shape[0] - 1] <= limit:
        swap_kernel(ws, limit, search.refinement)
        note_model(ws, limit, scratch)
    search.state[REFINED] = scratch.counts[FEWEST]


@kernel
def _cover(search: Search, point: int) -> None:
    search.children.covered[search.state[COVERED]] = point
    search.state[COVERED] += 1
    search.tally[REPEATED] += 1


@kernel
def _put_back(ws: Workspace, children: Children, k: int, names: NDArray[np.int64]) -> int:
    """Put the removed points that lie within the fit of child k back into it; return how many there are."""
    removed = children.removed[k]
    gamma = ws.x[ws.x.shape[0] - 1] - tie_width(ws.x)
    count = 0
    for i in range(ws.r.shape[0]):
        if ws.gain[i] == 0.0 and abs(ws.r[i]) < gamma:
            removed[i >> 3] ^= 1 << (i & 7)
            children.key[k] ^= names[i]
            count += 1
    children.level[k] -= count
    return count


@kernel
def _try_child(search: Search, k: int, point: int, gamma: float, limit: float, napa: bool, dibp: bool) -> bool:
    """Fit the child without `point`, write it to row k and copy k + 1; True if it is to be a node."""
    ws, nodes, children, state, tally = search.ws, search.nodes, search.children, search.state, search.tally
    x = ws.x
    n = x.shape[0]
    node = state[NODE]
    removed = children.removed[k]
    for m in range(removed.shape[0]):
        removed[m] = nodes.removed[node, m]
    removed[point >> 3] |= 1 << (point & 7)
    children.key[k] = nodes.key[node] ^ search.names[point]
    children.level[k] = nodes.level[node] + 1
    tally[GENERATED] += 1
    if find(nodes, removed, children.key[k]) >= 0:
        _cover(search, point)
        return False
    search.scratch.counts[FITS] += 1
    if remove_point(ws, point) != OK:
        state[STUCK] = min(state[STUCK], nodes.bound[node])
        return False
    value = x[n - 1]
    children.value[k] = value
    note_model(ws, limit, search.scratch)
    if value <= limit:  # the best there is below the node, and noted
        return False
    if napa and dibp:
        # Only where f falls, so that the search never comes back to where it was
        if value < gamma - tie_width(x) and _put_back(ws, children, k, search.names) > 0:
            tally[NON_ADJACENT] += 1
            if find(nodes, removed, children.key[k]) >= 0:
                _cover(search, point)
                return False
    elif napa and _put_back(ws, children, k, search.names) > 0:
        tally[NON_ADJACENT] += 1
        return False
    save_vertex(ws, search.copies, k + 1)
    return True


@kernel
def _open(search: Search, limit: float, napa: bool, dibp: bool) -> None:
    """Take the first node, fit it and its children, and list those that are new in the order of branching."""
    ws, nodes, children, state = search.ws, search.nodes, search.children, search.state
    scratch, x = search.scratch, ws.x
    n = x.shape[0]
    node = pop(nodes)
    state[NODE] = node
    state[CHILDREN] = 0
    state[COVERED] = 0
    search.tally[EXPANDED] += 1
    _set_modes(ws, nodes.removed[node])
    scratch.counts[FITS] += 1
    size = 0
    if cold_fit(*ws) == OK:
        note_model(ws, limit, scratch)
        if x[n - 1] <= limit:  # rounding hid it when the node was made
            return
        size = free_basis(ws, scratch.basis)
    if size == 0:
        state[STUCK] = min(state[STUCK], nodes.bound[node])
        return
    gamma = x[n - 1]
    save_vertex(ws, search.copies, 0)
    rho = scratch.rho
    for k in range(size):
        point = scratch.basis[k]
        if _try_child(search, k, point, gamma, limit, napa, dibp):
            place = state[CHILDREN]
            while place > 0 and rho[children.point[place - 1]] < rho[point]:
                children.point[place] = children.point[place - 1]
                children.copy[place] = children.copy[place - 1]
                place -= 1
            children.point[place] = point
            children.copy[place] = k
            state[CHILDREN] += 1
        ws.gain[point] = 1.0
        ws.cap[point] = 0.0
        load_vertex(ws, search.copies, 0)
    state[PLACE] = 0
    state[STAGE] = _BOUND
    if dibp:
        state[PLACE] = _first_attempt(search)
        state[STAGE] = _ATTEMPT


@kernel
def _first_attempt(search: Search) -> int:
    """Return how many of the new children's points to enforce first, so that pruning is possible at all.

    With s of n = d + 1 basis points enforced, the rest of a basis has n - s points, so that m points hold at
    most (m - s) / (n - s) bases that share none; it takes `need` of them to prune.
    """
    node = search.state[NODE]
    n = search.ws.x.shape[0]
    need = search.scratch.counts[FEWEST] - search.nodes.level[node]
    m = search.ws.r.shape[0] - search.nodes.level[node]
    least = 1
    if need > 1:
        least = max(least, int(np.ceil((need * n - m) / (need - 1))))
    return int(max(least - search.state[COVERED], 0))


@kernel
def _prune(search: Search, limit: float) -> None:
    """Enforce the covered points and the first few others: if that costs too much, branch on those only."""
    ws, nodes, children, state, scratch = search.ws, search.nodes, search.children, search.state, search.scratch
    if state[PLACE] >= state[CHILDREN]:  # there is no branch left to prune
        state[PLACE] = 0
        state[STAGE] = _BOUND
        return
    node = state[NODE]
    level = nodes.level[node]
    _set_modes(ws, nodes.removed[node])
    for k in range(state[COVERED]):
        ws.gain[children.covered[k]] = 0.0
        ws.cap[children.covered[k]] = limit
    for k in range(state[PLACE]):
        ws.gain[children.point[k]] = 0.0
        ws.cap[children.point[k]] = limit
    search.tally[ATTEMPTS] += 1
    scratch.counts[FITS] += 1
    status = cold_fit(*ws)
    hopeless = status == INFEASIBLE
    if status == OK:
        lower = insertion_bound(ws, limit, scratch.counts[FEWEST] - level, scratch)
        hopeless = level + lower >= scratch.counts[FEWEST]
    if hopeless:
        search.tally[PRUNED] += state[CHILDREN] - state[PLACE]
        state[CHILDREN] = state[PLACE]
    else:
        state[PLACE] += 1


@kernel
def _bound(search: Search, limit: float) -> None:
    """Bound the next child and put it into the queue."""
    ws, nodes, children, state, scratch = search.ws, search.nodes, search.children, search.state, search.scratch
    if state[PLACE] >= state[CHILDREN]:
        state[STAGE] = _OPEN
        return
    k = children.copy[state[PLACE]]
    state[PLACE] += 1
    removed = children.removed[k]
    if find(nodes, removed, children.key[k]) >= 0:  # a sister was the same
        search.tally[REPEATED] += 1
        return
    level = children.level[k]
    _set_modes(ws, removed)
    load_vertex(ws, search.copies, k + 1)
    lower = insertion_bound(ws, limit, max(scratch.counts[FEWEST] - level, 1), scratch)
    parent = state[NODE]
    lower = max(lower, 1, nodes.bound[parent] - nodes.level[parent] - 1)
    child = make(nodes, removed, children.key[k], level, level + lower, children.value[k])
    if nodes.bound[child] < scratch.counts[FEWEST]:
        push(nodes, child)


@kernel
def advance(search: Search, limit: float, napa: bool, dibp: bool, improve: bool, fits: int, most_nodes: int) -> int:
    """Search on, until it is done or about `fits` fits were made.

    Parameters
    ----------
    search
        Planted.
    limit
        Threshold plus slack, in the unit of the rows.
    napa, dibp, improve
        See `maxcon.search.astar.astar`.
    fits
        How many fits to make before coming back.
    most_nodes
        Do not open a node when so many were made.

    Returns
    -------
    PAUSED, FINISHED, FULL or COUNTED_OUT.
    """
    nodes, state, counts = search.nodes, search.state, search.scratch.counts
    n = search.ws.x.shape[0]
    stop = counts[FITS] + fits
    while counts[FITS] < stop:
        if improve and counts[FEWEST] < state[REFINED]:
            _refine(search, limit)
        if state[STAGE] != _OPEN and nodes.bound[state[NODE]] >= counts[FEWEST]:
            state[STAGE] = _OPEN  # nothing better than what is known lies below this node
        if state[STAGE] == _OPEN:
            if nodes.sizes[QUEUED] == 0 or nodes.bound[nodes.queue[0]] >= counts[FEWEST]:
                return FINISHED
            if nodes.sizes[MADE] >= most_nodes:
                return COUNTED_OUT
            if nodes.sizes[MADE] + n > nodes.key.shape[0]:
                return FULL
            _open(search, limit, napa, dibp)
        elif state[STAGE] == _ATTEMPT:
            _prune(search, limit)
        else:
            _bound(search, limit)
    return PAUSED
