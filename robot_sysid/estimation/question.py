"""Records of an estimation task: the user's options, the question, and the choices from data.

A ``Question`` says which parameters are wanted; a ``Choice`` holds the settings that are selected
from the recordings themselves, such as friction terms.
"""

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
"""Values of the option ``torques``: equations of all joints that carry the terminal link, or of
the last joint only."""
DEFAULT_TERMINAL = "coulomb-viscous-offset"
"""Default friction model with ``torques="terminal"``; it has no rotor inertia, which one joint's
torque does not tell from the inertia of the link."""
CHOSEN = "auto"
"""Value of the option ``friction_model`` that selects each joint's friction terms from the data."""


def _uncertainty(default: float, help: str, unit: str = "%") -> Any:
    """Return the dataclass field of an option that is a prior standard deviation, zero or more.

    Args:
        default: value in the given unit.
        help: text for the user.
        unit: of the value, as it is printed.
    """
    # The option is shown as P, and values below zero are refused.
    return option(default, help, "P >= 0", unit=unit)


@dataclass(frozen=True)
class EstimationOptions(OptionRecord):
    """Options of the user: how parameters are estimated from torques.

    Each field's text says what it means. Uncertainties are standard deviations of priors in the
    printed unit: percent, milliradians, degrees, milliseconds.
    """

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
        """Check each value, that the friction model exists, and that options do not conflict.

        Raises:
            InputError: a check failed.
        """
        super().__post_init__()
        if self.no_friction and self.friction_model is not None:
            raise InputError("--friction-model and --no-friction exclude each other")
        if self.friction_model not in (None, CHOSEN):
            from robot_sysid.dynamics.friction import friction_model

            friction_model(str(self.friction_model))
        others = [entry for entry in given_options(self) if entry.key != "torque_from"]
        # All other options describe how parameters are estimated from measured torques.
        if self.torque_from is not None and others:
            raise InputError(
                f"{others[0].flag} is about measured torques; leave it off with --torque-from "
                f"{self.torque_from}"
            )

    @property
    def friction(self) -> FrictionModel | None:
        """Friction terms of every joint; None where each joint's terms are selected from data.

        With the option ``no_friction`` it is a model without terms.
        """
        from robot_sysid.dynamics.friction import FrictionModel, friction_model

        if self.no_friction:
            return FrictionModel(())
        if self.friction_model not in (None, CHOSEN):
            return friction_model(str(self.friction_model))
        if self.torques == "terminal":
            return friction_model(DEFAULT_TERMINAL)
        return None

    @property
    def left_out_terms(self) -> tuple[str, ...]:
        """Terms of the default friction model that the user's own friction model lacks.

        A sigmoid is no lack of Coulomb friction.
        """
        from robot_sysid.dynamics.friction import DEFAULT_MEASURED, friction_model

        default = DEFAULT_TERMINAL if self.torques == "terminal" else DEFAULT_MEASURED
        if self.friction is None:
            return ()
        terms = self.friction.terms
        given = {*terms, "coulomb"} if "sigmoid" in terms else {*terms}
        return tuple(t for t in friction_model(default).terms if t not in given)


# Names of the parts of a model file that may stay as they are (``Question.unchanged_parts``).
# Friction of joints and motors.
FILE_FRICTION = "friction"
# Rotor inertia.
FILE_ROTORS = "rotors"
# Direction of gravity.
FILE_GRAVITY = "gravity"
# All links but the terminal one.
FILE_LINKS = "links"


@dataclass(frozen=True)
class Question:
    """Which parameters to estimate from recordings, and under which assumptions.

    Attributes:
        options: prior uncertainties of the arm, and the other options of the estimate.
        loaded: whether some recordings carry a payload, whose parameters are estimated.
        drifts: whether to estimate a drift of friction from the first to the last recording.
        known_mass: mass of the payload [kg], from which torque scales are estimated; None where it
            is not known.
        in_file: whether to estimate only the parameters that a model file can hold.
        file_kind: kind of the model file, "mjcf" or "urdf"; a URDF holds no rotor inertia.
        unchanged_parts: parts of the model file that stay as they are: ``FILE_FRICTION``,
            ``FILE_ROTORS``, ``FILE_GRAVITY``, ``FILE_LINKS``.
        carried: inertial parameters (10,) of the payload that loaded recordings carry, where they
            are known; None to leave the payload out.
        resting: whether the recordings are poses at rest, which have no dynamic friction.
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
    """Return factors of one on the uncertainty of links, the default of ``Choice.link_scales``."""
    # Commands read these options before numpy is needed.
    from robot_sysid.estimation.algebra.priors import AS_STATED

    return AS_STATED


@dataclass(frozen=True)
class Choice:
    """Settings of a fit that are selected from the recordings themselves.

    Joints are the n of the chain; (joints,) counts only those that have equations.

    Attributes:
        friction: (n,) friction terms of each chain joint.
        couplings: motors that turn with several joints.
        link_scales: factors on the stated uncertainty of all links but the terminal one.
        common_scale: prior standard deviation of an error that all torque scales share, as a share
            of the torque; zero for none. Only the priors of links identify this error.
        offsets: joint to prior standard deviation of its torque sensor's offset [N m]; offsets of
            all other joints have no prior.
        rotors: joint or motor to its rotor inertia, where it is known and held [kg m^2].
        dry_friction: (joints,) approximate dry friction [N m], which sizes the prior of friction
            terms that the model lacks; None while friction terms are selected: with such a prior no
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

    @property
    def speed_rounds(self) -> int:
        """Number of linearisations after which speeds of nonlinear friction have settled, or one.

        They settle before ``dry_friction`` is stated: the terms that the model lacks would take up
        what a wrong speed misses, down to an amplitude of zero, which shows no speed any more.
        """
        return 4 if any(model.nonlinear_terms for model in self.friction) else 1
