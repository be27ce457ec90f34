"""The result of an identification, of a link or a payload: read by files, console and report.

A body has ten inertial parameters in the order of ``PARAMETER_NAMES``: mass [kg], first moments
[kg m], inertia about its frame's origin [kg m^2]. The arm's chain has n joints, base to terminal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from robot_sysid import records
from robot_sysid.dynamics.friction import ROTOR, Coupling
from robot_sysid.records import Array, Errors, ModelErrors, Motion, Traces, Validation
from robot_sysid.records.file_access import MODEL_NAMES, AtomicFiles
from robot_sysid.records.messages import Level, Remark
from robot_sysid.records.quantities import (
    CURVED,
    FILE,
    BodyEstimate,
    FrictionCurve,
    Quantity,
)
from robot_sysid.results.verdicts import Verdict, verdict_of

LINK = "link"
"""Question for the inertia of the terminal link, and of every other link with it."""
PAYLOAD = "payload"
"""Question for the inertia of a payload, from recordings without and with it."""


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
        relative_error: to expect of a file from that log and those that there are.
    """

    plan: tuple[str, ...]
    relative_error: float


@dataclass(frozen=True)
class Elsewhere(Errors[MotionErrors]):
    """Torque errors to expect on motions that nobody recorded, all over the arm's range.

    They are root mean square over random motions, right within a factor of 1.5 in most cases.
    Offsets of torque sensors are counted where that makes an error larger.

    Attributes:
        speed: highest speed of these motions.
        speed_unit: its unit.
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
    at_log_speeds: MotionErrors
    log_speed: float
    faster: str = ""
    still: tuple[str, ...] = ()
    parts: tuple[ErrorPart, ...] = ()
    for_like_motions: bool = False
    next: NextMotion | None = None


@dataclass(frozen=True)
class ModelFile:
    """What is said of a written model beside its numbers: its torque errors first of all.

    Its numbers are the rows with the source ``FILE``, or ``CURVED`` where its friction bends with
    speed, and the links ``Identification.thetas``.

    Attributes:
        errors: on held-out data of the logs, then on each of the other logs as a whole.
        gravity: (3,) in the model's world frame [m/s^2]; None where the file keeps its own.
        kept: names of what the file keeps ("friction", "gravity", "other links").
        motors: those that turn several joints; params.json has their numbers as rows.
        curved: the file beside it whose friction bends with speed and which has the same links,
            gravity and motors; None where no joint's friction bends.
        elsewhere: errors to expect on other motions; None where nothing is promised.
    """

    errors: tuple[ModelErrors, ...]
    gravity: Array | None = None
    kept: tuple[str, ...] = ()
    motors: tuple[Coupling, ...] = field(default=(), compare=False)
    curved: ModelFile | None = None
    elsewhere: Elsewhere | None = None

    @property
    def held_out(self) -> ModelErrors:
        """Errors on held-out data of the logs."""
        return self.errors[0]

    @property
    def others(self) -> tuple[ModelErrors, ...]:
        """Errors on each of the other logs."""
        return self.errors[1:]

    @property
    def before(self) -> Validation:
        """Held-out error of the original model, each joint's sensor offset removed."""
        return self.held_out.before

    @property
    def after(self) -> Validation:
        """Held-out error of the written model, likewise."""
        return self.held_out.after

    @property
    def before_as_used(self) -> Validation:
        """Held-out error of the original model, offsets counted as errors: no file holds them."""
        return self.held_out.before_as_used

    @property
    def after_as_used(self) -> Validation:
        """Held-out error of the written model, likewise."""
        return self.held_out.after_as_used


CurvedFile = ModelFile
"""The file of ``ModelFile.curved``, by a name for annotations."""


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
        payload: None of an arm.
        validation: errors of the fit in predicting torques: of held-out stretches of its logs
            first, then of other logs.
        unshown_scales: what has a torque ("all joints together", or a joint) to the factor by which
            that may read too much or too little without the logs showing it.
        friction_model: name of the friction model, or "per joint".
        cutoff: lowest cut-off of the logs' low-passes [Hz]; None of a simulation.
        link_scales: "mass", "centre_of_mass" and "inertia" to the factor by which the prior
            standard deviation of the other links was widened.
        checkpoints: motion on which a written model has to reproduce the predicted torque.
        traces: computes the measured and predicted torques over time, at every sample of the log,
            or with ``every_sample=False`` at as many instants as figures need.
    """

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
    unshown_scales: Mapping[str, float] = field(default_factory=dict)
    friction_model: str | None = None
    cutoff: float | None = None
    link_scales: Mapping[str, float] = field(default_factory=dict)
    checkpoints: Motion | None = None
    traces: Callable[..., Traces] | None = None

    @property
    def question(self) -> str:
        """``LINK`` or ``PAYLOAD``: what was asked for."""
        return LINK if self.payload is None else PAYLOAD

    @property
    def verdict(self) -> Verdict:
        """The verdict of the first remark of the highest level that has one; else ``OK``."""
        return verdict_of(self.remarks)

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
    def needs_mjcf(self) -> bool:
        """Whether a URDF lacks identified numbers."""
        return needs_mjcf(self.quantities, self.file.motors if self.file else ())

    @property
    def model_kind(self) -> str:
        """Format of the written model, "mjcf" or "urdf".

        It is an MJCF where MuJoCo alone would not load a URDF, or a URDF lacks identified numbers.
        """
        is_mjcf = self.needs_mjcf or self.robot.lacks_meshes
        return "mjcf" if is_mjcf else self.robot.kind

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
