"""The checks that a plan has to pass before an arm may move, but for those of its model's bodies.

Each is a finding that stops the run, or that the user should know.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from robot_sysid.damiao import protocol
from robot_sysid.damiao.bus import InspectedMotor, Inspection
from robot_sysid.damiao.checks.findings import note, stop
from robot_sysid.damiao.checks.motion import motion_checks
from robot_sysid.damiao.joints import (
    DamiaoJoint,
    Mounting,
    id_problems,
    limits_agree,
    no_load_speeds,
    peak_torques,
)
from robot_sysid.damiao.safety.holding import HoldingTorque
from robot_sysid.damiao.session import REPLY_SHARE
from robot_sysid.damiao.settings import (
    LEAST_STIFFNESS,
    OVERSHOOT,
    Plan,
    joint_positions,
    usual_stiffness,
)
from robot_sysid.damiao.trajectory import ROUNDING, DamiaoTrajectory
from robot_sysid.damiao.weight_file import weight_path
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import LIMITED, Limits
from robot_sysid.records.messages import Level, Remark
from robot_sysid.records.usual_errors import WEIGHT
from robot_sysid.wording import option_name

SMALLER = "export a smaller trajectory for this arm, or bring it elsewhere by hand"
"""Remedy for a trajectory that leaves an arm's limits, or touches something."""

REST_SPEED = 0.05
"""Speed below which a trajectory counts as at rest at its ends [rad/s]: a quarter of the approach
speed, so that the hold before and after it makes no step that a motor feels."""
WARMEST_START = 60.0
"""Temperature above which a motor does not start a run [degC]: half way from a warm room to the
limit during one, so that no motor reaches that in the run (a judgement)."""
LEAST_WATCHDOG_CYCLES = 10.0
"""Least timeout of a watchdog in control cycles: a motor that answers nothing is found after six,
and has to be driven while the others come to rest."""
LONGEST_WATCHDOG = 5.0
"""Timeout above which a watchdog is no protection at all [s] (a judgement)."""
LONG_WATCHDOG = 0.5
"""Timeout above which a watchdog is noted as long [s]: within it an arm that nobody commands falls
or runs far."""
NOTED_LOSS = 0.005
"""Share of commands without an answer from which on it is said (a judgement): a sound bus, which
repeats damaged frames by itself, loses none."""
LOOK_AT_BUS = (
    "a sound bus loses none: look at plugs, termination, supply and the adapter"
)
"""What to do about commands without an answer."""
MOST_LOST = 0.1
"""Share of requests without an answer from which on nothing is played: five commands in a row are
then lost by chance within a minute of seven motors at 250 Hz, and stop the run."""
USUAL_WATCHDOG = 0.1
"""Least timeout that is proposed [s]: the one that docs/motors.md recommends."""


def stops(checks: Sequence[Remark]) -> list[str]:
    """Return the texts of the checks that forbid to play."""
    return [check.text for check in checks if check.level is Level.REFUSES]


def require_playable(checks: Sequence[Remark]) -> None:
    """Raise HardwareAbort with the first check's text that forbids to play.

    Where no check forbids to play, nothing happens.
    """
    for text in stops(checks):
        raise HardwareAbort(f"not played: {text}")


class StatedLimits(NamedTuple):
    """Limits of the n joints of a run.

    Attributes:
        limits: of the joints.
        owner: what states them, in words, such as "the model's limit".
        remedy: what to do where a motion exceeds one, or what then happens.
        level: whether that forbids the run.
    """

    limits: Limits
    owner: str
    remedy: str
    level: Level = Level.REFUSES


def motor_ratings(joints: Sequence[DamiaoJoint]) -> tuple[StatedLimits, StatedLimits]:
    """Return what the motors of n joints can do at most, and what they can do for long."""
    most = Limits(velocity=no_load_speeds(joints), torque=peak_torques(joints))
    rated = Limits(torque=np.array([joint.spec.rated_torque for joint in joints]))
    smaller = "it cannot follow: plan a smaller or slower motion"
    heat = "it gets too hot if that lasts"
    return (
        StatedLimits(most, "what its motor can do", smaller),
        StatedLimits(rated, "what its motor can do for long", heat, Level.SAYS),
    )


