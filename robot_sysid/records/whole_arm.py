"""What an identification of every link found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

from robot_sysid.records.arrays import Array, checked_array
from robot_sysid.records.results import DataOrigin, RolloutTest, Validation


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
        friction: joint name to the name of its friction model.
        couplings: names of the combined speeds that share a motor.
        gamma: weight of the model.
        noise_per_joint: joint name to root mean square residual [N m].
        base: what the torques show.
        two_way: joint name to Coulomb friction forward and backward, which differ by twice the
            offset, each with its standard error [N m]; of joints with both terms.
    """

    names: tuple[str, ...]
    values: Array
    standard_errors: Array
    data_share: Array
    thetas: Array
    theta_errors: Array
    friction: Mapping[str, str]
    couplings: tuple[str, ...]
    gamma: float
    noise_per_joint: Mapping[str, float]
    base: BaseParameters
    two_way: Mapping[str, tuple[tuple[float, float], ...]] = field(default_factory=dict)

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
class FrictionCurve:
    """Friction torque over speed, without the part that grows with the gear's load.

    Attributes:
        speed, torque: (m,) the law that was found [rad/s, N m].
        measured_speed, measured_torque, standard_error: (k,) means of the logs' rows by speed, with
            all other torques and the load's part taken off.
        rows: (k,) how many rows each is the mean of.
    """

    speed: Array
    torque: Array
    measured_speed: Array
    measured_torque: Array
    standard_error: Array
    rows: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "torque", checked_array(self.torque, (len(self.speed),), "torque"))
        size = (len(self.measured_speed),)
        for name in ("measured_torque", "standard_error", "rows"):
            object.__setattr__(self, name, checked_array(getattr(self, name), size, name))


@dataclass(frozen=True)
class HeldFriction:
    """What a model file can hold of a joint's friction and rotor inertia.

    Attributes:
        values, errors: by term: ``armature``, ``coulomb``, ``viscous``, and ``quadratic`` and
            ``cubic`` where the polynomial predicts held-out torques clearly better, ``offset``
            where it is wanted; with their standard errors.
        kept: terms whose values the data does not prove; the file's own stay.
        missing: what the file cannot hold [N m], by name.
        curve: friction over speed.
        notes: one sentence each.
    """

    values: Mapping[str, float]
    errors: Mapping[str, float]
    kept: tuple[str, ...]
    missing: Mapping[str, float]
    curve: FrictionCurve
    notes: tuple[str, ...] = field(default=())

    def written(self, term: str) -> float | None:
        """Return the value that goes into the file, None where its own stays."""
        return None if term in self.kept else self.values.get(term)

    def words(self, term: str) -> str:
        """Return a value with its standard error, for a comment."""
        return f"{self.values[term]:.4g} ± {self.errors[term]:.2g}"


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
        choices: joint name to friction model to its held-out error [N m]; empty where it was given.
        model_friction: joint name to what a model can hold of its friction and rotor inertia.
        cutoff: of the low-pass [Hz].
        versions: package name to version.
        notes: one sentence each.
        slides: the joints that are slides, whose friction is a force.
        rollout: how the old and the new model move beside the arm, where that was asked for.
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
    choices: Mapping[str, Mapping[str, float]]
    model_friction: Mapping[str, HeldFriction]
    cutoff: float
    versions: Mapping[str, str]
    notes: tuple[str, ...] = field(default=())
    slides: tuple[str, ...] = ()
    rollout: RolloutTest | None = None


@dataclass(frozen=True)
class JointServo:
    """What was found of one joint of an arm without torque sensors, and of its servo.

    Attributes:
        joint: its name.
        before: number by name (gain, damping, frictionloss, armature) as the model has it; NaN
            where it has none.
        after, errors: what was found, with its standard error; the same and zero where the joint
            does not move.
        shares: how much of each comes from the data: 1 all, 0 all from the start of the search.
        moves: whether the joint moves in the logs.
        has_servo: whether the model has a position actuator that takes the gain.
        at_limit: share of time in which the servo asks for more than its limit.
    """

    joint: str
    before: Mapping[str, float]
    after: Mapping[str, float]
    errors: Mapping[str, float]
    shares: Mapping[str, float]
    moves: bool
    has_servo: bool
    at_limit: float


@dataclass(frozen=True)
class ServoIdentification:
    """Everything that is told of an arm identified from commands and positions alone.

    Attributes:
        model_path, model_sha256: which model file.
        joints: what was found of each chain joint.
        delay, delay_error: by which commands act late [s].
        position_errors: joint name to root mean square position error of the fit [rad or m].
        data: where commands and positions came from.
        rollout: the model before and after, played on held-out pieces.
        versions: package name to version.
        notes: one sentence each.
    """

    model_path: Path
    model_sha256: str
    joints: tuple[JointServo, ...]
    delay: float
    delay_error: float
    position_errors: Mapping[str, float]
    data: DataOrigin
    rollout: RolloutTest
    versions: Mapping[str, str]
    notes: tuple[str, ...] = ()
