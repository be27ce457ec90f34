"""From raw recordings to those that are fitted: filtered with one cut-off, or resting poses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.judgement.signs import compared_with_model
from robot_sysid.identify.payload.data.poses import resting_rows
from robot_sysid.identify.payload.data.recordings import RawRecording
from robot_sysid.identify.payload.data.rows import FilteredRows, RestingRows
from robot_sysid.identify.payload.equations import Recording
from robot_sysid.records import Array, Measurement, Motion, RobotModel
from robot_sysid.signals.process import ProcessedSignals, process, with_one_cutoff


@dataclass(frozen=True)
class Processed:
    """Recordings ready to be fitted.

    Attributes:
        recordings: they, in the order of the logs.
        cutoff: of the low-pass [Hz]; None for resting poses.
        notes: one sentence each.
    """

    recordings: tuple[Recording, ...]
    cutoff: float | None
    notes: tuple[str, ...]

    @property
    def motion(self) -> Motion:
        """Some of the measured motion."""
        return self.recordings[-1].source.motion


def filtered(
    robot: RobotModel, raw: Sequence[RawRecording], at: Array | None, options: EstimationOptions
) -> Processed:
    """Return the recordings, each filtered on its own, with the lowest cut-off one asks for.

    Args:
        robot: the arm.
        raw: the logs.
        at: (k,) their places in time, or None where they are not known.
        options: cut-off and deadband, where they were given.

    Raises:
        InputError: a joint's torque has the opposite sign of the model's.
    """

    def signals(each: _Piece, cutoff: float | None) -> ProcessedSignals:
        band, least = options.velocity_deadband, each.log.least_deadband
        try:
            return process(each.samples, robot.joint_names, cutoff, band, least)
        except InputError as error:
            raise InputError(f"{each.name}: {error}") from None

    pieces = list(_pieces(raw, at))
    found = with_one_cutoff(pieces, signals, options.cutoff)
    told: dict[str, tuple[str, ...]] = {each.name: each.notes for each in raw}
    for piece, signal in zip(pieces, found):
        notes = (*told[piece.log.name], *signal.notes, *compared_with_model(robot, signal))
        told[piece.log.name] = tuple(dict.fromkeys(notes))
    recordings = [
        Recording(piece.name, piece.log.is_loaded, FilteredRows(signal), piece.place)
        for piece, signal in zip(pieces, found)
    ]
    return Processed(tuple(recordings), found[0].cutoff, tuple(_shared_notes(told)))


@dataclass(frozen=True)
class _Piece:
    """A stretch of a log without long holes."""

    name: str
    log: RawRecording
    samples: Measurement
    place: float


def _pieces(raw: Sequence[RawRecording], at: Array | None) -> Iterator[_Piece]:
    places = np.zeros(len(raw)) if at is None else at
    for log, place in zip(raw, places.tolist()):
        for number, samples in enumerate(log.pieces, start=1):
            part = f" (part {number})" if len(log.pieces) > 1 else ""
            yield _Piece(f"{log.name}{part}", log, samples, place)


def resting(robot: RobotModel, raw: Sequence[RawRecording], at: Array | None) -> Processed:
    """Return the poses of the recordings at which the arm rests; arguments as above."""
    sources = [_resting_rows(robot, each) for each in raw]
    told = {
        each.name: (*each.notes, f"{len(source.poses)} poses, each approached from both sides")
        for each, source in zip(raw, sources)
    }
    places = np.zeros(len(raw)) if at is None else at
    recordings = [
        Recording(each.name, each.is_loaded, source, float(place))
        for each, source, place in zip(raw, sources, places)
    ]
    return Processed(tuple(recordings), None, tuple(_shared_notes(told)))


def _resting_rows(robot: RobotModel, raw: RawRecording) -> RestingRows:
    try:
        return resting_rows(raw.samples, robot.joint_names)
    except InputError as error:
        raise InputError(f"{raw.name}: {error}") from None


def _shared_notes(told: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Yield each note once, with the recordings that it is about."""
    for note in dict.fromkeys(note for notes in told.values() for note in notes):
        about = [name for name, notes in told.items() if note in notes]
        yield f"{'all recordings' if len(about) == len(told) else ', '.join(about)}: {note}"
