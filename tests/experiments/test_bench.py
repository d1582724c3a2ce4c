import json
import time
from dataclasses import asdict, replace

import numpy as np
import pytest

import maxcon
from maxcon.experiments import bench
from maxcon.experiments.bench import Settings, check_settings, header, known_methods, quick, run_bench, usual_methods
from maxcon.experiments.bench_calibration import Choice
from maxcon.experiments.bench_cells import Cell, make_instance
from maxcon.experiments.bench_peers import PEERS, installed
from maxcon.experiments.bench_records import BenchFile, Row, Unit, read_bench, unit_of

TINY = Settings(
    families=("line", "hyperplane"),
    sizes=(30,),
    rates=(30,),
    budgets=(2.0, 20.0),
    methods=("auto", "lo-ransac", "agent", "skimage-ransac"),
    instances=2,
    seeds=2,
    proof_time=0.5,
    long_time=0.02,
    calibration=1,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with the whole tiny benchmark."""
    folder = tmp_path_factory.mktemp("bench")
    progress = []
    units = list(run_bench(TINY, BenchFile(folder, header(TINY)), lambda *news: progress.append(news)))
    assert len(units) == 4
    assert progress[0] == ("calibrations", 0, 2)
    assert progress[-1] == ("instances", 4, 4)
    return folder


def test_what_is_recorded(folder):
    about, units = read_bench(folder)
    assert about["settings"]["instances"] == 2
    assert about["versions"]["maxcon"] == maxcon.__version__
    assert about["versions"]["scikit-image"]
    assert about["processor"]
    assert [each.name for each in units] == [f"{family}/30/30/0.{n}" for family in TINY.families for n in (0, 1)]
    for unit in units:
        served = [each for each in TINY.methods if each != "agent" or unit.family == "line"]
        assert {(each.method, each.budget) for each in unit.rows} == {(m, b) for m in served for b in TINY.budgets}
        assert ("agent" in unit.missing) == (unit.family == "hyperplane")
        assert unit.code
        assert unit.core > 0
        for row in unit.rows:
            assert len(row.inliers) == len(row.ms) == 2
            assert row.violations == 0
            assert max(row.inliers) <= unit.reference
            assert (row.iterations is None) == (row.method != "skimage-ransac")
        assert unit.above_proven == 0


def test_the_reference_is_the_optimum(folder):
    for unit in read_bench(folder)[1]:
        instance = make_instance(Cell(unit.family, unit.n_points, unit.rate), unit.number, unit.seed)
        assert unit.proven
        assert unit.reference == maxcon.fit(instance.problem, instance.threshold, method="exact").n_inliers


def test_it_goes_on_where_it_stopped(folder, tmp_path):
    for name in ("settings.json", "calibration.jsonl"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    text = (folder / "records.jsonl").read_text(encoding="utf-8")
    first, second, *_ = text.splitlines(keepends=True)
    (tmp_path / "records.jsonl").write_text(first + second[: len(second) // 2], encoding="utf-8")
    file = BenchFile(tmp_path, header(TINY))
    assert file.done == {("line/30/30", 0)}
    assert (tmp_path / "records.jsonl").read_text(encoding="utf-8") == first  # what the kill left is gone
    assert [each.name for each in run_bench(TINY, file)] == [
        "line/30/30/0.1",
        "hyperplane/30/30/0.0",
        "hyperplane/30/30/0.1",
    ]
    assert (tmp_path / "calibration.jsonl").read_bytes() == (folder / "calibration.jsonl").read_bytes()
    assert list(run_bench(TINY, BenchFile(tmp_path, header(TINY)))) == []


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"settings": {"seeds": 3}}, "settings.seeds differs"),
        ({"settings": {"seed": 3, "budgets": [1.0]}}, "settings.budgets, settings.seed differ"),
        ({"versions": {"numpy": "0"}}, "versions.numpy differs"),
        ({"processor": "another"}, "processor differs"),
    ],
)
def test_settings_and_machines_are_not_mixed(folder, other, message):
    about = header(TINY)
    for key, value in other.items():
        about[key] = {**about[key], **value} if isinstance(value, dict) else value
    before = (folder / "records.jsonl").read_bytes()
    with pytest.raises(ValueError, match=message):
        BenchFile(folder, about)
    assert (folder / "records.jsonl").read_bytes() == before


def test_a_line_of_another_digest(folder, tmp_path):
    for name in ("settings.json", "calibration.jsonl", "records.jsonl"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    line = json.loads((tmp_path / "records.jsonl").read_text(encoding="utf-8").splitlines()[0])
    with (tmp_path / "records.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps({**line, "digest": "0"}) + "\n")
    with pytest.raises(ValueError, match="other settings or another machine"):
        BenchFile(tmp_path, header(TINY))


def test_a_folder_without_a_benchmark(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no benchmark in"):
        read_bench(tmp_path)


def test_stopped_while_it_calibrates(tmp_path):
    settings = replace(TINY, methods=("skimage-ransac",), instances=1)
    file = BenchFile(tmp_path, header(settings))
    assert list(run_bench(settings, file, stop=lambda: True)) == []
    assert list(file.choices) == ["line/30/30"]
    assert list(BenchFile(tmp_path, header(settings)).choices) == ["line/30/30"]  # it goes on from there
    assert not BenchFile(tmp_path, header(replace(settings, seed=1))).choices  # nothing was judged with them
    assert not BenchFile(tmp_path, header(settings)).choices


def test_an_unsound_set_is_found():
    instance = make_instance(Cell("plane", 40, 40), 0, 0)
    result, seconds = bench.timed_fit(instance, "lo-ransac", 0.01, 0)
    assert seconds < 1
    assert bench.sound(instance, result)
    flipped = result.inlier_mask.copy()
    flipped[np.argmin(flipped)] = True
    assert not bench.sound(instance, replace(result, inlier_mask=flipped, n_inliers=result.n_inliers + 1))
    assert not bench.sound(instance, replace(result, n_inliers=result.n_inliers + 1))
    assert not bench.sound(instance, replace(result, model=result.model + 10))
    nothing = np.full(3, np.nan)
    assert not bench.sound(instance, replace(result, model=nothing))
    none = np.zeros(40, dtype=np.bool_)
    assert bench.sound(instance, replace(result, model=nothing, inlier_mask=none, n_inliers=0, status="infeasible"))


def test_violations_are_counted(monkeypatch):
    instance = make_instance(Cell("plane", 40, 40), 0, 0)
    honest = bench.timed_fit

    def lies(*args):
        result, seconds = honest(*args)
        return replace(result, n_inliers=result.n_inliers + 1), seconds

    monkeypatch.setattr(bench, "timed_fit", lies)
    row = bench.our_row(instance, "lo-ransac", 5.0, 3)
    assert row.violations == 3
    assert row.inliers == [honest(instance, "lo-ransac", 0.005, seed)[0].n_inliers for seed in range(3)]


def test_a_fit_that_fails_is_a_row(monkeypatch):
    def fails(*_):
        raise ArithmeticError("did not converge")

    monkeypatch.setattr(bench, "timed_fit", fails)
    row = bench.our_row(make_instance(Cell("plane", 40, 40), 0, 0), "gnc", 5.0, 2)
    assert row == Row("gnc", 5.0, [0, 0], [0.0, 0.0], 0, "did not converge")


def test_more_than_the_optimum_is_counted(monkeypatch):
    settings = replace(TINY, families=("line",), methods=("auto",), instances=1)
    monkeypatch.setattr(bench, "_reference", lambda instance, settings: (3, True, "exact"))
    unit = bench._run(bench._Work(settings, Cell("line", 30, 30), 0, {}))
    assert unit.reference == 3
    assert unit.above_proven == 4  # two budgets, two seeds


def test_the_best_known_is_that_of_anyone(monkeypatch):
    settings = replace(TINY, families=("line",), methods=("lo-ransac",), instances=1)
    monkeypatch.setattr(bench, "_reference", lambda instance, settings: (3, False, "peel"))
    unit = bench._run(bench._Work(settings, Cell("line", 30, 30), 0, {}))
    assert unit.reference == max(max(row.inliers) for row in unit.rows) > 3
    assert unit.reference_by == "lo-ransac"
    assert unit.above_proven == 0


@pytest.mark.parametrize("name", [name for name in usual_methods() if name in bench.OURS])
def test_our_methods_use_their_budget(name):
    """Those that do not end by a proof: none ends at half of its time, and none is far above it."""
    instance = make_instance(Cell("line", 60, 50), 0, 0)
    if bench._reason(name, "line") is not None:
        pytest.skip(f"{name} does not serve lines here")
    result, seconds = bench.timed_fit(instance, name, 0.2, 0)
    if result.status != "optimal" and name not in {"uclm"}:
        assert seconds > 0.1
    assert seconds < 2.0


def test_names():
    assert {"auto", "exact", "lo-ransac", "gnc", "peel", "poselib", "pycolmap", "astar"} <= set(known_methods())
    here = {each.name for each in PEERS if installed(each) is not None}
    assert {each for each in usual_methods() if each not in bench.OURS} == here
    assert set(bench.absent_peers()) == {each.name for each in PEERS} - here
    small = quick(Settings())
    assert len(small.cells()) < len(Settings().cells()) / 10


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"methods": ()}, ValueError, "methods must name at least one"),
        ({"methods": ("magic",)}, ValueError, "methods must be among .*'magic'"),
        ({"budgets": ()}, ValueError, "budgets must be positive"),
        ({"budgets": (0.0,)}, ValueError, "budgets must be positive"),
        ({"budgets": (np.inf,)}, ValueError, "budgets must be positive"),
        ({"instances": 0}, ValueError, "instances must be at least 1, but it is 0"),
        ({"jobs": 0}, ValueError, "jobs must be at least 1"),
        ({"seed": -1}, ValueError, "seed must be at least 0"),
        ({"proof_time": 0.0}, ValueError, "proof_time must be a positive number"),
        ({"long_time": np.inf}, ValueError, "long_time must be a positive number"),
        ({"families": ("circle",)}, ValueError, "families must be among"),
    ],
)
def test_bad_settings(changes, error, message):
    with pytest.raises(error, match=message):
        check_settings(replace(TINY, **changes))


@pytest.mark.skipif("poselib" not in bench.absent_peers(), reason="PoseLib is installed")
def test_a_peer_that_is_asked_for_must_be_there():
    with pytest.raises(ModuleNotFoundError, match="'poselib' is not installed: pip install poselib"):
        check_settings(replace(TINY, methods=("auto", "poselib")))


@pytest.mark.slow
def test_several_at_a_time(folder, tmp_path):
    settings = replace(TINY, jobs=2)
    units = list(run_bench(settings, BenchFile(tmp_path, header(settings))))
    assert {each.name: each.reference for each in units} == {
        each.name: each.reference for each in read_bench(folder)[1]
    }


def test_units_are_read_as_they_were_written():
    unit = Unit("line", 10, 20, 3, 1, 8, False, "peel", [Row("auto", 1.0, [8, 7], [0.5, 0.6])], {"agent": "no"}, 0, 0.9)
    assert unit_of(json.loads(json.dumps(asdict(unit)))) == unit
    assert (unit.cell, unit.name) == ("line/10/20", "line/10/20/1.3")


def test_the_processors_time_leaves_out_pauses(monkeypatch):
    settings = replace(TINY, families=("line",), budgets=(20.0,), methods=("auto",), instances=1, cpu_time=True)
    instance = make_instance(Cell("line", 30, 30), 0, 0)
    fitted = bench.fit

    def interrupted(*arguments, **options):
        time.sleep(0.1)
        return fitted(*arguments, **options)

    monkeypatch.setattr(bench, "fit", interrupted)
    assert max(bench.our_row(instance, "auto", 20.0, 2).ms) > 90
    (unit,) = run_units(settings)
    assert max(unit.rows[0].ms) < 90
    assert unit.core < 0.5


def run_units(settings):
    """Return what is found, without a file."""
    return [bench._run(bench._Work(settings, cell, 0, {})) for cell in settings.cells()]


def test_everyone_has_a_turn_to_be_the_first(monkeypatch):
    settings = replace(TINY, families=("line",), methods=("auto", "ransac", "gnc", "skimage-ransac"), instances=8)
    cell = settings.cells()[0]
    peers = {each.name: asdict(Choice(4, 1.0, 0.0, 0.0)) for each in PEERS}
    choices = {name: {f"{budget:g}": choice for budget in settings.budgets} for name, choice in peers.items()}
    bench._run(bench._Work(settings, cell, 0, choices))  # the fits that warm up are no turns
    turns = []

    def noted(run, name_of):
        def call(instance, method, *rest):
            turns.append(name_of(method))
            return run(instance, method, *rest)

        return call

    monkeypatch.setattr(bench, "our_row", noted(bench.our_row, str))
    monkeypatch.setattr(bench, "peer_row", noted(bench.peer_row, lambda peer: peer.name))
    first = []
    for number in (*range(8), 0):
        turns.clear()
        unit = bench._run(bench._Work(settings, cell, number, choices))
        assert [each.method for each in unit.rows] == [*settings.methods] * len(settings.budgets)
        assert sorted(turns) == sorted([*settings.methods] * len(settings.budgets))
        first.append(turns[0])
    assert len(set(first)) > 1
    assert first[-1] == first[0]
