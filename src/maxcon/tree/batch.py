"""Many episodes at once: the vectorised environment that training uses, one compiled call a step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import linear_rows
from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import OK, basis_multipliers, basis_points, cold_fit
from maxcon.minimax.refits import refit_after_removal
from maxcon.problem import LinearProblem


@dataclass(frozen=True, eq=False)
class Instances:
    """A set of problems of one size, in the engine's terms, from which episodes are drawn.

    Attributes
    ----------
    At, b
        Whitened rows, shapes (M, d, N) and (M, N).
    limit
        Shape (M,): the threshold, slack included, in the unit of the rows.
    """

    At: NDArray[np.float64]
    b: NDArray[np.float64]
    limit: NDArray[np.float64]

    @property
    def n_points(self) -> int:
        """N, the same for all."""
        return int(self.b.shape[1])

    @property
    def n_params(self) -> int:
        """d, the same for all."""
        return int(self.At.shape[1])

    def __len__(self) -> int:
        return len(self.b)


def make_instances(problems: list[LinearProblem], threshold: float) -> Instances:
    """Return `problems` as `Instances`.

    Raises
    ------
    ValueError
        If the list is empty, or the problems differ in N, in d or in rank.
    """
    if not problems:
        raise ValueError("problems must hold at least one problem, but it is empty")
    rows = [linear_rows(problem) for problem in problems]
    shapes = {each.At.shape for each in rows}
    if len(shapes) > 1:
        raise ValueError(f"problems must all have the same rank and number of points, but they have {sorted(shapes)}")
    limit = [problem.inlier_limit(threshold) / each.scale for problem, each in zip(problems, rows, strict=True)]
    return Instances(np.stack([each.At for each in rows]), np.stack([each.b for each in rows]), np.array(limit))


class BatchEnvironment:
    """K episodes side by side, each on one of the instances; finished ones stay at their goal until reset.

    The state of episode k is in row k of the arrays below, which training reads directly.

    Attributes
    ----------
    instance
        Shape (K,): which instance the episode is on.
    gain
        Shape (K, N): 1 for the points of S, 0 for the removed ones.
    x
        Shape (K, d + 1): the model and, last, f(S), in the unit of the whitened rows.
    basis
        Shape (K, d + 1): slots; the basis points, ascending, then -1. Action j removes ``basis[:, j]``.
    multipliers
        Shape (K, d + 1): the dual multiplier of each basis point.
    done
        Shape (K,): f(S) <= threshold.
    """

    def __init__(self, instances: Instances, n_episodes: int) -> None:
        K, N, n = n_episodes, instances.n_points, instances.n_params + 1
        self.instances = instances
        self.instance = np.zeros(K, dtype=np.int64)
        self.gain = np.zeros((K, N))
        self.cap = np.zeros((K, N))
        self.C = np.zeros((K, n, n))
        self.x = np.zeros((K, n))
        self.q = np.zeros((K, n), dtype=np.int64)
        self.r = np.zeros((K, N))
        self.basis = np.full((K, n), -1, dtype=np.int64)
        self.multipliers = np.zeros((K, n))
        self.done = np.ones(K, dtype=np.bool_)
        self._work = np.zeros((3, max(N, n)))
        self._table = np.zeros((n + 2, n))

    def _arrays(self) -> Any:
        """Return what every kernel takes."""
        return (
            self.instances.At, self.instances.b, self.instances.limit, self.instance,
            self.gain, self.cap, self.C, self.x, self.q, self.r, self._work, self._table,
            self.basis, self.multipliers, self.done,
        )  # fmt: skip

    def reset(self, episodes: NDArray[np.int64], instances: NDArray[np.int64]) -> None:
        """Start the named episodes on the named instances (one each); a feasible instance is at its goal at once."""
        self.instance[episodes] = instances
        if _reset(np.asarray(episodes, dtype=np.int64), *self._arrays()) != OK:
            raise ArithmeticError("a minimax fit did not converge at the start of an episode")

    def step(self, actions: NDArray[np.int64]) -> NDArray[np.float64]:
        """Remove the basis point in slot ``actions[k]`` of every unfinished episode; return the rewards, shape (K,).

        The reward is e(s) of the state that is left, as in Algorithm 1: -1, or 0 for an episode at its goal.

        Raises
        ------
        ValueError
            If an action names an empty slot.
        """
        live = ~self.done
        slots = np.asarray(actions, dtype=np.int64)
        chosen = self.basis[np.arange(len(slots)), np.clip(slots, 0, self.basis.shape[1] - 1)]
        if np.any(live & ((slots < 0) | (slots >= self.basis.shape[1]) | (chosen < 0))):
            raise ValueError("actions must name slots that hold a basis point, but one does not")
        rewards = np.where(live, -1.0, 0.0)
        if _step(slots, *self._arrays()) != OK:
            raise ArithmeticError("a minimax fit did not converge after a removal")
        return rewards

    def snapshot(self) -> dict[str, NDArray[np.generic]]:
        """Return copies of all arrays that a checkpoint must keep."""
        names = ("instance", "gain", "cap", "C", "x", "q", "r", "basis", "multipliers", "done")
        return {name: getattr(self, name).copy() for name in names}

    def restore(self, arrays: dict[str, NDArray[np.generic]]) -> None:
        """Put back what `snapshot` returned."""
        for name, value in arrays.items():
            getattr(self, name)[...] = value


@kernel
def _look(
    C: NDArray[np.float64],
    x: NDArray[np.float64],
    q: NDArray[np.int64],
    basis: NDArray[np.int64],
    multipliers: NDArray[np.float64],
    limit: float,
) -> bool:
    basis_points(C, q, basis)
    basis_multipliers(C, q, basis, multipliers)
    return bool(x[x.shape[0] - 1] <= limit)


@kernel
def _reset(
    episodes: NDArray[np.int64],
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    limit: NDArray[np.float64],
    instance: NDArray[np.int64],
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    C: NDArray[np.float64],
    x: NDArray[np.float64],
    q: NDArray[np.int64],
    r: NDArray[np.float64],
    work: NDArray[np.float64],
    table: NDArray[np.float64],
    basis: NDArray[np.int64],
    multipliers: NDArray[np.float64],
    done: NDArray[np.bool_],
) -> int:
    for k in episodes:
        m = instance[k]
        gain[k, :] = 1.0
        cap[k, :] = 0.0
        status = cold_fit(At[m], b[m], gain[k], cap[k], C[k], x[k], q[k], r[k], work, table)
        if status != OK:
            return status
        done[k] = _look(C[k], x[k], q[k], basis[k], multipliers[k], limit[m])
    return OK


@kernel
def _step(
    slots: NDArray[np.int64],
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    limit: NDArray[np.float64],
    instance: NDArray[np.int64],
    gain: NDArray[np.float64],
    cap: NDArray[np.float64],
    C: NDArray[np.float64],
    x: NDArray[np.float64],
    q: NDArray[np.int64],
    r: NDArray[np.float64],
    work: NDArray[np.float64],
    table: NDArray[np.float64],
    basis: NDArray[np.int64],
    multipliers: NDArray[np.float64],
    done: NDArray[np.bool_],
) -> int:
    for k in range(slots.shape[0]):
        if done[k]:
            continue
        m = instance[k]
        point = basis[k, slots[k]]
        status = refit_after_removal(At[m], b[m], gain[k], cap[k], C[k], x[k], q[k], r[k], work, table, point)
        if status != OK:
            return status
        done[k] = _look(C[k], x[k], q[k], basis[k], multipliers[k], limit[m])
    return OK
