"""Results are shared, and their fields belong together: nobody changes their arrays."""

from __future__ import annotations

import numpy as np


def freeze_arrays(result: object) -> None:
    """Make the arrays among the fields of a result read-only: to change one, copy it."""
    for value in vars(result).values():
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
