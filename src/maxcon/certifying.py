"""How good is a result, anyone's: `maxcon.certify`, and the certificate file that others can check."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maxcon.certification import Certificate, issue, save
from maxcon.minimax import minimax_fit
from maxcon.minimax.jit import working_clock
from maxcon.problem import Consensus, LinearProblem, check_indices, check_model, check_threshold
from maxcon.problem.validate import check_callback, check_gap, check_time_limit
from maxcon.search.anytime import Progress, Task, make_task, run
from maxcon.search.conclusion import judge
from maxcon.search.proof import prove
from maxcon.search.proposal import propose
from maxcon.search.refine import swap_refinement
from maxcon.search.witness import make_witness


def certify(
    problem: LinearProblem,
    threshold: float,
    model_or_mask: ArrayLike | Consensus,
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
        The result: a model, shape (d,), whose inliers are counted as they are; or a `Consensus`, for its model; or
        inliers, of shape (N,) or (N, 1), bool or 0 and 1: their minimax fit is the model, and of them as many count as
        it explains. Where no model explains them all, the largest part found that one explains counts.
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
    began = working_clock()
    if not isinstance(problem, LinearProblem):
        raise TypeError(f"problem must be a LinearProblem, but it is a {type(problem).__name__}")
    threshold = check_threshold(threshold)
    check_time_limit(time_limit)
    gap = check_gap(gap)
    check_callback(callback)
    task = make_task(problem, threshold, np.random.default_rng(0), time_limit)
    model, counted = _given(task, model_or_mask)
    known = (problem.residuals(model) <= problem.inlier_limit(threshold)) & counted
    n_given = int(np.count_nonzero(known))

    def stop(progress: Progress) -> bool:
        asked = callback is not None and bool(callback(progress))
        return asked or progress.upper_bound - n_given <= gap

    best = run(task, prove(task, known), None, stop)
    seconds = working_clock() - began
    return judge(task, model, known, best.upper_bound, seconds)


def write_certificate(path: str | Path, consensus: Consensus, *, time_limit: float | None = 10.0) -> Certificate:
    """Write a certificate of a result: a file that `maxcon verify` checks without trusting the search.

    Parameters
    ----------
    path
        Where to write it; JSON.
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
    check_time_limit(time_limit)
    if not isinstance(consensus, Consensus):
        raise TypeError(f"consensus must be a Consensus, but it is a {type(consensus).__name__}")
    problem, witness = consensus.problem, None
    if consensus.n_inliers > 0:
        task = make_task(problem, consensus.threshold, np.random.default_rng(0), time_limit)
        witness = make_witness(task, consensus.inlier_mask, enough=consensus.upper_bound)
    certificate = issue(problem, consensus, witness)
    save(certificate, path)
    return certificate


def _given(task: Task, model_or_mask: ArrayLike | Consensus) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the model given and that all points count, or the fit of the set given, or of a part, and the set."""
    problem = task.problem
    given = np.asarray(model_or_mask.model if isinstance(model_or_mask, Consensus) else model_or_mask)
    N = problem.n_points
    if given.dtype != np.bool_ and given.shape in ((N,), (N, 1)) and given.shape != (problem.n_params,):
        if not np.isin(given, (0, 1)).all():
            raise ValueError("model_or_mask must hold 0 and 1 only if it is a mask, but it holds other numbers")
        given = given == 1
    if given.dtype != np.bool_:
        if given.dtype.kind in "iu" and given.shape != (problem.n_params,):
            raise ValueError(
                f"model_or_mask must be a model of shape ({problem.n_params},) or a mask of shape ({N},), but its "
                f"shape is {given.shape}; of indices, make a mask: numpy.zeros({N}, bool), True at the indices"
            )
        return check_model(given, problem.n_params, "model_or_mask"), np.ones(N, dtype=np.bool_)
    mask = check_indices(given.reshape(-1) if given.shape == (N, 1) else given, N, "model_or_mask")
    fit = minimax_fit(problem, mask)
    limit = problem.inlier_limit(task.threshold)
    if fit.value <= limit:
        return fit.model, mask
    # The points outside the set are made such that no model explains them.
    part = LinearProblem(problem.A * mask[:, None], np.where(mask, problem.b, 2.0 * limit))
    seconds = task.seconds_left() / 2 if task.deadline < np.inf else None
    inner = make_task(part, task.threshold, np.random.default_rng(0), seconds)
    best = run(inner, propose(inner), swap_refinement)
    return fit.model if best.subset is None else minimax_fit(problem, best.subset).model, mask
