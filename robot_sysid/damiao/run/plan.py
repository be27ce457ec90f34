"""A whole run on a bus: inspect, check, and, if everything is in order, play and record."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from robot_sysid.damiao.bus.can_log import RawFrameLog
from robot_sysid.damiao.bus.clock import Clock
from robot_sysid.damiao.bus.inspection import InspectedMotor, Inspection
from robot_sysid.damiao.bus.link import GuardedLink
from robot_sysid.damiao.bus.register_client import RegisterClient, watchdogs_set_to
from robot_sysid.damiao.play.aside import Aside, words_of
from robot_sysid.damiao.play.player import Player, PlayReport, Told
from robot_sysid.damiao.play.recorder import MeasurementRecorder, RecordingHead, RecordingOptions
from robot_sysid.damiao.play.sampler import TrajectorySampler
from robot_sysid.damiao.play.session import MotorSession
from robot_sysid.damiao.play.settings import PlaySettings
from robot_sysid.damiao.play.stop_request import StopRequest
from robot_sysid.damiao.protocol.bus_load import BusTiming
from robot_sysid.damiao.protocol.codec import Scaling
from robot_sysid.damiao.protocol.frames import Address
from robot_sysid.damiao.protocol.registers import TIMEOUT
from robot_sysid.damiao.run.preflight import (
    Check,
    Permissions,
    bus_checks,
    plan_checks,
    require_no_stop,
)
from robot_sysid.damiao.trajectory.csv_file import DamiaoTrajectory, TrajectoryScan, scan_trajectory
from robot_sysid.errors import SysidError


@dataclass(frozen=True)
class Plan:
    """What is to be played, and how.

    Attributes:
        trajectory: the file.
        settings: gains and limits; what was left open is chosen for these motors and this bus.
        timing: bit rates of the bus.
        allowed: what the user allowed on purpose.
        recording: what is recorded.
        scan: the trajectory's extremes.
    """

    trajectory: DamiaoTrajectory
    settings: PlaySettings = PlaySettings()
    timing: BusTiming = BusTiming()
    allowed: Permissions = Permissions()
    recording: RecordingOptions = RecordingOptions()
    scan: TrajectoryScan = field(init=False)

    def __post_init__(self) -> None:
        specs = [joint.spec for joint in self.trajectory.joints]
        object.__setattr__(self, "settings", self.settings.for_motors(specs, self.timing))
        object.__setattr__(self, "scan", scan_trajectory(self.trajectory))

    @property
    def duration(self) -> float:
        """How long playing takes [s]."""
        return self.scan.duration / self.settings.speed

    def checks(self) -> list[Check]:
        """Return the checks that need no bus."""
        joints = self.trajectory.joints
        return plan_checks(self.scan, joints, self.settings, self.timing, self.allowed)

    def bus_checks(self, inspection: Inspection) -> list[Check]:
        """Return what the motors on the bus say to the plan."""
        joints = self.trajectory.joints
        return bus_checks(inspection, self.scan, joints, self.settings, self.allowed)


def run(
    link: GuardedLink,
    clock: Clock,
    plan: Plan,
    inspection: Inspection,
    stop: StopRequest,
    on_phase: Callable[[str], None],
    on_progress: Callable[[float], None],
) -> PlayReport:
    """Play the plan on inspected motors.

    Args:
        link: the bus.
        clock: for the deadlines.
        plan: what to play.
        inspection: what the motors said.
        stop: polled in every cycle.
        on_phase: gets a sentence when a phase begins.
        on_progress: gets the time played so far [s].

    Raises:
        HardwareAbort: a check forbids it, or the run was stopped; says why.
        InputError: a recording exists already or cannot be written.
        SysidError: the run went well, but recording or telling about it did not.
    """
    require_no_stop(plan.checks() + plan.bus_checks(inspection), "not played")
    joints = plan.trajectory.joints
    motors = [inspection.motors[joint.address] for joint in joints]
    scaling = Scaling.from_limits(motor.limits or (0.0, 0.0, 0.0) for motor in motors)
    session = MotorSession(link, clock, joints, scaling, not plan.recording.no_half_step)
    console, written = Aside(clock.live), Aside(clock.live)
    told = Told(
        lambda text: console(partial(on_phase, text)),
        lambda time: console.if_idle(partial(on_progress, time)),
    )
    try:
        with contextlib.ExitStack() as stack:
            recorder = stack.enter_context(_recorder(link, clock, plan, motors, written))
            if plan.allowed.watchdog is not None:
                stack.enter_context(_watchdogs(link, clock, session, motors, plan.allowed.watchdog))
            stack.enter_context(session)
            player = Player(session, clock, plan.settings, stop, recorder, told)
            sampler = TrajectorySampler(plan.trajectory, plan.settings.speed)
            report = player.play(sampler, plan.duration)
    finally:
        console.finish()
    _require_told(console, written)
    return report


def _require_told(console: Aside, written: Aside) -> None:
    """Say what went wrong beside a run that went well.

    Raises:
        SysidError: the recording is not complete, or the console does not work.
    """
    for what, aside in (("the recording is not complete", written), ("cannot print", console)):
        if aside.failure is not None:
            raise SysidError(
                "the trajectory was played and all motors are disabled, but "
                f"{what}: {words_of(aside.failure)}"
            )


def _watchdogs(
    link: GuardedLink,
    clock: Clock,
    session: MotorSession,
    motors: Sequence[InspectedMotor],
    seconds: float,
) -> contextlib.AbstractContextManager[None]:
    before = {motor.address: motor.registers[TIMEOUT] for motor in motors}

    def is_off(address: Address) -> bool:
        return address not in [session.joints[j].address for j in session.unconfirmed]

    return watchdogs_set_to(RegisterClient(link, clock), before, seconds, is_off)


@contextlib.contextmanager
def _recorder(
    link: GuardedLink, clock: Clock, plan: Plan, motors: Sequence[InspectedMotor], aside: Aside
) -> Iterator[MeasurementRecorder | None]:
    """Record the block, and every frame of it, where that was asked for."""
    with _frame_log(link, clock, plan.recording.frames) as frames:
        if plan.recording.record is None:
            yield None
            return
        registers = [motor.registers for motor in motors]
        source = plan.trajectory.path.name
        joints, settings = plan.trajectory.joints, plan.settings
        head = RecordingHead(joints, registers, settings, plan.recording, source)
        with MeasurementRecorder(plan.recording.record, head, aside, frames) as recorder:
            yield recorder


@contextlib.contextmanager
def _frame_log(link: GuardedLink, clock: Clock, path: Path | None) -> Iterator[RawFrameLog | None]:
    """Write every frame of the block to a file, where there is one."""
    if path is None:
        yield None
        return
    log = link.observer = RawFrameLog(path, clock, link.channels)
    try:
        yield log
    finally:
        link.observer = None
        # What a recorder did not take: without one, everything.
        with contextlib.suppress(Exception):
            log.write(log.taken())
        log.close()
