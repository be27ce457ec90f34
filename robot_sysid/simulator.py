"""Simulation: a trajectory in, torques out, in chunks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.errors import SimulationError
from robot_sysid.records import Motion, Recording, RobotModel


def simulate_inverse(
    robot: RobotModel, motions: Iterable[Motion]
) -> Iterator[Recording]:
    """Yield each chunk of a joint motion with the torques that an arm needs to follow it exactly.

    tau = inverse dynamics by MuJoCo + coulomb sign(qd) + viscous qd, with the model's own
    ``frictionloss`` and ``damping`` as coefficients of every chain joint.

    Raises:
        SimulationError: a torque is not finite; names the first such joint and its time.
    """
    torque = ArmDynamics(robot)
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
        yield Recording(motion.time, motion.q, motion.qd, tau, motion.qdd)
