"""The equations of an arm's joint torques as arrays, for programs with an estimate of their own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from robot_sysid.api.keywords import Model, arm_of, with_keywords
from robot_sysid.dynamics.equations import link_names
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics, LinkDynamics
from robot_sysid.errors import InputError
from robot_sysid.records import Array, checked_array

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from typing_extensions import Unpack

    from robot_sysid.api import keyword_types as types


@dataclass(frozen=True, repr=False)
class Regressor:
    """The regressor of an arm's joint torques at N samples; iterating yields Y and tau.

    Attributes:
        Y: (N, n, p) columns of the parameters in each joint's torque; (n, p) of one instant.
        tau: (N, n) torque of the model itself [N m; N of slides]; (n,) of one instant.
        theta: (p,) the model's own parameters, in the order of the columns.
        names: (p,) of the parameters: "m(link1)" to "Izz(link1)" of each link with mass from base
            to terminal (inertia about the body's ORIGIN), then "armature[joint1]",
            "viscous[joint1]" and "coulomb[joint1]" of each joint.
    """

    Y: Array
    tau: Array
    theta: Array
    names: tuple[str, ...]

    def __iter__(self) -> Iterator[Array]:
        return iter((self.Y, self.tau))

    def __repr__(self) -> str:
        return f"<Regressor Y {self.Y.shape}, tau {self.tau.shape}, {len(self.names)} parameters>"


@with_keywords()
def joint_torque_regressor(
    model: Model,
    q: ArrayLike,
    qd: ArrayLike,
    qdd: ArrayLike,
    **options: Unpack[types.JointTorqueRegressorKeywords],
) -> Regressor:
    """Return the regressor Y of all parameters of an arm, and the torque tau of its model.

    Y theta = tau: recursive Newton-Euler (Lynch and Park, "Modern Robotics", 2017, eq. 8.50 to
    8.53) is linear in each link's ten parameters; a joint adds armature qdd + viscous qd + coulomb
    sign(qd). tau is MuJoCo's inverse dynamics with that friction; it also holds the model's
    springs, tendons and actuators, which have no columns: tau - Y theta is their torque.

    Args:
        model: MJCF or URDF file, or a ``mujoco.MjSpec`` or ``MjModel``.
        q: (N, n) positions of the chain joints [rad], or (n,) of one instant.
        qd: their velocities [rad/s].
        qdd: their accelerations [rad/s^2].
        options: ``joint``, ``mesh_dir`` and ``keyframe``, as of ``identify``.

    Raises:
        InputError: the model cannot be used, or the arrays do not fit it.
    """
    robot = arm_of(model, options)
    n = robot.n_joints
    motion = []
    for name, signal in (("q", q), ("qd", qd), ("qdd", qdd)):
        samples = np.atleast_2d(np.asarray(signal, dtype=float))
        motion.append(checked_array(samples, (None, n), name))
    velocity = motion[1]
    acceleration = motion[2]
    if not len(motion[0]) == len(velocity) == len(acceleration):
        raise InputError("q, qd and qdd need the same number of samples")
    link_indices = [k for k, link in enumerate(robot.links) if link.has_mass]
    columns = [LinkDynamics(robot).motion(*motion).columns(link_indices)]
    theta = []
    names: list[str] = []
    for k in link_indices:
        theta.append(robot.links[k].theta)
        names += link_names(robot, k)
    joint_terms = (
        ("armature", acceleration, robot.armature),
        ("viscous", velocity, robot.friction.viscous),
        ("coulomb", np.sign(velocity), robot.friction.coulomb),
    )
    for term, factor, coefficients in joint_terms:
        columns.append(np.eye(n) * factor[:, None])
        theta.append(coefficients)
        names += [f"{term}[{joint}]" for joint in robot.joint_names]
    Y = np.concatenate(columns, axis=-1)
    tau = ArmDynamics(robot).torque(*motion) + robot.friction.torque(velocity)
    if np.ndim(q) == 1:
        Y = Y[0]
        tau = tau[0]
    return Regressor(Y, tau, np.concatenate(theta), tuple(names))
