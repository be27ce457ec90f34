"""A whole run on a bus: look, judge, and, if everything is in order, play and record."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from robot_sysid.damiao.bus.clock import Clock
from robot_sysid.damiao.bus.inspection import ALL_IDS, Inspection, inspect_bus
from robot_sysid.damiao.bus.link import GuardedLink
from robot_sysid.damiao.bus.register_client import RegisterClient, watchdogs_set_to
from robot_sysid.damiao.play.player import Player, PlayReport, StopRequest
from robot_sysid.damiao.play.preflight import Finding, Permissions, judge_bus, judge_plan, stops
from robot_sysid.damiao.play.recorder import FrameLog, MeasurementRecorder, RecordingHead
from robot_sysid.damiao.play.sampler import TrajectorySampler
from robot_sysid.damiao.play.session import MotorSession
from robot_sysid.damiao.play.settings import PlaySettings
from robot_sysid.damiao.protocol.bus_load import BusTiming
from robot_sysid.damiao.protocol.codec import Scaling
from robot_sysid.damiao.protocol.registers import TIMEOUT
from robot_sysid.damiao.trajectory.csv_file import DamiaoTrajectory, TrajectoryScan, scan_trajectory
from robot_sysid.errors import HardwareAbort


@dataclass(frozen=True)
class Plan:
    """What is to be played, and how.

    Attributes:
        trajectory: the file.
        scan: its extremes.
        settings: gains and limits.
        timing: bit rates of the bus.
        allowed: what the user allowed on purpose.
        half_step: add half a quantisation step to measured values.
        centred: centre recorded torques on the steps of the commands.
    """

    trajectory: DamiaoTrajectory
    scan: TrajectoryScan
    settings: PlaySettings
    timing: BusTiming
    allowed: Permissions
    half_step: bool = True
    centred: bool = True

    def judge(self) -> list[Finding]:
        """Return the findings that need no bus."""
        return judge_plan(
            self.scan, self.trajectory.joints, self.settings, self.timing, self.allowed
        )


@dataclass(frozen=True)
class RecordingChoice:
    """Where to record.

    Attributes:
        path: measurement CSV.
        frames: raw frame log, already open.
        overwrite: replace an existing measurement file.
    """

    path: Path
    frames: FrameLog | None = None
    overwrite: bool = False


@dataclass(frozen=True)
class Audience:
    """Who wants to hear about a run; each may be None.

    Attributes:
        phase: gets a sentence when a phase begins.
        progress: gets the time played so far [s].
    """

    phase: Callable[[str], None] | None = None
    progress: Callable[[float], None] | None = None


def make_plan(
    trajectory: DamiaoTrajectory,
    settings: PlaySettings,
    timing: BusTiming | None = None,
    allowed: Permissions | None = None,
    half_step: bool = True,
    centred: bool = True,
) -> Plan:
    """Read a trajectory once and return the plan to play it."""
    scan = scan_trajectory(trajectory)
    return Plan(
        trajectory,
        scan,
        settings,
        timing or BusTiming(),
        allowed or Permissions(),
        half_step,
        centred,
    )


def look(link: GuardedLink, clock: Clock, plan: Plan) -> tuple[Inspection, list[Finding]]:
    """Inspect the bus and return what it says to the plan; moves and enables nothing."""
    inspection = inspect_bus(link, clock, ALL_IDS)
    joints = plan.trajectory.joints
    return inspection, judge_bus(inspection, plan.scan, joints, plan.settings, plan.allowed)


def perform(
    link: GuardedLink,
    clock: Clock,
    plan: Plan,
    inspection: Inspection,
    stop: StopRequest,
    recording: RecordingChoice | None = None,
    audience: Audience | None = None,
) -> PlayReport:
    """Play the plan on inspected motors.

    Raises:
        HardwareAbort: the pre-flight list forbids it, or the run was stopped; says why.
    """
    findings = plan.judge()
    joints, settings = plan.trajectory.joints, plan.settings
    findings += judge_bus(inspection, plan.scan, joints, settings, plan.allowed)
    forbidden = stops(findings)
    if forbidden:
        raise HardwareAbort(f"not played: {forbidden[0]}")
    motors = [inspection.motors[joint.can_id] for joint in joints]
    scaling = Scaling.from_limits(motor.limits or (0.0, 0.0, 0.0) for motor in motors)
    timeouts = {motor.can_id: motor.registers[TIMEOUT] for motor in motors}
    client = RegisterClient(link, clock)
    hears = audience or Audience()
    with contextlib.ExitStack() as stack:
        recorder = None
        if recording:
            registers = [motor.registers for motor in motors]
            source = plan.trajectory.path.name
            head = RecordingHead(joints, registers, settings, plan.half_step, source, plan.centred)
            recorder = stack.enter_context(
                MeasurementRecorder(recording.path, head, recording.frames, recording.overwrite)
            )
        stack.enter_context(watchdogs_set_to(client, timeouts, plan.allowed.watchdog))
        session = stack.enter_context(MotorSession(link, clock, joints, scaling, plan.half_step))
        player = Player(session, clock, settings, stop, recorder, hears.phase, hears.progress)
        sampler = TrajectorySampler(plan.trajectory, settings.speed)
        return player.play(sampler, plan.scan.duration / settings.speed)
