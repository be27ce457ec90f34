"""Arrays of records: checked once, then read-only."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError

Array = NDArray[np.float64]
"""Array of floats, of any shape."""


def checked_array(value: Any, shape: tuple[int | None, ...], name: str) -> Array:
    """Return a read-only float array of a shape, a view of ``value`` if that is a float array.

    Args:
        value: an array, or anything that numpy converts to one.
        shape: expected length of each axis; None for any length.
        name: names the value in the error.

    Raises:
        InputError: the shape differs, or an element is not finite.
    """
    array = np.asarray(value, dtype=np.float64).view()
    fits = array.ndim == len(shape)
    for expected, length in zip(shape, array.shape):
        fits &= expected in (None, length)
    if not fits:
        raise InputError(
            f"{name} has shape {array.shape}, expected {shape} (None = any length)"
        )
    is_finite = np.isfinite(array)
    if not np.all(is_finite):
        index = tuple(np.argwhere(~is_finite)[0].tolist())
        raise InputError(f"{name} is not finite at index {index}")
    array.flags.writeable = False
    return array


def check_arrays(record: Any, **shapes: tuple[int | None, ...]) -> None:
    """Replace fields of a frozen record by read-only float arrays, see ``checked_array``.

    Args:
        record: the record, which is changed in place.
        shapes: name of a field to the expected length of each axis; None for any length.

    Raises:
        InputError: a shape differs, or an element is not finite.
    """
    for name, shape in shapes.items():
        array = checked_array(getattr(record, name), shape, name)
        object.__setattr__(record, name, array)
