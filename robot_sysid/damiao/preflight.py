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

from robot_sysid.damiao import trajectory as motion
from robot_sysid.damiao.centring import SamplingRipple
from robot_sysid.damiao.inspection import InspectedMotor, Inspection
from robot_sysid.damiao.protocol import frames
from robot_sysid.damiao.protocol.codec import Scaling
from robot_sysid.damiao.protocol.joints import DamiaoJoint, JointSpace, id_problems
from robot_sysid.damiao.protocol.motors import limits_agree, matching_types
from robot_sysid.damiao.recorder import RecordingOptions
from robot_sysid.damiao.references import FileHolding, HoldingCheck, torque_doubt, way_rows
from robot_sysid.damiao.safety.bounds import CommandRange
from robot_sysid.damiao.session import PAUSE
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.errors import HardwareAbort, InputError
from robot_sysid.motion.options import LimitOptions
from robot_sysid.records import Array
from robot_sysid.records.options import OptionRecord, option

OK, NOTE, STOP = "ok", "note", "stop"
# A quarter of the speed at which an arm goes to its first point [rad/s].
_REST_SPEED = 0.05
# A motor whose answer is missing gets no command for some cycles; twice that, and both ends.
_LEAST_WATCHDOG_CYCLES = 2 + 2 * PAUSE
# Judgements [s]: half a second lets an arm that nobody commands fall or run a quarter of its
# range; nobody waits five for a stop; and no run needs a watchdog above one.
_LONG_WATCHDOG, _NO_WATCHDOG, _LONGEST_SET_WATCHDOG = 0.5, 5.0, 1.0
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


_note, _stop = partial(Check, NOTE), partial(Check, STOP)


def _first(*table: tuple[str, object, str]) -> Check:
    """Return the first line of a table of severity, whether it holds, and text."""
    return next(Check(severity, text) for severity, holds, text in table if holds)


def _watchdog_time(value: float) -> str | None:
    fits = 0.0 < value <= _LONGEST_SET_WATCHDOG
    return None if fits else f"must be above 0 and at most {_LONGEST_SET_WATCHDOG:g} s"


@dataclass(frozen=True)
class Permissions(OptionRecord):
    """What the user allowed on purpose."""

    register_limits: bool = option(
        False,
        "use the motors' own PMAX, VMAX, TMAX where they differ from the motor type's",
        flag="--accept-register-limits",
    )
    watchdog: float | None = option(
        None,
        "set the motors' watchdogs for this run; nothing is stored in them",
        "S [s]",
        flag="--set-watchdog",
        check=_watchdog_time,
        usual="as they are",
    )
    directions: bool = option(
        False,
        "play although nobody has verified which way the joints turn that gravity hardly loads",
        flag="--accept-directions",
    )


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
    timing: frames.BusTiming = frames.BusTiming()
    allowed: Permissions = Permissions()
    recording: RecordingOptions = RecordingOptions()
    inertia: Array | None = None
    limits: LimitOptions = motion.NO_LIMITS
    model_range: tuple[Array, Array] | None = None
    ripple: SamplingRipple | None = None

    def __post_init__(self) -> None:
        if len(self.trajectory.time) < 2:
            raise InputError(f"{self.trajectory.path} needs at least two rows to be played")
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
        where, n = self.settings.park, self.trajectory.n_joints
        if where in (None, "rest", "start"):
            return None
        try:
            cells = Path(str(where)).read_text(encoding="utf-8-sig").split(",")
            pose = np.array([float(cell) for cell in cells])
        except (OSError, ValueError) as error:
            raise InputError(
                f"--park takes rest, start or a file with a line of {n} positions; {where}: {error}"
            ) from None
        if pose.shape != (n,) or not np.all(np.isfinite(pose)):
            raise InputError(f"{where} has to hold {n} positions in one line, separated by commas")
        return pose

    def command_range(self, held: Array) -> CommandRange:
        """Return where and how fast commands may go, held motors at ``held`` (m,) behind [rad].

        Positions are within the model's range, or else within that of the trajectory.
        """
        played = self.trajectory
        lower, upper = self.model_range or (np.min(played.q, axis=0), np.max(played.q, axis=0))
        if self.model_range is None and self.pose is not None:
            lower = np.minimum(lower, self.pose)
            upper = np.maximum(upper, self.pose)
        slope = np.diff(played.q, axis=0) / np.diff(played.time)[:, None]
        fastest = np.maximum(np.abs(slope).max(axis=0), np.abs(played.qd).max(axis=0))
        speed = np.maximum(self.settings.speed * fastest, self.settings.approach_speed)
        still = np.full_like(held, self.settings.approach_speed)
        return CommandRange(
            np.append(lower, held), np.append(upper, held), _SPEED_ROOM * np.append(speed, still)
        )

    def ways(self, here: Array) -> Iterator[tuple[str, Array, Array]]:
        """Yield from where to where (n,) an arm at ``here`` goes to begin and to park [rad]."""
        rest = here if self.settings.park == "start" else self.pose
        yield "on the way to the first point", here, self.trajectory.q[0]
        if rest is not None:
            yield "on the way to where it is parked", self.trajectory.q[-1], rest

    def places(self, inspection: Inspection) -> Array:
        """Return where the joints stand (n,) [rad]; NaN where a motor does not tell."""
        joints, motors = self.trajectory.joints, inspection.motors
        told = [motors[j.address].position if j.address in motors else np.nan for j in joints]
        return JointSpace.of(joints).joint_position(np.array(told))

    def others(self, inspection: Inspection) -> tuple[InspectedMotor, ...]:
        """Return the motors that answer but drive no joint of the trajectory."""
        known = {joint.address for joint in self.trajectory.joints}
        return tuple(m for address, m in sorted(inspection.motors.items()) if address not in known)


