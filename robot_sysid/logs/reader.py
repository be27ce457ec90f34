"""Logs of real arms to Measurement records, and back.

A log is a table with a row per sample: time, and position and torque of every chain joint;
velocity, acceleration and other columns as they come (see ``formats`` for what kind of file it
may be, ``columns`` and ``column_map`` for how columns are found, ``checks`` for what is checked).
It is read in blocks; what is left of it after thinning is held in memory.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.json_files import read_json
from robot_sysid.logs import column_map
from robot_sysid.logs.checks import check_log
from robot_sysid.logs.columns import joint_kind, read_title
from robot_sysid.logs.formats.arrays import hdf5_table, lerobot_table, matlab_table, npz_table
from robot_sysid.logs.formats.ros_bag import bag_table
from robot_sysid.logs.formats.table import Asked, LogTable
from robot_sysid.logs.formats.text import is_number, text_table
from robot_sysid.logs.options import LogOptions
from robot_sysid.logs.rows import followed, read_rows
from robot_sysid.records import Array, DataOrigin, Measurement, RobotModel, Source
from robot_sysid.records.atomic_files import whole_file
from robot_sysid.records.progress import Progress
from robot_sysid.records.torque_scale import CONSTANTS, SCALE, joint_factors
from robot_sysid.signals.process import LogPiece
from robot_sysid.signals.resampling import piece_note, pieces_of


@dataclass(frozen=True)
class MeasurementLog:
    """A checked log.

    Attributes:
        pieces: the samples between the gaps, those that are long enough.
        notes: one sentence each: which columns were used, what was mended, what looks odd.
    """

    path: Path
    columns: column_map.ColumnMap
    samples: Measurement
    pieces: tuple[LogPiece, ...]
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
    there = [each.name for each in fields(Measurement) if getattr(parts[0], each.name) is not None]
    joined: dict[str, Any] = {"qd": None}
    joined |= {name: np.concatenate([getattr(part, name) for part in parts]) for name in there}
    return Measurement(**joined)


def open_log(
    robot: RobotModel,
    source: Path | LogTable | MeasurementLog,
    options: LogOptions,
    progress: Progress | None = None,
) -> MeasurementLog:
    """Recognise, check and open a log of an arm; one that is open stays so.

    Raises:
        InputError: the log cannot be read, is ambiguous or cannot be what it seems to be.
    """
    if isinstance(source, MeasurementLog):
        return source
    path, names, slides = Path(source), robot.joint_names, robot.is_slide.tolist()
    table = source if isinstance(source, LogTable) else open_table(path, names, options)
    choices = column_map.parse_units(options.units) if options.units else column_map.ColumnChoices()
    if options.columns:
        choices = choices.over(column_map.read_columns_file(Path(options.columns), names))
    elif table.titles[:1] == ("#1",):
        raise InputError(
            f"{table.path} has no column titles; say which of its {len(table.titles)} columns is "
            "what with --columns FILE, for instance 'time = #1' and 'position = #2, #3, ...'"
        )
    wanted = options.torque_constants is not None, options.commanded
    choices = choices.over(table.choices)
    found = column_map.recognise_columns(
        table.titles, names, choices, table.first_row, slides, *wanted
    )
    found = found.with_torque_factor(torque_factor(options, names))
    rows = read_rows(table, found, slides, progress)
    checked = check_log(str(path), rows, robot, found.angle_declared)
    pieces = tuple(LogPiece(**vars(piece)) for piece in pieces_of(rows.samples))
    notes = (f"log layout: {table.layout}", *found.describe(), *checked)
    return MeasurementLog(
        path, found, rows.samples, pieces, (*notes, *piece_note(rows.samples, pieces))
    )


def origin_of(logs: Sequence[MeasurementLog]) -> DataOrigin:
    """Return where the data of some logs comes from."""
    duration = sum(log.duration for log in logs)
    rate = sum(len(log.samples) - 1 for log in logs) / duration
    words = ", ".join(str(log.path) for log in logs)
    files = tuple(str(log.path.absolute()) for log in logs)
    return DataOrigin(Source.LOG, words, duration, rate, files=files)


def torque_factor(options: LogOptions, joint_names: Sequence[str]) -> Array:
    """Return (n,) what the options multiply torque columns with."""
    factor = np.ones(len(joint_names))
    if options.torque_constants is not None:
        factor *= joint_factors(options.torque_constants, joint_names, CONSTANTS)
    if options.torque_scale is not None:
        factor /= joint_factors(options.torque_scale, joint_names, SCALE)
    return factor


_WRITTEN = {"position": "q", "velocity": "qd", "torque": "tau", "acceleration": "qdd"}
_WRITTEN["time"] = "joint_time"
"""Quantity, as titles end in it, to attribute of a measurement."""


def write_measurement_csv(
    path: Path,
    joint_names: Sequence[str],
    chunks: Iterable[Measurement],
    header_comments: Sequence[str] = (),
) -> None:
    """Write samples in the form ``open_log`` reads, with every digit; the file appears whole.

    Args:
        joint_names: the n chain joints; columns are called ``<joint>_position`` and so on.
        header_comments: lines written above the titles, each after a "#".

    Raises:
        InputError: there are no samples, or the file cannot be written.
    """
    with whole_file(path) as stream:
        stream.writelines(f"# {' '.join(comment.splitlines())}\n" for comment in header_comments)
        writer = csv.writer(stream, lineterminator="\n")
        there: dict[str, str] = {}
        for chunk in chunks:
            if not there:
                there = {n: a for n, a in _WRITTEN.items() if getattr(chunk, a) is not None}
                writer.writerow(["time", *(f"{j}_{n}" for n in there for j in joint_names)])
            values = [getattr(chunk, attribute) for attribute in there.values()]
            writer.writerows(map(repr, r) for r in np.column_stack((chunk.time, *values)).tolist())
        if not there:
            raise InputError("there are no samples to write")


@dataclass(frozen=True)
class Form:
    """A form of recordings.

    Attributes:
        what: it, in words.
        read: reads one.
        begins: how its files begin.
        holds: the file by which its folders are known; "" where it has none.
        option: the option that only it knows; "" for none.
    """

    what: str
    read: Callable[[Asked], LogTable]
    begins: tuple[bytes, ...] = ()
    holds: str = ""
    option: str = ""

    def fits(self, asked: Asked) -> bool:
        """Return whether a recording has this form."""
        held = bool(self.holds) and (asked.path / self.holds).is_file()
        return held or asked.start.startswith(self.begins)


FORMS = (
    Form(
        "a ROS bag",
        bag_table,
        (b"\x89MCAP0", b"#ROSBAG V", b"SQLite format 3"),
        "metadata.yaml",
        "topic",
    ),
    Form("a LeRobot data set", lerobot_table, holds="meta/info.json", option="episode"),
    Form("a MATLAB file", matlab_table, (b"MATLAB 5.0",)),
    # .mat files are HDF5 since version 7.3.
    Form("an HDF5 file", hdf5_table, (b"\x89HDF\r\n\x1a\n", b"MATLAB 7.3")),
    Form("a NumPy .npz file", npz_table, (b"PK\x03\x04",)),
)
"""What is told from a text table."""
_TEXT = Form("a text table", text_table)


def open_table(path: Path, joint_names: Sequence[str], options: LogOptions) -> LogTable:
    """Return a recording as a table."""
    asked = Asked(path, _start(path), joint_names, options)
    form = next((form for form in FORMS if form.fits(asked)), _TEXT)
    for other in FORMS:
        if other.option and getattr(options, other.option) and other is not form:
            raise InputError(
                f"--{other.option} is about {other.what}, and {path} is none; leave it off"
            )
    if form is _TEXT and os.path.isdir(path):
        raise InputError(
            f"{path} is a folder of no known form; a log is a text table (CSV), a ROS 1 or ROS 2 "
            "bag, a LeRobot data set, HDF5, NumPy .npz or MATLAB .mat"
        )
    return form.read(asked)


def _start(path: Path) -> bytes:
    """Return the first bytes of a file; nothing of a folder."""
    if os.path.isdir(path):  # Path.is_dir raises where a name is too long
        return b""
    try:
        with path.open("rb") as stream:
            return stream.read(4096)
    except OSError as error:
        raise InputError(f"cannot read the log {path}: {error.strerror or error}") from error


def earlier_logs(params: Path, robot: RobotModel) -> tuple[Path, ...]:
    """Return the logs that an earlier run used, read off its params.json.

    Information adds: the estimate from old and new logs together is the same as if all had been
    recorded at once.

    Raises:
        InputError: the file is none of an identification from logs, it was made with another model,
            or a log is no longer there.
    """
    content = read_json(params, "give the params.json of an earlier run")
    content = content if isinstance(content, dict) else {}
    logs, model = content.get("logs"), content.get("model")
    if not isinstance(logs, list) or not logs or not all(isinstance(log, str) for log in logs):
        raise InputError(
            f"{params} is of no identification from logs, so there is nothing to add to; give the "
            "params.json of a run with --measurements"
        )
    if not isinstance(model, dict) or model.get("sha256") != robot.sha256:
        raise InputError(
            f"{params} was made with another model than {robot.path}; give the same model file, or "
            "all logs with --measurements"
        )
    missing = [log for log in logs if not os.path.exists(log)]
    if missing:
        raise InputError(f"{params}: its log {missing[0]} is no longer there; put it back")
    return tuple(Path(log) for log in logs)


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
        lines.append(f"  {title.text:{width}}  {numbers}{empty}" + (f"  ({kind})" if kind else ""))
    lines.append("give the model too, to see which column is taken for what and what is wrong")
    return lines
