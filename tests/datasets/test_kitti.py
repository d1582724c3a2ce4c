import numpy as np
import pytest

from maxcon.datasets import kitti_drive
from real_data import real_data

CALIBRATION = "P0: 700 0 600 0 0 700 180 0 0 0 1 0\nP1: 700 0 600 -386 0 700 180 0 0 0 1 0\n"


@pytest.fixture
def drive(tmp_path):
    """Five empty frames of a car that moves one metre ahead a frame, and stands still at the end."""
    images = tmp_path / "sequences" / "07" / "image_0"
    images.mkdir(parents=True)
    for frame in range(5):
        (images / f"{frame:06d}.png").touch()
    (tmp_path / "sequences" / "07" / "calib.txt").write_text(CALIBRATION)
    (tmp_path / "poses").mkdir()
    (tmp_path / "poses" / "07.txt").write_text(
        "".join(f"1 0 0 0 0 1 0 0 0 0 1 {min(frame, 3)}\n" for frame in range(5))
    )
    return tmp_path


def test_pairs_at_a_step(drive):
    opened = kitti_drive("07", folder=drive)
    assert [(pair.first, pair.second) for pair in opened.pairs()] == [(0, 1), (1, 2), (2, 3), (3, 4)]
    assert [(pair.first, pair.second) for pair in opened.pairs(3)] == [(0, 3), (1, 4)]
    assert opened.pairs(3)[1].image2.name == "000004.png"
    for step in (0, 5, True, 1.5):
        with pytest.raises(ValueError, match="step must be a whole number from 1 to 4"):
            opened.pairs(step)


def test_the_fundamental_matrix_of_a_car_that_goes_straight_ahead(drive):
    """Both epipoles are the principal point, so F is that of a turn about it."""
    opened = kitti_drive("07", folder=drive)
    F = opened.pairs()[0].F
    centre = np.array([600.0, 180.0, 1.0])
    np.testing.assert_allclose(F @ centre, 0.0, atol=1e-12)
    np.testing.assert_allclose(F.T @ centre, 0.0, atol=1e-12)
    X = np.array([2.0, 1.0, 12.0])
    x1, x2 = (opened.camera(frame) @ [*X, 1.0] for frame in (0, 1))
    assert abs(x2 @ F @ x1) < 1e-9
    assert opened.pairs()[3].F is None  # stood still


def test_a_drive_without_poses_has_pairs_all_the_same(drive):
    (drive / "poses" / "07.txt").unlink()
    opened = kitti_drive("07", folder=drive)
    assert opened.pairs()[0].F is None
    with pytest.raises(ValueError, match="drive '07' has no poses"):
        opened.camera(0)


def test_the_second_camera_has_its_own_projection(drive):
    (drive / "sequences" / "07" / "image_0").rename(drive / "sequences" / "07" / "image_1")
    assert kitti_drive("07", folder=drive, camera=1).P[0, 3] == -386.0
    with pytest.raises(FileNotFoundError, match="image_0 holds 0 PNG images"):
        kitti_drive("07", folder=drive)
    with pytest.raises(ValueError, match="camera must be 0, 1, 2 or 3, but it is 5"):
        kitti_drive("07", folder=drive, camera=5)


def test_absent_and_damaged_files_are_told(drive, tmp_path, monkeypatch):
    monkeypatch.setenv("MAXCON_DATA", str(tmp_path / "nowhere"))
    message = r"the KITTI drive '00' is not at .*KITTI visual odometry benchmark .*Lay it out as kitti/sequences"
    with pytest.raises(FileNotFoundError, match=message):
        kitti_drive("00")
    (drive / "poses" / "07.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 4)
    with pytest.raises(ValueError, match="must have a pose for each of the 5 frames, but it has 4 rows"):
        kitti_drive("07", folder=drive)
    (drive / "poses" / "07.txt").write_text("1 0 0 0 0 1 0 0 0 0 1\n" * 5)
    with pytest.raises(ValueError, match=r"row 1 must hold the 12 numbers of a 3x4 matrix"):
        kitti_drive("07", folder=drive)
    calibration = drive / "sequences" / "07" / "calib.txt"
    calibration.write_text("P1: 1 2 3\n")
    with pytest.raises(ValueError, match="must have a row P0, but it has none"):
        kitti_drive("07", folder=drive)
    calibration.unlink()
    with pytest.raises(FileNotFoundError, match=r"calib\.txt is absent"):
        kitti_drive("07", folder=drive)


def test_the_drive_of_the_project():
    real_data("kitti", "sequences", "dev")
    opened = kitti_drive("dev")
    assert len(opened.images) == 51
    assert len(opened.pairs(1)) == 50
    assert len(opened.pairs(3)) == 48
    assert opened.P[0, 0] == pytest.approx(718.856)
    moved = np.linalg.norm(np.diff(opened.poses[:, :, 3], axis=0), axis=1)
    assert 0.1 < moved.min() < moved.max() < 3.0
