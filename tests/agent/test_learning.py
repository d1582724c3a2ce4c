"""Algorithm 1: its targets, its memory, that it learns, and that a killed run resumes to the same result."""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch

from maxcon.agent.config import AgentConfig, paper, shipped
from maxcon.agent.learn import Learner, prepare
from maxcon.agent.train import HeldOut, begin_with, held_out_gap, load_checkpoint, save_checkpoint, train
from maxcon.datasets.synthetic import mixed_rates, synthetic_hyperplane

SMALL = {
    "n_points": 24,
    "n_instances": 30,
    "updates": 60,
    "batch": 8,
    "memory": 200,
    "widths": (8, 8),
    "global_width": 8,
    "head": (8,),
    "neighbours": 4,
    "target_every": 7,
}


def small(base=shipped, **changes):
    return base(2).override(**{**SMALL, **changes})


def make_data(config, seed=1):
    rng = np.random.default_rng(seed)
    sample = mixed_rates(config.train.n_points, 2, 0.1, 0.4)
    return prepare([sample(rng) for _ in range(config.train.n_instances)], 0.1, config)


def make_held_out(config):
    rng = np.random.default_rng(9)
    problems = [synthetic_hyperplane(rng, config.train.n_points, rate, 2) for rate in (0.2, 0.2, 0.4, 0.4)]
    return HeldOut(prepare(problems, 0.1, config), np.full(4, config.train.n_points), np.array([0.2, 0.2, 0.4, 0.4]))


@pytest.mark.parametrize("changes", [{}, {"n_step": 1}, {"double": False}, {"target_every": 0}, {"discount": 0.9}])
def test_targets_against_the_definition(changes):
    """Follow each drawn transition through the memory by hand and sum its rewards."""
    config = small(**changes)
    learner = Learner(make_data(config), config)
    for _ in range(40):
        learner.act()
    for parameter in learner.target.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    memory, settings = learner.memory, config.train
    seed_state = learner.rng.bit_generator.state
    drawn = memory.sample(learner.rng, 32, settings.n_step)
    learner.rng.bit_generator.state = seed_state
    start = learner.rng.integers(0, memory.count - settings.n_step, 32)
    episode = learner.rng.integers(0, settings.n_episodes, 32)
    found = learner.targets(drawn.later, drawn.steps, drawn.finished).numpy()
    with torch.no_grad():
        online, target = (
            learner.q_values(learner.network, drawn.later),
            learner.q_values(learner.target, drawn.later),
        )
    n_finished = 0
    for i in range(32):
        t, total, alive = (memory.position - memory.count + start[i]) % len(memory.action), 0.0, True
        for ahead in range(settings.n_step):
            total -= settings.reward_scale * settings.discount**ahead
            if memory.done[(t + ahead) % len(memory.action), episode[i]]:
                alive = False
                break
        if alive:
            best = target[i].max() if not settings.double else target[i][online[i].argmax()]
            total += settings.discount**settings.n_step * float(best)
        n_finished += not alive
        assert found[i] == pytest.approx(total, abs=1e-5)
    assert 0 < n_finished < 32


def test_memory_gives_back_the_states_it_was_given():
    config = small(n_episodes=3, memory=30)
    learner = Learner(make_data(config), config)
    seen = []
    for _ in range(25):  # more than it holds
        learner.act()
        t = (learner.memory.position - 1) % 10
        seen.append(
            (
                learner.memory.instance[t].copy(),
                learner.memory.basis[t].copy(),
                learner.memory.action[t].copy(),
            )
        )
    assert learner.memory.count == 10
    for age in range(1, 11):
        t = (learner.memory.position - age) % 10
        for stored, given in zip(
            (learner.memory.instance, learner.memory.basis, learner.memory.action), seen[-age], strict=True
        ):
            assert np.array_equal(stored[t], given)


def test_paper_switches_every_departure_off():
    config = paper(2)
    assert config.network.channels == ("basis", "removed")
    assert not config.network.canonical
    train_config = config.train
    assert (train_config.n_episodes, train_config.target_every, train_config.n_step) == (1, 0, 1)
    assert not train_config.double
    learner = Learner(make_data(small(paper, target_every=0)), small(paper, target_every=0))
    assert learner.target is learner.network
    assert np.isfinite([learner.iterate() for _ in range(60)][-1])


def test_it_learns_to_beat_random_removal():
    config = small(
        n_points=40, n_instances=200, updates=500, batch=32, memory=5000, widths=(16, 16), learning_rate=3e-3
    )
    learner = Learner(make_data(config), config)
    rng = np.random.default_rng(5)
    problems = [synthetic_hyperplane(rng, 40, 0.3, 2) for _ in range(40)]
    held_out = HeldOut(prepare(problems, 0.1, config), np.full(40, 28), np.full(40, 0.3))
    before = held_out_gap(learner, held_out)[0.3]
    while learner.updates < 500:
        learner.iterate()
    after = held_out_gap(learner, held_out)[0.3]
    assert after < 0.5 * before


