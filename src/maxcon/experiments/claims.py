"""What it takes to hold the paper to its word: claims, verdicts, and comparisons of records.

Every claim is answered from the records alone, by the rule that stands beside it, once for each method that it
could be about: the paper's agent as written, the shipped EdgeConv agent, and "auto".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from maxcon.experiments.contenders import AUTO, IN_AUTO_TIME, IN_PAPER_TIME, OURS, PAPER
from maxcon.experiments.records import Run

Verdict = Literal["holds", "does not hold", "holds only against the paper's slower baselines", "not run"]

HOLDS: Verdict = "holds"
FAILS: Verdict = "does not hold"
SLOWER: Verdict = "holds only against the paper's slower baselines"
NOT_RUN: Verdict = "not run"


@dataclass(frozen=True)
class Answer:
    """What the records say to a claim.

    Attributes
    ----------
    name
        The method that the claim is about.
    verdict
        Whether it holds.
    numbers
        Why, in figures.
    """

    name: str
    verdict: Verdict
    numbers: str


@dataclass(frozen=True)
class Claim:
    """A claim of the paper.

    Attributes
    ----------
    label
        As in "line 1".
    quote
        What the paper says.
    rule
        When it counts as holding.
    answers
        One for each method.
    """

    label: str
    quote: str
    rule: str
    answers: tuple[Answer, ...]


def for_each_of_ours(records: Sequence[Run], judge: Callable[[str], Answer]) -> tuple[Answer, ...]:
    """Return the answers for the three of our methods; "not run" for one that has no result."""
    known = {each.name for each in records if each.done}
    errors = {each.name: each.error for each in records if not each.done}
    return tuple(
        judge(name) if name in known else Answer(name, NOT_RUN, str(errors.get(name, "no records"))) for name in OURS
    )


def of(records: Sequence[Run], name: str) -> list[Run]:
    """Return the rows of a method that have a result."""
    return [each for each in records if each.name == name and each.done]


def cells_of(records: Sequence[Run]) -> list[tuple[Any, ...]]:
    """Return what instances are grouped by: N and rate where there is a rate, else the step between frames."""
    return sorted({cell_of(each) for each in records})


def cell_of(row: Run) -> tuple[Any, ...]:
    """Return the group of a row."""
    return (row.n_points, row.rate) if row.rate is not None else (row.step,)


def rival(baseline: str, ours: str) -> str:
    """Return the name of a RANSAC variant that had the time of `ours`."""
    return baseline + {AUTO: IN_AUTO_TIME, PAPER: IN_PAPER_TIME}.get(ours, "")


def paired(records: Sequence[Run], first: str, second: str) -> list[tuple[Run, Run]]:
    """Return the rows of two methods on the same instances."""
    other = {each.unit: each for each in of(records, second)}
    return [(each, other[each.unit]) for each in of(records, first) if each.unit in other]


@dataclass(frozen=True)
class Comparison:
    """One method beside another on the same instances.

    Attributes
    ----------
    pairs
        How many instances.
    ahead
        Mean of the first's consensus minus the second's.
    worst
        The smallest of these means over the cells.
    best
        The largest.
    wins, losses
        On how many instances the first has more inliers, or fewer.
    multiple
        Median of the second's time over the first's.
    """

    pairs: int
    ahead: float
    worst: float
    best: float
    wins: int
    losses: int
    multiple: float

    def __str__(self) -> str:
        return (
            f"{self.ahead:+.2f} inliers ({self.worst:+.2f} to {self.best:+.2f} in the cells; more on {self.wins}, "
            f"fewer on {self.losses} of {self.pairs}) at {self.multiple:.2f} times the time"
        )


def compare(records: Sequence[Run], first: str, second: str) -> Comparison | None:
    """Return how `first` does beside `second`; None where they share no instance."""
    both = paired(records, first, second)
    if not both:
        return None
    ahead = np.array([a.consensus - b.consensus for a, b in both], dtype=np.float64)
    groups: dict[tuple[Any, ...], list[float]] = {}
    for (a, _), value in zip(both, ahead, strict=True):
        groups.setdefault(cell_of(a), []).append(float(value))
    means = [float(np.mean(group)) for group in groups.values()]
    return Comparison(
        len(both),
        float(ahead.mean()),
        min(means),
        max(means),
        int((ahead > 0).sum()),
        int((ahead < 0).sum()),
        median_ratio(both),
    )


def median_ratio(both: Sequence[tuple[Run, Run]]) -> float:
    """Return the median of the second's time over the first's; NaN for none."""
    return float(np.median([b.seconds / max(a.seconds, 1e-9) for a, b in both])) if both else float("nan")


def better_than(
    records: Sequence[Run], ours: str, weak: Sequence[str], strong: Sequence[str], margin: float
) -> tuple[Verdict, str]:
    """Return whether `ours` finds more inliers than its rivals in the same time.

    Parameters
    ----------
    records
        Rows of all methods.
    ours
        One of ours.
    weak
        The baselines that the paper compares with.
    strong
        Those with the same refinement as ours.
    margin
        How many inliers ahead in the mean of all instances counts as better. A mean of -0.05 or more in every cell
        is asked for, too: nowhere worse.

    Returns
    -------
    "holds" if it is better than all; "holds only against the paper's slower baselines" if better than the weak and not
    than the strong ones; else "does not hold".
    """
    told, beaten = [], {}
    for baseline in (*weak, *strong):
        found = compare(records, ours, rival(baseline, ours))
        if found is not None:
            told.append(f"{baseline}: {found}")
            beaten[baseline] = found.ahead >= margin and found.worst >= -0.05
    if not any(name in beaten for name in weak):
        return NOT_RUN, "no baseline has a result"
    if not all(beaten.get(name, True) for name in weak):
        return FAILS, "; ".join(told)
    return (HOLDS if all(beaten.get(name, True) for name in strong) else SLOWER), "; ".join(told)


def optimal_share(rows: Sequence[Run]) -> float:
    """Return the share of runs that found as many inliers as anyone."""
    return float(np.mean([each.short == 0 for each in rows])) if rows else float("nan")


def by_rate(records: Sequence[Run], name: str, value: Callable[[Sequence[Run]], float], form: str = ".2f") -> str:
    """Return a value of a method at every outlier rate as text: "10%: 0.00, 20%: 0.01"."""
    rates = sorted({each.rate for each in of(records, name) if each.rate is not None})
    parts = []
    for rate in rates:
        rows = [each for each in of(records, name) if each.rate == rate]
        parts.append(f"{rate}%: {value(rows):{form}}")
    return ", ".join(parts)


def mean_short(rows: Sequence[Run]) -> float:
    """Return how many inliers are missing in the mean."""
    return float(np.mean([each.short for each in rows])) if rows else float("nan")


def median_seconds(rows: Sequence[Run]) -> float:
    """Return the median time."""
    return float(np.median([each.seconds for each in rows])) if rows else float("nan")
