"""The minimax engine beside HiGHS: a fit from nothing, and the next fit after a point is removed.

    python benchmarks/engine.py

All times are taken in one run, on one thread, on the same instances of the synthetic protocol (50% outliers): CPU time
of the process, so that other work on the machine neither helps nor harms anyone. A cell is the median over the
instances of the median over the repeats. A removal chain takes out the same basis points in
the same order for the engine and for HiGHS, and its time is the time of the chain over its length.

The peers are made as fast as they fairly can be. Both minimax LPs are solved, the one in the parameters (two rows a
point) and its dual (two columns a point, d + 1 rows), and the ratios are to the faster one. HiGHS, kept warm, runs the
dual simplex without presolve, scaling, edge weights or output; freeing a point changes the bounds of its two rows, or
fixes its two columns at 0. All values are compared.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import platform  # noqa: E402
import subprocess  # noqa: E402
import sys  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import NamedTuple  # noqa: E402

import highspy  # noqa: E402
import numba  # noqa: E402
import numpy as np  # noqa: E402
import scipy  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from scipy.optimize import linprog  # noqa: E402

from maxcon.datasets.synthetic import synthetic_hyperplane  # noqa: E402
from maxcon.minimax import Workspace, allocate, linear_rows, minimax_fit  # noqa: E402
from maxcon.minimax.linear import basis_points, cold_fit  # noqa: E402
from maxcon.minimax.refits import refit_after_removal  # noqa: E402
from maxcon.problem import LinearProblem  # noqa: E402

CELLS = [(N, d) for d in (2, 3, 8) for N in (100, 200, 500, 1000)]
OUTLIERS = 0.5
INSTANCES = 7
REMOVALS = 20
REPEATS = 15  # of the engine's loops; of the peers, PEER_REPEATS
PEER_REPEATS = 5
COLD_LOOPS = 50

COLD_TARGET = 200  # times faster than linprog
WARM_TARGET = 15  # times faster than a warm HiGHS

Floats = NDArray[np.float64]


class Times(NamedTuple):
    """Microseconds, of one instance or the median of several."""

    cold: float
    public: float
    arrays: float
    linprog_rows: float
    linprog_columns: float
    warm: float
    highs_rows: float
    highs_columns: float


# No cache: numba would not notice that the kernels called here have changed.
@numba.njit(nogil=True)
def repeat_cold(workspace: Workspace, times: int) -> int:
    At, b, gain, cap, C, x, q, r, work, table = workspace
    status = 0
    for _ in range(times):
        status += cold_fit(At, b, gain, cap, C, x, q, r, work, table)
    return status


@numba.njit(nogil=True)
def remove_all(workspace: Workspace, points: NDArray[np.int64]) -> int:
    At, b, gain, cap, C, x, q, r, work, table = workspace
    status = 0
    for point in points:
        status += refit_after_removal(At, b, gain, cap, C, x, q, r, work, table, point)
    return status


def median_time(function: Callable[[], object], repeats: int, before: Callable[[], object] | None = None) -> float:
    """Return the median time of a call in microseconds, after one that does not count."""
    taken = []
    for _ in range(repeats + 1):
        if before is not None:
            before()
        began = time.process_time()
        function()
        taken.append(time.process_time() - began)
    return 1e6 * float(np.median(taken[1:]))


# --------------------------------------------------------------------------------------------------- the engine


def removal_chain(problem: LinearProblem, rng: np.random.Generator) -> tuple[NDArray[np.int64], list[float]]:
    """Return random basis points, removed one after the other, and f after each."""
    rows = linear_rows(problem)
    workspace = allocate(rows)
    cold_fit(*workspace)
    basis = np.empty(workspace.q.shape[0], dtype=np.int64)
    points, values = [], []
    for _ in range(REMOVALS):
        size = basis_points(workspace.C, workspace.q, basis)
        points.append(int(basis[rng.integers(size)]))
        refit_after_removal(*workspace, points[-1])
        values.append(float(workspace.x[-1]) * rows.scale)
    return np.array(points), values


def time_engine(problem: LinearProblem, points: NDArray[np.int64]) -> tuple[float, float, float, float]:
    """Return microseconds of a cold fit: kernel, public call, public call from arrays; and of a warm re-fit."""
    workspace = allocate(linear_rows(problem))
    cold = median_time(lambda: repeat_cold(workspace, COLD_LOOPS), REPEATS) / COLD_LOOPS
    public = median_time(lambda: minimax_fit(problem), REPEATS)
    arrays = median_time(lambda: minimax_fit(LinearProblem(problem.A, problem.b)), REPEATS)
    start = [array.copy() for array in workspace]

    def restore() -> None:
        for array, copy in zip(workspace, start, strict=True):
            if array.flags.writeable:
                array[...] = copy

    warm = median_time(lambda: remove_all(workspace, points), REPEATS, restore) / len(points)
    return cold, public, arrays, warm


# ----------------------------------------------------------------------------------------------------- the peers


def time_linprog(problem: LinearProblem, value: float) -> tuple[float, float]:
    """Return microseconds of SciPy's linprog(method="highs") on the LP in the parameters, and on its dual."""
    A, b = problem.A, problem.b
    N, d = A.shape
    ones = np.ones((N, 1))
    G, h = np.vstack([np.hstack([A, -ones]), np.hstack([-A, -ones])]), np.r_[b, -b]
    cost = np.r_[np.zeros(d), 1.0]
    free = [(None, None)] * d + [(0, None)]
    equations, right = np.vstack([np.hstack([A.T, -A.T]), np.ones((1, 2 * N))]), np.r_[np.zeros(d), 1.0]
    found = []

    def in_rows() -> None:
        found.append(linprog(cost, A_ub=G, b_ub=h, bounds=free, method="highs").fun)

    def in_columns() -> None:
        found.append(-linprog(np.r_[-b, b], A_eq=equations, b_eq=right, method="highs").fun)

    times = median_time(in_rows, PEER_REPEATS), median_time(in_columns, PEER_REPEATS)
    compare(found, [value] * len(found))
    return times


