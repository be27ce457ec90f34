"""From recordings to an answer: filter, choose, fit, and the file that follows."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.dynamics.friction import FrictionModel
from robot_sysid.dynamics.nuisances import gravity, tilt_axes
from robot_sysid.errors import InputError, named
from robot_sysid.estimation.algebra.information import sample_counts
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.estimation.answer import Answer, written_payload
from robot_sysid.estimation.choices import choose, without_standing
from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.couplings import couplings_of, select_couplings
from robot_sysid.estimation.dataset import Dataset, Mask, mean_torque
from robot_sysid.estimation.errors import FitErrors, fit_errors
from robot_sysid.estimation.file_fit import fit_file
from robot_sysid.estimation.fit import Evidence, Fit, Fitter, evidence_of
from robot_sysid.estimation.recordings import logs_compared, parts_compared
from robot_sysid.estimation.unknowns import Question
from robot_sysid.estimation.verdict import speaks
from robot_sysid.records import Array, Measurement, RobotModel, SquareRootInformation, Validation
from robot_sysid.records.progress import Detail, Progress
from robot_sysid.records.results import validation_of
from robot_sysid.signals.process import LogPiece, process
from robot_sysid.signals.repetition import visits

AT_REST = FrictionModel(("offset",))
"""What is left of friction at rest, approached from both sides."""


_PASSES = 18
"""Passes over the recordings in an identification: 15 to 18 with three real arms and an example."""


@dataclass(frozen=True)
class Piece:
    """A stretch of a recording without long holes, as it was measured: the recording's name in
    messages, whether it carries the payload, and its place as in ``Dataset``.
    """

    name: str
    samples: Measurement
    is_loaded: bool = False
    place: float = 0.0


def filtered(
    robot: RobotModel, pieces: Sequence[Piece], options: EstimationOptions
) -> tuple[list[Dataset], tuple[str, ...]]:
    """Return recordings, each filtered on its own, with the lowest cut-off that one asks for.

    With them comes what there is to say of them, one sentence each.

    Raises:
        InputError: one is too short.
    """
    parts, cutoffs, pairs = [LogPiece.of(piece.samples) for piece in pieces], [], []
    for piece, part in zip(pieces, parts):
        with named(piece.name):
            cutoffs.append(options.cutoff or part.choice[0])
    for piece, part, own in zip(pieces, parts, cutoffs):
        cutoff, by = options.cutoff, "as given"
        if own > min(cutoffs):
            cutoff, by = min(cutoffs), "as another recording asks for"
        with named(piece.name):
            signals = process(part, robot.joint_names, cutoff, by)
            pairs.append((piece, signals))
    found = []
    for piece, each in pairs:
        dataset = Dataset(piece.name, each, piece.is_loaded, piece.place)
        found.append(without_standing(robot, dataset, options))
    told: dict[str, tuple[str, ...]] = {}
    for piece, each in pairs:
        told[piece.name] = tuple(dict.fromkeys((*told.get(piece.name, ()), *each.notes)))
    return found, tuple(shared_notes(told))


def shared_notes(told: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Yield each note once, with the recordings that it is about where there are several."""
    for note in dict.fromkeys(note for notes in told.values() for note in notes):
        about = [name for name, notes in told.items() if note in notes]
        where = "all recordings" if len(about) == len(told) else ", ".join(about)
        yield note if len(told) == 1 else type(note)(f"{where}: {note}")


def answer_link(
    robot: RobotModel,
    datasets: Sequence[Dataset],
    options: EstimationOptions,
    progress: Progress,
    kept: tuple[str, ...] | None = (),
    tests: Mapping[str, Sequence[Dataset]] | None = None,
) -> Answer:
    """Identify an arm from recordings of it alone.

    Args:
        kept: parts of the model file that stay as they are; None asks for no file.
        tests: name to recordings that only test the result.

    Raises:
        InputError: a recording is too short, or the couplings do not fit the arm.
        SysidError: a delay or a tilt that is sought keeps moving.
    """
    question = Question(options)
    progress.stage(Detail("Choosing friction, couplings and how far links may be off..."))
    fitter = _fitter(robot, datasets, question, options.friction, progress)
    choice, tried, start = choose(fitter, question, options.friction)
    progress.stage("Solving for parameters...")
    fit = fitter.fit(question, choice, start)
    errors = fit_errors(fit)
    logs = logs_compared(fit, [each.name for each in datasets])
    file, validation = None, parts_compared(fit)
    if kept is not None:
        progress.stage(Detail("Fitting the model file..."))
        # What the file's rows say, which are drawn, takes as much memory.
        fit = replace(fit, samples=(), evidence=fit.evidence.merge_blocks())
        file = fit_file(fitter, options, kept, fit)
    signals = [each.signals for each in datasets if each.signals is not None]
    coarsest = max((each.acceleration_error for each in signals), default=0.0)
    answer = Answer(fit, file, errors, validation, (), tried, coarsest)
    notes: list[str] = []
    if any({"coulomb", "offset"} <= set(model.terms) for model in choice.friction):
        notes += [note for each in signals for note in each.one_way_joints(robot.joint_names)]
    others = tuple(tested(fit, errors, each, name) for name, each in (tests or {}).items())
    notes = list(dict.fromkeys((*notes, *logs.notes)))
    return replace(
        answer, notes=tuple(notes), tests=(*others, *logs.tests), friction_of_logs=logs.friction
    )


