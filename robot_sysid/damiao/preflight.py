"""What is to be played, and the list that is gone through before an arm may move.

Every point yields a check: ``ok``, ``note`` (worth knowing) or ``stop`` (nothing is played before
it is put right), each with what was found and what to do.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from robot_sysid.damiao import protocol
from robot_sysid.damiao import trajectory as motion
from robot_sysid.damiao.bus import InspectedMotor, Inspection
from robot_sysid.damiao.joints import (
    DamiaoJoint,
    JointSpace,
    id_problems,
    limits_agree,
    matching_types,
)
from robot_sysid.damiao.protocol import Scaling
from robot_sysid.damiao.recorder import SamplingRipple
from robot_sysid.damiao.references import (
    FileHolding,
    HoldingCheck,
    torque_doubt,
    way_rows,
)
from robot_sysid.damiao.safety.guards import CommandRange
from robot_sysid.damiao.session import PAUSE
from robot_sysid.damiao.settings import (
    LONGEST_SET_WATCHDOG,
    Permissions,
    PlaySettings,
    RecordingOptions,
)
from robot_sysid.errors import HardwareAbort, InputError
from robot_sysid.motion.plan_options import LimitOptions
from robot_sysid.records import Array
from robot_sysid.special_files import refuse_special_file

OK = "ok"
NOTE = "note"
STOP = "stop"
# A quarter of the speed at which an arm goes to its first point [rad/s].
_REST_SPEED = 0.05
# A motor whose answer is missing gets no command for some cycles; twice that, and both ends.
_LEAST_WATCHDOG_CYCLES = 2 + 2 * PAUSE
# Judgements [s]: half a second lets an arm that nobody commands fall or run a quarter of its
# range; nobody waits five for a stop.
_LONG_WATCHDOG = 0.5
_NO_WATCHDOG = 5.0
# Share of a control cycle within which all answers have to be there: the player waits that long.
_ANSWER_SHARE = 0.9
# Speed that one step of torque may give a joint within a cycle [rad/s]: a judgement, a third of
# what ``--max-speed-error`` stops at.
_SHAKEN = 0.3
# Commands may move by a tenth faster than what is played: rows are rounded.
_SPEED_ROOM = 1.1
# Relative; register values went through float32.
_FLOAT32_SLACK = 1e-6


@dataclass(frozen=True)
class Check:
    """One point of the list: ``text`` is what was found and, unless ok, what to do."""

    severity: str
    text: str


_note = partial(Check, NOTE)
_stop = partial(Check, STOP)


def _first(*table: tuple[str, object, str]) -> Check:
    """Return the first line of a table of severity, whether it holds, and text."""
    return next(Check(severity, text) for severity, holds, text in table if holds)


@dataclass(frozen=True)
class Plan:
    """What is to be played, and how; settings left open are chosen for these motors and this bus.

    Where a model is known, ``inertia`` is what each joint moves (n,) [kg m^2], ``model_range`` are
    the least and greatest positions (n,) of its joints [rad], and ``ripple`` says how torque steps
    show in what is sampled. ``limits`` hold for the trajectory, the way to it and the way to where
    the arm is parked.
    """

    trajectory: motion.DamiaoTrajectory
    settings: PlaySettings = PlaySettings()
    timing: protocol.BusTiming = protocol.BusTiming()
    allowed: Permissions = Permissions()
    recording: RecordingOptions = RecordingOptions()
    inertia: Array | None = None
    limits: LimitOptions = motion.NO_LIMITS
    model_range: tuple[Array, Array] | None = None
    ripple: SamplingRipple | None = None

    def __post_init__(self) -> None:
        if len(self.trajectory.time) < 2:
            raise InputError(
                f"{self.trajectory.path} needs at least two rows to be played"
            )
        specs = [joint.spec for joint in self.trajectory.joints]
        settings = self.settings.for_motors(specs, self.timing, self.inertia)
        object.__setattr__(self, "settings", settings)

    @property
    def duration(self) -> float:
        """How long playing takes [s]."""
        return float(np.ptp(self.trajectory.time)) / self.settings.speed

    @property
    def pose(self) -> Array | None:
        """Positions (n,) in which to leave the arm [rad]; None where --park names no file."""
        park = self.settings.park
        n = self.trajectory.n_joints
        if park in (None, "rest", "start"):
            return None
        refuse_special_file(str(park), "--park takes a file")
        try:
            cells = Path(str(park)).read_text(encoding="utf-8-sig").split(",")
            pose = np.array([float(cell) for cell in cells])
        except (OSError, ValueError) as error:
            raise InputError(
                f"--park takes rest, start or a file with a line of {n} positions; {park}: {error}"
            ) from None
        if pose.shape != (n,) or not np.all(np.isfinite(pose)):
            raise InputError(
                f"{park} has to hold {n} positions in one line, separated by commas"
            )
        return pose

    def command_range(self, held: Array) -> CommandRange:
        """Return where and how fast commands may go, held motors at ``held`` (m,) behind [rad].

        Positions are within the model's range, or else within that of the trajectory.
        """
        played = self.trajectory
        lower, upper = self.model_range or (
            np.min(played.q, axis=0),
            np.max(played.q, axis=0),
        )
        if self.model_range is None and self.pose is not None:
            lower = np.minimum(lower, self.pose)
            upper = np.maximum(upper, self.pose)
        slope = np.diff(played.q, axis=0) / np.diff(played.time)[:, None]
        fastest = np.maximum(np.abs(slope).max(axis=0), np.abs(played.qd).max(axis=0))
        speed = np.maximum(self.settings.speed * fastest, self.settings.approach_speed)
        held_speed = np.full_like(held, self.settings.approach_speed)
        return CommandRange(
            np.append(lower, held),
            np.append(upper, held),
            _SPEED_ROOM * np.append(speed, held_speed),
        )

    def ways(self, q: Array) -> Iterator[tuple[str, Array, Array]]:
        """Yield name, begin and end (n,) of the ways of an arm at q (n,) to begin and to park."""
        parked = q if self.settings.park == "start" else self.pose
        yield "on the way to the first point", q, self.trajectory.q[0]
        if parked is not None:
            yield "on the way to where it is parked", self.trajectory.q[-1], parked

    def joint_positions(self, inspection: Inspection) -> Array:
        """Return where the joints stand (n,) [rad]; NaN where a motor does not tell."""
        joints = self.trajectory.joints
        motors = inspection.motors
        positions = [
            motors[j.address].position if j.address in motors else np.nan
            for j in joints
        ]
        return JointSpace.of(joints).joint_position(np.array(positions))

    def others(self, inspection: Inspection) -> tuple[InspectedMotor, ...]:
        """Return the motors that answer but drive no joint of the trajectory."""
        addresses = {joint.address for joint in self.trajectory.joints}
        motors = sorted(inspection.motors.items())
        return tuple(motor for address, motor in motors if address not in addresses)


def limit_checks(
    plan: Plan, q: Array | None = None, orders: Sequence[str] = ()
) -> list[Check]:
    """Return where the trajectory, or else the ways from q (n,) [rad], break the user's limits.

    ``orders`` are those of the joints on each way.
    """
    played = plan.trajectory
    settings = plan.settings
    if q is None:
        return list(
            map(_stop, motion.limit_excesses(played, settings.speed, plan.limits))
        )
    pace = settings.approach_speed, settings.approach_time
    remedy = (
        f"move it nearer by hand, or lower --approach-speed {settings.approach_speed:g}"
    )
    checks = []
    for (name, begin, end), order in zip(plan.ways(q), orders):
        rows = way_rows(played, begin, end, pace, order)
        for excess in motion.limit_excesses(rows, 1.0, plan.limits):
            checks.append(_stop(f"{name}, {excess}; {remedy}"))
    return checks


def stops(checks: Sequence[Check]) -> list[str]:
    """Return the texts of the checks that forbid to play."""
    return [check.text for check in checks if check.severity == STOP]


def require_no_stop(checks: Sequence[Check], consequence: str) -> None:
    """Raise HardwareAbort with a consequence and the first check that forbids to play."""
    for text in stops(checks):
        raise HardwareAbort(f"{consequence}: {text}")


def plan_checks(plan: Plan) -> list[Check]:
    """Return what can be said without a bus: ids, limits, ends at rest, bus load."""
    limits = [joint.spec.limits for joint in plan.trajectory.joints]
    return [
        *_ids(plan.trajectory.joints),
        *_motion(plan),
        *_motors(plan),
        _load((j.address for j in plan.trajectory.joints), plan.settings, plan.timing),
        *_within_limits(plan, limits, "its type's"),
    ]


def _ids(joints: Sequence[DamiaoJoint]) -> Iterator[Check]:
    problems = [
        _stop(text) for text in id_problems([(*j.address, j.master_id) for j in joints])
    ]
    unique = f"ids are unique: {', '.join(str(j.can_id) for j in joints)}"
    yield from problems or [Check(OK, unique)]
    if any(joint.master_id == 0 for joint in joints):
        yield _note("a master id of 0 is a poor choice; set it to CAN id + 0x10")


def _motion(plan: Plan) -> Iterator[Check]:
    """Yield whether it begins and ends at rest, and whether velocities belong to positions."""
    played = plan.trajectory
    worst = float(np.max(np.abs(played.qd[[0, -1]]))) * plan.settings.speed
    moving = f"the trajectory starts or ends at {worst:.2f} rad/s; it has to start and end at rest"
    at_rest = f"starts and ends at rest, {plan.duration:.1f} s"
    yield _first((STOP, worst > _REST_SPEED, moving), (OK, True, at_rest))
    mismatch = motion.velocity_mismatch(played.time, played.q, played.qd)
    if mismatch is None:
        yield Check(OK, "velocities and positions agree")
        return
    label = played.joints[mismatch.joint].label
    yield _stop(
        f"line {played.line[mismatch.row]}: velocity {mismatch.stated:.4g} rad/s of {label}, but "
        f"the positions change by {mismatch.slope:.4g} rad/s; export the file again, with at "
        "least four decimals"
    )


def _motors(plan: Plan) -> Iterator[Check]:
    """Yield what is beyond motors' ratings, and which joints a step of torque throws about."""
    played = plan.trajectory
    joints = played.joints
    settings = plan.settings
    steps = Scaling(joint.spec.limits for joint in joints).steps[2]
    inertias = [np.inf] * len(joints) if plan.inertia is None else plan.inertia
    yield from map(
        _stop, motion.rotor_problems(played, settings.speed, torque_doubt(joints))
    )
    fastest = np.abs(played.qd).max(axis=0)
    strongest = np.abs(played.tau).max(axis=0)
    for j, (joint, step, inertia) in enumerate(zip(joints, steps, inertias)):
        torque = strongest[j] / joint.torque_ratio
        for text in motion.rating_warnings(joint, fastest[j] * settings.speed, torque):
            yield Check(STOP if motion.CANNOT_FOLLOW in text else NOTE, text)
        if joint.spec.note:
            yield _note(f"{joint.label}, {joint.motor_type}: {joint.spec.note}")
        if step * settings.period / inertia > _SHAKEN:
            yield _note(
                f"{joint.label} moves only {inertia:.2g} kg m^2 in the model, and a step of a "
                f"{joint.motor_type}'s torque is {step:.2g} N m: it will shake; give the model the "
                "rotor's inertia (armature), or the joint a smaller motor"
            )


