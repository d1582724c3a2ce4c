"""The learned search: proposals drawn from a belief, walks down the tree by a small network, a belief that learns.

What is tried, and in which order, is decided by two small networks, trained without labels (see
`maxcon.experiments.self_imitation`). What is found is checked like everything else: each set comes with a model that
proves it feasible.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maxcon.agent.search_networks import SearchNetworks, load_search_networks, shipped_search_networks
from maxcon.search.anytime import Step, Task
from maxcon.search.learned_kernels import Settings, begin_search, check_settings, finish_search, play_rounds
from maxcon.search.learned_memory import AGREEMENT, DOUBTS, N_COUNTS, ROUND, SIZE, STALL, SWAPPED, allocate_arena
from maxcon.search.random_kernels import seed_state
from maxcon.search.sampling import check_count

#: Without a time limit the search ends after so many rounds without progress, if the belief agrees with the incumbent:
#: its points are believed in with a mean probability of `SURE`, and at most a share of `DOUBTFUL` others.
ROUNDS_AGREED, SURE, DOUBTFUL = 6, 0.9, 0.05

#: If it does not agree: after this many, and not before the search has gone on for as long again as it took to
#: find what it has.
ROUNDS_OPEN = 24

#: A set is yielded, or an empty step, about so often, in seconds; a set costs 10 us.
PAUSE = 0.002

#: Until a round has been timed: what it takes, in times of the root.
ROUND_ROOTS = 1.6

#: How much of a round's time must be left for the last swap to be made, and for another round: what is begun is
#: finished, so that the time limit is passed by at most the rest of it.
SWAP_ROUNDS, ROUND_FITS = 0.5, 0.6


def learned(
    task: Task,
    *,
    network: str | Path | SearchNetworks | None = None,
    rounds: int | None = None,
    settings: Settings | None = None,
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

    Yields
    ------
    Step
        Each better set, some milliseconds after it was found at latest, refined and swapped as far as the time
        allows.

    Raises
    ------
    TypeError, ValueError
        If an option has the wrong type, or is outside its range, or the file does not hold such networks.
    """
    if network is None:
        nets = shipped_search_networks()
    elif isinstance(network, SearchNetworks):
        nets = network
    elif isinstance(network, (str, Path)):
        nets = load_search_networks(Path(network))
    else:
        raise TypeError(f"network must be a file name or a pair of networks, but it is a {type(network).__name__}")
    if rounds is not None:
        rounds = check_count(rounds, "rounds", 1)
    return _search(task, nets, rounds, Settings() if settings is None else check_settings(settings))


def _search(task: Task, nets: SearchNetworks, rounds: int | None, settings: Settings) -> Iterator[Step]:
    began = time.perf_counter()
    arena = allocate_arena(task.rows, seed_state(task.rng), nets.points, nets.peel)
    counts, member, limit = arena.integers[:N_COUNTS], arena.flags[: task.problem.n_points], task.limit
    begin_search(arena, limit)
    now = spoken = time.perf_counter()
    round_seconds = ROUND_ROOTS * (now - began)
    reported = 0
    while (rounds is None or counts[ROUND] < rounds) and task.deadline - now > ROUND_FITS * round_seconds:
        play_rounds(arena, limit, settings, 1)
        done = time.perf_counter()
        round_seconds, now = max(0.8 * round_seconds, done - now), done
        if task.deadline == np.inf and rounds is None and _is_settled(counts):
            break
        if now - spoken > PAUSE and task.deadline - now > 2.0 * round_seconds:
            yield _news(counts, member, reported)
            reported, spoken = int(counts[SIZE]), now
    if not counts[SWAPPED] and task.deadline - now > SWAP_ROUNDS * round_seconds:
        finish_search(arena, limit)
    yield _news(counts, member, reported)


def _news(counts: NDArray[np.int64], member: NDArray[np.bool_], reported: int) -> Step:
    return Step(subset=member.copy(), refined=True) if counts[SIZE] > reported else Step()


def _is_settled(counts: NDArray[np.int64]) -> bool:
    """Return whether further rounds are unlikely to gain; see `learned`."""
    stall = int(counts[STALL])
    agrees = counts[AGREEMENT] >= 1000.0 * SURE and counts[DOUBTS] <= max(1.0, DOUBTFUL * counts[SIZE])
    return stall >= (ROUNDS_AGREED if agrees else max(ROUNDS_OPEN, int(counts[ROUND]) - stall))
