"""``robot-sysid motors hold``: hold an arm, or let it float and measure how its joints drift."""

from __future__ import annotations

import contextlib

import numpy as np

from robot_sysid.commands.motors.following import plan_step
from robot_sysid.commands.motors.session import (
    Session,
    check_and_run,
    conclude_on_reports,
)
from robot_sysid.damiao.bus import inspect_bus
from robot_sysid.damiao.floating import Floating, measure_drift
from robot_sysid.damiao.protocol import Scaling
from robot_sysid.damiao.references import Activity, hold_reference
from robot_sysid.damiao.settings import Plan
from robot_sysid.errors import HardwareAbort


def hold(session: Session) -> int:
    """Hold an arm where it is, or let it float, and print how its joints drift.

    Returns the exit code: 1 where a motor reported a fault again and again, else 0. Errors are
    those of ``check_and_run`` and ``standing_plan``.
    """
    options = session.options.standing
    is_real = not options.simulate
    opened = (
        session.open_guarded()
        if is_real
        else session.open_simulated(session.standing_plan())
    )
    with opened as link:
        inspection = inspect_bus(link)
        plan = session.standing_plan(inspection)
        floating = Floating(plan, session.holding(plan).torque)
        text = f"({plan.duration:.1f} s)"
        activity = Activity(f"holding {text}", hold_reference, plan.duration)
        if options.floats:
            text = f"taking the stiffness away, then floating {text}"
            activity = Activity(text, floating.begin, floating.duration)
        try:
            report = check_and_run(session, link, plan, inspection, is_real, activity)
        except HardwareAbort:
            # No error of measuring or printing may hide what happened to the motors.
            with contextlib.suppress(Exception):
                _conclude(session, plan, floating)
                session.console.stage(*session.verdict[1:])
            raise
        session.verdict = ("Done: held, and all motors are disabled",)
        _conclude(session, plan, floating)
    return conclude_on_reports(session, report, plan.trajectory.joints)


def _conclude(session: Session, plan: Plan, floating: Floating) -> None:
    """Print how the joints have drifted, and set the verdict; do nothing if they did not float.

    Where one drifts, the next step plans a motion from which the arm is identified.
    """
    joints = plan.trajectory.joints
    scaling = Scaling(joint.spec.limits for joint in joints)
    drifts = measure_drift(floating.samples, session.robot, scaling.steps[2])
    if not drifts:
        return
    session.console.stage(*map(str, drifts))
    session.verdict = ("Done: all joints stand, and all motors are disabled",)
    fastest = max(drifts, key=lambda drift: abs(drift.end_speed))
    if fastest.end_speed:
        speed = np.degrees(abs(fastest.end_speed))
        session.conclude(
            f"Done: {fastest.joint} drifts fastest, at {speed:.2f} deg/s",
            plan_step(session, [joint.motor_type for joint in joints]),
        )
