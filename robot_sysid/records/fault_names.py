"""The names of faults of logs and models, as findings have them and ``--accept`` takes them."""

from __future__ import annotations

from enum import Enum


class FaultName(str, Enum):
    """A kind of fault, and what it is in words.

    It is a text as well, so that a user's word is found among the members and a finding is written
    to JSON with its name. The program itself compares members, never texts.

    Attributes:
        words: what a check of this name looks for.
    """

    words: str

    def __new__(cls, name: str, words: str) -> FaultName:
        """Return the member of a name, with its words."""
        member = str.__new__(cls, name)
        member._value_ = name
        member.words = words
        return member

    def __str__(self) -> str:
        """Return the name."""
        return self.value

    TORQUE_SCALE = (
        "torque-scale",
        "torque in another unit, on the motor's side of the gear, or scaled",
    )
    TORQUE_UNIT = (
        "torque-unit",
        "torque that is not in N·m, each joint's by another factor",
    )
    GRAVITY = "gravity", "torque without gravity, or external torque only"
    COMPUTED = "computed", "torque that was computed, not measured"
    UNSIGNED = "unsigned", "torque without a sign, as the size of a current"
    SIGN = "sign", "sign of a position or torque"
    ORDER = "order", "columns of joints exchanged"
    ANGLE_UNIT = "angle-unit", "degrees for radians or the other way round"
    ZERO = "zero", "zero of a joint's position"
    MODEL = "model", "model of another arm, or with another tool"
    TILT = "tilt", "base tilted against the model's"
    CLOCK = (
        "clock",
        "clock that jumps or drifts, a wrong time base, or samples lost or repeated",
    )
    DELAY = "delay", "torque delayed against position"
    SATURATED = "saturated", "torque sensor at its end"
    HELD = "held", "torque that stands still while the arm moves"
    CONTACT = "contact", "contact, a collision or a moving gripper"
    FORCE = "force", "constant force, a spring, a hose, or a hand that carries a part"
    PAYLOAD_STEP = "payload-step", "payload that changes within the log"
    COUPLING = "coupling", "one motor that turns with two joints"
    CROSSTALK = "crosstalk", "torque that holds a part of its neighbour's"
    FRICTION = (
        "friction",
        "friction that changes as gears warm up, or grows with the load",
    )
    UNEXPLAINED = "unexplained", "torque that nothing explains"
    TOO_LITTLE = "too-little", "too few independent samples"
    ROLLOUT = (
        "rollout",
        "new model that does not move more like the arm than the old one",
    )
