import builtins
import hashlib
import importlib.util
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from safetensors.numpy import load_file

from maxcon.agent.config import paper, shipped
from maxcon.agent.learn import Learner
from maxcon.cli.errors import Failure
from maxcon.cli.train import parse_settings

TINY = ("--set", "n_points=12", "--set", "n_instances=20", "--set", "widths=8,8", "--set", "global_width=8")


@pytest.fixture(autouse=True)
def few_held_out(monkeypatch):
    monkeypatch.setattr("maxcon.experiments.training.HELD_OUT_EACH", 2)
    monkeypatch.setattr("maxcon.experiments.training.TWO_VIEW_EACH", 1)


def test_settings():
    pairs = ("n_points=50", "clip=0", "double=false", "widths=8,8", "channels=basis,removed", "learning_rate=1e-4")
    settings = parse_settings(pairs)
    assert settings == {
        "n_points": 50,
        "clip": 0.0,
        "double": False,
        "widths": (8, 8),
        "channels": ("basis", "removed"),
        "learning_rate": 1e-4,
    }
    assert isinstance(settings["clip"], float)
    assert shipped(2).override(**settings).network.widths == (8, 8)


@pytest.mark.parametrize(
    ("pair", "message"),
    [
        ("batch", "--set must be KEY=VALUE"),
        ("foo=1", "there is no setting 'foo'"),
        ("n_params=3", "FAMILY gives it"),
        ("seed=3", "--seed gives it"),
        ("batch=1.5", "batch must be a whole number, but it is '1.5'"),
        ("clip=x", "clip must be a number"),
        ("double=1", "double must be true or false"),
        ("widths=a", "widths must be a list such as 32,32,64"),
    ],
)
def test_wrong_settings(pair, message):
    with pytest.raises(Failure, match=message):
        parse_settings((pair,))


def test_train_and_resume(run, tmp_path):
    whole = run("train", "line", "--updates", 30, "--seed", 4, *TINY, "--out", "whole")
    assert whole.exit_code == 0, whole.output
    assert "unrefined" in whole.stdout
    assert "wrote whole/agent.safetensors" in whole.stdout
    config = json.loads((tmp_path / "whole" / "config.json").read_text(encoding="utf-8"))
    assert (config["train"]["updates"], config["train"]["seed"], config["network"]["widths"]) == (30, 4, [8, 8])

    again = run("train", "line", "--out", "whole")  # a run that has ended: nothing changes
    assert again.exit_code == 0, again.output
    assert "going on with the run: 30 updates" in again.stderr

    fitted = run("evaluate", "line", "--n", 12, "--rates", 20, "--instances", 2, "--methods", "greedy",
                 "--weights", "mine=whole/agent.safetensors")  # fmt: skip
    assert "mine" in fitted.stdout


def test_interrupted_and_resumed_is_the_same_as_never_stopped(run, monkeypatch):
    whole = run("train", "line", "--updates", 40, *TINY, "--out", "whole")
    assert whole.exit_code == 0, whole.output
    real = Learner.iterate
    calls = iter(range(1000))

    def iterate(learner):
        if next(calls) == 45:  # as Ctrl-C in the middle of an update
            signal.raise_signal(signal.SIGINT)
        return real(learner)

    monkeypatch.setattr(Learner, "iterate", iterate)
    first = run("train", "line", "--updates", 40, *TINY, "--out", "halves")
    assert first.exit_code == 130
    assert "the checkpoint is in halves; go on with: maxcon train line --out halves" in first.stderr
    assert not os.path.exists("halves/agent.safetensors")
    second = run("train", "line", "--out", "halves")
    assert second.exit_code == 0, second.output
    one, other = load_file("whole/agent.safetensors"), load_file("halves/agent.safetensors")
    assert one.keys() == other.keys()
    for name, value in one.items():
        np.testing.assert_array_equal(value, other[name])


def test_minutes(run):
    result = run("train", "line", "--updates", 100000, "--minutes", 0.01, *TINY, "--out", "short")
    assert result.exit_code == 0, result.output
    assert "stopped after 0.01 minutes and" in result.stdout
    assert "go on with: maxcon train line --out short" in result.stdout
    assert {"agent.safetensors", "checkpoint.pt", "config.json"} <= set(os.listdir("short"))


def test_no_time_at_all(run):
    for given in (TINY, ()):
        result = run("train", "line", "--minutes", 1e-9, *given, "--out", "none")
        assert result.exit_code == 0, result.output
        assert "go on with: maxcon train line --out none" in result.stdout
        assert os.path.exists("none/checkpoint.pt")


def test_the_papers_agent(run, monkeypatch):
    seen = []
    monkeypatch.setattr("maxcon.cli.train._train", lambda config, *_: (seen.append(config), (None, None))[1])
    assert run("train", "plane", "--paper", "--seed", 2).exit_code == 130
    assert seen == [paper(3, 2)]
    assert os.listdir("runs") == ["plane-paper-seed2"]


