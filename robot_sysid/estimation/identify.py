"""From recordings to an answer: filter, select friction and couplings, fit, fit the model file.

Shapes: n joints of the chain; K rows (instants of equations) of a recording; p parameters
(``Columns.names``), k of them estimated; a body has ten inertial parameters (``PARAMETER_NAMES``).
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import FrictionModel, friction_model
from robot_sysid.errors import prefix_input_errors
from robot_sysid.estimation.algebra.priors import SURE, is_significant
from robot_sysid.estimation.answer import Answer, written_payload
from robot_sysid.estimation.choices import (
    WITH_ALL,
    choose,
    columns_of,
    couplings_of,
    select_couplings,
)
from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.dataset import Dataset, motion_signals, rms_torque
from robot_sysid.estimation.errors import fit_errors
from robot_sysid.estimation.file_fit import fit_file
from robot_sysid.estimation.fit import Fit, Fitter
from robot_sysid.estimation.held_out import (
    held_out_logs,
    held_out_validation,
    validate_datasets,
)
from robot_sysid.estimation.question import Choice, EstimationOptions, Question
from robot_sysid.estimation.trust import missed_friction
from robot_sysid.records import Array, Measurement, RobotModel
from robot_sysid.records.messages import Detail, Progress
from robot_sysid.signals.process import (
    LogPiece,
    ProcessedSignals,
    check_losses,
    process,
)

AT_REST = FrictionModel(("offset",))
"""Friction model for poses at rest. Each is approached from both sides, so that friction cancels
and a torque offset remains."""
_PASSES = 18
"""Number of passes over the recordings that progress is counted against: an identification takes 15
to 18 with three real arms and an example."""


@dataclass(frozen=True)
class Piece:
    """A stretch of a recording without long holes, as it was measured.

    Attributes:
        name: the recording's name in messages.
        samples: measured positions and torques.
        is_loaded: whether the arm carries the payload.
        order: its position in the order of recording, from -1 for the first to 1 for the last; 0
            where the order is not known.
    """

    name: str
    samples: Measurement
    is_loaded: bool = False
    order: float = 0.0


def low_pass_recordings(
    robot: RobotModel, pieces: Sequence[Piece], options: EstimationOptions
) -> tuple[list[Dataset], tuple[str, ...]]:
    """Resample every recording to a uniform grid and low-pass it, all with the same cut-off.

    The cut-off is the lowest that any of them requires, unless an option states it. Rows over turns
    at which a joint stands are left out (``without_standing``).

    Args:
        robot: the arm with its model.
        pieces: stretches of recordings, each of which becomes one recording.
        options: the cut-off, or None in its field to choose it from the data.

    Returns:
        (recordings, one per piece; notes on them, one sentence each).

    Raises:
        InputError: a recording is too short.
    """
    resampled = [LogPiece.of(piece.samples) for piece in pieces]
    cutoffs = []
    for piece, log in zip(pieces, resampled):
        with prefix_input_errors(piece.name):
            cutoffs.append(options.cutoff or log.choice.cutoff)
    low_passed = []
    notes: dict[str, dict[str, None]] = {}
    processed: defaultdict[str, list[ProcessedSignals]] = defaultdict(list)
    for piece, log, required in zip(pieces, resampled, cutoffs):
        cutoff = options.cutoff
        reason = "as given"
        if required > min(cutoffs):
            cutoff = min(cutoffs)
            reason = "as another recording asks for"
        with prefix_input_errors(piece.name):
            signals = process(log, robot.joint_names, cutoff, reason)
        processed[piece.name].append(signals)
        low_passed.append(Dataset(piece.name, signals, piece.is_loaded, piece.order))
        notes.setdefault(piece.name, {}).update(dict.fromkeys(signals.notes))
    for name, recordings in processed.items():
        with prefix_input_errors(name):
            check_losses(recordings)
    datasets = [without_standing(robot, dataset, options) for dataset in low_passed]
    return datasets, tuple(shared_notes(notes))


def shared_notes(notes_by_name: Mapping[str, Collection[str]]) -> Iterator[str]:
    """Yield each note once, with the names of its recordings where there are several recordings.

    Args:
        notes_by_name: name of a recording to its notes; a note may be a subclass of ``str``.
    """
    all_notes = dict.fromkeys(itertools.chain(*notes_by_name.values()))
    for note in all_notes:
        about = [name for name, notes in notes_by_name.items() if note in notes]
        where = ", ".join(about)
        if len(about) == len(notes_by_name):
            where = "all recordings"
        yield note if len(notes_by_name) == 1 else type(note)(f"{where}: {note}")


def answer_link(
    robot: RobotModel,
    datasets: Sequence[Dataset],
    options: EstimationOptions,
    progress: Progress,
    unchanged_parts: tuple[str, ...] | None = (),
    tests: Mapping[str, Sequence[Dataset]] | None = None,
) -> Answer:
    """Return the answer for an arm from recordings without a payload.

    Args:
        robot: the arm with its model.
        datasets: filtered recordings, as from ``low_pass_recordings``.
        options: options of the estimate.
        progress: receives the stages.
        unchanged_parts: parts of the model file that stay as they are; None for no file.
        tests: name to recordings that only test the result.

    Raises:
        InputError: a recording is too short, or the couplings do not fit the arm.
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
    validation = held_out_validation(fit)
    log_tests = held_out_logs(fit)
    missed = missed_friction(fit)
    file = None
    if unchanged_parts is not None:
        progress.stage(Detail("Fitting the model file..."))
        # The file's rows, which the report draws, take as much memory.
        fit = replace(fit, samples=(), evidence=fit.evidence.merge_blocks())
        file = fit_file(fitter, options, unchanged_parts, fit)
    signals = motion_signals(datasets)
    acceleration_errors = [log.acceleration_error for log in signals]
    validations = []
    for name, log in (tests or {}).items():
        validations.append(validate_datasets(fit, errors, log, name))
    return Answer(
        fit,
        errors,
        validation,
        candidates,
        file,
        tests=(*validations, *log_tests),
        acceleration_error=max(acceleration_errors, default=0.0),
        missed_friction=missed,
    )


