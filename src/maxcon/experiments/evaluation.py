"""Consensus against outlier rate (paper, figures of section 4.1): every method on held-out lines or planes.

For each number of points and outlier rate, every method fits the same held-out instances of the paper's protocol
without refinement, with local tree refinement and with the swap extension. A gap is the reference consensus minus the
consensus found; the reference is the proven optimum where the exact method serves the family, else the best that any
method found. Without refinement, the consensus of a method that walks down the tree is what its walk left.
"""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import maxcon
from maxcon.datasets.synthetic import THRESHOLD, synthetic_hyperplane
from maxcon.fitting import fit
from maxcon.problem import Consensus, LinearProblem

#: Parameters of the models of each family.
N_PARAMS = {"line": 2, "plane": 3}

#: Ways to refine, in the order of the tables.
REFINEMENTS: tuple[str | None, ...] = (None, "tree", "swap")

#: The name of the rows that tell what the reference took; no contender may have it.
REFERENCE = "reference"

#: Where no exact method serves, the reference is the best of these (and of the methods evaluated).
_FALLBACKS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("greedy", {}),
    ("lo-ransac", {}),
    ("gnc", {}),
    ("peel", {}),
    ("random", {"tries": 50}),
)


@dataclass(frozen=True)
class Contender:
    """A method under evaluation.

    Attributes
    ----------
    name
        What tables and figures call it.
    method, options
        As `maxcon.fit` takes them.
    """

    name: str
    method: str
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Settings:
    """What is evaluated on what.

    Attributes
    ----------
    family
        "line" or "plane".
    sizes
        Numbers of points (N).
    rates
        Outlier rates in whole percent.
    n_instances
        Instances for each N and rate.
    contenders
        The methods.
    seed
        Seeds the instances: those of N and rate come from ``default_rng([seed, 3, N, rate])``. Training draws
        from ``[seed, 1]`` and ``[seed, 2]``, so nothing here was trained on.
    """

    family: str
    sizes: tuple[int, ...]
    rates: tuple[int, ...]
    n_instances: int
    contenders: tuple[Contender, ...]
    seed: int = 0


@dataclass(frozen=True)
class Record:
    """One fit.

    Attributes
    ----------
    n_points, rate, instance
        The instance: N, outlier rate in percent, and its number among those.
    name
        Of the contender.
    refine
        None, "tree" or "swap".
    n_inliers
        The consensus found, without refinement the points that the walk down the tree left; 0 if the fit failed.
    reference
        The consensus to reach.
    proven
        Whether the reference is a proven optimum.
    seconds
        Wall-clock time of the fit, refinement included.
    error
        What went wrong; None where nothing did.
    """

    n_points: int
    rate: int
    instance: int
    name: str
    refine: str | None
    n_inliers: int
    reference: int
    proven: bool
    seconds: float
    error: str | None = None

    @property
    def gap(self) -> int:
        """How many inliers are missing."""
        return self.reference - self.n_inliers


@dataclass(frozen=True)
class Summary:
    """One row of the table: a method at one N and rate, with one refinement.

    Attributes
    ----------
    n_points, rate, name, refine
        As in `Record`.
    runs, failures
        How many fits, and how many of them failed.
    mean_gap, standard_error, median_gap
        Of the gaps, in inliers; the standard error is NaN for a single run.
    mean_ms
        Mean time of a fit in milliseconds.
    proven
        Whether all references are proven optima.
    """

    n_points: int
    rate: int
    name: str
    refine: str | None
    runs: int
    failures: int
    mean_gap: float
    standard_error: float
    median_gap: float
    mean_ms: float
    proven: bool


def instances(settings: Settings, n_points: int, rate: int) -> list[LinearProblem]:
    """Return the held-out instances of one N and outlier rate."""
    rng = np.random.default_rng([settings.seed, 3, n_points, rate])
    n_params = N_PARAMS[settings.family]
    return [synthetic_hyperplane(rng, n_points, rate / 100, n_params) for _ in range(settings.n_instances)]


def reference_consensus(problem: LinearProblem, threshold: float) -> tuple[int, bool, float]:
    """Return the consensus to reach, whether it is proven to be the largest, and the seconds that it took.

    The proven optimum where the exact method serves problems of this size, else the best of several searches.
    """
    try:
        exact = fit(problem, threshold, method="exact", refine=None)
    except ValueError:  # it does not serve this number of parameters
        found = [fit(problem, threshold, method=method, **options) for method, options in _FALLBACKS]
        return max(each.n_inliers for each in found), False, sum(each.seconds for each in found)
    return exact.n_inliers, exact.status == "optimal", exact.seconds


def evaluate(
    settings: Settings,
    *,
    done: Sequence[Record] = (),
    progress: Callable[[int, int], object] | None = None,
) -> Iterator[list[Record]]:
    """Yield the records of one instance after the other.

    Parameters
    ----------
    settings
        What to evaluate.
    done
        Records of an evaluation with the same settings that was stopped; their instances are not run again.
    progress
        Called with the number of instances done and of all instances.

    Raises
    ------
    ValueError
        If a method cannot serve the family, or a number is out of its range.
    """
    total = len(settings.sizes) * len(settings.rates) * settings.n_instances
    known = {(each.n_points, each.rate, each.instance) for each in done}
    _warm_up(settings)
    count = 0
    for n_points in settings.sizes:
        for rate in settings.rates:
            for number, problem in enumerate(instances(settings, n_points, rate)):
                if (n_points, rate, number) not in known:
                    yield run_instance(problem, settings.contenders, rate, number)
                count += 1
                if progress is not None:
                    progress(count, total)


