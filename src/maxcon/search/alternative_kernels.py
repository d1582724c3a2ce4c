"""Kernels that list all largest feasible sets: depth-first over which points are out and which are kept.

At a node some points are out, some are kept (within the limit in whatever is found below), the rest are free. The
minimax fit of the free points, with the kept ones enforced, is within the limit: then all that is not out is a
feasible set. Or it is not: then a point of its basis that is free is out in every feasible set below. The children
are: the first is out; the first is kept, the second is out; and so on. They share no set, so that none is found twice.

A branch ends where bases that share no free point need more points out than may still go: they are found by fits of
what the bases so far leave.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import Workspace
from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import BASIS_TOLERANCE, FAILED, INFEASIBLE, OK, cold_fit

# What `enumerate_sets` returns
DONE = 0  # there are no more sets
FOUND = 1  # the points that are not out are one; call again to go on
UNFINISHED = 2  # as many nodes were visited as were allowed; call again to go on
LARGER = 3  # the points that are not out are feasible, and more than there should be

# Entries of `Nodes.head`
DEPTH, N_OUT, FAILURES, TO_MOVE = 0, 1, 2, 3
N_HEAD = 4

# What is known about a point at a node
FREE, OUT, KEPT = 0, 1, 2

# What becomes of a node, besides FOUND and LARGER
_BRANCH, _END = 10, 11


class Nodes(NamedTuple):
    """Where the search is.

    Attributes
    ----------
    state
        Shape (N,): free, out or kept.
    branch
        Shape (most + 2, d + 1): for each depth the points that it branches on, the rest -1.
    place
        Shape (most + 2,): for each depth which of them is out; those before it are kept.
    badness
        Shape (N,): of the points of a branch, those with most of this are tried first.
    basis
        Scratch space, shape (d + 1,).
    head
        Shape (N_HEAD,): depth; how many points are out; fits that failed, each of which may have lost sets; whether
        the node has been looked at.
    """

    state: NDArray[np.int8]
    branch: NDArray[np.int64]
    place: NDArray[np.int64]
    badness: NDArray[np.float64]
    basis: NDArray[np.int64]
    head: NDArray[np.int64]


def allocate_nodes(state: NDArray[np.int8], badness: NDArray[np.float64], n_params: int, most: int) -> Nodes:
    """Return a search at its root, at which the points are free, out or kept as `state` says."""
    head = np.zeros(N_HEAD, dtype=np.int64)
    head[N_OUT] = np.count_nonzero(state == OUT)
    return Nodes(
        state=state.astype(np.int8),
        branch=np.full((most + 2, n_params + 1), -1, dtype=np.int64),
        place=np.full(most + 2, -1, dtype=np.int64),
        badness=badness,
        basis=np.full(n_params + 1, -1, dtype=np.int64),
        head=head,
    )


@kernel
def _set_modes(ws: Workspace, nodes: Nodes, limit: float) -> None:
    for i in range(nodes.state.shape[0]):
        free = nodes.state[i] == FREE
        ws.gain[i] = 1.0 if free else 0.0
        ws.cap[i] = 0.0 if free else (limit if nodes.state[i] == KEPT else np.inf)


@kernel
def _fit(ws: Workspace, nodes: Nodes, limit: float) -> int:
    """Fit the free points with the kept ones within the limit; where rounding defeats that, all of them alike."""
    _set_modes(ws, nodes, limit)
    status = cold_fit(*ws)
    if status == FAILED:
        for i in range(nodes.state.shape[0]):
            inside = nodes.state[i] != OUT
            ws.gain[i] = 1.0 if inside else 0.0
            ws.cap[i] = 0.0 if inside else np.inf
        status = cold_fit(*ws)
    return status


@kernel
def _free_basis(ws: Workspace, nodes: Nodes) -> int:
    """Write the free points of the basis into `nodes.basis`, the worst first, the rest -1; return how many."""
    C, q, basis, badness = ws.C, ws.q, nodes.basis, nodes.badness
    n = q.shape[0]
    size = 0
    for k in range(n):
        if q[k] < 0 or C[n - 1, k] <= BASIS_TOLERANCE:
            continue
        point = q[k] >> 1
        if nodes.state[point] != FREE:
            continue
        known = False
        for m in range(size):
            known = known or basis[m] == point
        if known:  # both sides of one point
            continue
        place = size
        while place > 0 and badness[basis[place - 1]] < badness[point]:
            basis[place] = basis[place - 1]
            place -= 1
        basis[place] = point
        size += 1
    for k in range(size, n):
        basis[k] = -1
    return size


@kernel
def _visit(ws: Workspace, nodes: Nodes, limit: float, most: int) -> int:
    """Look at the node: a set, the end of the branch, or the points to branch on, which go into `branch`."""
    head, x, basis = nodes.head, ws.x, nodes.basis
    depth = head[DEPTH]
    n = x.shape[0]
    status = _fit(ws, nodes, limit)
    if status == INFEASIBLE:
        return _END
    if status == FAILED:
        head[FAILURES] += 1
        return _END
    if x[n - 1] <= limit:
        return FOUND if head[N_OUT] == most else LARGER
    budget = most - head[N_OUT]
    if budget == 0:
        return _END
    smallest = n + 1
    packed = 0
    while True:
        size = _free_basis(ws, nodes)
        if size == 0:  # no model explains the kept points
            return _END
        packed += 1
        if packed > budget:
            return _END
        if size < smallest:
            smallest = size
            for k in range(n):
                nodes.branch[depth, k] = basis[k]
            nodes.place[depth] = -1
        for k in range(size):
            ws.gain[basis[k]] = 0.0
            ws.cap[basis[k]] = np.inf
        if cold_fit(*ws) != OK or x[n - 1] <= limit:
            return _BRANCH


@kernel
def _advance(nodes: Nodes, depth: int) -> bool:
    """Let the next point out of the branch at `depth`, or, if there is none left, further up; False at the end."""
    head, branch, place, state = nodes.head, nodes.branch, nodes.place, nodes.state
    while depth >= 0:
        k = place[depth]
        if k >= 0:
            state[branch[depth, k]] = KEPT
            head[N_OUT] -= 1
        k += 1
        if k < branch.shape[1] and branch[depth, k] >= 0:
            place[depth] = k
            state[branch[depth, k]] = OUT
            head[N_OUT] += 1
            head[DEPTH] = depth + 1
            return True
        for m in range(branch.shape[1]):
            if branch[depth, m] >= 0:
                state[branch[depth, m]] = FREE
        depth -= 1
    return False


@kernel
def enumerate_sets(ws: Workspace, nodes: Nodes, limit: float, most: int, n_nodes: int) -> int:
    """Go on to the next feasible set of all but `most` points, in about `n_nodes` nodes.

    Parameters
    ----------
    ws
        The rows of the problem.
    nodes
        Where the search is (see `allocate_nodes`). After FOUND and LARGER the set is where `state` is not OUT.
    limit
        A fit is feasible where gamma <= limit.
    most
        How many points are out: as few as leave a feasible set.
    n_nodes
        After so many nodes UNFINISHED is returned.

    Returns
    -------
    DONE, FOUND, UNFINISHED or LARGER.
    """
    head = nodes.head
    for _ in range(n_nodes):
        if head[TO_MOVE]:
            head[TO_MOVE] = 0
            if not _advance(nodes, head[DEPTH] - 1):
                head[DEPTH] = 0
                head[TO_MOVE] = 1
                return DONE
        verdict = _visit(ws, nodes, limit, most)
        if verdict == _BRANCH:
            if not _advance(nodes, head[DEPTH]):
                return DONE
            continue
        head[TO_MOVE] = 1
        if verdict != _END:
            return verdict
    return UNFINISHED
