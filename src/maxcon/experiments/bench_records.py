"""Records of the benchmark: JSON Lines, a line an instance, that survive a kill and never mix settings.

A folder belongs to one choice of settings, one machine and one set of versions: what they were stands in
``settings.json``, and their digest in every line. ``calibration.jsonl`` says what the peers were given in every cell,
``records.jsonl`` what everyone found.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import maxcon
from maxcon.experiments.records import settings_digest


@dataclass(frozen=True)
class Row:
    """What a method found on an instance within a budget, once for each seed.

    Attributes
    ----------
    method
        Its name.
    budget
        Milliseconds.
    inliers
        For each seed, how many points its model explains, recounted; 0 where it found none.
    ms
        For each seed, how long it took, in milliseconds.
    violations
        In how many of the runs the set returned was not explained by the model returned.
    error
        What the last run that failed said; None where none did.
    iterations, threshold
        What a peer was given.
    """

    method: str
    budget: float
    inliers: list[int]
    ms: list[float]
    violations: int = 0
    error: str | None = None
    iterations: int | None = None
    threshold: float | None = None


@dataclass(frozen=True)
class Unit:
    """All runs on one instance.

    Attributes
    ----------
    family, n_points, rate, number
        The instance: its cell, the rate in percent, and its number there.
    seed
        Of the benchmark's instances.
    reference
        The largest consensus known.
    proven
        Whether that is the proven optimum.
    reference_by
        Which method found it: "exact" where it is proven.
    rows
        The runs.
    missing
        Our methods that do not serve this family, and why.
    above_proven
        How many runs found more than the proven optimum: one of them is wrong, or the proof.
    core
        Time on the processor over time on the clock, of all runs: below 1 where the machine had other things to do.
    code
        A digest of the package's source, which may change while its version does not.
    digest
        Of settings, machine and versions.
    """

    family: str
    n_points: int
    rate: int
    number: int
    seed: int
    reference: int
    proven: bool
    reference_by: str
    rows: list[Row]
    missing: dict[str, str] = field(default_factory=dict)
    above_proven: int = 0
    core: float = 1.0
    code: str = ""
    digest: str = ""

    @property
    def cell(self) -> str:
        """The name of its cell."""
        return f"{self.family}/{self.n_points}/{self.rate}"

    @property
    def name(self) -> str:
        """Tells the instance from all others, of other seeds, too."""
        return f"{self.cell}/{self.seed}.{self.number}"


class Lines:
    """A file of JSON objects, a line each, with a digest in each; a kill at any moment loses the last line at most.

    Parameters
    ----------
    path
        The file; it need not exist.
    digest
        What every line must have.

    Raises
    ------
    ValueError
        If it holds lines of another digest.
    """

    def __init__(self, path: Path, digest: str) -> None:
        self.path, self.digest = path, digest
        self.entries = self._read()

    def add(self, entry: Mapping[str, Any]) -> None:
        """Append a line."""
        written = {**entry, "digest": self.digest}
        with self.path.open("ab") as file:
            file.write((json.dumps(written, allow_nan=False) + "\n").encode())
            file.flush()
            os.fsync(file.fileno())
        self.entries.append(written)

    def _read(self) -> list[dict[str, Any]]:
        if not self.path.exists():
            return []
        text = self.path.read_bytes().decode(errors="replace")
        lines = text.splitlines()
        entries = [each for each in map(_parsed, lines) if each is not None]
        if any(each.get("digest") != self.digest for each in entries):
            raise ValueError(f"{self.path} holds records of other settings or another machine; name another folder")
        if len(entries) < len(lines) or (text and not text.endswith("\n")):
            replace_file(self.path, "".join(json.dumps(each) + "\n" for each in entries))
        return entries


class BenchFile:
    """The folder of a benchmark.

    Parameters
    ----------
    folder
        An existing folder.
    header
        Settings, versions and machine: all that the records depend on.

    Raises
    ------
    ValueError
        If it holds records with another header; the message says what differs.
    """

    def __init__(self, folder: Path, header: Mapping[str, Any]) -> None:
        asked: dict[str, Any] = json.loads(json.dumps(header))
        described = folder / "settings.json"
        records = folder / "records.jsonl"
        known = json.loads(described.read_text(encoding="utf-8")) if described.exists() else {}
        begun = records.exists() and records.stat().st_size > 0
        if begun and known and known != asked:
            raise ValueError(
                f"{folder} holds a benchmark of other settings or another machine ({_differences(known, asked)}); "
                f"name another folder, or give the settings of before to go on"
            )
        if not begun and known != asked:
            (folder / "calibration.jsonl").unlink(missing_ok=True)  # of a benchmark that got no further
        self.digest = settings_digest(asked)
        self._calibration = Lines(folder / "calibration.jsonl", self.digest)
        self._records = Lines(records, self.digest)
        replace_file(described, json.dumps(asked, indent=2) + "\n")

    @property
    def choices(self) -> dict[str, dict[str, Any]]:
        """What peers were given, by the name of the cell."""
        return {each["cell"]: each["choices"] for each in self._calibration.entries}

    def add_choices(self, cell: str, choices: Mapping[str, Any]) -> None:
        """Keep what the peers are given in a cell."""
        self._calibration.add({"cell": cell, "choices": choices})

    @property
    def units(self) -> list[Unit]:
        """All instances that are done, each once."""
        return _unique([unit_of(each) for each in self._records.entries])

    @property
    def done(self) -> set[tuple[str, int]]:
        """The cells and numbers of these instances."""
        return {
            (f"{each['family']}/{each['n_points']}/{each['rate']}", each["number"]) for each in self._records.entries
        }

    def add(self, unit: Unit) -> None:
        """Keep the records of an instance."""
        self._records.add(asdict(unit))


def read_bench(folder: Path) -> tuple[dict[str, Any], list[Unit]]:
    """Return the header and all complete records of a folder, of whatever machine.

    Raises
    ------
    FileNotFoundError
        If there are none; the message names the folder.
    """
    described, records = folder / "settings.json", folder / "records.jsonl"
    if not described.is_file() or not records.is_file():
        raise FileNotFoundError(f"there is no benchmark in {str(folder)!r} (settings.json and records.jsonl)")
    header: dict[str, Any] = json.loads(described.read_text(encoding="utf-8"))
    lines = records.read_bytes().decode(errors="replace").splitlines()
    return header, _unique([unit_of(each) for each in map(_parsed, lines) if each is not None])


def unit_of(entry: Mapping[str, Any]) -> Unit:
    """Return the record that a line holds."""
    return Unit(**{**entry, "rows": [Row(**each) for each in entry["rows"]]})


@functools.cache
def code_digest() -> str:
    """Return twelve characters that tell this state of the package's source from others."""
    package = Path(maxcon.__file__).parent
    total = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        total.update(path.relative_to(package).as_posix().encode())
        total.update(path.read_bytes())
    return total.hexdigest()[:12]


def replace_file(path: Path, text: str) -> None:
    """Write a file so that a kill leaves the old one or the new one."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_text(text, encoding="utf-8")
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _parsed(line: str) -> dict[str, Any] | None:
    """Return the object that a line holds, or None where a kill cut it off."""
    try:
        entry = json.loads(line)
    except ValueError:
        return None
    return entry if isinstance(entry, dict) else None


def _unique(units: Sequence[Unit]) -> list[Unit]:
    return list({each.name: each for each in units}.values())


def _differences(known: Mapping[str, Any], asked: Mapping[str, Any]) -> str:
    """Return the names of what differs: a key of the header, or of one of its parts."""
    names: list[str] = []
    for key in sorted(known.keys() | asked.keys()):
        old, new = known.get(key), asked.get(key)
        if old == new:
            continue
        if isinstance(old, dict) and isinstance(new, dict):
            names += [f"{key}.{part}" for part in sorted(old.keys() | new.keys()) if old.get(part) != new.get(part)]
        else:
            names.append(key)
    return ", ".join(names) + " differ" + "s" * (len(names) == 1)
