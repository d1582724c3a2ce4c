"""The paper's method: from all points, remove the basis point that the agent values most, until feasible."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maxcon.agent.inference import Agent, Parameters, Scratch, q_values
from maxcon.agent.shipped import agent_file, shipped_agent
from maxcon.minimax import Workspace, allocate
from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import OK, basis_multipliers, basis_points, cold_fit
from maxcon.minimax.refits import refit_after_removal
from maxcon.problem.validate import check_number
from maxcon.search.anytime import Step, Task
from maxcon.tree.encoding import encode_channels


def agent_removal(
    task: Task, *, weights: str | Path | None = None, tries: int = 1, temperature: float = 0.05
) -> Iterator[Step]:
    """Yield the set that the agent's walk down the tree ends in (paper, Algorithm 1 without learning).

    Parameters
    ----------
    task
        The problem.
    weights
        An agent file, or the name of a shipped agent; None for the one shipped for this family of problems.
    tries
        How many walks. The first takes the best action at every state; the others draw it with probability
        proportional to ``exp(Q / temperature)``.
    temperature
        In the unit of Q, in which a removed point counts -0.1 for the agents shipped here.

    Raises
    ------
    ValueError
        If there is no agent for the family, or a number is out of its range.
    """
    if isinstance(tries, bool) or not isinstance(tries, (int, np.integer)) or tries < 1:
        raise ValueError(f"tries must be a positive integer, but it is {tries!r}")
    if not check_number(temperature, "temperature") > 0:
        raise ValueError(f"temperature must be positive, but it is {temperature}")
    agent = shipped_agent(task.problem) if weights is None else Agent.load(agent_file(weights))
    scratch = agent.prepare(task.problem, task.threshold)
    workspace = allocate(task.rows)
    N = task.problem.n_points
    channels = np.empty((N, agent.parameters.n_channels), dtype=np.float32)
    path = np.empty(N, dtype=np.int64)
    budget = max(1, _POINTS_A_SLICE // N)
    for attempt in range(tries):
        workspace.gain[:] = 1.0
        workspace.cap[:] = 0.0
        noise = task.rng.gumbel(scale=temperature, size=(N, len(workspace.x))) if attempt else _NO_NOISE
        length = 0
        while True:
            done, length = walk(
                workspace, agent.parameters, scratch, agent.flags, task.limit, noise, channels, path, length, budget
            )
            if length < 0:
                raise ArithmeticError("a minimax fit did not converge; please report the data that made this happen")
            if done:
                break
            yield Step()
        yield Step(subset=workspace.gain == 1.0, path=path[:length].copy())


_NO_NOISE = np.zeros((0, 0))

#: A slice of a walk looks at about so many points, all its states together: some hundredths of a second.
_POINTS_A_SLICE = 20000


@kernel
def walk(
    workspace: Workspace,
    parameters: Parameters,
    scratch: Scratch,
    flags: NDArray[np.bool_],
    limit: float,
    noise: NDArray[np.float64],
    channels: NDArray[np.float32],
    path: NDArray[np.int64],
    length: int,
    budget: int,
) -> tuple[bool, int]:
    """Go on with a walk that has made `length` removals, by at most `budget` more.

    Returns whether a feasible set is reached, and how many removals it took so far; -1 if a fit failed.

    ``noise[t]`` is added to the Q-values of step t (Gumbel noise makes the best a draw); of no rows: none.
    """
    At, b, gain, cap, C, x, q, r, work, table = workspace
    n = x.shape[0]
    basis = np.empty(n, dtype=np.int64)
    multipliers = np.empty(n)
    value = np.empty(n)
    if length == 0 and cold_fit(At, b, gain, cap, C, x, q, r, work, table) != OK:
        return False, -1
    last = length + budget
    while x[n - 1] > limit:
        if length == last:
            return False, length
        if basis_points(C, q, basis) == 0:
            return False, -1
        basis_multipliers(C, q, basis, multipliers)
        encode_channels(r, x[n - 1], limit, gain, basis, multipliers, flags, channels)
        q_values(parameters, scratch, channels, basis, value)
        best = 0
        for slot in range(n):
            if noise.shape[0] > 0:
                value[slot] += noise[length, slot]
            if value[slot] > value[best]:
                best = slot
        path[length] = basis[best]
        if refit_after_removal(At, b, gain, cap, C, x, q, r, work, table, basis[best]) != OK:
            return False, -1
        length += 1
    return True, length
