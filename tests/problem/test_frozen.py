"""Nobody changes the arrays of a result."""

from dataclasses import fields, replace

import numpy as np
import pytest

import maxcon
from maxcon.datasets import synthetic_two_view


def results():
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, 30)
    y = 2 * x + rng.uniform(-0.1, 0.1, 30)
    y[:4] += 3.0
    problem = maxcon.line(x, y)
    found = maxcon.fit(problem, 0.1)
    scene = synthetic_two_view(40, 0.2, rng)
    yield from (found, found.explain(0), maxcon.certify(problem, 0.1, [2.0, 0.0]), maxcon.minimax_fit(problem))
    yield from (maxcon.alternative_optima(problem, 0.1), maxcon.consensus_curve(problem), replace(found, seconds=0.0))
    yield maxcon.fit(maxcon.LinearProblem(np.zeros((3, 1)), np.ones(3)), 0.1)  # infeasible
    pair = maxcon.find_fundamental(scene.x1, scene.x2, threshold=0.1)
    yield from (pair, pair.consensus)


def test_arrays_of_results_are_read_only():
    kinds = set()
    for result in results():
        arrays = [value for each in fields(result) if isinstance(value := getattr(result, each.name), np.ndarray)]
        assert arrays
        for array in arrays:
            assert not array.flags.writeable
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 0
        kinds.add(type(result).__name__)
    assert kinds == {"Consensus", "Explanation", "MinimaxFit", "AlternativeOptima", "ConsensusCurve", "FundamentalFit"}


def test_what_was_passed_in_stays_as_it_was():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1, 1, (2, 30))
    problem = maxcon.line(x, y)
    model, mask = np.zeros(2), rng.random(30) < 0.5
    for given in (model, mask):
        maxcon.certify(problem, 0.5, given)
    assert all(array.flags.writeable for array in (x, y, model, mask))
