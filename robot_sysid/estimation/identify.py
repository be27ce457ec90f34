"""From recordings to an answer: filter, choose, fit, and the file that follows."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import FrictionModel, friction_model
from robot_sysid.dynamics.nuisances import gravity, tilt_axes
from robot_sysid.errors import InputError, prefix_input_errors
from robot_sysid.estimation.algebra.least_squares import sample_counts
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.estimation.algebra.priors import SURE, is_no_chance
from robot_sysid.estimation.answer import Answer, written_payload
from robot_sysid.estimation.choices import WITH_ALL, choose
from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.couplings import couplings_of, select_couplings
from robot_sysid.estimation.dataset import Dataset, Mask, mean_torque
from robot_sysid.estimation.errors import FitErrors, fit_errors
from robot_sysid.estimation.file_fit import fit_file
from robot_sysid.estimation.fit import Evidence, Fit, Fitter, evidence_of
from robot_sysid.estimation.recordings import compare_recordings, held_out_validation
from robot_sysid.estimation.unknowns import Choice, Question
from robot_sysid.estimation.verdict import is_informative
from robot_sysid.records import (
    Array,
    Measurement,
    RobotModel,
    SquareRootInformation,
    Validation,
)
from robot_sysid.records.progress import Detail, Progress
from robot_sysid.records.results import validation_of
from robot_sysid.signals.process import LogPiece, process
from robot_sysid.signals.repetition import visits

AT_REST = FrictionModel(("offset",))
"""Friction terms at rest, where poses were approached from both sides."""


_PASSES = 18
"""Passes over the recordings in an identification: 15 to 18 with three real arms and an example."""


@dataclass(frozen=True)
class Piece:
    """A stretch of a recording without long holes, as it was measured.

    Attributes:
        name: the recording's name in messages.
        is_loaded: whether it carries the payload.
        place: its position in the order of recording, as in ``Dataset``.
    """

    name: str
    samples: Measurement
    is_loaded: bool = False
    place: float = 0.0


def low_pass_recordings(
    robot: RobotModel, pieces: Sequence[Piece], options: EstimationOptions
) -> tuple[list[Dataset], tuple[str, ...]]:
    """Resample every recording to a uniform grid and low-pass it, all with the same cut-off.

    The cut-off is the lowest that any of them requires.

    Returns:
        (recordings, notes on them, one sentence each).

    Raises:
        InputError: a recording is too short.
    """
    resampled = [LogPiece.of(piece.samples) for piece in pieces]
    cutoffs = []
    pairs = []
    for piece, log in zip(pieces, resampled):
        with prefix_input_errors(piece.name):
            cutoffs.append(options.cutoff or log.choice[0])
    for piece, log, required in zip(pieces, resampled, cutoffs):
        cutoff = options.cutoff
        reason = "as given"
        if required > min(cutoffs):
            cutoff = min(cutoffs)
            reason = "as another recording asks for"
        with prefix_input_errors(piece.name):
            signals = process(log, robot.joint_names, cutoff, reason)
            pairs.append((piece, signals))
    datasets = []
    for piece, signals in pairs:
        dataset = Dataset(piece.name, signals, piece.is_loaded, piece.place)
        datasets.append(without_standing(robot, dataset, options))
    notes: dict[str, tuple[str, ...]] = {}
    for piece, signals in pairs:
        notes[piece.name] = tuple(
            dict.fromkeys((*notes.get(piece.name, ()), *signals.notes))
        )
    return datasets, tuple(shared_notes(notes))


def shared_notes(notes_by_name: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Yield each note once, with the names of its recordings where there are several."""
    for note in dict.fromkeys(
        note for notes in notes_by_name.values() for note in notes
    ):
        about = [name for name, notes in notes_by_name.items() if note in notes]
        where = (
            "all recordings" if len(about) == len(notes_by_name) else ", ".join(about)
        )
        yield note if len(notes_by_name) == 1 else type(note)(f"{where}: {note}")


