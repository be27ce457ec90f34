"""Health of the motors on a bus: answers, ids, other programs, faults and temperatures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robot_sysid.damiao.joints import DamiaoJoint
from robot_sysid.damiao.protocol import ENABLED, status_text
from robot_sysid.damiao.safety.plausibility import NO_STATUS, Mask, Replies
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.errors import HardwareAbort

# What single damaged frames do not explain: missing answers, answers and commands too many, each
# counted with a decay.
_FEW = 2.5


class BusHealth:
    """Counts what goes wrong on the bus of n joints.

    Args:
        joints: joints of the arm, base to terminal.
        settings: settings of the run.

    Attributes:
        silent: (n,) number of cycles in a row without a believed answer.
        unheard: (n,) the same without one that carries the believed position on, either.
        total_missed: (n,) number of all commands without an answer.
        failed: (n,) whether the motor reported that it does not drive any more.
    """

    def __init__(self, joints: Sequence[DamiaoJoint], settings: PlaySettings) -> None:
        self._joints = joints
        self._settings = settings
        n_joints = len(joints)
        # Number of doubted answers in a row, and decaying counts (3, n) of commands without answer,
        # answers without command, and commands of others.
        self.silent, self._doubted, self.total_missed = np.zeros((3, n_joints), int)
        self.unheard = np.zeros(n_joints, int)
        self._counts = np.zeros((3, n_joints))
        self.failed = np.zeros(n_joints, bool)

    def update(self, replies: Replies) -> None:
        """Count missing, doubted and surplus answers, and foreign commands, of a cycle's replies.

        A motor that reports a fault is noted in ``failed``.
        """
        unanswered = replies.requested & ~replies.answered
        counts = [self.silent + 1, self._doubted + replies.doubted]
        self.silent, self._doubted = np.where(replies.answered, 0, counts)
        is_heard = replies.answered | replies.followed
        self.unheard = np.where(is_heard, 0, self.unheard + 1)
        self.total_missed += unanswered
        events = np.array([unanswered, replies.surplus, replies.foreign])
        self._counts = 0.95 * self._counts + events
        status = replies.feedback.status
        is_faulty = (status != ENABLED) & (status != NO_STATUS)
        # Where two motors answer on one id, the status may be the other motor's.
        is_double = is_faulty & (self._counts[1] > 1.0)
        self._counts[1] = np.where(is_double, np.inf, self._counts[1])
        self.failed |= is_faulty & ~is_double

    def check(self, replies: Replies) -> None:
        """Raise HardwareAbort for the first fault of a cycle; call ``update`` before."""
        settings = self._settings
        feedback = replies.feedback
        hot = feedback.temperature
        lost, surplus, foreign = self._counts
        # A motor whose answer is missing is sent nothing for four cycles, see ``session.PAUSE``, so
        # commands alone would count too slowly.
        is_silent = self.silent >= 2 * settings.max_missed
        is_lost = lost > settings.max_missed - 0.5
        is_doubted = (is_silent | is_lost) & (self._doubted >= settings.max_missed)
        faults: tuple[tuple[Mask, str], ...] = (
            (
                foreign > _FEW,
                "gets commands of another program: end it; one master moves an arm",
            ),
            (
                surplus > _FEW,
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
            (is_lost, "did not answer in time again and again"),
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
