"""The experience replay memory: a ring of states in the order in which the episodes lived them.

A state is kept as what it is (which instance, which points are removed, the vertex of its fit), some hundred bytes;
what the network reads of it is computed again when it is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import compute_residuals
from maxcon.tree.batch import BatchEnvironment, Instances
from maxcon.tree.encoding import encode_channels


@dataclass(frozen=True, eq=False)
class StateBatch:
    """States as a batch: arrays with one row a state; see `BatchEnvironment` for the fields."""

    instance: NDArray[np.int64]
    x: NDArray[np.float64]
    gain: NDArray[np.float64]
    basis: NDArray[np.int64]
    multipliers: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Transitions:
    """A batch of transitions: n steps from `state` to `later`, or fewer where the goal came first."""

    state: StateBatch
    action: NDArray[np.int64]
    steps: NDArray[np.int64]
    finished: NDArray[np.bool_]
    later: StateBatch


class ReplayMemory:
    """The last `capacity` transitions of `n_episodes` episodes side by side."""

    def __init__(self, capacity: int, environment: BatchEnvironment) -> None:
        K, N = environment.gain.shape
        n = environment.x.shape[1]
        T = max(2, capacity // K)
        self.instance = np.zeros((T, K), dtype=np.int32)
        self.x = np.zeros((T, K, n))
        self.removed = np.zeros((T, K, N), dtype=np.bool_)
        self.basis = np.full((T, K, n), -1, dtype=np.int16 if N < 2**15 else np.int32)
        self.multipliers = np.zeros((T, K, n), dtype=np.float32)
        self.action = np.zeros((T, K), dtype=np.int16)
        self.done = np.zeros((T, K), dtype=np.bool_)
        self.position = 0
        self.count = 0

    def store(self, environment: BatchEnvironment) -> None:
        """Note the states of all episodes, before their actions."""
        t = self.position
        self.instance[t] = environment.instance
        self.x[t] = environment.x
        self.removed[t] = environment.gain == 0.0
        self.basis[t] = environment.basis
        self.multipliers[t] = environment.multipliers

    def close(self, actions: NDArray[np.int64], done: NDArray[np.bool_]) -> None:
        """Note the actions that were taken in the states stored last and whether they reached the goal."""
        self.action[self.position] = actions
        self.done[self.position] = done
        self.position = (self.position + 1) % len(self.action)
        self.count = min(self.count + 1, len(self.action))

    def sample(self, rng: np.random.Generator, size: int, n_step: int) -> Transitions:
        """Draw transitions of `n_step` steps at random."""
        T, K = self.action.shape
        start = rng.integers(0, self.count - n_step, size)
        t = (self.position - self.count + start) % T
        k = rng.integers(0, K, size)
        steps = np.full(size, n_step)
        finished = np.zeros(size, dtype=np.bool_)
        for ahead in range(n_step):
            reached = ~finished & self.done[(t + ahead) % T, k]
            steps[reached] = ahead + 1
            finished |= reached
        return Transitions(
            self._states(t, k),
            self.action[t, k].astype(np.int64),
            steps,
            finished,
            self._states((t + n_step) % T, k),
        )

    def _states(self, t: NDArray[np.int64], k: NDArray[np.int64]) -> StateBatch:
        return StateBatch(
            self.instance[t, k].astype(np.int64),
            self.x[t, k],
            np.where(self.removed[t, k], 0.0, 1.0),
            self.basis[t, k].astype(np.int64),
            self.multipliers[t, k].astype(np.float64),
        )

    def snapshot(self) -> dict[str, NDArray[np.generic]]:
        """Return all that a checkpoint must keep (views, not copies)."""
        names = ("instance", "x", "removed", "basis", "multipliers", "action", "done")
        arrays = {name: getattr(self, name) for name in names}
        return {**arrays, "clock": np.array([self.position, self.count])}

    def restore(self, arrays: dict[str, NDArray[np.generic]]) -> None:
        """Put back what `snapshot` returned."""
        for name, value in arrays.items():
            if name == "clock":
                self.position, self.count = (int(v) for v in value)
            else:
                getattr(self, name)[...] = value


@kernel
def encode_states(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    limit: NDArray[np.float64],
    instance: NDArray[np.int64],
    x: NDArray[np.float64],
    gain: NDArray[np.float64],
    basis: NDArray[np.int64],
    multipliers: NDArray[np.float64],
    flags: NDArray[np.bool_],
    r: NDArray[np.float64],
    out: NDArray[np.float32],
) -> None:
    """Write the channels of a batch of states into `out`, shape (B, N, channels); r is scratch, shape (N,)."""
    for s in range(instance.shape[0]):
        m = instance[s]
        compute_residuals(At[m], b[m], x[s], r)
        gamma = x[s, x.shape[1] - 1]
        encode_channels(r, gamma, limit[m], gain[s], basis[s], multipliers[s], flags, out[s])


def encode(
    instances: Instances, states: StateBatch | BatchEnvironment, flags: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return the channels of `states`, shape (B, N, number of true flags)."""
    out = np.empty((len(states.instance), instances.n_points, int(flags.sum())), dtype=np.float32)
    encode_states(
        instances.At, instances.b, instances.limit, states.instance, states.x, states.gain, states.basis,
        states.multipliers, flags, np.empty(instances.n_points), out,
    )  # fmt: skip
    return out
