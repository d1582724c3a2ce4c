"""All methods that prove must agree, with each other and with brute force, on every kind of small instance."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt
import pytest
from numba import config

from instances import BUILDERS
from maxcon.fitting import METHODS as TABLE
from maxcon.problem import LinearProblem
from maxcon.search.anytime import Step, Task, make_task, run
from maxcon.search.partition import exact_partition
from oracles import brute_force_consensus, default_slack, highs_minimax

Floats = npt.NDArray[np.float64]

METHODS = ("exact", "partition", "sweep", "astar", "astar-napa", "astar-napa-dibp", "milp")


def partition(task: Task) -> Iterator[Step]:
    return exact_partition(task, n_jobs=1)


def method(name: str) -> Callable[[Task], Iterator[Step]]:
    return partition if name == "partition" else TABLE[name].load()


def small_instance(name: str, rng: np.random.Generator) -> tuple[Floats, Floats, float]:
    """At most 11 points and 4 parameters; thresholds from less than the noise to more than the outliers."""
    d = int(rng.integers(1, 5))
    A, b = BUILDERS[name](rng, int(rng.integers(d + 1, 12)), d)
    A, b = A[:11], b[:11]
    if len(b) <= A.shape[1]:
        A, b = np.vstack([A] * 4)[: A.shape[1] + 1], np.hstack([b] * 4)[: A.shape[1] + 1]
    spread = float(np.abs(b).max())
    return A, b, float(rng.choice([0.1, 0.5, 1.0, 2.0, 0.3 * spread + 1e-9, 0.05 * spread + 1e-9]))


def check(name: str, seed: int) -> None:
    rng = np.random.default_rng([seed, *name.encode()])
    A, b, threshold = small_instance(name, rng)
    consensus = brute_force_consensus(A, b, threshold)
    problem = LinearProblem(A, b)
    limit = threshold + default_slack(threshold, b)
    for each in METHODS:
        if each == "sweep" and problem.n_params != 2:
            continue
        task = make_task(problem, threshold, np.random.default_rng(0))
        best = run(task, method(each)(task))
        where = f"{each} on {name}, seed {seed}"
        assert best.size == consensus, where
        # the MILP proves nothing where its box is a guess, or its tolerances could err
        assert best.upper_bound == consensus or (each == "milp" and best.upper_bound == len(b)), where
        if best.subset is not None and best.size:
            assert highs_minimax(A[best.subset], b[best.subset]) <= limit * (1 + 1e-9), where


@pytest.mark.skipif(config.DISABLE_JIT, reason="takes minutes where kernels are interpreted")
@pytest.mark.parametrize("name", sorted(BUILDERS))
def test_all_agree(name: str) -> None:
    for seed in range(4):
        check(name, seed)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(BUILDERS))
def test_all_agree_at_length(name: str) -> None:
    """With the 38 families, some 2,300 instances."""
    for seed in range(100, 160):
        check(name, seed)
