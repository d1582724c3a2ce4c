"""The comparison of agents for fundamental matrices: its records, its table, and that it goes on where it stood."""

import json

import numpy as np
import pytest
import torch

from maxcon.agent.config import fundamental, shipped
from maxcon.agent.network import QNetwork
from maxcon.agent.weights import save_weights
from maxcon.datasets.two_view_scene import synthetic_two_view
from maxcon.experiments import fundamental_agents
from maxcon.experiments.evaluation import REFERENCE, REFINEMENTS, Contender, Record
from maxcon.experiments.fundamental_agents import EQUAL_TIME, compare, main, table
from maxcon.vision.fundamental import fundamental_problem


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """An agent that has learned nothing."""
    config = fundamental(shipped(8)).override(widths=(4,), global_width=4, head=(4,))
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("agent") / "agent.safetensors"
    save_weights(QNetwork(10, config.network), config, path)
    return path


def test_every_method_with_every_refinement(weights):
    scene = synthetic_two_view(20, 0.3, np.random.default_rng(2))
    problem = fundamental_problem(scene.x1, scene.x2, threshold=0.1).problem
    records = compare(problem, 0.1, [Contender("mine", "agent", {"weights": str(weights)})], 30, 4, 5.0)
    found = {(each.name, each.refine): each for each in records}
    names = ["mine", "greedy", "random", *(f"{method}, equal time" for method in EQUAL_TIME), "estimate"]
    assert set(found) == {(name, refine) for name in names for refine in REFINEMENTS} | {(REFERENCE, None)}
    assert all((each.rate, each.instance, each.n_points) == (30, 4, 20) for each in records)
    assert len({each.reference for each in records}) == 1
    assert all(each.gap >= 0 for each in records)
    assert found["estimate", None].n_inliers == np.count_nonzero(np.abs(problem.b) <= 0.1)
    for name in ("mine", "estimate"):
        assert found[name, None].n_inliers <= found[name, "tree"].n_inliers <= found[name, "swap"].n_inliers


def test_the_table_averages_what_the_records_say():
    def record(rate, number, name, refine, n, proven):
        return Record(20, rate, number, name, refine, n, 15, proven, 0.002)

    records = [
        record(10, 0, "mine", None, 12, True),
        record(10, 0, REFERENCE, None, 15, True),
        record(10, 1, "mine", None, 15, False),
        record(10, 1, REFERENCE, None, 15, False),
        record(20, 0, "mine", None, 5, True),
        record(20, 0, REFERENCE, None, 15, True),
    ]
    assert table(records, (10, 20), "what").splitlines() == [
        "| what | 10 | 20 |",
        "| --- | --- | --- |",
        "| mine, before refinement | 1.50 (2 ms) | 10.00 (2 ms) |",
        "| best consensus known (proven) | 15.0 (50%) | 15.0 (100%) |",
    ]


def test_a_run_that_was_stopped_repeats_nothing(weights, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(fundamental_agents, "TWO_VIEW_RATES", (10, 30))
    given = ["scene", "--weights", f"mine={weights}", "--out", str(tmp_path), "--n-points", "15", "--instances", "2"]
    main(given)
    printed = capsys.readouterr().out
    path = tmp_path / "records.jsonl"
    whole = path.read_text(encoding="utf-8").splitlines()
    each = len(whole) // 4
    path.write_text("\n".join([*whole[: 3 * each + 2], whole[0][:30]]), encoding="utf-8")
    main(given)
    again = path.read_text(encoding="utf-8").splitlines()
    assert again[: 3 * each] == whole[: 3 * each]
    fixed = [
        {name: value for name, value in json.loads(line).items() if name not in ("seconds", "n_inliers")}
        for line in (*whole, *again)
    ]
    assert fixed[: 4 * each] == fixed[4 * each :]
    assert printed.count("mine, ") == 3
    with pytest.raises(ValueError, match="holds records of the agents"):
        main([*given[:2], f"other={weights}", *given[3:]])
