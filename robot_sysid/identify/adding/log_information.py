"""What one log says of a link, as a record of bounded size that adds: many logs, many machines.

The triangles of all joints' equations add (``estimation.information``), and so do the sums behind
the standard errors; what would depend on all logs at once is settled beforehand. Two rounds give
what ``identify.fit`` finds in one process: in the first the columns of encoder zeros, torque scales
and tilt are those of the model's links, in the second those of the first round's estimate, whose
residuals also say how torque noise is correlated in time.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import reduce
from itertools import chain
from operator import add

import numpy as np

from robot_sysid.dynamics.friction import FrictionModel, friction_model
from robot_sysid.dynamics.gravity import gravity
from robot_sysid.errors import InputError
from robot_sysid.estimation.autocorrelation import JointResiduals, collect_residuals
from robot_sysid.estimation.cross_validation import validate
from robot_sysid.estimation.information import combined
from robot_sysid.estimation.least_squares import no_clip
from robot_sysid.estimation.nuisances import NuisanceGroup, misfits, with_prior
from robot_sysid.estimation.options import CHOSEN, EstimationOptions
from robot_sysid.estimation.uncertainty import joint_space
from robot_sysid.identify.alignment import Aligner, Alignment, widened_estimate
from robot_sysid.identify.fit import MeasuredFit, one_way
from robot_sysid.identify.judgement.filtering import with_filtering
from robot_sysid.identify.judgement.signs import compared_with_model
from robot_sysid.identify.nuisances import nuisance_groups
from robot_sysid.identify.samples import DecimatedSamples, JoinedSamples
from robot_sysid.identify.simulated import CHECKPOINTS
from robot_sysid.records import (
    Array,
    DataOrigin,
    Estimate,
    Measurement,
    RobotModel,
    Source,
    SquareRootInformation,
    Validation,
)
from robot_sysid.records.traces import Traces
from robot_sysid.signals.process import ProcessedSignals, process
from robot_sysid.signals.row_sample import RowSample, sampled

MOST_NOTES = 20
Fitted = tuple[Estimate, tuple[NuisanceGroup, ...], Array]


@dataclass(frozen=True)
class Settled:
    """What has to be the same in all that is added.

    Attributes:
        model: hash of the model's files.
        joint: the terminal joint.
        around: hash of the first round's sum; "" in the first round itself.
        estimation: cut-off, friction model and all other options of the estimate.
    """

    model: str
    joint: str
    around: str
    estimation: EstimationOptions

    def differences(self, other: Settled) -> list[str]:
        """Return what is not the same, in words."""
        words = {"model": "the model", "joint": "the terminal joint", "around": "the first round"}
        found = [
            said for name, said in words.items() if getattr(self, name) != getattr(other, name)
        ]
        for each in fields(EstimationOptions):
            ours, theirs = (getattr(s.estimation, each.name) for s in (self, other))
            found += [] if ours == theirs else [f"{each.name} ({ours} and {theirs})"]
        return found


@dataclass(frozen=True, eq=False)
class LogInformation:
    """What logs say, whatever their number and length; ``+`` puts two together.

    Attributes:
        settled: what has to be the same in all that is added.
        information: triangles of all joints' equations.
        residuals: per joint, how the first round's residuals are correlated; empty in that round.
        pull: (joints, p) what the low-pass may move the estimate by, see ``judgement.filtering``.
        rows: some of the rows.
        squared_torque: (joints,) of the rows that are used [N^2 m^2].
        torque: (n,) sum of squares of all measured torque [N^2 m^2].
        samples: how many samples that was.
        duration: of all logs [s].
        logs: their number.
        acceleration_error: the largest, see ``signals.process``.
        notes: one sentence each, the first few of them.
    """

    settled: Settled
    information: SquareRootInformation
    residuals: tuple[JointResiduals, ...]
    pull: Array
    rows: RowSample
    squared_torque: Array
    torque: Array
    samples: int
    duration: float
    logs: int
    acceleration_error: float
    notes: tuple[str, ...]

    def __add__(self, other: LogInformation) -> LogInformation:
        """Return what both say together.

        Raises:
            InputError: they were made with different models or options.
        """
        if not isinstance(other, LogInformation):
            return NotImplemented
        differ = self.settled.differences(other.settled)
        if differ:
            raise InputError(
                f"information was settled differently and does not add: {', '.join(differ)}; make "
                "all of it with the same model, options and first round"
            )
        pairs = zip(self.residuals, other.residuals)
        summed = ("pull", "rows", "squared_torque", "torque", "samples", "duration", "logs")
        return LogInformation(
            settled=self.settled,
            information=combined([self.information, other.information]),
            residuals=tuple(ours + theirs for ours, theirs in pairs),
            acceleration_error=max(self.acceleration_error, other.acceleration_error),
            notes=tuple(dict.fromkeys((*self.notes, *other.notes)))[:MOST_NOTES],
            **{name: getattr(self, name) + getattr(other, name) for name in summed},
        )

    def __radd__(self, other: object) -> LogInformation:
        """Return this: ``sum`` starts with 0."""
        return self if other == 0 else NotImplemented

    @property
    def is_first_round(self) -> bool:
        """Whether a second round around it is still to come."""
        return not self.settled.around

    @property
    def origin(self) -> DataOrigin:
        """Where the data comes from."""
        many = f"{self.logs} log{'s' if self.logs > 1 else ''}, added"
        return DataOrigin(Source.LOG, many, self.duration, self.samples / self.duration)

    def digest(self) -> str:
        """Return a hash of the equations."""
        parts = [joint.triangle.tobytes() for joint in self.information.joints]
        return hashlib.sha256(b"".join(parts)).hexdigest()


def settled_options(options: EstimationOptions) -> EstimationOptions:
    """Return the options with nothing held out.

    Raises:
        InputError: an option would be chosen from the data, or needs every sample of it.
    """
    if options.cutoff is None:
        raise InputError(
            "information of several logs adds only where all went through one low-pass; give "
            "cutoff=HZ, such as identify(...).identification.cutoff of one of them"
        )
    for name, value, why in (
        ("friction_model", CHOSEN, "name one, such as identify(...).identification.friction_model"),
        ("delay", "auto", "put a delay right in the logs' time stamps"),
        ("tilt", "auto", "turn the gravity of the model"),
        ("method", "robust", "it needs every sample; take wls or ols"),
    ):
        if getattr(options, name) == value:
            raise InputError(
                f"{name}={value!r} depends on all logs together and does not add: {why}"
            )
    return replace(options, validate=0.0)


def log_information(
    robot: RobotModel,
    logs: Sequence[Measurement],
    options: EstimationOptions,
    around: LogInformation | None = None,
    notes: Sequence[str] = (),
) -> LogInformation:
    """Return what some logs say.

    Args:
        robot: the arm.
        logs: whole logs, or the pieces of one, each filtered on its own.
        options: of ``settled_options``.
        around: the sum of a first round over all logs; None in that round.
        notes: sentences to keep.

    Raises:
        InputError: a log does not fit the arm, or the first round was settled differently.
    """
    settled = _settled(robot, options, around)
    band = options.velocity_deadband
    signals = [process(log, robot.joint_names, options.cutoff, band) for log in logs]
    aligner = Aligner(robot, options, _friction(options), signals)
    fitted = None if around is None else _fitted(robot, around)
    values = None if fitted is None else fitted[0].values
    level = Alignment(0.0, gravity(robot))
    parts = aligner.samples(level, values)
    rows, residuals = JoinedSamples(parts), []
    if around is not None and fitted is not None:
        residuals = _residuals(around.information, fitted, parts)
    known = aligner.prior(rows.names) if values is None else values
    picked = [
        sampled(log.decimated_motion(), _left(part, known), _number(log))
        for log, part in zip(signals, parts)
    ]
    said = (*notes, *chain.from_iterable(_notes(robot, options, log) for log in signals))
    return LogInformation(
        settled=settled,
        information=rows.information(),
        residuals=tuple(residuals),
        pull=aligner.filtering_pull(level, parts, known),
        rows=reduce(add, picked),
        squared_torque=rows.squared_torque(),
        torque=np.sum([np.sum(log.tau**2, axis=0) for log in signals], axis=0),
        samples=sum(len(log) for log in signals),
        duration=sum(float(log.time[-1] - log.time[0]) for log in logs),
        logs=1,
        acceleration_error=max(log.acceleration_error for log in signals),
        notes=tuple(dict.fromkeys(said))[:MOST_NOTES],
    )


def _settled(
    robot: RobotModel, options: EstimationOptions, around: LogInformation | None
) -> Settled:
    first = Settled(robot.sha256, robot.terminal_joint, "", options)
    if around is None:
        return first
    differ = first.differences(replace(around.settled, around=""))
    if differ:
        raise InputError(f"the first round was settled differently: {', '.join(differ)}")
    return replace(first, around=around.digest())


def fit_from(
    robot: RobotModel, found: LogInformation, validation: LogInformation | None = None
) -> MeasuredFit:
    """Identify the terminal link from the sum of a second round.

    Args:
        robot: the arm.
        found: of the logs that are fitted.
        validation: of logs that only test the result, made like ``found``.

    Raises:
        InputError: this is a first round, or something was made with another model or options.
    """
    differ = replace(found.settled, model=robot.sha256, joint=robot.terminal_joint)
    said = differ.differences(found.settled if validation is None else validation.settled)
    said += differ.differences(found.settled)
    if said:
        raise InputError(f"this information does not fit: {', '.join(dict.fromkeys(said))} differ")
    if found.is_first_round:
        raise InputError(
            "this is the sum of a first round, which does not know its errors yet; make the "
            "information of all logs again with around= this sum, and identify from their sum"
        )
    estimate, groups, noise = _fitted(robot, found)
    estimate = with_filtering(estimate, found.information, groups, noise, found.pull)
    names = robot.joint_names
    torque = dict(zip(names, _torque(found).tolist()))
    return MeasuredFit(
        estimate,
        _friction(found.settled.estimation),
        Alignment(0.0, gravity(robot)),
        misfits(found.information, noise, groups),
        None if validation is None else _validated(validation, estimate),
        float(found.settled.estimation.cutoff or 0.0),
        torque,
        found.acceleration_error,
        found.rows.motion(CHECKPOINTS),
        _no_traces,
        found.notes,
    )


def _fitted(robot: RobotModel, found: LogInformation) -> Fitted:
    options = found.settled.estimation
    groups = nuisance_groups(robot, options, _friction(options), _torque(found))
    prior = Aligner(robot, options, _friction(options), ()).prior(found.information.names)
    each = [residuals.shortened() for residuals in found.residuals]

    def inflation(values: Array) -> Array:
        return found.rows.inflation() if each else np.ones(len(found.information.joints))

    return widened_estimate(
        found.information, prior, options, groups, inflation, None, each or None
    )


def _residuals(
    information: SquareRootInformation, fitted: Fitted, parts: Sequence[DecimatedSamples]
) -> list[JointResiduals]:
    """Return what the first round's estimate leaves unexplained in all parts of a log."""
    estimate, groups, noise = fitted
    weights = 1.0 / noise
    root = joint_space(with_prior(information, groups), weights).inverse_root()
    given = estimate.values, no_clip(information), root, weights
    each = [collect_residuals(information, part, *given, to_add=True) for part in parts]
    return [reduce(add, same) for same in zip(*each)]