def limit_checks(plan: Plan, here: Array | None = None, orders: Sequence[str] = ()) -> list[Check]:
    """Return where the trajectory, or else the ways from ``here`` (n,), break limits asked for.

    ``orders`` are those of the joints on each way.
    """
    played, settings = plan.trajectory, plan.settings
    if here is None:
        return list(map(_stop, motion.limit_excesses(played, settings.speed, plan.limits)))
    pace = settings.approach_speed, settings.approach_time
    slow = f"; move it nearer by hand, or lower --approach-speed {settings.approach_speed:g}"
    return [
        _stop(f"{words}, {excess}{slow}")
        for (words, begin, end), order in zip(plan.ways(here), orders)
        for excess in motion.limit_excesses(
            way_rows(played, begin, end, pace, order), 1.0, plan.limits
        )
    ]


def stops(checks: Sequence[Check]) -> list[str]:
    """Return the texts of the checks that forbid to play."""
    return [check.text for check in checks if check.severity == STOP]


def require_no_stop(checks: Sequence[Check], words: str) -> None:
    """Raise HardwareAbort with the first check that forbids to play, after some words."""
    for text in stops(checks):
        raise HardwareAbort(f"{words}: {text}")


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
    problems = [_stop(text) for text in id_problems([(*j.address, j.master_id) for j in joints])]
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
    if (found := motion.velocity_mismatch(played.time, played.q, played.qd)) is None:
        yield Check(OK, "velocities and positions agree")
    else:
        label, line = played.joints[found.joint].label, played.line[found.row]
        yield _stop(
            f"line {line}: velocity {found.stated:.4g} rad/s of {label}, but the positions "
            f"change by {found.shown:.4g} rad/s; export the file again, with at least four decimals"
        )


