"""The file: what is written is read, and what was changed is not."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest
from certificates import certified

import maxcon
from instances import synthetic
from maxcon.certification import CertificateError, load, save
from maxcon.certification.certificate import SLACK, _seal, data_digest, dumps, inlier_limit, loads
from maxcon.problem import inlier_slack, tolerance


@pytest.fixture(scope="module")
def certificate():
    problem = maxcon.LinearProblem(*synthetic(np.random.default_rng(3), 40, 2, 0.3))
    return certified(problem, 0.1)[1]


def test_what_is_written_is_read(certificate, tmp_path):
    path = tmp_path / "a.json"
    save(certificate, path)
    read = load(path)
    for field in certificate.__dataclass_fields__:
        value, expected = getattr(read, field), getattr(certificate, field)
        assert np.array_equal(value, expected) if isinstance(expected, np.ndarray) else value == expected, field
    assert read.proven_bound == certificate.proven_bound
    assert dumps(read) == path.read_bytes() == dumps(certificate)
    assert len(path.read_bytes()) < 5_000
    save(certificate, path)  # over an old one
    assert os.listdir(tmp_path) == ["a.json"]


def test_an_old_file_stays_if_writing_fails(certificate, tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    path.write_bytes(b"old")
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError("full")))
    with pytest.raises(OSError, match="full"):
        save(certificate, path)
    assert os.listdir(tmp_path) == ["a.json"]
    assert path.read_bytes() == b"old"


def test_no_change_of_a_character_goes_unnoticed(certificate):
    content = dumps(certificate)
    for place in range(len(content)):
        for other in {b"1", b"a"} - {content[place : place + 1]}:
            changed = content[:place] + other + content[place + 1 :]
            try:
                read = loads(changed)
            except CertificateError:
                continue
            assert dumps(read) == content, changed[max(place - 20, 0) : place + 20]


def test_a_file_that_was_cut_off(certificate):
    content = dumps(certificate)
    for length in range(len(content.rstrip()) - 1):
        with pytest.raises(CertificateError):
            loads(content[:length])


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "cut off"),
        (b"\xff\xfe", "not JSON"),
        (b"[" * 100_000, "no certificate"),
        (b"3", 'does not say "format"'),
        (b'{"format":"maxcon certificate"}', "version None"),
        (b'{"format":"maxcon certificate","version":1}', "lacks data, threshold"),
        (b'{"format":NaN}', "NaN is not a number"),
    ],
)
def test_what_is_no_certificate(content, reason):
    with pytest.raises(CertificateError, match=reason):
        loads(content)


@pytest.mark.parametrize(
    ("path", "value", "reason"),
    [
        (("version",), 2, "only version 1 can be read"),
        (("more",), 1, "what no certificate has: more"),
        (("slack", "relative"), 1e-6, "its slack is"),
        (("threshold",), -1.0, "threshold must be positive"),
        (("threshold",), "0.1", "threshold must be a finite number"),
        (("model",), [1.0], "model must be a list of 2 numbers"),
        (("data", "n_points"), 0, "n_points must be a whole number at least 1"),
        (("inliers",), "zz", "hexadecimal"),
        (("inliers",), "ff", "a bit for each of 40 points"),
        (("n_inliers",), 41, "n_inliers must be a whole number from 0 to 40"),
        (("n_inliers",), True, "n_inliers must be a whole number"),
        (("proven_bound",), 27, "proven_bound is 27, but its groups need"),
        (("groups",), {}, "groups must be a list"),
        (("groups", 0, "needed"), 0, "needed of group 1"),
        (("groups", 0, "bases", 0), [0, 1, 2, 3], "1 to 3 points"),
        (("groups", 0, "bases", 0), [0, 0], "names a point twice"),
        (("groups", 0, "bases", 0), [40], "from 0 to 39"),
        (("groups", 0, "proof", 0), -1, "proof of group 1"),
    ],
)
def test_what_makes_no_sense_is_refused_even_if_it_is_sealed(certificate, path, value, reason):
    record = json.loads(dumps(certificate))
    place = record
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    del record["seal"]
    record["seal"] = _seal(record)
    with pytest.raises(CertificateError, match=reason):
        loads(json.dumps(record).encode())


def test_the_slack_is_that_of_the_package():
    assert {"relative": tolerance.RELATIVE_SLACK, "absolute": tolerance.ABSOLUTE_SLACK} == SLACK
    rng = np.random.default_rng(0)
    for threshold in rng.uniform(0, 1, 50):
        b = rng.standard_normal(7) * 10.0 ** rng.integers(-8, 8)
        assert inlier_limit(threshold, b) == threshold + inlier_slack(threshold, float(np.abs(b).max()))


def test_the_digest_is_of_the_numbers_and_their_order():
    A, b = synthetic(np.random.default_rng(0), 10, 3, 0.2)
    digest = data_digest(A, b)
    assert digest == data_digest(np.asfortranarray(A), b.astype(">f8"))
    swapped = A.copy()
    swapped[[0, 1]] = swapped[[1, 0]]
    nudged = b.copy()
    nudged[3] = np.nextafter(nudged[3], 1)
    for other in (data_digest(swapped, b), data_digest(A, nudged), data_digest(A.reshape(15, 2), b)):
        assert other != digest


def test_a_folder_that_is_not_there(tmp_path):
    problem = maxcon.line(np.arange(5.0), np.arange(5.0))
    with pytest.raises(FileNotFoundError, match="there is no such folder") as caught:
        maxcon.write_certificate(tmp_path / "none" / "c.json", maxcon.fit(problem, 0.1))
    assert caught.value.filename == str(tmp_path / "none")
