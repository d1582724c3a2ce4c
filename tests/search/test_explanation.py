"""Why a point is out: against lines tried one by one, and against exhaustive subsets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numba import config

import maxcon
import oracles
from instances import BUILDERS, synthetic
from maxcon.certification.certificate import inlier_limit
from maxcon.certification.exact import ExactData
from maxcon.search.explanation import explain

compiled_only = pytest.mark.skipif(config.DISABLE_JIT, reason="takes minutes where kernels are interpreted")


def best_with_point(A, b, threshold, point):
    """The largest consensus of a model that explains the point: it alone counts for more than all others."""
    N = len(b)
    repeated = np.r_[np.arange(N), np.full(N, point)]
    if A.shape[1] == 2 and (A[:, 1] == 1).all():
        return max(oracles.line_consensus_bruteforce(A[repeated, 0], b[repeated], threshold) - N, 0)
    raise AssertionError("lines only")


def best_with_point_by_subsets(A, b, threshold, point):
    """The same for any model and N <= 8: a repeated point is the same as one, for N + 1 copies of which all fit."""
    N = len(b)
    repeated = np.r_[np.arange(N), np.full(N - 1, point)]
    found = oracles.brute_force_consensus(A[repeated], b[repeated], threshold) - (N - 1)
    return max(found, 0)


@pytest.mark.parametrize("tied", [False, True])
def test_lines(tied):
    checked = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        if tied:
            A = np.column_stack([rng.integers(-3, 4, 14), np.ones(14)]).astype(float)
            b, threshold = rng.integers(-4, 5, 14).astype(float), 0.5
        else:
            (A, b), threshold = synthetic(rng, 14, 2, 0.4), 0.1
        problem = maxcon.LinearProblem(A, b)
        consensus = maxcon.fit(problem, threshold, method="exact")
        for point in np.flatnonzero(~consensus.inlier_mask)[:3]:
            answer = explain(problem, consensus, point)
            assert answer.proven
            assert answer.point == point
            assert answer.consensus_with_point == best_with_point(A, b, threshold, point)
            assert answer.lost == consensus.n_inliers - answer.consensus_with_point >= 0
            assert_basis(problem, consensus, answer)
            checked += 1
    assert checked > 25


@pytest.mark.parametrize("builder", ["random_instance", "quantised", "duplicate_rows", "zero_rows", "dependent_column"])
def test_any_model_of_three_parameters(builder):
    for seed in range(4):
        A, b = BUILDERS[builder](np.random.default_rng(seed), 8, 3)
        problem = maxcon.LinearProblem(A, b)
        consensus = maxcon.fit(problem, 0.3, method="exact")
        if len(b) > 8:
            continue
        for point in np.flatnonzero(~consensus.inlier_mask)[:2]:
            answer = explain(problem, consensus, int(point))
            assert answer.consensus_with_point == best_with_point_by_subsets(A, b, 0.3, point)
            assert answer.proven
            assert_basis(problem, consensus, answer)


@compiled_only
def test_hyperplanes():
    A, b = synthetic(np.random.default_rng(0), 60, 8, 0.1)
    b[7] = A[7] @ np.linalg.lstsq(A, b)[0] + 0.35  # not far out
    problem = maxcon.LinearProblem(A, b)
    consensus = maxcon.fit(problem, 0.1, method="peel")
    outliers = np.flatnonzero(~consensus.inlier_mask)
    for point in outliers[:3]:
        answer = explain(problem, consensus, point, time_limit=1)
        assert_basis(problem, consensus, answer)
        assert 8 <= answer.consensus_with_point <= consensus.n_inliers
        # it is what a model that explains the point explains
        insisting = maxcon.LinearProblem(np.vstack([A] + 60 * [A[point]]), np.r_[b, np.full(60, b[point])])
        assert maxcon.fit(insisting, 0.1, method="peel", start="gnc").n_inliers - 60 <= answer.consensus_with_point


@compiled_only
def test_a_hyperplane_that_could_as_well_have_been_another():
    A, b = synthetic(np.random.default_rng(0), 60, 5, 0.1)
    problem = maxcon.LinearProblem(A, b)
    consensus = maxcon.fit(problem, 0.09, method="peel")  # less than the noise
    outliers = np.flatnonzero(~consensus.inlier_mask)
    answers = [explain(problem, consensus, point, time_limit=0.5) for point in outliers]
    assert sorted(answer.lost for answer in answers if answer.proven) == [0, 1]  # the others cost most of the points
    assert min(answer.lost for answer in answers if not answer.proven) > 20
    for answer in answers:
        assert_basis(problem, consensus, answer)


def assert_basis(problem, consensus, answer):
    """The basis is the point and inliers, which exclude it, and no smaller part of them does."""
    basis = answer.basis
    assert answer.point in basis
    assert len(basis) <= problem.n_params + 1
    others = basis[basis != answer.point]
    assert consensus.inlier_mask[others].all()
    assert (np.diff(basis) > 0).all()
    least = ExactData(problem.A, problem.b).least_maximum(basis.tolist())
    assert least is not None
    assert least > inlier_limit(consensus.threshold, problem.b)


def test_a_point_that_nothing_explains():
    A = np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 1.0], [3.0, 1.0]])
    problem = maxcon.LinearProblem(A, [5.0, 1.0, 2.0, 3.0])
    consensus = maxcon.fit(problem, 0.1, method="exact")
    answer = explain(problem, consensus, 0)
    assert (answer.basis.tolist(), answer.consensus_with_point, answer.lost, answer.proven) == ([0], 0, 3, True)


def test_a_point_that_could_be_added():
    A, b = synthetic(np.random.default_rng(0), 20, 2, 0.2)
    problem = maxcon.LinearProblem(A, b)
    best = maxcon.fit(problem, 0.1, method="exact")
    kept = best.inlier_mask.copy()
    dropped = int(np.flatnonzero(kept)[0])
    kept[dropped] = False
    poorer = replace(best, inlier_mask=kept, n_inliers=best.n_inliers - 1)
    answer = explain(problem, poorer, dropped)
    assert len(answer.basis) == 0
    assert (answer.consensus_with_point, answer.lost, answer.proven) == (best.n_inliers, -1, True)


def test_wrong_points():
    problem = maxcon.LinearProblem(*synthetic(np.random.default_rng(0), 20, 2, 0.2))
    consensus = maxcon.fit(problem, 0.1, method="exact")
    inlier = int(np.flatnonzero(consensus.inlier_mask)[0])
    with pytest.raises(ValueError, match=f"{inlier} is one"):
        explain(problem, consensus, inlier)
    with pytest.raises(ValueError, match="from 0 to 19, but it is 20"):
        explain(problem, consensus, 20)
    with pytest.raises(TypeError, match="whole number"):
        explain(problem, consensus, 1.5)
    other = maxcon.LinearProblem(*synthetic(np.random.default_rng(0), 19, 2, 0.2))
    with pytest.raises(ValueError, match="consensus must be of this problem"):
        explain(other, consensus, 1)
