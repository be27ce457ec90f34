"""Which of several arms of a model a log is of, by the names of its joints in the log's titles."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from robot_sysid.errors import AmbiguousJointError, InputError, ModelError
from robot_sysid.logs import LogOptions
from robot_sysid.logs.joint_names import NamePieces, split_name
from robot_sysid.logs.reader import open_table
from robot_sysid.model import ModelOptions
from robot_sysid.parser import load_robot_model
from robot_sysid.records.option_fields import given_values, record_from


def error_of_named_arm(
    error: AmbiguousJointError, logs: Sequence[Path], values: Mapping[str, Any]
) -> ModelError:
    """Return the error that names the one arm whose joints logs name; the same where none is it.

    Args:
        error: that the model has several arms.
        logs: of the command.
        values: of its options, by key.
    """
    model_options = given_values(record_from(ModelOptions, values))
    log_options = record_from(LogOptions, values)
    named = []
    for joint, _ in error.candidates:
        model_options["joint"] = joint
        with contextlib.suppress(InputError):
            robot = load_robot_model(values["path"], **model_options)
            if all(_names_joints(log, robot.joint_names, log_options) for log in logs):
                named.append(joint)
    if len(named) != 1 or not logs:
        return error
    listed = ", ".join(map(str, logs))
    text = f"{error.sentence}. {listed} has the names of the joints up to {named[0]}"
    return ModelError(text, options=[("--joint", named[0])])


def _names_joints(log: Path, joint_names: Sequence[str], options: LogOptions) -> bool:
    """Return whether the titles of a log have the whole name of each joint; InputError where it
    cannot be read for an arm of these.
    """
    table = open_table(log, joint_names, options)
    in_titles = {piece for title in table.titles for piece in _parts(split_name(title))}
    return {split_name(name) for name in joint_names} <= in_titles


def _parts(pieces: NamePieces) -> Iterator[NamePieces]:
    """Yield all pieces of a name that follow each other."""
    for start in range(len(pieces)):
        for end in range(start + 1, len(pieces) + 1):
            yield pieces[start:end]
