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
from robot_sysid.dynamics.inverse_dynamics import gravity_vector, tilt_axes
from robot_sysid.dynamics.spatial import N_INERTIAL, PARAMETER_NAMES
from robot_sysid.errors import prefix_input_errors
from robot_sysid.estimation.algebra.priors import (
    SURE,
    independent_prior,
    is_significant,
)
from robot_sysid.estimation.answer import Answer, written_payload
from robot_sysid.estimation.choices import (
    WITH_ALL,
    choose,
    columns_of,
    couplings_of,
    select_couplings,
)
from robot_sysid.estimation.columns import PAYLOAD_NAMES, Columns
from robot_sysid.estimation.dataset import (
    Dataset,
    DecimatedSamples,
    Mask,
    motion_signals,
    rms_torque,
)
from robot_sysid.estimation.errors import fit_errors
from robot_sysid.estimation.file_fit import fit_file
from robot_sysid.estimation.fit import Fit, Fitter
from robot_sysid.estimation.held_out import held_out_validation, validate_datasets
from robot_sysid.estimation.log_comparison import compare_recordings, estimate_alone
from robot_sysid.estimation.question import Choice, EstimationOptions, Question
from robot_sysid.estimation.trust import missed_friction
from robot_sysid.estimation.unknowns import WEIGHT, restrict_samples
from robot_sysid.records import Array, Flange, Measurement, RobotModel
from robot_sysid.records.messages import Detail, Progress
from robot_sysid.results.record import RecordingPayload
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
    log_notes, log_tests, friction = compare_recordings(fit)
    validation = held_out_validation(fit)
    missed = missed_friction(fit)
    file = None
    if unchanged_parts is not None:
        progress.stage(Detail("Fitting the model file..."))
        # The file's rows, which the report draws, take as much memory.
        fit = replace(fit, samples=(), evidence=fit.evidence.merge_blocks())
        file = fit_file(fitter, options, unchanged_parts, fit, errors)
    signals = motion_signals(datasets)
    acceleration_errors = [log.acceleration_error for log in signals]
    notes: list[str] = []
    # A joint that moves in one direction only confounds Coulomb friction with the sensor's offset.
    if any({"coulomb", "offset"} <= set(model.terms) for model in choice.friction):
        for log_signals in signals:
            notes += log_signals.one_way_joints(robot.joint_names)
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
        notes=tuple(dict.fromkeys((*notes, *log_notes))),
        friction_of_logs=friction,
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
        file = fit_file(
            fitter, options, unchanged_parts, free, weighed.errors, carried=carried
        )
        weighed = replace(weighed, file=file)
    return weighed, weighed


def refit(
    answer: Answer, used: Sequence[Mask], unchanged_parts: tuple[str, ...]
) -> Answer:
    """Return the answer from a part of the rows of an answer's recordings, all choices made again.

    Args:
        answer: gives recordings and options.
        used: mask (K,) for each recording of the rows to use.
        unchanged_parts: parts of the model file that stay as they are.
    """
    fit = answer.fit
    pairs = zip(fit.columns.datasets, used)
    datasets = [replace(dataset, used=mask) for dataset, mask in pairs]
    return answer_link(
        answer.robot, datasets, fit.question.options, Progress(), unchanged_parts
    )


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
    if options.tilt == "auto":
        tilt_axes(gravity_vector(robot))  # raises without gravity
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
    question = Question(
        replace(options, delay="off", tilt="off"), loaded=dataset.is_loaded
    )
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


SURE_MISFIT = 4.0
"""Root mean square difference of recordings of one kind (empty or loaded), in standard errors,
above which they are refused: none of 60 simulated sets exceeds 1.9, a real arm with elastic joints
reaches 3.3."""
LEAST_MASS = 0.03
"""Difference in mass below which recordings agree, as a share of the payload's mass."""
LEAST_PLACE = 0.01
"""Difference in the payload's centre of mass below which recordings agree [m]."""
LEAST_GYRATION = 0.05
"""Difference in the payload's radius of gyration below which recordings agree [m]."""
UNSEEN = 100.0
"""Prior standard deviation of a body's ten parameters, each in its SI unit: wide, and only there to
keep parameters without data finite."""


