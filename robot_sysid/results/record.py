"""The result of an identification, of a link or a payload: read by files, console and report.

A body has ten inertial parameters in the order of ``PARAMETER_NAMES``: mass [kg], first moments
[kg m], inertia about its frame's origin [kg m^2]. The arm's chain has n joints, base to terminal.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_sysid import records
from robot_sysid.dynamics.friction import Coupling
from robot_sysid.records import Array, InertialParameters, Motion, Traces, Validation
from robot_sysid.records.file_access import MODEL_NAMES, AtomicFiles
from robot_sysid.records.messages import number_text, with_error

LINK = "link"
"""Question for the inertia of the terminal link, and of every other link with it."""
PAYLOAD = "payload"
"""Question for the inertia of a payload, from recordings without and with it."""


class Verdict(Enum):
    """How an identification ended; the value is a sentence on the cause and what to do."""

    OK = "all requested parameters are identified from the data"
    PARTLY_FROM_MODEL = (
        "some parameter combinations are not identifiable from these torques and keep the model's "
        "values; use --torques chain, or a longer or wider motion, to identify more"
    )
    INERTIA_NOT_KNOWN = (
        "mass and centre of mass are identified; the inertia is not known, a ball of aluminium of "
        "that mass stands in its place (joints that swing the payload faster and wider show it)"
    )
    BETTER = "the written model predicts torques that were not fitted clearly better than before"
    TORQUES_ONLY = (
        "the written model predicts torques that were not fitted clearly better than before, but a "
        "part of the torque follows from nothing that was fitted: use the model for torques of "
        "motions like the log's, not for the numbers"
    )
    AS_GOOD = (
        "the model predicted torques that were not fitted about as well as noise allows before, "
        "and so does the written one"
    )
    TOO_WEAK = (
        "the link's mass does not differ significantly from zero (it is less than two standard "
        "errors); move faster, wider or longer (--excitation optimal)"
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
        "the payload's mass does not differ significantly from zero: move joints that lift it, "
        "faster, wider or longer, or check that the loaded recordings were made with the payload"
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
        return self in (
            Verdict.OK,
            Verdict.BETTER,
            Verdict.AS_GOOD,
            Verdict.PARTLY_FROM_MODEL,
            Verdict.INERTIA_NOT_KNOWN,
        )

    @property
    def writes_model(self) -> bool:
        """Whether a model file is written; ``TORQUES_ONLY`` gets one for predicting torques."""
        return self.is_trustworthy or self is Verdict.TORQUES_ONLY


HELD_NOTE = "held: kept at its bound or at the model's value, without an estimate"
"""Explanation of ``Quantity.text`` of a number that was held."""
_INTERVAL_ERRORS = 1.96
"""Standard errors on each side of a value within which 95 % of a normal distribution lie."""


class Quantity(NamedTuple):
    """An estimated number and its standard error, all causes together.

    The error is infinite where the data does not determine the number, and NaN where the number was
    held at a bound.
    """

    value: float
    error: float

    @property
    def interval(self) -> tuple[float, float]:
        """Bounds (low, high) of the 95 % confidence interval, for an error that is normal."""
        reach = _INTERVAL_ERRORS * self.error
        return self.value - reach, self.value + reach

    @property
    def text(self) -> str:
        """The number with its standard error, or with "(held)" where it was held at a bound."""
        if math.isnan(self.error):
            return f"{number_text(self.value)} (held)"
        return with_error(*self)


@dataclass(frozen=True)
class BodyEstimate(InertialParameters):
    """The ten inertial parameters of one body, estimated, and their errors.

    Attributes:
        theta: (10,) the parameters, in the body's frame; of a payload in the flange frame.
        name: name of the body.
        covariance: (10, 10) covariance of the parameters' errors, all causes together; zero where
            it is not known.
        is_determined: (10,) whether data and priors determine a parameter at all.
        budget: cause, "noise" of the torques first, to the standard errors (10,) due to it alone.
        data_share: (10,) share of each value that comes from the data, 0 to 1; the model gives the
            other share.
        prior: the parameters in the model; None of a payload.
        joint: the chain joint that moves the body; None of a payload.
    """

    name: str
    covariance: Array
    is_determined: NDArray[np.bool_]
    budget: Mapping[str, Array] = field(default_factory=dict)
    data_share: Array = field(default_factory=lambda: np.ones(10))
    prior: InertialParameters | None = None
    joint: str | None = None

    @property
    def errors(self) -> Array:
        """Standard errors (10,), all causes together; infinite where not determined."""
        errors = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return np.where(self.is_determined, errors, np.inf)

    @property
    def mass_causes(self) -> dict[str, float]:
        """Cause, noise first, to the standard error of the mass due to it alone [kg]."""
        return {cause: float(errors[0]) for cause, errors in self.budget.items()}


@dataclass(frozen=True)
class JointEstimate:
    """Friction and rotor inertia of one joint, or of a motor that turns with several.

    Attributes:
        friction_model: names of the friction terms joined by "-"; "none" where friction is not
            estimated.
        terms: friction term ("coulomb", ...) to its value.
        model_terms: terms that a model file holds, as in ``ModelFile.joints``, to their values in
            the model.
        noise: standard deviation of the joint's torque noise after filtering [N m]; NaN if unknown.
    """

    friction_model: str
    terms: Mapping[str, Quantity]
    model_terms: Mapping[str, float] = field(default_factory=dict)
    noise: float = float("nan")


@dataclass(frozen=True)
class ModelFile:
    """The numbers of the written model, fitted under its restrictions, and its prediction errors.

    Attributes:
        thetas: (n, 10) parameters of the links, as in ``RobotModel.links``; zero without mass.
        errors: (n, 10) standard errors of ``thetas``.
        joints: joint, or motor that turns several, to its terms in the file: "coulomb", "viscous",
            "armature".
        gravity: (3,) in the model's world frame [m/s^2]; None where the file keeps its own.
        validation_before: held-out error of the original model, each joint's sensor offset removed.
        validation_after: held-out error of the written model; None until it is known.
        other_validations: (before, after) on each of the other logs, held out as a whole.
        unchanged: names of what the file keeps ("friction", "gravity", "other links").
        motors: those that turn several joints; only an MJCF can hold them.
        urdf_file: of a URDF's arm with rotor inertia or such motors, the numbers of the URDF that
            is written beside this MJCF, without them.
        omissions: of a URDF beside an MJCF, what the MJCF alone holds, as phrases for the user.
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
    omissions: tuple[str, ...] = ()


