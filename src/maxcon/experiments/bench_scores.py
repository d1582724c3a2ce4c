"""What the records of a benchmark say: scores of cells and families, cells that are lost, changes between two runs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from maxcon.experiments.bench import LATE, LATE_MS
from maxcon.experiments.bench_records import Row, Unit

#: The method that is to lose nowhere, and by how much it may be behind the best of a cell.
AUTO, ALLOWED = "auto", 0.05

#: A change counts as real from so many of its standard errors on.
SIGNIFICANT = 2.0

#: A cell of the tables: family, N, outlier rate in percent.
CellKey = tuple[str, int, int]


@dataclass(frozen=True)
class Score:
    """A method in a cell within a budget.

    Attributes
    ----------
    cell, budget, method
        What, in milliseconds.
    gaps
        The mean gap over the seeds of each instance, by the instance's name.
    mean, error
        Of the gap over the instances, and its standard error; NaN for a single instance.
    ms
        The median time of a run.
    runs, late
        How many runs there are, and how many took more than the budget, by 20% and 0.2 ms.
    failed, violations
        How many instances have runs without a result, and how many sets were not what they were said to be.
    """

    cell: CellKey
    budget: float
    method: str
    gaps: Mapping[str, float]
    mean: float
    error: float
    ms: float
    runs: int
    late: int
    failed: int
    violations: int

    @property
    def over(self) -> bool:
        """Whether it typically takes more than the budget, by 20% and 0.2 ms: then it competes with nobody."""
        return is_late(self.ms, self.budget)


@dataclass(frozen=True)
class FamilyScore:
    """A method on a family within a budget.

    Attributes
    ----------
    mean, error
        The mean gap over the cells, and its standard error.
    ms
        The mean over the cells of the median time, in milliseconds.
    cells, over
        How many cells there are, and in how many the median run exceeds the budget.
    """

    family: str
    budget: float
    method: str
    mean: float
    error: float
    ms: float
    cells: int
    over: int


@dataclass(frozen=True)
class Lost:
    """A cell in which "auto" is neither the best nor within 0.05 of it.

    Attributes
    ----------
    auto, best
        The scores; `best` is None where "auto" is over its budget and no other method is within.
    difference, error
        By how much the mean gap of "auto" is larger, and the standard error of that, instance by instance.
    """

    auto: Score
    best: Score | None
    difference: float
    error: float


@dataclass(frozen=True)
class Change:
    """What changed between two benchmarks.

    Attributes
    ----------
    cell, budget, method
        What, in milliseconds.
    instances
        How many instances both have.
    mean, error
        By how many inliers the gap grew (negative: shrank), and its standard error; NaN for a single instance.
    """

    cell: CellKey
    budget: float
    method: str
    instances: int
    mean: float
    error: float

    @property
    def real(self) -> bool:
        """Whether it exceeds two standard errors; never with a single instance."""
        return self.instances > 1 and abs(self.mean) > SIGNIFICANT * self.error

    @property
    def worse(self) -> bool:
        """Whether the gap grew by more than two standard errors."""
        return self.real and self.mean > 0


def is_late(ms: float, budget: float) -> bool:
    """Return whether a run of `ms` milliseconds exceeds its budget by more than 20% and 0.2 ms."""
    return ms > (1.0 + LATE) * budget + LATE_MS


def mean_and_error(values: Iterable[float]) -> tuple[float, float]:
    """Return the mean and its standard error, which is NaN for a single value."""
    array = np.array(list(values), dtype=np.float64)
    error = float(array.std(ddof=1) / np.sqrt(len(array))) if len(array) > 1 else float("nan")
    return float(array.mean()), error


def summarise(units: Iterable[Unit]) -> list[Score]:
    """Return the scores of all cells, budgets and methods, in the order in which they first appear."""
    groups: dict[tuple[CellKey, float, str], list[tuple[Unit, Row]]] = {}
    for unit in units:
        key = (unit.family, unit.n_points, unit.rate)
        for row in unit.rows:
            groups.setdefault((key, row.budget, row.method), []).append((unit, row))
    scores = []
    for (key, budget, method), group in groups.items():
        gaps = {unit.name: unit.reference - float(np.mean(row.inliers)) for unit, row in group}
        mean, error = mean_and_error(gaps.values())
        ms = [each for _, row in group for each in row.ms]
        scores.append(
            Score(
                cell=key,
                budget=budget,
                method=method,
                gaps=gaps,
                mean=mean,
                error=error,
                ms=float(np.median(ms)),
                runs=len(ms),
                late=sum(is_late(each, budget) for each in ms),
                failed=sum(row.error is not None for _, row in group),
                violations=sum(row.violations for _, row in group),
            )
        )
    return scores


def families(scores: Iterable[Score]) -> list[FamilyScore]:
    """Return the mean over the cells of each family, for every budget and method; cells weigh the same."""
    groups: dict[tuple[str, float, str], list[Score]] = {}
    for each in scores:
        groups.setdefault((each.cell[0], each.budget, each.method), []).append(each)
    return [
        FamilyScore(
            family=family,
            budget=budget,
            method=method,
            mean=float(np.mean([each.mean for each in group])),
            error=float(np.sqrt(np.sum([each.error**2 for each in group])) / len(group)),
            ms=float(np.mean([each.ms for each in group])),
            cells=len(group),
            over=sum(each.over for each in group),
        )
        for (family, budget, method), group in groups.items()
    ]


def best_of(scores: Iterable[Score]) -> Score | None:
    """Return the score with the least mean gap among those within their budget; "auto" where it is among several."""
    within = [each for each in scores if not each.over]
    return min(within, key=lambda each: (each.mean, each.method != AUTO), default=None)


def competitions(scores: Iterable[Score]) -> dict[tuple[CellKey, float], list[Score]]:
    """Return the scores of each cell and budget."""
    groups: dict[tuple[CellKey, float], list[Score]] = {}
    for each in scores:
        groups.setdefault((each.cell, each.budget), []).append(each)
    return groups


def lost_cells(scores: Iterable[Score]) -> list[Lost]:
    """Return where "auto" is neither the best nor within 0.05 of the best, or is over its budget; the worst first."""
    lost = []
    for group in competitions(scores).values():
        auto = next((each for each in group if each.method == AUTO), None)
        if auto is None:
            continue
        best = best_of(group)
        behind = best is not None and auto.mean > best.mean + ALLOWED
        if auto.over or behind:
            rival = best.gaps if best is not None else auto.gaps
            both = [name for name in auto.gaps if name in rival]
            difference, error = mean_and_error(auto.gaps[name] - rival[name] for name in both)
            lost.append(Lost(auto, best, difference, error))
    return sorted(lost, key=lambda each: -each.difference)


def late_rivals(scores: Iterable[Score]) -> list[tuple[Score, Score]]:
    """Return "auto" and the best method that is over its budget, where "auto" is more than 0.05 behind that."""
    found = []
    for group in competitions(scores).values():
        auto = next((each for each in group if each.method == AUTO), None)
        late = [each for each in group if each.over and each.method != AUTO]
        if auto is not None and late:
            rival = min(late, key=lambda each: each.mean)
            if auto.mean > rival.mean + ALLOWED:
                found.append((auto, rival))
    return found


def compare(old: Sequence[Unit], new: Sequence[Unit]) -> list[Change]:
    """Return the changes of all cells, budgets and methods that both benchmarks have, on the instances that both have.

    What is compared are inliers found: a larger best known, found by whomever, is no change of a method.

    Raises
    ------
    ValueError
        If there is nothing in common.
    """
    before, after = _found(old), _found(new)
    pairs: dict[tuple[CellKey, float, str], list[float]] = {}
    for key, (cell, inliers) in after.items():
        if key in before:
            _, budget, method = key
            pairs.setdefault((cell, budget, method), []).append(before[key][1] - inliers)
    if not pairs:
        raise ValueError("old and new must have instances in common (cells, seed, budgets and methods), but have none")
    return [
        Change(cell, budget, method, len(values), *mean_and_error(values))
        for (cell, budget, method), values in pairs.items()
    ]


def _found(units: Iterable[Unit]) -> dict[tuple[str, float, str], tuple[CellKey, float]]:
    """Return the cell, and the mean number of inliers over the seeds, by instance, budget and method."""
    return {
        (unit.name, row.budget, row.method): ((unit.family, unit.n_points, unit.rate), float(np.mean(row.inliers)))
        for unit in units
        for row in unit.rows
    }
