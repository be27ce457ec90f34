"""The result of an identification, of a link or a payload: read by files, console and report.

A body has ten inertial parameters in the order of ``PARAMETER_NAMES``: mass [kg], first moments
[kg m], inertia about its frame's origin [kg m^2]. The arm's chain has n joints, base to terminal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robot_sysid import records
from robot_sysid.dynamics.friction import ROTOR, Coupling
from robot_sysid.records import Array, InertialParameters, Motion, Traces, Validation
from robot_sysid.records.file_access import MODEL_NAMES, AtomicFiles
from robot_sysid.records.messages import Level, Remark
from robot_sysid.wording import with_option_names

LINK = "link"
"""Question for the inertia of the terminal link, and of every other link with it."""
PAYLOAD = "payload"
"""Question for the inertia of a payload, from recordings without and with it."""


class Verdict(Enum):
    """What decides on the use of a result; the value says what it means, or what to do."""

    SWAPPED = (
        "the loaded recordings weigh less than the empty ones: {empty} and {loaded} look swapped; "
        "exchange them"
    )
    DISAGREE = (
        "the recordings contradict each other about the payload: one of them was made with "
        "another payload, or with it turned or moved, or is listed on the wrong side"
    )
    NOT_SEEN = (
        "the payload's mass does not differ significantly from zero: move joints that lift it, "
        "faster, wider or longer, or check that the loaded recordings were made with the payload"
    )
    WRONG_WEIGHT = (
        "the known mass does not fit the recordings: weighed with torques as they are it comes "
        "out far from what {known_mass} says; check the weight, its unit (kg), and that nothing "
        "else was changed between empty and loaded"
    )
    UNEXPLAINED = (
        "the torques do not follow from the motion as far as noise would let them, so the log, its "
        "units, its friction or the rest of the model are not what they are taken for"
    )
    IMPLAUSIBLE = (
        "the result is not what a link of this arm can be, so the log, its units or the rest of "
        "the model are not what they are taken for"
    )
    TOO_WEAK = (
        "the link's mass does not differ significantly from zero (it is less than two standard "
        "errors); move faster, wider or longer ({excitation=optimal})"
    )
    NO_BETTER = (
        "torques that were not fitted are predicted no better than the model does already; check "
        "that the log belongs to this arm, its units and signs, or record a richer motion"
    )
    TORQUES_ONLY = (
        "a part of the torque follows from nothing that was fitted: use the written model for "
        "torques of motions like the log's, not for the numbers"
    )
    INERTIA_NOT_KNOWN = (
        "mass and centre of mass are identified; the inertia is not known, a ball of aluminium of "
        "that mass stands in its place (joints that swing the payload faster and wider show it)"
    )
    PARTLY_FROM_MODEL = (
        "some parameter combinations are not identifiable from these torques and keep the model's "
        "values; use {torques=chain}, or a longer or wider motion, to identify more"
    )
    BETTER = "the written model predicts torques that were not fitted clearly better than before"
    AS_GOOD = (
        "the model predicted torques that were not fitted about as well as noise allows before, "
        "and so does the written one"
    )
    OK = "all requested parameters are identified from the data"

    @property
    def value(self) -> str:
        """What it means, or what to do, with options named for the reader."""
        return with_option_names(self._value_)

    @property
    def level(self) -> Level:
        """Whether it forbids the use of a result, limits it, or only informs."""
        if self is Verdict.TORQUES_ONLY:
            return Level.DOUBTS
        is_good = self in (
            Verdict.OK,
            Verdict.BETTER,
            Verdict.AS_GOOD,
            Verdict.PARTLY_FROM_MODEL,
            Verdict.INERTIA_NOT_KNOWN,
        )
        return Level.SAYS if is_good else Level.REFUSES

    @property
    def is_trustworthy(self) -> bool:
        """Whether the result may go into a model or a controller."""
        return self.level is Level.SAYS

    def remark(self, reason: str = "") -> Remark:
        """Return the remark by which this verdict follows from a reason, one phrase."""
        return Remark(self.level, self.name, *filter(None, (reason, self.value)))


DATA = "data"
"""Source of a number that follows from the recordings more than from the model."""
MODEL = "model"
"""Source of a number that the recordings determine less than the model, or not at all."""
BOUND = "bound"
"""Source of a number that is held at its bound, without a standard error."""
FILE = "file"
"""Source of a number of the written model, fitted under the restrictions of its format."""
CURVED = "curved file"
"""Source of a number of the written model whose friction bends with speed."""


@dataclass(frozen=True)
class Quantity:
    """One number of a result: a row of params.json, of the console's tables and of the report.

    Attributes:
        name: what it is, such as "mass", "com_x", "Ixx_about_com", "coulomb" or "scale".
        of: body, joint, motor or recording that has it; "arm" for what concerns all.
        unit: of the three numbers.
        model: the value in the original model; None where that has none.
        value: the identified value.
        error: standard error of ``value``, all causes together; infinite where the recordings do
            not determine it, NaN where it is held at a bound, None of a simulation of the model
            itself, which has rounding errors alone.
        source: ``DATA``, ``MODEL``, ``BOUND``, ``FILE`` or ``CURVED``.
        reason: the cause of most of the error, or why there is none.
    """

    name: str
    of: str
    unit: str
    model: float | None
    value: float
    error: float | None
    source: str = DATA
    reason: str = ""


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
    """

    name: str
    covariance: Array = field(default_factory=lambda: np.zeros((10, 10)))
    is_determined: NDArray[np.bool_] = field(
        default_factory=lambda: np.ones(10, dtype=bool)
    )
    budget: Mapping[str, Array] = field(default_factory=dict)
    data_share: Array = field(default_factory=lambda: np.ones(10))
    prior: InertialParameters | None = None

    @property
    def errors(self) -> Array:
        """Standard errors (10,), all causes together; infinite where not determined."""
        errors = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return np.where(self.is_determined, errors, np.inf)

    def moment_along(self, vector: Array) -> tuple[float, float]:
        """Return the first moment along a vector (3,), and its standard error [kg m].

        The error is infinite where the first moment is not determined.
        """
        direction = vector / max(float(np.linalg.norm(vector)), 1e-300)
        variance = direction @ self.covariance[1:4, 1:4] @ direction
        is_determined = np.all(self.is_determined[1:4])
        error = float(np.sqrt(variance)) if is_determined else np.inf
        return float(direction @ self.first_moment), error

    def largest_cause(self, index: int) -> str:
        """Return the cause of the largest part of a parameter's error; "" where that is not known.

        ``index``: of the parameter, 0 for the mass.
        """
        causes = {cause: errors[index] for cause, errors in self.budget.items()}
        if not np.all(np.isfinite([self.errors[index], *causes.values()])):
            return ""
        return max(causes, key=causes.__getitem__, default="")


