"""The environments keep Gymnasium's and Stable-Baselines3's contracts, and the paper's."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import maxcon
from maxcon.datasets.synthetic import synthetic_hyperplane
from maxcon.tree.environments import RemovalEnv
from oracles import highs_minimax

NAMES = ["maxcon/LineRemoval-v0", "maxcon/PlaneRemoval-v0", "maxcon/HyperplaneRemoval-v0"]


@pytest.mark.parametrize("name", NAMES)
def test_gymnasium_checker_passes(name):
    env = gymnasium.make(name, n_points=30)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # infinite bounds and flat Box shapes are remarked on, not refused
        check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize("name", NAMES)
def test_stable_baselines_checker_passes(name):
    env = gymnasium.make(name, n_points=30).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env_sb3(env)


@pytest.mark.parametrize("name", NAMES)
def test_an_episode_is_the_papers(name):
    env = gymnasium.make(name, n_points=40).unwrapped
    rng = np.random.default_rng(3)
    observation, info = env.reset(seed=5)
    A, b = env.state.problem.A, env.state.problem.b
    n_features = observation["state"].shape[1] - 2
    total, terminated, truncated = 0.0, False, False
    while not (terminated or truncated):
        subset = env.state.subset
        assert env.state.value == pytest.approx(highs_minimax(A[subset], b[subset]), rel=1e-9)
        assert env.state.value > 0.1
        basis = observation["basis"]
        mask = observation["action_mask"].astype(bool)
        assert np.array_equal(mask, basis >= 0)
        assert np.array_equal(mask, info["action_mask"])
        assert np.array_equal(mask, env.action_masks())
        marked = observation["state"][:, n_features]
        gone = observation["state"][:, n_features + 1]
        assert set(np.flatnonzero(marked == 1)) == set(basis[mask])
        assert np.array_equal(gone == 1, ~subset)
        assert set(np.unique(observation["state"][:, n_features:])) <= {-1.0, 1.0}
        assert np.allclose(np.abs(A[basis[mask]] @ env.state.model - b[basis[mask]]), env.state.value)
        action = rng.choice(np.flatnonzero(mask))
        observation, reward, terminated, truncated, info = env.step(action)
        total += reward
    assert terminated
    assert env.state.value <= 0.1 + 1e-6
    assert total == -len(env.state.path)
    assert not env.state.subset[list(env.state.path)].any()
    assert not env.action_masks().any()


def test_an_empty_slot_changes_nothing_and_costs_a_step():
    # Copies of two points and one outlier: the basis of a constant has two points, so a slot stays empty.
    problem = maxcon.LinearProblem(np.column_stack([np.ones(11), np.zeros(11)]), [0.0] * 5 + [0.1] * 5 + [9.0])
    env = gymnasium.make("maxcon/ProblemRemoval-v0", problem=problem, threshold=0.1).unwrapped
    observation, _ = env.reset(seed=0)
    empty = np.flatnonzero(observation["action_mask"] == 0)
    assert len(empty) == 1
    after, reward, terminated, truncated, info = env.step(empty[0])
    assert reward == -1.0
    assert info["invalid_action"]
    assert not terminated
    assert not truncated
    for key, value in observation.items():
        assert np.array_equal(value, after[key])


def test_an_episode_of_invalid_actions_is_truncated():
    problem = maxcon.LinearProblem(np.column_stack([np.ones(11), np.zeros(11)]), [0.0] * 5 + [0.1] * 5 + [9.0])
    env = gymnasium.make("maxcon/ProblemRemoval-v0", problem=problem, threshold=0.1).unwrapped
    observation, _ = env.reset(seed=0)
    empty = np.flatnonzero(observation["action_mask"] == 0)[0]
    for _ in range(10):
        assert not env.step(empty)[3]
    assert env.step(empty)[3]


def test_same_seed_same_episode():
    first, second = (gymnasium.make(NAMES[0]).unwrapped for _ in range(2))
    assert np.array_equal(first.reset(seed=7)[0]["state"], second.reset(seed=7)[0]["state"])
    assert not np.array_equal(first.reset(seed=8)[0]["state"], second.reset(seed=9)[0]["state"])


def test_a_problem_without_outliers_is_refused():
    problem = maxcon.line(np.arange(9.0), np.arange(9.0))
    with pytest.raises(ValueError, match="problem must need a removal"):
        gymnasium.make("maxcon/ProblemRemoval-v0", problem=problem, threshold=0.1)


def test_a_sampler_of_another_size_is_refused():
    with pytest.raises(ValueError, match="sample must draw problems with N = 30"):
        RemovalEnv(lambda rng: synthetic_hyperplane(rng, 20, 0.3, 2), 30, 2, 0.1)
