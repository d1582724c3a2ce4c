"""Kernels of exact stabbing: best-first branch and bound over prisms, in bounded memory.

Open prisms wait in one list for each bound (last in, first out), so that the largest bound, which is the global one,
falls as fast as it can. Each keeps a list of its undecided points in an arena; lists of prisms that are done are
garbage, and what is left is moved together when garbage is a quarter of all. Where the caller has no more memory to
give, new prisms do without a list (their parts look at all points), or are searched depth-first (a *dive*) on top
of the open ones, which takes a few nodes only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel
from maxcon.search.stabbing_prism import (
    BOX_SIZE,
    DOUBT,
    Prism,
    bound_prism,
    split_axis,
    take_part,
)
from maxcon.search.stabbing_rows import Strips, dependent_rows

#: Work for one prism, on top of one unit a point (some 10 ns).
PRISM_WORK = 64

#: When so many splits could not tell whether all possible inliers of a prism fit one model, the engine is asked:
#: strips that meet, or just fail to, over a long range of models would take a great many boxes.
PATIENCE = 10.0

#: Nodes kept free for dives; each level leaves one behind.
RESERVE = 1024

# Places in Tree.state.
TOP = 0  #           no open node has a larger bound
CEILING = 1  #       the largest bound of the nodes that had to be given up
NODE = 2  #          the node that the caller is asked about, or -1
FREE = 3  #          first of the freed nodes
USED = 4  #          nodes ever used
STACK = 5  #         first of the nodes of a dive
OPEN = 6  #          how many nodes are open
FILL = 7  #          how much of the arena is in use,
GARBAGE = 8  #       and how much of that is garbage
ROOTS = 9  #         roots still to be bounded
NODES_CAPPED = 10  # 1: there is no memory for more nodes,
LISTS_CAPPED = 11  # or for more lists
EXPANDED = 12  #     how many nodes have been split
N_STATE = 13

# Why `advance` came back.
PROVEN = 0
TIRED = 1  #          the budget is spent
NODES_FULL = 2  #     more memory for nodes, please, or NODES_CAPPED
LISTS_FULL = 3  #     more memory for lists, please, or LISTS_CAPPED
UNDECIDED = 4  #      the node's points had better be judged by the engine


class Tree(NamedTuple):
    """The open prisms.

    Attributes
    ----------
    boxes
        Shape (nodes, BOX_SIZE): see `stabbing_prism`.
    bound, base
        Shape (nodes,): upper bound; how many points are in for all of the prism.
    start, size
        Shape (nodes,): where in `arena` the undecided points are; start -1: nowhere, and base 0.
    link
        Shape (nodes,): the next node in the same list, or -1.
    head
        Shape (n + 1,): for each bound, the first of the nodes that wait with it, or -1.
    arena
        Lists of points, each after a header of two: node and length.
    everything
        Shape (n,): 0 to n - 1.
    state
        Shape (N_STATE,): see above.
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


@kernel
def node_points(tree: Tree, node: int) -> NDArray[np.int32]:
    """Return the undecided points of a node, regular ones first."""
    if tree.start[node] < 0:
        return tree.everything
    return tree.arena[tree.start[node] : tree.start[node] + tree.size[node]]


@kernel
def _store(tree: Tree, prism: Prism, bound: int, base: int, m: int, listed: bool) -> None:
    """Open a node for the prism, with its list of m points or without."""
    state = tree.state
    node = state[FREE]
    if node >= 0:
        state[FREE] = tree.link[node]
    elif state[USED] < tree.bound.shape[0]:
        node = state[USED]
        state[USED] += 1
    else:  # a dive deeper than the reserve: say what is left undone
        state[CEILING] = max(state[CEILING], bound)
        return
    for j in range(BOX_SIZE):
        tree.boxes[node, j] = prism.box[j]
    tree.bound[node] = bound
    tree.start[node] = -1
    tree.size[node] = 0
    tree.base[node] = 0
    if listed:
        fill = state[FILL]
        tree.arena[fill] = node
        tree.arena[fill + 1] = m
        tree.arena[fill + 2 : fill + 2 + m] = prism.kept[:m]
        state[FILL] = fill + 2 + m
        tree.start[node] = fill + 2
        tree.size[node] = m
        tree.base[node] = base
    if state[OPEN] + 1 > tree.bound.shape[0] - RESERVE:
        tree.link[node] = state[STACK]
        state[STACK] = node
    else:
        tree.link[node] = tree.head[bound]
        tree.head[bound] = node
    state[TOP] = max(state[TOP], bound)
    state[OPEN] += 1


