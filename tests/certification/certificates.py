"""Certificates for the tests, and ways to forge them."""

from __future__ import annotations

import json

import numpy as np

import maxcon
from maxcon.certification import issue
from maxcon.certification.certificate import _seal, dumps, loads
from maxcon.search.anytime import make_task
from maxcon.search.witness import make_witness


def solve(problem, threshold):
    """A result; proven where that is cheap."""
    method = "exact" if problem.n_params <= 3 else "peel"
    return maxcon.fit(problem, threshold, method=method)


def certified(problem, threshold, **options):
    """Return (consensus, certificate)."""
    consensus = solve(problem, threshold)
    task = make_task(problem, threshold, np.random.default_rng(0))
    mask = consensus.inlier_mask if consensus.n_inliers else np.ones(problem.n_points, dtype=bool)
    return consensus, issue(problem, consensus, make_witness(task, mask, **options))


def forge(certificate, change):
    """Return the certificate after `change(record)`, with the seal that belongs to its new content."""
    record = json.loads(dumps(certificate))
    change(record)
    del record["seal"]
    record["seal"] = _seal(record)
    return loads(json.dumps(record).encode())