@dataclass(frozen=True)
class ModelErrors:
    """Torque prediction errors of two models on the same data.

    Attributes:
        before: of the original model, each joint's sensor offset removed.
        after: of the written model, likewise.
        before_as_used: of the original model, offsets counted as errors: no file holds them.
        after_as_used: of the written model, likewise.
    """

    before: Validation
    after: Validation
    before_as_used: Validation
    after_as_used: Validation


@dataclass(frozen=True)
class MotionErrors:
    """Torque errors to expect of a model in motions, root mean square over the torque.

    Attributes:
        relative_error: of all joints together.
        relative_error_per_joint: name of each joint to its own, over its own torque.
    """

    relative_error: float
    relative_error_per_joint: Mapping[str, float]


@dataclass(frozen=True)
class ErrorPart:
    """What makes a part of an expected torque error.

    Attributes:
        what: in words, such as "friction of joint2".
        relative_error: that it makes alone, over the torque of all joints.
    """

    what: str
    relative_error: float


@dataclass(frozen=True)
class NextMotion:
    """The motion whose log would lower an expected error most.

    Attributes:
        plan: words of ``plan`` behind the model, which make it.
        relative_error: to expect of a file from both logs.
    """

    plan: tuple[str, ...]
    relative_error: float


@dataclass(frozen=True)
class Elsewhere:
    """Torque errors to expect on motions that nobody recorded, all over the arm's range.

    They are root mean square over random motions, right within a factor of 1.5 in most cases.
    Offsets of torque sensors are counted where that makes an error larger.

    Attributes:
        speed: highest speed of these motions.
        speed_unit: its unit.
        before: of the original model.
        after: of the written model.
        at_log_speeds: of the written model, on motions in which no joint is faster than in logs.
        log_speed: highest speed of these.
        faster: the joint that makes most of the error, if that comes from faster motions; else "".
        still: joints that stood still in the logs.
        parts: what makes most of the error of the written model, largest first.
        for_like_motions: whether the file is little better than the model on other motions, so that
            its use is for motions like the logs'.
        next: the motion to record next; None where none would gain much.
    """

    speed: float
    speed_unit: str
    before: MotionErrors
    after: MotionErrors
    at_log_speeds: MotionErrors
    log_speed: float
    faster: str = ""
    still: tuple[str, ...] = ()
    parts: tuple[ErrorPart, ...] = ()
    for_like_motions: bool = False
    next: NextMotion | None = None


