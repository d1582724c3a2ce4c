"""The witness: true, checkable, and tight where the groups are small enough to be solved."""

from __future__ import annotations

import itertools
import time
from fractions import Fraction

import numpy as np
import pytest
from numba import config

import maxcon
import oracles
from instances import BUILDERS, synthetic
from maxcon.certification.certificate import Group, inlier_limit
from maxcon.certification.exact import ExactData
from maxcon.certification.verify import follow, is_refuted
from maxcon.search.anytime import make_task
from maxcon.search.exclusion import excludes
from maxcon.search.witness import make_witness

compiled_only = pytest.mark.skipif(config.DISABLE_JIT, reason="takes minutes where kernels are interpreted")

#: The columns of these depend on each other only up to rounding, or nearly: bases need not hold in exact arithmetic.
NEARLY_DEPENDENT = {"one_cluster", "clustered", "chebyshev"}


def task_for(problem, threshold, time_limit=None):
    return make_task(problem, threshold, np.random.default_rng(0), time_limit)


def check(problem, threshold, witness):
    """The witness is a proof, to the letter."""
    data, limit = ExactData(problem.A, problem.b), inlier_limit(threshold, problem.b)
    taken = set()
    for group in witness.groups:
        points = {point for basis in group.bases for point in basis}
        assert taken.isdisjoint(points)
        taken |= points
        assert follow(Group(*group)) == ""
        assert all(is_refuted(data, basis, limit) for basis in group.bases)
    assert witness.upper_bound == problem.n_points - sum(group.needed for group in witness.groups)


def threshold_for(rng, b):
    size = float(np.median(np.abs(b)))
    return float(rng.choice([0.1, 0.25, 0.5, 1.0])) * (size if size > 0 else 1.0)


@pytest.mark.parametrize("builder", sorted(BUILDERS))
def test_from_the_best_set_the_bound_is_the_optimum(builder):
    for seed in range(6):
        rng = np.random.default_rng(seed)
        A, b = BUILDERS[builder](rng, 11, 1 + seed % 3)
        if len(b) > 14:
            continue
        threshold = threshold_for(rng, b)
        best = oracles.brute_force_consensus(A, b, threshold)
        problem = maxcon.LinearProblem(A, b)
        consensus = maxcon.fit(problem, threshold, method="exact")
        if consensus.n_inliers == 0:
            continue
        witness = make_witness(task_for(problem, threshold), consensus.inlier_mask)
        assert witness.upper_bound >= best
        if builder not in NEARLY_DEPENDENT:
            assert consensus.n_inliers == best
            assert witness.upper_bound == best
            check(problem, threshold, witness)


@pytest.mark.parametrize("builder", sorted(BUILDERS))
def test_from_any_set_the_bound_is_true(builder):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        A, b = BUILDERS[builder](rng, 12, 2 + seed % 2)
        if len(b) > 14:
            continue
        threshold = threshold_for(rng, b)
        best = oracles.brute_force_consensus(A, b, threshold)
        problem = maxcon.LinearProblem(A, b)
        mask = rng.random(len(b)) < 0.4
        mask[0] = True
        for options in ({}, {"max_bases": int(rng.integers(0, 8))}, {"enough": best + 1}):
            witness = make_witness(task_for(problem, threshold), mask, **options)
            assert witness.upper_bound >= best
            if builder not in NEARLY_DEPENDENT:
                check(problem, threshold, witness)
            assert sum(len(group.bases) for group in witness.groups) <= options.get("max_bases", 5_000)


@compiled_only
def test_decimal_grids_whose_rows_depend_on_each_other_on_paper_only():
    """0.1, 0.2, 0.3 are equally spaced on paper only: to the letter four such points exclude each other, not three."""
    loose = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        A = np.column_stack([rng.integers(-20, 21, (50, 2)) / 10, np.ones(50)])
        b = np.round(A @ rng.uniform(-1, 1, 3) + rng.uniform(-0.1, 0.1, 50), 1)
        b[:15] += rng.integers(-30, 31, 15) / 10
        problem = maxcon.LinearProblem(A, b)
        consensus = maxcon.fit(problem, 0.1, method="exact")
        witness = make_witness(task_for(problem, 0.1), consensus.inlier_mask)
        check(problem, 0.1, witness)
        loose += witness.upper_bound - consensus.n_inliers
    assert loose <= 1  # bases alone mostly suffice


@pytest.mark.parametrize("builder", sorted(BUILDERS))
def test_exclusion_to_the_letter(builder):
    rng = np.random.default_rng(1)
    A, b = BUILDERS[builder](rng, 7, 2)
    for size in range(1, A.shape[1] + 2):
        for points in itertools.islice(itertools.combinations(range(len(b)), size), 30):
            rows = np.array(points)
            value = oracles.exact_minimax(A[rows], b[rows])
            unique = size - oracles.exact_rank(A[rows]) == 1
            for limit in (0.0, 0.1, float(value), float(np.nextafter(float(value), 0))):
                assert excludes(A, b, rows, limit) == (unique and value > Fraction(limit))


