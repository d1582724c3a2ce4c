"""A million fits of small problems: is every point that is called an inlier within the threshold? All sets are checked.

    python benchmarks/feasibility.py                  # a million fits
    python benchmarks/feasibility.py --fits 20000

Problems of the benchmark's families with N = 10 to 60 and any outlier rate, some with duplicate, quantised or badly
scaled rows; methods in turn, with a few tenths of a millisecond each
(and "auto" once a problem with all the time it wants). A set is checked from the data alone: the
residuals of the model returned are computed anew, in extended precision, and all points counted. A violation is an
inlier beyond the threshold and the slack for rounding, a count that differs, or an "optimal" below what any
method found on the same problem. Printed: fits, violations by kind, the largest excess met.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import sys  # noqa: E402
import time  # noqa: E402
from collections import Counter  # noqa: E402

import numpy as np  # noqa: E402

import maxcon  # noqa: E402
from maxcon.experiments.search_instances import FAMILIES, make_problem  # noqa: E402
from maxcon.problem import LinearProblem  # noqa: E402

#: The methods and their options, in turn.
METHODS: tuple[tuple[str, dict[str, object]], ...] = (
    ("auto", {"time_limit": 0.0003}),
    ("learned", {"rounds": 1}),
    ("auto", {"time_limit": 0.0001}),
    ("learned", {"time_limit": 0.0003}),
    ("gnc", {"restarts": 1}),
    ("lo-ransac", {"samples": 20}),
    ("peel", {"restarts": 1}),
    ("ransac", {"samples": 20}),
)

#: Fits of a problem before the next one is drawn.
FITS_EACH = 100


def draw(rng: np.random.Generator) -> tuple[LinearProblem, float]:
    """Return a small problem and its threshold."""
    family = FAMILIES[rng.integers(len(FAMILIES))]
    n_points, rate = int(rng.integers(10, 61)), float(rng.uniform(0.0, 0.9))
    problem, threshold = make_problem(family, rng, n_points, rate, int(rng.integers(4, 9)))
    A, b = problem.A.copy(), problem.b.copy()
    kind = rng.integers(5)
    if kind == 1:  # duplicates
        again = rng.integers(n_points, size=n_points // 3)
        A[: len(again)], b[: len(again)] = A[again], b[again]
    elif kind == 2:  # quantised
        A, b = np.round(A, 1), np.round(b, 1)
    elif kind == 3:  # units far apart
        A = A * 10.0 ** rng.uniform(-6, 6, A.shape[1])
    return LinearProblem(A, b), threshold


def check(problem: LinearProblem, threshold: float, result: maxcon.Consensus) -> tuple[str | None, float]:
    """Return what is wrong with a result, or None; and by how much of the threshold the worst inlier exceeds it."""
    mask = result.inlier_mask
    if result.n_inliers != np.count_nonzero(mask):
        return "count", 0.0
    if not mask.any():
        return None, -np.inf
    A, b = problem.A[mask].astype(np.longdouble), problem.b[mask].astype(np.longdouble)
    residuals = np.abs(b - A @ result.model.astype(np.longdouble))
    excess = float((residuals.max() - problem.inlier_limit(threshold)) / threshold)
    return ("beyond the threshold" if excess > 1e-9 else None), excess


def main() -> None:
    parser = argparse.ArgumentParser(description="Check the sets of very many small fits.")
    parser.add_argument("--fits", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    wrong: Counter[str] = Counter()
    done, worst, began, number = 0, -np.inf, time.perf_counter(), 0
    while done < options.fits:
        rng = np.random.default_rng([options.seed, number])
        number += 1
        problem, threshold = draw(rng)
        best, proven = 0, problem.n_points
        for k in range(min(FITS_EACH, options.fits - done)):
            method, chosen = METHODS[k % len(METHODS)] if k > 0 else ("auto", {})
            result = maxcon.fit(problem, threshold, method=method, rng=int(rng.integers(2**31)), **chosen)
            fault, excess = check(problem, threshold, result)
            best, proven, worst = max(best, result.n_inliers), min(proven, result.upper_bound), max(worst, excess)
            done += 1
            if fault is not None:
                wrong[fault] += 1
                print(f"problem {number - 1}, fit {k}, {method}: {fault}", flush=True)
        if best > proven:
            wrong["a bound below a set"] += 1
            print(f"problem {number - 1}: bound {proven}, set {best}", flush=True)
        if number % 1000 == 0:
            print(f"{done} fits, {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    seconds = time.perf_counter() - began
    print(f"{done} fits of {number} problems in {seconds:.0f} s: {wrong.total()} violations {dict(wrong)}")
    print(f"the inlier closest to the limit (threshold and slack) misses it by {-worst:.1e} thresholds")


if __name__ == "__main__":
    main()
