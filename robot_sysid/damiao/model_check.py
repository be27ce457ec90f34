"""Checks of a motor trajectory against a model of the arm: limits, contacts, torques, gravity.

Between two rows position, velocity and torque change in a straight line, as the player sends them;
so each row is compared with the model's own joint ranges, speeds and torques, and the straight
lines between the rows with its bodies. The slope of the positions counts as a velocity too, besides
the velocity column. The torque that is fed forward is compared with what the motion needs, and that
with what the motors can do.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robot_sysid.damiao.joints import DamiaoJoint, peak_torques
from robot_sysid.damiao.preflight import NOTE, OK, STOP, Check
from robot_sysid.damiao.references import HoldingCheck, torque_doubt
from robot_sysid.damiao.safety.moved_zeros import MovedZeroCheck
from robot_sysid.damiao.settings import Plan, PlaySettings
from robot_sysid.damiao.trajectory import (
    CANNOT_FOLLOW,
    NO_LIMITS,
    WEIGH_FIRST,
    DamiaoTrajectory,
    peaks_beyond,
)
from robot_sysid.errors import InputError
from robot_sysid.model import PosedModelOptions
from robot_sysid.motion import WEIGHT, LimitOptions
from robot_sysid.motion.limit_check import first_contact
from robot_sysid.motion.problem import build_problem
from robot_sysid.motion.solids import unguarded_text
from robot_sysid.motion.trajectories import straight_way
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.records.file_access import plan_settings
from robot_sysid.records.option_fields import record_from
from robot_sysid.simulation.playback import interpolate
from robot_sysid.simulator import ArmTorque

_ROUNDING = 1e-9
"""Relative excess of a limit that is ignored: limits and trajectories share their numbers."""
_SMALLER = "export a smaller trajectory for this arm, or bring it elsewhere by hand"
"""Remedy for a trajectory that leaves the model's limits, or touches something."""
_PRINTED = 1e-4
"""Largest error of the difference of two positions with four decimals [rad or m]."""


class SampledTrajectory:
    """A motor trajectory of n joints and N rows as a motion plan, played at a factor of its speed.

    Args:
        trajectory: the trajectory file's content.
        speed: factor of the file's velocities; its times are divided by this factor.

    Attributes:
        time: times (N,) of the rows, from zero [s].
        q: positions (N, n) [rad].
        qd: velocities (N, n) at the played speed [rad/s].
        tau: feed-forward torques (N, n) [N m].
        slope: slope (N - 1, n) of the positions between rows [rad/s].
        duration: time of the last row [s].
        n_joints: number n of joints.
    """

    def __init__(self, trajectory: DamiaoTrajectory, speed: float) -> None:
        self.time = (trajectory.time - trajectory.time[0]) / speed
        self.q = trajectory.q
        self.qd = speed * trajectory.qd
        self.tau = trajectory.tau
        self.slope = np.diff(self.q, axis=0) / np.diff(self.time)[:, None]
        self.duration = float(self.time[-1])
        self.n_joints = trajectory.n_joints

    def evaluate(self, time: Array) -> Motion:
        """Return position and velocity (K, n) at times (K,) [s], with zero acceleration.

        Positions are interpolated in a straight line between the rows, as the player sends them;
        the velocity is the slope of this line.
        """
        q = interpolate(time, self.time, self.q)
        row_before = np.searchsorted(self.time, time, side="right") - 1
        interval = np.clip(row_before, 0, len(self.slope) - 1)
        return Motion(time, q, self.slope[interval], np.zeros_like(q))


class Contacts:
    """Finds contacts of an arm: with itself, its surroundings and planes.

    Args:
        robot: model of the arm.
        limits: the user's planes and boxes, and the least clearance.

    Attributes:
        robot: as given.
        problem: geometry, obstacles and limits of the arm, for the search of contacts.
    """

    def __init__(self, robot: RobotModel, limits: LimitOptions = NO_LIMITS) -> None:
        self.robot = robot
        self.problem = build_problem(robot, limits)

    def transfer_checks(self, name: str, begin: Array, end: Array) -> Iterator[Check]:
        """Yield a stop where the arm touches something on the line between two poses (n,) [rad].

        A line on which all joints move less than 0.02 rad is not looked at: bodies that touch there
        touch where the arm stands, and the model has a contact too many. ``name`` is the begin of
        the message: "on the way to the first point" or "... to where it is parked".
        """
        if np.max(np.abs(end - begin)) <= _SHORT:
            return
        contact = first_contact(self.problem, straight_way(begin, end))
        if contact is not None:
            remedy = "bring the arm nearer by hand"
            yield Check(STOP, f"{name} the model's {contact.label} touch; {remedy}")


