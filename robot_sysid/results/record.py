"""The one result of all questions: what files, console, report and Python programs read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_sysid import records
from robot_sysid.dynamics.friction import Coupling
from robot_sysid.records import Array, InertialParameters, Motion, Validation
from robot_sysid.records.arm import check_arrays
from robot_sysid.records.file_access import AtomicFiles

LINK = "link"
PAYLOAD = "payload"
"""Questions: the terminal link with every other link around it, or what came on to it."""


class Verdict(Enum):
    """How an identification ended: cause and remedy."""

    OK = "all requested parameters are identified from the data"
    PARTLY_FROM_MODEL = (
        "some parameter combinations do not show in these torques and keep the model's values; "
        "use --torques chain, or a longer or wider motion, to see more"
    )
    INERTIA_NOT_KNOWN = (
        "mass and centre of mass are identified; the inertia is not known, a ball of aluminium of "
        "that mass stands in its place (joints that swing the payload faster and wider show it)"
    )
    BETTER = "the written model predicts torques that were not fitted clearly better than before"
    TORQUES_ONLY = (
        "the written model predicts torques that were not fitted clearly better than before, but a "
        "part of the torque follows from nothing that it has: use it for torques of motions like "
        "the log's, not for its numbers"
    )
    AS_GOOD = (
        "the model predicted torques that were not fitted about as well as noise allows before, "
        "and so does the written one"
    )
    TOO_WEAK = (
        "the data does not tell the link's mass from zero (it is less than two standard errors); "
        "move faster, wider or longer (--excitation optimal)"
    )
    NO_BETTER = (
        "torques that were not fitted are predicted no better than the model does already; check "
        "that the log belongs to this arm, its units and signs, or record a richer motion"
    )
    IMPLAUSIBLE = (
        "the result is not what a link of this arm can be, so the log, its units or the rest of "
        "the model are not what they are taken for"
    )
    UNEXPLAINED = (
        "the torques do not follow from the motion as far as noise would let them, so the log, its "
        "units, its friction or the rest of the model are not what they are taken for"
    )
    SWAPPED = (
        "the loaded recordings weigh less than the empty ones: --empty and --loaded look swapped; "
        "exchange them"
    )
    NOT_SEEN = (
        "the recordings do not tell the payload's mass: move joints that lift it, faster, wider or "
        "longer, or check that the loaded recordings were made with the payload"
    )
    DISAGREE = (
        "the recordings contradict each other about the payload: one of them was made with "
        "another payload, or with it turned or moved, or is listed on the wrong side"
    )
    WRONG_WEIGHT = (
        "the known mass does not fit the recordings: weighed with torques as they are it comes "
        "out far from what --known-mass says; check the weight, its unit (kg), and that nothing "
        "else was changed between empty and loaded"
    )

    @property
    def is_trustworthy(self) -> bool:
        """Whether the result may go into a model or a controller."""
        whole = Verdict.OK, Verdict.BETTER, Verdict.AS_GOOD
        return self in (*whole, Verdict.PARTLY_FROM_MODEL, Verdict.INERTIA_NOT_KNOWN)

    @property
    def writes_model(self) -> bool:
        """Whether a model file is written, if only for the torques that it predicts."""
        return self.is_trustworthy or self is Verdict.TORQUES_ONLY


class Quantity(NamedTuple):
    """A number and its whole standard error: infinite where the data does not show it, NaN where
    it was held at a bound."""

    value: float
    error: float


@dataclass(frozen=True)
class BodyEstimate:
    """Ten inertial parameters of one body and how far they may be off.

    Attributes:
        name: the body's.
        inertial: the parameters, in the body's frame; of a payload in the flange frame.
        covariance: (10, 10) of their whole error, as far as anything shows it.
        shown: (10,) whether data and priors show a parameter at all.
        noise_errors: (10,) the part of the standard errors that torque noise explains.
        budget: cause to the part of the standard errors (10,) that it explains.
        data_share: (10,) how much of each value comes from the data: 1 all, 0 all from the model.
        before: what the model says; None of a payload.
        joint: the chain joint that moves it; None of a payload.
    """

    name: str
    inertial: InertialParameters
    covariance: Array
    is_determined: NDArray[np.bool_]
    noise_errors: Array
    budget: Mapping[str, Array] = field(default_factory=dict)
    data_share: Array = field(default_factory=lambda: np.ones(10))
    prior: InertialParameters | None = None
    joint: str | None = None

    @property
    def errors(self) -> Array:
        """Standard errors (10,), all causes together; infinite where nothing shows a parameter."""
        return np.where(
            self.is_determined,
            np.sqrt(np.maximum(np.diag(self.covariance), 0.0)),
            np.inf,
        )

    @property
    def mass_causes(self) -> dict[str, float]:
        """Cause, noise among them, to the part of the mass's standard error that it explains."""
        parts = {"noise": self.noise_errors, **self.budget}
        return {cause: float(part[0]) for cause, part in parts.items()}