@pytest.mark.parametrize("base", [shipped, paper])
def test_a_checkpoint_resumes_to_the_same_result(tmp_path, base):
    config = small(base) if base is shipped else small(base, target_every=0)
    data, held_out = make_data(config), make_held_out(config)
    whole = train(config, data, held_out, tmp_path / "whole", report_every=20, progress=False)

    half = Learner(data, config)
    while half.updates < 33:
        half.iterate()
    (tmp_path / "half").mkdir()
    (tmp_path / "half" / "config.json").write_text((tmp_path / "whole" / "config.json").read_text())
    save_checkpoint(half, tmp_path / "half" / "checkpoint.pt")
    resumed = train(config, data, held_out, tmp_path / "half", report_every=20, progress=False)

    assert (tmp_path / "whole" / "agent.safetensors").read_bytes() == (
        tmp_path / "half" / "agent.safetensors"
    ).read_bytes()
    assert whole.updates == resumed.updates == 60
    assert whole.rng.bit_generator.state == resumed.rng.bit_generator.state
    gaps = [
        [json.loads(line)["gap"] for line in (tmp_path / name / "log.jsonl").read_text().splitlines()]
        for name in ("whole", "half")
    ]
    assert gaps[0][1:] == gaps[1]
    assert list((tmp_path / "whole").glob("events.out.tfevents*"))


_SCRIPT = """
import sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from test_learning import make_data, make_held_out, small
from maxcon.agent.train import train
config = small(updates=int(sys.argv[3]))
data, held_out = make_data(config), make_held_out(config)
train(config, data, held_out, Path(sys.argv[2]), report_every=20, checkpoint_seconds=0.05, progress=False)
"""


def test_a_killed_run_resumes_to_the_same_result(tmp_path, request):
    here = str(request.path.parent)
    updates = 400
    command = [sys.executable, "-c", _SCRIPT, here]
    process = subprocess.Popen([*command, str(tmp_path / "killed"), str(updates)])
    for _ in range(600):
        if (tmp_path / "killed" / "checkpoint.pt").exists():
            break
        try:
            process.wait(0.1)
        except subprocess.TimeoutExpired:
            continue
    process.kill()
    process.wait()
    assert (tmp_path / "killed" / "checkpoint.pt").exists()
    config = small(updates=updates)
    data, held_out = make_data(config), make_held_out(config)
    learner = Learner(data, config)
    load_checkpoint(learner, tmp_path / "killed" / "checkpoint.pt")
    resumed = train(config, data, held_out, tmp_path / "killed", report_every=20, progress=False)
    whole = train(config, data, held_out, tmp_path / "whole", report_every=20, progress=False)
    assert resumed.updates == whole.updates
    assert (tmp_path / "whole" / "agent.safetensors").read_bytes() == (
        tmp_path / "killed" / "agent.safetensors"
    ).read_bytes()
    log = [json.loads(line)["updates"] for line in (tmp_path / "killed" / "log.jsonl").read_text().splitlines()]
    assert log == list(range(20, updates + 1, 20))


def test_a_folder_of_another_run_is_refused(tmp_path):
    config = small(updates=10)
    train(config, make_data(config), make_held_out(config), tmp_path, progress=False)
    other = small(updates=10, seed=1)
    with pytest.raises(ValueError, match="folder holds a run with another configuration"):
        train(other, make_data(other), make_held_out(other), tmp_path, progress=False)


def test_a_run_begins_with_the_weights_it_is_given(tmp_path):
    config = small(updates=20)
    data, held_out = make_data(config), make_held_out(config)
    first = train(config, data, held_out, tmp_path / "first", progress=False)
    weights = tmp_path / "first" / "agent.safetensors"
    learner = Learner(data, small(seed=3))
    begin_with(learner, weights)
    for network in (learner.network, learner.target):
        for name, value in network.state_dict().items():
            assert torch.equal(value, first.network.state_dict()[name]), name
    for other, message in ((small(widths=(8, 9)), "start must hold a network of"), (small(), "for d = 3")):
        problems = [synthetic_hyperplane(np.random.default_rng(0), 24, 0.3, 3)] if "d = 3" in message else None
        instances = prepare(problems, 0.1, other) if problems else make_data(other)
        with pytest.raises(ValueError, match=message):
            begin_with(Learner(instances, other.override(n_params=3) if problems else other), weights)


def test_older_configurations_are_read():
    """Those of the agents shipped first have no data section and do not know the estimate."""
    config = shipped(2)
    values = json.loads(json.dumps(config.to_dict()))
    del values["data"], values["network"]["estimate"]
    assert AgentConfig.from_dict(values) == config
    del values["network"]["canonical"]
    with pytest.raises(ValueError, match="values must have the settings"):
        AgentConfig.from_dict(values)


def test_configurations_survive_json_and_refuse_unknown_settings():
    config = shipped(3, seed=5).override(widths=(4, 4), n_step=2)
    assert AgentConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    with pytest.raises(TypeError, match="unknown setting 'depth'"):
        config.override(depth=3)
