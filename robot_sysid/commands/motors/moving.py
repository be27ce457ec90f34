"""``robot-sysid motors move``: move an arm from where it stands to a pose of its model.

The way is a straight line of the joints, that of the transfer with which a run approaches the first
point of its trajectory. Its rows are made beforehand, so that all checks of a trajectory look at
the whole way.
"""

from __future__ import annotations

import contextlib
import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from robot_sysid.commands.motors.following import step_with_motors
from robot_sysid.commands.motors.session import (
    USUAL_CHANNEL,
    Session,
    check_and_run,
    conclude_on_reports,
)
from robot_sysid.damiao.bus import inspect_bus
from robot_sysid.damiao.checks.after_run import recorded_plan
from robot_sysid.damiao.execution import SIMULATED_OPTIONS
from robot_sysid.damiao.references import (
    Activity,
    Reference,
    ReferenceFunction,
    transfer_reference,
)
from robot_sysid.damiao.safety.holding import HoldingTorque
from robot_sysid.damiao.settings import (
    ARM_OPTIONS,
    HoldOptions,
    MoveOptions,
    Plan,
    usual_stiffness,
)
from robot_sysid.errors import InputError
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.records.file_access import read_text
from robot_sysid.records.option_fields import command_arguments, options_of_all
from robot_sysid.wording import option_setting

ROW_TIME = 0.02
"""Time from row to row of the motion that is checked [s]: at 0.2 rad/s a joint moves by 0.004 rad,
and what lies between two rows is a straight line."""
PEAK_SPEED = 15.0 / 8.0
"""Peak over mean speed of a transfer, whose way is a polynomial of fifth degree in time."""
ARRIVED = 0.05
"""Distance from its goal at which a joint has arrived [rad]: under their rated torque motors give
way by as much with the stiffness that they have by default."""
OTHER_POSE = "move to another pose, or bring the arm elsewhere by hand"
"""Remedy for a way that leaves an arm's limits, or on which something touches."""


def goal_pose(robot: RobotModel, words: Sequence[str]) -> Array:
    """Return the pose (n,) that the words of a user name [rad]: a keyframe, or n positions.

    A keyframe is named by its name or its number, from 0 on. InputError lists the model's
    keyframes where the words name no pose.
    """
    from robot_sysid.parser import keyframe_names

    names = keyframe_names(robot.mj_model)
    if len(words) == 1:
        (word,) = words
        numbers = [str(index) for index in range(len(names))]
        for listed in (names, numbers):
            if word in listed:
                qpos = robot.mj_model.key_qpos[listed.index(word)]
                return qpos[robot.qpos_index].copy()
    with contextlib.suppress(ValueError):
        pose = np.array([float(word) for word in words])
        if len(pose) == robot.n_joints and np.all(np.isfinite(pose)):
            return pose
    raise InputError(
        f"{option_setting('to', ' '.join(words))}: no such pose; the keyframes of "
        f"{robot.path.name} are {', '.join(names) or 'none'}, and else it takes one position per "
        f"joint: {', '.join(robot.joint_names)}"
    )


def moving_plan(standing: Plan, robot: RobotModel, goal: Array) -> Plan:
    """Return the plan that moves an arm to a pose, from the one that holds it where it is.

    The torques of its rows are what the motion needs by the model.

    Args:
        standing: plan that holds the arm.
        robot: model of the arm with n joints.
        goal: pose (n,) to move to [rad].
    """
    from robot_sysid.damiao.checks.model import with_weight_of
    from robot_sysid.dynamics.inverse_dynamics import ArmDynamics

    settings = standing.settings
    joints = standing.trajectory.joints
    start = standing.trajectory.q[0]
    nothing = np.zeros_like(start)
    # The arm may have sunk a little until its motors hold it.
    longest = np.max(np.abs(goal - start)) + settings.start_tolerance
    way, duration = transfer_reference(
        Reference(start, nothing, nothing),
        Reference(goal, nothing, nothing),
        settings.approach_speed,
        max(settings.approach_time, PEAK_SPEED * longest / settings.approach_speed),
        # The torques of all rows follow at once, below.
        HoldingTorque(joints, np.zeros_like, nothing),
    )
    time = np.linspace(0.0, duration, 1 + int(np.ceil(duration / ROW_TIME)))
    states = [way(moment) for moment in time]
    q = np.array([state.position for state in states])
    qd = np.array([state.velocity for state in states])
    trajectory = replace(
        standing.trajectory, path=Path("move"), time=time, q=q, qd=qd, tau=0.0 * q
    )
    needed = ArmDynamics(robot)(Motion(time, q, qd, trajectory.qdd))
    trajectory = with_weight_of(robot, replace(trajectory, tau=needed))
    return replace(standing, trajectory=trajectory, remedy=OTHER_POSE)


