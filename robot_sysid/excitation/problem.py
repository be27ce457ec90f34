"""An excitation problem: arm, limits and what must not be touched, as the search sees them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from robot_sysid.collision.clearance import Clearance
from robot_sysid.collision.halfspaces import HalfSpace, box_half_spaces, plane_half_space
from robot_sysid.collision.obstacles import NoObstacles, Obstacles
from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.kinematics import ArmDynamics, ChainKinematics, subtree
from robot_sysid.dynamics.screws import ScrewChain
from robot_sysid.errors import InputError
from robot_sysid.excitation.options import ExcitationOptions, per_joint
from robot_sysid.records import Array, Motion, RobotModel, checked_array
from robot_sysid.trajectory import POSITION_MARGIN, TORQUE_MARGIN, UNLIMITED_RANGE

TorqueFunction = Callable[[Motion], Array]


@dataclass(frozen=True)
class MotionLimits:
    """What the motion must obey; a torque limit is infinite where there is none.

    Attributes:
        lower, upper: (n,) positions, finite, margin already taken off [rad or m].
        velocity: (n,) [rad/s or m/s].
        acceleration: (n,) [rad/s^2 or m/s^2].
        torque: (n,) [N m or N]; infinite too where holding still already exceeds the limit.
    """

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    torque: Array

    def __post_init__(self) -> None:
        if not np.all((self.lower < self.upper) & np.isfinite(self.upper - self.lower)):
            raise InputError("position limits must be finite, with lower < upper for every joint")
        for name in ("velocity", "acceleration", "torque"):
            if not np.all(getattr(self, name) > 0.0):
                raise InputError(f"{name} limits must be positive")


@dataclass(frozen=True)
class ExcitationProblem:
    """One arm, ready for the search.

    Attributes:
        joint_names: the n chain joints.
        rest: (n,) where the motion starts and ends [rad].
        limits: what it must obey.
        chain: the arm's screws.
        prior: (10,) the terminal link's parameters in the model; sets the physical scale.
        torque: joint torques (N, n) along a motion, friction included.
        obstacles: what must not be touched.
        rows: chain joints whose torque will be used.
        sigma: (len(rows),) standard deviation of their noise [N m].
        notes: what the reader should know about these limits.
    """

    joint_names: tuple[str, ...]
    rest: Array
    limits: MotionLimits
    chain: ScrewChain
    prior: Array
    torque: TorqueFunction
    obstacles: Obstacles
    rows: tuple[int, ...]
    sigma: Array
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "rest", checked_array(self.rest, (self.n_joints,), "rest"))
        object.__setattr__(self, "prior", checked_array(self.prior, (10,), "prior"))
        sigma = checked_array(self.sigma, (len(self.rows),), "torque noise")
        object.__setattr__(self, "sigma", sigma)

    @property
    def n_joints(self) -> int:
        """Number of chain joints n."""
        return len(self.joint_names)

    @property
    def scale(self) -> Array:
        """Typical magnitudes (10,) of the inertial parameters: m, m L, m L^2."""
        length = spatial.characteristic_length(self.prior)
        return spatial.parameter_scale(float(self.prior[0]), length)


class ArmTorque:
    """Torques the model needs for a motion, friction included.

    Args:
        robot: the arm.
    """

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        self._dynamics = ArmDynamics(robot)

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel to another process as what it was made from."""
        return type(self), (self._robot,)

    def __call__(self, motion: Motion) -> Array:
        """Return joint torques (N, n) [N m]."""
        rigid = self._dynamics.torque(motion.q, motion.qd, motion.qdd)
        return rigid + self._robot.friction.torque(motion.qd)


def build_problem(robot: RobotModel, options: ExcitationOptions) -> ExcitationProblem:
    """Collect what the search needs to know about an arm.

    Args:
        robot: the arm.
        options: limits and surroundings asked for.

    Raises:
        InputError: the arm breaks a limit already at rest; says which.
    """
    lower, upper = _position_limits(robot)
    rest = np.clip(robot.reference, lower, upper)
    torque = ArmTorque(robot)
    limits, notes = _limits(robot, options, (lower, upper), rest, torque)
    if not np.array_equal(rest, robot.reference):
        notes += _moved_rest_note(robot, rest)
    obstacles, more = _obstacles(robot, options, rest)
    rows = tuple(range(robot.n_joints)) if options.torques == "chain" else (robot.n_joints - 1,)
    sigma = per_joint(options.noise_torque, robot.n_joints, "--noise-torque")[list(rows)]
    return ExcitationProblem(
        joint_names=robot.joint_names,
        rest=rest,
        limits=limits,
        chain=screw_chain(robot),
        prior=robot.prior.theta,
        torque=torque,
        obstacles=obstacles,
        rows=rows,
        sigma=sigma,
        notes=notes + more,
    )


