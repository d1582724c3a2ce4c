"""SIFT matches, on an image and its copy moved by a known map."""

import numpy as np
import pytest

from maxcon.datasets import kitti_drive
from maxcon.vision import find_fundamental, match_images, read_image, sampson_distances
from maxcon.vision.matching import grey_levels
from real_data import real_data

cv2 = pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def textured():
    """A picture of blobs, 300 x 400."""
    rng = np.random.default_rng(0)
    image = np.full((300, 400), 110, dtype=np.uint8)
    for _ in range(250):
        centre = (int(rng.integers(0, 400)), int(rng.integers(0, 300)))
        cv2.circle(image, centre, int(rng.integers(3, 14)), int(rng.integers(0, 256)), -1)
    return cv2.GaussianBlur(image, (0, 0), 1.0)


def turned(image):
    """Return the image turned by 20 degrees and shrunk, with the 2x3 map that does it."""
    M = cv2.getRotationMatrix2D((200, 150), 20, 0.85)
    return cv2.warpAffine(image, M, (400, 300), borderValue=110), M


def test_matches_follow_the_map(textured):
    image, M = turned(textured)
    found = match_images(textured, image)
    assert len(found.x1) > 60
    assert found.x1.shape == found.x2.shape == (len(found.ratio), 2)
    error = np.linalg.norm(found.x1 @ M[:, :2].T + M[:, 2] - found.x2, axis=1)
    assert np.mean(error < 1.5) > 0.9
    assert np.median(error) < 0.3
    assert (np.diff(found.ratio) >= 0).all()
    assert found.ratio.max() < 0.8
    assert min(found.n_keypoints) >= len(found.x1)


def test_no_match_is_double_and_mutual_matches_are_unique(textured):
    image, _ = turned(textured)
    found = match_images(textured, image)
    both = np.hstack([found.x1, found.x2])
    assert len(np.unique(both, axis=0)) == len(both)
    loose = match_images(textured, image, mutual=False)
    assert len(loose.x1) >= len(found.x1)
    kept = {tuple(row) for row in both}
    assert kept <= {tuple(row) for row in np.hstack([loose.x1, loose.x2])}
    strict = match_images(textured, image, ratio=0.5)
    assert {tuple(row) for row in np.hstack([strict.x1, strict.x2])} <= kept
    assert strict.ratio.max() < 0.5
    assert len(match_images(textured, image, ratio=1.0).x1) > len(found.x1)


def test_keypoints_can_be_limited(textured):
    found = match_images(textured, turned(textured)[0], max_keypoints=40)
    assert max(found.n_keypoints) <= 45  # OpenCV keeps ties


def test_images_without_keypoints_have_no_matches(textured):
    blank = np.zeros((50, 60), dtype=np.uint8)
    for pair in ((blank, blank), (textured, blank), (blank, textured)):
        found = match_images(*pair)
        assert found.x1.shape == found.x2.shape == (0, 2)
        assert found.ratio.shape == (0,)


def test_the_cache_gives_the_same_and_survives_damage(textured, tmp_path):
    image, _ = turned(textured)
    first = match_images(textured, image, cache=tmp_path / "deep" / "cache")
    (file,) = (tmp_path / "deep" / "cache").iterdir()
    stamp = file.stat().st_mtime_ns
    second = match_images(textured, image, cache=tmp_path / "deep" / "cache")
    assert file.stat().st_mtime_ns == stamp
    for name in ("x1", "x2", "ratio", "n_keypoints"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    assert second.n_keypoints == first.n_keypoints
    match_images(textured, image, ratio=0.7, cache=tmp_path / "deep" / "cache")
    assert len(list((tmp_path / "deep" / "cache").iterdir())) == 2
    for damage in (b"", b"damaged", file.read_bytes()[:200]):
        file.write_bytes(damage)
        third = match_images(textured, image, cache=tmp_path / "deep" / "cache")
        np.testing.assert_array_equal(first.x1, third.x1)


def test_colours_and_floats_are_read_as_grey_levels():
    colour = np.zeros((2, 3, 3), dtype=np.uint8)
    colour[0, 0] = (255, 0, 0)
    colour[0, 1] = (0, 255, 0)
    colour[1] = 200
    expected = [[76, 150, 0], [200, 200, 200]]
    np.testing.assert_array_equal(grey_levels(colour), expected)
    np.testing.assert_array_equal(grey_levels(colour / 255.0), expected)
    opaque = np.dstack([colour, np.full((2, 3), 255, dtype=np.uint8)])
    np.testing.assert_array_equal(grey_levels(opaque), expected)
    np.testing.assert_array_equal(grey_levels(colour), cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY))


@pytest.mark.parametrize(
    ("image", "error", "message"),
    [
        (np.zeros((3, 3), dtype=complex), TypeError, "image1 must hold grey levels or colours"),
        (np.zeros(5), ValueError, r"image1 must have shape \(height, width\)"),
        (np.zeros((4, 4, 2)), ValueError, r"image1 must have shape \(height, width\)"),
        (np.full((4, 4), 2.0), ValueError, "image1 must lie in 0 to 1, but it spans 2.0 to 2.0"),
        (np.full((4, 4), 300), ValueError, "image1 must lie in 0 to 255"),
        (np.full((4, 4), np.nan), ValueError, "image1 must lie in 0 to 1"),
    ],
)
def test_errors_name_the_argument(image, error, message):
    with pytest.raises(error, match=message):
        match_images(image, np.zeros((4, 4)))


@pytest.mark.parametrize("ratio", [0.0, 1.1, float("nan")])
def test_a_ratio_out_of_range_is_refused(ratio, textured):
    with pytest.raises(ValueError, match="ratio must be above 0 and at most 1"):
        match_images(textured, textured, ratio=ratio)


def test_image_files(textured, tmp_path):
    file = tmp_path / "ünï.png"
    file.write_bytes(cv2.imencode(".png", textured)[1].tobytes())
    np.testing.assert_array_equal(read_image(file), textured)
    for content in (b"", b"no image"):
        file.write_bytes(content)
        with pytest.raises(ValueError, match="must be an image"):
            read_image(file)
    with pytest.raises(FileNotFoundError):
        read_image(tmp_path / "none.png")


@pytest.mark.parametrize("step", [1, 3])
def test_frames_of_kitti_agree_with_their_poses(step):
    """F from calibration and poses, which no match knew of, puts the inliers found within a pixel."""
    real_data("kitti", "sequences", "dev")
    pair = kitti_drive("dev").pairs(step)[40]
    matches = match_images(read_image(pair.image1), read_image(pair.image2))
    assert len(matches.x1) > 300
    found = find_fundamental(matches.x1, matches.x2, 0.01, method="peel")
    assert found.n_inliers > 0.9 * len(matches.x1)
    true = sampson_distances(pair.F, matches.x1, matches.x2)
    assert np.median(true[found.inlier_mask]) < 0.5
    assert np.median(true[~found.inlier_mask]) > 3.0
    assert found.median_sampson < 1.0
