"""Information of logs about an arm as a record of bounded size that adds: many logs, many machines.

Triangles of equations add, and so do the sums behind the standard errors; options that would depend
on all logs at once have to be stated. Two rounds give the estimate of one process: in the first,
columns that depend on the parameters are those of the model, in the second those of the first
round's estimate, whose residuals also give the autocorrelation of torque noise.

Shapes: n joints of the chain, "joints" those with equations; p parameters (``Columns.names``).
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.least_squares import combine
from robot_sysid.estimation.algebra.uncertainty import (
    JointResiduals,
    autocorrelation_time,
)
from robot_sysid.estimation.answer import Answer
from robot_sysid.estimation.choices import (
    CANDIDATES,
    choose,
    columns_of,
    couplings_of,
    select_couplings,
)
from robot_sysid.estimation.columns import Point
from robot_sysid.estimation.dataset import (
    Dataset,
    DecimatedSamples,
    motion_signals,
    squared_torque,
)
from robot_sysid.estimation.errors import (
    filtering_bias,
    fit_errors,
    residuals_to_add,
    residuals_within,
)
from robot_sysid.estimation.file_fit import fit_file
from robot_sysid.estimation.fit import Evidence, Fit, Fitter, evidence
from robot_sysid.estimation.held_out import held_out_validation, validate_rows
from robot_sysid.estimation.identify import Piece, low_pass_recordings
from robot_sysid.estimation.question import (
    CHOSEN,
    FILE_GRAVITY,
    Choice,
    EstimationOptions,
    Question,
)
from robot_sysid.estimation.trust import missed_friction
from robot_sysid.records import (
    Array,
    DataOrigin,
    Measurement,
    Motion,
    RobotModel,
    Source,
)
from robot_sysid.results.verification import CHECKPOINTS
from robot_sysid.signals.repetition import RowSample, sample_rows

MOST_NOTES = 20
"""Largest number of notes that a record keeps."""


@dataclass(frozen=True, repr=False)
class CommonSettings:
    """Settings that are equal in all records that are added.

    Attributes:
        model: hash of the model's files.
        joint: name of the terminal joint.
        around: hash of the first round's sum, at whose estimate the equations are linearised; "" in
            the first round.
        estimation: all options of the estimate.
    """

    model: str
    joint: str
    around: str
    estimation: EstimationOptions

    def differences(self, other: CommonSettings) -> list[str]:
        """Return a phrase for each setting that differs from the other record's."""
        labels = {
            "model": "the model",
            "joint": "the terminal joint",
            "around": "the first round",
        }
        ours = {**vars(self), **vars(self.estimation)}
        theirs = {**vars(other), **vars(other.estimation)}
        phrases = []
        for name in (*labels, *vars(self.estimation)):
            if ours[name] != theirs[name]:
                phrase = f"{name} ({ours[name]} and {theirs[name]})"
                phrases.append(labels.get(name, phrase))
        return phrases


@dataclass(frozen=True, eq=False)
class LogInformation:
    """Information of any number of logs of any length; ``+`` combines two records.

    Attributes:
        settled: settings that are equal in all records that are added.
        evidence: triangles of all joints' equations, in the blocks of cross-validation.
        residuals: per joint, sums over lags of the first round's residuals; empty in that round.
        pull: (joints, p) sums of ``errors.filtering_bias``, for the error due to the low-pass of
            positions.
        rows: a random sample of the motion of the rows.
        torque: (n,) sum of squares of all measured torque [N^2 m^2].
        samples: number of samples of each joint's torque.
        duration: duration of all logs together [s].
        logs: number of logs.
        acceleration_error: largest expected error of a log's acceleration, as a share of the
            acceleration (``signals.process``).
        notes: the first ``MOST_NOTES`` notes of the logs, one sentence each.
    """

    settled: CommonSettings
    evidence: Evidence
    residuals: tuple[JointResiduals, ...]
    pull: Array
    rows: RowSample
    torque: Array
    samples: int
    duration: float
    logs: int
    acceleration_error: float
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        logs = "1 log" if self.logs == 1 else f"{self.logs} logs"
        rows = f"{self.samples} samples of joints up to {self.settled.joint}"
        return f"<LogInformation of {logs}: {rows} in {self.duration:g} s>"

    def __add__(self, other: LogInformation) -> LogInformation:
        """Return the information of both records together.

        Raises:
            InputError: they were made with different models or options.
        """
        if not isinstance(other, LogInformation):
            return NotImplemented
        differing = self.settled.differences(other.settled)
        if differing:
            raise InputError(
                f"information was settled differently and does not add: {', '.join(differing)}; "
                "make all of it with the same model, options and first round"
            )
        blocks = map(combine, zip(self.evidence.blocks, other.evidence.blocks))
        squares = self.evidence.squared_torque + other.evidence.squared_torque
        torque = self.torque + other.torque
        samples = self.samples + other.samples
        root_mean_square = np.sqrt(torque / samples)
        return LogInformation(
            settled=self.settled,
            evidence=Evidence(tuple(blocks), squares, root_mean_square),
            residuals=tuple(map(add, self.residuals, other.residuals)),
            pull=self.pull + other.pull,
            rows=self.rows + other.rows,
            torque=torque,
            samples=samples,
            duration=self.duration + other.duration,
            logs=self.logs + other.logs,
            acceleration_error=max(self.acceleration_error, other.acceleration_error),
            notes=tuple(dict.fromkeys((*self.notes, *other.notes)))[:MOST_NOTES],
        )

    def __radd__(self, other: object) -> LogInformation:
        """Return this record for 0 + record, with which ``sum`` starts."""
        return self if other == 0 else NotImplemented

    @property
    def origin(self) -> DataOrigin:
        """Where the data comes from."""
        detail = f"{self.logs} log{'s' if self.logs > 1 else ''}, added"
        return DataOrigin(
            Source.LOG, detail, self.duration, self.samples / self.duration
        )

    @property
    def checkpoints(self) -> Motion:
        """Motion at a sample of the rows; its time is the number of each row, in no unit."""
        return self.rows.motion(CHECKPOINTS)

    def digest(self) -> str:
        """Return the SHA-256 hash of all equations, in hexadecimal digits."""
        triangles = [joint.triangle.tobytes() for joint in self.evidence.total.joints]
        return hashlib.sha256(b"".join(triangles)).hexdigest()


