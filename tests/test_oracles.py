"""The oracles against each other, and against answers worked out by hand."""

import math
from fractions import Fraction

import numpy as np
import pytest

import instances
import oracles

ALL = sorted(instances.BUILDERS)


def small(name: str, seed: int, largest: int, d_most: int) -> instances.Instance:
    rng = np.random.default_rng([seed, largest])
    d = int(rng.integers(1, d_most + 1))
    return instances.BUILDERS[name](rng, int(rng.integers(d + 1, largest + 1)), d)


def thresholds(A: instances.Floats, b: instances.Floats) -> list[float]:
    """Some that cut the data in the middle, and some that a tie may sit on."""
    f = oracles.highs_minimax(A, b)
    return [t for t in (f / 4, f / 2, 0.5, 1.0) if t > 1e-9 * np.abs(b).max()]


# ---------------------------------------------------------------------------------------------- by hand


def test_minimax_by_hand():
    assert oracles.exact_minimax([[1.0], [1.0]], [0.0, 1.0]) == Fraction(1, 2)
    line = [[0.0, 1.0], [1.0, 1.0], [2.0, 1.0]]
    assert oracles.exact_minimax(line, [0.0, 1.0, 0.0]) == Fraction(1, 2)  # y = 1/2
    assert oracles.highs_minimax(line, [0.0, 1.0, 0.0]) == 0.5
    assert oracles.minimax_fit(line, [0.0, 1.0, 0.0]) == (0.5, [0, 1, 2])
    assert oracles.highs_minimax([[0.0], [0.0]], [3.0, -2.0]) == 3.0
    assert oracles.highs_minimax(line[:2], [5.0, -7.0]) == 0.0
    assert oracles.highs_minimax(np.zeros((0, 2)), np.zeros(0)) == 0.0


def test_enforced_by_hand():
    A, b = [[1.0], [1.0], [1.0]], [0.0, 1.0, 4.0]
    assert oracles.highs_minimax(A, b) == 2.0
    assert oracles.highs_minimax(A, b, [True, False, False], 0.5) == 3.5
    assert oracles.highs_minimax(A, b, [True, False, True], 2.0) == 1.0
    assert oracles.highs_minimax(A, b, [True, False, True], math.nextafter(2.0, 0.0)) == math.inf
    assert oracles.highs_minimax(A, b, [True, True, True], 2.0) == 0.0
    with pytest.raises(ValueError, match="threshold"):
        oracles.highs_minimax(A, b, [True, False, True])


def test_consensus_by_hand():
    x = np.array([0.0, 1.0, 2.0, 3.0, 3.0, 3.0])
    y = np.array([0.0, 0.5, 0.0, 0.5, 9.0, -9.0])
    A = np.c_[x, np.ones(6)]
    for threshold, expected in ((0.25, 4), (0.2, 3), (9.0, 6), (0.01, 2)):
        assert oracles.brute_force_consensus(A, y, threshold) == expected
        assert oracles.line_consensus_bruteforce(x, y, threshold) == expected
        assert oracles.milp_consensus(A, y, threshold) == expected


def test_consensus_is_closed_and_the_slack_counts():
    A, b = np.ones((3, 1)), np.array([0.0, 0.2, 0.2 + 2e-10])
    assert oracles.brute_force_consensus(A, b, 0.1) == 3  # f = 0.1 + 1e-10 with a slack of 1e-10 and a bit
    assert oracles.brute_force_consensus(A, b, 0.1, slack=0.0) == 2
    assert oracles.line_consensus_bruteforce(np.zeros(3), b, 0.1) == 3
    assert oracles.line_consensus_bruteforce(np.zeros(3), b, 0.1, slack=0.0) == 2


def test_wrong_value_is_caught():
    A, b = small("random_instance", 0, 20, 3)
    f = oracles.highs_minimax(A, b)
    oracles.assert_minimax_value(f * (1 + 5e-10), A, b)
    with pytest.raises(AssertionError, match="away from"):
        oracles.assert_minimax_value(f * (1 + 1e-8), A, b)
    with pytest.raises(AssertionError, match="cannot be kept"):
        oracles.assert_minimax_value(f, A, b, np.ones(len(b), dtype=bool), f / 2)
    oracles.assert_minimax_value(math.inf, A, b, np.ones(len(b), dtype=bool), f / 2)
    with pytest.raises(AssertionError, match="away from"):
        oracles.assert_minimax_value(math.nan, A, b)


def test_enforced_value_is_judged_with_the_slack():
    A, b, held = [[1.0], [1.0], [1.0]], [0.0, 1.0, 4.0], [True, False, True]
    for value in (1.0, 1.0 + 1e-9, math.inf):  # the threshold only just holds: with less, it is infeasible
        oracles.assert_minimax_value(value, A, b, held, 2.0)
    with pytest.raises(AssertionError, match="away from"):
        oracles.assert_minimax_value(0.9, A, b, held, 2.0)
    with pytest.raises(AssertionError, match="away from"):
        oracles.assert_minimax_value(math.inf, A, b, held, 2.1)


# ------------------------------------------------------------------------------------ one against another


@pytest.mark.parametrize("name", ALL)
def test_minimax_agrees_with_enumeration(name):
    for seed in range(8):
        A, b = small(name, seed, 7, 3)
        exact = oracles.exact_minimax(A, b)
        assert oracles.highs_minimax(A, b) == float(exact)
        assert abs(oracles.highs_linprog(A, b)[0] - exact) <= oracles.minimax_tolerance(float(exact), b)


