import json
from pathlib import Path

import numpy as np
import pytest

import maxcon
from maxcon.cli.alternatives import rows
from maxcon.datasets.classic import load_table
from maxcon.search.alternatives import alternative_optima
from maxcon.search.anytime import Step


@pytest.fixture
def stars(tmp_path):
    table = load_table("cyg_ob1")
    path = tmp_path / "stars.csv"
    np.savetxt(path, np.column_stack([table.x, table.y]), delimiter=",", header="heat,light", comments="", fmt="%.17g")
    return path


def test_two_sets(run, stars):
    result = run("alternatives", stars, "--model", "line", "--threshold", 0.6)
    assert result.exit_code == 0, result.output
    lines = [" ".join(line.split()) for line in result.stdout.splitlines()]
    assert lines[0] == f"line through {stars}, threshold 0.6"
    assert "consensus 40 of 47 (85.1%), proven to be the largest" in lines
    assert "sets 2, no others" in lines
    assert "in all 39 points" in lines
    assert "in none 6 points: rows 9, 11, 18, 20, 30, 34" in lines
    assert "varying 2 points: rows 7, 17" in lines
    assert "1 light = 2.9231 * heat - 7.9396 0.56038 row 17" in lines
    assert "2 light = 1.5593 * heat - 1.905 0.5672 row 7" in lines


def test_one_set(run, points):
    result = run("alternatives", points, "--model", "line", "--threshold", 0.06)
    lines = [" ".join(line.split()) for line in result.stdout.splitlines()]
    assert "sets one only" in lines
    assert "in none 8 points: rows 1, 6, 11, 16, 21, 26, 31, 36" in lines
    assert "varying 0 points" in lines
    assert not any(line.startswith("unknown") for line in lines)


def test_json_and_limit(run, stars):
    table = load_table("cyg_ob1")
    expected = alternative_optima(maxcon.line(table.x, table.y), 0.2)
    assert expected.n_found > 10
    args = ("alternatives", stars, "--model", "line", "--threshold", 0.2)
    record = json.loads(run(*args, "--json", "-").stdout)
    assert record["masks"] == expected.masks.tolist()
    assert record["in_all"] == expected.in_all.tolist()
    assert (record["complete"], record["n_inliers"], record["family"]) == (True, expected.n_inliers, "line")
    result = run(*args)
    assert f"({expected.n_found - 10} more; --json lists them)" in result.stdout
    few = run(*args, "--limit", 3, "--json", "a.json")
    assert "3 found, there may be more (--limit ended the list)" in few.stdout
    assert "wrote a.json" in few.stdout
    with open("a.json", encoding="utf-8") as file:
        record = json.load(file)
    assert (len(record["masks"]), record["complete"]) == (3, False)
    assert record["in_all"] == expected.in_all.tolist()


def test_no_model(run, tmp_path):
    np.savetxt(tmp_path / "p.csv", [[0.0, 1.0], [0.0, 1.0], [0.0, 1.0]], delimiter=",")
    assert "one only" in run("alternatives", "p.csv", "--model", "line", "--threshold", 0.1).stdout


def test_more_parameters(run, tmp_path):
    rng = np.random.default_rng(0)
    X = rng.uniform(-1, 1, (30, 5))
    X[:25, 4] = X[:25, :4].sum(axis=1) + rng.uniform(-0.1, 0.1, 25)
    X[25:, 4] += 8.0
    np.save(tmp_path / "p.npy", X)
    result = run("alternatives", "p.npy", "--model", "hyperplane", "--threshold", 0.1)
    assert "25 of 30 (83.3%), proven to be the largest" in result.stdout
    assert "in none    5 points: rows 26-30" in result.stdout


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--threshold", 0), "threshold must be a positive finite number"),
        (("--threshold", 1, "--limit", 0), "Invalid value for '--limit'"),
        (("--threshold", 1, "--time-limit", 0), "time_limit must be a positive number"),
        (("--threshold", 1, "--columns", "dose,dosis"), "has no column 'dosis'"),
        (("--threshold", 1, "--json", "none/a.json"), "--json: there is no folder"),
        ((), "Missing option '--threshold'"),
    ],
)
def test_errors(fails, points, args, message):
    assert message in fails("alternatives", points, "--model", "line", *args)


def test_without_a_proof(run, points, monkeypatch):
    def slow(_task):
        yield Step(subset=np.isin(np.arange(40), [1, 2]))

    monkeypatch.setattr("maxcon.search.alternatives.exact", slow)
    result = run("alternatives", points, "--model", "line", "--threshold", 0.06, "--json", "all.json")
    assert result.exit_code == 0, result.output
    assert "32 of 40 (80.0%), not proven to be the largest: at most 40 are possible" in result.stdout
    assert "sets       not looked for" in result.stdout
    assert "unknown    40 points: not settled in time" in result.stdout
    record = json.loads(Path("all.json").read_text(encoding="utf-8"))
    assert (record["n_inliers"], record["upper_bound"]) == (32, 40)
    assert (record["proven"], record["complete"]) == (False, False)


def test_rows():
    assert rows(np.zeros(3, dtype=bool)) == "0 points"
    assert rows(np.array([False, True])) == "1 point: row 2"
    assert rows(np.array([True, True, True])) == "3 points: rows 1-3"
    assert rows(np.ones(50, dtype=bool)) == "50 points"
