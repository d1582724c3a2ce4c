"""Exact consensus maximisation with up to three parameters: branch and bound, stabbing along the last one.

For models with one parameter each point is an inlier on an interval, and the best model stabs the most intervals. With
two or three the others are searched by branch and bound, and each box of them is bounded by a stabbing of
intervals that are widened for the box (`stabbing_kernels`). Nothing is assumed about the size of the parameters: they
are homogeneous, and the boxes cover the faces of a cube (`stabbing_rows`).

At w = 0, "infinitely steep", there is no model, only limits of models; there all points of one vertical line, or of one
vertical plane, are inliers together, and no box that touches it has a bound below their number. But their
rows are dependent, and a subset of such points fits a model only if it fits one with a parameter less. So where the
undecided points of such a box are dependent, all points dependent in the same way are solved once, as a
problem of their own.

Branching over all parameters but one, with interval stabbing for that one: Zhang, Peng, Xu, Kneip, "Accelerating
globally optimal consensus maximization in geometric vision" (TPAMI 2024). Bins instead of sorting, windows, the pruning
of decided points and the homogeneous parameters are this file's.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import allocate
from maxcon.minimax.linear import OK, basis_points, cold_fit
from maxcon.search.anytime import Step, Task
from maxcon.search.stabbing_kernels import (
    BEST,
    CAPPED,
    CEILING,
    DEPENDENT,
    FREE,
    FULL,
    N_STATE,
    NODE,
    PROVEN,
    ROOTS,
    STACK,
    TOO_SMALL,
    TOP,
    Tree,
    advance,
    dependent_rows,
    inliers,
    node_points,
)
from maxcon.search.stabbing_rows import SAMPLES, Strips, make_strips, stabbing_column

#: Points in prisms between two steps: some 10 ms.
BUDGET = 2_000_000

#: Memory at first, and at most: nodes, and entries of lists (as multiples of N, or absolute, whatever is larger).
FIRST_NODES, MOST_NODES = 2_048, 262_144
FIRST_LISTS, MOST_LISTS = (16, 32_768), (32, 16_777_216)

#: Bins of a stabbing at most: they stay in the nearest cache.
MOST_BINS = 4_096

#: How many minimax fits may go into the decision about a box that is too small to be split.
FITS = 256

#: Groups of dependent rows that are remembered as solved: one bit each.
MARKS = 64

_INF = float("inf")
_FACES = {
    1: np.array(
        [
            [0, 0, 1, 1, 0, 0, -_INF, _INF],
            [1, 0, 0.5, 0, 0, 0.5, -_INF, _INF],
            [-1, 0, 0.5, 0, 0, 0.5, -_INF, _INF],
        ]
    ),
    2: np.array(
        [
            [0, 0, 1, 1, 1, 0, -_INF, _INF],
            [1, 0, 0.5, 0, 1, 0.5, -_INF, _INF],
            [-1, 0, 0.5, 0, 1, 0.5, -_INF, _INF],
            [0, 1, 0.5, 1, 0, 0.5, -_INF, _INF],
            [0, -1, 0.5, 1, 0, 0.5, -_INF, _INF],
        ]
    ),
}


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
    The bound holds for all models, whatever their size, and for the floats given: intervals are widened by what rounding
    can do. Where a box is so small that it cannot be split, its points are decided by minimax fits, a bounded number of
    them; where these do not settle it, the search ends with a gap of what is left. Memory is bounded; when it runs
    out, the search goes depth-first.
    """
    rank = task.rows.At.shape[0]
    if rank > 3:
        raise ValueError(
            f"exact stabbing takes problems with at most 3 independent parameters, but this one has {rank}; "
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
        values = np.empty((6, n))
        self.order = np.empty(n, dtype=np.int64)
        strips = Strips(*values, np.empty(n, dtype=np.uint64), 0)
        limit = task.limit * task.rows.scale  # exact: the scale is a power of two
        n_regular, size, always, self.left_out = make_strips(
            A, b, limit, columns, constant, task.rng.random((SAMPLES, 3)), strips, self.order
        )
        self.always = self.order[n - always :]
        self.strips = Strips(*(array[:size] for array in strips[:7]), n_regular)

    def steps(self) -> Iterator[Step]:
        """Search, and report in terms of points."""
        free = len(self.always) + self.left_out
        if self.k == 0:
            best, bound, mask = _stab(self.strips, np.arange(len(self.strips.low)))
            yield Step(subset=self.subset(mask), upper_bound=bound + free)
            return
        search = _Search(self, self.strips, np.arange(len(self.strips.low)), self.k, 0, self.task.gap)
        shown = 0
        for _ in search.steps():
            subset = None
            if search.best > shown:
                shown = search.best
                subset = self.subset(search.mask())
            yield Step(subset=subset, upper_bound=search.upper_bound + free)

    def subset(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
        """Return the points of these strips, and those that are always inliers, if they are feasible.

        The model that they share says that they are; but the engine, which has its own rounding, has the last word. Of
        points that it puts above the limit, the one that holds the fit most is left out.
        """
        subset = np.zeros(len(self.order), dtype=np.bool_)
        subset[self.order[: len(mask)][mask]] = True
        subset[self.always] = True
        while subset.any():
            workspace = allocate(self.task.rows, subset)
            if cold_fit(*workspace) == OK and workspace.x[-1] <= self.task.limit:
                return subset
            rows = workspace.q >= 0
            if not rows.any():
                return None
            multipliers = np.where(rows, workspace.C[-1], -np.inf)
            subset[workspace.q[int(np.argmax(multipliers))] >> 1] = False
        return None


def _stab(strips: Strips, group: NDArray[np.intp]) -> tuple[int, int, NDArray[np.bool_]]:
    """Stab the intervals of these strips, whose rows are all equal: (depth, upper bound on it, which are stabbed)."""
    low, high, pad = strips.low[group], strips.high[group], strips.pad[group]
    bound, _ = _deepest(low - pad, high + pad)
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
    best = int(np.argmax(depth))
    return int(depth[best]), float(begins[best])


class _Search:
    """Branch and bound over k = 1 or 2 outer parameters of strips, for consensus above `best`."""

    def __init__(
        self, owner: _Points, strips: Strips, rows: NDArray[np.intp], k: int, best: int, gap: int
    ) -> None:
        n = len(strips.low)
        self.owner, self.strips, self.rows, self.k, self.gap = owner, strips, rows, k, gap
        self._found: NDArray[np.bool_] | None = None
        self._groups = 0
        state = np.zeros(N_STATE, dtype=np.int64)
        state[[BEST, CEILING, NODE, FREE, STACK, ROOTS, TOP]] = best, 0, -1, -1, -1, len(_FACES[k]), n
        self._counted = best
        nodes = FIRST_NODES
        factor, least = FIRST_LISTS
        self.tree = Tree(
            np.empty((nodes, 8)),
            *(np.empty(nodes, dtype=np.int64) for _ in range(5)),
            np.full(n + 1, -1, dtype=np.int64),
            np.empty(max(factor * n, least), dtype=np.int32),
            np.arange(n, dtype=np.int32),
            state,
            np.array([0.0, 0.0, 1.0, 0.0]),
            np.empty(8),
            np.empty(n + 1, dtype=np.int32),
            np.empty((4, n + 1)),
            np.empty(min(4 * n, MOST_BINS) + 9, dtype=np.int32),
        )

    @property
    def best(self) -> int:
        """The largest consensus found; at first, the one to beat."""
        return int(self.tree.state[BEST])

    @property
    def upper_bound(self) -> int:
        """No model has more inliers among the strips, or more than `best` was at first."""
        state = self.tree.state
        return int(max(state[BEST], state[CEILING], state[TOP]))

    def mask(self) -> NDArray[np.bool_]:
        """Return which strips are in the best set."""
        if self._found is None or self._counted < self.best:
            self._found = np.empty(len(self.strips.low), dtype=np.bool_)
            inliers(self.strips, self.tree.model, self._found)
            self._counted = self.best
        return self._found

    def steps(self) -> Iterator[None]:
        """Search to the end; come back now and then."""
        while True:
            reason = advance(self.strips, self.tree, _FACES[self.k], self.k, BUDGET, self.gap)
            if reason == FULL:
                self._grow()
                continue
            if reason == DEPENDENT:
                yield from self._solve_dependent()
            elif reason == TOO_SMALL:
                self._decide()
            yield
            if reason == PROVEN:
                return

    def _improve(self, best: int, mask: NDArray[np.bool_]) -> None:
        self.tree.state[BEST] = self._counted = best
        self._found = mask

    def _give_up(self, bound: int) -> None:
        """Close the node in question with what is known about it."""
        state = self.tree.state
        state[CEILING] = max(state[CEILING], min(bound, int(self.tree.bound[state[NODE]])))

    def _grow(self) -> None:
        """Double the memory, or say that there is no more."""
        tree = self.tree
        factor, least = MOST_LISTS
        nodes = min(2 * len(tree.bound), MOST_NODES)
        lists = min(2 * len(tree.arena), max(factor * len(tree.everything), least))
        if nodes == len(tree.bound) and lists == len(tree.arena):
            tree.state[CAPPED] = 1
        fields = {
            name: _enlarged(getattr(tree, name), nodes)
            for name in ("boxes", "bound", "base", "start", "size", "link")
        }
        self.tree = tree._replace(arena=_enlarged(tree.arena, lists), **fields)

    def _solve_dependent(self) -> Iterator[None]:
        """Solve all points that are dependent in the way of those of the node, which is closed by that."""
        strips, node = self.strips, int(self.tree.state[NODE])
        members = node_points(self.tree, node).copy()
        _, v0, v1 = dependent_rows(strips, members, self.k)
        group = np.union1d(_group(strips, members, self.k, v0, v1), members)
        if self.k == 1:
            best, bound, mask = _stab(strips, group)
            if best > self.best:
                self._improve(best, mask)
        else:
            along = strips.a0 if v0 == 1.0 else strips.a1
            n_regular = int(np.searchsorted(group, strips.n_regular))
            fields = (
                along,
                np.zeros_like(along),
                strips.low,
                strips.high,
                2.0 * strips.pad,
                2.0 * strips.grain,
            )
            smaller = Strips(
                *(field[group] for field in fields), np.zeros(len(group), dtype=np.uint64), n_regular
            )
            search = _Search(self.owner, smaller, self.rows[group], 1, self.best, 0)
            for _ in search.steps():
                yield
            bound = search.upper_bound
            if search.best > self.best:
                mask = np.zeros(len(strips.low), dtype=np.bool_)
                mask[group[search.mask()]] = True
                self._improve(search.best, mask)
        if bound > self.best:
            self._give_up(bound)
        bit = np.uint64(1) << np.uint64(self._groups % MARKS)
        self._groups += 1
        strips.marks[:] &= ~bit
        strips.marks[group] |= bit

    def _decide(self) -> None:
        """Decide a box that is too small to be split by minimax fits of its points."""
        box = self.tree.boxes[self.tree.state[NODE]]
        possible = _possible(self.strips, box)
        subset = np.zeros(len(self.owner.order), dtype=np.bool_)
        subset[self.owner.order[self.rows[possible]]] = True
        found, settled = _largest_feasible(self.owner.task, subset, self.best)
        if found is not None:
            mask = found[self.owner.order[self.rows]]
            self._improve(int(np.count_nonzero(mask)), mask)
        if not settled:
            self._give_up(len(self.strips.low))


def _enlarged(array: NDArray[np.generic], length: int) -> NDArray[np.generic]:
    larger = np.empty((length, *array.shape[1:]), dtype=array.dtype)
    larger[: len(array)] = array
    return larger


def _group(strips: Strips, members: NDArray[np.int32], k: int, v0: float, v1: float) -> NDArray[np.intp]:
    """Return the strips whose rows depend on those of `members`, which differ along v (k = 2) or are equal (k = 1)."""
    here = members[0]
    regular = np.arange(len(strips.low)) < strips.n_regular
    d0 = strips.a0 - np.where(regular, strips.a0[here], 0.0)
    d1 = strips.a1 - np.where(regular, strips.a1[here], 0.0)
    tolerance = 4.0 * (strips.grain + strips.grain[here])
    if k == 1:
        return np.flatnonzero(regular & (np.abs(d0) <= tolerance))
    if here >= strips.n_regular:  # only flat ones
        regular[:] = ~regular
    else:
        regular[:] = True
    return np.flatnonzero(regular & (np.abs(d0 * v1 - d1 * v0) <= tolerance))


def _possible(strips: Strips, box: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the strips that hold a model of the prism."""
    shift = strips.a0 * box[0] + strips.a1 * box[1]
    radius = np.abs(strips.a0) * box[3] + np.abs(strips.a1) * box[4] + strips.pad
    lower = strips.low * box[2] - shift - radius - np.abs(strips.low) * box[5]
    upper = strips.high * box[2] - shift + radius + np.abs(strips.high) * box[5]
    regular = np.arange(len(shift)) < strips.n_regular
    return np.flatnonzero(
        (lower <= np.where(regular, box[7], 0.0)) & (upper >= np.where(regular, box[6], 0.0))
    )


def _largest_feasible(
    task: Task, subset: NDArray[np.bool_], floor: int
) -> tuple[NDArray[np.bool_] | None, bool]:
    """Look for a feasible part of `subset` with more than `floor` points: (one or None, whether that is the largest).

    An infeasible set holds a basis that is infeasible, so every feasible part misses one point of it: a depth-first search
    over which one. A part without point j of a basis need not be looked at where one without j was.
    """
    best: NDArray[np.bool_] | None = None
    open_sets = [(subset, np.zeros_like(subset))]
    basis = np.empty(task.rows.At.shape[0] + 1, dtype=np.int64)
    for _ in range(FITS):
        if not open_sets:
            return best, True
        part, kept = open_sets.pop()
        size = int(np.count_nonzero(part))
        if size <= floor:
            continue
        workspace = allocate(task.rows, part)
        if cold_fit(*workspace) != OK:
            return best, False
        if workspace.x[-1] <= task.limit:
            best, floor = part, size
            continue
        length = basis_points(workspace.C, workspace.q, basis)
        kept = kept.copy()
        for point in basis[:length]:
            if not kept[point]:
                smaller = part.copy()
                smaller[point] = False
                open_sets.append((smaller, kept.copy()))
                kept[point] = True
    return best, not open_sets
