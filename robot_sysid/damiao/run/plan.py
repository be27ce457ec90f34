"""A whole run on a bus: inspect, check, and, if everything is in order, play and record."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from robot_sysid.damiao.bus.can_bus import RawFrameLog
from robot_sysid.damiao.bus.inspection import (
    InspectedMotor,
    Inspection,
    RegisterClient,
    watchdogs_set_to,
)
from robot_sysid.damiao.bus.link import Clock, GuardedLink
from robot_sysid.damiao.exchange.recorder import (
    Aside,
    MeasurementRecorder,
    RecordingHead,
    RecordingOptions,
)
from robot_sysid.damiao.exchange.session import MotorSession
from robot_sysid.damiao.exchange.settings import PlaySettings
from robot_sysid.damiao.play.player import Park, Player, PlayReport, Told
from robot_sysid.damiao.play.sampler import Reference, ReferenceFunction, TrajectorySampler
from robot_sysid.damiao.play.supervision import StopRequest
from robot_sysid.damiao.protocol.codec import Scaling
from robot_sysid.damiao.protocol.frames import Address, BusTiming
from robot_sysid.damiao.protocol.joints import DamiaoJoint
from robot_sysid.damiao.protocol.motors import matching_types
from robot_sysid.damiao.protocol.registers import TIMEOUT
from robot_sysid.damiao.run.preflight import (
    Check,
    Permissions,
    bus_checks,
    other_checks,
    park_checks,
    plan_checks,
    require_no_stop,
)
from robot_sysid.damiao.trajectory import DamiaoTrajectory, TrajectoryScan, scan_trajectory
from robot_sysid.errors import InputError, SysidError, words_of
from robot_sysid.records import Array

PoseCheck = Callable[[Array, Array], None]


def other_motors(
    inspection: Inspection, joints: Sequence[DamiaoJoint]
) -> tuple[InspectedMotor, ...]:
    """Return the motors that answer but drive no joint of these."""
    known = {joint.address for joint in joints}
    return tuple(m for address, m in sorted(inspection.motors.items()) if address not in known)


def held_joint(motor: InspectedMotor) -> DamiaoJoint | None:
    """Return a motor as one that can be held where it is; None where its type is not known."""
    types = matching_types(motor.limits) if motor.limits else ()
    if not types:
        return None
    bus, can_id = motor.address
    return DamiaoJoint(types[0], can_id, motor.master_id, "", bus, motor.channel)


def with_held(
    settings: PlaySettings, held: Sequence[DamiaoJoint], timing: BusTiming
) -> PlaySettings:
    """Return settings with gains for the held motors behind those of the trajectory's joints."""
    usual = PlaySettings(rate=settings.rate).for_motors([j.spec for j in held], timing)
    return replace(
        settings,
        kp=(*settings.kp, *usual.kp),
        kd=(*settings.kd, *usual.kd),
        max_torque_error=(*settings.max_torque_error, *usual.max_torque_error),
    )


def alongside(reference: ReferenceFunction, positions: Array) -> ReferenceFunction:
    """Return a reference that also holds further motors at positions (m,) [rad]."""
    still = np.zeros_like(positions)

    def both(time: float) -> Reference:
        parts = zip(reference(time), (positions, still, still))
        return Reference(*(np.concatenate(pair) for pair in parts))

    return both


