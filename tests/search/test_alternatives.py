"""All largest consensus sets against all subsets, in exact arithmetic."""

from dataclasses import replace

import numpy as np
import pytest
from numba import config
from subset_fits import circuits, largest_sets

import maxcon
import oracles
from instances import BUILDERS, synthetic
from maxcon.datasets.classic import load_table
from maxcon.problem import inlier_slack
from maxcon.search import alternatives
from maxcon.search.alternatives import alternative_optima

compiled_only = pytest.mark.skipif(config.DISABLE_JIT, reason="takes minutes where kernels are interpreted")


def rows_of(masks):
    return {tuple(mask.tolist()) for mask in masks}


def small_instances(n_params, seeds, most=12):
    """Yield problems with a threshold at which no set is within rounding of being feasible, but ties are common."""
    for name, builder in BUILDERS.items():
        for seed in seeds:
            rng = np.random.default_rng([seed, n_params, *name.encode()])
            A, b = builder(rng, int(rng.integers(n_params + 1, most + 1)), n_params)
            if len(b) > most or A.shape[1] != n_params or oracles.scaled_condition(A) > 1e6:
                continue
            _, values = circuits(A, b)
            values = values[values > 1e-6 * np.abs(b).max()]
            if len(values) == 0:
                continue
            threshold = float(values[int(rng.integers(max(len(values) // 2, 1)))])  # a tie: f(S) of some set
            if seed % 2:
                threshold *= float(rng.uniform(0.8, 1.2))
            limit = threshold + inlier_slack(threshold, float(np.abs(b).max()))
            if (np.abs(values - limit) > 1e-12 * (1.0 + limit) + 0.2 * (limit - threshold)).all():
                yield name, A, b, threshold, limit


def solved(problem, threshold, masks):
    """Return a proven result for any number of parameters, from the oracle."""
    result = maxcon.fit(problem, threshold, method="peel")
    mask = masks[0]
    if not mask.any():
        return replace(result, inlier_mask=mask, n_inliers=0, status="infeasible")
    fit = maxcon.minimax_fit(problem, mask)
    return replace(
        result, inlier_mask=mask, n_inliers=int(mask.sum()), status="optimal", residuals=problem.residuals(fit.model)
    )


def assert_all(answer, expected):
    assert answer.complete
    assert answer.n_inliers == expected[0].sum()
    if answer.n_inliers > 0:
        assert len(answer.masks) == answer.n_found == len(expected)
        assert rows_of(answer.masks) == rows_of(expected)
        assert (np.diff(answer.values) >= 0).all()
    np.testing.assert_array_equal(answer.in_all, expected.all(axis=0))
    np.testing.assert_array_equal(answer.in_none, ~expected.any(axis=0))
    np.testing.assert_array_equal(answer.varying, expected.any(axis=0) & ~expected.all(axis=0))
    assert not answer.unknown.any()


def assert_some(answer, expected):
    assert rows_of(answer.masks) <= rows_of(expected)
    assert not (answer.in_all & ~expected.all(axis=0)).any()
    assert not (answer.in_none & expected.any(axis=0)).any()
    assert not (answer.varying & (expected.all(axis=0) | ~expected.any(axis=0))).any()


def compare(n_params, seeds):
    checked = several = 0
    for name, A, b, threshold, limit in small_instances(n_params, seeds):
        expected = largest_sets(A, b, limit)
        problem = maxcon.LinearProblem(A, b)
        given = solved(problem, threshold, expected)
        try:
            assert_all(alternative_optima(problem, threshold, given), expected)
            for most in (1, 3):
                answer = alternative_optima(problem, threshold, given, limit=most)
                if expected.any():
                    assert answer.n_found == min(most, len(expected))
                    assert answer.complete == (len(expected) <= most)
                    assert_some(answer, expected)
                    assert not answer.unknown.any()
            if n_params <= 3:
                assert_all(alternative_optima(problem, threshold), expected)
        except (AssertionError, ValueError, ArithmeticError) as error:
            raise AssertionError(f"{name}: A={A.tolist()}, b={b.tolist()}, {threshold!r}: {error}") from error
        checked += 1
        several += len(expected) > 1
    return checked, several


@compiled_only
@pytest.mark.parametrize("n_params", [1, 2, 3, 4])
def test_all_families(n_params):
    checked, several = compare(n_params, range(2))
    assert checked >= 35
    assert several >= 10


@compiled_only
@pytest.mark.slow
@pytest.mark.parametrize("n_params", [1, 2, 3, 4, 5])
def test_many_of_all_families(n_params):
    checked, several = compare(n_params, range(2, 12))
    assert checked >= 200
    assert several >= 60


def test_a_few():
    for seed in range(2):
        A, b = BUILDERS["quantised_halves"](np.random.default_rng(seed), 8, 2)
        limit = 0.75 + inlier_slack(0.75, float(np.abs(b).max()))
        assert_all(alternative_optima(maxcon.LinearProblem(A, b), 0.75), largest_sets(A, b, limit))


@compiled_only
@pytest.mark.parametrize("n_params", [2, 3, 5])
def test_questions_settle_what_a_short_search_leaves_open(n_params, monkeypatch):
    monkeypatch.setattr(alternatives, "FIRST_WORK", 0)
    monkeypatch.setattr(alternatives, "LONG_FIRST_WORK", 0)
    asked = []
    ask = alternatives._Lister.ask
    monkeypatch.setattr(
        alternatives._Lister,
        "ask",
        lambda self, point, out: asked.append(answer := ask(self, point, out=out)) or answer,
    )
    for name, A, b, threshold, limit in small_instances(n_params, [0], 10):
        expected = largest_sets(A, b, limit)
        problem = maxcon.LinearProblem(A, b)
        answer = alternative_optima(problem, threshold, solved(problem, threshold, expected))
        try:
            assert_all(answer, expected)
        except AssertionError as error:
            raise AssertionError(f"{name}: {error}") from error
    assert {True, False} <= set(asked)
    assert None not in asked


def sets_at_vertices(x, y, limit):
    """All largest consensus sets of lines: each is that of a line through two points' limits, closed."""
    i, j = np.triu_indices(len(x), 1)
    i, j = i[x[i] != x[j]], j[x[i] != x[j]]
    sets = {}
    for side_i in (-limit, limit):
        for side_j in (-limit, limit):
            slope = (y[j] + side_j - y[i] - side_i) / (x[j] - x[i])
            residuals = y[None, :] - y[i][:, None] - side_i - slope[:, None] * (x[None, :] - x[i][:, None])
            for mask in np.abs(residuals) <= limit + 1e-11:
                sets[mask.tobytes()] = mask
    most = max(mask.sum() for mask in sets.values())
    return np.array([mask for mask in sets.values() if mask.sum() == most])


@compiled_only
@pytest.mark.parametrize("first_work", [0, alternatives.FIRST_WORK])
def test_lines_against_the_arrangement(first_work, monkeypatch):
    monkeypatch.setattr(alternatives, "FIRST_WORK", first_work)
    several = 0
    for seed in range(80):
        rng = np.random.default_rng(seed)
        name = ("quantised_halves", "tenths", "random_instance", "duplicate_a", "grid_points", "uniform_noise")[
            seed % 6
        ]
        A, b = BUILDERS[name](rng, int(rng.integers(15, 45)), 2)
        threshold = float(rng.choice([0.05, 0.1, 0.25, 0.5, 1.0]))
        expected = sets_at_vertices(A[:, 0], b, threshold + inlier_slack(threshold, float(np.abs(b).max())))
        assert_all(alternative_optima(maxcon.line(A[:, 0], b), threshold, limit=100_000), expected)
        several += len(expected) > 1
    assert several > 25


@compiled_only
def test_more_sets_than_the_limit():
    """Sixteen numbers: two largest sets, counted by hand; thirty points: any two of them."""
    b = np.repeat([0.0, 1.0, 2.0, 3.0], [5, 5, 5, 1])
    problem = maxcon.LinearProblem(np.ones((16, 1)), b)
    answer = alternative_optima(problem, 0.5)
    assert (answer.n_inliers, answer.n_found, answer.complete) == (10, 2, True)
    assert answer.in_all.tolist() == [False] * 5 + [True] * 5 + [False] * 6
    assert answer.in_none.tolist() == [False] * 15 + [True]
    answer = alternative_optima(problem, 0.5, limit=1)
    assert (answer.n_found, answer.complete) == (1, False)
    assert answer.in_all.tolist() == [False] * 5 + [True] * 5 + [False] * 6
    assert answer.in_none.tolist() == [False] * 15 + [True]

    rng = np.random.default_rng(0)
    problem = maxcon.line(rng.uniform(-1, 1, 30), rng.uniform(-1, 1, 30))
    answer = alternative_optima(problem, 1e-9, limit=20)
    assert (answer.n_inliers, answer.n_found, answer.complete) == (2, 20, False)
    assert answer.varying.all()
    answer = alternative_optima(problem, 1e-9)
    assert (answer.n_found, answer.complete) == (30 * 29 // 2, True)


def test_stars():
    """At 0.6 two sets of 40 stars tie, and their lines differ by far (see the table's notes)."""
    stars = load_table("cyg_ob1")
    answer = alternative_optima(maxcon.line(stars.x, stars.y), 0.6)
    assert (answer.n_inliers, answer.n_found, answer.complete) == (40, 2, True)
    assert sorted(np.round(answer.models[:, 0], 2)) == [1.56, 2.92]
    assert (answer.in_all.sum(), answer.in_none.sum(), answer.varying.sum()) == (39, 6, 2)
    assert (answer.values <= 0.6 + 1e-9).all()
    assert repr(answer) == "AlternativeOptima(2 sets of 40 of 47 points, 39 in all, 6 in none, 2 varying)"


@compiled_only
@pytest.mark.parametrize(("n_params", "rate"), [(2, 0.6), (3, 0.4), (6, 0.15)])
def test_larger_problems(n_params, rate):
    A, b = synthetic(np.random.default_rng(2), 80, n_params, rate)
    problem = maxcon.LinearProblem(A, b)
    result = maxcon.fit(problem, 0.08, method="exact" if n_params <= 3 else "astar-napa-dibp", time_limit=60)
    answer = alternative_optima(problem, 0.08, result)
    assert answer.complete
    assert not answer.unknown.any()
    limit = 0.08 + inlier_slack(0.08, problem.scale)
    for mask, model, value in zip(answer.masks, answer.models, answer.values, strict=True):
        assert mask.sum() == result.n_inliers
        np.testing.assert_array_equal(problem.residuals(model) <= limit, mask)
        assert value <= limit
    # a point of no largest set: forced in, it costs at least one; of all: without it, at least one is lost
    if n_params <= 3:
        for point in np.flatnonzero(answer.in_all)[::9]:
            rest = np.delete(np.arange(80), point)
            assert maxcon.fit(maxcon.LinearProblem(A[rest], b[rest]), 0.08).n_inliers == result.n_inliers - 1
        for point in np.flatnonzero(answer.in_none)[::9]:
            twice = np.r_[np.arange(80), point]
            assert maxcon.fit(maxcon.LinearProblem(A[twice], b[twice]), 0.08).n_inliers == result.n_inliers


@compiled_only
def test_stopped_at_any_moment():
    stopped = 0
    for _, A, b, threshold, limit in small_instances(2, [0]):
        expected = largest_sets(A, b, limit)
        if len(expected) < 4:
            continue
        problem = maxcon.LinearProblem(A, b)
        for stop in range(0, 8, 2):
            calls = iter(range(stop))
            answer = alternative_optima(problem, threshold, callback=lambda _, calls=calls: next(calls, None) is None)
            assert answer.n_found >= 1
            assert_some(answer, expected)
            assert not answer.complete or len(expected) == answer.n_found
            stopped += not answer.complete
    assert stopped >= 10
    hard = maxcon.LinearProblem(*synthetic(np.random.default_rng(1), 100, 8, 0.5))
    claimed = replace(maxcon.fit(hard, 0.1), status="optimal")
    answer = alternative_optima(hard, 0.1, claimed, time_limit=0.3)
    assert answer.seconds < 3
    assert not answer.complete
    assert answer.unknown.any()


def test_nothing_fits():
    problem = maxcon.LinearProblem(np.zeros((4, 1)), np.ones(4))
    answer = alternative_optima(problem, 0.5)
    assert (answer.n_inliers, answer.n_found, answer.complete) == (0, 0, True)
    assert answer.in_none.all()
    assert not answer.in_all.any()


def test_everything_fits():
    problem = maxcon.LinearProblem(np.ones((4, 1)), np.ones(4))
    answer = alternative_optima(problem, 0.5)
    assert (answer.n_inliers, answer.n_found, answer.complete) == (4, 1, True)
    assert answer.in_all.all()


def test_a_false_claim_is_refuted():
    problem = maxcon.line(np.arange(6.0), [0.0, 0.0, 0.0, 0.0, 0.0, 9.0])
    poor = maxcon.fit(problem, 0.1)
    mask = np.array([True, True, True, False, False, False])
    poor = replace(poor, inlier_mask=mask, n_inliers=3)
    with pytest.raises(ValueError, match="with 3 inliers, but there is a set of 5 points"):
        alternative_optima(problem, 0.1, poor)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"threshold": 0.0}, ValueError, "threshold must be a positive"),
        ({"limit": 0}, ValueError, "limit must be at least 1, but it is 0"),
        ({"limit": 1.5}, TypeError, "limit must be a whole number"),
        ({"time_limit": -1}, ValueError, "time_limit must be a positive number"),
        ({"callback": 3}, TypeError, "callback must be callable"),
        ({"consensus": 3}, TypeError, "consensus must be a Consensus, but it is a int"),
    ],
)
def test_bad_arguments(arguments, error, message):
    problem = maxcon.LinearProblem(*synthetic(np.random.default_rng(1), 15, 2, 0.4))
    with pytest.raises(error, match=message):
        alternative_optima(**{"problem": problem, "threshold": 0.1} | arguments)


def test_other_results_are_refused():
    problem = maxcon.LinearProblem(*synthetic(np.random.default_rng(1), 15, 2, 0.4))
    other = maxcon.LinearProblem(*synthetic(np.random.default_rng(1), 16, 2, 0.4))
    result = maxcon.fit(problem, 0.1)
    with pytest.raises(ValueError, match="consensus must be of this problem, with 16 points, but it has 15"):
        alternative_optima(other, 0.1, result)
    with pytest.raises(ValueError, match=r"consensus must be at the threshold 0.2, but it is at 0.1"):
        alternative_optima(problem, 0.2, result)
    with pytest.raises(ValueError, match="its status is 'heuristic'"):
        alternative_optima(problem, 0.1, maxcon.fit(problem, 0.1, method="greedy"))
    with pytest.raises(TypeError, match="problem must be a LinearProblem"):
        alternative_optima(3, 0.1)


def contaminated():
    """Points of which some quarter can be proven to be outliers in a moment, but not how many are."""
    rng = np.random.default_rng(0)
    X = rng.standard_normal((300, 8))
    y = X @ rng.standard_normal(8) + rng.uniform(-0.1, 0.1, 300)
    y[:120] += rng.uniform(-5, 5, 120)
    return maxcon.hyperplane(X, y)


@compiled_only
@pytest.mark.parametrize("how", ["time", "callback", "ctrl-c"])
def test_stopped_before_the_largest_consensus_is_proven(how, monkeypatch):
    problem = contaminated()
    calls = []
    options = {"time_limit": 0.3} if how == "time" else {"callback": lambda n_found: calls.append(n_found) or True}
    if how == "ctrl-c":
        options = {}
        exact = alternatives.exact

        def interrupted(task):
            yield next(exact(task))
            raise KeyboardInterrupt

        monkeypatch.setattr(alternatives, "exact", interrupted)
    answer = alternative_optima(problem, 0.1, **options)
    assert not answer.proven
    assert not answer.complete
    assert answer.n_inliers < answer.upper_bound <= 300
    assert answer.masks.shape == (1, 300)
    assert answer.masks.sum() == answer.n_inliers > 0
    assert answer.values[0] <= 0.1 * (1 + 1e-6)
    assert answer.unknown.all()
    assert f"1 set or more of {answer.n_inliers} (at most {answer.upper_bound}) of 300 points" in repr(answer)
    assert set(calls) <= {0}
    assert (how == "callback") == bool(calls)


def test_proven_optima_say_so():
    table = load_table("cyg_ob1")
    answer = alternative_optima(maxcon.line(table.x, table.y), 0.5)
    assert answer.proven
    assert answer.n_inliers == answer.upper_bound == 38
