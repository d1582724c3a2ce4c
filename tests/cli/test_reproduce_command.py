import json
import os
import signal
import subprocess
import sys
import time

import pytest

from maxcon.agent.shipped import agent_path
from maxcon.experiments.records import read_records

#: Of lines of the usual sizes, so small that it takes a second.
TINY = ("--quick", "--rates", "20", "--instances", 1, "--time-limit", 1, "--astar-time-limit", 0.05)
ALONE = (*TINY, "--backend", "sequential")


def records_of(folder, part):
    return read_records(folder / "records" / f"{part}.jsonl")


def test_line(run, tmp_path):
    result = run("reproduce", "line", *ALONE, "--out", "res")
    assert result.exit_code == 0, result.output
    assert "line: 2 instances, the paper's synthetic protocol" in result.stdout
    assert "line 1, auto: holds" in result.stdout
    rows = records_of(tmp_path / "res", "line")
    assert {each.unit for each in rows} == {"N=100, 20%, 0", "N=200, 20%, 0"}
    assert all(each.proven for each in rows)
    assert sorted(os.listdir("res/figures")) == ["line-100.png", "line-200.png"]
    settings = json.loads((tmp_path / "res/records/line.settings.json").read_text(encoding="utf-8"))
    limits = {each["name"]: each["time_limit"] for each in settings["contenders"]}
    assert (limits["exact"], limits["A*"]) == (1.0, 0.05)
    before = os.stat("res/records/line.jsonl").st_mtime_ns
    assert run("reproduce", "line", *ALONE, "--out", "res").exit_code == 0
    assert os.stat("res/records/line.jsonl").st_mtime_ns == before  # nothing was run twice


def test_all_on_two_processes_without_real_data(run, tmp_path, monkeypatch):
    monkeypatch.setenv("MAXCON_DATA", str(tmp_path / "nothing"))
    result = run("reproduce", "all", *TINY, "--jobs", 2, "--out", "res")
    assert result.exit_code == 0, result.output
    assert "modelnet: 1 instance, made scenes (ModelNet40 is not there)" in result.stdout
    assert "kitti: 2 instances, made pairs (KITTI is not there)" in result.stdout
    assert {"summary.md", "records", "figures"} <= set(os.listdir("res"))
    for part in ("line", "plane", "modelnet", "kitti", "trajectory"):
        assert records_of(tmp_path / "res", part)
    assert "kitti-matches.png" in os.listdir("res/figures")


def test_agents_of_ones_own(run, tmp_path):
    given = ("--weights", f"line-paper={agent_path('line')}")
    result = run("reproduce", "trajectory", *ALONE, *given, "--out", "res")
    assert result.exit_code == 0, result.output
    rows = {each.name: each for each in records_of(tmp_path / "res", "trajectory")}
    assert rows["paper's agent"].measures["path"] == rows["EdgeConv agent"].measures["path"]
    assert "not run" not in "".join(line for line in result.stdout.splitlines() if "paper's agent" in line)


def test_other_settings_in_the_folder(run, fails):
    assert run("reproduce", "trajectory", *ALONE, "--out", "res").exit_code == 0
    message = fails("reproduce", "trajectory", *ALONE, "--seed", 1, "--out", "res")
    assert "holds records of other settings (seed differ" in message


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("homography",), "Invalid value"),
        (("line", "--backend", "slurm"), "Invalid value for '--backend'"),
        (("line", "--scheduler", "tcp://a:1"), "--scheduler is for the backends dask and ray"),
        (("line", "--jobs", "0"), "Invalid value for '--jobs'"),
        (("line", "--instances", "0"), "Invalid value for '--instances'"),
        (("line", "--rates", "a"), "--rates: 'a' is not a rate"),
        (("line", "--time-limit", "0"), "--time-limit must be positive and finite, but it is 0"),
        (("line", "--time-limit", "nan"), "--time-limit must be positive and finite"),
        (("line", "--astar-time-limit", "-1"), "--astar-time-limit must be positive"),
        (("line", "--ransac-time", "inf"), "--ransac-time must be positive and finite"),
        (("line", "--weights", "x=y"), "--weights must be AGENT=FILE with AGENT one of line, line-paper"),
        (("line", "--weights", "line"), "--weights must be AGENT=FILE"),
        (("line", "--weights", "line=none.st"), "there is no file 'none.st'"),
        (("line", "--weights", "PLANE"), "was trained for d = 3, not for line"),
        (("line", "--out", "file"), "'file' is a file, not a folder"),
        (("kitti", "--sequence", "99"), "the KITTI drive '99' is not at"),
    ],
)
def test_errors(fails, tmp_path, monkeypatch, args, message):
    monkeypatch.setenv("MAXCON_DATA", str(tmp_path / "nothing"))
    (tmp_path / "file").touch()
    assert message in fails("reproduce", *(f"line={agent_path('plane')}" if arg == "PLANE" else arg for arg in args))


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_a_cluster_that_is_not_there(run):
    dask = pytest.importorskip("dask", reason="needs Dask: pip install 'maxcon[dask]'")
    pytest.importorskip("distributed", reason="needs Dask: pip install 'maxcon[dask]'")
    with dask.config.set({"distributed.comm.timeouts.connect": 0.5}):
        args = ("--backend", "dask", "--scheduler", "tcp://127.0.0.1:9", "--out", "res")
        result = run("reproduce", "trajectory", *TINY, *args)
    assert result.exit_code == 2
    assert "--scheduler: no cluster answers at tcp://127.0.0.1:9" in result.stderr


def start(*args):
    code = f"from maxcon.cli import main; main(['reproduce', *{tuple(map(str, args))!r}])"
    return subprocess.Popen(
        [sys.executable, "-c", code],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,  # a group of its own, so that a signal reaches its workers as from a terminal
    )


def wait_for(path, n_lines, process):
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and process.poll() is None:
        if path.exists() and path.read_bytes().count(b"\n") >= n_lines:
            return
        time.sleep(0.005)
    raise AssertionError("the command made no records")


MANY = ("line", "--quick", "--rates", "30,40", "--instances", 12, "--astar-time-limit", 0.05)


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
@pytest.mark.parametrize(
    ("backend", "how"), [("loky", signal.SIGINT), ("sequential", signal.SIGINT), ("loky", signal.SIGKILL)]
)
def test_a_stopped_run_goes_on(run, tmp_path, backend, how):
    settings = (*MANY, "--backend", backend, "--out", "res")
    process = start(*settings)
    path = tmp_path / "res" / "records" / "line.jsonl"
    wait_for(path, 28, process)
    os.killpg(process.pid, how)
    _, stderr = process.communicate(timeout=60)
    if how == signal.SIGINT:
        assert process.returncode == 130, stderr
        assert "interrupted; the same command goes on from what is in res" in stderr
    kept = records_of(tmp_path / "res", "line")
    assert 2 <= len({each.unit for each in kept}) < 48
    # No fit that Ctrl-C cut short passes for a result: the optimum is proven everywhere.
    assert all(each.proven for each in kept)
    assert run("reproduce", *settings).exit_code == 0
    rows = records_of(tmp_path / "res", "line")
    assert rows[: len(kept)] == kept
    assert len({each.unit for each in rows}) == 48
    assert len({(each.unit, each.name) for each in rows}) == len(rows)
    assert len(path.read_text(encoding="utf-8").splitlines()) == len(rows)
