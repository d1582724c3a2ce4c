import builtins
import dataclasses
import json
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

import maxcon
from maxcon.cli.fit import parse_options
from maxcon.cli.present import equation, plain, runs_of
from maxcon.search.anytime import Step

OUTLIERS = "rows 1, 6, 11, 16, 21, 26, 31, 36"


def test_line(run, points):
    result = run("fit", points, "--model", "line", "--threshold", 0.06)
    assert result.exit_code == 0, result.output
    for text in ("32 of 40 (80.0%)", "proven optimal", "effect = ", " * dose - ", OUTLIERS):
        assert text in result.stdout


def test_nothing_is_proven_where_nothing_is(run, points):
    result = run("fit", points, "--model", "line", "--threshold", 0.06, "--method", "greedy", "--refine", "tree")
    assert "proof     none" in result.stdout
    assert "greedy, then local tree refinement" in result.stdout


def test_json_holds_everything(run, points):
    result = run("fit", points, "--model", "line", "--threshold", 0.06, "--method", "greedy", "--json", "-")
    record = json.loads(result.stdout)
    table = np.loadtxt(points, delimiter=",", skiprows=1)
    expected = maxcon.fit(maxcon.line(table[:, 0], table[:, 1]), 0.06, method="greedy", rng=0)
    for field in dataclasses.fields(maxcon.Consensus):
        if field.name not in {"seconds", "problem"}:
            value = getattr(expected, field.name)
            assert record[field.name] == (value.tolist() if isinstance(value, np.ndarray) else value), field.name
    assert 0 < record["seconds"] < 60
    assert record["parameters"] == {"slope": expected.model[0], "intercept": expected.model[1]}
    assert (record["file"], record["family"], record["columns"]) == (str(points), "line", ["dose", "effect"])
    assert set(record["path"]) == {0, 5, 10, 15, 20, 25, 30, 35}


def test_json_file_beside_the_table(run, points):
    result = run("fit", points, "--model", "line", "--threshold", 0.06, "--json", "out.json")
    assert "32 of 40" in result.stdout
    assert "wrote out.json" in result.stdout
    with open("out.json", encoding="utf-8") as file:
        assert json.load(file)["n_inliers"] == 32
    assert set(os.listdir()) == {"out.json", "points.csv"}


def test_plane_and_hyperplane_from_npy(run, tmp_path):
    rng = np.random.default_rng(0)
    X = rng.uniform(-1, 1, (30, 4))
    y = X @ [1.0, -2.0, 0.5, 3.0] + 4.0
    np.save(tmp_path / "p.npy", np.column_stack([X, y]))
    record = json.loads(run("fit", "p.npy", "--model", "hyperplane", "--threshold", 1e-6, "--json", "-").stdout)
    assert record["n_inliers"] == 30
    assert record["parameters"]["coef"] == pytest.approx([1.0, -2.0, 0.5, 3.0])
    assert record["parameters"]["intercept"] == pytest.approx(4.0)
    np.save(tmp_path / "q.npy", np.column_stack([X[:, :2], X[:, :2] @ [1.5, -1.0] + 0.25]))
    record = json.loads(run("fit", "q.npy", "--model", "plane", "--threshold", 1e-6, "--json", "-").stdout)
    assert record["parameters"] == pytest.approx({"p": 1.5, "q": -1.0, "intercept": 0.25})
    swapped = run("fit", "q.npy", "--model", "plane", "--columns", "2,1,3", "--threshold", 1e-6, "--json", "-")
    assert json.loads(swapped.stdout)["parameters"]["p"] == pytest.approx(-1.0)


def test_standard_input(run):
    result = run("fit", "-", "--model", "line", "--threshold", "0.1", "--json", "-", stdin=b"1 2\n2 4\n3 6\n4 0\n")
    record = json.loads(result.stdout)
    assert record["file"] == "standard input"
    assert record["inlier_mask"] == [True, True, True, False]


def test_picture_on_standard_output(run, points):
    result = run("fit", points, "--model", "line", "--threshold", 0.06, "--plot", "-", "--json", "out.json")
    assert result.stdout_bytes.startswith(b"\x89PNG")
    assert result.stdout_bytes.endswith(b"IEND\xaeB`\x82")
    assert os.path.exists("out.json")


def test_same_seed_same_answer(run, points):
    def path(seed):
        args = ("fit", points, "--model", "line", "--threshold", 0.06, "--method", "random", "--seed", seed)
        return json.loads(run(*args, "--json", "-").stdout)["path"]

    assert path(1) == path(1)
    assert path(1) != path(2)