def limit_checks(
    trajectory: DamiaoTrajectory, speed: float, stated: Iterable[StatedLimits]
) -> Iterator[Remark]:
    """Yield a finding for each joint and each limit that a trajectory exceeds.

    The slope of the positions from row to row counts as a velocity too, and the torque is the
    larger one of the file's and of that which is fed at this speed. What the rounding of the file's
    numbers may make is left to each quantity.

    Args:
        trajectory: with n joints.
        speed: factor of the file's speed at which it is played.
        stated: the limits.
    """
    step = np.diff(trajectory.time)[:, None]
    velocity = np.abs(trajectory.qd)
    slopes = np.abs(trajectory.slopes) - 2.0 * ROUNDING / step
    velocity[:-1] = np.maximum(velocity[:-1], slopes)
    acceleration = speed**2 * trajectory.qdd
    fed = trajectory.at_speed(speed).tau
    torque = np.where(np.abs(fed) > np.abs(trajectory.tau), fed, trajectory.tau)
    signals = trajectory.q, speed * velocity, acceleration, torque
    # A velocity is rounded at both ends of a step.
    rounding = ROUNDING * np.array([1.0, 1.0, 2.0 / step.min(), 1.0])
    labels = [joint.label for joint in trajectory.joints]
    tolerance = np.append(np.repeat(rounding, len(labels)), 0.0)
    for limits, owner, remedy, level in stated:
        chunk = trajectory.time / speed, limits.signals(*signals)
        uses = limits.uses([chunk], labels, tolerance)
        for use in uses:
            if not use.is_kept:
                yield Remark(
                    level,
                    "",
                    f"{use.owner}: {use.quantity} {use.middle + use.value:.4g} "
                    f"{LIMITED[use.quantity]} is beyond {owner}, {use.middle + use.limit:g}, at "
                    f"{use.time:.2f} s; {remedy}",
                )


def plan_checks(plan: Plan) -> Iterator[Remark]:
    """Yield the checks of a plan that need no bus.

    They compare ids, speed at the ends, the signals of the file with one another, bus load, and the
    motion with the limits of the motors, the model's joints and the user.
    """
    trajectory = plan.trajectory
    joints = trajectory.joints
    settings = plan.settings
    yield from map(stop, id_problems([(j.can_id, j.master_id) for j in joints]))

    end_speed = np.max(np.abs(trajectory.qd[[0, -1]])) * settings.speed
    if end_speed > REST_SPEED:
        yield stop(
            f"the trajectory starts or ends at {end_speed:.2f} rad/s; it has to start and end at "
            "rest"
        )
    yield from motion_checks(trajectory)
    timing = plan.timing
    limit = protocol.PLANNING_LIMIT
    load = protocol.bus_load(len(joints), 1.0 / settings.period, timing)
    if load > limit:
        rate = protocol.default_rate(len(joints), timing)
        yield stop(
            f"frames at {settings.rate:g} Hz load {'CAN-FD' if timing.fd else 'classic CAN'} to "
            f"{100 * load:.0f} %, limit {100 * limit:.0f} %; use {option_name('rate', f'{rate:g}')}"
        )

    stated = [*motor_ratings(joints)]
    for limits, owner, remedy in (
        (plan.user_limits, "your limit", "plan a motion within it"),
        (plan.model_limits, "the model's limit", plan.remedy or SMALLER),
    ):
        if limits is not None:
            stated.insert(0, StatedLimits(limits, owner, remedy))
    yield from limit_checks(trajectory, settings.speed, stated)
    yield from stiffness_checks(plan)
    yield from weight_checks(trajectory, settings.speed)


def stiffness_checks(plan: Plan) -> Iterator[Remark]:
    """Yield a note where an arm may swing farther than a joint may leave its path.

    So it does where its weight is off by what models usually are, and its stiffness is low. It is
    stopped then, although nothing is broken. With still less the arm topples like a pencil on its
    end: a stop is yielded where it does so even if its links are as much lighter as they usually
    are.
    """
    swing = OVERSHOOT * plan.usual_excess
    stiffness = np.array(plan.settings.kp)
    joints = plan.trajectory.joints
    slope = plan.trajectory.weight_slope
    if slope is None:
        # That of a link on a level joint is m g l cos(q), which changes by m g l in a radian; that
        # of an arm that stands upright is more.
        slope = np.max(np.abs(plan.trajectory.tau), axis=0)
        topples = np.zeros(len(joints), bool)
    else:
        topples = stiffness < (1.0 - WEIGHT) * slope
    # What a motor's frames can carry is the most there is to recommend.
    enough = swing / np.array(plan.settings.tracking) + slope
    enough = np.ceil(np.minimum(enough, protocol.KP_MAX))
    # Enough is what is not stopped; the arm sags by half of what it may swing.
    sag = plan.usual_excess / np.maximum(enough - slope, LEAST_STIFFNESS)
    usual = usual_stiffness([joint.spec for joint in joints])
    key = option_name("kp")
    remedies = [
        f"{key} of {kp:g} lets it sag by {angle:.2g} rad"
        for kp, angle in zip(enough, sag)
    ]
    for j in np.flatnonzero(usual > enough):
        remedies[j] += f", and without {key} it has {usual[j]:g}"
    for j in np.flatnonzero(topples):
        yield stop(
            f"{joints[j].label}: with a stiffness of {stiffness[j]:g} N·m/rad it topples: as it "
            f"sinks, its weight grows by {slope[j]:.0f} N·m per radian by the model; "
            f"{remedies[j]}"
        )
    is_low = (stiffness < enough) & (stiffness < protocol.KP_MAX) & ~topples
    for j in np.flatnonzero(is_low):
        yield note(
            f"{joints[j].label}: with a stiffness of {stiffness[j]:g} N·m/rad it may swing by more "
            f"than {plan.settings.tracking[j]:.2g} rad where the arm's weight is as far from the "
            "model's as it usually is, and is stopped then; "
            f"{remedies[j]}"
        )


