"""The plan of a run on motors, and the checks that it has to pass before an arm may move."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from robot_sysid.damiao import protocol
from robot_sysid.damiao import trajectory as motion
from robot_sysid.damiao.bus import InspectedMotor, Inspection
from robot_sysid.damiao.joints import DamiaoJoint, Mounting, id_problems, limits_agree
from robot_sysid.damiao.references import HoldingCheck
from robot_sysid.damiao.session import PAUSE, REPLY_SHARE
from robot_sysid.damiao.settings import Permissions, Plan, PlaySettings
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array
from robot_sysid.records.messages import Level, Remark

_START_TEMPERATURE = 60.0
"""Highest temperature at which a run may begin [deg C].

A judgement: half way from a warm room to the limit, so that motors do not reach it during a run.
"""
_LEAST_WATCHDOG_CYCLES = 2 * (PAUSE + 1)
"""Least watchdog time in control cycles.

A motor whose answer is missing gets its next command ``PAUSE`` + 1 cycles after the last one. The
watchdog has to outlast two such waits in succession.
"""
_NO_WATCHDOG = 5.0
"""Watchdog time above which the watchdog is no protection at all [s] (a judgement)."""


note = partial(Remark, Level.SAYS, "")
"""Return a finding, by its text, that the user should know."""
stop = partial(Remark, Level.REFUSES, "")
"""Return a finding, by its text with the remedy, that forbids to play."""


def stops(checks: Sequence[Remark]) -> list[str]:
    """Return the texts of the checks that forbid to play."""
    return [check.text for check in checks if check.level is Level.REFUSES]


def require_no_stop(checks: Sequence[Remark], consequence: str) -> None:
    """Raise HardwareAbort with ``consequence`` and the first check's text that forbids to play.

    Where no check forbids to play, nothing happens.
    """
    for text in stops(checks):
        raise HardwareAbort(f"{consequence}: {text}")


def plan_checks(plan: Plan) -> list[Remark]:
    """Return the checks of a plan that need neither a bus nor a model of the arm.

    They compare ids, speed at the ends, velocities with positions, ratings of the motors, bus load
    and the user's limits.
    """
    joints = plan.trajectory.joints
    ids = [(joint.can_id, joint.master_id) for joint in joints]
    bounds = motion.user_bounds(plan.limits, len(joints))
    excesses = motion.excesses(plan.trajectory, plan.settings.speed, bounds)
    return [
        *map(stop, id_problems(ids)),
        *_motion_checks(plan),
        *_motor_checks(plan),
        *_load_checks(plan),
        *map(stop, excesses),
    ]


def _motion_checks(plan: Plan) -> Iterator[Remark]:
    """Yield a stop where a trajectory has a speed at an end, or velocities do not fit positions."""
    trajectory = plan.trajectory
    end_speed = float(np.max(np.abs(trajectory.qd[[0, -1]]))) * plan.settings.speed
    # A quarter of the default approach speed.
    if end_speed > 0.05:
        yield stop(
            f"the trajectory starts or ends at {end_speed:.2f} rad/s; it has to start and end at "
            "rest"
        )
    mismatch = motion.velocity_mismatch(trajectory)
    if mismatch is not None:
        row, joint, error = mismatch
        yield stop(
            f"from {trajectory.time[row]:g} s on, positions of {trajectory.joints[joint].label} "
            f"change by {error:.4g} rad/s more than its velocities say; export the file again, "
            "with at least four decimals"
        )


def _motor_checks(plan: Plan) -> Iterator[Remark]:
    """Yield the checks of motors by the data of their types: torque, speed, resolution.

    A rating that the motor cannot exceed stops the run, one that can be exceeded briefly is noted.
    """
    trajectory = plan.trajectory
    joints = trajectory.joints
    settings = plan.settings
    speeds = np.abs(trajectory.qd).max(axis=0) * settings.speed
    torques = np.abs(trajectory.tau).max(axis=0)
    for j, joint in enumerate(joints):
        for warning in motion.rating_warnings(joint, speeds[j], torques[j]):
            is_possible = motion.CANNOT_FOLLOW not in warning
            yield note(warning) if is_possible else stop(warning)


def _load_checks(plan: Plan) -> Iterator[Remark]:
    """Yield a stop where the bus cannot carry the frames of all motors."""
    limit = protocol.PLANNING_LIMIT
    n_motors = plan.trajectory.n_joints
    settings = plan.settings
    load = protocol.bus_load(n_motors, 1.0 / settings.period, plan.timing)
    bus_type = "CAN-FD" if plan.timing.fd else "classic CAN"
    if load > limit:
        rate = protocol.default_rate(n_motors, plan.timing)
        yield stop(
            f"frames at {settings.rate:g} Hz load {bus_type} to {100 * load:.0f} %, limit "
            f"{100 * limit:.0f} %; use --rate {rate:g}"
        )


def _frame_limit_checks(
    plan: Plan, limits: Sequence[tuple[float, ...]]
) -> Iterator[Remark]:
    """Yield a stop for each quantity of a joint beyond the range of its motor's frames.

    ``limits`` are PMAX, VMAX and TMAX of each joint's motor [rad, rad/s, N m].
    """
    trajectory = plan.trajectory
    mounting = Mounting.of(trajectory.joints)
    pmax, velocity, torque = np.array(limits).T
    lower, upper = mounting.frame_range(pmax)
    bounds = motion.Bounds("its registers'", lower, upper, velocity, torque=torque)
    for excess in motion.excesses(trajectory, plan.settings.speed, bounds):
        yield stop(f"{excess}; export a smaller trajectory")


def bus_checks(plan: Plan, inspection: Inspection) -> Iterator[Remark]:
    """Yield the checks of a plan against the answers of the motors on the bus.

    Frame limits, answer time and the distance from the first point are only checked if the scaling
    limits of all joints' motors are known.
    """
    if inspection.unsolicited:
        yield stop(
            f"{inspection.unsolicited} frames came without being asked for: another program is "
            "talking to these motors; end it first"
        )
    motors = inspection.motors
    ids = [(can_id, motor.master_id) for can_id, motor in motors.items()]
    yield from map(stop, id_problems(ids))
    joints = plan.trajectory.joints
    limits = []
    for joint in joints:
        motor = motors.get(joint.can_id)
        if motor is None:
            yield stop(
                f"{joint.label} does not answer; check power, wiring, its id, bit rate, --fd"
            )
            continue
        yield from _condition_checks(motor, plan, joint)
        if set(protocol.SCALING) <= set(motor.registers):
            limits.append(motor.limits)
    if len(limits) == len(joints):
        yield from _frame_limit_checks(plan, limits)
        yield from _answer_time_checks(inspection.round_trip, plan.settings)
        yield from _start_checks(plan, plan.joint_positions(inspection))
    driven = {joint.can_id for joint in joints}
    yield from _other_motor_checks(
        [motor for can_id, motor in motors.items() if can_id not in driven]
    )


def _other_motor_checks(motors: Sequence[InspectedMotor]) -> Iterator[Remark]:
    """Yield the checks of ``motors`` outside the trajectory, which are left limp."""
    if motors:
        names = ", ".join(motor.name for motor in motors)
        yield note(f"not in the trajectory and left limp: {names}")
    for motor in motors:
        if motor.feedback is None or motor.feedback.status[0] == protocol.ENABLED:
            yield stop(
                f"{motor.name} is not in the trajectory, and is enabled by another program or does "
                "not tell: end that program and power-cycle the motor, or take it off the bus"
            )


def _condition_checks(
    motor: InspectedMotor, plan: Plan, joint: DamiaoJoint
) -> Iterator[Remark]:
    """Yield the checks of one motor's registers and state.

    Args:
        motor: answers of the motor.
        plan: the plan of the run.
        joint: joint that the motor drives, with which ids and scaling are compared.
    """
    name = joint.label
    registers = motor.registers
    if len(motor.reply_ids) > 1:
        yield stop(f"{len(motor.reply_ids)} motors answer to the id of {name}")
    missing = set(protocol.REQUIRED) - set(registers)
    if missing:
        names = ", ".join(protocol.NAMES[number] for number in sorted(missing))
        yield stop(f"{name} does not answer for {names}; try again")
        return
    stored_id = int(registers[protocol.MST_ID])
    if {stored_id, *motor.reply_ids} != {joint.master_id}:
        answers = ", ".join(
            f"{reply_id:#x}" for reply_id in sorted(set(motor.reply_ids))
        )
        yield stop(
            f"{name} answers on {answers} (MST_ID {stored_id:#x}) but the trajectory expects "
            f"{joint.master_id:#x}; set it with motors setup --new-master-id, or export again with "
            "the right --master-id"
        )
    yield from _scaling_checks(motor, joint, plan.permissions)
    mode = int(registers[protocol.CTRL_MODE])
    if mode != protocol.MIT_MODE:
        mode_name = protocol.MODES.get(mode, "unknown")
        yield stop(f"{name} is in mode {mode} ({mode_name}); set CTRL_MODE to 1 (MIT)")
    watchdog = registers[protocol.TIMEOUT] * protocol.TIMEOUT_UNIT
    yield from _watchdog_checks(name, watchdog, plan.settings)
    yield from _state_checks(motor, plan.settings, name)


def _scaling_checks(
    motor: InspectedMotor, joint: DamiaoJoint, permissions: Permissions
) -> Iterator[Remark]:
    """Yield a stop where a motor's PMAX, VMAX, TMAX are not those of its joint's motor type.

    It is a note where the user permits the limits in the registers.
    """
    limits = motor.limits
    stored = ", ".join(f"{limit:g}" for limit in limits)
    nominal = ", ".join(f"{limit:g}" for limit in joint.spec.limits)
    if limits_agree(joint.spec.limits, limits):
        return
    name = joint.label
    difference = (
        f"{name} has PMAX, VMAX, TMAX {stored} but a {joint.motor_type} has {nominal}"
    )
    if permissions.register_limits and min(limits) > 0.0:
        yield note(f"{difference}: the motor's own values are used")
    else:
        yield stop(
            f"{difference}; if the motor is right, give --accept-register-limits"
        )


def _watchdog_checks(
    name: str, timeout: float, settings: PlaySettings
) -> Iterator[Remark]:
    """Yield a finding where a watchdog's timeout [s] is too long, or ends between two cycles.

    ``name`` is the motor's name in the message.
    """
    least = _LEAST_WATCHDOG_CYCLES * settings.period
    # The timeout to propose, in tenths of a second.
    proposed = max(0.1, np.ceil(10.0 * least) / 10.0)
    remedy = f"set it with motors setup --watchdog {proposed:g} --store"
    watchdog = f"{name}'s watchdog of {1e3 * timeout:g} ms"
    if not least <= timeout <= _NO_WATCHDOG:
        yield stop(
            f"{watchdog} is not from {1e3 * least:g} to {1e3 * _NO_WATCHDOG:g} ms (0 is none: the "
            f"arm would go on if this program died); {remedy}"
        )
    # Until then an arm that nobody commands falls or runs far.
    elif timeout > 0.5:
        yield note(f"{watchdog} is long; {remedy}")


def _state_checks(
    motor: InspectedMotor, settings: PlaySettings, name: str
) -> Iterator[Remark]:
    """Yield a stop where a motor's state or temperature forbids to enable it.

    ``name`` is the motor's name in messages.
    """
    feedback = motor.feedback
    if feedback is None:
        yield stop(f"{name} does not tell its state; its firmware may be too old")
        return
    code = int(feedback.status[0])
    if code == protocol.ENABLED:
        yield stop(f"{name} is enabled already; end the program that uses it")
    elif code != protocol.DISABLED:
        fault = protocol.status_text(code)
        yield stop(
            f"{name} reports {fault}; find the cause, then clear it or power-cycle"
        )
    temperature = max(feedback.temperature_mos[0], feedback.temperature_rotor[0])
    limit = min(_START_TEMPERATURE, settings.max_temperature)
    if temperature > limit:
        yield stop(
            f"{name} is at {temperature} deg C, above {limit:g}; let it cool down"
        )


def _answer_time_checks(
    round_trip: float | None, settings: PlaySettings
) -> Iterator[Remark]:
    """Yield a stop where not all motors' answers come while the player waits for them.

    ``round_trip`` is the time from the commands to the last answer [s]; None where it is unknown.
    """
    if round_trip is not None and round_trip > REPLY_SHARE * settings.period:
        rate = protocol.handy_rate(REPLY_SHARE / round_trip)
        yield stop(
            f"all motors have answered after {1e3 * round_trip:.1f} ms, too late for "
            f"{settings.rate:g} Hz: commands and samples would be mixed up; use --rate {rate:g} or "
            "a faster adapter"
        )


def direction_checks(plan: Plan, holding: HoldingCheck) -> Iterator[Remark]:
    """Yield a finding where a joint's direction is not known, by its load or a verification.

    ``holding`` computes the torques that hold the arm. Where it has no model, or if the user
    permits them, unknown directions are only noted; otherwise they stop the run.
    """
    joints = holding.unverified_joints(plan.trajectory.q[0])
    labels = ", ".join(joint.label for joint in joints)
    if not joints:
        return
    finding = (
        f"nobody has verified which way {labels} turn, and where the trajectory begins gravity "
        "hardly loads them"
    )
    if plan.permissions.directions or not holding.is_model:
        yield note(f"{finding}: mirrored or swapped, they would be played like that")
        return
    yield stop(
        f"{finding}; move them by hand once with motors map, and give the --joint-map; "
        "--accept-directions plays without"
    )


def _start_checks(plan: Plan, q: Array) -> Iterator[Remark]:
    """Yield a stop for each joint whose position in q (n,) [rad] is far from the first point."""
    tolerance = plan.settings.start_tolerance
    for joint, position, first in zip(plan.trajectory.joints, q, plan.trajectory.q[0]):
        distance = abs(position - first)
        if distance <= tolerance:
            continue
        yield stop(
            f"{joint.label} is at {position:.3f} rad but the trajectory starts at {first:.3f}, "
            f"more than {tolerance:g} away; move it by hand (a whole turn: it lost its turn count)"
        )
