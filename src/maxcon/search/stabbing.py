"""Exact consensus maximisation with up to three parameters: branch and bound, stabbing along the last one.

For models with one parameter each point is an inlier on an interval, and the best model stabs the most intervals.
With two or three, the others are searched by branch and bound, and each box of them is bounded by a stabbing of
intervals that are widened for the box (`stabbing_prism`, `stabbing_kernels`). Nothing is assumed about the size of
the parameters: they are homogeneous, and the boxes cover the faces of a cube (`stabbing_rows`).

At w = 0, "infinitely steep", there is no model, only limits of models; there all points of one vertical line, or of
one vertical plane, are inliers together, and no box that touches it has a bound below their number. But their rows
are dependent, and a subset of such points fits a model only if it fits one with a parameter less. So where the
possible inliers of a steep box are dependent, all points that depend in the same way are solved once, as a problem
of their own.

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
    DEPENDENT,
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
    TOP,
    UNDECIDED,
    Tree,
    advance,
    node_points,
)
from maxcon.search.stabbing_prism import BOX_SIZE, CENTRE, HALF, WINDOW, Prism, inliers
from maxcon.search.stabbing_rows import SAMPLES, Strips, dependent_rows, make_strips, stabbing_column

#: Points in prisms between two steps: some 10 ms.
BUDGET = 1_000_000

#: Memory for nodes, at first and at most: 150 bytes each.
FIRST_NODES, MOST_NODES = 2_048, 262_144

#: Memory for lists of points, at first and at most: so many times N, but at least so many entries of 4 bytes.
FIRST_LISTS, MOST_LISTS = (16, 32_768), (32, 16_777_216)

#: Bins of one stabbing at most: these stay in the nearest cache.
MOST_BINS = 4_096

#: How many minimax fits may go into the decision about a box that is too small to be split.
FITS = 256

#: Points that the engine may refuse in a set that the search has found, before the set is given up.
REFUSALS = 8

#: How many groups of dependent rows are remembered as solved: one bit each.
MARKS = 64


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


_FACES = {k: _faces(k) for k in (1, 2)}


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
    rounding can do. Where a box is so small that splitting it is pointless, its points are decided by minimax fits,
    a bounded number of them; where these do not settle it, the search ends with a gap. Memory is bounded; when it
    runs out, the search goes depth-first.
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
    yield from _Points(task).steps()


class _Points:
    """The problem as strips, and the way back from strips to points."""

    def __init__(self, task: Task) -> None:
        self.task = task
        A, b = task.problem.A, task.problem.b
        n = len(b)
        columns = np.flatnonzero(task.rows.to_model.any(axis=1))
        self.k = len(columns) - 1
        place, constant = stabbing_column(A, columns)
        columns[[place, -1]] = columns[[-1, place]]
        limit = task.limit * task.rows.scale  # exact: the scale is a power of two
        self.order = np.empty(n, dtype=np.int64)
        strips = _empty_strips(n)
        n_regular, size, always, self.left_out = make_strips(
            A, b, limit, columns, constant, task.rng.random((SAMPLES, 3)), strips, self.order
        )
        self.strips = _select(strips, slice(size), n_regular)
        self.always = self.order[n - always :]

    def steps(self) -> Iterator[Step]:
        """Search, and report in terms of points."""
        free = len(self.always) + self.left_out
        everything = np.arange(len(self.strips.low))
        if self.k == 0:
            _, bound, mask = _stab(self.strips, everything)
            yield Step(subset=self.subset(mask), upper_bound=bound + free)
            return
        search = _Search(self, self.strips, everything, self.k, 0, self.task.gap)
        shown = 0
        for _ in search.steps():
            subset = None
            if search.best > shown:
                shown = search.best
                subset = self.subset(search.mask())
            yield Step(subset=subset, upper_bound=search.upper_bound + free)

    def subset(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
        """Return the points of these strips, and those that are always inliers, as a feasible set.

        The model that they share says that they are feasible; but the engine, which rounds in its own way, has the
        last word. Should it refuse, the point that holds the fit most is left out.
        """
        subset = np.zeros(len(self.order), dtype=np.bool_)
        subset[self.order[: len(mask)][mask]] = True
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


def _empty_strips(n: int) -> Strips:
    a0, a1, low, high, pad, grain = np.empty((6, n))
    return Strips(a0, a1, low, high, pad, grain, np.zeros(n, dtype=np.uint64), 0)


def _select(strips: Strips, chosen: slice | NDArray[np.intp], n_regular: int) -> Strips:
    """Return these of the strips, of which the first `n_regular` are regular."""
    return Strips(
        strips.a0[chosen],
        strips.a1[chosen],
        strips.low[chosen],
        strips.high[chosen],
        strips.pad[chosen],
        strips.grain[chosen],
        strips.marks[chosen],
        n_regular,
    )


def _stab(strips: Strips, group: NDArray[np.intp]) -> tuple[int, int, NDArray[np.bool_]]:
    """Stab the intervals of strips whose rows are equal: (depth, upper bound on it, which are stabbed)."""
    low, high = strips.low[group], strips.high[group]
    rounding = strips.pad[group] + strips.grain[group]
    bound, _ = _deepest(low - rounding, high + rounding)
    depth, where = _deepest(low, high)
    mask = np.zeros(len(strips.low), dtype=np.bool_)
    mask[group] = (low <= where) & (where <= high)
    return depth, bound, mask


def _deepest(low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[int, float]:
    """Return how many of the closed intervals share a number, and such a number."""
    if len(low) == 0:
        return 0, 0.0
    begins = np.sort(low)
    depth = np.arange(1, len(low) + 1) - np.searchsorted(np.sort(high), begins, side="left")
    best = int(depth.max())
    places = begins[depth == best]
    return best, float(places[np.argmin(np.abs(places))])  # steep models are worst for the engine


class _Search:
    """Branch and bound over k = 1 or 2 outer parameters of some strips, for a consensus above `best`.

    `rows` says which of the owner's strips these are.
    """

    def __init__(self, owner: _Points, strips: Strips, rows: NDArray[np.intp], k: int, best: int, gap: int) -> None:
        n = len(strips.low)
        self.owner, self.strips, self.rows, self.k, self.gap = owner, strips, rows, k, gap
        self._found: NDArray[np.bool_] | None = None
        self._counted = best
        self._groups = 0
        state = np.zeros(N_STATE, dtype=np.int64)
        state[[TOP, NODE, FREE, STACK, ROOTS]] = n, -1, -1, -1, len(_FACES[k])
        bound, base, start, size, link = (np.empty(FIRST_NODES, dtype=np.int64) for _ in range(5))
        self.tree = Tree(
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
        self.prism = Prism(
            np.zeros(BOX_SIZE),
            np.empty(n + 1, dtype=np.int32),
            np.empty((4, n + 1)),
            np.empty(min(4 * n, MOST_BINS) + 9, dtype=np.int32),
            np.array([best]),
            np.array([0.0, 0.0, 1.0, 0.0]),
        )

    @property
    def best(self) -> int:
        """The largest consensus found; at first, the one to beat."""
        return int(self.prism.best[0])

    @property
    def upper_bound(self) -> int:
        """No model has more inliers among the strips than this, or than there were to beat."""
        return int(max(self.best, self.tree.state[CEILING], self.tree.state[TOP]))

    def mask(self) -> NDArray[np.bool_]:
        """Return which strips are in the best set."""
        if self._found is None or self._counted < self.best:
            self._found = np.empty(len(self.strips.low), dtype=np.bool_)
            inliers(self.strips, self.prism.model, self._found)
            self._counted = self.best
        return self._found

    def steps(self) -> Iterator[None]:
        """Search to the end; come back now and then."""
        while True:
            reason = advance(self.strips, self.prism, self.tree, _FACES[self.k], self.k, BUDGET, self.gap)
            if reason == NODES_FULL:
                self._grow_nodes()
                continue
            if reason == LISTS_FULL:
                self._grow_lists()
                continue
            if reason == DEPENDENT:
                yield from self._solve_dependent()
            elif reason == UNDECIDED:
                self._decide()
            yield
            if reason == PROVEN:
                return

    def _improve(self, best: int, mask: NDArray[np.bool_]) -> None:
        self.prism.best[0] = self._counted = best
        self._found = mask

    def _give_up(self, bound: int) -> None:
        """Close the node in question, leaving its bound."""
        state = self.tree.state
        state[CEILING] = max(state[CEILING], min(bound, int(self.tree.bound[state[NODE]])))

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

    def _solve_dependent(self) -> Iterator[None]:
        """Solve all points that depend in the way of those of the node in question; that closes it."""
        strips = self.strips
        members = node_points(self.tree, int(self.tree.state[NODE])).copy()
        _, v0, v1 = dependent_rows(strips, members, self.k)
        group = np.union1d(_group(strips, members, self.k, v0, v1), members)
        if self.k == 1:
            best, bound, mask = _stab(strips, group)
        else:
            search = self._along(group, strips.a0 if v0 == 1.0 else strips.a1)
            for _ in search.steps():
                yield
            best, bound = search.best, search.upper_bound
            mask = np.zeros(len(strips.low), dtype=np.bool_)
            if best > self.best:
                mask[group[search.mask()]] = True
        if best > self.best:
            self._improve(best, mask)
        if bound > self.best:
            self._give_up(bound)
        bit = np.uint64(1) << np.uint64(self._groups % MARKS)
        self._groups += 1
        strips.marks[:] &= ~bit
        strips.marks[group] |= bit

    def _along(self, group: NDArray[np.intp], a: NDArray[np.float64]) -> _Search:
        """Return the search for more than the best among the strips of `group`, which have a line of rows `a`.

        All a_i = a_0 + mu_i v, so models differ by (a_0 . sigma + tau, v . sigma) only, and mu is one component of a_i:
        that in which v is 1. Rounding counts twice, since `a` stands for both components.
        """
        strips = self.strips
        n_regular = int(np.searchsorted(group, strips.n_regular))
        line = _select(strips, group, n_regular)._replace(
            a0=a[group],
            a1=np.zeros(len(group)),
            pad=2.0 * strips.pad[group],
            grain=2.0 * strips.grain[group],
            marks=np.zeros(len(group), dtype=np.uint64),
        )
        return _Search(self.owner, line, self.rows[group], 1, self.best, 0)

    def _decide(self) -> None:
        """Decide the node in question, which small boxes cannot decide, by minimax fits of its points."""
        possible = _possible(self.strips, self.tree.boxes[self.tree.state[NODE]])
        points = self.owner.order[self.rows]
        subset = np.zeros(len(self.owner.order), dtype=np.bool_)
        subset[points[possible]] = True
        found, settled = _largest_feasible(self.owner.task, subset, self.best)
        if found is not None:
            self._improve(int(np.count_nonzero(found)), found[points])
        if not settled:
            self._give_up(len(possible))


def _enlarged(array: NDArray[Any], length: int) -> NDArray[Any]:
    larger = np.empty((length, *array.shape[1:]), dtype=array.dtype)
    larger[: len(array)] = array
    return larger


def _group(strips: Strips, members: NDArray[np.int32], k: int, v0: float, v1: float) -> NDArray[np.intp]:
    """Return the strips whose rows depend on those of `members`: equal ones (k = 1), or along v (k = 2)."""
    here = members[0]
    regular = np.arange(len(strips.low)) < strips.n_regular
    d0 = strips.a0 - np.where(regular, strips.a0[here], 0.0)
    d1 = strips.a1 - np.where(regular, strips.a1[here], 0.0)
    tolerance = 4.0 * (strips.grain + strips.grain[here])
    if k == 1:
        return np.flatnonzero(regular & (np.abs(d0) <= tolerance))
    candidates = np.ones(len(regular), dtype=np.bool_) if here < strips.n_regular else ~regular
    return np.flatnonzero(candidates & (np.abs(d0 * v1 - d1 * v0) <= tolerance))


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