def answer_payload(
    robot: RobotModel,
    datasets: Sequence[Dataset],
    question: Question,
    progress: Progress,
    unchanged_parts: tuple[str, ...] | None = (),
) -> tuple[Answer, Answer]:
    """Return the answers for a payload from recordings without and with it.

    Args:
        robot: the arm with its model.
        datasets: filtered recordings, or poses at rest.
        question: may contain the known mass of the payload.
        progress: receives the stages.
        unchanged_parts: parts of the model file that stay as they are; None for no file.

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

    def answer_of(fit: Fit) -> Answer:
        """Return a fit with its errors and its held-out error."""
        validation = held_out_validation(fit)
        missed = "" if question.resting else missed_friction(fit)
        return Answer(
            fit, fit_errors(fit), validation, candidates, missed_friction=missed
        )

    weighed = answer_of(free)
    if question.known_mass is not None:
        return answer_of(fitter.fit(question, choice, free.point)), weighed
    can_have_file = options.torques == "chain" and not question.resting
    if unchanged_parts is not None and can_have_file:
        progress.stage(Detail("Fitting the model file..."))
        carried, _ = written_payload(weighed)
        file = fit_file(fitter, options, unchanged_parts, free, carried=carried)
        weighed = replace(weighed, file=file)
    return weighed, weighed


def _passes(progress: Progress) -> Callable[[], None]:
    """Return a function that counts passes over the recordings and reports progress by them."""
    counter = itertools.count()

    def report() -> None:
        """Count one more pass and report it; later passes than ``_PASSES`` count as the last."""
        done = min(next(counter), _PASSES - 1)
        progress.advance("Identifying", done, _PASSES, "")

    return report


def _fitter(
    robot: RobotModel,
    datasets: Sequence[Dataset],
    question: Question,
    model: FrictionModel | None,
    progress: Progress,
) -> Fitter:
    """Return a fitter of recordings with the stated couplings and those with clear evidence.

    Args:
        robot: the arm with its model.
        datasets: the recordings.
        question: what to estimate, with which options.
        model: friction of every joint, where the user states it; None to select it later.
        progress: receives a count of passes over the recordings.
    """
    options = question.options
    # All couplings: first stated ones, then ``offered``, which are used only with clear evidence.
    motors, offered = couplings_of(robot, options)
    columns = Columns(robot, datasets, options.torques, motors)
    fitter = Fitter(columns, rms_torque(datasets), _passes(progress))
    if not offered:
        return fitter
    # Columns of rejected couplings would cost every later pass time and memory.
    couplings = motors[: len(motors) - len(offered)]
    # Poses at rest show no coupling.
    if not question.resting:
        couplings = select_couplings(fitter, question, model, offered)
    fitter.forget_rows()
    return replace(fitter, columns=columns.with_couplings(couplings))


WORSE = 2.0
"""Ratio of mean squared residuals above which additional rows make an estimate worse. With n rows
of variance s^2, the variance of a mean is s^2 / n; m more rows of variance r s^2 lower it only
while r < 2 + m / n."""


def without_standing(
    robot: RobotModel, dataset: Dataset, options: EstimationOptions
) -> Dataset:
    """Return the recording without the rows at reversals where joints stand still for a while.

    Low-passed positions do not show standing (``signals.turning``), but residuals do. Rows over
    turns also have the most information on inertia, so they are left out only where they fit worse
    than all others. Every recording is judged by itself, with a flexible friction model: logs that
    are added up one by one then give the estimate of all logs together.

    Args:
        robot: the arm with its model.
        dataset: the recording; one without reversals, or of poses at rest, is returned as it is.
        options: options of the estimate.

    Raises:
        InputError: no joint moves fast enough, or the recording is too short.
    """
    signals = dataset.signals
    if signals is None or not np.any(signals.turning):
        return dataset

    columns = columns_of(robot, [dataset], options)
    model = friction_model(WITH_ALL)
    if options.friction is not None and not options.friction.terms:
        model = options.friction
    choice = Choice((model,) * robot.n_joints, columns.couplings)
    question = Question(options, loaded=dataset.is_loaded)
    fit = Fitter(columns, rms_torque([dataset])).fit(question, choice, rounds=1)

    (samples,) = fit.samples
    torques = samples.torque(fit.values)
    # Rows (K, n) that would be used if all joints stood at their turns.
    is_used = replace(signals, standing=tuple(range(robot.n_joints))).usable()
    standing = []
    for row, joint in enumerate(columns.joint_indices):
        if _are_worse(samples.tau[row] - torques[row], ~is_used[:, joint]):
            standing.append(joint)
    return replace(dataset, source=replace(signals, standing=tuple(standing)))


def _are_worse(residual: Array, doubtful: NDArray[np.bool_]) -> bool:
    """Tell whether doubtful rows have clearly larger residuals than all other rows.

    Args:
        residual: (K,) residual torques of a joint [N m]; NaN where a row is not used.
        doubtful: (K,) mask of the doubtful rows.
    """
    used = np.isfinite(residual)
    doubted = residual[used & doubtful]
    other_residual = residual[used & ~doubtful]
    if len(doubted) == 0 or len(other_residual) < len(doubted):
        return False
    mean_square = float(np.mean(other_residual**2))
    squared = float(np.sum(doubted**2)) / mean_square if mean_square > 0.0 else 0.0
    return squared > WORSE * len(doubted) and is_significant(
        squared, len(doubted), 1.0 - SURE
    )
