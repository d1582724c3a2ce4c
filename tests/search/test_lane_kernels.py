"""Models of many samples at once, against NumPy one by one."""

import numpy as np
import pytest

from instances import BUILDERS
from maxcon.minimax import linear_rows
from maxcon.problem import LinearProblem
from maxcon.search.lane_kernels import LANES, SMALL_PIVOT, allocate_lanes, solve_lanes


@pytest.mark.parametrize("d", [1, 2, 3, 8])
@pytest.mark.parametrize("count", [1, 7, LANES])
def test_models_solve_their_equations(d, count):
    rng = np.random.default_rng([d, count])
    At, b = rng.normal(size=(d, 40)), rng.normal(size=40)
    lanes = allocate_lanes(d)
    for lane in range(count):
        lanes.points[:, lane] = rng.choice(40, d, replace=False)
    solve_lanes(At, b, count, lanes)
    assert np.count_nonzero(lanes.good[:count]) >= 0.9 * count
    for lane in np.flatnonzero(lanes.good[:count]):
        points = lanes.points[:, lane]
        expected = np.linalg.solve(At[:, points].T, b[points])
        np.testing.assert_allclose(lanes.models[:, lane], expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["duplicate_rows", "quantised", "zero_a", "repeated_column", "one_x", "years"])
def test_a_model_that_is_called_good_solves_its_equations(name):
    rng = np.random.default_rng(3)
    A, b = BUILDERS[name](rng, 30, 3)
    rows = linear_rows(LinearProblem(A, b))
    d = rows.At.shape[0]
    lanes = allocate_lanes(d)
    for _ in range(20):
        for lane in range(LANES):
            lanes.points[:, lane] = rng.integers(30, size=d)  # the same point twice, too
        solve_lanes(rows.At, rows.b, LANES, lanes)
        for lane in range(LANES):
            points = lanes.points[:, lane]
            if lanes.good[lane]:
                r = rows.b[points] - rows.At[:, points].T @ lanes.models[:, lane]
                assert np.abs(r).max(initial=0.0) <= 1e-15 / SMALL_PIVOT**2 * (
                    1 + np.abs(lanes.models[:, lane]).max(initial=0.0)
                )
            if len(set(points)) < d:
                assert not lanes.good[lane]
