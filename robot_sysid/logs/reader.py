"""Logs of real arms to Measurement records, and back.

A log is a table with a row per sample: time, and position and torque of every chain joint;
velocity and other columns as they come (see ``formats`` for what kind of file it
may be, ``columns`` and ``column_map`` for how columns are found, ``checks`` for what is checked).
It is read in blocks; what is left of it after thinning is held in memory.
"""

from __future__ import annotations

import functools
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from robot_sysid.errors import ColumnsError, InputError
from robot_sysid.logs import LogOptions, arrays, column_map
from robot_sysid.logs.checks import check_log
from robot_sysid.logs.ros_bag import bag_table
from robot_sysid.logs.table import Asked, LogTable, followed, read_rows
from robot_sysid.logs.text import is_number, text_table
from robot_sysid.logs.titles import joint_kind, read_title
from robot_sysid.records import Array, DataOrigin, Measurement, RobotModel, Source
from robot_sysid.records.progress import Detail, Progress
from robot_sysid.records.torque_scale import CONSTANTS, SCALE, joint_factors
from robot_sysid.signals.process import LogPiece
from robot_sysid.signals.resampling import piece_notes, split_at_gaps
from robot_sysid.special_files import refuse_special_file


@dataclass(frozen=True, repr=False)
class MeasurementLog:
    """A checked log, the pieces between its gaps that are long enough, what there is to say, and
    what its torques were divided by (n,), as the user gave it.
    """

    path: Path
    columns: column_map.ColumnMap
    samples: Measurement
    pieces: tuple[LogPiece, ...]
    notes: tuple[str, ...]
    torque_scale: Array

    def __fspath__(self) -> str:
        """The path, so that a log that was read may stand where its file is expected."""
        return str(self.path)

    __str__ = __fspath__

    def __repr__(self) -> str:
        what = f"{len(self.samples)} samples of {self.samples.q.shape[1]} joints"
        return f"<MeasurementLog {self.path}: {what} in {self.duration:.4g} s>"

    def _repr_html_(self) -> str:
        """Return what was read, and what there is to say of it, for a notebook."""
        notes = "".join(f"<li>{escape(note)}</li>" for note in self.notes)
        return f"<p>{escape(repr(self))}</p><ul>{notes}</ul>"

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.samples.time[-1] - self.samples.time[0])


def open_log(
    robot: RobotModel,
    source: Path | LogTable | MeasurementLog,
    options: LogOptions,
    progress: Progress | None = None,
) -> MeasurementLog:
    """Recognise, check and open a log of an arm, or raise InputError; one that is open stays so."""
    if isinstance(source, MeasurementLog):
        return source
    path = Path(source)
    names = robot.joint_names
    slides = robot.is_slide.tolist()
    table = source if isinstance(source, LogTable) else open_table(path, names, options)
    found = _columns(table, path, robot, options)
    tables = (CONSTANTS, options.torque_constants), (SCALE, options.torque_scale)
    constants, scale = (
        np.ones(len(names)) if given is None else joint_factors(given, names, name)[0]
        for name, given in tables
    )
    found = found.with_torque_factor(constants / scale)
    rows = read_rows(table, found, slides, progress)
    checked = check_log(str(path), rows, robot, found.angle_declared)
    pieces = tuple(map(LogPiece.of, split_at_gaps(rows.samples)))
    taken = map(Detail, (f"log layout: {table.layout}", *found.describe()))
    notes = (*taken, *checked, *piece_notes(rows.samples, pieces))
    return MeasurementLog(path, found, rows.samples, pieces, notes, scale)


def _columns(
    table: LogTable, path: Path, robot: RobotModel, options: LogOptions
) -> column_map.ColumnMap:
    """Return what each column of a log is, declared or recognised."""
    names = robot.joint_names
    slides = robot.is_slide.tolist()
    choices = (
        column_map.parse_units(options.units)
        if options.units
        else column_map.ColumnChoices()
    )
    if options.columns:
        choices = choices.over(
            column_map.read_columns_file(Path(options.columns), names)
        )
    elif table.titles[:1] == ("#1",):
        raise ColumnsError(
            f"{table.path} has no column titles; say which of its {len(table.titles)} columns is "
            "what with --columns FILE, for instance 'time = #1' and 'position = #2-8'",
            column_map.draft(
                table.titles, names, "command" if options.commanded else "torque"
            ),
            f"{path.stem}_columns.txt",
        )
    wanted = options.torque_constants is not None, options.commanded
    try:
        return column_map.recognise_columns(
            table.titles,
            names,
            choices.over(table.choices),
            table.first_row,
            slides,
            *wanted,
        )
    except ColumnsError as error:
        if table.elsewhere:
            raise InputError(f"{path}: {error}; {table.elsewhere}") from None
        raise ColumnsError(
            f"{path}: {error}", error.draft, f"{path.stem}_columns.txt"
        ) from None


