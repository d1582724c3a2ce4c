"""Kernels of the learned search: the root, one round of it, and its parts by number.

A round: propose from the belief, walk down from the best proposals and from the incumbent, update the belief, and
where that agrees with the incumbent, swap. All parts share `Search`, allocated once a fit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.agent.point_features import write_best_features
from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import OK, cold_fit, compute_residuals
from maxcon.search.belief import SHRINK, agreement, forget_votes, root_models, start_belief, update_belief
from maxcon.search.belief_proposals import KEPT, MANY, propose, refine_proposals, same_model
from maxcon.search.gnc_kernels import descend
from maxcon.search.learned_memory import (
    AGREEMENT,
    DOUBTS,
    IN_WINDOW,
    MEMORY,
    PLACED,
    ROUND,
    SIZE,
    STALL,
    STEPS,
    SWAPPED,
    WALKED,
    WALKS,
    WHOLLY,
    Arena,
    Search,
    carve,
)
from maxcon.search.learned_settings import Settings
from maxcon.search.model_kernels import count_within, weighted_model
from maxcon.search.peel_walk import choose_start, copy_rows, install_walk, walk_down, walk_workspace
from maxcon.search.random_kernels import draw_next, random_below, random_unit
from maxcon.search.refine_kernels import refine_by, swap_by, swap_kernel
from maxcon.search.vertex_kernels import load_vertex, save_vertex
from maxcon.search.window import CORE, NEAR_MISS, OUTER, SWAP_TRIES, choose_window, window_scratch

#: The parts of a round, in order; walks 0 and 1 start from proposals, 2 from the incumbent, the rest from variations.
PROPOSE, WALK, WALK_INCUMBENT, VARY, BELIEVE, SWAP, PARTS = 0, 1, 3, 4, 5, 6, 7

#: Two starts are the same where their residuals differ by less than this many limits, root mean square.
SAME_START = 0.1

#: A walk is not begun where its set would have to grow by more than this to be worth it.
FEW_MORE = 3


@kernel
def take_model(search: Search, limit: float) -> None:
    """Make the points that model ``search.x`` explains the incumbent."""
    r, member, counts = search.scratch.r, search.member, search.counts
    compute_residuals(search.ws.At, search.ws.b, search.x, r)
    counts[SIZE] = 0
    for i in range(r.shape[0]):
        member[i] = abs(r[i]) <= limit
        counts[SIZE] += member[i]
    counts[PLACED] = 0
    _note_progress(search, limit, r)


@kernel
def take_vertex(search: Search, limit: float, size: int) -> None:
    """Make the set in the workspace, of `size` points and at its vertex, the incumbent."""
    ws = search.ws
    for i in range(ws.r.shape[0]):
        search.member[i] = ws.gain[i] == 1.0
    for j in range(search.x.shape[0]):
        search.x[j] = ws.x[j]
    save_vertex(ws, search.vertex, 0)
    search.counts[SIZE] = size
    search.counts[PLACED] = 1
    _note_progress(search, limit, ws.r)


@kernel
def _note_progress(search: Search, limit: float, r: NDArray[np.float64]) -> None:
    counts = search.counts
    counts[STALL] = -1  # the end of the round makes it 0
    counts[SWAPPED] = 0
    counts[WALKED] = 0
    write_best_features(r, search.member, limit, search.belief.bins, search.belief.features)


@kernel
def _clear(search: Search) -> None:
    """Make a search one that has not begun."""
    for i in range(search.ws.b.shape[0]):
        search.scratch.pool[i] = i
        search.belief.p[i] = 0.5
        for k in range(search.refinement.certificate.shape[1]):
            search.refinement.certificate[i, k] = -1
    for k in range(MEMORY):
        for j in range(search.x.shape[0]):
            search.starts[k, j] = np.inf


@kernel
def begin(search: Search, limit: float) -> None:
    """Do the root: the two models of all points, the first incumbent, the first belief."""
    _clear(search)
    root_models(search.ws.At, search.ws.b, limit, search.scratch, search.l1, search.gnc)
    for j in range(search.x.shape[0]):
        search.x[j] = search.gnc[j]
    take_model(search, limit)
    search.counts[STALL] = 0
    begin_belief(search, limit)


@kernel
def begin_above(search: Search, limit: float, coarse: Search, local: float, afresh: bool) -> None:
    """Do the root with what a search on some of the points has found: its incumbent moved to a local minimum.

    The two models of all points are those of the coarse search, unless they are to be made `afresh`. The first belief
    (see `begin_belief`) is left to be made when a round is to be played: it takes as long as the rest.
    """
    _clear(search)
    ws, scratch = search.ws, search.scratch
    size = -1
    if afresh:
        size = root_models(ws.At, ws.b, limit, scratch, search.l1, search.gnc)
    for j in range(search.x.shape[0]):
        if not afresh:
            search.l1[j] = coarse.l1[j]
            search.gnc[j] = coarse.gnc[j]
        search.x[j] = search.gnc[j]
        scratch.x[j] = coarse.x[j]
    descend(ws.At, ws.b, limit, local * local, SHRINK, 1000, scratch, scratch.x, search.x, size)
    take_model(search, limit)
    search.counts[STALL] = 0


@kernel
def begin_belief(search: Search, limit: float) -> None:
    """Make the first belief, from the two models of all points and the incumbent."""
    ws = search.ws
    start_belief(ws.At, ws.b, limit, search.scratch, search.l1, search.gnc, search.belief)
    update_belief(search.point_net, 0, search.belief)


@kernel
def walk_from(search: Search, limit: float, settings: Settings, x: NDArray[np.float64], loyal: bool) -> None:
    """Walk down from model x, add back, and keep what was found if it is more than the incumbent.

    Of many points, the walk sees those of a window (see `window`). A `loyal` walk removes no point of the incumbent:
    from its model it ends at a set that holds it, or what the window shows of it.
    """
    ws, walk, counts, r = search.ws, search.walk, search.counts, search.trial
    N = r.shape[0]
    compute_residuals(ws.At, ws.b, x, r)
    inside = count_within(r, limit)
    reach, windowed, below = settings.reach * limit, N > MANY, 0
    m = choose_start(r, reach, walk.points)
    if m + FEW_MORE < counts[SIZE]:
        return
    if windowed:
        m, below = choose_window(r, CORE * limit, max(OUTER * limit, reach), walk.points)
    status, removed, steps = walk_down(
        ws.At,
        ws.b,
        limit,
        search.peel_net,
        m,
        below,
        reach,
        r,
        inside / N,
        settings.explore,
        search.member if loyal else search.member[:0],
        search.belief,
        search.scratch.state,
        walk,
    )
    counts[WALKS] += 1
    counts[STEPS] = steps
    if status != OK:
        return
    if windowed and not _refine_window(search, limit, m, m - removed, below, settings.tries):
        return
    _take_walk(search, limit, m, settings.tries)


@kernel
def _refine_window(search: Search, limit: float, m: int, size: int, below: int, tries: int) -> bool:
    """Add points to the end of a walk, of those in its window; whether they may be more than the incumbent's.

    The walk's set has `size` points in the window and `below` that are not.
    """
    to_beat = search.counts[SIZE] - below
    ws = walk_workspace(search.ws.At.shape[0], m, search.walk)
    compute_residuals(ws.At, ws.b, ws.x, ws.r)
    if 10 * (count_within(ws.r, limit) + below) < 9 * search.counts[SIZE] - 10:  # too far off, as in `_take_walk`
        return False
    scratch = window_scratch(m, search.refinement)
    for i in range(m):
        scratch.tried[i] = False
    miss = NEAR_MISS if search.counts[ROUND] > 0 else -1  # the first set is soon replaced
    size += refine_by(ws, limit, scratch, to_beat - miss - size, tries)
    if to_beat - miss <= size <= to_beat:
        size += swap_by(ws, limit, scratch, SWAP_TRIES)
    return bool(size > to_beat)


@kernel
def _take_walk(search: Search, limit: float, m: int, tries: int) -> None:
    """Add points to the end of a walk that saw m points, and keep that if it is more than the incumbent.

    After a window only what its vertex explains: of the others, those in the window have been tried.
    """
    ws, walk, counts = search.ws, search.walk, search.counts
    windowed = ws.gain.shape[0] > MANY
    install_walk(ws, m, walk)
    if 10 * count_within(ws.r, limit) < 9 * counts[SIZE] - 10:  # too far off for a few more points to matter
        return
    size = 0
    for i in range(ws.gain.shape[0]):
        search.refinement.tried[i] = windowed and abs(ws.r[i]) > limit
        size += ws.gain[i] == 1.0
    size += refine_by(ws, limit, search.refinement, counts[SIZE] - size + 1, tries)
    if size > counts[SIZE]:
        take_vertex(search, limit, size)


@kernel
def _is_new_start(search: Search, limit: float, x: NDArray[np.float64]) -> bool:
    for k in range(MEMORY):
        if same_model(search.starts[k], x, SAME_START * limit):
            return False
    place = search.counts[WALKS] % MEMORY
    for j in range(x.shape[0]):
        search.starts[place, j] = x[j]
    return True


@kernel
def walk_part(search: Search, limit: float, settings: Settings, which: int) -> None:
    """Walk from proposal 0 or 1, or (2) from the incumbent, unless that has been done or cannot find more.

    A loyal walk ends at a set that holds the incumbent. One that has its vertex has been refined: no point (of its
    window) can be added to it, so that no larger feasible set holds it.
    """
    if which < 2:
        proposals, best = search.proposals, -1
        for k in range(KEPT):
            if proposals.scores[k] >= 0.0:
                proposals.scores[k] = -1.0
                if _is_new_start(search, limit, proposals.models[k]):
                    best = k
                    break
        if best >= 0:
            walk_from(search, limit, settings, proposals.models[best], False)
    elif not search.counts[WALKED]:
        search.counts[WALKED] = 1
        loyal = settings.explore == 0.0
        if not (loyal and search.counts[PLACED]):
            walk_from(search, limit, settings, search.x, loyal)


@kernel
def vary_part(search: Search, limit: float, settings: Settings) -> None:
    """Walk from variations of the incumbent."""
    if search.counts[AGREEMENT] <= 1000.0 * settings.agreed:
        return
    for _ in range(settings.variations):
        vary(search, limit, settings)


@kernel
def vary(search: Search, limit: float, settings: Settings) -> None:
    """Walk from the model of a few of the incumbent's points and some near it outside.

    From that model itself, or from the local minimum that it leads to. Models of the incumbent's own points lead back
    to it nearly always: the points outside are what leads elsewhere.
    """
    ws, scratch, member = search.ws, search.scratch, search.member
    x, r, w = scratch.x, scratch.r, scratch.w
    d, N = x.shape[0], member.shape[0]
    # While there is progress, the next set is near and a descent not worth its time.
    straight = search.counts[STALL] <= 0 or random_unit(scratch.state) < settings.straight
    share = 2 if straight else 1  # a model that is not refitted must be nearer to a good one
    few = share * d * (settings.least + random_below(scratch.state, max(settings.most - settings.least, 0) + 1))
    compute_residuals(ws.At, ws.b, search.x, r)
    size, others = 0, N
    for i in range(N):  # members from the front, those outside from the back
        w[i] = 0.0
        if member[i]:
            scratch.inliers[size] = i
            size += 1
        elif share * abs(r[i]) <= settings.spread * limit:
            others -= 1
            scratch.inliers[others] = i
    few = min(few, size // 2)
    if few < d:
        return
    for k in range(few):
        w[draw_next(scratch.state, scratch.inliers, k, size)] = 1.0
    strangers = scratch.inliers[others:]
    foreign = 1 + random_below(scratch.state, settings.foreign) if settings.foreign > 0 else 0
    for k in range(min(foreign, N - others)):
        w[draw_next(scratch.state, strangers, k, N - others)] = 1.0
    weighted_model(ws.At, ws.b, w, scratch.weighted, scratch.table, x)
    if not straight:
        control = settings.loose * settings.loose
        descend(ws.At, ws.b, limit, control, SHRINK, 1000, scratch, x, search.proposals.best, -1)
        if not _is_new_start(search, limit, x):
            return
    walk_from(search, limit, settings, x, False)


@kernel
def propose_part(search: Search, limit: float, settings: Settings) -> None:
    """Draw and refine proposals; a model that explains more than the incumbent replaces it."""
    ws, belief, scratch = search.ws, search.belief, search.scratch
    stall, local = max(search.counts[STALL], 0), settings.local
    power = settings.power / (1.0 + settings.soften * stall)
    samples, refined = settings.samples, settings.refined
    doubtful = search.counts[AGREEMENT] <= 1000.0 * settings.agreed
    if doubtful and stall > 0 and stall % settings.lost == 0:
        # What the belief favours has come to nothing: start from anywhere. There, few samples are worth a look, and
        # many of them a descent: those that rank best lead to the same few valleys.
        power, local = 0.0, np.inf
        samples, refined = settings.strays, KEPT
    propose(ws.At, ws.b, limit, samples, power, settings.floor, belief, search.proposals, scratch)
    size = search.counts[SIZE]
    found = refine_proposals(
        ws.At,
        ws.b,
        limit,
        refined,
        local,
        belief,
        search.proposals,
        scratch,
        search.x,
        size,
    )
    if found > size:
        take_model(search, limit)


@kernel
def place_incumbent(search: Search, limit: float) -> bool:
    """Put the incumbent's set and vertex into the workspace; False if rounding stands against it."""
    ws, counts = search.ws, search.counts
    for i in range(ws.gain.shape[0]):
        ws.gain[i] = 1.0 if search.member[i] else 0.0
        ws.cap[i] = 0.0 if search.member[i] else np.inf
    if counts[PLACED]:
        load_vertex(ws, search.vertex, 0)
        return True
    return cold_fit(*ws) == OK and ws.x[ws.x.shape[0] - 1] <= limit