@pytest.mark.parametrize("name", ALL)
def test_minimax_does_not_hang_on_where_it_starts(name):
    for seed in range(2):
        rng = np.random.default_rng(seed)
        A, b = small(name, seed, 40, 8)
        N = len(b)
        order, above = rng.permutation(N), rng.random(N) < 0.5
        nobody = np.zeros(N, dtype=bool)
        value, basis, _ = oracles._exact_simplex(A, b, held=nobody, threshold=0.0, order=order, above=above)
        assert value is not None
        assert float(value) == oracles.highs_minimax(A, b)
        assert float(value) == oracles.highs_minimax(A[basis], b[basis])  # a basis attains it
        # HiGHS alone is 3e-12 max|b| off on `chebyshev`, where f is small and nothing else
        assert abs(oracles.highs_linprog(A, b)[0] - value) <= 1e-9 * value + 1e-10 * np.abs(b).max()


@pytest.mark.parametrize("name", ALL)
def test_enforced_rows_are_kept(name):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        A, b = small(name, seed, 30, 5)
        held = rng.random(len(b)) < rng.choice([0.2, 0.5, 0.9])
        alone = oracles.highs_minimax(A[held], b[held])
        rest = oracles.highs_minimax(A[~held], b[~held])
        full = oracles.highs_minimax(A, b)
        for threshold in (0.9 * alone, 1.1 * alone + 1e-3, 0.6 * alone + 0.5 * full + 1e-3):
            value = oracles.highs_minimax(A, b, held, threshold)
            if threshold < alone:
                assert value == math.inf
                continue
            assert rest <= value < math.inf
            assert full <= max(value, threshold) * (1 + 1e-15)
            raw = oracles.highs_linprog(A, b, held, threshold)[0]
            assert raw == pytest.approx(value, rel=1e-9, abs=1e-9 * np.abs(b).max(initial=0.0))


@pytest.mark.parametrize("name", ALL)
def test_consensus_agrees(name):
    for seed in range(3):
        A, b = small(name, seed, 11, 4)
        for threshold in thresholds(A, b):
            expected = oracles.brute_force_consensus(A, b, threshold)
            assert oracles.milp_consensus(A, b, threshold) == expected
            assert min(len(b), oracles.exact_rank(A)) <= expected <= len(b)


def test_lines_agree():
    rng = np.random.default_rng(3)
    for round_ in range(60):
        N = int(rng.integers(2, 25))
        step = (1.0, 0.5, 0.1)[round_ % 3]
        width = int(rng.choice([1, 2, 10]))  # one, two or many different x
        x, y = rng.integers(0, width, N) * step, rng.integers(-8, 9, N) * step
        A, threshold = np.c_[x, np.ones(N)], step * float(rng.choice([0.5, 1.0, 2.0]))
        expected = oracles.line_consensus_bruteforce(x, y, threshold)
        assert oracles.milp_consensus(A, y, threshold) == expected
        if N <= 12:
            assert oracles.brute_force_consensus(A, y, threshold) == expected


def test_box_without_enough_regular_subsets():
    """Most of the points are one point: what spans is rare, and the box comes from the basic models."""
    A = np.array([[1.0, 2.0]] * 6 + [[3.0, 1.0], [0.0, 1.0]])
    b = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 100.0, -50.0])
    for threshold in (0.1, 0.5, 1.0, 2.5):
        assert oracles.milp_consensus(A, b, threshold) == oracles.brute_force_consensus(A, b, threshold)


# ------------------------------------------------------------------------------------------ the instances


@pytest.mark.parametrize("name", ALL)
def test_family_is_deterministic_and_well_posed(name):
    for seed in range(6):
        A, b = instances.FAMILIES[name](np.random.default_rng(seed))
        again = instances.FAMILIES[name](np.random.default_rng(seed))
        np.testing.assert_array_equal(A, again[0])
        np.testing.assert_array_equal(b, again[1])
        assert A.dtype == b.dtype == np.float64
        assert A.flags.c_contiguous
        assert b.flags.c_contiguous
        N, d = A.shape
        assert b.shape == (N,)
        assert N > d >= 1
        assert np.isfinite(A).all()
        assert np.isfinite(b).all()
        assert oracles.scaled_condition(A) < 1e6
        scaled = A / np.maximum(np.abs(A).max(axis=0), 1e-300)
        assert oracles.exact_rank(A) == np.linalg.matrix_rank(scaled, tol=1e-9)


def test_family_sizes():
    rng = np.random.default_rng(0)
    sizes = [instances.draw_size(rng) for _ in range(500)]
    assert {d for _, d in sizes} == set(range(1, 9))
    assert max(N for N, _ in sizes) == instances.LARGE
    assert all(d < N <= instances.SMALL for N, d in sizes if N != instances.LARGE)


@pytest.mark.parametrize("rate", [0.0, 0.3, 0.8])
def test_synthetic_follows_the_protocol(rate):
    A, b = instances.synthetic(np.random.default_rng(1), 20, 3, rate)
    assert (A[:, -1] == 1.0).all()
    assert np.abs(A).max() <= 1.0
    assert oracles.milp_consensus(A, b, 0.1) >= 20 - round(rate * 20)
    if rate == 0.0:
        assert oracles.highs_minimax(A, b) <= 0.1


def test_trap_of_columns_dependent_on_paper_only():
    rng = np.random.default_rng(2)
    x = rng.standard_normal(20)
    A = np.c_[x, 0.1 * x]
    assert oracles.exact_rank(A) == 2
    assert oracles.scaled_condition(A) > 1e14