@dataclass(frozen=True)
class JointEstimate:
    """Friction and rotor inertia of one joint, or of a motor that turns with several.

    Attributes:
        friction_model: its terms joined by "-", "none" where nothing was sought.
        terms: friction term ("coulomb", ...) or the speed of a bent one ("stribeck_speed").
        before: "coulomb", "viscous" and "armature" as the model has them.
        candidates: friction model to its held-out root mean square error [N m]; empty if given.
        noise: standard deviation of the joint's torque noise after filtering [N m]; NaN if unknown.
        two_ways: Coulomb friction forward and backward, which differ by twice the offset.
        logs: of several logs, each one's name to its friction terms, with what they have in common
            left out of the errors.
        another_day: of several logs, friction term as it is in another log than these.
    """

    friction_model: str
    terms: Mapping[str, Quantity]
    model_terms: Mapping[str, float] = field(default_factory=dict)
    candidates: Mapping[str, float] = field(default_factory=dict)
    noise: float = float("nan")
    directional_coulomb: tuple[Quantity, Quantity] | None = None
    logs: Mapping[str, Mapping[str, Quantity]] = field(default_factory=dict)
    other_day_terms: Mapping[str, Quantity] = field(default_factory=dict)


@dataclass(frozen=True)
class BaseParameters:
    """The r combinations of the links' parameters that torques can show.

    Attributes:
        combinations: in words, such as ``Izz(link_1) + 0.25*m(link_2)``.
        structural_rank: how many combinations any motion of this arm can show.
        essential: (r,) whether backward elimination keeps it.
    """

    combinations: tuple[str, ...]
    values: Array
    standard_errors: Array
    structural_rank: int
    essential: tuple[bool, ...]


@dataclass(frozen=True)
class ModelFile:
    """What the written model holds, fitted as such, and how well a file with it predicts.

    Attributes:
        thetas, errors: (n, 10) links as in ``RobotModel.links``, zero without mass, and their
            standard errors.
        joints: joint, or motor that turns several, to what it gets of "coulomb", "viscous",
            "armature", "quadratic", "cubic".
        gravity: (3,) in the model's world frame [m/s^2]; None where the file's own stays.
        before, after: held-out error of the model as it was, each joint's sensor offset taken out,
            and of the written file; None until it is known.
        others: the same pairs on whole other logs.
        kept: parts that were left alone, in words ("friction", "gravity", "other links").
        motors: those that turn several joints: with one the file is an MJCF.
        beside: what a URDF gets beside this MJCF, where the model is one; it has no such motors.
    """

    thetas: Array
    errors: Array
    joints: Mapping[str, Mapping[str, Quantity]]
    gravity: Array | None
    validation_before: Validation
    validation_after: Validation | None
    other_validations: tuple[tuple[Validation, Validation], ...] = ()
    unchanged: tuple[str, ...] = ()
    motors: tuple[Coupling, ...] = ()
    urdf_file: ModelFile | None = None


@dataclass(frozen=True)
class RecordingPayload:
    """The payload's mass [kg] and centre of mass (3,) in the flange frame [m] according to one
    recording alone, against all of the other kind, and the mass's standard errors [kg].
    """

    name: str
    is_loaded: bool
    mass: float
    com: Array
    noise_error: float
    error: float


@dataclass(frozen=True)
class Payload:
    """What came on between recordings.

    Attributes:
        flange: the frame in which it is stated.
        body: in the FLANGE frame, inertia about its origin.
        link, total: the terminal link without and with it, in the terminal body's frame.
        recordings: "empty" and "loaded" to their names.
        known_mass, torque_scale: a weight that was given [kg], and joint to its scale by it.
    """

    flange: records.Flange
    body: BodyEstimate
    link: BodyEstimate
    total: BodyEstimate
    recordings: Mapping[str, tuple[str, ...]]
    scatter: tuple[RecordingPayload, ...] = ()
    torque_scale: Mapping[str, Quantity] = field(default_factory=dict)
    known_mass: float | None = None


OPEN = "open loop"
CLOSED = "closed loop"
"""Measured torques alone; a servo that holds the model near the measured motion, or commands."""


@dataclass(frozen=True)
class RolloutError:
    """Root mean square position errors of the two models (n,) [rad or m] over windows of a length
    (horizon [s]), loop ``OPEN`` or ``CLOSED``; how many windows of each ran away, which count with
    the largest error.
    """

    loop: str
    horizon: float
    windows: int
    errors_before: Array
    errors_after: Array
    diverged: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        check_arrays(
            self, errors_before=(None,), errors_after=(np.size(self.errors_before),)
        )

    @property
    def overall(self) -> tuple[float, float]:
        """The error of all joints together (before, after)."""
        before, after = (
            float(np.sqrt(np.mean(e**2)))
            for e in (self.errors_before, self.errors_after)
        )
        return before, after

    @property
    def ratio(self) -> float | None:
        """Error of all joints, after by before; None where there was none before."""
        before, after = self.overall
        return after / before if before > 0.0 else None


