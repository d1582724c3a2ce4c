"""The UCLM network without torch: against torch, and what its weights may not hang on."""

from __future__ import annotations

import json

import numpy as np
import pytest
from safetensors.numpy import save_file

import maxcon
from instances import BUILDERS
from maxcon.agent.uclm import (
    DEPENDENT,
    UclmNetwork,
    describe_points,
    layer_shapes,
    load_uclm,
    save_uclm,
    shipped_uclm,
    uclm_names,
)
from maxcon.datasets.synthetic import synthetic_hyperplane
from maxcon.datasets.two_view_scene import synthetic_two_view
from maxcon.minimax import linear_rows
from maxcon.problem import LinearProblem
from maxcon.search.anytime import make_task
from maxcon.vision.fundamental import fundamental_problem


def random_network(n_params, width, seed=0):
    """Biases too are random: zeros hide mistakes."""
    rng = np.random.default_rng(seed)
    tensors = {}
    for name, (inputs, outputs) in layer_shapes(n_params, width).items():
        tensors[f"{name}.matrix"] = rng.normal(0, np.sqrt(2 / inputs), (inputs, outputs)).astype(np.float32)
        tensors[f"{name}.bias"] = rng.normal(0, 0.3, outputs).astype(np.float32)
    return UclmNetwork(n_params, width, tensors)


def weights_of(network, A, b, threshold):
    task = make_task(LinearProblem(A, b), threshold, np.random.default_rng(0))
    return network.inlier_weights(task.problem, task.rows, task.limit)


@pytest.mark.parametrize(("d", "N", "width"), [(2, 100, 48), (3, 57, 8), (8, 300, 32), (8, 9, 5)])
def test_inference_equals_torch(d, N, width):
    torch = pytest.importorskip("torch")
    from maxcon.experiments.uclm_training import forward  # noqa: PLC0415

    network = random_network(d, width)
    problem = synthetic_hyperplane(np.random.default_rng(N), N, 0.3, d)
    inputs = describe_points(problem, linear_rows(problem), 0.02)
    with torch.no_grad():
        parameters = {name: torch.from_numpy(tensor.copy()) for name, tensor in network.tensors.items()}
        expected = torch.sigmoid(forward(parameters, torch.from_numpy(inputs)[None]))[0].numpy()
    found = network.inlier_weights(problem, linear_rows(problem), 0.02)
    assert np.abs(found - expected).max() < 1e-5
    assert np.ptp(found) > 0.05  # the weights say something: equality is not that of constants


@pytest.mark.parametrize("d", [2, 3, 8])
def test_the_order_of_the_points_does_not_matter(d):
    rng = np.random.default_rng(d)
    network = random_network(d, 16)
    problem = synthetic_hyperplane(rng, 80, 0.4, d)
    order = rng.permutation(80)
    w = weights_of(network, problem.A, problem.b, 0.1)
    assert np.allclose(weights_of(network, problem.A[order], problem.b[order], 0.1), w[order], atol=1e-5)


@pytest.mark.parametrize("d", [2, 3, 8])
def test_units_and_origin_of_the_parameters_do_not_matter(d):
    """Columns times any positive number, b and threshold in another unit, b moved along A."""
    rng = np.random.default_rng(d)
    network = random_network(d, 16)
    problem = synthetic_hyperplane(rng, 80, 0.4, d)
    A, b = problem.A, problem.b
    w = weights_of(network, A, b, 0.1)
    assert np.allclose(weights_of(network, A * 10.0 ** rng.uniform(-4, 4, d), b, 0.1), w, atol=1e-4)
    assert np.allclose(weights_of(network, A, 1000 * b, 100.0), w, atol=1e-4)
    assert np.allclose(weights_of(network, A, b + A @ rng.uniform(-9, 9, d), 0.1), w, atol=1e-4)
    A = A.copy()
    A[:, 0] += 5.0 * A[:, -1]  # x from another origin
    assert np.allclose(weights_of(network, A, b, 0.1), w, atol=1e-4)


@pytest.mark.parametrize("name", BUILDERS)
def test_coordinates_are_those_of_gram_schmidt_from_the_last_column(name):
    A, b = BUILDERS[name](np.random.default_rng([3, *name.encode()]), 40, 4)
    problem = LinearProblem(A, b)
    rows = linear_rows(problem)
    inputs = describe_points(problem, rows, 0.1)
    assert np.isfinite(inputs).all()
    N, d = problem.A.shape
    assert inputs.shape == (N, d + 4)
    frame = inputs[:, :d].astype(float)
    dead = ~frame.any(axis=0)
    assert (~dead).sum() == rows.At.shape[0]
    gram = frame.T @ frame / N
    assert np.allclose(gram, np.diag(~dead), atol=1e-4)
    for j in range(d):  # each column is made of its own coordinate and those of the columns after it
        column = problem.A[:, j] / (np.abs(problem.A[:, j]).max() or 1.0)
        parts = frame.T @ column / N
        assert np.abs(parts[:j]).max(initial=0) < 1e-5
        assert parts[j] >= -1e-5
        assert np.allclose(frame @ parts, column, atol=1e-5)
    size = np.sqrt(np.mean(rows.b**2))
    if size > 1e-3:
        assert np.allclose(inputs[:, d], rows.b / size, atol=1e-5)
        assert np.allclose(np.exp(3 * np.abs(inputs[:, d + 1])), 1 + np.abs(rows.b) / 0.1, rtol=1e-4)
        assert np.allclose(inputs[:, d + 3], np.log(size / 0.1) / 3, atol=1e-5)
    assert DEPENDENT < 1e-8