@kernel
def swap_window(search: Search, limit: float) -> None:
    """Swap among the points of the incumbent's window; what is found gets all points that its model explains."""
    ws, walk, member, r = search.ws, search.walk, search.member, search.trial
    compute_residuals(ws.At, ws.b, search.x, r)
    m, _ = choose_window(r, CORE * limit, OUTER * limit, walk.points)
    window = copy_rows(ws.At, ws.b, m, walk)
    for k in range(m):
        if not member[walk.points[k]]:
            window.gain[k] = 0.0
            window.cap[k] = np.inf
    if m == 0 or cold_fit(*window) != OK or window.x[window.x.shape[0] - 1] > limit:
        return
    if swap_by(window, limit, window_scratch(m, search.refinement), SWAP_TRIES) > 0:
        _take_walk(search, limit, m, member.shape[0])


@kernel
def swap_part(search: Search, limit: float, wholly: bool) -> None:
    """Refine and swap the incumbent, unless that has been done; of many points in its window, or `wholly` among all."""
    counts = search.counts
    if counts[SIZE] == 0 or counts[SWAPPED] >= (WHOLLY if wholly else IN_WINDOW):
        return
    if not wholly and search.member.shape[0] > MANY:
        swap_window(search, limit)
        counts[SWAPPED] = IN_WINDOW
        return
    if place_incumbent(search, limit):
        gained = swap_kernel(search.ws, limit, search.refinement)
        if gained > 0:
            take_vertex(search, limit, counts[SIZE] + gained)
    counts[SWAPPED] = WHOLLY


