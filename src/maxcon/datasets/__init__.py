"""Data to fit: classic tables, made scenes in two views, and loaders for the real data of the paper."""

from maxcon.datasets.classic import TABLES, Table, belgian_calls, cyg_ob1, load_table
from maxcon.datasets.kitti import FramePair, KittiDrive, kitti_drive
from maxcon.datasets.location import data_folder
from maxcon.datasets.matches import MatchTable, load_mat, load_points, two_view_folder
from maxcon.datasets.modelnet import Mesh, load_off, modelnet_files, modelnet_two_view
from maxcon.datasets.two_view_scene import TwoViewScene, synthetic_two_view

__all__ = [
    "TABLES",
    "FramePair",
    "KittiDrive",
    "MatchTable",
    "Mesh",
    "Table",
    "TwoViewScene",
    "belgian_calls",
    "cyg_ob1",
    "data_folder",
    "kitti_drive",
    "load_mat",
    "load_off",
    "load_points",
    "load_table",
    "modelnet_files",
    "modelnet_two_view",
    "synthetic_two_view",
    "two_view_folder",
]