def _load(
    addresses: Iterable[protocol.Address],
    settings: PlaySettings,
    timing: protocol.BusTiming,
) -> Check:
    buses = [bus for bus, _ in addresses]
    limit = protocol.PLANNING_LIMIT
    n_motors = max(buses.count(bus) for bus in buses)
    load = protocol.bus_load(n_motors, 1.0 / settings.period, timing)
    bus_type = "CAN-FD" if timing.fd else "classic CAN"
    text = f"{n_motors} motors at {settings.rate:g} Hz load {bus_type} to {100 * load:.0f} %"
    suggested_rate = protocol.suggested_rate(n_motors, timing)
    full = f"{text}, limit {100 * limit:.0f} %; use --rate {suggested_rate:g}"
    return _first((OK, load <= limit, text), (STOP, True, full))


def _within_limits(
    plan: Plan, limits: Sequence[tuple[float, float, float]], whose: str
) -> Sequence[Check]:
    played = plan.trajectory
    speed = plan.settings.speed
    remedy = "export a smaller trajectory"
    positions = played.q
    # Where it is parked counts as well.
    if plan.pose is not None:
        positions = np.vstack([positions, plan.pose])
        remedy = f"{remedy}, or choose another --park"
    slope = np.diff(played.q, axis=0) / np.diff(played.time)[:, None]
    p, v, t = JointSpace.of(played.joints).to_motors(
        positions, speed * played.qd, played.tau
    )
    position_limit, velocity_limit, torque_limit = zip(*limits)
    checks = []
    for quantity, unit, values, tops in (
        ("position", "rad", p, position_limit),
        ("velocity", "rad/s", v, velocity_limit),
        ("torque", "N m", t, torque_limit),
        ("position step", "rad/s", speed * slope, velocity_limit),
    ):
        peaks = np.abs(values).max(axis=0)
        for joint, peak, top in zip(played.joints, peaks, tops):
            if peak > top * (1.0 + _FLOAT32_SLACK):
                finding = (
                    f"{quantity} {peak:.4g} {unit} is beyond {whose} limit {top:g}"
                )
                checks.append(_stop(f"{joint.label}: {finding}; {remedy}"))
    return checks or [Check(OK, f"the trajectory stays within {whose} limits")]


