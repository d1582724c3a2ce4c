"""A state of the tree as people use it: a subset, its minimax fit, and the removals that lead on from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import Workspace, allocate, linear_rows
from maxcon.minimax.linear import OK, basis_multipliers, basis_points, cold_fit
from maxcon.minimax.refits import refit_after_removal
from maxcon.problem import LinearProblem, check_threshold, inlier_slack
from maxcon.tree.encoding import PAPER_CHANNELS, channel_flags, encode_channels, raw_features


@dataclass(frozen=True, eq=False)
class State:
    """A subset S of the points (paper, section 3.1).

    Attributes
    ----------
    problem, threshold
        What is fitted.
    subset
        Shape (N,), bool: the points of S.
    model
        Shape (d,): the minimax fit of S.
    value
        f(S), in the unit of b.
    basis
        Shape (d + 1,): slots; the basis points, ascending, then -1. Action j removes ``basis[j]``.
    path
        The points removed on the way here, in order.
    """

    problem: LinearProblem
    threshold: float
    subset: NDArray[np.bool_]
    model: NDArray[np.float64]
    value: float
    basis: NDArray[np.int64]
    path: tuple[int, ...]
    _workspace: Workspace

    def __repr__(self) -> str:
        kept = int(self.subset.sum())
        return f"State({kept} of {len(self.subset)} points, f(S) = {self.value:.4g}, goal {self.is_goal})"

    @property
    def is_goal(self) -> bool:
        """Whether f(S) is within the threshold: no more points need to go."""
        return bool(self._workspace.x[-1] <= self._limit)

    @property
    def reward(self) -> float:
        """e(s) of equation 5: 0 at a goal, -1 elsewhere."""
        return 0.0 if self.is_goal else -1.0

    @property
    def action_mask(self) -> NDArray[np.bool_]:
        """Shape (d + 1,): which slots hold a basis point; none at a goal."""
        return np.zeros(len(self.basis), dtype=np.bool_) if self.is_goal else self.basis >= 0

    @property
    def _limit(self) -> float:
        slack = inlier_slack(self.threshold, self.problem.scale)
        return (self.threshold + slack) / linear_rows(self.problem).scale

    def remove(self, slot: int) -> State:
        """Return the child state without the basis point in `slot`, by a warm re-fit.

        Raises
        ------
        ValueError
            If the slot is empty, or this state is a goal.
        """
        if not 0 <= slot < len(self.basis) or not self.action_mask[slot]:
            raise ValueError(f"slot must be one of {np.flatnonzero(self.action_mask).tolist()}, but it is {slot}")
        point = int(self.basis[slot])
        old = self._workspace
        workspace = old._replace(
            gain=old.gain.copy(), cap=old.cap.copy(), C=old.C.copy(), x=old.x.copy(), q=old.q.copy(), r=old.r.copy()
        )
        if refit_after_removal(*workspace, point) != OK:
            raise ArithmeticError(f"the minimax fit did not converge after the removal of point {point}")
        return _state(self.problem, self.threshold, workspace, (*self.path, point))

    def encode(self, channels: tuple[str, ...] = PAPER_CHANNELS) -> NDArray[np.float32]:
        """Return the matrix S = [H b v] of equation 11, shape (N, k + 1 + channels); see `maxcon.tree.encoding`."""
        flags = channel_flags(channels)
        out = np.empty((self.problem.n_points, int(flags.sum())), dtype=np.float32)
        multipliers = np.empty(len(self.basis))
        workspace = self._workspace
        basis_multipliers(workspace.C, workspace.q, self.basis, multipliers)
        encode_channels(workspace.r, workspace.x[-1], self._limit, workspace.gain, self.basis, multipliers, flags, out)
        return np.concatenate([raw_features(self.problem), out], axis=1)


def root(problem: LinearProblem, threshold: float) -> State:
    """Return the initial state: all points.

    Raises
    ------
    TypeError, ValueError
        If the threshold is not a positive number.
    """
    threshold = check_threshold(threshold)
    workspace = allocate(linear_rows(problem))
    if cold_fit(*workspace) != OK:
        raise ArithmeticError("the minimax fit of all points did not converge")
    return _state(problem, threshold, workspace, ())


def _state(problem: LinearProblem, threshold: float, workspace: Workspace, path: tuple[int, ...]) -> State:
    rows = linear_rows(problem)
    basis = np.full(problem.n_params + 1, -1, dtype=np.int64)
    basis_points(workspace.C, workspace.q, basis[: len(workspace.x)])
    return State(
        problem,
        threshold,
        workspace.gain == 1.0,
        rows.model(workspace.x),
        float(workspace.x[-1] * rows.scale),
        basis,
        path,
        workspace,
    )
