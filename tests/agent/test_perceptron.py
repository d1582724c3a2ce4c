"""The compiled perceptrons against NumPy, and their files."""

import numpy as np
import pytest
from safetensors.numpy import save_file

from maxcon.agent.perceptron import (
    BLOCK,
    LEAK,
    evaluate_columns,
    evaluate_row,
    layers,
    load_perceptrons,
    perceptron,
    random_perceptron,
    save_perceptrons,
)
from maxcon.agent.search_networks import (
    PEEL_WIDTHS,
    POINT_WIDTHS,
    SearchNetworks,
    load_search_networks,
    save_search_networks,
    shipped_search_networks,
)


def forward(net, inputs):
    """Layer by layer, in NumPy; inputs of shape (n, inputs)."""
    values = inputs
    found = layers(net)
    for number, (matrix, bias) in enumerate(found):
        values = values @ matrix + bias
        if number < len(found) - 1:
            values = np.where(values > 0, values, LEAK * values)
    return values[:, 0]


@pytest.mark.parametrize(
    "widths", [(1, 1), (3, 1), (4, 1, 1), (5, 3, 1), (12, 16, 16, 1), (18, 24, 24, 1), (7, 5, 6, 9, 1)]
)
def test_both_kernels_equal_numpy(widths):
    rng = np.random.default_rng(list(widths))
    net = random_perceptron(widths, rng)
    net.weights[:] = rng.normal(size=len(net.weights))  # biases and the last layer, too
    for n in (1, 2, 7, BLOCK - 1, BLOCK, BLOCK + 1, 2 * BLOCK + 5):
        inputs = rng.normal(size=(n, widths[0]))
        expected = forward(net, inputs)
        found = np.full(n, np.nan)
        evaluate_columns(net, np.ascontiguousarray(inputs.T), np.full((2, max(widths), BLOCK), np.nan), found)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
        hidden = np.full((2, max(widths)), np.nan)
        for row, value in zip(inputs[:8], expected[:8], strict=True):
            assert evaluate_row(net, row, hidden) == pytest.approx(value, rel=1e-12, abs=1e-12)


def test_perceptron_names_what_is_wrong():
    with pytest.raises(ValueError, match="layer 1 must take 3 inputs"):
        perceptron([np.ones((2, 3)), np.ones((2, 1))], [np.ones(3), np.ones(1)])
    with pytest.raises(ValueError, match="one output"):
        perceptron([np.ones((2, 3))], [np.ones(3)])
    with pytest.raises(ValueError, match="one output"):
        perceptron([], [])
    with pytest.raises(ValueError, match="finite"):
        perceptron([np.full((2, 1), np.nan)], [np.ones(1)])


def test_a_file_keeps_the_networks_to_single_precision(tmp_path):
    rng = np.random.default_rng(1)
    pair = SearchNetworks(random_perceptron(POINT_WIDTHS, rng), random_perceptron(PEEL_WIDTHS, rng))
    path = tmp_path / "pair.safetensors"
    save_search_networks(pair, path, {"seed": "1"})
    again = load_search_networks(path)
    for one, other in zip(pair, again, strict=True):
        np.testing.assert_array_equal(one.widths, other.widths)
        np.testing.assert_array_equal(one.weights.astype(np.float32), other.weights)
    assert [each.name for each in tmp_path.iterdir()] == ["pair.safetensors"]


def test_wrong_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match="there is no file"):
        load_search_networks(tmp_path / "none.safetensors")
    (tmp_path / "text.safetensors").write_text("hello")
    with pytest.raises(ValueError, match="must be a safetensors file"):
        load_search_networks(tmp_path / "text.safetensors")
    save_perceptrons(
        {"points": random_perceptron(POINT_WIDTHS, np.random.default_rng(0))}, tmp_path / "one.safetensors"
    )
    with pytest.raises(ValueError, match="must hold the perceptron 'peel'"):
        load_search_networks(tmp_path / "one.safetensors")
    with pytest.raises(ValueError, match="of 5 inputs"):
        load_perceptrons(tmp_path / "one.safetensors", {"points": 5})
    broken = {"points.0.weight": np.ones((2, 3), np.float32), "points.0.bias": np.ones(2, np.float32)}
    save_file(broken, str(tmp_path / "broken.safetensors"))
    with pytest.raises(ValueError, match="sound"):
        load_perceptrons(tmp_path / "broken.safetensors", {"points": 2})


def test_the_shipped_pair_is_small_and_of_this_version():
    pair = shipped_search_networks()
    assert pair.points.widths[0] == POINT_WIDTHS[0]
    assert pair.peel.widths[0] == PEEL_WIDTHS[0]
    assert 4 * (len(pair.points.weights) + len(pair.peel.weights)) < 40_000
