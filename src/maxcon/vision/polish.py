"""The geometric polish: the matrix of rank 2 that has the most matches within some pixels, by local optimisation."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maxcon.datasets.cameras import hartley_transform, transformed
from maxcon.minimax.jit import working_clock
from maxcon.problem.validate import check_array, check_time_limit
from maxcon.search.random_kernels import seed_state
from maxcon.search.sampling import check_count
from maxcon.search.sampling_kernels import samples_needed
from maxcon.vision.epipolar import check_matches, check_pixels, enforce_rank_two
from maxcon.vision.fundamental import check_generator
from maxcon.vision.polish_kernels import anneal, frame_of, matrix_of, within
from maxcon.vision.seven_point_kernels import company, sampled_round

#: Fewer matches than this are fitted exactly by some matrix.
LEAST_MATCHES = 8

#: Rounds without one more match after which the polish ends.
PATIENCE = 12

#: Samples are drawn from the matches that have most company, in turns from these parts of all, but so many at least.
_PARTS, _LEAST_PART = (0.1, 0.2, 0.1, 0.2, 0.4, 1.0), 20

#: Company is counted among so many matches, within so far (where the mean distance from the centroid is sqrt(2)).
_COMPANY, _NEIGHBOURS, _FARTHEST = 300, 4.5, 0.5

#: Samples of seven of a round near the best matrix and of one among all matches; how many of its models are refined.
_NEAR, _ANYWHERE, _ANNEALED = 100, 100, 4

#: Samples of a round near the best matrix are of matches within so many times the limit.
_REACH = 2.0

#: Proposals are scored on so many matches, and first refined on so many.
_LOOKED, _FEW = 200, 300

#: Annealing begins at so many times the limit.
_WIDTH = 7.0

#: A threshold beyond this part of the size of the points (where their mean distance from the centroid is sqrt(2)) is
#: fulfilled by much: most likely the points are not in pixels.
_COARSE = 0.1

#: Rounds anywhere end where a sample of seven right matches was drawn with this probability.
_CONFIDENCE = 0.99


def polish_fundamental(
    F: ArrayLike | None,
    x1: ArrayLike,
    x2: ArrayLike,
    pixels: float = 1.0,
    *,
    rng: int | np.random.Generator | None = None,
    time_limit: float | None = None,
    patience: int = PATIENCE,
) -> NDArray[np.float64]:
    """Return a fundamental matrix of rank 2 with as many matches within `pixels` of it as local optimisation finds.

    The distance is that of Sampson (`maxcon.vision.sampson_distances`), and the matches are all of them, not only
    inliers of some earlier step. Matrices of rank 2 have seven parameters here (the orthonormal representation of
    Bartoli and Sturm 2004). Each start is annealed: some steps of Levenberg and Marquardt on Tukey's biweight loss,
    whose width shrinks from seven times `pixels` to twice. Then come rounds of random samples of seven matches, drawn
    in turns from those within twice `pixels` of the best matrix, and from a tenth, a fifth, two fifths and all of the
    matches, those with most neighbours in common in both images. The best models of a round are annealed on 300
    matches, and the best of these on all. Of everything met, the starts included, the matrix with the most matches
    within `pixels` is returned, with the least truncated quadratic loss among equals. There is no bound on how many
    another matrix might have.

    Parameters
    ----------
    F
        Where to start: shape (3, 3), or (k, 3, 3) for several, in pixels, of any scale and rank; None for samples only.
    x1, x2
        Shape (N, 2) each, N >= 8, in pixels.
    pixels
        The threshold.
    rng
        A seed or a NumPy generator for the samples; None stands for the seed 0.
    time_limit
        Seconds within which it ends, unless the starts take longer: no round (some half a millisecond) is begun that
        would not fit, but one where no start has rank 2. None: until `patience` ends it. Without a limit, equal
        arguments give equal results.
    patience
        It ends after so many rounds without one more match; 0 for the starts alone.

    Returns
    -------
    numpy.ndarray
        Shape (3, 3), in pixels, rank 2, unit Frobenius norm, the entry of largest size positive. All NaN where neither
        a start nor a sample has rank 2.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of this kind, the points of an image coincide, or N < 8; the message names it.
    """
    pixels = check_pixels(pixels)
    first, second = check_matches(x1, x2, LEAST_MATCHES)
    starts = _check_starts(F)
    check_time_limit(time_limit)
    patience = check_count(patience, "patience", 0)
    began = working_clock()
    polish = Polish(first, second, pixels, check_generator(rng))
    for start in starts:
        polish.start(start)
    polish.sample(None if time_limit is None else began + time_limit, patience)
    return polish.matrix()


def _check_starts(F: ArrayLike | None) -> NDArray[np.float64]:
    """Return starts as an array of shape (k, 3, 3); TypeError or ValueError otherwise."""
    if F is None:
        return np.empty((0, 3, 3))
    starts = check_array(F, "F", np.ndim(F) if np.ndim(F) in (2, 3) else 2)
    if starts.shape[-2:] != (3, 3):
        raise ValueError(f"F must have shape (3, 3) or (k, 3, 3), but its shape is {starts.shape}")
    starts = starts.reshape(-1, 3, 3)
    if not starts.any(axis=(1, 2)).all():
        raise ValueError("F must not be zero, but all of its entries are")
    return starts


def _alike(T1: NDArray[np.float64], T2: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return two normalisations with one scale for both images, so that distances keep their proportions."""
    scale = 2.0 / (1.0 / T1[0, 0] + 1.0 / T2[0, 0])
    alike = [T * np.array([[scale / T[0, 0]], [scale / T[0, 0]], [1.0]]) for T in (T1, T2)]
    return alike[0], alike[1]


