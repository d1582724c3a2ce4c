"""One fit of the EdgeConv agent beside the minimax fits that it makes: how much the network costs.

    python benchmarks/agent.py

Both are timed in the same run, on one thread, on the same instances; the medians over the instances are printed.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import platform  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable  # noqa: E402

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

import maxcon  # noqa: E402
from maxcon.datasets.synthetic import THRESHOLD, synthetic_hyperplane  # noqa: E402
from maxcon.minimax import Workspace, allocate, linear_rows  # noqa: E402
from maxcon.minimax.jit import kernel  # noqa: E402
from maxcon.minimax.linear import cold_fit  # noqa: E402
from maxcon.minimax.refits import refit_after_removal  # noqa: E402

INSTANCES = 30
REPEATS = 15


@kernel
def replay(workspace: Workspace, path: NDArray[np.int64]) -> None:
    """Do the minimax fits of a walk alone: the cold one of all points, and the warm one after each removal."""
    At, b, gain, cap, C, x, q, r, work, table = workspace
    gain[:] = 1.0
    cap[:] = 0.0
    cold_fit(At, b, gain, cap, C, x, q, r, work, table)
    for point in path:
        refit_after_removal(At, b, gain, cap, C, x, q, r, work, table, point)


def fastest(function: Callable[[], object]) -> float:
    """Return the shortest of several timings, in microseconds."""
    function()
    best = np.inf
    for _ in range(REPEATS):
        began = time.perf_counter()
        function()
        best = min(best, time.perf_counter() - began)
    return 1e6 * best


def main() -> None:
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, one thread used")
    print("target: a ratio of at most 100 (line, N = 100, 50%)")
    print(f"{'model':8}{'N':>6}{'rate':>6}{'removals':>10}{'fit us':>10}{'minimax us':>12}{'ratio':>8}")
    for n_params, name in ((2, "line"), (3, "plane")):
        for n_points, rate in ((100, 0.3), (100, 0.5), (200, 0.5)):
            rows = []
            for seed in range(INSTANCES):
                problem = synthetic_hyperplane(np.random.default_rng([seed, 4]), n_points, rate, n_params)

                def fit(problem: maxcon.LinearProblem = problem) -> maxcon.Consensus:
                    return maxcon.fit(problem, THRESHOLD, method="agent", refine=None)

                path = fit().path
                workspace = allocate(linear_rows(problem))
                rows.append((len(path), fastest(fit), fastest(lambda w=workspace, p=path: replay(w, p))))
            removals, whole, alone = np.median(np.array(rows), axis=0)
            print(f"{name:8}{n_points:6}{rate:6.0%}{removals:10.0f}{whole:10.0f}{alone:12.1f}{whole / alone:8.1f}")


if __name__ == "__main__":
    main()
