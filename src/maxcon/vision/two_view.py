"""`find_fundamental`: from matches to a fundamental matrix, by the front door of the package."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maxcon.datasets.cameras import epipolar_rows, transformed
from maxcon.fitting import fit
from maxcon.minimax.jit import working_clock
from maxcon.problem import Consensus, check_threshold, freeze_arrays
from maxcon.problem.validate import check_time_limit
from maxcon.search.anytime import Progress
from maxcon.vision.degeneracy import Degeneracy, degeneracy
from maxcon.vision.epipolar import (
    check_matches,
    enforce_rank_two,
    sampson_distances,
    symmetric_epipolar_distances,
)
from maxcon.vision.estimate import smallest_directions
from maxcon.vision.fundamental import LEAST_MATCHES, SAMPLES, FundamentalProblem, fundamental_problem

#: What the search has of a time limit that posing the problem has used up, in seconds.
LEAST_TIME = 1e-6


@dataclass(frozen=True, eq=False)
class FundamentalFit:
    """A fundamental matrix with the consensus that it rests on.

    Attributes
    ----------
    F
        Shape (3, 3), in pixels, rank 2, unit Frobenius norm: ``[x2, 1] @ F @ [x1, 1]`` is near 0 for inliers. All NaN
        where `consensus` is "infeasible".
    consensus
        What `maxcon.fit` found: who is an inlier, the bound, the status. Its `model`, residuals and
        threshold are those of the linear problem: algebraic, normalised, before the rank is enforced.
    problem
        The linear problem, its chart and its normalisation.
    sampson, symmetric
        Shape (N,): the distances of the matches under `F` in pixels (`maxcon.vision.sampson_distances`,
        `maxcon.vision.symmetric_epipolar_distances`); NaN where there is no F.
    """

    F: NDArray[np.float64]
    consensus: Consensus
    problem: FundamentalProblem
    sampson: NDArray[np.float64]
    symmetric: NDArray[np.float64]

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    def chart(self) -> str:
        """The chart: "auto", "F32=1" or "F33=1"."""
        return self.problem.chart

    @property
    def inlier_mask(self) -> NDArray[np.bool_]:
        """Which matches are inliers, shape (N,), bool."""
        return self.consensus.inlier_mask

    @property
    def n_inliers(self) -> int:
        """The consensus: how many matches are inliers."""
        return self.consensus.n_inliers

    @property
    def median_sampson(self) -> float:
        """The median Sampson distance of the inliers, in pixels; NaN where there is no F."""
        return float(np.median(self.sampson[self.inlier_mask])) if self.inlier_mask.any() else float("nan")

    @cached_property
    def degeneracy(self) -> Degeneracy:
        """Whether the inliers determine F: its `note` says so where they do not. Found when it is first asked for."""
        return degeneracy(self.problem, self.inlier_mask, self.median_sampson)

    def __repr__(self) -> str:
        return f"FundamentalFit(chart={self.chart!r}, {self.consensus!r})"


def find_fundamental(
    x1: ArrayLike,
    x2: ArrayLike,
    threshold: float,
    *,
    chart: str = "auto",
    method: str = "auto",
    rng: int | np.random.Generator | None = None,
    time_limit: float | None = None,
    refine: str | None = "swap",
    gap: int = 0,
    callback: Callable[[Progress], object] | None = None,
    refit: bool = False,
    samples: int = SAMPLES,
    **options: Any,
) -> FundamentalFit:
    """Find the fundamental matrix that explains as many matches as possible within the threshold.

    Matches are posed as linear residuals (`maxcon.vision.fundamental_problem`), fitted by `maxcon.fit`, and the F
    found is brought to rank 2, in normalised coordinates, as a last step.

    Parameters
    ----------
    x1, x2
        Shape (N, 2) each, N >= 9, in pixels: ``x1[i]`` of image 1 is matched to ``x2[i]`` of image 2.
    threshold
        The largest residual of an inlier: algebraic, in normalised coordinates, without a unit. The paper
        takes 0.1 for made scenes and 0.01 for KITTI. What it means in pixels depends on the images; `sampson` tells.
    chart
        How the scale of F is fixed, and with it the residual: "auto", "F32=1" or "F33=1".
    method, time_limit, refine, gap, callback, **options
        As for `maxcon.fit`. The time limit covers posing the problem, too, which it does not cut short: some 10 ms,
        but .1 to .3 s for 2,000 matches of which a quarter is right.
    rng
        A seed or a NumPy generator, for the chart "auto" and for the search; None stands for the seed 0.
    refit
        False: F is the minimax fit of the inliers, as `consensus.model` is. True: it is their total least-squares
        fit (the eight-point algorithm), nearer to the truth where their errors are many and small; the inliers stay
        those of the minimax fit.
    samples
        How many random samples the chart "auto" is estimated from, at most.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of this kind, the points of an image coincide, or N < 9; the message names it.
    """
    threshold = check_threshold(threshold)
    check_time_limit(time_limit)
    first, second = check_matches(x1, x2, LEAST_MATCHES)
    began = working_clock()
    posed = fundamental_problem(first, second, chart=chart, threshold=threshold, rng=rng, samples=samples)
    if time_limit is not None:
        time_limit = max(time_limit - (working_clock() - began), LEAST_TIME)
    consensus = fit(
        posed.problem,
        threshold,
        method=method,
        rng=rng,
        time_limit=time_limit,
        refine=refine,
        gap=gap,
        callback=callback,
        **options,
    )
    if not np.isfinite(consensus.model).all():
        nothing = np.full(len(first), np.nan)
        return FundamentalFit(np.full((3, 3), np.nan), consensus, posed, nothing, nothing.copy())
    F = posed.normalised_matrix(consensus.model)
    if refit:
        F = _total_least_squares(posed, first[consensus.inlier_mask], second[consensus.inlier_mask], F)
    F = posed.to_pixels(enforce_rank_two(F))
    F.setflags(write=False)
    return FundamentalFit(
        F, consensus, posed, sampson_distances(F, first, second), symmetric_epipolar_distances(F, first, second)
    )


def _total_least_squares(
    posed: FundamentalProblem, x1: NDArray[np.float64], x2: NDArray[np.float64], otherwise: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the F of least ``|rows @ f|``, |f| = 1; `otherwise` where fewer than 8 matches leave it open."""
    if len(x1) < 8:
        return otherwise
    rows = epipolar_rows(transformed(posed.T1, x1), transformed(posed.T2, x2))
    return smallest_directions(rows.T @ rows).reshape(3, 3)
