"""Checks of a motor trajectory against a model of the arm: limits, contacts, torques, gravity.

Between two rows position, velocity and torque change in a straight line, as the player sends them;
so each row is compared with the model's own joint ranges, speeds and torques, and the straight
lines between the rows with its bodies. The slope of the positions counts as a velocity too, besides
the velocity column. The torque that is fed forward is compared with what the motion needs, and that
with what the motors can do.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robot_sysid.damiao.joints import DamiaoJoint, peak_torques
from robot_sysid.damiao.preflight import NOTE, OK, STOP, Check
from robot_sysid.damiao.references import (
    ORDERS,
    STRAIGHT,
    HoldingCheck,
    poses_between,
    torque_doubt,
)
from robot_sysid.damiao.safety.moved_zeros import MovedZeroCheck
from robot_sysid.damiao.settings import Plan, PlaySettings
from robot_sysid.damiao.trajectory import (
    CANNOT_FOLLOW,
    NO_LIMITS,
    DamiaoTrajectory,
    peaks_beyond,
)
from robot_sysid.errors import InputError
from robot_sysid.model import ModelOptions
from robot_sysid.motion import WEIGHT, LimitOptions
from robot_sysid.motion.limit_check import BetweenArms, first_contact
from robot_sysid.motion.problem import build_problem
from robot_sysid.motion.trajectories import straight_way
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.records.file_access import plan_settings
from robot_sysid.records.option_fields import record_from
from robot_sysid.simulation.plant import ArmStepper
from robot_sysid.simulation.playback import interpolate
from robot_sysid.simulator import ArmTorque

# Relative; for limits and trajectories that came out of the same numbers.
_ROUNDING = 1e-9
# Two positions with four decimals are this far apart from what was meant at most [rad or m].
_PRINTED = 1e-4


class SampledTrajectory:
    """A motor trajectory as a motion plan, played at a factor of its speed.

    Attributes:
        time: of the N rows, from zero [s].
        q, qd, tau: (N, n) [rad, rad/s, N m].
        slope: velocity (N - 1, n) of the positions between rows [rad/s].
        duration: [s].
        n_joints: n.
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
        """Return the motion at times (N,) [s]; the acceleration is left at zero."""
        q = interpolate(time, self.time, self.q)
        between = np.searchsorted(self.time, time, side="right") - 1
        qd = self.slope[np.clip(between, 0, len(self.slope) - 1)]
        return Motion(time, q, qd, np.zeros_like(q))


class Contacts:
    """Finds contacts of a model's arms: with themselves, each other, surroundings and planes.

    Attributes:
        arms: one arm or two.
        between: check of two arms against each other; None for one.
        problems: limits of each arm.
        joints_of_arms: slice of each arm's joints among all n.
    """

    def __init__(
        self, arms: Sequence[RobotModel], limits: LimitOptions = NO_LIMITS
    ) -> None:
        self.arms = arms
        self.between = BetweenArms(*arms) if len(arms) > 1 else None
        self.problems = [build_problem(robot, limits) for robot in arms]
        ends = np.cumsum([0, *(robot.n_joints for robot in arms)]).tolist()
        self.joints_of_arms = [slice(begin, end) for begin, end in zip(ends, ends[1:])]
        """Which of all joints are those of each arm."""

    def order(self, begin: Array, end: Array) -> tuple[str, str]:
        """Return the order of joints in which arms touch nothing between two poses (n,) [rad].

        Returns:
            One of ``ORDERS``, or "" where there is none; and what touches on the straight line,
            or "".
        """
        touching = self._contact_between(poses_between(begin, end, STRAIGHT))
        if not touching or np.max(np.abs(end - begin)) <= _THERE:
            return STRAIGHT, ""
        for order in ORDERS[1:]:
            if not self._contact_between(poses_between(begin, end, order)):
                return order, touching
        return "", touching

    def _contact_between(self, poses: Sequence[Array]) -> str:
        """Return what touches on straight lines between poses (n,), "" where nothing does."""
        for begin, end in zip(poses, poses[1:]):
            for problem, joints in zip(self.problems, self.joints_of_arms):
                contact = first_contact(
                    problem, straight_way(begin[joints], end[joints])
                )
                if contact is not None:
                    return contact.label
            line = straight_way(begin, end)
            if self.between is not None and self.between.touch_at(line) is not None:
                return "arms"
        return ""


# A contact on a transfer shorter than this is the model's error [rad].
_THERE = 0.02


