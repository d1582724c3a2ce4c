"""The best settings of a peer for a time budget, found on instances that are judged nowhere."""

from __future__ import annotations

import gc
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from maxcon.experiments.bench_cells import Instance
from maxcon.experiments.bench_peers import Model, Peer, Run
from maxcon.minimax.clock import read_clock

#: Iterations of the first rung of the ladder, and the factor from rung to rung.
FIRST, FACTOR = 2, 2

#: A ladder also ends where this many rungs in a row, from so many iterations on, took no longer: it stops by itself.
IDLE_RUNGS, IDLE_FROM, IDLE_GROWTH = 3, 256, 1.1


@dataclass(frozen=True)
class Choice:
    """What a peer is given for a budget.

    Attributes
    ----------
    iterations, threshold
        Its settings.
    inliers, seconds
        What they brought (mean) and took (median) on the instances of the calibration, at the largest number of
        iterations tried that fits the budget.
    """

    iterations: int
    threshold: float
    inliers: float
    seconds: float


@dataclass(frozen=True)
class _Rung:
    iterations: int
    seconds: float
    inliers: float


def timed(run: Run, iterations: int, threshold: float) -> tuple[Model | None, float, str | None]:
    """Call a prepared peer; return its model, the seconds that it took, and what it raised, if anything.

    Peers report "nothing found" by exceptions of many kinds, and by warnings, which are silenced.
    """
    collecting = gc.isenabled()
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        gc.disable()
        began = read_clock()
        try:
            model, error = run(iterations, threshold), None
        except Exception as raised:  # whatever it is, it is a row of the record and not the end of the benchmark
            model, error = None, f"{type(raised).__name__}: {raised}".partition("\n")[0]
        finally:
            seconds = read_clock() - began
            if collecting:
                gc.enable()
    return model, seconds, error


def calibrate(peer: Peer, instances: Sequence[Instance], budgets: Sequence[float]) -> dict[float, Choice]:
    """Return the best settings for each budget, in seconds.

    For each threshold the iterations are doubled until the median time exceeds the largest budget. For a budget, the
    threshold is chosen that has the most inliers at the largest number of iterations that fits; then that
    number is raised by what is left of the budget, the time taken as linear in between. A peer for which even
    the least number is too long gets that, and its runs will be flagged.

    Parameters
    ----------
    peer
        The peer.
    instances
        What it is calibrated on.
    budgets
        Seconds; the median time is held below them.
    """
    runs = [peer.prepare(each, 0) for each in instances]
    timed(runs[0], FIRST, peer.thresholds[0])  # what is loaded on first use
    ladders = {threshold: _climb(peer, instances, runs, threshold, max(budgets)) for threshold in peer.thresholds}
    choices = {}
    for budget in budgets:
        offers = [_fitted(rungs, threshold, budget) for threshold, rungs in ladders.items()]
        affordable = [each for each in offers if each.seconds <= budget] or offers
        choices[budget] = max(affordable, key=lambda each: (each.inliers, -each.seconds))
    return choices


def _climb(
    peer: Peer, instances: Sequence[Instance], runs: Sequence[Run], threshold: float, longest: float
) -> list[_Rung]:
    rungs: list[_Rung] = []
    iterations = FIRST
    while True:
        seconds, inliers = [], []
        for instance, run in zip(instances, runs, strict=True):
            model, took, _ = timed(run, iterations, threshold)
            seconds.append(took)
            inliers.append(instance.count_model(model))
        # The median: a call that the machine interrupted says nothing of the peer.
        rungs.append(_Rung(iterations, float(np.median(seconds)), float(np.mean(inliers))))
        if rungs[-1].seconds > longest or iterations * FACTOR > peer.most or _idle(rungs):
            return rungs
        iterations *= FACTOR


def _idle(rungs: Sequence[_Rung]) -> bool:
    if len(rungs) <= IDLE_RUNGS or rungs[-1].iterations < IDLE_FROM:
        return False
    return rungs[-1].seconds < IDLE_GROWTH * min(each.seconds for each in rungs[-1 - IDLE_RUNGS : -1])


def _fitted(rungs: Sequence[_Rung], threshold: float, budget: float) -> Choice:
    fitting = [place for place, rung in enumerate(rungs) if rung.seconds <= budget]
    if not fitting:
        return Choice(rungs[0].iterations, threshold, rungs[0].inliers, rungs[0].seconds)
    last = fitting[-1]
    here = rungs[last]
    if last + 1 == len(rungs):
        return Choice(here.iterations, threshold, here.inliers, here.seconds)
    above = rungs[last + 1]
    part = (budget - here.seconds) / max(above.seconds - here.seconds, 1e-9)
    more = int(part * (above.iterations - here.iterations))
    return Choice(here.iterations + more, threshold, here.inliers, here.seconds)
