"""The groups of the partition bound and the balanced binary tree that merges them.

Points are renumbered so that every node of the tree owns a contiguous range of *places*; nodes are numbered in
preorder, so that every subtree owns a contiguous range of nodes. The root is node 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# The columns of `MergeTree.nodes`.
LO, HI, LEFT, RIGHT, SIZE, HEIGHT, PARENT = range(7)
N_TREE_COLUMNS = 7


@dataclass(frozen=True, eq=False)
class MergeTree:
    """A balanced binary tree over disjoint groups of points.

    Attributes
    ----------
    order
        Shape (N,): the point at each place; ``order[nodes[t, LO]:nodes[t, HI]]`` are the points of node t.
    nodes
        Shape (T, 7), a row for each node: places LO to HI, children LEFT and RIGHT (-1 for a leaf), number of
        nodes SIZE of the subtree (nodes t to t + SIZE), HEIGHT (0 for a leaf) and PARENT (-1 for the root).
    leaf_of
        Shape (N,): the leaf that owns each place.
    """

    order: NDArray[np.int64]
    nodes: NDArray[np.int64]
    leaf_of: NDArray[np.int64]

    @property
    def groups(self) -> list[NDArray[np.int64]]:
        """The points of each leaf."""
        return [self.order[row[LO] : row[HI]] for row in self.nodes if row[LEFT] < 0]

    def points(self, node: int) -> NDArray[np.int64]:
        """Return the points of `node`."""
        return self.order[self.nodes[node, LO] : self.nodes[node, HI]]


def leaf_size(n_points: int, n_params: int, n_outliers: int) -> int:
    """Return how many points a group should have at first: small groups are solved fast, and join where that pays.

    At least 2 d + 1 points, or a group proves nothing, and about three outliers.
    """
    return min(n_points, max(2 * n_params + 1, 3 * n_points // max(n_outliers, 1)))


def merge_tree(residuals: NDArray[np.float64], leaf: int) -> MergeTree:
    """Deal the points into N / leaf groups, round robin by falling residual, and merge these two by two.

    Parameters
    ----------
    residuals
        Shape (N,): the residual of each point under a good model. Every group then gets its share of outliers.
    leaf
        How many points a group has, about.
    """
    n_points = len(residuals)
    n_groups = max(1, round(n_points / leaf))
    ranked = np.argsort(-residuals, kind="stable")
    groups = [ranked[k::n_groups] for k in range(n_groups)]
    order = np.concatenate(groups).astype(np.int64)
    ends = np.concatenate([[0], np.cumsum([len(group) for group in groups])])
    rows: list[list[int]] = []

    def build(first: int, last: int, parent: int) -> int:
        node = len(rows)
        rows.append([int(ends[first]), int(ends[last]), -1, -1, 1, 0, parent])
        if last - first > 1:
            middle = (first + last + 1) // 2
            left = build(first, middle, node)
            right = build(middle, last, node)
            height = 1 + max(rows[left][HEIGHT], rows[right][HEIGHT])
            rows[node][LEFT : HEIGHT + 1] = left, right, len(rows) - node, height
        return node

    build(0, n_groups, -1)
    nodes = np.array(rows, dtype=np.int64)
    leaf_of = np.empty(n_points, dtype=np.int64)
    for t in np.flatnonzero(nodes[:, LEFT] < 0):
        leaf_of[nodes[t, LO] : nodes[t, HI]] = t
    return MergeTree(order, nodes, leaf_of)
