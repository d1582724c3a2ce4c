import json
import signal
import threading
import time

import numpy as np
import pytest

import maxcon
from maxcon.search.threshold_curve import consensus_curve


def problem_of(points):
    table = np.loadtxt(points, delimiter=",", skiprows=1)
    return maxcon.line(table[:, 0], table[:, 1])


def test_table(run, points):
    result = run("curve", points, "--model", "line")
    assert result.exit_code == 0, result.output
    curve = consensus_curve(problem_of(points))
    lines = result.stdout.splitlines()
    assert lines[0] == f"line through {points}"
    assert "proven: no model does better at any of these thresholds" in result.stdout
    assert "(40 breakpoints in all; --json lists them)" in result.stdout
    (knee,) = (line.split() for line in lines if line.rstrip().endswith("knee"))
    assert knee[:2] == ["32", "80%"]
    assert knee[2] == f"{curve.thresholds[31]:.5g}"
    assert any(line.split() == ["40", "100%", f"{curve.thresholds[39]:.5g}"] for line in lines)
    assert any(line.split()[2:3] == ["0"] for line in lines)  # two points, exactly but for rounding


def test_json(run, points):
    record = json.loads(run("curve", points, "--model", "line", "--from", 0.01, "--to", 2, "--json", "-").stdout)
    curve = consensus_curve(problem_of(points), (0.01, 2.0))
    assert record["thresholds"] == curve.thresholds.tolist()
    assert record["counts"] == curve.counts.tolist()
    assert record["models"] == curve.models.tolist()
    assert record["knees"] == curve.knees().tolist()
    assert (record["low"], record["high"], record["complete"], record["n_points"]) == (0.01, 2.0, True, 40)
    assert (record["family"], record["columns"]) == ("line", ["dose", "effect"])
    record = json.loads(run("curve", points, "--model", "line", "--json", "-").stdout)
    assert record["high"] is None
    assert len(record["counts"]) == 40


def test_range(run, points):
    result = run("curve", points, "--model", "line", "--from", 0.06, "--to", 0.9)
    assert "within 0.06  32" in result.stdout
    assert run("curve", points, "--model", "line", "--from", 0.06, "--to", 0.0601).exit_code == 0


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_plot(run, points, tmp_path, suffix):
    result = run("curve", points, "--model", "line", "--plot", f"a.{suffix}")
    assert f"wrote a.{suffix}" in result.stdout
    magic = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}[suffix]
    assert (tmp_path / f"a.{suffix}").read_bytes().startswith(magic)


def test_picture_on_standard_output(run, points):
    assert run("curve", points, "--model", "line", "--plot", "-").stdout_bytes.startswith(b"\x89PNG")


def test_not_all_proven(run, points):
    result = run("curve", points, "--model", "line", "--time-limit", 1e-6)
    assert result.exit_code == 0
    said = 'not all proven: more than "consensus" may be possible, up to "at most"'
    assert said in " ".join(result.stdout.split())
    assert any(line.split()[-1:] == ["most"] for line in result.stdout.splitlines())  # that column's head


def test_plane_and_hyperplane(run, tmp_path):
    X = np.random.default_rng(0).uniform(-1, 1, (12, 3))
    np.save(tmp_path / "p.npy", X)
    plane = json.loads(run("curve", "p.npy", "--model", "plane", "--json", "-").stdout)
    hyperplane = json.loads(run("curve", "p.npy", "--model", "hyperplane", "--json", "-").stdout)
    assert plane["thresholds"] == hyperplane["thresholds"]
    assert plane["complete"]


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--from", 2, "--to", 1), "--from must be less than --to, but they are 2 and 1"),
        (("--from", -1), "'--from': -1.0 is not in the range x>=0"),
        (("--time-limit", 0), "time_limit must be a positive number"),
        (("--columns", "dose,dosis"), "has no column 'dosis'"),
        (("--json", "-", "--plot", "-"), "cannot both go to standard output"),
        (("--plot", "a.jpg"), "--plot must end in .png, .svg or .pdf"),
        (("--json", "none/a.json"), "--json: there is no folder"),
    ],
)
def test_errors(fails, points, args, message):
    assert message in fails("curve", points, "--model", "line", *args)


def test_too_many_parameters(fails, tmp_path):
    np.save(tmp_path / "p.npy", np.random.default_rng(0).uniform(-1, 1, (12, 4)))
    assert "at most 3 independent parameters" in fails("curve", "p.npy", "--model", "hyperplane")


def test_progress_where_there_is_no_terminal(run, points, monkeypatch):
    monkeypatch.setattr("maxcon.cli.curve.SILENCE", 0.0)
    lines = run("curve", points, "--model", "line").stderr.splitlines()
    lines = [line for line in lines if line.startswith("searching: ")]
    done = [int(line.split()[1]) for line in lines]
    assert done == sorted(done)
    assert lines[-1].startswith(f"searching: {done[-1]} of 40 breakpoints proven, ")
    assert done[-1] == 40
    monkeypatch.setattr("maxcon.cli.curve.SILENCE", 1e9)
    assert "searching" not in run("curve", points, "--model", "line").stderr


def test_the_help_says_how_long_it_takes(run):
    text = " ".join(run("curve", "--help").stdout.split())
    assert "Lines take milliseconds. Planes of hundreds of points take minutes" in text


def test_ctrl_c_shows_what_is_known(run, points, monkeypatch):
    def slow(_task):
        threading.Timer(0.05, signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT)).start()
        time.sleep(20)
        yield

    monkeypatch.setattr("maxcon.search.threshold_curve.prove", slow)
    result = run("curve", points, "--model", "line")
    assert result.exit_code == 130
    assert "stopped by Ctrl-C" in result.stdout
    assert "not all proven" in result.stdout
