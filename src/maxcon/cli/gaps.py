"""The table of an evaluation: gaps before and after refinement, and times."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.table import Table

from maxcon.experiments.evaluation import REFERENCE, REFINEMENTS, Summary


def gap_table(rows: Sequence[Summary], title: str) -> Table:
    """Return the table of one N: a line for each outlier rate and method.

    Parameters
    ----------
    rows
        What `summarise` says of this N.
    title
        Of the table.
    """
    by_key = {(each.rate, each.name, each.refine): each for each in rows}
    rates = sorted({each.rate for each in rows})
    names = list(dict.fromkeys(each.name for each in rows))
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), title=title, title_justify="left", title_style="bold")
    table.caption, table.caption_justify = _caption(rows), "left"
    # Narrow enough for 80 columns, or cells would break into two lines.
    table.add_column("rate", justify="right")
    table.add_column("method")
    for heading in ("unrefined", "tree", "swap"):
        table.add_column(heading, justify="right")
    for heading in ("ms", "+swap"):
        table.add_column(heading, justify="right")
    for rate in rates:
        if table.row_count and len(names) > 1:
            table.add_row()
        for position, name in enumerate(names):
            cells = [by_key.get((rate, name, refine)) for refine in REFINEMENTS]
            first = f"{rate}%" if position == 0 else ""
            before, swap = cells[0], cells[-1]
            if before is None:
                continue
            if name == REFERENCE:
                label = "optimum" if before.proven else "best known"
                table.add_row(first, label, "", "", "", _ms(before), "", style="dim")
            else:
                table.add_row(first, name, *(_gap(each) for each in cells), _ms(before), _ms(swap))
    return table


def _caption(rows: Sequence[Summary]) -> str:
    goal = "the proven optimum" if all(each.proven for each in rows) else "the best consensus known"
    text = f"inliers short of {goal}: mean±standard error (median); ms: mean time of a fit, and with swaps"
    failures = sum(each.failures for each in rows)
    return f"{text}; {failures} fits failed and count as no inliers" if failures else text


def _gap(row: Summary | None) -> str:
    if row is None:
        return ""
    error = "" if math.isnan(row.standard_error) else f"±{row.standard_error:.2f}"
    return f"{row.mean_gap:.2f}{error} ({row.median_gap:g})"


def _ms(row: Summary | None) -> str:
    return "" if row is None else f"{row.mean_ms:.2f}" if row.mean_ms < 100 else f"{row.mean_ms:.0f}"
