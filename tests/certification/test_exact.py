"""Exact arithmetic: who is within the limit, and which points exclude each other."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest

import oracles
from instances import BUILDERS
from maxcon.certification.exact import ExactData, independent_columns, within


def test_within_is_decided_by_the_exact_residual():
    A = np.array([[1.0], [1.0], [1.0], [3.0]])
    b = np.array([0.0, 0.25, np.nextafter(0.25, 1.0), 0.0])
    np.testing.assert_array_equal(within(A, b, np.array([0.0]), 0.25), [True, True, False, True])
    # 3 * 0.1 is a little more than 0.3 in floats, and 0.1 a little more than a tenth
    exact = abs(Fraction(0.1) * 3)
    assert within(A, b, np.array([0.1]), 0.3)[3] == (exact <= Fraction(0.3))
    assert within(A, b, np.array([0.1]), 0.30000000000000004)[3]


@pytest.mark.parametrize("builder", ["quantised", "tenths", "synthetic_some", "graded_columns", "large_offset", "huge"])
def test_within_against_rationals(builder):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        A, b = BUILDERS[builder](rng, 20, 3)
        model = rng.standard_normal(A.shape[1])
        residuals = [
            abs(sum(Fraction(a) * Fraction(t) for a, t in zip(row, model.tolist(), strict=True)) - Fraction(y))
            for row, y in zip(A.tolist(), b.tolist(), strict=True)
        ]
        for limit in sorted(float(r) for r in residuals)[::4]:  # at a residual, and a rounding below and above
            for near in (np.nextafter(limit, 0), limit, np.nextafter(limit, np.inf)):
                expected = [r <= Fraction(float(near)) for r in residuals]
                np.testing.assert_array_equal(within(A, b, model, float(near)), expected)


@pytest.mark.parametrize("builder", sorted(BUILDERS))
def test_the_least_maximum_is_that_of_the_minimax_fit_or_a_bound_below_it(builder):
    rng = np.random.default_rng(1)
    A, b = BUILDERS[builder](rng, 7, 2)
    data = ExactData(A, b)
    for size in range(1, A.shape[1] + 2):
        for points in itertools.islice(itertools.combinations(range(len(b)), size), 40):
            rows = list(points)
            least = data.least_maximum(points)
            value = oracles.exact_minimax(A[rows], b[rows])
            if least is not None:
                assert least == value
            y = data.multipliers(points)
            assert (y is None) == (len(rows) - oracles.exact_rank(A[rows]) != 1)
            if y is not None:
                for column in A[rows].T.tolist():
                    assert sum(Fraction(k) * Fraction(a) for k, a in zip(y, column, strict=True)) == 0


def test_independent_columns():
    rng = np.random.default_rng(0)
    for builder in (
        "dependent_column",
        "repeated_column",
        "zero_column",
        "low_dimensional",
        "zero_a",
        "random_instance",
    ):
        A, _ = BUILDERS[builder](rng, 9, 4)
        np.testing.assert_array_equal(A[:, independent_columns(A)], oracles.independent_columns(A), err_msg=builder)
