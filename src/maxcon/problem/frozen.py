"""Results are shared, and their fields belong together: nobody changes their arrays, nor those of a copy."""

from __future__ import annotations

from typing import Any

import numpy as np


class ReadOnlyArrays:
    """A dataclass that makes the arrays among its fields read-only: to change one, copy it.

    A pickle and a deep copy bring arrays back writeable; they are frozen again.
    """

    def __post_init__(self) -> None:
        self._freeze_arrays()

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._freeze_arrays()

    def _freeze_arrays(self) -> None:
        for value in vars(self).values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
