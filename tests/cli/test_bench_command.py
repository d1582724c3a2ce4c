import json
import os
import signal
import subprocess
import sys
import time

import pytest

from maxcon.experiments.bench import absent_peers

TINY = ("--families", "line", "--points", 20, "--rates", 30, "--budgets", "1,5", "--instances", 2, "--seeds", 1)
OURS = ("--methods", "auto,gnc")


def test_a_run_and_its_page(run, tmp_path):
    result = run("bench", *TINY, "--methods", "auto,gnc,skimage-ransac", "--out", "res")
    assert result.exit_code == 0, result.output
    assert "line, mean gap" in result.stdout
    assert "wrote res/leaderboard.md" in result.stdout
    names = {each.name for each in (tmp_path / "res").iterdir()}
    assert names == {"settings.json", "calibration.jsonl", "records.jsonl", "leaderboard.md", "gap-line.png"}
    page = (tmp_path / "res" / "leaderboard.md").read_text(encoding="utf-8")
    assert "| skimage-ransac |" in page
    records = (tmp_path / "res" / "records.jsonl").read_bytes()
    again = run("bench", *TINY, "--methods", "auto,gnc,skimage-ransac", "--out", "res")
    assert again.exit_code == 0
    assert (tmp_path / "res" / "records.jsonl").read_bytes() == records  # nothing was run twice


def test_absent_peers_are_named_where_all_are_meant(run, monkeypatch):
    absent = absent_peers() or {"peer-of-a-test": "peer"}
    monkeypatch.setattr("maxcon.experiments.bench.absent_peers", lambda: absent)
    monkeypatch.setattr("maxcon.experiments.bench.usual_methods", lambda: ("auto", "gnc"))
    result = run("bench", *TINY)
    assert result.exit_code == 0
    for name in absent:
        assert f"{name} is not installed and left out" in result.stderr
    result = run("bench", *TINY, *OURS, "--out", "other")
    assert result.exit_code == 0
    assert "not installed" not in result.stderr


def test_quick_is_a_start(run, tmp_path):
    args = ("--quick", "--families", "line", "--instances", 1, *OURS)
    assert run("bench", *args).exit_code == 0
    settings = json.loads((tmp_path / "bench" / "settings.json").read_text(encoding="utf-8"))["settings"]
    assert settings["sizes"] == [100]
    assert settings["rates"] == [30, 60]
    assert settings["budgets"] == [1.0, 10.0]
    assert (settings["instances"], settings["seeds"], settings["methods"]) == (1, 1, ["auto", "gnc"])


@pytest.fixture
def pair(run, tmp_path):
    """Return a function that makes two benchmarks, the second with so many inliers fewer in every run of a method."""

    def make(method, fewer):
        assert run("bench", *TINY, *OURS, "--out", "old").exit_code == 0
        (tmp_path / "new").mkdir()
        (tmp_path / "new" / "settings.json").write_bytes((tmp_path / "old" / "settings.json").read_bytes())
        lines = (tmp_path / "old" / "records.jsonl").read_text(encoding="utf-8").splitlines()
        with (tmp_path / "new" / "records.jsonl").open("w", encoding="utf-8") as file:
            for line in lines:
                unit = json.loads(line)
                for row in unit["rows"]:
                    if row["method"] == method:
                        row["inliers"] = [each - fewer for each in row["inliers"]]
                file.write(json.dumps(unit) + "\n")

    return make


@pytest.mark.parametrize(
    ("method", "fewer", "code", "said"),
    [
        ("auto", 3, 1, "worse: auto, line N = 20 30%, 1 ms: +3.00 +-0.00"),
        ("auto", -3, 0, "better: auto, line N = 20 30%, 1 ms: -3.00 +-0.00"),
        ("gnc", 3, 0, "worse: gnc, line N = 20 30%, 5 ms: +3.00 +-0.00"),
        ("auto", 0, 0, "0 of 4 changes exceed two standard errors"),
    ],
)
def test_compare(run, pair, method, fewer, code, said):
    pair(method, fewer)
    result = run("bench", "--compare", "old", "new")
    assert result.exit_code == code, result.output
    assert said in result.stdout
    assert "another" not in result.stdout
    assert ('"auto" got worse' in result.stdout) == (code == 1)


def test_comparing_machines(run, pair, tmp_path):
    pair("auto", 0)
    path = tmp_path / "new" / "settings.json"
    header = json.loads(path.read_text(encoding="utf-8"))
    header["versions"]["numpy"] = "0.1"
    path.write_text(json.dumps({**header, "processor": "an abacus"}), encoding="utf-8")
    result = run("bench", "--compare", "old", "new")
    assert result.exit_code == 0
    assert "on another machine: an abacus, not " in result.stdout
    assert "with another numpy: 0.1, not " in result.stdout


def test_other_settings_in_the_folder(run, fails):
    assert run("bench", *TINY, *OURS, "--out", "res").exit_code == 0
    line = fails("bench", *TINY, *OURS, "--seed", 1, "--out", "res")
    assert "settings.seed differs" in line
    assert "name another folder" in line


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
def test_ctrl_c_keeps_what_is_done(run, tmp_path):
    settings = ("--families", "line", "--points", "20", "--rates", "30", "--instances", "400", "--seeds", "1", *OURS)
    code = f"from maxcon.cli import main; main(['bench', *{settings!r}])"
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    records = tmp_path / "bench" / "records.jsonl"
    deadline = time.monotonic() + 60
    while not records.exists() and time.monotonic() < deadline:
        time.sleep(0.005)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted; the same command goes on from what is in bench" in stderr
    kept = records.read_text(encoding="utf-8").splitlines()
    assert 0 < len(kept) < 400
    assert all(json.loads(line)["digest"] for line in kept)
    assert f"Not complete: {len(kept)} of 400" in (tmp_path / "bench" / "leaderboard.md").read_text(encoding="utf-8")
    assert "wrote" in stdout


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--families", "circle"), "families must be among line"),
        (("--families", ","), "--families must list at least one"),
        (("--points", "many"), "--points must list whole numbers"),
        (("--points", "2"), "points must be at least d + 1 = 3"),
        (("--rates", "150"), "must be whole percents"),
        (("--budgets", "soon"), "--budgets must list numbers of milliseconds"),
        (("--budgets", "0"), "budgets must be positive"),
        (("--methods", "magic"), "methods must be among"),
        (("--instances", "0"), "Invalid value for '--instances'"),
        (("--proof-time", "0"), "proof_time must be a positive number"),
        (("--out", "file"), "'file' is a file, not a folder"),
        (("--compare", "none", "other"), "there is no benchmark in 'none'"),
        (("--compare", "none"), "'--compare' requires 2 arguments"),
    ],
)
def test_errors(fails, tmp_path, args, message):
    (tmp_path / "file").touch()
    assert message in fails("bench", *TINY, *OURS, *args)
