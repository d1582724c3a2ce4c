"""How good is a result, anyone's: `maxcon.certify`, and the certificate file that others can check."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maxcon.certification import Certificate, issue, save
from maxcon.minimax import minimax_fit
from maxcon.problem import Consensus, LinearProblem, check_indices, check_model, check_threshold, inlier_slack
from maxcon.problem.validate import check_number
from maxcon.search.anytime import Progress, Task, make_task, run
from maxcon.search.conclusion import judge
from maxcon.search.proof import prove
from maxcon.search.proposal import best_proposal
from maxcon.search.witness import make_witness


def certify(
    problem: LinearProblem,
    threshold: float,
    model_or_mask: ArrayLike,
    *,
    time_limit: float | None = None,
    gap: int = 0,
    callback: Callable[[Progress], object] | None = None,
) -> Consensus:
    """Say how far a result of any origin is from the best possible one.

    Parameters
    ----------
    problem
        The points.
    threshold
        The largest residual of an inlier, in the unit of b.
    model_or_mask
        The result: a model, shape (d,), whose inliers are counted as they are; or its inliers, bool of shape (N,), of
        which as many count as one model explains (their minimax fit, if that is within the threshold).
    time_limit
        Seconds after which the bound proven so far is returned; None for no limit, which can take long where there are
        many outliers and more than three parameters.
    gap
        Stop as soon as the result is proven to be within so many inliers of the largest possible.
    callback
        Called with a `Progress` whenever the bound improves, or a set larger than all before is found on the way; a
        true return value stops the search.

    Returns
    -------
    Consensus
        The result as given, with `upper_bound`, `gap` and `status` as far as they are proven; method "given". Where the
        gap is above 0, `maxcon.fit` finds what there is to gain.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type, shape or range; the message names it.
    """
    began = time.perf_counter()
    if not isinstance(problem, LinearProblem):
        raise TypeError(f"problem must be a LinearProblem, but it is a {type(problem).__name__}")
    threshold = check_threshold(threshold)
    if time_limit is not None and not check_number(time_limit, "time_limit") > 0:
        raise ValueError(f"time_limit must be a positive number of seconds or None, but it is {time_limit}")
    if isinstance(gap, bool) or not isinstance(gap, (int, np.integer)):
        raise TypeError(f"gap must be a whole number, but it is {gap!r}")
    if gap < 0:
        raise ValueError(f"gap must be at least 0, but it is {gap}")
    if callback is not None and not callable(callback):
        raise TypeError(f"callback must be callable, but it is a {type(callback).__name__}")
    task = make_task(problem, threshold, np.random.default_rng(0), time_limit)
    model = _model(task, model_or_mask)
    n_given = int(np.count_nonzero(problem.residuals(model) <= _limit(problem, threshold)))

    def stop(progress: Progress) -> bool:
        asked = callback is not None and bool(callback(progress))
        return asked or progress.upper_bound - n_given <= gap

    known = problem.residuals(model) <= _limit(problem, threshold)
    best = run(task, prove(task, known), None, stop)
    return judge(task, model, max(best.upper_bound, n_given), time.perf_counter() - began)


def write_certificate(
    path: str | Path, problem: LinearProblem, consensus: Consensus, *, time_limit: float | None = 10.0
) -> Certificate:
    """Write a certificate of a result: a file that `maxcon verify` checks without trusting the search.

    Parameters
    ----------
    path
        Where to write it; JSON.
    problem
        What was fitted.
    consensus
        The result of `maxcon.fit` or `maxcon.certify`. Its upper bound is the claim.
    time_limit
        Seconds to spend on the explicit proof in the file. It is by disjoint groups of points, each with bases that no
        model explains, and can be weaker than the claim, which is by search: then `maxcon verify` says what the file
        proves, and ``--rerun`` proves the claim again by another solver.

    Returns
    -------
    Certificate
        What was written.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or range.
    """
    if time_limit is not None and not check_number(time_limit, "time_limit") > 0:
        raise ValueError(f"time_limit must be a positive number of seconds or None, but it is {time_limit}")
    witness = None
    if consensus.n_inliers > 0:
        task = make_task(problem, consensus.threshold, np.random.default_rng(0), time_limit)
        witness = make_witness(task, consensus.inlier_mask, enough=consensus.upper_bound)
    certificate = issue(problem, consensus, witness)
    save(certificate, path)
    return certificate


def _limit(problem: LinearProblem, threshold: float) -> float:
    return threshold + inlier_slack(threshold, problem.scale)


def _model(task: Task, model_or_mask: ArrayLike) -> NDArray[np.float64]:
    """Return the model given, or the minimax fit of the set given, or of the largest part of it found that has one."""
    given = np.asarray(model_or_mask)
    problem = task.problem
    if given.dtype != np.bool_:
        if given.shape == (problem.n_points,) and problem.n_points != problem.n_params:
            raise ValueError("model_or_mask must be of dtype bool if it is a mask, but it is " + str(given.dtype))
        return check_model(given, problem.n_params, "model_or_mask")
    mask = check_indices(given, problem.n_points, "model_or_mask")
    fit = minimax_fit(problem, mask)
    if fit.value <= _limit(problem, task.threshold):
        return fit.model
    part = LinearProblem(problem.A[mask], problem.b[mask])
    chosen = best_proposal(make_task(part, task.threshold, np.random.default_rng(0)))
    return minimax_fit(part, chosen).model if chosen.any() else fit.model
