"""Descents that learn nothing: greedy removal, and the paper's random baseline (RB, section 4)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import Workspace, allocate
from maxcon.minimax.linear import FAILED, OK, STOPPED, cold_fit
from maxcon.search.anytime import Step, Task
from maxcon.search.removal_kernels import greedy_kernel, random_kernel
from maxcon.search.vertex_kernels import allocate_copies, load_vertex, save_vertex

#: Removals between two yields are so many that N * d * (fits per removal) is about this: some 20 ms.
WORK_PER_YIELD = 5_000_000


def greedy(task: Task) -> Iterator[Step]:
    """Descend by the basis point whose removal leaves the smallest f, until the set is feasible.

    Deterministic. At each state every child is evaluated by a warm re-fit, so a removal costs up to d + 1
    fits; of children that are equal to the last bit the lowest index is taken.

    Yields
    ------
    Empty steps while it works, then one with the feasible set and the path to it. Nothing is found only where
    no single point is feasible: a point that another set of parameters could fit leaves only in a basis with
    others, which fit one by one as well and stay.

    Raises
    ------
    ArithmeticError
        If a minimax fit does not converge.
    """
    workspace, path, basis = _root(task)
    copies = allocate_copies(task.rows, 2)
    budget = _budget(task, len(basis))
    n_removed, status = 0, STOPPED
    while True:
        status, n_removed = greedy_kernel(workspace, task.limit, copies, basis, path, n_removed, budget)
        if status != STOPPED:
            break
        yield Step()
    yield _arrival(workspace, status, path[:n_removed])


def random_removal(task: Task, tries: int = 1) -> Iterator[Step]:
    """Descend by basis points drawn uniformly, until the set is feasible (paper, section 4: random baseline).

    Parameters
    ----------
    task
        `task.rng` gives N random numbers for each descent.
    tries
        How many descents to make, each from the set of all points.

    Yields
    ------
    Empty steps while it works, and for each descent one with its feasible set and path.

    Raises
    ------
    ValueError
        If `tries` is not a positive integer.
    ArithmeticError
        If a minimax fit does not converge.
    """
    if isinstance(tries, bool) or not isinstance(tries, (int, np.integer)) or tries < 1:
        raise ValueError(f"tries must be a positive integer, but it is {tries!r}")
    return _descents(task, int(tries))


def _descents(task: Task, tries: int) -> Iterator[Step]:
    workspace, path, basis = _root(task)
    root = allocate_copies(task.rows, 1)
    save_vertex(workspace, root, 0)
    budget = _budget(task, 1)
    for attempt in range(tries):
        if attempt:
            workspace.gain[:] = 1.0
            workspace.cap[:] = 0.0
            load_vertex(workspace, root, 0)
        uniforms = task.rng.random(task.problem.n_points)
        n_removed = 0
        while True:
            status, n_removed = random_kernel(workspace, task.limit, uniforms, basis, path, n_removed, budget)
            if status != STOPPED:
                break
            yield Step()
        yield _arrival(workspace, status, path[:n_removed])


def _root(task: Task) -> tuple[Workspace, NDArray[np.int64], NDArray[np.int64]]:
    """Return a workspace at the fit of all points, and room for the path and for a basis."""
    workspace = allocate(task.rows)
    if cold_fit(*workspace) != OK:
        raise ArithmeticError("the minimax fit of all points did not converge; please report the data")
    return (
        workspace,
        np.empty(task.problem.n_points, dtype=np.int64),
        np.empty(len(workspace.x), dtype=np.int64),
    )


def _budget(task: Task, fits: int) -> int:
    return max(1, WORK_PER_YIELD // (task.rows.At.size * fits + task.problem.n_points))


def _arrival(workspace: Workspace, status: int, path: NDArray[np.int64]) -> Step:
    """Return the step that tells of the set reached; an empty one if it is the empty set."""
    if status == FAILED:
        raise ArithmeticError(f"a minimax fit did not converge after {len(path)} removals; please report the data")
    subset = workspace.gain == 1.0
    return Step(subset=subset, path=path.copy()) if subset.any() else Step()
