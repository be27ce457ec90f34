"""Motion of bodies from the screws of their joints, in numpy, with exact gradients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid.dynamics.spatial import cross, skew
from robot_sysid.records.arm import Array, check_arrays


@dataclass(frozen=True)
class ScrewChain:
    """A serial arm as seen from one of its bodies, or from several.

    Product of exponentials in the body frame (Lynch and Park, "Modern Robotics", 2017, eq. 4.16 and
    5.18). With B the body Jacobian of a body at ``home`` and J_i its columns at q,

        J_i = Ad(exp(-B_n d_n) ... exp(-B_{i+1} d_{i+1})) B_i,      d = q - home,
        dJ_i / dq_k = ad(J_i) J_k for k > i, else 0,
        V  = sum_i J_i qd_i,
        V' = sum_i J_i qdd_i + sum_{i<k} ad(J_i) J_k qd_i qd_k - [0, g].

    This serves where thousands of gradients are needed; the identification itself uses MuJoCo.
    Arrays are component first: (6, n, N) holds N samples of n twists [omega, v]. Of L bodies they
    have one more axis, (6, n, L, N); screws of joints that do not carry a body are zero.

    Attributes:
        screws, home: (6, n) the body Jacobian [omega, v], at joint positions (n,) [rad].
        gravity: (3,) gravity in the body's frame there [m/s^2].
    """

    screws: Array
    home: Array
    gravity: Array

    def __post_init__(self) -> None:
        bodies = self.gravity.shape[1:]
        check_arrays(self, home=(None,), gravity=(3, *bodies), screws=(6, len(self.home), *bodies))

    def evaluate(self, q: Array, qd: Array, qdd: Array) -> ChainMotion:
        """Return the motion of the body, or of each of them, for chain motions (N, n)."""
        jacobian, gravity = self._jacobian(q)
        ones = (1,) * (gravity.ndim - 2)
        speed, change = (part.T.reshape(q.shape[1], *ones, -1) for part in (qd, qdd))
        # U_k: what joint k contributes to the twist; P_k: twist of all joints before it.
        steps = jacobian * speed
        before = np.cumsum(steps, axis=1) - steps
        velocity = np.sum(steps, axis=1)
        acceleration = np.sum(jacobian * change + bracket(before, steps), axis=1)
        acceleration[3:] -= gravity
        return ChainMotion(speed, change, jacobian, steps, before, velocity, acceleration, gravity)

    def _jacobian(self, q: Array) -> tuple[Array, Array]:
        """Return the body Jacobian (6, n, N) and gravity in the body frame (3, N)."""
        (samples, joints), bodies = q.shape, self.gravity.shape[1:]
        jacobian = np.empty((6, joints, *bodies, samples))
        rotation, position = np.zeros((3, 3, *bodies, samples)), np.zeros((3, *bodies, samples))
        rotation[range(3), range(3)] = 1.0
        for i in reversed(range(joints)):
            screw = self.screws[:, i]
            omega = np.einsum("ab...n,b...->a...n", rotation, screw[:3])
            linear = np.einsum("ab...n,b...->a...n", rotation, screw[3:])
            jacobian[:3, i] = omega
            jacobian[3:, i] = linear + cross(position, omega)
            step_rotation, step_position = exponential(screw, self.home[i] - q[:, i])
            position = position + np.einsum("ab...,b...->a...", rotation, step_position)
            rotation = np.einsum("ab...,bc...->ac...", rotation, step_rotation)
        return jacobian, np.einsum("ab...n,b...->a...n", rotation, self.gravity)


@dataclass(frozen=True)
class ChainMotion:
    """A body's motion of N samples, with what its gradient needs; of L bodies (..., L, N).

    Attributes:
        qd, qdd: (n, N) of the joints.
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
        outer_adjoint = acceleration_adjoint[:, None]
        before_adjoint = -bracket_transposed(self.steps, outer_adjoint)
        after = np.sum(before_adjoint, axis=1, keepdims=True) - np.cumsum(before_adjoint, axis=1)
        steps_adjoint = (
            bracket_transposed(self.before, outer_adjoint) + after + velocity_adjoint[:, None]
        )
        jacobian_adjoint = jacobian_adjoint + outer_adjoint * self.qdd + steps_adjoint * self.qd
        turned = bracket_transposed(self.jacobian, jacobian_adjoint)
        q_adjoint = np.sum((np.cumsum(turned, axis=1) - turned) * self.jacobian, axis=0)
        falling = cross(self.jacobian[:3], self.gravity[:, None])
        q_adjoint += np.sum(outer_adjoint[3:] * falling, axis=0)
        qd_adjoint = np.sum(self.jacobian * steps_adjoint, axis=0)
        qdd_adjoint = np.sum(self.jacobian * outer_adjoint, axis=0)
        joints, samples = q_adjoint.shape[0], q_adjoint.shape[-1]
        each = (part.reshape(joints, -1, samples) for part in (q_adjoint, qd_adjoint, qdd_adjoint))
        by_q, by_qd, by_qdd = (np.sum(part, axis=1).T for part in each)
        return by_q, by_qd, by_qdd


def exponential(twist: Array, angle: Array) -> tuple[Array, Array]:
    """Return rotation (3, 3, N) and translation (3, N) of exp([twist] angle), angle (N,).

    Of twists (6, L): (3, 3, L, N) and (3, L, N). Rodrigues' formula (Modern Robotics, eq. 3.51 and
    3.88); a twist with omega = 0 slides.
    """
    hat, linear = skew(twist[:3]), twist[3:]
    square = np.einsum("ab...,bc...->ac...", hat, hat)
    sine, versine = np.sin(angle), 1.0 - np.cos(angle)
    rotation = np.multiply.outer(hat, sine) + np.multiply.outer(square, versine)
    rotation[range(3), range(3)] += 1.0
    translation = np.multiply.outer(linear, angle)
    for matrix, size in ((hat, versine), (square, angle - sine)):
        translation += np.multiply.outer(np.einsum("ab...,b...->a...", matrix, linear), size)
    return rotation, translation


def bracket(a: Array, b: Array) -> Array:
    """Return ad(a) b = [w_a x w_b, v_a x w_b + w_a x v_b] for twists (6, ...)."""
    return np.concatenate((cross(a[:3], b[:3]), cross(a[3:], b[:3]) + cross(a[:3], b[3:])), axis=0)


def bracket_transposed(a: Array, b: Array) -> Array:
    """Return ad(a)^T b = -[w_a x m + v_a x f, w_a x f] for b = [m, f] (6, ...)."""
    return -np.concatenate((cross(a[:3], b[:3]) + cross(a[3:], b[3:]), cross(a[:3], b[3:])), axis=0)