@dataclass(frozen=True)
class CurvedFile(ModelErrors):
    """What is said of the written model whose friction bends with speed.

    Its numbers are the rows with the source ``CURVED``; all but friction is that of the other file.

    Attributes:
        others: errors on each of the other logs, held out as a whole.
        elsewhere: errors to expect on other motions; None where nothing is promised.
    """

    others: tuple[ModelErrors, ...] = ()
    elsewhere: Elsewhere | None = None


@dataclass(frozen=True)
class FrictionCurve:
    """Friction of a joint that bends with speed, at three speeds.

    Attributes:
        of: the joint, or a motor that turns several.
        unit: of the torques.
        speed_unit: of the speeds.
        known_to: highest speed of the logs, up to which friction is known.
        speeds: at which friction is stated, the last one ``known_to``.
        model: friction in the original model.
        torque: the identified friction.
        errors: standard errors of the identified friction.
    """

    of: str
    unit: str
    speed_unit: str
    known_to: float
    speeds: tuple[float, ...]
    model: tuple[float, ...]
    torque: tuple[float, ...]
    errors: tuple[float, ...]


@dataclass(frozen=True)
class ModelFile(ModelErrors):
    """What is said of a written model beside its numbers: its held-out error first of all.

    Its numbers are the rows with the source ``FILE`` and the links ``Identification.thetas``.

    Attributes:
        others: errors on each of the other logs, held out as a whole.
        gravity: (3,) in the model's world frame [m/s^2]; None where the file keeps its own.
        kept: names of what the file keeps ("friction", "gravity", "other links").
        motors: those that turn several joints; params.json has their numbers as rows.
        curved: the file beside it whose friction bends with speed; None where no joint's does.
        elsewhere: errors to expect on other motions; None where nothing is promised.
    """

    others: tuple[ModelErrors, ...] = ()
    gravity: Array | None = None
    kept: tuple[str, ...] = ()
    motors: tuple[Coupling, ...] = field(default=(), compare=False)
    curved: CurvedFile | None = None
    elsewhere: Elsewhere | None = None


def needs_mjcf(rows: Iterable[Quantity], motors: Sequence[Coupling]) -> bool:
    """Return whether a URDF, as MuJoCo reads it, cannot hold all rows of a written model.

    ``motors`` are those that turn several joints.
    """
    return bool(motors) or any((r.name, r.source) == (ROTOR.name, FILE) for r in rows)


@dataclass(frozen=True)
class Payload(BodyEstimate):
    """A payload that the arm carries in some recordings and not in others, in the FLANGE frame.

    Attributes:
        flange: the frame in which the payload is stated.
        recordings: "empty" and "loaded" to the names of the recordings.
        known_mass: the payload's weight as the user states it [kg]; None where it is unknown.
    """

    flange: records.Flange = records.Flange("terminal body", np.eye(3), np.zeros(3))
    recordings: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    known_mass: float | None = None


