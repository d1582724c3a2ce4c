import sys
from types import SimpleNamespace

import numpy as np
import pytest

from maxcon.experiments import bench_peers
from maxcon.experiments.bench_calibration import timed
from maxcon.experiments.bench_cells import CHARTS, N_PARAMS, Cell, make_instance
from maxcon.experiments.bench_peers import PEERS, PoseLib, PyColmap, VerticalModel, installed, peer_names, peers_for

#: Iterations that suffice at 20% outliers, for those that do not need more than these to be slow.
ENOUGH = {"sklearn-ransac": 60, "sklearn-theilsen": 300, "opencv-lmeds": 500}

SERVED = [
    pytest.param(peer, family, id=f"{peer.name}-{family}")
    for peer in PEERS
    for family in N_PARAMS
    if peer.serves(family) and installed(peer) is not None
]


@pytest.mark.parametrize(("peer", "family"), SERVED)
def test_peers_find_what_is_easy(peer, family):
    """With few outliers, everyone explains most of the inliers under the one residual; a least-squares fit does not."""
    instance = make_instance(Cell(family, 100, 20), 0, 0)
    iterations = ENOUGH.get(peer.name, 300)
    found = []
    for threshold in peer.thresholds:
        model, seconds, error = timed(peer.prepare(instance, 0), iterations, threshold)
        assert error is None
        assert seconds > 0
        found.append(instance.count_model(model))
    # Huber's loss bends to outliers, and the spatial median of minimal fits is poor.
    least = 30 if peer.name in {"sklearn-huber", "sklearn-theilsen"} else 62
    assert max(found) >= least
    assert max(found) <= 100


@pytest.mark.parametrize(("peer", "family"), SERVED)
def test_a_peer_returns_parameters_or_a_matrix(peer, family):
    instance = make_instance(Cell(family, 60, 20), 1, 0)
    model, _, _ = timed(peer.prepare(instance, 3), 100, peer.thresholds[-1])
    assert model is not None
    assert model.shape == ((3, 3) if family in CHARTS else (N_PARAMS[family],))
    assert model.dtype == np.float64


@pytest.mark.parametrize("name", ["sklearn-ransac", "skimage-ransac", "opencv-ransac"])
def test_seeds_differ_and_repeat(name):
    family = "fundamental" if name == "opencv-ransac" else "plane"
    (peer,) = peers_for(family, (name,))
    instance = make_instance(Cell(family, 60, 50), 0, 0)
    models = [timed(peer.prepare(instance, seed), 8, peer.thresholds[2])[0] for seed in (0, 0, 1, 2, 3)]
    np.testing.assert_array_equal(models[0], models[1])
    assert any(not np.array_equal(models[0], each) for each in models[2:])


def test_all_are_named_in_the_order_of_the_tables():
    names = peer_names()
    assert len(set(names)) == len(names)
    assert {"poselib", "pycolmap", "opencv-usac-magsac", "sklearn-ransac", "skimage-ransac"} <= set(names)
    assert [each.name for each in peers_for("line", ("skimage-ransac", "opencv-ransac"))] == ["skimage-ransac"]


def test_two_view_peers_want_matches():
    peer = next(each for each in PEERS if each.name == "opencv-ransac")
    with pytest.raises(ValueError, match="instance must be a two-view problem, but it is of the family 'line'"):
        peer.prepare(make_instance(Cell("line", 20, 10), 0, 0), 0)


def test_errors_and_warnings_are_not_the_end(recwarn):
    def fails(iterations, threshold):
        np.float64(1.0) / np.float64(0.0)
        raise RuntimeError("no luck\nat all")

    model, seconds, error = timed(fails, 1, 1.0)
    assert model is None
    assert error == "RuntimeError: no luck"
    assert seconds >= 0
    assert not recwarn.list


def test_the_vertical_model():
    rows = np.array([[0.0, 1.0, 1.0], [1.0, 1.0, 3.0], [2.0, 1.0, 5.0]])
    model = VerticalModel.from_estimate(rows)
    np.testing.assert_allclose(model.theta, [2.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(model.residuals(rows + np.array([0, 0, 0.5])), 0.5, atol=1e-12)
    assert model.estimate(rows * [1, 1, 2])
    np.testing.assert_allclose(model.theta, [4.0, 2.0], atol=1e-12)


@pytest.fixture
def library(monkeypatch):
    """Stand in for a library that is not installed."""

    def install(name, **content):
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(__version__="9.9", **content))
        bench_peers._version.cache_clear()

    yield install
    bench_peers._version.cache_clear()


def test_poselib_by_its_documented_interface(library):
    instance = make_instance(Cell("fundamental", 30, 0), 0, 0)
    F = instance.posed.matrix(np.zeros(8))
    asked = {}

    def estimate_fundamental(points2D_1, points2D_2, ransac_opt, bundle_opt, initial_F=None):
        asked.update(ransac_opt)
        assert points2D_1.shape == points2D_2.shape == (30, 2)
        assert bundle_opt == {}
        return F, {"inliers": [True] * 30}

    library("poselib", estimate_fundamental=estimate_fundamental)
    peer = PoseLib()
    assert installed(peer) is not None
    model, _, error = timed(peer.prepare(instance, 5), 77, 2.5)
    assert error is None
    np.testing.assert_array_equal(model, F)
    assert asked == {
        "max_iterations": 77,
        "min_iterations": 77,
        "max_epipolar_error": 2.5,
        "success_prob": bench_peers.CERTAIN,
        "seed": 5,
    }


def test_pycolmap_by_its_documented_interface(library):
    instance = make_instance(Cell("fundamental", 30, 0), 0, 0)
    F = instance.posed.matrix(np.zeros(8))
    asked = []

    class RANSACOptions:
        max_error = 4.0
        confidence = 0.9999
        min_num_trials = 1000
        max_num_trials = 100000
        random_seed = -1

    def estimate_fundamental_matrix(points2D1, points2D2, estimation_options):
        asked.append(estimation_options)
        rows = set(map(tuple, np.hstack([points2D1, points2D2])))
        assert rows == set(map(tuple, np.hstack([instance.x1, instance.x2])))  # in another order, but still matched
        found = {"F": F, "num_inliers": 30, "inlier_mask": np.ones(30, dtype=bool)}
        return found if estimation_options.max_error > 1 else None

    library("pycolmap", RANSACOptions=RANSACOptions, estimate_fundamental_matrix=estimate_fundamental_matrix)
    run = PyColmap().prepare(instance, 5)
    np.testing.assert_array_equal(timed(run, 77, 2.5)[0], F)
    assert timed(run, 77, 0.5)[0] is None
    assert (asked[0].max_error, asked[0].min_num_trials, asked[0].max_num_trials) == (2.5, 77, 77)
    assert asked[0].random_seed == 5


def test_what_is_absent_has_no_version(monkeypatch):
    monkeypatch.setitem(sys.modules, "poselib", None)  # Python's way to say that an import fails
    bench_peers._version.cache_clear()
    assert installed(PoseLib()) is None
    assert peers_for("fundamental", ("poselib",)) == ()
    bench_peers._version.cache_clear()
