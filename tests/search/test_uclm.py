"""UCLM as a method: what it yields is feasible and is what its models explain."""

from __future__ import annotations

import numpy as np
import pytest

import maxcon
from instances import BUILDERS, synthetic
from maxcon.agent.uclm import UclmNetwork, layer_shapes, save_uclm
from maxcon.datasets.synthetic import synthetic_hyperplane
from maxcon.minimax import minimax_fit
from maxcon.problem import LinearProblem
from maxcon.search.anytime import make_task, run
from maxcon.search.refine import swap_refinement
from maxcon.search.uclm import PARTS, null_vector, suggested_models, uclm


def random_network(n_params, width=8, seed=0):
    rng = np.random.default_rng(seed)
    tensors = {}
    for name, (inputs, outputs) in layer_shapes(n_params, width).items():
        tensors[f"{name}.matrix"] = rng.normal(0, np.sqrt(2 / inputs), (inputs, outputs)).astype(np.float32)
        tensors[f"{name}.bias"] = np.zeros(outputs, dtype=np.float32)
    return UclmNetwork(n_params, width, tensors)


def task_for(A, b, threshold=0.1):
    return make_task(LinearProblem(A, b), threshold, np.random.default_rng(0))


@pytest.mark.parametrize("name", BUILDERS)
def test_every_set_is_feasible_and_larger_than_the_last(name):
    """Whatever the weights: a network of random weights proposes worse sets, but no false ones."""
    for seed in range(3):
        A, b = BUILDERS[name](np.random.default_rng([seed, *name.encode()]), 30, 3)
        threshold = 0.1 * float(np.abs(b).max() or 1.0)
        task = task_for(A, b, threshold)
        size = 0
        for step in uclm(task, network=random_network(task.problem.n_params, seed=seed)):
            if step.subset is None:
                continue
            assert step.subset.dtype == np.bool_
            assert step.subset.shape == b.shape
            assert not step.refined
            assert np.count_nonzero(step.subset) > size
            size = np.count_nonzero(step.subset)
            assert minimax_fit(task.problem, step.subset).value <= task.limit * task.rows.scale * (1 + 1e-9)
        best = run(task, uclm(task, network=random_network(task.problem.n_params, seed=seed)), swap_refinement)
        assert best.size >= size


def test_models_are_those_of_their_definition():
    for seed, d in ((0, 2), (1, 3), (2, 8)):
        rng = np.random.default_rng(seed)
        rows = task_for(*synthetic(rng, 70, d, 0.3)).rows
        w = rng.uniform(0.05, 1.0, 70)
        models = list(suggested_models(rows, w))
        M = np.column_stack([rows.At.T, -rows.b])
        v = np.linalg.svd(w[:, None] * M)[2][-1]
        assert np.allclose(models[0], v[:-1] / v[-1], atol=1e-7)
        expected = np.linalg.lstsq(w[:, None] * rows.At.T, w * rows.b, rcond=None)[0]
        assert np.allclose(models[1], expected, atol=1e-9)
        order = np.argsort(-w)
        sizes = sorted({max(d + 1, round(part * 70)) for part in PARTS})
        assert len(models) == 2 + len(sizes)
        for model, size in zip(models[2:], sizes, strict=True):
            best = order[:size]
            expected = np.linalg.lstsq(rows.At.T[best], rows.b[best], rcond=None)[0]
            assert np.allclose(model, expected, atol=1e-9)


def test_tiny_weights_have_the_null_vector_of_large_ones():
    rng = np.random.default_rng(0)
    rows = task_for(*synthetic(rng, 50, 3, 0.3)).rows
    w = rng.uniform(0.1, 1.0, 50)
    v, tiny = null_vector(rows, w), null_vector(rows, 1e-200 * w)
    assert abs(v @ tiny) == pytest.approx(1.0, abs=1e-9)
    assert np.isfinite(null_vector(rows, np.zeros(50))).all()


def test_right_weights_give_the_inliers():
    problem = synthetic_hyperplane(np.random.default_rng(5), 100, 0.4, 3)
    task = make_task(problem, 0.1, np.random.default_rng(0))
    exact = maxcon.fit(problem, 0.1, method="exact")
    w = np.where(exact.inlier_mask, 0.9, 0.01)
    best = max(
        np.count_nonzero(np.abs(task.rows.At.T @ phi - task.rows.b) <= task.limit)
        for phi in suggested_models(task.rows, w)
    )
    assert best >= exact.n_inliers - 6  # least squares is not the minimax fit


def test_it_is_repeatable_and_takes_files(tmp_path):
    network = random_network(2)
    save_uclm(network, tmp_path / "n.safetensors")
    task = task_for(*synthetic(np.random.default_rng(0), 60, 2, 0.3))
    first = [step.subset for step in uclm(task, network=network) if step.subset is not None]
    for given in (tmp_path / "n.safetensors", str(tmp_path / "n.safetensors"), network):
        again = [step.subset for step in uclm(task, network=given) if step.subset is not None]
        assert len(again) == len(first)
        assert all(np.array_equal(one, other) for one, other in zip(first, again, strict=True))


def test_shipped_networks_with_swaps_are_close_to_what_was_generated():
    for d in (2, 3):
        short = []
        for seed in range(20):
            task = make_task(
                synthetic_hyperplane(np.random.default_rng([seed, 77]), 100, 0.4, d), 0.1, np.random.default_rng(0)
            )
            short.append(60 - run(task, uclm(task), swap_refinement).size)
        assert np.mean(short) < 1.0


def test_errors_name_the_argument():
    task = task_for(*synthetic(np.random.default_rng(0), 60, 2, 0.3))
    with pytest.raises(TypeError, match="network must be a file, a UclmNetwork or None, but it is a int"):
        uclm(task, network=3)
    with pytest.raises(ValueError, match="network must name a file"):
        uclm(task, network="missing.safetensors")
    with pytest.raises(ValueError, match="must have the 3 parameters"):
        list(uclm(task, network=random_network(3)))
    with pytest.raises(ValueError, match="has shipped networks for the families"):
        uclm(task)  # the family "linear" with 2 parameters
