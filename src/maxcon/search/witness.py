"""A witness of an upper bound: disjoint groups of points, and why each of them has so many outliers.

For disjoint groups of points every model leaves out at least the sum of what it leaves out of each. What it
leaves out of a group is proven by a pool of bases, that is of sets of at most d + 1 points that no model
explains, and a short proof that no fewer points hit all of them (`witness_kernels`). So a checker needs
neither this file nor the engine: a basis is refuted by one linear system, and the rest is counting
(`maxcon.certification.verify`).

The points are sorted by their residuals and dealt round-robin into parts, so that each has its share of
outliers among enough inliers. Small parts are cheap but lose something: their own best model leaves out fewer
points than the best model of all. A part that loses is given points that speak against its model and that no
other proof needs; where there are none it is merged with another part, as long as that pays.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import LinearRows, Workspace, allocate
from maxcon.minimax.linear import OK, cold_fit, compute_residuals
from maxcon.problem import check_indices
from maxcon.search.anytime import Task
from maxcon.search.exclusion import excludes
from maxcon.search.witness_kernels import (
    DOUBTFUL,
    FAILED,
    FOUND,
    FULL,
    KEPT,
    PROVEN,
    SIZE,
    UNFINISHED,
    WRITTEN,
    Search,
    allocate_search,
    begin,
    prove,
)

#: A fit counts as feasible up to so much above the limit, relative and, in the unit of the rows, absolute:
#: what is proven must hold in exact arithmetic too, and the engine is good to some 1e-14.
RELATIVE_MARGIN, ABSOLUTE_MARGIN = 1e-11, 1e-13

#: How many outliers a part has at first, about: of 2 to 10, the number that proved most with a few thousand
#: bases.
OUTLIERS_PER_PART = 4

#: The number of bases that is allowed at least.
LEAST_BASES = 5_000

#: Nodes between two looks at the clock: some 10 ms at most.
PIECE = 200

#: Nodes of one proof, times the bases allowed: it ends in any case.
NODES_PER_BASIS = 4

#: How often a part is given new points, and how many at a time.
REINFORCEMENTS, REINFORCEMENT = 60, 2


class Group(NamedTuple):
    """Points that no model explains without leaving out `needed` of them.

    Attributes
    ----------
    needed
        How many points at least hit all bases.
    bases
        Sets of at most d + 1 points that no model explains together.
    proof
        Why fewer than `needed` points do not hit all bases, as `witness_kernels` writes it down.
    """

    needed: int
    bases: tuple[tuple[int, ...], ...]
    proof: tuple[int, ...]


@dataclass(frozen=True)
class Witness:
    """Disjoint groups, which prove ``n_inliers <= upper_bound`` for any model.

    Attributes
    ----------
    groups
        None shares a point with another.
    upper_bound
        N minus all that the groups need.
    """

    groups: tuple[Group, ...]
    upper_bound: int


def make_witness(
    task: Task, mask: NDArray[np.bool_], *, enough: int | None = None, max_bases: int | None = None
) -> Witness:
    """Prove an upper bound on the consensus, by bases alone.

    Parameters
    ----------
    task
        The problem; what is proven by its deadline is returned.
    mask
        Shape (N,), bool, or indices: a good set of points. Its minimax fit, the incumbent, says where
        outliers may be. The bound is valid whatever the set is, and close to its size where that is close to
        the optimum.
    enough
        Stop when this upper bound is proven; by default the number of inliers of the incumbent.
    max_bases
        About so many bases are used at most, which bounds the work and the size of a file (some 50 bytes a
        basis). By default 5,000, or as many as there are outliers.

    Raises
    ------
    ValueError
        If `mask` is empty or names points that do not exist.
    ArithmeticError
        If its minimax fit does not converge.
    """
    mask = check_indices(mask, task.problem.n_points, "mask")
    residuals = _residuals(task, mask)
    n_points, n_outliers = len(residuals), int(np.count_nonzero(residuals > task.limit))
    target = n_outliers if enough is None else n_points - enough
    maker = _Maker(task, residuals, target, max(LEAST_BASES, n_outliers) if max_bases is None else max_bases)
    for _ in maker.steps():
        if task.over():
            break
    groups = tuple(group for part in maker.parts.values() for group in part.groups)
    return Witness(groups, n_points - maker.needed)


def _residuals(task: Task, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the sizes of the residuals of the minimax fit of these points, in the unit of the rows."""
    workspace = allocate(task.rows, mask)
    if cold_fit(*workspace) != OK:
        raise ArithmeticError("the minimax fit of mask did not converge; please report the data")
    compute_residuals(workspace.At, workspace.b, workspace.x, workspace.r)
    return np.abs(workspace.r)