def _normalised(F: NDArray[np.float64], T1: NDArray[np.float64], T2: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix of normalised points nearest to that of F in pixels which has rank 2, of unit norm."""
    moved = np.linalg.solve(T2.T, F) @ np.linalg.inv(T1)
    return enforce_rank_two(moved / np.linalg.norm(moved))


class Polish:
    """The best matrix so far, and what makes it better: starts and rounds of samples.

    Parameters
    ----------
    x1, x2
        Shape (N, 2) each, N >= 8, in pixels.
    pixels
        The threshold.
    rng
        Draws the samples.

    Raises
    ------
    ValueError
        If the points of an image coincide.
    """

    def __init__(
        self, x1: NDArray[np.float64], x2: NDArray[np.float64], pixels: float, rng: np.random.Generator
    ) -> None:
        self.T1, self.T2 = _alike(hartley_transform(x1, "x1"), hartley_transform(x2, "x2"))
        self.limit = pixels * float(self.T1[0, 0])
        self.n_points = len(x1)
        order = rng.permutation(self.n_points)  # the first are to stand for all
        self.matches = np.ascontiguousarray(np.hstack([transformed(self.T1, x1), transformed(self.T2, x2)])[order].T)
        self.state = seed_state(rng)
        self.everything, self.pool = np.arange(self.n_points), np.arange(self.n_points)
        self.best, self.record = np.full(19, np.nan), np.array([-1.0, np.inf])
        self.models, self.scores = np.empty((_ANNEALED, 9)), np.empty(_ANNEALED, dtype=np.int64)
        self.f = np.empty(9)
        looked = min(_COMPANY, self.n_points)
        counts = np.empty(self.n_points, dtype=np.int64)
        company(self.matches, looked, min(_NEIGHBOURS / np.sqrt(looked), _FARTHEST), self.limit, counts)
        self.by_company = np.argsort(-counts, kind="stable")
        self.idle, self.rounds, self.drawn = 0, 0, 0

    def start(self, F: NDArray[np.float64]) -> None:
        """Anneal from a matrix in pixels; one of rank 1 is none."""
        frame = np.empty(19)
        if frame_of(_normalised(F, self.T1, self.T2).ravel(), frame) and anneal(
            self.matches, frame, self.limit, _WIDTH, self.everything, self.best, self.record
        ):
            self.idle = 0

    def sample(self, deadline: float | None, patience: int = PATIENCE) -> None:
        """Go on in rounds until so many in a row brought no match, or, with some matrix, to the deadline."""
        began, before = working_clock(), self.rounds
        while self.idle < patience:
            if deadline is not None and self.record[0] >= 0:
                now = working_clock()
                if now + (now - began) / max(self.rounds - before, 1) >= deadline:
                    return
            self._round()

    def matrix(self) -> NDArray[np.float64]:
        """Return the best matrix, in pixels, shape (3, 3); NaN where there is none."""
        if self.record[0] < 0:
            return np.full((3, 3), np.nan)
        matrix_of(self.best, self.f)
        F = enforce_rank_two(self.T2.T @ self.f.reshape(3, 3) @ self.T1)  # what rounding did to the rank
        F /= np.linalg.norm(F)
        F *= np.sign(F.flat[np.argmax(np.abs(F))])
        return F

    @property
    def credible(self) -> bool:
        """Whether the best matrix says anything: it has twice the matches of a sample, and the threshold is small."""
        return bool(self.record[0] >= 14) and self.limit <= _COARSE

    def _round(self) -> None:
        """Draw samples, near the best frame or from those with company, and anneal the best of them."""
        near = self.record[0] >= 0 and (self.rounds % 2 == 1 or self._confident())
        n_pool, samples, pool = 0, _NEAR, self.pool
        if near:
            n_pool = within(self.matches, self.best, _REACH * self.limit, pool, self.f)
        if n_pool < LEAST_MATCHES:
            part = _PARTS[self.rounds // 2 % len(_PARTS)]
            n_pool = max(int(part * self.n_points), min(_LEAST_PART, self.n_points))
            samples, pool = _ANYWHERE, self.by_company[:n_pool].copy()
            self.drawn += samples if n_pool == self.n_points else 0
        grown = sampled_round(
            self.matches,
            self.everything,
            pool,
            n_pool,
            min(_LOOKED, self.n_points),
            min(_FEW, self.n_points),
            self.limit,
            samples,
            self.state,
            self.models,
            self.scores,
            self.best,
            self.record,
        )
        self.rounds += 1
        self.idle = 0 if grown else self.idle + 1

    def _confident(self) -> bool:
        return self.drawn >= samples_needed(int(self.record[0]), self.n_points, 7, _CONFIDENCE)
