"""A box that holds a model of a best set, derived from the data: what makes a big-M formulation exact.

Everything is in whitened rows, ``|a_i . phi - b_i| <= limit`` with r independent parameters phi. Two arguments,
the second where the first gives no finite box:

By counting
    r points I with a regular A_I confine every model that explains them: with ``c = A_I^-1 b_I``, each |phi -
    c| is at most ``|A_I^-1| (limit, ..., limit)``. Take a family of such r-subsets: all of the data, or, where
    these are too many, all of each of g blocks into which the points are dealt. Let a model be known that
    explains K points; then a best set S has at least K, and q = K / g of them in a block on average. Since
    C(., r) is convex, S holds at least m = sum over the blocks of C(q, r) subsets of the family (q rounded up
    in K mod g blocks, else down). All m confine every model of S, whichever they are. So no model of S is
    above the m-th largest of the upper ends of the family, or below the m-th smallest of the lower ends;
    subsets that are not regular count as infinite. Now subsets whose models are all outside this box are none
    of the m, nor are those with a point that no model in the box explains. Without them the box is smaller,
    and so on until nothing changes.

By basic models
    If S is degenerate, its models can be unbounded. But take k = rank A_S and k columns J that span those of
    A_S: S has a model that is 0 outside J, and the models of this form are a polytope. Its vertices have k
    independent points I of S at the limit: ``phi_J = A_IJ^-1 (b_I +- limit)``. So the hull of 0 and of all
    these boxes, for all regular minors of A, holds a model of S.

A minor whose condition number is too large counts as singular. In the first argument that is sound whatever the
bound, and so is the allowance for rounding, which is added to the limit. In the second it leaves out models that
double precision cannot tell from noise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

#: How many minors are inverted at most.
MOST_MINORS = 200_000

#: For each argument: the largest condition number of a regular minor (in the maximum norm), and by how much of
#: |b| + limit the limit is raised for it: for the first, ten times what the rounding of its inverse can do.
COUNTED, BASIC = (1e8, 1e-6), (1e12, 1e-2)

#: A row of a minor that is this small, relative to the largest entry of all, is rounding of zeros.
ZERO = 1e-12

#: Rounding of a residual, relative to the sizes of its terms, with room to spare.
ROUNDING = 1e-9

#: Minors inverted in one go.
BATCH = 20_000

#: Subsets drawn where all would be too many.
GUESSES = 2_000

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


class Box(NamedTuple):
    """Bounds on the parameters.

    Attributes
    ----------
    low, high
        Shape (r,): a best set has a model between them if `proven`.
    proven
        False where the data are too many and too degenerate for both arguments; the box is a guess then.
    """

    low: Floats
    high: Floats
    proven: bool


def model_box(At: Floats, b: Floats, limit: float, known: int, tight: float, rng: np.random.Generator) -> Box:
    """Return a box that holds a model of a best set.

    Parameters
    ----------
    At, b
        Whitened rows, shapes (r, N) and (N,), r >= 1.
    limit
        The largest residual of an inlier, in the unit of the rows.
    known
        A consensus that is reached.
    tight
        The box need not shrink further once no residual within it is larger than this, but for points that no
        model within it explains.
    rng
        Deals the points into blocks.
    """
    r, N = At.shape
    blocks = _blocks(N, r, rng)
    few = len(blocks) * math.comb(len(blocks[0]), r) <= MOST_MINORS
    if few:
        subsets = np.concatenate([_subsets(block, r) for block in blocks])
    else:
        subsets = np.stack([rng.choice(N, r, replace=False) for _ in range(GUESSES)])
    centres, halves = _confined(At, b, limit, subsets, np.arange(r), COUNTED)
    if few:
        box = _counted(At, b, limit, subsets, (centres - halves, centres + halves), _held(known, len(blocks), r), tight)
        if box is not None:
            return Box(*box, True)
    if math.comb(N + r, r) <= MOST_MINORS:
        return Box(*_basic_models(At, b, limit), True)
    regular = np.isfinite(halves[:, 0])
    low = np.quantile((centres - halves)[regular], 0.01, axis=0) if regular.any() else np.full(r, -1.0)
    high = np.quantile((centres + halves)[regular], 0.99, axis=0) if regular.any() else np.full(r, 1.0)
    return Box(np.minimum(low, 0.0), np.maximum(high, 0.0), False)


def _blocks(N: int, r: int, rng: np.random.Generator) -> list[Integers]:
    """Deal the points into as few blocks of almost equal size as `MOST_MINORS` allows, of more than r points."""
    count = 1
    while count * math.comb(-(-N // count), r) > MOST_MINORS and N // (count + 1) > r:
        count += 1
    order = rng.permutation(N)
    return [np.sort(order[k::count]) for k in range(count)]


def _subsets(points: Integers, size: int) -> Integers:
    return points[np.array(list(combinations(range(len(points)), size)), dtype=np.int64)]


def _held(known: int, blocks: int, r: int) -> int:
    """Return how many r-subsets within blocks a set of `known` points holds at least."""
    q, more = divmod(known, blocks)
    return (blocks - more) * math.comb(q, r) + more * math.comb(q + 1, r)


def _counted(
    At: Floats,
    b: Floats,
    limit: float,
    subsets: Integers,
    ends: tuple[Floats, Floats],
    held: int,
    tight: float,
) -> tuple[Floats, Floats] | None:
    """Return the box that `held` of the subsets give, whichever they are, or None if it is not finite."""
    if held == 0:
        return None
    lows, highs = ends
    sizes = np.abs(At)
    box = None
    while len(lows) >= held:
        low = np.partition(lows, held - 1, axis=0)[held - 1]
        high = -np.partition(-highs, held - 1, axis=0)[held - 1]
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            break
        box = low, high
        centre, half = 0.5 * (low + high), np.maximum(0.5 * (high - low), 0.0)
        at_centre, spread = np.abs(centre @ At - b), half @ sizes
        doubt = ROUNDING * (np.abs(centre) @ sizes + spread + np.abs(b) + limit)
        possible = at_centre - spread <= limit + doubt
        if (at_centre + spread)[possible].max(initial=0.0) <= tight:
            break
        stays = ((lows <= high) & (highs >= low)).all(axis=1) & possible[subsets].all(axis=1)
        if stays.all():
            break
        subsets, lows, highs = subsets[stays], lows[stays], highs[stays]
    return box


def _batches(count: int) -> Iterator[slice]:
    for begin in range(0, count, BATCH):
        yield slice(begin, min(begin + BATCH, count))


def _confined(
    At: Floats, b: Floats, limit: float, subsets: Integers, columns: Integers, care: tuple[float, float]
) -> tuple[Floats, Floats]:
    """Return centre and half width of the parameters `columns`, all others 0, that points I within the limit allow.

    Shapes (len(subsets), k) each; the half widths are infinite where the minor is singular.
    """
    largest, allowance = care
    k = len(columns)
    centres, halves = np.zeros((len(subsets), k)), np.full((len(subsets), k), np.inf)
    rows = At[columns].T
    for batch in _batches(len(subsets)):
        chosen = subsets[batch]
        minors = rows[chosen]
        scales = np.abs(minors).max(axis=2)  # of the rows: the condition must not hang on them
        good = np.flatnonzero(scales.min(axis=1) > ZERO * np.abs(At).max())
        scaled = minors[good] / scales[good][:, :, None]
        good_det = np.abs(np.linalg.det(scaled)) > 1e-30
        good, scaled = good[good_det], scaled[good_det]
        inverses = np.linalg.inv(scaled)
        condition = np.abs(scaled).sum(axis=2).max(axis=1) * np.abs(inverses).sum(axis=2).max(axis=1)
        good, inverses = good[condition <= largest], inverses[condition <= largest]
        inverses = inverses / scales[good][:, None, :]
        target = batch.start + good
        centres[target] = np.einsum("ijk,ik->ij", inverses, b[chosen[good]])
        reach = limit + allowance * (np.abs(b[chosen[good]]) + limit)
        halves[target] = np.einsum("ijk,ik->ij", np.abs(inverses), reach)
    return centres, halves


def _basic_models(At: Floats, b: Floats, limit: float) -> tuple[Floats, Floats]:
    r, N = At.shape
    low, high = np.zeros(r), np.zeros(r)
    for k in range(1, r + 1):
        subsets = _subsets(np.arange(N), k)
        for columns in _subsets(np.arange(r), k):
            centres, halves = _confined(At, b, limit, subsets, columns, BASIC)
            regular = np.isfinite(halves[:, 0])
            low[columns] = np.minimum(low[columns], (centres - halves)[regular].min(axis=0, initial=0.0))
            high[columns] = np.maximum(high[columns], (centres + halves)[regular].max(axis=0, initial=0.0))
    return low, high