# --- what the motors say ------------------------------------------------------------------------


def general_checks(
    inspection: Inspection, settings: PlaySettings, timing: protocol.BusTiming
) -> list[Check]:
    """Return what motors say on their own, without a trajectory to compare them with."""
    motors = inspection.motors.values()
    conditions = [
        check for m in motors for check in _condition(m, settings, Permissions())
    ]
    return [
        _load(inspection.motors, settings, timing),
        *_bus_itself(inspection),
        *conditions,
    ]


def bus_checks(plan: Plan, inspection: Inspection) -> list[Check]:
    """Return what the motors on the bus say to the plan."""
    joints = plan.trajectory.joints
    settings = plan.settings
    checks = list(_bus_itself(inspection))
    present = [
        inspection.motors[j.address] for j in joints if j.address in inspection.motors
    ]
    for joint in joints:
        if (motor := inspection.motors.get(joint.address)) is None:
            checks.append(
                _stop(
                    f"{joint.label} does not answer; check power, wiring, its id, bit rate"
                )
            )
        else:
            checks += _condition(motor, settings, plan.allowed, joint)
    limits = [m.limits for m in present if set(protocol.SCALING) <= set(m.registers)]
    if len(limits) == len(joints):
        checks += _within_limits(plan, limits, "its registers'")
        checks += _in_time(inspection.round_trip, settings)
        checks += _near_start(plan, plan.joint_positions(inspection))
    return [*checks, *_other_motors(plan, plan.others(inspection))]


