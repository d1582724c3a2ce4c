import json
import os
import signal
import subprocess
import sys
import time

import pytest

from maxcon.agent.shipped import agent_path
from maxcon.cli.evaluate import parse_rates

TINY = ("--n", 12, "--rates", "10,50", "--instances", 2, "--methods", "greedy,random")


def test_table(run):
    result = run("evaluate", "line", *TINY)
    assert result.exit_code == 0, result.output
    assert "line, N = 12, 2 held-out instances a rate" in result.stdout
    for text in ("unrefined", "tree", "swap", "10%", "50%", "greedy", "random", "optimum"):
        assert text in result.stdout
    assert os.listdir() == []


def test_folder_and_json(run, tmp_path):
    result = run("evaluate", "line", *TINY, "--n", "12", "14", "--out", "res", "--json", "out.json")
    assert result.exit_code == 0, result.output
    assert set(os.listdir("res")) == {"settings.json", "records.jsonl", "line-12.png", "line-14.png"}
    lines = (tmp_path / "res" / "records.jsonl").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 2 * 2 * 2 * (2 * 3 + 1)
    record = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    assert record["settings"]["sizes"] == [12, 14]
    assert record["machine"]["cores"] == os.cpu_count()
    assert len(record["table"]) == 2 * 2 * (2 * 3 + 1)
    before = os.stat("res/records.jsonl").st_mtime_ns
    again = run("evaluate", "line", *TINY, "--n", "12,14", "--out", "res")
    assert again.exit_code == 0
    assert os.stat("res/records.jsonl").st_mtime_ns == before  # nothing was run twice


def test_another_evaluation_in_the_folder(run, fails):
    assert run("evaluate", "line", *TINY, "--out", "res").exit_code == 0
    assert "holds an evaluation with other settings" in fails("evaluate", "line", *TINY, "--seed", 1, "--out", "res")


def test_json_on_standard_output_and_nothing_else(run):
    result = run("evaluate", "line", *TINY, "--instances", 1, "--json", "-")
    table = json.loads(result.stdout)["table"]
    assert {row["standard_error"] for row in table} == {None}


def test_an_agent_file_under_a_name(run):
    weights = f"mine={agent_path('line')}"
    args = ("evaluate", "line", *TINY, "--methods", "agent", "--weights", weights, "--json", "-")
    table = json.loads(run(*args).stdout)["table"]
    gaps = {name: [row["mean_gap"] for row in table if row["name"] == name] for name in ("agent", "mine", "reference")}
    assert gaps["mine"] == gaps["agent"]
    assert len(gaps["mine"]) == 6


@pytest.mark.parametrize(
    ("given", "rates"),
    [
        ("10", [10]),
        ("50,10,10", [10, 50]),
        ("10:40", [10, 20, 30, 40]),
        ("10:40:15", [10, 25, 40]),
        ("0.1:0.3", [10, 20, 30]),
        ("0.07", [7]),
        ("0,60", [0, 60]),
    ],
)
def test_rates(given, rates):
    assert parse_rates(given) == tuple(rates)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--rates", "a"), "--rates: 'a' is not a rate"),
        (("--rates", "1:2:3:4"), "is not a rate, low:high or low:high:step"),
        (("--rates", "10:20:0"), "is not a rate"),
        (("--rates", "100"), "must be whole percents from 0 to 99"),
        (("--rates", "-5"), "must be whole percents"),
        (("--rates", "nan"), "must be whole percents"),
        (("--rates", "12.5"), "must be whole percents"),
        (("--rates", "30:10"), "at least one rate"),
        (("--n", "2"), "whole numbers of at least 3 for a line, but it holds '2'"),
        (("--n", "1e3"), "but it holds '1e3'"),
        (("--n", ","), "--n-points must list at least one"),
        (("--instances", "0"), "Invalid value for '--instances'"),
        (("--methods", "magic"), "--methods must be among auto, agent,"),
        (("--methods", ","), "--methods must list at least one"),
        (("--methods", "greedy,greedy"), "two methods are named 'greedy'"),
        (("--weights", "x"), "--weights must be NAME=FILE"),
        (("--weights", "x=none.st"), "there is no file 'none.st'"),
        (("--weights", "PLANE"), "was trained for d = 3, not for a line"),
        (("--weights", "REFERENCE"), "give the agent another NAME"),
        (("--json", "none/x.json"), "there is no folder"),
        (("--out", "file"), "'file' is a file, not a folder"),
    ],
)
def test_errors(fails, tmp_path, args, message):
    (tmp_path / "file").touch()
    names = {"PLANE": f"x={agent_path('plane')}", "REFERENCE": f"reference={agent_path('line')}"}
    assert message in fails("evaluate", "line", *(names.get(arg, arg) for arg in args))


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
def test_ctrl_c_keeps_what_is_done(run, tmp_path):
    settings = ("--n", "60", "--rates", "50", "--instances", "400", "--methods", "greedy,random", "--out", "res")
    code = f"from maxcon.cli import main; main(['evaluate', 'line', *{settings!r}])"
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    records = tmp_path / "res" / "records.jsonl"
    deadline = time.monotonic() + 60
    while not records.exists() and time.monotonic() < deadline:
        time.sleep(0.005)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    assert (process.returncode, stdout) == (130, "")
    assert "the same command goes on from what is in res" in stderr
    kept = records.read_text(encoding="utf-8").splitlines()
    assert 0 < len(kept) < 400 * 7
    assert len(kept) % 7 == 0
    assert run("evaluate", "line", *settings).exit_code == 0
    assert records.read_text(encoding="utf-8").splitlines()[: len(kept)] == kept
