"""What may go wrong with a motor or an arm: how far joints may get, and what has to be said.

benchmarks/motor_faults.md shows the table that ``benchmarks/motor_faults.py`` makes of it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rigs.damaged_links import Damage
from rigs.fault_bench import MOTOR_TYPES, BenchRun, Case, SetUp, loaded_joint
from rigs.motor_causes import (
    DamagedFrame,
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

DAMAGES = [
    *(("position", angle) for angle in (0.2, 0.78, 3.9)),
    *((name, bit) for name in ("velocity", "torque") for bit in (5, 8, 11)),
    *(("status", code) for code in (0x0, 0x9, 0xA, 0xD)),
    ("id nibble", "other"),
    ("id nibble", 0xF),
    ("arbitration id", "other"),
    ("arbitration id", 0x7A),
    ("text", "any"),
]
"""Fields of a feedback frame, and what happens to them; see ``Damage``."""
MOMENTS = {
    "enabling": (0.0, 0.0, 0.05),
    "raising": (0.0, 0.75, 0.15),
    "moving": (0.0, 1.45, 0.2),
    "playing": (0.0, 4.95, 0.4),
    "coming": (0.0, 0.45, 0.1),
    "lowering": (0.0, 2.0, 0.1),
}
"""Phases: the earliest and the latest onset after their beginning [s], and their share of runs."""
DAMAGE_BOUND = 0.05
"""Largest departure of a joint after a damaged frame [rad]."""


def damage_cases(runs, seed):
    """Return cases of one damaged frame each, spread over fields, sizes, phases and joints."""
    random = np.random.default_rng(seed)
    shares = [share for *_, share in MOMENTS.values()]
    cases = []
    for number in range(runs):
        name, size = DAMAGES[number % len(DAMAGES)]
        phase = str(random.choice(list(MOMENTS), p=shares))
        park = "rest" if phase == "lowering" or random.random() < 0.5 else None
        setup = SetUp(model_is_given=bool(random.random() < 0.5), park=park)
        joint = int(random.integers(len(MOTOR_TYPES)))
        cause = DamagedFrame(Damage(name, _size(name, size, joint, random), joint))
        begin, end, _ = MOMENTS[phase]
        onset = phase, random.uniform(begin, end), 1.0
        cases.append(Case(f"{name}, {size}", setup, cause, *onset, joint))
    return cases


def _size(name, size, joint, random):
    """Return the size of a damage of the feedback frame of a joint (from 0)."""
    n = len(MOTOR_TYPES)
    other = 1 + (joint + int(random.integers(1, n))) % n
    if name == "position":
        return float(size * random.choice([-1.0, 1.0]))
    if size == "other":
        return other + 0x10 * (name == "arbitration id")
    return int(random.integers(21 * 8)) if size == "any" else size


def hold_cases():
    """Return a case for each fault of a motor that holds the arm still, pose and stiffness."""
    cases = []
    for kp, pose in itertools.product((60.0, 180.0), range(5)):
        setup = SetUp("truth", kp=kp, pose=pose, stands=True, duration=2.5)
        joint = loaded_joint(setup)
        for name, cause in (
            ("weak motor, half", WeakMotor(joint, 0.5)),
            ("weak motor, 0.6", WeakMotor(joint, 0.6)),
            ("motor lost", LostMotor(joint)),
        ):
            cases.append(Case(name, setup, cause, after=1.0, joint=joint))
    return cases