def _bus_itself(inspection: Inspection) -> Iterator[Check]:
    if inspection.unsolicited:
        yield _stop(
            f"{inspection.unsolicited} frames came without being asked for: another program is "
            "talking to these motors; end it first"
        )
    if inspection.error_frames:
        yield _note(
            f"{inspection.error_frames} error frames: two motors may share an id, or a motor is "
            "set to CAN-FD (use --fd) or to another bit rate"
        )
    ids = [(*address, motor.master_id) for address, motor in inspection.motors.items()]
    yield from map(_stop, id_problems(ids))


def _other_motors(plan: Plan, others: Sequence[InspectedMotor]) -> Iterator[Check]:
    if not others:
        return
    names = ", ".join(motor.name for motor in others)
    if plan.settings.others == "limp":
        yield _note(
            f"not in the trajectory and left limp: {names} (--others hold holds them)"
        )
        yield from (check for motor in others for check in _left_alone(motor))
        return
    yield _note(f"not in the trajectory and held where they are: {names}")
    for motor in others:
        yield from _condition(motor, plan.settings, plan.allowed, taken_over=True)
        if not matching_types(motor.limits):
            yield _stop(
                f"{motor.name} is of no known type and cannot be held; use --others limp"
            )


def _left_alone(motor: InspectedMotor) -> Iterator[Check]:
    """Yield what forbids to leave a motor as it is: it drives something, and nobody watches it."""
    if motor.feedback is None:
        yield _stop(
            f"{motor.name} does not tell whether it is enabled; take it off the bus"
        )
    elif motor.feedback.status[0] == protocol.ENABLED:
        yield _stop(
            f"{motor.name} is enabled by another program and not in the trajectory; end that "
            "program and power-cycle the motor, or take it over with --others hold"
        )


