"""Health of the motors on a bus: answers, ids, other programs, faults and temperatures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robot_sysid.damiao.joints import DamiaoJoint
from robot_sysid.damiao.protocol import ENABLED, status_text
from robot_sysid.damiao.safety.plausibility import NO_STATUS, Mask, Replies
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.errors import HardwareAbort

# Answers or commands too many, a decaying count, that damaged frames do not explain.
_FEW = 2.5


class BusHealth:
    """Counts what goes wrong on the bus of n joints.

    Args:
        joints: joints of the arm, base to terminal.
        settings: settings of the run.

    Attributes:
        silent: (n,) number of cycles in a row without an answer.
        total_missed: (n,) number of all commands without an answer.
        failed: (n,) whether the motor reported that it does not drive any more.
    """

    def __init__(self, joints: Sequence[DamiaoJoint], settings: PlaySettings) -> None:
        self._joints = joints
        self._settings = settings
        n_joints = len(joints)
        # Number of commands in a row without an answer, of cycles, and of doubted answers.
        self._missed, self.silent, self._doubted = np.zeros((3, n_joints), int)
        self.total_missed = np.zeros(n_joints, int)
        self._surplus, self._foreign = np.zeros((2, n_joints))
        self.failed = np.zeros(n_joints, bool)

    def update(self, replies: Replies) -> None:
        """Count missing, doubted and surplus answers, and foreign commands, of a cycle's replies.

        A motor that reports a fault is noted in ``failed``.
        """
        unanswered = replies.requested & ~replies.answered
        doubted = self._doubted + replies.doubted
        counts = [self._missed + unanswered, self.silent + 1, doubted]
        self._missed, self.silent, self._doubted = np.where(replies.answered, 0, counts)
        self.total_missed += unanswered
        # Counts decay: a single wrong one is a damaged frame.
        self._surplus = 0.9 * self._surplus + replies.surplus
        self._foreign = 0.9 * self._foreign + replies.foreign
        status = replies.feedback.status
        is_faulty = (status != ENABLED) & (status != NO_STATUS)
        # Where two motors answer on one id, the status may be the other motor's.
        is_double = is_faulty & (self._surplus > 1.0)
        self._surplus = np.where(is_double, np.inf, self._surplus)
        self.failed |= is_faulty & ~is_double

    def check(self, replies: Replies) -> None:
        """Raise HardwareAbort for the first fault of a cycle; call ``update`` before."""
        settings = self._settings
        feedback = replies.feedback
        hot = feedback.temperature
        # A motor whose answer is missing is sent nothing for four cycles, see ``session.PAUSE``, so
        # commands alone would count too slowly.
        is_silent = self._missed >= settings.max_missed
        is_silent |= self.silent >= 2 * settings.max_missed
        is_doubted = is_silent & (self._doubted >= settings.max_missed)
        faults: tuple[tuple[Mask, str], ...] = (
            (
                self._foreign > _FEW,
                "gets commands of another program: end it; one master moves an arm",
            ),
            (
                self._surplus > _FEW,
                "answers more often than it is asked: a second motor has its id, or another "
                "program commands it",
            ),
            (replies.answered & (feedback.status != ENABLED), "reports {status}"),
            (
                is_doubted,
                "answered {doubted} times in a row what cannot be true: its line is disturbed, its "
                "encoder is not sound, or another motor has its id",
            ),
            (is_silent, "did not answer in time for {silent} cycles"),
            (
                replies.answered & (hot > settings.max_temperature),
                "is at {hot} deg C, limit {limit:g}",
            ),
            (
                replies.jump != 0.0,
                "jumped by {jump:.3f} rad between two samples: its encoder or its mounting is not "
                "sound",
            ),
        )
        for mask, text in faults:
            for j in np.flatnonzero(mask).tolist():
                description = text.format(
                    status=status_text(feedback.status[j]),
                    doubted=self._doubted[j],
                    silent=self.silent[j],
                    hot=hot[j],
                    limit=settings.max_temperature,
                    jump=abs(replies.jump[j]),
                )
                raise HardwareAbort(f"{self._joints[j].label} {description}")