def _motors(plan: Plan) -> Iterator[Check]:
    """Yield what is beyond motors' ratings, and which joints a step of torque throws about."""
    played, joints, settings = plan.trajectory, plan.trajectory.joints, plan.settings
    steps = Scaling(joint.spec.limits for joint in joints).steps[2]
    moves = [np.inf] * len(joints) if plan.inertia is None else plan.inertia
    yield from map(_stop, motion.rotor_problems(played, settings.speed, torque_doubt(joints)))
    fastest, strongest = (np.abs(each).max(axis=0) for each in (played.qd, played.tau))
    for j, (joint, step, moved) in enumerate(zip(joints, steps, moves)):
        torque = strongest[j] / joint.torque_ratio
        for text in motion.rating_warnings(joint, fastest[j] * settings.speed, torque):
            yield Check(STOP if motion.CANNOT_FOLLOW in text else NOTE, text)
        if joint.spec.note:
            yield _note(f"{joint.label}, {joint.motor_type}: {joint.spec.note}")
        if step * settings.period / moved > _SHAKEN:
            yield _note(
                f"{joint.label} moves only {moved:.2g} kg m^2 in the model, and a step of a "
                f"{joint.motor_type}'s torque is {step:.2g} N m: it will shake; give the model the "
                "rotor's inertia (armature), or the joint a smaller motor"
            )


def _load(
    addresses: Iterable[frames.Address], settings: PlaySettings, timing: frames.BusTiming
) -> Check:
    buses, limit = [bus for bus, _ in addresses], frames.PLANNING_LIMIT
    n_motors = max(buses.count(bus) for bus in buses)
    load = frames.bus_load(n_motors, 1.0 / settings.period, timing)
    kind = "CAN-FD" if timing.fd else "classic CAN"
    text = f"{n_motors} motors at {settings.rate:g} Hz load {kind} to {100 * load:.0f} %"
    handy = frames.suggested_rate(n_motors, timing)
    full = f"{text}, limit {100 * limit:.0f} %; use --rate {handy:g}"
    return _first((OK, load <= limit, text), (STOP, True, full))


def _within_limits(
    plan: Plan, limits: Sequence[tuple[float, float, float]], whose: str
) -> Sequence[Check]:
    played, speed, remedy = plan.trajectory, plan.settings.speed, "export a smaller trajectory"
    space, places = JointSpace.of(played.joints), played.q
    # Where it is parked counts as well.
    if plan.pose is not None:
        places, remedy = np.vstack([places, plan.pose]), f"{remedy}, or choose another --park"
    step = np.diff(played.q, axis=0) / np.diff(played.time)[:, None]
    asked = (*space.to_motors(places, speed * played.qd, played.tau), speed * step)
    words = ("position", "velocity", "torque", "position step"), ("rad", "rad/s", "N m", "rad/s")
    beyond = [
        _stop(f"{joint.label}: {what} {peak:.4g} {unit} is beyond {whose} limit {top:g}; {remedy}")
        for j, (joint, limit) in enumerate(zip(played.joints, limits))
        for (what, unit, values), top in zip(zip(*words, asked), (*limit, limit[1]))
        if (peak := np.abs(values[:, j]).max()) > top * (1.0 + _FLOAT32_SLACK)
    ]
    return beyond or [Check(OK, f"the trajectory stays within {whose} limits")]


# --- what the motors say ------------------------------------------------------------------------


def general_checks(
    inspection: Inspection, settings: PlaySettings, timing: frames.BusTiming
) -> list[Check]:
    """Return what motors say on their own, without a trajectory to compare them with."""
    motors = inspection.motors.values()
    conditions = [check for m in motors for check in _condition(m, settings, Permissions())]
    return [_load(inspection.motors, settings, timing), *_bus_itself(inspection), *conditions]


def bus_checks(plan: Plan, inspection: Inspection) -> list[Check]:
    """Return what the motors on the bus say to the plan."""
    joints, settings, checks = plan.trajectory.joints, plan.settings, [*_bus_itself(inspection)]
    present = [inspection.motors[j.address] for j in joints if j.address in inspection.motors]
    for joint in joints:
        if (motor := inspection.motors.get(joint.address)) is None:
            checks.append(
                _stop(f"{joint.label} does not answer; check power, wiring, its id, bit rate")
            )
        else:
            checks += _condition(motor, settings, plan.allowed, joint)
    limits = [m.limits for m in present if set(frames.SCALING) <= set(m.registers)]
    if len(limits) == len(joints):
        checks += _within_limits(plan, limits, "its registers'")
        checks += _in_time(inspection.round_trip, settings)
        checks += _near_start(plan, plan.places(inspection))
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
        yield _note(f"not in the trajectory and left limp: {names} (--others hold holds them)")
        yield from (check for motor in others for check in _left_alone(motor))
        return
    yield _note(f"not in the trajectory and held where they are: {names}")
    for motor in others:
        yield from _condition(motor, plan.settings, plan.allowed, taken_over=True)
        if not matching_types(motor.limits):
            yield _stop(f"{motor.name} is of no known type and cannot be held; use --others limp")


