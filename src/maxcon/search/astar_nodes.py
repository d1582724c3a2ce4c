"""Kernels of the nodes of a best-first tree search: the queue, and the table of sets met before.

A node is a set of removed points, kept as bits, so that two nodes are the same only if their sets are: no
proof hangs on a hash value. Nodes are numbered in the order in which they are made.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel

#: Places in `Nodes.sizes`.
MADE, QUEUED = 0, 1


class Nodes(NamedTuple):
    """All nodes that were made, with room for more.

    Attributes
    ----------
    removed
        Shape (capacity, ceil(N / 8)), uint8: bit ``i & 7`` of byte ``i >> 3`` tells that point i is removed.
    key
        Shape (capacity,): hash values of these sets.
    level
        Shape (capacity,): how many points are removed.
    bound
        Shape (capacity,): e = level + h, no more than the outliers of the best set below the node.
    value
        Shape (capacity,): f of the points that are left, in the unit of the rows.
    queue
        Shape (capacity,): a binary heap of the nodes that wait to be expanded, first the one of the smallest
        e; of equal ones the one of the smallest f, and then the one that was made first.
    table
        Shape (2 or 4 times capacity, a power of two): open addressing by key; node numbers, -1 where empty.
    sizes
        Shape (2,): how many nodes were made, and how many wait.
    """

    removed: NDArray[np.uint8]
    key: NDArray[np.int64]
    level: NDArray[np.int32]
    bound: NDArray[np.int32]
    value: NDArray[np.float64]
    queue: NDArray[np.int32]
    table: NDArray[np.int32]
    sizes: NDArray[np.int64]


def bytes_needed(N: int, capacity: int) -> int:
    """Return the memory that `capacity` nodes of problems with N points take."""
    return capacity * ((N + 7) // 8 + 8 + 4 + 4 + 8 + 4) + 4 * _table_size(capacity)


def _table_size(capacity: int) -> int:
    return 1 << (2 * capacity - 1).bit_length()


def allocate_nodes(N: int, capacity: int) -> Nodes:
    """Return room for `capacity` nodes, none made yet."""
    return Nodes(
        np.zeros((capacity, (N + 7) // 8), dtype=np.uint8),
        np.zeros(capacity, dtype=np.int64),
        np.zeros(capacity, dtype=np.int32),
        np.zeros(capacity, dtype=np.int32),
        np.zeros(capacity),
        np.zeros(capacity, dtype=np.int32),
        np.full(_table_size(capacity), -1, dtype=np.int32),
        np.zeros(2, dtype=np.int64),
    )


def enlarged(nodes: Nodes, capacity: int) -> Nodes:
    """Return the same nodes with room for `capacity`."""
    kept = nodes.sizes[MADE]
    new = allocate_nodes(8 * nodes.removed.shape[1], capacity)
    new.removed[:kept] = nodes.removed[:kept]
    new.key[:kept] = nodes.key[:kept]
    new.level[:kept] = nodes.level[:kept]
    new.bound[:kept] = nodes.bound[:kept]
    new.value[:kept] = nodes.value[:kept]
    waiting = nodes.sizes[QUEUED]
    new.queue[:waiting] = nodes.queue[:waiting]
    new.sizes[:] = nodes.sizes
    enter_all(new)
    return new


@kernel
def enter_all(nodes: Nodes) -> None:
    """Fill an empty table with all nodes."""
    mask = nodes.table.shape[0] - 1
    for node in range(nodes.sizes[MADE]):
        slot = nodes.key[node] & mask
        while nodes.table[slot] >= 0:
            slot = (slot + 1) & mask
        nodes.table[slot] = node


@kernel
def find(nodes: Nodes, removed: NDArray[np.uint8], key: int) -> int:
    """Return the node whose removed points are these, or -1."""
    mask = nodes.table.shape[0] - 1
    slot = key & mask
    while nodes.table[slot] >= 0:
        node = nodes.table[slot]
        if nodes.key[node] == key:
            same = True
            for k in range(removed.shape[0]):
                if nodes.removed[node, k] != removed[k]:
                    same = False
                    break
            if same:
                return int(node)
        slot = (slot + 1) & mask
    return -1


@kernel
def make(nodes: Nodes, removed: NDArray[np.uint8], key: int, level: int, bound: int, value: float) -> int:
    """Make a node, which does not wait yet; the caller has seen to it that it is new and that there is room."""
    node = nodes.sizes[MADE]
    nodes.sizes[MADE] += 1
    for k in range(removed.shape[0]):
        nodes.removed[node, k] = removed[k]
    nodes.key[node] = key
    nodes.level[node] = level
    nodes.bound[node] = bound
    nodes.value[node] = value
    mask = nodes.table.shape[0] - 1
    slot = key & mask
    while nodes.table[slot] >= 0:
        slot = (slot + 1) & mask
    nodes.table[slot] = node
    return int(node)


@kernel
def _before(nodes: Nodes, a: int, b: int) -> bool:
    if nodes.bound[a] != nodes.bound[b]:
        return bool(nodes.bound[a] < nodes.bound[b])
    if nodes.value[a] != nodes.value[b]:
        return bool(nodes.value[a] < nodes.value[b])
    return a < b


@kernel
def push(nodes: Nodes, node: int) -> None:
    """Let `node` wait in the queue."""
    queue = nodes.queue
    k = nodes.sizes[QUEUED]
    nodes.sizes[QUEUED] += 1
    while k > 0:
        parent = (k - 1) >> 1
        if not _before(nodes, node, queue[parent]):
            break
        queue[k] = queue[parent]
        k = parent
    queue[k] = node


@kernel
def pop(nodes: Nodes) -> int:
    """Take the first node out of the queue, which is not empty."""
    queue = nodes.queue
    first = queue[0]
    nodes.sizes[QUEUED] -= 1
    size = nodes.sizes[QUEUED]
    node = queue[size]
    k = 0
    while 2 * k + 1 < size:
        child = 2 * k + 1
        if child + 1 < size and _before(nodes, queue[child + 1], queue[child]):
            child += 1
        if not _before(nodes, queue[child], node):
            break
        queue[k] = queue[child]
        k = child
    queue[k] = node
    return int(first)
