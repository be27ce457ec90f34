"""Simulation: a trajectory in, torques out, in chunks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.errors import SimulationError
from robot_sysid.records import Array, Measurement, Motion, RobotModel


class ArmTorque:
    """A function of a motion that returns the torques the model needs for it, friction included.

    It is pickled as its robot alone: a pickle of MuJoCo's data ends the process in MuJoCo 3.0.
    """

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        self._dynamics = ArmDynamics(robot)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how pickle makes the object again: its class and its robot."""
        return type(self), (self._robot,)

    def __call__(self, motion: Motion) -> Array:
        """Return joint torques (N, n) [N m]."""
        rigid = self._dynamics.torque(motion.q, motion.qd, motion.qdd)
        return rigid + self._robot.friction.torque(motion.qd)


def simulate_inverse(
    robot: RobotModel, motions: Iterable[Motion]
) -> Iterator[Measurement]:
    """Yield each chunk of a joint motion with the torques that an arm needs to follow it exactly.

    tau = inverse dynamics by MuJoCo + coulomb sign(qd) + viscous qd, with the model's own
    ``frictionloss`` and ``damping`` as coefficients of every chain joint.

    Raises:
        SimulationError: a torque is not finite; names the first such joint and its time.
    """
    torque = ArmTorque(robot)
    for motion in motions:
        tau = torque(motion)
        invalid = np.argwhere(~np.isfinite(tau))
        if len(invalid):
            sample, joint = invalid[0].tolist()
            raise SimulationError(
                f"the torque of joint {robot.joint_names[joint]} is not finite at "
                f"{motion.time[sample]:.3f} s: the likely cause is a link with an impossible mass "
                "or inertia; check the model's <inertial> elements"
            )
        yield Measurement(motion.time, motion.q, motion.qd, tau, motion.qdd)