def weight_checks(trajectory: DamiaoTrajectory, speed: float) -> Iterator[Remark]:
    """Yield notes where what carries the arm is not known at the speed of a run.

    At the file's own speed its torque is the right one without that.
    """
    foreign = trajectory.foreign_weight
    if foreign is not None:
        yield note(
            f"{foreign} is not used: it was written with another trajectory than "
            f"{trajectory.path.name}, or one of the two was changed; export again"
        )
    if trajectory.weight is None and speed < 1.0:
        yield note(
            f"what carries the arm is not known at this speed: the torque of the file, which is "
            f"that of full speed, is fed, and no load is judged; give {option_name('model')}, or "
            f"export again, which writes {weight_path(trajectory.path).name} beside the file"
        )


def bus_checks(plan: Plan, inspection: Inspection) -> Iterator[Remark]:
    """Yield the checks of a plan against the answers of the motors on the bus."""
    trajectory = plan.trajectory
    joints = trajectory.joints
    settings = plan.settings
    motors = inspection.motors
    if inspection.unsolicited:
        yield stop(
            f"{inspection.unsolicited} frames came without being asked for: another program is "
            "talking to these motors; end it first"
        )
    ids = [(can_id, motor.master_id) for can_id, motor in motors.items()]
    yield from map(stop, id_problems(ids))

    for joint in joints:
        if joint.can_id in motors:
            yield from motor_checks(motors[joint.can_id], plan, joint)
        else:
            yield stop(
                f"{joint.label} does not answer; check power, wiring, its id, bit rate, "
                f"{option_name('fd')}"
            )

    # Motors outside the trajectory are left limp.
    driven = [joint.can_id for joint in joints]
    others = [motor for can_id, motor in motors.items() if can_id not in driven]
    if others:
        names = ", ".join(motor.name for motor in others)
        yield note(f"not in the trajectory and left limp: {names}")
    for motor in others:
        if motor.feedback is None or motor.feedback.status[0] == protocol.ENABLED:
            yield stop(
                f"{motor.name} is not in the trajectory, and is enabled by another program or does "
                "not tell: end that program and power-cycle the motor, or take it off the bus"
            )

    yield from loss_checks([motors[i] for i in driven if i in motors])
    # Time from the commands to the last answer [s].
    round_trip = inspection.round_trip
    if round_trip > REPLY_SHARE * settings.period:
        fitting = protocol.default_rate(len(joints), plan.timing)
        rate = min(protocol.handy_rate(REPLY_SHARE / round_trip), fitting)
        yield stop(
            f"all motors have answered after {1e3 * round_trip:.1f} ms, too late for "
            f"{settings.rate:g} Hz: commands and samples would be mixed up; use "
            f"{option_name('rate', f'{rate:g}')} or a faster adapter"
        )
    # What is not known, or no motor has, stops the run already.
    unknown = np.full(3, np.inf)
    frames = np.array(
        [motors[i].limits if i in motors else unknown for i in driven], float
    )
    frames[~(frames > 0.0)] = np.inf
    limits = Mounting.of(joints).frame_limits(frames)
    remedy = plan.remedy or SMALLER
    stated = [StatedLimits(limits, "its registers' limit", remedy)]
    yield from limit_checks(trajectory, settings.speed, stated)
    positions = joint_positions(joints, inspection)
    tolerance = settings.start_tolerance
    for joint, position, first in zip(joints, positions, trajectory.q[0]):
        if abs(position - first) > tolerance:
            yield stop(
                f"{joint.label} is at {position:.3f} rad but the trajectory starts at {first:.3f}, "
                f"more than {tolerance:g} away; move it by hand (a whole turn: it lost its turn "
                "count)"
            )


def loss_checks(motors: Sequence[InspectedMotor]) -> Iterator[Remark]:
    """Yield a finding where some of the requests to motors were not answered."""
    seconds = np.array([time for motor in motors for time in motor.answer_times])
    if not seconds.size:
        return
    lost = np.isnan(seconds)
    share = float(np.mean(lost))
    text = f"{np.count_nonzero(lost)} of {lost.size} requests were not answered; {LOOK_AT_BUS}"
    if share > MOST_LOST:
        yield stop(f"{text}, then check again; with so many a run is stopped by chance")
    elif share >= NOTED_LOSS:
        yield note(text)


