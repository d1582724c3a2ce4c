"""The experiments of the paper, tiny."""

from dataclasses import replace

import numpy as np
import pytest

import maxcon
import oracles
from maxcon.agent.shipped import agent_path
from maxcon.datasets.synthetic import THRESHOLD
from maxcon.experiments import contenders as contenders_module
from maxcon.experiments import kitti_experiment, modelnet_experiment
from maxcon.experiments.canvas import picture
from maxcon.experiments.contenders import (
    AGENT,
    ASTAR,
    AUTO,
    IN_AUTO_TIME,
    IN_PAPER_TIME,
    LO_SWAP,
    PAPER,
    RANSAC,
    RB,
    RB_TREE,
    Contender,
    compete,
    synthetic_contenders,
    two_view_contenders,
)
from maxcon.experiments.kitti_experiment import KittiExperiment, frame_pairs, unpacked
from maxcon.experiments.modelnet_experiment import ModelnetExperiment
from maxcon.experiments.records import EXACT, read_records
from maxcon.experiments.reproduction import PARTS, QUICK, open_records, plan, reproduce
from maxcon.experiments.summary import MARK, overview, renew_page, summarise_folder
from maxcon.experiments.synthetic_experiment import SyntheticExperiment
from maxcon.experiments.trajectory_experiment import TrajectoryExperiment, trace_astar
from real_data import real_data

LIMITS = (2.0, 0.2, 1)
TINY = replace(
    QUICK,
    sizes=(20,),
    rates=(20, 50),
    instances=2,
    modelnet_rates=(10, 20),
    modelnet_instances=1,
    pairs=1,
    trajectories=2,
    proof_time=2.0,
    astar_time=0.2,
    astar_first=1,
)


def synthetic(name="line", **changes):
    chosen = synthetic_contenders(name, *LIMITS, {})
    return replace(SyntheticExperiment(name, (15, 20), (20, 50), 2, chosen), **changes)


@pytest.fixture(scope="module")
def rows():
    experiment = synthetic()
    return [row for unit in experiment.units() for row in experiment.run(unit, "digest")]


def test_a_row_for_every_run(rows):
    assert len({(each.unit, each.name) for each in rows}) == len(rows)
    for unit in {each.unit for each in rows}:
        some = [each for each in rows if each.unit == unit]
        assert {each.rows for each in some} == {len(some)}
        assert (ASTAR in {each.name for each in some}) == unit.endswith(", 0")  # it runs on the first of a cell
    for each in rows:
        assert each.digest == "digest"
        assert each.versions["maxcon"] == maxcon.__version__
        assert each.settings["seed"] == int(each.unit.rpartition(" ")[2])
        assert each.processor


def test_gaps_are_to_the_optimum(rows):
    experiment = synthetic()
    for unit in experiment.units():
        problem = experiment.instance(unit).problem
        optimum = oracles.line_consensus_bruteforce(problem.A[:, 0], problem.b, THRESHOLD)
        for each in (each for each in rows if each.unit == unit and each.done):
            assert each.proven
            assert each.best == each.upper_bound == optimum
            assert each.gap == each.short == optimum - each.consensus >= 0
            assert each.consensus == optimum or each.name not in (EXACT, AUTO)


def test_instances_hang_on_their_names_alone():
    more = synthetic(sizes=(20, 40), rates=(50, 70), n_instances=5)
    for unit in ("N=20, 50%, 0", "N=20, 50%, 1"):
        np.testing.assert_array_equal(more.instance(unit).problem.b, synthetic().instance(unit).problem.b)
    b = [experiment.instance("N=20, 50%, 0").problem.b for experiment in (synthetic(), synthetic(seed=1))]
    assert not np.array_equal(*b)
    b = [synthetic(name).instance("N=20, 50%, 0").problem.b for name in ("line", "plane")]
    assert not np.array_equal(*b)
    b = [synthetic().instance(f"N=20, 50%, {number}").problem.b for number in (0, 1)]
    assert not np.array_equal(*b)


def test_random_baseline_is_what_the_walk_keeps(rows):
    for each in rows:
        if each.name == RB:
            assert each.consensus == each.before_refinement
        elif each.name == RB_TREE:
            assert each.consensus >= each.before_refinement
        elif each.name in (RANSAC, EXACT):
            assert each.before_refinement is None


