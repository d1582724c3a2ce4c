"""The paper's synthetic protocol for lines, planes and hyperplanes (section 4.1).

To the letter: N points a_i, a random model, ``b_i = a_i . theta``; of the N points, N_o chosen at random become
outliers, their b_i corrupted by noise uniform in [-5, -0.1) or (0.1, 5]; the others by noise uniform in [-0.1, 0.1];
the threshold is 0.1. What the paper leaves open is chosen here: every coordinate of a_i and of the model is uniform in
[-1, 1] (consensus does not depend on the scale of either), the intercept is the last parameter, and
``N_o = round(rate * N)``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from maxcon.problem import LinearProblem, hyperplane, line, plane

#: The inlier threshold of the protocol, and the size of the inliers' noise.
THRESHOLD = 0.1

#: The largest corruption of an outlier.
LARGEST_OUTLIER = 5.0

Sampler = Callable[[np.random.Generator], LinearProblem]


def synthetic_hyperplane(rng: np.random.Generator, n_points: int, outlier_rate: float, n_params: int) -> LinearProblem:
    """Return a random problem with `n_params` parameters, the last an intercept, from the paper's protocol.

    Parameters
    ----------
    rng
        Draws everything.
    n_points
        How many points (N), at least d + 1.
    outlier_rate
        The part of the points that are outliers, 0 to 1.
    n_params
        How many parameters (d), at least 2.

    Raises
    ------
    ValueError
        If a number is out of its range; the message names it.
    """
    if n_params < 2:
        raise ValueError(f"n_params must be at least 2, but it is {n_params}")
    if n_points < n_params + 1:
        raise ValueError(f"n_points must be at least d + 1 = {n_params + 1}, but it is {n_points}")
    if not 0.0 <= outlier_rate <= 1.0:
        raise ValueError(f"outlier_rate must be between 0 and 1, but it is {outlier_rate}")
    X = rng.uniform(-1.0, 1.0, (n_points, n_params - 1))
    theta = rng.uniform(-1.0, 1.0, n_params)
    y = X @ theta[:-1] + theta[-1]
    outlier = np.zeros(n_points, dtype=np.bool_)
    outlier[rng.permutation(n_points)[: round(outlier_rate * n_points)]] = True
    size = rng.uniform(THRESHOLD, LARGEST_OUTLIER, n_points)
    sign = rng.choice([-1.0, 1.0], n_points)
    y += np.where(outlier, sign * size, rng.uniform(-THRESHOLD, THRESHOLD, n_points))
    if n_params == 2:
        return line(X[:, 0], y)
    if n_params == 3:
        return plane(X[:, 0], X[:, 1], y)
    return hyperplane(X, y)


def mixed_rates(n_points: int, n_params: int, low: float = 0.01, high: float = 0.40) -> Sampler:
    """Return a sampler of training problems: the outlier rate of each is uniform in [low, high] (section 3.5)."""

    def sample(rng: np.random.Generator) -> LinearProblem:
        return synthetic_hyperplane(rng, n_points, float(rng.uniform(low, high)), n_params)

    return sample
