"""``robot-sysid motors map --zeros-at-stops``: zeros from the end stops of a limp arm's joints.

A person pushes each joint to its two stops. What its motor measures there is compared with the
model's range of the joint; a zero that the two contradict is never written.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

from robot_sysid.commands.motors.limp import LimpArm
from robot_sysid.commands.motors.session import Session, ask
from robot_sysid.commands.motors.stops import SPAN_TOLERANCE, Extremes, StopZero
from robot_sysid.damiao.joints import DamiaoJoint
from robot_sysid.errors import HardwareAbort, InputError
from robot_sysid.records import RobotModel
from robot_sysid.records.messages import aligned_lines

ATTEMPTS = 3
"""How often a person is asked to push a joint until its span agrees with the model's range."""
KEEP = "keep"
"""What a person types to leave a joint's zero as it was."""


@dataclass(frozen=True)
class RenewedZero:
    """The zero of a joint, before and after.

    Attributes:
        joint: the joint with its motor and its zero before.
        stops: what was measured at its stops; None where nothing was.
        offset: of the motor where the joint is at zero [rad]; None where it stays as it was.
    """

    joint: DamiaoJoint
    stops: StopZero | None
    offset: float | None


def zeros_at_stops(
    session: Session,
    arm: LimpArm,
    robot: RobotModel,
    joints: Sequence[DamiaoJoint],
    has_zeros: bool,
) -> list[DamiaoJoint]:
    """Return joints (n,) of a robot, base to terminal, with the zeros that a person shows.

    Args:
        session: run of the command, on whose console everything is printed.
        arm: the limp arm.
        robot: model of the arm.
        joints: its joints with their motors and directions.
        has_zeros: whether the joints have zeros already, so that one may be kept.

    Raises:
        InputError: something else than was asked for was typed.
        HardwareAbort: a motor does not answer, or a joint's span contradicts the model.
    """
    session.console.stage("the motors are off and the arm is limp: support it")
    has_range = robot.limits.has_range.tolist()
    zeros: dict[str, RenewedZero] = {}
    for j, joint in enumerate(joints):
        if has_range[j]:
            ends = robot.limits.lower[j], robot.limits.upper[j]
            zeros[joint.name] = _zero_of(session, arm, joint, ends, has_zeros)
    without = {j: joint for j, joint in enumerate(joints) if not has_range[j]}
    if without:
        for zero in _zeros_by_pose(session, arm, robot, without, has_zeros):
            zeros[zero.joint.name] = zero
    rows = [zeros[joint.name] for joint in joints]
    session.console.stage(*_table(rows, has_zeros))
    if ask("type yes to write these zeros into the joint map: ") != "yes":
        raise InputError("not confirmed; nothing was written")
    renewed = []
    for row in rows:
        offset = row.joint.offset if row.offset is None else row.offset
        renewed.append(replace(row.joint, offset=offset))
    return renewed


def _zero_of(
    session: Session,
    arm: LimpArm,
    joint: DamiaoJoint,
    ends: tuple[float, float],
    has_zero: bool,
) -> RenewedZero:
    """Have a person push a joint to its stops, and return its zero; see ``zeros_at_stops``.

    ``ends`` are the lower and the upper end of its range in the model.
    """
    motors = [*arm.motors]
    index = motors.index(joint.can_id)
    extremes = Extremes(len(motors))
    choice = f", or type {KEEP} to leave its zero as it is" if has_zero else ""
    prompt = (
        f"push joint {joint.name} slowly to one of its stops and hold it there for a second, then "
        f"the same at the other one; then press Enter{choice}: "
    )
    measured = None
    for _ in range(ATTEMPTS):
        answer = arm.follow_while(extremes, partial(ask, prompt))
        lowest = extremes.lowest[index]
        highest = extremes.highest[index]
        zero = StopZero(lowest, highest, *ends, joint.direction)
        measured = zero if zero.was_reached else measured
        if has_zero and answer == KEEP:
            return RenewedZero(joint, measured, None)
        if answer:
            raise InputError(
                f"{answer!r} is not what was asked for; nothing was written"
            )
        if zero.agrees:
            session.console.stage(f"{joint.label}: {_reached_text(zero)}; they agree")
            return RenewedZero(joint, zero, round(zero.offset, 4))
        spans = dict(zip(motors, extremes.spans))
        session.console.stage(_disagreement_text(joint, zero, spans))
        if zero.excess > 0.0:
            # What is too far does not come back: another joint was pushed, or an angle was wrong.
            extremes = Extremes(len(motors))
    raise HardwareAbort(
        f"the stops of {joint.label} and its range in the model do not agree within "
        f"{SPAN_TOLERANCE:g} rad; nothing was written"
    )