@kernel
def _release(tree: Tree, node: int) -> None:
    """Give a node that waits nowhere any more, and its list, back."""
    if tree.start[node] >= 0:
        tree.state[GARBAGE] += tree.size[node] + 2
    tree.start[node] = -1
    tree.link[node] = tree.state[FREE]
    tree.state[FREE] = node


@kernel
def _take(tree: Tree, best: int, gap: int) -> int:
    """Take the next node out: of a dive, else the one with the largest bound; -1 if none is above best + gap."""
    state = tree.state
    while state[STACK] >= 0:
        node = state[STACK]
        state[STACK] = tree.link[node]
        state[OPEN] -= 1
        if tree.bound[node] > best:
            return int(node)
        _release(tree, node)
    while state[TOP] > best + gap and tree.head[state[TOP]] < 0:
        state[TOP] -= 1
    if state[TOP] <= best + gap:
        return -1
    node = tree.head[state[TOP]]
    tree.head[state[TOP]] = tree.link[node]
    state[OPEN] -= 1
    return int(node)


@kernel
def _put_back(tree: Tree, node: int) -> None:
    """Undo `_take`."""
    bound = tree.bound[node]
    tree.link[node] = tree.head[bound]
    tree.head[bound] = node
    tree.state[OPEN] += 1


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
def _room_for_lists(tree: Tree, n: int) -> bool:
    """Whether two more lists of n points fit, after compaction where that is worth its while."""
    state = tree.state
    needed = 2 * n + 4
    if state[FILL] + needed > tree.arena.shape[0] and 4 * state[GARBAGE] >= tree.arena.shape[0]:
        _compact(tree)
    return bool(state[FILL] + needed <= tree.arena.shape[0])


@kernel
def _split(strips: Strips, prism: Prism, tree: Tree, node: int, axis: int, listed: bool) -> None:
    """Halve the prism of a node; open the halves that may hold something better."""
    for side in range(2):
        take_part(tree.boxes[node], axis, side, prism.box)
        bound, base, m = bound_prism(strips, prism, node_points(tree, node), tree.base[node])
        bound = min(bound, tree.bound[node])
        prism.box[DOUBT] = prism.box[DOUBT] + 1.0 if base + m <= prism.best[0] + 1 else 0.0
        if bound > prism.best[0]:
            _store(tree, prism, bound, base, m, listed)
    tree.state[EXPANDED] += 1


@kernel
def _plant(strips: Strips, prism: Prism, tree: Tree, root: NDArray[np.float64]) -> None:
    """Bound one of the prisms to begin with."""
    prism.box[: root.shape[0]] = root
    bound, base, m = bound_prism(strips, prism, tree.everything, 0)
    if bound > prism.best[0]:
        _store(tree, prism, bound, base, m, True)
    tree.state[ROOTS] -= 1


@kernel
def advance(
    strips: Strips, prism: Prism, tree: Tree, roots: NDArray[np.float64], dependence: int, budget: int, gap: int
) -> int:
    """Search until `budget` units of work are spent, or there is a reason to come back; return it.

    Parameters
    ----------
    strips
        The points.
    prism
        Scratch space, and the best model so far.
    tree
        The state of the search. A node that the last call asked about (``state[NODE]``) is closed.
    roots
        Shape (faces, 8): the boxes and windows to begin with.
    dependence
        Prisms all of whose possible inliers have a rank of no more than this are dropped.
    budget, gap
        How much work to do, and which gap is small enough. A unit is one point in one prism.
    """
    state = tree.state
    if state[NODE] >= 0:
        _release(tree, state[NODE])
        state[NODE] = -1
    work = 0
    while work < budget:
        if state[ROOTS] > 0:
            _plant(strips, prism, tree, roots[roots.shape[0] - state[ROOTS]])
            work += tree.everything.shape[0] + PRISM_WORK
            continue
        node = _take(tree, prism.best[0], gap)
        if node < 0:
            return PROVEN
        points = node_points(tree, node)
        if dependence > 0 and tree.base[node] == 0 and dependent_rows(strips, points, dependence):
            _release(tree, node)
            continue
        box = tree.boxes[node]
        axis = split_axis(box)
        if axis < 0 or box[DOUBT] >= PATIENCE:
            state[NODE] = node
            return UNDECIDED
        if state[NODES_CAPPED] == 0 and state[USED] + 2 > tree.bound.shape[0] - RESERVE and state[FREE] < 0:
            _put_back(tree, node)
            return NODES_FULL
        n = points.shape[0]
        listed = _room_for_lists(tree, n)
        if not listed and state[LISTS_CAPPED] == 0:
            _put_back(tree, node)
            return LISTS_FULL
        _split(strips, prism, tree, node, axis, listed)
        work += 2 * (n + PRISM_WORK)
        _release(tree, node)
    return TIRED
