"""Deterministic data for the tests: the paper's protocol, and families that break naive solvers.

A builder takes (rng, N, d) and returns (A, b), A (N, d) and b (N,), C-contiguous float64. It may change N or
d where its subject asks for it. `FAMILIES` draws the sizes too. Dependent columns are dependent exactly, in
floats: what they are made from lies on a dyadic grid, so that sums and small products do not round. Otherwise
the exact minimax fit would fit the rounding noise, and no method in double precision could agree with it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Instance = tuple[Floats, Floats]
Rng = np.random.Generator
Builder = Callable[[Rng, int, int], Instance]

SMALL, LARGE = 60, 200  # N is drawn up to SMALL, and is LARGE once in ten


def draw_size(rng: Rng) -> tuple[int, int]:
    """Draw N and d: d in 1..8, N in d + 1..60, or 200 once in ten."""
    d = int(rng.integers(1, 9))
    return (LARGE if rng.random() < 0.1 else int(rng.integers(d + 1, SMALL + 1))), d


def _instance(A: npt.ArrayLike, b: npt.ArrayLike) -> Instance:
    return np.ascontiguousarray(A, dtype=np.float64), np.ascontiguousarray(b, dtype=np.float64)


def _grid(rng: Rng, *shape: int) -> Floats:
    """Sixteenths in [-4, 4]."""
    return rng.integers(-64, 65, shape) / 16.0


# ----------------------------------------------------------------------------------------- ordinary data


def random_instance(rng: Rng, N: int, d: int) -> Instance:
    """Gaussian rows, a plane with noise, and a fifth of the points far off it."""
    A = rng.standard_normal((N, d))
    b = A @ rng.standard_normal(d) + 0.1 * rng.standard_normal(N)
    b += (rng.random(N) < 0.2) * rng.uniform(-5, 5, N)
    return _instance(A, b)


def synthetic(rng: Rng, N: int, d: int, outlier_rate: float) -> Instance:
    """Draw the paper's synthetic protocol, meant for the threshold 0.1.

    a_i is uniform in [-1, 1]^(d-1) with a last column of ones, theta uniform in [-1, 1]^d, inlier noise
    uniform in [-0.1, 0.1]; round(outlier_rate N) points are moved by a uniform draw from
    [-5, -0.1) u (0.1, 5] instead.
    """
    A = np.hstack([rng.uniform(-1, 1, (N, d - 1)), np.ones((N, 1))])
    noise = rng.uniform(-0.1, 0.1, N)
    outliers = rng.permutation(N)[: round(outlier_rate * N)]
    sizes = 5.0 - rng.uniform(0.0, 4.9, len(outliers))  # in (0.1, 5]
    noise[outliers] = rng.choice([-1.0, 1.0], len(outliers)) * sizes
    return _instance(A, A @ rng.uniform(-1, 1, d) + noise)


def uniform_noise(rng: Rng, N: int, d: int) -> Instance:
    """b has nothing to do with A."""
    return _instance(rng.uniform(-1, 1, (N, d)), rng.uniform(-1, 1, N))


def synthetic_some(rng: Rng, N: int, d: int) -> Instance:
    """The paper's protocol at a rate in 0.1..0.8."""
    return synthetic(rng, N, d, float(rng.uniform(0.1, 0.8)))


# ------------------------------------------------------------------------------------------------- ties


def quantised(rng: Rng, N: int, d: int) -> Instance:
    """Small integers everywhere: many ties, duplicates and singular bases."""
    return _instance(rng.integers(-3, 4, (N, d)), rng.integers(-5, 6, N))


def quantised_halves(rng: Rng, N: int, d: int) -> Instance:
    """Halves, with an intercept."""
    A = rng.integers(-6, 7, (N, d)) / 2.0
    A[:, -1] = 1.0
    b = np.round(2 * (A @ rng.integers(-2, 3, d) + rng.uniform(-2, 2, N))) / 2
    return _instance(A, b)


def tenths(rng: Rng, N: int, d: int) -> Instance:
    """Tenths: ties on paper that floats break by one rounding."""
    A = rng.integers(-10, 11, (N, d)) / 10.0
    A[:, -1] = 1.0
    return _instance(A, rng.integers(-20, 21, N) / 10.0)


def grid_points(rng: Rng, N: int, d: int) -> Instance:
    """The points 0, 1, 2, ... in each coordinate, shuffled, with an intercept: equal spacing, symmetric."""
    A = np.stack([rng.permutation(N) for _ in range(d)], axis=1).astype(float)
    A[:, -1] = 1.0
    return _instance(A, rng.integers(-3, 4, N))


