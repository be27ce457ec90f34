"""An arm whose motions are planned: what they may use, and what its torques would show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics, LinksMotion
from robot_sysid.records import Array, Limits, Motion, RobotModel
from robot_sysid.records.levels import INTERVAL
from robot_sysid.spatial import N_INERTIAL
from robot_sysid.trajectory import TorqueFunction


@dataclass(frozen=True)
class PlannedArm:
    """An arm with the limits of its motions and the noise of its torques.

    Attributes:
        robot: the arm.
        rest: (n,) configuration in which the motion starts and ends [rad].
        limits: that the motion may use, with margins already taken off; all positions have some.
        links: L indices in ``robot.links`` of the links with mass: the terminal one, then the
            others from the base on.
        dynamics: motion of all links.
        tool: (8, 3) corners of a box about the terminal link and all it carries, in the terminal
            body's frame [m]. Speed is a convex function of the point, so that the fastest one is a
            corner.
        arm_torque: joint torques (N, n) along a motion, friction included, without any load.
        reserve: the heaviest load at the tip of the tool that torque limits hold for too [kg].
        link_errors: (10 L, 10 L) lower triangular factor of the prior covariance of all links'
            parameters, from the terminal link inwards; zero where the links are taken as they are.
        rows: indices of the chain joints whose torque will be used.
        sigma: (len(rows),) standard deviation of the noise of these torques [N m].
    """

    robot: RobotModel
    rest: Array
    limits: Limits
    links: tuple[int, ...]
    dynamics: LinkDynamics
    tool: Array
    arm_torque: TorqueFunction
    reserve: float
    link_errors: Array
    rows: tuple[int, ...]
    sigma: Array

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the chain joints."""
        return self.robot.joint_names

    @property
    def n_joints(self) -> int:
        """Number of chain joints n."""
        return self.robot.n_joints

    def torque(self, motion: Motion) -> Array:
        """Return the torques (N, n) that are compared with the limits [N m].

        Each is the larger one of the torques without and with the reserved load, increased by the
        reserve for the links' errors.
        """
        return self.torque_of_links(motion, self.links_motion(motion))

    def links_motion(self, motion: Motion) -> LinksMotion:
        """Return the motion of all links in a motion of the joints."""
        return self.dynamics.motion(motion.q, motion.qd, motion.qdd)

    def torque_of_links(self, motion: Motion, links: LinksMotion) -> Array:
        """Return ``torque`` where the motion of the links is known already."""
        torque = self.arm_torque(motion)
        if self.reserve > 0.0:
            loaded = torque + self.reserve * self.torque_per_kilogram(links)
            torque = np.where(np.abs(loaded) > np.abs(torque), loaded, torque)
        return torque + np.copysign(self.torque_reserve(links), torque)

    def torque_reserve(self, links: LinksMotion) -> Array:
        """Return the torques (N, n) reserved for errors of the links [N m]: two standard deviations
        of each torque; zero at joints without a torque limit.

        A joint moves the links from the last one to its own. From the terminal link inwards they
        are the first ones, whose errors the first columns of the triangular factor hold alone.
        """
        deviations = np.zeros((self.n_joints, links.velocity.shape[2]))
        limited = np.flatnonzero(np.isfinite(self.limits.torque)).tolist()
        if not (limited and np.any(self.link_errors)):
            return deviations.T
        inwards = sorted(self.links, reverse=True)
        columns = links.columns(inwards).transpose(1, 2, 0)
        for joint in limited:
            size = N_INERTIAL * sum(link >= joint for link in inwards)
            errors = self.link_errors[:size, :size].T @ columns[joint, :size]
            deviations[joint] = np.sqrt(np.sum(errors**2, axis=0))
        return INTERVAL * deviations.T

    def torque_per_kilogram(self, links: LinksMotion) -> Array:
        """Return the torques (N, n) that a load at the tool's tip adds, per kilogram [N m/kg].

        The tip is the corner of the tool's box that is farthest from the terminal body's origin.
        """
        tip = self.tool[np.argmax(np.linalg.norm(self.tool, axis=1))]
        thetas = np.zeros((self.n_joints, N_INERTIAL))
        # A point mass of 1 kg.
        thetas[-1] = spatial.theta_from_com(1.0, tip, np.zeros((3, 3)))
        return links.torque(thetas)

    def torque_at(self, q: Array, qd: float = 0.0) -> Array:
        """Return ``torque`` (N, n) at positions q (N, n) [N m], where all joints move at one
        velocity qd that does not change.
        """
        zero = np.zeros_like(q)
        return self.torque(motion_of_samples(q, zero + qd, zero))


def motion_of_samples(q: Array, qd: Array, qdd: Array) -> Motion:
    """Return samples (N, n) as a motion; neither torques nor limits depend on their times."""
    return Motion(np.arange(float(len(q))), q, qd, qdd)