def moving_activity(plan: Plan, holding: HoldingTorque, goal_name: str) -> Activity:
    """Return what the arm does by a ``moving_plan``; ``goal_name`` is said when it begins.

    What is fed forward is the model's gravity along the way.
    """
    goal = plan.trajectory.q[-1]
    target = Reference.at_rest(goal, holding)

    def begin(standing: Reference) -> ReferenceFunction:
        """Return the way to the goal from the reference in which the arm stands."""
        reference, _ = transfer_reference(
            standing, target, plan.settings.approach_speed, plan.duration, holding
        )
        return reference

    announcement = f"moving to {goal_name} ({plan.duration:.1f} s)"
    return Activity(announcement, begin, plan.duration)


def last_positions(recording: Path, n_joints: int) -> Array:
    """Return the last position (n,) of each joint in the recording of a run [rad].

    NaN for a joint that did not answer; InputError where the file cannot be read.
    """
    lines = read_text(recording, "give the recording of a run").splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    positions = np.full(n_joints, np.nan)
    for row in rows:
        for j in range(n_joints):
            positions[j] = float(row[f"j{j}_pos"] or positions[j])
    return positions


def move(session: Session, options: MoveOptions) -> int:
    """Move an arm to a pose of its model, hold it there for a moment, and disable it.

    Returns the exit code, see ``conclude_on_reports``, and 1 where the arm has not arrived. Errors
    are those of ``check_and_run``, ``standing_plan`` and ``goal_pose``: a pose that does not exist
    is refused before anything is asked of a motor.
    """
    words = options.to
    robot = session.robot
    goal = goal_pose(robot, words)
    is_real = not session.options.standing.simulate
    opened = (
        session.open_guarded()
        if is_real
        else session.open_simulated(session.standing_plan())
    )
    goal_name = " ".join(words)
    reached = np.full(robot.n_joints, np.nan)
    with contextlib.ExitStack() as stack:
        link = stack.enter_context(opened)
        inspection = inspect_bus(link)
        plan = moving_plan(session.standing_plan(inspection), robot, goal)
        plan = stack.enter_context(recorded_plan(plan))
        activity = moving_activity(plan, session.holding(plan), goal_name)
        report = check_and_run(session, link, plan, inspection, is_real, activity)
        # Without a recording, as on a full disk, nobody knows.
        with contextlib.suppress(InputError):
            reached = last_positions(plan.recording.record or Path(), robot.n_joints)
    joints = plan.trajectory.joints
    short = shortfall(plan, robot, reached - goal, goal_name)
    ids = [joint.can_id for joint in joints]
    step = step_with_motors(session, robot, inspection.motors, ids)
    further = ["--to", *words]
    changes = {"record": None, "overwrite": None}
    if short and is_soft(plan):
        sentence = "Next, move it with the stiffness by motor type"
        of_arm = options_of_all(HoldOptions, only=ARM_OPTIONS)
        further += command_arguments(
            session.options.given, [*of_arm, *SIMULATED_OPTIONS]
        )
        step = session.step_to("move", sentence, *further, kp=None, **changes)
    elif not is_real and not short:
        sentence = "Next, with the arm connected, move it"
        channel = session.options.address.channel or USUAL_CHANNEL
        step = session.step_to("move", sentence, *further, channel=channel, **changes)
    done = short or f"Done: moved to {goal_name}"
    session.conclude(f"{done}, and all motors are disabled", step)
    return conclude_on_reports(session, report, joints) or int(bool(short))


def is_soft(plan: Plan) -> bool:
    """Return whether a joint has less stiffness than its motor has by default."""
    usual = usual_stiffness([joint.spec for joint in plan.trajectory.joints])
    return bool(np.any(np.array(plan.settings.kp) < usual))


def shortfall(plan: Plan, robot: RobotModel, error: Array, goal_name: str) -> str:
    """Return a sentence on the joint that is farthest from the goal of a way, and why.

    It is "" where the arm has arrived, or nobody knows.

    Args:
        plan: what was played.
        robot: the arm.
        error: of the joints' last positions (n,) [rad]; NaN where they are not known.
        goal_name: what the user calls the goal.
    """
    distances = np.nan_to_num(np.abs(error))
    j = int(np.argmax(distances))
    if distances[j] <= ARRIVED:
        return ""
    stiffness = plan.settings.kp[j]
    name = robot.joint_names[j]
    return (
        f"Not there: {name} stands {distances[j]:.2f} rad from {goal_name}; its stiffness of "
        f"{stiffness:g} N·m/rad makes {stiffness * distances[j]:.2g} N·m there, by which weight "
        "and friction differ from the model's"
    )