@dataclass(frozen=True)
class Plan:
    """What is to be played, and how; settings left open are chosen for these motors and this bus.

    ``inertia`` is what each joint moves (n,), where a model is known [kg m^2].
    """

    trajectory: DamiaoTrajectory
    settings: PlaySettings = PlaySettings()
    timing: BusTiming = BusTiming()
    allowed: Permissions = Permissions()
    recording: RecordingOptions = RecordingOptions()
    inertia: Array | None = None
    scan: TrajectoryScan = field(init=False)

    def __post_init__(self) -> None:
        specs = [joint.spec for joint in self.trajectory.joints]
        object.__setattr__(
            self, "settings", self.settings.for_motors(specs, self.timing, self.inertia)
        )
        object.__setattr__(self, "scan", scan_trajectory(self.trajectory))

    @property
    def duration(self) -> float:
        """How long playing takes [s]."""
        return self.scan.duration / self.settings.speed

    def checks(self) -> list[Check]:
        """Return the checks that need no bus."""
        joints = self.trajectory.joints
        asked = self.settings, self.timing, self.allowed
        checks = plan_checks(self.scan, joints, *asked, self.inertia)
        return checks if self.pose is None else [*checks, *park_checks(self.pose, joints)]

    def bus_checks(self, inspection: Inspection) -> list[Check]:
        """Return what the motors on the bus say to the plan."""
        joints = self.trajectory.joints
        checks = bus_checks(inspection, self.scan, joints, self.settings, self.allowed)
        others = other_motors(inspection, joints)
        return checks + other_checks(others, self.settings, self.allowed)

    def held(self, inspection: Inspection) -> tuple[DamiaoJoint, ...]:
        """Return the motors outside the trajectory that are to be held where they are."""
        if self.settings.others != "hold":
            return ()
        found = other_motors(inspection, self.trajectory.joints)
        return tuple(filter(None, (held_joint(motor) for motor in found)))

    @property
    def pose(self) -> Array | None:
        """Positions (n,) in which to leave the arm [rad]; None where --park names no file."""
        where = self.settings.park
        if where is None or where in ("rest", "start"):
            return None
        return read_pose(Path(where), self.trajectory.n_joints)

    def park(self, held: Array) -> Park:
        """Return where to leave the arm; ``held`` are the positions of motors beside it [rad]."""
        pose = self.pose
        return self.settings.park if pose is None else np.concatenate([pose, held])


def read_pose(path: Path, n: int) -> Array:
    """Return the n joint positions in a file with one line of numbers, or raise InputError."""
    try:
        pose = np.array([float(cell) for cell in path.read_text(encoding="utf-8-sig").split(",")])
    except (OSError, ValueError) as error:
        raise InputError(
            f"--park takes rest, start or a file with a line of {n} positions; {path}: {error}"
        ) from None
    if pose.shape != (n,) or not np.all(np.isfinite(pose)):
        raise InputError(f"{path} has to hold {n} positions in one line, separated by commas")
    return np.asarray(pose)


def run(
    link: GuardedLink,
    clock: Clock,
    plan: Plan,
    inspection: Inspection,
    stop: StopRequest,
    on_phase: Callable[[str], None],
    on_progress: Callable[[float], None],
    pose_check: PoseCheck | None = None,
) -> PlayReport:
    """Play the plan on inspected motors.

    For ``stop`` and ``pose_check`` see ``Player``; ``on_phase`` gets a sentence when a phase
    begins, ``on_progress`` the time played so far [s].

    Raises:
        HardwareAbort: a check forbids it, or the run was stopped; says why.
        InputError: a recording exists already or cannot be written.
        SysidError: the run went well, but recording or telling about it did not.
    """
    require_no_stop(plan.checks() + plan.bus_checks(inspection), "not played")
    held = plan.held(inspection)
    joints = (*plan.trajectory.joints, *held)
    motors = [inspection.motors[joint.address] for joint in joints]
    scaling = Scaling.from_limits(motor.limits or (0.0, 0.0, 0.0) for motor in motors)
    places = np.array([inspection.motors[joint.address].position for joint in held])
    session = MotorSession(link, clock, joints, scaling, not plan.recording.no_half_step)
    settings, park = with_held(plan.settings, held, plan.timing), plan.park(places)
    check = pose_check and _of_the_arm(pose_check, plan.trajectory.n_joints)
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
            player = Player(session, clock, settings, stop, recorder, told, park, check)
            sampler = TrajectorySampler(plan.trajectory, settings.speed)
            report = player.play(alongside(sampler, places), plan.duration)
    finally:
        console.finish()
    _require_told(console, written)
    n = plan.trajectory.n_joints
    return replace(report, missed=report.missed[:n], worst_tracking=report.worst_tracking[:n])


def _of_the_arm(check: PoseCheck, n: int) -> PoseCheck:
    """Return a check that sees the first n joints only."""
    return lambda q, tau: check(q[:n], tau[:n])


def _require_told(console: Aside, written: Aside) -> None:
    """Raise SysidError where something went wrong beside a run that went well."""
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
        registers = [motor.registers for motor in motors[: plan.trajectory.n_joints]]
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
