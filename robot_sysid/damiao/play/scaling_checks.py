"""Do the numbers that a motor sends mean what its registers say?

Positions, velocities and torques are scaled by numbers stored in the motor. If one is wrong, every
value is wrong by the same factor and nothing else seems odd.
"""

from __future__ import annotations

import numpy as np

from robot_sysid.records import Array

_WINDOW = 0.2
_LEAST_WINDOWS = 10
# How far the slope may be from 1.
_SLOPE_TOLERANCE = 0.03


class VelocityScalingCheck:
    """Tells whether the velocity channel integrates to the position channel.

    Both are scaled by numbers stored in the motor. If VMAX is wrong, every velocity is wrong by the
    same factor and nothing else seems odd. So the slope of position change against integrated
    velocity, over short windows, has to be 1. How well it can be known depends on the scatter and
    on the steps of the velocity channel: an error of up to half a step, the same all through a
    window, is allowed for.

    Args:
        velocity_step: (n,) one quantisation step of each joint's velocity [rad/s].
    """

    def __init__(self, velocity_step: Array) -> None:
        n_joints = len(velocity_step)
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
        self._last = (np.where(fresh, time, t0), np.where(fresh, q, q0), np.where(fresh, qd, v0))
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
        return (j, float(slope[j])) if excess[j] > _SLOPE_TOLERANCE else None


_ENOUGH_SAMPLES = 25
# Torque is an estimate from the current; but both directions use the same constant.
_RATIO_TOLERANCE = 0.15
_SLOW = 0.1


class TorqueScalingCheck:
    """Tells whether motors report the torque they were told to make.

    A motor makes kp (p - q) + kd (v - qd) + t and reports what it makes. Both numbers are known in
    each cycle, so their ratio is; a motor whose TMAX is another than its register says, or that
    counts before its gear, shows by it, and so would every mass identified from it.

    Args:
        torque_step: (n,) one quantisation step of each joint's torque [N m].
        peak: (n,) what each motor can deliver; beyond it a motor does not do as told [N m].
    """

    def __init__(self, torque_step: Array, peak: Array) -> None:
        self._peak, self._doubt = 0.9 * peak, np.maximum(4.0 * torque_step, 0.005 * peak)
        # Per joint: count and sums of xx, xy.
        self._sums = np.zeros((3, len(peak)))

    def add(self, told: Array, measured: Array, qd: Array) -> None:
        """Add one sample per joint; NaN where a joint did not answer.

        Args:
            told, measured: (n,) torques [N m].
            qd: (n,) velocities [rad/s]; samples of a joint that moves fast are left out, because
                a velocity that is wrong or late would make ``told`` wrong.
        """
        slow = np.abs(qd) < _SLOW
        known = np.isfinite(measured) & (np.abs(told) < self._peak) & slow
        x, y = np.where(known, told, 0.0), np.where(known, measured, 0.0)
        self._sums += np.stack([known.astype(float), x * x, x * y])

    def worst(self) -> tuple[int, float] | None:
        """Return (joint, ratio) of a joint that surely reports another torque, or None.

        The doubt is what rounding makes of the size of the torques seen so far.
        """
        count, xx, xy = self._sums
        size = np.sqrt(xx / np.maximum(count, 1.0))
        seen = (count >= _ENOUGH_SAMPLES) & (size > 2.0 * self._doubt)
        ratio = np.where(seen, xy / np.where(seen, xx, 1.0), 1.0)
        excess = np.abs(ratio - 1.0) - np.where(seen, self._doubt / np.maximum(size, 1e-9), np.inf)
        j = int(np.argmax(excess))
        return (j, float(ratio[j])) if excess[j] > _RATIO_TOLERANCE else None
