"""The stage between arm and files of ``robot-sysid payload``: read, identify."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.config import LOADED, PayloadConfig
from robot_sysid.diagnosis.run import look_at
from robot_sysid.errors import InputError
from robot_sysid.estimation.answer import Answer
from robot_sysid.estimation.dataset import Dataset, RestingPoses
from robot_sysid.estimation.identify import (
    Piece,
    answer_payload,
    low_pass_recordings,
    shared_notes,
)
from robot_sysid.estimation.result import payload_of
from robot_sysid.estimation.unknowns import SCALES, Question, Unknowns
from robot_sysid.logs.reader import open_log
from robot_sysid.model.flange import find_flange
from robot_sysid.records import Array, DataOrigin, Measurement, RobotModel, Source
from robot_sysid.records.progress import Progress
from robot_sysid.records.torque_scale import SCALE, joint_factors
from robot_sysid.results.record import Figure, Payload, Result
from robot_sysid.signals.poses import resting_poses

LEAST_WITHIN = 0.15
"""Share of the spread of places within one kind of recording below which a drift and the payload
cannot be told apart: 0 for A B, 0.2 for A A B B at equal distances, 1 for A B B A."""


@dataclass(frozen=True)
class RawRecording(Piece):
    """A whole log as it was read, its place not looked for yet; the same cut at long
    holes, and what reading it had to say, one sentence each.
    """

    pieces: tuple[Measurement, ...] = ()
    notes: tuple[str, ...] = ()


def weighed(
    config: PayloadConfig, robot: RobotModel, progress: Progress
) -> tuple[Answer, Result]:
    """Identify a payload and write nothing; returns the estimate and all that is said of it."""
    options = config.payload
    flange = find_flange(robot, options.flange)
    if flange.note:
        progress.note(flange.note)
    raw = _recordings(config, robot, progress)
    at = places(raw, options.order)
    drifts = not options.static and at is not None and drift_shows(raw, at)
    datasets, notes = _datasets(config, robot, raw, at)
    if not drifts and not options.static:
        notes = (*notes, _no_drift(raw, at is not None))
    progress.note(*notes)
    question = Question(
        config.estimation,
        loaded=True,
        drifts=drifts,
        known_mass=options.known_mass,
        resting=options.static,
    )
    answer, free = answer_payload(
        robot, datasets, question, progress, config.output.keep
    )
    duration = sum(float(np.ptp(each.samples.time)) for each in raw)
    rate = sum(len(each.samples) - 1 for each in raw) / duration
    origin = DataOrigin(
        Source.LOG, ", ".join(each.name for each in raw), duration, rate
    )
    result = payload_of(answer, free, flange, origin)
    if config.log.torque_scale is not None and result.payload is not None:
        divided = joint_factors(config.log.torque_scale, robot.joint_names, SCALE)[0]
        factors = dict(zip(robot.joint_names, divided.tolist()))
        result = replace(
            result, payload=_combined(result.payload, factors, answer.fit.unknowns)
        )
    progress.note(*result.notes[len(robot.notes) :])
    return answer, result


def _combined(
    payload: Payload, divided: Mapping[str, float], sought: Unknowns
) -> Payload:
    """Return a payload with the scales of the log's own torques, which were divided before."""
    # Where what is found contradicts what they were divided by, errors are as many times as large
    # as the prior had to be widened (the Birge ratio of means that do not agree).
    apart = max(
        [1.0, *(group.widened for group in sought.groups if group.cause == SCALES)]
    )
    scales = {
        joint: Figure(divided[joint] * each.value, divided[joint] * apart * each.error)
        for joint, each in payload.torque_scale.items()
    }
    return replace(payload, torque_scale=scales)


def _datasets(
    config: PayloadConfig,
    robot: RobotModel,
    raw: Sequence[RawRecording],
    at: Array | None,
) -> tuple[list[Dataset], tuple[str, ...]]:
    place = np.zeros(len(raw)) if at is None else at
    if config.payload.static:
        found = []
        told = {}
        for each, where in zip(raw, place.tolist()):
            try:
                poses, used = resting_poses(each.samples, robot.joint_names)
            except InputError as error:
                raise InputError(f"{each.name}: {error}") from None
            found.append(
                Dataset(each.name, RestingPoses(poses, used), each.is_loaded, where)
            )
            told[each.name] = (
                *each.notes,
                f"{len(poses)} poses, each approached from both sides",
            )
        return found, tuple(shared_notes(told))
    pieces = []
    for each, where in zip(raw, place.tolist()):
        for number, samples in enumerate(each.pieces, start=1):
            name = f"{each.name} (part {number})" if len(each.pieces) > 1 else each.name
            pieces.append(Piece(name, samples, each.is_loaded, where))
    datasets, said = low_pass_recordings(robot, pieces, config.estimation)
    return datasets, (*shared_notes({each.name: each.notes for each in raw}), *said)


def _no_drift(raw: Sequence[RawRecording], known: bool) -> str:
    order = (
        "their order does not tell it from the payload"
        if known or len(raw) == 2
        else "the order in which they were recorded is not known (--order tells it)"
    )
    return (
        f"a drift of friction over the {len(raw)} logs is not estimated: {order}; record in the "
        "order empty, loaded, loaded, empty"
    )


def _recordings(
    config: PayloadConfig, robot: RobotModel, progress: Progress
) -> list[RawRecording]:
    """Return all recordings, empty ones first."""
    options = config.payload
    found = []
    kinds = [(path, False) for path in options.empty] + [
        (path, True) for path in options.loaded
    ]
    for path, is_loaded in kinds:
        progress.stage(f"Reading {'loaded' if is_loaded else 'empty'} log {path}...")
        log = open_log(robot, path, config.log, progress)
        if not options.static:  # an arm at rest shows none of what is looked for
            look_at(robot, log, config.log.accept, progress, links_known=False)
        whole = str(path), log.samples, is_loaded
        found.append(RawRecording(*whole, pieces=log.pieces, notes=log.notes))
    return found


def places(recordings: Sequence[RawRecording], order: str | None) -> Array | None:
    """Return each recording's place (k,) from -1, the first, to 1, the last, empty ones first; None
    where the order is not known: without letters of ``--order`` and clocks that the logs share.
    """
    if order is not None:
        kinds = [letter == LOADED for letter in order]
        turns = {
            kind: iter(np.flatnonzero(np.equal(kinds, kind))) for kind in (False, True)
        }
        return _scaled(
            np.array([float(next(turns[each.is_loaded])) for each in recordings])
        )
    spans = sorted(
        (float(r.samples.time[0]), float(r.samples.time[-1])) for r in recordings
    )
    if any(after[0] <= before[1] for before, after in zip(spans, spans[1:])):
        return None
    return _scaled(np.array([np.mean(r.samples.time[[0, -1]]) for r in recordings]))


def drift_shows(recordings: Sequence[RawRecording], at: Array) -> bool:
    """Tell whether the order lets a drift be told from the payload."""
    kinds = np.array([each.is_loaded for each in recordings])
    within = sum(
        np.sum((at[kinds == kind] - np.mean(at[kinds == kind])) ** 2) for kind in (0, 1)
    )
    return bool(within >= LEAST_WITHIN * np.sum((at - np.mean(at)) ** 2) > 0.0)


def _scaled(at: Array) -> Array:
    low = float(np.min(at))
    high = float(np.max(at))
    return 2.0 * (at - low) / (high - low) - 1.0 if high > low else 0.0 * at
