"""Nobody changes the arrays of a result, nor those of its copies."""

import copy
import pickle
from dataclasses import fields, replace

import numpy as np
import pytest

import maxcon
from maxcon.certification import issue
from maxcon.datasets import load_table, synthetic_two_view


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
    yield from (pair, pair.consensus, pair.problem, problem, issue(problem, found), load_table("cyg_ob1"))


KINDS = {
    "AlternativeOptima",
    "Certificate",
    "Consensus",
    "ConsensusCurve",
    "Explanation",
    "FundamentalFit",
    "FundamentalProblem",
    "LinearProblem",
    "MinimaxFit",
    "Table",
}


def unpickled(result):
    return pickle.loads(pickle.dumps(result))


@pytest.mark.parametrize("copied", [lambda result: result, copy.copy, copy.deepcopy, unpickled])
def test_arrays_of_results_and_of_their_copies_are_read_only(copied):
    kinds = set()
    for result in results():
        same = copied(result)
        assert type(same) is type(result)
        kinds.add(type(result).__name__)
        found = 0
        for each in fields(result):
            array, before = getattr(same, each.name), getattr(result, each.name)
            if not isinstance(before, np.ndarray):
                continue
            found += 1
            assert np.array_equal(array, before, equal_nan=before.dtype.kind == "f")
            assert not array.flags.writeable
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 0
        assert found
    assert kinds == KINDS


def test_what_a_copy_of_a_result_holds_is_read_only_too():
    consensus = next(results())
    for same in (copy.deepcopy(consensus), unpickled(consensus)):
        assert same.problem is not consensus.problem
        assert not same.problem.A.flags.writeable
        assert not same.problem.b.flags.writeable
        assert same.explain(0).lost == consensus.explain(0).lost


def test_what_was_passed_in_stays_as_it_was():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1, 1, (2, 30))
    problem = maxcon.line(x, y)
    model, mask = np.zeros(2), rng.random(30) < 0.5
    for given in (model, mask):
        maxcon.certify(problem, 0.5, given)
    assert all(array.flags.writeable for array in (x, y, model, mask))
