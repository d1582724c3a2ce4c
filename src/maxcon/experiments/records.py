"""Records of experiments: JSON Lines, one row a run, that survive a kill and never mix settings.

The runs of one instance are a unit: they are written together when all of them are done, so a kill at any moment
loses the units under way and no more. A file belongs to one choice of settings, which stand beside it in
``NAME.settings.json``, and whose digest stands in every row.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numba
import numpy as np

import maxcon
from maxcon.experiments.evaluation import machine

#: The name of the runs that prove: their bound stands in all rows of a unit.
EXACT = "exact"


@dataclass(frozen=True)
class Run:
    """One run of one method on one instance.

    Attributes
    ----------
    experiment
        "line", "plane", "modelnet", "kitti" or "trajectory".
    unit
        What tells the instance from all others of the experiment.
    rows
        How many rows the unit has.
    instance
        Where the instance comes from: its seed, its mesh and seed, or its pair of frames.
    n_points
        How many points it has (N).
    rate
        Its outlier rate in percent; None for real matches, where nobody knows.
    step
        How many frames apart its images are; None where there are none.
    name
        What figures and tables call the method.
    method, settings
        As `maxcon.fit` takes them: options, refinement, time limit and seed; `budget` names the method whose time was
        the limit.
    consensus
        The inliers found; 0 for a run that failed. Of a walk down the tree that is not refined, what it kept.
    before_refinement
        What a walk down the tree kept, before it was refined; None for methods that do not walk.
    upper_bound
        Proven for this instance: no model has more inliers.
    proven
        Whether some method reached the bound on this instance: then it is the optimum.
    best
        The largest consensus that any method found on this instance.
    gap
        ``upper_bound - consensus``: the distance to the optimum where that is proven, else to its bound.
    status
        What `maxcon.fit` says of this run, "not installed" or "failed".
    seconds
        Wall-clock time, refinement included.
    multiple
        `seconds` over those of the method whose time was the limit; None without such a limit.
    error
        Why there is no result; None where there is one.
    measures
        Further numbers of the experiment.
    digest
        Of the settings of the experiment.
    versions, processor
        What it ran with and on.
    """

    experiment: str
    unit: str
    rows: int
    instance: str
    n_points: int
    rate: int | None
    step: int | None
    name: str
    method: str
    settings: dict[str, Any]
    consensus: int
    before_refinement: int | None
    upper_bound: int
    proven: bool
    best: int
    gap: int
    status: str
    seconds: float
    multiple: float | None = None
    error: str | None = None
    measures: dict[str, Any] = field(default_factory=dict)
    digest: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    processor: str = ""

    @property
    def done(self) -> bool:
        """Whether there is a result."""
        return self.error is None

    @property
    def short(self) -> int:
        """How many inliers fewer than the best known: the distance to the optimum where `proven`."""
        return self.best - self.consensus


@functools.cache
def versions() -> dict[str, str]:
    """Return the versions that a result may hang on."""
    return {
        "maxcon": maxcon.__version__,
        "numba": numba.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }


@functools.cache
def processor() -> str:
    """Return the processor and how many cores of it there are."""
    about = machine()
    return f"{about['processor']}, {about['cores']} cores"


def settings_digest(settings: Mapping[str, Any]) -> str:
    """Return twelve characters that tell these settings from others."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]


class RecordFile:
    """The records of one experiment: ``FOLDER/NAME.jsonl`` and ``FOLDER/NAME.settings.json``.

    Attributes
    ----------
    path
        The file of the rows.
    digest
        Of the settings.
    done
        The rows of all complete units.

    Raises
    ------
    ValueError
        If the file holds rows of other settings; the message says which settings differ.
    """

    def __init__(self, folder: Path, name: str, settings: Mapping[str, Any]) -> None:
        self.path = folder / f"{name}.jsonl"
        self._described = folder / f"{name}.settings.json"
        asked: dict[str, Any] = json.loads(json.dumps(settings))
        self.digest = settings_digest(asked)
        self._check_settings(asked)
        self.done = self._read()
        if not self._described.exists():
            _replace(self._described, json.dumps(asked, indent=2) + "\n")

    @property
    def units(self) -> set[str]:
        """The units that need not be run again."""
        return {each.unit for each in self.done}

    def add(self, rows: Sequence[Run]) -> None:
        """Append the rows of a unit, all or none of them."""
        text = "".join(json.dumps(asdict(each), allow_nan=False) + "\n" for each in rows)
        with self.path.open("ab") as file:
            file.write(text.encode())
            file.flush()
            os.fsync(file.fileno())
        self.done += rows

    def _check_settings(self, asked: dict[str, Any]) -> None:
        if not self._described.exists():
            return
        known = json.loads(self._described.read_text(encoding="utf-8"))
        if known != asked and self.path.exists() and self.path.stat().st_size > 0:
            differ = sorted(key for key in known.keys() | asked.keys() if known.get(key) != asked.get(key))
            raise ValueError(
                f"{self.path} holds records of other settings ({', '.join(differ)} differ, see {self._described}); "
                f"name another folder, or give the settings of before to go on"
            )
        self._described.unlink()

    def _read(self) -> list[Run]:
        """Return the rows of complete units, and drop what a kill left of another from the file."""
        if not self.path.exists():
            return []
        text = self.path.read_bytes().decode(errors="replace")
        rows = [each for each in map(_parsed, text.splitlines()) if each is not None]
        strangers = [each for each in rows if each.digest != self.digest]
        if strangers:
            raise ValueError(
                f"{self.path} holds records of other settings (their digest is {strangers[0].digest}, not "
                f"{self.digest}); name another folder"
            )
        kept = complete_units(rows)
        if len(kept) < len(text.splitlines()) or (text and not text.endswith("\n")):
            _replace(self.path, "".join(json.dumps(asdict(each)) + "\n" for each in kept))
        return kept


def read_records(path: Path) -> list[Run]:
    """Return the rows of all complete units in a file; none if there is no such file."""
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    return complete_units(each for each in map(_parsed, lines) if each is not None)


def complete_units(rows: Iterable[Run]) -> list[Run]:
    """Return the rows of units of which no row is missing, each row once."""
    unique: dict[tuple[str, str], Run] = {}
    for each in rows:
        unique.setdefault((each.unit, each.name), each)
    count: dict[str, int] = {}
    for each in unique.values():
        count[each.unit] = count.get(each.unit, 0) + 1
    return [each for each in unique.values() if count[each.unit] == each.rows]


_FIELDS = {each.name for each in fields(Run)}


def _parsed(line: str) -> Run | None:
    """Return the row that a line holds, or None where a kill cut it off."""
    try:
        entry = json.loads(line)
    except ValueError:
        return None
    return Run(**entry) if isinstance(entry, dict) and entry.keys() == _FIELDS else None


def _replace(path: Path, text: str) -> None:
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_text(text, encoding="utf-8")
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