def test_equal_time():
    experiment = synthetic(factor=3.0)
    rows = {each.name: each for each in experiment.run("N=20, 50%, 0", "")}
    for name, payer in ((RANSAC, AGENT), (LO_SWAP, AGENT), (RANSAC + IN_AUTO_TIME, AUTO)):
        assert rows[name].settings["budget"] == payer
        assert rows[name].settings["time_limit"] == pytest.approx(3.0 * rows[payer].seconds)
        assert rows[name].multiple == pytest.approx(rows[name].seconds / rows[payer].seconds)
        assert rows[name].multiple >= 2.9
    assert rows[EXACT].settings["time_limit"] == 2.0
    assert rows[EXACT].multiple is None


def test_without_an_agent_the_time_is_that_of_auto():
    chosen = [replace(each, missing="gone") if each.method == "agent" else each for each in synthetic().contenders]
    rows = {each.name: each for each in synthetic(contenders=tuple(chosen)).run("N=20, 50%, 0", "")}
    assert rows[RANSAC].settings["budget"] == AUTO
    assert (rows[AGENT].status, rows[AGENT].error, rows[AGENT].consensus) == ("not installed", "gone", 0)


def test_agents_that_are_not_there_are_told(monkeypatch):
    monkeypatch.setattr(contenders_module, "agent_names", lambda: ("line",))
    chosen = {each.name: each for each in synthetic_contenders("line", *LIMITS, {})}
    assert chosen[PAPER].missing == "not installed: no agent 'line-paper' is shipped or given"
    assert chosen[AGENT].missing is None
    assert RANSAC + IN_PAPER_TIME not in chosen
    given = {"line-paper": str(agent_path("line"))}
    chosen = {each.name: each for each in synthetic_contenders("line", *LIMITS, given)}
    assert chosen[PAPER].missing is None
    assert chosen[PAPER].describe()["options"]["weights"].startswith("sha256 ")
    assert chosen[PAPER].refine == "tree"
    assert chosen[RANSAC + IN_PAPER_TIME].budget == (PAPER,)
    monkeypatch.setattr(contenders_module, "METHODS", {})
    assert "no method 'uclm'" in {each.name: each for each in two_view_contenders(*LIMITS, {})}["UCLM"].missing


def test_a_failed_run_stays_as_a_row(monkeypatch):
    real = maxcon.fit

    def failing(problem, threshold, *, method, **rest):
        if method == "random":
            raise ArithmeticError("did not converge")
        return real(problem, threshold, method=method, **rest)

    monkeypatch.setattr(contenders_module, "fit", failing)
    rows = {each.name: each for each in synthetic().run("N=20, 50%, 0", "")}
    assert rows[RB].error == "failed: did not converge"
    assert (rows[RB].status, rows[RB].consensus, rows[RB].gap) == ("failed", 0, rows[RB].upper_bound)


def test_no_time_without_whoever_pays():
    chosen = tuple(each for each in synthetic().contenders if each.name in (EXACT, RANSAC))
    rows = {each.name: each for each in synthetic(contenders=chosen).run("N=20, 50%, 0", "")}
    assert rows[RANSAC].error == f"failed: none of {AGENT}, {AUTO} ran, whose time is its limit"
    assert rows[EXACT].done


def test_a_wrong_option_is_no_failed_run():
    wrong = synthetic(contenders=(Contender("none", "random", {"tries": 0}),))
    with pytest.raises(ValueError, match="tries"):
        compete(wrong.instance("N=20, 50%, 0"), wrong.contenders, 1.0)


def test_the_bound_stands_where_nothing_is_proven():
    chosen = tuple(each for each in two_view_contenders(1e-3, 0.05, 1, {}) if each.name in (EXACT, RANSAC, AUTO))
    experiment = ModelnetExperiment((), (60,), 1, chosen, n_points=150)
    rows = experiment.run("60%, 0", "")
    assert not rows[0].proven
    for each in rows:
        assert each.best == max(other.consensus for other in rows)
        assert each.gap == each.upper_bound - each.consensus > 0
        assert each.upper_bound <= 150


def test_modelnet_on_shapes_of_our_own():
    chosen = tuple(each for each in two_view_contenders(*LIMITS, {}) if each.name in (EXACT, AUTO, RANSAC))
    experiment = ModelnetExperiment((), (20,), 2, chosen)
    rows = experiment.run("20%, 1", "")
    assert [each.n_points for each in rows] == [100, 100, 100]
    assert rows[0].proven
    assert rows[0].consensus >= 80
    assert rows[0].instance == "shapes of our own, seed [0, 6, 100, 20, 1]"
    assert experiment.settings()["meshes"] == "shapes of our own"


