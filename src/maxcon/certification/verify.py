"""The checker: recount the inliers, re-derive the bound; NumPy and the standard library, nothing of the search.

Everything that decides is exact: the data are floats, floats are rationals, and what a certificate says about
them is true or false.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maxcon.certification.certificate import Certificate, Group, data_digest, inlier_limit
from maxcon.certification.exact import ExactData, within
from maxcon.certification.rerun import Rerun, prove_again


class _Refused(Exception):  # noqa: N818  (carries the reason to the report)
    """What a certificate says is not so."""


@dataclass(frozen=True)
class VerificationReport:
    """What a check of a certificate came to.

    Attributes
    ----------
    accepted
        Everything that the certificate says and that was checked is so.
    reason
        Why it was refused; empty if accepted.
    n_points, n_inliers
        N, and how many inliers the model has.
    claimed_bound
        The upper bound that the certificate claims.
    proven_bound
        The upper bound that the file proves.
    n_groups, n_bases
        How large the proof is.
    rerun
        What came of proving the claim again; None if that was not asked for.
    seconds
        How long the check took.
    """

    accepted: bool
    reason: str
    n_points: int
    n_inliers: int
    claimed_bound: int
    proven_bound: int
    n_groups: int
    n_bases: int
    rerun: Rerun | None
    seconds: float

    @property
    def bound(self) -> int:
        """The best upper bound that this check stands for; N if the certificate was refused."""
        if not self.accepted:
            return self.n_points
        if self.rerun is not None and self.rerun.status == "confirmed":
            return min(self.proven_bound, self.claimed_bound)
        return self.proven_bound

    @property
    def claim_confirmed(self) -> bool:
        """Whether the claimed bound is proven, by the file or by the rerun."""
        return self.accepted and self.bound <= self.claimed_bound

    def __str__(self) -> str:
        if not self.accepted:
            return f"refused: {self.reason}"
        text = (
            f"accepted: {self.n_inliers} of {self.n_points} points are inliers, and no model has more than {self.bound}"
        )
        if not self.claim_confirmed:
            text += f" (a bound of {self.claimed_bound} is claimed, but not proven by the file)"
        return text


def verify(
    certificate: Certificate,
    A: ArrayLike,
    b: ArrayLike,
    *,
    threshold: float | None = None,
    rerun: bool = False,
    time_limit: float = 60.0,
) -> VerificationReport:
    """Check a certificate against the data that it is about.

    Parameters
    ----------
    certificate
        From `load`.
    A, b
        The data, shapes (N, d) and (N,).
    threshold
        The threshold that the certificate must be for; None to take it from the certificate.
    rerun
        Also prove the claimed bound again, by a solver that shares nothing with the search: a sweep for one
        and two parameters, otherwise a mixed-integer programme (HiGHS).
    time_limit
        Seconds for that.

    Returns
    -------
    VerificationReport
        Accepted, or refused with the reason.

    Notes
    -----
    A basis is refuted by the one linear combination of its rows that vanishes (`ExactData.least_maximum`), which
    is derived here from the points and the data. Proofs are followed step by step (`follow`). Groups that share
    no point add up.
    """
    began = time.perf_counter()
    rows = np.ascontiguousarray(A, dtype=np.float64)
    values = np.ascontiguousarray(b, dtype=np.float64)
    report = VerificationReport(
        accepted=True,
        reason="",
        n_points=certificate.n_points,
        n_inliers=certificate.n_inliers,
        claimed_bound=certificate.upper_bound,
        proven_bound=certificate.proven_bound,
        n_groups=len(certificate.groups),
        n_bases=sum(len(group.bases) for group in certificate.groups),
        rerun=None,
        seconds=0.0,
    )
    try:
        _check_subject(certificate, rows, values, threshold)
        limit = inlier_limit(certificate.threshold, values)
        _check_inliers(certificate, rows, values, limit)
        _check_groups(certificate.groups, ExactData(rows, values), limit)
        _check_bounds(certificate)
        if rerun:
            again = prove_again(rows, values, limit, certificate.upper_bound, time_limit)
            report = replace(report, rerun=again)
            if again.status == "refuted":
                raise _Refused(
                    f"a bound of {certificate.upper_bound} is claimed, but some model has {again.n_inliers} inliers"
                )
    except _Refused as refusal:
        report = replace(report, accepted=False, reason=str(refusal))
    return replace(report, seconds=time.perf_counter() - began)


def _check_subject(
    certificate: Certificate, A: NDArray[np.float64], b: NDArray[np.float64], threshold: float | None
) -> None:
    shape = (certificate.n_points, certificate.n_params)
    if A.shape != shape or b.shape != shape[:1]:
        raise _Refused(
            f"it is about other data: {shape[0]} points and {shape[1]} parameters, "
            f"but these have shapes {A.shape} and {b.shape}"
        )
    if not (np.isfinite(A).all() and np.isfinite(b).all()):
        raise _Refused("the data are not finite")
    if data_digest(A, b) != certificate.digest:
        raise _Refused("it is about other data: the SHA-256 of these is another one")
    if threshold is not None and threshold != certificate.threshold:
        raise _Refused(f"it is about the threshold {certificate.threshold!r}, not {threshold!r}")


def _check_inliers(certificate: Certificate, A: NDArray[np.float64], b: NDArray[np.float64], limit: float) -> None:
    claimed = int(np.count_nonzero(certificate.inlier_mask))
    if claimed != certificate.n_inliers:
        raise _Refused(f"it says {certificate.n_inliers} inliers, but it marks {claimed}")
    if not np.isfinite(certificate.model).all():
        if claimed > 0:
            raise _Refused(f"it marks {claimed} inliers, but has no model")
        return
    inliers = within(A, b, certificate.model, limit)
    differing = np.flatnonzero(inliers != certificate.inlier_mask)
    if len(differing) > 0:
        point = int(differing[0])
        has = "is" if inliers[point] else "is not"
        raise _Refused(
            f"its model has {np.count_nonzero(inliers)} inliers, not those {claimed} that it marks: "
            f"point {point}, for one, {has} within the threshold"
        )


def _check_groups(groups: tuple[Group, ...], data: ExactData, limit: float) -> None:
    taken: dict[int, int] = {}
    for number, group in enumerate(groups, start=1):
        for point in {point for basis in group.bases for point in basis}:
            if taken.setdefault(point, number) != number:
                raise _Refused(f"point {point} is in groups {taken[point]} and {number}, which must share none")
        for basis in group.bases:
            if not is_refuted(data, basis, limit):
                raise _Refused(f"group {number}: the points {', '.join(map(str, basis))} do not exclude each other")
        fault = follow(group)
        if fault:
            raise _Refused(f"group {number}: it does not follow that {group.needed} points must be left out: {fault}")


def _check_bounds(certificate: Certificate) -> None:
    for bound, who in (
        (certificate.upper_bound, "a bound that is claimed"),
        (certificate.proven_bound, "what its groups prove"),
    ):
        if bound < certificate.n_inliers:
            raise _Refused(f"its {certificate.n_inliers} inliers are more than {who}, {bound}")


def is_refuted(data: ExactData, basis: tuple[int, ...], limit: float) -> bool:
    """Return whether no model has all residuals of these points within the limit, as their one dependence shows."""
    least = data.least_maximum(basis)
    return least is not None and least > limit


def follow(group: Group) -> str:
    """Follow the proof that fewer than `needed` points do not hit all bases; return what is wrong with it, or ""."""
    names: dict[int, int] = {}
    order = [[names.setdefault(point, len(names)) for point in basis] for basis in group.bases]
    bits = [sum(1 << name for name in basis) for basis in order]
    proof = group.proof
    nodes = [(0, 0, group.needed - 1)]  # points that are out, points that are kept, how many more may go out
    at = 0
    while nodes:
        out, kept, budget = nodes.pop()
        if at >= len(proof):
            return "its proof ends too early"
        count = proof[at]
        cited = proof[at + 1 : at + 1 + max(count, 1)]
        at += 1 + len(cited)
        if len(cited) < max(count, 1):
            return "its proof ends too early"
        for k in cited:
            if k >= len(bits):
                return f"there is no basis {k}"
            if bits[k] & out:
                return f"basis {k} is cited where one of its points is out"
        if count > 0:
            if not _ends(bits, cited, kept, budget):
                return f"so few disjoint bases ({count}) do not need more than {budget} points"
        elif budget == 0:
            return "a branch has no point left to go out"
        else:
            children = []
            for name in order[cited[0]]:
                point = 1 << name
                if not kept & point:
                    children.append((out | point, kept, budget - 1))
                    kept |= point
            nodes += reversed(children)
    return "" if at == len(proof) else "its proof does not end where it should"


def _ends(bits: list[int], cited: tuple[int, ...], kept: int, budget: int) -> bool:
    """Return whether these bases need more points than may go out."""
    used = 0
    for k in cited:
        free = bits[k] & ~kept
        if free == 0:
            return True
        if free & used:
            return False
        used |= free
    return len(cited) > budget
