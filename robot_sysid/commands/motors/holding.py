"""``robot-sysid motors hold``: hold an arm, or let it float and measure how its joints drift."""

from __future__ import annotations

import contextlib

import numpy as np

from robot_sysid.commands.motors.session import Session, run_checked
from robot_sysid.damiao.bus import inspect_bus
from robot_sysid.damiao.floating import Floating, measure_drift
from robot_sysid.damiao.references import Activity, hold_reference
from robot_sysid.damiao.settings import HoldOptions, Plan
from robot_sysid.errors import HardwareAbort
from robot_sysid.pipeline.next_steps import step_after
from robot_sysid.records.messages import NextStep
from robot_sysid.records.option_fields import record_from


def hold(session: Session) -> int:
    """Hold an arm where it is, or let it float, and print how its joints drift.

    Returns the exit code 0. Errors are those of ``run_checked`` and ``standing_plan``.
    """
    options = record_from(HoldOptions, session.values)
    with contextlib.ExitStack() as stack:
        if options.simulate:
            plan = session.standing_plan()
            link = stack.enter_context(session.open_simulated(plan))
            inspection = inspect_bus(link)
        else:
            link = stack.enter_context(session.open_guarded())
            inspection = inspect_bus(link)
            plan = session.standing_plan(inspection)
        floating = Floating(
            plan.trajectory.joints,
            plan.settings,
            session.holding(plan).torque,
            plan.command_limits,
            options.lifetime,
        )
        text = f"({options.lifetime:.1f} s)"
        activity = Activity(f"holding {text}", hold_reference, options.lifetime)
        if options.floats:
            text = f"taking the stiffness away, then floating {text}"
            activity = Activity(text, floating.begin, floating.duration)
        checks = session.checks(plan)
        is_real = not options.simulate
        try:
            run_checked(session, link, plan, checks, inspection, is_real, activity)
        except HardwareAbort:
            # An error of printing must not hide what happened to the motors.
            with contextlib.suppress(OSError):
                _conclude(session, plan, floating)
                session.console.stage(*session.verdict[1:])
            raise
        session.verdict = ("Done: held, and all motors are disabled",)
        _conclude(session, plan, floating)
    return 0


def _conclude(session: Session, plan: Plan, floating: Floating) -> None:
    """Print how the joints have drifted, and set the verdict; do nothing if they did not float."""
    names = session.robot.joint_names
    drift = measure_drift(floating.samples, session.robot)
    if drift is None:
        return
    session.console.stage(*drift.sentences(names))
    session.verdict = ("Done: all joints stand, and all motors are disabled",)
    if np.any(drift.end_speed):
        fastest = int(np.argmax(np.abs(drift.end_speed)))
        speed = np.degrees(abs(drift.end_speed[fastest]))
        session.conclude(
            f"Done: {names[fastest]} drifts fastest, at {speed:.2f} deg/s",
            _identification_step(session, plan),
        )


def _identification_step(session: Session, plan: Plan) -> NextStep:
    """Return the step that plans a motion from which the arm of a plan is identified."""
    values = {**session.values, "path": session.values["model"]}
    words = ["--for", "arm", "--export-damiao"]
    for joint in plan.trajectory.joints:
        words += ["--motor-type", joint.motor_type]
    return step_after("self-test passed", values, *words, folder=".")
