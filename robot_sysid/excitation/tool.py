"""The tool: how fast its fastest point moves, and what a load in its hand would take of the joints.

A point p of the terminal body moves at v + w x p, so its speed is a convex function of p and the
fastest point is a corner of the body, or in the ball that stands for what is round about one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.screws import ScrewChain
from robot_sysid.excitation.information import body_wrench
from robot_sysid.records import Array, Motion
from robot_sysid.trajectory import TorqueFunction


@dataclass(frozen=True)
class Tool:
    """The terminal body and all it carries, by its outermost points.

    Attributes:
        points: (P, 3) in the terminal body's frame [m].
        radius: (P,) of a ball about each that belongs to it too [m].
    """

    points: Array
    radius: Array

    @property
    def tip(self) -> Array:
        """The point (3,) farthest from the last joint's body origin [m]."""
        distance = np.linalg.norm(self.points, axis=1)
        far = int(np.argmax(distance + self.radius))
        along = self.points[far] / distance[far] if distance[far] > 0.0 else np.zeros(3)
        return np.asarray(self.points[far] + self.radius[far] * along)

    def speed(self, twist: Array) -> Array:
        """Return the speed (N,) of the fastest point at twists (6, N) of the body [m/s]."""
        return np.asarray(np.max(self._speeds(twist)[0], axis=0))

    def speed_vjp(self, twist: Array, weight: Array) -> Array:
        """Return the gradient (6, N) of sum(weight * speed) with respect to the twists."""
        speeds, velocity = self._speeds(twist)
        at, each = np.argmax(speeds, axis=0), np.arange(twist.shape[1])
        along = _unit(velocity[:, at, each])
        point, turning = self.points[at].T, _unit(twist[:3]) * self.radius[at]
        return weight * np.concatenate((spatial.cross(point, along) + turning, along))

    def _speeds(self, twist: Array) -> tuple[Array, Array]:
        """Return the largest speed about each corner (P, N), and its own velocity (3, P, N)."""
        turned = spatial.cross(twist[:3, None, :], self.points.T[:, :, None])
        velocity = twist[3:, None, :] + turned
        spin = np.linalg.norm(twist[:3], axis=0)
        return np.linalg.norm(velocity, axis=0) + self.radius[:, None] * spin, velocity


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=0)
    return vectors / np.where(length > 0.0, length, 1.0)


@dataclass(frozen=True)
class LoadedTorque:
    """Torques of a motion, with or without an unknown load at the tip of the tool.

    Attributes:
        arm: torques (N, n) of the arm alone.
        chain: its screws.
        tip: (3,) where the load's mass would be, in the terminal body's frame [m].
        reserve: the heaviest load [kg]; each torque is the larger one of without and with it.
    """

    arm: TorqueFunction
    chain: ScrewChain
    tip: Array
    reserve: float = 0.0

    def __call__(self, motion: Motion) -> Array:
        """Return the torques (N, n) that have to be kept within limits [N m]."""
        torque = self.arm(motion)
        if self.reserve == 0.0:
            return torque
        loaded = torque + self.reserve * self.per_kilogram(motion)
        return np.where(np.abs(loaded) > np.abs(torque), loaded, torque)

    def per_kilogram(self, motion: Motion) -> Array:
        """Return the torques (N, n) that a load adds, per kilogram of it [N m/kg]."""
        body = self.chain.evaluate(motion.q, motion.qd, motion.qdd)
        theta = spatial.theta_from_com(1.0, self.tip, np.zeros((3, 3)))
        wrench = np.einsum("ikn,k->in", body_wrench(body.velocity, body.acceleration), theta)
        return np.einsum("ijn,in->nj", body.jacobian, wrench)

    def load_left(self, motion: Motion, limit: Array) -> tuple[float, int]:
        """Return the heaviest load [kg] that keeps torque limits (n,), and the joint that ends it.

        Infinite where no torque is limited, negative where the arm alone is beyond a limit.
        """
        torque, more = self.arm(motion), self.per_kilogram(motion)
        room = np.where(more >= 0.0, limit - torque, limit + torque)
        room = np.where(np.abs(torque) > limit, limit - np.abs(torque), room)
        share = np.abs(more) > 1e-12
        left = np.where(share, room / np.where(share, np.abs(more), 1.0), np.inf)
        least = np.min(left, axis=0)
        return float(np.min(least)), int(np.argmin(least))
