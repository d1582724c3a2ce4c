"""The methods that the experiments compare, and how they compete on one instance at equal time."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from maxcon.agent.shipped import agent_names, agent_path
from maxcon.experiments.records import EXACT, Run, processor, versions
from maxcon.fitting import METHODS, fit
from maxcon.problem import Consensus, LinearProblem

#: What tables and figures call the methods.
ASTAR, DIBP = "A*", "A*-NAPA-DIBP"
PAPER, AGENT, AUTO = "paper's agent", "EdgeConv agent", "auto"
TUNED, LEARNED, UCLM, UCLM_SWAP = "EdgeConv agent, fine-tuned", "learned", "UCLM", "UCLM + swap"
RB, RB_TREE = "RB", "RB + tree"
RANSAC, LO, LO_SWAP = "RANSAC", "LO-RANSAC", "LO-RANSAC + swap"

#: The three of ours that every claim is checked for.
OURS = (PAPER, AGENT, AUTO)

#: Added to the name of a method that had the time of "auto", or of the paper's agent, instead of the EdgeConv agent's.
IN_AUTO_TIME, IN_PAPER_TIME = ", auto's time", ", paper's agent's time"

#: Added to "auto" where it had the time of another.
AUTO_LONG, AUTO_UCLM = f"{AUTO}, agent's time", f"{AUTO}, UCLM's time"

#: More samples than any time limit here lets them draw: only the time ends a RANSAC.
_ENDLESS = 10**9


@dataclass(frozen=True)
class Contender:
    """A method under comparison.

    Attributes
    ----------
    name
        What tables and figures call it.
    method, options, refine
        As `maxcon.fit` takes them.
    time_limit
        Seconds; None for no limit.
    budget
        The names of contenders before this one: the time of the first of them that has run is the time limit.
    first
        Runs only on so many instances of a cell, the first ones; None for all.
    missing
        Why it cannot run; None where it can.
    """

    name: str
    method: str
    options: dict[str, Any] = field(default_factory=dict)
    refine: str | None = "swap"
    time_limit: float | None = None
    budget: tuple[str, ...] = ()
    first: int | None = None
    missing: str | None = None

    def describe(self) -> dict[str, Any]:
        """Return what belongs into the settings of an experiment: files by their content, not their place."""
        about: dict[str, Any] = {
            "name": self.name,
            "method": self.method,
            "options": {key: _content(value) for key, value in self.options.items()},
            "refine": self.refine,
            "time_limit": self.time_limit,
            "budget": list(self.budget),
            "first": self.first,
            "missing": self.missing,
        }
        return about


@dataclass(frozen=True)
class Instance:
    """A problem with what its records say of it; see `Run`."""

    experiment: str
    unit: str
    instance: str
    problem: LinearProblem
    threshold: float
    seed: int
    number: int
    rate: int | None = None
    step: int | None = None


def synthetic_contenders(
    family: str, proof_time: float, astar_time: float, astar_first: int, weights: Mapping[str, str]
) -> tuple[Contender, ...]:
    """Return what is compared on lines and planes.

    Parameters
    ----------
    family
        "line" or "plane".
    proof_time, astar_time
        Time limits of the exact method and of A*, in seconds.
    astar_first
        A* runs on so many instances of a cell.
    weights
        Agent files by the name of the agent: "line", "line-paper" and so on; those shipped where there is none.
    """
    paper = _agent(PAPER, f"{family}-paper", "tree", weights)
    return (
        Contender(EXACT, "exact", refine=None, time_limit=proof_time),
        Contender(ASTAR, "astar", time_limit=astar_time, first=astar_first),
        Contender(DIBP, "astar-napa-dibp", time_limit=astar_time, first=astar_first),
        paper,
        _agent(AGENT, family, "swap", weights),
        Contender(AUTO, "auto"),
        *_if_known(Contender(LEARNED, "learned")),
        Contender(RB, "random", refine=None),
        Contender(RB_TREE, "random", refine="tree"),
        *_sampling(paper),
    )


def two_view_contenders(
    proof_time: float, astar_time: float, astar_first: int, weights: Mapping[str, str], *, tuned: bool = False
) -> tuple[Contender, ...]:
    """Return what is compared on fundamental matrices; the parameters are those of `synthetic_contenders`.

    `tuned` adds the agent "fundamental-kitti", fine-tuned on real pairs, where there is one.
    """
    fine = _agent(TUNED, "fundamental-kitti", "swap", weights)
    paper = _agent(PAPER, "fundamental-paper", "tree", weights)
    return (
        Contender(EXACT, "exact", {"n_jobs": 1}, refine=None, time_limit=proof_time),
        Contender(DIBP, "astar-napa-dibp", time_limit=astar_time, first=astar_first),
        paper,
        _agent(AGENT, "fundamental", "swap", weights),
        *((fine,) if tuned else ()),
        Contender(AUTO, "auto", {"n_jobs": 1}),
        _known(Contender(UCLM, "uclm", refine=None)),
        _known(Contender(UCLM_SWAP, "uclm", refine="swap")),
        *_if_known(Contender(LEARNED, "learned")),
        Contender(AUTO_LONG, "auto", {"n_jobs": 1}, budget=(AGENT, AUTO)),
        *_if_known(Contender(AUTO_UCLM, "auto", {"n_jobs": 1}, budget=(UCLM, AUTO)), "uclm"),
        Contender(RB, "random", refine=None),
        Contender(RB_TREE, "random", refine="tree"),
        *_sampling(paper),
    )


def _sampling(paper: Contender) -> tuple[Contender, ...]:
    """Return the RANSAC variants, in the time of each of ours."""
    times: tuple[tuple[str, tuple[str, ...]], ...] = (("", (AGENT, AUTO)), (IN_AUTO_TIME, (AUTO,)))
    if paper.missing is None:
        times += ((IN_PAPER_TIME, (PAPER,)),)
    return tuple(
        Contender(name + suffix, method, {"samples": _ENDLESS}, refine, budget=budget)
        for suffix, budget in times
        for name, method, refine in ((RANSAC, "ransac", None), (LO, "lo-ransac", None), (LO_SWAP, "lo-ransac", "swap"))
    )


def _agent(name: str, agent: str, refine: str, weights: Mapping[str, str]) -> Contender:
    if agent in weights:
        return Contender(name, "agent", {"weights": weights[agent]}, refine)
    if agent in agent_names():
        return Contender(name, "agent", {"weights": str(agent_path(agent))}, refine)
    return Contender(name, "agent", {}, refine, missing=f"not installed: no agent {agent!r} is shipped or given")


def _known(contender: Contender) -> Contender:
    if contender.method in METHODS:
        return contender
    return replace(contender, missing=f"not installed: this version has no method {contender.method!r}")


def _if_known(contender: Contender, method: str | None = None) -> tuple[Contender, ...]:
    """Return the contender unless the method, which the paper does not have, is not there."""
    return (contender,) if (method or contender.method) in METHODS else ()


def compete(
    instance: Instance, contenders: Sequence[Contender], factor: float, digest: str = ""
) -> tuple[list[Run], dict[str, Consensus]]:
    """Run all contenders on an instance, one after the other.

    Parameters
    ----------
    instance
        The instance.
    contenders
        In their order: whose time is a limit for others comes before them.
    factor
        Time limits that are the time of another method are so many times as long.
    digest
        Of the experiment's settings.

    Returns
    -------
    The records, and the results by the contenders' names.
    """
    contenders = [each for each in contenders if each.first is None or instance.number < each.first]
    results: dict[str, Consensus] = {}
    errors: dict[str, str] = {}
    limits: dict[str, tuple[str | None, float | None]] = {}
    for each in contenders:
        payer = next((name for name in each.budget if name in results), None)
        limit = each.time_limit if payer is None else factor * results[payer].seconds
        limits[each.name] = payer, limit
        if each.missing is not None:
            errors[each.name] = each.missing
            continue
        if each.budget and payer is None:  # without a limit it would never end
            errors[each.name] = f"failed: none of {', '.join(each.budget)} ran, whose time is its limit"
            continue
        try:
            results[each.name] = _fit(instance, each, limit)
        except ArithmeticError as error:  # a failed run stays as a row; a wrong argument is a mistake of ours
            errors[each.name] = f"failed: {error}"
    best = max((each.n_inliers for each in results.values()), default=0)
    bound = min((each.upper_bound for each in results.values()), default=instance.problem.n_points)
    rows = []
    for each in contenders:
        payer, limit = limits[each.name]
        row = _row(instance, each, results.get(each.name), errors.get(each.name), bound, best, payer, limit)
        if payer is not None and each.name in results:
            row = replace(row, multiple=results[each.name].seconds / results[payer].seconds)
        rows.append(replace(row, rows=len(contenders), digest=digest))
    return rows, results


def warm_up(instance: Instance, contenders: Sequence[Contender]) -> None:
    """Run every contender on a small instance, so that no time measured includes the compilation of a kernel.

    Twice: the first time compiling may take all the time that there is, before all of the method was called.
    """
    for each in contenders:
        if each.missing is None:
            endless = each.options.get("samples") == _ENDLESS
            brief = replace(each, options=each.options | {"samples": 200}) if endless else each
            for _ in range(2):
                try:
                    _fit(instance, brief, 0.3)
                except ArithmeticError:
                    break  # it will show in the records


def _fit(instance: Instance, contender: Contender, limit: float | None) -> Consensus:
    return fit(
        instance.problem,
        instance.threshold,
        method=contender.method,
        rng=instance.seed,
        refine=contender.refine,
        time_limit=limit,
        **contender.options,
    )


def _row(
    instance: Instance,
    contender: Contender,
    result: Consensus | None,
    error: str | None,
    bound: int,
    best: int,
    payer: str | None,
    limit: float | None,
) -> Run:
    walked = len(result.inlier_mask) - len(result.path) if result is not None and len(result.path) else None
    found = result.n_inliers if result is not None else 0
    if contender.refine is None and walked is not None:
        found = walked  # the paper's set is the one that the walk ends in; `maxcon.fit` counts all its fit explains
    failed = "not installed" if contender.missing is not None else "failed"
    return Run(
        experiment=instance.experiment,
        unit=instance.unit,
        rows=0,
        instance=instance.instance,
        n_points=instance.problem.n_points,
        rate=instance.rate,
        step=instance.step,
        name=contender.name,
        method=contender.method,
        settings={
            "options": {key: _short(value) for key, value in contender.options.items()},
            "refine": contender.refine,
            "time_limit": limit,
            "budget": payer,
            "seed": instance.seed,
            "threshold": instance.threshold,
        },
        consensus=found,
        before_refinement=walked,
        upper_bound=bound,
        proven=best == bound,
        best=best,
        gap=bound - found,
        status=result.status if result is not None else failed,
        seconds=result.seconds if result is not None else 0.0,
        error=error,
        versions=versions(),
        processor=processor(),
    )


def _short(value: Any) -> Any:
    """Return an option as the records show it: a file by its name."""
    return Path(value).name if isinstance(value, str) else value


@functools.cache
def _digest_of(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:12]


def _content(value: Any) -> Any:
    return f"sha256 {_digest_of(value)}" if isinstance(value, str) and Path(value).is_file() else value
