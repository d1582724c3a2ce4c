"""Kernels of the witness: prove, by infeasible bases alone, that a group of points has so many outliers.

A basis (at most d + 1 points that no model explains) loses a point in every feasible part of the group. So if
no `most` points of the group hit all bases of a pool, every feasible part leaves out more than `most`. The
search for such a hitting set goes depth-first over the points of one missed basis: the first is out, or it is
kept and the second is out, and so on. A branch ends where missed bases that share no free point (neither out
nor kept) need more points than may still go out. The pool grows as the search goes: where its bases end no
branch, the minimax fit of what is left is asked for another.

A basis of fewer than d + 1 points rests on rows that are dependent; whether they are to the letter of the
data, or only up to rounding, is for the caller to say.

The search writes down what it rests on, node by node in the order in which they are visited: a branch as ``0,
basis``, an end as ``count, basis, ..., basis``. Who reads that needs no search of his own
(`maxcon.certification.verify`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import Workspace
from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import INFEASIBLE, OK, basis_points, cold_fit, compute_residuals

# What `prove` returns
PROVEN = 0  # no `most` points hit all bases of the pool
FOUND = 1  # some do, as far as the engine can tell: the group without them is feasible
UNFINISHED = 2  # as many nodes were visited as were allowed: call again to go on
FULL = 3  # there is no room for another basis, or for the proof
FAILED = 4  # a minimax fit did not converge
DOUBTFUL = 5  # the newest basis is smaller than d + 1: make sure that it is one in exact arithmetic, and call again

# Entries of `Search.head`
SIZE, DEPTH, STAMP, WRITTEN = 0, 1, 2, 3
N_HEAD = 4

# What is known about a point at a node
FREE, OUT, KEPT = 0, 1, 2

# What becomes of a node; the others are what `prove` returns
_BRANCH, _END = 10, 11

# What the minimax fit says; >= 0: the place of a new basis in the pool
_EXPLAINED, _FEW_LEFT_OUT, _NO_ROOM, _NO_FIT = -1, -2, -3, -4


class Search(NamedTuple):
    """The pool, and where the search is. The points of a group are numbered in the order in which they are tried.

    Attributes
    ----------
    pool
        Shape (capacity, d + 1): the points of each basis, -1 where it has fewer; each is tried in this order.
    state
        Shape (n,): free, out or kept.
    branch
        Shape (n + 1, 2): for each depth the basis that it branches on, and the place in it of the point that
        is out.
    was_free
        Shape (n + 1, d + 1): for each depth which points of that basis were free there.
    stamp
        Shape (n,): the free points of the packing carry the number of the node.
    missed, basis
        Scratch space, shapes (capacity + n + 1,) and (d + 1,).
    proof
        Shape (length,): what has been written.
    head
        Shape (N_HEAD,): bases in the pool; depth; number of the node; how much of `proof` is written.
    """

    pool: NDArray[np.int32]
    state: NDArray[np.int8]
    branch: NDArray[np.int64]
    was_free: NDArray[np.bool_]
    stamp: NDArray[np.int64]
    missed: NDArray[np.int32]
    basis: NDArray[np.int64]
    proof: NDArray[np.int32]
    head: NDArray[np.int64]


def allocate_search(n_points: int, n_params: int, capacity: int) -> Search:
    """Return a search for groups of up to `n_points` points and `capacity` bases."""
    n = n_params + 1
    return Search(
        pool=np.empty((capacity, n), dtype=np.int32),
        state=np.zeros(n_points, dtype=np.int8),
        branch=np.zeros((n_points + 1, 2), dtype=np.int64),
        was_free=np.zeros((n_points + 1, n), dtype=np.bool_),
        stamp=np.zeros(n_points, dtype=np.int64),
        missed=np.zeros(capacity + n_points + 1, dtype=np.int32),
        basis=np.full(n, -1, dtype=np.int64),
        proof=np.empty(16 * capacity + 64, dtype=np.int32),
        head=np.zeros(N_HEAD, dtype=np.int64),
    )


@kernel
def begin(search: Search, n_points: int) -> None:
    """Put the search for a group of so many points at its root, with the pool as it is and nothing written."""
    search.head[DEPTH] = 0
    search.head[WRITTEN] = 0
    for i in range(n_points):
        search.state[i] = FREE


@kernel
def _free_points(search: Search, row: int) -> int:
    """Return how many points of a basis are free; -1 if one is out."""
    pool, state = search.pool, search.state
    free = 0
    for k in range(pool.shape[1]):
        point = pool[row, k]
        if point < 0:
            break
        if state[point] == OUT:
            return -1
        if state[point] == FREE:
            free += 1
    return free


@kernel
def _claim(search: Search, row: int) -> bool:
    """Put a basis into the packing, if it shares no free point with those in it."""
    pool, state, stamp = search.pool, search.state, search.stamp
    now = search.head[STAMP]
    for k in range(pool.shape[1]):
        point = pool[row, k]
        if point < 0:
            break
        if state[point] == FREE and stamp[point] == now:
            return False
    for k in range(pool.shape[1]):
        point = pool[row, k]
        if point < 0:
            break
        if state[point] == FREE:
            stamp[point] = now
    return True


@kernel
def _pack(search: Search, budget: int) -> int:
    """Pack missed bases, those with fewest free points first, until there are more than `budget`; return how many.

    They are the first entries of `missed`. A basis without free points ends the branch alone: then it is the
    first, and -1 is returned.
    """
    missed, head, pool = search.missed, search.head, search.pool
    width = pool.shape[1]
    count = 0
    least = width + 1
    for row in range(head[SIZE]):
        free = _free_points(search, row)
        if free == 0:
            missed[0] = row
            return -1
        if free > 0:
            missed[count] = row
            count += 1
            least = min(least, free)
    packed = 0
    for free in range(least, width + 1):
        for k in range(packed, count):
            row = missed[k]
            if _free_points(search, row) == free and _claim(search, row):
                missed[k] = missed[packed]
                missed[packed] = row
                packed += 1
                if packed > budget:
                    return packed
    return packed


@kernel
def _ask(ws: Workspace, search: Search, limit: float, most: int) -> int:
    """Fit what is neither out nor in the packing, the kept points within the limit; a new basis goes into the pool.

    That the kept points must be within the limit, and that gamma is minimised over the free ones alone, makes
    for bases of many kept points and few free ones, which are worth most.
    """
    gain, cap, C, x, q, r = ws.gain, ws.cap, ws.C, ws.x, ws.q, ws.r
    state, stamp, head, pool, basis = search.state, search.stamp, search.head, search.pool, search.basis
    now = head[STAMP]
    for i in range(r.shape[0]):
        fitted = state[i] == FREE and stamp[i] != now
        gain[i] = 1.0 if fitted else 0.0
        cap[i] = 0.0 if fitted else (limit if state[i] == KEPT else np.inf)
    status = cold_fit(*ws)
    if status == INFEASIBLE:  # no model explains the kept points
        for i in range(r.shape[0]):
            gain[i] = 1.0 if state[i] == KEPT else 0.0
            cap[i] = 0.0 if state[i] == KEPT else np.inf
        status = cold_fit(*ws)
    if status != OK:
        return _NO_FIT
    if x[x.shape[0] - 1] <= limit:
        compute_residuals(ws.At, ws.b, x, r)
        outside = 0
        for i in range(r.shape[0]):
            outside += 1 if abs(r[i]) > limit else 0
        return _FEW_LEFT_OUT if outside <= most else _EXPLAINED
    row = head[SIZE]
    if row == pool.shape[0]:
        return _NO_ROOM
    size = basis_points(C, q, basis)
    for k in range(pool.shape[1]):
        pool[row, k] = basis[k] if k < size else -1
    head[SIZE] = row + 1
    return int(row)


@kernel
def _write(search: Search, first: int, count: int) -> bool:
    """Write `first`, then the first `count` entries of `missed`; False where there is no room."""
    proof, missed, head = search.proof, search.missed, search.head
    place = head[WRITTEN]
    if place + 1 + count > proof.shape[0]:
        return False
    proof[place] = first
    for k in range(count):
        proof[place + 1 + k] = missed[k]
    head[WRITTEN] = place + 1 + count
    return True


@kernel
def _visit(ws: Workspace, search: Search, limit: float, most: int) -> int:
    """Look at the node: end the branch here, or find the basis to branch on, and write that down."""
    head, missed = search.head, search.missed
    depth = head[DEPTH]
    budget = most - depth
    head[STAMP] += 1
    packed = _pack(search, budget)
    while 0 <= packed <= budget:
        row = _ask(ws, search, limit, most)
        if row < 0:
            if row == _FEW_LEFT_OUT or (packed == 0 and row == _EXPLAINED):
                return FOUND
            if row == _NO_ROOM:
                return FULL
            if packed == 0:
                return FAILED
            break
        if search.pool[row, search.pool.shape[1] - 1] < 0:
            return DOUBTFUL
        if _free_points(search, row) == 0:
            missed[0] = row
            packed = -1
        else:
            _claim(search, row)
            missed[packed] = row
            packed += 1
    if packed < 0:
        return _END if _write(search, 1, 1) else FULL
    if packed > budget:
        return _END if _write(search, packed, packed) else FULL

    for k in range(1, packed):  # branch on the one with fewest free points
        if _free_points(search, missed[k]) < _free_points(search, missed[0]):
            missed[0] = missed[k]
    search.branch[depth, 0] = missed[0]
    search.branch[depth, 1] = -1
    for k in range(search.pool.shape[1]):
        point = search.pool[missed[0], k]
        search.was_free[depth, k] = point >= 0 and search.state[point] == FREE
    return _BRANCH if _write(search, 0, 1) else FULL


@kernel
def _advance(search: Search, depth: int) -> bool:
    """Let the next point out of the branch at `depth`, or, if there is none left, further up; False at the end."""
    head, branch, was_free, state, pool = search.head, search.branch, search.was_free, search.state, search.pool
    while depth >= 0:
        row = branch[depth, 0]
        k = branch[depth, 1]
        if k >= 0:
            state[pool[row, k]] = KEPT
        k += 1
        while k < pool.shape[1] and not was_free[depth, k]:
            k += 1
        if k < pool.shape[1]:
            branch[depth, 1] = k
            state[pool[row, k]] = OUT
            head[DEPTH] = depth + 1
            return True
        for m in range(pool.shape[1]):
            if was_free[depth, m]:
                state[pool[row, m]] = FREE
        depth -= 1
    return False


@kernel
def prove(ws: Workspace, search: Search, limit: float, most: int, nodes: int) -> int:
    """Prove that no `most` points of the group hit all infeasible bases, in about `nodes` nodes; or go on with that.

    Parameters
    ----------
    ws
        The rows of the group.
    search
        Where the search is: to start one, see `begin`. After PROVEN its `proof` is complete.
    limit
        A fit is feasible where gamma <= limit.
    most
        How many points may be left out.
    nodes
        After so many nodes UNFINISHED is returned.

    Returns
    -------
    PROVEN, FOUND, UNFINISHED, FULL, FAILED or DOUBTFUL. After UNFINISHED and DOUBTFUL call again to go on.
    """
    for _ in range(nodes):
        verdict = _visit(ws, search, limit, most)
        if verdict not in (_BRANCH, _END):
            return verdict
        depth = search.head[DEPTH]
        if not _advance(search, depth if verdict == _BRANCH else depth - 1):
            return PROVEN
    return UNFINISHED
