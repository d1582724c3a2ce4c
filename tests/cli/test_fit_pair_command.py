import inspect
import json

import numpy as np
import pytest
from scipy.io import savemat

from maxcon.cli.fit_pair import _CHARTS, _PIXELS, _THRESHOLD
from maxcon.cli.pair_picture import LINES, draw_matches, spread
from maxcon.datasets import synthetic_two_view
from maxcon.vision import CHARTS, find_fundamental, sampson_distances
from maxcon.vision.fundamental import USUAL_THRESHOLD
from real_data import real_data


@pytest.fixture
def pair(tmp_path):
    """A made pair of 60 matches, 12 of them wrong, in a MATLAB file with images."""
    scene = synthetic_two_view(60, 0.2, np.random.default_rng(0), noise=0.3)
    X1, X2 = (np.column_stack([x, np.ones(60)]).T for x in (scene.x1, scene.x2))
    rng = np.random.default_rng(1)
    images = {name: rng.integers(0, 256, (480, 640, 3)).astype(np.uint8) for name in ("im1", "im2")}
    path = tmp_path / "pair.mat"
    savemat(path, {"data": {"matches": {"X1": X1, "X2": X2, **images}}})
    return path, scene


def test_it_shows_what_it_found(run, pair):
    path, scene = pair
    result = run("fit-pair", path, "--method", "peel", "--threshold", 0.03)
    assert result.exit_code == 0, result.output
    lines = {line.split("  ")[0]: line for line in result.stdout.splitlines()}
    assert "60 (from the file)" in lines["matches"]
    count = int(lines["inliers"].split()[1])
    assert count >= scene.inlier_mask.sum()
    assert "at most 60 are possible" in lines["bound"]
    assert lines["chart"].split()[-1] == "auto"
    assert "pixels" in lines["Sampson"]
    assert int(lines["polished"].split()[1]) > 0.7 * scene.inlier_mask.sum()
    assert "within 1 px of F" in lines["polished"]
    assert "polished" not in run("fit-pair", path, "--method", "peel", "--threshold", 0.03, "--pixels", 0).stdout
    assert "F (pixels)" in result.stdout


def test_json_holds_the_matrix_and_the_matches(run, pair):
    path, scene = pair
    result = run("fit-pair", path, "--method", "peel", "--threshold", 0.03, "--chart", "F32=1", "--json", "-")
    record = json.loads(result.stdout)
    assert record["files"] == [str(path)]
    assert record["chart"] == "F32=1"
    F = np.array(record["F"])
    assert np.linalg.svd(F, compute_uv=False)[2] < 1e-12
    np.testing.assert_allclose(record["x1"], scene.x1)
    np.testing.assert_allclose(record["sampson"], sampson_distances(F, scene.x1, scene.x2), rtol=1e-6)
    assert sum(record["inlier_mask"]) == record["n_inliers"]
    assert record["pixels"] == 1.0
    assert record["within_pixels"] == (sampson_distances(F, scene.x1, scene.x2) <= 1.0).tolist()
    assert np.linalg.svd(record["F_linear"], compute_uv=False)[2] < 1e-12
    assert record["threshold"] == 0.03


def test_pictures_are_written_where_they_belong(run, pair, tmp_path):
    pytest.importorskip("matplotlib")
    path, _ = pair
    for suffix, head in ((".png", b"\x89PNG"), (".svg", b"<?xml"), (".pdf", b"%PDF")):
        out = tmp_path / f"matches{suffix}"
        result = run("fit-pair", path, "--method", "ransac", "--picture", out)
        assert result.exit_code == 0, result.output
        assert f"wrote {out}" in result.stdout
        assert out.read_bytes().startswith(head)
    result = run("fit-pair", path, "--method", "ransac", "--picture", "-")
    assert result.stdout_bytes.startswith(b"\x89PNG")


def test_the_same_command_gives_the_same_result(run, pair):
    path, _ = pair
    records = [json.loads(run("fit-pair", path, "--method", "lo-ransac", "--json", "-").stdout) for _ in range(2)]
    for record in records:
        del record["seconds"]
    assert records[0] == records[1]


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ((), "give two images, or one .mat file, but there are 0 files"),
        (("a.png",), "give two images, or one .mat file, but there are 1 files: ['a.png']"),
        (("none.mat",), "cannot read 'none.mat': No such file or directory"),
        (("none.png", "other.png"), "cannot read 'none.png': No such file or directory"),
        (("text.png", "text.png"), "text.png must be an image"),
        (("text.mat",), "text.mat must be a MATLAB 5 file"),
        (("pair.mat", "--threshold", "-1"), "threshold must be a positive finite number, but it is -1.0"),
        (("pair.mat", "--pixels", "-1"), "pixels must be a positive finite number, but it is -1.0"),
        (("pair.mat", "--chart", "F11=1"), "Invalid value for '--chart'"),
        (("pair.mat", "--method", "luck"), "but it is 'luck'"),
        (("pair.mat", "--json", "-", "--picture", "-"), "--json and --picture cannot both go to standard output"),
        (("pair.mat", "--picture", "x.jpg"), "--picture must end in .png, .svg or .pdf, but it is 'x.jpg'"),
        (("pair.mat", "--json", "no/x.json"), "--json: there is no folder"),
    ],
)
def test_errors_take_one_line(fails, pair, tmp_path, args, message):
    pytest.importorskip("cv2")
    for name in ("text.png", "text.mat"):
        (tmp_path / name).write_text("neither an image nor a table\n" * 10)
    assert message in fails("fit-pair", *args)