def origin_of(logs: Sequence[MeasurementLog]) -> DataOrigin:
    """Return where the data of some logs comes from."""
    duration = sum(log.duration for log in logs)
    rate = sum(len(log.samples) - 1 for log in logs) / duration
    words = ", ".join(str(log.path) for log in logs)
    paths = (log.path for log in logs)
    files = tuple(
        str(path if path == STANDARD_INPUT else path.absolute()) for path in paths
    )
    return DataOrigin(Source.LOG, words, duration, rate, files=files)


_FORMS: Mapping[bytes, Callable[[Asked], LogTable]] = {
    **dict.fromkeys((b"\x89MCAP0", b"#ROSBAG V", b"SQLite format 3"), bag_table),
    b"MATLAB 5.0": arrays.matlab_table,
    # .mat files are HDF5 since version 7.3.
    **dict.fromkeys((b"\x89HDF\r\n\x1a\n", b"MATLAB 7.3"), arrays.hdf5_table),
    b"PK\x03\x04": arrays.npz_table,
    b"PAR1": arrays.parquet_table,
    b"ARROW1": arrays.feather_table,
}
"""How files of a form begin, to what reads it; what begins otherwise is a text table."""
_FOLDERS = {"metadata.yaml": bag_table, "meta/info.json": arrays.lerobot_table}
"""The file by which a folder is known, to what reads it."""
_ONLY = {
    "topic": ("a ROS bag", bag_table),
    "episode": ("a LeRobot data set", arrays.lerobot_table),
}
"""Options that only one form knows."""


STANDARD_INPUT = Path("-")
"""Stands for a log that is piped in."""


@functools.cache
def _piped() -> Path:
    """Return what is piped in as a file; it is read once, and looked at more often."""
    if sys.stdin is None or sys.stdin.isatty():
        raise InputError("- stands for a log that is piped in, and nothing is")
    _KEPT.append(tempfile.TemporaryDirectory(prefix="robot-sysid-"))
    path = Path(_KEPT[-1].name, "standard input")
    with path.open("wb") as file:
        shutil.copyfileobj(sys.stdin.buffer, file)
    return path


_KEPT: list[tempfile.TemporaryDirectory[str]] = []


_READ_TWICE = "a log is read twice: write it to a file, or pipe it into this command and call it -"


def open_table(path: Path, joint_names: Sequence[str], options: LogOptions) -> LogTable:
    """Return a recording as a table."""
    path = _piped() if path == STANDARD_INPUT else path
    is_folder = os.path.isdir(path)  # Path.is_dir raises where a name is too long
    start = b""
    try:
        if not is_folder:
            refuse_special_file(path, _READ_TWICE)
            with path.open("rb") as stream:
                start = stream.read(4096)
    except OSError as error:
        raise InputError(
            f"cannot read the log {path}: {error.strerror or error}"
        ) from error
    known = (
        read for name, read in _FOLDERS.items() if is_folder and (path / name).is_file()
    )
    read = next(
        (_FORMS[first] for first in _FORMS if start.startswith(first)), text_table
    )
    read = next(known, read)
    for option, (what, only) in _ONLY.items():
        if getattr(options, option) and read is not only:
            raise InputError(
                f"--{option} is about {what}, and {path} is none; leave it off"
            )
    if read is text_table and is_folder:
        raise InputError(
            f"{path} is a folder of no known form; a log is a text table (CSV), a ROS 1 or ROS 2 "
            "bag, a LeRobot data set, HDF5, Parquet, Feather, NumPy .npz or MATLAB .mat"
        )
    return read(Asked(path, start, joint_names, options))


def content_lines(path: Path, options: LogOptions, progress: Progress) -> list[str]:
    """Return lines on a log's form and on the numbers in each of its columns."""
    table = open_table(Path(path), (), options)
    numeric = [k for k, cell in enumerate(table.first_row) if is_number(cell)]
    columns = numeric if table.first_row else list(range(len(table.titles)))
    least, most, holes = np.tile([[np.nan], [np.nan], [0.0]], len(columns))
    rows = 0
    for block in followed(table, columns, progress):
        rows += len(block.cells)
        cells = np.where(np.isfinite(block.cells), block.cells, np.nan)
        holes += np.count_nonzero(np.isnan(cells), axis=0)
        least = np.fmin.reduce(np.vstack((least, cells)))
        most = np.fmax.reduce(np.vstack((most, cells)))
    lines = [f"log layout: {table.layout}", f"{rows} {table.word}s"]
    width = max(map(len, table.titles))
    for column, low, high, missing in zip(columns, least, most, holes):
        title = read_title(table.titles[column])
        kind = "time" if title.kind == "time" else joint_kind(title)
        numbers = f"{low:12.6g} to {high:12.6g}" if low <= high else "no numbers"
        empty = f", {missing:.0f} empty" if missing else ""
        lines.append(
            f"  {title.text:{width}}  {numbers}{empty}"
            + (f"  ({kind})" if kind else "")
        )
    lines.append(
        "give the model too, to see which column is taken for what and what is wrong"
    )
    return lines
