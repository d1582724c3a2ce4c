"""The checker: what is right is accepted, and nothing else, whatever the seal says."""

from __future__ import annotations

import itertools
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from certificates import certified, forge, solve

import maxcon
import oracles
from instances import BUILDERS, synthetic
from maxcon.certification import Group, issue, save, verify
from maxcon.certification.verify import follow


@pytest.fixture(scope="module")
def made():
    problem = maxcon.LinearProblem(*synthetic(np.random.default_rng(3), 60, 3, 0.3))
    consensus, certificate = certified(problem, 0.1)
    return problem, consensus, certificate


def check(problem, certificate, **options):
    return verify(certificate, problem.A, problem.b, **options)


def test_a_good_certificate(made):
    problem, consensus, certificate = made
    report = check(problem, certificate, threshold=0.1)
    assert report.accepted, report.reason
    assert report.claim_confirmed
    assert report.n_inliers == consensus.n_inliers == report.bound == report.proven_bound == report.claimed_bound
    assert str(report).startswith("accepted: ")
    assert report.rerun is None


def test_a_weaker_witness_is_accepted_for_what_it_proves(made):
    problem, consensus, _ = made
    _, weak = certified(problem, 0.1, max_bases=5)
    assert weak.upper_bound == consensus.n_inliers < weak.proven_bound < problem.n_points
    report = check(problem, weak)
    assert report.accepted
    assert not report.claim_confirmed
    assert report.bound == weak.proven_bound
    assert "not proven by the file" in str(report)
    bare = check(problem, issue(problem, consensus))
    assert bare.accepted
    assert bare.bound == problem.n_points


def test_other_data(made):
    problem, _, certificate = made
    A, b = problem.A.copy(), problem.b.copy()
    b[17] = np.nextafter(b[17], 2)
    assert "SHA-256" in verify(certificate, A, b).reason
    assert "SHA-256" in verify(certificate, A[::-1], problem.b[::-1]).reason
    report = verify(certificate, A[:-1], b[:-1])
    assert not report.accepted
    assert "60 points and 3 parameters" in report.reason
    assert report.bound == report.n_points
    assert str(report).startswith("refused: it is about other data")


def test_another_threshold(made):
    problem, _, certificate = made
    report = check(problem, certificate, threshold=0.2)
    assert not report.accepted
    assert "0.1, not 0.2" in report.reason


