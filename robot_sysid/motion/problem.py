"""An excitation problem: arm, limits and what must not be touched, as the search sees them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.equations import N_INERTIAL, other_links
from robot_sysid.dynamics.inverse_dynamics import subtree
from robot_sysid.dynamics.newton_euler import LinkDynamics, split_motion
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.priors import model_link_factor
from robot_sysid.model.chain import DEFAULT_SLIDE_VELOCITY
from robot_sysid.motion.clearance import Clearance
from robot_sysid.motion.plan_options import TOP_FREQUENCY_HZ, HalfSpace, LimitOptions
from robot_sysid.motion.solids import has_floor, mounting_height, outermost_points
from robot_sysid.records import Array, JointLimits, Motion, RobotModel
from robot_sysid.records.messages import Detail
from robot_sysid.records.option_fields import (
    DEFAULT_MAX_VELOCITY,
    PerJoint,
    joint_values,
)
from robot_sysid.simulator import ArmTorque
from robot_sysid.trajectory import (
    POSITION_MARGIN,
    TORQUE_MARGIN,
    UNLIMITED_RANGE,
    TorqueFunction,
)

LIMIT_NAMES = ("position", "velocity", "acceleration", "torque")
"""The families of joint limits, in the order of their columns."""
OBSTACLE_LENGTH = 0.05
"""A slack of minus this length [m] counts as much as exceeding a limit by 100 %."""
ROUNDING = 1e-9
"""Share of a limit by which rounding may exceed it: the motion may start exactly at one."""
DEFAULT_NOISE_TORQUE = 0.3
"""Torque noise that a plan predicts errors for where none is given [N m]."""
RESERVED_DEVIATIONS = 2.0
"""Standard deviations of a joint's torque, as the links' errors make it, that a motion leaves."""
RESERVE_WORDS = ", with the reserve for errors of the links"
"""What the name of a torque limit ends with that a reserve is kept of."""
_LEVEL = 0.9
"""Cosine of the slope up to which a plane that is asked for says where the ground is."""
MODEL = "the model"
ASKED = "the options"
ASSUMED = "an assumption"
NONE = "nothing"
"""Where a limit may come from."""


@dataclass(frozen=True)
class MotionLimits(JointLimits):
    """What the motion must obey, each (n,) [rad or m, s, N m or N]; infinite without a limit.

    Positions are finite, with the margin already taken off. The speed is that of the tool's fastest
    point [m/s].
    """

    acceleration: Array
    tool_speed: float = np.inf

    def __post_init__(self) -> None:
        if not np.all((self.lower < self.upper) & np.isfinite(self.upper - self.lower)):
            raise InputError(
                "position limits must be finite, with lower < upper for every joint"
            )
        for name in ("velocity", "acceleration", "torque"):
            if not np.all(getattr(self, name) > 0.0):
                raise InputError(f"{name} limits must be positive")

    @property
    def center(self) -> Array:
        """Middle of the position limits (n,) [rad or m]."""
        return 0.5 * (self.lower + self.upper)

    @property
    def largest(self) -> Array:
        """Largest distance from the center, speed, acceleration and torque (4, n)."""
        span = 0.5 * (self.upper - self.lower)
        return np.stack((span, self.velocity, self.acceleration, self.torque))

    @property
    def columns(self) -> Array:
        """Limits (4 n + 1,) of the columns of ``ExcitationProblem.signals``."""
        return np.append(self.largest, self.tool_speed)


@dataclass(frozen=True)
class Tool:
    """The terminal body and all it carries, by its outermost points.

    A point p of the body moves at v + w x p, so its speed is a convex function of p and the fastest
    point is a corner of the body, or in the ball that stands for what is round about one.

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
        at = np.argmax(speeds, axis=0)
        each = np.arange(twist.shape[1])
        along = _unit(velocity[:, at, each])
        point = self.points[at].T
        turning = _unit(twist[:3]) * self.radius[at]
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
class ExcitationProblem:
    """One arm, ready for the search.

    Attributes:
        rest: (n,) where the motion starts and ends [rad].
        links: numbers (L,) of links with mass, the terminal one first; they descend, so that a
            joint's equations have the first ones alone.
        dynamics: motion of all links.
        tool: the outermost points of the terminal link and all it carries.
        arm_torque: joint torques (N, n) along a motion, friction included, without any load.
        reserve: the heaviest load at the tip of the tool that torque limits hold for too [kg].
        link_errors: (10 L, 10 L) factor of the prior covariance of all links' parameters; zero
            where the links are taken as they are.
        rows: chain joints whose torque will be used.
        sigma: (len(rows),) standard deviation of their noise [N m].
        origins: per family in ``LIMIT_NAMES`` where the limit of each joint (n,) comes from.
        notes: what the reader should know about these limits.
        has_floor: whether anything keeps the arm above the ground.
    """

    robot: RobotModel
    rest: Array
    limits: MotionLimits
    links: tuple[int, ...]
    dynamics: LinkDynamics
    tool: Tool
    arm_torque: TorqueFunction
    reserve: float
    link_errors: Array
    obstacles: Clearance
    rows: tuple[int, ...]
    sigma: Array
    origins: Mapping[str, NDArray[np.str_]]
    notes: tuple[str, ...] = ()
    has_floor: bool = True

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the chain joints."""
        return self.robot.joint_names

    @property
    def n_joints(self) -> int:
        """Number of chain joints n."""
        return self.robot.n_joints

    def torque(self, motion: Motion) -> Array:
        """Return the torques (N, n) that have to be kept within limits [N m].

        Each is the larger one of without and with the load that is reserved, and farther from zero
        by the reserve for the links' errors.
        """
        torque = self.arm_torque(motion)
        if self.reserve > 0.0:
            loaded = torque + self.reserve * self.torque_per_kilogram(motion)
            torque = np.where(np.abs(loaded) > np.abs(torque), loaded, torque)
        return torque + np.copysign(self.torque_reserve(motion), torque)

    @property
    def has_torque_reserve(self) -> bool:
        """Whether torque is left for the links' errors: something limits it, and they have some."""
        return bool(np.any(self.link_errors)) and bool(
            np.any(np.isfinite(self.limits.torque))
        )

    def torque_reserve(self, motion: Motion) -> Array:
        """Return the torques (N, n) that are left for what the links may be off [N m]: two standard
        deviations of each torque; zero at joints without a torque limit.
        """
        if not self.has_torque_reserve:
            return np.zeros_like(motion.q)
        deviations = []
        rates = motion.q, motion.qd, motion.qdd
        # The regressor and its product with the errors are held at a time.
        for part in split_motion(2 * self.n_joints * len(self.link_errors), *rates):
            regressor = self.dynamics.motion(*part).columns(self.links)
            deviations.append(np.linalg.norm(regressor @ self.link_errors, axis=2))
        limited = np.isfinite(self.limits.torque)
        return RESERVED_DEVIATIONS * limited * np.concatenate(deviations)

    def torque_per_kilogram(self, motion: Motion) -> Array:
        """Return the torques (N, n) that a load at the tool's tip adds, per kilogram [N m/kg]."""
        thetas = np.zeros((self.n_joints, N_INERTIAL))
        thetas[-1] = spatial.theta_from_com(1.0, self.tool.tip, np.zeros((3, 3)))
        return self.dynamics.motion(motion.q, motion.qd, motion.qdd).torque(thetas)

    def load_left(self, motion: Motion) -> tuple[float, int]:
        """Return the heaviest load [kg] that keeps all torque limits, and the joint that ends it.

        Infinite where no torque is limited, negative where the arm alone is beyond a limit.
        """
        torque = self.arm_torque(motion)
        more = self.torque_per_kilogram(motion)
        limit = self.limits.torque - self.torque_reserve(motion)
        room = np.where(more >= 0.0, limit - torque, limit + torque)
        room = np.where(np.abs(torque) > limit, limit - np.abs(torque), room)
        share = (
            np.abs(more) > 1e-12
        )  # More than rounding leaves of a load that a joint carries.
        left = np.where(share, room / np.where(share, np.abs(more), 1.0), np.inf)
        least = np.min(left, axis=0)
        return float(np.min(least)), int(np.argmin(least))

    def torque_at(
        self, q: Array, qd: Array | float = 0.0, qdd: Array | float = 0.0
    ) -> Array:
        """Return the torques (N, n) at positions (N, n), at rest if nothing else is said [N m]."""
        still = np.zeros_like(q)
        return self.torque(Motion(np.arange(float(len(q))), q, still + qd, still + qdd))

    @property
    def signal_names(self) -> tuple[str, ...]:
        """What the columns of ``signals`` are limited by, in words."""
        names = [
            f"{kind} limit of joint {j}"
            for kind in LIMIT_NAMES
            for j in self.joint_names
        ]
        if self.has_torque_reserve:
            torques = [f"{name}{RESERVE_WORDS}" for name in names[-self.n_joints :]]
            names = [*names[: -self.n_joints], *torques]
        return (*names, "speed limit of the tool")

    def signals(
        self, motion: Motion, torque: bool = False, tool: bool = False
    ) -> Array:
        """Return what has limits (N, 4 n + 1): for each joint, and for the tool.

        Distance from the middle of the range, speed, acceleration and torque of all joints, and the
        speed of the tool's fastest point. The torques and the speed of the tool are zero where
        nothing limits them, unless they are asked for.
        """
        needed = np.zeros_like(motion.q)
        fastest = np.zeros(len(motion.q))
        if torque or np.any(np.isfinite(self.limits.torque)):
            needed = self.torque(motion)
        if tool or np.isfinite(self.limits.tool_speed):
            links = self.dynamics.motion(motion.q, motion.qd, motion.qdd)
            fastest = self.tool.speed(links.velocity[-1])
        place = motion.q - self.limits.center
        return np.column_stack((place, motion.qd, motion.qdd, needed, fastest))

    @property
    def scale(self) -> Array:
        """Typical magnitudes (10,) of the inertial parameters: m, m L, m L^2."""
        theta = self.robot.prior.theta
        return spatial.parameter_scale(
            float(theta[0]), spatial.characteristic_length(theta)
        )