def answer_link(
    robot: RobotModel,
    datasets: Sequence[Dataset],
    options: EstimationOptions,
    progress: Progress,
    kept_parts: tuple[str, ...] | None = (),
    tests: Mapping[str, Sequence[Dataset]] | None = None,
) -> Answer:
    """Identify an arm from recordings without a payload.

    Args:
        kept_parts: parts of the model file that stay as they are; None for no file.
        tests: name to recordings that only test the result.

    Raises:
        InputError: a recording is too short, or the couplings do not fit the arm.
        SysidError: an estimated delay or tilt does not converge.
    """
    question = Question(options)
    progress.stage(
        Detail("Choosing friction, couplings and how far links may be off...")
    )
    fitter = _fitter(robot, datasets, question, options.friction, progress)
    choice, candidates, start = choose(fitter, question, options.friction)
    progress.stage("Solving for parameters...")
    fit = fitter.fit(question, choice, start)
    errors = fit_errors(fit)
    logs = compare_recordings(fit, [dataset.name for dataset in datasets])
    file = None
    validation = held_out_validation(fit)
    if kept_parts is not None:
        progress.stage(Detail("Fitting the model file..."))
        # The file's rows, which the report draws, take as much memory.
        fit = replace(fit, samples=(), evidence=fit.evidence.merge_blocks())
        file = fit_file(fitter, options, kept_parts, fit)
    signals = [dataset.signals for dataset in datasets if dataset.signals is not None]
    coarsest = max(
        (log_signals.acceleration_error for log_signals in signals), default=0.0
    )
    answer = Answer(fit, file, errors, validation, (), candidates, coarsest)
    notes: list[str] = []
    if any({"coulomb", "offset"} <= set(model.terms) for model in choice.friction):
        notes += [
            note
            for log_signals in signals
            for note in log_signals.one_way_joints(robot.joint_names)
        ]
    others = tuple(
        validate_datasets(fit, errors, log, name) for name, log in (tests or {}).items()
    )
    notes = list(dict.fromkeys((*notes, *logs.notes)))
    return replace(
        answer,
        notes=tuple(notes),
        tests=(*others, *logs.tests),
        friction_of_logs=logs.friction,
    )


def answer_payload(
    robot: RobotModel,
    datasets: Sequence[Dataset],
    question: Question,
    progress: Progress,
    kept_parts: tuple[str, ...] | None = (),
) -> tuple[Answer, Answer]:
    """Identify a payload from recordings without and with it.

    Args:
        kept_parts: parts of the model file that stay as they are; None for no file.

    Returns:
        (answer with the known mass where there is one, answer as if the mass were not known).
    """
    options = question.options
    progress.stage(Detail("Estimating arm, friction and payload together..."))
    model = AT_REST if question.resting else options.friction
    weighing = replace(question, known_mass=None)
    fitter = _fitter(robot, datasets, weighing, model, progress)
    choice, candidates, start = choose(fitter, weighing, model)
    free = fitter.fit(weighing, choice, start)
    progress.stage(Detail("Finding out how far off it may be..."))
    weighed = Answer(
        free, None, fit_errors(free), held_out_validation(free), (), candidates
    )
    if question.known_mass is None:
        if (
            kept_parts is not None
            and options.torques == "chain"
            and not question.resting
        ):
            progress.stage(Detail("Fitting the model file..."))
            carried, _ = written_payload(weighed)
            file = fit_file(fitter, options, kept_parts, free, carried=carried)
            weighed = replace(weighed, file=file)
        return weighed, weighed
    fit = fitter.fit(question, choice, free.point)
    return Answer(
        fit, None, fit_errors(fit), held_out_validation(fit), (), candidates
    ), weighed


def refit(answer: Answer, used: Sequence[Mask], kept_parts: tuple[str, ...]) -> Answer:
    """Return the answer from the used rows of its recordings, with all choices made again."""
    fit = answer.fit
    datasets = [
        replace(dataset, used=mask) for dataset, mask in zip(fit.columns.datasets, used)
    ]
    return answer_link(
        answer.robot, datasets, fit.question.options, Progress(), kept_parts
    )


def _passes(progress: Progress) -> Callable[[], None]:
    """Return a function that reports progress, to be called before each pass."""
    done = itertools.count()

    def report() -> None:
        progress.advance("Identifying", min(next(done), _PASSES - 1), _PASSES, "")

    return report


def _fitter(
    robot: RobotModel,
    datasets: Sequence[Dataset],
    question: Question,
    model: FrictionModel | None,
    progress: Progress,
) -> Fitter:
    """Return the fitter, with the given couplings and those that the recordings call for."""
    options = question.options
    repetitions = None
    if options.tilt == "auto":
        tilt_axes(gravity(robot))  # raises without gravity
    if all(dataset.signals is not None for dataset in datasets):
        repetitions = visits([dataset.motion for dataset in datasets])
    motors, offered = couplings_of(robot, options)
    columns = Columns(robot, datasets, options.torques, motors)
    fitter = Fitter(columns, mean_torque(datasets), repetitions, _passes(progress))
    if not offered:
        return fitter
    # Columns of rejected couplings would cost every later pass time and memory.
    couplings = motors[: len(motors) - len(offered)]
    if not question.resting:
        couplings = select_couplings(fitter, question, model, offered)
    fitter = replace(fitter, _last=None)  # frees memory for the new rows
    return replace(fitter, columns=columns.with_couplings(couplings))