_SHORT = 0.02
"""Largest motion of a joint in a transfer that is too short to be judged [rad]."""


def model_checks(plan: Plan, contacts: Contacts) -> Iterator[Check]:
    """Yield a stop for each limit of the model that a plan exceeds and for each contact.

    If there is none, one check with severity OK is yielded. A note names the links whose contacts
    cannot be found. ``contacts`` has the arm of the model, loaded with an infinite
    ``max_velocity``, so that only the model's limits of speed count.
    """
    robot = contacts.robot
    unguarded = unguarded_text(contacts.problem.unguarded)
    if unguarded:
        yield Check(NOTE, unguarded)
    motion = SampledTrajectory(plan.trajectory, plan.settings.speed)
    excesses = list(_joint_excesses(robot, motion))
    contact = first_contact(contacts.problem, motion)
    if contact is not None:
        excesses.append(f"the model's {contact.label} touch at {contact.time:.2f} s")
    excesses = [f"{excess}; {_SMALLER}" for excess in excesses]
    for excess in excesses:
        yield Check(STOP, excess)
    if not excesses:
        name = robot.path.name
        yield Check(OK, f"the trajectory stays within the limits of {name}")


def _joint_excesses(robot: RobotModel, motion: SampledTrajectory) -> Iterator[str]:
    """Yield a sentence for each joint and limit of the model that a motion exceeds.

    The limits are those of position (upper and lower), velocity and torque; a sentence states the
    largest excess.
    """
    # Slope of the positions up to the next row, which counts where it is steeper than the velocity
    # column says. The slope that rounding of positions may make is subtracted; the last row has no
    # next one.
    slope = np.zeros_like(motion.qd)
    slope[:-1] = np.abs(motion.slope) - _PRINTED / np.diff(motion.time)[:, None]
    speed = np.maximum(np.abs(motion.qd), slope)
    torque = np.abs(motion.tau)
    limits = robot.limits
    # With sign -1, the least value is compared with a lower limit.
    for quantity, sign, values, bounds in (
        ("position", 1.0, motion.q, limits.upper),
        ("position", -1.0, motion.q, limits.lower),
        ("velocity", 1.0, speed, limits.velocity),
        ("torque", 1.0, torque, limits.torque),
    ):
        worst_rows = np.argmax(sign * values, axis=0)
        for j, row in enumerate(worst_rows):
            value = values[row, j]
            bound = bounds[j]
            if sign * value > sign * bound + _ROUNDING * max(abs(bound), 1.0):
                yield (
                    f"joint {robot.joint_names[j]}: {quantity} {value:.4g} "
                    f"{_unit(quantity, robot, j)} is beyond the model's limit {bound:g}, at "
                    f"{motion.time[row]:.2f} s"
                )


def _unit(quantity: str, robot: RobotModel, joint: int) -> str:
    """Return the unit of "position", "velocity" or "torque" (``quantity``) of a joint of a robot.

    ``joint`` is the joint's index; the unit depends on whether the joint is a hinge or a slide.
    """
    length, force = ("m", "N") if robot.is_slide[joint] else ("rad", "N m")
    return {"position": length, "velocity": f"{length}/s", "torque": force}[quantity]


_OTHER_TORQUE = 0.8
"""Error of the feed-forward torque, as a share of the torque that the motion needs (both rms).

From this value on it is the torque of another motion. The share is 1 without any torque, 2 with the
other sign, and 0.5 where a new load doubles the torque of a joint: this is a judgement between.
"""


def torque_checks(
    trajectory: DamiaoTrajectory, settings: PlaySettings, robot: RobotModel
) -> Iterator[Check]:
    """Yield a stop for each joint whose motion needs more torque than its motor can make.

    Further stops are yielded where the file feeds forward another torque than the motion needs, or
    only a note where the motion is meant to weigh the arm. The needed torques are those of
    ``robot``, the model of the arm; ``settings`` have the speed and the permitted torque errors.
    """
    played = SampledTrajectory(trajectory, settings.speed)
    qdd = settings.speed**2 * trajectory.qdd
    needed = ArmTorque(robot)(Motion(played.time, played.q, played.qd, qdd))
    joints = trajectory.joints
    available = peak_torques(joints)
    for j, peak in peaks_beyond(needed, available):
        yield Check(
            STOP,
            f"{joints[j].label}: the motion needs {peak:.1f} N m and its motor makes "
            f"{available[j]:g} at most; {CANNOT_FOLLOW}, {WEIGH_FIRST}",
        )
    yield from _foreign_torque_checks(trajectory, robot)
    max_error = np.array(settings.max_torque_error)
    for j, error in peaks_beyond(needed - trajectory.tau, max_error):
        yield Check(
            STOP,
            f"{joints[j].label}: the motion needs {error:.1f} N m more or less than the file "
            f"feeds forward, limit {max_error[j]:g}; {CANNOT_FOLLOW}, {WEIGH_FIRST}",
        )


