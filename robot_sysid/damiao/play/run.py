"""A whole run on a bus: inspect, check, and, if everything is in order, play and record."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from robot_sysid.damiao.bus.can_log import RawFrameLog
from robot_sysid.damiao.bus.clock import Clock
from robot_sysid.damiao.bus.inspection import Inspection
from robot_sysid.damiao.bus.link import GuardedLink
from robot_sysid.damiao.bus.register_client import RegisterClient, watchdogs_set_to
from robot_sysid.damiao.play.player import Player, PlayReport, StopRequest
from robot_sysid.damiao.play.preflight import (
    Check,
    Permissions,
    bus_checks,
    plan_checks,
    require_no_stop,
)
from robot_sysid.damiao.play.recorder import MeasurementRecorder, RecordingHead, RecordingOptions
from robot_sysid.damiao.play.sampler import TrajectorySampler
from robot_sysid.damiao.play.session import MotorSession
from robot_sysid.damiao.play.settings import PlaySettings
from robot_sysid.damiao.protocol.bus_load import BusTiming
from robot_sysid.damiao.protocol.codec import Scaling
from robot_sysid.damiao.protocol.registers import TIMEOUT
from robot_sysid.damiao.trajectory.csv_file import DamiaoTrajectory, TrajectoryScan, scan_trajectory


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
    channel: str,
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
        channel: name of the bus in the log of frames.
        on_phase: gets a sentence when a phase begins.
        on_progress: gets the time played so far [s].

    Raises:
        HardwareAbort: a check forbids it, or the run was stopped; says why.
        InputError: a recording exists already or cannot be written.
    """
    require_no_stop(plan.checks() + plan.bus_checks(inspection), "not played")
    plan.recording.require_free(plan.trajectory.path)
    joints, settings = plan.trajectory.joints, plan.settings
    motors = [inspection.motors[joint.can_id] for joint in joints]
    scaling = Scaling.from_limits(motor.limits or (0.0, 0.0, 0.0) for motor in motors)
    timeouts = {motor.can_id: motor.registers[TIMEOUT] for motor in motors}
    half_step = not plan.recording.no_half_step
    with contextlib.ExitStack() as stack:
        frames = stack.enter_context(_frame_log(link, clock, plan.recording.frames, channel))
        recorder = None
        if plan.recording.record:
            registers = [motor.registers for motor in motors]
            source = plan.trajectory.path.name
            head = RecordingHead(joints, registers, settings, plan.recording, source)
            recorder = MeasurementRecorder(plan.recording.record, head, frames)
            stack.enter_context(recorder)
        if plan.allowed.watchdog is not None:
            client = RegisterClient(link, clock)
            stack.enter_context(watchdogs_set_to(client, timeouts, plan.allowed.watchdog))
        session = stack.enter_context(MotorSession(link, clock, joints, scaling, half_step))
        player = Player(session, clock, settings, stop, recorder, on_phase, on_progress)
        return player.play(TrajectorySampler(plan.trajectory, settings.speed), plan.duration)


@contextlib.contextmanager
def _frame_log(
    link: GuardedLink, clock: Clock, path: Path | None, channel: str
) -> Iterator[RawFrameLog | None]:
    """Write every frame of the block to a file, where there is one."""
    if path is None:
        yield None
        return
    log = link.observer = RawFrameLog(path, clock, channel)
    try:
        yield log
    finally:
        link.observer = None
        log.close()