def settled_options(options: EstimationOptions) -> EstimationOptions:
    """Return options under which information adds, with a stated friction model.

    It is the default model where the options state none.

    Raises:
        InputError: an option would be chosen from the data, or needs every sample of it.
    """
    if options.cutoff is None:
        raise InputError(
            "information of several logs adds only where all went through one low-pass; give "
            "cutoff=HZ, such as identify(...).result.cutoff of one of them"
        )
    for name, value, remedy in (
        (
            "friction_model",
            CHOSEN,
            "name one, such as the default coulomb-viscous-offset-armature",
        ),
        ("delay", "auto", "put a delay right in the logs' time stamps"),
        ("tilt", "auto", "turn the gravity of the model"),
    ):
        if getattr(options, name) == value:
            raise InputError(
                f"{name}={value!r} depends on all logs together and does not add: {remedy}"
            )
    named = options.friction is not None
    return options if named else replace(options, friction_model=CANDIDATES[0])


class _Fixed(Fitter):
    """A fitter of added information around one point; it has no rows to linearise anew.

    It selects and solves like any fitter, but ignores the points at which callers want to start.
    The autocorrelation of noise, which other fitters take from rows, follows from the record.

    Args:
        robot: the arm.
        information: the sum of a round.
        point: gives gravity and the speeds of friction terms, to which increments are added; None
            for those of the model. The equations are those of ``information`` in any case.
    """

    def __init__(
        self, robot: RobotModel, information: LogInformation, point: Point | None = None
    ) -> None:
        options = information.settled.estimation
        columns = columns_of(robot, (), options)
        super().__init__(columns, information.evidence.torque)
        self._information = information
        self._point = point or columns.start()
        if information.residuals:
            correlation_times = []
            for joint in information.residuals:
                time = autocorrelation_time(joint.products, joint.count)
                correlation_times.append(time)
            self.residual_correlation = np.array(correlation_times)

    def around(self, point: Point) -> tuple[Evidence, tuple[DecimatedSamples, ...]]:
        """Return (evidence of all logs around the fitter's own point, no rows)."""
        return self._information.evidence, ()

    def correlation_factors(self, fit: Fit) -> Array:
        """Return how many rows of each joint (joints,) count as one independent row.

        The number follows from the residuals of the first round; in that round it is one.
        """
        return fit.residual_correlation

    def fit(
        self,
        question: Question,
        choice: Choice,
        point: Point | None = None,
        rounds: int = 1,
    ) -> Fit:
        """Return the fit around the fitter's own point; ``point`` and ``rounds`` have no effect."""
        return self.solve_around(self._point, question, choice)