def test_too_few_matches_are_told(fails, tmp_path):
    cv2 = pytest.importorskip("cv2")
    blank = tmp_path / "blank.png"
    blank.write_bytes(cv2.imencode(".png", np.zeros((50, 50), dtype=np.uint8))[1].tobytes())
    message = fails("fit-pair", blank, blank)
    assert "needs at least 9 matches" in message
    assert "have 0 (of 0 and 0 SIFT keypoints)" in message


def test_without_opencv_the_error_names_the_extra(fails, monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "cv2", None)
    assert "pip install 'maxcon[vision]'" in fails("fit-pair", "a.png", "b.png")


def test_the_help_knows_the_charts_and_the_threshold():
    assert tuple(CHARTS) == _CHARTS
    assert USUAL_THRESHOLD == _THRESHOLD
    assert inspect.signature(find_fundamental).parameters["pixels"].default == _PIXELS


def test_lines_are_few_and_spread():
    rng = np.random.default_rng(2)
    cluster = rng.normal(0.0, 0.01, (500, 2))
    points = np.vstack([cluster, [[5.0, 0.0], [0.0, 5.0], [5.0, 5.0]]])
    chosen = spread(points, 10)
    assert len(set(chosen.tolist())) == 10
    assert {500, 501, 502} <= set(chosen.tolist())
    np.testing.assert_array_equal(spread(points[:7], 10), np.arange(7))
    assert len(spread(np.zeros((20, 2)), 10)) == 10


@pytest.mark.parametrize("shape", [(100, 120), (60, 200)])
def test_the_picture_puts_both_images_and_counts_all_matches(shape):
    pytest.importorskip("matplotlib")
    rng = np.random.default_rng(3)
    height, width = shape
    x1, x2 = rng.uniform(0, (width, height), (2, 300, 2))
    mask = np.arange(300) < 220
    image = np.zeros(shape, dtype=np.uint8)
    figure = draw_matches(x1, x2, mask, image, image[: height - 10], "a and b", "caption")
    axes = figure.axes[0]
    inliers, outliers = axes.collections[0], axes.collections[2]
    assert len(inliers.get_segments()) == LINES
    assert len(outliers.get_segments()) == 80
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == [f"220 inliers, {LINES} of them as lines", "80 outliers"]
    shift = np.array(inliers.get_segments())[:, 1] - x2[mask][spread(x1[mask], LINES)]
    side_by_side = width < 1.7 * height
    assert (shift[:, 0] > width).all() if side_by_side else (shift[:, 1] > height).all()
    np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), atol=1e-9)
    blank = draw_matches(x1, x2, np.ones(300, dtype=bool), None, None, "a and b", "caption")
    assert len(blank.legends[0].get_texts()) == 1


def test_two_frames_of_kitti(run, tmp_path):
    pytest.importorskip("cv2")
    frames = [real_data("kitti", "sequences", "dev", "image_0", f"{i:06d}.png") for i in (40, 43)]
    result = run("fit-pair", *frames, "--method", "peel", "--picture", tmp_path / "frames.png", "--json", "out.json")
    assert result.exit_code == 0, result.output
    record = json.loads((tmp_path / "out.json").read_text())
    assert record["n_inliers"] > 0.9 * len(record["x1"]) > 300
    assert record["median_sampson"] < 1.0


def test_the_rectified_pair_of_scikit_image(run, tmp_path):
    """F33 = 0: the chart "F33=1" loses the consensus, the others keep it."""
    cv2 = pytest.importorskip("cv2")
    data = pytest.importorskip("skimage.data")
    for name, image in zip(("left.png", "right.png"), data.stereo_motorcycle()[:2], strict=True):
        (tmp_path / name).write_bytes(cv2.imencode(".png", image[..., ::-1])[1].tobytes())
    counts = {}
    for chart in CHARTS:
        result = run("fit-pair", "left.png", "right.png", "--method", "peel", "--chart", chart, "--json", "-")
        assert result.exit_code == 0, result.output
        record = json.loads(result.stdout)
        counts[chart] = record["n_inliers"] / len(record["x1"])
    assert counts["auto"] > 0.93
    assert counts["F32=1"] > 0.9
    assert counts["F33=1"] < 0.4


def test_a_note_where_the_matches_do_not_determine_the_matrix(run, pair, tmp_path):
    path, scene = pair
    args = ("--method", "peel", "--threshold", 0.03)
    assert "\nnote " not in run("fit-pair", path, *args).stdout
    assert json.loads(run("fit-pair", path, *args, "--json", "-").stdout)["note"] is None
    X = np.column_stack([scene.x1, np.ones(60)]).T
    savemat(tmp_path / "same.mat", {"data": {"matches": {"X1": X, "X2": X}}})
    text = " ".join(run("fit-pair", "same.mat", *args).stdout.split())
    assert "note one homography explains 60 of the 60 inliers" in text
    assert "they do not determine F" in json.loads(run("fit-pair", "same.mat", *args, "--json", "-").stdout)["note"]
