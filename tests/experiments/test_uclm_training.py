"""The loss of UCLM against its definition, and a training that can be stopped anywhere."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from maxcon.agent.uclm import load_uclm  # noqa: E402
from maxcon.experiments import uclm_training  # noqa: E402
from maxcon.experiments.uclm_evaluation import CONTENDERS, evaluate_cell, table  # noqa: E402
from maxcon.experiments.uclm_training import (  # noqa: E402
    UclmRecipe,
    consensus_loss,
    first_parameters,
    forward,
    smallest_singular_value,
    train_uclm,
    training_data,
)

SMALL = UclmRecipe(n_points=30, n_instances=40, batch=8, width=8)


def naive_loss(w, M, recipe):
    """By the book: the singular values of diag(w) M."""
    s = np.linalg.svd(w[:, None] * M, compute_uv=False)[-1]
    if recipe.loss == "plain":
        return -w.mean() + recipe.trade_off * s / np.sqrt(len(w))
    return -np.log(w.mean()) + 0.5 * recipe.trade_off * np.log(s**2 / len(w) + recipe.floor**2)


@pytest.mark.parametrize("family", ["line", "plane", "fundamental"])
@pytest.mark.parametrize("recipe", [SMALL, replace(SMALL, loss="plain", trade_off=0.3)], ids=["log", "plain"])
def test_gradient_through_the_singular_value_is_that_of_finite_differences(family, recipe):
    rng = np.random.default_rng(0)
    matrices = training_data(family, 5, replace(recipe, n_instances=4))[1]
    weights = rng.uniform(0.05, 0.95, matrices.shape[:2])
    w = torch.tensor(weights, requires_grad=True)
    value = smallest_singular_value(w, torch.from_numpy(matrices))
    loss = consensus_loss(w, value, recipe)
    loss.sum().backward()
    for k in range(len(matrices)):
        expected = np.linalg.svd(weights[k][:, None] * matrices[k], compute_uv=False)[-1]
        assert value[k].item() == pytest.approx(expected, rel=1e-7)
        assert loss[k].item() == pytest.approx(naive_loss(weights[k], matrices[k], recipe), abs=1e-7)
        for i in rng.choice(weights.shape[1], 8, replace=False):
            h = 1e-5
            up, down = weights[k].copy(), weights[k].copy()
            up[i] += h
            down[i] -= h
            slope = (naive_loss(up, matrices[k], recipe) - naive_loss(down, matrices[k], recipe)) / (2 * h)
            assert w.grad[k, i].item() == pytest.approx(slope, abs=1e-6, rel=1e-4)


def test_gradient_is_finite_where_the_fit_is_exact_and_where_singular_values_coincide():
    exact = np.column_stack([np.ones(10), np.ones(10), np.zeros(10)])  # singular values 0 twice
    w = torch.full((1, 10), 0.5, dtype=torch.float64, requires_grad=True)
    value = smallest_singular_value(w, torch.from_numpy(exact[None]))
    assert value.item() < 1e-7
    consensus_loss(w, value, SMALL).sum().backward()
    assert torch.isfinite(w.grad).all()


def test_gradient_reaches_every_parameter_of_the_network():
    rng = np.random.default_rng(0)
    parameters = first_parameters(3, 8, rng)
    inputs, matrices = training_data("plane", 0, SMALL)
    weights = torch.sigmoid(forward(parameters, torch.from_numpy(inputs)).double())
    consensus_loss(weights, smallest_singular_value(weights, torch.from_numpy(matrices)), SMALL).mean().backward()
    before_context = {f"{name}.bias" for name in ("first", "second", "third", "local", "fifth", "sixth")}
    for name, parameter in parameters.items():
        assert torch.isfinite(parameter.grad).all(), name
        if name not in before_context:  # a mean that is taken away teaches nothing
            assert parameter.grad.abs().max() > 1e-8, name


def test_shrinking_all_weights_pays_in_the_plain_loss_only():
    matrices = torch.from_numpy(training_data("line", 0, SMALL)[1])

    def loss(size, recipe):
        w = torch.full(matrices.shape[:2], size, dtype=torch.float64)
        return consensus_loss(w, smallest_singular_value(w, matrices), recipe).mean().item()

    plain = replace(SMALL, loss="plain", trade_off=1.0)
    assert loss(0.01, plain) < loss(0.1, plain) < loss(1.0, plain)
    assert loss(0.01, SMALL) > loss(0.1, SMALL) > loss(1.0, SMALL)


def test_data_are_drawn_from_the_seed_without_labels():
    inputs, matrices = training_data("line", 3, SMALL)
    again = training_data("line", 3, SMALL)
    other = training_data("line", 4, SMALL)
    assert np.array_equal(inputs, again[0])
    assert np.array_equal(matrices, again[1])
    assert not np.array_equal(inputs, other[0])
    assert inputs.shape == (40, 30, 6)
    assert matrices.shape == (40, 30, 3)


class _KilledError(Exception):
    """Stands for a kill between two checkpoints."""


def test_a_killed_run_goes_on_to_the_same_network(tmp_path, monkeypatch):
    whole = train_uclm("line", tmp_path / "whole", seed=1, updates=12, recipe=SMALL)

    def kill(news):
        if news.updates == 7:
            raise _KilledError

    saves = []
    save = uclm_training._Run.save

    def save_until_killed(run, path):
        saves.append(run.updates)
        if run.updates != 7:  # as a kill would, this leaves the file of update 6
            save(run, path)

    monkeypatch.setattr(uclm_training._Run, "save", save_until_killed)
    with pytest.raises(_KilledError):
        train_uclm(
            "line",
            tmp_path / "killed",
            seed=1,
            updates=12,
            recipe=SMALL,
            progress=kill,
            report_every=1,
            checkpoint_seconds=0.0,
        )
    assert saves[-2:] == [6, 7]
    monkeypatch.undo()
    assert not (tmp_path / "killed" / "line.safetensors").exists()
    steps = []
    again = train_uclm(
        "line", tmp_path / "killed", seed=1, updates=12, recipe=SMALL, progress=steps.append, report_every=1
    )
    assert [news.updates for news in steps] == list(range(7, 13))
    stored = load_uclm(tmp_path / "killed" / "line.safetensors")
    for name, tensor in whole.tensors.items():
        assert np.array_equal(again.tensors[name], tensor)
        assert np.array_equal(stored.tensors[name], tensor)
    assert not list((tmp_path / "killed").glob("*.part"))


def test_ctrl_c_and_a_true_callback_end_a_run_that_can_go_on(tmp_path):
    def interrupt(news):
        raise KeyboardInterrupt

    train_uclm("line", tmp_path, updates=5, recipe=SMALL, progress=interrupt, report_every=2)
    assert torch.load(tmp_path / "checkpoint.pt", weights_only=True)["updates"] == 2
    train_uclm("line", tmp_path, updates=5, recipe=SMALL, progress=lambda news: True, report_every=1)
    assert torch.load(tmp_path / "checkpoint.pt", weights_only=True)["updates"] == 3
    assert not (tmp_path / "line.safetensors").exists()
    train_uclm("line", tmp_path, updates=5, recipe=SMALL)
    assert (tmp_path / "line.safetensors").exists()


def test_ctrl_c_in_the_middle_of_an_update_keeps_no_half_of_it(tmp_path, monkeypatch):
    whole = train_uclm("line", tmp_path / "whole", updates=6, recipe=SMALL)
    steps = []

    def interrupted(*arguments):
        steps.append(1)
        if len(steps) == 4:
            raise KeyboardInterrupt
        return consensus_loss(*arguments)

    monkeypatch.setattr(uclm_training, "consensus_loss", interrupted)
    train_uclm("line", tmp_path / "cut", updates=6, recipe=SMALL, checkpoint_seconds=0.0)
    monkeypatch.undo()
    again = train_uclm("line", tmp_path / "cut", updates=6, recipe=SMALL)
    assert all(np.array_equal(again.tensors[name], tensor) for name, tensor in whole.tensors.items())


def test_a_folder_keeps_its_settings(tmp_path):
    train_uclm("line", tmp_path, updates=1, recipe=SMALL)
    assert json.loads((tmp_path / "config.json").read_text())["width"] == 8
    with pytest.raises(ValueError, match="seed is 0, not 1"):
        train_uclm("line", tmp_path, updates=1, seed=1, recipe=SMALL)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"family": "circle"}, "family must be one of line, plane, fundamental, but it is 'circle'"),
        ({"updates": 0}, "updates must be a positive integer, but it is 0"),
        ({"seed": -1}, "seed must be a non-negative integer, but it is -1"),
        ({"recipe": replace(SMALL, loss="square")}, "loss must be 'log' or 'plain', but it is 'square'"),
    ],
)
def test_bad_arguments_are_named(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        train_uclm(**{"family": "line", "out": tmp_path / "run", "recipe": SMALL, **changes})
    assert not (tmp_path / "run").exists()


def test_training_lowers_the_loss(tmp_path):
    seen = []
    recipe = replace(SMALL, n_instances=100, width=16)
    train_uclm("line", tmp_path, updates=120, recipe=recipe, progress=lambda p: seen.append(p.loss), report_every=20)
    assert seen[-1] < 0.7 * seen[0]


def test_the_evaluation_compares_at_the_same_instances(tmp_path):
    network = train_uclm("line", tmp_path, updates=30, recipe=SMALL)
    cell = evaluate_cell("line", network, 20, n_points=40, instances=3)
    assert cell.sizes.shape == cell.seconds.shape == (3, len(CONTENDERS))
    assert cell.proven.all()
    assert (cell.reference >= 32).all()
    assert (cell.sizes <= cell.reference[:, None]).all()
    assert (cell.sizes[:, 2] >= cell.sizes[:, 0]).all()
    text = table([cell])
    assert "| uclm + swap: mean gap | " in text
    assert "| instances with a proven optimum | 3 of 3 |" in text
