"""What an identification of every link found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

from robot_sysid.records.arrays import Array, checked_array
from robot_sysid.records.results import DataOrigin, Validation


class ArmStatus(Enum):
    """How an identification of every link ended: cause and remedy."""

    OK = "every link is a possible rigid body of plausible size, and held-out torques are predicted"
    IMPLAUSIBLE = (
        "a link has a mass or a centre of mass that its model does not come near; check units, "
        "signs and torque scale of the log, or hold the links closer to the model with "
        "--model-weight"
    )
    UNPREDICTED = (
        "torques that were not fitted are predicted no better than the model already does; check "
        "that the log belongs to this arm, its units and signs, or record a richer motion"
    )

    @property
    def is_trustworthy(self) -> bool:
        """Whether the result may go into a model."""
        return self is ArmStatus.OK


@dataclass(frozen=True)
class BaseParameters:
    """Combinations of the links' parameters that torques can show.

    Attributes:
        combinations: in words, such as ``Izz(link_1) + 0.25*m(link_2)``; the first parameter of
            each is the one it is named after.
        values, standard_errors: (r,).
        structural_rank: how many combinations any motion of this arm can show.
        essential: (r,) whether backward elimination keeps it.
    """

    combinations: tuple[str, ...]
    values: Array
    standard_errors: Array
    structural_rank: int
    essential: tuple[bool, ...]

    @property
    def rank(self) -> int:
        """How many combinations the data shows."""
        return len(self.combinations)


@dataclass(frozen=True)
class ArmEstimate:
    """All parameters of an arm.

    Attributes:
        names: (p,) parameter names; those of links but the terminal one like ``m(forearm)``.
        values, standard_errors: (p,).
        data_share: (p,) how much of each value comes from the data: 1 all, 0 all from the model.
        thetas, theta_errors: (n, 10) the links, as in ``RobotModel.links``, and their errors.
        friction: name of the friction model of every joint.
        couplings: names of the combined speeds that share a motor.
        gamma: weight of the model.
        noise_per_joint: joint name to root mean square residual [N m].
        base: what the torques show.
    """

    names: tuple[str, ...]
    values: Array
    standard_errors: Array
    data_share: Array
    thetas: Array
    theta_errors: Array
    friction: str
    couplings: tuple[str, ...]
    gamma: float
    noise_per_joint: Mapping[str, float]
    base: BaseParameters

    def __post_init__(self) -> None:
        size = (len(self.names),)
        for name in ("values", "standard_errors", "data_share"):
            object.__setattr__(self, name, checked_array(getattr(self, name), size, name))
        object.__setattr__(self, "thetas", checked_array(self.thetas, (None, 10), "thetas"))

    def value(self, name: str) -> float | None:
        """Return one parameter by name, or None where it was not estimated."""
        return float(self.values[self.names.index(name)]) if name in self.names else None

    def error(self, name: str) -> float | None:
        """Return one parameter's standard error by name, or None where it was not estimated."""
        if name not in self.names:
            return None
        return float(self.standard_errors[self.names.index(name)])


@dataclass(frozen=True)
class ArmIdentification:
    """Everything that is reported and written of an identification of every link.

    Attributes:
        model_path, model_sha256: which model file.
        joint_names, link_names: (n,) base to terminal.
        model_thetas: (n, 10) the links as the model has them.
        estimate: the result.
        status: how it ended.
        reasons: what is wrong, one phrase each; empty where nothing is.
        data: where the torques came from.
        held_out: error on stretches of the logs that were predicted from the others.
        model_error: relative error of the model's own links with refitted friction on the same.
        validation: error on other logs.
        choices: friction model to its held-out error [N m].
        model_friction: joint name to the Coulomb and viscous friction nearest to what was found,
            and rotor inertia, which a model can hold.
        cutoff: of the low-pass [Hz].
        versions: package name to version.
        notes: one sentence each.
    """

    model_path: Path
    model_sha256: str
    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]
    model_thetas: Array
    estimate: ArmEstimate
    status: ArmStatus
    reasons: tuple[str, ...]
    data: DataOrigin
    held_out: Validation
    model_error: float
    validation: tuple[Validation, ...]
    choices: Mapping[str, float]
    model_friction: Mapping[str, Mapping[str, float]]
    cutoff: float
    versions: Mapping[str, str]
    notes: tuple[str, ...] = field(default=())
