"""Exact consensus maximisation with up to three parameters: branch and bound, stabbing along the last one.

For models with one parameter each point is an inlier on an interval, and the best model stabs the most intervals.
With two or three, the others are searched by branch and bound, and each box of them is bounded by a stabbing of
intervals that are widened for the box (`stabbing_prism`, `stabbing_kernels`). Nothing is assumed about the size of
the parameters: they are homogeneous, and the boxes cover the faces of a cube (`stabbing_rows`).

At w = 0, "infinitely steep", there is no model, only limits of models; there all points of one vertical line, or of
one vertical plane, are inliers together, and no box that touches it has a bound below their number. But a largest
consensus set S has the rank of all rows: else there were a point j whose row does not depend on those of S, and a
change of the model that leaves the residuals of S as they are could fit j as well. So a box can be dropped
where all possible inliers are of lower rank, as in the end they are wherever w comes near 0.

Branching over all parameters but one, with interval stabbing for that one: Zhang, Peng, Xu, Kneip, "Accelerating
globally optimal consensus maximization in geometric vision" (TPAMI 2024, arXiv 2304.05156).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import allocate
from maxcon.minimax.linear import OK, basis_points, cold_fit
from maxcon.search.anytime import Step, Task
from maxcon.search.stabbing_kernels import (
    CEILING,
    FREE,
    LISTS_CAPPED,
    LISTS_FULL,
    N_STATE,
    NODE,
    NODES_CAPPED,
    NODES_FULL,
    PROVEN,
    ROOTS,
    STACK,
    TIRED,
    TOP,
    UNDECIDED,
    Tree,
    advance,
)
from maxcon.search.stabbing_prism import BOX_SIZE, CENTRE, HALF, WINDOW, Prism, inliers
from maxcon.search.stabbing_rows import SAMPLES, Strips, dependent_rows, make_strips, stabbing_column

#: Points in prisms between two steps: some 5 ms. Where there is a time limit the first step is so much shorter, and
#: none is longer than what is left of the time by what the one before took.
BUDGET, SHORTER = 500_000, 20

#: Memory for nodes, at first and at most: 150 bytes each.
FIRST_NODES, MOST_NODES = 2_048, 262_144

#: Memory for lists of points, at first and at most: so many times N, but at least so many entries of 4 bytes.
FIRST_LISTS, MOST_LISTS = (16, 32_768), (32, 16_777_216)

#: Bins of one stabbing at most: these stay in the nearest cache.
MOST_BINS = 4_096

#: But no step is shorter than this, some 10 us.
LEAST_BUDGET = 1_000

#: How many minimax fits may go into the decision about a prism that splitting does not decide.
FITS = 256

#: Points that the engine may refuse in a set that the search has found, before the set is given up.
REFUSALS = 8


def _faces(k: int) -> NDArray[np.float64]:
    """Return the boxes and windows that cover all models: the face w = 1, and sigma_j = 1 and -1 with w >= 0."""
    faces = np.zeros((1 + 2 * k, 8))
    faces[:, WINDOW], faces[:, WINDOW + 1] = -np.inf, np.inf
    faces[:, HALF : HALF + k] = 1.0
    faces[1:, [CENTRE + 2, HALF + 2]] = 0.5
    faces[0, CENTRE + 2] = 1.0
    for j in range(k):
        faces[[1 + 2 * j, 2 + 2 * j], CENTRE + j] = 1.0, -1.0
        faces[[1 + 2 * j, 2 + 2 * j], HALF + j] = 0.0
    return faces


_FACES = {k: _faces(k) for k in range(3)}


def exact_stabbing(task: Task) -> Iterator[Step]:
    """Yield better sets and smaller bounds until the largest consensus is proven.

    Parameters
    ----------
    task
        A problem with at most three (independent) parameters.

    Raises
    ------
    ValueError
        If it has more.

    Notes
    -----
    The bound holds for all models, whatever their size, and for the floats given: intervals are widened by what
    rounding can do. Where splitting a box further is pointless (rounding is larger than the box, or its points just
    fail to fit one model, all over it), minimax fits decide, a bounded number of them; where these do not settle it,
    the search ends with a gap. Memory is bounded; when it runs out, the search goes depth-first.
    """
    rank = task.rows.At.shape[0]
    if rank > 3:
        raise ValueError(
            f"exact stabbing is for at most 3 independent parameters, but this problem has {rank}; "
            "use another exact method"
        )
    if rank == 0:
        mask = np.abs(task.problem.b) <= task.limit * task.rows.scale
        yield Step(subset=mask if mask.any() else None, upper_bound=int(np.count_nonzero(mask)))
        return
    yield from _Search(task).steps()


class _Search:
    """The state of a search, and the way back from strips to points."""

    def __init__(self, task: Task) -> None:
        self.task = task
        A, b = task.problem.A, task.problem.b
        n = len(b)
        columns = np.flatnonzero(task.rows.to_model.any(axis=1))
        self.k = len(columns) - 1
        place, constant = stabbing_column(A, columns)
        columns[[place, -1]] = columns[[-1, place]]
        limit = task.limit * task.rows.scale  # exact: the scale is a power of two
        fields, order = np.empty((6, n)), np.empty(n, dtype=np.int64)
        n_regular, size, always, left_out = make_strips(
            A, b, limit, columns, constant, task.rng.random((SAMPLES, 3)), fields, order
        )
        a0, a1, low, high, pad, grain = fields[:, :size]
        self.strips = Strips(a0, a1, low, high, pad, grain, n_regular)
        self.points = order[:size]
        self.always = order[n - always :]
        self.free = always + left_out
        self.tree = _new_tree(size, len(_FACES[self.k]))
        self.prism = Prism(
            np.zeros(BOX_SIZE),
            np.empty(size + 1, dtype=np.int32),
            np.empty((4, size + 1)),
            np.empty(min(4 * size, MOST_BINS) + 9, dtype=np.int32),
            np.zeros(1, dtype=np.int64),
            np.array([0.0, 0.0, 1.0, 0.0]),
        )
        self._found: NDArray[np.bool_] | None = None

    @property
    def best(self) -> int:
        """The largest consensus found among the strips."""
        return int(self.prism.best[0])

    @property
    def upper_bound(self) -> int:
        """No model has more inliers than this."""
        return self.free + int(max(self.best, self.tree.state[CEILING], self.tree.state[TOP]))

    def steps(self) -> Iterator[Step]:
        """Search to the end."""
        if self.k == 0:
            yield self._stab()
            return
        everything = self.tree.everything
        dependence = self.k if len(everything) and not dependent_rows(self.strips, everything, self.k) else 0
        shown = 0
        reason = TIRED
        left = self.task.seconds_left()
        budget = BUDGET if left == np.inf else BUDGET // SHORTER
        while reason != PROVEN:
            reason = advance(self.strips, self.prism, self.tree, _FACES[self.k], dependence, budget, self.task.gap)
            if left < np.inf:
                before, left = left, self.task.seconds_left()
                fits = budget * max(left, 0.0) / max(before - left, 1e-9)
                budget = max(LEAST_BUDGET, int(min(fits, 2.0 * budget, BUDGET)))
            if reason == NODES_FULL:
                self._grow_nodes()
                continue
            if reason == LISTS_FULL:
                self._grow_lists()
                continue
            if reason == UNDECIDED:
                self._decide()
            subset = None
            if self.best > shown:
                shown = self.best
                subset = self._subset()
            yield Step(subset=subset, upper_bound=self.upper_bound, refined=True)

    def _stab(self) -> Step:
        """Solve a problem with one parameter."""
        low, high = self.strips.low, self.strips.high
        rounding = self.strips.pad + self.strips.grain
        bound, _ = _deepest(low - rounding, high + rounding)
        self.prism.best[0], self.prism.model[3] = _deepest(low, high)
        return Step(subset=self._subset(), upper_bound=self.free + bound)

    def _subset(self) -> NDArray[np.bool_] | None:
        """Return the best set as points, with those that are always inliers, if it is feasible.

        The model that the points share says that it is; but the engine, which rounds in its own way, has the last word.
        Should it refuse, the point that holds the fit most is left out.
        """
        if self._found is not None:
            subset = self._found
            self._found = None
        else:
            mask = np.empty(len(self.points), dtype=np.bool_)
            inliers(self.strips, self.prism.model, mask)
            subset = np.zeros(self.task.problem.n_points, dtype=np.bool_)
            subset[self.points[mask]] = True
        subset[self.always] = True
        for _ in range(REFUSALS):
            if not subset.any():
                break
            workspace = allocate(self.task.rows, subset)
            if cold_fit(*workspace) == OK and workspace.x[-1] <= self.task.limit:
                return subset
            multipliers = np.where(workspace.q >= 0, workspace.C[-1], -np.inf)
            if not multipliers.max() > 0:
                break
            subset[workspace.q[int(np.argmax(multipliers))] >> 1] = False
        return None

    def _decide(self) -> None:
        """Decide the node in question, which small boxes cannot decide, by minimax fits of its points."""
        state = self.tree.state
        node = int(state[NODE])
        possible = _possible(self.strips, self.tree.boxes[node])
        subset = np.zeros(self.task.problem.n_points, dtype=np.bool_)
        subset[self.points[possible]] = True
        found, settled = _largest_feasible(self.task, subset, self.best)
        if found is not None:
            self._found = found
            self.prism.best[0] = int(np.count_nonzero(found))
        if not settled:
            state[CEILING] = max(state[CEILING], self.tree.bound[node])

    def _grow_nodes(self) -> None:
        """Double the memory for nodes, or say that there is no more."""
        tree = self.tree
        length = min(2 * len(tree.bound), MOST_NODES)
        if length <= len(tree.bound):
            tree.state[NODES_CAPPED] = 1
            return
        self.tree = tree._replace(
            boxes=_enlarged(tree.boxes, length),
            bound=_enlarged(tree.bound, length),
            base=_enlarged(tree.base, length),
            start=_enlarged(tree.start, length),
            size=_enlarged(tree.size, length),
            link=_enlarged(tree.link, length),
        )

    def _grow_lists(self) -> None:
        """Double the memory for lists, or say that there is no more."""
        tree = self.tree
        length = min(2 * len(tree.arena), max(MOST_LISTS[0] * len(tree.everything), MOST_LISTS[1]))
        if length <= len(tree.arena):
            tree.state[LISTS_CAPPED] = 1
            return
        self.tree = tree._replace(arena=_enlarged(tree.arena, length))


def _new_tree(n: int, n_roots: int) -> Tree:
    state = np.zeros(N_STATE, dtype=np.int64)
    state[[TOP, NODE, FREE, STACK, ROOTS]] = n, -1, -1, -1, n_roots
    bound, base, start, size, link = (np.empty(FIRST_NODES, dtype=np.int64) for _ in range(5))
    return Tree(
        np.empty((FIRST_NODES, BOX_SIZE)),
        bound,
        base,
        start,
        size,
        link,
        np.full(n + 1, -1, dtype=np.int64),
        np.empty(max(FIRST_LISTS[0] * n, FIRST_LISTS[1]), dtype=np.int32),
        np.arange(n, dtype=np.int32),
        state,
    )


def _deepest(low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[int, float]:
    """Return how many of the closed intervals share a number, and such a number."""
    if len(low) == 0:
        return 0, 0.0
    begins = np.sort(low)
    depth = np.arange(1, len(low) + 1) - np.searchsorted(np.sort(high), begins, side="left")
    best = int(depth.max())
    places = begins[depth == best]
    return best, float(places[np.argmin(np.abs(places))])  # steep models are worst for the engine


def _enlarged(array: NDArray[Any], length: int) -> NDArray[Any]:
    larger = np.empty((length, *array.shape[1:]), dtype=array.dtype)
    larger[: len(array)] = array
    return larger


def _possible(strips: Strips, box: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the strips that can hold a model of the prism."""
    c0, c1, cw, h0, h1, hw = box[:WINDOW]
    shift = strips.a0 * c0 + strips.a1 * c1
    radius = np.abs(strips.a0) * h0 + np.abs(strips.a1) * h1 + strips.grain + strips.pad * (cw + hw)
    lower = strips.low * cw - shift - radius - np.abs(strips.low) * hw
    upper = strips.high * cw - shift + radius + np.abs(strips.high) * hw
    regular = np.arange(len(shift)) < strips.n_regular
    begin, end = np.where(regular, box[WINDOW], 0.0), np.where(regular, box[WINDOW + 1], 0.0)
    return np.flatnonzero((lower <= end) & (upper >= begin))


def _largest_feasible(task: Task, subset: NDArray[np.bool_], floor: int) -> tuple[NDArray[np.bool_] | None, bool]:
    """Look for a feasible part of `subset` with more than `floor` points: (one or None, is it the largest?).

    An infeasible set holds an infeasible basis, and every feasible part of it misses a point of that: a depth-first
    search over which one. Where parts without one point have been looked at, all others hold it.
    """
    best: NDArray[np.bool_] | None = None
    waiting = [(subset, np.zeros_like(subset))]
    basis = np.empty(task.rows.At.shape[0] + 1, dtype=np.int64)
    for _ in range(FITS):
        if not waiting:
            break
        part, held = waiting.pop()
        size = int(np.count_nonzero(part))
        if size <= floor:
            continue
        workspace = allocate(task.rows, part)
        if cold_fit(*workspace) != OK:
            return best, False
        if workspace.x[-1] <= task.limit:
            best, floor = part, size
            continue
        held = held.copy()
        for point in basis[: basis_points(workspace.C, workspace.q, basis)]:
            if not held[point]:
                smaller = part.copy()
                smaller[point] = False
                waiting.append((smaller, held.copy()))
                held[point] = True
    return best, not waiting
