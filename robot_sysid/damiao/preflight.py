"""The plan of a run on motors, and the checks that it has to pass before an arm may move."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import chain

import numpy as np

from robot_sysid.damiao import protocol
from robot_sysid.damiao import trajectory as motion
from robot_sysid.damiao.bus import InspectedMotor, Inspection
from robot_sysid.damiao.joints import DamiaoJoint, Mounting, id_problems, limits_agree
from robot_sysid.damiao.references import HoldingCheck
from robot_sysid.damiao.session import PAUSE, REPLY_SHARE
from robot_sysid.damiao.settings import Plan, PlaySettings, joint_positions
from robot_sysid.errors import HardwareAbort
from robot_sysid.records.messages import Level, Remark
from robot_sysid.wording import option_name

note = partial(Remark, Level.SAYS, "")
"""Return a finding, by its text, that the user should know."""
stop = partial(Remark, Level.REFUSES, "")
"""Return a finding, by its text with the remedy, that forbids to play."""


def stops(checks: Sequence[Remark]) -> list[str]:
    """Return the texts of the checks that forbid to play."""
    return [check.text for check in checks if check.level is Level.REFUSES]


def require_playable(checks: Sequence[Remark]) -> None:
    """Raise HardwareAbort with the first check's text that forbids to play.

    Where no check forbids to play, nothing happens.
    """
    for text in stops(checks):
        raise HardwareAbort(f"not played: {text}")


def plan_checks(plan: Plan) -> Iterator[Remark]:
    """Yield the checks of a plan that need neither a bus nor a model of the arm.

    They compare ids, speed at the ends, velocities with positions, ratings of the motors, bus load
    and the user's limits. A rating that the motor cannot exceed stops the run, one that can be
    exceeded briefly is noted.
    """
    trajectory = plan.trajectory
    joints = trajectory.joints
    settings = plan.settings
    yield from map(stop, id_problems([(j.can_id, j.master_id) for j in joints]))

    end_speed = np.max(np.abs(trajectory.qd[[0, -1]])) * settings.speed
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
            f"from {trajectory.time[row]:g} s on, positions of {joints[joint].label} "
            f"change by {error:.4g} rad/s more than its velocities say; export the file again, "
            "with at least four decimals"
        )

    speeds = np.abs(trajectory.qd).max(axis=0) * settings.speed
    torques = np.abs(trajectory.tau).max(axis=0)
    for warning in chain(*map(motion.rating_warnings, joints, speeds, torques)):
        is_possible = motion.CANNOT_FOLLOW not in warning
        yield note(warning) if is_possible else stop(warning)

    limit = protocol.PLANNING_LIMIT
    load = protocol.bus_load(len(joints), 1.0 / settings.period, plan.timing)
    if load > limit:
        bus_type = "CAN-FD" if plan.timing.fd else "classic CAN"
        rate = protocol.default_rate(len(joints), plan.timing)
        yield stop(
            f"frames at {settings.rate:g} Hz load {bus_type} to {100 * load:.0f} %, limit "
            f"{100 * limit:.0f} %; use {option_name('rate', f'{rate:g}')}"
        )
    yield from map(
        stop,
        motion.limit_excesses(trajectory, settings.speed, "your", plan.user_limits),
    )


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
                f"{joint.label} does not answer; check power, wiring, its id, bit rate, "
                f"{option_name('fd')}"
            )
            continue
        yield from _condition_checks(motor, plan, joint)
        if set(protocol.SCALING) <= set(motor.registers):
            limits.append(motor.limits)
    if len(limits) == len(joints):
        yield from _readiness_checks(plan, inspection, limits)

    # Motors outside the trajectory are left limp.
    driven = {joint.can_id for joint in joints}
    others = [motor for can_id, motor in motors.items() if can_id not in driven]
    if others:
        yield note(
            f"not in the trajectory and left limp: {', '.join(motor.name for motor in others)}"
        )
    for motor in others:
        if motor.feedback is None or motor.feedback.status[0] == protocol.ENABLED:
            yield stop(
                f"{motor.name} is not in the trajectory, and is enabled by another program or does "
                "not tell: end that program and power-cycle the motor, or take it off the bus"
            )


def _condition_checks(
    motor: InspectedMotor, plan: Plan, joint: DamiaoJoint
) -> Iterator[Remark]:
    """Yield the checks of one motor's registers and state.

    PMAX, VMAX, TMAX other than those of the motor type stop the run, or are noted where the user
    permits the limits in the registers.

    Args:
        motor: answers of the motor.
        plan: the plan of the run.
        joint: joint that the motor drives, with which ids and scaling are compared.
    """
    name = joint.label
    registers = motor.registers
    if len(motor.reply_ids) > 1:
        yield stop(f"{len(motor.reply_ids)} motors answer to the id of {name}")
    missing = set(protocol.Register) - set(registers)
    if missing:
        names = ", ".join(number.name for number in sorted(missing))
        yield stop(f"{name} does not answer for {names}; try again")
        return
    stored_id = motor.master_id
    if {stored_id, *motor.reply_ids} != {joint.master_id}:
        answers = ", ".join(
            f"{reply_id:#x}" for reply_id in sorted(set(motor.reply_ids))
        )
        yield stop(
            f"{name} answers on {answers} (MST_ID {stored_id:#x}) but the trajectory expects "
            f"{joint.master_id:#x}; set it with motors setup --new-master-id, or export again with "
            f"the right {option_name('master_id')}"
        )

    limits = motor.limits
    nominal_limits = joint.spec.limits
    if not limits_agree(nominal_limits, limits):
        stored = ", ".join(f"{limit:g}" for limit in limits)
        nominal = ", ".join(f"{limit:g}" for limit in nominal_limits)
        difference = f"{name} has PMAX, VMAX, TMAX {stored} but a {joint.motor_type} has {nominal}"
        if plan.permissions.register_limits and min(limits) > 0.0:
            yield note(f"{difference}: the motor's own values are used")
        else:
            yield stop(
                f"{difference}; if the motor is right, give "
                f"{option_name('accept_register_limits')}"
            )

    mode = int(registers[protocol.Register.CTRL_MODE])
    if mode != protocol.MIT_MODE:
        yield stop(
            f"{name} is in mode {mode} ({protocol.MODES.get(mode, 'unknown')}); set CTRL_MODE to 1 "
            "(MIT)"
        )
    watchdog = registers[protocol.Register.TIMEOUT] * protocol.TIMEOUT_UNIT
    yield from _watchdog_checks(name, watchdog, plan.settings)
    yield from _state_checks(name, motor.feedback, plan.settings)


def _watchdog_checks(
    name: str, timeout: float, settings: PlaySettings
) -> Iterator[Remark]:
    """Yield a finding where a watchdog's timeout [s] is too long, or ends between two cycles.

    ``name`` is the motor's name in the message.
    """
    # A motor whose answer is missing gets its next command ``PAUSE`` + 1 cycles after the last one.
    # The watchdog has to outlast two such waits in succession.
    least = 2 * (PAUSE + 1) * settings.period
    # A longer one is no protection at all (a judgement).
    longest = 5.0
    # The timeout to propose, in tenths of a second.
    proposed = max(0.1, np.ceil(10.0 * least) / 10.0)
    remedy = f"set it with motors setup --watchdog {proposed:g} --store"
    watchdog = f"{name}'s watchdog of {1e3 * timeout:g} ms"
    if not least <= timeout <= longest:
        yield stop(
            f"{watchdog} is not from {1e3 * least:g} to {1e3 * longest:g} ms (0 is none: the "
            f"arm would go on if this program died); {remedy}"
        )
    # Until then an arm that nobody commands falls or runs far.
    elif timeout > 0.5:
        yield note(f"{watchdog} is long; {remedy}")


def _state_checks(
    name: str, feedback: protocol.Feedback | None, settings: PlaySettings
) -> Iterator[Remark]:
    """Yield a stop where a motor's state or temperature forbids to enable it.

    ``name`` is the motor's name in messages.
    """
    if feedback is None:
        yield stop(f"{name} does not tell its state; its firmware may be too old")
        return
    code = feedback.status[0]
    if code == protocol.ENABLED:
        yield stop(f"{name} is enabled already; end the program that uses it")
    elif code != protocol.DISABLED:
        yield stop(
            f"{name} reports {protocol.status_text(code)}; find the cause, then clear it or "
            "power-cycle"
        )
    temperature = feedback.temperature[0]
    # A judgement: half way from a warm room to the limit, so that no motor reaches it in the run.
    limit = min(60.0, settings.max_temperature)
    if temperature > limit:
        yield stop(
            f"{name} is at {temperature} deg C, above {limit:g}; let it cool down"
        )


def _readiness_checks(
    plan: Plan, inspection: Inspection, limits: Sequence[tuple[float, ...]]
) -> Iterator[Remark]:
    """Yield the checks for which the scaling of all joints' motors has to be known.

    There is a stop for each quantity of a joint beyond the range of its motor's frames, where not
    all motors' answers come while the player waits for them, and for each joint that is far from
    the first point.

    Args:
        plan: the plan of the run.
        inspection: answers of the motors.
        limits: PMAX, VMAX and TMAX of each joint's motor [rad, rad/s, N m].
    """
    trajectory = plan.trajectory
    joints = trajectory.joints
    settings = plan.settings
    # Others are those of no motor, and stop the run already.
    if np.min(limits) > 0.0:
        frames = Mounting.of(joints).frame_limits(np.array(limits))
        for excess in motion.limit_excesses(
            trajectory, settings.speed, "its registers'", frames
        ):
            yield stop(f"{excess}; export a smaller trajectory")

    # Time from the commands to the last answer [s].
    round_trip = inspection.round_trip
    if round_trip is not None and round_trip > REPLY_SHARE * settings.period:
        rate = protocol.handy_rate(REPLY_SHARE / round_trip)
        yield stop(
            f"all motors have answered after {1e3 * round_trip:.1f} ms, too late for "
            f"{settings.rate:g} Hz: commands and samples would be mixed up; use "
            f"{option_name('rate', f'{rate:g}')} or a faster adapter"
        )

    tolerance = settings.start_tolerance
    positions = joint_positions(joints, inspection)
    for joint, position, first in zip(joints, positions, trajectory.q[0]):
        # Written so that a NaN stops.
        if not abs(position - first) <= tolerance:
            yield stop(
                f"{joint.label} is at {position:.3f} rad but the trajectory starts at {first:.3f}, "
                f"more than {tolerance:g} away; move it by hand (a whole turn: it lost its turn "
                "count)"
            )


def direction_checks(plan: Plan, holding: HoldingCheck) -> Iterator[Remark]:
    """Yield a finding where a joint's direction is not known, by its load or a verification.

    ``holding`` computes the torques that hold the arm. Where it has no model, or if the user
    permits them, unknown directions are only noted; otherwise they stop the run.
    """
    joints = holding.unverified_joints(plan.trajectory.q[0])
    if not joints:
        return
    finding = (
        f"nobody has verified which way {', '.join(joint.label for joint in joints)} turn, and "
        "where the trajectory begins gravity hardly loads them"
    )
    if plan.permissions.directions or not holding.is_model:
        yield note(f"{finding}: mirrored or swapped, they would be played like that")
    else:
        yield stop(
            f"{finding}; move them by hand once with motors map, and give the "
            f"{option_name('joint_map')}; {option_name('accept_directions')} plays without"
        )