def validate_datasets(
    fit: Fit, errors: FitErrors, datasets: Sequence[Dataset], source: str
) -> Validation:
    """Return the error of a fit in other recordings; InputError as in ``validate_rows``."""
    columns = Columns(
        fit.columns.robot, datasets, fit.columns.torques, fit.columns.couplings
    )
    samples = columns.samples(replace(fit.point, values=fit.values))
    return validate_rows(
        fit, errors, evidence_of([samples], fit.evidence.torque), source
    )


def validate_rows(
    fit: Fit, errors: FitErrors, data: Evidence, source: str
) -> Validation:
    """Return the error with which a fit predicts the torques of rows that were not fitted.

    Raises:
        InputError: the rows hold no usable samples.
    """
    counts = sample_counts(data.whole)
    squares = np.sum(data.squared_torque, axis=0)
    if not np.any(counts):
        raise InputError(f"no usable torque samples to validate on in {source}")
    residual = data.whole.squared_residuals(fit.values)
    joints = [joint.joint for joint in data.whole.joints]
    validation = validation_of(joints, residual, squares, counts, source)
    noise = counts[None] * fit.noise**2
    told_enough = is_informative(
        residual[None],
        noise,
        lambda: noise + _prediction_variance(fit, errors, data.whole),
    )
    return replace(validation, told_enough=told_enough)


def _prediction_variance(
    fit: Fit, errors: FitErrors, data: SquareRootInformation
) -> Array:
    """Return the variance (joints,) of the torques that a fit predicts, summed over the rows of
    other data [N^2 m^2]; infinite where the fit does not identify a parameter of a joint's torque.
    """
    indices = fit.unknowns.kept
    variances = np.zeros(len(data.joints))
    for row, (joint, fitted) in enumerate(zip(data.joints, fit.evidence.whole.joints)):
        is_free = np.isin(joint.columns, indices)
        change = np.zeros((len(joint.triangle), len(indices)))
        columns = np.searchsorted(indices, joint.columns[is_free])
        change[:, columns] = joint.triangle[:, :-1][:, is_free]
        is_identified = fitted.n_samples > 0 and np.all(errors.shown(change))
        variances[row] = np.trace(errors.of(change)[0]) if is_identified else np.inf
    return variances


WORSE = 2.0
"""Ratio of mean squared residuals from which on rows make an estimate worse: the variance s^2 / n
of one from n rows falls by m more of variance r s^2 for as long as r < 2 + m / n."""


def without_standing(
    robot: RobotModel, dataset: Dataset, options: EstimationOptions
) -> Dataset:
    """Return a recording without the rows over turns at which joints stand for a while.

    Low-passed positions do not show standing (``signals.turning``), but residuals do. Rows over
    turns also have the most information on inertia, so they are left out only where they fit worse
    than all others. Every recording is judged by itself: logs that are added up one by one then
    give the same estimate as together.

    Raises:
        InputError: no joint moves fast enough, or the recording is too short.
    """
    signals = dataset.signals
    if signals is None or not np.any(signals.turning):
        return dataset

    columns = Columns(
        robot, [dataset], options.torques, couplings_of(robot, options)[0]
    )
    model = friction_model(WITH_ALL)
    if options.friction is not None and not options.friction.terms:
        model = options.friction
    choice = Choice((model,) * robot.n_joints, columns.couplings)
    question = Question(
        replace(options, delay="off", tilt="off"), loaded=dataset.is_loaded
    )
    fit = Fitter(columns, mean_torque([dataset])).fit(question, choice, rounds=1)

    (samples,) = fit.samples
    turns_left_out = replace(signals, standing=tuple(range(robot.n_joints))).usable()
    standing = []
    for row, joint in enumerate(columns.rows_of):
        predicted = samples.rows[row] @ fit.values[samples.columns[row]]
        if _are_worse(samples.tau[row] - predicted, ~turns_left_out[:, joint]):
            standing.append(joint)
    return replace(dataset, source=replace(signals, standing=tuple(standing)))


def _are_worse(residual: Array, doubtful: NDArray[np.bool_]) -> bool:
    """Tell whether doubtful rows (K,) have clearly larger residuals (K,) than others.

    Residuals of rows that are not in use are NaN.
    """
    used = np.isfinite(residual)
    doubted = residual[used & doubtful]
    other_residual = residual[used & ~doubtful]
    if len(doubted) == 0 or len(other_residual) < len(doubted):
        return False
    mean_square = float(np.mean(other_residual**2))
    squared = float(np.sum(doubted**2)) / mean_square if mean_square > 0.0 else 0.0
    return squared > WORSE * len(doubted) and is_no_chance(
        squared, len(doubted), 1.0 - SURE
    )
