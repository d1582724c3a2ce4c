"""RANSAC and LO-RANSAC, the paper's baselines: models of random minimal samples, scored by consensus."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import LinearRows
from maxcon.minimax.linear import compute_residuals
from maxcon.problem.validate import check_number
from maxcon.search.anytime import Step, Task
from maxcon.search.random_kernels import seed_state
from maxcon.search.sampling_kernels import allocate_scratch, sample

#: How many samples are drawn at most where the confidence decides: 0.1 s for 100 points and d = 8.
MAX_SAMPLES = 100_000

#: Samples before the first step; each chunk is twice as long as the one before.
FIRST_CHUNK = 100

#: What a chunk of samples may take, in seconds, by the rough model of `_longest_chunk`.
CHUNK_SECONDS = 0.01

#: Beyond so many points a local optimisation takes milliseconds, and ends its chunk.
PAUSE_FROM = 2000

#: Non-minimal samples for each new best model; where there are many points, this over N.
INNER, INNER_WORK = 50, 200_000


def check_count(value: Any, name: str, least: int) -> int:
    """Return `value` as an int.

    Raises
    ------
    TypeError
        If it is not an integer.
    ValueError
        If it is below `least`.
    """
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"{name} must be an integer, but it is {value!r}")
    if value < least:
        raise ValueError(f"{name} must be at least {least}, but it is {value}")
    return int(value)


def inlier_mask(rows: LinearRows, x: NDArray[np.float64], limit: float) -> NDArray[np.bool_]:
    """Return which points model x of `rows` explains, shape (N,), by the arithmetic of the kernels."""
    r = np.empty(rows.b.shape[0])
    compute_residuals(rows.At, rows.b, x, r)
    return np.abs(r) <= limit


def ransac(task: Task, *, samples: int | None = None, confidence: float = 0.99) -> Iterator[Step]:
    """Draw minimal samples and keep the model with the largest consensus (Fischler and Bolles 1981).

    Parameters
    ----------
    task
        What is fitted. A minimal sample has as many independent points as A has rank; dependent points
        (duplicates, collinear ones) are passed over as they are drawn.
    samples
        How many samples to draw. None: until one of them was all inliers with probability `confidence`, were
        the best consensus found the largest; at most 100,000.
    confidence
        In (0, 1); used where `samples` is None.

    Yields
    ------
    Step
        After each chunk of samples, with the inliers of the best model if it is new.

    Raises
    ------
    TypeError, ValueError
        If an option is not a number, or outside its range.
    """
    return _in_chunks(task, samples, confidence, _LocalOptimisation(0, 0, 1.0, 0, 0))


def lo_ransac(
    task: Task,
    *,
    samples: int | None = None,
    confidence: float = 0.99,
    inner: int | None = None,
    steps: int = 4,
    wide: float = 1.5,
) -> Iterator[Step]:
    """RANSAC that optimises every new best model locally.

    From the new best model: least squares on the points within `wide` times the threshold, again and again
    while that threshold shrinks to its proper size in `steps` steps. Then `inner` times: a non-minimal sample
    (max(14, 2 r) points, r the rank of A, but at most half) of the best model's inliers, its least-squares
    model, and from there the same shrinking. No least squares uses more than max(7 r, N / 8) points, drawn at
    random: it is the variety of models that finds larger sets. The best model met anywhere is kept.

    This is Chum, Matas and Kittler 2003, "Locally optimized RANSAC", in the form of Lebeda, Matas and Chum
    2012, "Fixing the locally optimized RANSAC" (LO+), with the count of inliers as the score.

    Parameters
    ----------
    task
        What is fitted.
    samples, confidence
        As for `ransac`.
    inner
        How many non-minimal samples each new best model is given, at least 0. None for 50, and from 4000
        points on for 200,000 / N, at least 5: the more points, the less the models differ.
    steps
        How many least-squares fits each shrinking takes, at least 1.
    wide
        The first threshold of a shrinking, in thresholds, at least 1.

    Yields
    ------
    Step
        After each chunk of samples, with the inliers of the best model if it is new.

    Raises
    ------
    TypeError, ValueError
        If an option is not a number, or outside its range.
    """
    rank, n_points = task.rows.At.shape
    if inner is None:
        inner = min(INNER, max(5, INNER_WORK // n_points))
    wide = check_number(wide, "wide")
    if not 1.0 <= wide < np.inf:
        raise ValueError(f"wide must be at least 1 and finite, but it is {wide}")
    local = _LocalOptimisation(
        check_count(inner, "inner", 0),
        max(14, 2 * rank),
        wide,
        check_count(steps, "steps", 1),
        max(7 * rank, n_points // 8, 1),
    )
    return _in_chunks(task, samples, confidence, local)


@dataclass(frozen=True)
class _LocalOptimisation:
    """The settings of `optimise_locally`; ``steps == 0`` means plain RANSAC."""

    inner: int
    inner_size: int
    wide: float
    steps: int
    most: int


def _longest_chunk(rank: int, n_points: int) -> int:
    """Return how many samples fit into `CHUNK_SECONDS`: elimination goes with r^2, scoring with N r."""
    return max(1, int(CHUNK_SECONDS / (1e-7 + 5e-9 * rank**2 + 3e-10 * n_points * (rank + 1))))


def _in_chunks(task: Task, samples: int | None, confidence: float, local: _LocalOptimisation) -> Iterator[Step]:
    if samples is None:
        total = MAX_SAMPLES
        confidence = check_number(confidence, "confidence")
        if not 0.0 < confidence < 1.0:
            raise ValueError(f"confidence must lie between 0 and 1, both excluded, but it is {confidence}")
    else:
        total = check_count(samples, "samples", 1)
        confidence = 1.0  # never reached
    return _draw(task, total, confidence, local)


def _draw(task: Task, total: int, confidence: float, local: _LocalOptimisation) -> Iterator[Step]:
    At, b = task.rows.At, task.rows.b
    rank, n_points = At.shape
    scratch = allocate_scratch(At, seed_state(task.rng))
    best = np.zeros(rank)
    size, drawn = -1, 0
    chunk, longest = FIRST_CHUNK, _longest_chunk(rank, n_points)
    settings = (local.inner, local.inner_size, local.wide, local.steps, local.most, n_points >= PAUSE_FROM)
    while drawn < total:
        before, left = drawn, task.seconds_left()
        last = min(drawn + min(chunk, longest), total)
        found, drawn, confident = sample(At, b, task.limit, confidence, drawn, last, *settings, scratch, best, size)
        each = (left - task.seconds_left()) / max(drawn - before, 1) if left < np.inf else 0.0
        if found > max(size, 0):
            yield Step(subset=inlier_mask(task.rows, best, task.limit))
        else:
            yield Step()
        size = found
        if confident:
            return
        chunk *= 2
        if left < np.inf:  # no more than the time that is left lets one draw
            chunk = max(1, min(chunk, int(task.seconds_left() / max(each, 1e-9))))