@dataclass(frozen=True)
class RecordingPayload:
    """The payload as one recording alone determines it, against all recordings of the other kind.

    Attributes:
        name: name of the recording.
        is_loaded: whether it was made with the payload.
        mass: mass of the payload [kg].
        com: (3,) the payload's centre of mass in the flange frame [m]; NaN where the mass is zero.
        noise_error: standard error of the mass due to noise alone [kg].
        error: standard error of the mass, all causes together [kg].
    """

    name: str
    is_loaded: bool
    mass: float
    com: Array
    noise_error: float
    error: float


@dataclass(frozen=True)
class Payload:
    """A payload that the arm carries in some recordings and not in others.

    Attributes:
        flange: the frame in which the payload is stated.
        body: the payload in the FLANGE frame, inertia about that frame's origin.
        link: the terminal link without the payload, in the terminal body's frame.
        total: the terminal link with the payload, in the terminal body's frame.
        recordings: "empty" and "loaded" to the names of the recordings.
        scatter: the payload according to each recording alone.
        torque_scale: joint to the torque scale that follows from ``known_mass``.
        known_mass: the payload's weight as the user states it [kg]; None where it is unknown.
    """

    flange: records.Flange
    body: BodyEstimate
    link: BodyEstimate
    total: BodyEstimate
    recordings: Mapping[str, tuple[str, ...]]
    scatter: tuple[RecordingPayload, ...] = ()
    torque_scale: Mapping[str, Quantity] = field(default_factory=dict)
    known_mass: float | None = None


