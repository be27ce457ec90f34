"""Identification of a payload from recordings without and with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from robot_sysid.config import PayloadConfig, PayloadOptions
from robot_sysid.diagnosis.log_checks import check_log
from robot_sysid.errors import InputError
from robot_sysid.estimate import identify
from robot_sysid.estimate.identify import Piece, low_pass_recordings, shared_notes
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.payload import payload_result
from robot_sysid.estimate.questions import Question
from robot_sysid.estimate.result import traces_of
from robot_sysid.estimate.rows import Poses, Recording
from robot_sysid.logs import CHECKS, LogOptions
from robot_sysid.logs.reader import open_log, refuse_repeated_logs
from robot_sysid.model.bodies import find_flange
from robot_sysid.motion import LOADED
from robot_sysid.records import Array, DataOrigin, Measurement, RobotModel, Source
from robot_sysid.records.messages import Progress
from robot_sysid.records.option_fields import SCALE, joint_factors
from robot_sysid.results.record import Payload, Quantity, Result
from robot_sysid.signals.rests import resting_poses

LEAST_WITHIN = 0.15
"""Least share of the variance of positions in the order of recording that lies within the empty and
within the loaded logs, for a drift to be told apart from the payload: 0 for the order A B, 0.2 for
A A B B at equal distances, 1 for A B B A."""

CHECKS_AT_REST = (
    "torque-scale",
    "torque-unit",
    "gravity",
    "computed",
    "sign",
    "order",
    "angle-unit",
)
"""Checks of columns and units, for which the slow motion between poses at rest is enough."""


@dataclass(frozen=True)
class RawRecording(Piece):
    """A log as it was read: ``samples`` of the whole log, and what else reading it returned.

    Attributes:
        pieces: the log cut at long holes.
        notes: what reading it had to say, one sentence each.
    """

    pieces: tuple[Measurement, ...] = ()
    notes: tuple[str, ...] = ()


def identify_payload(
    config: PayloadConfig, robot: RobotModel, progress: Progress
) -> Result:
    """Identify a payload from the logs that a configuration names; no file is written.

    Args:
        config: names the empty and the loaded logs, and how they are read and fitted.
        robot: the arm that carries the payload.
        progress: receives stages and notes.

    Raises:
        InputError: a log cannot be used, or is refused by the checks.
    """
    options = config.payload
    flange = find_flange(robot, options.flange)
    if flange.note:
        progress.note(flange.note)
    recordings = _read_recordings(options, config.log, robot, progress)
    positions = order_positions(recordings, options.order)
    drifts = (
        not options.static
        and positions is not None
        and is_drift_identifiable(recordings, positions)
    )
    order = np.zeros(len(recordings)) if positions is None else positions
    if options.static:
        datasets, notes = _resting_datasets(recordings, order)
    else:
        datasets, notes = _moving_datasets(robot, recordings, order, config.estimation)
    if not drifts and not options.static:
        is_order_known = positions is not None
        notes = (*notes, _no_drift_note(recordings, is_order_known))
    progress.note(*notes)
    question = Question(
        config.estimation,
        loaded=True,
        drifts=drifts,
        known_mass=options.known_mass,
        resting=options.static,
    )
    fitted, weighed, file = identify.identify_payload(
        robot, datasets, question, progress, config.estimation.keep
    )
    result = payload_result(fitted, weighed, file, flange, _origin(recordings))
    if config.log.torque_scale is not None and result.payload is not None:
        factors = joint_factors(config.log.torque_scale, robot.joint_names, SCALE)[0]
        applied_scales = dict(zip(robot.joint_names, factors.tolist()))
        payload = _with_applied_scales(result.payload, applied_scales)
        result = replace(result, payload=payload)
    progress.note(*result.notes[len(robot.notes) :])
    checkpoints = fitted.recordings[-1].motion
    traces = partial(traces_of, fitted, None)
    return replace(result, checkpoints=checkpoints, traces=traces)


def _origin(recordings: Sequence[RawRecording]) -> DataOrigin:
    """Return where recordings come from, with their whole duration and mean sample rate."""
    names = ", ".join(recording.name for recording in recordings)
    duration = 0.0
    n_intervals = 0
    for recording in recordings:
        duration += float(np.ptp(recording.samples.time))
        n_intervals += len(recording.samples) - 1
    return DataOrigin(Source.LOG, names, duration, n_intervals / duration)


def _with_applied_scales(
    payload: Payload, applied_scales: Mapping[str, float]
) -> Payload:
    """Return a payload whose torque scales are those of the log before scales were applied.

    Args:
        payload: as estimated from torques that were divided by the applied scales.
        applied_scales: joint to the scale that the log's torques were divided by.
    """
    scales = {}
    for joint, figure in payload.torque_scale.items():
        applied = applied_scales[joint]
        scales[joint] = Quantity(applied * figure.value, applied * figure.error)
    return replace(payload, torque_scale=scales)


def _moving_datasets(
    robot: RobotModel,
    recordings: Sequence[RawRecording],
    positions: Array,
    options: EstimationOptions,
) -> tuple[list[Recording], tuple[str, ...]]:
    """Return recordings as low-passed signals, and notes on them.

    Args:
        robot: the arm.
        recordings: k logs; each piece between long holes becomes a data set.
        positions: (k,) of ``order_positions``; all zero where the order is not known.
        options: say how signals are low-passed.
    """
    pieces = []
    notes = {}
    for recording, position in zip(recordings, positions.tolist()):
        notes[recording.name] = recording.notes
        for samples in recording.pieces:
            name = recording.name
            pieces.append(Piece(name, samples, recording.is_loaded, position))
    datasets, filter_notes = low_pass_recordings(robot, pieces, options.cutoff)
    return datasets, (*shared_notes(notes), *filter_notes)


def _resting_datasets(
    recordings: Sequence[RawRecording], positions: Array
) -> tuple[list[Recording], tuple[str, ...]]:
    """Return recordings as poses at rest, and notes on them, one sentence each.

    Args:
        recordings: k logs of slow motions that rest at poses, each approached from both sides.
        positions: (k,) of ``order_positions``; all zero where the order is not known.

    Raises:
        InputError: a recording holds no such poses; its message begins with the recording's name.
    """
    datasets = []
    notes = {}
    for recording, position in zip(recordings, positions.tolist()):
        name = recording.name
        try:
            poses, used = resting_poses(recording.samples)
        except InputError as error:
            raise InputError(f"{name}: {error}") from None
        resting = Poses(poses, used)
        datasets.append(Recording(name, resting, recording.is_loaded, position))
        pose_note = f"{len(poses)} poses, each approached from both sides"
        notes[name] = (*recording.notes, pose_note)
    return datasets, tuple(shared_notes(notes))


def _no_drift_note(recordings: Sequence[RawRecording], is_order_known: bool) -> str:
    """Return the sentence that says why no drift of friction is estimated, and what to do."""
    reason = "their order does not tell it from the payload"
    if not is_order_known and len(recordings) != 2:
        reason = "the order in which they were recorded is not known (--order tells it)"
    return (
        f"a drift of friction over the {len(recordings)} logs is not estimated: {reason}; record "
        "in the order empty, loaded, loaded, empty"
    )


def _read_recordings(
    options: PayloadOptions,
    log_options: LogOptions,
    robot: RobotModel,
    progress: Progress,
) -> list[RawRecording]:
    """Return all recordings, empty ones first; each is read and checked.

    Args:
        options: name the logs without and with the payload.
        log_options: how a log is read, and which of its faults are accepted.
        robot: the arm.
        progress: receives a stage per log, and the findings.

    Raises:
        InputError: a log cannot be read or is refused.
    """
    kinds = [(path, False) for path in options.empty]
    kinds += [(path, True) for path in options.loaded]
    recordings = []
    for path, is_loaded in kinds:
        progress.stage(f"Reading {'loaded' if is_loaded else 'empty'} log {path}...")
        log = open_log(robot, path, log_options, progress)
        checks = CHECKS_AT_REST if options.static else CHECKS
        log = check_log(
            robot, log, log_options.accept, progress, links_known=False, checks=checks
        )
        recordings.append(
            RawRecording(
                str(path), log.samples, is_loaded, pieces=log.pieces, notes=log.notes
            )
        )
    refuse_repeated_logs((log.name, log.samples) for log in recordings)
    return recordings


def order_positions(
    recordings: Sequence[RawRecording], order: str | None
) -> Array | None:
    """Return each recording's position (k,) in the order of recording, from -1 to 1.

    None where the order is not known: without ``order`` and a clock that all logs share.

    Args:
        recordings: empty ones first.
        order: a letter of ``--order`` for each recording, A for an empty one; or None.
    """
    if order is not None:
        # The k-th A is the k-th empty recording, and so for B: a stable sort keeps their order.
        is_loaded = np.array([letter == LOADED for letter in order])
        return _scaled_to_unit(np.argsort(is_loaded, kind="stable").astype(float))
    ends = np.array([recording.samples.time[[0, -1]] for recording in recordings])
    spans = ends[np.lexsort(ends.T[::-1])]
    # Logs that overlap in time do not share a clock.
    if np.any(spans[1:, 0] <= spans[:-1, 1]):
        return None
    return _scaled_to_unit(np.mean(ends, axis=1))


def is_drift_identifiable(recordings: Sequence[RawRecording], positions: Array) -> bool:
    """Return whether the order (k,) of empty and loaded recordings separates drift and payload."""
    is_loaded = np.array([recording.is_loaded for recording in recordings])
    within = 0.0
    for loaded in (False, True):
        side_positions = positions[is_loaded == loaded]
        within += np.sum((side_positions - np.mean(side_positions)) ** 2)
    total = np.sum((positions - np.mean(positions)) ** 2)
    return bool(within >= LEAST_WITHIN * total > 0.0)


def _scaled_to_unit(positions: Array) -> Array:
    """Return numbers (k,) scaled to the range from -1 to 1; zeros where all are equal."""
    low = float(np.min(positions))
    high = float(np.max(positions))
    if high <= low:
        return 0.0 * positions
    return 2.0 * (positions - low) / (high - low) - 1.0
