"""Does the arm, held still, carry the torques that gravity asks for in the model?

A motor that turns the other way than its joint, or that sits at another joint, moves an arm on
another path than the one that was checked. Where gravity loads a joint clearly, the torque that
holds it tells.
"""

from __future__ import annotations

import numpy as np

from robot_sysid.damiao.protocol.joints import DamiaoJoint
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.simulator import ArmTorque

# Torque that says nothing about gravity: this share of the motor's peak, and dry friction.
_SHARE = 0.06


class GravityCheck:
    """Compares holding torques with the model's, by their signs.

    Args:
        robot: the arm.
        joints: its motors.
    """

    def __init__(self, robot: RobotModel, joints: tuple[DamiaoJoint, ...]) -> None:
        self._torque, self._joints, self._path = ArmTorque(robot), joints, robot.path
        peak = [joint.spec.strongest for joint in joints]
        self._doubt = _SHARE * np.array(peak) + robot.friction.coulomb

    def holding(self, q: Array) -> Array:
        """Return what the model's gravity asks for at rest at q (n,) [N m]."""
        still = np.zeros((1, len(q)))
        return np.asarray(self._torque(Motion(np.zeros(1), q[None], still, still))[0])

    def __call__(self, q: Array, tau: Array) -> None:
        """Compare a pose that is held.

        Args:
            q, tau: (n,) measured positions and torques at rest [rad, N m].

        Raises:
            HardwareAbort: a torque has the opposite sign of the model's.
        """
        model = self.holding(q)
        clear = (np.abs(model) > self._doubt) & (np.abs(tau) > self._doubt)
        for j in np.flatnonzero(clear & (np.sign(model) != np.sign(tau))):
            raise HardwareAbort(
                f"{self._joints[j].label} holds the arm with {tau[j]:.1f} N m but the model "
                f"{self._path.name} needs {model[j]:.1f} N m in this pose: a motor turns the other "
                "way than its joint, sits at another one, or has another zero; see 'motors map'"
            )
