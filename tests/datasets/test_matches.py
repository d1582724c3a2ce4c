import numpy as np
import pytest
from scipy.io import savemat

from maxcon.datasets import load_mat, load_points, two_view_folder
from maxcon.datasets.cameras import hartley_transform
from real_data import real_data


def test_the_two_kinds_of_tables(tmp_path):
    file = tmp_path / "small_pts.txt"
    file.write_text("1 2 1 3 4 1 0\n5 6 1 7 8 1 2\n")
    table = load_points(file)
    assert table.name == "small_pts"
    np.testing.assert_array_equal(table.x1, [[1, 2], [5, 6]])
    np.testing.assert_array_equal(table.x2, [[3, 4], [7, 8]])
    np.testing.assert_array_equal(table.labels, [0, 2])
    file.write_text("1 2 3 4 .5 .6 MSER SIFT 1\n\n")
    table = load_points(file)
    np.testing.assert_array_equal(table.x2, [[3, 4]])
    np.testing.assert_array_equal(table.labels, [1])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("1 2 3\n", "line 1 must be 'x1 y1 1 x2 y2 1 label' or .*, but it is '1 2 3'"),
        ("1 2 5 3 4 1 0\n", "line 1 must be"),
        ("1 2 1 nan 4 1 0\n", "line 1 must be"),
        ("1 2 1 3 4 1 0.5\n", "line 1 must be"),
        ("1 2 1 3 4 1 0\na b c d e f g\n", "line 2 must be"),
        ("\n", "must hold at least one match"),
    ],
)
def test_other_tables_are_refused(content, message, tmp_path):
    file = tmp_path / "bad.txt"
    file.write_text(content)
    with pytest.raises(ValueError, match=message):
        load_points(file)


def test_matlab_files(tmp_path):
    file = tmp_path / "pair.mat"
    x1, x2 = np.arange(20.0).reshape(10, 2), np.arange(20.0, 40.0).reshape(10, 2)
    X1 = np.column_stack([2 * x1, np.full(10, 2.0)]).T  # homogeneous, of another scale
    X2 = np.column_stack([x2, np.ones(10)]).T
    colours = np.zeros((4, 5, 3))
    colours[1, 2] = (0.0, 0.5, 1.0)
    savemat(file, {"data": {"matches": {"X1": X1, "X2": X2, "im1": colours, "im2": 255.0 * colours}}})
    table = load_mat(file)
    np.testing.assert_allclose(table.x1, x1)
    np.testing.assert_allclose(table.x2, x2)
    for image in (table.image1, table.image2):
        assert image.shape == (4, 5)
        assert image.dtype == np.uint8
        assert image[1, 2] == 128
    assert table.labels is None
    savemat(file, {"data": {"matches": {"X1": X1, "X2": X2}}})
    assert load_mat(file).image1 is None
    savemat(file, {"data": {"matches": {"X1": X1, "X2": X2[:, :9]}}})
    with pytest.raises(ValueError, match="must hold as many points in X2 as in X1, 10, but it holds 9"):
        load_mat(file)
    savemat(file, {"data": {"matches": {"X1": X1[:2], "X2": X2}}})
    with pytest.raises(ValueError, match="X1 must be finite homogeneous points"):
        load_mat(file)
    savemat(file, {"other": 1})
    with pytest.raises(ValueError, match=r"must hold a struct 'data' with 'matches\.X1'"):
        load_mat(file)
    for content in (b"", b"no matlab file, by a long way " * 10):
        file.write_bytes(content)
        with pytest.raises(ValueError, match="must be a MATLAB 5 file"):
            load_mat(file)
    with pytest.raises(FileNotFoundError):
        load_mat(tmp_path / "none.mat")


def test_absent_data_get_an_error_that_says_how_to_obtain_them(tmp_path, monkeypatch):
    monkeypatch.setenv("MAXCON_DATA", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"published matches is not at .*AdelaideRMF .*Lay it out as two_view/"):
        two_view_folder()


def test_the_pair_of_the_tree_search_authors_has_hartleys_normalisation():
    from scipy.io import loadmat  # noqa: PLC0415

    file = real_data("two_view", "mat", "KITTI_417_420.mat")
    table = load_mat(file)
    data = loadmat(file, squeeze_me=True, struct_as_record=False)["data"]
    assert table.x1.shape == (385, 2)
    assert table.image1.shape == (376, 1241)
    np.testing.assert_allclose(hartley_transform(table.x1), data.T1, atol=1e-12)
    np.testing.assert_allclose(hartley_transform(table.x2), data.T2, atol=1e-12)


def test_all_published_tables_load():
    files = sorted(real_data("two_view").glob("*/*_pts.txt"))
    assert len(files) >= 30
    for file in files:
        table = load_points(file)
        assert table.x1.shape == table.x2.shape == (len(table.labels), 2)
        assert len(table.labels) > 8
        assert table.labels.min() >= 0
    barrsmith = load_points(real_data("two_view", "fundamental", "barrsmith_pts.txt"))
    np.testing.assert_allclose(barrsmith.x1[0], [10.483, 556.29])
    np.testing.assert_allclose(barrsmith.x2[0], [114.17, 554.73])
    assert set(barrsmith.labels) >= {0, 1, 2}
