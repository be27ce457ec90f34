"""Motion of the terminal body from joint screws, in numpy, with exact gradients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid.dynamics.spatial import cross, skew
from robot_sysid.records.arm import Array, check_arrays


@dataclass(frozen=True)
class ScrewChain:
    """A serial arm as seen from its terminal body.

    Product of exponentials in the body frame (Lynch and Park, "Modern Robotics", 2017, eq. 4.16 and
    5.18). With B the body Jacobian of its terminal body at ``home`` and J_i its columns at q,

        J_i = Ad(exp(-B_n d_n) ... exp(-B_{i+1} d_{i+1})) B_i,      d = q - home,
        dJ_i / dq_k = ad(J_i) J_k for k > i, else 0,
        V  = sum_i J_i qd_i,
        V' = sum_i J_i qdd_i + sum_{i<k} ad(J_i) J_k qd_i qd_k - [0, g].

    This serves where thousands of gradients are needed; the identification itself uses MuJoCo.
    Arrays are component first: (6, n, N) holds N samples of n twists [omega, v].

    Attributes:
        screws, home: (6, n) the body Jacobian [omega, v], at joint positions (n,) [rad].
        gravity: (3,) gravity in the terminal body's frame there [m/s^2].
    """

    screws: Array
    home: Array
    gravity: Array

    def __post_init__(self) -> None:
        check_arrays(self, home=(None,), gravity=(3,), screws=(6, len(self.home)))

    def evaluate(self, q: Array, qd: Array, qdd: Array) -> ChainMotion:
        """Return the terminal body's motion for chain motions (N, n)."""
        jacobian, gravity = self._jacobian(q)
        # U_k: what joint k contributes to the twist; P_k: twist of all joints before it.
        steps = jacobian * qd.T
        before = np.cumsum(steps, axis=1) - steps
        velocity = np.sum(steps, axis=1)
        acceleration = np.sum(jacobian * qdd.T + bracket(before, steps), axis=1)
        acceleration[3:] -= gravity
        return ChainMotion(qd, qdd, jacobian, steps, before, velocity, acceleration, gravity)

    def _jacobian(self, q: Array) -> tuple[Array, Array]:
        """Return the body Jacobian (6, n, N) and gravity in the body frame (3, N)."""
        samples, joints = q.shape
        jacobian = np.empty((6, joints, samples))
        rotation = np.repeat(np.eye(3)[:, :, None], samples, axis=2)
        position = np.zeros((3, samples))
        for i in reversed(range(joints)):
            omega = np.tensordot(rotation, self.screws[:3, i], axes=(1, 0))
            linear = np.tensordot(rotation, self.screws[3:, i], axes=(1, 0))
            jacobian[:3, i] = omega
            jacobian[3:, i] = linear + cross(position, omega)
            step_rotation, step_position = exponential(self.screws[:, i], self.home[i] - q[:, i])
            position = position + np.einsum("abn,bn->an", rotation, step_position)
            rotation = np.einsum("abn,bcn->acn", rotation, step_rotation)
        return jacobian, np.tensordot(rotation, self.gravity, axes=(1, 0))


@dataclass(frozen=True)
class ChainMotion:
    """Terminal body motion of N samples, with what its gradient needs.

    Attributes:
        jacobian: (6, n, N) body Jacobian.
        steps, before: (6, n, N) each joint's twist, and the sum over the joints before it.
        velocity, acceleration: (6, N) of the body, the spatial one minus gravity.
        gravity: (3, N) gravity in the body frame.
    """

    qd: Array
    qdd: Array
    jacobian: Array
    steps: Array
    before: Array
    velocity: Array
    acceleration: Array
    gravity: Array

    def vjp(
        self, jacobian_adjoint: Array, velocity_adjoint: Array, acceleration_adjoint: Array
    ) -> tuple[Array, Array, Array]:
        """Return a scalar's gradient (N, n) by q, qd and qdd from that by ``jacobian`` (6, n, N),
        ``velocity`` and ``acceleration`` (6, N): reverse mode.
        """
        outer_adjoint = acceleration_adjoint[:, None, :]
        before_adjoint = -bracket_transposed(self.steps, outer_adjoint)
        after = np.sum(before_adjoint, axis=1, keepdims=True) - np.cumsum(before_adjoint, axis=1)
        steps_adjoint = (
            bracket_transposed(self.before, outer_adjoint) + after + velocity_adjoint[:, None, :]
        )
        jacobian_adjoint = jacobian_adjoint + outer_adjoint * self.qdd.T + steps_adjoint * self.qd.T
        turned = bracket_transposed(self.jacobian, jacobian_adjoint)
        q_adjoint = np.sum((np.cumsum(turned, axis=1) - turned) * self.jacobian, axis=0)
        falling = cross(self.jacobian[:3], self.gravity[:, None, :])
        q_adjoint += np.sum(outer_adjoint[3:] * falling, axis=0)
        qd_adjoint = np.sum(self.jacobian * steps_adjoint, axis=0)
        qdd_adjoint = np.sum(self.jacobian * outer_adjoint, axis=0)
        return q_adjoint.T, qd_adjoint.T, qdd_adjoint.T


def exponential(twist: Array, angle: Array) -> tuple[Array, Array]:
    """Return rotation (3, 3, N) and translation (3, N) of exp([twist] angle).

    Rodrigues' formula (Modern Robotics, eq. 3.51 and 3.88); a twist with omega = 0 slides.
    """
    omega, linear = twist[:3], twist[3:]
    if not np.any(omega):
        return np.repeat(np.eye(3)[:, :, None], len(angle), axis=2), np.outer(linear, angle)
    hat = skew(omega)
    square = hat @ hat
    sine, versine = np.sin(angle), 1.0 - np.cos(angle)
    rotation = np.eye(3)[:, :, None] + np.multiply.outer(hat, sine)
    rotation += np.multiply.outer(square, versine)
    translation = np.outer(linear, angle) + np.outer(hat @ linear, versine)
    return rotation, translation + np.outer(square @ linear, angle - sine)


def bracket(a: Array, b: Array) -> Array:
    """Return ad(a) b = [w_a x w_b, v_a x w_b + w_a x v_b] for twists (6, ...)."""
    return np.concatenate((cross(a[:3], b[:3]), cross(a[3:], b[:3]) + cross(a[:3], b[3:])), axis=0)


def bracket_transposed(a: Array, b: Array) -> Array:
    """Return ad(a)^T b = -[w_a x m + v_a x f, w_a x f] for b = [m, f] (6, ...)."""
    return -np.concatenate((cross(a[:3], b[:3]) + cross(a[3:], b[3:]), cross(a[:3], b[3:])), axis=0)
