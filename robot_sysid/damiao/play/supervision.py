"""What is watched while an arm moves; the first thing out of order stops the run."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from robot_sysid.damiao.exchange.session import NO_STATUS, Replies
from robot_sysid.damiao.exchange.settings import PlaySettings
from robot_sysid.damiao.protocol.codec import MitCommand
from robot_sysid.damiao.protocol.joints import DamiaoJoint
from robot_sysid.damiao.protocol.registers import ENABLED, describe
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array

# What an arm's joints do at most from one sample to the next, beside going on as they were.
_LEAST_JUMP, _TOP_ACCELERATION, _SPEED_DOUBT = 0.05, 200.0, 0.5
_STEPS = 2.0
# Cycles without an answer per unanswered command that is allowed.
_SILENT_CYCLES = 2


class Supervisor:
    """Checks every cycle's replies against the settings' limits.

    Args:
        joints: the motors, for the messages.
        settings: the limits.
        velocity_step: (n,) one quantisation step of each joint's velocity [rad/s].
    """

    def __init__(
        self, joints: Sequence[DamiaoJoint], settings: PlaySettings, velocity_step: Array
    ) -> None:
        self._joints, self._settings = joints, settings
        self._speed_limit = settings.max_speed_error + _STEPS * velocity_step
        self._torque_limit = np.array(settings.max_torque_error)
        self._last: tuple[Array, Array, Array] | None = None
        # Commands without an answer in time, and cycles without one, in a row.
        self.missed = np.zeros(len(joints), dtype=int)
        self.silent = np.zeros(len(joints), dtype=int)
        self.total_missed = np.zeros(len(joints), dtype=int)
        self.worst_tracking = np.zeros(len(joints))
        self.failed = np.zeros(len(joints), dtype=bool)

    def update(self, replies: Replies) -> None:
        """Count missed replies and note which motors no longer drive."""
        unanswered = replies.unanswered
        self.missed = np.where(replies.answered, 0, self.missed + unanswered)
        self.silent = np.where(replies.answered, 0, self.silent + 1)
        self.total_missed += unanswered
        status = replies.feedback.status
        self.failed |= (status != ENABLED) & (status != NO_STATUS)

    def check(self, replies: Replies, acted: MitCommand) -> None:
        """Raise HardwareAbort naming the first thing that is out of order.

        Args:
            replies: of this cycle, after ``update``.
            acted: the command in force when they were sampled.
        """
        feedback, answered = replies.feedback, replies.answered
        self._check_states(replies)
        self._check_jump(replies)
        for what, unit, value, wanted, limit in (
            ("off its path", "rad", feedback.position, acted.position, self._path_limit),
            ("off its speed", "rad/s", feedback.velocity, acted.velocity, self._speed_limit),
            ("off its torque", "N m", feedback.torque, acted.torque, self._torque_limit),
        ):
            error = np.where(answered, np.abs(value - wanted), 0.0)
            if unit == "rad":
                self.worst_tracking = np.maximum(self.worst_tracking, error)
            self._stop_where(error > limit, _off(what, unit, error, limit))

    @property
    def _path_limit(self) -> Array:
        return np.full(len(self._joints), self._settings.max_tracking_error)

    def _check_states(self, replies: Replies) -> None:
        feedback, limits = replies.feedback, self._settings
        self._stop_where(
            replies.answered & (feedback.status != ENABLED),
            lambda j: f"reports {describe(int(feedback.status[j]))}",
        )
        self._stop_where(
            (self.missed >= limits.max_missed)
            | (self.silent >= _SILENT_CYCLES * limits.max_missed),
            lambda j: f"did not answer in time for {self.silent[j]} cycles",
        )
        hot = np.maximum(feedback.temperature_mos, feedback.temperature_rotor)
        self._stop_where(
            replies.answered & (hot > limits.max_temperature),
            lambda j: f"is at {hot[j]} deg C, limit {limits.max_temperature:g}",
        )

    def _check_jump(self, replies: Replies) -> None:
        """Compare how far each joint came with how fast it says that it was."""
        now = replies.time, replies.feedback.position, replies.feedback.velocity
        before, self._last = self._last or now, now
        self._last = (
            np.where(replies.answered, now[0], before[0]),
            np.where(replies.answered, now[1], before[1]),
            np.where(replies.answered, now[2], before[2]),
        )
        passed = now[0] - before[0]
        way = 0.5 * (now[2] + before[2]) * passed
        jump = np.abs(now[1] - before[1] - way)
        allowed = _LEAST_JUMP + _SPEED_DOUBT * np.abs(way) + 0.5 * _TOP_ACCELERATION * passed**2
        self._stop_where(
            np.nan_to_num(jump) > np.nan_to_num(allowed, nan=np.inf),
            lambda j: (
                f"jumped by {jump[j]:.3f} rad between two samples: its encoder or its mounting "
                "is not sound"
            ),
        )

    def _stop_where(self, bad: NDArray[np.bool_], what: Callable[[int], str]) -> None:
        if np.any(bad):
            j = int(np.flatnonzero(bad)[0])
            raise HardwareAbort(f"{self._joints[j].label} {what(j)}")


def _off(what: str, unit: str, error: Array, limit: Array) -> Callable[[int], str]:
    return lambda j: f"is {error[j]:.3f} {unit} {what}, limit {limit[j]:g}"
