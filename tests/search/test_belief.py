"""The belief: votes against their definition, and what the root and the network make of them."""

import numpy as np
import pytest

from maxcon.agent.search_networks import shipped_search_networks
from maxcon.datasets.synthetic import synthetic_hyperplane
from maxcon.search.anytime import make_task
from maxcon.search.belief import MOST_LACK, MOST_LOGIT, TEMPERATURES, agreement, cast_vote, forget_votes, nearness
from maxcon.search.learned_kernels import PARTS, begin_search, play_parts
from maxcon.search.learned_memory import allocate_arena, carve
from maxcon.search.learned_settings import Settings as RoundSettings
from maxcon.search.random_kernels import seed_state


@pytest.mark.parametrize("N", [1, 5, 8, 9, 100])
def test_nearness_is_the_truncated_quadratic(N):
    r = np.random.default_rng(N).normal(size=N) * 3
    near = np.empty(N)
    total = nearness(r, 0.7, near)
    np.testing.assert_allclose(near, np.maximum(1 - (r / 1.4) ** 2, 0), atol=1e-14)
    assert total == pytest.approx(near.sum())
    assert nearness(r, 0.7, r) == total  # in place


@pytest.mark.parametrize("ballot", [0, 1, 2])
def test_votes_do_not_depend_on_their_order(ballot):
    """Each weighs exp(-temperature x what it lacks of the best), whenever that came."""
    rng = np.random.default_rng(ballot)
    scores, nears = rng.uniform(0, MOST_LACK / TEMPERATURES[ballot], 12), rng.random((12, 7))
    expected = np.exp(TEMPERATURES[ballot] * (scores - scores.max()))
    for order in (np.arange(12), np.argsort(scores), np.argsort(-scores)):
        votes, totals, tops = np.zeros((3, 7)), np.zeros(3), np.zeros(3)
        for k in order:
            cast_vote(votes, totals, tops, ballot, scores[k], nears[k])
        np.testing.assert_allclose(votes[ballot], expected @ nears)
        assert totals[ballot] == pytest.approx(expected.sum())
        assert tops[ballot] == scores.max()
        assert (np.delete(votes, ballot, axis=0) == 0).all()


def test_a_hopeless_vote_is_not_cast():
    votes, totals, tops = np.zeros((3, 2)), np.zeros(3), np.zeros(3)
    cast_vote(votes, totals, tops, 0, 50.0, np.ones(2))
    before = votes.copy()
    cast_vote(votes, totals, tops, 0, 50.0 - 1.01 * MOST_LACK / TEMPERATURES[0], np.ones(2))
    np.testing.assert_array_equal(votes, before)


def test_agreement_counts():
    p = np.array([0.9, 0.7, 0.6, 0.2])
    assert agreement(p, np.array([True, True, False, False])) == (pytest.approx(0.8), 1)
    assert agreement(p, np.zeros(4, dtype=bool)) == (0.0, 3)


def played(rate, rounds, d=4, seed=0):
    problem = synthetic_hyperplane(np.random.default_rng([seed, 9]), 100, rate, d)
    task = make_task(problem, 0.1, np.random.default_rng(0))
    nets = shipped_search_networks()
    arena = allocate_arena(task.rows, seed_state(task.rng), nets.points, nets.peel)
    begin_search(arena, task.limit)
    for _ in range(rounds):
        play_parts(arena, task.limit, RoundSettings(), 0, PARTS)
    return carve(arena)


def test_the_belief_comes_to_tell_inliers_from_outliers():
    for seed in range(5):
        search = played(0.5, 4, seed=seed)
        p, member = search.belief.p, search.member
        assert member.sum() >= 50
        assert p[member].mean() > 0.8
        assert p[~member].mean() < 0.2
        assert (np.abs(search.belief.logit) <= MOST_LOGIT).all()


def test_forgetting_empties_the_ballots():
    search = played(0.5, 2)
    assert (search.belief.totals > 0).all()
    forget_votes(search.belief)
    assert not search.belief.votes.any()
    assert not search.belief.totals.any()
