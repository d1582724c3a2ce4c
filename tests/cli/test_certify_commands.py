"""Proofs and certificates from the command line, and the tables that come with the package."""

import json

import numpy as np
import pytest

from maxcon.datasets import synthetic_two_view
from maxcon.datasets.synthetic import synthetic_hyperplane


@pytest.mark.parametrize(("table", "threshold", "inliers"), [("belgian_calls", 0.2, 16), ("cyg_ob1", 0.5, 38)])
def test_the_tables_of_the_package_are_certified(run, table, threshold, inliers):
    fitted = run("fit", table, "--model", "line", "--threshold", threshold, "--certificate", "c.json")
    assert fitted.exit_code == 0, fitted.output
    assert "proven optimal" in fitted.stdout
    assert f"wrote c.json: proves that no model has more than {inliers} inliers" in fitted.stdout
    verified = run("verify", "c.json", table)
    assert verified.exit_code == 0
    assert "accepted" in verified.stdout
    assert f"no model has more than {inliers} inliers: proven by the file" in verified.stdout


def test_a_tampered_or_mismatched_certificate_is_refused(run, tmp_path):
    run("fit", "cyg_ob1", "--model", "line", "--threshold", 0.5, "--certificate", "c.json")
    mismatched = run("verify", "c.json", "belgian_calls")
    assert mismatched.exit_code == 1
    assert "it is about other data" in mismatched.stdout
    text = (tmp_path / "c.json").read_text()
    assert text.count('"upper_bound":38') == 1
    (tmp_path / "c.json").write_text(text.replace('"upper_bound":38', '"upper_bound":37'))
    tampered = run("verify", "c.json", "cyg_ob1")
    assert tampered.exit_code == 1
    assert "refused" in tampered.stdout


def test_certify_proves_what_another_method_found(run, points):
    args = ("fit", points, "--model", "line", "--threshold", 0.06, "--method", "ransac")
    assert "proof     none: nothing is proven" in run(*args).stdout
    assert "proven optimal" in run(*args, "--certify").stdout


def test_a_bound_within_the_time(run, tmp_path):
    problem = synthetic_hyperplane(np.random.default_rng(0), 100, 0.5, 8)
    np.save(tmp_path / "h.npy", np.column_stack([problem.A[:, :-1], problem.b]))
    args = ("fit", "h.npy", "--model", "hyperplane", "--threshold", 0.1, "--certify", "--time-limit", 0.5)
    result = run(*args, "--json", "h.json")
    assert result.exit_code == 0
    assert "no model has more than" in result.stdout
    record = json.loads((tmp_path / "h.json").read_text())
    assert record["status"] == "bounded"
    assert 50 <= record["n_inliers"] < record["upper_bound"] < 100


def test_a_pair_is_certified_with_its_rows(run, tmp_path):
    scipy_io = pytest.importorskip("scipy.io")
    scene = synthetic_two_view(50, 0.1, np.random.default_rng(0), noise=0.3)
    X1, X2 = (np.column_stack([x, np.ones(50)]).T for x in (scene.x1, scene.x2))
    scipy_io.savemat(tmp_path / "pair.mat", {"data": {"matches": {"X1": X1, "X2": X2}}})
    made = run("fit-pair", "pair.mat", "--threshold", 0.02, "--certificate", "c.json", "--rows", "rows.npy")
    assert made.exit_code == 0, made.output
    assert "wrote c.json" in made.stdout
    assert np.load(tmp_path / "rows.npy").shape == (50, 9)
    verified = run("verify", "c.json", "rows.npy")
    assert verified.exit_code == 0, verified.output
    assert "accepted" in verified.stdout


def test_outputs_are_checked_first(fails, points):
    args = ("fit", points, "--model", "line", "--threshold", 0.06)
    assert "--certificate must be a file" in fails(*args, "--certificate", "-")
    assert "--certificate: there is no folder" in fails(*args, "--certificate", "none/c.json")
    assert "--rows must end in .npy" in fails("fit-pair", "pair.mat", "--rows", "rows.csv")
