"""From recordings to answers: low-pass all alike, fit, fit the model file."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from robot_sysid.errors import prefix_input_errors
from robot_sysid.estimate.choose import solved
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.payload import written_payload
from robot_sysid.estimate.questions import Question
from robot_sysid.estimate.restricted_fit import RestrictedFit, fit_file
from robot_sysid.estimate.rows import Recording
from robot_sysid.records import Measurement, RobotModel
from robot_sysid.records.messages import Detail, Progress
from robot_sysid.signals.process import (
    LogPiece,
    ProcessedSignals,
    check_losses,
    process,
)


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
    robot: RobotModel, pieces: Sequence[Piece], cutoff: float | None = None
) -> tuple[list[Recording], tuple[str, ...]]:
    """Resample every recording to a uniform grid and low-pass it, all with the same cut-off.

    Args:
        robot: the arm with its model.
        pieces: stretches of recordings, each of which becomes one recording.
        cutoff: of the low-pass [Hz]; None for the lowest that any of them requires.

    Returns:
        (recordings, one per piece; notes on them, one sentence each).

    Raises:
        InputError: a recording is too short.
    """
    resampled = [LogPiece.of(piece.samples) for piece in pieces]
    cutoffs = []
    for piece, log in zip(pieces, resampled):
        with prefix_input_errors(piece.name):
            cutoffs.append(cutoff or log.choice.cutoff)
    recordings = []
    processed: defaultdict[str, list[ProcessedSignals]] = defaultdict(list)
    for piece, log, required in zip(pieces, resampled, cutoffs):
        given = min(cutoffs) if required > min(cutoffs) else cutoff
        with prefix_input_errors(piece.name):
            signals = process(log, robot.joint_names, given, robot.slides)
        processed[piece.name].append(signals)
        recordings.append(Recording(piece.name, signals, piece.is_loaded, piece.order))
    notes = {}
    for name, of_log in processed.items():
        with prefix_input_errors(name):
            check_losses(of_log)
        notes[name] = [note for signals in of_log for note in signals.notes]
    return recordings, tuple(shared_notes(notes))


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


def identify_link(
    robot: RobotModel,
    recordings: Sequence[Recording],
    options: EstimationOptions,
    progress: Progress,
    unchanged: Sequence[str] = (),
) -> tuple[Fit, RestrictedFit]:
    """Return the fits of all terms and of the model file, from recordings without a payload.

    Args:
        unchanged: parts of the model file that stay as they are.

    Raises:
        InputError: no joint moves fast enough for its equations to be used.
    """
    progress.stage("Solving for parameters...")
    fitted = solved(robot, recordings, Question(options), progress)
    progress.stage(Detail("Fitting the model file..."))
    return fitted, fit_file(fitted, unchanged)


def identify_payload(
    robot: RobotModel,
    recordings: Sequence[Recording],
    question: Question,
    progress: Progress,
    unchanged: Sequence[str] = (),
) -> tuple[Fit, Fit, RestrictedFit | None]:
    """Return the fits with the known mass, without it, and of the arm's model file.

    The first two are one where no mass is known.
    """
    progress.stage(Detail("Estimating arm, friction and payload together..."))
    weighed = solved(robot, recordings, replace(question, known_mass=None), progress)
    if question.known_mass is not None:
        return solved(robot, recordings, question, progress), weighed, None
    if question.options.torques != "chain":
        return weighed, weighed, None
    progress.stage(Detail("Fitting the model file..."))
    carried, _ = written_payload(weighed)
    return weighed, weighed, fit_file(weighed, unchanged, carried)
