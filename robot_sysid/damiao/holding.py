"""What should hold an arm that stands still, and whether that is what holds it.

A motor that turns the other way than its joint, or that sits at another joint, moves an arm on
another path than the one that was checked; where gravity loads the joint, its torque shows it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from robot_sysid.damiao.protocol.joints import DamiaoJoint
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array

# Torque that says nothing about what a joint carries: this share of its motor's peak (a judgement).
_DOUBT = 0.06


def torque_doubt(joints: Sequence[DamiaoJoint]) -> Array:
    """Return the torque (n,) up to which a joint's says nothing about what it carries [N m]."""
    return _DOUBT * np.array([joint.spec.peak_torque * joint.torque_ratio for joint in joints])


class HoldingCheck:
    """Compares the torques that hold an arm still with those that should, by their signs.

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

    def torque(self, q: Array) -> Array:
        """Return what holds the arm at q [N m]; zero for motors beside it, behind the joints."""
        return np.append(self._due(q[: self._n]), np.zeros(len(q) - self._n))

    def __call__(self, q: Array, tau: Array) -> None:
        """Raise HardwareAbort where a torque (n,) [N m] at rest at q (n,) has the other sign."""
        due, tau = self._due(q[: self._n]), tau[: self._n]
        clear = (np.abs(due) > self.doubt) & (np.abs(tau) > self.doubt)
        for j in np.flatnonzero(clear & (np.sign(due) != np.sign(tau))).tolist():
            raise HardwareAbort(
                f"{self._joints[j].label} holds the arm with {tau[j]:.1f} N m but {self._source} "
                f"{due[j]:.1f} N m in this pose: a motor turns the other way than its joint, sits "
                "at another one, or has another zero; see 'motors map'"
            )


# So near to the first point its torque is nearly what holds the arm: 2 N m off at 20 N m/rad.
_NEAR = 0.1


class FileHolding(HoldingCheck):
    """What the first row (n,) [rad, N m] of a trajectory says that holds the arm, near to it.

    A ``largest`` (n,) torque of the whole trajectory that is within every joint's doubt carries no
    arm [N m].
    """

    def __init__(
        self, joints: Sequence[DamiaoJoint], first: Array, torque: Array, largest: Array
    ) -> None:
        super().__init__(joints, lambda q: torque, 0.0, "the trajectory feeds forward")
        self._first, self._carries = first, bool(np.any(largest > self.doubt))

    def __call__(self, q: Array, tau: Array) -> None:
        """Raise HardwareAbort as above, near the first point, or where nothing carries the arm."""
        if not self._carries:
            for j in np.flatnonzero(np.abs(tau[: self._n]) > self.doubt).tolist():
                raise HardwareAbort(
                    f"{self._joints[j].label} holds the arm with {tau[j]:.1f} N m, and the "
                    "trajectory never feeds forward what carries an arm: its torque lacks gravity"
                )
        if np.all(np.abs(q[: self._n] - self._first) < _NEAR):
            super().__call__(q, tau)