@dataclass(frozen=True)
class Result:
    """Everything that files, console, report and Python programs read of an identification.

    Attributes:
        question: ``LINK`` or ``PAYLOAD``.
        robot: the arm, as its model describes it.
        estimate: all parameters, the terminal link's first (of a payload: without it).
        verdict: how the identification ended.
        torques: "chain" or "terminal": the joints whose torques were fitted.
        data: where the data comes from.
        reasons: what is wrong with the result, one phrase each.
        links: name of the body to every link with mass, base to terminal; empty of the model's own
            simulation.
        joints: chain joint to its friction and rotor inertia.
        couplings: sum of joint speeds, such as ``joint_5+joint_6``, to the motor that turns with
            it.
        sensors: nuisance parameter to its value: torque scales ("scale[joint]"), zeros, drifts,
            tilt, delay.
        file: the numbers of the written model; None where only the terminal link or the payload is
            written into the original.
        payload: None of the question ``LINK``.
        validation: errors of the fit in predicting torques: of held-out stretches of its logs
            first, then of other logs.
        friction_model: name of the friction model, or "per joint".
        cutoff: cut-off of the low-pass [Hz]; None of a simulation and of resting poses.
        link_scales: "mass", "centre_of_mass" and "inertia" to the factor by which the prior
            standard deviation of the other links was widened.
        wrong_links: links of the model that the recordings contradict.
        notes: remarks for the user, one sentence each.
        checkpoints: motion on which a written model has to reproduce the predicted torque.
        traces: computes the measured and predicted torques that a report draws.
    """

    question: str
    robot: records.RobotModel
    estimate: records.Estimate
    verdict: Verdict
    torques: str
    data: records.DataOrigin
    reasons: tuple[str, ...] = ()
    links: Mapping[str, BodyEstimate] = field(default_factory=dict)
    joints: Mapping[str, JointEstimate] = field(default_factory=dict)
    couplings: Mapping[str, JointEstimate] = field(default_factory=dict)
    sensors: Mapping[str, Quantity] = field(default_factory=dict)
    file: ModelFile | None = None
    payload: Payload | None = None
    validation: tuple[Validation, ...] = ()
    friction_model: str | None = None
    cutoff: float | None = None
    link_scales: Mapping[str, float] = field(default_factory=dict)
    wrong_links: tuple[records.WrongLink, ...] = ()
    notes: tuple[str, ...] = ()
    checkpoints: Motion | None = None
    traces: Callable[[], Traces] | None = None

    @property
    def model_kind(self) -> str:
        """Format of the written model, "mjcf" or "urdf".

        It is an MJCF where MuJoCo alone would not load a URDF, or a URDF lacks identified numbers.
        """
        has_both = self.file is not None and self.file.urdf_file
        return "mjcf" if has_both or self.robot.lacks_meshes else self.robot.kind

    @property
    def written_file(self) -> ModelFile | None:
        """``file``; None where the verdict forbids to write it."""
        return self.file if self.verdict.writes_model else None

    @property
    def model_name(self) -> str:
        """Name of the written model file."""
        return MODEL_NAMES[self.model_kind]

    @property
    def is_measured(self) -> bool:
        """Whether the data comes from anything but a simulation of the model itself."""
        return self.data.description != records.ITSELF

    @property
    def body(self) -> BodyEstimate:
        """The payload; without one, the terminal link with all bodies that move with it.

        Where no link was estimated with errors, the link's covariance is zero.
        """
        if self.payload is not None:
            return self.payload.body
        if self.links:
            return [*self.links.values()][-1]
        return BodyEstimate(
            theta=self.estimate.inertial.theta,
            name=self.robot.body_name,
            covariance=np.zeros((10, 10)),
            is_determined=np.ones(10, dtype=bool),
            prior=self.robot.prior,
        )

    @property
    def relative_mass_error(self) -> float | None:
        """Standard error of the mass of ``body`` over that mass; None where it is not known."""
        error = float(self.body.errors[0])
        mass = self.body.mass
        is_known = self.is_measured and np.isfinite(error) and mass > 0.0
        return error / mass if is_known else None

    @property
    def failure(self) -> str | None:
        """Why the result must not be used; None where it may."""
        if self.verdict.writes_model:
            return None
        return "; ".join((*self.reasons, self.verdict.value))


@dataclass(frozen=True)
class ModelTarget:
    """Where a model is written to, and what is needed for it.

    Attributes:
        files: receives the draft.
        path: final path of the file, or folder of several.
        checkpoints: motion on which the written model must reproduce the predicted torque.
        rmse: residual of the identification [N m], for comments in the file.
        mesh_dir: the user's mesh folder; None where the model's own paths hold.
    """

    files: AtomicFiles
    path: Path
    checkpoints: Motion
    rmse: float
    mesh_dir: Path | None = None


def json_text(content: Mapping[str, Any]) -> str:
    """Return strict JSON text: arrays as lists, numbers that are not finite as null."""
    return json.dumps(_strict(content), indent=2, allow_nan=False) + "\n"


def _strict(value: Any) -> Any:
    """Return a value as strict JSON can hold it: records as dicts, quantities with an interval.

    Numbers that are not finite become None. Fields that do not count in comparisons are left out.
    """
    if isinstance(value, Quantity):
        entry = {
            "value": value.value,
            "standard_error": value.error,
            "interval": value.interval,
        }
        return _strict(entry)
    if is_dataclass(value) and not isinstance(value, type):
        names = [entry.name for entry in fields(value) if entry.compare]
        return _strict({name: getattr(value, name) for name in names})
    if isinstance(value, Mapping):
        return dict(zip(map(str, value), map(_strict, value.values())))
    if isinstance(value, (np.ndarray, np.generic)):
        return _strict(value.tolist())
    if isinstance(value, (list, tuple)):
        return list(map(_strict, value))
    return None if isinstance(value, float) and not math.isfinite(value) else value