def _condition(
    motor: InspectedMotor,
    play: PlaySettings,
    allow: Permissions,
    joint: DamiaoJoint | None = None,
    taken_over: bool = False,
) -> Iterator[Check]:
    name = joint.label if joint else motor.name
    registers = motor.registers
    if len(motor.reply_ids) > 1:
        yield _stop(f"{len(motor.reply_ids)} motors answer to the id of {name}")
    lacking = [
        protocol.NAMES[number]
        for number in protocol.REQUIRED
        if number not in registers
    ]
    if lacking:
        yield _stop(f"{name} does not answer for {', '.join(lacking)}; try again")
        return
    if joint:
        yield from _identity(motor, joint, name)
        yield _scaling(motor, joint, allow)
    mode = int(registers[protocol.CTRL_MODE])
    if mode != protocol.MIT_MODE:
        mode_name = protocol.MODES.get(mode, "unknown")
        yield _stop(f"{name} is in mode {mode} ({mode_name}); set CTRL_MODE to 1 (MIT)")
    stored = registers[protocol.TIMEOUT] * protocol.TIMEOUT_UNIT
    yield _watchdog(name, stored if allow.watchdog is None else allow.watchdog, play)
    yield from _state(motor, play, name, taken_over)


def _identity(motor: InspectedMotor, joint: DamiaoJoint, name: str) -> Iterator[Check]:
    can_id = int(motor.registers[protocol.ESC_ID])
    master_id = int(motor.registers[protocol.MST_ID])
    if can_id != joint.can_id:
        yield _stop(f"{name} says that its CAN id is {can_id}; power-cycle it")
    if master_id != joint.master_id or set(motor.reply_ids) != {joint.master_id}:
        answers = ", ".join(f"{i:#x}" for i in sorted(set(motor.reply_ids)))
        yield _stop(
            f"{name} answers on {answers} (MST_ID {master_id:#x}) but the trajectory expects "
            f"{joint.master_id:#x}; set it (robot-sysid motors setup --new-master-id), or export "
            "again (robot-sysid plan --export-damiao --master-id)"
        )


def _scaling(
    motor: InspectedMotor, joint: DamiaoJoint, permissions: Permissions
) -> Check:
    limits = motor.limits
    stored = ", ".join(f"{limit:g}" for limit in limits)
    nominal = ", ".join(f"{limit:g}" for limit in joint.spec.limits)
    text = f"{joint.label} has PMAX, VMAX, TMAX {stored}"
    same = f"{joint.label} is scaled as a {joint.motor_type}: {stored}"
    other = f"{text} but a {joint.motor_type} has {nominal}"
    return _first(
        (STOP, min(limits) <= 0.0, f"{text}: not usable"),
        (OK, limits_agree(joint.spec.limits, limits), same),
        (
            NOTE,
            permissions.register_limits,
            f"{other}: the motor's own values are used",
        ),
        (STOP, True, f"{other}; if the motor is right, give --accept-register-limits"),
    )


