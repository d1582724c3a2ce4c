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
from maxcon.problem import Consensus, ReadOnlyArrays, check_threshold
from maxcon.problem.validate import check_time_limit
from maxcon.search.anytime import Progress
from maxcon.vision.degeneracy import Degeneracy, degeneracy
from maxcon.vision.epipolar import (
    check_matches,
    check_pixels,
    enforce_rank_two,
    sampson_distances,
    symmetric_epipolar_distances,
)
from maxcon.vision.estimate import smallest_directions
from maxcon.vision.fundamental import (
    LEAST_MATCHES,
    SAMPLES,
    USUAL_THRESHOLD,
    FundamentalProblem,
    check_chart,
    check_generator,
    fundamental_problem,
)
from maxcon.vision.polish import Polish

#: What the search has of a time limit that posing the problem has used up, in seconds.
LEAST_TIME = 1e-6

#: Up to this part of a time limit goes to the polish from samples, before the search; and so many seconds a match are
#: kept for polishing the consensus, which is what two starts take.
_SAMPLING, _POLISH = 0.5, 1.5e-6


@dataclass(frozen=True, eq=False)
class FundamentalFit(ReadOnlyArrays):
    """A fundamental matrix with the consensus that it rests on.

    Attributes
    ----------
    F
        Shape (3, 3), in pixels, rank 2, unit Frobenius norm: ``[x2, 1] @ F @ [x1, 1]`` is near 0 for right matches. It
        is the polished matrix (`maxcon.vision.polish_fundamental`); with ``pixels=None`` it is `F_linear`. All NaN
        where there is none.
    F_linear
        Shape (3, 3), as `F`: the matrix of the consensus, brought to rank 2. All NaN where `consensus` is "infeasible".
    consensus
        What `maxcon.fit` found: who is an inlier, the bound, the status. Its `model`, residuals and
        threshold are those of the linear problem: algebraic, normalised, before the rank is enforced. The bound says
        nothing of `F`, nor of how many matches a matrix of rank 2 can have within some pixels.
    problem
        The linear problem, its chart and its normalisation.
    sampson, symmetric
        Shape (N,): the distances of the matches under `F` in pixels (`maxcon.vision.sampson_distances`,
        `maxcon.vision.symmetric_epipolar_distances`); NaN where there is no F.
    pixels
        The Sampson distance within which `F` was to have as many matches as possible; None where it was not polished.
    """

    F: NDArray[np.float64]
    F_linear: NDArray[np.float64]
    consensus: Consensus
    problem: FundamentalProblem
    sampson: NDArray[np.float64]
    symmetric: NDArray[np.float64]
    pixels: float | None

    @property
    def chart(self) -> str:
        """The chart: "auto", "F32=1" or "F33=1"."""
        return self.problem.chart

    @property
    def inlier_mask(self) -> NDArray[np.bool_]:
        """Which matches are inliers of the linear problem, shape (N,), bool."""
        return self.consensus.inlier_mask

    @property
    def n_inliers(self) -> int:
        """The consensus: how many matches are inliers of the linear problem."""
        return self.consensus.n_inliers

    def within(self, pixels: float | None = None) -> NDArray[np.bool_]:
        """Return which matches have a Sampson distance of at most so many pixels from `F`, shape (N,), bool.

        Parameters
        ----------
        pixels
            None stands for those that `F` was polished for.

        Raises
        ------
        TypeError, ValueError
            If it is no positive finite number, or None for an F that was not polished.
        """
        if pixels is None and self.pixels is None:
            raise ValueError("pixels must be given where F was not polished, but it is None")
        return self.sampson <= check_pixels(self.pixels if pixels is None else pixels)

    @property
    def median_sampson(self) -> float:
        """The median Sampson distance of the inliers from `F`, in pixels; NaN where there is no F."""
        return float(np.median(self.sampson[self.inlier_mask])) if self.inlier_mask.any() else float("nan")

    @cached_property
    def degeneracy(self) -> Degeneracy:
        """Whether the inliers determine F: its `note` says so where they do not. Found when it is first asked for."""
        return degeneracy(self.problem, self.inlier_mask, (self.F, self.F_linear))

    def __repr__(self) -> str:
        return f"FundamentalFit(chart={self.chart!r}, {self.consensus!r})"