def highs_model(problem: LinearProblem, columns: bool) -> highspy.Highs:
    """Return a solved model of the minimax LP in the parameters, or of its dual, one column a side of a point."""
    A, b = problem.A, problem.b
    N, d = A.shape
    infinity = highspy.kHighsInf
    lp = highspy.HighsLp()
    if columns:
        G = np.vstack([np.hstack([A.T, -A.T]), np.ones((1, 2 * N))])
        lp.col_cost_ = np.r_[-b, b]
        lp.col_lower_, lp.col_upper_ = np.zeros(2 * N), np.full(2 * N, infinity)
        lp.row_lower_, lp.row_upper_ = np.r_[np.zeros(d), -infinity], np.r_[np.zeros(d), 1.0]
    else:
        G = np.vstack([np.hstack([A, -np.ones((N, 1))]), np.hstack([A, np.ones((N, 1))])])
        lp.col_cost_ = np.r_[np.zeros(d), 1.0]
        lp.col_lower_, lp.col_upper_ = np.r_[np.full(d, -infinity), 0.0], np.full(d + 1, infinity)
        lp.row_lower_, lp.row_upper_ = np.r_[np.full(N, -infinity), b], np.r_[b, np.full(N, infinity)]
    lp.num_row_, lp.num_col_ = G.shape
    matrix = scipy.sparse.csc_matrix(G)
    lp.a_matrix_.format_ = highspy.MatrixFormat.kColwise
    lp.a_matrix_.start_, lp.a_matrix_.index_, lp.a_matrix_.value_ = matrix.indptr, matrix.indices, matrix.data
    highs = highspy.Highs()
    options = {
        "output_flag": False,
        "presolve": "off",
        "solver": "simplex",
        "parallel": "off",
        "threads": 1,
        "simplex_strategy": 1,
        "simplex_scale_strategy": 0,
        "simplex_dual_edge_weight_strategy": 0,
    }
    for name, setting in options.items():
        assert highs.setOptionValue(name, setting) == highspy.HighsStatus.kOk
    highs.passModel(lp)
    highs.run()
    return highs


def time_highs(problem: LinearProblem, points: NDArray[np.int64], values: list[float], columns: bool) -> float:
    """Return microseconds of a removal and a warm re-solve: the chain's time over its length."""
    N, infinity = problem.n_points, highspy.kHighsInf
    highs, found = highs_model(problem, columns), []

    def restart() -> None:
        nonlocal highs
        highs = highs_model(problem, columns)

    def remove(point: int) -> None:
        if columns:
            highs.changeColBounds(point, 0.0, 0.0)
            highs.changeColBounds(N + point, 0.0, 0.0)
        else:
            highs.changeRowBounds(point, -infinity, infinity)
            highs.changeRowBounds(N + point, -infinity, infinity)
        highs.run()

    chain = points.tolist()
    for point in chain:
        remove(point)
        found.append(abs(highs.getInfo().objective_function_value))
    compare(found, values)
    return median_time(lambda: [remove(point) for point in chain], PEER_REPEATS, restart) / len(chain)