def run_instance(
    problem: LinearProblem,
    contenders: Sequence[Contender],
    rate: int,
    number: int,
    reference: tuple[int, bool, float] | None = None,
    threshold: float = THRESHOLD,
) -> list[Record]:
    """Return the records of one instance: every contender with every refinement, and the reference.

    Parameters
    ----------
    problem, rate, number
        The instance, its outlier rate in percent, and its number, which also seeds the methods.
    contenders
        The methods.
    reference
        What `reference_consensus` says of the instance, if that is known already.
    threshold
        The inlier threshold.
    """
    goal, proven, goal_seconds = reference or reference_consensus(problem, threshold)
    runs: list[tuple[str, str | None, int, float, str | None]] = []
    for contender in contenders:
        for refine in REFINEMENTS:
            result = _fit(problem, contender, refine, number, threshold)
            if isinstance(result, str):
                runs.append((contender.name, refine, 0, 0.0, result))
            else:
                found = result.n_inliers if refine is not None else _walked(result)
                runs.append((contender.name, refine, found, result.seconds, None))
    if not proven:
        goal = max(goal, *(n_inliers for _, _, n_inliers, _, _ in runs))
    runs.append((REFERENCE, None, goal, goal_seconds, None))
    return [
        Record(problem.n_points, rate, number, name, refine, n_inliers, goal, proven, seconds, error)
        for name, refine, n_inliers, seconds, error in runs
    ]


def summarise(records: Iterable[Record]) -> list[Summary]:
    """Return a row for each N, rate, method and refinement, in the order in which they first appear."""
    groups: dict[tuple[int, int, str, str | None], list[Record]] = {}
    for each in records:
        groups.setdefault((each.n_points, each.rate, each.name, each.refine), []).append(each)
    rows = []
    for (n_points, rate, name, refine), group in groups.items():
        gaps = np.array([each.gap for each in group], dtype=np.float64)
        rows.append(
            Summary(
                n_points=n_points,
                rate=rate,
                name=name,
                refine=refine,
                runs=len(group),
                failures=sum(each.error is not None for each in group),
                mean_gap=float(gaps.mean()),
                standard_error=_standard_error(gaps),
                median_gap=float(np.median(gaps)),
                mean_ms=1e3 * float(np.mean([each.seconds for each in group])),
                proven=all(each.proven for each in group),
            )
        )
    return rows


def machine() -> dict[str, Any]:
    """Return what the times were taken on."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "maxcon": maxcon.__version__,
    }


class RecordFile:
    """The records of one evaluation in a folder: ``settings.json`` and ``records.jsonl``, a line a fit.

    The records of an instance are written together once all its fits are done, so an evaluation that was stopped at
    any moment goes on where it stood.
    """

    def __init__(self, folder: Path, settings: Settings) -> None:
        self.path = folder / "records.jsonl"
        described = folder / "settings.json"
        asked = json.loads(json.dumps(asdict(settings)))
        if described.exists() and self.path.exists():
            if json.loads(described.read_text(encoding="utf-8"))["settings"] != asked:
                raise ValueError(f"{folder} holds an evaluation with other settings ({described}); name another folder")
        else:
            text = json.dumps({"settings": asked, "machine": machine()}, indent=2)
            described.write_text(text + "\n", encoding="utf-8")
        self.done = self._read(settings)

    def add(self, records: Sequence[Record]) -> None:
        """Append the records of an instance."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write("".join(json.dumps(asdict(each)) + "\n" for each in records))
        self.done += records

    def _read(self, settings: Settings) -> list[Record]:
        """Return the records of complete instances, and drop what a kill left of another from the file."""
        if not self.path.exists():
            return []
        lines = self.path.read_text(encoding="utf-8").splitlines()
        records = [Record(**json.loads(line)) for line in lines if line.endswith("}")]
        count: dict[tuple[int, int, int], int] = {}
        for each in records:
            key = (each.n_points, each.rate, each.instance)
            count[key] = count.get(key, 0) + 1
        complete = len(settings.contenders) * len(REFINEMENTS) + 1
        kept = [each for each in records if count[each.n_points, each.rate, each.instance] == complete]
        if len(kept) < len(lines):
            part = self.path.with_suffix(".part")
            part.write_text("".join(json.dumps(asdict(each)) + "\n" for each in kept), encoding="utf-8")
            os.replace(part, self.path)
        return kept


def _fit(
    problem: LinearProblem, contender: Contender, refine: str | None, seed: int, threshold: float = THRESHOLD
) -> Consensus | str:
    """Return the result, or what went wrong: a failed fit stays as a record."""
    try:
        return fit(problem, threshold, method=contender.method, rng=seed, refine=refine, **contender.options)
    except ArithmeticError as error:
        return str(error)


def _walked(result: Consensus) -> int:
    """Return how many points a walk down the tree kept: what the paper calls the solution before refinement.

    `maxcon.fit` counts all inliers of that set's minimax fit, which can be more.
    """
    return len(result.inlier_mask) - len(result.path) if len(result.path) else result.n_inliers


def _warm_up(settings: Settings) -> None:
    """Fit once with everything, so that no time measured includes the compilation of a kernel."""
    problem = instances(settings, settings.sizes[0], settings.rates[0])[0]
    reference_consensus(problem, THRESHOLD)
    for contender in settings.contenders:
        for refine in REFINEMENTS:
            _fit(problem, contender, refine, 0)


def _standard_error(values: NDArray[np.float64]) -> float:
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")


def _processor() -> str:
    if sys.platform == "linux":
        for entry in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if entry.startswith("model name"):
                return entry.partition(":")[2].strip()
    return platform.processor() or platform.machine()
