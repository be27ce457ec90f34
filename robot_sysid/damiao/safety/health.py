"""Health of the motors on a bus: answers, ids, other programs, faults and temperatures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from robot_sysid.damiao.joints import DamiaoJoint
from robot_sysid.damiao.protocol import DISABLED, ENABLED, status_text
from robot_sysid.damiao.safety.plausibility import NO_STATUS, Mask, Replies
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.errors import HardwareAbort

# What single damaged frames do not explain: commands of others, counted with a decay.
_FEW = 2.5
_DOUBLED = 5.5
"""The same of answers too many: an adapter may hand one over twice now and then, and a second motor
answers each time."""
_DECAY = 0.95
"""Share of such a count that is left after a cycle: with more, damaged frames would add up."""
_LOST_DECAY = 0.99
"""The same of commands without an answer: it is a count of about a hundred cycles."""
_FAIR = 0.5
"""Share of the commands without an answer that stop a run, below which answers can be trusted."""
_DECAYS = np.array([_LOST_DECAY, _DECAY, _DECAY])
CONFIRMED = 2
"""Number of equal reports of a status that are the motor's own: one may be a damaged frame."""
# What is said of a motor that reports that it is disabled.
_STARTED_AGAIN = "was switched off, or started again"
_DEAD_BUS = (
    "the motors did not answer in time to {silent} commands in a row, none of them: look at the "
    "adapter, its cable, the bus and the motors' supply"
)