def test_fundamental_matrices_and_fine_tuning(run, tmp_path):
    small = (*TINY, "--set", "n_points=20")
    first = run("train", "fundamental", "--updates", 20, *small, "--out", "first")
    assert first.exit_code == 0, first.output
    assert "training an agent for fundamental matrices: 20 updates" in first.stderr
    assert "fundamental, N = 20, 1 held-out instances a rate" in first.stdout
    before = json.loads((tmp_path / "first" / "config.json").read_text(encoding="utf-8"))
    assert (before["data"]["source"], before["data"]["chart"], before["network"]["estimate"]) == ("scene", "auto", True)

    weights = "first/agent.safetensors"
    tuned = run("train", "fundamental", "--from", weights, "--updates", 8, "--out", "tuned")
    assert tuned.exit_code == 0, tuned.output
    after = json.loads((tmp_path / "tuned" / "config.json").read_text(encoding="utf-8"))
    assert after["network"] == before["network"]
    assert (after["train"]["learning_rate"], after["train"]["updates"]) == (2e-4, 8)
    assert after["data"]["started_from"] == hashlib.sha256((tmp_path / weights).read_bytes()).hexdigest()
    one, other = load_file(weights), load_file("tuned/agent.safetensors")
    moved = max(float(np.abs(value - other[name]).max()) for name, value in one.items())
    assert 0 < moved < 8 * 2e-4 * 10  # Adam's steps are about as large as the learning rate

    half = run("train", "fundamental", "--from", weights, "--updates", 8, "--minutes", 1e-9, "--out", "half")
    assert half.exit_code == 0, half.output
    assert f"go on with: maxcon train fundamental --from {weights} --out half" in half.stdout
    rest = run("train", "fundamental", "--from", weights, "--out", "half")
    assert rest.exit_code == 0, rest.output
    for name, value in load_file("half/agent.safetensors").items():
        np.testing.assert_array_equal(value, other[name])
    (tmp_path / "half" / "checkpoint.pt").unlink()  # as after a kill before the first checkpoint
    lost = run("train", "fundamental", "--out", "half")
    assert lost.exit_code == 2
    assert "start must name the agent file" in lost.stderr
    wrong = run("train", "fundamental", "--from", "fundamental", "--out", "half")
    assert "holds a run that did not begin with" in wrong.stderr

    again = run("train", "fundamental", "--out", "tuned")  # a run that has ended: nothing changes
    assert again.exit_code == 0, again.output
    for name, value in load_file("tuned/agent.safetensors").items():
        np.testing.assert_array_equal(value, other[name])


def test_wrong_data_and_weights(fails, run, tmp_path):
    assert "--data is for fundamental matrices, not for a line" in fails("train", "line", "--data", ".")
    assert "--data must hold sequences/NAME/image_0" in fails("train", "fundamental", "--data", ".")
    assert "is no folder" in fails("train", "fundamental", "--data", "nowhere")
    assert "there is no file 'nothing'" in fails("train", "line", "--from", "nothing")
    assert "cannot be used with --paper" in fails("train", "line", "--from", "line", "--paper")
    assert "was trained for d = 2, not a plane" in fails("train", "plane", "--from", "line")
    assert "--set started_from: --from gives it" in fails("train", "line", "--set", "started_from=x")
    (tmp_path / "sequences" / "00").mkdir(parents=True)
    assert "holds 0 PNG images" in fails("train", "fundamental", "--data", ".", "--out", "a")


def test_a_setting_of_text():
    assert parse_settings(("chart=F32=1", "frames=3,9")) == {"chart": "F32=1", "frames": (3, 9)}


def test_errors(run, fails, monkeypatch, tmp_path):
    assert "--set: there is no setting 'foo'" in fails("train", "line", "--set", "foo=1")
    assert "Invalid value for '--updates'" in fails("train", "line", "--updates", 0)
    assert "Invalid value for '--minutes'" in fails("train", "line", "--minutes", 0)
    (tmp_path / "file").touch()
    assert "is a file, not a folder" in fails("train", "line", "--out", "file")
    assert "n_points must be at least d + 1 = 3" in fails("train", "line", "--set", "n_points=2", "--out", "a")
    assert run("train", "line", "--updates", 5, *TINY, "--out", "run").exit_code == 0
    assert "for d = 2, not for a plane" in fails("train", "plane", "--out", "run")
    result = run("train", "line", "--seed", 1, "--out", "run")
    assert result.exit_code == 2
    assert "holds a run with another configuration" in result.stderr.splitlines()[-1]


def test_without_torch(fails, monkeypatch):
    real = importlib.util.find_spec
    monkeypatch.setattr("maxcon.cli.train.find_spec", lambda name: None if name == "torch" else real(name))
    message = fails("train", "line")
    assert "training needs torch, which is not installed: pip install 'maxcon[train]'" in message


def test_parsing_needs_no_torch(fails, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        assert name.partition(".")[0] != "torch"
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    assert "there is no setting" in fails("train", "line", "--set", "foo=1")


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
def test_a_real_ctrl_c(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = f"from maxcon.cli import main; main(['train', 'line', *{TINY!r}, '--out', 'run'])"
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while not (tmp_path / "run" / "log.jsonl").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "go on with: maxcon train line --out run" in stderr
    assert (tmp_path / "run" / "checkpoint.pt").exists()