def model_checks(plan: Plan, contacts: Contacts) -> Iterator[Check]:
    """Yield where a plan exceeds a model's limits or touches something, parking pose included.

    Models are loaded without a speed limit, so that only their own hold.
    """
    played = plan.trajectory
    speed = plan.settings.speed
    excesses: list[str] = []
    for robot, problem, joints in zip(
        contacts.arms, contacts.problems, contacts.joints_of_arms
    ):
        columns = {
            name: getattr(played, name)[:, joints] for name in ("q", "qd", "tau")
        }
        of_arm = replace(played, joints=played.joints[joints], **columns)
        motion = SampledTrajectory(of_arm, speed)
        excesses += _joint_excesses(robot, motion)
        if (contact := first_contact(problem, motion)) is not None:
            excesses.append(
                f"the model's {contact.label} touch at {contact.time:.2f} s"
            )
    if excesses:
        remedy = _smaller_motion_remedy(played, contacts.arms[0])
        excesses = [f"{excess}; {remedy}" for excess in excesses]
    if plan.parking_pose is not None:
        for robot, joints in zip(contacts.arms, contacts.joints_of_arms):
            excesses += _pose_excesses(robot, plan.parking_pose[joints])
    both_arms = SampledTrajectory(played, speed)
    between = contacts.between
    if between is not None and (at := between.touch_at(both_arms)) is not None:
        excesses.append(
            f"the arms touch while both move, at {at:.2f} s; play one after the other"
        )
    yield from (Check(STOP, excess) for excess in excesses)
    if not excesses:
        name = contacts.arms[0].path.name
        if len(contacts.arms) > 1:
            name += ", and the arms apart"
        yield Check(OK, f"the trajectory stays within the limits of {name}")


def _smaller_motion_remedy(trajectory: DamiaoTrajectory, robot: RobotModel) -> str:
    """Return what to do about a motion that is too large for an arm, as a command if it can be."""
    if not np.any(np.ptp(trajectory.q, axis=0)):
        return "bring the arm elsewhere by hand"
    remedy = "export a smaller trajectory for this arm"
    return _planning_remedy(remedy, "smaller", trajectory, robot)


def transfer_check(name: str, order: str, touching: str) -> Iterator[Check]:
    """Yield a note or stop for a transfer on whose straight line the arms touch something.

    Args:
        name: of the transfer, see ``Plan.transfers``.
        order: of ``ORDERS`` in which it is free; "" where there is none.
        touching: bodies that touch on the straight line; "" where nothing does.
    """
    if not touching:
        return
    finding = f"{name} the model's {touching} touch if it goes straight"
    if order:
        yield Check(NOTE, f"{finding}: it goes {order}")
        return
    remedy = (
        "choose another --park" if "parked" in name else "bring the arm nearer by hand"
    )
    yield Check(STOP, f"{finding}, and joint by joint something touches too; {remedy}")


def _pose_excesses(robot: RobotModel, pose: Array) -> Iterator[str]:
    """Yield a sentence for each joint of a parking pose (n,) outside the model's range."""
    limits = zip(robot.joint_names, pose, robot.limits.lower, robot.limits.upper)
    for j, (name, q, lower, upper) in enumerate(limits):
        if not lower - _ROUNDING <= q <= upper + _ROUNDING:
            yield (
                f"joint {name} is to be parked at {q:.4g} {_unit('position', robot, j)}, outside "
                f"the model's {lower:g} to {upper:g}; choose another --park"
            )


def _joint_excesses(robot: RobotModel, motion: SampledTrajectory) -> Iterator[str]:
    """Yield a sentence for each joint whose range, speed or torque in the model is exceeded."""
    # Up to the next row, if the positions show more than the velocities say.
    slope = np.zeros_like(motion.qd)
    slope[:-1] = np.abs(motion.slope) - _PRINTED / np.diff(motion.time)[:, None]
    limits = robot.limits
    for quantity, sign, values, bounds in (
        ("position", 1.0, motion.q, limits.upper),
        ("position", -1.0, motion.q, limits.lower),
        ("velocity", 1.0, np.maximum(np.abs(motion.qd), slope), limits.velocity),
        ("torque", 1.0, np.abs(motion.tau), limits.torque),
    ):
        for j, row in enumerate(np.argmax(sign * values, axis=0)):
            value = values[row, j]
            bound = bounds[j]
            if sign * value > sign * bound + _ROUNDING * max(abs(bound), 1.0):
                yield (
                    f"joint {robot.joint_names[j]}: {quantity} {value:.4g} "
                    f"{_unit(quantity, robot, j)} is beyond the model's limit {bound:g}, at "
                    f"{motion.time[row]:.2f} s"
                )


def _unit(quantity: str, robot: RobotModel, joint: int) -> str:
    """Return the unit of a joint's position, velocity or torque: rad or, for slides, m."""
    length, force = ("m", "N") if robot.is_slide[joint] else ("rad", "N m")
    return {"position": length, "velocity": f"{length}/s", "torque": force}[quantity]


