"""Records of an estimation task: the user's options, the question, and the choices from data.

A ``Question`` says which parameters are wanted; a ``Choice`` holds the settings that are selected
from the recordings themselves, such as friction terms.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from robot_sysid.estimate.options import (  # noqa: F401
    CHOSEN,
    DEFAULT_TERMINAL,
    FILE_FRICTION,
    FILE_GRAVITY,
    FILE_LINKS,
    FILE_ROTORS,
    TORQUE_CHOICES,
    EstimationOptions,
    Priors,
    priors_of,
    read_priors,
)

if TYPE_CHECKING:
    from robot_sysid.dynamics.friction import Coupling, FrictionModel
    from robot_sysid.estimation.algebra.priors import LinkScales
    from robot_sysid.records import Array


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
