"""Alternative optima: all largest consensus sets, and which points are in all of them or in none."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import allocate, linear_rows, minimax_fit
from maxcon.minimax.jit import working_clock
from maxcon.minimax.linear import OK, cold_fit
from maxcon.problem import Consensus, LinearProblem, ReadOnlyArrays, check_threshold
from maxcon.problem.validate import check_callback, check_time_limit
from maxcon.search.alternative_kernels import (
    DONE,
    FAILURES,
    FOUND,
    FREE,
    KEPT,
    LARGER,
    OUT,
    UNFINISHED,
    Nodes,
    allocate_nodes,
    enumerate_sets,
)
from maxcon.search.anytime import Step, Task, make_task, run
from maxcon.search.conclusion import conclude
from maxcon.search.exact import exact
from maxcon.search.partition import exact_partition
from maxcon.search.proof import prove
from maxcon.search.refine import swap_refinement

#: With these, the largest consensus is known: that of the result, or none.
PROVEN = ("optimal", "infeasible")

#: Work between two looks at the clock, in points of the fits that a node may take: some 10 ms.
PIECE = 800_000

#: Work of the first enumeration, which is all where sets and outliers are few: about that of all questions after it,
#: with interval stabbing and without.
FIRST_WORK, LONG_FIRST_WORK = 10 * PIECE, 100 * PIECE

#: With so many independent parameters at most, interval stabbing answers questions about a point.
STABBED = 3


@dataclass(frozen=True, eq=False)
class AlternativeOptima(ReadOnlyArrays):
    """The largest consensus sets of a problem.

    A largest consensus set is a set of points with f(S) within the threshold (with the package's slack for rounding)
    and with as many points as any such set has.

    Attributes
    ----------
    n_inliers
        How many points each has: the largest consensus, 0 if no model explains any point. Where `proven` is False, the
        most that was found.
    upper_bound
        No model explains more points than this.
    proven
        Whether `n_inliers` is proven to be the largest consensus, so that it equals `upper_bound`. Where it is not, in
        the time that there was, one set of that size is given, and nothing is known about the points.
    masks
        Shape (K, N), bool: the sets found, each once, those with the smallest f(S) first.
    models
        Shape (K, d): the minimax fit of each.
    values
        Shape (K,): its f(S), in the unit of b.
    complete
        Whether these are all; never where `proven` is False.
    in_all
        Shape (N,), bool: points that are proven to be in every largest consensus set.
    in_none
        Shape (N,), bool: points that are proven to be in none.
    varying
        Shape (N,), bool: points that are in some, and in others not.
    threshold
        The inlier threshold.
    seconds
        Wall-clock time, without that of compiling and loading kernels.
    """

    n_inliers: int
    upper_bound: int
    proven: bool
    masks: NDArray[np.bool_]
    models: NDArray[np.float64]
    values: NDArray[np.float64]
    complete: bool
    in_all: NDArray[np.bool_]
    in_none: NDArray[np.bool_]
    varying: NDArray[np.bool_]
    threshold: float
    seconds: float

    @property
    def n_found(self) -> int:
        """How many sets were found."""
        return len(self.masks)

    @property
    def unknown(self) -> NDArray[np.bool_]:
        """Shape (N,), bool: points that are in all sets found, or in none, which is not proven of the others."""
        known: NDArray[np.bool_] = self.in_all | self.in_none | self.varying
        return ~known

    def __repr__(self) -> str:
        count = f"{self.n_found} set{'s' * (self.n_found != 1)}" + ("" if self.complete else " or more")
        size = str(self.n_inliers) if self.proven else f"{self.n_inliers} (at most {self.upper_bound})"
        return (
            f"AlternativeOptima({count} of {size} of {self.masks.shape[1]} points, "
            f"{int(self.in_all.sum())} in all, {int(self.in_none.sum())} in none, {int(self.varying.sum())} varying)"
        )


def alternative_optima(
    problem: LinearProblem,
    threshold: float,
    consensus: Consensus | None = None,
    *,
    limit: int = 1000,
    time_limit: float | None = None,
    callback: Callable[[int], object] | None = None,
) -> AlternativeOptima:
    """List the largest consensus sets, and tell which points are in all of them and in none.

    Parameters
    ----------
    problem
        The points.
    threshold
        The largest residual of an inlier, in the unit of b.
    consensus
        A result of `maxcon.fit` at this threshold with the status "optimal", or "infeasible". None to let the exact
        search find it.
    limit
        So many sets are listed at most; the points in all or in none are then looked for one by one.
    time_limit
        Seconds after which what is known is returned; None for no limit. Where the largest consensus is not proven by
        then, that is the best set found, with `proven` False. Ctrl-C does the same.
    callback
        Called now and then with how many sets have been found, 0 until the largest consensus is proven; a true return
        value stops.

    Raises
    ------
    TypeError
        If an argument has the wrong type.
    ValueError
        If an argument is out of its range, or `consensus` is not of this problem and threshold, not proven optimal,
        or refuted by a larger set.

    Notes
    -----
    Of the proven optimum the number of outliers is known, and a search over which points are out finds each set of
    so few outliers once (`alternative_kernels`). Where there are more sets than `limit`, or that search takes long,
    whether a point is in all sets is asked of an exact search: without the point, is there a set as large? And
    whether it is in none: with the point doubled, is there a set that is larger by one? With up to three independent
    parameters interval stabbing answers, otherwise the partition search. What has been answered is then kept, or out,
    from the start, which makes a second search for all sets short.
    """
    began = working_clock()
    if not isinstance(problem, LinearProblem):
        raise TypeError(f"problem must be a LinearProblem, but it is a {type(problem).__name__}")
    threshold = check_threshold(threshold)
    if isinstance(limit, bool) or not isinstance(limit, (int, np.integer)):
        raise TypeError(f"limit must be a whole number, but it is {limit!r}")
    if limit < 1:
        raise ValueError(f"limit must be at least 1, but it is {limit}")
    check_time_limit(time_limit)
    check_callback(callback)
    stopped = False
    task = make_task(problem, threshold, np.random.default_rng(0), time_limit)
    if consensus is None:
        best = run(task, exact(task), swap_refinement, None if callback is None else lambda _progress: callback(0))
        consensus, stopped = conclude(task, best, "exact", 0, 0.0), best.interrupted
    else:
        _check_consensus(consensus, problem, threshold)
    lister = _Lister(task, consensus, int(limit), callback)
    if stopped or not lister.proven:
        pass  # all that is known is the set itself
    elif consensus.n_inliers > 0:
        with suppress(_StoppedError, KeyboardInterrupt):
            lister.run()
    else:
        lister.complete = True  # the empty set is the only one
        lister.ever_out[:] = True
    return lister.result(working_clock() - began)


def _check_consensus(consensus: Consensus, problem: LinearProblem, threshold: float) -> None:
    if not isinstance(consensus, Consensus):
        raise TypeError(f"consensus must be a Consensus, but it is a {type(consensus).__name__}")
    N = problem.n_points
    if consensus.inlier_mask.shape != (N,):
        raise ValueError(f"consensus must be of this problem, with {N} points, but it has {len(consensus.inlier_mask)}")
    if not consensus.problem.same_data(problem):
        raise ValueError("consensus must be of this problem, but it is of other data")
    if consensus.threshold != threshold:
        raise ValueError(f"consensus must be at the threshold {threshold}, but it is at {consensus.threshold}")
    if consensus.status not in PROVEN:
        raise ValueError(f"consensus must be proven optimal, but its status is {consensus.status!r}")


class _StoppedError(Exception):
    """The time is over, or the callback asks to stop."""


class _Lister:
    """The sets found, and what is proven about the points."""

    def __init__(self, task: Task, consensus: Consensus, limit: int, callback: Callable[[int], object] | None) -> None:
        self.task, self.limit, self.callback = task, limit, callback
        N = task.problem.n_points
        self.n_inliers = consensus.n_inliers
        self.proven = consensus.status in PROVEN
        self.upper_bound = consensus.n_inliers if self.proven else consensus.upper_bound
        self.n_outliers = N - consensus.n_inliers
        self.incumbent = consensus.inlier_mask.copy()  # kernels take arrays that can be written
        self.stabs = task.rows.At.shape[0] <= STABBED
        self.n_nodes = max(PIECE // ((self.n_outliers + 1) * N), 1)
        self.badness = np.where(np.isfinite(consensus.residuals), consensus.residuals, 0.0)
        self.complete = False
        self.found: dict[bytes, NDArray[np.bool_]] = {}
        self.ever_in, self.ever_out = np.zeros((2, N), dtype=np.bool_)
        self.in_all, self.in_none = np.zeros((2, N), dtype=np.bool_)
        if consensus.n_inliers > 0:
            self.add(consensus.inlier_mask)

    def run(self) -> None:
        """List all sets if that is short; else settle the points, then try again with them."""
        if self.enumerate(FIRST_WORK if self.stabs else LONG_FIRST_WORK):
            return
        self.settle()
        if len(self.found) <= self.limit:
            self.enumerate(None)

    def enumerate(self, work: int | None) -> bool:
        """List sets; True when all are known, False where there are more than the limit or the work is done."""
        state = np.full(self.task.problem.n_points, FREE, dtype=np.int8)
        state[self.in_all], state[self.in_none] = KEPT, OUT
        nodes = self.nodes(state)
        workspace = allocate(self.task.rows)
        pieces = 0
        while work is None or pieces < work // PIECE:
            verdict = enumerate_sets(workspace, nodes, self.task.limit, self.n_outliers, self.n_nodes)
            if verdict == DONE:
                self.complete = nodes.head[FAILURES] == 0
                return self.complete
            if verdict == UNFINISHED:
                pieces += 1
            else:
                self.add(self.inside(nodes, verdict))
                if len(self.found) > self.limit:
                    return False
            self.look()
        return False

    def settle(self) -> None:
        """Find out, of each point that is in all sets found or in none, whether that is so of all others."""
        for point in np.argsort(-self.badness):
            if not (self.ever_in[point] and self.ever_out[point]):
                answer = self.ask(int(point), out=bool(self.ever_in[point]))
                if answer is False:
                    (self.in_all if self.ever_in[point] else self.in_none)[point] = True
                self.look()

    def ask(self, point: int, *, out: bool) -> bool | None:
        """Return whether there is a largest set without the point, or with it; None where that stays open."""
        A, b = self.task.problem.A, self.task.problem.b
        N = len(b)
        limit = self.task.problem.inlier_limit(self.task.threshold)
        start = self.incumbent
        if out:  # no parameter moves its residual any more, which is too large
            A, b, start = A.copy(), b.copy(), start.copy()
            A[point], b[point], start[point] = 0.0, 2.0 * limit, False
        else:
            A, b, start = np.vstack([A, A[point]]), np.append(b, b[point]), np.append(start, False)
        wanted = self.n_inliers + (0 if out else 1)
        problem = LinearProblem(A, b)
        rows = linear_rows(problem)
        rng = np.random.default_rng(0)
        task = replace(self.task, problem=problem, rows=rows, limit=limit / rows.scale, rng=rng)
        steps = prove(task, start) if self.stabs else exact_partition(task, start=start, n_jobs=1)
        best = run(task, _until(steps, wanted), swap_refinement)
        if best.interrupted:
            raise _StoppedError
        if best.upper_bound < wanted:
            return False
        if best.subset is None or best.size < wanted or not self.feasible(best.subset[:N]):
            return None
        self.add(best.subset[:N])
        return True

    def nodes(self, state: NDArray[np.int8]) -> Nodes:
        return allocate_nodes(state, self.badness, self.task.rows.At.shape[0], self.n_outliers)

    def inside(self, nodes: Nodes, verdict: int) -> NDArray[np.bool_]:
        """Return the set that the kernel has found."""
        mask: NDArray[np.bool_] = nodes.state != OUT
        if verdict == LARGER:
            raise ValueError(
                f"consensus must be proven optimal, with {self.n_inliers} inliers, "
                f"but there is a set of {int(np.count_nonzero(mask))} points within the threshold"
            )
        assert verdict == FOUND
        return mask

    def add(self, mask: NDArray[np.bool_]) -> None:
        """Note a largest set."""
        self.ever_in |= mask
        self.ever_out |= ~mask
        if len(self.found) <= self.limit:
            self.found.setdefault(np.packbits(mask).tobytes(), mask.copy())

    def feasible(self, mask: NDArray[np.bool_]) -> bool:
        workspace = allocate(self.task.rows, mask)
        return bool(cold_fit(*workspace) == OK and workspace.x[-1] <= self.task.limit)

    def look(self) -> None:
        """Stop where the time is over or the callback asks for it."""
        if self.task.over():
            raise _StoppedError
        if self.callback is not None and self.callback(min(len(self.found), self.limit)):
            raise _StoppedError

    def result(self, seconds: float) -> AlternativeOptima:
        problem = self.task.problem
        if self.complete:
            self.in_all, self.in_none = ~self.ever_out, ~self.ever_in
        masks = list(self.found.values())[: self.limit]
        fits = [minimax_fit(problem, mask) for mask in masks]
        order = sorted(range(len(masks)), key=lambda k: fits[k].value)
        return AlternativeOptima(
            n_inliers=self.n_inliers,
            upper_bound=self.upper_bound,
            proven=self.proven,
            masks=np.array([masks[k] for k in order], dtype=np.bool_).reshape(-1, problem.n_points),
            models=np.array([fits[k].model for k in order]).reshape(-1, problem.n_params),
            values=np.array([fits[k].value for k in order]),
            complete=self.complete,
            in_all=self.in_all,
            in_none=self.in_none,
            varying=self.ever_in & self.ever_out,
            threshold=self.task.threshold,
            seconds=seconds,
        )


def _until(steps: Iterator[Step], wanted: int) -> Iterator[Step]:
    """Yield steps until a set as large as wanted is found, or proven not to be there."""
    for step in steps:
        yield step
        if step.subset is not None and np.count_nonzero(step.subset) >= wanted:
            return
        if step.upper_bound is not None and step.upper_bound < wanted:
            return
