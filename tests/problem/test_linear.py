"""Linear problems: what is kept, what is computed, and what every error says."""

import dataclasses

import numpy as np
import pytest

from maxcon.problem import LinearProblem, Problem, hyperplane, line, plane

A = np.array([[1.0, 1.0], [2.0, 1.0], [3.0, 1.0], [4.0, 1.0]])
B = np.array([1.0, -2.5, 3.0, 0.5])


# ------------------------------------------------------------------------------------------------ what is kept


def test_shapes_and_scale():
    problem = LinearProblem(A, B)
    assert (problem.n_points, problem.n_params, problem.scale, problem.family) == (4, 2, 3.0, "linear")
    assert isinstance(problem, Problem)
    assert repr(problem) == "LinearProblem(N=4, d=2, family='linear')"


@pytest.mark.parametrize(
    "given",
    [
        A.tolist(),
        np.asfortranarray(A),
        np.repeat(A, 2, axis=0)[::2],
        A.astype(np.float32),
        A.astype(np.int16),
        A.astype(object),
        [["1", "1"], ["2", "1"], ["3", "1"], ["4", "1"]],
    ],
    ids=["list", "fortran", "strided", "float32", "int16", "object", "strings"],
)
def test_arrays_become_contiguous_float64(given):
    problem = LinearProblem(given, B)
    for array in (problem.A, problem.b):
        assert array.dtype == np.float64
        assert array.flags.c_contiguous
        assert not array.flags.writeable
    assert (problem.A == A).all()


def test_data_are_copied():
    mine, values = A.copy(), B.copy()
    problem = LinearProblem(mine, values)
    mine[:], values[:] = 7.0, 7.0
    assert (problem.A == A).all()
    assert (problem.b == B).all()


def test_frozen():
    problem = LinearProblem(A, B)
    with pytest.raises(dataclasses.FrozenInstanceError):
        problem.A = A
    with pytest.raises(dataclasses.FrozenInstanceError):
        problem.family = "line"
    with pytest.raises(ValueError, match="read-only"):
        problem.A[0, 0] = 7.0
    with pytest.raises(ValueError, match="read-only"):
        problem.b[0] = 7.0


def test_equal_only_to_itself():
    """Arrays have no single truth value: problems are compared, and hashed, by identity."""
    problem = LinearProblem(A, B)
    assert problem == problem  # noqa: PLR0124
    assert problem != LinearProblem(A, B)
    assert len({problem, LinearProblem(A, B)}) == 2


def test_residuals():
    problem = LinearProblem(A, B)
    assert problem.residuals([1.0, -1.0]).tolist() == [1.0, 3.5, 1.0, 2.5]
    assert problem.residuals((0, 0)).tolist() == np.abs(B).tolist()


@pytest.mark.parametrize("model", [[1.0], [1.0, 2.0, 3.0], [[1.0, 2.0]], [np.nan, 1.0], 3.0])
def test_residuals_of_a_bad_model(model):
    with pytest.raises(ValueError, match=r"^model must"):
        LinearProblem(A, B).residuals(model)


# -------------------------------------------------------------------------------------------------- builders


def test_line():
    problem = line([0, 1, 2], [1, 3, 5])
    assert problem.family == "line"
    assert problem.A.tolist() == [[0, 1], [1, 1], [2, 1]]
    assert problem.residuals([2.0, 1.0]).tolist() == [0, 0, 0]


def test_plane():
    problem = plane([0, 1, 2, 0], [1, 0, 1, 2], [4, 3, 7, 8])
    assert problem.family == "plane"
    assert problem.A.tolist() == [[0, 1, 1], [1, 0, 1], [2, 1, 1], [0, 2, 1]]
    assert problem.residuals([1.5, 3.0, 1.0]).tolist() == [0, 0.5, 0, 1]


def test_hyperplane():
    problem = hyperplane([[0, 1], [1, 0], [2, 1], [0, 2]], [4, 3, 7, 8])
    assert problem.family == "hyperplane"
    assert problem.A.tolist() == [[0, 1, 1], [1, 0, 1], [2, 1, 1], [0, 2, 1]]
    assert problem.n_params == 3


@pytest.mark.parametrize(
    "problem",
    [line([0, 1, 2], [1, 3, 5]), plane([0, 1, 2, 3], [0, 1, 0, 2], [1, 3, 5, 4]), hyperplane(A, B)],
    ids=["line", "plane", "hyperplane"],
)
def test_builders_freeze_too(problem):
    for array in (problem.A, problem.b):
        assert array.dtype == np.float64
        assert array.flags.c_contiguous
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 7.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        problem.b = np.zeros(3)


def test_builders_copy():
    x, y = np.arange(4.0), np.arange(4.0)
    problem = line(x, y)
    x[:], y[:] = 9.0, 9.0
    assert problem.A[:, 0].tolist() == [0, 1, 2, 3]
    assert problem.b.tolist() == [0, 1, 2, 3]


