"""What is watched while an arm moves; the first thing out of order stops the run."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from robot_sysid.damiao.joints import DamiaoJoint
from robot_sysid.damiao.session import NO_STATUS, Replies
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.damiao.status import ENABLED, describe
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