def payloads_by_recording(fit: Fit, flange: Flange) -> tuple[RecordingPayload, ...]:
    """Return the payload according to each recording, compared with those of the other kind.

    The kinds are recordings without and with the payload; those without come first. A recording
    that is the only one of its kind gets no entry. Payloads are in the flange frame. The fit needs
    its rows (``Fit.samples``).
    """
    unknowns = fit.unknowns
    recordings = fit.columns.datasets
    payloads = []
    logs = [restrict_samples(samples, unknowns) for samples in fit.samples]
    prior = fit.columns.model_values[unknowns.estimated]
    indices = np.searchsorted(unknowns.estimated, fit.columns.indices(PAYLOAD_NAMES))
    kinds = np.array([log.is_loaded for log in recordings])
    for k in np.argsort(kinds, kind="stable"):
        is_loaded = recordings[k].is_loaded
        if np.count_nonzero(kinds == is_loaded) < 2:
            continue
        selected = [logs[k]]
        for other in np.flatnonzero(kinds != is_loaded):
            selected.append(logs[other])
        values, *covariances = estimate_alone(
            selected, unknowns.groups, prior, fit.noise
        )
        # Of the mass, the first parameter of the payload: due to noise, and of the whole error.
        variances = np.array(covariances)[:, indices[0], indices[0]]
        noise, error = np.sqrt(variances).tolist()
        theta = flange.to_flange(values[indices])
        mass = float(theta[0])
        com = theta[1:4] / mass if mass else np.full(3, np.nan)
        name = recordings[k].name
        payload = RecordingPayload(name, is_loaded, mass, com, noise, error)
        payloads.append(payload)
    return tuple(payloads)


def contradiction(fit: Fit, flange: Flange) -> str:
    """Return a sentence on recordings of one kind that contradict each other; "" where they agree.

    The kinds are recordings without and with the payload; with fewer than three recordings, none
    can be compared. Torque scales of the fit may have been adapted to a recording of the wrong
    kind, so that a difference has to show in a second linearisation, around the model's own values,
    too.

    Args:
        fit: with the rows of recordings (``Fit.samples``).
        flange: frame in which the sentence states bodies.
    """
    recordings = fit.columns.datasets
    kinds = np.array([log.is_loaded for log in recordings])
    if len(kinds) < 3:
        return ""
    bodies, covariance = bodies_apart(fit, fit.samples)
    if not any(_differences(kinds, bodies, covariance)):
        return ""
    samples_of_model = fit.columns.samples(fit.columns.start())
    bodies, covariance = bodies_apart(fit, samples_of_model)
    differences = sorted(_differences(kinds, bodies, covariance))
    if not differences:
        return ""
    # The largest one, in standard errors.
    _, number, quantity = differences[-1]
    same = [k for k in np.flatnonzero(kinds == kinds[number]) if k != number]
    lightest = int(np.argmin(bodies[:, 0]))
    carried = bodies - bodies[lightest]
    least = LEAST_MASS * float(np.max(carried[:, 0]))
    phrases = []
    for log, theta in zip(recordings, carried):
        if log is not recordings[lightest]:
            body = _describe_body(flange.to_flange(theta), least)
            phrases.append(f"{log.name} {body}")
    return (
        f"{recordings[number].name} differs from {', '.join(recordings[k].name for k in same)} in "
        f"{quantity}; compared with {recordings[lightest].name} the arm carries: "
        f"{', '.join(phrases)}"
    )


def _describe_body(theta: Array, least: float) -> str:
    """Return a phrase with mass and centre of mass of a body.

    Args:
        theta: (10,) inertial parameters of the body.
        least: mass up to which the phrase is "nothing" [kg].
    """
    if theta[0] <= least:
        return "nothing"
    position = ", ".join(f"{1e3 * x:.0f}" for x in theta[1:4] / theta[0])
    return f"{theta[0]:.3g} kg at ({position}) mm"


