"""Logs of real arms to Measurement records, and back.

A log is a table with a row per sample: time, and position and torque of every chain joint;
velocity, acceleration and other columns as they come (see ``formats`` for what kind of file it
may be, ``columns``, ``column_map`` and ``column_file`` for how columns are found, ``checks`` for
what is checked). It is read in blocks; what is left of it after ``thinning`` is held in memory.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.checks import check_log
from robot_sysid.logs.column_file import ColumnChoices, Units, parse_units, read_columns_file
from robot_sysid.logs.column_map import ColumnMap, recognise_columns
from robot_sysid.logs.formats.known_text import merged
from robot_sysid.logs.formats.recognise import open_table
from robot_sysid.logs.formats.table import ArrayTable, LogTable
from robot_sysid.logs.options import LogOptions
from robot_sysid.logs.rows import read_rows
from robot_sysid.logs.timing import LogContext
from robot_sysid.records import Array, DataOrigin, JointLimits, Measurement, RobotModel, Source
from robot_sysid.records.atomic_files import whole_file
from robot_sysid.records.progress import Progress
from robot_sysid.records.torque_scale import CONSTANTS, SCALE, joint_factors
from robot_sysid.signals.pieces import piece_note, pieces_of


@dataclass(frozen=True)
class MeasurementLog:
    """A checked log.

    Attributes:
        path: the file.
        columns: which column was taken for what.
        samples: the usable rows.
        pieces: the samples between the gaps, those that are long enough.
        notes: one sentence each: which columns were used, what was mended, what looks odd.
    """

    path: Path
    columns: ColumnMap
    samples: Measurement
    pieces: tuple[Measurement, ...]
    notes: tuple[str, ...]

    def __fspath__(self) -> str:
        """The path, so that a log that was read may stand where its file is expected."""
        return str(self.path)

    __str__ = __fspath__

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.samples.time[-1] - self.samples.time[0])


def join_measurements(chunks: Iterable[Measurement]) -> Measurement:
    """Return consecutive chunks as one measurement."""
    parts = list(chunks)
    joined = {
        name: None if getattr(parts[0], name) is None
        else np.concatenate([getattr(part, name) for part in parts])
        for name in ("time", "q", "qd", "tau", "qdd", "joint_time", "command")
    }  # fmt: skip
    return Measurement(**joined)  # type: ignore[arg-type]


@dataclass(frozen=True)
class LogJoints:
    """The joints that a log is about.

    Attributes:
        names: the n chain joints, base to terminal.
        limits: what they may do; None checks no limits.
        is_slide: (n,) whether a joint is a slide, whose positions are metres; empty for none.
    """

    names: tuple[str, ...]
    limits: JointLimits | None = None
    is_slide: tuple[bool, ...] = ()

    @property
    def slides(self) -> list[bool]:
        """Whether each joint is a slide (n,)."""
        return list(self.is_slide) or [False] * len(self.names)


def read_log(
    source: Path | ArrayTable,
    joints: LogJoints,
    options: LogOptions,
    progress: Progress | None = None,
) -> MeasurementLog:
    """Recognise, check and open a log.

    Args:
        source: the log, a file, a folder or arrays.
        joints: what it is about.
        options: what was said of it.
        progress: where to tell how far it is.

    Raises:
        InputError: the log cannot be read, is ambiguous or cannot be what it seems to be.
    """
    path, names, slides = Path(source), joints.names, joints.slides
    table: LogTable
    table = source if isinstance(source, ArrayTable) else open_table(path, names, options)
    choices = read_columns_file(Path(options.columns), names) if options.columns else None
    own = choices or ColumnChoices()
    own = merged(replace(own, units=_declared_units(options.units, own)), table.choices)
    _require_titles(table, choices is not None)
    currents = options.torque_constants is not None
    wanted = currents, options.commanded
    found = recognise_columns(table.titles, names, own, table.first_row, slides, *wanted)
    factor = torque_factor(options, names)
    if factor is not None:
        found = found.with_torque_factor(factor)
    rows = read_rows(table, found, slides, progress)
    declared = found.angle_declared
    context = LogContext(str(path), names, joints.limits, np.array(slides), declared)
    checked = check_log(rows, context)
    pieces = pieces_of(rows.samples)
    notes = (f"log layout: {table.layout}", *found.describe(), *checked)
    return MeasurementLog(
        path, found, rows.samples, pieces, (*notes, *piece_note(rows.samples, pieces))
    )


def open_log(
    robot: RobotModel,
    source: Path | ArrayTable | MeasurementLog,
    options: LogOptions,
    progress: Progress | None = None,
) -> MeasurementLog:
    """Recognise, check and open a log of an arm, see ``read_log``; one that is open stays so."""
    if isinstance(source, MeasurementLog):
        return source
    joints = LogJoints(robot.joint_names, robot.limits, tuple(robot.is_slide.tolist()))
    return read_log(source, joints, options, progress)


def origin_of(logs: Sequence[MeasurementLog]) -> DataOrigin:
    """Return where the data of some logs comes from."""
    duration = sum(log.duration for log in logs)
    rate = sum(len(log.samples) - 1 for log in logs) / duration
    words = ", ".join(str(log.path) for log in logs)
    files = tuple(str(log.path.absolute()) for log in logs)
    return DataOrigin(Source.LOG, words, duration, rate, files=files)


def torque_factor(options: LogOptions, joint_names: Sequence[str]) -> Array | None:
    """Return (n,) what the options multiply torque columns with; None for nothing.

    Raises:
        InputError: there are not as many numbers as joints, or a file does not fit.
    """
    if options.torque_scale is None and options.torque_constants is None:
        return None
    factor = np.ones(len(joint_names))
    if options.torque_constants is not None:
        factor *= joint_factors(options.torque_constants, joint_names, CONSTANTS)
    if options.torque_scale is not None:
        factor /= joint_factors(options.torque_scale, joint_names, SCALE)
    return factor


def write_measurement_csv(
    path: Path,
    joint_names: Sequence[str],
    chunks: Iterable[Measurement],
    header_comments: Sequence[str] = (),
) -> None:
    """Write samples in the form ``read_log`` reads, with every digit.

    The file appears whole or not at all.

    Args:
        path: where to.
        joint_names: the n chain joints; columns are called ``<joint>_position`` and so on.
        chunks: the samples in order, at least one chunk.
        header_comments: lines written above the titles, each after a "#".

    Raises:
        InputError: there are no samples, or the file cannot be written.
    """
    with whole_file(path) as stream:
        stream.writelines(f"# {' '.join(comment.splitlines())}\n" for comment in header_comments)
        writer = csv.writer(stream, lineterminator="\n")
        _write_chunks(writer.writerow, joint_names, chunks)


def _write_chunks(
    write_row: Callable[[Iterable[str]], object],
    joint_names: Sequence[str],
    chunks: Iterable[Measurement],
) -> None:
    quantities: tuple[tuple[str, str], ...] = ()
    for chunk in chunks:
        if not quantities:
            quantities = _written_quantities(chunk)
            write_row(["time", *(f"{j}_{name}" for name, _ in quantities for j in joint_names)])
        values = [getattr(chunk, attribute) for _, attribute in quantities]
        for row in np.column_stack((chunk.time, *values)):
            write_row(map(repr, row.tolist()))
    if not quantities:
        raise InputError("there are no samples to write")


def _written_quantities(chunk: Measurement) -> tuple[tuple[str, str], ...]:
    names = (("position", "q"), ("velocity", "qd"), ("torque", "tau"), ("acceleration", "qdd"))
    quantities = (*names, ("time", "joint_time"))
    return tuple(pair for pair in quantities if getattr(chunk, pair[1]) is not None)


def _require_titles(table: LogTable, has_columns_file: bool) -> None:
    if has_columns_file or table.titles[:1] != ("#1",):
        return
    raise InputError(
        f"{table.path} has no column titles; say which of its {len(table.titles)} columns is what "
        "with --columns FILE, for instance 'time = #1' and 'position = #2, #3, ...'"
    )


def _declared_units(units: str | None, choices: ColumnChoices) -> Units:
    given = parse_units(units) if units else Units()
    return Units(given.angle or choices.units.angle, given.time or choices.units.time)