def duplicate_rows(rng: Rng, N: int, d: int) -> Instance:
    """Each point about three times."""
    A, b = random_instance(rng, max(d + 1, N // 3), d)
    copies = np.r_[np.arange(len(b)), rng.integers(0, len(b), max(N - len(b), 0))]
    rng.shuffle(copies)
    return _instance(A[copies], b[copies])


def duplicate_a(rng: Rng, N: int, d: int) -> Instance:
    """Each a_i about three times, with another b: bases of two points."""
    A, b = duplicate_rows(rng, N, d)
    return _instance(A, b + rng.uniform(-1, 1, len(b)))


def opposite_rows(rng: Rng, N: int, d: int) -> Instance:
    """Each row beside its mirror image (-a, -b), the same constraint again."""
    A, b = random_instance(rng, max(d + 1, N // 2), d)
    rows = rng.permutation(2 * len(b))
    return _instance(np.vstack([A, -A])[rows], np.r_[b, -b][rows])


# --------------------------------------------------------------------------------------- deficient rank


def repeated_column(rng: Rng, N: int, d: int) -> Instance:
    """The last column repeats the first."""
    A, b = random_instance(rng, N, d)
    A[:, -1] = A[:, 0]
    return _instance(A, b)


def zero_column(rng: Rng, N: int, d: int) -> Instance:
    """One column is 0; for d = 1 that is all of A."""
    A, b = random_instance(rng, N, d)
    A[:, rng.integers(d)] = 0.0
    return _instance(A, b)


def dependent_column(rng: Rng, N: int, d: int) -> Instance:
    """The last column is a combination of the others, with integer weights."""
    A = _grid(rng, N, d)
    A[:, -1] = A[:, :-1] @ rng.integers(-3, 4, d - 1)
    return _instance(A, rng.standard_normal(N))


def low_dimensional(rng: Rng, N: int, d: int) -> Instance:
    """All a_i in one subspace, of about half the dimension."""
    k = (d + 1) // 2
    return _instance(_grid(rng, N, k) @ rng.integers(-2, 3, (k, d)), rng.standard_normal(N))


def collinear_most(rng: Rng, N: int, d: int) -> Instance:
    """All but d a_i on one line through 0: nearly every choice of d rows is singular."""
    A = rng.integers(-8, 9, (N, 1)) * rng.integers(1, 4, d)
    few = rng.permutation(N)[:d]
    A[few] = rng.integers(-8, 9, (d, d))
    return _instance(A, _grid(rng, N))


def zero_rows(rng: Rng, N: int, d: int) -> Instance:
    """A quarter of the a_i are 0: their residual is |b_i| whatever theta is."""
    A, b = random_instance(rng, N, d)
    A[rng.random(N) < 0.25] = 0.0
    return _instance(A, b)


def one_x(rng: Rng, N: int, d: int) -> Instance:
    """Two groups, each at one a: rank 2, or 1 for d = 1."""
    groups = rng.integers(-4, 5, (2, d)).astype(float)
    return _instance(groups[rng.integers(0, 2, N)], _grid(rng, N))


# -------------------------------------------------------------------------------------- size and scaling


def minimal(rng: Rng, N: int, d: int) -> Instance:
    """N = d + 1: one basis is all there is."""
    return random_instance(rng, d + 1, d)


def bad_column(rng: Rng, N: int, d: int) -> Instance:
    """One column is a million times larger than the next."""
    A, b = random_instance(rng, N, d)
    A[:, rng.integers(d)] *= 1e6
    return _instance(A, b)


def graded_columns(rng: Rng, N: int, d: int) -> Instance:
    """Column sizes from 1e-6 to 1e6."""
    A, b = random_instance(rng, N, d)
    return _instance(A * np.logspace(-6, 6, d), b)


def tiny(rng: Rng, N: int, d: int) -> Instance:
    """All of it times 1e-6."""
    A, b = random_instance(rng, N, d)
    return _instance(A * 1e-6, b * 1e-6)


def huge(rng: Rng, N: int, d: int) -> Instance:
    """All of it times 1e6."""
    A, b = random_instance(rng, N, d)
    return _instance(A * 1e6, b * 1e6)


def years(rng: Rng, N: int, d: int) -> Instance:
    """Years 1950-1973 and an intercept (last column), with other columns between: large offsets."""
    A = rng.uniform(-1, 1, (N, max(d, 2)))
    A[:, 0] = rng.integers(1950, 1974, N)
    A[:2, 0] = 1950, 1973
    A[:, -1] = 1.0
    return _instance(A, 0.1 * (A[:, 0] - 1950) + rng.choice([0.1, 10.0], N, p=[0.8, 0.2]) * rng.random(N))


def large_offset(rng: Rng, N: int, d: int) -> Instance:
    """Every column 1000 +- 1, and b beside an offset of 1e4."""
    A = 1000.0 + rng.uniform(-1, 1, (N, d))
    A[:, -1] = 1.0
    return _instance(A, 1e4 + rng.standard_normal(N))


def clustered(rng: Rng, N: int, d: int) -> Instance:
    """A few tight clusters (radius 1e-3) of points."""
    A = rng.uniform(-1, 1, (d + 2, d))[rng.integers(0, d + 2, N)] + 1e-3 * rng.standard_normal((N, d))
    return _instance(A, A @ rng.uniform(-1, 1, d) + 0.1 * rng.standard_normal(N))


def one_cluster(rng: Rng, N: int, d: int) -> Instance:
    """All points within 1e-3 of one, beside an intercept: nearly dependent columns."""
    A = rng.uniform(1, 2, d) + 1e-3 * rng.standard_normal((N, d))
    A[:, -1] = 1.0
    return _instance(A, rng.standard_normal(N))


def far_outliers(rng: Rng, N: int, d: int) -> Instance:
    """A fifth of the points are off by up to 1e6, at least one."""
    A, b = synthetic(rng, N, d, 0.0)
    off = rng.random(N) < 0.2
    off[rng.integers(N)] = True
    return _instance(A, b + off * rng.uniform(-1e6, 1e6, N))


def leverage(rng: Rng, N: int, d: int) -> Instance:
    """A tenth of the rows (a, b) are 1e4 times longer than the rest, at least one."""
    A, b = random_instance(rng, N, d)
    long = rng.random(N) < 0.1
    long[rng.integers(N)] = True
    return _instance(np.where(long[:, None], 1e4, 1.0) * A, np.where(long, 1e4, 1.0) * b)


def leverage_outliers(rng: Rng, N: int, d: int) -> Instance:
    """A tenth of the a_i are 1e3 times longer, but b knows nothing of it: they pull any fit to theirs."""
    A, b = random_instance(rng, N, d)
    A[rng.random(N) < 0.1] *= 1e3
    return _instance(A, b)


def vandermonde(rng: Rng, N: int, d: int) -> Instance:
    """Polynomials of degree d - 1 on [-1, 1]: ordered points, alternating bases."""
    x = np.sort(rng.uniform(-1, 1, N))
    return _instance(np.vander(x, d), np.exp(x) + 0.01 * rng.standard_normal(N))


def chebyshev(rng: Rng, N: int, d: int) -> Instance:
    """A smooth function by a polynomial, points equally spaced: symmetric, f down to 1e-7, no noise."""
    x = np.linspace(-1, 1, N)
    return _instance(np.vander(x, d), np.cos(2 * x + rng.random()))


# ------------------------------------------------------------------------------------------- special b


def constant_b(rng: Rng, N: int, d: int) -> Instance:
    """B is one number, and no column is constant."""
    return _instance(rng.standard_normal((N, d)), np.full(N, rng.standard_normal()))


def linear_b(rng: Rng, N: int, d: int) -> Instance:
    """B is exactly linear in a, without rounding: f = 0."""
    A = _grid(rng, N, d)
    return _instance(A, A @ rng.integers(-4, 5, d))


def linear_b_rounded(rng: Rng, N: int, d: int) -> Instance:
    """B is linear up to rounding: f is about 1e-17."""
    A = rng.standard_normal((N, d))
    return _instance(A, A @ rng.standard_normal(d))


def linear_but_one(rng: Rng, N: int, d: int) -> Instance:
    """B is exactly linear but for one point: f = 0 as soon as it goes."""
    A, b = linear_b(rng, N, d)
    b[rng.integers(N)] += 1.0
    return _instance(A, b)


def zero_b(rng: Rng, N: int, d: int) -> Instance:
    """B is 0: theta = 0 and f = 0."""
    return _instance(rng.standard_normal((N, d)), np.zeros(N))


def zero_a(rng: Rng, N: int, d: int) -> Instance:
    """A is 0: f = max|b|."""
    return _instance(np.zeros((N, d)), rng.standard_normal(N))


def two_structures(rng: Rng, N: int, d: int) -> Instance:
    """Half the points on one plane, half on another."""
    A, b = synthetic(rng, N, d, 0.0)
    return _instance(A, np.where(rng.random(N) < 0.5, b, A @ rng.uniform(-1, 1, d)))


BUILDERS: dict[str, Builder] = {
    builder.__name__: builder
    for builder in (
        random_instance,
        synthetic_some,
        uniform_noise,
        quantised,
        quantised_halves,
        tenths,
        grid_points,
        duplicate_rows,
        duplicate_a,
        opposite_rows,
        repeated_column,
        zero_column,
        dependent_column,
        low_dimensional,
        collinear_most,
        zero_rows,
        one_x,
        minimal,
        bad_column,
        graded_columns,
        tiny,
        huge,
        years,
        large_offset,
        clustered,
        one_cluster,
        far_outliers,
        leverage,
        leverage_outliers,
        vandermonde,
        chebyshev,
        constant_b,
        linear_b,
        linear_b_rounded,
        linear_but_one,
        zero_b,
        zero_a,
        two_structures,
    )
}
"""Builders by name, where a test sets N and d."""


def _drawing(builder: Builder) -> Callable[[Rng], Instance]:
    def draw(rng: Rng) -> Instance:
        N, d = draw_size(rng)
        return builder(rng, N, d)

    draw.__name__, draw.__doc__ = builder.__name__, builder.__doc__
    return draw


FAMILIES: dict[str, Callable[[Rng], Instance]] = {name: _drawing(build) for name, build in BUILDERS.items()}
"""The same, where N and d are drawn as well."""
