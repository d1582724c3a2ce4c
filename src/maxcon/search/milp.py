"""The largest consensus by a mixed-integer linear programme, solved by HiGHS: the independent judge."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from functools import partial

import numpy as np
import scipy.optimize
import scipy.sparse
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import Bounds, LinearConstraint, OptimizeResult

from maxcon.minimax import Workspace, allocate
from maxcon.minimax.linear import OK, basis_points, cold_fit
from maxcon.search.anytime import Step, Task
from maxcon.search.milp_box import ROUNDING, Box, Floats, model_box
from maxcon.search.peel import peel
from maxcon.search.sampling import check_count
from maxcon.waiting import interruptible

#: Seconds of the first call of HiGHS where there is no time limit, and how much longer each next one is.
FIRST_SLICE, LONGER = 60.0, 2.0

#: LO-RANSAC samples for the first incumbent.
SAMPLES = 500

#: What SciPy calls the ends of a run.
OPTIMAL, STOPPED = 0, 1

#: HiGHS takes a z within 1e-6 of a whole number for whole. Its bound must be this much above a whole number to
#: prove the next.
WHOLE = 1e-3

#: Beyond an M of this, in limits, HiGHS's tolerances (1e-6) are no longer small, and its bound can be wrong.
LARGEST_M = 1e6


def milp(
    task: Task, *, box: tuple[ArrayLike, ArrayLike] | None = None, node_limit: int | None = None
) -> Iterator[Step]:
    """Find the largest consensus and prove it with HiGHS, through SciPy.

    Minimise sum z_i subject to ``-1 - m_i z_i <= (a_i . phi - b_i) / limit <= 1 + M_i z_i``, z_i 0 or 1 (1: an
    outlier) and phi in a box, in whitened rows. The box is derived from the data (`milp_box`: it holds a
    model of a best set), and m_i and M_i are the smallest numbers that do not constrain phi within it where
    z_i = 1. Where the box leaves no doubt about a point, z_i is fixed.

    HiGHS works to tolerances: with z_i = 1e-6 it forgives a residual of up to 1e-6 M_i. So its set is checked
    by the minimax fit. If it is infeasible, one of the points of its basis must be out: a cut, and HiGHS starts
    again. Its bound needs no such care, for tolerances only let it find fewer outliers; it is used with a
    margin of 1e-3.

    Parameters
    ----------
    task
        What is fitted. ``task.rng`` serves the first incumbent, and deals the points for the box.
    box
        (low, high), numbers or of shape (d,): bounds on the model, to be used instead. The proof then *assumes*
        that a best set has a model between them; this is the usual textbook formulation.
    node_limit
        HiGHS stops after so many nodes of its tree.

    Yields
    ------
    Step
        The sets of a short peel, whose consensus the box needs; then after each call of HiGHS its set, or what
        is feasible of it, and its bound. There is no bound, and one call only, where the box is not proven
        (more than a few hundred points with d = 3, or ten with d = 8, of which so many are repeated or on one
        plane through the origin of the rows that few subsets are regular) or is so large that some M is above
        10^6 limits, which is where HiGHS's tolerances make it err.

    Raises
    ------
    TypeError, ValueError
        If an option has the wrong type or is out of its range.
    ArithmeticError
        If a minimax fit does not converge. (If HiGHS fails, that is the end, with what is known then.)

    Notes
    -----
    HiGHS cannot be interrupted; a time limit it keeps by itself. Without one it is called for a minute, and if
    that is not enough for twice as long, and so on, always anew; callbacks are heard between the calls. Ctrl-C is heard
    at once, and leaves HiGHS to its own in a thread, which ends with its call or with the process
    (`maxcon.waiting.solver_at_work`).
    """
    given = None if box is None else _check_box(box, task.problem.n_params)
    if node_limit is not None:
        node_limit = check_count(node_limit, "node_limit", 1)
    return _steps(task, given, node_limit)


def _steps(task: Task, given: tuple[Floats, Floats] | None, node_limit: int | None) -> Iterator[Step]:
    rows = task.rows
    if len(rows.At) == 0:  # no parameter moves any residual
        mask = np.abs(rows.b) <= task.limit
        yield Step(subset=mask if mask.any() else None, upper_bound=int(np.count_nonzero(mask)))
        return
    known = 0
    for step in peel(task, samples=SAMPLES):
        yield step
        if step.subset is not None and _fit(task, step.subset).x[-1] <= task.limit:
            known = max(known, int(np.count_nonzero(step.subset)))
    if given is None:
        box = model_box(rows.At, rows.b, task.limit, known, LARGEST_M * task.limit, task.rng)
    else:
        box = _whitened(task, *given)
    programme = _Programme(task, box)
    seconds = FIRST_SLICE
    while True:
        began = time.perf_counter()
        if task.deadline < np.inf:
            seconds = task.seconds_left()
            if seconds <= 0.0:
                return
        answer = programme.solve(seconds, node_limit)
        subset, whole = programme.check(answer)
        yield Step(subset=subset, upper_bound=programme.upper_bound(answer))
        out_of_time = answer.status == STOPPED and time.perf_counter() - began >= 0.9 * seconds
        if answer.status == OPTIMAL and not whole and programme.sound:
            continue
        if not (out_of_time and task.deadline == np.inf):
            return
        seconds *= LONGER


def _fit(task: Task, subset: NDArray[np.bool_]) -> Workspace:
    workspace = allocate(task.rows, subset)
    if cold_fit(*workspace) != OK:
        raise ArithmeticError("a minimax fit did not converge; please report the data")
    return workspace


def _check_box(box: object, d: int) -> tuple[Floats, Floats]:
    if not isinstance(box, (tuple, list)) or len(box) != 2:
        raise TypeError(f"box must be a pair (low, high) or None, but it is {box!r}")
    try:
        low, high = (np.broadcast_to(np.asarray(end, dtype=np.float64), (d,)) for end in box)
    except (TypeError, ValueError):
        raise ValueError(f"box must have ends that are numbers or of shape ({d},), but it is {box!r}") from None
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low <= high).all()):
        raise ValueError(f"box must have finite ends, low <= high, but it is {box!r}")
    return low, high


def _whitened(task: Task, low: Floats, high: Floats) -> Box:
    """Return the smallest box of phi that holds all models between low and high."""
    inverse = np.linalg.pinv(task.rows.to_model)
    centre = inverse @ (0.5 * (low + high) - task.rows.origin)
    half = np.abs(inverse) @ (0.5 * (high - low))
    return Box(centre - half, centre + half, True)


class _Programme:
    """The programme of one task. Variables: r parameters u in [-1, 1], phi = centre + half * u, and N outlier flags."""

    def __init__(self, task: Task, box: Box) -> None:
        self.task = task
        At, b = task.rows.At, task.rows.b
        r, N = At.shape
        centre, half = 0.5 * (box.low + box.high), 0.5 * (box.high - box.low)
        rows = (At.T * half) / task.limit
        at_centre = (centre @ At - b) / task.limit
        spread = np.abs(rows).sum(axis=1)
        doubt = ROUNDING * (1.0 + spread + (np.abs(At.T) @ np.abs(centre) + np.abs(b)) / task.limit)
        above = at_centre + spread + doubt - 1.0  # how far the residual may exceed the limit within the box
        below = -at_centre + spread + doubt - 1.0
        always_in = np.maximum(above, below) <= 0.0
        always_out = np.maximum(-above, -below) > 2.0 + 2.0 * doubt
        upper, lower = (above > 0.0) & ~always_out, (below > 0.0) & ~always_out
        self.sound = box.proven and max(above[upper].max(initial=0.0), below[lower].max(initial=0.0)) <= LARGEST_M
        flags = scipy.sparse.eye_array(N, format="csr")
        self.constraints = [
            self._one_side(rows[upper], flags[upper], above[upper], 1.0 - at_centre[upper]),
            self._one_side(-rows[lower], flags[lower], below[lower], 1.0 + at_centre[lower]),
        ]
        self.bounds = Bounds(
            np.concatenate([-np.ones(r), always_out.astype(float)]),
            np.concatenate([np.ones(r), 1.0 - always_in]),
        )
        self.weights = np.concatenate([np.zeros(r), np.ones(N)])

    @staticmethod
    def _one_side(
        rows: NDArray[np.float64], flags: scipy.sparse.csr_array, big: NDArray[np.float64], most: NDArray[np.float64]
    ) -> LinearConstraint:
        """Return ``rows @ u - big * z <= most``."""
        left = scipy.sparse.hstack([scipy.sparse.csr_array(rows), -scipy.sparse.diags_array(big) @ flags], format="csr")
        return LinearConstraint(left, ub=most)

    def solve(self, seconds: float, node_limit: int | None) -> OptimizeResult:
        """Call HiGHS."""
        nodes = node_limit or np.iinfo(np.int32).max
        solve = partial(
            scipy.optimize.milp,
            self.weights,
            integrality=self.weights,
            bounds=self.bounds,
            constraints=tuple(self.constraints),
            options={"mip_rel_gap": 0.0, "time_limit": seconds, "node_limit": nodes},
        )
        return interruptible(solve)

    def upper_bound(self, answer: OptimizeResult) -> int | None:
        """Return what HiGHS has proven of the consensus, if anything."""
        if not self.sound or answer.mip_dual_bound is None or not math.isfinite(answer.mip_dual_bound):
            return None
        return int(self.task.problem.n_points - max(0, math.ceil(answer.mip_dual_bound - WHOLE)))

    def check(self, answer: OptimizeResult) -> tuple[NDArray[np.bool_] | None, bool]:
        """Return a feasible set from HiGHS's, if it has one, and whether it is the same; cut its set off if not."""
        if answer.x is None:
            return None, False
        r = len(self.task.rows.At)
        kept = answer.x[r:] < 0.5
        workspace = _fit(self.task, kept)
        if workspace.x[-1] <= self.task.limit:
            return (kept if kept.any() else None), True
        basis = np.empty(r + 1, dtype=np.int64)
        size = basis_points(workspace.C, workspace.q, basis)
        cut = np.zeros(len(self.weights))
        cut[r + basis[:size]] = 1.0
        self.constraints.append(LinearConstraint(cut[None, :], lb=1.0))
        inliers = np.abs(workspace.r) <= self.task.limit
        return (inliers if inliers.any() else None), False
