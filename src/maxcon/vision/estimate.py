"""A robust estimate of the fundamental matrix that no chart enters: what the chart "auto" is rotated to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.search.random_kernels import seed_state
from maxcon.search.sampling_kernels import samples_needed
from maxcon.vision.estimate_kernels import best_of_samples

#: How many of the sampled models are refined.
_REFINED = 48

#: Samples before the first look at the confidence, and the confidence that is enough.
_FIRST_CHUNK, _CONFIDENCE = 1000, 0.99

#: Of more matches than this, so many are looked at.
_MOST = 2000

#: The refinement starts at so many scales; so many reweightings bring it down to one, and so many follow there.
_WIDEST, _SHRINKING, _SETTLING = 2.0, 8, 5


def robust_estimate(
    rows: NDArray[np.float64], scale: float, rng: np.random.Generator, samples: int
) -> NDArray[np.float64]:
    """Return a unit vector f of small ``sum(min((rows @ f / scale)^2, 1))``.

    Models through 8 random matches are scored by that sum (MSAC, Torr and Zisserman 2000); the best 48, and the
    total least-squares fit of all matches, are refined by total least squares, reweighted by a Geman-McClure loss
    whose scale shrinks from 2 to 1 times `scale`; the best model met is returned. Of more than 2,000 matches, so many
    are drawn for all this. Its sign makes the entry of
    largest size positive.

    Parameters
    ----------
    rows
        Shape (N, 9), C-contiguous: those of `maxcon.datasets.cameras.epipolar_rows`, of normalised points; N >= 8.
    scale
        The residual ``|rows @ f|`` beyond which a match no longer counts.
    rng
        Draws the samples; equal generators give equal estimates.
    samples
        How many samples are drawn at most: in chunks, until with probability 0.99 one of them was all inliers, were
        the best sampled model's inliers all there are.
    """
    everything, rows = rows, _some(rows, rng)
    kept = min(_REFINED, samples)
    best, losses = np.zeros((kept, 9)), np.full(kept, np.inf)
    state, pool = seed_state(rng), np.arange(len(rows))
    drawn, needed = 0, float(_FIRST_CHUNK)
    while drawn < min(needed, samples):
        chunk = min(max(drawn, _FIRST_CHUNK), samples - drawn)
        best_of_samples(rows, scale, chunk, state, pool, best, losses)
        drawn += chunk
        within = int(np.count_nonzero(np.abs(rows @ best[np.argmin(losses)]) <= scale))
        needed = samples_needed(within, len(rows), 8, _CONFIDENCE)
    f = _refined(rows, scale, np.vstack([best, smallest_directions(everything.T @ everything)]))
    positive: NDArray[np.float64] = f * np.sign(f[np.argmax(np.abs(f))])
    return positive


def _some(rows: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the rows, or `_MOST` of them drawn at random where there are more: an estimate needs no more."""
    if len(rows) <= _MOST:
        return rows
    return np.ascontiguousarray(rows[np.sort(rng.choice(len(rows), _MOST, replace=False))])


def smallest_directions(moments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit eigenvectors of the least eigenvalue of symmetric matrices, shape (..., 9, 9) to (..., 9)."""
    vectors: NDArray[np.float64] = np.linalg.eigh(moments)[1][..., 0]
    return vectors


def _refined(rows: NDArray[np.float64], scale: float, models: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the best of the models, shape (k, 9), and of all that reweighting makes of them."""
    squares = (rows[:, :, None] * rows[:, None, :]).reshape(len(rows), 81)
    best: NDArray[np.float64] = models[0]
    least = np.inf
    for width in (*np.geomspace(_WIDEST, 1.0, _SHRINKING), *np.ones(_SETTLING)):
        r2 = (models @ rows.T / scale) ** 2
        losses = np.minimum(r2, 1.0).sum(axis=1)
        k = int(np.argmin(losses))
        if losses[k] < least:
            best, least = models[k], float(losses[k])
        weights = (width**2 / (width**2 + r2)) ** 2
        models = smallest_directions((weights @ squares).reshape(-1, 9, 9))
    return best