def _foreign_torque_checks(
    trajectory: DamiaoTrajectory, robot: RobotModel
) -> Iterator[Check]:
    """Yield a note or stop for each joint whose feed-forward torque is not what its motion needs.

    It is a note where the file's torque agrees with the model that the motion was planned with, and
    the motion was planned for weighing an unknown load. The needed torque is that of ``robot``, the
    model of the arm that is to be moved.
    """
    fed = _FedTorque.of(trajectory, robot)
    weighs_as_planned = bool(np.any(fed.is_foreign)) and _weighs_as_planned(trajectory)
    for j in np.flatnonzero(fed.is_foreign).tolist():
        finding = (
            f"{trajectory.joints[j].label}: the torque that the file feeds forward is that of "
            f"another motion or arm: it is off by {fed.error[j]:.1f} N m where "
            f"{robot.path.name} needs {fed.needed[j]:.1f} (rms)"
        )
        if weighs_as_planned:
            yield Check(
                NOTE, f"{finding}; the file is as its model has it, and weighs this arm"
            )
            continue
        remedy = "export the file again for this arm"
        yield Check(STOP, f"{finding}, and {CANNOT_FOLLOW}; {remedy}, or {WEIGH_FIRST}")


@dataclass(frozen=True)
class _FedTorque:
    """Agreement of a file's feed-forward torque with the torque that its motion needs by a model.

    Attributes:
        needed: rms (n,) of the needed torque [N m].
        error: rms (n,) of feed-forward minus needed torque [N m].
        is_foreign: whether the error is more than friction explains, and more than 0.8 times the
            needed torque (n,).
    """

    needed: Array
    error: Array
    is_foreign: NDArray[np.bool_]

    @classmethod
    def of(cls, trajectory: DamiaoTrajectory, robot: RobotModel) -> _FedTorque:
        """Return how a file's torque agrees with what ``robot`` needs at the file's own speed."""
        signals = trajectory.q, trajectory.qd, trajectory.qdd
        motion = Motion(trajectory.time, *signals)
        needed = ArmTorque(robot)(motion)
        # Torque (n,) that friction alone may explain [N m].
        doubt = torque_doubt(trajectory.joints) + robot.friction.largest_dry
        needed_rms = np.sqrt(np.mean(needed**2, axis=0))
        error = np.sqrt(np.mean((trajectory.tau - needed) ** 2, axis=0))
        return cls(
            needed=needed_rms,
            error=error,
            is_foreign=(error > doubt) & (error > _OTHER_TORQUE * needed_rms),
        )


def _weighs_as_planned(trajectory: DamiaoTrajectory) -> bool:
    """Tell whether a motion was planned for weighing an unknown load, and a file's torque agrees
    with the model that it was planned with.

    False where the settings of its plan are not beside it, or the model that they name cannot be
    loaded or has another number of joints.
    """
    plan_file = plan_settings(trajectory.path.parent)
    settings = {} if plan_file is None else plan_file[1]
    if settings.get("for_") != WEIGHT:
        return False
    model = record_from(PosedModelOptions, settings)
    max_speed = float("inf")
    try:
        path = Path(settings["path"])
        robot = load_robot_model(
            path, model.mesh_dir, model.joint, max_speed, model.keyframe
        )
    except (InputError, KeyError):
        return False
    fits = robot.n_joints == trajectory.n_joints
    return fits and not np.any(_FedTorque.of(trajectory, robot).is_foreign)


def gravity_check(robot: RobotModel, joints: tuple[DamiaoJoint, ...]) -> HoldingCheck:
    """Return a check that compares the torques that hold an arm with those of the model's gravity.

    Args:
        robot: model of the arm with n joints.
        joints: joints of the arm with their motors, base to terminal.
    """
    arm = ArmTorque(robot)

    def holding_torque(q: Array) -> Array:
        """Return the torque (n,) that holds the arm at rest in a pose q (n,) [N m]."""
        zero = np.zeros((1, len(q)))
        return np.asarray(arm(Motion(np.zeros(1), q[None], zero, zero))[0])

    return HoldingCheck(
        joints,
        holding_torque,
        robot.friction.largest_dry,
        source=f"the model {robot.path.name} needs",
        is_model=True,
        watch=partial(MovedZeroCheck, robot, joints),
    )