# ---------------------------------------------------------------------------------------------------- errors

NAN, INF = float("nan"), float("inf")
BAD = [  # (value, what the message says of it, {} for the name of the argument)
    ([1, 2, NAN, 4], r"must be finite, but 1 of its 4 entries are not; the first is nan at {}\[2\]"),
    ([1, -INF, NAN, 4], r"must be finite, but 2 of its 4 entries are not; the first is -inf at {}\[1\]"),
    ([], r"must not be empty"),
    ([[1, 2, 3, 4]], r"must have 1 dimension, but its shape is \(1, 4\)"),
    (3.0, r"must have 1 dimension, but its shape is \(\)"),
    ([1, None, 3, 4], r"must be finite, but 1 of its 4 entries are not; the first is nan at {}\[1\]"),
    ([1, 2, [3], 4], r"must be a regular array"),
]
BAD_TYPES = [([1, 2, 3, 4j], "complex128"), (["a", "b", "c", "d"], "<U1"), ([{}] * 4, "object")]
GOOD = [1.0, 2.0, 3.0, 5.0]
CALLS = [  # (how to call with one bad argument, its name)
    pytest.param(lambda bad: line(bad, GOOD), "x", id="line-x"),
    pytest.param(lambda bad: line(GOOD, bad), "y", id="line-y"),
    pytest.param(lambda bad: plane(bad, GOOD, GOOD), "x", id="plane-x"),
    pytest.param(lambda bad: plane(GOOD, bad, GOOD), "y", id="plane-y"),
    pytest.param(lambda bad: plane(GOOD, GOOD, bad), "z", id="plane-z"),
    pytest.param(lambda bad: hyperplane(A, bad), "y", id="hyperplane-y"),
    pytest.param(lambda bad: LinearProblem(A, bad), "b", id="linear-b"),
]


@pytest.mark.parametrize(("call", "name"), CALLS)
@pytest.mark.parametrize(("value", "message"), BAD)
def test_bad_vectors_are_named(call, name, value, message):
    with pytest.raises(ValueError, match=f"^{name} " + message.replace("{}", name)):
        call(value)


@pytest.mark.parametrize(("call", "name"), CALLS)
@pytest.mark.parametrize(("value", "dtype"), BAD_TYPES)
def test_vectors_of_the_wrong_type_are_named(call, name, value, dtype):
    with pytest.raises(TypeError, match=f"^{name} must hold real numbers, but its dtype is {dtype}"):
        call(value)


@pytest.mark.parametrize(("call", "name"), [case for case in CALLS if case.values[1] != "x"])
def test_vectors_of_the_wrong_length_are_named(call, name):
    with pytest.raises(ValueError, match=rf"^{name} must have .* but its shape is \(5,\)"):
        call([1, 2, 3, 4, 5])


@pytest.mark.parametrize(("build", "name"), [(LinearProblem, "A"), (hyperplane, "X")])
@pytest.mark.parametrize(
    ("value", "message"),
    [
        (GOOD, r"must have 2 dimensions, but its shape is \(4,\)"),
        (np.zeros((4, 2, 1)), r"must have 2 dimensions"),
        (np.zeros((0, 2)), r"must not be empty, but its shape is \(0, 2\)"),
        (np.zeros((4, 0)), r"must not be empty, but its shape is \(4, 0\)"),
        ([[1, 2], [3]], r"must be a regular array"),
        ([[1, 2], [3, 4], [5, INF], [7, 8]], r"must be finite, but 1 of its 8 entries .* inf at {}\[2, 1\]"),
    ],
)
def test_bad_matrices_are_named(build, name, value, message):
    with pytest.raises(ValueError, match=f"^{name} " + message.replace("{}", name)):
        build(value, B)


@pytest.mark.parametrize(("build", "name"), [(LinearProblem, "A"), (hyperplane, "X")])
def test_matrices_of_the_wrong_type_are_named(build, name):
    with pytest.raises(TypeError, match=f"^{name} must hold real numbers"):
        build(A * 1j, B)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: LinearProblem(A[:2], B[:2]), r"^A must hold at least d \+ 1 = 3 points .* but it holds 2"),
        (lambda: line([1, 2], [3, 4]), r"^x must hold at least d \+ 1 = 3 points"),
        (lambda: plane(GOOD[:3], GOOD[:3], GOOD[:3]), r"^x must hold at least d \+ 1 = 4 points"),
        (lambda: hyperplane(A[:3], B[:3]), r"^X must hold at least d \+ 1 = 4 points"),
    ],
)
def test_too_few_points(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_d_plus_1_points_are_enough():
    assert LinearProblem(A[:3], B[:3]).n_points == 3
    assert line([1, 2, 3], [4, 5, 6]).n_points == 3


def test_huge_values_stay_finite():
    problem = LinearProblem(A * 1e150, B * 1e150)
    assert np.isfinite(problem.residuals([1.0, 1.0])).all()