@dataclass(frozen=True)
class Identification:
    """What was identified: all that files, console, report and Python programs read of it.

    The functions of Python return it as ``api.results.Result``, with what is done with it: to save
    and to print it is the work of layers that read this record, so that it has no such methods.

    Attributes:
        question: ``LINK`` or ``PAYLOAD``.
        robot: the arm, as its model describes it.
        quality: what the equations determine, and how well they are fitted.
        torques: "chain" or "terminal": the joints whose torques were fitted.
        data: where the data comes from.
        thetas: (n, 10) parameters of the links in the written model, as in ``RobotModel.links``,
            without a payload; zero without mass.
        quantities: every identified number, once, and every number of the written file: of bodies,
            joints, motors that turn several joints (``joint_5+joint_6``), sensors and recordings.
        remarks: what the user should know; the verdict follows from the first of the highest level.
        total: the terminal link with all bodies that move with it, a payload too; without errors
            where they are not known.
        links: name of the body to every link with mass, base to terminal; empty of the model's own
            simulation.
        standard_errors: parameter name to standard error of all causes together, in the parameter's
            unit. "m" to "Izz" are of the terminal link, or the payload; "m(link3)" of another link;
            "coulomb[joint6]" of a joint's friction. All others are nuisances, allowed for because
            they make other errors larger: friction beyond the terms, torque scales
            ("scale[joint6]"), encoder zeros, tilt and delay. It is infinite where the data does not
            determine the parameter. Empty for a simulation of the model itself.
        file: what is said of the written model; None where only the terminal link or the payload is
            written into the original.
        curves: friction of the joints and motors whose friction bends.
        tops: joint or motor to the speed at which friction that bends is flat [rad/s or m/s].
        payload: None of the question ``LINK``.
        validation: errors of the fit in predicting torques: of held-out stretches of its logs
            first, then of other logs.
        friction_model: name of the friction model, or "per joint".
        cutoff: cut-off of the low-pass [Hz]; None of a simulation.
        link_scales: "mass", "centre_of_mass" and "inertia" to the factor by which the prior
            standard deviation of the other links was widened.
        checkpoints: motion on which a written model has to reproduce the predicted torque.
        traces: computes the measured and predicted torques that a report draws.
    """

    question: str
    robot: records.RobotModel
    quality: records.FitQuality
    torques: str
    data: records.DataOrigin
    total: BodyEstimate
    thetas: Array
    quantities: tuple[Quantity, ...] = ()
    remarks: tuple[Remark, ...] = ()
    links: Mapping[str, BodyEstimate] = field(default_factory=dict)
    standard_errors: Mapping[str, float] = field(default_factory=dict)
    file: ModelFile | None = None
    curves: tuple[FrictionCurve, ...] = ()
    tops: Mapping[str, float] = field(default_factory=dict)
    payload: Payload | None = None
    validation: tuple[Validation, ...] = ()
    friction_model: str | None = None
    cutoff: float | None = None
    link_scales: Mapping[str, float] = field(default_factory=dict)
    checkpoints: Motion | None = None
    traces: Callable[[], Traces] | None = None

    @property
    def verdict(self) -> Verdict:
        """The verdict of the first remark of the highest level that has one; else ``OK``."""
        for level in Level:
            for remark in self.remarks:
                if remark.level is level and remark.about in Verdict.__members__:
                    return Verdict[remark.about]
        return Verdict.OK

    def quantity(self, name: str, of: str, source: str = "") -> Quantity | None:
        """Return a number by its name and what has it; None where there is none.

        It is the identified number, and with the source ``FILE`` or ``CURVED`` that of a written
        model.
        """
        for row in self.quantities:
            written = row.source if row.source in (FILE, CURVED) else ""
            if (row.name, row.of, written) == (name, of, source):
                return row
        return None

    @property
    def model_kind(self) -> str:
        """Format of the written model, "mjcf" or "urdf".

        It is an MJCF where MuJoCo alone would not load a URDF, or a URDF lacks identified numbers.
        """
        is_mjcf = needs_mjcf(self.quantities, self.file.motors if self.file else ())
        return "mjcf" if is_mjcf or self.robot.lacks_meshes else self.robot.kind

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
        """The payload; without one, the terminal link with all bodies that move with it."""
        return self.payload or self.total

    @property
    def failure(self) -> str | None:
        """Why the result must not be used; None where it may."""
        refusals = [each for each in self.remarks if each.level is Level.REFUSES]
        if not refusals:
            return None
        texts = dict.fromkeys(each.text for each in refusals)
        return "; ".join(filter(None, (*texts, refusals[0].remedy)))


@dataclass(frozen=True)
class ModelTarget:
    """Where a model is written to, and what is needed for it.

    Attributes:
        files: receives the draft.
        path: final path of the file, or folder of several.
        checkpoints: motion on which the written model must reproduce the predicted torque.
        mesh_dir: the user's mesh folder; None where the model's own paths hold.
    """

    files: AtomicFiles
    path: Path
    checkpoints: Motion
    mesh_dir: Path | None = None
