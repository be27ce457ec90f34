"""Arrays that were checked once and cannot be changed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError

Array = NDArray[np.float64]


def checked_array(value: Any, shape: tuple[int | None, ...], name: str) -> Array:
    """Return a read-only float view of ``value``, or raise InputError naming what is wrong.

    Args:
        value: anything numpy can turn into a float array.
        shape: expected length per axis; None accepts any length.
        name: how the array is called in the message.
    """
    array = np.asarray(value, dtype=np.float64).view()
    fits = array.ndim == len(shape) and all(
        want is None or want == got for want, got in zip(shape, array.shape)
    )
    if not fits:
        raise InputError(f"{name} has shape {array.shape}, expected {shape} (None = any length)")
    if not np.all(np.isfinite(array)):
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InputError(f"{name} is not finite at index {where}")
    array.flags.writeable = False
    return array
