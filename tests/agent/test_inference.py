"""The compiled network equals the torch network."""

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file

import maxcon
from maxcon.agent.config import paper, shipped
from maxcon.agent.graph import batched_neighbour_max, neighbour_graph, neighbour_max, point_features, scatter_gradient
from maxcon.agent.inference import Agent, pack, q_values
from maxcon.agent.network import QNetwork
from maxcon.agent.search_networks import save_search_networks, shipped_search_networks
from maxcon.agent.shipped import agent_file, agent_names, agent_path, model_card, shipped_agent
from maxcon.agent.weights import load_weights, save_weights
from maxcon.datasets.synthetic import synthetic_hyperplane
from maxcon.datasets.two_view_scene import synthetic_two_view
from maxcon.tree import root
from maxcon.tree.encoding import canonical_features, raw_features
from maxcon.vision.fundamental import fundamental_problem


def random_network(config, n_features, seed):
    torch.manual_seed(seed)
    network = QNetwork(n_features, config.network)
    for parameter in network.parameters():  # norms and biases too: their initial ones and zeros hide mistakes
        torch.nn.init.normal_(parameter, std=0.3)
    return network


def states(problem, rng, channels):
    """All states of a random walk down the tree, as (channels, basis)."""
    state = root(problem, 0.1)
    columns = len(channels)
    while not state.is_goal:
        yield np.ascontiguousarray(state.encode(channels)[:, -columns:]), state.basis
        state = state.remove(rng.choice(np.flatnonzero(state.action_mask)))


@pytest.mark.parametrize(
    ("n_params", "n_points", "changes"),
    [
        (2, 100, {}),
        (3, 60, {}),
        (4, 50, {"estimate": True}),
        (2, 7, {}),  # fewer points than neighbours
        (4, 150, {"widths": (16, 24), "head": (8,), "global_width": 12}),
        (2, 50, {"widths": (5, 7, 9), "head": (6, 5, 4), "global_width": 3, "neighbours": 4}),
    ],
)
def test_compiled_equals_torch(n_params, n_points, changes):
    rng = np.random.default_rng(n_points)
    for base in (shipped, paper):
        config = base(n_params).override(**changes)
        network = random_network(config, n_params + config.network.estimate, n_points)
        tensors = {name: value.detach().numpy() for name, value in network.state_dict().items()}
        agent = Agent(config, pack(tensors, config))
        problem = synthetic_hyperplane(rng, n_points, 0.4, n_params)
        H = point_features(problem, 0.1, config.network)
        graph = neighbour_graph(H, config.network.neighbours)
        scratch = agent.prepare(problem, 0.1)
        found = np.empty(n_params + 1)
        n_states = 0
        for channels, basis in states(problem, rng, config.network.channels):
            q_values(agent.parameters, scratch, channels, basis, found)
            with torch.no_grad():
                inputs = (H, graph, channels, basis)
                expected = network(*(torch.from_numpy(each)[None] for each in inputs))[0].numpy()
            assert np.array_equal(np.isinf(found), basis < 0)
            filled = basis >= 0
            assert np.abs(found[filled] - expected[filled]).max() <= 1e-5 * max(1, np.abs(expected[filled]).max())
            n_states += 1
        assert n_states > 0


def test_the_features_of_a_problem():
    problem = synthetic_hyperplane(np.random.default_rng(5), 40, 0.3, 2)
    raw, canonical = (base(2).network for base in (paper, shipped))
    assert np.array_equal(point_features(problem, 0.1, raw), raw_features(problem))
    assert np.array_equal(point_features(problem, 0.1, canonical), canonical_features(problem))
    features = point_features(problem, 0.2, shipped(2).override(estimate=True).network)
    assert np.array_equal(features[:, :-1], canonical_features(problem))
    signed = features[:, -1].astype(float)
    assert np.allclose(0.2 * signed / (1 - np.abs(signed)), problem.b, rtol=1e-5)
    scaled = maxcon.LinearProblem(problem.A, 7.0 * problem.b)  # in another unit
    assert np.allclose(point_features(scaled, 1.4, shipped(2).override(estimate=True).network), features, atol=1e-5)