def _left_alone(motor: InspectedMotor) -> Iterator[Check]:
    """Yield what forbids to leave a motor as it is: it drives something, and nobody watches it."""
    if motor.feedback is None:
        yield _stop(f"{motor.name} does not tell whether it is enabled; take it off the bus")
    elif motor.feedback.status[0] == frames.ENABLED:
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
    name, held = joint.label if joint else motor.name, motor.registers
    if len(motor.reply_ids) > 1:
        yield _stop(f"{len(motor.reply_ids)} motors answer to the id of {name}")
    lacking = [frames.NAMES[number] for number in frames.REQUIRED if number not in held]
    if lacking:
        yield _stop(f"{name} does not answer for {', '.join(lacking)}; try again")
        return
    if joint:
        yield from _identity(motor, joint, name)
        yield _scaling(motor, joint, allow)
    mode = int(held[frames.CTRL_MODE])
    if mode != frames.MIT_MODE:
        said = frames.MODES.get(mode, "unknown")
        yield _stop(f"{name} is in mode {mode} ({said}); set CTRL_MODE to 1 (MIT)")
    stored = held[frames.TIMEOUT] * frames.TIMEOUT_UNIT
    yield _watchdog(name, stored if allow.watchdog is None else allow.watchdog, play)
    yield from _state(motor, play, name, taken_over)


def _identity(motor: InspectedMotor, joint: DamiaoJoint, name: str) -> Iterator[Check]:
    found, stored = (int(motor.registers[n]) for n in (frames.ESC_ID, frames.MST_ID))
    if found != joint.can_id:
        yield _stop(f"{name} says that its CAN id is {found}; power-cycle it")
    if stored != joint.master_id or set(motor.reply_ids) != {joint.master_id}:
        answers = ", ".join(f"{i:#x}" for i in sorted(set(motor.reply_ids)))
        yield _stop(
            f"{name} answers on {answers} (MST_ID {stored:#x}) but the trajectory expects "
            f"{joint.master_id:#x}; set it (robot-sysid motors setup --new-master-id), or export "
            "again (robot-sysid plan --export-damiao --master-id)"
        )


def _scaling(motor: InspectedMotor, joint: DamiaoJoint, allowed: Permissions) -> Check:
    found, wanted = motor.limits, joint.spec.limits
    held, usual = (", ".join(f"{value:g}" for value in values) for values in (found, wanted))
    text = f"{joint.label} has PMAX, VMAX, TMAX {held}"
    same = f"{joint.label} is scaled as a {joint.motor_type}: {held}"
    other = f"{text} but a {joint.motor_type} has {usual}"
    return _first(
        (STOP, min(found) <= 0.0, f"{text}: not usable"),
        (OK, limits_agree(wanted, found), same),
        (NOTE, allowed.register_limits, f"{other}: the motor's own values are used"),
        (STOP, True, f"{other}; if the motor is right, give --accept-register-limits"),
    )