@kernel
def play(search: Search, limit: float, settings: Settings, first: int, last: int) -> None:
    """Do the parts `first` to ``last - 1`` of a round; the round is over after its last part."""
    counts = search.counts
    for part in range(first, last):
        if part == PROPOSE:
            propose_part(search, limit, settings)
        elif part < VARY:
            walk_part(search, limit, settings, part - WALK)
        elif part == VARY:
            vary_part(search, limit, settings)
        elif part == BELIEVE:
            counts[ROUND] += 1
            update_belief(search.point_net, counts[ROUND], search.belief)
            agreed, doubts = agreement(search.belief.p, search.member)
            counts[AGREEMENT] = int(1000.0 * agreed)
            counts[DOUBTS] = doubts
        elif counts[STALL] > 0 and counts[AGREEMENT] > 1000.0 * settings.agreed:
            swap_part(search, limit, False)
    if last == PARTS:
        _end_round(search, settings)


@kernel
def _end_round(search: Search, settings: Settings) -> None:
    counts = search.counts
    counts[STALL] += 1
    if counts[STALL] > 0 and counts[STALL] % settings.patience == 0:
        forget_votes(search.belief)


@kernel
def begin_search(arena: Arena, limit: float) -> None:
    """Do the root."""
    begin(carve(arena), limit)


