"""A whole run on a bus: check, and, if everything is in order, play and record."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from robot_sysid.damiao import inspection as asked
from robot_sysid.damiao.bus import GuardedLink, RawFrameLog
from robot_sysid.damiao.holding import HoldingCheck
from robot_sysid.damiao.player import Player, PlayReport
from robot_sysid.damiao.preflight import Plan, bus_checks, plan_checks, require_no_stop
from robot_sysid.damiao.protocol.codec import Scaling
from robot_sysid.damiao.protocol.joints import DamiaoJoint
from robot_sysid.damiao.protocol.motors import matching_types
from robot_sysid.damiao.recorder import Aside, MeasurementRecorder, head_lines
from robot_sysid.damiao.references import Reference, ReferenceFunction, sampled
from robot_sysid.damiao.session import MotorSession
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.damiao.supervision import StopRequest
from robot_sysid.errors import SysidError, words_of
from robot_sysid.records import Array


def run(
    link: GuardedLink,
    plan: Plan,
    inspection: asked.Inspection,
    stop: StopRequest,
    on_phase: Callable[[str], None],
    on_progress: Callable[[float], None],
    holding: HoldingCheck | None = None,
) -> PlayReport:
    """Play the plan on inspected motors.

    For ``stop``, ``holding`` (by default what the trajectory says) and what is told see ``Player``.

    Raises:
        HardwareAbort: a check forbids it, or the run was stopped; says why.
        InputError: a recording exists already or cannot be written.
        SysidError: the run went well, but recording or telling about it did not.
    """
    require_no_stop([*plan_checks(plan), *bus_checks(plan, inspection)], "not played")
    held, n, pose = _held(plan, inspection), plan.trajectory.n_joints, plan.pose
    joints = (*plan.trajectory.joints, *held)
    motors = [inspection.motors[joint.address] for joint in joints]
    scaling = Scaling(motor.limits for motor in motors)
    places = np.array([motor.position for motor in motors[n:]])
    session = MotorSession(link, joints, scaling)
    settings = _with_held(plan, held)
    park = settings.park if pose is None else np.concatenate([pose, places])
    console, written = Aside(link.clock.live), Aside(link.clock.live)
    told = (
        lambda text: console(partial(on_phase, text)),
        lambda time: console.if_idle(partial(on_progress, time)),
    )
    try:
        with contextlib.ExitStack() as stack:
            recorder = stack.enter_context(_recorder(link, plan, motors, written))
            if plan.allowed.watchdog is not None:
                client, seconds = asked.RegisterClient(link), plan.allowed.watchdog
                stack.enter_context(asked.watchdogs_set_to(client, motors, seconds, session.is_off))
            stack.enter_context(session)
            player = Player(session, settings, stop, recorder, *told, park, holding or plan.holding)
            own = sampled(plan.trajectory, settings.speed)
            report = player.play(_alongside(own, places), plan.duration)
    finally:
        console.finish()
    _require_told(console, written)
    return replace(report, missed=report.missed[:n], worst_tracking=report.worst_tracking[:n])


def _held(plan: Plan, inspection: asked.Inspection) -> tuple[DamiaoJoint, ...]:
    """Return the motors outside the trajectory that are to be held, as joints of known types."""
    if plan.settings.others != "hold":
        return ()
    return tuple(
        DamiaoJoint(name, motor.can_id, motor.master_id, "", motor.address.bus, motor.channel)
        for motor in plan.others(inspection)
        for name in matching_types(motor.limits)[:1]
    )


def _with_held(plan: Plan, held: Sequence[DamiaoJoint]) -> PlaySettings:
    """Return settings with gains for the held motors behind those of the trajectory's joints."""
    own = plan.settings
    usual = PlaySettings(rate=own.rate).for_motors([j.spec for j in held], plan.timing)
    each = ("kp", "kd", "max_torque_error")
    return replace(own, **{name: getattr(own, name) + getattr(usual, name) for name in each})


def _alongside(reference: ReferenceFunction, positions: Array) -> ReferenceFunction:
    """Return a reference that also holds further motors at positions (m,) [rad]."""
    held = positions, np.zeros_like(positions), np.zeros_like(positions)
    return lambda time: Reference(*map(np.concatenate, zip(reference(time), held)))


def _require_told(console: Aside, written: Aside) -> None:
    """Raise SysidError where something went wrong beside a run that went well."""
    for what, aside in (("the recording is not complete", written), ("cannot print", console)):
        if aside.failure is not None:
            raise SysidError(
                "the trajectory was played and all motors are disabled, but "
                f"{what}: {words_of(aside.failure)}"
            )


@contextlib.contextmanager
def _recorder(
    link: GuardedLink, plan: Plan, motors: Sequence[asked.InspectedMotor], aside: Aside
) -> Iterator[MeasurementRecorder | None]:
    path, record, played = plan.recording.frames, plan.recording.record, plan.trajectory
    if path is None:
        yield None
        return
    registers = [motor.registers for motor in motors[: played.n_joints]]
    head = head_lines(played.joints, registers, plan.settings, played.path.name)
    names = [joint.name if played.both else f"j{j}" for j, joint in enumerate(played.joints)]
    # Frames alone are written as the run goes on too: kept until its end, they fill the memory.
    with contextlib.ExitStack() as stack:
        frames = stack.enter_context(RawFrameLog(path, link))
        how = names, aside, frames, plan.recording.overwrite or record is None
        yield stack.enter_context(MeasurementRecorder(record or Path(os.devnull), head, *how))
