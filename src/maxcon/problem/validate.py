"""Checks of what users pass in: each error names the argument, what it must be and what it was."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def check_array(value: ArrayLike, name: str, ndim: int) -> NDArray[np.float64]:
    """Return `value` as a C-contiguous float64 array that nobody else can change.

    Raises
    ------
    TypeError
        If `value` cannot be read as an array of real numbers.
    ValueError
        If it has not `ndim` dimensions, is empty, or holds NaN or infinite entries.
    """
    try:
        raw = np.asarray(value)
    except ValueError as error:  # ragged nested lists
        raise ValueError(f"{name} must be a regular array of numbers: {error}") from None
    if np.ma.is_masked(value):
        raise ValueError(f"{name} must have no masked entries; leave these points out")
    if raw.dtype.kind in "cmM":
        raise TypeError(f"{name} must hold real numbers, but its dtype is {raw.dtype}")
    if raw.dtype.kind not in "biuf":
        try:
            raw = raw.astype(np.float64)
        except (TypeError, ValueError, OverflowError):
            raise TypeError(f"{name} must hold real numbers, but its dtype is {raw.dtype}") from None
    if raw.ndim != ndim:
        raise ValueError(f"{name} must have {ndim} dimension{'s' * (ndim > 1)}, but its shape is {raw.shape}")
    array = np.array(raw, dtype=np.float64, order="C", copy=True)
    if array.size == 0:
        raise ValueError(f"{name} must not be empty, but its shape is {array.shape}")
    finite = np.isfinite(array)
    if not finite.all():
        where = tuple(int(i) for i in np.argwhere(~finite)[0])
        place = where[0] if ndim == 1 else where
        bad = int(array.size - np.count_nonzero(finite))
        raise ValueError(
            f"{name} must be finite, but {bad} of its {array.size} entries are not; "
            f"the first is {array[where]} at {name}[{str(place).strip('()')}]"
        )
    array.setflags(write=False)
    return array


def check_number(value: Any, name: str) -> float:
    """Return `value` as a float; TypeError if it is not one real number."""
    if isinstance(value, (bool, np.bool_, str, bytes)) or np.ndim(value) != 0:
        raise TypeError(f"{name} must be a number, but it is {value!r}")
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise TypeError(f"{name} must be a number, but it is {value!r}") from None


def check_time_limit(value: Any) -> None:
    """Raise TypeError or ValueError if `value` is not a positive number of seconds or None."""
    if value is not None and not check_number(value, "time_limit") > 0:
        raise ValueError(f"time_limit must be a positive number of seconds or None, but it is {value}")


def check_gap(value: Any) -> int:
    """Return the gap at which a search may stop; TypeError or ValueError if it is not a whole number of at least 0."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"gap must be a whole number, but it is {value!r}")
    if value < 0:
        raise ValueError(f"gap must be at least 0, but it is {value}")
    return int(value)


def check_callback(value: Any) -> None:
    """Raise TypeError if `value` is neither None nor callable."""
    if value is not None and not callable(value):
        raise TypeError(f"callback must be callable, but it is a {type(value).__name__}")


def check_threshold(value: Any) -> float:
    """Return the inlier threshold as a float.

    Raises
    ------
    TypeError
        If it is not a number.
    ValueError
        If it is zero, negative, NaN or infinite.
    """
    threshold = check_number(value, "threshold")
    if not (threshold > 0 and math.isfinite(threshold)):
        raise ValueError(f"threshold must be a positive finite number, but it is {threshold}")
    return threshold


def check_model(value: ArrayLike, n_params: int, name: str = "model") -> NDArray[np.float64]:
    """Return `value` as a model of `n_params` parameters; ValueError or TypeError otherwise."""
    model = check_array(value, name, 1)
    if model.shape != (n_params,):
        raise ValueError(f"{name} must have shape ({n_params},), but its shape is {model.shape}")
    return model


def check_indices(value: ArrayLike | None, n_points: int, name: str = "subset") -> NDArray[np.bool_]:
    """Return a boolean mask over the points from a mask, from indices, or (None) of all points.

    Raises
    ------
    TypeError
        If `value` is neither boolean nor integer.
    ValueError
        If it is empty, has the wrong shape, names a point twice or one that does not exist.
    """
    if value is None:
        return np.ones(n_points, dtype=np.bool_)
    array = np.asarray(value)
    if array.ndim != 1:
        raise ValueError(f"{name} must have 1 dimension, but its shape is {array.shape}")
    if array.dtype.kind == "b":
        if array.shape != (n_points,):
            raise ValueError(f"{name} must have shape ({n_points},) as a boolean mask, but its shape is {array.shape}")
        mask = np.array(array, dtype=np.bool_)
    elif array.size == 0:
        mask = np.zeros(n_points, dtype=np.bool_)
    elif array.dtype.kind in "iu":
        if array.min() < 0 or array.max() >= n_points:
            raise ValueError(
                f"{name} must hold indices from 0 to {n_points - 1}, but it spans {array.min()} to {array.max()}"
            )
        mask = np.zeros(n_points, dtype=np.bool_)
        mask[array] = True
        if int(mask.sum()) != array.size:
            raise ValueError(f"{name} must name each point once, but it has {array.size - int(mask.sum())} repeats")
    else:
        raise TypeError(f"{name} must be a boolean mask or integer indices, but its dtype is {array.dtype}")
    if not mask.any():
        raise ValueError(f"{name} must hold at least one point, but it is empty")
    return mask