@compiled_only
@pytest.mark.parametrize(("N", "d", "n_outliers"), [(60, 2, 12), (100, 2, 50), (60, 3, 12), (100, 3, 40), (100, 8, 10)])
def test_few_outliers_are_proven_in_full(N, d, n_outliers):
    for seed in range(3):
        A, b = synthetic(np.random.default_rng(seed), N, d, n_outliers / N)
        problem = maxcon.LinearProblem(A, b)
        consensus = maxcon.fit(problem, 0.1, method="exact" if d <= 3 else "peel")
        witness = make_witness(task_for(problem, 0.1), consensus.inlier_mask)
        assert witness.upper_bound == consensus.n_inliers
        check(problem, 0.1, witness)


@compiled_only
def test_hyperplanes_against_the_milp():
    for seed in range(4):
        A, b = synthetic(np.random.default_rng(seed), 18, 5, 0.35)
        problem = maxcon.LinearProblem(A, b)
        consensus = maxcon.fit(problem, 0.1, method="peel")
        witness = make_witness(task_for(problem, 0.1), consensus.inlier_mask)
        check(problem, 0.1, witness)
        best = oracles.milp_consensus(A, b, 0.1)
        assert witness.upper_bound >= best >= consensus.n_inliers
        if consensus.n_inliers == best:
            assert witness.upper_bound == best


@compiled_only
def test_many_outliers_leave_a_weaker_bound():
    A, b = synthetic(np.random.default_rng(0), 100, 8, 0.5)
    problem = maxcon.LinearProblem(A, b)
    consensus = maxcon.fit(problem, 0.1, method="peel", start="gnc")
    witness = make_witness(task_for(problem, 0.1), consensus.inlier_mask, max_bases=1_000)
    assert consensus.n_inliers < witness.upper_bound < 80  # disjoint bases alone prove no less than 89
    check(problem, 0.1, witness)


@compiled_only
def test_the_deadline():
    A, b = synthetic(np.random.default_rng(0), 200, 8, 0.45)
    problem = maxcon.LinearProblem(A, b)
    consensus = maxcon.fit(problem, 0.1, method="peel", start="gnc")
    make_witness(task_for(problem, 0.1), consensus.inlier_mask, max_bases=50)  # compiled
    bounds = []
    for limit in (1e-9, 0.02, 0.1):
        began = time.perf_counter()
        witness = make_witness(task_for(problem, 0.1, limit), consensus.inlier_mask)
        assert time.perf_counter() - began < limit + 2.0
        check(problem, 0.1, witness)
        bounds.append(witness.upper_bound)
    assert bounds[0] >= 199
    assert min(bounds) >= consensus.n_inliers


def test_without_outliers_there_is_nothing_to_prove():
    A, b = synthetic(np.random.default_rng(0), 20, 2, 0.0)
    problem = maxcon.LinearProblem(A, b)
    witness = make_witness(task_for(problem, 0.2), np.ones(20, dtype=bool))
    assert (witness.groups, witness.upper_bound) == ((), 20)


def test_the_same_again():
    A, b = synthetic(np.random.default_rng(0), 40, 3, 0.4)
    problem = maxcon.LinearProblem(A, b)
    mask = maxcon.fit(problem, 0.1, method="exact").inlier_mask
    assert make_witness(task_for(problem, 0.1), mask) == make_witness(task_for(problem, 0.1), mask)


def test_a_bad_mask():
    A, b = synthetic(np.random.default_rng(0), 20, 2, 0.2)
    with pytest.raises(ValueError, match="mask must hold at least one point"):
        make_witness(task_for(maxcon.LinearProblem(A, b), 0.1), np.zeros(20, dtype=bool))


@compiled_only
@pytest.mark.slow
def test_many_instances():
    names = sorted(set(BUILDERS) - NEARLY_DEPENDENT)
    for seed in range(1500):
        rng = np.random.default_rng(seed)
        A, b = BUILDERS[names[seed % len(names)]](rng, int(rng.integers(5, 15)), int(rng.integers(1, 4)))
        if not A.shape[1] < len(b) <= 15:
            continue
        threshold = threshold_for(rng, b)
        best = oracles.brute_force_consensus(A, b, threshold)
        problem = maxcon.LinearProblem(A, b)
        mask = rng.random(len(b)) < 0.6
        mask[0] = True
        witness = make_witness(task_for(problem, threshold), mask)
        assert witness.upper_bound >= best, seed
        check(problem, threshold, witness)
