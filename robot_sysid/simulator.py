"""The simulated arm: a trajectory in, torque measurements out, chunk by chunk."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from robot_sysid.errors import SimulationError
from robot_sysid.kinematics import ArmDynamics
from robot_sysid.records import Array, Measurement, Motion, RobotModel


def inverse_torque(robot: RobotModel) -> Callable[[Motion], Array]:
    """Return a function from a motion to the joint torques (N, n) the model needs for it."""
    dynamics = ArmDynamics(robot)

    def torque(motion: Motion) -> Array:
        rigid = dynamics.torque(motion.q, motion.qd, motion.qdd)
        return rigid + robot.friction.torque(motion.qd)

    return torque


def simulate_inverse(robot: RobotModel, motions: Iterable[Motion]) -> Iterator[Measurement]:
    """Yield the torques the model needs to follow a motion exactly.

    tau = inverse dynamics by MuJoCo + coulomb sign(qd) + viscous qd, with the model's own
    ``frictionloss`` and ``damping`` as coefficients of every chain joint.

    Args:
        robot: the arm, truth of this simulation.
        motions: chunks of chain joint motion.

    Raises:
        SimulationError: a torque is not finite.
    """
    torque = inverse_torque(robot)
    for motion in motions:
        tau = torque(motion)
        _require_finite(tau, motion.time, robot.joint_names)
        yield Measurement(motion.time, motion.q, motion.qd, tau, motion.qdd)


def _require_finite(tau: Array, time: Array, joints: tuple[str, ...]) -> None:
    bad = np.argwhere(~np.isfinite(tau))
    if len(bad) == 0:
        return
    sample, joint = (int(i) for i in bad[0])
    raise SimulationError(
        f"the torque of joint {joints[joint]} is not finite at {time[sample]:.3f} s: the likely "
        "cause is a link with an impossible mass or inertia; check the model's <inertial> elements"
    )