def motor_checks(
    motor: InspectedMotor, plan: Plan, joint: DamiaoJoint
) -> Iterator[Remark]:
    """Yield the checks of the registers and the state of the motor that drives a joint.

    PMAX, VMAX, TMAX other than those of the motor type stop the run, or are noted where the user
    accepts the limits in the registers.
    """
    settings = plan.settings
    name = joint.label
    setup = f"motors setup --motor {joint.can_id}"
    registers = motor.registers
    if len(motor.reply_ids) > 1:
        yield stop(f"{len(motor.reply_ids)} motors answer to the id of {name}")
    missing = {number for number in protocol.Register if number not in registers}
    if missing:
        names = ", ".join(number.name for number in sorted(missing))
        yield stop(f"{name} does not answer for {names}; try again")
        return
    ids = {motor.master_id, *motor.reply_ids}
    if ids != {joint.master_id}:
        yield stop(
            f"{name} answers on {', '.join(map(hex, sorted(ids)))} but the trajectory expects "
            f"{joint.master_id:#x}; set it with {setup} --new-master-id {joint.master_id:#x} "
            f"--store, or state the right one in a {option_name('joint_map')}"
        )

    nominal = joint.spec.limits
    if not limits_agree(nominal, motor.limits):
        values = [", ".join(map("{:g}".format, row)) for row in (motor.limits, nominal)]
        difference = (
            f"{name} has PMAX, VMAX, TMAX {values[0]} but a {joint.motor_type} has "
            f"{values[1]}"
        )
        is_usable = all(0.0 < limit < np.inf for limit in motor.limits)
        if settings.accept_register_limits and is_usable:
            yield note(f"{difference}: the motor's own values are used")
        else:
            yield stop(
                f"{difference}; if the motor is right, give "
                f"{option_name('accept_register_limits')}"
            )
    mode = int(registers[protocol.Register.CTRL_MODE])
    if mode != protocol.MIT_MODE:
        yield stop(
            f"{name} is in mode {mode} ({protocol.MODES.get(mode, 'unknown')}); set it to MIT with "
            f"{setup} --mit --store"
        )
    timeout = registers[protocol.Register.TIMEOUT] * protocol.TIMEOUT_UNIT
    yield from watchdog_checks(joint, timeout, settings.period)

    feedback = motor.feedback
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
    limit = min(WARMEST_START, settings.max_temperature)
    if temperature > limit:
        yield stop(
            f"{name} is at {temperature} deg C, above {limit:g}; let it cool down"
        )


def watchdog_checks(
    joint: DamiaoJoint, timeout: float, period: float
) -> Iterator[Remark]:
    """Yield a finding where a watchdog's timeout [s] is too long, or ends between two cycles.

    Args:
        joint: that the watchdog's motor drives.
        timeout: of the watchdog [s].
        period: length of a control cycle [s].
    """
    least = LEAST_WATCHDOG_CYCLES * period
    # In tenths of a second.
    proposed = max(USUAL_WATCHDOG, np.ceil(10.0 * least) / 10.0)
    remedy = f"set it with motors setup --motor {joint.can_id} --watchdog {proposed:g} --store"
    watchdog = f"{joint.label}'s watchdog of {1e3 * timeout:g} ms"
    if not least <= timeout <= LONGEST_WATCHDOG:
        yield stop(
            f"{watchdog} is not from {1e3 * least:g} to {1e3 * LONGEST_WATCHDOG:g} ms (0 is none: "
            f"the arm would go on if this program died); {remedy}"
        )
    elif timeout > LONG_WATCHDOG:
        yield note(f"{watchdog} is long; {remedy}")


def direction_checks(plan: Plan, holding: HoldingTorque) -> Iterator[Remark]:
    """Yield a finding where a joint's direction is not known, by its load or a verification.

    ``holding`` computes the torques that hold the arm. Where it has no model, or if the user
    accepts them, unknown directions are only noted; otherwise they stop the run.
    """
    joints = holding.unverified_joints(plan.trajectory.q[0])
    if not joints:
        return
    finding = (
        f"nobody has verified which way {', '.join(joint.label for joint in joints)} turn, and "
        "where the trajectory begins gravity hardly loads them"
    )
    if plan.settings.accept_directions or not holding.is_model:
        yield note(f"{finding}: mirrored or swapped, they would be played like that")
    else:
        yield stop(
            f"{finding}; move them by hand once with motors map, and give the "
            f"{option_name('joint_map')}; {option_name('accept_directions')} plays without"
        )