def _notes(
    robot: RobotModel, options: EstimationOptions, signals: ProcessedSignals
) -> Iterator[str]:
    yield from signals.notes
    yield from compared_with_model(robot, signals)
    yield from one_way(robot, _friction(options), signals)


def _left(part: DecimatedSamples, values: Array) -> Array:
    """Return (K, joints) what values (p,) leave unexplained; NaN in rows that are not used."""
    pairs = zip(part, part.columns)
    return np.stack([tau - rows @ values[columns] for (_, rows, tau), columns in pairs], axis=1)


def _validated(found: LogInformation, estimate: Estimate) -> Validation:
    source = f"{found.origin.detail}, not fitted"
    return validate(found.information, estimate.values, source, found.squared_torque)


def _torque(found: LogInformation) -> Array:
    """Return (n,) root mean square of each joint's measured torque [N m]."""
    return np.asarray(np.sqrt(found.torque / found.samples))


def _friction(options: EstimationOptions) -> FrictionModel:
    return friction_model(options.measured_friction)


def _number(signals: ProcessedSignals) -> int:
    """Return a number that hardly another log has."""
    content = hashlib.sha256(signals.q.tobytes() + signals.tau.tobytes()).digest()
    return int.from_bytes(content[:8], "little")


def _no_traces() -> Traces:
    raise InputError(
        "added information holds no samples, so there are no torques to draw; identify one of the "
        "logs to see them"
    )
