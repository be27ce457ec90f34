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
from robot_sysid.motion.solids import unguarded_text
from robot_sysid.motion.trajectories import straight_way
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.records.file_access import plan_settings
from robot_sysid.records.option_fields import record_from
from robot_sysid.simulation.plant import ArmStepper
from robot_sysid.simulation.playback import interpolate
from robot_sysid.simulator import ArmTorque

_ROUNDING = 1e-9
"""Relative excess of a limit that is ignored: limits and trajectories share their numbers."""
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
    """Finds contacts of one or two arms: with themselves, each other, surroundings and planes.

    Args:
        arms: the one or two arms of a model.
        limits: the user's planes and boxes, and the least clearance.

    Attributes:
        arms: as given.
        between: check of two arms against each other; None for one arm.
        problems: geometry, obstacles and limits of each arm, for the search of contacts.
        joints_of_arms: slice of each arm's joints among the n joints of all arms.
    """

    def __init__(
        self, arms: Sequence[RobotModel], limits: LimitOptions = NO_LIMITS
    ) -> None:
        self.arms = arms
        self.between = BetweenArms(*arms) if len(arms) > 1 else None
        self.problems = [build_problem(robot, limits) for robot in arms]
        self.joints_of_arms = []
        end = 0
        for robot in arms:
            begin = end
            end = begin + robot.n_joints
            self.joints_of_arms.append(slice(begin, end))

    def order(self, begin: Array, end: Array) -> tuple[str, str]:
        """Return an order of joints in which arms touch nothing between two poses (n,) [rad].

        Returns:
            The first such order of ``ORDERS`` (straight, joint by joint from the base, or from the
            tip), or "" where there is none; and the names of the bodies that touch on the straight
            line, or "". Where all joints move less than 0.02 rad, the order is always straight.
        """
        touching = self._contact_between(poses_between(begin, end, STRAIGHT))
        if not touching or np.max(np.abs(end - begin)) <= _SHORT:
            return STRAIGHT, ""
        for order in ORDERS[1:]:
            if not self._contact_between(poses_between(begin, end, order)):
                return order, touching
        return "", touching

    def _contact_between(self, poses: Sequence[Array]) -> str:
        """Return the bodies that touch first on straight lines between poses (n,) [rad], or "".

        For two arms that touch each other, this is "arms".
        """
        for begin, end in zip(poses, poses[1:]):
            for problem, joints in zip(self.problems, self.joints_of_arms):
                arm_line = straight_way(begin[joints], end[joints])
                contact = first_contact(problem, arm_line)
                if contact is not None:
                    return contact.label
            line = straight_way(begin, end)
            if self.between is not None and self.between.touch_at(line) is not None:
                return "arms"
        return ""


_SHORT = 0.02
"""Largest motion of a joint in a transfer that is too short for another order [rad].

Bodies that touch on so short a way touch where the arm stands: the model has a contact too many.
"""


def model_checks(plan: Plan, contacts: Contacts) -> Iterator[Check]:
    """Yield a stop for each limit of the model that a plan exceeds and for each contact.

    If there is none, one check with severity OK is yielded. A note names the links whose contacts
    cannot be found. The trajectory and the parking pose are checked. ``contacts`` has the arms of
    the model, loaded with an infinite ``max_velocity``, so that only the model's limits of speed
    count.
    """
    played = plan.trajectory
    speed = plan.settings.speed
    excesses: list[str] = []
    for robot, problem, joints in zip(
        contacts.arms, contacts.problems, contacts.joints_of_arms
    ):
        arm_trajectory = replace(
            played,
            joints=played.joints[joints],
            q=played.q[:, joints],
            qd=played.qd[:, joints],
            tau=played.tau[:, joints],
        )
        unguarded = unguarded_text(problem.unguarded)
        if unguarded:
            yield Check(NOTE, unguarded)
        motion = SampledTrajectory(arm_trajectory, speed)
        excesses += _joint_excesses(robot, motion)
        contact = first_contact(problem, motion)
        if contact is not None:
            excesses.append(
                f"the model's {contact.label} touch at {contact.time:.2f} s"
            )
    if excesses:
        remedy = _smaller_motion_remedy(played, contacts.arms[0])
        excesses = [f"{excess}; {remedy}" for excess in excesses]
    if plan.parking_pose is not None:
        for robot, joints in zip(contacts.arms, contacts.joints_of_arms):
            excesses += _pose_excesses(robot, plan.parking_pose[joints])
    if contacts.between is not None:
        time = contacts.between.touch_at(SampledTrajectory(played, speed))
        if time is not None:
            excesses.append(
                f"the arms touch while both move, at {time:.2f} s; play one after the other"
            )
    for excess in excesses:
        yield Check(STOP, excess)
    if not excesses:
        name = contacts.arms[0].path.name
        if len(contacts.arms) > 1:
            name += ", and the arms apart"
        yield Check(OK, f"the trajectory stays within the limits of {name}")


