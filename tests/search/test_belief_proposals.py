"""Proposals drawn from a belief: the draw, the models, the ranking, the refinement."""

import numpy as np
import pytest

from instances import BUILDERS, synthetic
from maxcon.agent.search_networks import shipped_search_networks
from maxcon.problem import LinearProblem
from maxcon.search.anytime import make_task
from maxcon.search.belief_proposals import (
    KEPT,
    MANY,
    accumulate_weights,
    draw_lanes,
    draw_weighted,
    keep_best,
    propose,
    refine_proposals,
    same_model,
    sample_model,
)
from maxcon.search.lane_kernels import LANES
from maxcon.search.learned_kernels import begin_search
from maxcon.search.learned_memory import allocate_arena, carve
from maxcon.search.random_kernels import random_unit, seed_state


def begun(A, b, threshold=0.1, seed=0):
    task = make_task(LinearProblem(A, b), threshold, np.random.default_rng(seed))
    nets = shipped_search_networks()
    arena = allocate_arena(task.rows, seed_state(task.rng), nets.points, nets.peel)
    begin_search(arena, task.limit)
    return carve(arena), task


def test_points_are_drawn_by_their_weight():
    p = np.array([0.0, 1.0, 0.5, 0.25, 0.0])
    cumulative, guide = np.empty(5), np.empty(5, dtype=np.int64)
    accumulate_weights(p, 2.0, 0.1, cumulative, guide)
    weights = p**2 + 0.1
    np.testing.assert_allclose(np.diff(cumulative, prepend=0), weights)
    state = seed_state(np.random.default_rng(0))
    counts = np.bincount([draw_weighted(cumulative, guide, state) for _ in range(4000)], minlength=5)
    expected = 4000 * weights / weights.sum()
    assert (np.abs(counts - expected) < 5 * np.sqrt(expected)).all()


@pytest.mark.parametrize("name", ["even", "one", "none but the last", "tiny", "steep"])
def test_the_guide_leads_to_the_point_of_the_running_sums(name):
    rng = np.random.default_rng(1)
    p = {
        "even": np.ones(50),
        "one": np.eye(50)[17],
        "none but the last": np.eye(50)[49],
        "tiny": 1e-9 * rng.random(50),
        "steep": 10.0 ** -rng.uniform(0, 30, 50),
    }[name]
    cumulative, guide = np.empty(50), np.empty(50, dtype=np.int64)
    accumulate_weights(p, 1.0, 1e-300, cumulative, guide)
    state = seed_state(rng)
    for _ in range(500):
        before = state.copy()
        point = draw_weighted(cumulative, guide, state)
        target = random_unit(before) * cumulative[-1]
        assert point == min(np.searchsorted(cumulative, target, side="right"), 49)


def test_the_points_of_a_sample_are_different_where_they_can_be():
    p = np.array([1.0, 1.0, 1.0, 0.01, 0.01])
    cumulative, guide = np.empty(5), np.empty(5, dtype=np.int64)
    accumulate_weights(p, 1.0, 0.0, cumulative, guide)
    points = np.zeros((3, LANES), dtype=np.int64)
    state = seed_state(np.random.default_rng(0))
    draw_lanes(cumulative, guide, state, LANES, points)
    assert all(len(set(lane)) == 3 for lane in points.T)
    accumulate_weights(np.eye(5)[2], 1.0, 0.0, cumulative, guide)
    draw_lanes(cumulative, guide, state, 7, points)
    assert (points[:, :7] == 2).all()  # which `solve_lanes` finds dependent


@pytest.mark.parametrize("d", [1, 2, 8])
def test_a_model_passes_through_believed_points(d):
    rng = np.random.default_rng(d)
    search, task = begun(rng.normal(size=(30, d)), rng.normal(size=30))
    believed = np.arange(30) < d + 2
    scratch, x = search.scratch, np.zeros(d)
    cumulative, guide = np.empty(30), np.empty(30, dtype=np.int64)
    accumulate_weights(np.where(believed, 1.0, 1e-12), 1.0, 0.0, cumulative, guide)
    for _ in range(20):
        sample_model(task.rows.At, task.rows.b, cumulative, guide, scratch.state, scratch.table, scratch.places, x)
        r = np.abs(task.rows.b - task.rows.At.T @ x)
        assert np.count_nonzero(r[believed] < 1e-9) >= d
        assert np.count_nonzero(r[~believed] < 1e-9) == 0


@pytest.mark.parametrize("name", ["duplicate_rows", "quantised", "zero_a", "repeated_column", "one_x", "minimal"])
def test_degenerate_data_make_finite_models(name):
    rng = np.random.default_rng(4)
    search, task = begun(*BUILDERS[name](rng, 12, 3))
    scratch, x = search.scratch, np.zeros(task.rows.At.shape[0])
    cumulative, guide = np.empty(12), np.empty(12, dtype=np.int64)
    accumulate_weights(np.ones(12), 1.0, 0.0, cumulative, guide)
    for _ in range(50):
        sample_model(task.rows.At, task.rows.b, cumulative, guide, scratch.state, scratch.table, scratch.places, x)
        assert np.isfinite(x).all()


def test_the_best_are_kept_in_order():
    rng = np.random.default_rng(0)
    models, scores = np.zeros((4, 1)), np.full(4, -1.0)
    values = rng.permutation(20).astype(float)
    for value in values:
        keep_best(models, scores, np.array([10 * value]), value)
    np.testing.assert_array_equal(scores, [19, 18, 17, 16])
    np.testing.assert_array_equal(models[:, 0], 10 * scores)


@pytest.mark.parametrize("n_points", [60, MANY + 50])
def test_refined_proposals_are_ranked_and_tell_the_best_model(n_points):
    search, task = begun(*synthetic(np.random.default_rng(1), n_points, 4, 0.5))
    At, b, limit = task.rows.At, task.rows.b, task.limit
    propose(At, b, limit, 60, 1.0, 0.01, search.belief, search.proposals, search.scratch)
    raw = search.proposals.scores.copy()
    assert (np.diff(raw) <= 0).all()
    best = np.zeros(4)
    size = refine_proposals(At, b, limit, 5, 4.0, search.belief, search.proposals, search.scratch, best, 0)
    assert np.count_nonzero(np.abs(b - At.T @ best) <= limit) == size
    assert size >= 0.4 * n_points
    scores, models = search.proposals.scores, search.proposals.models
    assert (np.diff(scores) <= 0).all()
    assert (scores[5:] == -1).all()
    for k in range(min(5, KEPT)):
        near = np.maximum(1 - ((b - At.T @ models[k]) / (2 * limit)) ** 2, 0).sum()
        assert scores[k] == pytest.approx(near)
    nobody = refine_proposals(At, b, limit, 0, 4.0, search.belief, search.proposals, search.scratch, best, size)
    assert nobody == size


def test_the_distance_of_models_is_that_of_their_residuals():
    rng = np.random.default_rng(5)
    _, task = begun(rng.normal(size=(40, 3)), rng.normal(size=40))
    x, y = rng.normal(size=(2, 3))
    apart = np.sqrt(np.mean((task.rows.At.T @ (x - y)) ** 2))
    assert same_model(x, y, 1.0001 * apart)
    assert not same_model(x, y, 0.9999 * apart)
