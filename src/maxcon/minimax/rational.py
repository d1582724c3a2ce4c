"""Linear equations to the letter of the data, in rational arithmetic."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction


def reduced(rows: Iterable[Iterable[float]]) -> list[tuple[int, list[Fraction]]]:
    """Return the independent ones of some rows in reduced form: each with the column of its leading 1.

    That column is 0 in all the others.
    """
    solved: list[tuple[int, list[Fraction]]] = []
    for values in rows:
        row = [Fraction(value) for value in values]
        for lead, known in solved:
            if row[lead]:
                row = [x - row[lead] * y for x, y in zip(row, known, strict=True)]
        lead = next((k for k, value in enumerate(row) if value), len(row))
        if lead == len(row):
            continue
        row = [value / row[lead] for value in row]
        for place, (other, known) in enumerate(solved):
            if known[lead]:
                solved[place] = (other, [x - known[lead] * y for x, y in zip(known, row, strict=True)])
        solved.append((lead, row))
    return solved
