"""The page of a benchmark, Markdown: who is best where, which cells are lost, and what was checked."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from maxcon.experiments.bench_records import Unit, replace_file
from maxcon.experiments.bench_scores import (
    ALLOWED,
    AUTO,
    CellKey,
    Change,
    FamilyScore,
    Lost,
    Score,
    best_of,
    competitions,
    families,
    late_rivals,
    lost_cells,
    summarise,
)

#: What is said of a machine that had other things to do.
_BUSY = ": the machine was busy, so that within a budget everyone did less than the machine can, and runs were late."

#: The time taken is shown where it is less than this share of the budget.
_EARLY = 0.6

#: Means this close are equal.
_TIE = 1e-9

_RULES = f"""
- The gap is the largest consensus known minus the number of points that the model returned explains:
  |a . theta - b| at most the threshold, with the package's slack for rounding, recounted for everyone in the same
  way. Tables show the mean over the instances +- its standard error; the seeds of an instance are averaged first.
- The largest consensus known is the proven optimum where the exact method proves one within its time limit, and else
  the best that any method found within any budget or in a long run.
- A budget is {{clock}} on one core. For our methods it covers everything from the problem to the result; for
  peers it covers their call alone, on data in the form that they take. Counting inliers is outside it for everyone.
  On each instance the methods take their turns in random order.
- Peers have, for each cell and budget, the number of iterations that fits and the best threshold, found on
  separate instances (calibration.jsonl says which). Nothing of ours refines what they return. Peers for fundamental
  matrices return matrices of rank 2 and measure pixels; they are judged by the algebraic residual of the chart.
- The chart of the family "fundamental" is rotated to a rough robust estimate. Making that estimate is a part of
  posing the problem, and of nobody's budget. "fundamental-F32" has the chart F32 = 1.
- A run is late if it exceeds its budget by more than 20% and 0.2 ms. A method whose median run is late is marked (!)
  with that median, and does not compete for the best of a cell.
- Bold is the best of a column. A cell counts as lost where "{AUTO}" is neither the best nor within {ALLOWED:g} of it,
  or is itself over its budget.