def _smaller_motion_remedy(trajectory: DamiaoTrajectory, robot: RobotModel) -> str:
    """Return the remedy for a motion that is too large for an arm, with a command if possible."""
    is_moving = np.any(np.ptp(trajectory.q, axis=0))
    if not is_moving:
        return "bring the arm elsewhere by hand"
    remedy = "export a smaller trajectory for this arm"
    return _planning_remedy(
        remedy, folder="smaller", trajectory=trajectory, robot=robot
    )


def transfer_check(name: str, order: str, touching: str) -> Iterator[Check]:
    """Yield a note or stop for a transfer on whose straight line the arms touch something.

    Args:
        name: begin of the message: "on the way to the first point" or "... to where it is parked".
        order: the order of ``ORDERS`` in which nothing touches; "" where there is none.
        touching: names of the bodies that touch on the straight line; "" where nothing touches.
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
    """Yield a sentence for each joint whose position in a parking pose is out of the model's range.

    ``pose`` (n,) [rad or m] has the n joints of ``robot``.
    """
    limits = zip(robot.joint_names, pose, robot.limits.lower, robot.limits.upper)
    for j, (name, q, lower, upper) in enumerate(limits):
        if not lower - _ROUNDING <= q <= upper + _ROUNDING:
            yield (
                f"joint {name} is to be parked at {q:.4g} {_unit('position', robot, j)}, outside "
                f"the model's {lower:g} to {upper:g}; choose another --park"
            )


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
    """Yield a note or stop for each joint whose feed-forward torque is not what its motion needs.

    It is a note where the file's torque agrees with the model that the motion was planned with, and
    the motion was planned for weighing an unknown load. The needed torque is that of ``robot``, the
    model of the arm that is to be moved.
    """
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
            remedy = _planning_remedy(
                remedy, folder="exported", trajectory=trajectory, robot=robot
            )
        yield Check(STOP, f"{finding}, and {CANNOT_FOLLOW}; {remedy}")


@dataclass(frozen=True)
class _FedTorque:
    """Agreement of a file's feed-forward torque with the torque that its motion needs by a model.

    Attributes:
        needed: rms (n,) of the needed torque [N m].
        error: rms (n,) of feed-forward minus needed torque [N m].
        is_missing: whether the file has no more torque for a joint than friction explains (n,).
        is_against: whether the file's torque mostly has the opposite sign (n,).
        is_foreign: whether the error is more than friction explains, and more than 0.8 times the
            needed torque (n,).
    """

    needed: Array
    error: Array
    is_missing: NDArray[np.bool_]
    is_against: NDArray[np.bool_]
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
        fed_rms = np.sqrt(np.mean(trajectory.tau**2, axis=0))
        error = np.sqrt(np.mean((trajectory.tau - needed) ** 2, axis=0))
        return cls(
            needed=needed_rms,
            error=error,
            is_missing=fed_rms < doubt,
            # The mean product of two torques is negative where their signs mostly differ.
            is_against=np.sum(trajectory.tau * needed, axis=0) < 0.0,
            is_foreign=(error > doubt) & (error > _OTHER_TORQUE * needed_rms),
        )


def _is_weighing(trajectory: DamiaoTrajectory) -> bool:
    """Tell whether the plan settings beside a trajectory file are for weighing an unknown load."""
    plan_file = plan_settings(trajectory.path.parent)
    if plan_file is None:
        return False
    _, settings = plan_file
    return settings.get("for_") == WEIGHT


def _is_as_planned(trajectory: DamiaoTrajectory) -> bool:
    """Tell whether a file's torque agrees with the model that the motion was planned with.

    False where the file has two arms, or the settings of its plan are not beside it, or the model
    that they name cannot be loaded or has another number of joints.
    """
    if trajectory.has_two_arms:
        return False
    plan_file = plan_settings(trajectory.path.parent)
    if plan_file is None:
        return False
    _, settings = plan_file
    model = record_from(ModelOptions, settings)
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


def _planning_remedy(
    remedy: str, folder: str, trajectory: DamiaoTrajectory, robot: RobotModel
) -> str:
    """Return a remedy, and on a line below it the command that plans a file's motion again.

    The command writes into ``folder`` beside the file. For the file of two arms there is no
    command, and the remedy is returned as it is.
    """
    command = _plan_command(trajectory, robot, for_model=True)
    if not command:
        return remedy
    command += ["--output-dir", str(trajectory.path.parent / folder)]
    return f"{remedy}:\n  {shlex.join(command)}"


def weighing_remedy(trajectory: DamiaoTrajectory, robot: RobotModel) -> str:
    """Return the remedy for an arm that needs more torque than its motors make, with a command."""
    command = _plan_command(trajectory, robot)
    if not command:
        return "plan a smaller motion for that arm with plan --for weight"
    folder = trajectory.path.parent
    if _is_weighing(trajectory):
        # Weighing uses half of the limits, so the next motion takes half of this one's torques.
        peaks = np.abs(trajectory.tau).max(axis=0)
        command += ["--max-torque", ",".join(f"{peak:.3g}" for peak in peaks)]
    command += ["--for", WEIGHT, "--output-dir", str(folder / "weighing")]
    return f"weigh the arm with a smaller motion first:\n  {shlex.join(command)}"


def _plan_command(
    trajectory: DamiaoTrajectory, robot: RobotModel, for_model: bool = False
) -> list[str]:
    """Return the words of the command that plans another motion for the motors of a file.

    Where the settings of the file's plan are beside it, the command uses them; with ``for_model``
    it replaces their model by that of ``robot``. Empty for a file of two arms.
    """
    if trajectory.has_two_arms:
        return []
    command = ["robot-sysid", "plan"]
    plan_file = plan_settings(trajectory.path.parent)
    # The settings of a plan that only exported a given trajectory plan no motion.
    if plan_file is not None and "trajectory" not in plan_file[1]:
        path, _ = plan_file
        if for_model:
            command.append(str(robot.path))
        return [*command, "--config", str(path)]
    command += [str(robot.path), "--joint", robot.terminal_joint, "--export-damiao"]
    for joint in trajectory.joints:
        command += ["--motor-type", joint.motor_type]
        command += ["--can-id", str(joint.can_id), "--master-id", str(joint.master_id)]
    return command


_STEP = 1e-4
"""Step of central differences of the tip's position [rad]."""


def gravity_check(
    robot: RobotModel, joints: tuple[DamiaoJoint, ...], is_chain: bool = True
) -> HoldingCheck:
    """Return a check that compares the torques that hold an arm with those of the model's gravity.

    Args:
        robot: model of the arm with n joints.
        joints: joints of the arm with their motors, base to terminal.
        is_chain: whether every joint carries all later ones; then the torques of a motion are also
            checked for joints whose zero has moved, see ``MovedZeroCheck``.
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
        """Return the torque (n,) [N m] that holds 1 kg at the arm's end in a pose q (n,) [rad].

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