def problem_for(name, rng):
    """Return a problem of the kind that a shipped agent is for."""
    if name.startswith("fundamental"):
        scene = synthetic_two_view(100, 0.3, rng)
        return fundamental_problem(scene.x1, scene.x2, threshold=0.1).problem
    return synthetic_hyperplane(rng, 100, 0.5, {"line": 2, "plane": 3}[name.partition("-")[0]])


def test_shipped_agents_equal_torch_to_1e_5():
    assert {"line", "plane", "fundamental", "fundamental-paper"} <= set(agent_names())
    for name in agent_names():
        problem = problem_for(name, np.random.default_rng(1))
        agent = Agent.load(agent_file(name))
        H = point_features(problem, 0.1, agent.config.network)
        network = QNetwork(H.shape[1], agent.config.network)
        tensors, _ = load_weights(agent_path(name))
        network.load_state_dict({key: torch.from_numpy(value) for key, value in tensors.items()})
        graph = neighbour_graph(H, agent.config.network.neighbours)
        scratch = agent.prepare(problem, 0.1)
        found = np.empty(problem.n_params + 1)
        for channels, basis in states(problem, np.random.default_rng(2), agent.config.network.channels):
            q_values(agent.parameters, scratch, channels, basis, found)
            with torch.no_grad():
                expected = network(*(torch.from_numpy(each)[None] for each in (H, graph, channels, basis)))[0].numpy()
            # Q-values of d = 8 reach some -5: float32 keeps about seven digits of them
            assert np.abs(found - expected).max() <= 1e-5 * max(1.0, float(np.abs(expected[basis >= 0]).max()))


def test_the_family_chooses_the_agent(tmp_path, monkeypatch):
    scene = synthetic_two_view(40, 0.3, np.random.default_rng(0))
    for name in ("line", "plane", "fundamental"):
        problem = problem_for(name, np.random.default_rng(0))
        assert shipped_agent(problem).config == load_weights(agent_path(name))[1]
    posed = fundamental_problem(scene.x1, scene.x2, threshold=0.1)
    assert maxcon.fit(posed.problem, 0.1, method="agent", weights="fundamental-paper").n_inliers > 8
    other = fundamental_problem(scene.x1, scene.x2, chart="F32=1").problem
    with pytest.raises(ValueError, match="families fundamental, line, plane, but the problem is of the family 'fundam"):
        maxcon.fit(other, 0.1, method="agent")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "line").write_bytes(agent_path("plane").read_bytes())  # a file goes before a name
    assert Agent.load(agent_file("line")).config.train.n_params == 3


def test_model_cards_name_their_command_and_seed():
    for name in agent_names():
        card = model_card(name)
        for word in ("seed", f"maxcon train {name.partition('-')[0]}", "held-out"):
            assert word in card, (name, word)
    with pytest.raises(ValueError, match="name must be one of"):
        model_card("circle")


def test_q_does_not_depend_on_the_order_of_the_points():
    config = shipped(2)
    network = random_network(config, 2, 0)
    agent = Agent(config, pack({k: v.detach().numpy() for k, v in network.state_dict().items()}, config))
    rng = np.random.default_rng(0)
    problem = synthetic_hyperplane(rng, 80, 0.3, 2)
    channels, basis = next(states(problem, rng, config.network.channels))
    order = rng.permutation(80)
    shuffled = maxcon.LinearProblem(problem.A[order], problem.b[order])
    first, second = np.empty(3), np.empty(3)
    q_values(agent.parameters, agent.prepare(problem, 0.1), np.ascontiguousarray(channels), basis, first)
    where = np.argsort(order)[basis]
    q_values(agent.parameters, agent.prepare(shuffled, 0.1), np.ascontiguousarray(channels[order]), where, second)
    assert np.abs(first - second).max() < 1e-4


def test_canonical_agents_do_not_see_units():
    config = shipped(2)
    network = random_network(config, 2, 0)
    agent = Agent(config, pack({k: v.detach().numpy() for k, v in network.state_dict().items()}, config))
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=60), rng.normal(size=60)
    first, second = root(maxcon.line(x, y), 0.1), root(maxcon.line(1950 + 7 * x, 1e3 * y + 55 * x + 8), 100.0)
    assert np.array_equal(first.basis, second.basis)
    found = []
    for state in (first, second):
        q = np.empty(3)
        channels = np.ascontiguousarray(state.encode(config.network.channels)[:, -5:])
        q_values(agent.parameters, agent.prepare(state.problem, 0.1), channels, state.basis, q)
        found.append(q)
    assert np.allclose(*found, atol=1e-4)


