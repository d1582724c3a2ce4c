"""How results look: tables for people, JSON for programs."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from maxcon.problem import Consensus

#: Columns assumed where standard output is no terminal.
PLAIN_WIDTH = 120

#: So many outliers are listed by their rows; of more, the number is enough.
LISTED_OUTLIERS = 30


def console(*, stderr: bool = False) -> Console:
    """Return a console; where it is no terminal, lines may be longer than the 80 columns of an old one."""
    stream = sys.stderr if stderr else sys.stdout
    return Console(stderr=stderr, highlight=False, width=None if stream.isatty() else PLAIN_WIDTH)


def borderless() -> Table:
    """Return a two-column table of labels and values."""
    table = Table(show_header=False, box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    return table


def consensus_table(consensus: Consensus, names: Sequence[str], refine: str | None, notes: Sequence[str] = ()) -> Table:
    """Return what `maxcon fit` shows; `names` are those of the columns, the dependent one last.

    `notes` are remarks on the time.
    """
    N = len(consensus.inlier_mask)
    table = borderless()
    table.add_row("model", Text(equation(consensus.model, names)))
    table.add_row("inliers", f"{consensus.n_inliers} of {N} ({consensus.n_inliers / N:.1%})")
    table.add_row("proof", proof(consensus))
    if (remark := caution(consensus)) is not None:
        table.add_row("note", Text(remark, style="yellow"))
    if consensus.status == "optimal" or refine is None:
        table.add_row("method", consensus.method)
    else:
        table.add_row("method", f"{consensus.method}, then {REFINED_BY[refine]}")
    table.add_row("time", ", ".join([duration(consensus.seconds), *notes]))
    outliers = np.flatnonzero(~consensus.inlier_mask) + 1
    if 0 < len(outliers) <= LISTED_OUTLIERS:
        table.add_row("outliers", f"row{'s' * (len(outliers) > 1)} {runs_of(outliers)}")
    elif len(outliers) > 0:
        table.add_row("outliers", f"{len(outliers)} rows (--json lists them)")
    return table


#: In words.
REFINED_BY = {"tree": "local tree refinement", "swap": "local tree refinement with swaps"}


def proof(consensus: Consensus) -> Text:
    """Return the status, the bound and the gap in words."""
    if consensus.status == "optimal":
        return Text("proven optimal: no model has more inliers", style="green")
    if consensus.status == "bounded":
        return Text(f"no model has more than {consensus.upper_bound} inliers: gap {consensus.gap}", style="yellow")
    if consensus.status == "infeasible":
        return Text("no model explains even one point within the threshold", style="red")
    return Text("none: nothing is proven, so another model may have more inliers", style="yellow")


def caution(consensus: Consensus) -> str | None:
    """Return what makes the model worth little, though nothing is wrong with the fit; None if nothing does."""
    n_inliers, d = consensus.n_inliers, consensus.problem.n_params
    if n_inliers == 0:
        return None
    if n_inliers <= d:
        found = f"so few inliers say nothing: {d} points nearly always have a model through them"
        return found + "; a larger --threshold may find more"
    A = consensus.problem.A[consensus.inlier_mask]
    sizes = np.abs(consensus.problem.A).max(axis=0)
    rank = int(np.linalg.matrix_rank(A / np.where(sizes > 0, sizes, 1.0)))
    if rank < d:
        return f"the inliers do not determine the model (rank {rank} of {d}): other models explain them as well"
    return None


def equation(model: Sequence[float] | np.ndarray[Any, Any], names: Sequence[str]) -> str:
    """Return the model as a formula; `names` are those of the columns, the dependent one last."""
    if not np.isfinite(model).all():
        return "none"
    *slopes, intercept = (float(value) for value in model)
    terms = [f"{number(slope)} * {_safe(name)}" for slope, name in zip(slopes, names[:-1], strict=True)]
    text = " + ".join([*terms, number(intercept)]).replace("+ -", "- ")
    return f"{_safe(names[-1])} = {text}"


def parameters(model: Sequence[float] | np.ndarray[Any, Any], family: str) -> dict[str, Any]:
    """Return the parameters by name: slope and intercept; p, q and intercept; coef and intercept."""
    values = [float(value) for value in model]
    if family == "line":
        return dict(zip(("slope", "intercept"), values, strict=True))
    if family == "plane":
        return dict(zip(("p", "q", "intercept"), values, strict=True))
    return {"coef": values[:-1], "intercept": values[-1]}


def consensus_json(consensus: Consensus, about: Mapping[str, Any]) -> bytes:
    """Return a JSON object: `about`, then every field of the consensus; one line a key, NaN as null."""
    names = (field.name for field in fields(consensus) if field.name != "problem")
    record = dict(about) | {name: getattr(consensus, name) for name in names}
    lines = [f"  {json.dumps(key)}: {json.dumps(plain(value), allow_nan=False)}" for key, value in record.items()]
    return ("{\n" + ",\n".join(lines) + "\n}\n").encode()


def plain(value: Any) -> Any:
    """Return `value` as JSON knows it: arrays as lists, NaN and infinity as None."""
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    return value


def number(value: float) -> str:
    """Return `value` with five significant digits."""
    return f"{value:.5g}"


def duration(seconds: float) -> str:
    """Return a time in the unit that suits it."""
    if seconds < 1.0:
        return f"{1e3 * seconds:.2f} ms" if seconds < 0.01 else f"{1e3 * seconds:.0f} ms"
    return f"{seconds:.1f} s" if seconds < 120 else f"{seconds / 60:.1f} min"


def runs_of(values: Sequence[int] | np.ndarray[Any, Any]) -> str:
    """Return ascending whole numbers with neighbours drawn together: "3, 7-9, 12"."""
    parts: list[list[int]] = []
    for value in values:
        if parts and value == parts[-1][-1] + 1:
            parts[-1].append(int(value))
        else:
            parts.append([int(value)])
    shown = (str(run[0]) if len(run) == 1 else f"{run[0]}{'-' if len(run) > 2 else ', '}{run[-1]}" for run in parts)
    return ", ".join(shown)


def _safe(name: str) -> str:
    """Return a column's name as it stands in a formula: in brackets where it is more than a word."""
    return name if name.isidentifier() else f"[{name}]"
