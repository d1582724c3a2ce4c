"""The public minimax fit against exact answers: value, model and basis, on all families of data."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numba import config
from walks import draw, generator

import instances
import oracles
from maxcon.minimax import MinimaxFit, minimax_fit
from maxcon.problem import LinearProblem, line

NAMES = sorted(instances.FAMILIES)

compiled = pytest.mark.skipif(bool(config.DISABLE_JIT), reason="takes too long without compilation")

#: Families without ties or dependent columns: one basis, of rank + 1 points, each of which counts.
GENERIC = ["random_instance", "synthetic_some", "uniform_noise", "vandermonde", "large_offset", "clustered", "leverage"]


def fit(A: np.ndarray, b: np.ndarray, subset: np.ndarray | None = None) -> MinimaxFit:
    return minimax_fit(LinearProblem(A, b), subset)


def close(first: float, second: float, b: np.ndarray) -> bool:
    return abs(first - second) <= 1e-9 * second + 1e-12 * np.abs(b).max()


# ------------------------------------------------------------------------------------------- against oracles


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", range(4))
def test_value_model_and_basis(name, seed):
    A, b = draw(name, seed)
    found = fit(A, b)
    oracles.assert_minimax_value(found.value, A, b)
    assert found.model.shape == (A.shape[1],)
    assert np.abs(A @ found.model - b).max() == found.value
    assert found.basis.dtype == np.int64
    assert len(found.basis) <= oracles.exact_rank(A) + 1
    assert (np.diff(found.basis) > 0).all()
    if len(found.basis):
        oracles.assert_minimax_value(found.value, A[found.basis], b[found.basis])
    else:
        assert found.value <= 1e-12 * np.abs(b).max()


@pytest.mark.parametrize("name", NAMES)
def test_subsets_of_every_size(name):
    A, b = draw(name, 10)
    rng, problem = generator(name, 11), LinearProblem(A, b)
    N, d = A.shape
    for size in {1, 2, d, d + 1, (N + d) // 2, N - 1}:
        indices = rng.permutation(N)[:size]
        mask = np.zeros(N, dtype=bool)
        mask[indices] = True
        found = minimax_fit(problem, mask)
        value = oracles.highs_minimax(A[mask], b[mask])
        assert close(found.value, value, b), (size, found.value, value)
        assert np.abs(A[mask] @ found.model - b[mask]).max() == found.value
        assert mask[found.basis].all()
        again = minimax_fit(problem, indices)
        assert again.value == found.value
        assert again.basis.tolist() == found.basis.tolist()
        assert (again.model == found.model).all()


@pytest.mark.parametrize("name", GENERIC)
@pytest.mark.parametrize("seed", range(2))
def test_only_basis_points_matter(name, seed):
    """In general position, f falls with a basis point, by what the exact fit says, and with no other."""
    A, b = draw(name, 20 + seed)
    problem, N = LinearProblem(A, b), len(b)
    found = minimax_fit(problem)
    for i in found.basis:
        rest = np.delete(np.arange(N), i)
        less = oracles.highs_minimax(A[rest], b[rest])
        assert less < found.value * (1 - 1e-9)
        assert close(minimax_fit(problem, rest).value, less, b)
    others = np.setdiff1d(np.arange(N), found.basis)
    for i in others[:10]:
        assert close(minimax_fit(problem, np.delete(np.arange(N), i)).value, found.value, b)


@pytest.mark.parametrize("name", NAMES)
def test_other_points_do_not_matter_with_ties_either(name):
    """Where points tie, a basis point may have a stand-in; all points outside the basis can still go, at once."""
    A, b = draw(name, 30)
    problem, N = LinearProblem(A, b), len(b)
    found = minimax_fit(problem)
    if len(found.basis):
        assert close(minimax_fit(problem, found.basis).value, found.value, b)
    for i in found.basis[:3]:
        rest = np.delete(np.arange(N), i)
        assert close(minimax_fit(problem, rest).value, oracles.highs_minimax(A[rest], b[rest]), b)


def test_value_against_enumeration():
    """The slowest oracle there is: no LP solver, all circuits in fractions."""
    for name, seed in itertools.product(NAMES, range(2)):
        rng = generator(name, 40 + seed)
        d = int(rng.integers(1, 4))
        A, b = instances.BUILDERS[name](rng, int(rng.integers(d + 1, 8)), d)
        if A.shape[0] <= 8 and A.shape[1] <= 3:
            assert close(fit(A, b).value, float(oracles.exact_minimax(A, b)), b), (name, seed)


# ---------------------------------------------------------------------------------------------- by hand


def test_line_by_hand():
    found = minimax_fit(line([0.0, 1.0, 2.0, 1.0], [0.0, 1.0, 0.0, 0.5]))
    assert found.value == pytest.approx(0.5, abs=1e-15)
    assert found.model == pytest.approx([0.0, 0.5], abs=1e-15)
    assert found.basis.tolist() == [0, 1, 2]


def test_midrange():
    found = fit(np.ones((5, 1)), np.array([3.0, -1.0, 2.0, 7.0, 0.0]))
    assert found.model == pytest.approx([3.0])
    assert found.value == pytest.approx(4.0)
    assert found.basis.tolist() == [1, 3]


def test_zero_rows_alone_hold_the_fit():
    found = fit(np.array([[0.0], [1.0], [2.0]]), np.array([-3.0, 1.0, 2.0]))
    assert found.value == pytest.approx(3.0)
    assert found.basis.tolist() == [0]


def test_one_point_is_fitted_exactly():
    found = fit(np.array([[2.0, 1.0], [1.0, 1.0], [0.0, 3.0]]), np.array([5.0, 1.0, 2.0]), np.array([1]))
    assert found.value <= 1e-15
    assert found.basis.tolist() == []


# ------------------------------------------------------------------------------------- what must not matter


@pytest.mark.parametrize("name", NAMES)
def test_the_same_twice(name):
    A, b = draw(name, 50)
    first, second = fit(A, b), fit(A.copy(), b.copy())
    assert first.value == second.value
    assert (first.model == second.model).all()
    assert (first.basis == second.basis).all()


@pytest.mark.parametrize("name", NAMES)
def test_order_signs_and_units_of_the_points(name):
    A, b = draw(name, 60)
    rng, value = generator(name, 61), fit(A, b).value
    order, signs = rng.permutation(len(b)), rng.choice([-1.0, 1.0], len(b))
    assert close(fit(A[order], b[order]).value, value, b)
    assert close(fit(A * signs[:, None], b * signs).value, value, b)
    for unit in (1e-6, 3.7, 1e6):
        assert close(fit(A, b * unit).value, value * unit, b * unit)
        assert close(fit(A * unit, b * unit).value, value * unit, b * unit)
        assert close(fit(A * unit, b).value, value, b)


@pytest.mark.parametrize("name", GENERIC)
def test_coordinates_of_the_model(name):
    """f depends on the column space of A alone, and on b up to that space."""
    A, b = draw(name, 70)
    rng, value = generator(name, 71), fit(A, b).value
    d = A.shape[1]
    columns = A[:, rng.permutation(d)] * np.exp2(rng.integers(-20, 21, d))
    assert close(fit(columns, b).value, value, b)
    shift = A @ rng.uniform(-1, 1, d)
    assert close(fit(A, b + shift).value, value, np.r_[b, shift])


def test_the_rest_of_the_problem_does_not_matter():
    """A subset is fitted as well inside a problem of wild outliers (1e9 times as large) as it is alone."""
    rng = np.random.default_rng(80)
    A, b = instances.synthetic(rng, 60, 4, 0.0)
    wild = np.vstack([A, 10.0 * rng.standard_normal((20, 4))])
    value = fit(A, b).value
    inside = fit(wild, np.r_[b, 1e9 * rng.standard_normal(20)], np.arange(60)).value
    assert inside == pytest.approx(value, abs=1e-12 * 1e9)
    assert fit(wild, np.r_[b, 1e2 * rng.standard_normal(20)], np.arange(60)).value == pytest.approx(value, rel=1e-9)


# ------------------------------------------------------------------------------------------------ extremes


@pytest.mark.parametrize(
    ("name", "N", "d"), [("random_instance", 2000, 12), ("quantised", 2000, 12), ("tenths", 1000, 8)]
)
def test_many_points_and_parameters(name, N, d):
    A, b = instances.BUILDERS[name](np.random.default_rng(90), N, d)
    found = fit(A, b)
    oracles.assert_minimax_value(found.value, A[found.basis], b[found.basis])  # so f is at least that ...
    assert np.abs(A @ found.model - b).max() == found.value  # ... and at most that


@pytest.mark.parametrize("size", [1e3, 1e6, 1e9, 1e12])
def test_huge_outliers(size):
    rng = np.random.default_rng(91)
    A, b = instances.synthetic(rng, 80, 5, 0.0)
    b[:3] += size * rng.uniform(0.5, 1, 3)
    oracles.assert_minimax_value(fit(A, b).value, A, b)


@pytest.mark.parametrize("size", [1e2, 1e4, 1e6])
def test_points_far_out(size):
    rng = np.random.default_rng(92)
    A, b = instances.synthetic(rng, 80, 5, 0.0)
    A[:4, :-1] *= size
    oracles.assert_minimax_value(fit(A, b).value, A, b)


@pytest.mark.parametrize("radius", [1e-1, 1e-3, 1e-5])
def test_a_tiny_cluster_in_a_wide_range(radius):
    rng = np.random.default_rng(93)
    A = 0.3 + radius * rng.standard_normal((60, 3))
    A[:4] = rng.uniform(-1, 1, (4, 3))
    A[:, -1] = 1.0
    b = A @ rng.uniform(-1, 1, 3) + 0.1 * rng.standard_normal(60)
    oracles.assert_minimax_value(fit(A, b).value, A, b)
    cluster = np.arange(4, 60)
    assert close(fit(A, b, cluster).value, oracles.highs_minimax(A[cluster], b[cluster]), b)


def test_a_narrow_range_of_many_points():
    """Polynomials of degree 7 on a fifteenth of the range: beyond what the rows whitened together can tell apart."""
    A, b = instances.vandermonde(np.random.default_rng([0, 300, 8]), 300, 8)
    subset = np.argsort(A[:, -2])[-20:]
    found = fit(A, b, subset)
    assert found.value == pytest.approx(oracles.highs_minimax(A[subset], b[subset]), rel=1e-3)
    assert set(found.basis) <= set(subset.tolist())
    assert np.abs(A[subset] @ found.model - b[subset]).max() == found.value


@pytest.mark.parametrize("noise", [1e-15, 1e-12, 1e-9])
@pytest.mark.parametrize("seed", range(5))
def test_near_ties(noise, seed):
    """Values that tie but for `noise`: the order of ties must not decide, nor cost the value."""
    rng = np.random.default_rng([94, seed])
    A = rng.integers(-3, 4, (50, 4)).astype(float)
    b = rng.integers(-5, 6, 50) + noise * rng.standard_normal(50)
    oracles.assert_minimax_value(fit(A, b).value, A, b)


# ------------------------------------------------------------------------------------------------ hypothesis

SHAPES = st.tuples(st.integers(1, 4), st.integers(0, 12)).map(lambda s: (s[0] + 1 + s[1], s[0]))


@settings(max_examples=150, deadline=None, derandomize=True)
@given(data=st.data(), shape=SHAPES)
def test_small_integers(data, shape):
    A = data.draw(hnp.arrays(float, shape, elements=st.integers(-4, 4).map(float)))
    b = data.draw(hnp.arrays(float, shape[0], elements=st.integers(-9, 9).map(float)))
    found = fit(A, b)
    oracles.assert_minimax_value(found.value, A, b)
    if len(found.basis):
        oracles.assert_minimax_value(found.value, A[found.basis], b[found.basis])


@settings(max_examples=150, deadline=None, derandomize=True)
@given(data=st.data(), shape=SHAPES)
def test_floats(data, shape):
    floats = st.floats(-1e3, 1e3, allow_subnormal=False, width=32)
    A = data.draw(hnp.arrays(float, shape, elements=floats))
    b = data.draw(hnp.arrays(float, shape[0], elements=floats))
    assume(oracles.scaled_condition(A) <= 1e6)
    value = fit(A, b).value
    # The bound of the engine, and beside it what no residual in double precision can do without.
    model = np.abs(fit(A, b).model)
    rounding = 4 * np.finfo(float).eps * (np.abs(A) @ model).max()
    assert abs(value - oracles.highs_minimax(A, b)) <= oracles.minimax_tolerance(value, b) + rounding


# ------------------------------------------------------------------------------------------------- arguments


def test_problem_must_be_a_problem():
    with pytest.raises(TypeError, match="problem must be a LinearProblem, but it is a tuple"):
        minimax_fit((np.ones((3, 1)), np.ones(3)))


@pytest.mark.parametrize(
    ("subset", "error", "message"),
    [
        (np.zeros(4, dtype=bool), ValueError, "subset must hold at least one point"),
        ([0, 4], ValueError, "subset must hold indices from 0 to 3"),
        ([1, 1], ValueError, "subset must name each point once"),
        ([0.0, 1.0], TypeError, "subset must be a boolean mask or integer indices"),
        ([True, False], ValueError, r"subset must have shape \(4,\)"),
    ],
)
def test_bad_subsets(subset, error, message):
    with pytest.raises(error, match=message):
        fit(np.ones((4, 1)), np.arange(4.0), subset)


def test_arguments_are_left_alone():
    A, b = draw("random_instance", 99)
    problem, mask = LinearProblem(A, b), np.ones(len(b), dtype=bool)
    minimax_fit(problem, mask)
    assert mask.all()
    assert (problem.A == A).all()
    assert (problem.b == b).all()


def test_result_is_frozen():
    found = fit(*draw("random_instance", 98))
    with pytest.raises(AttributeError):
        found.value = math.pi
    assert isinstance(found.value, float)
