"""The learned search: proposals drawn from a belief, walks down the tree by a small network, a belief that learns.

What is tried, and in which order, is decided by two small networks, trained without labels (see
`maxcon.experiments.self_imitation`). What is found is checked like everything else: each set comes with a model that
proves it feasible.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import cycle
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maxcon.agent.search_networks import SearchNetworks, load_search_networks, shipped_search_networks
from maxcon.minimax import LinearRows
from maxcon.minimax.jit import working_clock
from maxcon.search.anytime import Step, Task
from maxcon.search.belief_proposals import MANY
from maxcon.search.learned_kernels import (
    BELIEVE,
    PARTS,
    SWAP,
    VARY,
    WALK_INCUMBENT,
    begin_search,
    begin_search_above,
    begin_search_belief,
    finish_search,
    play_coarse_round,
    play_parts,
    read_belief,
    swap_search,
)
from maxcon.search.learned_memory import (
    AGREEMENT,
    DOUBTS,
    N_COUNTS,
    ROUND,
    SIZE,
    STALL,
    SWAPPED,
    WHOLLY,
    Arena,
    allocate_arena,
)
from maxcon.search.learned_settings import Settings, check_settings
from maxcon.search.random_kernels import seed_state
from maxcon.search.sampling import check_count

#: Without a time limit the search ends after so many rounds without progress, if the belief agrees with the incumbent:
#: its points are believed in with a mean probability of `SURE`, and at most a share of `DOUBTFUL` others.
ROUNDS_AGREED, SURE, DOUBTFUL = 6, 0.9, 0.05

#: After so many rounds without progress, where the belief agrees, the search says that it has settled.
ROUNDS_SETTLED = 1

#: If it does not agree: after this many, and not before the search has gone on for as long again as it took to
#: find what it has.
ROUNDS_OPEN = 24

#: A set is yielded, or an empty step, about so often, in seconds; a set costs 10 us.
PAUSE = 0.002

#: With fewer parameters than this many are more points, as the root takes time with the square of the rank.
MANY_RANK = 9

#: The root of many points is that of a search on `COARSE` random ones, or a `COARSER`-th of the points if
#: that is more: rounds there until its belief agrees with its incumbent, at most so many, in at most this share of the
#: time, but one at least on the fewest points.
COARSE, COARSER, COARSE_ROUNDS, COARSE_SHARE = 200, 6, 8, 0.3

#: Where the belief does not agree in the end, the models of all points are made too, if there are so many times as much
#: time as has been spent.
AFRESH = 3.0

#: Fewer points than so many times the rank determine too little.
COARSE_RANKS = 20

#: A walk takes about the number of points to this power. A root's last walk is worth more than all before it: one that
#: would pass the time limit is begun if it passes it by no more than half of what has been spent.
WALK_GROWTH, OVERRUN = 1.8, 0.5

#: Until a round has been timed: what it takes, in times of the root.
ROUND_ROOTS = 1.6

#: Of many points, the first incumbent is swapped at once where there is too little time for a round, but more than this
#: of what has been spent; otherwise rounds come first, as they replace it.
SWAP_FIRST = 0.4

#: Where no more than this share is left out, of no more points than this, the first incumbent is nearly the last one:
#: it is swapped among all points if so many times as much is left as was spent.
EASY_SHARE, EASY_POINTS, EASY_LEFT = 0.3, 2000, 1.2

#: The parts of a round of many points. Variations come twice: their walks see a window only, and take little of it.
PIECES = (*range(VARY), VARY, VARY, BELIEVE, SWAP)

#: How much of a round's time must be left for the last swap to be made, and of what a piece of a round takes for
#: another one: what is begun is finished, so that the time limit is passed by at most the rest of it.
SWAP_ROUNDS, PIECE_FITS = 0.5, 0.6

#: Of many points, the first belief and a round are begun where there is so many times what a piece of a round takes.
BELIEF_PIECES = 2.0


def learned(
    task: Task,
    *,
    network: str | Path | SearchNetworks | None = None,
    rounds: int | None = None,
    settings: Settings | None = None,
    belief_out: NDArray[np.float64] | None = None,
) -> Iterator[Step]:
    """Search with the learned agent: propose, walk down the tree, believe, swap; again and again.

    The root: the L1 fit and a Geman-McClure continuation of all points, from which the point network draws its
    first belief, a probability for each point that it is in the best set. A round: minimal samples drawn from
    the belief are ranked, and the best refined by a local continuation; from the best of these and from the
    incumbent a walk starts down the tree, on which the peel network says which basis point to remove until
    the set is feasible, and then points are added back (local tree refinement); the votes of all models met,
    and the incumbent, make the next belief. Where rounds bring nothing new the votes are forgotten, so that
    the search looks elsewhere. The incumbent is swapped (see `swap_refinement`) where the belief agrees
    with it, and in the end.

    Parameters
    ----------
    task
        What is fitted.
    network
        The file of a pair of networks, or the pair; None for the shipped one.
    rounds
        How many rounds are played at most. None: as many as the time limit allows; without one, until
        further work is unlikely to gain. That is judged by the rounds without progress: 6 where the belief agrees
        with the incumbent (mean probability of its points at least 0.9, at most 5% as many others above one
        half), else 24 and at least as many as the progress took.
    settings
        The settings of a round; None for the defaults.
    belief_out
        Shape (N,), float64: is told, when the search settles and when it has ended, with what probability each point
        is an inlier of the best set.

    Yields
    ------
    Step
        Each better set, some milliseconds after it was found at latest, refined and swapped as far as the time
        allows. Once, where the belief first agrees with the best set, after a round without progress, a step
        that is `settled`; the search goes on after it.

    Raises
    ------
    TypeError, ValueError
        If an option has the wrong type, or is outside its range, or the file does not hold such networks.
    """
    nets = search_networks(network)
    if rounds is not None:
        rounds = check_count(rounds, "rounds", 1)
    N = task.problem.n_points
    if belief_out is not None and not (
        isinstance(belief_out, np.ndarray)
        and belief_out.shape == (N,)
        and belief_out.dtype == np.float64
        and belief_out.flags.writeable
    ):
        raise ValueError(f"belief_out must be an array of shape ({N},) and type float64 that can be written to")
    return _search(task, nets, rounds, Settings() if settings is None else check_settings(settings), belief_out)


def search_networks(network: str | Path | SearchNetworks | None) -> SearchNetworks:
    """Return the pair of networks that an option names: a file, a pair, or the shipped one.

    Raises
    ------
    TypeError, ValueError
        If it is neither, or the file does not hold such networks.
    """
    if network is None:
        return shipped_search_networks()
    if isinstance(network, SearchNetworks):
        return network
    if isinstance(network, (str, Path)):
        return load_search_networks(Path(network))
    raise TypeError(f"network must be a file name or a pair of networks, but it is a {type(network).__name__}")


def _search(
    task: Task, nets: SearchNetworks, rounds: int | None, settings: Settings, belief_out: NDArray[np.float64] | None
) -> Iterator[Step]:
    began = working_clock()
    end = began + task.seconds_left()
    arena, walk = _root(task, nets, settings)
    counts, member, limit = arena.integers[:N_COUNTS], arena.flags[: task.problem.n_points], task.limit
    now = spoken = working_clock()
    # Of many points, a round takes so long that the clock is looked at between its parts.
    pieces = [(part, part + 1) for part in PIECES] if task.problem.n_points > MANY else [(0, PARTS)]
    took = [ROUND_ROOTS * (now - began) / len(pieces)] * len(pieces)
    reported, settled = 0, False
    if len(pieces) > 1:
        if end - now > PAUSE:  # else the step would be the last one
            yield _news(counts, member, reported)
            reported, spoken = int(counts[SIZE]), working_clock()
        if walk < end - now + OVERRUN * (now - began):
            play_parts(arena, limit, settings, WALK_INCUMBENT, WALK_INCUMBENT + 1)
        now = working_clock()
        if _is_easy(counts, task.problem.n_points) and end - now > EASY_LEFT * (now - began):
            finish_search(arena, limit)
        elif SWAP_FIRST * (now - began) < end - now < ROUND_ROOTS * (now - began):
            swap_search(arena, limit)
        now = working_clock()
        if end - now <= BELIEF_PIECES * took[0]:
            pieces = []
        elif len(sizes_of(task.rows)) > 1:
            begin_search_belief(arena, limit)
            now = working_clock()
    for number in cycle(range(len(pieces))):
        if number == 0 and (counts[ROUND] >= rounds if rounds is not None else end == np.inf and _is_settled(counts)):
            break
        if end - now <= PIECE_FITS * took[number]:
            break
        play_parts(arena, limit, settings, *pieces[number])
        done = working_clock()
        took[number], now = max(0.8 * took[number], done - now), done
        if now - spoken > PAUSE and (len(pieces) > 1 or end - now > 2.0 * took[0]):
            yield _news(counts, member, reported)
            reported, spoken = int(counts[SIZE]), (now := working_clock())
        if not settled and counts[STALL] >= ROUNDS_SETTLED and _agrees(counts):
            settled = True
            if belief_out is not None:
                read_belief(arena, belief_out)
            yield replace(_news(counts, member, reported), settled=True)
            reported, spoken = int(counts[SIZE]), (now := working_clock())
        # A swap among all of many points takes some rounds' time.
        stalled = len(pieces) > 1 and counts[SWAPPED] != WHOLLY and counts[STALL] >= settings.patience
        if stalled and end - now > now - began:
            finish_search(arena, limit)
            now = working_clock()
    if end == np.inf:
        finish_search(arena, limit)
    elif not counts[SWAPPED] and end - now > SWAP_ROUNDS * sum(took):
        swap_search(arena, limit)
    if belief_out is not None:
        read_belief(arena, belief_out)
    yield _news(counts, member, reported)


def _root(task: Task, nets: SearchNetworks, settings: Settings) -> tuple[Arena, float]:
    """Return a search that has begun; where there are many points, above searches on fewer of them.

    And the seconds that a walk from its incumbent may take, by what one took on fewer points.
    """
    N = task.problem.n_points
    began, left, coarse, walk = working_clock(), task.seconds_left(), None, 0.0
    for size in reversed(sizes_of(task.rows)):
        rows = task.rows if size == N else _some(task.rows, task.rng.choice(N, size, replace=False))
        arena = allocate_arena(rows, seed_state(task.rng), nets.points, nets.peel)
        counts = arena.integers[:N_COUNTS]
        if coarse is None:
            begin_search(arena, task.limit)
        else:
            afresh = not _agrees(coarse.integers[:N_COUNTS]) and AFRESH * (working_clock() - began) < left
            begin_search_above(arena, task.limit, coarse, settings, afresh)
            before = working_clock()
            if size < N and walk < left - (1.0 - OVERRUN) * (before - began):
                play_parts(arena, task.limit, settings, WALK_INCUMBENT, WALK_INCUMBENT + 1)
                walk = (working_clock() - before) * COARSER**WALK_GROWTH
            if size < N:
                begin_search_belief(arena, task.limit)
        while size < N and counts[ROUND] < COARSE_ROUNDS and not (counts[ROUND] > 0 and _agrees(counts)):
            if (coarse is not None or counts[ROUND] > 0) and working_clock() - began > COARSE_SHARE * left:
                break
            play_coarse_round(arena, task.limit, settings)
        coarse = arena
    return arena, walk


def sizes_of(rows: LinearRows) -> list[int]:
    """Return of how many points the searches are that a root takes: of all, and before that of ever fewer."""
    r, N = rows.At.shape
    sizes, least = [N], max(COARSE, COARSE_RANKS * r)
    while sizes[-1] > max(MANY * max(1.0, (MANY_RANK / (r + 1)) ** 2), 2 * least):
        sizes.append(max(sizes[-1] // COARSER, least))
    return sizes


def _some(rows: LinearRows, points: NDArray[np.int64]) -> LinearRows:
    return replace(rows, At=np.ascontiguousarray(rows.At[:, points]), b=rows.b[points])


def _news(counts: NDArray[np.int64], member: NDArray[np.bool_], reported: int) -> Step:
    return Step(subset=member.copy(), refined=True) if counts[SIZE] > reported else Step()


def _is_easy(counts: NDArray[np.int64], n_points: int) -> bool:
    return bool(n_points <= EASY_POINTS and counts[SIZE] >= (1.0 - EASY_SHARE) * n_points)


def _is_settled(counts: NDArray[np.int64]) -> bool:
    """Return whether further rounds are unlikely to gain; see `learned`."""
    stall = int(counts[STALL])
    return stall >= (ROUNDS_AGREED if _agrees(counts) else max(ROUNDS_OPEN, int(counts[ROUND]) - stall))


def _agrees(counts: NDArray[np.int64]) -> bool:
    """Return whether the belief agrees with the incumbent."""
    return bool(counts[AGREEMENT] >= 1000.0 * SURE and counts[DOUBTS] <= max(1.0, DOUBTFUL * counts[SIZE]))
