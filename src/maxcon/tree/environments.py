"""The tree as Gymnasium environments: an episode starts from all points and ends at a feasible subset.

Imported only by those who use Gymnasium (the extra ``maxcon[train]``). The import registers ``maxcon/LineRemoval-v0``,
``PlaneRemoval-v0``, ``HyperplaneRemoval-v0`` (d = 8) and ``ProblemRemoval-v0`` (a problem of one's own);
``gymnasium.make("maxcon.tree.environments:maxcon/LineRemoval-v0")`` does both.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from maxcon.datasets.synthetic import THRESHOLD, mixed_rates
from maxcon.problem import LinearProblem, check_threshold
from maxcon.tree.encoding import PAPER_CHANNELS, channel_flags, raw_features
from maxcon.tree.state import State, root

Observation = dict[str, Any]

#: How many problems in a row a sampler may draw that need no removal.
_MOST_DRAWS = 1000


class RemovalEnv(gymnasium.Env[dict[str, Any], np.int64]):
    """Remove basis points until the rest fits within the threshold (paper, sections 3.1 to 3.3).

    Observation: a dictionary of "state", shape (N, k + 1 + channels), the matrix S = [H b v]; "basis", shape (d + 1,),
    the point that each action removes, -1 where there is none; and "action_mask", shape (d + 1,), 1 where there is one.
    Action j removes the basis point in slot j. The reward is e(s) of the state that is left: -1 a removal.
    An action that names an empty slot changes nothing, costs -1 and is reported as ``info["invalid_action"]``.
    The episode terminates at a goal, f(S) <= threshold; it is truncated after N actions.

    Parameters
    ----------
    sample
        Draws the problem of each episode; all must have N points and d parameters. Problems that need no removal are
        drawn again.
    n_points, n_params
        N and d.
    threshold
        The inlier threshold.
    channels
        Channels besides H; the paper's are "basis" and "removed".

    Raises
    ------
    ValueError
        If an argument is out of its range, or the sampler draws problems of another size.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  (Gymnasium's own declaration)

    def __init__(
        self,
        sample: Callable[[np.random.Generator], LinearProblem],
        n_points: int,
        n_params: int,
        threshold: float,
        channels: tuple[str, ...] = PAPER_CHANNELS,
        render_mode: None = None,
    ) -> None:
        if render_mode is not None:
            raise ValueError(f"render_mode must be None, but it is {render_mode!r}")
        self.render_mode = None
        self.threshold = check_threshold(threshold)
        self.channels = tuple(channels)
        columns = int(channel_flags(self.channels).sum())
        self._sample, self._n_points, self._n_params = sample, n_points, n_params
        n_features = raw_features(self._draw(np.random.default_rng(0))).shape[1]
        slots = n_params + 1
        self.observation_space: spaces.Space[Observation] = spaces.Dict(
            {
                "state": spaces.Box(-np.inf, np.inf, (n_points, n_features + columns), np.float32),
                "basis": spaces.Box(-1, n_points - 1, (slots,), np.int64),
                "action_mask": spaces.Box(0, 1, (slots,), np.int8),
            }
        )
        self.action_space = spaces.Discrete(slots)
        self.state: State | None = None
        self._steps = 0

    def _draw(self, rng: np.random.Generator) -> LinearProblem:
        problem = self._sample(rng)
        if (problem.n_points, problem.n_params) != (self._n_points, self._n_params):
            raise ValueError(
                f"sample must draw problems with N = {self._n_points} and d = {self._n_params}, but one has "
                f"N = {problem.n_points} and d = {problem.n_params}"
            )
        return problem

    def action_masks(self) -> NDArray[np.bool_]:
        """Return which actions name a basis point, shape (d + 1,), as maskable agents ask for it."""
        if self.state is None:
            raise gymnasium.error.ResetNeeded("call reset before action_masks")
        return self.state.action_mask

    def _observe(self) -> tuple[Observation, dict[str, Any]]:
        assert self.state is not None  # set by reset
        mask = self.state.action_mask
        observation: Observation = {
            "state": self.state.encode(self.channels),
            "basis": self.state.basis.copy(),
            "action_mask": mask.astype(np.int8),
        }
        info: dict[str, Any] = {
            "action_mask": mask,
            "value": self.state.value,
            "n_removed": len(self.state.path),
            "invalid_action": False,
        }
        return observation, info

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode from all points of a new problem, or of ``options["problem"]``."""
        super().reset(seed=seed)
        self._steps = 0
        given = None if options is None else options.get("problem")
        for _ in range(_MOST_DRAWS):
            problem = self._draw(self.np_random) if given is None else given
            self.state = root(problem, self.threshold)
            if not self.state.is_goal:
                return self._observe()
            if given is not None:
                raise ValueError("options['problem'] must need a removal, but all its points fit within the threshold")
        raise ValueError(f"sample must draw problems that need a removal, but none of {_MOST_DRAWS} does")

    def step(self, action: np.int64) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Remove the basis point in slot `action`."""
        if self.state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        reward = self.state.reward
        slot = int(action)
        valid = 0 <= slot < len(self.state.basis) and bool(self.state.action_mask[slot])
        if valid:
            self.state = self.state.remove(slot)
        self._steps += 1
        observation, info = self._observe()
        info["invalid_action"] = not valid
        terminated = self.state.is_goal
        return observation, reward, terminated, not terminated and self._steps >= self._n_points, info


def synthetic_environment(
    n_params: int,
    n_points: int = 100,
    low_rate: float = 0.01,
    high_rate: float = 0.40,
    channels: tuple[str, ...] = PAPER_CHANNELS,
    render_mode: None = None,
) -> RemovalEnv:
    """Return the environment of the paper's training: synthetic problems at mixed outlier rates (section 3.5)."""
    sample = mixed_rates(n_points, n_params, low_rate, high_rate)
    return RemovalEnv(sample, n_points, n_params, THRESHOLD, channels, render_mode)


def problem_environment(
    problem: LinearProblem,
    threshold: float,
    channels: tuple[str, ...] = PAPER_CHANNELS,
    render_mode: None = None,
) -> RemovalEnv:
    """Return the environment of one problem of one's own; every episode starts from all its points.

    Raises
    ------
    ValueError
        If the problem needs no removal.
    """
    if root(problem, threshold).is_goal:
        raise ValueError("problem must need a removal, but all its points fit within the threshold")
    return RemovalEnv(lambda _: problem, problem.n_points, problem.n_params, threshold, channels, render_mode)


for _name, _n_params in (("Line", 2), ("Plane", 3), ("Hyperplane", 8)):
    gymnasium.register(
        id=f"maxcon/{_name}Removal-v0",
        entry_point="maxcon.tree.environments:synthetic_environment",
        kwargs={"n_params": _n_params},
    )
gymnasium.register(id="maxcon/ProblemRemoval-v0", entry_point="maxcon.tree.environments:problem_environment")
