import builtins
import json

import pytest

from maxcon.agent.shipped import agent_names


def test_demo(run, tmp_path):
    result = run("demo", "--out", "pictures")
    assert result.exit_code == 0, result.output
    for text in ("belgian_calls", "cyg_ob1", "least squares", "agent", "exact", "16 of 24", "38 of 47"):
        assert text in result.stdout
    assert (tmp_path / "pictures" / "demo.png").read_bytes().startswith(b"\x89PNG")
    rows = [line.split() for line in result.stdout.splitlines() if line.strip().startswith("exact")]
    assert [row[-5:-2] for row in rows] == [["24", "0", "yes"], ["47", "0", "yes"]]


def test_demo_without_matplotlib(run, tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name.partition(".")[0] == "matplotlib":
            raise ModuleNotFoundError("No module named 'matplotlib'")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    result = run("demo")
    assert result.exit_code == 0
    assert "16 of 24" in result.stdout
    assert "no picture was drawn: pictures need matplotlib" in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_demo_errors(fails, tmp_path):
    (tmp_path / "file").touch()
    assert "is a file, not a folder" in fails("demo", "--out", "file")
    assert "weights must be a safetensors file" in fails("demo", "--weights", "file")


def test_agents(run):
    result = run("agents")
    assert result.exit_code == 0
    for name in agent_names():
        assert f"\n{name} " in result.stdout
    assert "KB" in result.stdout


@pytest.fixture
def cards(tmp_path, monkeypatch):
    monkeypatch.setattr("maxcon.agent.shipped.model_card", lambda name: f"# The agent for a {name}\n\nSeed [0].\n")


def test_card(run, cards):
    assert run("agents", "line").stdout == "# The agent for a line\n\nSeed [0].\n\n"


def test_agents_json(run, cards):
    record = json.loads(run("agents", "--json").stdout)
    assert [each["name"] for each in record] == list(agent_names())
    for each in record:
        d = {"line": 2, "plane": 3, "fundamental": 8}[each["name"].partition("-")[0]]
        assert each["config"]["train"]["n_params"] == d
        assert each["bytes"] > 10_000
    assert [each["name"] for each in json.loads(run("agents", "plane", "--json").stdout)] == ["plane"]


def test_unknown_agent(fails):
    names = "fundamental, fundamental-paper, line, line-paper, plane, plane-paper"
    assert f"name must be one of {names}, but it is 'circle'" in fails("agents", "circle")


def test_no_agents(run, monkeypatch):
    monkeypatch.setattr("maxcon.agent.shipped.agent_names", tuple)
    assert "ships no agents; `maxcon train line` makes one" in run("agents").stdout