def _flip(record, place):
    bits = bytearray(bytes.fromhex(record["inliers"]))
    bits[place // 8] ^= 128 >> (place % 8)
    record["inliers"] = bits.hex()


def _add_inlier(record):
    place = next(k for k in range(60) if not bytes.fromhex(record["inliers"])[k // 8] & (128 >> (k % 8)))
    _flip(record, place)
    record["n_inliers"] += 1
    record["upper_bound"] += 1


def _drop_inlier(record):
    place = next(k for k in range(60) if bytes.fromhex(record["inliers"])[k // 8] & (128 >> (k % 8)))
    _flip(record, place)
    record["n_inliers"] -= 1


def _need_more(record):
    record["groups"][0]["needed"] += 1
    record["proven_bound"] -= 1


def _twice(record):
    record["groups"].append(record["groups"][0])
    record["proven_bound"] -= record["groups"][0]["needed"]


def _harmless_basis(record):
    inliers = np.flatnonzero(np.unpackbits(np.frombuffer(bytes.fromhex(record["inliers"]), np.uint8)))
    taken = {p for group in record["groups"] for basis in group["bases"] for p in basis}
    harmless = [int(p) for p in inliers if p not in taken][:4] or [int(p) for p in inliers[:4]]
    record["groups"].append({"needed": 1, "bases": [harmless], "proof": [1, 0]})
    record["proven_bound"] -= 1


FORGERIES = {
    "model": (lambda record: record["model"].__setitem__(0, record["model"][0] + 0.05), "its model has"),
    "no model": (lambda record: record.update(model=None), "has no model"),
    "one inlier more": (_add_inlier, "is not within the threshold"),
    "one inlier less": (_drop_inlier, "is within the threshold"),
    "count": (lambda record: record.update(n_inliers=record["n_inliers"] - 1), "but it marks"),
    "threshold": (lambda record: record.update(threshold=0.3), "do not exclude each other|its model has"),
    "claim below the inliers": (
        lambda record: record.update(upper_bound=record["n_inliers"] - 1),
        "are more than a bound",
    ),
    "more needed": (_need_more, "does not follow"),
    "a group twice": (_twice, "which must share none"),
    "points that agree": (_harmless_basis, "do not exclude each other|which must share none"),
    "proof cut off": (lambda record: record["groups"][0]["proof"].pop(), "does not follow"),
    "proof too long": (lambda record: record["groups"][0]["proof"].append(0), "does not follow"),
    "no proof": (lambda record: record["groups"][0].update(proof=[]), "ends too early"),
    "a missing basis": (lambda record: record["groups"][0]["bases"].pop(), "does not follow"),
    "digest": (lambda record: record["data"].update(sha256="0" * 64), "other data"),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forgery_is_refused_with_the_reason(made, name):
    problem, _, certificate = made
    change, reason = FORGERIES[name]
    report = check(problem, forge(certificate, change))
    assert not report.accepted
    assert report.reason
    assert any(part in report.reason for part in reason.split("|")), report.reason


def test_no_change_of_a_basis_or_a_proof_makes_a_wrong_bound(made):
    """Whatever is changed: what is accepted is true."""
    problem, consensus, certificate = made
    rng = np.random.default_rng(0)
    accepted = 0
    for _ in range(400):

        def change(record):
            group = record["groups"][rng.integers(len(record["groups"]))]
            for _ in range(rng.integers(1, 3)):
                what = rng.integers(4)
                if what == 0:
                    basis = group["bases"][rng.integers(len(group["bases"]))]
                    point = int(rng.integers(60))
                    if point not in basis:
                        basis[rng.integers(len(basis))] = point
                elif what == 1:
                    group["proof"][rng.integers(len(group["proof"]))] = int(rng.integers(8))
                elif what == 2:
                    del group["proof"][rng.integers(len(group["proof"]))]
                else:
                    group["needed"] = max(1, group["needed"] + int(rng.choice([-1, 1])))
            record["proven_bound"] = 60 - sum(each["needed"] for each in record["groups"])

        report = check(problem, forge(certificate, change))
        accepted += report.accepted
        assert not report.accepted or report.bound >= consensus.n_inliers
    assert accepted < 200


def hitting_number(bases):
    """The fewest points that hit all bases, by trying all sets."""
    points = sorted({point for basis in bases for point in basis})
    for size in range(len(points) + 1):
        for chosen in itertools.combinations(points, size):
            if all(not set(basis).isdisjoint(chosen) for basis in bases):
                return size
    raise AssertionError("an empty basis")


def proof_of(bases, needed):
    """A proof that fewer than `needed` points do not hit all bases, as plain as can be; None if they do."""
    proof = []

    def node(out, kept, budget):
        missed = [k for k, basis in enumerate(bases) if out.isdisjoint(basis)]
        dead = [k for k in missed if kept.issuperset(bases[k])]
        if dead:
            proof.extend([1, dead[0]])
            return True
        if not missed:
            return False
        if budget == 0:
            proof.extend([1, missed[0]])
            return True
        proof.extend([0, missed[0]])
        for point in bases[missed[0]]:
            if point not in kept:
                if not node(out | {point}, kept, budget - 1):
                    return False
                kept = kept | {point}
        return True

    return tuple(proof) if node(set(), set(), needed - 1) else None


def test_following_a_proof_against_all_hitting_sets():
    rng = np.random.default_rng(2)
    followed = 0
    for _ in range(150):
        bases = tuple(
            tuple(rng.choice(8, rng.integers(1, 5), replace=False).tolist()) for _ in range(rng.integers(1, 12))
        )
        number = hitting_number(bases)
        proof = proof_of(bases, number)
        assert proof is not None
        assert follow(Group(number, bases, proof)) == ""
        assert proof_of(bases, number + 1) is None
        assert follow(Group(number + 1, bases, proof)) != ""
        for _ in range(60):  # damaged proofs prove nothing that is not so
            damaged = list(proof)
            for _ in range(rng.integers(1, 4)):
                damaged[rng.integers(len(damaged))] = int(rng.integers(len(bases) + 1))
            needed = number + int(rng.integers(0, 3))
            if follow(Group(needed, bases, tuple(damaged))) == "":
                followed += 1
                assert needed <= number
    assert followed > 10


@pytest.mark.parametrize("builder", sorted(BUILDERS))
def test_what_is_issued_is_accepted_and_true(builder):
    for seed, d in enumerate((1, 2, 3)):
        rng = np.random.default_rng(seed)
        A, b = BUILDERS[builder](rng, 11, d)
        for share in (0.0, 0.3):
            threshold = max(float(np.quantile(np.abs(b), share)) * 0.5, 1e-3 * float(np.abs(b).max()), 1e-6)
            problem = maxcon.LinearProblem(A, b)
            _, certificate = certified(problem, threshold)
            report = check(problem, certificate)
            assert report.accepted, report.reason
            if len(b) <= 14:
                assert report.proven_bound >= oracles.brute_force_consensus(A, b, threshold)


def test_where_no_model_explains_any_point():
    problem = maxcon.LinearProblem(np.zeros((4, 2)), np.array([1.0, -2.0, 3.0, 4.0]))
    consensus, certificate = certified(problem, 0.5)
    assert consensus.status == "infeasible"
    report = check(problem, certificate)
    assert report.accepted, report.reason
    assert report.bound == 0


def test_bases_that_hold_only_up_to_rounding_are_not_claimed():
    rng = np.random.default_rng(0)
    x = rng.standard_normal(30)
    A = np.column_stack([x, 0.1 * x, np.ones(30)])  # of rank 3 to the letter, of rank 2 to any engine
    b = x + rng.uniform(-0.05, 0.05, 30)
    b[:8] += 3.0
    problem = maxcon.LinearProblem(A, b)
    consensus, certificate = certified(problem, 0.1)
    assert consensus.n_inliers == 22
    report = check(problem, certificate)
    assert report.accepted, report.reason
    assert report.proven_bound >= 22


def test_more_inliers_than_the_bound_are_no_certificate(made):
    problem, consensus, _ = made
    with pytest.raises(ArithmeticError, match="more than the upper bound"):
        issue(problem, replace(consensus, upper_bound=consensus.n_inliers - 1))


def test_a_witness_can_prove_what_the_search_did_not():
    problem = maxcon.LinearProblem(*synthetic(np.random.default_rng(0), 60, 8, 0.1))
    consensus, certificate = certified(problem, 0.1)
    assert solve(problem, 0.1).status == "heuristic"
    assert certificate.upper_bound == certificate.proven_bound == consensus.n_inliers
    assert certificate.method == "witness"
    assert check(problem, certificate).claim_confirmed


def test_the_checker_imports_nothing_of_the_search(made, tmp_path):
    problem, _, certificate = made
    save(certificate, tmp_path / "c.json")
    np.savez(tmp_path / "d.npz", A=problem.A, b=problem.b)
    code = """if True:
        import sys
        import numpy as np
        from maxcon.certification import load, verify
        data = np.load("d.npz")
        report = verify(load("c.json"), data["A"], data["b"])
        assert report.accepted
        foreign = ("maxcon.search", "maxcon.minimax", "maxcon.tree", "maxcon.fit", "maxcon.problem", "scipy", "numba")
        print([name for name in sys.modules if name.startswith(foreign)])
    """
    answer = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert answer.stdout == "[]\n"
