"""How every link is estimated."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from robot_sysid.dynamics.friction import friction_model
from robot_sysid.errors import InputError
from robot_sysid.records.options import (
    OptionRecord,
    PerJoint,
    given_options,
    levels,
    not_negative,
    option,
    positive,
)


@dataclass(frozen=True)
class ArmOptions(OptionRecord):
    """How the links, the friction and the motors of a whole arm are estimated."""

    model_weight: float | None = option(
        None,
        "how strongly links are held near the model, from 0.001 (hardly) to 1000",
        metavar="W",
        check=positive,
        usual="from held-out torques",
    )
    coupling: Path | None = option(
        None,
        "JSON file of motors that turn with several joints",
        metavar="FILE",
        usual="found where it shows",
    )
    friction: str | None = option(
        None,
        "friction terms of every joint, such as coulomb-viscous-offset-armature",
        flag="--friction-model",
        metavar="TERMS",
        usual="from held-out torques",
    )
    cutoff: float | None = option(
        None,
        "cut-off of the low-pass that all signals go through",
        unit="Hz",
        metavar="HZ",
        check=positive,
        usual="from the data",
    )
    velocity_deadband: PerJoint | None = option(
        None,
        "leave out rows with moments in which a joint is slower than this, one number or one per "
        "joint",
        unit="rad/s",
        metavar="V",
        parse=levels,
        check=not_negative,
        usual="0.5 % of its peak speed",
    )
    zero_uncertainty: float = option(
        2.0,
        "how far each joint's zero position may be off; 0 takes the zeros as exact",
        unit="mrad",
        metavar="P",
        check=not_negative,
    )
    gravity_uncertainty: float = option(
        0.3,
        "how far the base may be tilted against gravity; 0 takes it as level",
        unit="deg",
        metavar="P",
        check=not_negative,
    )

    write_offset: bool = option(
        False,
        "also write the offset of each joint's friction (unequal in the two directions), as a soft "
        "spring that is tensioned far away",
    )
    torque_from: str | None = option(
        None,
        "no torque was measured: find servos, friction and rotor inertia from commanded and "
        "measured positions",
        choices=("position-error",),
        usual="measured torques",
    )
    write_delay: bool = option(
        False,
        "with --torque-from, also write the delay of the commands into the model's position "
        "actuators",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.friction is not None:
            friction_model(self.friction)
        if self.write_delay and self.torque_from is None:
            raise InputError(
                "--write-delay is about servos found from commands; add --torque-from "
                "position-error"
            )
        about_servos = ("torque_from", "write_delay")
        others = [each.flag for each in given_options(self) if each.key not in about_servos]
        if self.torque_from is not None and others:
            raise InputError(
                f"{others[0]} is about measured torques; leave it off with --torque-from "
                f"{self.torque_from}"
            )
