"""Where data that the package does not bring lie on this machine, and what to do where they do not."""

from __future__ import annotations

import os
from pathlib import Path

#: The environment variable that names the folder of the data sets.
VARIABLE = "MAXCON_DATA"

#: Where the folder is looked for otherwise, from the root of a checkout.
_BESIDE_CHECKOUT = ("..", "shared", "data")


def data_folder() -> Path:
    """Return the folder of the data sets, whether or not it exists.

    It is what the environment variable MAXCON_DATA names; without it, ``../shared/data`` seen from the root of the
    checkout that holds this package, or from the working folder where the package is installed elsewhere.
    """
    named = os.environ.get(VARIABLE)
    if named:
        return Path(named).expanduser()
    root = Path(__file__).resolve().parents[3]  # of src/maxcon/datasets/location.py
    if not (root / "pyproject.toml").is_file():
        root = Path.cwd()
    return Path(os.path.normpath(root.joinpath(*_BESIDE_CHECKOUT)))


def required(folder: Path, what: str, obtain: str, layout: str) -> Path:
    """Return `folder`, which holds `what`, if it exists.

    Raises
    ------
    FileNotFoundError
        If it does not; the message says where it was looked for, how to obtain the data and how they lie.
    """
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{what} is not at {folder}. To obtain it: {obtain} Lay it out as {layout}, and either pass that folder or "
            f"set {VARIABLE} to the folder that holds it."
        )
    return folder
