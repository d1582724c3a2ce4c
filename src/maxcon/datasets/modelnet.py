"""ModelNet40 (Wu et al. 2015): two views of meshes, the made matches of the paper's section 4.2.

Points are spread evenly over the surface of a mesh; cameras, noise, outliers and all else that the paper leaves
open are those of `maxcon.datasets.two_view_scene`. The split is that of the data set: a mesh is for training or for
testing.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from maxcon.datasets.location import data_folder, required
from maxcon.datasets.two_view_scene import (
    NOISE,
    THRESHOLD,
    TwoViewScene,
    check_scene,
    into_unit_ball,
    view_points,
)

_OBTAIN = (
    "download ModelNet40.zip from the page of the Princeton ModelNet project (modelnet.cs.princeton.edu, "
    "for research use) and unpack it."
)
_LAYOUT = "ModelNet40/CLASS/{train,test}/NAME.off"

#: The header of an OFF file, whose counts some files of the archive glue to the word.
_GLUED = re.compile(rb"\A\s*OFF[ \t]*(?=[0-9])")


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    Attributes
    ----------
    name
        As in "bathtub_0001".
    vertices
        Shape (V, 3), in the unit of the file.
    faces
        Shape (M, 3): indices of vertices, at least one triangle with an area.
    """

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]


def modelnet_files(split: Literal["train", "test"], folder: str | Path | None = None) -> list[Path]:
    """Return the OFF files of a split, sorted by class and name.

    Parameters
    ----------
    split
        "train" or "test".
    folder
        The folder ModelNet40; None for the one in the folder of the data sets (see `maxcon.datasets.data_folder`).

    Raises
    ------
    ValueError
        If there is no such split.
    FileNotFoundError
        If the folder is absent or holds no such file; the message says how to obtain the data.
    """
    if split not in ("train", "test"):
        raise ValueError(f"split must be 'train' or 'test', but it is {split!r}")
    root = Path(folder) if folder is not None else data_folder() / "ModelNet40"
    files = sorted(required(root, "ModelNet40", _OBTAIN, _LAYOUT).glob(f"*/{split}/*.off"))
    if not files:
        raise FileNotFoundError(
            f"{root} holds no mesh for {split!r}. To obtain them: {_OBTAIN} Lay it out as {_LAYOUT}."
        )
    return files


def load_off(file: str | Path) -> Mesh:
    """Read an OFF file by trimesh; a header that is glued to the counts, as in the archive, is mended first.

    Raises
    ------
    ModuleNotFoundError
        If trimesh is not installed; the message says how to install it.
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no OFF file, or has no surface.
    """
    try:
        import trimesh  # noqa: PLC0415  (only meshes need it)
    except ImportError:
        raise ModuleNotFoundError("meshes need trimesh, which is not installed: pip install 'maxcon[data]'") from None
    path = Path(file)
    content = _GLUED.sub(b"OFF\n", path.read_bytes(), count=1)
    if not content.lstrip().startswith(b"OFF"):
        raise ValueError(f"{path} must be an OFF file, but its header is {content[:20]!r}")
    try:
        mesh: Any = trimesh.load(trimesh.util.wrap_as_stream(content), file_type="off", force="mesh", process=False)
        vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
        faces = np.ascontiguousarray(mesh.faces, dtype=np.int64)
    except (ValueError, IndexError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} must be an OFF file, but trimesh cannot read it: {error}") from error
    bad = len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all()
    if bad or not _areas(vertices, faces).sum() > 0:
        raise ValueError(f"{path} must hold a surface, but its {len(faces)} faces have no area or no vertices")
    return Mesh(path.stem, vertices, faces)


def surface_points_of(mesh: Mesh, n_points: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return random points, shape (N, 3), spread evenly over the surface of `mesh`, in its unit."""
    share = np.cumsum(_areas(mesh.vertices, mesh.faces))
    face = np.searchsorted(share, rng.random(n_points) * share[-1], side="right").clip(max=len(share) - 1)
    corner = mesh.vertices[mesh.faces[face]]
    u, v = rng.random((2, n_points, 1))
    beyond = u + v > 1.0  # the half of the parallelogram that is not the triangle, mirrored into it
    u, v = np.where(beyond, 1.0 - u, u), np.where(beyond, 1.0 - v, v)
    points: NDArray[np.float64] = corner[:, 0] + u * (corner[:, 1] - corner[:, 0]) + v * (corner[:, 2] - corner[:, 0])
    return points


def modelnet_two_view(
    mesh: Mesh,
    n_points: int,
    outlier_rate: float,
    rng: np.random.Generator,
    *,
    noise: float = NOISE,
    threshold: float = THRESHOLD,
) -> TwoViewScene:
    """Return the matches of two random views of `mesh`: the paper's N = 100, outlier rates 0.1 to 0.5, threshold 0.1.

    Parameters
    ----------
    mesh
        From `load_off`.
    n_points, outlier_rate, rng, noise, threshold
        As for `maxcon.datasets.synthetic_two_view`.

    Raises
    ------
    ValueError
        If a number is out of its range; the message names it.
    """
    check_scene(n_points, outlier_rate, noise, threshold)
    points = into_unit_ball(surface_points_of(mesh, n_points, rng))
    return view_points(points, outlier_rate, rng, noise=noise, threshold=threshold)


def _areas(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the area of every face, shape (M,)."""
    corner = vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    areas: NDArray[np.float64] = 0.5 * np.sqrt((normal**2).sum(axis=1))
    return areas