@dataclass(frozen=True)
class RolloutTest:
    """The old and the new model, played on pieces of the logs that were not fitted.

    Attributes:
        held_out, servo: which pieces, and what held the model in closed loop, in words.
        errors: one per loop and horizon that could be played.
        notes: what could not be, one sentence each.
    """

    joint_names: tuple[str, ...]
    held_out: str
    servo: str
    errors: tuple[RolloutError, ...]
    notes: tuple[str, ...] = ()

    @property
    def score(self) -> float | None:
        """Geometric mean of the ratios of all loops and horizons; None where nothing was played."""
        ratios = [error.ratio for error in self.errors]
        known = [max(ratio, 1e-12) for ratio in ratios if ratio is not None]
        return float(np.exp(np.mean(np.log(known)))) if known else None

    @property
    def is_better(self) -> bool:
        """Whether the new model moves more like the arm."""
        return self.score is not None and self.score < 1.0


@dataclass(frozen=True)
class Result:
    """Everything that files, console, report and Python programs read.

    Attributes:
        question: ``LINK`` or ``PAYLOAD``.
        estimate: all parameters, the terminal link's first (of a payload: without it).
        verdict, reasons: how it ended; one phrase each on what is wrong.
        torques: "chain" or "terminal".
        links: every link with mass, base to terminal; empty of the model's own simulation.
        joints: chain joint to its friction and rotor inertia.
        couplings: combined speed, such as ``joint_5+joint_6``, to its motor.
        sensors: torque scale ("scale[joint]"), zeros, drift, tilt and delay, and so on.
        base: what the torques show of all links; None of the model's own simulation.
        file: what the written model holds; None where nothing was learnt of it.
        validation: of the fit itself, on its own held-out stretches first, then on other logs.
        friction_model: name of the friction model, or "per joint".
        delay, tilt: by which torque lags position [s], and angle between the model's gravity and
            the estimated one [rad], where they were sought.
        cutoff: of the low-pass [Hz]; None of a simulation and of resting poses.
        link_scales: "mass", "centre_of_mass" and "inertia" to by how many times the stated share
            the other links were taken to be off.
        wrong_links: links of the model that the recordings contradict.
        conflicts: what the data asks for that the model does not have.
        notes: one sentence each: what the user should know.
        rollout: how the model before and after move beside the arm, where that was asked for.
    """

    question: str
    robot: records.RobotModel
    estimate: records.Estimate
    verdict: Verdict
    torques: str
    data: records.DataOrigin
    reasons: tuple[str, ...] = ()
    links: tuple[BodyEstimate, ...] = ()
    joints: Mapping[str, JointEstimate] = field(default_factory=dict)
    couplings: Mapping[str, JointEstimate] = field(default_factory=dict)
    sensors: Mapping[str, Quantity] = field(default_factory=dict)
    base: BaseParameters | None = None
    file: ModelFile | None = None
    payload: Payload | None = None
    validation: tuple[Validation, ...] = ()
    friction_model: str | None = None
    delay: float | None = None
    tilt: float | None = None
    cutoff: float | None = None
    link_scales: Mapping[str, float] = field(default_factory=dict)
    wrong_links: tuple[records.WrongLink, ...] = ()
    conflicts: tuple[records.PriorConflict, ...] = ()
    notes: tuple[str, ...] = ()
    rollout: RolloutTest | None = None

    @property
    def model_kind(self) -> str:
        """Kind of the written model, "mjcf" or "urdf"."""
        return "mjcf" if self.file is not None and self.file.motors else self.robot.kind

    @property
    def is_measured(self) -> bool:
        """Whether the data says something that the model does not know already."""
        return self.data.source is not records.Source.ITSELF

    @property
    def body(self) -> BodyEstimate:
        """What was asked for: the payload, else the terminal link with all that hangs on it."""
        if self.payload is not None:
            return self.payload.body
        if self.links:
            return self.links[-1]
        exact = np.zeros((10, 10)), np.ones(10, dtype=bool), np.zeros(10)
        robot = self.robot
        found = self.estimate.inertial
        return BodyEstimate(robot.body_name, found, *exact, prior=robot.prior)

    @property
    def relative_mass_error(self) -> float | None:
        """Whole standard error of the asked body's mass, as a part of it; None where not known."""
        error = float(self.body.errors[0])
        mass = self.body.inertial.mass
        return (
            error / mass
            if self.is_measured and np.isfinite(error) and mass > 0.0
            else None
        )

    @property
    def failure(self) -> str | None:
        """Why the result must not be used, or None."""
        if self.verdict.writes_model:
            return None
        return "; ".join((*self.reasons, self.verdict.value))


@dataclass(frozen=True)
class ModelTarget:
    """Where a model is written to, the motion on which it must reproduce the predicted torque, and
    the residual of the identification [N m], for its comments.
    """

    files: AtomicFiles
    path: Path
    checkpoints: Motion
    rmse: float
    mesh_dir: Path | None = None