def compare(found: list[float], values: list[float]) -> None:
    """Stop where HiGHS, good to 1e-7, and the engine differ: times of different problems mean nothing."""
    worst = np.abs(np.array(found) - values).max()
    if worst > 1e-6:
        raise ArithmeticError(f"HiGHS and the engine differ by {worst:.1e}")


# ----------------------------------------------------------------------------------------------------- the table


def time_cell(N: int, d: int) -> Times:
    """Return the medians over the instances."""
    taken = []
    for seed in range(INSTANCES):
        rng = np.random.default_rng([seed, N, d])
        problem = synthetic_hyperplane(rng, N, OUTLIERS, d)
        points, values = removal_chain(problem, rng)
        cold, public, arrays, warm = time_engine(problem, points)
        rows, columns = time_linprog(problem, minimax_fit(problem).value)
        chains = [time_highs(problem, points, values, by_columns) for by_columns in (False, True)]
        taken.append(Times(cold, public, arrays, rows, columns, warm, *chains))
    return Times(*np.median(taken, axis=0).tolist())


def processor() -> str:
    """Return the name of the processor."""
    described = Path("/proc/cpuinfo")
    if described.exists():
        for line in described.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def import_times() -> tuple[float, float]:
    """Return milliseconds of CPU that ``import maxcon``, and a first minimax fit besides, add to a bare Python."""
    fit = "import maxcon; maxcon.minimax_fit(maxcon.line([0, 1, 2], [0, 1, 0]))"
    medians = []
    for code in ("pass", "import maxcon", fit):
        taken = []
        for _ in range(PEER_REPEATS + 1):
            before = os.times()
            subprocess.run([sys.executable, "-c", code], check=True)
            after = os.times()
            taken.append(after.children_user + after.children_system - before.children_user - before.children_system)
        medians.append(1e3 * float(np.median(taken[1:])))
    return medians[1] - medians[0], medians[2] - medians[0]


def main() -> None:
    print(f"{processor()}, {os.cpu_count()} cores, one thread used; load {os.getloadavg()[0]:.1f}")
    print(
        f"Python {platform.python_version()}, numpy {np.__version__}, numba {numba.__version__}, "
        f"scipy {scipy.__version__}, highspy {highspy.Highs().version()}"
    )
    print(f"Synthetic protocol, {OUTLIERS:.0%} outliers, {INSTANCES} instances a cell; all times in microseconds.")
    print("cold: the kernel in a compiled loop; public: minimax_fit(problem); arrays: and LinearProblem(A, b) before.")
    print(
        f"Targets: cold at least {COLD_TARGET} times, warm at least {WARM_TARGET} times faster than the faster peer.\n"
    )
    head = [
        "N",
        "d",
        "cold",
        "public",
        "arrays",
        "linprog",
        "its dual",
        "times",
        "warm",
        "highspy",
        "its dual",
        "times",
    ]
    print("| " + " | ".join(f"{name:>8}" for name in head) + " |")
    print("|" + "|".join("---------:" for _ in head) + "|")
    missed = 0
    for N, d in CELLS:
        t = time_cell(N, d)
        cold_ratio = min(t.linprog_rows, t.linprog_columns) / t.cold
        warm_ratio = min(t.highs_rows, t.highs_columns) / t.warm
        missed += (cold_ratio < COLD_TARGET) + (warm_ratio < WARM_TARGET)
        cells = [
            *(f"{N}", f"{d}", f"{t.cold:.2f}", f"{t.public:.0f}", f"{t.arrays:.0f}"),
            *(f"{t.linprog_rows:.0f}", f"{t.linprog_columns:.0f}", f"{cold_ratio:.0f}"),
            *(f"{t.warm:.2f}", f"{t.highs_rows:.0f}", f"{t.highs_columns:.0f}", f"{warm_ratio:.0f}"),
        ]
        print("| " + " | ".join(f"{cell:>8}" for cell in cells) + " |", flush=True)
    print(f"\n{2 * len(CELLS) - missed} of {2 * len(CELLS)} targets met.")
    bare, first = import_times()
    print(f"import maxcon: {bare:.0f} ms; with the first minimax fit, kernels in the cache: {first:.0f} ms.")


if __name__ == "__main__":
    main()