def answer_payload(
    robot: RobotModel,
    datasets: Sequence[Dataset],
    question: Question,
    progress: Progress,
    kept: tuple[str, ...] | None = (),
) -> tuple[Answer, Answer]:
    """Identify a payload from recordings without and with it.

    Args:
        kept: parts of the model file that stay as they are; None asks for no file.

    Returns:
        (the answer, with the known mass where there is one; the one as if it were not known).
    """
    options = question.options
    progress.stage(Detail("Estimating arm, friction and payload together..."))
    given = AT_REST if question.resting else options.friction
    weighing = replace(question, known_mass=None)
    fitter = _fitter(robot, datasets, weighing, given, progress)
    choice, tried, start = choose(fitter, weighing, given)
    free = fitter.fit(weighing, choice, start)
    progress.stage(Detail("Finding out how far off it may be..."))
    weighed = Answer(free, None, fit_errors(free), parts_compared(free), (), tried)
    if question.known_mass is None:
        if kept is not None and options.torques == "chain" and not question.resting:
            progress.stage(Detail("Fitting the model file..."))
            carried, _ = written_payload(weighed)
            file = fit_file(fitter, options, kept, free, carried=carried)
            weighed = replace(weighed, file=file)
        return weighed, weighed
    fit = fitter.fit(question, choice, free.point)
    return Answer(fit, None, fit_errors(fit), parts_compared(fit), (), tried), weighed


def refit(answer: Answer, used: Sequence[Mask], kept: tuple[str, ...]) -> Answer:
    """Return the answer of some rows of its recordings alone, everything chosen anew."""
    fit = answer.fit
    datasets = [replace(each, used=mask) for each, mask in zip(fit.columns.datasets, used)]
    return answer_link(answer.robot, datasets, fit.question.options, Progress(), kept)


def _passes(progress: Progress) -> Callable[[], None]:
    """Return what tells how far an identification is, when called before each pass."""
    done = itertools.count()

    def told() -> None:
        progress.advance("Identifying", min(next(done), _PASSES - 1), _PASSES, "")

    return told


def _fitter(
    robot: RobotModel,
    datasets: Sequence[Dataset],
    question: Question,
    given: FrictionModel | None,
    progress: Progress,
) -> Fitter:
    """Return what fits, with the couplings that are known or that the recordings decide for."""
    options, again = question.options, None
    if options.tilt == "auto":
        tilt_axes(gravity(robot))  # which there have to be
    if all(each.signals is not None for each in datasets):
        again = visits([each.motion for each in datasets])
    motors, offered = couplings_of(robot, options)
    columns = Columns(robot, datasets, options.torques, motors)
    fitter = Fitter(columns, mean_torque(datasets), again, _passes(progress))
    if not offered:
        return fitter
    # Columns of couplings that are not there would cost every later pass time and memory.
    known = motors[: len(motors) - len(offered)]
    found = known if question.resting else select_couplings(fitter, question, given, offered)
    fitter = replace(fitter, _last=None)  # before rows are made anew, which take as much memory
    return replace(fitter, columns=columns.coupled(found))


def tested(fit: Fit, errors: FitErrors, datasets: Sequence[Dataset], source: str) -> Validation:
    """Return the error with which a fit predicts other recordings; InputError as ``predicted``."""
    columns = Columns(fit.columns.robot, datasets, fit.columns.torques, fit.columns.couplings)
    samples = columns.samples(replace(fit.point, values=fit.values))
    return predicted(fit, errors, evidence_of([samples], fit.evidence.torque), source)


def predicted(fit: Fit, errors: FitErrors, data: Evidence, source: str) -> Validation:
    """Return the error with which a fit predicts what rows that it was not made from say.

    Raises:
        InputError: they hold no usable samples.
    """
    counts, squares = sample_counts(data.whole), np.sum(data.squared_torque, axis=0)
    if not np.any(counts):
        raise InputError(f"no usable torque samples to validate on in {source}")
    wrong = data.whole.squared_residuals(fit.values)
    joints = [joint.joint for joint in data.whole.joints]
    found = validation_of(joints, wrong, squares, counts, source)
    noise = counts[None] * fit.noise**2
    told = speaks(wrong[None], noise, lambda: noise + _left_open(fit, errors, data.whole))
    return replace(found, told_enough=told)


def _left_open(fit: Fit, errors: FitErrors, data: SquareRootInformation) -> Array:
    """Return (joints,) sum of squares that the errors of a fit make of other rows [N^2 m^2];
    infinite where it tells nothing of a joint's friction, or of what else its torque depends on.
    """
    kept, found = fit.unknowns.kept, np.zeros(len(data.joints))
    for row, (joint, own) in enumerate(zip(data.joints, fit.evidence.whole.joints)):
        stay = np.isin(joint.columns, kept)
        change = np.zeros((len(joint.triangle), len(kept)))
        change[:, np.searchsorted(kept, joint.columns[stay])] = joint.triangle[:, :-1][:, stay]
        told = own.n_samples > 0 and np.all(errors.shown(change))
        found[row] = np.trace(errors.of(change)[0]) if told else np.inf
    return found