def build_problem(
    robot: RobotModel,
    limits: LimitOptions,
    torques: str = "chain",
    noise_torque: PerJoint = DEFAULT_NOISE_TORQUE,
    top_frequency_hz: float | None = TOP_FREQUENCY_HZ,
    link_uncertainty: float = 0.0,
) -> ExcitationProblem:
    """Collect what a search or a limit check needs to know about an arm.

    Args:
        robot, limits: the arm, and what its motion has to obey.
        torques: "chain" or "terminal": which joint torques will be used.
        noise_torque: standard deviation of the torque noise [N m], one number or one per joint.
        top_frequency_hz: where no acceleration limit is given, the one that full speed at this
            frequency needs [Hz], or at that of the usual band where this is higher: a motion with
            faster harmonics shall not shake the arm harder. None leaves accelerations free.
        link_uncertainty: how far the links may be off [%]; torque is reserved for that.

    Raises:
        InputError: the arm breaks a limit already at rest; says which.
    """
    motion_limits, origins = _limits(robot, limits, top_frequency_hz)
    rest = np.clip(robot.reference, motion_limits.lower, motion_limits.upper)
    names = zip(robot.joint_names, rest, robot.reference)
    moved = [
        f"{name} at {q:.3f} instead of {own:.3f}" for name, q, own in names if q != own
    ]
    words = "the reference configuration is at or beyond a position limit; the motion starts and"
    notes = (f"{words} ends with {', '.join(moved)}",) if moved else ()
    base = _above_base(robot, limits, rest)
    obstacles, more = _obstacles(robot, limits, rest, base)
    links = (robot.n_joints - 1, *reversed(other_links(robot)))
    rows = tuple(range(robot.n_joints)) if torques == "chain" else (robot.n_joints - 1,)
    return ExcitationProblem(
        robot=robot,
        rest=rest,
        limits=motion_limits,
        links=links,
        dynamics=LinkDynamics(robot),
        tool=Tool(*outermost_points(robot)),
        arm_torque=ArmTorque(robot),
        reserve=limits.payload_reserve,
        link_errors=model_link_factor(robot, links, 0.01 * link_uncertainty),
        obstacles=obstacles,
        rows=rows,
        sigma=joint_values(noise_torque, robot.n_joints, "--noise-torque")[list(rows)],
        origins=origins,
        notes=notes + more,
        has_floor=bool(base or limits.keep_out or limits.workspace) or has_floor(robot),
    )


