"""What may go wrong with a motor or an arm: how far joints may get, and what has to be said.

benchmarks/motor_faults.md shows the table that ``benchmarks/motor_faults.py`` makes of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from rigs.fault_bench import BenchRun, Case, SetUp
from rigs.motor_causes import (
    FailedMotor,
    FrozenEncoder,
    GrippedMass,
    JammedJoint,
    LostMotor,
    MotorSetting,
    MovedZero,
    Push,
    SaggingSupply,
    SecondMaster,
    SecondMotor,
    SlippingGear,
    WeakMotor,
    joint_of,
)
from robot_sysid.damiao.protocol import DISABLED

FAULT_BOUND = 0.15
SHOULDER = 1
WRIST = 5


@dataclass(frozen=True)
class Line:
    """A fault, the greatest departure that it may cause [rad], and words of what is said.

    ``options`` are those of ``Case``; ``quantity`` is the one of ``Outcome`` that is bounded: where
    a motor does not drive any more, that of the other joints.
    """

    name: str
    cause: Callable[[BenchRun], None]
    words: str
    bound: float = FAULT_BOUND
    quantity: str = "departure"
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def case(self):
        options = {"phase": "playing", "after": 1.5, "joint": joint_of(self.cause)}
        return Case(self.name, SetUp(), self.cause, **{**options, **self.options})


AT_START = {"phase": "", "after": 0.0}
OTHERS = "others_departure"
SECOND = "a second motor has its id"
FOREIGN = "gets commands of another program"
UNSEEN = "another program commands it"
MOVED = "its zero has moved"
DIFFERS = "are commanded: it is weak, its supply sags"
UNANSWERED = "did not answer in time"
LINES = (
    Line("motor makes half its torque", WeakMotor(SHOULDER, 0.5), "suddenly needs"),
    Line("motor makes 0.6 of its torque, at kp 500", WeakMotor(SHOULDER, 0.6), ""),
    Line("motor makes half and says so", WeakMotor(SHOULDER, 0.5, True), DIFFERS),
    Line("motor lost", LostMotor(SHOULDER), UNANSWERED, quantity=OTHERS),
    Line("motor reports a fault", FailedMotor(SHOULDER), "reports status A", quantity=OTHERS),
    Line("second motor of the same id, wrist", SecondMotor(WRIST, 0.7), SECOND),
    Line("second motor of the same id, shoulder", SecondMotor(SHOULDER, 0.7), SECOND),
    Line("second motor that answers last", SecondMotor(WRIST, 0.7, is_first=False), SECOND),
    Line("second motor that is disabled", SecondMotor(WRIST, 0.7, DISABLED), SECOND),
    Line("second master, wrist", SecondMaster(WRIST, 0.5, True), FOREIGN),
    Line("second master, not seen", SecondMaster(WRIST, 0.5, False), UNSEEN),
    Line("second master, shoulder", SecondMaster(SHOULDER, 0.5, True), FOREIGN),
    Line("encoder frozen, shoulder", FrozenEncoder(SHOULDER), "its encoder is frozen"),
    Line("encoder frozen, wrist", FrozenEncoder(WRIST), "its encoder is frozen"),
    Line("reported position frozen", FrozenEncoder(SHOULDER, False), "its answers are stale"),
    Line("gear slips 0.3 rad/s", SlippingGear(SHOULDER), "its gear slips", bound=0.4),
    Line(
        "gear slips, velocity is the joint's", SlippingGear(SHOULDER, is_felt=False),
        "its gear or its encoder slips", bound=0.3,
    ),
    Line("gear of an unloaded wrist slips", SlippingGear(WRIST), "its gear slips", bound=0.9),
    Line("stale answers", MotorSetting(SHOULDER, "is_stale", True), "its answers are stale"),
    Line(
        "velocity reversed", MotorSetting(SHOULDER, "velocity_factor", -1.0),
        "off its speed",
    ),
    Line("torque reversed", MotorSetting(SHOULDER, "torque_factor", -1.0), DIFFERS),
    Line("supply sags", SaggingSupply(SHOULDER), "reports status 9", quantity=OTHERS),
    Line("3 kg gripped", GrippedMass(), "suddenly needs"),
    Line("push of 60 N", Push(), "suddenly needs"),
    Line("joint jammed, shoulder", JammedJoint(SHOULDER), "motor 2 (joint joint1) stands still"),
    Line("joint jammed, wrist", JammedJoint(WRIST), "or it is blocked"),
    Line("answers lost", MotorSetting(SHOULDER, "lost_replies", True), UNANSWERED),
    Line("zero 0.3 rad off", MovedZero(SHOULDER, 0.3), MOVED, 0.35, options=AT_START),
    Line("zero -0.3 rad off", MovedZero(SHOULDER, -0.3), MOVED, 0.35, options=AT_START),
)  # fmt: skip
