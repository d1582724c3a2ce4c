import json
import os
import signal
import sys
import threading
import time
from contextlib import suppress
from types import ModuleType

import numpy as np
import pytest
import scipy.optimize

import maxcon
from maxcon.certification import issue, save
from maxcon.certification.certificate import dumps
from maxcon.search.anytime import make_task
from maxcon.search.witness import make_witness
from maxcon.waiting import solver_at_work


@pytest.fixture
def certificate(points, tmp_path):
    """The certificate of a line through `points`, in the folder in which commands are run."""
    table = np.loadtxt(points, delimiter=",", skiprows=1)
    problem = maxcon.line(table[:, 0], table[:, 1])
    consensus = maxcon.fit(problem, 0.06)
    witness = make_witness(make_task(problem, 0.06, np.random.default_rng(0)), consensus.inlier_mask)
    made = issue(problem, consensus, witness)
    save(made, tmp_path / "cert.json")
    save(issue(problem, consensus), tmp_path / "bare.json")
    return made


@pytest.mark.usefixtures("certificate")
def test_a_good_certificate(run, points):
    result = run("verify", "cert.json", points)
    assert result.exit_code == 0, result.output
    for text in (
        "accepted",
        "32 of 40, recounted",
        "no model has more than 32 inliers: proven by the file",
        "line, threshold",
    ):
        assert text in result.stdout
    result = run("verify", "cert.json", points, "--rerun", "--model", "line", "--threshold", 0.06)
    assert result.exit_code == 0, result.output
    assert "proven by the file and by another solver (sweep" in result.stdout


@pytest.mark.usefixtures("certificate")
def test_a_claim_that_the_file_does_not_prove(run, points):
    result = run("verify", "bare.json", points)
    assert result.exit_code == 3, result.output
    assert "no model has more than 40 inliers" in result.stdout
    assert "not proven by the file (--rerun tries to prove it by another solver)" in result.stdout
    assert "proven by another solver" in run("verify", "bare.json", points, "--rerun").stdout
    assert (
        "nor by the rerun: the time limit" in run("verify", "bare.json", points, "--rerun", "--time-limit", 1e-9).stdout
    )


def test_a_tampered_certificate(run, points, tmp_path, certificate):
    (tmp_path / "bad.json").write_bytes(dumps(certificate).replace(b'"n_inliers":32', b'"n_inliers":33'))
    result = run("verify", "bad.json", points)
    assert result.exit_code == 1
    assert "refused" in result.stdout
    assert "changed since it was written" in result.stdout


@pytest.mark.usefixtures("certificate")
def test_other_data_and_another_threshold(run, points):
    result = run("verify", "cert.json", points, "--columns", "2,1")
    assert result.exit_code == 1
    assert "other data" in result.stdout
    result = run("verify", "cert.json", points, "--threshold", 0.1)
    assert result.exit_code == 1
    assert "0.06, not 0.1" in result.stdout


@pytest.mark.usefixtures("certificate")
def test_json(run, points):
    record = json.loads(run("verify", "cert.json", points, "--rerun", "--json", "-").stdout)
    assert record["accepted"] is True
    assert (record["n_inliers"], record["bound"], record["claimed_bound"], record["proven_bound"]) == (32, 32, 32, 32)
    assert record["rerun"]["status"] == "confirmed"
    result = run("verify", "cert.json", points, "--columns", "2,1", "--json", "out.json")
    assert result.exit_code == 1
    assert "refused" in result.stdout


def test_a_linear_model(run, tmp_path):
    rng = np.random.default_rng(0)
    A = rng.standard_normal((20, 2))
    b = A @ [1.0, 2.0]
    b[:3] += 5
    np.save(tmp_path / "d.npy", np.column_stack([A, b]))
    problem = maxcon.LinearProblem(A, b)
    save(issue(problem, maxcon.fit(problem, 0.1)), tmp_path / "c.json")
    assert run("verify", "c.json", "d.npy", "--rerun").exit_code == 0


def test_what_cannot_be_read(fails, run, points, tmp_path):
    assert "there is no file 'none.json'" in fails("verify", "none.json", points)
    (tmp_path / "text.json").write_text("hello")
    result = run("verify", "text.json", points)
    assert result.exit_code == 1
    assert "no certificate" in result.stdout


@pytest.mark.usefixtures("certificate")
def test_data_that_cannot_be_read(fails):
    assert "there is no file 'none.csv'" in fails("verify", "cert.json", "none.csv")


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
def test_ctrl_c_ends_a_rerun(run, tmp_path, monkeypatch):
    """HiGHS does not look up, here for ten seconds: what is known without it is shown at once."""
    rng = np.random.default_rng(0)
    X = rng.standard_normal((40, 3))
    X[:30, 2] = X[:30, :2].sum(axis=1) + rng.uniform(-0.1, 0.1, 30)
    np.save(tmp_path / "p.npy", X)
    consensus = maxcon.fit(maxcon.hyperplane(X[:, :2], X[:, 2]), 0.1)
    save(issue(consensus.problem, consensus), tmp_path / "bare.json")
    done = threading.Event()

    def solver(*_args, **_options):
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        done.wait(10)

    at_exit, ended = [], []
    monkeypatch.setattr("scipy.optimize.milp", solver)
    monkeypatch.setattr("atexit.register", at_exit.append)
    monkeypatch.setattr("os._exit", ended.append)
    began = time.monotonic()
    result = run("verify", "bare.json", "p.npy", "--rerun")
    assert time.monotonic() - began < 9
    (leave,) = at_exit
    leave()
    assert ended == [130]  # at once: HiGHS ending in the middle of the interpreter's end would abort the process
    done.set()
    while solver_at_work():
        time.sleep(0.01)
    leave()
    assert ended == [130]  # nobody is at work: the usual end
    assert result.exit_code == 130
    assert "accepted" in result.stdout
    assert "not proven by the file (nor by the rerun: stopped by Ctrl-C)" in " ".join(result.stdout.split())


@pytest.mark.usefixtures("certificate")
@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
def test_ctrl_c_while_the_solver_is_loaded(run, points, monkeypatch):
    """Extension modules swallow it, as this one does."""

    class Solvers(ModuleType):
        def __getattr__(self, name):
            with suppress(KeyboardInterrupt):
                signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
            return getattr(scipy.optimize, name)

    monkeypatch.setitem(sys.modules, "scipy.optimize", Solvers("scipy.optimize"))
    result = run("verify", "bare.json", points, "--rerun")
    assert result.exit_code == 130
    assert "interrupted" in result.stderr
    assert "claim" not in result.stdout


def test_a_header_of_numbers(run, tmp_path):
    rng = np.random.default_rng(0)
    table = rng.uniform(0, 1, (20, 2))
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="0,1", comments="", fmt="%.17g")
    assert (
        run("fit", "a.csv", "--header", "--model", "line", "--threshold", 0.1, "--certificate", "c.json").exit_code == 0
    )
    assert run("verify", "c.json", "a.csv", "--header").exit_code == 0
    assert run("verify", "c.json", "a.csv").exit_code == 1
