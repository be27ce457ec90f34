"""What logs say of an arm as a record of bounded size that adds: many logs, many machines.

Triangles of equations add, and so do the sums behind the standard errors; what would depend on all
logs at once is settled beforehand. Two rounds give what one process finds: in the first, columns
that depend on what is known are those of the model, in the second those of the first round's
estimate, whose residuals also say how torque noise is correlated in time.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.autocorrelation import JointResiduals, memory_of
from robot_sysid.estimation.algebra.information import combined
from robot_sysid.estimation.algebra.options import CHOSEN, EstimationOptions
from robot_sysid.estimation.answer import Answer
from robot_sysid.estimation.choices import CANDIDATES, choose
from robot_sysid.estimation.columns import Columns, Point
from robot_sysid.estimation.couplings import couplings_of, select_couplings
from robot_sysid.estimation.dataset import Dataset, DecimatedSamples
from robot_sysid.estimation.errors import (
    filtering_bias,
    fit_errors,
    residuals_to_add,
    residuals_within,
)
from robot_sysid.estimation.file_fit import fit_file
from robot_sysid.estimation.fit import Evidence, Fit, Fitter, evidence, solve
from robot_sysid.estimation.identify import Piece, filtered, predicted
from robot_sysid.estimation.recordings import parts_compared
from robot_sysid.estimation.unknowns import FILE_GRAVITY, Choice, Question
from robot_sysid.records import (
    Array,
    DataOrigin,
    Measurement,
    Motion,
    RobotModel,
    Source,
    Validation,
)
from robot_sysid.results.model import CHECKPOINTS
from robot_sysid.signals.repetition import RowSample, sampled

MOST_NOTES = 20


@dataclass(frozen=True)
class Settled:
    """What has to be the same in all that is added: the hash of the model's files, the terminal
    joint, the hash of the first round's sum that all is made ``around`` ("" in that round itself),
    and all options of the estimate.
    """

    model: str
    joint: str
    around: str
    estimation: EstimationOptions

    def differences(self, other: Settled) -> list[str]:
        """Return what is not the same, in words."""
        words = {"model": "the model", "joint": "the terminal joint", "around": "the first round"}
        ours, theirs = (dict(vars(each.estimation), **vars(each)) for each in (self, other))
        return [
            words.get(name, f"{name} ({ours[name]} and {theirs[name]})")
            for name in (*words, *vars(self.estimation))
            if ours[name] != theirs[name]
        ]


@dataclass(frozen=True, eq=False)
class LogInformation:
    """What logs say, whatever their number and length; ``+`` puts two together.

    Attributes:
        settled: what has to be the same in all that is added.
        evidence: triangles of all joints' equations, in blocks.
        residuals: per joint, how the first round's residuals are correlated; empty in that round.
        pull: (joints, p) what the low-pass may move the estimate by, see ``errors.filtering_bias``.
        rows: some of the rows.
        torque: (n,) sum of squares of all measured torque [N^2 m^2].
        samples: how many samples that was.
        duration: of all logs [s].
        logs: their number.
        acceleration_error: the largest, see ``signals.process``.
        notes: one sentence each, the first few of them.
    """

    settled: Settled
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
        summed = ("pull", "rows", "torque", "samples", "duration", "logs")
        both = {name: getattr(self, name) + getattr(other, name) for name in summed}
        pairs = zip(self.evidence.blocks, other.evidence.blocks)
        squares = self.evidence.squared_torque + other.evidence.squared_torque
        blocks = tuple(combined(pair) for pair in pairs)
        return LogInformation(
            settled=self.settled,
            evidence=Evidence(blocks, squares, np.sqrt(both["torque"] / both["samples"])),
            residuals=tuple(a + b for a, b in zip(self.residuals, other.residuals)),
            acceleration_error=max(self.acceleration_error, other.acceleration_error),
            notes=tuple(dict.fromkeys((*self.notes, *other.notes)))[:MOST_NOTES],
            **both,
        )

    def __radd__(self, other: object) -> LogInformation:
        """Return this: ``sum`` starts with 0."""
        return self if other == 0 else NotImplemented

    @property
    def origin(self) -> DataOrigin:
        """Where the data comes from."""
        many = f"{self.logs} log{'s' if self.logs > 1 else ''}, added"
        return DataOrigin(Source.LOG, many, self.duration, self.samples / self.duration)

    @property
    def checkpoints(self) -> Motion:
        """Some of the motion; its time only counts the rows."""
        return self.rows.motion(CHECKPOINTS)

    def digest(self) -> str:
        """Return a hash of the equations."""
        parts = [joint.triangle.tobytes() for joint in self.evidence.whole.joints]
        return hashlib.sha256(b"".join(parts)).hexdigest()


def settled_options(options: EstimationOptions) -> EstimationOptions:
    """Return the options, the friction model among them.

    Raises:
        InputError: an option would be chosen from the data, or needs every sample of it.
    """
    if options.cutoff is None:
        raise InputError(
            "information of several logs adds only where all went through one low-pass; give "
            "cutoff=HZ, such as identify(...).result.cutoff of one of them"
        )
    for name, value, why in (
        ("friction_model", CHOSEN, "name one, such as the default coulomb-viscous-offset-armature"),
        ("delay", "auto", "put a delay right in the logs' time stamps"),
        ("tilt", "auto", "turn the gravity of the model"),
    ):
        if getattr(options, name) == value:
            raise InputError(
                f"{name}={value!r} depends on all logs together and does not add: {why}"
            )
    named = options.friction is not None
    return options if named else replace(options, friction_model=CANDIDATES[0])


class _Fixed(Fitter):
    """A fitter of what is left of logs, whose rows were around a point, None for the model: it
    cannot make them anew.
    """

    def __init__(
        self, robot: RobotModel, found: LogInformation, point: Point | None = None
    ) -> None:
        options = found.settled.estimation
        columns = Columns(robot, (), options.torques, couplings_of(robot, options)[0])
        super().__init__(columns, found.evidence.torque)
        self._found, self._point = found, point or columns.start()

    def around(self, point: Point) -> tuple[Evidence, tuple[DecimatedSamples, ...]]:
        """Return what rows said, and none."""
        return self._found.evidence, ()

    def solve_around(self, point: Point, question: Question, choice: Choice) -> Fit:
        """Return the solution around the one point that there is."""
        residuals = self._found.residuals
        given = self.columns, question, choice, self._point, self._found.evidence
        if not residuals:
            return solve(*given)
        inflation = self._found.rows.inflation()
        return solve(*given, inflation=inflation, residual_memory=self._residual_memory())

    def noise_memory(self, fit: Fit) -> Array:
        """Return how many rows (joints,) of each joint count as one, by the first round."""
        return self._residual_memory()

    def _residual_memory(self) -> Array:
        residuals = self._found.residuals
        if not residuals:
            return np.ones(len(self.columns.joints))
        return np.array([memory_of(each.products, each.count) for each in residuals])

    def fit(
        self, question: Question, choice: Choice, point: Point | None = None, rounds: int = 1
    ) -> Fit:
        """Return the fit around the one point that there is."""
        return self.solve_around(self._point, question, choice)


def log_information(
    robot: RobotModel,
    logs: Sequence[Measurement],
    options: EstimationOptions,
    around: LogInformation | None = None,
    notes: Sequence[str] = (),
) -> LogInformation:
    """Return what some logs say.

    Args:
        logs: whole logs, or the pieces of one, each filtered on its own.
        options: of ``settled_options``.
        around: the sum of a first round over all logs; None in that round.
        notes: sentences to keep.

    Raises:
        InputError: a log does not fit the arm, or the first round was settled differently.
    """
    settled = Settled(robot.sha256, robot.terminal_joint, "", options)
    if around is not None:
        differ = settled.differences(replace(around.settled, around=""))
        if differ:
            raise InputError(f"the first round was settled differently: {', '.join(differ)}")
        settled = replace(settled, around=around.digest())
    datasets, said = filtered(robot, [Piece("", log) for log in logs], options)
    columns = Columns(robot, datasets, options.torques, couplings_of(robot, options)[0])
    first = None if around is None else _fitted(robot, around)
    point = columns.start() if first is None else replace(columns.start(), values=first.values)
    samples = columns.samples(point)
    torque = np.sum([np.sum(each.torque**2, axis=0) for each in datasets], axis=0)
    count = sum(len(each.torque) for each in datasets)
    pairs = list(zip(datasets, samples))
    residuals: tuple[JointResiduals, ...] = ()
    if first is not None:
        each = [residuals_to_add(first, part) for part in samples]
        residuals = tuple(reduce(add, same) for same in zip(*each))
    return LogInformation(
        settled=settled,
        evidence=evidence(samples, np.sqrt(torque / count)),
        residuals=residuals,
        pull=np.sum([filtering_bias(columns, point, *pair) for pair in pairs], axis=0),
        rows=reduce(add, [_sampled(*pair, point.values) for pair in pairs]),
        torque=torque,
        samples=count,
        duration=sum(float(log.time[-1] - log.time[0]) for log in logs),
        logs=1,
        acceleration_error=max(e.signals.acceleration_error for e in datasets if e.signals),
        notes=tuple(dict.fromkeys((*notes, *said)))[:MOST_NOTES],
    )


def _fitted(robot: RobotModel, found: LogInformation) -> Fit:
    options, fitter = found.settled.estimation, _Fixed(robot, found)
    question, (known, offered) = Question(options), couplings_of(robot, options)
    couplings = select_couplings(fitter, question, options.friction, offered) if offered else known
    choice, *_ = choose(fitter, question, options.friction, couplings)
    return fitter.fit(question, choice)


def _sampled(dataset: Dataset, part: DecimatedSamples, values: Array) -> RowSample:
    pairs = zip(part, part.columns)
    left = [tau - rows @ values[columns] for (_, rows, tau), columns in pairs]
    assert dataset.signals is not None
    content = dataset.signals.q.tobytes() + dataset.signals.tau.tobytes()
    number = int.from_bytes(hashlib.sha256(content).digest()[:8], "little")
    return sampled(dataset.motion, np.stack(left, axis=1), number)


def answer_from(
    robot: RobotModel, found: LogInformation, validation: LogInformation | None = None
) -> Answer:
    """Identify an arm from the sum of a second round; ``validation`` is made alike, and only tests.

    Raises:
        InputError: this is a first round, or something was made with another model or options.
    """
    here = replace(found.settled, model=robot.sha256, joint=robot.terminal_joint)
    said = here.differences(found.settled if validation is None else validation.settled)
    said += here.differences(found.settled)
    if said:
        raise InputError(f"this information does not fit: {', '.join(dict.fromkeys(said))} differ")
    if not found.settled.around:
        raise InputError(
            "this is the sum of a first round, which does not know its errors yet; make the "
            "information of all logs again with around= this sum, and identify from their sum"
        )
    fit, options = _fitted(robot, found), found.settled.estimation
    residuals = [each.shortened() for each in residuals_within(fit, found.residuals)]
    errors = fit_errors(fit, residuals, found.pull)
    fixed = _Fixed(robot, found, fit.point)
    file = fit_file(fixed, options, (FILE_GRAVITY,), fit, found.pull)
    tests: tuple[Validation, ...] = ()
    if validation is not None:
        tests = (
            predicted(fit, errors, validation.evidence, f"{validation.origin.detail}, not fitted"),
        )
    own = parts_compared(fit)
    return Answer(fit, file, errors, own, tests, {}, found.acceleration_error, found.notes)