def find_fundamental(
    x1: ArrayLike,
    x2: ArrayLike,
    threshold: float = USUAL_THRESHOLD,
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
    pixels: float | None = 1.0,
    **options: Any,
) -> FundamentalFit:
    """Find the fundamental matrix that explains as many matches as possible within the threshold.

    Two questions are answered. The consensus: matches are posed as linear residuals
    (`maxcon.vision.fundamental_problem`) and fitted by `maxcon.fit`, which knows a bound. And, unless `pixels` is None,
    which matrix of rank 2 has the most matches within so many pixels: local optimisation from random samples, to whose
    result the chart "auto" is then rotated, and at the end from the consensus as well
    (`maxcon.vision.polish_fundamental`). No bound holds for that count.

    Parameters
    ----------
    x1, x2
        Shape (N, 2) each, or OpenCV's (N, 1, 2), N >= 9, in pixels: ``x1[i]`` of image 1 is matched to ``x2[i]`` of
        image 2.
    threshold
        The largest residual of an inlier: algebraic, in normalised coordinates, without a unit. The paper
        takes 0.1 for made scenes and 0.01, the default, for KITTI. What it means in pixels depends on the images;
        `sampson` tells.
    chart
        How the scale of F is fixed, and with it the residual: "auto", "F32=1" or "F33=1".
    method, time_limit, refine, gap, callback, **options
        As for `maxcon.fit`. The time limit covers everything: at most half of it goes to polishing from samples, some
        milliseconds are kept for polishing the consensus, and the search has the rest. With ``pixels=None`` it covers
        posing the problem, which it does not cut short: some 10 ms, but .1 s for 2,000 matches of which a quarter is
        right.
    rng
        A seed or a NumPy generator, for the polish, the chart "auto" and the search; None stands for the seed 0.
    refit
        False: `F_linear` is the minimax fit of the inliers, as `consensus.model` is. True: it is their total
        least-squares fit (the eight-point algorithm), nearer to the truth where their errors are many and small; the
        inliers stay those of the minimax fit.
    samples
        How many random samples the chart "auto" is estimated from, at most, where F is not polished.
    pixels
        F is polished to have many matches within this Sampson distance, and the chart "auto" rotated to it, unless it
        has less than 14 or the distance is large beside the images. None: F is `F_linear`, and the chart "auto" is
        rotated to a robust estimate by the linear residuals, as in those cases.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of this kind, the points of an image coincide, or N < 9; the message names it.
    """
    threshold = check_threshold(threshold)
    check_chart(chart)  # at once, and not after the polish
    check_time_limit(time_limit)
    pixels = None if pixels is None else check_pixels(pixels)
    first, second = check_matches(x1, x2, LEAST_MATCHES)
    clock = _Clock(time_limit)
    polish = None if pixels is None else Polish(first, second, pixels, check_generator(rng))
    sampled = None
    if polish is not None:
        polish.sample(clock.after(_SAMPLING))
        sampled = polish.matrix() if polish.credible else None
    posed = fundamental_problem(
        first, second, chart=chart, threshold=threshold, rng=rng, samples=samples, estimate=sampled
    )
    consensus = fit(
        posed.problem,
        threshold,
        method=method,
        rng=rng,
        time_limit=clock.left(0.0 if pixels is None else _POLISH * len(first)),
        refine=refine,
        gap=gap,
        callback=callback,
        **options,
    )
    F = linear = np.full((3, 3), np.nan)
    if np.isfinite(consensus.model).all():
        minimax = posed.normalised_matrix(consensus.model)
        least = _total_least_squares(posed, first[consensus.inlier_mask], second[consensus.inlier_mask], minimax)
        F = linear = posed.to_pixels(enforce_rank_two(least if refit else minimax))
        if polish is not None:
            polish.start(posed.to_pixels(minimax))
            polish.start(posed.to_pixels(least))
    if polish is not None:
        polish.sample(clock.after(1.0))
        F = polish.matrix()
    if np.isnan(F).any():
        sampson, symmetric = np.full(len(first), np.nan), np.full(len(first), np.nan)
    else:
        sampson, symmetric = sampson_distances(F, first, second), symmetric_epipolar_distances(F, first, second)
    return FundamentalFit(F, linear, consensus, posed, sampson, symmetric, pixels)


class _Clock:
    """A time limit in seconds or None, compiling not counted."""

    def __init__(self, time_limit: float | None) -> None:
        self.began, self.limit = working_clock(), time_limit

    def after(self, part: float) -> float | None:
        """Return the moment, by `working_clock`, when this part of the limit is over; None without a limit."""
        return None if self.limit is None else self.began + part * self.limit

    def left(self, kept: float) -> float | None:
        """Return the seconds that are left without `kept` (at most a third) of them; None without a limit."""
        if self.limit is None:
            return None
        left = self.began + self.limit - working_clock()
        return max(left - min(kept, left / 3), LEAST_TIME)


def _total_least_squares(
    posed: FundamentalProblem, x1: NDArray[np.float64], x2: NDArray[np.float64], otherwise: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the F of least ``|rows @ f|``, |f| = 1; `otherwise` where fewer than 8 matches leave it open."""
    if len(x1) < 8:
        return otherwise
    rows = epipolar_rows(transformed(posed.T1, x1), transformed(posed.T2, x2))
    return smallest_directions(rows.T @ rows).reshape(3, 3)
