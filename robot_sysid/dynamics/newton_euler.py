"""Motion and torque of all links at once, in numpy on whole chunks: recursive Newton-Euler.

With T_i the pose of link i in link i-1 and S_i the screw of its joint in its own frame (Lynch and
Park, "Modern Robotics", 2017, eq. 8.50 to 8.53, A_0 = [0, -g]):

    V_i = Ad(T_i^-1) V_{i-1} + S_i qd_i,
    A_i = Ad(T_i^-1) A_{i-1} + ad(V_i) S_i qd_i + S_i qdd_i,
    F_i = Y6(V_i, A_i) theta_i + Ad(T_{i+1}^-1)^T F_{i+1},   tau_i = S_i^T F_i.

The regressor of a link's own parameters needs the twist of each joint below it:

    J_ij = Ad(T_i^-1) J_{i-1,j},   J_ii = S_i,   d tau_j / d theta_i = J_ij^T Y6(V_i, A_i).

Arrays are component first: (6, N) holds N samples of a twist [omega, v].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from robot_sysid.dynamics.screws import bracket, bracket_transposed, exponential
from robot_sysid.dynamics.spatial import PARAMETER_NAMES, cross, skew, symmetric_from_six
from robot_sysid.records import Array, RobotModel
from robot_sysid.regressor import wrench_regressor

N_PARAMETERS = len(PARAMETER_NAMES)


@dataclass(frozen=True)
class LinksMotion:
    """Motion of all links over N samples: velocity and spatial acceleration minus gravity (6, N),
    each in the link's own frame, its pose in the link before it, and its joint's screw (6,).
    """

    velocity: tuple[Array, ...]
    acceleration: tuple[Array, ...]
    steps: tuple[Step, ...]
    screws: tuple[Array, ...]

    def columns(self, links: Sequence[int]) -> Array:
        """Return the joint torque regressor (N, n, 10 len(links)) of some links [N m]."""
        samples = self.velocity[0].shape[1]
        columns = np.zeros((samples, len(self.velocity), N_PARAMETERS * len(links)))
        jacobian: list[Array] = []
        for link in range(max(links, default=-1) + 1):
            screw = np.repeat(self.screws[link][:, None], samples, axis=1)
            jacobian = [*(self.steps[link].into(twist) for twist in jacobian), screw]
            for place in np.flatnonzero(np.equal(links, link)):
                wrench = wrench_regressor(self.velocity[link].T, self.acceleration[link].T)
                block = columns[:, :, N_PARAMETERS * place : N_PARAMETERS * (place + 1)]
                for joint, twist in enumerate(jacobian):
                    block[:, joint] = np.einsum("in,ikn->nk", twist, wrench)
        return columns

    def torque(self, thetas: Array) -> Array:
        """Return the joint torque (N, n) [N m] of links theta (n, 10), rigid bodies only."""
        samples = self.velocity[0].shape[1]
        tau = np.zeros((samples, len(thetas)))
        wrench = np.zeros((6, samples))
        for link in reversed(range(len(thetas))):
            if np.any(thetas[link]):
                move = self.velocity[link], self.acceleration[link]
                wrench = wrench + _wrench(thetas[link], *move)
            tau[:, link] = self.screws[link] @ wrench
            wrench = self.steps[link].out_of(wrench)
        return tau


class LinkDynamics:
    """Recursive Newton-Euler of one arm."""

    def __init__(self, robot: RobotModel) -> None:
        self._links, self._home = robot.links, robot.reference
        options = robot.mj_model.opt
        weightless = options.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
        self._gravity = np.zeros(3) if weightless else np.array(options.gravity)

    def motion(self, q: Array, qd: Array, qdd: Array) -> LinksMotion:
        """Return the motion of all links for chain motions (N, n) [rad, rad/s, rad/s^2]."""
        samples = len(q)
        velocity, acceleration = np.zeros((2, 6, samples))
        acceleration[3:] = -self._gravity[:, None]
        moves = []
        for i, link in enumerate(self._links):
            rotation, place = exponential(link.screw, q[:, i] - self._home[i])
            step = Step(
                np.einsum("ab,bcn->acn", link.rotation, rotation),
                link.translation[:, None] + link.rotation @ place,
            )
            screw = np.repeat(link.screw[:, None], samples, axis=1)
            turning = screw * qd[:, i]
            velocity = step.into(velocity) + turning
            acceleration = step.into(acceleration) + bracket(velocity, turning) + screw * qdd[:, i]
            moves.append((velocity, acceleration, step, link.screw))
        return LinksMotion(*zip(*moves))


@dataclass(frozen=True)
class Step:
    """Pose of a link in the one before it: rotation (3, 3, N), translation (3, N)."""

    rotation: Array
    translation: Array

    def into(self, twist: Array) -> Array:
        """Return Ad(T^-1) of a twist (6, N)."""
        omega = np.einsum("abn,an->bn", self.rotation, twist[:3])
        shifted = twist[3:] + cross(twist[:3], self.translation)
        return np.concatenate((omega, np.einsum("abn,an->bn", self.rotation, shifted)))

    def out_of(self, wrench: Array) -> Array:
        """Return Ad(T^-1)^T of a wrench (6, N), as the link before it feels it."""
        parts = np.split(wrench, 2)
        moment, force = (np.einsum("abn,bn->an", self.rotation, part) for part in parts)
        return np.concatenate((moment + cross(self.translation, force), force))


def _wrench(theta: Array, velocity: Array, acceleration: Array) -> Array:
    """Return G A - ad(V)^T G V (6, N) with G = [[I, [h]x], [-[h]x, m 1]]."""
    hat = skew(theta[1:4])
    inertia = np.block([[symmetric_from_six(theta[4:]), hat], [-hat, theta[0] * np.eye(3)]])
    return inertia @ acceleration - bracket_transposed(velocity, inertia @ velocity)
