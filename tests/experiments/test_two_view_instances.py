"""Fundamental matrices to train on: the split, the draw, and what the consensus to reach is compared with."""

import dataclasses

import numpy as np
import pytest

import oracles
from maxcon.agent.config import DataConfig, fundamental, paper, shipped
from maxcon.datasets.two_view_scene import synthetic_two_view
from maxcon.experiments import training, two_view_instances
from maxcon.experiments.two_view_instances import DriveSource, SceneSource, best_known, open_drive, pair_matches
from maxcon.vision.fundamental import fundamental_problem
from real_data import real_data

SCENE = DataConfig(source="scene")
KITTI = DataConfig(source="kitti", threshold=0.01, frames=(0, 2), steps=(1,))


def small(**changes):
    return fundamental(shipped(8)).override(n_points=20, n_instances=6, **changes)


def same(one, other):
    return np.array_equal(one.A, other.A) and np.array_equal(one.b, other.b)


def test_scenes_are_posed_in_the_chart_and_of_the_size_asked_for():
    for chart, family in (("auto", "fundamental"), ("F32=1", "fundamental F32=1")):
        source = SceneSource(dataclasses.replace(SCENE, chart=chart), "train")
        problem = source.draw(np.random.default_rng(3), 30, 0.2)
        scene = synthetic_two_view(30, 0.2, np.random.default_rng(3))
        assert same(problem, fundamental_problem(scene.x1, scene.x2, chart=chart, threshold=0.1).problem)
        assert (problem.family, problem.A.shape) == (family, (30, 8))


def test_training_and_held_out_instances_come_from_the_seed_and_differ(monkeypatch):
    monkeypatch.setattr(training, "TWO_VIEW_EACH", 1)
    config = small()
    one, again = training.training_problems(config), training.training_problems(config)
    held = training.held_out_problems(config)
    assert (len(one), len(held)) == (6, 5)
    assert all(same(a, b) for a, b in zip(one, again, strict=True))
    assert not any(same(a, b) for a in one for b in (*held, *training.training_problems(config.override(seed=1))))
    assert training.held_out_rates(config, held, [0] * 5) == [10, 20, 30, 40, 50]


def test_the_data_of_the_paper():
    for base in (shipped(8), paper(8)):
        config = fundamental(base)
        assert (config.train.low_rate, config.train.high_rate) == (0.1, 0.5)
        assert (config.data.threshold, config.data.chart) == (0.1, "auto")
    assert fundamental(paper(8), "kitti").data.threshold == 0.01
    assert not fundamental(paper(8)).network.estimate  # departure 12


def test_an_unknown_source():
    with pytest.raises(ValueError, match="source must be one of hyperplane, scene, modelnet, kitti, but it is 'x'"):
        training.training_problems(small(source="x"))


@pytest.mark.parametrize("changes", [{"chart": "F32=1"}, {"source": "hyperplane"}])
def test_no_estimate_where_there_is_none(changes):
    with pytest.raises(ValueError, match="estimate must be false but for the chart 'auto'"):
        training.training_problems(small(**changes))
    assert len(training.training_problems(small(**changes, estimate=False))) == 6


def test_best_known_against_every_subset():
    """Of 11 matches, so that the oracle can look at every subset."""
    rng = np.random.default_rng(0)
    for trial in range(3):
        scene = synthetic_two_view(11, 0.4, rng)
        problem = fundamental_problem(scene.x1, scene.x2, threshold=0.1).problem
        found, proven, seconds = best_known(problem, 0.02, 20.0)
        assert proven
        assert seconds > 0
        assert found == oracles.brute_force_consensus(problem.A, problem.b, 0.02), trial


def test_best_known_without_time_for_a_proof_is_no_worse_than_the_proposers():
    scene = synthetic_two_view(100, 0.5, np.random.default_rng(1))
    problem = fundamental_problem(scene.x1, scene.x2, threshold=0.1).problem
    found, proven, _ = best_known(problem, 0.1, 1e-9)
    exact, certain, _ = best_known(problem, 0.1, 5.0)
    assert not proven
    assert found >= 50
    assert found <= exact or not certain


def test_the_split_of_a_drive(tmp_path, monkeypatch):
    """Frames of noise, and matches that say which frames they are of."""
    cv2 = pytest.importorskip("cv2")
    folder = tmp_path / "sequences" / "07"
    (folder / "image_0").mkdir(parents=True)
    for frame in range(7):
        cv2.imwrite(str(folder / "image_0" / f"{frame:06}.png"), np.full((4, 4), frame, dtype=np.uint8))
    (folder / "calib.txt").write_text("P0: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    drive = open_drive("", tmp_path)
    assert drive.name == "07"

    def matches(first, second):
        pixels = np.array([[first[0, 0], second[0, 0]]], dtype=float)
        return two_view_matches(pixels, pixels)

    monkeypatch.setattr("maxcon.vision.matching.match_images", matches)
    for split, pairs in (("train", [(0, 1), (1, 2), (2, 3), (0, 3)]), ("test", [(4, 5), (5, 6)])):
        drawn = [(step, first, m[0, 0], m[0, 1]) for step, first, m in pair_matches(drive, (0, 3), (1, 3), split)]
        assert drawn == [(b - a, a, a, b) for a, b in pairs]
    with pytest.raises(ValueError, match="within 0 and 6, not"):
        list(pair_matches(drive, (0, 7), (1,), "train"))
    with pytest.raises(ValueError, match=r"of the 3 pairs for training none"):
        DriveSource(dataclasses.replace(KITTI, frames=(0, 3)), "train", 20, tmp_path)
    (tmp_path / "sequences" / "08").mkdir()
    with pytest.raises(ValueError, match="sequence must name one of the drives 07, 08"):
        open_drive("", tmp_path)
    with pytest.raises(FileNotFoundError, match="KITTI"):
        open_drive("", tmp_path / "nowhere")


def two_view_matches(x1, x2):
    return type("Matches", (), {"x1": x1, "x2": x2})


def test_a_real_drive():
    folder = real_data("kitti")
    pytest.importorskip("cv2")
    source = DriveSource(KITTI, "train", 100, folder)
    assert len(source.pairs) == 2
    one, again = (source.draw(np.random.default_rng(4)) for _ in range(2))
    assert same(one, again)
    assert (one.family, one.n_points) == ("fundamental", 100)
    assert best_known(one, 0.01)[0] > 60  # most matches of neighbouring frames are right


def test_meshes():
    folder = real_data("ModelNet40")
    pytest.importorskip("trimesh")
    config = dataclasses.replace(SCENE, source="modelnet")
    one, other = (SceneSource(config, split, folder) for split in ("train", "test"))
    assert {mesh.name for mesh in one.meshes}.isdisjoint(mesh.name for mesh in other.meshes)
    assert one.draw(np.random.default_rng(0), 30, 0.3).n_points == 30
    assert two_view_instances.SceneSource(SCENE, "train").meshes == []
