"""Non-zero entries of the regressor, written by ``regressor.derived_source``."""

from __future__ import annotations

from typing import Any

# fmt: off
PLACES = (
    (0, 2), (0, 3), (0, 4), (0, 5), (0, 6), (0, 7), (0, 8), (0, 9), (1, 1), (1, 3), (1, 4), (1, 5),
    (1, 6), (1, 7), (1, 8), (1, 9), (2, 1), (2, 2), (2, 4), (2, 5), (2, 6), (2, 7), (2, 8), (2, 9),
    (3, 0), (3, 1), (3, 2), (3, 3), (4, 0), (4, 1), (4, 2), (4, 3), (5, 0), (5, 1), (5, 2), (5, 3),
)
"""Row and column of each."""


def entries(
    wx: Any, wy: Any, wz: Any, vx: Any, vy: Any, vz: Any, awx: Any, awy: Any, awz: Any, avx: Any,
    avy: Any, avz: Any,
) -> tuple[Any, ...]:
    """Return their values for a twist [omega, v] and an acceleration."""
    x0 = avz - vx*wy + vy*wx
    x1 = avy + vx*wz - vz*wx
    x2 = wx*wz
    x3 = -x2
    x4 = awy + x3
    x5 = wx*wy
    x6 = awz + x5
    x7 = wy*wz
    x8 = -x7
    x9 = wy**2
    x10 = wz**2
    x11 = -x10
    x12 = avx - vy*wz + vz*wy
    x13 = awx + x7
    x14 = wx**2
    x15 = -x5
    x16 = awz + x15
    x17 = awx + x8
    x18 = awy + x2
    return (
        x0, -x1, awx, x4, x6, x8, x11 + x9, x7, -x0, x12, x2, x13, -x11 - x14, awy, x16, x3, x1,
        -x12, x15, x14 - x9, x17, x5, x18, awz, x12, -x10 - x9, -x16, x18, x1, x6, -x10 - x14, -x17,
        x0, -x4, x13, -x14 - x9,
    )
