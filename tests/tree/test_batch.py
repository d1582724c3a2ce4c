"""The compiled batch of episodes does what the states one by one do."""

import numpy as np
import pytest

from maxcon.agent.replay import encode
from maxcon.datasets.synthetic import synthetic_hyperplane
from maxcon.tree import root
from maxcon.tree.batch import BatchEnvironment, make_instances
from maxcon.tree.encoding import CHANNELS, LARGEST_RATIO, channel_flags


@pytest.mark.parametrize("n_params", [2, 3, 8])
def test_batch_equals_states_one_by_one(n_params):
    rng = np.random.default_rng(n_params)
    problems = [synthetic_hyperplane(rng, 40, 0.3, n_params) for _ in range(6)]
    environment = BatchEnvironment(make_instances(problems, 0.1), 6)
    environment.reset(np.arange(6), np.arange(6))
    states = [root(problem, 0.1) for problem in problems]
    flags = channel_flags(("basis", "removed"))
    while not environment.done.all():
        encoded = encode(environment.instances, environment, flags)
        for k, state in enumerate(states):
            assert environment.done[k] == state.is_goal
            assert np.array_equal(environment.gain[k] == 1, state.subset)
            assert np.array_equal(environment.basis[k], state.basis)
            assert np.array_equal(encoded[k], state.encode()[:, -2:])
        size = (environment.basis >= 0).sum(axis=1)
        actions = (rng.random(6) * size).astype(int)
        rewards = environment.step(actions)
        for k, state in enumerate(states):
            assert rewards[k] == state.reward
            if not state.is_goal:
                states[k] = state.remove(actions[k])


def test_channels_mean_what_they_say():
    problem = synthetic_hyperplane(np.random.default_rng(0), 50, 0.3, 3)
    state = root(problem, 0.1).remove(0).remove(1)
    columns = state.encode(CHANNELS)[:, -len(CHANNELS) :]
    signed = problem.b - problem.A @ state.model
    expected = np.clip(signed / state.value, -LARGEST_RATIO, LARGEST_RATIO)
    assert np.allclose(columns[:, 2], expected, atol=1e-5)
    assert np.allclose(columns[:, 3], np.log(state.value / 0.1) / 3, atol=1e-5)
    assert columns[:, 4].sum() == pytest.approx(1, abs=1e-5)
    assert set(np.flatnonzero(columns[:, 4])) == set(state.basis[state.basis >= 0])


def test_a_finished_episode_stays_and_costs_nothing():
    rng = np.random.default_rng(1)
    problems = [synthetic_hyperplane(rng, 20, 0.0, 2), synthetic_hyperplane(rng, 20, 0.4, 2)]
    environment = BatchEnvironment(make_instances(problems, 0.1), 2)
    environment.reset(np.arange(2), np.arange(2))
    assert environment.done.tolist() == [True, False]
    assert environment.step(np.zeros(2, dtype=int)).tolist() == [0.0, -1.0]
    assert environment.gain[0].all()


def test_an_empty_slot_is_refused():
    environment = BatchEnvironment(make_instances([synthetic_hyperplane(np.random.default_rng(1), 20, 0.4, 2)], 0.1), 1)
    environment.reset(np.arange(1), np.arange(1))
    with pytest.raises(ValueError, match="actions must name slots"):
        environment.step(np.array([3]))


def test_problems_of_two_sizes_are_refused():
    rng = np.random.default_rng(1)
    problems = [synthetic_hyperplane(rng, n, 0.1, 2) for n in (20, 21)]
    with pytest.raises(ValueError, match="problems must all have the same"):
        make_instances(problems, 0.1)