def test_options_reach_the_method(run, points, monkeypatch):
    def method(task, *, word="a", number=1, anything=None):
        assert (word, number, anything) == ("b", 7, [1, 2])
        yield Step(subset=np.ones(40, dtype=bool))

    monkeypatch.setattr("maxcon.search.removal.greedy", method)
    options = [each for pair in ("word=b", "number=7", "anything=[1,2]") for each in ("--option", pair)]
    result = run("fit", points, "--model", "line", "--threshold", 9, "--method", "greedy", *options)
    assert result.exit_code == 0, result.output


def test_options_are_read_as_json_or_text():
    pairs = ("a=1", "b=2.5", "c=true", "d=null", "e=file.st", "f=x=y", "g=")
    assert parse_options(pairs) == {"a": 1, "b": 2.5, "c": True, "d": None, "e": "file.st", "f": "x=y", "g": ""}


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--threshold", 0), "threshold must be a positive finite number, but it is 0.0"),
        (("--threshold", "nan"), "threshold must be"),
        (("--threshold", "inf"), "threshold must be"),
        (("--method", "magic"), "method must be one of auto, agent,"),
        (("--time-limit", 0), "time_limit must be a positive number"),
        (("--option", "tries"), "--option must be KEY=VALUE, but it is 'tries'"),
        (("--option", "tries=3"), "unknown option 'tries' for method"),
        (("--method", "agent", "--option", "tries=x"), "--option tries must be a whole number, but it is 'x'"),
        (("--method", "agent", "--option", "tries=2.5"), "--option tries must be a whole number"),
        (("--method", "agent", "--option", "tries=0"), "tries must be a positive integer, but it is 0"),
        (("--method", "agent", "--option", "temperature=hot"), "--option temperature must be a number"),
        (("--method", "agent", "--option", "weights=none.st"), "there is no file 'none.st'"),
        (("--columns", "dose,dosis"), "has no column 'dosis'"),
        (("--json", "none/out.json"), "--json: there is no folder"),
        (("--plot", "none/out.png"), "--plot: there is no folder"),
        (("--plot", "out.jpg"), "--plot must end in .png, .svg or .pdf"),
        (("--json", "-", "--plot", "-"), "cannot both go to standard output"),
    ],
)
def test_errors(fails, points, args, message):
    given = () if "--threshold" in args else ("--threshold", 0.06)
    assert message in fails("fit", points, "--model", "line", *given, *args)
    assert os.listdir() == ["points.csv"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y\n1,2\n2,nan\n3,4\n4,5\n", "f.csv, line 3, column 2 (y): 'nan' is not a finite number"),
        ("1,2\n", "a line with 2 parameters needs at least 3 rows of data, but f.csv has 1"),
        ("1,2,3\n4,5,6\n", "a line takes 2 columns, the dependent one last, but f.csv has 3 columns"),
        ("", "f.csv holds no data"),
        (None, "there is no file 'f.csv'"),
    ],
)
def test_bad_files(fails, tmp_path, text, message):
    if text is not None:
        (tmp_path / "f.csv").write_text(text, encoding="utf-8")
    assert message in fails("fit", "f.csv", "--model", "line", "--threshold", 1)


def test_outputs_are_checked_before_the_fit(fails, points, monkeypatch):
    def never(*_, **__):
        raise AssertionError("the fit ran")

    monkeypatch.setattr("maxcon.cli.fit._fit", never)
    assert "there is no folder" in fails("fit", points, "--model", "line", "--threshold", 1, "--json", "no/out")