def _position_limits(robot: RobotModel) -> tuple[Array, Array]:
    """Return position limits with the margin taken off; an assumed range where there are none."""
    lower = robot.limits.lower
    upper = robot.limits.upper
    assumed = 0.5 * np.where(
        robot.is_slide, UNLIMITED_RANGE[True], UNLIMITED_RANGE[False]
    )
    lower = np.where(
        np.isfinite(lower), lower, np.minimum(robot.reference, upper) - assumed
    )
    upper = np.where(
        np.isfinite(upper), upper, np.maximum(robot.reference, lower) + assumed
    )
    margin = POSITION_MARGIN * (upper - lower)
    return lower + margin, upper - margin


def _limits(
    robot: RobotModel, options: LimitOptions, top_frequency_hz: float | None
) -> tuple[MotionLimits, Mapping[str, NDArray[np.str_]]]:
    """Return the limits, and per family in ``LIMIT_NAMES`` where that of each joint comes from."""
    own = robot.limits
    slide = robot.is_slide
    asked = options.max_acceleration
    top = (
        np.inf if top_frequency_hz is None else min(top_frequency_hz, TOP_FREQUENCY_HZ)
    )
    natural = 2.0 * np.pi * top * own.velocity
    lower, upper = _position_limits(robot)
    strongest = np.inf if options.max_torque is None else options.max_torque
    most = joint_values(strongest, robot.n_joints, "--max-torque")
    limits = MotionLimits(
        lower=lower,
        upper=upper,
        velocity=own.velocity,
        acceleration=natural if asked is None else np.where(slide, natural, asked),
        torque=TORQUE_MARGIN * np.minimum(own.torque, most),
        tool_speed=np.inf if options.max_tool_speed is None else options.max_tool_speed,
    )
    speed = joint_values(options.max_velocity, robot.n_joints, "--max-velocity")
    usual = np.where(slide, np.minimum(DEFAULT_SLIDE_VELOCITY, speed), speed)
    by_default = slide | (speed == DEFAULT_MAX_VELOCITY)
    ranged = np.isfinite(own.lower) & np.isfinite(own.upper)
    shaken = np.isfinite(limits.acceleration)
    as_strong = limits.torque >= TORQUE_MARGIN * own.torque
    origins = {
        "position": np.where(ranged, MODEL, ASSUMED),
        "velocity": np.where(
            own.velocity < usual, MODEL, np.where(by_default, ASSUMED, ASKED)
        ),
        "acceleration": np.where(
            shaken, np.where(slide | (asked is None), ASSUMED, ASKED), NONE
        ),
        "torque": np.where(as_strong, MODEL, ASKED),
    }
    origins["torque"][~np.isfinite(limits.torque)] = NONE
    return limits, origins