# How far feed-forward torque is off, of what its motion needs (rms): 1 where there is none, 2 with
# the other sign; 0.5 where a new load doubles what a joint carries. A judgement between them.
_OTHER_TORQUE = 0.8


def torque_checks(
    trajectory: DamiaoTrajectory, settings: PlaySettings, robot: RobotModel
) -> Iterator[Check]:
    """Yield a stop where a motion needs more torque than motors make, or another than is fed."""
    played = SampledTrajectory(trajectory, settings.speed)
    qdd = settings.speed**2 * trajectory.qdd
    needed = ArmTorque(robot)(Motion(played.time, played.q, played.qd, qdd))
    joints = trajectory.joints
    available = peak_torques(joints)
    for j, peak in peaks_beyond(needed, available):
        yield Check(
            STOP,
            f"{joints[j].label}: the motion needs {peak:.1f} N m and its motor makes "
            f"{available[j]:g} at most; {CANNOT_FOLLOW}, {weighing_remedy(trajectory, robot)}",
        )
    yield from _foreign_torque_checks(trajectory, robot)
    max_error = np.array(settings.max_torque_error)
    for j, error in peaks_beyond(needed - trajectory.tau, max_error):
        yield Check(
            STOP,
            f"{joints[j].label}: the motion needs {error:.1f} N m more or less than the file "
            f"feeds forward, limit {max_error[j]:g}; {CANNOT_FOLLOW}, "
            f"{weighing_remedy(trajectory, robot)}",
        )


def _foreign_torque_checks(
    trajectory: DamiaoTrajectory, robot: RobotModel
) -> Iterator[Check]:
    """Yield a note or stop for each joint whose torque in the file is not that of its motion."""
    fed = _FedTorque.of(trajectory, robot)
    is_as_planned = bool(np.any(fed.is_foreign)) and _is_as_planned(trajectory)
    for j in np.flatnonzero(fed.is_foreign).tolist():
        fault = "is another joint's or another arm's"
        if fed.is_missing[j]:
            fault = "is missing"
        elif fed.is_against[j]:
            fault = "has the other sign"
        finding = (
            f"{trajectory.joints[j].label}: the torque that the file feeds forward {fault}: "
            f"it is off by {fed.error[j]:.1f} N m where {robot.path.name} needs "
            f"{fed.needed[j]:.1f} (rms)"
        )
        if is_as_planned and _is_weighing(trajectory):
            yield Check(
                NOTE, f"{finding}; the file is as its model has it, and weighs this arm"
            )
            continue
        remedy = "export the file again for this arm"
        if is_as_planned:
            remedy = weighing_remedy(trajectory, robot)
        else:
            remedy = _planning_remedy(remedy, "exported", trajectory, robot)
        yield Check(STOP, f"{finding}, and {CANNOT_FOLLOW}; {remedy}")


@dataclass(frozen=True)
class _FedTorque:
    """Agreement of a file's feed-forward torque with the torque of its motion by a model.

    Attributes:
        needed: rms (n,) of what the motion needs [N m].
        error: rms (n,) of how far the file's torque is from that [N m].
        is_missing: joints (n,) for which the file has next to none.
        is_against: joints (n,) for which it has the other sign.
        is_foreign: joints (n,) for which it is not that of the motion.
    """

    needed: Array
    error: Array
    is_missing: NDArray[np.bool_]
    is_against: NDArray[np.bool_]
    is_foreign: NDArray[np.bool_]

    @classmethod
    def of(cls, trajectory: DamiaoTrajectory, robot: RobotModel) -> _FedTorque:
        """Compare the torque of a file with a model's, both at the file's own speed."""
        signals = trajectory.q, trajectory.qd, trajectory.qdd
        motion = Motion(trajectory.time, *signals)
        needed = ArmTorque(robot)(motion)
        doubt = torque_doubt(trajectory.joints) + robot.friction.largest_dry
        needed_rms = np.sqrt(np.mean(needed**2, axis=0))
        error = np.sqrt(np.mean((trajectory.tau - needed) ** 2, axis=0))
        return cls(
            needed_rms,
            error,
            np.sqrt(np.mean(trajectory.tau**2, axis=0)) < doubt,
            np.sum(trajectory.tau * needed, axis=0) < 0.0,
            (error > doubt) & (error > _OTHER_TORQUE * needed_rms),
        )


def _is_weighing(trajectory: DamiaoTrajectory) -> bool:
    """Tell whether a motion was planned to weigh an arm that its model may not know."""
    settings = plan_settings(trajectory.path.parent)
    return settings is not None and settings[1].get("for_") == WEIGHT