def test_without_matplotlib(fails, points, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name.partition(".")[0] == "matplotlib":
            raise ModuleNotFoundError("No module named 'matplotlib'")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    message = fails("fit", points, "--model", "line", "--threshold", 1, "--plot", "out.png")
    assert "pictures need matplotlib, which is not installed: pip install 'maxcon[plot]'" in message


def test_ctrl_c_shows_the_best_so_far(run, points, monkeypatch):
    def slow(_task):
        subset = np.zeros(40, dtype=bool)
        subset[1:3] = True
        yield Step(subset=subset)
        threading.Timer(0.05, signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT)).start()
        time.sleep(20)

    monkeypatch.setattr("maxcon.search.removal.greedy", slow)
    before = signal.getsignal(signal.SIGINT)
    result = run("fit", points, "--model", "line", "--threshold", 0.06, "--method", "greedy", "--json", "out.json")
    assert result.exit_code == 130
    assert "stopped by Ctrl-C" in result.stdout
    assert "32 of 40" in result.stdout  # refined from the two points
    assert os.path.exists("out.json")
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
def test_ctrl_c_ends_a_milp_at_once(tmp_path):
    """In a process of its own, whose end HiGHS, which would go on for a minute, neither delays nor breaks."""
    rng = np.random.default_rng(0)
    X = rng.uniform(-1, 1, (120, 9))
    X[:70, 8] = X[:70, :8].sum(axis=1) + rng.uniform(-0.1, 0.1, 70)
    np.save(tmp_path / "p.npy", X)
    code = """if True:
        import os, signal, sys, threading
        import scipy.optimize
        solve = scipy.optimize.milp
        def milp(*args, **options):
            threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
            return solve(*args, **options)
        scipy.optimize.milp = milp
        from maxcon.cli import main
        main(["fit", "p.npy", "--model", "hyperplane", "--threshold", "0.1", "--method", "milp", "--json", "out.json"])
    """
    process = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False
    )
    assert process.returncode == 130, process.stderr
    assert "stopped by Ctrl-C" in process.stdout
    assert "wrote out.json" in process.stdout
    record = json.loads((tmp_path / "out.json").read_text())
    assert record["n_inliers"] >= 60
    assert record["seconds"] < 30  # HiGHS has a minute


def test_many_outliers_are_only_counted(run, tmp_path):
    x = np.arange(100.0)
    y = np.where(x < 50, 0.0, np.random.default_rng(0).uniform(1.0, 9.0, 100))
    np.savetxt(tmp_path / "many.csv", np.column_stack([x, y]))
    result = run("fit", "many.csv", "--model", "line", "--threshold", 0.1)
    assert "50 rows (--json lists them)" in result.stdout


def test_equation():
    assert equation([2.0, -1.0], ["x", "y"]) == "y = 2 * x - 1"
    assert equation([-0.5, 1e-7, 3.0], ["a b", "q", "z"]) == "z = -0.5 * [a b] + 1e-07 * q + 3"
    assert equation([np.nan, np.nan], ["x", "y"]) == "none"


def test_runs():
    assert runs_of([]) == ""
    assert runs_of([3]) == "3"
    assert runs_of([1, 2, 4, 5, 6, 9]) == "1, 2, 4-6, 9"


def test_plain_knows_no_nan():
    value = {"a": np.array([1.0, np.nan]), "b": (np.float64(np.inf), np.int64(3), np.bool_(True)), "c": None}
    assert plain(value) == {"a": [1.0, None], "b": [None, 3, True], "c": None}
    json.dumps(plain(value), allow_nan=False)


def test_a_note_where_the_consensus_says_nothing(run, points):
    note = "so few inliers say nothing: 2 points nearly always have a model through them"
    assert note in run("fit", points, "--model", "line", "--threshold", 1e-9).stdout
    assert "\nnote " not in run("fit", points, "--model", "line", "--threshold", 0.06).stdout


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_a_note_where_the_inliers_leave_the_model_open(run, tmp_path, scale):
    rng = np.random.default_rng(0)
    table = np.column_stack([np.full(30, 3.0 * scale), rng.uniform(0, 1, 30)])
    np.savetxt(tmp_path / "one_x.csv", table, delimiter=",")
    text = run("fit", "one_x.csv", "--model", "line", "--threshold", 0.3).stdout
    assert "the inliers do not determine the model (rank 1 of 2)" in text
    table[0, 0] *= 2.0
    np.savetxt(tmp_path / "two_x.csv", table, delimiter=",")
    assert "\nnote " not in run("fit", "two_x.csv", "--model", "line", "--threshold", 0.6).stdout


def test_a_header_of_numbers(run, tmp_path):
    rng = np.random.default_rng(0)
    np.savetxt(tmp_path / "a.csv", rng.uniform(0, 1, (20, 2)), delimiter=",", header="0,1", comments="")
    args = ("fit", "a.csv", "--model", "line", "--threshold", 0.1)
    result = run(*args)
    assert " of 21 " in result.stdout
    assert "note: line 1 of a.csv (0, 1) is taken for data" in result.stderr
    for option, count in (("--header", 20), ("--no-header", 21)):
        result = run(*args, option)
        assert f" of {count} " in result.stdout
        assert result.stderr == ""
    for command in (("curve", "a.csv", "--model", "line"), ("alternatives", *args[1:])):
        assert " of 20 " in run(*command, "--header").stdout or "points  20" in run(*command, "--header").stdout
