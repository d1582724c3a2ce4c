"""The front door: `maxcon.fit` and the table of methods."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np

from maxcon.minimax.jit import working_clock
from maxcon.problem import Consensus, LinearProblem, check_threshold
from maxcon.problem.validate import check_callback, check_gap, check_time_limit
from maxcon.search.anytime import Method, Progress, Refiner, make_task, run
from maxcon.search.conclusion import conclude
from maxcon.search.proof import then_prove


@dataclass(frozen=True)
class MethodEntry:
    """A row of the table of methods.

    Attributes
    ----------
    home
        Module and function, imported when first used.
    summary
        One line for people.
    """

    home: str
    summary: str

    def load(self) -> Method:
        """Return the generator function."""
        module, function = self.home.split(":")
        method: Method = getattr(import_module(module), function)
        return method


METHODS: dict[str, MethodEntry] = {
    "auto": MethodEntry(
        "maxcon.search.portfolio:auto",
        "exact for d <= 3, where the time allows; else the learned search, then the exact search",
    ),
    "agent": MethodEntry(
        "maxcon.search.agent_removal:agent_removal",
        "the paper's method: a learned agent removes basis points until the rest fits",
    ),
    "greedy": MethodEntry(
        "maxcon.search.removal:greedy",
        "removes the basis point whose removal lowers f(S) the most, until the rest fits",
    ),
    "random": MethodEntry(
        "maxcon.search.removal:random_removal",
        "removes random basis points until the rest fits (the paper's RB)",
    ),
    "ransac": MethodEntry(
        "maxcon.search.sampling:ransac", "models through minimal random samples (Fischler & Bolles 1981)"
    ),
    "lo-ransac": MethodEntry(
        "maxcon.search.sampling:lo_ransac", "RANSAC with local optimisation of every new best (Chum et al. 2003)"
    ),
    "gnc": MethodEntry(
        "maxcon.search.gnc:gnc", "graduated non-convexity with the Geman-McClure kernel (Yang et al. 2020)"
    ),
    "peel": MethodEntry(
        "maxcon.search.peel:peel",
        "from a good model, removes the basis point that it explains worst, until the rest fits",
    ),
    "learned": MethodEntry(
        "maxcon.search.learned:learned",
        "proposals from a belief, walks down the tree by a small network, a belief that learns; until the time is over",
    ),
    "uclm": MethodEntry(
        "maxcon.search.uclm:uclm",
        "weights from one pass of a network, models from the weights (Probst et al. 2019)",
    ),
    "sweep": MethodEntry(
        "maxcon.search.sweep:exact_sweep", "the proven optimum, d = 2: sweeps the arrangement of lines"
    ),
    "exact": MethodEntry(
        "maxcon.search.exact:exact", "the proven optimum: branch and bound, over parameters (d <= 3) or over points"
    ),
    "astar": MethodEntry("maxcon.search.astar:astar", "the proven optimum: A* tree search (Chin et al. 2015)"),
    "astar-napa": MethodEntry(
        "maxcon.search.astar:astar_napa", "A* with non-adjacent path avoidance (Cai et al. 2019)"
    ),
    "astar-napa-dibp": MethodEntry(
        "maxcon.search.astar:astar_napa_dibp", "the same with dimension-insensitive branch pruning (Cai et al. 2019)"
    ),
    "milp": MethodEntry("maxcon.search.milp:milp", "the proven optimum by big-M integer programming (HiGHS)"),
}

#: Methods that end with a proof, if they end; they need no other search after them.
PROVING = ("auto", "exact")

REFINERS: dict[str, str] = {
    "tree": "maxcon.search.refine:tree_refinement",
    "swap": "maxcon.search.refine:swap_refinement",
}


def fit(
    problem: LinearProblem,
    threshold: float,
    *,
    method: str = "auto",
    rng: int | np.random.Generator | None = None,
    time_limit: float | None = None,
    refine: str | None = "swap",
    gap: int = 0,
    certify: bool = False,
    callback: Callable[[Progress], object] | None = None,
    **options: Any,
) -> Consensus:
    """Find a model that explains as many points as possible within the threshold.

    Parameters
    ----------
    problem
        The points: `maxcon.line`, `maxcon.plane`, `maxcon.hyperplane` or `maxcon.LinearProblem`.
    threshold
        The largest residual of an inlier, in the unit of b.
    method
        A name from `maxcon.methods`.
    rng
        A seed or a NumPy generator. None stands for the seed 0: the same data get the same answer.
    time_limit
        Seconds after which the best so far is returned; None for no limit.
    refine
        What improves each set that the method finds: "tree" is local tree refinement (paper, Algorithm 2),
        "swap" also tries to give up one point for several, None does nothing.
    gap
        Stop as soon as the best found is proven to be within so many inliers of the largest possible.
    certify
        Prove how good the result is: the exact search follows the method, from its result, until the optimum is proven,
        the gap is reached or the time is over. The method itself then has half of the time. Without a time limit a
        proof can take long where there are many outliers and more than three parameters.
    callback
        Called with a `Progress` whenever the best set or the bound improves; a true return value stops the fit.
    **options
        Options of the method.

    Returns
    -------
    Consensus
        The best found until the method ended, the gap was reached, the time was over, the callback asked to stop, or
        Ctrl-C was pressed.

    Raises
    ------
    TypeError
        If an argument has the wrong type, or the method has no option of a given name.
    ValueError
        If an argument is out of its range; the message names it.
    """
    began = working_clock()
    if not isinstance(problem, LinearProblem):
        raise TypeError(f"problem must be a LinearProblem, but it is a {type(problem).__name__}")
    threshold = check_threshold(threshold)
    generator, seed = _check_rng(rng)
    check_time_limit(time_limit)
    gap = check_gap(gap)
    check_callback(callback)
    refiner = _check_refine(refine)
    if not isinstance(certify, bool):
        raise TypeError(f"certify must be True or False, but it is {certify!r}")
    function = METHODS[_check_method(method)].load()
    _check_options(method, function, options)

    task = make_task(problem, threshold, generator, time_limit, gap)
    if certify and method == "auto":  # whose time goes to a proof anyway
        function = METHODS["exact"].load()
    steps = then_prove(task, function, options) if certify and method not in PROVING else function(task, **options)
    best = run(task, steps, refiner, callback)
    result = conclude(task, best, method, seed, 0.0)
    return replace(result, seconds=working_clock() - began)


def methods() -> dict[str, str]:
    """Return the name of every method with one line on what it does."""
    return {name: entry.summary for name, entry in METHODS.items()}


def _check_rng(rng: Any) -> tuple[np.random.Generator, int | None]:
    if isinstance(rng, np.random.Generator):
        return rng, None
    if rng is None:
        return np.random.default_rng(0), 0
    if isinstance(rng, bool) or not isinstance(rng, (int, np.integer)):
        raise TypeError(f"rng must be None, a seed or a numpy Generator, but it is {rng!r}")
    if rng < 0:
        raise ValueError(f"rng must be a seed of at least 0, but it is {rng}")
    return np.random.default_rng(int(rng)), int(rng)


def _check_refine(refine: Any) -> Refiner | None:
    if refine is None:
        return None
    if not isinstance(refine, str):
        raise TypeError(f"refine must be 'tree', 'swap' or None, but it is {refine!r}")
    if refine not in REFINERS:
        raise ValueError(f"refine must be 'tree', 'swap' or None, but it is {refine!r}")
    module, function = REFINERS[refine].split(":")
    refiner: Refiner = getattr(import_module(module), function)
    return refiner


def _check_method(method: Any) -> str:
    if not isinstance(method, str):
        raise TypeError(f"method must be a string, but it is {method!r}")
    if method not in METHODS:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, but it is {method!r}")
    return method


def _check_options(name: str, function: Method, options: dict[str, Any]) -> None:
    if not options:
        return
    known = list(inspect.signature(function).parameters)[1:]
    for option in options:
        if option not in known:
            has = f"its options are {', '.join(known)}" if known else "this method takes no options"
            raise TypeError(f"unknown option {option!r} for method {name}: {has}")
