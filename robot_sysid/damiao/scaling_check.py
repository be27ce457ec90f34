"""Does the velocity channel integrate to the position channel?

Both are scaled by numbers stored in the motor. If VMAX is wrong, every velocity is wrong by the
same factor and nothing else looks odd. So the slope of position change against integrated velocity,
over short windows, has to be 1. How well it can be known depends on the scatter and on the steps of
the velocity channel: an error of up to half a step, the same all through a window, is allowed for.
"""

from __future__ import annotations

import numpy as np

from robot_sysid.records import Array

_WINDOW = 0.2
_LEAST_WINDOWS = 10


class VelocityScalingCheck:
    """Collects (integrated velocity, position change) pairs per joint.

    Args:
        velocity_step: (n,) one quantisation step of each joint's velocity [rad/s].
        tolerance: how far the slope may be from 1.
    """

    def __init__(self, velocity_step: Array, tolerance: float = 0.03) -> None:
        n_joints = len(velocity_step)
        self._tolerance = tolerance
        self._rounding = 0.5 * velocity_step * _WINDOW
        self._last: tuple[Array, Array, Array] | None = None
        self._begin = np.zeros((2, n_joints))
        self._integral = np.zeros(n_joints)
        # Per joint: count and sums of x, y, xx, xy, yy.
        self._sums = np.zeros((6, n_joints))

    def add(self, time: Array, q: Array, qd: Array) -> None:
        """Add one sample per joint; NaN where a joint did not answer.

        Args:
            time: (n,) when each joint was sampled [s].
            q, qd: (n,) positions and velocities [rad, rad/s].
        """
        fresh = np.isfinite(time) & np.isfinite(q)
        if self._last is None:
            if np.all(fresh):
                self._last = time, q, qd
                self._begin = np.stack([time, q])
            return
        t0, q0, v0 = self._last
        self._integral += np.where(fresh, 0.5 * (qd + v0) * (time - t0), 0.0)
        self._last = (
            np.where(fresh, time, t0),
            np.where(fresh, q, q0),
            np.where(fresh, qd, v0),
        )
        self._close_windows(fresh & (time - self._begin[0] >= _WINDOW))

    def _close_windows(self, full: Array) -> None:
        if self._last is None or not np.any(full):
            return
        x = np.where(full, self._integral, 0.0)
        y = np.where(full, self._last[1] - self._begin[1], 0.0)
        self._sums += np.stack([full.astype(float), x, y, x * x, x * y, y * y])
        self._integral = np.where(full, 0.0, self._integral)
        self._begin = np.where(full, np.stack(self._last[:2]), self._begin)

    def slopes(self) -> tuple[Array, Array]:
        """Return (slope (n,), how far off it may be (n,)); 1 and infinity where too little moved.

        The second is three standard errors plus the largest effect of rounded velocities.
        """
        count, x, y, xx, xy, yy = self._sums
        n = np.maximum(count, 1.0)
        cxx, cxy, cyy = xx - x * x / n, xy - x * y / n, yy - y * y / n
        spread = np.sqrt(np.maximum(cxx, 0.0) / n)
        moved = (count >= _LEAST_WINDOWS) & (spread > self._rounding)
        safe = np.where(moved, cxx, 1.0)
        slope = np.where(moved, cxy / safe, 1.0)
        residual = np.maximum(cyy - slope * cxy, 0.0) / np.maximum(count - 2.0, 1.0)
        doubt = 3.0 * np.sqrt(residual / safe) + self._rounding / np.where(moved, spread, 1.0)
        return slope, np.where(moved, doubt, np.inf)

    def worst(self) -> tuple[int, float] | None:
        """Return (joint, slope) of a joint whose slope is surely off, or None."""
        slope, doubt = self.slopes()
        excess = np.abs(slope - 1.0) - doubt
        j = int(np.argmax(excess))
        return (j, float(slope[j])) if excess[j] > self._tolerance else None
