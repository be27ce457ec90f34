"""The problem of a new motion: the arm, its limits and the distances that bodies have to keep."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import (
    ArmDynamics,
    LinkDynamics,
    LinksMotion,
    other_links,
    subtree,
)
from robot_sysid.estimate.links import link_factor
from robot_sysid.model.chain import DEFAULT_SLIDE_VELOCITY
from robot_sysid.motion import LimitOptions
from robot_sysid.motion.clearance import Clearance, unguarded_links
from robot_sysid.motion.mounting import mounting_plane
from robot_sysid.motion.planes import tool_corners
from robot_sysid.records import Array, Limits, Motion, RobotModel
from robot_sysid.records.levels import INTERVAL
from robot_sysid.records.option_fields import (
    DEFAULT_MAX_VELOCITY,
    TOP_FREQUENCY_HZ,
    PerJoint,
    joint_values,
)
from robot_sysid.spatial import N_INERTIAL
from robot_sysid.trajectory import (
    POSITION_MARGIN,
    TORQUE_MARGIN,
    TorqueFunction,
    assumed_reach,
)

LIMIT_SHARE = 0.99
"""Share of the limits the search uses; the rest covers peaks between grid points.

A peak between two of 25 points per period is cos(pi / 25) = 0.992 of itself at the nearer one.
"""
OBSTACLE_LENGTH = 0.05
"""A slack of minus this length [m] counts as much as exceeding a limit by 100 %."""
LEVEL_COSINE = 0.9
"""Cosine of the steepest slope, of 26 degrees, of a half-space that is the ground itself."""
DEFAULT_NOISE_TORQUE = 0.3
"""Torque noise that a plan predicts errors for where none is given [N m]."""


@dataclass(frozen=True)
class ExcitationProblem:
    """One arm with everything that a search for motions and a check of limits need.

    Attributes:
        robot: the arm.
        rest: (n,) configuration in which the motion starts and ends [rad].
        limits: that the motion may use, with margins already taken off; all positions have some.
        assumed: (3, n) whether a joint's limit of position, velocity and acceleration is stated
            neither by the model nor by an option.
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
        obstacles: distances between bodies that have to be kept.
        notes: sentences for the user on these limits.
        unguarded: names of the moving links without collision geometry.
    """

    robot: RobotModel
    rest: Array
    limits: Limits
    assumed: NDArray[np.bool_]
    links: tuple[int, ...]
    dynamics: LinkDynamics
    tool: Array
    arm_torque: TorqueFunction
    reserve: float
    link_errors: Array
    obstacles: Clearance
    rows: tuple[int, ...]
    sigma: Array
    notes: tuple[str, ...]
    unguarded: tuple[str, ...]

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
        return self._torque(motion, self.links_motion(motion))

    def links_motion(self, motion: Motion) -> LinksMotion:
        """Return the motion of all links in a motion of the joints."""
        return self.dynamics.motion(motion.q, motion.qd, motion.qdd)

    def _torque(self, motion: Motion, links: LinksMotion) -> Array:
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

    @property
    def missing_limits(self) -> Iterator[str]:
        """Sentences on what nothing limits: contacts of links, torques of joints."""
        if self.unguarded:
            yield (
                f"nothing keeps {', '.join(self.unguarded)} from touching anything: the model has "
                "no collision geometry there that can meet any other"
            )
        names = np.array(self.joint_names)[np.isinf(self.limits.torque)]
        if len(names):
            yield (
                f"no torque limit of {', '.join(names)} is known: the model states none (an "
                "effort of 0 is none)"
            )

    @property
    def owners(self) -> list[str]:
        """The joints in words, as owners of limits."""
        return [f"joint {name}" for name in self.joint_names]

    def signals(self, motion: Motion) -> Array:
        """Return the quantities that have limits (N, m), see ``Limits.signals``."""
        links = self.links_motion(motion)
        spin, velocity = np.split(links.velocity[-1][:, None], 2)
        corners = velocity + spatial.cross(spin, self.tool.T[:, :, None])
        fastest = np.max(np.linalg.norm(corners, axis=0), axis=0)
        torque = self._torque(motion, links)
        return self.limits.signals(motion.q, motion.qd, motion.qdd, torque, fastest)


def motion_of_samples(q: Array, qd: Array, qdd: Array) -> Motion:
    """Return samples (N, n) as a motion; neither torques nor limits depend on their times."""
    return Motion(np.arange(float(len(q))), q, qd, qdd)


def build_problem(
    robot: RobotModel,
    options: LimitOptions,
    torques: str = "chain",
    noise_torque: PerJoint = DEFAULT_NOISE_TORQUE,
    shakes_gently: bool = True,
    link_uncertainty: float = 0.0,
    motors: Limits | None = None,
) -> ExcitationProblem:
    """Return the problem of a motion of an arm: its limits, obstacles and dynamics.

    Args:
        robot: the arm.
        options: that limit its motion.
        torques: "chain" or "terminal": which joint torques will be used.
        noise_torque: standard deviation of the torque noise [N m], one number or one per joint.
        shakes_gently: where no acceleration limit is given, whether there is the one that full
            speed at the top of the usual band needs.
        link_uncertainty: how far the links may be off [%]; torque is reserved for that.
        motors: limits of the motors that will play it.

    Raises:
        InputError: the arm breaks a limit already at rest; says which.
    """
    model = robot.mj_model
    moving = subtree(model, model.dof_bodyid[robot.dof_index[0]])
    user = options.limits(robot.is_slide, moving, subtree(model, robot.body_id))
    stated = Limits.of(robot.limits, user, motors or Limits())
    limits, assumed = _usable_limits(robot, stated, user, shakes_gently)
    # A motion that starts outside what the search uses would break its limits, however small.
    span = LIMIT_SHARE * limits.span
    start_pose = np.clip(robot.reference, limits.center - span, limits.center + span)
    moved = [
        name
        for name, q, reference in zip(robot.joint_names, start_pose, robot.reference)
        if q != reference
    ]
    note = (
        f"the model's pose at rest is at or beyond a position limit of {', '.join(moved)}; the "
        "motion starts and ends within it"
    )
    if not options.below_base:
        limits = _above_base(robot, limits, start_pose)
    n_joints = robot.n_joints
    links = (n_joints - 1, *other_links(robot))
    rows = tuple(range(0 if torques == "chain" else n_joints - 1, n_joints))
    return ExcitationProblem(
        robot=robot,
        rest=start_pose,
        limits=limits,
        assumed=assumed,
        links=links,
        dynamics=LinkDynamics(robot),
        tool=tool_corners(robot),
        arm_torque=ArmDynamics(robot),
        reserve=options.payload_reserve,
        link_errors=link_factor(
            robot, sorted(links, reverse=True), 0.01 * link_uncertainty
        ),
        obstacles=Clearance(robot, start_pose, limits),
        rows=rows,
        sigma=joint_values(noise_torque, robot.n_joints, "the prior noise")[list(rows)],
        notes=(note,) if moved else (),
        unguarded=unguarded_links(robot),
    )


def _usable_limits(
    robot: RobotModel, stated: Limits, user: Limits, shakes_gently: bool
) -> tuple[Limits, NDArray[np.bool_]]:
    """Return what a motion may use of stated limits: all but a margin, with usual limits where none
    are stated; and ``ExcitationProblem.assumed``.

    Args:
        robot: the arm.
        stated: limits by the model, the user and motors.
        user: limits by the user alone.
        shakes_gently: as in ``build_problem``.
    """
    is_slide = robot.is_slide
    # The acceleration of a sinusoid of this frequency that reaches the speed limit.
    top = TOP_FREQUENCY_HZ if shakes_gently else np.inf
    is_natural = np.isinf(stated.acceleration)
    acceleration = np.where(
        is_natural, 2.0 * np.pi * top * stated.velocity, stated.acceleration
    )
    usual_speed = np.where(is_slide, DEFAULT_SLIDE_VELOCITY, DEFAULT_MAX_VELOCITY)
    is_usual_speed = is_slide | (user.velocity == DEFAULT_MAX_VELOCITY)
    assumed = (
        ~stated.has_range,
        is_usual_speed & (stated.velocity == usual_speed),
        is_natural & np.isfinite(acceleration),
    )
    ranged = stated.around(robot.reference, assumed_reach(robot))
    margin = 2.0 * POSITION_MARGIN * ranged.span
    usable = replace(
        ranged,
        lower=ranged.lower + margin,
        upper=ranged.upper - margin,
        acceleration=acceleration,
        torque=TORQUE_MARGIN * stated.torque,
    )
    return usable, np.stack(assumed)


def _above_base(robot: RobotModel, limits: Limits, start_pose: Array) -> Limits:
    """Return the limits with the half-space above the body that carries the arm.

    There is none where the model has a floor, or a half-space is one. The base's height is taken
    with the joints at ``start_pose`` (n,).
    """
    base = mounting_plane(robot, start_pose)
    if base is None:
        return limits
    slopes = [space.normal @ base.normal for space in limits.spaces]
    if any(slope > LEVEL_COSINE for slope in slopes):
        return limits
    return replace(limits, spaces=(*limits.spaces, base))
