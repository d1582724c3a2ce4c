import numpy as np
import pytest

from maxcon.experiments.bench_cells import (
    CALIBRATION,
    CHARTS,
    JUDGED,
    N_PARAMS,
    RATES,
    Cell,
    grid,
    make_instance,
)
from maxcon.minimax import minimax_fit


@pytest.mark.parametrize("family", N_PARAMS)
def test_an_instance_is_drawn_again(family):
    cell = Cell(family, 30, 40)
    one, same, other = (make_instance(cell, number, 7) for number in (3, 3, 4))
    np.testing.assert_array_equal(one.problem.A, same.problem.A)
    np.testing.assert_array_equal(one.problem.b, same.problem.b)
    assert one.problem.A.shape == (30, N_PARAMS[family])
    assert not np.array_equal(one.problem.b, other.problem.b)
    assert not np.array_equal(one.problem.b, make_instance(cell, 3, 8).problem.b)
    assert (one.x1 is not None) == (family in CHARTS)


@pytest.mark.parametrize("family", ["line", "fundamental"])
def test_nobody_is_calibrated_on_what_is_judged(family):
    cell = Cell(family, 30, 40)
    judged = {make_instance(cell, number, 0, JUDGED).problem.b.tobytes() for number in range(8)}
    calibrated = {make_instance(cell, number, 0, CALIBRATION).problem.b.tobytes() for number in range(8)}
    assert len(judged) == len(calibrated) == 8
    assert not judged & calibrated


def test_the_count_is_closed_with_one_slack():
    instance = make_instance(Cell("line", 20, 0), 0, 0)
    A, b = instance.problem.A, instance.problem.b
    theta = np.array([0.1, 0.2])
    residuals = [abs(float(a @ theta) - value) for a, value in zip(A, b, strict=True)]
    slack = 1e-9 * 0.1 + 1e-12 * max(abs(float(value)) for value in b)
    assert instance.limit == pytest.approx(0.1 + slack, rel=1e-15)
    assert instance.count(theta) == sum(each <= 0.1 + slack for each in residuals)
    moved = theta + np.array([0.0, 0.1 - float((A @ theta - b)[0])])  # the first point is now at the threshold
    assert abs(float(A[0] @ moved) - float(b[0])) == pytest.approx(0.1)
    assert (instance.problem.residuals(moved) <= instance.limit)[0]
    assert instance.count(None) == 0
    assert instance.count(np.array([np.nan, 0.0])) == 0


@pytest.mark.parametrize("family", CHARTS)
def test_a_matrix_counts_as_its_parameters_do(family):
    instance = make_instance(Cell(family, 60, 30), 1, 0)
    mask = np.arange(60) < 25
    theta = minimax_fit(instance.problem, mask).model
    assert instance.posed is not None
    F = instance.posed.matrix(theta)
    found = instance.count(theta)
    assert instance.count_model(F) == found
    assert instance.count_model(-3.7 * F) == found
    assert instance.count_model(np.full((3, 3), np.nan)) == 0
    assert instance.count_model(np.zeros((3, 3))) == 0
    assert instance.count_model(None) == 0


def test_a_matrix_without_a_place_in_the_chart():
    instance = make_instance(Cell("fundamental-F32", 30, 30), 0, 0)
    assert instance.posed is not None
    normalised = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert instance.count_model(instance.posed.to_pixels(normalised)) == 0


def test_the_grid():
    cells = grid(("line", "hyperplane"), (20, 40))
    assert len(cells) == 2 * (len(RATES["line"]) + len(RATES["hyperplane"]))
    assert [each.family for each in cells] == sorted((each.family for each in cells), reverse=True)
    assert grid(("plane",), (10, 10), (30, 0)) == (Cell("plane", 10, 30), Cell("plane", 10, 0))
    assert Cell("plane", 10, 30).name == "plane/10/30"


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ((("circle",), (20,)), "families must be among line, .*'circle'"),
        ((("hyperplane",), (20, 8)), "points must be at least d . 1 = 9 .* hold 8"),
        ((("line",), (20,), (100,)), "rates must be from 0 to 99 percent, but they hold 100"),
    ],
)
def test_bad_grids(args, message):
    with pytest.raises(ValueError, match=message):
        grid(*args)
    with pytest.raises(ValueError, match="family must be one of"):
        make_instance(Cell("circle", 20, 10), 0, 0)
