"""The problem of a new motion: the arm, its limits and the distances that bodies have to keep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import (
    ArmDynamics,
    LinkDynamics,
    other_links,
    split_motion,
    subtree,
)
from robot_sysid.estimate.links import link_factor
from robot_sysid.model.chain import DEFAULT_SLIDE_VELOCITY
from robot_sysid.motion import TOP_FREQUENCY_HZ, HalfSpace, LimitOptions
from robot_sysid.motion.clearance import Clearance
from robot_sysid.motion.solids import mounting_plane, tool_corners, unguarded_links
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.records.levels import INTERVAL
from robot_sysid.records.option_fields import (
    DEFAULT_MAX_VELOCITY,
    PerJoint,
    joint_values,
)
from robot_sysid.spatial import N_INERTIAL
from robot_sysid.trajectory import (
    POSITION_MARGIN,
    TORQUE_MARGIN,
    UNLIMITED_RANGE,
    TorqueFunction,
)
from robot_sysid.wording import option_name

LIMIT_NAMES = ("position", "velocity", "acceleration", "torque")
"""The families of joint limits, in the order of their columns."""
LIMIT_SHARE = 0.99
"""Share of the limits the search uses; the rest covers peaks between grid points.

A peak between two of 25 points per period is cos(pi / 25) = 0.992 of itself at the nearer one.
"""
OBSTACLE_LENGTH = 0.05
"""A slack of minus this length [m] counts as much as exceeding a limit by 100 %."""
ROUNDING = 1e-9
"""Share of a limit by which rounding may exceed it: the motion may start exactly at one."""
DEFAULT_NOISE_TORQUE = 0.3
"""Torque noise that a plan predicts errors for where none is given [N m]."""


@dataclass(frozen=True)
class MotionLimits:
    """Limits of a motion, (n,) each; infinite where there is none, but for positions.

    Attributes:
        lower: (n,) smallest positions, with the margin already added [rad or m].
        upper: (n,) largest positions, with the margin already subtracted [rad or m].
        velocity: largest absolute speed of each joint [rad/s or m/s].
        acceleration: largest absolute acceleration of each joint [rad/s^2 or m/s^2].
        torque: largest absolute torque of each joint [N m or N].
        tool_speed: largest speed of the tool's fastest point, one number [m/s].
        assumed: (3, n) whether a joint's limit of position, velocity and acceleration is stated
            neither by the model nor by an option.
    """

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    torque: Array
    tool_speed: float
    assumed: NDArray[np.bool_]

    @property
    def center(self) -> Array:
        """Middle of the position limits (n,) [rad or m]."""
        return 0.5 * (self.lower + self.upper)

    @property
    def columns(self) -> Array:
        """Limits (4 n + 1,) of the columns of ``ExcitationProblem.signals``."""
        span = 0.5 * (self.upper - self.lower)
        joints = (span, self.velocity, self.acceleration, self.torque)
        return np.append(joints, self.tool_speed)


@dataclass(frozen=True)
class ExcitationProblem:
    """One arm with everything that a search for motions and a check of limits need.

    Attributes:
        robot: the arm.
        rest: (n,) configuration in which the motion starts and ends [rad].
        limits: of joints and of the tool.
        links: L indices in ``robot.links`` of the links with mass: the terminal one, then the
            others from the base on.
        dynamics: motion of all links.
        tool: (8, 3) corners of a box about the terminal link and all it carries, in the terminal
            body's frame [m]. Speed is a convex function of the point, so that the fastest one is a
            corner.
        arm_torque: joint torques (N, n) along a motion, friction included, without any load.
        reserve: the heaviest load at the tip of the tool that torque limits hold for too [kg].
        link_errors: (10 L, 10 L) factor of the prior covariance of all links' parameters; zero
            where the links are taken as they are.
        rows: indices of the chain joints whose torque will be used.
        sigma: (len(rows),) standard deviation of the noise of these torques [N m].
        obstacles: distances between bodies that have to be kept.
        notes: sentences for the user on these limits.
        unguarded: names of the moving links without collision geometry.
    """

    robot: RobotModel
    rest: Array
    limits: MotionLimits
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
        torque = self.arm_torque(motion)
        if self.reserve > 0.0:
            loaded = torque + self.reserve * self.torque_per_kilogram(motion)
            torque = np.where(np.abs(loaded) > np.abs(torque), loaded, torque)
        return torque + np.copysign(self.torque_reserve(motion), torque)

    def torque_reserve(self, motion: Motion) -> Array:
        """Return the torques (N, n) reserved for errors of the links [N m]: two standard deviations
        of each torque; zero at joints without a torque limit.
        """
        is_limited = np.isfinite(self.limits.torque)
        if not (np.any(self.link_errors) and np.any(is_limited)):
            return np.zeros_like(motion.q)
        deviations = []
        rates = motion.q, motion.qd, motion.qdd
        # The regressor and its product with the errors are in memory at a time.
        for chunk in split_motion(2 * self.n_joints * len(self.link_errors), *rates):
            regressor = self.dynamics.motion(*chunk).columns(self.links)
            deviations.append(np.linalg.norm(regressor @ self.link_errors, axis=2))
        return INTERVAL * is_limited * np.concatenate(deviations)

    def torque_per_kilogram(self, motion: Motion) -> Array:
        """Return the torques (N, n) that a load at the tool's tip adds, per kilogram [N m/kg].

        The tip is the corner of the tool's box that is farthest from the terminal body's origin.
        """
        tip = self.tool[np.argmax(np.linalg.norm(self.tool, axis=1))]
        thetas = np.zeros((self.n_joints, N_INERTIAL))
        # A point mass of 1 kg.
        thetas[-1] = spatial.theta_from_com(1.0, tip, np.zeros((3, 3)))
        return self.dynamics.motion(motion.q, motion.qd, motion.qdd).torque(thetas)

    def torque_at(self, q: Array, qd: float = 0.0) -> Array:
        """Return ``torque`` (N, n) at positions q (N, n) [N m], where all joints move at one
        velocity qd that does not change.
        """
        zero = np.zeros_like(q)
        return self.torque(motion_of_samples(q, zero + qd, zero))

    @property
    def signal_names(self) -> tuple[str, ...]:
        """Names (4 n + 1,) of the limits of the columns of ``signals``."""
        names = []
        for family in LIMIT_NAMES:
            names += [f"{family} limit of joint {joint}" for joint in self.joint_names]
        return (*names, "speed limit of the tool")

    def signals(self, motion: Motion) -> Array:
        """Return the quantities that have limits (N, 4 n + 1): distance from the middle of the
        range, speed, acceleration and torque of all joints, and speed of the tool's fastest point.
        """
        offset = motion.q - self.limits.center
        links = self.dynamics.motion(motion.q, motion.qd, motion.qdd)
        spin, velocity = np.split(links.velocity[-1][:, None], 2)
        corners = velocity + spatial.cross(spin, self.tool.T[:, :, None])
        fastest = np.max(np.linalg.norm(corners, axis=0), axis=0)
        torque = self.torque(motion)
        return np.column_stack((offset, motion.qd, motion.qdd, torque, fastest))

    @property
    def scale(self) -> Array:
        """Typical magnitudes (10,) of the inertial parameters: m, m L, m L^2."""
        theta = self.robot.prior.theta
        return spatial.parameter_scale(theta[0], spatial.characteristic_length(theta))


def motion_of_samples(q: Array, qd: Array, qdd: Array) -> Motion:
    """Return samples (N, n) as a motion; neither torques nor limits depend on their times."""
    return Motion(np.arange(float(len(q))), q, qd, qdd)


def build_problem(
    robot: RobotModel,
    limits: LimitOptions,
    torques: str = "chain",
    noise_torque: PerJoint = DEFAULT_NOISE_TORQUE,
    shakes_gently: bool = True,
    link_uncertainty: float = 0.0,
) -> ExcitationProblem:
    """Return the problem of a motion of an arm: its limits, obstacles and dynamics.

    Args:
        robot: the arm.
        limits: options that limit its motion.
        torques: "chain" or "terminal": which joint torques will be used.
        noise_torque: standard deviation of the torque noise [N m], one number or one per joint.
        shakes_gently: where no acceleration limit is given, whether there is the one that full
            speed at the top of the usual band needs.
        link_uncertainty: how far the links may be off [%]; torque is reserved for that.

    Raises:
        InputError: the arm breaks a limit already at rest; says which.
    """
    motion_limits = _limits(robot, limits, shakes_gently)
    # A motion that starts outside what the search uses would break its limits, however small.
    center = motion_limits.center
    span = LIMIT_SHARE * (motion_limits.upper - center)
    start_pose = np.clip(robot.reference, center - span, center + span)
    moved = [
        f"{name} at {q:.3f} instead of {reference:.3f}"
        for name, q, reference in zip(robot.joint_names, start_pose, robot.reference)
        if q != reference
    ]
    note = (
        "the reference configuration is at or beyond a position limit; the motion starts and "
        f"ends with {', '.join(moved)}"
    )
    spaces = _half_spaces(robot, limits, start_pose)
    n_joints = robot.n_joints
    links = (n_joints - 1, *other_links(robot))
    rows = tuple(range(0 if torques == "chain" else n_joints - 1, n_joints))
    return ExcitationProblem(
        robot=robot,
        rest=start_pose,
        limits=motion_limits,
        links=links,
        dynamics=LinkDynamics(robot),
        tool=tool_corners(robot),
        arm_torque=ArmDynamics(robot),
        reserve=limits.payload_reserve,
        link_errors=link_factor(robot, links, 0.01 * link_uncertainty),
        obstacles=Clearance(robot, start_pose, limits.clearance, spaces),
        rows=rows,
        sigma=joint_values(noise_torque, robot.n_joints, "the prior noise")[list(rows)],
        notes=(note,) if moved else (),
        unguarded=unguarded_links(robot),
    )


def _position_limits(robot: RobotModel) -> tuple[Array, Array]:
    """Return the lower and upper position limits (n,) of a motion [rad or m]: those of the model
    less a margin, or an assumed range about the reference where the model has none.
    """
    lower = robot.limits.lower
    upper = robot.limits.upper
    assumed = np.where(robot.is_slide, UNLIMITED_RANGE[True], UNLIMITED_RANGE[False])
    assumed_lower = np.minimum(robot.reference, upper) - 0.5 * assumed
    lower = np.where(np.isfinite(lower), lower, assumed_lower)
    assumed_upper = np.maximum(robot.reference, lower) + 0.5 * assumed
    upper = np.where(np.isfinite(upper), upper, assumed_upper)
    margin = POSITION_MARGIN * (upper - lower)
    return lower + margin, upper - margin


def _limits(
    robot: RobotModel, options: LimitOptions, shakes_gently: bool
) -> MotionLimits:
    """Return the limits of a motion; ``shakes_gently`` is as in ``build_problem``."""
    model_limits = robot.limits
    is_slide = robot.is_slide
    top = TOP_FREQUENCY_HZ if shakes_gently else np.inf
    # The acceleration of a sinusoid of this frequency that reaches the speed limit.
    natural = 2.0 * np.pi * top * model_limits.velocity

    is_natural = is_slide | (options.max_acceleration is None)
    acceleration = np.where(is_natural, natural, options.max_acceleration or 0.0)
    torque = joint_values(
        options.max_torque or np.inf, robot.n_joints, option_name("max_torque")
    )
    # The robot's velocity limits are those of ``--max-velocity`` (for slides, at most the default)
    # unless the model states lower ones.
    speed = joint_values(
        options.max_velocity, robot.n_joints, option_name("max_velocity")
    )
    default_speed = np.where(is_slide, np.minimum(DEFAULT_SLIDE_VELOCITY, speed), speed)
    is_default = is_slide | (speed == DEFAULT_MAX_VELOCITY)
    has_range = np.isfinite(model_limits.lower) & np.isfinite(model_limits.upper)
    is_usual_speed = is_default & (model_limits.velocity >= default_speed)
    is_usual_acceleration = is_natural & np.isfinite(acceleration)
    return MotionLimits(
        *_position_limits(robot),
        velocity=model_limits.velocity,
        acceleration=acceleration,
        torque=TORQUE_MARGIN * np.minimum(model_limits.torque, torque),
        tool_speed=options.max_tool_speed or np.inf,
        assumed=np.stack((~has_range, is_usual_speed, is_usual_acceleration)),
    )


def _half_spaces(
    robot: RobotModel, options: LimitOptions, start_pose: Array
) -> tuple[HalfSpace, ...]:
    """Return the half-spaces of the options, and the one above the body that carries the arm.

    There is none above it where an option allows to go below it, the model has a floor, or a
    keep-out plane is one. The base's height is taken with the joints at ``start_pose`` (n,).
    """
    model = robot.mj_model
    moving = subtree(model, model.dof_bodyid[robot.dof_index[0]])
    spaces = options.half_spaces(moving, subtree(model, robot.body_id))
    base = mounting_plane(robot, start_pose)
    if options.below_base or base is None:
        return spaces
    # The cosine of a slope: a plane that is less steep is a ground.
    is_ground = [space.normal @ base.normal > 0.9 for space in spaces]
    return spaces if any(is_ground) else (*spaces, base)
