"""Exact consensus maximisation by the partition bound, for any number of parameters.

For disjoint groups of points, the fewest outliers of all points are at least the sum of the fewest outliers of each
group. A group's own optimum, proven by search, is a far stronger part of that sum than "one for each infeasible basis".
The groups are merged two by two; every node of that tree keeps a proven lower bound, which the search (in or out on a
basis point, see `partition_machine`) lifts to the optimum: at the root, in the end.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from threading import Event, Lock

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import allocate
from maxcon.minimax.clock import read_clock
from maxcon.minimax.linear import OK, cold_fit
from maxcon.search.anytime import Step, Task
from maxcon.search.partition_jobs import LIST_TASKS, RUN_TASKS, SOLVE_NODES
from maxcon.search.partition_machine import BUSY, DONE, FULL, advance
from maxcon.search.partition_moves import sum_up
from maxcon.search.partition_state import (
    BEST,
    CUR,
    EXPANDED,
    FOUND,
    INCUMBENT,
    JOB,
    LAST,
    LINKS,
    OPEN,
    PROVEN,
    QUEUE,
    WORK,
    SearchState,
    allocate_state,
    grow,
    model_bytes,
    state_bytes,
)
from maxcon.search.partition_tree import HEIGHT, HI, LEFT, LO, RIGHT, SIZE, MergeTree, leaf_size, merge_tree
from maxcon.search.proposal import best_proposal

#: How long the kernels run before the caller hears from them, in seconds, and the work for the first time.
INTERVAL, FIRST_BUDGET = 0.02, 20_000

#: The least work that they are called for, so that a time limit is passed by no more than some 0.1 ms; and the work
#: of a second, until that has been measured.
LEAST_BUDGET, SPEED = 2_000, 3e7

#: All threads together may take so much memory, in bytes; beyond, the search ends with what it has proven.
MOST_BYTES = 4 << 30

#: So many bytes of new memory are written in a second: no deal is begun whose models cannot be in the time left.
FILL_RATE = 1e9

#: Stands beside what `advance` returns: the work allowed is spent.
SPENT = 3

#: Groups are dealt anew where the outliers of the incumbent have fallen by this part since they were dealt.
DEAL_ANEW = 0.05

#: The root's bound rises by more than one at a time as long as that is expected to take no more work than this (some
#: 0.1 s), at so many times the work for each step up.
LITTLE_WORK, GROWTH = 5_000_000, 1.8


def check_jobs(n_jobs: int) -> int:
    """Return how many threads that means; TypeError or ValueError if it is not -1 or a whole number of at least 1."""
    if isinstance(n_jobs, bool) or not isinstance(n_jobs, (int, np.integer)):
        raise TypeError(f"n_jobs must be a whole number, but it is {n_jobs!r}")
    if n_jobs < 1 and n_jobs != -1:
        raise ValueError(f"n_jobs must be -1 or at least 1, but it is {n_jobs}")
    return usable_cores() if n_jobs == -1 else int(n_jobs)


def usable_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def exact_partition(
    task: Task,
    *,
    start: NDArray[np.bool_] | None = None,
    belief: NDArray[np.float64] | None = None,
    leaf: int | None = None,
    n_jobs: int = -1,
    max_work: int | None = None,
) -> Iterator[Step]:
    """Search until the largest consensus is proven; the bound falls on the way.

    Parameters
    ----------
    task
        What is fitted.
    start
        Shape (N,), bool: a feasible set from any other method; the larger it is, the faster the proof. None: find one.
    belief
        Shape (N,): how probable it is that the point is an inlier, from 0 to 1. The search branches on improbable ones
        first, largest residual first, then on the least probable one. None: on the largest residual under `start`.
    leaf
        How many points a group has at first, at least 1; None: from d and the number of outliers of `start`.
    n_jobs
        How many threads to use; -1 for one a core. Neither the set nor the bound depends on it, where time suffices.
    max_work
        Stop after about so much work, in columns of linear programmes, with one thread after exactly so much; None for
        no limit. A thread does some 3e7 a second.

    Yields
    ------
    Step
        Every few hundredths of a second: larger sets, and the bound proven.

    Raises
    ------
    ValueError
        If an option has the wrong shape or is outside its range.
    """
    return PartitionSearch(task, start=start, belief=belief, leaf=leaf, n_jobs=n_jobs, max_work=max_work).steps()


def _check_belief(belief: NDArray[np.float64], n_points: int) -> None:
    if np.shape(belief) != (n_points,):
        raise ValueError(f"belief must have the shape ({n_points},), but its shape is {np.shape(belief)}")
    wrong = np.flatnonzero(~((belief >= 0.0) & (belief <= 1.0)))
    if wrong.size > 0:
        raise ValueError(
            f"belief must be probabilities from 0 to 1, but {wrong.size} of its {n_points} entries are not; "
            f"the first is {belief[wrong[0]]} at belief[{wrong[0]}]"
        )


class _SpentError(Exception):
    """The work or the memory allowed is spent."""


class PartitionSearch:
    """One partition search, and what it has proven so far.

    Parameters
    ----------
    task, start, belief, leaf, n_jobs, max_work
        See `exact_partition`.

    Attributes
    ----------
    inliers
        Shape (N,), bool: the largest feasible set known.
    least_outliers
        No model has fewer outliers than this.
    """

    def __init__(
        self,
        task: Task,
        *,
        start: NDArray[np.bool_] | None = None,
        belief: NDArray[np.float64] | None = None,
        leaf: int | None = None,
        n_jobs: int = -1,
        max_work: int | None = None,
    ) -> None:
        n_points = task.problem.n_points
        if start is not None and (start.shape != (n_points,) or start.dtype != np.bool_):
            raise ValueError(
                f"start must be a boolean mask of shape ({n_points},), but it is {start.dtype} of shape {start.shape}"
            )
        if belief is not None:
            _check_belief(belief, n_points)
        if leaf is not None and leaf < 1:
            raise ValueError(f"leaf must be at least 1, but it is {leaf}")
        self.task = task
        self.inliers = np.zeros(n_points, dtype=np.bool_)
        self.least_outliers = 0
        self._improved = False
        self._start = start
        self._belief = belief
        self._leaf = leaf
        self._n_jobs = check_jobs(n_jobs)
        self._max_work = np.iinfo(np.int64).max if max_work is None else max_work
        self._work_before = self._expanded_before = 0  # of states that are gone
        self._budget, self._speed = FIRST_BUDGET, SPEED
        self._tree: MergeTree | None = None
        self._states: list[SearchState] = []

    @property
    def n_outliers(self) -> int:
        """The outliers of the largest set known."""
        return int(np.count_nonzero(~self.inliers))

    @property
    def expanded(self) -> int:
        """How many nodes of the search were branched on so far, by all threads, in all deals."""
        return self._expanded_before + sum(int(state.registers[EXPANDED]) for state in self._states)

    def groups(self) -> list[tuple[NDArray[np.int64], int]]:
        """Return disjoint groups of points, each with a proven lower bound on the outliers of any model among them.

        Together they hold all points, and the sum of their bounds is a bound for all. A search that came to its end has
        found these bounds to be optimal, group by group; what it has proven beyond their sum is `least_outliers`.
        """
        if not self._states:
            return []
        assert self._tree is not None
        nodes, found, stack = self._states[0].nodes, [], [0]
        while stack:
            row = nodes[stack.pop()]
            if row[LEFT] < 0:
                found.append((self._tree.order[row[LO] : row[HI]], int(row[PROVEN])))
            else:
                stack += [int(row[RIGHT]), int(row[LEFT])]
        return found

    def steps(self) -> Iterator[Step]:
        """Run the search; see `exact_partition`."""
        limit = self.task.limit
        start = best_proposal(self.task) if self._start is None else self._start
        residuals = self._residuals_of_fit(start)
        within = residuals <= limit
        self.inliers = within if np.count_nonzero(within) >= np.count_nonzero(start) else start.copy()
        dealt = 2 * len(self.inliers) + 1  # so that the first deal is made, however many are out
        if self.inliers.any():
            yield Step(subset=self.inliers.copy())
        try:
            while self.n_outliers < (1.0 - DEAL_ANEW) * dealt and self.least_outliers < self.n_outliers:
                dealt = self.n_outliers
                self._deal(self._residuals_of_fit(self.inliers))
                yield from self._solve_nodes(dealt)
            yield from self._raise_root()
        except _SpentError:  # what has been proven stands
            yield self._news()

    def _residuals_of_fit(self, subset: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the residuals of all points under the minimax fit of `subset`, shape (N,), in the unit of the rows."""
        rows = self.task.rows
        workspace = allocate(rows, subset)
        model = np.zeros(rows.At.shape[0])
        if subset.any() and cold_fit(*workspace) == OK:
            model = workspace.x[:-1]
        residuals: NDArray[np.float64] = np.abs(rows.b - model @ rows.At)
        return residuals

    def _deal(self, residuals: NDArray[np.float64]) -> None:
        """Deal the points into groups by their residuals under the incumbent, and allocate a state for each thread."""
        rows = self.task.rows
        leaf = leaf_size(len(rows.b), len(rows.At), self.n_outliers) if self._leaf is None else self._leaf
        tree = merge_tree(residuals, leaf)
        bytes_each = state_bytes(len(rows.At), len(rows.b), tree)
        n_jobs = min(self._n_jobs, MOST_BYTES // bytes_each)
        filled = n_jobs * model_bytes(len(rows.b), len(tree.nodes))
        if n_jobs == 0 or (self.task.deadline < np.inf and filled > FILL_RATE * self.task.seconds_left()):
            raise _SpentError
        self._work_before, self._expanded_before = self._work(), self.expanded
        self._tree, self._n_jobs, self._states = tree, n_jobs, []  # the states before go before new ones come
        self._states = [
            allocate_state(rows.At, rows.b, self.task.limit, self._tree, residuals) for _ in range(self._n_jobs)
        ]
        self._adopt(residuals)

    def _adopt(self, residuals: NDArray[np.float64]) -> None:
        """Make the largest set known the incumbent of every state; its model's residuals tell where to branch."""
        assert self._tree is not None
        rank = residuals
        if self._belief is not None:
            # Neither is rounded: added to 1, small residuals would be.
            rank = np.where(self._belief > 0.5, -0.5 * self._belief, residuals)
        for state in self._states:
            state.rank[:] = rank[self._tree.order]
            state.models[-1, 0] = ~self.inliers[self._tree.order]
            state.registers[[FOUND, INCUMBENT]] = self.n_outliers

    def _solve_nodes(self, dealt: int) -> Iterator[Step]:
        """Find the optimum of every node below the root, lower ones first; stop early where dealing anew is better."""
        assert self._tree is not None
        heights = self._tree.nodes[:, HEIGHT]
        for height in range(int(heights[0])):
            level = np.flatnonzero(heights == height)
            for state in self._states:
                state.queue[: len(level)] = level
            yield from self._run(SOLVE_NODES, len(level))
            if self.n_outliers < (1.0 - DEAL_ANEW) * dealt:
                return
        for state in self._states:
            sum_up(state.nodes, PROVEN)
            state.nodes[:, CUR] = state.nodes[:, PROVEN]
        yield self._news()

    def _raise_root(self) -> Iterator[Step]:
        """Raise the bound of the root step by step, each time through independent tasks."""
        step = 1
        while (before := self.least_outliers) < (outliers := self.n_outliers):
            worked = self._work()
            base = self._states[0].nodes.copy()
            self._states[0].task_target[0] = min(before + step, outliers)
            yield from self._run(LIST_TASKS, 1)
            first = self._states[0]
            n_tasks = int(first.registers[LINKS])
            proven = [int(first.nodes[0, CUR])]  # if the tasks prove what they are to prove
            yield from self._run(RUN_TASKS, n_tasks)
            first = self._states[0]
            proven += [k + int(first.task_proven[k]) for k in range(n_tasks) if first.task_target[k] > 0]
            base[0, [CUR, PROVEN]] = max(before, min(proven))
            for state in self._states:
                state.nodes[:] = base
            yield self._news()
            if self.least_outliers == before and self.n_outliers == outliers:
                return  # the arithmetic failed somewhere: the bound stays where it is
            step = 1 + max(0, int(np.log(LITTLE_WORK / max(self._work() - worked, 1)) / np.log(GROWTH)))

    def _grow(self, state: SearchState) -> SearchState:
        """Return the state with more room; _SpentError where that is too much memory."""
        if sum(array.nbytes for array in state) > MOST_BYTES // self._n_jobs // 2:
            raise _SpentError
        return grow(state)

    def _work(self) -> int:
        """Return how many columns of linear programmes were looked at."""
        return self._work_before + sum(int(state.registers[WORK]) for state in self._states)

    def _news(self) -> Step:
        """Return the largest set, if it is new, and the bound proven so far."""
        if self._states:
            nodes = self._states[0].nodes.copy()
            sum_up(nodes, PROVEN)
            self.least_outliers = max(self.least_outliers, int(nodes[0, PROVEN]))
        subset = self.inliers.copy() if self._improved else None
        self._improved = False
        return Step(subset=subset, upper_bound=len(self.inliers) - self.least_outliers)

    def _consider(self, n_outliers: int, out: NDArray[np.uint8]) -> None:
        """Take the set whose outliers are marked in `out`, by place, if it is larger and really feasible."""
        assert self._tree is not None
        if n_outliers >= self.n_outliers:
            return
        found = np.zeros(len(self.inliers), dtype=np.bool_)
        found[self._tree.order] = out == 0
        within = self._residuals_of_fit(found) <= self.task.limit  # the model met need not be the best for its set
        if np.count_nonzero(within) > np.count_nonzero(self.inliers):
            self.inliers, self._improved = within, True

    def _run(self, kind: int, n_jobs: int) -> Iterator[Step]:
        """Run the jobs 0 to `n_jobs` of one kind; a better set that they have found becomes the incumbent."""
        for state in self._states:
            state.registers[[QUEUE, OPEN]] = kind, 0
        if self._n_jobs == 1 or n_jobs < 2:
            yield from self._run_alone(kind, n_jobs)
        else:
            yield from self._run_together(kind, n_jobs)
        if self.n_outliers < self._states[0].registers[INCUMBENT]:
            self._adopt(self._residuals_of_fit(self.inliers))
        yield self._news()

    def _run_alone(self, kind: int, n_jobs: int) -> Iterator[Step]:
        """Run all jobs on the first state, with a word to the caller every `INTERVAL`."""
        state = self._states[0]
        state.registers[[JOB, LAST]] = 0, n_jobs
        status = FULL
        while status != DONE:
            began = read_clock()
            left = self._max_work - self._work()
            affordable = LEAST_BUDGET + self._speed * max(self.task.seconds_left(), 0.0)
            budget = int(min(self._budget, left, affordable))
            status = advance(state, budget) if left > 0 else SPENT
            if status == FULL:
                self._states[0] = state = self._grow(state)
            elif status == BUSY:
                self._speed = budget / max(read_clock() - began, 1e-6)
                self._budget = 100 + int(min(max(INTERVAL * self._speed, 0.3 * self._budget), 3.0 * self._budget))
            if status in (BUSY, SPENT):
                if state.registers[BEST] < state.registers[FOUND]:
                    self._consider(int(state.registers[BEST]), state.best_out)
                yield self._news()
            if status == SPENT:
                raise _SpentError
        self._consider(int(state.registers[FOUND]), state.found_out)
        for worker in range(1, len(self._states)):
            if kind == SOLVE_NODES:
                for k in range(n_jobs):
                    self._share_node(int(state.queue[k]), state, self._states[worker])
            elif kind == LIST_TASKS:
                self._share_tasks(worker)

    def _run_together(self, kind: int, n_jobs: int) -> Iterator[Step]:
        """Run each job on whichever thread is free, a state each, and collect what they find in the order of jobs."""
        stop, lock, queue = Event(), Lock(), iter(range(n_jobs))
        ended: dict[int, tuple[int, int, NDArray[np.uint8]]] = {}

        def serve(worker: int) -> None:
            while not stop.is_set():
                with lock:
                    k = next(queue, None)
                if k is None:
                    return
                registers = self._states[worker].registers
                registers[[JOB, LAST, FOUND]] = k, k + 1, registers[INCUMBENT]
                status = FULL
                while status != DONE and not stop.is_set():
                    status = advance(self._states[worker], self._budget)
                    if status == FULL:
                        try:
                            self._states[worker] = self._grow(self._states[worker])
                        except _SpentError:
                            stop.set()
                            raise
                if status == DONE:
                    state = self._states[worker]
                    ended[k] = worker, int(state.registers[FOUND]), state.found_out.copy()

        with ThreadPoolExecutor(self._n_jobs) as pool:
            futures = [pool.submit(serve, worker) for worker in range(self._n_jobs)]
            collected = 0
            try:
                while wait(futures, timeout=max(min(INTERVAL, self.task.seconds_left()), 1e-3)).not_done:
                    while collected in ended:
                        self._consider(*ended[collected][1:])
                        collected += 1
                    yield self._news()
                    if self._work() >= self._max_work:
                        raise _SpentError
            finally:
                stop.set()
        for future in futures:
            future.result()
        for k in range(n_jobs):
            worker, n_outliers, out = ended[k]
            self._consider(n_outliers, out)
            source = self._states[worker]
            if kind == RUN_TASKS:
                self._states[0].task_proven[k] = source.task_proven[k]
            else:
                for state in self._states:
                    if state is not source:
                        self._share_node(int(source.queue[k]), source, state)

    def _share_node(self, t: int, source: SearchState, target: SearchState) -> None:
        """Copy what has been found out about node t and those below it."""
        assert self._tree is not None
        row = self._tree.nodes[t]
        below, places = slice(t, t + int(row[SIZE])), slice(int(row[LO]), int(row[HI]))
        target.nodes[below] = source.nodes[below]
        target.models[below] = source.models[below]
        target.leaf_of[places] = source.leaf_of[places]

    def _share_tasks(self, worker: int) -> None:
        """Give a thread's state the tasks that the first state has listed."""
        source = self._states[0]
        n_tasks = int(source.registers[LINKS])
        while len(self._states[worker].task_bounds) <= n_tasks:
            self._states[worker] = self._grow(self._states[worker])
        target = self._states[worker]
        target.nodes[:] = source.nodes
        target.registers[LINKS] = n_tasks
        target.task_place[:n_tasks] = source.task_place[:n_tasks]
        target.task_target[:n_tasks] = source.task_target[:n_tasks]
        target.task_bounds[:n_tasks] = source.task_bounds[:n_tasks]