def screw_chain(robot: RobotModel) -> ScrewChain:
    """Return the arm's screws at the reference configuration."""
    still = np.zeros((1, robot.n_joints))
    motion = ChainKinematics(robot).evaluate(robot.reference[None], still, still)
    # At rest the only acceleration is the missing fall: minus gravity.
    return ScrewChain(motion.jacobian[0], robot.reference, -motion.acceleration[0, 3:])


def _position_limits(robot: RobotModel) -> tuple[Array, Array]:
    """Return position limits with the margin taken off; an assumed range where there are none."""
    lower, upper = robot.limits.lower, robot.limits.upper
    assumed = np.array([0.5 * UNLIMITED_RANGE[bool(slide)] for slide in robot.is_slide])
    lower = np.where(np.isfinite(lower), lower, np.minimum(robot.reference, upper) - assumed)
    upper = np.where(np.isfinite(upper), upper, np.maximum(robot.reference, lower) + assumed)
    margin = POSITION_MARGIN * (upper - lower)
    return lower + margin, upper - margin


def _limits(
    robot: RobotModel,
    options: ExcitationOptions,
    position: tuple[Array, Array],
    rest: Array,
    torque: ArmTorque,
) -> tuple[MotionLimits, tuple[str, ...]]:
    own = robot.limits.torque
    asked = per_joint(options.max_torque or (np.inf,), robot.n_joints, "--max-torque")
    allowed = TORQUE_MARGIN * np.minimum(own, asked)
    still = np.zeros((1, robot.n_joints))
    holding = np.abs(torque(Motion(np.zeros(1), rest[None], still, still))[0])
    too_weak = holding >= allowed
    notes = tuple(
        f"holding still takes {holding[j]:.3g} at joint {robot.joint_names[j]}, more than its "
        f"torque limit of {min(own[j], asked[j]):g} allows; its limit is not obeyed"
        for j in np.flatnonzero(too_weak)
    )
    limits = MotionLimits(
        lower=position[0],
        upper=position[1],
        velocity=robot.limits.velocity,
        acceleration=_acceleration_limits(robot, options),
        torque=np.where(too_weak, np.inf, allowed),
    )
    return limits, notes


def _acceleration_limits(robot: RobotModel, options: ExcitationOptions) -> Array:
    """Return acceleration limits: asked for, or those of a sinusoid at full speed and frequency."""
    natural = 2.0 * np.pi * options.basis().top_frequency_hz * robot.limits.velocity
    if options.max_acceleration is None:
        return natural
    return np.where(robot.is_slide, natural, options.max_acceleration)


def _moved_rest_note(robot: RobotModel, rest: Array) -> tuple[str, ...]:
    moved = [
        f"{name} at {q:.3f} instead of {reference:.3f}"
        for name, q, reference in zip(robot.joint_names, rest, robot.reference)
        if q != reference
    ]
    return (
        "the reference configuration is at or beyond a position limit; the motion starts and "
        f"ends with {', '.join(moved)}",
    )


def _obstacles(
    robot: RobotModel, options: ExcitationOptions, rest: Array
) -> tuple[Obstacles, tuple[str, ...]]:
    model = robot.mj_model
    spaces = _half_spaces(robot, options)
    solid = bool(np.any(model.geom_contype | model.geom_conaffinity)) or model.npair > 0
    if not solid and not spaces:
        note = "the model has no collision geometry; nothing keeps the arm from touching itself"
        return NoObstacles(robot.n_joints), (note,)
    clearance = Clearance(robot, rest, options.clearance, spaces)
    _require_inside(clearance)
    near = clearance.close_at_rest()
    if not near:
        return clearance, ()
    note = (
        f"nearer than --clearance {options.clearance:g} m already at rest: {'; '.join(near)}; "
        "these pairs keep half their distance at rest"
    )
    return clearance, (note,)


def _half_spaces(robot: RobotModel, options: ExcitationOptions) -> tuple[HalfSpace, ...]:
    model = robot.mj_model
    first = int(model.jnt_bodyid[model.dof_jntid[robot.dof_index[0]]])
    moving = subtree(model, first)
    planes = tuple(plane_half_space(p, options.clearance, moving) for p in options.keep_out)
    if options.workspace is None:
        return planes
    return planes + box_half_spaces(options.workspace, subtree(model, robot.body_id))


def _require_inside(clearance: Clearance) -> None:
    """Refuse half-spaces that the arm leaves already at rest: no trajectory could start there."""
    outside = clearance.half_spaces_left_at_rest()
    if not outside:
        return
    space, body, depth = max(outside, key=lambda entry: entry[2])
    raise InputError(
        f"no trajectory is feasible: at rest, body {body} is {1000 * depth:.0f} mm beyond "
        f"{space.label}; move that limit, or change the model's reference configuration"
    )
