"""A reproduction as a page and as figures, from its records alone.

    python -m maxcon.experiments.summary DIR [--page docs/reproduction.md]

writes DIR/figures and DIR/summary.md again; and renews, in a page of the docs, all that follows its line
``<!-- from records -->``, with the figures beside it in ``figures/reproduction``.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from maxcon.experiments.canvas import picture
from maxcon.experiments.claims import Claim, cell_of, cells_of, mean_short, median_seconds
from maxcon.experiments.kitti_experiment import KittiExperiment
from maxcon.experiments.records import Run, read_records
from maxcon.experiments.synthetic_claims import line_claims, plane_claims, trajectory_claims
from maxcon.experiments.trajectory_experiment import TrajectoryExperiment
from maxcon.experiments.two_view_claims import kitti_claims, modelnet_claims, targets

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: The line of a page below which the numbers go.
MARK = "<!-- from records -->"

#: The experiments in the order of the page, with their titles and claims.
_PARTS: dict[str, tuple[str, Callable[[Sequence[Run]], list[Claim]]]] = {
    "line": ("Lines (section 4.1)", line_claims),
    "plane": ("Planes (section 4.1)", plane_claims),
    "modelnet": ("Fundamental matrices, ModelNet40 (section 4.2)", modelnet_claims),
    "kitti": ("Fundamental matrices, KITTI (section 4.2)", kitti_claims),
    "trajectory": ("Trajectories of A* and of the agent (figure 1)", trajectory_claims),
}


def summarise_folder(folder: Path) -> list[Path]:
    """Draw all figures of a reproduction and write its summary; return the files written.

    Parameters
    ----------
    folder
        Of the reproduction, with its ``records``.

    Raises
    ------
    ModuleNotFoundError
        If matplotlib is not installed.
    FileNotFoundError
        If there are no records.
    """
    records = {name: read_records(folder / "records" / f"{name}.jsonl") for name in _PARTS}
    records = {name: rows for name, rows in records.items() if rows}
    if not records:
        raise FileNotFoundError(f"there are no records in {folder / 'records'}")
    figures = folder / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    written: dict[str, list[Path]] = {}
    for name, rows in records.items():
        for label, figure in _figures(folder, name, rows):
            path = figures / f"{label}.png"
            _replace(path, picture(figure, "png"))
            written.setdefault(name, []).append(path)
    page = folder / "summary.md"
    _replace(page, "\n".join(_page(folder, records, written)).encode() + b"\n")
    return [*(path for paths in written.values() for path in paths), page]


def overview(folder: Path) -> list[str]:
    """Return a line for each claim and method: the verdict of the records in a folder."""
    lines = []
    for name, (_, claims) in _PARTS.items():
        rows = read_records(folder / "records" / f"{name}.jsonl")
        for claim in claims(rows) if rows else []:
            lines += [f"{claim.label}, {answer.name}: {answer.verdict}" for answer in claim.answers]
    return lines


def _figures(folder: Path, name: str, rows: Sequence[Run]) -> Iterator[tuple[str, Figure]]:
    """Yield the figures of an experiment with their names."""
    from maxcon.experiments import (  # noqa: PLC0415  (only pictures need them)
        kitti_figure,
        match_figure,
        modelnet_figure,
        synthetic_figure,
        trajectory_figure,
    )

    if name in ("line", "plane"):
        for n_points in sorted({each.n_points for each in rows}):
            yield f"{name}-{n_points}", synthetic_figure.draw_synthetic(rows, n_points)
    elif name == "modelnet":
        yield name, modelnet_figure.draw_modelnet(rows)
    elif name == "kitti":
        yield name, kitti_figure.draw_kitti(rows)
        unit = match_figure.chosen_unit(rows)
        if unit is not None:
            pair = _kitti(folder).matches(unit)
            yield "kitti-matches", match_figure.draw_matches_of(rows, unit, pair)
    else:
        unit = trajectory_figure.chosen_unit(rows)
        if unit is not None:
            problem = _trajectories(folder).instance(unit).problem
            yield name, trajectory_figure.draw_trajectory(rows, unit, problem)


def _settings(folder: Path, name: str) -> dict[str, Any]:
    text = (folder / "records" / f"{name}.settings.json").read_text(encoding="utf-8")
    settings: dict[str, Any] = json.loads(text)
    return settings


def _kitti(folder: Path) -> KittiExperiment:
    """Return the experiment that the records of KITTI are of, to get at its matches."""
    about = _settings(folder, "kitti")
    sequence = about["sequence"] if about["sequence"] != "made pairs" else ""
    pairs = tuple((step, first) for step, first in about["pairs"])
    return KittiExperiment(sequence, pairs, (), str(folder / "matches"), seed=about["seed"])


def _trajectories(folder: Path) -> TrajectoryExperiment:
    about = _settings(folder, "trajectory")
    return TrajectoryExperiment((), about["n_points"], about["n_outliers"], about["instances"], about["seed"])


def _page(folder: Path, records: Mapping[str, list[Run]], written: Mapping[str, list[Path]]) -> Iterator[str]:
    """Yield the lines of the summary."""
    yield "# The paper's experiments"
    yield ""
    yield from _about(records)
    yield ""
    yield from _overview([claim for name, rows in records.items() for claim in _PARTS[name][1](rows)])
    for name, rows in records.items():
        title, claims = _PARTS[name]
        yield ""
        yield _escaped(f"## {title}")
        yield ""
        yield from (f"![{path.stem}](figures/{path.name})\n" for path in written.get(name, []))
        yield ""
        yield from _what_ran(_settings(folder, name), rows)
        yield ""
        if name != "trajectory":
            yield from _table(rows)
            yield ""
        if name in ("modelnet", "kitti"):
            yield from (_escaped(f"- {text}") for text in targets(rows))
            yield ""
        yield from _claims(claims(rows))


def _about(records: Mapping[str, list[Run]]) -> Iterator[str]:
    rows = [each for some in records.values() for each in some]
    machines = sorted({each.processor for each in rows})
    versions = sorted({", ".join(f"{key} {value}" for key, value in each.versions.items()) for each in rows})
    yield f"{len(rows)} runs on {'; '.join(machines)}; {'; '.join(versions)}."
    yield ""
    yield "Every number is computed from the records. Times are wall-clock times of one thread, refinement included,"
    yield "compilation excluded. A RANSAC variant had the time of the EdgeConv agent on the same instance (of auto"
    yield 'where that is not installed), or that of the method it names; "times the time" is measured.'
    failed = sorted({f"{each.name}: {each.error}" for each in rows if each.error is not None})
    if failed:
        yield ""
        yield "Without a result: " + "; ".join(failed) + "."


def _what_ran(settings: Mapping[str, Any], rows: Sequence[Run]) -> Iterator[str]:
    shown = {
        key: value if key != "pairs" else f"{len(value)} pairs"
        for key, value in settings.items()
        if key not in ("contenders", "experiment")
    }
    limits = {each["name"]: each["time_limit"] for each in settings["contenders"] if each["time_limit"] is not None}
    units = {each.unit: each.proven for each in rows}
    text = ", ".join(f"{key} {_plain(value)}" for key, value in shown.items())
    stops = ", ".join(f"{name} {limit:g} s" for name, limit in limits.items())
    yield (
        _escaped(f"Settings: {text}; time limits: {stops}.")
        + f" Optimum proven: {sum(units.values())} of {len(units)} instances."
    )


def _plain(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def _table(rows: Sequence[Run]) -> Iterator[str]:
    """Yield a table of inliers missing (mean) and median time of every method in every cell."""
    cells = cells_of(rows) if rows[0].rate is not None else sorted({(each.step,) for each in rows})
    titles = [f"N={cell[0]}, {cell[1]}%" if len(cell) == 2 else f"step {cell[0]}" for cell in cells]
    yield "Inliers fewer than the best known (mean), and median time in ms:"
    yield ""
    yield "| method | " + " | ".join(titles) + " |"
    yield "| --- " * (len(cells) + 1) + "|"
    for name in dict.fromkeys(each.name for each in rows):
        entries = []
        for cell in cells:
            some = [each for each in rows if each.name == name and each.done and cell_of(each) == cell]
            entries.append(f"{mean_short(some):.2f} / {1e3 * median_seconds(some):.3g}" if some else "-")
        if all(entry == "-" for entry in entries):
            entries = [next((each.status for each in rows if each.name == name), "no result"), *entries[1:]]
        yield _escaped(f"| {name} | " + " | ".join(entries) + " |")
    best = [np.mean([each.best for each in {r.unit: r for r in rows if cell_of(r) == cell}.values()]) for cell in cells]
    yield "| best known, inliers | " + " | ".join(f"{value:.2f}" for value in best) + " |"


def _overview(answered: Sequence[Claim]) -> Iterator[str]:
    """Yield a table of the verdicts alone."""
    yield "| claim | verdicts |"
    yield "| --- | --- |"
    for claim in answered:
        verdicts = "; ".join(f"{answer.name}: **{answer.verdict}**" for answer in claim.answers)
        yield _escaped(f"| {claim.label}: {claim.quote} | {verdicts} |")


def _claims(answered: Sequence[Claim]) -> Iterator[str]:
    yield "| claim | method | verdict | numbers |"
    yield "| --- | --- | --- | --- |"
    for claim in answered:
        head = f"{claim.label}: {claim.quote} Rule: {claim.rule}"
        for answer in claim.answers:
            yield _escaped(f"| {head} | {answer.name} | **{answer.verdict}** | {answer.numbers} |")
            head = ""


def _escaped(text: str) -> str:
    """Return Markdown in which the star of A* is a star."""
    return text.replace("A*", "A\\*")


def _replace(path: Path, content: bytes) -> None:
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(content)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def renew_page(folder: Path, page: Path) -> list[Path]:
    """Put the summary of a reproduction into a page, below its mark, and its figures beside it; return the files.

    Parameters
    ----------
    folder
        Of the reproduction, with its summary and figures.
    page
        A Markdown file with the line ``<!-- from records -->``.

    Raises
    ------
    ValueError
        If the page has no such line.
    """
    text = page.read_text(encoding="utf-8")
    if MARK not in text.splitlines():
        raise ValueError(f"{page} must have the line {MARK!r}, below which the numbers go, but it has none")
    head = text[: text.index(MARK)]
    summary = (folder / "summary.md").read_text(encoding="utf-8").partition("\n")[2]
    figures = page.parent / "figures" / "reproduction"
    figures.mkdir(parents=True, exist_ok=True)
    written = [page]
    for path in sorted((folder / "figures").glob("*.png")):
        _replace(figures / path.name, path.read_bytes())
        written.append(figures / path.name)
    _replace(page, (head + MARK + "\n" + summary.replace("](figures/", "](figures/reproduction/")).encode())
    return written


def _main() -> None:
    parser = argparse.ArgumentParser(description="Draw the figures of a reproduction and write its summary again.")
    parser.add_argument("folder", type=Path, help="of the reproduction")
    parser.add_argument("--page", type=Path, help="a page of the docs to renew")
    given = parser.parse_args()
    written = summarise_folder(given.folder)
    if given.page is not None:
        written += renew_page(given.folder, given.page)
    for path in written:
        print(f"wrote {path}")


if __name__ == "__main__":
    _main()
