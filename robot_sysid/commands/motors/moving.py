"""``robot-sysid motors move``: move an arm from where it stands to a pose of its model."""

from __future__ import annotations

from robot_sysid.commands.motors.following import step_with_motors
from robot_sysid.commands.motors.session import USUAL_CHANNEL, Session, run_checked
from robot_sysid.damiao.bus import inspect_bus
from robot_sysid.damiao.moving import goal_pose, moving_activity
from robot_sysid.damiao.settings import HoldOptions, MoveOptions
from robot_sysid.records.option_fields import record_from


def move(session: Session) -> int:
    """Move an arm to a pose of its model, hold it there for a moment, and disable it.

    Returns the exit code 0. Errors are those of ``run_checked`` and ``moving_plan``; a pose that
    does not exist is refused before anything is asked of a motor.
    """
    words = record_from(MoveOptions, session.values).to
    goal_pose(session.robot, words)
    is_real = not record_from(HoldOptions, session.values).simulate
    opened = (
        session.open_guarded()
        if is_real
        else session.open_simulated(session.standing_plan())
    )
    goal = " ".join(words)
    with opened as link:
        inspection = inspect_bus(link)
        plan = session.moving_plan(inspection)
        activity = moving_activity(plan, session.holding(plan), goal)
        run_checked(session, link, plan, inspection, is_real, activity)
    ids = [joint.can_id for joint in plan.trajectory.joints]
    step = step_with_motors(session, session.robot, inspection.motors, ids)
    if not is_real:
        options = {"channel": USUAL_CHANNEL, **session.values}
        options.update(record=None, overwrite=None)
        sentence = "Next, with the arm connected, move it"
        step = session.step_to("move", sentence, "--to", *words, **options)
    session.conclude(f"Done: moved to {goal}, and all motors are disabled", step)
    return 0
