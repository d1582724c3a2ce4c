"""Training of the search networks: small trainings, resumed and repeated, and what they learn from."""

import numpy as np
import pytest

from maxcon.agent.perceptron import random_perceptron
from maxcon.agent.search_networks import PEEL_WIDTHS, POINT_WIDTHS, SearchNetworks, load_search_networks
from maxcon.experiments.played_fits import WIDEST_BASIS, Recorder, Records, best_known, random_settings
from maxcon.experiments.search_instances import FAMILIES, Ranges, draw_problem, make_problem
from maxcon.experiments.self_imitation import (
    Learner,
    Recipe,
    held_out_gaps,
    peel_loss,
    point_loss,
    train_search_networks,
)
from maxcon.search.anytime import make_task
from maxcon.search.learned_settings import check_settings

torch = pytest.importorskip("torch")

SMALL = Recipe(
    fits=3, updates=4, replayed=2, samples=50, label_rounds=2, play_rounds=(2, 3), ranges=Ranges(many=(200, 220))
)


def untrained(seed=0):
    rng = np.random.default_rng(seed)
    return SearchNetworks(random_perceptron(POINT_WIDTHS, rng), random_perceptron(PEEL_WIDTHS, rng))


@pytest.mark.parametrize("family", FAMILIES)
def test_problems_are_drawn_again_from_the_same_stream(family):
    one, threshold = make_problem(family, np.random.default_rng(3), 60, 0.4)
    other, _ = make_problem(family, np.random.default_rng(3), 60, 0.4)
    assert one.n_points == 60
    assert threshold == 0.1
    np.testing.assert_array_equal(one.A, other.A)
    drawn, limit = draw_problem([family], np.random.default_rng(1), Ranges())
    assert 50 <= drawn.n_points <= 600
    assert 0.03 <= limit <= 0.1
    with pytest.raises(ValueError, match="family must be one of"):
        make_problem("circle", np.random.default_rng(0), 60, 0.4)


def test_what_is_recorded_is_labelled_by_the_best_set():
    rng = np.random.default_rng(0)
    problem, threshold = make_problem("hyperplane", rng, 80, 0.6)
    label = best_known(problem, threshold, 200, rng, None, 0)
    recorder = Recorder()
    task = make_task(problem, threshold, rng)
    settings = check_settings(random_settings(rng, SMALL.explore))._replace(reach=4.0)
    known, found = recorder.fit(task, untrained(), label, settings, 3)
    assert known == label.sum()
    records = recorder.records()
    assert len(records.points) == len(records.points_right) == 4 * 48
    assert np.isfinite(records.points).all()
    best = max(known, found)
    assert abs(records.points_right.mean() - best / 80) < 0.15
    assert len(records.steps) == len(records.steps_right) > 0
    d = task.rows.At.shape[0]
    assert (records.steps_right[:, d + 1 :] == -1).all()
    # Every basis of an infeasible set holds a point outside the label.
    assert (records.steps_right == 1).any(axis=1).all()


def test_the_losses_look_at_filled_slots_only():
    logit = torch.tensor([[2.0, -1.0, 7.0], [0.5, 0.0, -3.0]])
    outside = torch.tensor([[1.0, 0.0, -1.0], [1.0, 1.0, -1.0]])
    filled = torch.nn.functional.binary_cross_entropy_with_logits(logit[:, :2], outside[:, :2])
    choice = torch.log(torch.exp(torch.tensor(2.0)) + torch.exp(torch.tensor(-1.0))) - 2.0
    assert peel_loss(logit, outside).item() == pytest.approx((0.5 * filled + choice).item(), rel=1e-6)
    assert peel_loss(logit[1:], outside[1:]).item() == pytest.approx(
        0.5 * point_loss(logit[1:, :2], outside[1:, :2]).item(), rel=1e-6
    )


def test_learning_separates_what_can_be_separated():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(4000, POINT_WIDTHS[0])).astype(np.float32)
    steps = rng.normal(size=(800, WIDEST_BASIS, PEEL_WIDTHS[0])).astype(np.float32)
    records = Records(points, (points[:, 3] > 0).astype(np.float32), steps, (steps[:, :, 5] > 1).astype(np.float32))
    learner = Learner(untrained(), Recipe(updates=150, batch_points=1024, batch_steps=128))
    first = learner.learn([records], 0.0, rng)
    second = learner.learn([records], 0.5, rng)
    assert second[0] < 0.5 * first[0] < 0.3
    assert second[1] < 0.6 * first[1]


def test_training_can_be_stopped_resumed_and_repeated(tmp_path):
    told = []
    whole = train_search_networks(tmp_path / "a", seed=3, rounds=2, recipe=SMALL, judge_every=0, progress=told.append)
    assert [each.round for each in told] == [1, 2]
    assert all(np.isfinite([each.point_loss, each.peel_loss]).all() for each in told)
    stop = train_search_networks(
        tmp_path / "b", seed=3, rounds=2, recipe=SMALL, judge_every=0, progress=lambda each: True
    )
    assert (stop.points.weights != whole.points.weights).any()
    resumed = train_search_networks(tmp_path / "b", seed=3, rounds=2, recipe=SMALL, judge_every=0)
    for one, other in zip(whole, resumed, strict=True):
        np.testing.assert_array_equal(one.weights, other.weights)
    loaded = load_search_networks(tmp_path / "b" / "search.safetensors")
    np.testing.assert_allclose(loaded.peel.weights, resumed.peel.weights, rtol=1e-6)
    assert sorted(each.name for each in (tmp_path / "b").iterdir()) == ["checkpoint.pt", "search.safetensors"]
    with pytest.raises(ValueError, match="must be a folder of the same training"):
        train_search_networks(tmp_path / "b", seed=4, rounds=2, recipe=SMALL)
    again = train_search_networks(tmp_path / "b", seed=4, rounds=1, recipe=SMALL, judge_every=0, resume=False)
    assert (again.points.weights != resumed.points.weights).any()


def test_bad_arguments_are_named(tmp_path):
    with pytest.raises(ValueError, match="rounds must be at least 1"):
        train_search_networks(tmp_path, rounds=0)
    with pytest.raises(ValueError, match="families must be some of"):
        train_search_networks(tmp_path, families=["circle"])
    with pytest.raises(ValueError, match="families must be some of"):
        train_search_networks(tmp_path, families=[])


def test_held_out_gaps_are_told_by_family():
    gaps = held_out_gaps(untrained(), ["line", "fundamental"], instances=2, budget=0.002)
    assert set(gaps) == {"line", "fundamental"}