def test_an_agent_for_another_number_of_columns_is_refused():
    config = shipped(2)
    network = random_network(config, 2, 0)
    agent = Agent(config, pack({k: v.detach().numpy() for k, v in network.state_dict().items()}, config))
    with pytest.raises(ValueError, match="problem must have 1 columns that vary"):
        agent.prepare(synthetic_hyperplane(np.random.default_rng(0), 30, 0.3, 3), 0.1)


def test_weights_survive_the_file(tmp_path):
    config = shipped(3, seed=4).override(widths=(8, 8))
    network = random_network(config, 3, 0)
    save_weights(network, config, tmp_path / "a.safetensors")
    tensors, read = load_weights(tmp_path / "a.safetensors")
    assert read == config
    for name, value in network.state_dict().items():
        assert np.array_equal(tensors[name], value.numpy())


def test_broken_weight_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match="weights must name an agent file"):
        load_weights(tmp_path / "none.safetensors")
    (tmp_path / "bad.safetensors").write_bytes(b"hello, this is not it")
    with pytest.raises(ValueError, match="weights must be a safetensors file"):
        load_weights(tmp_path / "bad.safetensors")
    save_search_networks(shipped_search_networks(), tmp_path / "search.safetensors")
    with pytest.raises(ValueError, match="holds a pair of search networks: these are for the method 'learned'"):
        load_weights(tmp_path / "search.safetensors")
    save_file({"a": np.zeros(3)}, tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match="holds no configuration"):
        load_weights(tmp_path / "other.safetensors")


def test_neighbour_max_and_its_gradient_against_the_obvious():
    rng = np.random.default_rng(0)
    q = rng.normal(size=(3, 20, 6)).astype(np.float32)
    graph = rng.integers(0, 20, (3, 20, 5)).astype(np.int32)
    out, which = np.empty_like(q), np.empty(q.shape, dtype=np.int32)
    batched_neighbour_max(q, graph, out, which)
    gathered = np.stack([q[s][graph[s]] for s in range(3)])
    assert np.array_equal(out, gathered.max(axis=2))
    single = np.empty_like(q[0])
    neighbour_max(q[0], graph[0], single)
    assert np.array_equal(single, out[0])
    gradient = rng.normal(size=q.shape).astype(np.float32)
    expected = np.zeros_like(q)
    for s, i, c in np.ndindex(*q.shape):
        expected[s, graph[s, i, gathered[s, i, :, c].argmax()], c] += gradient[s, i, c]
    found = np.zeros_like(q)
    scatter_gradient(gradient, which, found)
    assert np.allclose(found, expected, atol=1e-6)


def test_graph_against_the_obvious():
    H = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)
    distance = ((H[:, None] - H[None]) ** 2).sum(axis=2)
    assert np.array_equal(np.sort(neighbour_graph(H, 6)), np.sort(np.argsort(distance, axis=1)[:, :6]))
    small = neighbour_graph(H[:3], 6)
    assert small.shape == (3, 6)
    assert np.array_equal(small[:, 3:], np.arange(3)[:, None].repeat(3, axis=1))


def test_shipped_agents_are_what_their_command_makes():
    """The settings in the file are those of `maxcon train`, and what they were trained to see has not changed since."""
    expected = {"line": [-3.037, -3.0312, -3.0351], "plane": [-3.098, -3.1059, -3.1099, -3.0881]}
    for name, n_params in (("line", 2), ("plane", 3)):
        problem = synthetic_hyperplane(np.random.default_rng(1), 100, 0.3, n_params)
        agent = shipped_agent(problem)
        assert agent.config == shipped(n_params, agent.config.train.seed)
        state = root(problem, 0.1)
        q = np.empty(n_params + 1)
        channels = np.ascontiguousarray(state.encode(agent.config.network.channels)[:, -5:])
        q_values(agent.parameters, agent.prepare(problem, 0.1), channels, state.basis, q)
        assert np.allclose(q, expected[name], atol=2e-3), q
