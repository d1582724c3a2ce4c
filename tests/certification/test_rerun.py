"""The independent solvers against exhaustive ones, on both sides of the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from certificates import certified

import maxcon
import oracles
from instances import BUILDERS, synthetic
from maxcon.certification import verify
from maxcon.certification.certificate import inlier_limit
from maxcon.certification.rerun import prove_again

TIED = ("quantised", "quantised_halves", "tenths", "duplicate_rows", "opposite_rows", "one_x", "zero_rows", "years")


def again(A, b, threshold, bound, time_limit=60.0):
    return prove_again(A, b, inlier_limit(threshold, b), bound, time_limit)


@pytest.mark.parametrize("builder", ["synthetic_some", "uniform_noise", "low_dimensional", "two_structures", *TIED])
@pytest.mark.parametrize("d", [1, 2])
def test_the_sweep(builder, d):
    for seed in range(4):
        A, b = BUILDERS[builder](np.random.default_rng(seed), 12, d)
        if A.shape[1] > 2:
            continue
        threshold = [0.1, 0.5, 1.0, 0.25][seed]
        best = oracles.brute_force_consensus(A, b, threshold)
        assert again(A, b, threshold, best).status == "confirmed"
        low = again(A, b, threshold, best - 1)
        assert (low.status, low.n_inliers) == ("refuted", best)
        assert low.solver == "sweep"


def test_the_sweep_of_more_points():
    for seed in range(3):
        A, b = synthetic(np.random.default_rng(seed), 40, 2, 0.4)
        best = oracles.line_consensus_bruteforce(A[:, 0], b, 0.1)
        assert again(A, b, 0.1, best).status == "confirmed"
        assert again(A, b, 0.1, best - 1).status == "refuted"


@pytest.mark.parametrize("builder", ["synthetic_some", "quantised", "duplicate_rows", "repeated_column"])
def test_the_milp(builder):
    for seed in range(2):
        A, b = BUILDERS[builder](np.random.default_rng(seed), 13, 3)
        best = oracles.brute_force_consensus(A, b, 0.1 if builder == "synthetic_some" else 0.5)
        threshold = 0.1 if builder == "synthetic_some" else 0.5
        answers = again(A, b, threshold, best), again(A, b, threshold, best - 1)
        assert answers[0].status in {"confirmed", "unfinished"}
        assert answers[1].status in {"refuted", "unfinished"}
        if builder == "synthetic_some":
            assert (answers[0].status, answers[1].status) == ("confirmed", "refuted")
        for answer in answers:
            assert answer.note if answer.status == "unfinished" else not answer.note


def test_the_time_limit():
    A, b = synthetic(np.random.default_rng(0), 60, 2, 0.4)
    slow = again(A, b, 0.1, 10, time_limit=1e-9)
    assert (slow.status, slow.note) == ("unfinished", "the time limit was reached")
    A, b = synthetic(np.random.default_rng(0), 100, 8, 0.3)
    slow = again(A, b, 0.1, 70, time_limit=0.2)
    assert slow.status == "unfinished"


def test_a_rerun_confirms_or_refutes_a_claim():
    problem = maxcon.LinearProblem(*synthetic(np.random.default_rng(3), 50, 2, 0.4))
    _, weak = certified(problem, 0.1, max_bases=4)
    assert weak.proven_bound > weak.upper_bound
    report = verify(weak, problem.A, problem.b, rerun=True)
    assert report.accepted
    assert report.claim_confirmed
    assert report.rerun.status == "confirmed"
    assert report.bound == weak.upper_bound

    # a claim that is too low, of a model that is not the best
    model = np.zeros(2)
    inliers = problem.residuals(model) <= 0.1
    assert inliers.sum() < weak.n_inliers
    wrong = replace(
        weak, model=model, inlier_mask=inliers, n_inliers=int(inliers.sum()), upper_bound=int(inliers.sum())
    )
    report = verify(wrong, problem.A, problem.b, rerun=True)
    assert not report.accepted
    assert f"some model has {report.rerun.n_inliers} inliers" in report.reason


def test_what_a_solver_raises_reaches_the_caller(monkeypatch):
    def solver(*_args, **_options):
        raise ZeroDivisionError

    monkeypatch.setattr("scipy.optimize.milp", solver)
    A, b = synthetic(np.random.default_rng(0), 30, 3, 0.2)[:2]
    with pytest.raises(ZeroDivisionError):
        again(A, b, 0.1, 25)
