"""The one result type of the package."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from maxcon.problem.explanation import Explanation
from maxcon.problem.frozen import ReadOnlyArrays
from maxcon.problem.linear import LinearProblem

Status = Literal["optimal", "bounded", "heuristic", "infeasible"]


@dataclass(frozen=True, eq=False)
class Consensus(ReadOnlyArrays):
    """A model, the points that it explains within the threshold, and how good that is.

    Its arrays are read-only.

    Attributes
    ----------
    model
        Shape (d,): the minimax fit of the inliers. All NaN if `status` is "infeasible".
    inlier_mask
        Shape (N,), bool: ``residuals <= threshold``, with the package's slack for rounding.
    n_inliers
        The consensus: how many points are inliers.
    upper_bound
        No model has more inliers than this (N where nothing is known).
    gap
        ``upper_bound - n_inliers``.
    status
        "optimal": proven to be the largest; "bounded": an upper bound below N is proven; "heuristic":
        nothing is proven; "infeasible": no model was found.
    residuals
        Shape (N,): the residual of every point under `model`.
    basis
        Indices of the inliers that hold the minimax fit in place, at most d + 1.
    path
        Indices of the points that the search removed, in order; empty for methods that remove none.
    threshold
        The inlier threshold that was asked for.
    method
        The name of the method that found it.
    seed
        What seeded the random numbers (drawn or not), or None where a generator was passed.
    seconds
        Wall-clock time of the fit, without that of compiling kernels, once on a machine, and of loading them, once in a
        process.
    problem
        What was fitted.
    """

    model: NDArray[np.float64]
    inlier_mask: NDArray[np.bool_]
    n_inliers: int
    upper_bound: int
    gap: int
    status: Status
    residuals: NDArray[np.float64]
    basis: NDArray[np.int64]
    path: NDArray[np.int64]
    threshold: float
    method: str
    seed: int | None
    seconds: float
    problem: LinearProblem = field(repr=False)

    def explain(self, point: int, *, time_limit: float | None = 10.0) -> Explanation:
        """Explain why a point is no inlier: which inliers speak against it, and what it would cost to force it in.

        Parameters
        ----------
        point
            The index of a point that is not among the inliers.
        time_limit
            Seconds after which the best so far is returned; None for no limit.

        Raises
        ------
        TypeError
            If `point` is not a whole number.
        ValueError
            If there is no such point, or it is an inlier.
        """
        # A result is what searches return, and this question takes a search: it is looked up when it is asked.
        explanation: Explanation = import_module("maxcon.search.explanation").explain(
            self.problem, self, point, time_limit=time_limit
        )
        return explanation

    def __repr__(self) -> str:
        return (
            f"Consensus({self.n_inliers} of {len(self.inlier_mask)} points within {self.threshold:g}, "
            f"{self.status}, gap {self.gap}, method {self.method!r}, {1e3 * self.seconds:.2f} ms)"
        )