class BusHealth:
    """Counts what goes wrong on the bus of n joints.

    Args:
        joints: joints of the arm, base to terminal.
        settings: settings of the run.

    Attributes:
        silent: (n,) number of commands in a row without a believed answer.
        unheard: (n,) number of cycles in a row without an answer that is believed or carries the
            believed position on.
        commanded: (n,) number of all commands and requests.
        total_missed: (n,) number of those without a believed answer.
        late: (n,) number of answers that no command of their cycle awaited.
        doubted: (n,) number of answers that were not believed.
        reports: how often each of the n motors answered with each status code but ``ENABLED``,
            believed or not.
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
        # Number of commands in a row to which nothing came, believed or not.
        self._absent = np.zeros(n_joints, int)
        self.failed = np.zeros(n_joints, bool)
        self.commanded, self.late, self.doubted = np.zeros((3, n_joints), int)
        self.reports: list[Counter[int]] = [Counter() for _ in joints]
        # Status of each motor's last answer, number of answers in a row that have it, and number of
        # answers in a row with any that is not ``ENABLED``, believed or not.
        self._status = np.full(n_joints, ENABLED)
        self._repeated, self._idle = np.zeros((2, n_joints), int)
        # Whether the last check found the motor silent, without a reason.
        self._fell_silent = np.zeros(n_joints, bool)

    def update(self, replies: Replies) -> None:
        """Count missing, doubted and surplus answers, and foreign commands, of a cycle's replies.

        A motor that reports a fault is noted in ``failed``.
        """
        self._count_reports(replies)
        unanswered = replies.requested & ~replies.answered
        counts = [self.silent + unanswered, self._doubted + replies.doubted]
        self.silent, self._doubted = np.where(replies.answered, 0, counts)
        is_heard = replies.answered | replies.followed
        self.unheard = np.where(is_heard, 0, self.unheard + 1)
        self.total_missed += unanswered
        untimely = unanswered + replies.late
        events = np.array([untimely, replies.surplus, replies.foreign])
        self._counts = _DECAYS[:, None] * self._counts + events
        status = replies.feedback.status
        is_faulty = (status != ENABLED) & (status != NO_STATUS)
        is_faulty |= self._is_confirmed
        # Where two motors answer on one id, the status may be the other motor's.
        is_double = is_faulty & (self._counts[1] > 1.0)
        self._counts[1] = np.where(is_double, np.inf, self._counts[1])
        self.failed |= is_faulty & ~is_double

    def _count_reports(self, replies: Replies) -> None:
        """Count the status codes of a cycle's answers, whether these are believed or not."""
        self.commanded += replies.requested
        self.late += replies.late
        self.doubted += replies.doubted
        reported = replies.reported
        came = reported != NO_STATUS
        self._absent = np.where(came, 0, self._absent + replies.requested)
        is_idle = came & (reported != ENABLED)
        for j in is_idle.nonzero()[0].tolist():
            self.reports[j][int(reported[j])] += 1
        is_same = reported == self._status
        repeated = np.where(is_same, self._repeated + 1, 1)
        self._repeated = np.where(came, repeated, self._repeated)
        self._idle = np.where(came, is_idle * (self._idle + 1), self._idle)
        self._status = np.where(came, reported, self._status)

    @property
    def is_untimely(self) -> bool:
        """Whether some motor has sent nothing for some time, or answers of the bus come late."""
        is_dead = self._absent >= self._settings.max_missed
        is_late = self._counts[0] > _FAIR * self._settings.max_lost
        return bool(np.any(is_dead | is_late))

    @property
    def _is_confirmed(self) -> Mask:
        """Whether the last answers of each motor (n,) all say that it does not drive."""
        return (self._status != ENABLED) & (self._repeated >= CONFIRMED)

    def check(self, replies: Replies) -> None:
        """Raise HardwareAbort for the first fault of a cycle; call ``update`` before."""
        settings = self._settings
        feedback = replies.feedback
        hot = feedback.temperature
        lost, surplus, foreign = self._counts
        is_silent = self.silent >= settings.max_missed
        is_lost = lost > settings.max_lost
        is_doubted = self._doubted >= settings.max_doubted
        # A motor that started again is silent, and says then that it is disabled, perhaps with
        # another position: what it said is the reason for the silence.
        says_why = (self._idle > 0) & (self._idle >= self._doubted)
        is_amiss = is_silent | is_lost | is_doubted | (replies.jump != 0.0)
        is_idle = self._is_confirmed | (is_amiss & says_why)
        is_idle |= replies.answered & (feedback.status != ENABLED)
        is_off = self._status == DISABLED
        self._fell_silent = (is_silent | is_lost) & ~is_idle
        faults: tuple[tuple[Mask, str], ...] = (
            (
                foreign > _FEW,
                "gets commands of another program: end it; one master moves an arm",
            ),
            (
                (surplus > _DOUBLED) | (is_doubted & (surplus > _FEW)),
                "answers more often than it is asked: a second motor has its id, or another "
                "program commands it",
            ),
            (is_idle & is_off, f"{_STARTED_AGAIN}: it reports {{status}}"),
            (is_idle & ~is_off, "reports {status}"),
            (
                is_doubted,
                "answered {doubted} times in a row what cannot be true: its line is disturbed, its "
                "encoder is not sound, or another motor has its id",
            ),
            (is_silent, "did not answer in time to {silent} commands in a row"),
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
        if is_silent.all() and len(is_silent) > 1:
            raise HardwareAbort(_DEAD_BUS.format(silent=self.silent.min()))
        for mask, text in faults:
            for j in mask.nonzero()[0].tolist():
                description = text.format(
                    status=status_text(self._status[j]),
                    doubted=self._doubted[j],
                    silent=self.silent[j],
                    hot=hot[j],
                    limit=settings.max_temperature,
                    jump=abs(replies.jump[j]),
                )
                raise HardwareAbort(f"{self._joints[j].label} {description}")

    def reason_of_silence(self) -> str:
        """Return what the first motor that had fallen silent in the last check has said since.

        It is the end of a message, and empty where no such motor reports that it does not drive. A
        motor takes longer to start again than the run waits for its answers.
        """
        for j in np.flatnonzero(self._fell_silent & self._is_confirmed).tolist():
            reports = f"reports {status_text(self._status[j])}"
            if self._status[j] == DISABLED:
                reports = f"{_STARTED_AGAIN}: it {reports}"
            return f"; it has answered since then: {self._joints[j].label} {reports}"
        return ""
