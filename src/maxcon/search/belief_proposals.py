"""Models to start from: minimal samples drawn from the belief, ranked, the best of them refined."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import compute_residuals
from maxcon.search.belief import RAW, SHARP, SHRINK, SOFT, Belief, cast_vote, nearness
from maxcon.search.gnc_kernels import descend, local_start
from maxcon.search.lane_kernels import LANES, solve_lanes
from maxcon.search.model_kernels import count_within, eliminate_point, substitute_back
from maxcon.search.random_kernels import draw_next, random_unit
from maxcon.search.sampling_kernels import Scratch

#: From so many points on, samples are ranked on `FEW` random ones first.
MANY, FEW = 400, 256

#: Where samples were ranked on some points, they are refined on those first, and on all points from this control
#: parameter of the loss on.
POLISH = 2.56

#: How many samples are kept by rank, and of these, how many are refined.
KEPT = 8


class Proposals(NamedTuple):
    """The proposals of a round.

    Attributes
    ----------
    models, scores
        Shapes (KEPT, r) and (KEPT,): best first; scores are soft counts of points.
    cumulative, guide
        Shape (N,): running sums of the weights of the draw, and where to begin to look among them.
    few_rows, few_b, few_r
        Shapes (r, m), (m,), (m,): the random points that samples are ranked on, m = 0 where all are.
    best
        Shape (r,): scratch space of the refinement.
    """

    models: NDArray[np.float64]
    scores: NDArray[np.float64]
    cumulative: NDArray[np.float64]
    guide: NDArray[np.int64]
    few_rows: NDArray[np.float64]
    few_b: NDArray[np.float64]
    few_r: NDArray[np.float64]
    best: NDArray[np.float64]


@kernel
def accumulate_weights(
    p: NDArray[np.float64],
    power: float,
    floor: float,
    cumulative: NDArray[np.float64],
    guide: NDArray[np.int64],
) -> None:
    """Write the running sums of the weights of the draw, p^power + floor, and their guide.

    ``guide[k]`` is the first point whose running sum is above k / N of all: a draw begins to look there, and is a step
    or two from its point (guide table, Chen and Asau 1974).
    """
    N = p.shape[0]
    total = 0.0
    for i in range(N):
        total += p[i] ** power + floor
        cumulative[i] = total
    point = 0
    for k in range(N):
        while point < N - 1 and cumulative[point] <= k * total / N:
            point += 1
        guide[k] = point


@kernel
def draw_weighted(cumulative: NDArray[np.float64], guide: NDArray[np.int64], state: NDArray[np.int64]) -> int:
    """Draw a point with the probability of its share of the running sums."""
    last = cumulative.shape[0] - 1
    share = random_unit(state)
    target, point = share * cumulative[last], guide[int(share * (last + 1))]
    while point < last and cumulative[point] <= target:
        point += 1
    return int(point)


@kernel
def draw_lanes(
    cumulative: NDArray[np.float64],
    guide: NDArray[np.int64],
    state: NDArray[np.int64],
    count: int,
    points: NDArray[np.int64],
) -> None:
    """Draw the points of the first `count` lanes, shape (r, LANES), by weight.

    All points of a lane are different, unless that takes too many draws.
    """
    d = points.shape[0]
    for lane in range(count):
        k = 0
        for _ in range(4 * d + 16):
            if k == d:
                break
            points[k, lane] = draw_weighted(cumulative, guide, state)
            known = False
            for other in range(k):
                known = known or points[other, lane] == points[k, lane]
            if not known:
                k += 1
        for other in range(k, d):
            points[other, lane] = points[0, lane]


@kernel
def sample_model(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    cumulative: NDArray[np.float64],
    guide: NDArray[np.int64],
    state: NDArray[np.int64],
    table: NDArray[np.float64],
    places: NDArray[np.int64],
    x: NDArray[np.float64],
) -> None:
    """Write into x the model through r independent points drawn by weight, as `minimal_model` does uniformly.

    A point that depends on those before it, as one that is drawn again does, is passed over.
    """
    d = At.shape[0]
    for j in range(d):
        places[j] = j
    rank = 0
    for _ in range(4 * d + 16):
        if rank == d:
            break
        if eliminate_point(At, b, draw_weighted(cumulative, guide, state), rank, table, places):
            rank += 1
    substitute_back(rank, table, places, x)


@kernel
def keep_best(models: NDArray[np.float64], scores: NDArray[np.float64], x: NDArray[np.float64], score: float) -> None:
    """Insert model x by its score, the worst one falls out."""
    last = scores.shape[0] - 1
    if score <= scores[last]:
        return
    place = last
    while place > 0 and scores[place - 1] < score:
        scores[place] = scores[place - 1]
        for j in range(x.shape[0]):
            models[place, j] = models[place - 1, j]
        place -= 1
    scores[place] = score
    for j in range(x.shape[0]):
        models[place, j] = x[j]


@kernel
def _choose_few(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    few_rows: NDArray[np.float64],
    few_b: NDArray[np.float64],
    pool: NDArray[np.int64],
    state: NDArray[np.int64],
) -> None:
    d, N = At.shape
    for m in range(few_b.shape[0]):
        i = draw_next(state, pool, m, N)
        few_b[m] = b[i]
        for j in range(d):
            few_rows[j, m] = At[j, i]


@kernel
def propose(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    limit: float,
    samples: int,
    power: float,
    floor: float,
    belief: Belief,
    proposals: Proposals,
    scratch: Scratch,
) -> None:
    """Draw samples from the belief, rank them, keep the best `KEPT`, and let them vote."""
    x, r = scratch.x, scratch.r
    state, table, places = scratch.state, scratch.table, scratch.places
    votes, totals, tops = belief.votes, belief.totals, belief.tops
    models, scores, cumulative, guide = proposals.models, proposals.scores, proposals.cumulative, proposals.guide
    few_rows, few_b, few_r, lanes = proposals.few_rows, proposals.few_b, proposals.few_r, scratch.lanes
    few = few_b.shape[0] > 0
    accumulate_weights(belief.p, power, floor, cumulative, guide)
    for k in range(KEPT):
        scores[k] = -1.0
    if few:
        _choose_few(At, b, few_rows, few_b, scratch.pool, state)
    for number in range(samples):
        lane = number % LANES
        if lane == 0:
            count = min(LANES, samples - number)
            draw_lanes(cumulative, guide, state, count, lanes.points)
            solve_lanes(At, b, count, lanes)
        if lanes.good[lane]:
            for j in range(x.shape[0]):
                x[j] = lanes.models[j, lane]
        else:
            sample_model(At, b, cumulative, guide, state, table, places, x)
        if few:
            compute_residuals(few_rows, few_b, x, few_r)
            keep_best(models, scores, x, nearness(few_r, limit, few_r))
        else:
            compute_residuals(At, b, x, r)
            score = nearness(r, limit, r)
            keep_best(models, scores, x, score)
            cast_vote(votes, totals, tops, RAW, score, r)
    if few:
        for k in range(KEPT):
            if scores[k] >= 0.0:
                compute_residuals(At, b, models[k], r)
                score = nearness(r, limit, r)
                cast_vote(votes, totals, tops, RAW, score, r)


@kernel
def refine_proposals(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    limit: float,
    count: int,
    local: float,
    belief: Belief,
    proposals: Proposals,
    scratch: Scratch,
    best: NDArray[np.float64],
    size: int,
) -> int:
    """Move the best `count` proposals to a local minimum of the loss, rank them again, let them vote.

    A minimum near them, from where residuals of `local` limits still count; infinity: from where half the points do.
    `best` takes any model met that explains more than `size` points; returns the new size.
    """
    d = At.shape[0]
    models, scores, x = proposals.models, proposals.scores, scratch.trial
    count = min(count, KEPT)
    for k in range(count):
        if scores[k] < 0.0:
            count = k
            break
    m = proposals.few_b.shape[0]
    brief = Scratch(
        scratch.state,
        scratch.pool,
        scratch.inliers,
        scratch.near,
        scratch.x,
        scratch.trial,
        scratch.r[:m],
        scratch.w[:m],
        scratch.weighted[:m],
        scratch.table,
        scratch.places,
        scratch.lanes,
        scratch.lane,
    )
    for k in range(count):
        for j in range(d):
            x[j] = models[k, j]
        control = local * local
        if local == np.inf:
            control = local_start(At, b, limit, scratch, x)
        if m > 0:
            descend(proposals.few_rows, proposals.few_b, limit, control, SHRINK, 1000, brief, x, proposals.best, -1)
            control = min(control, POLISH)
        found, _ = descend(At, b, limit, control, SHRINK, 1000, scratch, x, proposals.best, -1)
        if found > size:
            size = found
            for j in range(d):
                best[j] = proposals.best[j]
        for j in range(d):
            models[k, j] = x[j]
        count_there = count_within(scratch.r, limit)
        scores[k] = nearness(scratch.r, limit, scratch.r)
        cast_vote(belief.votes, belief.totals, belief.tops, SOFT, scores[k], scratch.r)
        cast_vote(belief.votes, belief.totals, belief.tops, SHARP, float(count_there), scratch.r)
    for k in range(1, count):  # by score, best first
        place = k
        while place > 0 and scores[place - 1] < scores[place]:
            scores[place - 1], scores[place] = scores[place], scores[place - 1]
            for j in range(d):
                models[place - 1, j], models[place, j] = models[place, j], models[place - 1, j]
            place -= 1
    for k in range(count, KEPT):
        scores[k] = -1.0
    return size


@kernel
def same_model(x: NDArray[np.float64], y: NDArray[np.float64], distance: float) -> bool:
    """Return whether the residuals of two models differ by less than `distance`, root mean square.

    The columns of whitened rows are orthogonal and of length sqrt(N): the distance of the models is that of
    their residuals.
    """
    total = 0.0
    for j in range(x.shape[0]):
        total += (x[j] - y[j]) ** 2
    return total < distance * distance