def test_kitti_on_made_pairs():
    chosen = tuple(each for each in two_view_contenders(*LIMITS, {}) if each.name in (AUTO, RANSAC))
    experiment = KittiExperiment("", ((1, 0), (3, 2)), chosen)
    assert experiment.units() == {"step 1, 0": (1, 0, 0), "step 3, 2": (3, 2, 0)}
    pair = experiment.matches("step 3, 2")
    rows = experiment.run("step 3, 2", "")
    for each in rows:
        assert each.n_points == len(pair.x1)
        mask = unpacked(each)
        assert mask.sum() == each.consensus == each.measures["marked"]
        assert 0 < each.measures["confirmed"] <= each.consensus
        assert each.step == 3


def test_kitti_on_a_real_pair(tmp_path):
    real_data("kitti", "sequences", "dev")
    pytest.importorskip("cv2", reason="needs OpenCV: pip install 'maxcon[vision]'")
    experiment = plan("kitti", TINY, tmp_path, sequence="dev")
    assert list(experiment.units()) == ["step 1, 0", "step 3, 0"]
    chosen = tuple(each for each in experiment.contenders if each.name in (AUTO, RANSAC))
    rows = replace(experiment, contenders=chosen).run("step 1, 0", "")
    assert rows[0].instance == "drive dev, frames 0 and 1"
    for each in rows:
        assert 300 <= each.n_points <= 1500
        assert unpacked(each).sum() == each.consensus
        assert each.measures["confirmed"] >= 0.9 * each.consensus  # the true F agrees
        assert each.measures["true_sampson_pixels"] < 1.0
    assert list((tmp_path / "matches").glob("*.npz"))


def test_modelnet_on_a_real_mesh(tmp_path):
    real_data("ModelNet40")
    pytest.importorskip("trimesh", reason="needs trimesh: pip install 'maxcon[data]'")
    experiment = plan("modelnet", TINY, tmp_path)
    chosen = tuple(each for each in experiment.contenders if each.name in (EXACT, AUTO))
    rows = replace(experiment, contenders=chosen).run("10%, 0", "")
    assert rows[0].instance.partition(",")[0] in experiment.settings()["meshes"]
    assert rows[0].proven
    assert rows[0].consensus >= 90


def test_pairs_of_a_drive():
    assert frame_pairs("", (1,), None) == tuple((1, first) for first in range(50))
    assert frame_pairs("", (1, 3), 3) == ((1, 0), (1, 24), (1, 49), (3, 0), (3, 24), (3, 47))


@pytest.mark.parametrize("number", range(6))
def test_astar_is_traced_to_the_optimum(number):
    experiment = TrajectoryExperiment((), n_points=16, n_outliers=5)
    problem = experiment.instance(f"instance {number}").problem
    trace = trace_astar(problem, THRESHOLD)
    nodes, expanded = trace["nodes"], trace["expanded"]
    assert nodes[0] == [-1, -1]
    assert expanded[0] == 0
    assert len(set(expanded)) == len(expanded)
    removed = [frozenset()]
    for node, (parent, point) in enumerate(nodes[1:], 1):
        assert 0 <= parent < node
        assert parent in expanded
        assert point not in removed[parent]
        removed.append(removed[parent] | {point})
    assert len(set(removed)) == len(removed)
    left = np.ones(16, dtype=bool)
    left[list(removed[expanded[-1]])] = False
    assert maxcon.minimax_fit(problem, left).value <= THRESHOLD
    assert left.sum() == oracles.line_consensus_bruteforce(problem.A[:, 0], problem.b, THRESHOLD)
    for node in expanded[:-1]:  # no feasible set was passed over
        mask = np.ones(16, dtype=bool)
        mask[list(removed[node])] = False
        assert maxcon.minimax_fit(problem, mask).value > THRESHOLD


def untimed(rows):
    """Return what does not hang on the clock."""
    return sorted(
        (each.unit, each.name, each.instance, each.consensus, each.before_refinement or 0)
        for each in rows
        if each.settings["time_limit"] is None or each.name == EXACT
    )


def test_records_do_not_hang_on_who_runs_them(tmp_path, rows):
    experiment = synthetic()
    found = {}
    for backend, jobs in (("sequential", 1), ("loky", 2)):
        file = open_records(experiment, tmp_path / backend)
        found[backend] = [row for some in reproduce(experiment, file, backend=backend, jobs=jobs) for row in some]
        assert read_records(file.path) == file.done == found[backend]
    assert untimed(found["sequential"]) == untimed(found["loky"]) == untimed(rows)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_records_of_a_cluster(tmp_path, rows):
    pytest.importorskip("dask.distributed", reason="needs Dask: pip install 'maxcon[dask]'")
    experiment = synthetic()
    file = open_records(experiment, tmp_path)
    some = [row for rows in reproduce(experiment, file, backend="dask", jobs=2) for row in rows]
    assert untimed(some) == untimed(rows)


