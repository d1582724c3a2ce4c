"""What "auto" does: it spends the time on the learned search and on proofs, by a small table of measured rules.

| parameters | time limit | what is done |
| --- | --- | --- |
| up to 3 | none, or enough for a proof (`PROOF_SECONDS`, `HARD_SHARE`) | the exact search |
| up to 3 | less | the learned search for `SHORT_SHARE` of the time; then the exact search, or `RATE_SECONDS`: it anew |
| up to 3 | less than twice an easy proof (`EASY_SHARE`), or up to 2 parameters | the learned search |
| more | none | `propose`, the learned search until it has settled, then `BRIEF_WORK` of the exact search |
| more | up to `ALL_LEARNED` seconds a point and `MOST_LEARNED`, no gap asked | the learned search, in between a proof |
| more | more | `propose`, the learned search until it has settled, at most `LONG_SHARE` of the time; the exact search |

A proof in between: where the learned search has settled, the exact search gets the time that it seems to need
(`reckoned_proof`), if that is there, and the learned search the rest. Where there is more time, and a proof is out of
reach all the same (`HOPELESS`), the learned search goes on, and the exact search gets `BOUND_SHARE` for a bound.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maxcon.agent.search_networks import SearchNetworks
from maxcon.search.anytime import Method, Step, Task
from maxcon.search.learned import learned, search_networks
from maxcon.search.partition import check_jobs, exact_partition
from maxcon.search.proof import MOST_PARAMETERS, prove
from maxcon.search.proposal import propose
from maxcon.search.refine import swap_refinement

#: Seconds a point that the exact search takes at 90% outliers and N = 1000, by the number of parameters. With three
#: parameters and fewer points it takes longer a point: see `RATE_SECONDS`.
PROOF_SECONDS = {0: 9e-7, 1: 9e-7, 2: 9e-7, 3: 4e-5}

#: Where the time is too short for any proof, this part of it goes to the learned search first.
SHORT_SHARE = 0.5

#: With three parameters and a share s of inliers the exact search takes some ``RATE_SECONDS * N ** 0.75 / s ** 2``
#: seconds (N = 100 to 1000, s = .1 to .5): where that is more than is left, the learned search begins anew instead.
RATE_SECONDS = 2e-6

#: The shares of inliers by which a proof with three parameters is reckoned: where there is time even for the hard one
#: it comes first, and where there is too little even for the easy one none is kept for it.
HARD_SHARE, EASY_SHARE = 0.1, 0.5

#: With more than three parameters no proof is attempted in so little time, in seconds a point: what it would find or
#: prove is less than what the learned search still gains.
ALL_LEARNED = 2e-4

#: Seconds of a proof beyond three parameters, times the points squared, and the factor for each further tenth of
#: outliers. Measured with eight parameters, N = 100 to 1000 and 10 to 50%: hyperplanes take a 20th to once that,
#: fundamental matrices once to three times, some in the chart F32 = 1 far more.
PROOF_RATE, PROOF_GROWTH = 5e-9, 10.0

#: In little time a proof is tried where it is reckoned to take at most this share of what is left. It gets up to that,
#: and up to so many times as long as was reckoned, as it seldom ends beyond, but a least share in any case.
PROOF_SHARE, PROOF_TIMES, LEAST_SHARE = 0.6, 5.0, 0.25

#: In more time, where a proof is reckoned to take so many times what is left, it is out of reach. The last part of the
#: time then goes to a bound, and `BRIEF_SECONDS` already before the search goes on, if they are at most such a share.
HOPELESS, BOUND_SHARE, BRIEF_SHARE = 20.0, 0.25, 0.4

#: However many points there are, a proof is attempted in more time than this, in seconds, or where a gap is asked for.
MOST_LEARNED = 1.0

#: Of more points, `propose` takes longer than it is worth.
PROPOSED_POINTS = 2000

#: The learned search gets no more of the time than this where a proof is to follow.
LONG_SHARE = 0.5

#: Where no time is given, the exact search beyond three parameters ends after so much work, in columns of linear
#: programmes: some 60 ms, which prove 30 outliers of 100 with eight parameters, and most pairs of a KITTI drive.
BRIEF_WORK, BRIEF_SECONDS = 2_000_000, 0.065


def auto(task: Task, *, n_jobs: int = -1, network: str | Path | SearchNetworks | None = None) -> Iterator[Step]:
    """Yield ever better sets and bounds, by the methods that the problem and the time call for.

    Parameters
    ----------
    task
        What is fitted. Without a time limit the same data get the same answer; ``method="exact"`` goes on to a proof.
    n_jobs
        How many threads the exact search may use where there is a time limit; -1 for one a core.
    network
        The networks of the learned search: a file, or a pair; None for the shipped pair.

    Raises
    ------
    TypeError, ValueError
        If `n_jobs` is not -1 or a whole number of at least 1, or `network` holds no such networks.
    """
    check_jobs(n_jobs)
    search = partial(learned, network=None if network is None else search_networks(network))
    left = task.seconds_left()
    if task.problem.n_params <= MOST_PARAMETERS:
        if left >= _most_proof_seconds(task.problem.n_points, task.problem.n_params):
            return prove(task, n_jobs=n_jobs)
        return _short(task, left, search)
    if task.gap == 0 and left <= min(ALL_LEARNED * task.problem.n_points, MOST_LEARNED):
        return _learned_and_proof(task, search)
    return _long(task, left, n_jobs, search)


def _short(task: Task, left: float, search: Method) -> Iterator[Step]:
    N, d = task.problem.n_points, task.problem.n_params
    if d < MOST_PARAMETERS or (1.0 - SHORT_SHARE) * left < _proof_seconds(N, EASY_SHARE):
        yield from search(task)
        return
    found = 0
    for step in search(replace(task, deadline=task.deadline - (1.0 - SHORT_SHARE) * left)):
        found = found if step.subset is None else int(np.count_nonzero(step.subset))
        yield step
    if _proof_seconds(N, max(found, 1) / N) <= task.seconds_left():
        yield from prove(task)
    else:
        yield from search(task)


def _learned_and_proof(task: Task, search: Method) -> Iterator[Step]:
    """Search by learning; where few points are left out, stop once for a proof, which then takes no longer."""
    N = task.problem.n_points
    best, belief = np.zeros(N, dtype=np.bool_), np.full(N, 0.5)
    for step in search(task, belief_out=belief):
        best = best if step.subset is None else step.subset
        yield step
        if step.settled:
            left, reckoned = task.seconds_left(), reckoned_proof(best)
            if reckoned <= PROOF_SHARE * left:
                spent = left - min(PROOF_SHARE * left, max(PROOF_TIMES * reckoned, LEAST_SHARE * left))
                own = replace(task, deadline=task.deadline - spent)
                for news in exact_partition(own, start=best, belief=belief, n_jobs=1):
                    yield news
                    if own.over():  # it does not end by itself
                        break


def reckoned_proof(inliers: NDArray[np.bool_]) -> float:
    """Return about how many seconds it takes to prove, beyond three parameters, that a set is the largest."""
    N = len(inliers)
    return float(PROOF_RATE * N**2 * PROOF_GROWTH ** (10.0 * (1.0 - np.count_nonzero(inliers) / N)))


def _most_proof_seconds(n_points: int, n_params: int) -> float:
    """Return about how long the exact search takes at most, up to three parameters."""
    most = PROOF_SECONDS[n_params] * n_points
    return max(most, _proof_seconds(n_points, HARD_SHARE)) if n_params == MOST_PARAMETERS else most


def _proof_seconds(n_points: int, inlier_share: float) -> float:
    """Return about how long the exact search takes with three parameters."""
    return float(RATE_SECONDS * n_points**0.75 / inlier_share**2)


def _long(task: Task, left: float, n_jobs: int, search: Method) -> Iterator[Step]:
    own = replace(task, deadline=task.deadline - (1.0 - LONG_SHARE) * left) if np.isfinite(left) else task
    best, belief = np.zeros(task.problem.n_points, dtype=np.bool_), np.full(task.problem.n_points, 0.5)
    untimed = replace(task, deadline=np.inf)  # so that the learned search ends by itself
    first = propose(task) if task.problem.n_points <= PROPOSED_POINTS else iter(())
    for step in chain(first, search(untimed, belief_out=belief)):
        best = _larger(best, step)
        yield step
        if own.over():
            yield Step(subset=(best := _refined(task, best)), refined=True)
            break
    if not np.isfinite(left):
        yield from exact_partition(task, start=best, belief=belief, n_jobs=1, max_work=BRIEF_WORK)
        return
    if reckoned_proof(best) > HOPELESS * task.seconds_left():
        if BRIEF_SHARE * task.seconds_left() >= BRIEF_SECONDS:
            until = task.seconds_left() - BRIEF_SECONDS
            # One thread: those of an interrupted search go on beside what comes next.
            for step in exact_partition(task, start=best, belief=belief, n_jobs=1):
                best = _larger(best, step)
                yield step
                if task.seconds_left() <= until:
                    break
        for step in search(replace(task, deadline=task.deadline - BOUND_SHARE * left), belief_out=belief):
            best = _larger(best, step)
            yield step
    yield from exact_partition(task, start=best, belief=belief, n_jobs=n_jobs)


def _larger(best: NDArray[np.bool_], step: Step) -> NDArray[np.bool_]:
    """Return the set of a step if it is larger than the best, else that."""
    if step.subset is None or np.count_nonzero(step.subset) <= np.count_nonzero(best):
        return best
    return step.subset


def _refined(task: Task, best: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return swap_refinement(task, best) if best.any() else best
