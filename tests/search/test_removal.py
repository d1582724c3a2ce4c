"""Greedy and random descents, replayed step by step with cold fits."""

import numpy as np
import pytest

from instances import BUILDERS, synthetic
from maxcon.minimax import minimax_fit
from maxcon.minimax.linear import FAILED
from maxcon.problem import LinearProblem
from maxcon.search import removal
from maxcon.search.anytime import Step, Task, make_task, run
from maxcon.search.removal import greedy, random_removal


def draw_task(name: str, seed: int) -> Task:
    rng = np.random.default_rng([seed, len(name)])
    d = int(rng.integers(1, 5))
    A, b = BUILDERS[name](rng, int(rng.integers(d + 2, 21)), d)
    threshold = float(rng.choice([0.1, 0.5, 1.0, 0.1 * np.abs(b).max() + 1e-9]))
    return make_task(LinearProblem(A, b), threshold, rng)


def found(steps: list[Step]) -> list[Step]:
    return [step for step in steps if step.subset is not None]


def value(task: Task, subset: np.ndarray) -> float:
    return minimax_fit(task.problem, subset).value if subset.any() else 0.0


def without(subset: np.ndarray, point: int) -> np.ndarray:
    smaller = subset.copy()
    smaller[point] = False
    return smaller


def replay(task: Task, step: Step) -> list[tuple[np.ndarray, int, float]]:
    """Check that `step` is a descent: every state before the last infeasible, the last one not.

    Returns each state, the point removed, and f of what remains.
    """
    limit, noise = task.limit * task.rows.scale, 1e-9 * task.threshold + 1e-11 * task.problem.scale
    state = np.ones(task.problem.n_points, dtype=bool)
    moves = []
    above = value(task, state)
    for point in step.path:
        assert state[point]
        assert above > limit - noise
        below = value(task, without(state, point))
        assert below <= above + noise
        moves.append((state, int(point), below))
        state, above = without(state, point), below
    assert above <= limit + noise
    np.testing.assert_array_equal(state, step.subset)
    return moves


@pytest.mark.parametrize("name", BUILDERS)
def test_descents_are_paths_to_feasible_sets(name):
    for seed in range(4):
        task = draw_task(name, seed)
        descents = found(list(greedy(task))) + found(list(random_removal(task, tries=2)))
        if not descents:  # only where no point fits any model
            assert all(value(task, one) > task.threshold for one in np.eye(task.problem.n_points, dtype=bool))
            continue
        assert len(descents) == 3
        for step in descents:
            assert step.subset.any()
            replay(task, step)


@pytest.mark.parametrize("name", BUILDERS)
def test_greedy_takes_the_best_child(name):
    for seed in range(3):
        task = draw_task(name, seed)
        noise = 1e-9 * task.threshold + 1e-11 * task.problem.scale
        for step in found(list(greedy(task))):
            for state, _, below in replay(task, step):
                best = min(value(task, without(state, i)) for i in minimax_fit(task.problem, state).basis)
                assert below <= best + noise