def test_nothing_is_run_twice(tmp_path):
    experiment = synthetic()
    file = open_records(experiment, tmp_path)
    seen = []
    run = reproduce(experiment, file, backend="sequential", progress=lambda *count: seen.append(count))
    for _ in range(3):
        next(run)
    run.close()
    assert seen == [(0, 8), (1, 8), (2, 8), (3, 8)]
    before = list(file.done)
    again = open_records(experiment, tmp_path)
    assert again.done == before
    rest = [row for some in reproduce(experiment, again, backend="sequential") for row in some]
    assert not {each.unit for each in rest} & {each.unit for each in before}
    assert again.units == set(experiment.units())
    assert list(reproduce(experiment, open_records(experiment, tmp_path), backend="sequential")) == []
    with pytest.raises(ValueError, match="holds records of other settings"):
        open_records(synthetic(seed=1), tmp_path)


def test_without_real_data_made_scenes_take_their_place(tmp_path, monkeypatch):
    monkeypatch.setenv("MAXCON_DATA", str(tmp_path / "nothing"))
    assert plan("modelnet", TINY, tmp_path).settings()["meshes"] == "shapes of our own"
    assert plan("kitti", TINY, tmp_path).settings()["sequence"] == "made pairs"
    with pytest.raises(ValueError, match="part must be one of line, plane, modelnet, kitti, trajectory"):
        plan("homography", TINY, tmp_path)


def test_everything_from_the_records_alone(tmp_path, monkeypatch):
    for part in PARTS:
        experiment = plan(part, TINY, tmp_path, made=True)
        for _ in reproduce(experiment, open_records(experiment, tmp_path), backend="sequential"):
            pass
    monkeypatch.setattr(contenders_module, "fit", None)  # no fit is made from here on
    monkeypatch.setattr(kitti_experiment, "kitti_drive", None)
    monkeypatch.setattr(modelnet_experiment, "modelnet_files", None)
    written = summarise_folder(tmp_path)
    names = {path.name for path in written}
    assert {"line-20.png", "plane-20.png", "modelnet.png", "kitti.png"} <= names
    assert {"kitti-matches.png", "summary.md"} <= names
    page = (tmp_path / "summary.md").read_text(encoding="utf-8")
    for name in names - {"summary.md"}:
        assert f"(figures/{name})" in page
    for text in ("ModelNet40 3", "KITTI 5", "figure 1, b", "times the time", "Optimum proven"):
        assert text in page
    assert any(line.startswith("ModelNet40 1, exact: does not hold") for line in overview(tmp_path))
    docs = tmp_path / "docs" / "page.md"
    docs.parent.mkdir()
    docs.write_text(f"# A page\n\nWords.\n\n{MARK}\nold\n", encoding="utf-8")
    for _ in range(2):
        renewed = renew_page(tmp_path, docs)
    text = docs.read_text(encoding="utf-8")
    assert text.startswith(f"# A page\n\nWords.\n\n{MARK}\n")
    assert "old" not in text.splitlines()
    assert text.count("## Lines") == 1
    for name in names - {"summary.md"}:
        assert f"(figures/reproduction/{name})" in text
        assert docs.parent / "figures" / "reproduction" / name in renewed
    docs.write_text("# A page\n", encoding="utf-8")
    with pytest.raises(ValueError, match="must have the line '<!-- from records -->'"):
        renew_page(tmp_path, docs)


def test_no_records_no_page(tmp_path):
    with pytest.raises(FileNotFoundError, match="no records"):
        summarise_folder(tmp_path)


def test_a_figure_says_what_is_missing(rows):
    from maxcon.experiments.synthetic_figure import draw_synthetic  # noqa: PLC0415

    some = [
        replace(each, error="not installed: x", status="not installed") if each.name == RB else each for each in rows
    ]
    figure = draw_synthetic(some, 20)
    left, right = figure.axes
    assert left.get_title(loc="left") == "distance to the proven optimum"
    assert "RB" in figure.legends[0].get_title().get_text()
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert RB not in labels
    assert AGENT in labels
    assert "times the time of EdgeConv agent" in figure.legends[0].get_title().get_text()
    assert right.get_yscale() == "log"
    unproven = [replace(each, proven=False) for each in rows]
    assert draw_synthetic(unproven, 20).axes[0].get_title(loc="left") == "distance to the largest consensus known"
    assert picture(figure, "png").startswith(b"\x89PNG")
