"""A walk down the tree from a proposal: the peel network says which basis point to remove, until the rest fits.

The set S that the walk starts from holds the points near the proposal only, and the walk's fits see no others:
they work on copies of the rows of S, side by side in memory.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.agent.peel_features import write_peel_features
from maxcon.agent.perceptron import Perceptron, evaluate_row
from maxcon.minimax import Workspace
from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import FAILED, OK, basis_multipliers, basis_points, cold_fit, compute_residuals
from maxcon.minimax.refits import refit_after_removals
from maxcon.search.belief import Belief
from maxcon.search.random_kernels import random_below, random_unit


class Walk(NamedTuple):
    """Room for the rows of S, its vertex, and the network's inputs.

    Attributes
    ----------
    points
        Shape (N,): ``points[:m]`` are the points of S.
    At, b, gain, cap, r, work, table, C, x, q
        The parts of a `Workspace` of up to N points, flat where their shape depends on m.
    basis, named, multipliers, sides, features, hidden
        Shapes (d + 1,), ..., (d + 1, 12), (2, W): one step; `basis` are places in `points`, `named` the
        points there.
    log, log_basis
        Shapes (L, d + 1, 12) and (L, d + 1): the first L steps of the walk, as the network saw them; L = 0 keeps
        none.
    """

    points: NDArray[np.int64]
    At: NDArray[np.float64]
    b: NDArray[np.float64]
    gain: NDArray[np.float64]
    cap: NDArray[np.float64]
    r: NDArray[np.float64]
    work: NDArray[np.float64]
    table: NDArray[np.float64]
    C: NDArray[np.float64]
    x: NDArray[np.float64]
    q: NDArray[np.int64]
    basis: NDArray[np.int64]
    named: NDArray[np.int64]
    multipliers: NDArray[np.float64]
    sides: NDArray[np.float64]
    features: NDArray[np.float64]
    hidden: NDArray[np.float64]
    log: NDArray[np.float64]
    log_basis: NDArray[np.int64]


#: So many points more, one basis point more is removed in a step.
ONE_OF = 2000


@kernel
def choose_start(r: NDArray[np.float64], reach: float, points: NDArray[np.int64]) -> int:
    """Write the points with residuals up to `reach` into `points`; return how many there are."""
    m = 0
    for i in range(r.shape[0]):
        if abs(r[i]) <= reach:
            points[m] = i
            m += 1
    return m


@kernel
def walk_workspace(d: int, m: int, walk: Walk) -> Workspace:
    """Return the workspace of the m points of a walk."""
    return Workspace(
        walk.At[: d * m].reshape(d, m),
        walk.b[:m],
        walk.gain[:m],
        walk.cap[:m],
        walk.C,
        walk.x,
        walk.q,
        walk.r[:m],
        walk.work,
        walk.table,
    )


@kernel
def copy_rows(At: NDArray[np.float64], b: NDArray[np.float64], m: int, walk: Walk) -> Workspace:
    """Return a workspace of the rows of ``walk.points[:m]``, all of them in the fit."""
    ws = walk_workspace(At.shape[0], m, walk)
    points = walk.points
    for j in range(At.shape[0]):
        a, target = At[j], ws.At[j]
        for k in range(m):
            target[k] = a[points[k]]
    for k in range(m):
        ws.b[k] = b[points[k]]
        ws.gain[k] = 1.0
        ws.cap[k] = 0.0
    return ws


@kernel
def walk_down(
    At: NDArray[np.float64],
    b: NDArray[np.float64],
    limit: float,
    net: Perceptron,
    m: int,
    below: int,
    reach: float,
    proposal: NDArray[np.float64],
    proposal_share: float,
    explore: float,
    kept: NDArray[np.bool_],
    belief: Belief,
    state: NDArray[np.int64],
    walk: Walk,
) -> tuple[int, int, int]:
    """Remove basis points from the set of those of ``walk.points[:m]`` that the proposal reaches until it is feasible.

    Of many points several are removed in a step, as the network ranks them: what that costs comes back when points are
    added to the end of the walk.

    Parameters
    ----------
    limit
        Threshold plus slack, in the unit of the rows.
    m, below
        How many points the walk sees, and how many more its set has.
    reach
        Points with a larger residual of the proposal are not in the set.
    proposal, proposal_share
        Shape (N,): the residuals of the model that the set comes from, and the share of its inliers.
    explore
        How often a basis point is removed at random (for training).
    kept
        Shape (N,): points that are not removed, or shape (0,) for none. Those of a feasible set: every basis of an
        infeasible one holds another point.
    state
        The random state, used only to explore.

    Returns
    -------
    OK, or FAILED where a fit did; how many points were left out or removed, and the number of steps. The vertex
    reached is in ``walk.C``, ``walk.x``, ``walk.q`` (named by places in ``walk.points``) with ``walk.gain[:m]`` 1 for
    the points kept.
    """
    wAt, wb, gain, cap, C, x, q, r, work, table = copy_rows(At, b, m, walk)
    points, basis, named, multipliers, sides = walk.points, walk.basis, walk.named, walk.multipliers, walk.sides
    features, hidden, logit, known = walk.features, walk.hidden, belief.logit, belief.features
    n = x.shape[0]
    removed = steps = 0
    for k in range(m):
        if abs(proposal[points[k]]) > reach:
            gain[k] = 0.0
            cap[k] = np.inf
            removed += 1
    several = 1 + (m - removed) // ONE_OF
    if m == removed or cold_fit(wAt, wb, gain, cap, C, x, q, r, work, table) != OK:
        return FAILED, 0, 0
    while x[n - 1] > limit:
        size = basis_points(C, q, basis)
        if size == 0:
            return FAILED, removed, steps
        basis_multipliers(C, q, basis, multipliers)
        for slot in range(size):
            sides[slot] = 1.0 if r[basis[slot]] >= 0.0 else -1.0
            named[slot] = points[basis[slot]]
        share = (below + m - removed) / At.shape[1]
        write_peel_features(
            named,
            size,
            multipliers,
            sides,
            x[n - 1],
            limit,
            share,
            proposal,
            proposal_share,
            logit,
            known,
            features,
        )
        if steps < walk.log.shape[0]:
            _keep_log(features, named, size, walk.log[steps], walk.log_basis[steps])
        count = _best_rows(net, features, named, size, kept, hidden, several, multipliers, basis)
        if explore > 0.0 and random_unit(state) < explore:
            slot = random_below(state, size)
            basis[0], basis[slot] = basis[slot], basis[0]
        if refit_after_removals(wAt, wb, gain, cap, C, x, q, r, work, table, basis, count) != OK:
            return FAILED, removed, steps
        removed += count
        steps += 1
    return OK, removed, steps


@kernel
def _best_rows(
    net: Perceptron,
    features: NDArray[np.float64],
    named: NDArray[np.int64],
    size: int,
    kept: NDArray[np.bool_],
    hidden: NDArray[np.float64],
    several: int,
    logits: NDArray[np.float64],
    basis: NDArray[np.int64],
) -> int:
    """Move the points with the largest logits to the front of ``basis[:size]``; return how many, at most `several`.

    Points that are kept come last; one at least is in front. `logits` is scratch space.
    """
    free = 0
    for slot in range(size):
        logits[slot] = -np.inf
        if kept.shape[0] == 0 or not kept[named[slot]]:
            logits[slot] = evaluate_row(net, features[slot], hidden)
            free += 1
    count = max(min(several, free), 1)
    for place in range(count):
        best = place
        for slot in range(place + 1, size):
            if logits[slot] > logits[best]:
                best = slot
        logits[place], logits[best] = logits[best], logits[place]
        basis[place], basis[best] = basis[best], basis[place]
    return count


@kernel
def _keep_log(
    features: NDArray[np.float64],
    named: NDArray[np.int64],
    size: int,
    log: NDArray[np.float64],
    log_basis: NDArray[np.int64],
) -> None:
    for k in range(named.shape[0]):
        log_basis[k] = named[k] if k < size else -1
    for k in range(size):
        for f in range(features.shape[1]):
            log[k, f] = features[k, f]


@kernel
def install_walk(ws: Workspace, m: int, walk: Walk) -> None:
    """Put the vertex that a walk reached, and its set, into a workspace of all points."""
    n = ws.x.shape[0]
    for i in range(ws.gain.shape[0]):
        ws.gain[i] = 0.0
        ws.cap[i] = np.inf
    for k in range(m):
        if walk.gain[k] == 1.0:
            ws.gain[walk.points[k]] = 1.0
            ws.cap[walk.points[k]] = 0.0
    for j in range(n):
        for k in range(n):
            ws.C[j, k] = walk.C[j, k]
        ws.x[j] = walk.x[j]
        name = walk.q[j]
        ws.q[j] = name if name < 0 else 2 * walk.points[name >> 1] + (name & 1)
    compute_residuals(ws.At, ws.b, ws.x, ws.r)
