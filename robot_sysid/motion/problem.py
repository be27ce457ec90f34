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
    other_links,
    subtree,
)
from robot_sysid.estimate.links import link_factor
from robot_sysid.expected.planned_arm import PlannedArm
from robot_sysid.model.chain import DEFAULT_SLIDE_VELOCITY
from robot_sysid.motion import LimitOptions
from robot_sysid.motion.clearance import Clearance, unguarded_links
from robot_sysid.motion.mounting import mounting_plane
from robot_sysid.motion.planes import tool_corners
from robot_sysid.records import Array, Limits, Motion, RobotModel
from robot_sysid.records.option_fields import (
    DEFAULT_MAX_VELOCITY,
    TOP_FREQUENCY_HZ,
    PerJoint,
    joint_values,
)
from robot_sysid.trajectory import POSITION_MARGIN, TORQUE_MARGIN, assumed_reach

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
class ExcitationProblem(PlannedArm):
    """One arm with everything that a search for motions and a check of limits need.

    Attributes:
        assumed: (3, n) whether a joint's limit of position, velocity and acceleration is stated
            neither by the model nor by an option.
        obstacles: distances between bodies that have to be kept.
        notes: sentences for the user on these limits.
        unguarded: names of the moving links without collision geometry.
    """

    assumed: NDArray[np.bool_]
    obstacles: Clearance
    notes: tuple[str, ...]
    unguarded: tuple[str, ...]

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
        torque = self.torque_of_links(motion, links)
        return self.limits.signals(motion.q, motion.qd, motion.qdd, torque, fastest)


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
