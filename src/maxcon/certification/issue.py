"""From a result and a witness to a certificate that its checker accepts."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

import numpy as np

from maxcon.certification.certificate import Certificate, Group, data_digest, inlier_limit
from maxcon.certification.exact import ExactData, within
from maxcon.certification.verify import is_refuted

if TYPE_CHECKING:
    from maxcon.problem import Consensus, LinearProblem
    from maxcon.search.witness import Witness


def issue(problem: LinearProblem, consensus: Consensus, witness: Witness | None = None) -> Certificate:
    """Return the certificate of a result.

    Parameters
    ----------
    problem
        What was fitted.
    consensus
        The result; the claim is its upper bound, or that of the witness if that is lower.
    witness
        What proves a bound (`maxcon.search.witness`); without one the file proves nothing beyond N.

    Raises
    ------
    ArithmeticError
        If the result has more inliers than its upper bound, or than the witness allows.

    Notes
    -----
    What is stated is what holds in exact arithmetic. Bases of the witness that do not are left out: those whose
    rows depend on each other only up to rounding (columns like ``x`` and ``0.1 * x``), so that to the letter of
    the data some model of astronomical size explains them.
    """
    limit = inlier_limit(consensus.threshold, problem.b)
    if consensus.status == "infeasible":
        inliers = np.zeros(problem.n_points, dtype=np.bool_)
    else:
        inliers = within(problem.A, problem.b, consensus.model, limit)
    data = ExactData(problem.A, problem.b)
    found = () if witness is None else witness.groups
    groups = tuple(group for each in found if (group := _tenable(Group(*each), data, limit)).needed > 0)
    n_inliers = int(np.count_nonzero(inliers))
    proven = problem.n_points - sum(group.needed for group in groups)
    bound = min(consensus.upper_bound, proven)
    if n_inliers > bound:
        raise ArithmeticError(
            f"{n_inliers} inliers are more than the upper bound, {bound}; please report the data that made this happen"
        )
    return Certificate(
        digest=data_digest(problem.A, problem.b),
        n_points=problem.n_points,
        n_params=problem.n_params,
        family=problem.family,
        threshold=consensus.threshold,
        model=np.array(consensus.model),
        inlier_mask=inliers,
        n_inliers=n_inliers,
        upper_bound=bound,
        method="witness" if proven < consensus.upper_bound else consensus.method,
        seconds=float(consensus.seconds),
        package=_package(),
        groups=groups,
    )


def _tenable(group: Group, data: ExactData, limit: float) -> Group:
    """Return the group if all its bases hold; otherwise as many disjoint ones as do, which need a point each."""
    holds = [is_refuted(data, basis, limit) for basis in group.bases]
    if all(holds):
        return group
    taken: set[int] = set()
    disjoint = []
    for basis in (basis for basis, good in zip(group.bases, holds, strict=True) if good):
        if taken.isdisjoint(basis):
            disjoint.append(basis)
            taken.update(basis)
    return Group(len(disjoint), tuple(disjoint), (len(disjoint), *range(len(disjoint))))


def _package() -> str:
    try:
        return f"maxcon {version('maxcon')}"
    except PackageNotFoundError:  # run from its source folder
        return "maxcon"