"""


def write_page(folder: Path, header: Mapping[str, Any], units: Sequence[Unit], absent: Mapping[str, str]) -> list[Path]:
    """Write ``leaderboard.md`` and a figure for each family into a folder; return what was written.

    Parameters
    ----------
    folder
        Where they go.
    header, units
        Of the benchmark, see `maxcon.experiments.bench_records.read_bench`.
    absent
        Peers that are not installed, with the packages that bring them.

    Raises
    ------
    ModuleNotFoundError
        If matplotlib is not installed.
    ValueError
        If there are no records.
    """
    from maxcon.experiments.canvas import picture  # noqa: PLC0415  (only pictures need matplotlib)
    from maxcon.experiments.leaderboard_figure import draw_family  # noqa: PLC0415

    if not units:
        raise ValueError("units must hold at least one record, but there are none")
    scores = summarise(units)
    written = []
    for family in dict.fromkeys(each.cell[0] for each in scores):
        path = folder / f"gap-{family}.png"
        path.write_bytes(picture(draw_family(scores, family), "png"))
        written.append(path)
    page = folder / "leaderboard.md"
    replace_file(page, page_text(header, units, absent))
    return [page, *written]


def page_text(header: Mapping[str, Any], units: Sequence[Unit], absent: Mapping[str, str]) -> str:
    """Return the page."""
    scores = summarise(units)
    lost = lost_cells(scores)
    parts = [
        "# Leaderboard\n",
        _about(header, units, scores),
        _notes(units, absent),
        "## How to read it\n" + _RULES.format(clock=_clock(header)),
    ]
    parts.append(_checks(units, scores, busy=not header["settings"].get("cpu_time")))
    parts.append(_lost_text(lost, scores))
    for family in dict.fromkeys(each.cell[0] for each in scores):
        mine = [each for each in scores if each.cell[0] == family]
        parts.append(f"## {family}\n")
        parts.append(f"![gap against time](gap-{family}.png)\n")
        parts.append(f"Mean over the {len({each.cell for each in mine})} cells of the family:\n")
        parts.append(_family_table([each for each in families(scores) if each.family == family]))
        parts += [_size_tables(mine, n_points) for n_points in sorted({each.cell[1] for each in mine})]
    return "\n".join(parts)


def _clock(header: Mapping[str, Any]) -> str:
    """Return which time was counted."""
    return "time on the processor" if header["settings"].get("cpu_time") else "wall-clock time"


def family_lines(scores: Sequence[Score]) -> list[str]:
    """Return the mean gap of each method on each family within each budget, as lines of text."""
    found = families(scores)
    budgets = sorted({each.budget for each in found})
    width = max((len(each.method) for each in found), default=0)
    lines = []
    for family in dict.fromkeys(each.family for each in found):
        lines.append(f"{family + ', mean gap':{width + 2}}" + "".join(f"{f'{budget:g} ms':>16}" for budget in budgets))
        for method in dict.fromkeys(each.method for each in found if each.family == family):
            mine = {each.budget: each for each in found if (each.family, each.method) == (family, method)}
            texts = [
                _plain(mine[budget].mean, mine[budget].error) + "!" * (mine[budget].over > 0) if budget in mine else ""
                for budget in budgets
            ]
            lines.append(f"  {method:{width}}" + "".join(f"{text:>16}" for text in texts))
    return lines


def change_lines(changes: Sequence[Change]) -> list[str]:
    """Return the comparison as lines of text: per cell the change of each method, then what exceeds two errors."""
    lines = ["change of the mean gap, new - old, +- its standard error; * exceeds two of them (below 0 is better)"]
    budgets = sorted({each.budget for each in changes})
    width = max(len(each.method) for each in changes)
    for cell in dict.fromkeys(each.cell for each in changes):
        here = [each for each in changes if each.cell == cell]
        lines.append(f"{cell[0]}, N = {cell[1]}, {cell[2]}% outliers ({here[0].instances} instances)")
        lines.append(" " * (width + 2) + "".join(f"{f'{budget:g} ms':>20}" for budget in budgets))
        for method in dict.fromkeys(each.method for each in here):
            values = {each.budget: each for each in here if each.method == method}
            texts = [_change(values[budget]) if budget in values else "" for budget in budgets]
            lines.append(f"  {method:{width}}" + "".join(f"{text:>20}" for text in texts))
    real = [each for each in changes if each.real]
    lines.append(f"{len(real)} of {len(changes)} changes exceed two standard errors")
    for each in sorted(real, key=lambda change: -change.mean):
        word = "worse" if each.worse else "better"
        lines.append(
            f"  {word}: {each.method}, {each.cell[0]} N = {each.cell[1]} {each.cell[2]}%, {each.budget:g} ms: "
            f"{each.mean:+.2f} +-{each.error:.2f}"
        )
    return lines


def _about(header: Mapping[str, Any], units: Sequence[Unit], scores: Sequence[Score]) -> str:
    settings, found = header["settings"], header["versions"]
    cells = len({each.cell for each in scores})
    jobs = settings["jobs"]
    crowd = "one at a time" if jobs == 1 else f"{jobs} at a time, which disturbs the times of all"
    seeds = settings["seeds"]
    text = (
        f"{cells} cells, {len(units)} instances ({settings['instances']} a cell, seed {settings['seed']}), "
        f"{seeds} seed{'s' * (seeds != 1)} of each method, run {crowd}, on {header['processor']}. "
        f"Versions: {', '.join(f'{name} {version}' for name, version in sorted(found.items()))}.\n"
    )
    codes = sorted({each.code for each in units})
    if len(codes) > 1:
        text += f"\nThe source of the package changed while this ran: {len(codes)} states of it are in the records.\n"
    wanted = cells * settings["instances"]
    if len(units) < wanted:
        text += f"\nNot complete: {len(units)} of {wanted} instances in the cells begun.\n"
    return text


def _notes(units: Sequence[Unit], absent: Mapping[str, str]) -> str:
    lines = [f"- {name}: not installed (pip install {package})" for name, package in absent.items()]
    missing: dict[str, list[str]] = {}
    for unit in units:
        for name in unit.missing:
            if unit.family not in missing.setdefault(name, []):
                missing[name].append(unit.family)
    lines += [f"- {name}: does not serve {', '.join(names)}" for name, names in missing.items()]
    return "Not in the tables:\n\n" + "\n".join(lines) + "\n" if lines else ""


def _checks(units: Sequence[Unit], scores: Sequence[Score], *, busy: bool) -> str:
    runs = sum(each.runs for each in scores)
    violations = sum(each.violations for each in scores)
    above = sum(each.above_proven for each in units)
    proven = sum(each.proven for each in units)
    finders: dict[str, int] = {}
    for unit in units:
        if not unit.proven:
            finders[unit.reference_by] = finders.get(unit.reference_by, 0) + 1
    best_known = ", ".join(f"{name} {count}" for name, count in sorted(finders.items(), key=lambda pair: -pair[1]))
    late = sum(each.late for each in scores)
    core = float(np.mean([each.core for each in units]))
    failed = [each for each in scores if each.failed]
    lines = [
        "## What was checked\n",
        f"- {runs} runs, of which {violations} returned a set that its model does not explain, and {above} more "
        f"points than the proven optimum has (both must be 0).",
        f"- {proven} of {len(units)} references are proven optima"
        + (f"; the others: {best_known}." if finders else "."),
        f"- {late} of {runs} runs were late ({late / max(runs, 1):.1%}).",
        f"- The runs had {core:.0%} of a core" + (_BUSY if busy and core < 0.95 else "."),
    ]
    if failed:
        counts: dict[str, int] = {}
        for each in failed:
            counts[each.method] = counts.get(each.method, 0) + each.failed
        named = ", ".join(f"{name} {count}" for name, count in counts.items())
        lines.append(f"- Instances with runs that raised an error and count as 0 inliers: {named}.")
    return "\n".join(lines) + "\n"


def _lost_text(lost: Sequence[Lost], scores: Sequence[Score]) -> str:
    if not any(each.method == AUTO for each in scores):
        return f'## Lost cells\n\n"{AUTO}" did not run.\n'
    total = len(competitions(scores))
    if not lost:
        return f'## Lost cells\n\nNone: "{AUTO}" is the best or within {ALLOWED:g} of it in all {total}.\n' + _late(
            scores
        )
    lines = [
        f'## Lost cells\n\n"{AUTO}" is the best or within {ALLOWED:g} of it in {total - len(lost)} of {total}; '
        f"not in these:\n",
        f"| family | N | outliers | budget | {AUTO} | best | its gap | difference |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for each in lost:
        family, n_points, rate = each.auto.cell
        name, gap = (each.best.method, _plain(each.best.mean, each.best.error)) if each.best else ("-", "-")
        lines.append(
            f"| {family} | {n_points} | {rate}% | {each.auto.budget:g} ms | {_score(each.auto, bold=False)} | {name} | "
            f"{gap} | {_plain(each.difference, each.error)} |"
        )
    return "\n".join(lines) + "\n" + _late(scores)


def _late(scores: Sequence[Score]) -> str:
    """Return where a method that takes more than its budget is ahead: nothing is lost there, and nothing hidden."""
    places: dict[str, list[str]] = {}
    for auto, rival in late_rivals(scores):
        family, n_points, rate = auto.cell
        places.setdefault(rival.method, []).append(f"{family} N = {n_points} {rate}% at {auto.budget:g} ms")
    if not places:
        return ""
    named = "; ".join(f"{name} in {len(cells)} ({', '.join(cells)})" for name, cells in places.items())
    return f"\nBesides, it is behind a method that takes more than the budget: {named}.\n"


def _family_table(rows: Sequence[FamilyScore]) -> str:
    budgets = sorted({each.budget for each in rows})
    methods = list(dict.fromkeys(each.method for each in rows))
    values = {(each.method, each.budget): each for each in rows}
    whole = max(each.cells for each in rows)
    least = {
        budget: min(
            (each.mean for each in rows if each.budget == budget and each.cells == whole and 2 * each.over <= whole),
            default=np.nan,
        )
        for budget in budgets
    }
    lines = [_table_head("method", [f"{budget:g} ms" for budget in budgets])]
    for method in methods:
        texts = []
        for budget in budgets:
            each = values.get((method, budget))
            if each is None:
                texts.append("")
                continue
            bold = each.mean <= least[budget] + _TIE and each.cells == whole and 2 * each.over <= whole
            over = f" (! {each.over} of {each.cells})" if each.over else ""
            early = f" ({each.ms:.2g} ms)" if each.ms < _EARLY * budget and not each.over else ""
            texts.append(_plain(each.mean, each.error, bold=bold) + over + early)
        lines.append(f"| {method} | " + " | ".join(texts) + " |")
    notes = []
    if any(each.over for each in rows):
        notes.append("!: in how many cells the median run exceeds the budget")
    if any(each.ms < _EARLY * each.budget for each in rows):
        notes.append(f"ms: the time taken, where that is less than {_EARLY:.0%} of the budget")
    note = f"\n({'; '.join(notes)}.)\n" if notes else ""
    return "\n".join(lines) + "\n" + note


def _size_tables(scores: Sequence[Score], n_points: int) -> str:
    """Return a table for each budget: methods down, outlier rates across; folded away."""
    mine = [each for each in scores if each.cell[1] == n_points]
    rates = sorted({each.cell[2] for each in mine})
    parts = [f"<details><summary>N = {n_points}, by outlier rate</summary>\n"]
    for budget in sorted({each.budget for each in mine}):
        here = {(each.cell, each.method): each for each in mine if each.budget == budget}
        best = _least(mine, budget)
        lines = [_table_head(f"{budget:g} ms", [f"{rate}%" for rate in rates])]
        for method in dict.fromkeys(each.method for each in mine):
            texts = []
            for rate in rates:
                each = here.get(((mine[0].cell[0], n_points, rate), method))
                bold = each is not None and not each.over and each.mean <= best[each.cell] + _TIE
                texts.append(_score(each, bold=bold) if each is not None else "")
            lines.append(f"| {method} | " + " | ".join(texts) + " |")
        parts.append("\n".join(lines) + "\n")
    return "\n".join([*parts, "</details>\n"])


def _least(scores: Iterable[Score], budget: float) -> dict[CellKey, float]:
    """Return the least mean gap of each cell within a budget; NaN where nobody keeps to it."""
    found = {}
    for (cell, spent), group in competitions(scores).items():
        if spent == budget:
            best = best_of(group)
            found[cell] = best.mean if best is not None else float("nan")
    return found


def _table_head(corner: str, columns: Sequence[str]) -> str:
    return f"| {corner} | " + " | ".join(columns) + " |\n" + "| --- " * (len(columns) + 1) + "|"


def _score(score: Score, *, bold: bool) -> str:
    return _plain(score.mean, score.error, bold=bold) + (f" (! {score.ms:.3g} ms)" if score.over else "")


def _plain(mean: float, error: float, *, bold: bool = False) -> str:
    digits = 2 if abs(mean) < 9.995 else 1
    number = f"**{mean:.{digits}f}**" if bold else f"{mean:.{digits}f}"
    return number if np.isnan(error) else f"{number} +-{error:.{digits}f}"


def _change(change: Change) -> str:
    if np.isnan(change.error):
        return f"{change.mean:+.2f}"
    return f"{change.mean:+.2f} +-{change.error:.2f}{'*' if change.real else ' '}"
