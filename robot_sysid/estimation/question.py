"""What to estimate from recordings: options, the question, and what the recordings decide."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robot_sysid.errors import InputError
from robot_sysid.records.option_fields import (
    OptionRecord,
    PerJoint,
    given_options,
    option,
)

if TYPE_CHECKING:
    from robot_sysid.dynamics.friction import Coupling, FrictionModel
    from robot_sysid.estimation.algebra.priors import LinkScales
    from robot_sysid.records import Array


TORQUE_CHOICES = ("chain", "terminal")
"""Torques in use: those of all joints that carry the link, or of the last joint only."""
DEFAULT_TERMINAL = "coulomb-viscous-offset"
"""Friction terms with one joint's torque alone, where rotor and link inertia are confounded."""
CHOSEN = "auto"
"""Friction model that is chosen from the data."""


def _uncertainty(default: float, help: str, unit: str = "%") -> Any:
    return option(default, help, "P >= 0", unit=unit)


@dataclass(frozen=True)
class EstimationOptions(OptionRecord):
    """How parameters are estimated from torques."""

    torques: str = option(
        "chain",
        "use the torques of all joints that carry the link, or of the last joint only",
        choices=TORQUE_CHOICES,
    )
    no_friction: bool = option(
        False, "leave friction out and identify the 10 inertial parameters only"
    )
    friction_model: str | None = option(
        None,
        "friction terms of every joint, such as coulomb-viscous-offset, or auto",
        "TERMS",
        default_text="auto: each joint's by held-out torques; of the last joint's torque alone "
        f"{DEFAULT_TERMINAL}",
    )
    cutoff: float | None = option(
        None,
        "cut-off of the low-pass that all signals go through",
        "HZ [Hz] > 0",
        default_text="from the data",
    )
    delay: str = option(
        "off",
        "estimate how much the torque lags behind the position",
        choices=("off", "auto"),
    )
    tilt: str = option(
        "off",
        "estimate how much the base is tilted against gravity",
        choices=("off", "auto"),
    )
    link_uncertainty: float = _uncertainty(
        5.0,
        "how well the model knows the other links: their mass, their centre of mass as part of "
        "their size, half of what their inertia is off by",
    )
    scale_uncertainty: PerJoint | None = option(
        None,
        "how far each joint's torque scale may be off, one number or one per joint",
        "P [%] >= 0",
        default_text="2; 3 of payloads; what a file of torque scales says of itself",
    )
    zero_uncertainty: float = _uncertainty(
        2.0, "how far each joint's zero position may be off", "mrad"
    )
    gravity_uncertainty: float = _uncertainty(
        0.3, "how far the base may be tilted against gravity", "deg"
    )
    delay_uncertainty: float = _uncertainty(
        5.0, "how late or early the torque may be beside the position", "ms"
    )
    friction_uncertainty: float = _uncertainty(
        2.0,
        "how much friction may grow with the torque of the gear where the friction model has no "
        "term for it; it may also be curved by five times that part of its Coulomb friction",
    )
    coupling: Path | None = option(
        None,
        "JSON file of motors that turn with several joints",
        "FILE",
        default_text="found where it shows",
    )
    torque_from: str | None = option(
        None,
        "no torque was measured: find servos, friction and rotor inertia from commanded and "
        "measured positions",
        choices=("position-error",),
        default_text="measured torques",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.no_friction and self.friction_model is not None:
            raise InputError("--friction-model and --no-friction exclude each other")
        if self.friction_model not in (None, CHOSEN):
            from robot_sysid.dynamics.friction import friction_model

            friction_model(str(self.friction_model))
        others = [entry for entry in given_options(self) if entry.key != "torque_from"]
        if self.torque_from is not None and others:
            raise InputError(
                f"{others[0].flag} is about measured torques; leave it off with --torque-from "
                f"{self.torque_from}"
            )

    @property
    def friction(self) -> FrictionModel | None:
        """Friction terms of every joint of measured data; None where the data chooses them."""
        from robot_sysid.dynamics.friction import FrictionModel, friction_model

        if self.no_friction:
            return FrictionModel(())
        if self.friction_model in (None, CHOSEN):
            return None if self.torques == "chain" else friction_model(DEFAULT_TERMINAL)
        return friction_model(str(self.friction_model))


# Parts of a model file that may be kept as they are.
FILE_FRICTION = "friction"
FILE_ROTORS = "rotors"
FILE_GRAVITY = "gravity"
FILE_LINKS = "links"


@dataclass(frozen=True)
class Question:
    """What to estimate from recordings.

    Attributes:
        options: prior uncertainties of the arm, and the other options of the estimate.
        loaded: whether recordings carry a payload to estimate.
        drifts: whether to estimate a drift of friction over the recordings.
        known_mass: of the payload [kg], where torque scales are estimated with it.
        in_file: whether to estimate only what a model file can hold.
        file_kind: kind of that file; a "urdf" holds no rotor inertia.
        unchanged_parts: parts of that file that stay as they are, ``FILE_FRICTION`` and the like.
        carried: the payload (10,) that loaded recordings carry, where it is known.
        resting: whether the recordings are poses at rest.
    """

    options: EstimationOptions
    loaded: bool = False
    drifts: bool = False
    known_mass: float | None = None
    in_file: bool = False
    file_kind: str = "mjcf"
    unchanged_parts: tuple[str, ...] = ()
    carried: Array | None = None
    resting: bool = False


def _stated_scales() -> LinkScales:
    # Commands read these options before numpy is needed.
    from robot_sysid.estimation.algebra.priors import AS_STATED

    return AS_STATED


@dataclass(frozen=True)
class Choice:
    """What the recordings themselves decide.

    Attributes:
        friction: per chain joint, its friction terms.
        couplings: motors that turn with several joints.
        link_scales: factors on the stated uncertainty of the other links.
        common_scale: standard deviation of an error that all torque scales share, a share; only
            links identify it.
        offsets: joint to standard deviation of its torque sensor's offset [N m]; that of others is
            free.
        rotors: joint or motor to its rotor's inertia, where that is known [kg m^2].
        dry_friction: (joints,) approximate dry friction of each row's joint [N m], which sizes the
            prior of friction curves; None while friction terms are chosen: with such a prior no
            term would lower the held-out error.
        correlation_factors: (joints,) how many rows of a joint count as one independent row; None
            for one row each.
    """

    friction: tuple[FrictionModel, ...]
    couplings: tuple[Coupling, ...] = ()
    link_scales: LinkScales = field(default_factory=_stated_scales)
    common_scale: float = 0.0
    offsets: Mapping[str, float] = field(default_factory=dict)
    rotors: Mapping[str, float] = field(default_factory=dict)
    dry_friction: tuple[float, ...] | None = None
    correlation_factors: tuple[float, ...] | None = None