def _differences(
    kinds: NDArray[np.bool_], bodies: Array, covariance: Array
) -> Iterator[tuple[float, int, str]]:
    """Yield the significant differences of each recording from the others of its kind.

    The kinds are recordings without and with the payload. Differences that are small compared with
    the payload are left out (``LEAST_MASS``, ``LEAST_PLACE``, ``LEAST_GYRATION``).

    Args:
        kinds: (d,) whether each recording carries the payload.
        bodies: (d, 10) inertial parameters of the body on the arm in each recording, in the frame
            of the terminal body.
        covariance: (d, 10, d, 10) of the bodies.

    Yields:
        (root mean square difference in standard errors, number of the recording, quantity that
        differs: "mass", "centre of mass" or "inertia").
    """
    payload = np.mean(bodies[kinds], axis=0) - np.mean(bodies[~kinds], axis=0)
    mass = max(abs(float(payload[0])), np.finfo(float).tiny)
    for number, is_loaded in enumerate(kinds):
        others = (kinds == is_loaded) & (np.arange(len(kinds)) != number)
        if not np.any(others):
            continue
        # The body in this recording less the mean one in the others, with the change's covariance.
        weights = (np.arange(len(kinds)) == number) - others / np.sum(others)
        change = weights @ bodies
        spread = np.einsum("i,iajb,j", weights, covariance, weights)
        # Change of the first moment that no change of the mass explains [kg m].
        moved = change[1:4] - change[0] * payload[1:4] / mass
        inertia = np.max(np.abs(change[4:]))
        # Quantity, size of its change, least size per kg of the payload, parameters that it is of.
        for quantity, size, least, block in (
            ("mass", abs(change[0]), LEAST_MASS, slice(0, 4)),
            ("centre of mass", np.linalg.norm(moved), LEAST_PLACE, slice(0, 4)),
            ("inertia", inertia, LEAST_GYRATION**2, slice(4, 10)),
        ):
            changes = change[block]
            squared = changes @ np.linalg.solve(spread[block, block], changes)
            ratio = float(np.sqrt(squared / len(changes)))
            if size > least * mass and ratio > SURE_MISFIT:
                yield ratio, number, quantity


def bodies_apart(fit: Fit, samples: Sequence[DecimatedSamples]) -> tuple[Array, Array]:
    """Return the bodies (d, 10) on the arm in each of d recordings, and their covariance.

    A body is its ten inertial parameters, the covariance (d, 10, d, 10). Each recording gets a body
    of its own in place of the payload. The first recording is the
    reference: its body and its error are zero. Labels of recordings as empty or loaded are not
    used. Bodies are in the frame of the terminal body.

    Args:
        fit: gives all other unknowns and their priors.
        samples: rows of each recording.
    """
    count = len(samples) - 1
    common = np.setdiff1d(fit.unknowns.estimated, fit.columns.indices(PAYLOAD_NAMES))
    fewer = replace(fit.unknowns, estimated=common)
    added = list[str]()
    for number in range(count):
        added += [f"{name}({number})" for name in PARAMETER_NAMES]
    names = (*fewer.estimated_names, *added)

    def add_body_columns(number: int, samples: DecimatedSamples) -> DecimatedSamples:
        """Return a recording's rows with columns of all bodies, zero but for that of its number."""
        narrow = restrict_samples(samples, fewer)
        body_columns = np.arange(len(common), len(names))
        rows = []
        columns = []
        # The first ten columns of a joint's rows are those of the terminal link.
        for block, full, block_columns in zip(
            narrow.rows, samples.rows, narrow.columns
        ):
            bodies = np.zeros((len(block), count, N_INERTIAL))
            if number:
                bodies[:, number - 1] = full[:, :N_INERTIAL]
            rows.append(np.hstack((block, bodies.reshape(len(block), -1))))
            columns.append(np.append(block_columns, body_columns))
        return replace(narrow, names=names, columns=tuple(columns), rows=tuple(rows))

    # A recording of the wrong kind widens priors that have nothing to do with it. A known mass
    # (cause ``WEIGHT``) is that of the payload, which these bodies replace.
    priors = [replace(g, widened=1.0) for g in fit.unknowns.groups if g.cause != WEIGHT]
    priors.append(independent_prior("unseen", added, added, UNSEEN))
    prior = np.append(fit.columns.model_values[common], np.zeros(len(added)))
    logs = list(itertools.starmap(add_body_columns, enumerate(samples)))
    values, _, errors = estimate_alone(logs, priors, prior)
    last = slice(len(common), None)
    bodies = np.zeros((count + 1, N_INERTIAL))
    covariance = np.zeros((count + 1, N_INERTIAL) * 2)
    bodies[1:] = values[last].reshape(count, -1)
    covariance[1:, :, 1:] = errors[last, last].reshape((count, N_INERTIAL) * 2)
    return bodies, covariance
