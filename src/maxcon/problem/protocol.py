"""The contract of a problem: what every search may ask of the thing that it fits."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray


@runtime_checkable
class Problem(Protocol):
    """Points, a model with `n_params` parameters and one residual a point; frozen once made."""

    @property
    def n_points(self) -> int:
        """How many points there are (N)."""
        ...

    @property
    def n_params(self) -> int:
        """How many parameters a model has (d)."""
        ...

    @property
    def scale(self) -> float:
        """The size of the numbers that a residual is a difference of; ``max|b|`` for linear residuals."""
        ...

    def residuals(self, model: ArrayLike) -> NDArray[np.float64]:
        """Return the residual of every point under `model`, shape (N,), all >= 0."""
        ...