def test_greedy_is_what_a_naive_greedy_does():
    """In general position, point by point."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        A, b = synthetic(rng, 40, int(rng.integers(2, 6)), 0.4)
        task = make_task(LinearProblem(A, b), 0.1, rng)
        state, path = np.ones(40, dtype=bool), []
        while value(task, state) > task.limit * task.rows.scale:
            children = {int(i): value(task, without(state, i)) for i in minimax_fit(task.problem, state).basis}
            path.append(min(children, key=children.__getitem__))
            state = without(state, path[-1])
        (step,) = found(list(greedy(task)))
        assert step.path.tolist() == path
        np.testing.assert_array_equal(step.subset, state)


def test_random_removes_basis_points():
    rng = np.random.default_rng(1)
    A, b = synthetic(rng, 40, 3, 0.5)
    task = make_task(LinearProblem(A, b), 0.1, rng)
    for step in found(list(random_removal(task, tries=3))):
        for state, point, _ in replay(task, step):
            assert point in minimax_fit(task.problem, state).basis


def test_random_draws_uniformly_and_independently():
    rng = np.random.default_rng(7)
    A, b = synthetic(rng, 14, 3, 0.5)
    task = make_task(LinearProblem(A, b), 0.1, rng)
    tries = 1000
    firsts = np.array([step.path[0] for step in found(list(random_removal(task, tries=tries)))])
    basis = minimax_fit(task.problem).basis
    counts = np.array([np.count_nonzero(firsts == i) for i in basis])
    assert len(basis) == 4
    assert counts.sum() == tries
    assert np.abs(counts - tries / 4).max() < 5 * np.sqrt(tries * 3 / 16)


def test_seed_decides():
    A, b = synthetic(np.random.default_rng(3), 50, 3, 0.5)
    problem = LinearProblem(A, b)

    def paths(seed: int) -> list[list[int]]:
        task = make_task(problem, 0.1, np.random.default_rng(seed))
        return [step.path.tolist() for step in random_removal(task, tries=3)]

    assert paths(0) == paths(0)
    assert paths(0) != paths(1)
    assert len({tuple(path) for path in paths(0)}) == 3


@pytest.mark.parametrize("method", [greedy, random_removal])
def test_pauses_change_nothing(method, monkeypatch):
    A, b = synthetic(np.random.default_rng(3), 50, 3, 0.5)
    problem = LinearProblem(A, b)
    (whole,) = list(method(make_task(problem, 0.1, np.random.default_rng(0))))
    monkeypatch.setattr(removal, "WORK_PER_YIELD", 1)
    steps = list(method(make_task(problem, 0.1, np.random.default_rng(0))))
    assert len(steps) == len(whole.path)  # one removal each; the last says that it has arrived
    assert all(step.subset is None for step in steps[:-1])
    np.testing.assert_array_equal(steps[-1].path, whole.path)
    np.testing.assert_array_equal(steps[-1].subset, whole.subset)


@pytest.mark.parametrize("method", [greedy, random_removal])
def test_feasible_from_the_start(method):
    task = make_task(LinearProblem([[1.0], [1.0], [1.0]], [0.0, 1.0, 2.0]), 1.0, np.random.default_rng(0))
    (step,) = list(method(task))
    assert step.subset.all()
    assert len(step.path) == 0


@pytest.mark.parametrize("method", [greedy, random_removal])
def test_no_feasible_point(method):
    task = make_task(LinearProblem(np.zeros((4, 2)), [2.0, -3.0, 4.0, 5.0]), 1.0, np.random.default_rng(0))
    best = run(task, method(task))
    assert best.subset is None


@pytest.mark.parametrize("method", [greedy, random_removal])
def test_zero_rows_go_and_the_rest_stays(method):
    A = [[0.0, 0.0], [1.0, 0.0], [0.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]]
    task = make_task(LinearProblem(A, [9.0, 1.0, 0.5, 2.0, 1.0, -7.0]), 1.0, np.random.default_rng(0))
    (step,) = found(list(method(task)))
    assert sorted(step.path.tolist()) == [0, 5]


@pytest.mark.parametrize(("method", "kernel"), [(greedy, "greedy_kernel"), (random_removal, "random_kernel")])
def test_failed_fit_is_reported(method, kernel, monkeypatch):
    monkeypatch.setattr(removal, kernel, lambda *_: (FAILED, 3))
    with pytest.raises(ArithmeticError, match="after 3 removals"):
        list(method(draw_task("random_instance", 0)))


@pytest.mark.parametrize("tries", [0, -1, 1.5, True, "3"])
def test_tries_must_be_a_positive_integer(tries):
    with pytest.raises(ValueError, match="tries must be a positive integer"):
        random_removal(draw_task("random_instance", 0), tries=tries)
