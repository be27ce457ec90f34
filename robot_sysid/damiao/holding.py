"""What should hold an arm that stands still, and whether that is what holds it.

A motor that turns the other way than its joint, or that sits at another joint, moves an arm on
another path than the one that was checked; where gravity loads the joint, its torque shows it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from robot_sysid.damiao.protocol.joints import DamiaoJoint
from robot_sysid.damiao.trajectory import DamiaoTrajectory
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array

# Torque that says nothing about what a joint carries: this share of its motor's peak (a judgement).
_DOUBT = 0.06
# Of the doubt: a joint that carries more than this is judged by it, also where a guessed model is
# twice too heavy; one that then carries less than that is not at the joint it is taken for.
_LOADED, _BARE = 2.0, 0.5


def torque_doubt(joints: Sequence[DamiaoJoint]) -> Array:
    """Return the torque (n,) up to which a joint's says nothing about what it carries [N m]."""
    return _DOUBT * np.array([joint.spec.peak_torque * joint.torque_ratio for joint in joints])


class HoldingCheck:
    """Compares the torques that hold an arm still with those that should.

    Args:
        torque: from a pose (n,) [rad] to what should hold the arm there (n,) [N m].
        doubt: (n,) dry friction, where it is known [N m].
        source: who says what should, in words.
    """

    def __init__(
        self,
        joints: Sequence[DamiaoJoint],
        torque: Callable[[Array], Array],
        doubt: Array | float,
        source: str,
    ) -> None:
        self._due, self._joints, self._source = torque, joints, source
        self._n, self.doubt = len(joints), doubt + torque_doubt(joints)

    def unjudged(self, q: Array) -> list[DamiaoJoint]:
        """Return the unverified joints whose load at q (n,) shows no direction."""
        bare = np.abs(self._due(q)) <= _LOADED * self.doubt
        return [j for j, is_bare in zip(self._joints, bare) if is_bare and not j.verified]

    def torque(self, q: Array) -> Array:
        """Return what holds the arm at q [N m]; zero for motors beside it, behind the joints."""
        return np.append(self._due(q[: self._n]), np.zeros(len(q) - self._n))

    def __call__(self, q: Array, tau: Array) -> None:
        """Raise HardwareAbort where a torque (n,) [N m] at rest at q (n,) is not what holds it."""
        due, tau = self._due(q[: self._n]), tau[: self._n]
        along = np.sign(due) * tau
        wrong = (np.abs(due) > self.doubt) & (along < -self.doubt)
        wrong |= (np.abs(due) > _LOADED * self.doubt) & (along < _BARE * self.doubt)
        for j in np.flatnonzero(wrong).tolist():
            raise HardwareAbort(
                f"{self._joints[j].label} holds the arm with {tau[j]:.1f} N m but {self._source} "
                f"{due[j]:.1f} N m in this pose: a motor turns the other way than its joint, sits "
                "at another one, or has another zero; see 'motors map'"
            )


# So near to the first point its torque is nearly what holds the arm: 2 N m off at 20 N m/rad [rad].
# With less acceleration [rad/s^2] it is the torque at rest: 1 N m at 2 kg m^2.
_NEAR, _GENTLE = 0.1, 0.5


class FileHolding(HoldingCheck):
    """What a trajectory says that holds the arm near its first point.

    That is its torque where it accelerates least there; nothing is compared where that is still for
    a motion. One whose torque is within every joint's doubt all the time carries no arm.
    """

    def __init__(self, played: DamiaoTrajectory) -> None:
        near = np.all(np.abs(played.q - played.q[0]) <= _NEAR, axis=1)
        speeding = np.max(np.abs(np.gradient(played.qd, played.time, axis=0)), axis=1)
        row = int(np.argmin(np.where(near, speeding, np.inf)))
        torque, self._at_rest = played.tau[row], speeding[row] < _GENTLE
        said = "the trajectory feeds forward"
        super().__init__(played.joints, lambda q: torque, 0.0, said)
        self._first = played.q[0]
        self._carries = bool(np.any(np.abs(played.tau).max(axis=0) > self.doubt))

    def __call__(self, q: Array, tau: Array) -> None:
        """Raise HardwareAbort as above, and where nothing is fed forward to carry the arm."""
        if np.any(np.abs(q[: self._n] - self._first) > _NEAR):
            return
        loaded = np.abs(tau[: self._n]) > _LOADED * self.doubt
        for j in [] if self._carries else np.flatnonzero(loaded).tolist():
            raise HardwareAbort(
                f"{self._joints[j].label} holds the arm with {tau[j]:.1f} N m, and the trajectory "
                "never feeds forward what carries an arm: its torque lacks gravity"
            )
        if self._at_rest:
            super().__call__(q, tau)
