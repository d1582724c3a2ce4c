"""The largest consensus as a function of the threshold: an exact step function for up to three parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maxcon.minimax import linear_rows, minimax_fit
from maxcon.minimax.jit import working_clock
from maxcon.problem import LinearProblem, ReadOnlyArrays, inlier_slack
from maxcon.problem.tolerance import ABSOLUTE_SLACK, RELATIVE_SLACK
from maxcon.problem.validate import check_number, check_time_limit
from maxcon.search.anytime import Step, Task, make_task, run
from maxcon.search.proof import prove
from maxcon.search.refine import swap_refinement
from maxcon.search.sweep import exact_sweep

#: Independent parameters that interval stabbing can take.
MOST_PARAMETERS = 3

#: A knee is where the threshold must grow (in logarithms) this many times as much to win so large a part of the points
#: as it did for the same part before. Growth by 2% is nothing: quantised data win many points at one threshold.
LEAST_BEND, WINDOW, SMALL_GROWTH = 2.0, 0.1, float(np.log(1.02))


@dataclass(frozen=True, eq=False)
class ConsensusCurve(ReadOnlyArrays):
    """The most inliers that a model can have, for each threshold of a range.

    The consensus reaches k at the smallest f(S) of all sets S of k points: the k-th breakpoint. Breakpoints are
    good to the slack for rounding by which an inlier is judged (`maxcon.problem.inlier_slack`): what is closer
    together is one breakpoint.

    Attributes
    ----------
    counts
        Shape (K,), ascending without gaps: the consensus k that each breakpoint reaches.
    thresholds
        Shape (K,), ascending, in the unit of b: the smallest f(S) known of a set of k points, and so a threshold at
        which a model has k inliers. Where the curve is complete, no smaller one (by more than the slack) has.
    proven_to
        Shape (K,): no set of k points has an f(S) below this, to the slack. Equal to `thresholds` where that is proven.
    models
        Shape (K, d): a model with k inliers at that threshold.
    n_at_low
        The consensus known at the lower end of the range; the first breakpoint reaches one more.
    low, high
        The range of thresholds that was asked for; 0 and infinity for all.
    n_points
        How many points the problem has (N).
    scale
        ``max|b|``, which the slack for rounding depends on.
    complete
        Whether each breakpoint of the range is proven. Otherwise the truth lies between `consensus` and
        `upper_bound`.
    seconds
        Wall-clock time, without that of compiling and loading kernels.
    """

    counts: NDArray[np.int64]
    thresholds: NDArray[np.float64]
    proven_to: NDArray[np.float64]
    models: NDArray[np.float64]
    n_at_low: int
    low: float
    high: float
    n_points: int
    scale: float
    complete: bool
    seconds: float

    def consensus(self, threshold: ArrayLike) -> Any:
        """Return the largest consensus at each threshold (the largest known, where the curve is not complete).

        Parameters
        ----------
        threshold
            A number or an array, within the range of the curve.

        Returns
        -------
        An int for a number, else an array of the shape of `threshold`.

        Raises
        ------
        TypeError
            If `threshold` does not hold real numbers.
        ValueError
            If a threshold is NaN, negative or outside the range.
        """
        return self._count(self.thresholds, threshold)

    def upper_bound(self, threshold: ArrayLike) -> Any:
        """Return what no consensus exceeds at each threshold; arguments and errors as of `consensus`."""
        return self._count(self.proven_to, threshold)

    def _count(self, values: NDArray[np.float64], threshold: ArrayLike) -> Any:
        asked = np.asarray(threshold)
        if asked.dtype.kind not in "iuf":
            raise TypeError(f"threshold must hold real numbers, but its dtype is {asked.dtype}")
        outside = ~((asked >= self.low) & (asked <= self.high))
        if outside.any():
            raise ValueError(
                f"threshold must be from {self.low:g} to {self.high:g}, the range of this curve, "
                f"but it is {asked[outside].ravel()[0]}"
            )
        limits = asked + RELATIVE_SLACK * asked + ABSOLUTE_SLACK * self.scale
        found = self.n_at_low + np.searchsorted(values, limits, side="right")
        return int(found) if asked.ndim == 0 else found

    def knees(self, most: int = 3) -> NDArray[np.int64]:
        """Return the positions of at most so many breakpoints where the curve bends most, ascending.

        At a knee a smaller threshold loses many points, and a larger one wins few: to win the next tenth of all
        points the threshold must be multiplied by far more (at least by the square of it) than what won the tenth
        before. Of several in a row the sharpest counts. Knees are at least a tenth of the points apart. Curves of
        data without a clear noise level have none.

        They depend on the range that the curve was asked for: only its breakpoints are looked at, and none is a knee
        that wins less than a tenth of all points within the range before it, or is the last. Those of an incomplete
        curve are of `thresholds` as far as they are known.

        Raises
        ------
        ValueError
            If `most` is no whole number of at least 0.
        """
        if isinstance(most, bool) or not isinstance(most, (int, np.integer)) or most < 0:
            raise ValueError(f"most must be a whole number of at least 0, but it is {most!r}")
        window = max(2, round(WINDOW * self.n_points))
        first = int(np.searchsorted(self.thresholds, 2.0 * ABSOLUTE_SLACK * self.scale, side="right"))
        last = len(self.counts) - 1
        places = np.arange(first + window, last)  # what won fewer points before tells little
        growth = np.log(np.maximum(self.thresholds, 1e-300))
        bend, bends = np.zeros(len(places)), np.ones(len(places), dtype=np.bool_)
        for reach in (window, max(window // 2, 1), max(window // 4, 1), 1):  # small parts tell just where it is
            then = growth[np.minimum(places + reach, last)] - growth[places]
            earlier = growth[places] - growth[places - reach]
            bend += then - earlier
            if reach == window:
                bends &= then >= LEAST_BEND * (earlier + SMALL_GROWTH)
        bend[~bends] = 0.0
        found: list[int] = []
        for place in places[np.argsort(-bend, kind="stable")]:
            if len(found) == most or bend[place - places[0]] <= 0:
                break
            if all(abs(place - other) >= window for other in found):
                found.append(int(place))
        return np.array(sorted(found), dtype=np.int64)

    def plot(self, path: str | Path, *, unit: str = "", title: str = "") -> None:
        """Draw the curve into a file.

        Parameters
        ----------
        path
            Where to; the suffix .png, .svg or .pdf says what kind of file.
        unit
            The unit of b, or the name of what it is in the unit of, for the label of the axis.
        title
            A line above the picture.

        Raises
        ------
        ModuleNotFoundError
            If matplotlib is not installed.
        ValueError
            If the suffix is none of these.
        """
        kind = Path(path).suffix[1:].lower()
        if kind not in {"png", "svg", "pdf"}:
            raise ValueError(f"path must end in .png, .svg or .pdf, but it is {str(path)!r}")
        # Drawing is a layer above searching, and only pictures need it: it is looked up when it is asked for.
        figure = import_module("maxcon.experiments.curve_figure").draw_curve(self, unit, title)
        Path(path).write_bytes(import_module("maxcon.experiments.canvas").picture(figure, kind))

    def __repr__(self) -> str:
        ends = ""
        if len(self.counts):
            ends = f" from {self.thresholds[0]:g} to {self.thresholds[-1]:g}"
        state = "complete" if self.complete else "partial"
        return f"ConsensusCurve({len(self.counts)} breakpoints{ends}, N={self.n_points}, {state}, {self.seconds:.2g} s)"


def consensus_curve(
    problem: LinearProblem,
    thresholds: tuple[float, float] | None = None,
    *,
    time_limit: float | None = None,
    callback: Callable[[int, int], object] | None = None,
) -> ConsensusCurve:
    """Compute the largest consensus for each threshold, exactly.

    Parameters
    ----------
    problem
        The points, with at most three (independent) parameters.
    thresholds
        The range (low, high) of thresholds that matter, in the unit of b; high may be infinite. None for all, which
        includes those so small that little more than d points fit: with three parameters and hundreds of points these
        take longest.
    time_limit
        Seconds after which what is known is returned; None for no limit.
    callback
        Called after each exact search with how many breakpoints are proven, and how many there may be in the range;
        a true return value stops.

    Returns
    -------
    ConsensusCurve
        Complete, unless the time was over, the callback asked to stop, or Ctrl-C was pressed.

    Raises
    ------
    TypeError
        If an argument has the wrong type.
    ValueError
        If an argument is out of its range, or the problem has more than three independent parameters.

    Notes
    -----
    Any model bounds all breakpoints from above by its sorted residuals, and an exact search (`prove`; for
    lines that it leaves undecided `exact_sweep`) at one threshold bounds them from below: what it proves
    impossible there has a larger breakpoint. So each search is made just below, by the slack for rounding, the
    smallest f(S) known of k points: it finds a set of k points with a smaller one, or proves the breakpoint. The
    next k is the middle of the longest run of those of which nothing tells one from another, so that the curve is
    known roughly soon, and then ever better.
    """
    began = working_clock()
    if not isinstance(problem, LinearProblem):
        raise TypeError(f"problem must be a LinearProblem, but it is a {type(problem).__name__}")
    low, high = _check_range(thresholds)
    check_time_limit(time_limit)
    if callback is not None and not callable(callback):
        raise TypeError(f"callback must be callable, but it is a {type(callback).__name__}")
    rank = linear_rows(problem).At.shape[0]
    if rank > MOST_PARAMETERS:
        raise ValueError(
            f"problem must have at most {MOST_PARAMETERS} independent parameters for an exact curve, but it has {rank}"
        )
    search = _Search(problem, low, high, None if time_limit is None else began + time_limit)
    with suppress(KeyboardInterrupt):
        search.run(callback)
    return search.result(low, high, began)


def _check_range(thresholds: Any) -> tuple[float, float]:
    if thresholds is None:
        return 0.0, np.inf
    if isinstance(thresholds, (str, bytes)) or np.shape(thresholds) != (2,):
        raise TypeError(f"thresholds must be None or a pair (low, high), but it is {thresholds!r}")
    low, high = (check_number(each, "thresholds") for each in thresholds)
    if not 0 <= low < high or low == np.inf:
        raise ValueError(f"thresholds must be a pair with 0 <= low < high, but it is ({low:g}, {high:g})")
    return low, high


class _Search:
    """What is known about each breakpoint.

    Attributes
    ----------
    upper, models
        Entry k - 1: the smallest value known at which a model has k inliers, and that model.
    lower
        Entry k - 1: k points have f(S) above this, or equal to `upper`.
    unsettled
        Entry k - 1: exact searches ended without an answer.
    """

    def __init__(self, problem: LinearProblem, low: float, high: float, deadline: float | None) -> None:
        self.problem, self.deadline = problem, deadline
        N = problem.n_points
        self.upper = np.full(N, np.inf)
        self.models = np.zeros((N, problem.n_params))
        self.lower = np.zeros(N)
        self.unsettled = np.zeros(N, dtype=np.bool_)
        self.ends = low, high
        self.least = problem.inlier_limit(low) if low > 0 else -np.inf
        self.most = problem.inlier_limit(high)
        self.methods: list[Callable[[Task], Iterator[Step]]] = [prove]
        if problem.n_params == 2:
            self.methods.append(exact_sweep)
        self.try_model(np.zeros(problem.n_params))
        everything = minimax_fit(problem)
        self.try_model(everything.model)
        self.lower[N - 1] = self.upper[N - 1] = min(everything.value, self.upper[N - 1])

    def run(self, callback: Callable[[int, int], object] | None) -> None:
        """Search until all is proven, or the time is over."""
        for threshold in self.ends:  # what lies outside the range need not be known
            if 0 < threshold < np.inf and not self.search(threshold):
                return
        while (k := self.next()) is not None:
            self.concentrate(k)
            if self.settled()[k - 1]:
                continue
            threshold = self.just_below(self.upper[k - 1])
            before = self.upper[k - 1]
            if not self.search(threshold):
                return
            self.unsettled[k - 1] = not self.settled()[k - 1] and self.upper[k - 1] == before
            if callback is not None and callback(*self.progress()):
                return

    def search(self, threshold: float) -> bool:
        """Make exact searches at a threshold until one proves its answer; False where the time is over."""
        for method in self.methods:
            left = None if self.deadline is None else max(self.deadline - working_clock(), 1e-9)
            task = make_task(self.problem, threshold, np.random.default_rng(0), left)
            best = run(task, method(task), swap_refinement)
            if best.subset is not None and best.size > 0:
                self.try_model(minimax_fit(self.problem, best.subset).model)
            limit = self.problem.inlier_limit(threshold)
            bounded = self.lower[best.upper_bound :]
            np.maximum(bounded, np.minimum(limit, self.upper[best.upper_bound :]), out=bounded)
            if best.interrupted or task.over():
                return False
            if best.gap <= 0:
                break
        return True

    def try_model(self, model: NDArray[np.float64]) -> None:
        """Learn what a model says about each breakpoint: its k-th smallest residual is no smaller."""
        values = np.sort(self.problem.residuals(model))
        better = values < self.upper
        self.upper[better] = values[better]
        self.models[better] = model

    def concentrate(self, k: int) -> None:
        """Lower the k-th breakpoint: fit the k points that its model explains best, again and again."""
        while True:
            before = self.upper[k - 1]
            order = np.argsort(self.problem.residuals(self.models[k - 1]), kind="stable")
            self.try_model(minimax_fit(self.problem, order[:k]).model)
            if self.upper[k - 1] >= before - inlier_slack(before, self.problem.scale):
                return

    def just_below(self, value: float) -> float:
        """Return the threshold that with its slack is as much below a value as the slack there; <= 0 for none."""
        below = value - inlier_slack(value, self.problem.scale)
        return float((below - ABSOLUTE_SLACK * self.problem.scale) / (1.0 + RELATIVE_SLACK))

    def settled(self) -> NDArray[np.bool_]:
        """Return which breakpoints are proven, to the slack for rounding."""
        slack = RELATIVE_SLACK * self.upper + ABSOLUTE_SLACK * self.problem.scale
        smallest = self.upper <= 2.0 * slack  # no positive threshold is so small
        return smallest | (self.upper - self.lower <= slack * (1.0 + 1e-6))

    def inside(self) -> NDArray[np.bool_]:
        """Return which breakpoints may lie in the range."""
        return (self.upper > self.least) & (self.lower < self.most)

    def progress(self) -> tuple[int, int]:
        """Return how many breakpoints of the range are proven, and how many there may be."""
        inside = self.inside()
        return int(np.count_nonzero(inside & self.settled())), int(np.count_nonzero(inside))

    def next(self) -> int | None:
        """Return the k whose breakpoint to look for next; None at the end."""
        open_ones = np.flatnonzero(self.inside() & ~self.settled() & ~self.unsettled)
        if len(open_ones) == 0:
            return None
        breaks = np.flatnonzero((np.diff(open_ones) > 1) | (np.diff(self.lower[open_ones]) != 0)) + 1
        runs = np.split(open_ones, breaks)
        longest = max(runs, key=len)
        return int(longest[len(longest) // 2]) + 1

    def result(self, low: float, high: float, began: float) -> ConsensusCurve:
        """Return what is known."""
        settled, inside = self.settled(), self.inside()
        proven_to = np.where(settled, self.upper, self.lower)
        inside &= proven_to <= self.most
        return ConsensusCurve(
            counts=np.flatnonzero(inside) + 1,
            thresholds=self.upper[inside],
            proven_to=np.maximum.accumulate(proven_to[inside]),
            models=self.models[inside],
            n_at_low=int(np.count_nonzero(self.upper <= self.least)),
            low=low,
            high=high,
            n_points=self.problem.n_points,
            scale=self.problem.scale,
            complete=bool(settled[inside].all()),
            seconds=working_clock() - began,
        )
