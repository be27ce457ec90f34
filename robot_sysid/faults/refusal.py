"""The error that refuses a log for findings that one thing puts right, with what that is.

That are options, or a columns file: the lines of the file that the user gave, if any, and one line
for each column that changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from robot_sysid.errors import ColumnsError, InputError
from robot_sysid.faults import ColumnCorrection, Finding
from robot_sysid.logs.declarations import column_text, declarations
from robot_sysid.records import Column, ColumnMap, Recording
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.file_access import read_text
from robot_sysid.records.option_fields import Columns


def refuse_for(logs: Sequence[Recording], findings: Sequence[Finding]) -> InputError:
    """Return the error that refuses logs for findings; ColumnsError where columns are wrong.

    Columns are those of the first log: logs of one run have one columns file.

    Args:
        logs: that were read.
        findings: one, or several that have one correction of columns.
    """
    log = logs[0]
    names = ", ".join(each.name for each in logs)
    text = f"{names}: {'; '.join(finding.sentence for finding in findings)}"
    finding = findings[0]
    options = finding.options if len(findings) == 1 else ()
    columns = log.columns
    if finding.about is FaultName.ANGLE_UNIT and columns and columns.angle_declared:
        options = ()  # A unit in a title outranks the option.
    if finding.correction is not None and columns and (finding.command or not options):
        lines = _corrected_lines(log.joint_names, columns, finding.correction)
        if lines:
            reason = f"{names}: {'; '.join(each.text for each in findings)}"
            draft = _add_lines(log.options.get("columns"), lines, reason)
            name = _free_name(Path(log.name), draft)
            options = tuple((*each, "--columns", name) for each in options or [()])
            return ColumnsError(text, draft, name, options, finding.command)
    return InputError(text, options, finding.command)


def _corrected_lines(
    joint_names: Sequence[str], columns: ColumnMap, correction: ColumnCorrection
) -> dict[str, str]:
    """Return key to value of the lines of a columns file that put columns right.

    It is empty where a torque is no column, joints have time stamps that a new order separates from
    their positions, or a joint without a column has another zero.

    Args:
        joint_names: (n,) of the arm.
        columns: of the log as it was read.
        correction: of its columns; velocities, where they are recorded, are corrected like
            positions.
    """
    if columns.commanded or columns.joint_time:
        return {}
    right = {"position": correction.position, "torque": correction.torque}
    if columns.velocity:
        right["velocity"] = correction.position
    lines = {}
    for quantity, sources in right.items():
        group = getattr(columns, quantity)
        for joint, (name, (source, factor)) in enumerate(zip(joint_names, sources)):
            # A joint without torque has no column.
            if group[source].factor and (source != joint or factor != 1.0):
                value = _column_text(columns.titles, group[source], factor)
                lines[f"{quantity}.{name}"] = value
    zeros = correction.zeros or (0.0,) * len(joint_names)
    if any(zeros) or (lines and any(column.zero for column in columns.position)):
        for name, (source, factor), added in zip(joint_names, right["position"], zeros):
            column = columns.position[source]
            if added and not column.factor:
                return {}
            read = column.zero
            read -= added / (factor * column.factor) if added else 0.0
            lines[f"zero.{name}"] = f"{read:.12g}"
    return lines


def _column_text(titles: Sequence[str], column: Column, factor: float) -> str:
    """Return a column as a columns file states it: "title", "-title" or "0.5 * title".

    A title that occurs twice, or that the file could not hold, is replaced by the column's number.

    Args:
        titles: of all columns of the log.
        column: the column as it was read.
        factor: by which its numbers are to be multiplied in addition.
    """
    title = column_text(titles, column.index)
    total = factor * column.declared_factor
    signs = {1.0: "", -1.0: "-"}
    return f"{signs[total]}{title}" if total in signs else f"{total:.12g} * {title}"


def _add_lines(source: Columns | None, lines: dict[str, str], reason: str) -> str:
    """Return the text of a columns file with lines added to it, or replaced in it.

    Args:
        source: the file, or the line in its place, that is in use; None for none.
        lines: key to value of the lines.
        reason: for the comment above the lines.
    """
    if isinstance(source, Path):
        text = read_text(source, "give a columns file, or its lines")
        old_lines = [*filter(None, text.rstrip("\n").split("\n"))]
    else:
        old_lines = [
            f"{key} = {value}" for key, value in declarations(source or "").items()
        ]
    unchanged = [s for s in old_lines if s.partition("=")[0].strip() not in lines]
    changed = [f"{key} = {value}" for key, value in lines.items()]
    return "\n".join([*unchanged, f"# {' '.join(reason.split())}", *changed, ""])


def _free_name(log: Path, text: str) -> str:
    """Return the name of a columns file for a log, numbered where something else has it."""
    name = f"{log.stem}_columns"
    path = Path(f"{name}.txt")
    number = 1
    while path.exists() and not (
        path.is_file() and path.read_text("utf-8", errors="replace") == text
    ):
        number += 1
        path = Path(f"{name}_{number}.txt")
    return str(path)
