"""The checks at the door, the slack of the threshold, and the result type."""

import dataclasses
import math

import numpy as np
import pytest

import maxcon
import oracles
from maxcon.problem import Consensus, LinearProblem, check_indices, check_model, check_threshold, inlier_slack
from maxcon.problem.validate import check_array, check_number

# ------------------------------------------------------------------------------------------------- threshold


@pytest.mark.parametrize("value", [0.1, 1, np.float32(0.5), np.int64(2), np.array(0.25), 5e-324, 1e308])
def test_thresholds(value):
    threshold = check_threshold(value)
    assert type(threshold) is float
    assert threshold == float(value)


@pytest.mark.parametrize("value", [0, 0.0, -1e-9, math.nan, math.inf, -math.inf])
def test_thresholds_out_of_range(value):
    with pytest.raises(ValueError, match=r"^threshold must be a positive finite number, but it is -?(\d|nan|inf)"):
        check_threshold(value)


@pytest.mark.parametrize("value", [None, "0.1", b"1", True, np.True_, 1j, [0.1], np.ones(1), {}, object()])
def test_thresholds_of_the_wrong_type(value):
    with pytest.raises(TypeError, match=r"^threshold must be a number, but it is "):
        check_threshold(value)


def test_numbers_are_named():
    assert check_number(3, "gap") == 3.0
    with pytest.raises(TypeError, match=r"^gap must be a number, but it is 'x'"):
        check_number("x", "gap")


# --------------------------------------------------------------------------------------------------- indices


def test_all_points():
    assert check_indices(None, 3).tolist() == [True] * 3


@pytest.mark.parametrize(
    "value",
    [
        [0, 3],
        [3, 0],
        (0, 3),
        np.array([0, 3], dtype=np.uint8),
        np.array([3, 0], dtype=np.int32),
        range(0, 4, 3),
        [True, False, False, True],
        np.array([1, 0, 0, 1], dtype=bool),
    ],
)
def test_masks_and_indices(value):
    mask = check_indices(value, 4)
    assert mask.dtype == np.bool_
    assert mask.tolist() == [True, False, False, True]


def test_masks_are_copied():
    given = np.ones(3, dtype=bool)
    check_indices(given, 3)[0] = False
    assert given.all()


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([], "must hold at least one point, but it is empty"),
        ([False] * 4, "must hold at least one point, but it is empty"),
        ([True] * 3, r"must have shape \(4,\) as a boolean mask, but its shape is \(3,\)"),
        ([0, 4], "must hold indices from 0 to 3, but it spans 0 to 4"),
        ([-1, 2], "must hold indices from 0 to 3, but it spans -1 to 2"),
        ([1, 2, 1, 1], "must name each point once, but it has 2 repeats"),
        ([[0, 1]], r"must have 1 dimension, but its shape is \(1, 2\)"),
        (2, r"must have 1 dimension, but its shape is \(\)"),
    ],
)
def test_bad_indices_are_named(value, message):
    for name in ("subset", "basis"):
        with pytest.raises(ValueError, match=f"^{name} {message}"):
            check_indices(value, 4, name)


@pytest.mark.parametrize("value", [[0.0, 1.0], ["0"], [None], [1j]])
def test_indices_of_the_wrong_type(value):
    with pytest.raises(TypeError, match=r"^subset must be a boolean mask or integer indices, but its dtype is "):
        check_indices(value, 4)


# ---------------------------------------------------------------------------------------------------- models


def test_models():
    model = check_model([1, 2, 3], 3)
    assert model.dtype == np.float64
    assert model.tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("value", "error", "message"),
    [
        ([1, 2], ValueError, r"^model must have shape \(3,\), but its shape is \(2,\)"),
        ([[1, 2, 3]], ValueError, "^model must have 1 dimension"),
        ([1, math.nan, 3], ValueError, r"^model must be finite, .* nan at model\[1\]"),
        ([1, 2, 3j], TypeError, "^model must hold real numbers"),
        (None, (TypeError, ValueError), "^model must"),
        ("abc", (TypeError, ValueError), "^model must"),
    ],
)
def test_bad_models_are_named(value, error, message):
    with pytest.raises(error, match=message):
        check_model(value, 3)


# ---------------------------------------------------------------------------------------------------- arrays


def test_arrays_are_read_only_copies():
    given = np.arange(3.0)
    array = check_array(given, "y", 1)
    given[0] = 9.0
    assert array.tolist() == [0, 1, 2]
    with pytest.raises(ValueError, match="read-only"):
        array[0] = 1.0


def test_booleans_are_numbers():
    """As in NumPy: a mask fitted as 0 and 1 is fitted."""
    assert check_array([True, False], "y", 1).tolist() == [1.0, 0.0]


# ----------------------------------------------------------------------------------------------------- slack


@pytest.mark.parametrize(("threshold", "largest"), [(0.1, 1.0), (1e-9, 1e6), (3.0, 0.0), (1e6, 1e-3)])
def test_slack_is_the_one_of_the_oracles(threshold, largest):
    """1e-9 threshold + 1e-12 max|b|, in the package and in what judges it."""
    assert inlier_slack(threshold, largest) == oracles.default_slack(threshold, [largest, -largest])
    assert inlier_slack(threshold, largest) == 1e-9 * threshold + 1e-12 * largest


# ---------------------------------------------------------------------------------------------------- result


def test_result_is_frozen_and_says_what_it_is():
    result = Consensus(
        model=np.zeros(2),
        inlier_mask=np.array([True, True, False]),
        n_inliers=2,
        upper_bound=3,
        gap=1,
        status="bounded",
        residuals=np.zeros(3),
        basis=np.array([0, 1]),
        path=np.array([2]),
        threshold=0.25,
        method="greedy",
        seed=0,
        seconds=0.0015,
        problem=LinearProblem(np.eye(3, 2), np.zeros(3)),
    )
    assert repr(result) == "Consensus(2 of 3 points within 0.25, bounded, gap 1, method 'greedy', 1.50 ms)"
    with pytest.raises(dataclasses.FrozenInstanceError):
        result.n_inliers = 3


def test_what_only_looks_like_numbers_is_refused():
    with pytest.raises(TypeError, match="x must hold real numbers"):
        maxcon.line(np.array(["2020-01-01", "2020-01-02", "2020-01-03"], dtype="datetime64[D]"), [1, 2, 3])
    with pytest.raises(TypeError, match="y must hold real numbers"):
        maxcon.line([1, 2, 3], [1, 2, 10**400])
    with pytest.raises(ValueError, match="y must have no masked entries"):
        maxcon.line([1, 2, 3], np.ma.masked_array([1.0, 2.0, 3.0], [False, True, False]))
    with pytest.raises(TypeError, match="threshold must be a number"):
        maxcon.fit(maxcon.line([1, 2, 3], [1, 2, 4]), 10**400)
