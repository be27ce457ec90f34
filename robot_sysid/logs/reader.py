"""Logs of real arms as recordings.

A log is a table with a row per sample: time, and position and torque of every chain joint;
velocity and other columns where the file has them. ``table`` describes its form, ``declarations``
is what the user says of columns, ``titles`` and ``column_map`` find them, ``checks`` judges the
rows. The numbers of its columns are held in memory.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs import LogOptions, arrays, documents
from robot_sysid.logs.checks import read_recording
from robot_sysid.logs.column_map import ColumnFinder
from robot_sysid.logs.declarations import ColumnChoices, stated_choices
from robot_sysid.logs.halves import join_halves, join_rows
from robot_sysid.logs.joint_names import join_names
from robot_sysid.logs.matching import UnrecognisedError
from robot_sysid.logs.ros_bag import bag_table
from robot_sysid.logs.suggestion import shortened, suggest_columns
from robot_sysid.logs.table import LogTable, as_input_errors
from robot_sysid.records import ColumnMap, DataOrigin, Recording, RobotModel
from robot_sysid.records.file_access import begins_as_xml, refuse_special_file
from robot_sysid.records.messages import Detail, Progress, count_text
from robot_sysid.records.option_fields import (
    CONSTANTS,
    SCALE,
    joint_factors,
    options_of,
)
from robot_sysid.records.servo_setting import UNKNOWN, ServoSetting
from robot_sysid.signals.resampling import piece_notes, split_at_gaps
from robot_sysid.wording import (
    is_for_python,
    option_name,
    option_setting,
    with_option_names,
)


def open_logs(
    robot: RobotModel,
    sources: Iterable[Path | LogTable | Recording],
    options: LogOptions,
    progress: Progress | None = None,
    kind: str = "",
) -> list[Recording]:
    """Return the recordings in logs of an arm, read and checked, or raise InputError.

    A file of positions and one of torques are one log.

    Args:
        robot: the arm, whose joints the columns are for.
        sources: files, tables, or logs that were opened before, which are returned unchanged; the
            order is kept.
        options: declared columns, units and torque scale.
        progress: receives a stage per log, and the progress of reading.
        kind: what the logs are, for the stages; "" for no stages.
    """
    progress = progress or Progress()
    opened: list[Any] = []
    for source in sources:
        if kind:
            progress.stage(Detail(f"Reading {kind} {source}..."))
        if not isinstance(source, (LogTable, Recording)):
            source = open_table(Path(source), robot.joint_names, options)
        opened.append(source)
    choices = stated_choices(options, robot.joint_names)
    is_read = any(isinstance(source, Recording) for source in opened)
    if len(opened) > 1 and not is_read:
        opened = join_halves(opened, robot, choices)
    logs = []
    for source in opened:
        if isinstance(source, Recording):
            _refuse_other_reading(source, robot, options)
            logs.append(source)
        else:
            logs.append(_read_table(source, robot, options, choices, progress))
    return logs


def _read_table(
    table: LogTable,
    robot: RobotModel,
    options: LogOptions,
    choices: ColumnChoices,
    progress: Progress,
) -> Recording:
    """Return the recording in a log, read and checked; ``choices`` are what options declare."""
    columns = _map_columns(ColumnFinder(table, robot, choices.over(table.choices)))
    table = join_rows(table, columns)
    names = robot.joint_names
    constants = joint_factors(options.torque_constants, names, CONSTANTS)[0]
    scale = joint_factors(options.torque_scale, names, SCALE)[0]
    factors = zip(columns.torque, (constants / scale).tolist())
    torque = [replace(column, factor=k * column.factor) for column, k in factors]
    columns = replace(columns, torque=tuple(torque))
    recording = read_recording(table, columns, robot, progress)
    description = Detail(f"{table.layout}: {columns.describe()}")
    pieces = piece_notes(recording, split_at_gaps(recording))
    notes = (description, *table.notes, *columns.notes, *recording.notes, *pieces)
    return replace(recording, notes=notes, options=vars(options), setting=table.setting)


def _refuse_other_reading(
    log: Recording, robot: RobotModel, options: LogOptions
) -> None:
    """Raise InputError where a log was read for another arm, or otherwise than options say.

    Factors of torques have to be stated: what follows the reading uses them, too.
    """
    if log.joint_names != robot.joint_names:
        raise InputError(
            f"{log} was read for the joints {join_names(log.joint_names)}, and the chain of this "
            f"model has {join_names(robot.joint_names)}; read it with this model"
        )
    for name, option in options_of(LogOptions).items():
        value = getattr(options, name)
        is_stated = value or name in (SCALE, CONSTANTS)
        if is_stated and name != "accept" and value != log.options[name]:
            raise InputError(
                f"{log} was read without {option.name}, or with another one: give read_log and "
                "this call the same"
            )


def refuse_repeated_logs(logs: Sequence[Recording]) -> None:
    """Raise InputError where two logs, to be fitted or to test the result, are one recording."""
    arrays_of = attrgetter("time", "q", "tau")
    for log, other in combinations(logs, 2):
        # Logs that were read hold no NaN.
        if all(map(np.array_equal, arrays_of(log), arrays_of(other))):
            raise InputError(
                f"{other} has the samples of {log}: noise that counts twice makes errors too "
                "small, and no log tests itself; give each log once"
            )


def with_settings(
    logs: Sequence[Recording], settings: Sequence[ServoSetting]
) -> list[Recording]:
    """Return logs with what the user says that servos were recorded with, over what files say.

    Args:
        logs: that were read; those that only test the result come last.
        settings: one for all logs, or one for each; () where nothing is said.

    Raises:
        InputError: the number of settings does not fit.
    """
    if len(settings) not in (0, 1, len(logs)):
        listed = ", ".join(map(str, logs))
        raise InputError(
            f"{option_name('servo_setting')} is given {len(settings)} times for "
            f"{count_text(len(logs), 'log')} ({listed}); give it once for all, or once for each "
            "in this order"
        )
    stated = settings if len(settings) == len(logs) else [*settings] * len(logs)
    given = stated or [UNKNOWN] * len(logs)
    return [
        replace(log, setting=setting.over(log.setting))
        for log, setting in zip(logs, given)
    ]


def _map_columns(finder: ColumnFinder) -> ColumnMap:
    """Return the column of each quantity of a log, declared or recognised.

    InputError where columns are missing, with the line that declares them as far as it is known.
    """
    table = finder.table
    try:
        return finder.find_all()
    except InputError as error:
        fault = "; ".join((f"{table}: {error}", *table.notes))
        suggestion = None
        if finder.has_servos or isinstance(error, UnrecognisedError):
            suggestion = suggest_columns(finder)
        if suggestion and error.options:
            # Titles tell positions and commands, and nothing is missing but their units.
            options = [(*suggestion.unit_words, *words) for words in error.options]
            raise InputError(fault, options, error.command) from None
        if suggestion is None:
            if not error.options:
                titles = ", ".join(shortened(table.titles, "more"))
                fault += f"; {with_option_names(_REMEDY)}; {_HALF}. Columns: {titles}"
            raise InputError(fault, error.options, error.command) from None
    line = suggestion.line
    reasons = [*suggestion.reasons]
    if {"position", "torque"} & {*suggestion.blanks}:
        reasons.append(_HALF)
    doubt = "if that is right"
    if suggestion.blanks:
        doubt = f"with the '?' filled in{suggestion.fillings}"
    action = f"give {option_setting('columns', line)}" if is_for_python() else "run"
    sentences = [fault, *reasons, f"{doubt}, {action}"]
    options = [("--columns", line, *suggestion.further)]
    raise InputError("; ".join(sentences), options, suggestion.command)


def origin_of(logs: Sequence[Recording], sources: Iterable[Any]) -> DataOrigin:
    """Return files, duration and mean sampling rate of logs, as the origin of a result's data.

    ``sources`` are what they were read from, which may be two files for a log.
    """
    duration = sum(log.duration for log in logs)
    rate = sum(len(log) - 1 for log in logs) / duration
    files = [str(Path(source).absolute()) for source in sources]
    listed = ", ".join(map(str, logs))
    return DataOrigin(f"log {listed}", duration, rate, files=tuple(files))


TableReader = Callable[[Path, Sequence[str], LogOptions], LogTable]
"""Reads a log of one form as a table: its path, the joints of the arm, and options."""
_BAG = "a ROS bag", bag_table
_HDF5 = "an HDF5 file", arrays.hdf5_table
FILES: Mapping[bytes, tuple[str, TableReader]] = {
    rb"\x89MCAP0": ("an MCAP file", documents.mcap_table),
    rb"#ROSBAG V": _BAG,
    rb"SQLite format 3": _BAG,
    rb"MATLAB 5\.0": ("a MATLAB .mat file", arrays.matlab_table),
    # .mat files are HDF5 since version 7.3.
    rb"MATLAB 7\.3": _HDF5,
    rb"\x89HDF\r\n\x1a\n": _HDF5,
    # An Excel file is an archive, too; its first file lies in one of these folders.
    rb"PK\x03\x04.{26}(\[Content_Types\]|_rels|docProps|xl)": (
        "an Excel file",
        documents.excel_table,
    ),
    rb"PK\x03\x04": ("a NumPy .npz file", arrays.npz_table),
    rb"PAR1": ("a Parquet file", arrays.parquet_table),
    rb"(\xef\xbb\xbf)?\s*[\[{]\s*[\[{\"\d\]}-]": ("JSON", documents.json_table),
    # What ros2 topic echo prints, behind warnings.
    rb"(.*\n)?header:\s+(seq|stamp):": (
        "text of ros2 topic echo",
        documents.echo_table,
    ),
    rb"": ("a table of text", documents.text_table),
}
"""Pattern of a file's first bytes to its form and the form's reader; the first that fits counts."""
FOLDERS: Mapping[str, tuple[str, TableReader]] = {
    "metadata.yaml": _BAG,
    "meta/info.json": ("a LeRobot data set", arrays.lerobot_table),
}
"""A file in a folder to the folder's form and the form's reader."""
# What to do where columns are not recognised.
_REMEDY = (
    "if the model is of this arm, say which column is what with {columns FILE}, of lines such as "
    "'position = A, B, C' with a title for each joint, or 'position = A*'"
)
# What to do where columns are in another file.
_HALF = (
    "if positions and torques are in two files, give both, one after the other, with titles such "
    "as q1 and tau1"
)


def open_table(path: Path, joint_names: Sequence[str], options: LogOptions) -> LogTable:
    """Return a log as a table, its form recognised.

    Whatever a reader raises becomes an InputError, also where the form is not known.

    Args:
        path: file or folder.
        joint_names: (n,) of the arm, which joints of a ROS bag or data set are matched with.
        options: topic, episodes and whether commands are read.
    """
    if os.path.isdir(path):  # Path.is_dir raises where a name is too long
        forms = [form for name, form in FOLDERS.items() if (path / name).is_file()]
    else:
        refuse_special_file(path, "a log is read twice: write it to a file")
        if begins_as_xml(path):
            raise InputError(f"{path} is XML, as models are, and no log; give a log")
        try:
            with path.open("rb") as stream:
                beginning = stream.read(4096)
        except OSError as error:
            reason = error.strerror or error
            raise InputError(f"cannot read the log {path}: {reason}") from error
        forms = [
            form
            for pattern, form in FILES.items()
            if re.match(pattern, beginning, re.DOTALL)
        ]
    if not forms:
        raise InputError(
            f"{path} is a folder of no known form; a log is a text table (CSV), JSON, a ROS 1 or "
            "ROS 2 bag, MCAP, a LeRobot data set, HDF5, Parquet, NumPy .npz, MATLAB .mat or Excel "
            ".xlsx"
        )
    form, reader = forms[0]
    with as_input_errors(path, form):
        table = reader(path, joint_names, options)
    return replace(table, form=form)
