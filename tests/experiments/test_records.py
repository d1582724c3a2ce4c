"""Records: rows that survive a kill, and never mix settings."""

import json
from dataclasses import asdict, replace

import pytest

from maxcon.experiments.records import RecordFile, Run, complete_units, read_records, settings_digest

SETTINGS = {"sizes": [10, 20], "contenders": [{"name": "a"}], "seed": 0}


def row(unit="u0", name="a", rows=2, digest=None, **changes):
    base = Run(
        experiment="line",
        unit=unit,
        rows=rows,
        instance="seed 0",
        n_points=10,
        rate=20,
        step=None,
        name=name,
        method="ransac",
        settings={"refine": None, "time_limit": 0.5, "budget": None},
        consensus=7,
        before_refinement=None,
        upper_bound=9,
        proven=False,
        best=8,
        gap=2,
        status="heuristic",
        seconds=0.25,
        digest=settings_digest(SETTINGS) if digest is None else digest,
    )
    return replace(base, **changes)


def unit(number, **changes):
    return [row(f"u{number}", name, **changes) for name in ("a", "b")]


def test_rows_come_back_as_they_were(tmp_path):
    file = RecordFile(tmp_path, "line", SETTINGS)
    assert file.done == []
    rows = [replace(each, measures={"path": [1, 2], "pixels": 0.5}, multiple=1.25) for each in unit(0)]
    file.add(rows)
    file.add(unit(1))
    again = RecordFile(tmp_path, "line", SETTINGS)
    assert again.done == [*rows, *unit(1)]
    assert again.units == {"u0", "u1"}
    assert read_records(tmp_path / "line.jsonl") == again.done
    assert again.done[0].short == 1
    assert json.loads((tmp_path / "line.settings.json").read_text()) == SETTINGS


def test_no_file_holds_no_records(tmp_path):
    assert read_records(tmp_path / "none.jsonl") == []


def test_what_a_kill_leaves_at_any_byte_is_taken_away(tmp_path):
    """After a kill in the middle of a write, complete units are there and nothing else is."""
    file = RecordFile(tmp_path, "line", SETTINGS)
    for number in range(3):
        file.add(unit(number))
    whole = file.path.read_bytes()
    lines = whole.splitlines(keepends=True)
    ends = [sum(len(each) for each in lines[: 2 * number]) for number in range(4)]
    # A kill just before the last end of line leaves all of a unit: only then may one more be there.
    for cut in range(0, len(whole) + 1, 7):
        file.path.write_bytes(whole[:cut])
        kept = RecordFile(tmp_path, "line", SETTINGS).done
        n_units = sum(cut >= end - 1 for end in ends[1:])
        assert kept == [each for number in range(n_units) for each in unit(number)]
        assert file.path.read_bytes() == whole[: ends[n_units]]
    again = RecordFile(tmp_path, "line", SETTINGS)
    again.add(unit(9))
    assert again.done == RecordFile(tmp_path, "line", SETTINGS).done


def test_a_unit_that_was_run_twice_counts_once():
    rows = [*unit(0), *unit(0), *unit(1)[:1]]
    assert complete_units(rows) == unit(0)


def test_other_settings_are_refused(tmp_path):
    RecordFile(tmp_path, "line", SETTINGS).add(unit(0))
    with pytest.raises(ValueError, match=r"line.jsonl holds records of other settings \(seed, sizes differ"):
        RecordFile(tmp_path, "line", SETTINGS | {"seed": 1, "sizes": [10]})
    assert RecordFile(tmp_path, "line", SETTINGS).done == unit(0)
    assert RecordFile(tmp_path, "plane", SETTINGS | {"seed": 1}).done == []


def test_other_settings_are_refused_where_only_the_rows_tell(tmp_path):
    RecordFile(tmp_path, "line", SETTINGS).add(unit(0))
    (tmp_path / "line.settings.json").unlink()
    with pytest.raises(ValueError, match="their digest is"):
        RecordFile(tmp_path, "line", SETTINGS | {"seed": 1})
    assert RecordFile(tmp_path, "line", SETTINGS).done == unit(0)


def test_settings_may_change_while_there_are_no_rows(tmp_path):
    RecordFile(tmp_path, "line", SETTINGS)
    other = SETTINGS | {"seed": 1}
    assert RecordFile(tmp_path, "line", other).done == []
    assert json.loads((tmp_path / "line.settings.json").read_text()) == other


def test_rows_of_another_shape_are_dropped(tmp_path):
    file = RecordFile(tmp_path, "line", SETTINGS)
    file.add(unit(0))
    strange = {key: value for key, value in asdict(row("u1", rows=1)).items() if key != "gap"}
    with file.path.open("a") as stream:
        stream.write(json.dumps(strange) + "\n[1, 2]\n")
    assert RecordFile(tmp_path, "line", SETTINGS).done == unit(0)


def test_nan_is_no_record(tmp_path):
    file = RecordFile(tmp_path, "line", SETTINGS)
    with pytest.raises(ValueError, match="JSON"):
        file.add([row(rows=1, seconds=float("nan"))])
    assert file.done == []
    assert not file.path.exists()