def _is_as_planned(trajectory: DamiaoTrajectory) -> bool:
    """Tell whether a file's torque is that of its motion by the model that it was planned with."""
    settings = (
        None if trajectory.has_two_arms else plan_settings(trajectory.path.parent)
    )
    if settings is None:
        return False
    model = record_from(ModelOptions, settings[1])
    free = float("inf")
    try:
        path = Path(settings[1]["path"])
        robot = load_robot_model(
            path, model.mesh_dir, model.joint, free, model.keyframe
        )
    except (InputError, KeyError):
        # What is not there any more speaks for no file.
        return False
    fits = robot.n_joints == trajectory.n_joints
    return fits and not np.any(_FedTorque.of(trajectory, robot).is_foreign)


def _planning_remedy(
    remedy: str, folder: str, trajectory: DamiaoTrajectory, robot: RobotModel
) -> str:
    """Return a remedy with the command that plans the motion of a file again for a robot.

    The command writes into ``folder`` beside the file; there is none for the file of two arms.
    """
    command = _plan_command(trajectory, robot, for_model=True)
    if not command:
        return remedy
    command += ["--output-dir", str(trajectory.path.parent / folder)]
    return f"{remedy}: {shlex.join(command)}"


def weighing_remedy(trajectory: DamiaoTrajectory, robot: RobotModel) -> str:
    """Return the remedy for an arm that needs more than its motors make, as a command."""
    command = _plan_command(trajectory, robot)
    if not command:
        return "plan a smaller motion for that arm with robot-sysid plan --for weight"
    folder = trajectory.path.parent
    if _is_weighing(trajectory):
        # Weighing uses half of the limits: half of what this motion took.
        peaks = np.abs(trajectory.tau).max(axis=0)
        command += ["--max-torque", ",".join(f"{peak:.3g}" for peak in peaks)]
    command += ["--for", WEIGHT, "--output-dir", str(folder / "weighing")]
    return f"weigh the arm with a smaller motion first: {shlex.join(command)}"


def _plan_command(
    trajectory: DamiaoTrajectory, robot: RobotModel, for_model: bool = False
) -> list[str]:
    """Return the command that plans another motion for the motors of a file; none of two arms.

    Where the settings that the motion was planned with stand beside it, they are asked for again,
    with the model that was planned with, or ``for_model`` with the one that is checked.
    """
    if trajectory.has_two_arms:
        return []
    settings = plan_settings(trajectory.path.parent)
    program = ["robot-sysid", "plan"]
    model = [str(robot.path)]
    if settings is not None and "trajectory" not in settings[1]:
        return [*program, *(model if for_model else []), "--config", str(settings[0])]
    motors = ["--joint", robot.terminal_joint, "--export-damiao"]
    for joint in trajectory.joints:
        ids = ("--can-id", str(joint.can_id), "--master-id", str(joint.master_id))
        motors += ["--motor-type", joint.motor_type, *ids]
    return [*program, *model, *motors]


# For slopes of the end's place [rad].
_STEP = 1e-4


def gravity_check(
    robot: RobotModel, joints: tuple[DamiaoJoint, ...], is_chain: bool = True
) -> HoldingCheck:
    """Return the check that compares measured torques at rest with those of a model's gravity.

    Args:
        robot: the model of the arm.
        joints: the arm's motors, base to terminal.
        is_chain: whether every joint carries all later ones; then the torques during a motion are
            also watched for joints whose zero has moved (``MovedZeroCheck``).
    """
    arm = ArmTorque(robot)

    def holding_torque(q: Array) -> Array:
        """Return the torque (n,) that holds the arm at rest in a pose q (n,) [N m]."""
        zero = np.zeros((1, len(q)))
        return np.asarray(arm(Motion(np.zeros(1), q[None], zero, zero))[0])

    stepper = ArmStepper(robot)
    gravity = np.array(robot.mj_model.opt.gravity)

    def tip_position(q: Array) -> Array:
        """Return the position (3,) of the arm's end in a pose q (n,) [m]."""
        stepper.q = q
        return stepper.tip()

    def load_torque(q: Array) -> Array:
        """Return the torque (n,) that holds a mass of 1 kg at the arm's end [N m].

        By virtual work it is minus gravity times the derivative of the end's position by q.
        """
        differences = []
        for step in _STEP * np.eye(len(q)):
            differences.append(tip_position(q + step) - tip_position(q - step))
        return -np.array(differences) / (2.0 * _STEP) @ gravity

    return HoldingCheck(
        joints,
        holding_torque,
        robot.friction.largest_dry,
        source=f"the model {robot.path.name} needs",
        load=load_torque,
        watch=partial(MovedZeroCheck, robot, joints) if is_chain else None,
    )