@dataclass
class _Part:
    """Points that are looked at together.

    Attributes
    ----------
    points
        Those that the incumbent explains worst come first.
    n_outliers
        How many of them the incumbent leaves out.
    groups
        What is proven about them.
    model
        Parameters for the rows that leave out no more of them than is proven; None where that is not known.
    open
        There may be more to prove with the bases that are allowed.
    """

    points: NDArray[np.int64]
    n_outliers: int
    groups: tuple[Group, ...] = ()
    model: NDArray[np.float64] | None = None
    open: bool = True

    @property
    def needed(self) -> int:
        return sum(group.needed for group in self.groups)

    @property
    def tight(self) -> bool:
        return self.needed >= self.n_outliers


class _Maker:
    """Proves what each part needs, then mends and merges the parts that lose; can be stopped after each step.

    Attributes
    ----------
    parts
        By number.
    needed
        How many points are proven to be left out, of all parts.
    """

    def __init__(self, task: Task, residuals: NDArray[np.float64], target: int, max_bases: int) -> None:
        """Deal the points, the worst explained first, into parts."""
        self.task, self.residuals, self.target, self.max_bases = task, residuals, target, max_bases
        n_points, rank = len(residuals), task.rows.At.shape[0]
        outlier = residuals > task.limit
        n_outliers = int(np.count_nonzero(outlier))
        size = max(2 * (rank + 1), OUTLIERS_PER_PART * n_points // max(n_outliers, 1))
        n_parts = max(1, min(n_points // size, n_outliers))
        order = np.argsort(-residuals, kind="stable")
        self.parts: dict[int, _Part] = {}
        for k in range(n_parts):
            points = order[k::n_parts]
            self.parts[k] = _Part(points, int(np.count_nonzero(outlier[points])))
        self.owner = np.empty(n_points, dtype=np.int64)
        self.owner[order] = np.arange(n_points) % n_parts
        self.uses = np.zeros(n_points, dtype=np.int64)  # in how many bases a point is
        self.place = np.zeros(n_points, dtype=np.int32)  # of a point in the part that is looked at
        self.search = allocate_search(n_points, task.problem.n_params, max_bases)
        self.needed = self.n_bases = 0

    @property
    def done(self) -> bool:
        return self.needed >= self.target

    def steps(self) -> Iterator[None]:
        """Prove one more outlier in each part, again and again (the first are the cheapest); then mend, then merge."""
        active = [part for part in self.parts.values() if not part.tight]
        while active:
            still = []
            for part in active:
                if self.done:
                    return
                if (yield from self._prove_one_more(part)) == PROVEN and not part.tight:
                    still.append(part)
            active = still
        for key in self._losing():
            yield from self._mend(key)
        while not self.done and (pair := self._choose_pair()) is not None:
            yield from self._merge(*pair)

    def _losing(self) -> list[int]:
        """Return which parts may need more than is proven, the smallest first."""
        losing = [key for key, part in self.parts.items() if part.open and not part.tight]
        return sorted(losing, key=lambda key: len(self.parts[key].points))

    def _mend(self, key: int) -> Generator[None, None, int]:
        """Prove as much as can be, giving the part points that speak against the models by which it loses."""
        part = self.parts[key]
        left = REINFORCEMENTS
        while True:
            if part.tight or self.done:
                return PROVEN
            verdict = yield from self._prove_one_more(part)
            if verdict == FOUND:
                left -= 1
                if left < 0 or not self._reinforce(key):
                    return FOUND
            elif verdict != PROVEN:
                return verdict

    def _reinforce(self, key: int) -> bool:
        """Move points that its model explains badly to a part, inliers that no proof needs; False without any."""
        part = self.parts[key]
        assert part.model is not None
        against = np.abs(self.task.rows.b - part.model @ self.task.rows.At)
        movable = (self.uses == 0) & (self.residuals <= self.task.limit) & (self.owner != key)
        against[~movable] = 0.0
        points = np.argsort(-against)[:REINFORCEMENT]
        points = points[against[points] > self._limit()]
        for former in set(self.owner[points].tolist()):
            other = self.parts[former]
            other.points = other.points[~np.isin(other.points, points)]
        part.points = self._sorted(np.concatenate([part.points, points]))
        self.owner[points] = key
        return len(points) > 0

    def _choose_pair(self) -> tuple[int, int] | None:
        """Return the smallest part that loses, and the one with most points, for its size, against its model.

        That is another one that loses, if there is one.
        """
        losing = self._losing()
        if not losing:
            return None
        others = losing[1:] or [key for key, part in self.parts.items() if part.open and key != losing[0]]
        if not others:
            return None
        model = self.parts[losing[0]].model
        if model is None:
            return losing[0], others[0]
        against = np.abs(self.task.rows.b - model @ self.task.rows.At) > self.task.limit
        count = np.bincount(self.owner[against], minlength=max(self.parts) + 1)
        return losing[0], max(others, key=lambda key: count[key] / max(len(self.parts[key].points), 1))

    def _merge(self, first: int, second: int) -> Iterator[None]:
        """Make one part of two; their groups stay until it needs more than both."""
        one, other = self.parts.pop(first), self.parts.pop(second)
        key = max(first, second)
        points = self._sorted(np.concatenate([one.points, other.points]))
        self.parts[key] = part = _Part(points, one.n_outliers + other.n_outliers, one.groups + other.groups)
        self.owner[points] = key
        verdict = yield from self._mend(key)
        part.open = verdict in {PROVEN, FOUND}

    def _prove_one_more(self, part: _Part) -> Generator[None, None, int]:
        """Try to prove that one more point of the part is left out; return what `prove` does."""
        known = [basis for group in part.groups for basis in group.bases]
        room = self.max_bases - self.n_bases + len(known)  # new ones take the place of those that it has
        if room <= len(known):
            part.open = False
            return FULL
        search = self.search._replace(pool=self.search.pool[:room])
        self.place[part.points] = np.arange(len(part.points), dtype=np.int32)
        search.pool[: len(known)] = -1
        for row, basis in enumerate(known):
            search.pool[row, : len(basis)] = self.place[list(basis)]
        search.head[SIZE] = len(known)
        begin(search, len(part.points))
        workspace = self._workspace(part.points)
        verdict, pieces = UNFINISHED, NODES_PER_BASIS * self.max_bases // PIECE + 1
        while verdict in {UNFINISHED, DOUBTFUL} and pieces > 0:
            verdict = prove(workspace, search, self._limit(), part.needed, PIECE)
            if verdict == DOUBTFUL and not self._settle(part.points, search, workspace):
                verdict = FAILED
            pieces -= verdict == UNFINISHED
            yield
        part.model = workspace.x[:-1].copy() if verdict == FOUND else None
        part.open = verdict in {PROVEN, FOUND}
        if verdict == PROVEN:
            group = _used(part.points, part.needed + 1, search.pool, search.proof[: search.head[WRITTEN]])
            for bases, change in ((known, -1), (group.bases, 1)):
                for basis in bases:
                    self.uses[list(basis)] += change
            self.n_bases += len(group.bases) - len(known)
            part.groups = (group,)
            self.needed += 1
        yield
        return verdict

    def _settle(self, points: NDArray[np.int64], search: Search, workspace: Workspace) -> bool:
        """Make the newest basis one to the letter of the data, with more points if need be; False if that fails.

        Rows that are dependent only up to rounding have a model all the same, of astronomical size. One or
        two more points, all but without weight, exclude that: best those that are kept, which cost nothing.
        """
        problem = self.task.problem
        row = search.pool[search.head[SIZE] - 1]
        basis = row[row >= 0].tolist()
        state = search.state[: len(points)]
        fitted = (workspace.gain > 0) | (state == KEPT)
        tight = workspace.q[workspace.q >= 0] >> 1
        rest = np.r_[tight, np.flatnonzero(state == KEPT), np.flatnonzero(fitted)[::-1]].tolist()
        limit = problem.inlier_limit(self.task.threshold)
        while not excludes(problem.A, problem.b, points[basis], limit):
            more = next((point for point in rest if point not in basis), None)
            if more is None or len(basis) == len(row):
                return False
            basis.append(more)
        row[: len(basis)] = basis
        return True

    def _limit(self) -> float:
        return self.task.limit * (1.0 + RELATIVE_MARGIN) + ABSOLUTE_MARGIN

    def _sorted(self, points: NDArray[np.int64]) -> NDArray[np.int64]:
        return points[np.argsort(-self.residuals[points], kind="stable")]

    def _workspace(self, points: NDArray[np.int64]) -> Workspace:
        """Return a workspace for these points alone."""
        rows = self.task.rows
        At = np.ascontiguousarray(rows.At[:, points])
        return allocate(LinearRows(At, rows.b[points], rows.scale, rows.to_model, rows.origin))


def _used(points: NDArray[np.int64], needed: int, pool: NDArray[np.int32], proof: NDArray[np.int32]) -> Group:
    """Return what is proven, with those bases alone that the proof cites."""
    numbers: dict[int, int] = {}
    written: list[int] = []
    at, entries = 0, proof.tolist()
    while at < len(entries):
        end = at + 1 + max(entries[at], 1)
        written.append(entries[at])
        written += [numbers.setdefault(row, len(numbers)) for row in entries[at + 1 : end]]
        at = end
    bases = tuple(tuple(points[row[row >= 0]].tolist()) for row in pool[list(numbers)])
    return Group(needed, bases, tuple(written))