def _above_base(
    robot: RobotModel, options: LimitOptions, rest: Array
) -> tuple[HalfSpace, ...]:
    """Return the space above what carries the arm, where nothing else says how low it may get."""
    found = mounting_height(robot, rest)
    if options.below_base or has_floor(robot) or found is None:
        return ()
    up, height, bodies = found
    if any(space.normal @ up > _LEVEL for space in options.half_spaces(bodies)):
        return ()
    label = f"the plane that the arm is mounted on, at {height + 0.0:.3g} m (--below-base lifts it)"
    return (HalfSpace(up, height, 0.0, tuple(bodies), label),)


def _obstacles(
    robot: RobotModel, options: LimitOptions, rest: Array, base: tuple[HalfSpace, ...]
) -> tuple[Clearance, tuple[str, ...]]:
    model = robot.mj_model
    moving = subtree(model, int(model.jnt_bodyid[model.dof_jntid[robot.dof_index[0]]]))
    spaces = (*options.half_spaces(moving, subtree(model, robot.body_id)), *base)
    clearance = Clearance(robot, rest, options.clearance, spaces)
    none: tuple[str, ...] = ()
    if not clearance.is_solid:
        none = (
            "the model has no collision geometry; nothing keeps the arm from touching itself",
        )
    if clearance.outside_at_rest:
        space, body, depth = max(clearance.outside_at_rest, key=lambda entry: entry[2])
        raise InputError(
            f"no trajectory is feasible: at rest, body {body} is {1000 * depth:.0f} mm beyond "
            f"{space.label}; move that limit, or change the model's reference configuration"
        )
    pairs = clearance.at_rest
    said = (
        "links that overlap by design, next to each other or in every position, are not looked at",
        "touching already at rest, and never to get deeper",
        "so near at rest that they keep half that distance, less than elsewhere",
    )
    listed = ("; ".join(pairs[kind]) for kind in ("ignored", "touching", "near"))
    told = (Detail(f"{words}: {which}") for words, which in zip(said, listed) if which)
    return clearance, (*none, *told)
