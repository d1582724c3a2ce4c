"""What is believed of each point: the root models, the votes of proposals, and the point network's update.

The belief is a probability for each point that it is an inlier of the best model. It starts from two models of
all points (L1 by reweighting, Geman-McClure by graduated non-convexity) and the leverage, and is updated each round
from the votes of the models met so far and from the incumbent.
"""

from __future__ import annotations

from math import exp
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.agent.perceptron import Perceptron, evaluate_columns
from maxcon.agent.point_features import write_root_features, write_round_features
from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import compute_residuals
from maxcon.minimax.sums import total_of
from maxcon.search.gnc_kernels import descend, global_start, least_absolute_model
from maxcon.search.sampling_kernels import Scratch

#: The three ballots: raw proposals, and refined ones twice.
RAW, SOFT, SHARP = 0, 1, 2

#: How fast the weight of a vote falls with each point that its model explains less than the best.
TEMPERATURES = (0.3, 0.2, 1.0)

#: A vote that weighs less than exp(-this) is not cast.
MOST_LACK = 6.0

#: How far a vote reaches, in units of the limit: the truncation of the quadratic by which proposals are scored.
REACH = 2.0

#: Reweightings towards the L1 fit at the root.
L1_STEPS = 12

#: What the parameter of a Geman-McClure continuation is divided by after each of its fits.
SHRINK = 1.6

#: Logits are kept within this.
MOST_LOGIT = 12.0


class Belief(NamedTuple):
    """The belief, and what it is made from.

    Attributes
    ----------
    features
        Shape (18, N): see `maxcon.agent.point_features`.
    votes, totals, tops
        Shapes (3, N), (3,), (3,): sums of votes, of their weights, and the best score on each ballot.
    logit, p
        Shape (N,): the belief.
    hidden, bins
        Scratch space.
    """

    features: NDArray[np.float64]
    votes: NDArray[np.float64]
    totals: NDArray[np.float64]
    tops: NDArray[np.float64]
    logit: NDArray[np.float64]
    p: NDArray[np.float64]
    hidden: NDArray[np.float64]
    bins: NDArray[np.int64]


@kernel
def root_models(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    limit: float,
    scratch: Scratch,
    l1: NDArray[np.float64],
    gnc: NDArray[np.float64],
) -> int:
    """Write the L1 fit and the best model of a Geman-McClure continuation; return the consensus of the latter."""
    x = scratch.x
    for j in range(x.shape[0]):
        x[j] = 0.0
        l1[j] = 0.0
        gnc[j] = 0.0
    least_absolute_model(At, b, 0.1 * limit, L1_STEPS, scratch, l1)
    control = max(global_start(At, b, limit, scratch, x), 1.0)
    size, _ = descend(At, b, limit, control, SHRINK, 1000, scratch, x, gnc, -1)
    return size


@kernel
def start_belief(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    limit: float,
    scratch: Scratch,
    l1: NDArray[np.float64],
    gnc: NDArray[np.float64],
    belief: Belief,
) -> None:
    """Write the features of the root models."""
    compute_residuals(At, b, l1, scratch.r)
    compute_residuals(At, b, gnc, scratch.w)
    write_root_features(At, scratch.r, scratch.w, limit, belief.bins, belief.features)


@kernel
def nearness(r: NDArray[np.float64], limit: float, near: NDArray[np.float64]) -> float:
    """Write max(0, 1 - (r / 2 limit)^2) for each residual; return the sum, a count in which near points count more.

    `near` may be r itself.
    """
    scale = 1.0 / (REACH * limit * REACH * limit)
    for i in range(r.shape[0]):
        value = 1.0 - r[i] * r[i] * scale
        near[i] = value if value > 0.0 else 0.0
    return total_of(near[: r.shape[0]])


@kernel
def cast_vote(
    votes: NDArray[np.float64],
    totals: NDArray[np.float64],
    tops: NDArray[np.float64],
    ballot: int,
    score: float,
    near: NDArray[np.float64],
) -> None:
    """Let a model vote for the points near it (see `nearness`), with a weight that falls with its lack of score.

    The weights are relative to the best score so far: where a better one comes, all earlier votes shrink. The first
    three arrays are those of `Belief` (handing over a tuple of arrays costs more than the vote).
    """
    temperature = TEMPERATURES[ballot]
    row = votes[ballot]
    N = near.shape[0]
    if score > tops[ballot]:
        shrink = exp(temperature * (tops[ballot] - score))
        for i in range(N):
            row[i] *= shrink
        totals[ballot] *= shrink
        tops[ballot] = score
    elif temperature * (tops[ballot] - score) > MOST_LACK:
        return
    weight = exp(temperature * (score - tops[ballot]))
    for i in range(N):
        row[i] += weight * near[i]
    totals[ballot] += weight


@kernel
def forget_votes(belief: Belief) -> None:
    """Empty the ballots, so that the search looks elsewhere; root and incumbent are still known."""
    for k in range(3):
        belief.totals[k] = 0.0
        belief.tops[k] = 0.0
        for i in range(belief.votes.shape[1]):
            belief.votes[k, i] = 0.0


@kernel
def update_belief(net: Perceptron, number: int, belief: Belief) -> None:
    """Let the point network judge all points anew, in round `number`."""
    write_round_features(belief.votes, belief.totals, number, belief.features)
    evaluate_columns(net, belief.features, belief.hidden, belief.logit)
    logit, p = belief.logit, belief.p
    for i in range(p.shape[0]):
        logit[i] = min(max(logit[i], -MOST_LOGIT), MOST_LOGIT)
        p[i] = 1.0 / (1.0 + exp(-logit[i]))


@kernel
def agreement(p: NDArray[np.float64], member: NDArray[np.bool_]) -> tuple[float, int]:
    """Return the mean probability of the members, and how many others have more than one half."""
    total = 0.0
    count = 0
    doubts = 0
    for i in range(member.shape[0]):
        if member[i]:
            total += p[i]
            count += 1
        elif p[i] > 0.5:
            doubts += 1
    return total / max(count, 1), doubts