@kernel
def begin_search_above(arena: Arena, limit: float, coarse: Arena, settings: Settings, afresh: bool) -> None:
    """Do the root from what a search on some of the points has found; see `begin_above`."""
    begin_above(carve(arena), limit, carve(coarse), settings.local, afresh)


@kernel
def begin_search_belief(arena: Arena, limit: float) -> None:
    """Make the first belief of a search that was begun from one on some of the points."""
    begin_belief(carve(arena), limit)


@kernel
def play_parts(arena: Arena, limit: float, settings: Settings, first: int, last: int) -> None:
    """Do some parts of a round, for those who look at what comes between."""
    play(carve(arena), limit, settings, first, last)


@kernel
def play_coarse_round(arena: Arena, limit: float, settings: Settings) -> None:
    """Do a round without walks and swaps, on some of the points: a better vertex of these is none of all points."""
    search = carve(arena)
    play(search, limit, settings, PROPOSE, PROPOSE + 1)
    play(search, limit, settings, BELIEVE, BELIEVE + 1)
    _end_round(search, settings)


@kernel
def swap_search(arena: Arena, limit: float) -> None:
    """Swap the incumbent; of many points, those in its window only."""
    swap_part(carve(arena), limit, False)


@kernel
def finish_search(arena: Arena, limit: float) -> None:
    """Refine and swap the incumbent among all points, for the last time."""
    swap_part(carve(arena), limit, True)


@kernel
def read_belief(arena: Arena, p: NDArray[np.float64]) -> None:
    """Write what is believed of each point now."""
    p[:] = carve(arena).belief.p