def test_exact_data_give_finite_weights():
    x = np.arange(20.0)
    w = weights_of(random_network(2, 8), np.column_stack([x, np.ones(20)]), 3 * x - 1, 0.1)
    assert np.isfinite(w).all()
    assert ((w >= 0) & (w <= 1)).all()


@pytest.mark.parametrize(("factor", "end"), [(1e7, 1.0), (-1e7, 0.0)])
def test_huge_logits_do_not_overflow(factor, end):
    network = random_network(2, 8)
    tensors = {**network.tensors, "weight.matrix": np.full((8, 1), factor, dtype=np.float32)}
    problem = synthetic_hyperplane(np.random.default_rng(0), 50, 0.3, 2)
    w = UclmNetwork(2, 8, tensors).inlier_weights(problem, linear_rows(problem), 0.02)
    assert np.isfinite(w).all()
    assert np.median(w) == end


def test_files_keep_networks(tmp_path):
    network = random_network(3, 8)
    save_uclm(network, tmp_path / "n.safetensors", {"seed": "7"})
    again = load_uclm(tmp_path / "n.safetensors")
    assert (again.n_params, again.width) == (3, 8)
    assert all(np.array_equal(again.tensors[name], tensor) for name, tensor in network.tensors.items())
    assert [path.name for path in tmp_path.iterdir()] == ["n.safetensors"]


def test_bad_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match="there is no file"):
        load_uclm(tmp_path / "none.safetensors")
    (tmp_path / "text.safetensors").write_text("text")
    with pytest.raises(ValueError, match="must be a safetensors file"):
        load_uclm(tmp_path / "text.safetensors")
    tensors = dict(random_network(2, 8).tensors)
    for header, changed in (
        ({}, {}),
        ({"config": "{"}, {}),
        ({"config": json.dumps({"kind": "search", "n_params": 2, "width": 8})}, {}),
        ({"config": json.dumps({"kind": "uclm", "n_params": 3, "width": 8})}, {}),
        ({"config": json.dumps({"kind": "uclm", "n_params": 2, "width": "8"})}, {}),
        ({"config": json.dumps({"kind": "uclm", "n_params": 2, "width": 8})}, {"more.bias": np.zeros(1, np.float32)}),
        (
            {"config": json.dumps({"kind": "uclm", "n_params": 2, "width": 8})},
            {"weight.bias": np.full(1, np.nan, dtype=np.float32)},
        ),
    ):
        save_file({**tensors, **changed}, str(tmp_path / "bad.safetensors"), header)
        with pytest.raises(ValueError, match=r"must be a UCLM network .*bad\.safetensors"):
            load_uclm(tmp_path / "bad.safetensors")


def test_another_number_of_parameters_is_refused():
    with pytest.raises(ValueError, match=r"must have the 3 parameters .* but it has 2"):
        weights_of(random_network(3, 8), np.column_stack([np.arange(9.0), np.ones(9)]), np.arange(9.0) ** 2, 0.1)


def test_shipped_networks_load_and_serve_their_families():
    assert set(uclm_names()) == {"line", "plane", "fundamental"}
    rng = np.random.default_rng(0)
    assert shipped_uclm(synthetic_hyperplane(rng, 30, 0.1, 2)).n_params == 2
    assert shipped_uclm(synthetic_hyperplane(rng, 30, 0.1, 3)).n_params == 3
    fundamental = shipped_uclm(LinearProblem(rng.normal(size=(30, 8)), rng.normal(size=30)))
    assert fundamental.n_params == 8
    scene = synthetic_two_view(30, 0.1, rng)
    for chart in ("auto", "F32=1", "F33=1"):
        problem = fundamental_problem(scene.x1, scene.x2, chart=chart, threshold=0.1, samples=50).problem
        assert shipped_uclm(problem) is fundamental
    with pytest.raises(ValueError, match="'uclm' has shipped networks for the families fundamental, line, plane"):
        shipped_uclm(maxcon.hyperplane(rng.normal(size=(30, 4)), rng.normal(size=30)))
    with pytest.raises(ValueError, match="'linear' with 5 parameters"):
        shipped_uclm(LinearProblem(rng.normal(size=(30, 5)), rng.normal(size=30)))


def test_shipped_weights_tell_inliers_from_outliers():
    """Their order, held out: a random inlier has the larger weight than a random outlier at least 9 times in 10."""
    for family, d in (("line", 2), ("plane", 3)):
        right = []
        for seed in range(20):
            problem = synthetic_hyperplane(np.random.default_rng([seed, 99]), 100, 0.4, d)
            task = make_task(problem, 0.1, np.random.default_rng(0))
            w = shipped_uclm(problem).inlier_weights(problem, task.rows, task.limit)
            inlier = maxcon.fit(problem, 0.1, method="exact").inlier_mask
            right.append(np.mean(w[inlier][:, None] > w[~inlier]))
        assert np.mean(right) > 0.9, family
