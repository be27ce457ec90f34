"""What may go wrong with a motor or an arm: how far joints may get, and what has to be said.

benchmarks/motor_faults.md shows the table that ``benchmarks/motor_faults.py`` makes of it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from rigs.damaged_links import Damage
from rigs.fault_bench import MOTOR_TYPES, BenchRun, Case, SetUp, loaded_joint
from rigs.motor_causes import (
    DamagedFrame,
    FailedMotor,
    FrozenEncoder,
    SaggingSupply,
    SecondMaster,
    SecondMotor,
    grip_mass,
    lost_motor,
    push,
    setting,
)
from robot_sysid.damiao.protocol import DISABLED

FAULT_BOUND = 0.15
JAMMED = 1e5
"""Damping of a joint that is jammed [N m s/rad]."""
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
        joint = getattr(self.cause, "joint", None)
        return Case(self.name, SetUp(), self.cause, joint=joint, **self.options)


AT_START = {"phase": "", "after": 0.0}
OTHERS = "others_departure"
SECOND = "a second motor has its id"
FOREIGN = "gets commands of another program"
UNSEEN = "another program commands it"
MOVED = "its zero has moved"
DIFFERS = "are commanded: it is weak, its supply sags"
UNANSWERED = "did not answer in time"
shoulder = partial(setting, SHOULDER)
wrist = partial(setting, WRIST)
LINES = (
    Line("motor makes half its torque", shoulder(torque_share=0.5), "suddenly needs"),
    Line("motor makes 0.6 of its torque, at kp 500", shoulder(torque_share=0.6), ""),
    Line(
        "motor makes half and says so", shoulder(torque_share=0.5, share_is_reported=True), DIFFERS
    ),
    Line("motor lost", lost_motor(SHOULDER), UNANSWERED, quantity=OTHERS),
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
    Line("gear slips 0.3 rad/s", shoulder(slip_rate=0.3), "its gear slips", bound=0.4),
    Line(
        "gear slips, velocity is the joint's", shoulder(slip_rate=0.3, slip_is_felt=False),
        "its gear or its encoder slips", bound=0.3,
    ),
    Line("gear of an unloaded wrist slips", wrist(slip_rate=0.3), "its gear slips", bound=0.9),
    Line("stale answers", shoulder(is_stale=True), "its answers are stale"),
    Line(
        "velocity reversed", shoulder(velocity_factor=-1.0),
        "off its speed",
    ),
    Line("torque reversed", shoulder(torque_factor=-1.0), DIFFERS),
    Line("supply sags", SaggingSupply(SHOULDER), "reports status 9", quantity=OTHERS),
    Line("3 kg gripped", grip_mass, "suddenly needs"),
    Line("push of 60 N", push, "suddenly needs"),
    Line(
        "joint jammed, shoulder", shoulder(jam_damping=JAMMED),
        "motor 2 (joint joint1) stands still",
    ),
    Line("joint jammed, wrist", wrist(jam_damping=JAMMED), "or it is blocked"),
    Line("answers lost", shoulder(lost_replies=True), UNANSWERED),
    Line("zero 0.3 rad off", shoulder(encoder_error=0.3), MOVED, 0.35, options=AT_START),
    Line("zero -0.3 rad off", shoulder(encoder_error=-0.3), MOVED, 0.35, options=AT_START),
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
            ("weak motor, half", setting(joint, torque_share=0.5)),
            ("weak motor, 0.6", setting(joint, torque_share=0.6)),
            ("motor lost", lost_motor(joint)),
        ):
            cases.append(Case(name, setup, cause, after=1.0, joint=joint))
    return cases