def _watchdog(name: str, timeout: float, settings: PlaySettings) -> Check:
    least = _LEAST_WATCHDOG_CYCLES * settings.period
    options = f"--set-watchdog {max(0.1, np.ceil(10.0 * least) / 10.0):g}"
    if least > LONGEST_SET_WATCHDOG:
        slowest = _LEAST_WATCHDOG_CYCLES / LONGEST_SET_WATCHDOG
        options = f"--rate {slowest:g} and --set-watchdog {LONGEST_SET_WATCHDOG:g}"
    watchdog = f"{name}'s watchdog of {1e3 * timeout:g} ms"
    absent = f"{name} has no watchdog: it would go on for ever if this program died"
    endless = (
        f"{name}'s watchdog of {timeout:g} s is none: the arm would go on that long"
    )
    short = f"{watchdog} is too short for {settings.rate:g} Hz; give {options}"
    return _first(
        (STOP, timeout == 0.0, f"{absent}; give {options} or set TIMEOUT"),
        (STOP, timeout > _NO_WATCHDOG, f"{endless}; give {options} or set TIMEOUT"),
        (STOP, timeout < least, short),
        (NOTE, timeout > _LONG_WATCHDOG, f"{watchdog} is long; {options} is better"),
        (OK, True, f"{name}'s watchdog stops it after {1e3 * timeout:g} ms"),
    )


def _state(
    motor: InspectedMotor, settings: PlaySettings, name: str, taken_over: bool
) -> Iterator[Check]:
    feedback = motor.feedback
    if feedback is None:
        yield _stop(f"{name} does not tell its state; its firmware may be too old")
        return
    code = int(feedback.status[0])
    if code == protocol.ENABLED and taken_over:
        yield _note(
            f"{name} is enabled by another program: it is taken over, and disabled at the end"
        )
    elif code == protocol.ENABLED:
        yield _stop(f"{name} is enabled already; end the program that uses it")
    elif code != protocol.DISABLED:
        fault = protocol.status_text(code)
        yield _stop(
            f"{name} reports {fault}; find the cause, then clear it or power-cycle"
        )
    temperature = max(feedback.temperature_mos[0], feedback.temperature_rotor[0])
    if temperature > settings.start_temperature:
        limit = f"{settings.start_temperature:g}"
        yield _stop(
            f"{name} is at {temperature} deg C, above {limit}; let it cool down"
        )


def _in_time(took: float | None, settings: PlaySettings) -> Iterator[Check]:
    if took is None:
        return
    text = f"all motors have answered after {1e3 * took:.1f} ms"
    rates = protocol.HANDY_RATES
    fits = next((rate for rate in rates if rate * took <= _ANSWER_SHARE), rates[-1])
    late = (
        f"{text}, too late for {settings.rate:g} Hz: commands and samples would be mixed up; use "
        f"--rate {fits:g} or a faster adapter"
    )
    timely = took <= _ANSWER_SHARE * settings.period
    yield _first(
        (OK, timely, f"{text}, in time for {settings.rate:g} Hz"), (STOP, True, late)
    )


def direction_checks(plan: Plan, model: HoldingCheck | None) -> Iterator[Check]:
    """Yield which joints' directions nothing has shown, and what to do."""
    holding = model or FileHolding(plan.trajectory)
    unverified = [
        joint.label for joint in holding.unverified_joints(plan.trajectory.q[0])
    ]
    if not unverified:
        yield Check(
            OK, "gravity shows which way each joint turns, or somebody has verified it"
        )
        return
    finding = (
        f"nobody has verified which way {', '.join(unverified)} turn, and where the trajectory "
        "begins gravity hardly loads them"
    )
    if model is None or plan.allowed.directions:
        yield _note(f"{finding}: mirrored or swapped, they would be played like that")
        return
    yield _stop(
        f"{finding}; move them by hand once (robot-sysid motors map --model), or let each move a "
        "little (robot-sysid motors play --verify), and give the --joint-map; --accept-directions "
        "plays without"
    )


def _near_start(plan: Plan, q: Array) -> Iterator[Check]:
    tolerance = plan.settings.start_tolerance
    for joint, position, first in zip(plan.trajectory.joints, q, plan.trajectory.q[0]):
        distance = abs(position - first)
        if distance <= tolerance:
            continue
        text = (
            f"{joint.label} is at {position:.3f} rad but the trajectory starts at {first:.3f}, "
            f"more than {tolerance:g} away; move it there by hand"
        )
        if abs(distance - 2.0 * np.pi) < tolerance:
            text += (
                "; a whole turn apart: the motor lost its turn count when it was off"
            )
        yield _stop(text)
