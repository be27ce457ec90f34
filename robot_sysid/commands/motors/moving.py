"""``robot-sysid motors move``: move an arm from where it stands to a pose of its model.

The way is a straight line of the joints, that of the transfer with which a run approaches the first
point of its trajectory. Its rows are made beforehand, so that all checks of a trajectory look at
the whole way.
"""

from __future__ import annotations

import contextlib
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
from robot_sysid.damiao.references import (
    Activity,
    Reference,
    ReferenceFunction,
    transfer_reference,
)
from robot_sysid.damiao.safety.holding import HoldingTorque
from robot_sysid.damiao.settings import MoveOptions, Plan
from robot_sysid.errors import InputError
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.wording import option_setting

ROW_TIME = 0.02
"""Time from row to row of the motion that is checked [s]: at 0.2 rad/s a joint moves by 0.004 rad,
and what lies between two rows is a straight line."""
PEAK_SPEED = 15.0 / 8.0
"""Peak over mean speed of a transfer, whose way is a polynomial of fifth degree in time."""
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


def move(session: Session, options: MoveOptions) -> int:
    """Move an arm to a pose of its model, hold it there for a moment, and disable it.

    Returns the exit code, see ``conclude_on_reports``. Errors are those of ``check_and_run``,
    ``standing_plan`` and ``goal_pose``: a pose that does not exist is refused before anything is
    asked of a motor.
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
    with opened as link:
        inspection = inspect_bus(link)
        plan = moving_plan(session.standing_plan(inspection), robot, goal)
        activity = moving_activity(plan, session.holding(plan), goal_name)
        report = check_and_run(session, link, plan, inspection, is_real, activity)
    joints = plan.trajectory.joints
    ids = [joint.can_id for joint in joints]
    step = step_with_motors(session, robot, inspection.motors, ids)
    if not is_real:
        sentence = "Next, with the arm connected, move it"
        step = session.step_to(
            "move",
            sentence,
            "--to",
            *words,
            channel=session.options.address.channel or USUAL_CHANNEL,
            record=None,
            overwrite=None,
        )
    session.conclude(f"Done: moved to {goal_name}, and all motors are disabled", step)
    return conclude_on_reports(session, report, joints)
