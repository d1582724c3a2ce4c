import numpy as np
import pytest

from maxcon.datasets import load_off, modelnet_files, modelnet_two_view
from maxcon.datasets.modelnet import Mesh, surface_points_of
from maxcon.datasets.two_view_scene import normalised_residuals
from real_data import real_data

#: A tetrahedron, and a face with four corners.
BODY = "4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n3 0 1 3\n3 0 2 3\n3 1 2 3\n"


def triangle(corners):
    return Mesh("triangle", np.array(corners, dtype=float), np.array([[0, 1, 2]]))


@pytest.mark.parametrize("header", ["OFF\n", "OFF", "OFF ", "  OFF\t", "OFF\r\n"])
def test_headers_that_are_glued_to_the_counts_load(header, tmp_path):
    pytest.importorskip("trimesh")
    file = tmp_path / "four.off"
    file.write_bytes((header + BODY).encode())
    mesh = load_off(file)
    assert mesh.name == "four"
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "must be an OFF file, but its header is b''"),
        (b"PLY\n1 2 3", "must be an OFF file, but its header is b'PLY"),
        (b"OFF\n4 1 0\n0 0 0\n", "must be an OFF file, but trimesh cannot read it"),
        (b"OFF\n3 1 0\n0 0 0\n1 1 1\n2 2 2\n3 0 1 2\n", "must hold a surface"),
        (b"OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n", "must hold a surface"),
        (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "must hold a surface|cannot read it"),
    ],
)
def test_damaged_files_are_refused(content, message, tmp_path):
    pytest.importorskip("trimesh")
    file = tmp_path / "bad.off"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        load_off(file)


def test_points_are_spread_evenly_over_the_surface():
    """Two triangles of areas 1 : 3 get points 1 : 3, and within a triangle the mean is its centroid."""
    mesh = Mesh(
        "two",
        np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 5], [3, 0, 5], [0, 1, 5]]),
        np.array([[0, 1, 2], [3, 4, 5]]),
    )
    points = surface_points_of(mesh, 40_000, np.random.default_rng(0))
    above = points[:, 2] == 5.0
    assert np.mean(above) == pytest.approx(0.75, abs=0.01)
    np.testing.assert_allclose(points[~above].mean(axis=0), [1 / 3, 1 / 3, 0], atol=0.01)
    np.testing.assert_allclose(points[above].mean(axis=0), [1, 1 / 3, 5], atol=0.03)
    x, y, _ = points[~above].T
    assert (x >= 0).all()
    assert (y >= 0).all()
    assert (x + y <= 1 + 1e-12).all()
    # uniform: a triangle of half the sides at a corner has a quarter of the points
    assert np.mean(x + y <= 0.5) == pytest.approx(0.25, abs=0.02)


def test_faces_without_area_get_no_points():
    mesh = Mesh("flat", np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 0, 1], [0, 1, 2], [1, 1, 1]]))
    points = surface_points_of(mesh, 500, np.random.default_rng(1))
    assert (points[:, 1] > 0).mean() > 0.99


def test_absent_data_get_an_error_that_says_how_to_obtain_them(tmp_path, monkeypatch):
    monkeypatch.setenv("MAXCON_DATA", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"ModelNet40 is not at .*download ModelNet40.zip .*MAXCON_DATA"):
        modelnet_files("train")
    (tmp_path / "ModelNet40" / "bed" / "test").mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match="holds no mesh for 'train'"):
        modelnet_files("train")
    (tmp_path / "ModelNet40" / "bed" / "test" / "bed_1.off").touch()
    assert [file.name for file in modelnet_files("test")] == ["bed_1.off"]
    with pytest.raises(ValueError, match="split must be 'train' or 'test', but it is 'all'"):
        modelnet_files("all")


def test_two_views_of_a_mesh():
    cube = np.array([[x, y, z] for x in (0.0, 9.0) for y in (0.0, 5.0) for z in (0.0, 7.0)])
    faces = [(0, 1, 3), (0, 3, 2), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4), (2, 3, 7), (2, 7, 6)]
    mesh = Mesh("box", cube, np.array(faces))
    rng = np.random.default_rng(2)
    for rate in (0.1, 0.3, 0.5):
        scene = modelnet_two_view(mesh, 100, rate, rng)
        residuals = normalised_residuals(scene.F, scene.x1, scene.x2)
        np.testing.assert_array_equal(residuals <= 0.1, scene.inlier_mask)
        assert scene.inlier_mask.sum() == 100 - 100 * rate
    first, second = (modelnet_two_view(mesh, 50, 0.2, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(first.x2, second.x2)
    with pytest.raises(ValueError, match="outlier_rate must be between 0 and 1"):
        modelnet_two_view(mesh, 50, 2.0, rng)


@pytest.mark.parametrize("split", ["train", "test"])
def test_the_meshes_of_modelnet_load(split):
    pytest.importorskip("trimesh")
    real_data("ModelNet40")
    files = modelnet_files(split)
    assert all(file.parent.name == split for file in files)
    for file in files:
        text = file.read_text().replace("OFF", "", 1).split()
        mesh = load_off(file)
        assert mesh.vertices.shape == (int(text[0]), 3)
        assert len(mesh.faces) >= int(text[1])  # trimesh makes triangles
        np.testing.assert_allclose(mesh.vertices[0], [float(word) for word in text[3:6]])
        scene = modelnet_two_view(mesh, 100, 0.5, np.random.default_rng(0))
        assert scene.inlier_mask.sum() == 50


def test_no_mesh_is_in_both_splits():
    real_data("ModelNet40")
    train, test = ({file.stem for file in modelnet_files(split)} for split in ("train", "test"))
    assert train
    assert test
    assert not train & test
