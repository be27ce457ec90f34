"""What is watched while an arm moves; the first thing out of order stops the run."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from robot_sysid.damiao.play.session import NO_STATUS, Replies
from robot_sysid.damiao.play.settings import PlaySettings
from robot_sysid.damiao.protocol.joints import DamiaoJoint
from robot_sysid.damiao.protocol.registers import ENABLED, describe
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array


class Supervisor:
    """Checks every cycle's replies against the settings' limits.

    Args:
        joints: the motors, for the messages.
        settings: the limits.
    """

    def __init__(self, joints: Sequence[DamiaoJoint], settings: PlaySettings) -> None:
        self._joints, self._settings = joints, settings
        self.missed = np.zeros(len(joints), dtype=int)
        self.total_missed = np.zeros(len(joints), dtype=int)
        self.worst_tracking = np.zeros(len(joints))
        self.failed = np.zeros(len(joints), dtype=bool)

    def update(self, replies: Replies) -> None:
        """Count missed replies and note which motors no longer drive."""
        self.missed = np.where(replies.answered, 0, self.missed + 1)
        self.total_missed += ~replies.answered
        status = replies.feedback.status
        self.failed |= (status != ENABLED) & (status != NO_STATUS)

    @property
    def any_alive(self) -> bool:
        """Whether at least one motor answers and drives."""
        return bool(np.any(~self.failed & (self.missed < self._settings.max_missed)))

    def check(self, replies: Replies, expected: Array) -> None:
        """Raise HardwareAbort naming the first thing that is out of order.

        Args:
            replies: of this cycle, after ``update``.
            expected: (n,) positions commanded in the cycle before [rad].
        """
        feedback, limits = replies.feedback, self._settings
        self._stop_where(
            replies.answered & (feedback.status != ENABLED),
            lambda j: f"reports {describe(int(feedback.status[j]))}",
        )
        self._stop_where(
            self.missed >= limits.max_missed,
            lambda j: f"did not answer {self.missed[j]} times in a row",
        )
        hot = np.maximum(feedback.temperature_mos, feedback.temperature_rotor)
        self._stop_where(
            replies.answered & (hot > limits.max_temperature),
            lambda j: f"is at {hot[j]} deg C, limit {limits.max_temperature:g}",
        )
        error = np.where(replies.answered, np.abs(feedback.position - expected), 0.0)
        self.worst_tracking = np.maximum(self.worst_tracking, error)
        self._stop_where(
            error > limits.max_tracking_error,
            lambda j: f"is {error[j]:.3f} rad off its path, limit {limits.max_tracking_error:g}",
        )

    def _stop_where(self, bad: NDArray[np.bool_], what: Callable[[int], str]) -> None:
        if np.any(bad):
            j = int(np.flatnonzero(bad)[0])
            raise HardwareAbort(f"motor {self._joints[j].can_id} (joint {j}) {what(j)}")


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
        return (j, float(slope[j])) if excess[j] > _SLOPE_TOLERANCE else None
