"""The table of names of faults of logs and models, as findings and ``--accept`` have them.

A name is a row: what a check of this name looks for, what of a log it needs, and what else it may
stand for. Where two faults are found, these columns say which may be the other's consequence.
"""

from __future__ import annotations

from enum import Enum, Flag, IntEnum, auto


class Needs(IntEnum):
    """What of a log has to be there for a fault to show, the least first.

    What needs less is wrong first, and what needs more may be its consequence.
    """

    SAMPLES = 0
    """Samples, which show it without a model."""
    TORQUE = 1
    """Torque that is one of this arm, in whatever unit."""
    COLUMNS = 2
    """Columns, each of which is compared with the others."""
    MODEL = 3
    """A model that is about right."""


class StandsFor(Flag):
    """What else may be wrong where a fault is found."""

    NOTHING = 0
    ALL = auto()
    """Whatever is found beside it: a torque that is none of the arm's shows no more."""
    GRAVITY = auto()
    """Gravity in another direction."""
    LINKS = auto()
    """Links that are off: a joint that moves alone says nothing of it, nor do bodies that stand for
    links of a model without masses."""
    SHAPE = auto()
    """At one joint, torque of any shape, which other terms of the joint take up."""
    MOMENT = auto()
    """What touched the arm for a moment: torque is left over all the time, or does not follow."""


class FaultName(str, Enum):
    """A kind of fault, and what it is in words.

    It is a text as well, so that a user's word is found among the members and a finding is written
    to JSON with its name. The program itself compares members and their columns, never texts.

    Attributes:
        words: what a check of this name looks for.
        needs: of a log.
        stands_for: what else.
    """

    words: str
    needs: Needs
    stands_for: StandsFor

    def __new__(
        cls,
        name: str,
        words: str,
        needs: Needs = Needs.MODEL,
        stands_for: StandsFor = StandsFor.NOTHING,
    ) -> FaultName:
        """Return the member of a name, with its words, what it needs and what it may stand for."""
        member = str.__new__(cls, name)
        member._value_ = name
        member.words = words
        member.needs = needs
        member.stands_for = stands_for
        return member

    def __str__(self) -> str:
        """Return the name."""
        return self.value

    TORQUE_SCALE = (
        "torque-scale",
        "torque in another unit, on the motor's side of the gear, or scaled",
        Needs.MODEL,
        StandsFor.LINKS,
    )
    TORQUE_UNIT = (
        "torque-unit",
        "torque that is not in N·m, each joint's by another factor",
        Needs.TORQUE,
        StandsFor.ALL,
    )
    GRAVITY = (
        "gravity",
        "torque without gravity, or external torque only",
        Needs.TORQUE,
        StandsFor.GRAVITY,
    )
    COMPUTED = (
        "computed",
        "torque that was computed, not measured",
        Needs.TORQUE,
        StandsFor.ALL,
    )
    UNSIGNED = (
        "unsigned",
        "torque without a sign, as the size of a current",
        Needs.SAMPLES,
    )
    SIGN = "sign", "sign of a position or torque", Needs.COLUMNS
    ORDER = "order", "columns of joints exchanged", Needs.COLUMNS
    ANGLE_UNIT = (
        "angle-unit",
        "degrees for radians or the other way round",
        Needs.COLUMNS,
    )
    ZERO = "zero", "zero of a joint's position", Needs.COLUMNS, StandsFor.LINKS
    MODEL = (
        "model",
        "model of another arm, or with another tool",
        Needs.MODEL,
        StandsFor.LINKS | StandsFor.MOMENT,
    )
    TILT = (
        "tilt",
        "base tilted against the model's",
        Needs.MODEL,
        StandsFor.GRAVITY | StandsFor.LINKS,
    )
    CLOCK = (
        "clock",
        "clock that jumps or drifts, a wrong time base, or samples lost or repeated",
        Needs.SAMPLES,
        StandsFor.LINKS,
    )
    DELAY = "delay", "torque delayed against position", Needs.COLUMNS
    SATURATED = (
        "saturated",
        "torque sensor at its end",
        Needs.SAMPLES,
        StandsFor.MOMENT,
    )
    HELD = (
        "held",
        "torque that stands still while the arm moves",
        Needs.SAMPLES,
        StandsFor.MOMENT,
    )
    CONTACT = (
        "contact",
        "contact, a collision or a moving gripper",
        Needs.MODEL,
        StandsFor.SHAPE,
    )
    FORCE = (
        "force",
        "constant force, a spring, a hose, or a hand that carries a part",
        Needs.MODEL,
        StandsFor.GRAVITY | StandsFor.LINKS | StandsFor.SHAPE,
    )
    PAYLOAD_STEP = (
        "payload-step",
        "payload that changes within the log",
        Needs.MODEL,
        StandsFor.GRAVITY,
    )
    COUPLING = "coupling", "one motor that turns with two joints"
    CROSSTALK = (
        "crosstalk",
        "torque that holds a part of its neighbour's",
        Needs.MODEL,
        StandsFor.SHAPE,
    )
    FRICTION = (
        "friction",
        "friction that changes as gears warm up, or grows with the load",
    )
    UNEXPLAINED = (
        "unexplained",
        "torque that nothing explains",
        Needs.MODEL,
        StandsFor.MOMENT,
    )
    TOO_LITTLE = "too-little", "too few independent samples", Needs.SAMPLES
    ROLLOUT = (
        "rollout",
        "new model that does not move more like the arm than the old one",
    )
