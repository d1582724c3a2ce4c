"""The memory of a learned search: three blocks outside, sixty named arrays inside.

A kernel that is handed sixty arrays spends some 20 us on taking them from Python, as long as a walk down the tree.
Handed the three blocks, it cuts the arrays out of them itself, in less than 1 us.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.agent.peel_features import N_PEEL_FEATURES
from maxcon.agent.perceptron import BLOCK, Perceptron
from maxcon.agent.point_features import BINS, N_POINT_FEATURES
from maxcon.minimax import LinearRows, Workspace
from maxcon.minimax.jit import kernel
from maxcon.search.belief import Belief
from maxcon.search.belief_proposals import FEW, KEPT, MANY, Proposals
from maxcon.search.lane_kernels import LANES, Lanes
from maxcon.search.peel_walk import Walk
from maxcon.search.refine_kernels import RefineScratch
from maxcon.search.sampling_kernels import Scratch
from maxcon.search.trial_kernels import NearRows
from maxcon.search.vertex_kernels import VertexCopies

#: How many starts of walks are remembered, so that none is made twice.
MEMORY = 16

#: Places in `Search.counts`: the size of the incumbent, the number of the round, rounds without progress, how the
#: incumbent has been swapped, whether its vertex is kept, walks made, steps of the last walk, whether the
#: incumbent has been walked from, how much of each block `carve` uses, the mean belief in the incumbent's points in
#: thousandths, and the number of points outside the incumbent that are believed in.
SIZE, ROUND, STALL, SWAPPED, PLACED, WALKS, STEPS, WALKED = 0, 1, 2, 3, 4, 5, 6, 7
FLOATS_USED, INTEGERS_USED, FLAGS_USED = 8, 9, 10
AGREEMENT, DOUBTS = 11, 12
N_COUNTS = 16

#: How the incumbent has been swapped, in ``counts[SWAPPED]``, where it has: among the points of its window (see
#: `window`), or among all.
IN_WINDOW, WHOLLY = 1, 2


class Arena(NamedTuple):
    """All that a kernel of the search needs, in few arrays.

    Attributes
    ----------
    At, b
        The whitened rows, shapes (r, N) and (N,).
    state
        Shape (4,): the random state.
    floats, integers, flags
        Blocks of float64, int64 and bool; the first `N_COUNTS` integers are `Search.counts`, the first N flags the
        points of the incumbent.
    point_net, peel_net
        The networks.
    log_steps
        How many steps of a walk are kept, for training.
    """

    At: NDArray[np.float64]
    b: NDArray[np.float64]
    state: NDArray[np.int64]
    floats: NDArray[np.float64]
    integers: NDArray[np.int64]
    flags: NDArray[np.bool_]
    point_net: Perceptron
    peel_net: Perceptron
    log_steps: int


class Search(NamedTuple):
    """All that a search knows.

    Attributes
    ----------
    ws, refinement
        Workspace of all points, and scratch space of the refinement kernels.
    scratch, belief, proposals, walk
        See `sampling_kernels`, `belief`, `belief_proposals` and `peel_walk`.
    point_net, peel_net
        The networks.
    member, x, vertex
        The incumbent: its points, shape (N,), a model that proves them feasible, shape (r,), and its vertex, one
        level, where ``counts[PLACED]``.
    l1, gnc
        Shape (r,): the root models.
    trial
        Shape (N,): the residuals of the start of a walk.
    starts
        Shape (MEMORY, r): where walks started.
    counts
        Integers, by the names above.
    """

    ws: Workspace
    refinement: RefineScratch
    scratch: Scratch
    belief: Belief
    proposals: Proposals
    walk: Walk
    point_net: Perceptron
    peel_net: Perceptron
    member: NDArray[np.bool_]
    x: NDArray[np.float64]
    vertex: VertexCopies
    l1: NDArray[np.float64]
    gnc: NDArray[np.float64]
    trial: NDArray[np.float64]
    starts: NDArray[np.float64]
    counts: NDArray[np.int64]


def allocate_arena(
    rows: LinearRows, state: NDArray[np.int64], point_net: Perceptron, peel_net: Perceptron, log_steps: int = 0
) -> Arena:
    """Return the memory of a search on `rows` that has not begun; `state` is its random state."""
    d, N = rows.At.shape
    n, wide = d + 1, max(N, d + 1)
    few = FEW if N >= MANY else 0
    floats = (
        (22 + 2 * d + N_POINT_FEATURES + 3) * N  # vectors over the points, copied rows, features, votes
        + 6 * wide
        + n * n * 6 + n * 8 + 2 * n * (n + 2)  # vertices and tables
        + d * (d + 1) + 6 * d + KEPT * (d + 1) + MEMORY * d  # models
        + 6 + few * (d + 2) + d * (d + 2) * LANES
        + 2 * BLOCK * int(point_net.widths.max()) + 2 * int(peel_net.widths.max())
        + n * N_PEEL_FEATURES * (1 + log_steps)
    )  # fmt: skip
    integers = N_COUNTS + (10 + 2 * n) * N + 9 * n + d + BINS + log_steps * n + d * LANES + 2
    return Arena(
        rows.At,
        rows.b,
        state,
        np.zeros(floats),
        np.zeros(integers, dtype=np.int64),
        np.zeros(5 * N + LANES, dtype=np.bool_),
        point_net,
        peel_net,
        log_steps,
    )


@kernel
def _cut(block: Any, at: int, length: int) -> tuple[Any, int]:
    return block[at : at + length], at + length


@kernel
def _cut2(block: Any, at: int, rows: int, columns: int) -> tuple[Any, int]:
    return block[at : at + rows * columns].reshape(rows, columns), at + rows * columns


@kernel
def _cut3(block: Any, at: int, depth: int, rows: int, columns: int) -> tuple[Any, int]:
    end = at + depth * rows * columns
    return block[at:end].reshape(depth, rows, columns), end


@kernel
def carve(arena: Arena) -> Search:
    """Return the arrays of a search, cut out of its blocks; always the same ones."""
    At, b, state, F, K, B, point_net, peel_net, log_steps = arena
    d, N = At.shape
    n = d + 1
    wide = max(N, n)
    few = FEW if N >= MANY else 0
    f, k, g = 0, 0, 0

    counts, k = _cut(K, k, N_COUNTS)
    member, g = _cut(B, g, N)

    gain, f = _cut(F, f, N)
    cap, f = _cut(F, f, N)
    C, f = _cut2(F, f, n, n)
    x, f = _cut(F, f, n)
    q, k = _cut(K, k, n)
    r, f = _cut(F, f, N)
    work, f = _cut2(F, f, 3, wide)
    table, f = _cut2(F, f, n + 2, n)
    ws = Workspace(At, b, gain, cap, C, x, q, r, work, table)

    copies_C, f = _cut3(F, f, 2, n, n)
    copies_x, f = _cut2(F, f, 2, n)
    copies_q, k = _cut2(K, k, 2, n)
    copies_r, f = _cut2(F, f, 2, N)
    tried, g = _cut(B, g, N)
    fresh, g = _cut(B, g, N)
    waiting, k = _cut(K, k, N)
    bound, f = _cut(F, f, N)
    leave, k = _cut(K, k, N)
    certificate, k = _cut2(K, k, N, n)
    before, k = _cut2(K, k, N, n)
    basis, k = _cut(K, k, n)
    kept, g = _cut(B, g, N)
    dropped, g = _cut(B, g, N)
    blame, k = _cut(K, k, N)
    near_points, k = _cut(K, k, N)
    near_place, k = _cut(K, k, N)
    near_At, f = _cut(F, f, d * N)
    near_b, f = _cut(F, f, N)
    near_gain, f = _cut(F, f, N)
    near_cap, f = _cut(F, f, N)
    near_r, f = _cut(F, f, N)
    near_C, f = _cut2(F, f, n, n)
    near_x, f = _cut(F, f, n)
    near_q, k = _cut(K, k, n)
    near = NearRows(near_points, near_place, near_At, near_b, near_gain, near_cap, near_r, near_C, near_x, near_q)
    copies = VertexCopies(copies_C, copies_x, copies_q, copies_r)
    refinement = RefineScratch(
        copies, tried, fresh, waiting, bound, leave, certificate, before, basis, kept, dropped, blame, near
    )

    pool, k = _cut(K, k, N)
    inliers, k = _cut(K, k, N)
    near, k = _cut(K, k, N)
    model, f = _cut(F, f, d)
    other, f = _cut(F, f, d)
    residuals, f = _cut(F, f, N)
    w, f = _cut(F, f, N)
    weighted, f = _cut(F, f, N)
    small, f = _cut2(F, f, d, d + 1)
    places, k = _cut(K, k, d)
    lane_points, k = _cut2(K, k, d, LANES)
    lane_table, f = _cut3(F, f, d, d + 1, LANES)
    lane_models, f = _cut2(F, f, d, LANES)
    good, g = _cut(B, g, LANES)
    lanes = Lanes(lane_points, lane_table, lane_models, good)
    lane, k = _cut(K, k, 2)
    scratch = Scratch(state, pool, inliers, near, model, other, residuals, w, weighted, small, places, lanes, lane)

    features, f = _cut2(F, f, N_POINT_FEATURES, N)
    votes, f = _cut2(F, f, 3, N)
    totals, f = _cut(F, f, 3)
    tops, f = _cut(F, f, 3)
    logit, f = _cut(F, f, N)
    p, f = _cut(F, f, N)
    hidden, f = _cut3(F, f, 2, point_net.widths.max(), BLOCK)
    bins, k = _cut(K, k, BINS)
    belief = Belief(features, votes, totals, tops, logit, p, hidden, bins)

    models, f = _cut2(F, f, KEPT, d)
    scores, f = _cut(F, f, KEPT)
    cumulative, f = _cut(F, f, N)
    guide, k = _cut(K, k, N)
    few_rows, f = _cut2(F, f, d, few)
    few_b, f = _cut(F, f, few)
    few_r, f = _cut(F, f, few)
    best, f = _cut(F, f, d)
    proposals = Proposals(models, scores, cumulative, guide, few_rows, few_b, few_r, best)

    points, k = _cut(K, k, N)
    walk_At, f = _cut(F, f, d * N)
    walk_b, f = _cut(F, f, N)
    walk_gain, f = _cut(F, f, N)
    walk_cap, f = _cut(F, f, N)
    walk_r, f = _cut(F, f, N)
    walk_work, f = _cut2(F, f, 3, wide)
    walk_table, f = _cut2(F, f, n + 2, n)
    walk_C, f = _cut2(F, f, n, n)
    walk_x, f = _cut(F, f, n)
    walk_q, k = _cut(K, k, n)
    walk_basis, k = _cut(K, k, n)
    named, k = _cut(K, k, n)
    multipliers, f = _cut(F, f, n)
    sides, f = _cut(F, f, n)
    inputs, f = _cut2(F, f, n, N_PEEL_FEATURES)
    row_hidden, f = _cut2(F, f, 2, peel_net.widths.max())
    log, f = _cut3(F, f, log_steps, n, N_PEEL_FEATURES)
    log_basis, k = _cut2(K, k, log_steps, n)
    walk = Walk(
        points,
        walk_At,
        walk_b,
        walk_gain,
        walk_cap,
        walk_r,
        walk_work,
        walk_table,
        walk_C,
        walk_x,
        walk_q,
        walk_basis,
        named,
        multipliers,
        sides,
        inputs,
        row_hidden,
        log,
        log_basis,
    )

    incumbent, f = _cut(F, f, d)
    vertex_C, f = _cut3(F, f, 1, n, n)
    vertex_x, f = _cut2(F, f, 1, n)
    vertex_q, k = _cut2(K, k, 1, n)
    vertex_r, f = _cut2(F, f, 1, N)
    l1, f = _cut(F, f, d)
    gnc, f = _cut(F, f, d)
    trial, f = _cut(F, f, N)
    starts, f = _cut2(F, f, MEMORY, d)
    counts[FLOATS_USED], counts[INTEGERS_USED], counts[FLAGS_USED] = f, k, g
    return Search(
        ws,
        refinement,
        scratch,
        belief,
        proposals,
        walk,
        point_net,
        peel_net,
        member,
        incumbent,
        VertexCopies(vertex_C, vertex_x, vertex_q, vertex_r),
        l1,
        gnc,
        trial,
        starts,
        counts,
    )