def log_information(
    robot: RobotModel,
    logs: Sequence[Measurement],
    options: EstimationOptions,
    around: LogInformation | None = None,
    notes: Sequence[str] = (),
) -> LogInformation:
    """Return the information of a log about the arm, linearised around the first round's estimate.

    In the first round, it is linearised around the model's own values.

    Args:
        robot: the arm with its model.
        logs: whole logs, or the pieces of one, each filtered on its own; they count as one log.
        options: options that ``settled_options`` returned.
        around: the sum of a first round over all logs; None in that round.
        notes: sentences to keep.

    Raises:
        InputError: a log does not fit the arm, or the first round was settled differently.
    """
    settled = CommonSettings(robot.sha256, robot.terminal_joint, "", options)
    if around is not None:
        differences = settled.differences(replace(around.settled, around=""))
        if differences:
            raise InputError(
                f"the first round was settled differently: {', '.join(differences)}"
            )
        settled = replace(settled, around=around.digest())
    pieces = [Piece("", log) for log in logs]
    datasets, messages = low_pass_recordings(robot, pieces, options)
    columns = columns_of(robot, datasets, options)
    point = columns.start()
    if around is not None:
        first = _fit_sum(robot, around)
        point = replace(point, values=first.values)
    samples = columns.samples(point)
    residuals: tuple[JointResiduals, ...] = ()
    if around is not None:
        log_sums = [residuals_to_add(first, log_samples) for log_samples in samples]
        residuals = tuple(reduce(add, joint_sums) for joint_sums in zip(*log_sums))
    row_samples = []
    for dataset in datasets:
        row_samples.append(_sample_rows(dataset))
    signals = motion_signals(datasets)
    torque, count = squared_torque(datasets)
    return LogInformation(
        settled=settled,
        evidence=evidence(samples, np.sqrt(torque / count)),
        residuals=residuals,
        pull=filtering_bias(columns, point, samples),
        rows=reduce(add, row_samples),
        torque=torque,
        samples=count,
        duration=sum(float(log.time[-1] - log.time[0]) for log in logs),
        logs=1,
        acceleration_error=max(log.acceleration_error for log in signals),
        notes=tuple(dict.fromkeys((*notes, *messages)))[:MOST_NOTES],
    )


def _fit_sum(robot: RobotModel, information: LogInformation) -> Fit:
    """Return the fit to the sum of all logs, around the point at which their equations were made.

    Couplings and choices (``choose``) are made from the sum, too.
    """
    options = information.settled.estimation
    fitter = _Fixed(robot, information)
    question = Question(options)
    couplings, offered = couplings_of(robot, options)
    if offered:
        couplings = select_couplings(fitter, question, options.friction, offered)
    choice, *_ = choose(fitter, question, options.friction, couplings)
    return fitter.fit(question, choice)


def _sample_rows(dataset: Dataset) -> RowSample:
    """Return a random sample of a recording's rows.

    The seed is a hash of the recorded signals, so that equal recordings give equal samples. The
    recording must not be one of poses at rest, which has no signals.
    """
    assert dataset.signals is not None
    content = dataset.signals.q.tobytes() + dataset.signals.tau.tobytes()
    seed = int.from_bytes(hashlib.sha256(content).digest()[:8], "little")
    return sample_rows(dataset.motion, seed)


def answer_from(
    robot: RobotModel,
    information: LogInformation,
    validation: LogInformation | None = None,
) -> Answer:
    """Return the estimate of an arm from the sum of a second round.

    Args:
        robot: the arm with its model.
        information: the sum of a second round.
        validation: information of other logs with the same settings, on which to test the estimate;
            None for no test.

    Raises:
        InputError: this is a first round, or the settings of model or options differ.
    """
    settled = replace(
        information.settled, model=robot.sha256, joint=robot.terminal_joint
    )
    differences = []
    if validation is not None:
        differences += settled.differences(validation.settled)
    differences += settled.differences(information.settled)
    if differences:
        raise InputError(
            f"this information does not fit: {', '.join(dict.fromkeys(differences))} differ"
        )
    if not information.settled.around:
        raise InputError(
            "this is the sum of a first round, which does not know its errors yet; make the "
            "information of all logs again with around= this sum, and identify from their sum"
        )
    fit = _fit_sum(robot, information)
    options = information.settled.estimation
    sums = residuals_within(fit, information.residuals)
    residuals = list(map(JointResiduals.limit_lags, sums))
    errors = fit_errors(fit, residuals, information.pull)
    fixed = _Fixed(robot, information, fit.point)
    file = fit_file(fixed, options, (FILE_GRAVITY,), fit, errors, pull=information.pull)
    tests = []
    if validation is not None:
        source = f"{validation.origin.detail}, not fitted"
        tests.append(validate_rows(fit, errors, validation.evidence, source))
    return Answer(
        fit,
        errors,
        held_out_validation(fit),
        file=file,
        tests=tuple(tests),
        acceleration_error=information.acceleration_error,
        notes=information.notes,
        missed_friction=missed_friction(fit),
    )