def _watchdog(name: str, timeout: float, settings: PlaySettings) -> Check:
    least = _LEAST_WATCHDOG_CYCLES * settings.period
    usual = f"--set-watchdog {max(0.1, np.ceil(10.0 * least) / 10.0):g}"
    if least > _LONGEST_SET_WATCHDOG:
        slowest = _LEAST_WATCHDOG_CYCLES / _LONGEST_SET_WATCHDOG
        usual = f"--rate {slowest:g} and --set-watchdog {_LONGEST_SET_WATCHDOG:g}"
    held, remedy = f"{name}'s watchdog of {1e3 * timeout:g} ms", f"give {usual}"
    gone = f"{name} has no watchdog: it would go on for ever if this program died"
    none = f"{name}'s watchdog of {timeout:g} s is none: the arm would go on that long"
    short = f"{held} is too short for {settings.rate:g} Hz; {remedy}"
    return _first(
        (STOP, timeout == 0.0, f"{gone}; {remedy} or set TIMEOUT"),
        (STOP, timeout > _NO_WATCHDOG, f"{none}; {remedy} or set TIMEOUT"),
        (STOP, timeout < least, short),
        (NOTE, timeout > _LONG_WATCHDOG, f"{held} is long; {usual} is better"),
        (OK, True, f"{name}'s watchdog stops it after {1e3 * timeout:g} ms"),
    )


def _state(
    motor: InspectedMotor, settings: PlaySettings, name: str, taken_over: bool
) -> Iterator[Check]:
    told = motor.feedback
    if told is None:
        yield _stop(f"{name} does not tell its state; its firmware may be too old")
        return
    code = int(told.status[0])
    if code == frames.ENABLED and taken_over:
        yield _note(
            f"{name} is enabled by another program: it is taken over, and disabled at the end"
        )
    elif code == frames.ENABLED:
        yield _stop(f"{name} is enabled already; end the program that uses it")
    elif code != frames.DISABLED:
        said = frames.describe(code)
        yield _stop(f"{name} reports {said}; find the cause, then clear it or power-cycle")
    hot, most = max(told.temperature_mos[0], told.temperature_rotor[0]), settings.start_temperature
    if hot > most:
        yield _stop(f"{name} is at {hot} deg C, above {most:g}; let it cool down")


def _in_time(took: float | None, settings: PlaySettings) -> Iterator[Check]:
    if took is None:
        return
    text = f"all motors have answered after {1e3 * took:.1f} ms"
    rates = frames.HANDY_RATES
    fits = next((rate for rate in rates if rate * took <= _ANSWER_SHARE), rates[-1])
    late = (
        f"{text}, too late for {settings.rate:g} Hz: commands and samples would be mixed up; use "
        f"--rate {fits:g} or a faster adapter"
    )
    timely = took <= _ANSWER_SHARE * settings.period
    yield _first((OK, timely, f"{text}, in time for {settings.rate:g} Hz"), (STOP, True, late))


def direction_checks(plan: Plan, model: HoldingCheck | None) -> Iterator[Check]:
    """Yield which joints' directions nothing has shown, and what to do."""
    known = model or FileHolding(plan.trajectory)
    unseen = [joint.label for joint in known.unjudged(plan.trajectory.q[0])]
    if not unseen:
        yield Check(OK, "gravity shows which way each joint turns, or somebody has verified it")
        return
    names = f"nobody has verified which way {', '.join(unseen)} turn"
    names += ", and where the trajectory begins gravity hardly loads them"
    if model is None or plan.allowed.directions:
        return (yield _note(f"{names}: mirrored or swapped, they would be played like that"))
    yield _stop(
        f"{names}; move them by hand once (robot-sysid motors map --model), or let each move a "
        "little (robot-sysid motors play --verify), and give the --joint-map; --accept-directions "
        "plays without"
    )


def _near_start(plan: Plan, places: Array) -> Iterator[Check]:
    tolerance = plan.settings.start_tolerance
    for joint, here, first in zip(plan.trajectory.joints, places, plan.trajectory.q[0]):
        away = abs(here - first)
        if away > tolerance:
            whole = abs(away - 2.0 * np.pi) < tolerance
            turn = "; a whole turn apart: the motor lost its turn count when it was off"
            yield _stop(
                f"{joint.label} is at {here:.3f} rad but the trajectory starts at {first:.3f}, "
                f"more than {tolerance:g} away; move it there by hand{turn if whole else ''}"
            )