def _reached_text(zero: StopZero) -> str:
    """Return a clause: which angles a motor has reached, and the model's range."""
    reached = "it was not held at two angles"
    if zero.was_reached:
        reached = (
            f"it was held at {zero.lowest:.3f} and at {zero.highest:.3f} rad, "
            f"{zero.highest - zero.lowest:.3f} rad apart"
        )
    return f"{reached}; the model's range is {zero.upper - zero.lower:.3f} rad"


def _disagreement_text(
    joint: DamiaoJoint, zero: StopZero, spans: Mapping[int, float]
) -> str:
    """Return a sentence on a joint whose stops contradict its range in the model.

    ``spans`` are the angles by which the motors have moved [rad], by their CAN ids.
    """
    text = f"{joint.label}: {_reached_text(zero)}"
    farthest = max(spans, key=lambda can_id: spans[can_id])
    if farthest != joint.can_id and spans[farthest] > spans[joint.can_id]:
        return (
            f"{text}, but motor {farthest} has moved by {spans[farthest]:.3f} rad: another joint "
            "was pushed, or the joint has another motor"
        )
    scale = "its gear or encoder has another scale"
    if zero.excess > 0.0:
        return (
            f"{text}: the range in the model is narrower than the mechanical one, or {scale}, or "
            "the joint has another motor"
        )
    return (
        f"{text}: a stop was not reached or the joint was not held there, or the range in the "
        f"model is wider than the mechanical one, or {scale}"
    )


def _zeros_by_pose(
    session: Session,
    arm: LimpArm,
    robot: RobotModel,
    joints: Mapping[int, DamiaoJoint],
    has_zeros: bool,
) -> Iterator[RenewedZero]:
    """Yield the zeros of joints without stops, which a person puts into the model's own pose.

    ``joints`` are joints by their numbers, base first; see ``zeros_at_stops`` for the others.
    """
    pose = ", ".join(
        f"{joint.name} {robot.reference[j]:.3f}" for j, joint in joints.items()
    )
    names = ", ".join(joint.name for joint in joints.values())
    session.console.stage(
        f"without a range in the model, whose zero the model's own pose gives: {names}"
    )
    choice = f", or type {KEEP} to leave their zeros as they are" if has_zeros else ""
    answer = ask(
        f"put the arm into the model's own pose at least there ({pose} rad or m) and hold it; then "
        f"press Enter{choice}: "
    )
    keeps = has_zeros and answer == KEEP
    if answer and not keeps:
        raise InputError(f"{answer!r} is not what was asked for; nothing was written")
    positions = arm.positions()
    for j, joint in joints.items():
        offset = positions[joint.can_id] - joint.direction * robot.reference[j]
        yield RenewedZero(joint, None, None if keeps else round(offset, 4))


def _table(zeros: Sequence[RenewedZero], has_zeros: bool) -> list[str]:
    """Return the lines of a table of zeros, one row per joint below the headings."""
    rows = [["joint", "motor", "stops [rad]", "model [rad]", "differ by", "zero [rad]"]]
    for zero in zeros:
        cells = ["-", "-", "-"]
        found = "as before"
        if zero.offset is not None:
            found = f"{zero.offset:.4f}"
            if zero.stops is None:
                found += " by the pose"
            else:
                found += f" ± {zero.stops.doubt:.4f}"
        if zero.stops is not None:
            cells = [
                f"{zero.stops.lowest:.3f} to {zero.stops.highest:.3f}",
                f"{zero.stops.lower:.3f} to {zero.stops.upper:.3f}",
                f"{zero.stops.excess:+.3f}",
            ]
        if has_zeros:
            found = f"{zero.joint.offset:.4f} -> {found}"
        rows.append([zero.joint.name, str(zero.joint.can_id), *cells, found])
    return aligned_lines(rows)
