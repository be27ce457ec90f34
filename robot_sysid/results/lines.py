"""What the console prints of a result: a view of the content of params.json."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.records import ITSELF
from robot_sysid.records.messages import Detail, percent, with_error
from robot_sysid.results.cards import NOT_KNOWN
from robot_sysid.results.content import Content
from robot_sysid.results.record import PAYLOAD
from robot_sysid.results.table import (
    all_cells,
    beyond_line,
    body_rows,
    cells,
    friction_rows,
    label,
    largest_changes,
    table_lines,
)
from robot_sysid.results.verdict import before_after_text, verdict_line

if TYPE_CHECKING:
    from robot_sysid.damiao.trajectory import DamiaoExportReport


def result_lines(content: Content, links: bool = False) -> list[str]:
    """Return the lines of a result without those of files and without --verbose."""
    lines = (*block_lines(content, links), *more_lines(content), verdict_line(content))
    return [line for line in lines if not isinstance(line, Detail)]


def block_lines(content: Content, links: bool = False) -> list[str]:
    """Return the identified numbers line by line: a table, or the block of a self-test.

    Args:
        content: of params.json.
        links: whether the table shows every link and every joint in place of the last ones.
    """
    if content["question"] == PAYLOAD:
        rows = body_rows(content, PAYLOAD)
        flange = content["payload"]["flange"]["name"]
        lines = [f"Identified payload, in the frame of {flange}:"]
        lines += table_lines(cells(row, label(row)) for row in rows)
        if 1 < len(rows) < 10:
            lines.append(f"  {NOT_KNOWN}")
        return lines
    if content["source"] == ITSELF:
        return _self_test_lines(content)
    beyond = beyond_line(content)
    lines = [beyond] if beyond else []
    link = content["body_name"]
    rows = body_rows(content, link) + friction_rows(content, content["joint_name"])
    table = [cells(row, label(row)) for row in rows]
    title = f"{link} with all on it"
    if links:
        table = [*all_cells(content)]
        title = "Before -> after"
    return [*lines, *table_lines(table, title)]


def _self_test_lines(content: Content) -> list[str]:
    """Return the block "Identified parameters: ..." of the model's own simulation."""
    rows = {row["name"]: row for row in content["quantities"]}
    lines = ["Identified parameters:"]
    for title, names in (
        ("Mass", ("mass",)),
        ("CoM moment", PARAMETER_NAMES[1:4]),
        ("Inertia", PARAMETER_NAMES[4:]),
    ):
        numbers = _decimals_text([rows[name]["value"] for name in names])
        numbers = numbers if title == "Mass" else f"[{numbers}]"
        lines.append(f"  {title}: {numbers} {rows[names[0]]['unit']}")
    for term in ("coulomb", "viscous"):
        if term in rows:
            number = _friction_text(rows[term]["value"])
            lines.append(
                f"  {term.capitalize()} friction: {number} {rows[term]['unit']}"
            )
    return [*lines, *_quality_lines(content)]


def _quality_lines(content: Content) -> list[str]:
    """Return the lines on residual, condition number and base parameters of the regressor."""
    return [
        f"  RMSE: {content['rmse']:.4f} N·m",
        f"  Condition number: {content['condition_number'] or math.inf:.1f}",
        f"  Base parameters: {content['n_base_params']}",
    ]


def _decimals_text(values: Sequence[float]) -> str:
    """Return numbers with three decimals; if all are below 0.01, with two digits of the largest."""
    largest = np.max(np.abs(values))
    is_small = 0.0 < largest < 0.01
    decimals = 1 - math.floor(math.log10(largest)) if is_small else 3
    return ", ".join(f"{value:.{decimals}f}" for value in values)


def _friction_text(value: float) -> str:
    """Return a number with two decimals, or with one significant digit instead of 0.00."""
    # Adding zero turns the -0.00 that rounding leaves into 0.00.
    rounded = round(value, 2) + 0.0
    return f"{value:.1g}" if value and not rounded else f"{rounded:.2f}"


def more_lines(content: Content) -> list[str]:
    """Return the lines below the block; those for --verbose only are ``Detail``."""
    lines: list[str] = []
    if content["question"] == PAYLOAD:
        lines += _payload_lines(content)
    elif content["failure"] is None:
        lines += largest_changes(content)
    lines += _validation_lines(content)
    if content["file"] is not None and content["file"]["kept"]:
        lines.append(Detail(f"As in the model: {', '.join(content['file']['kept'])}"))
    if content["source"] != ITSELF:
        lines += map(Detail, _quality_lines(content))
    lines.append(Detail("  RMSE per joint [N·m; N of a slide]:"))
    for joint, rmse in content["rmse_per_joint"].items():
        noise = content["noise_per_joint"].get(joint)
        noise_text = "" if noise is None else f", noise {noise:.2g}"
        lines.append(Detail(f"    {joint}: {rmse:.2e}{noise_text}"))
    return lines


def _payload_lines(content: Content) -> Iterator[str]:
    """Yield lines on the link without and with a payload, and on torque scales."""
    link = content["body_name"]
    for preposition, body in (("without", link), ("with", f"{link} with payload")):
        mass, *com = body_rows(content, body)[:4]
        listed = ", ".join(with_error(row["value"], row["error"]) for row in com)
        text = with_error(mass["value"], mass["error"], "kg")
        yield Detail(
            f"Terminal link {preposition} it: {text}, centre of mass [{listed}] m"
        )
    scales = [row for row in content["quantities"] if row["name"] == "torque_scale"]
    if scales:
        known = content["payload"]["known_mass"]
        yield (
            f"Torque scales by the known mass of {known:g} kg (what the log reads over what is "
            "there):"
        )
    for row in scales:
        yield f"  {row['of']}: {with_error(row['value'], row['error'])}"


def _validation_lines(content: Content) -> Iterator[str]:
    """Yield lines on torque errors of data that was not fitted.

    They are errors of the written file on other logs; where there is no file, errors of the fit.
    The verdict states the error of the file on held-out data.
    """
    tests = content["validation"]
    file = content["file"]
    if file is not None:
        for test in file["others"]:
            shares = before_after_text(test["before"], test["after"])
            yield f"Torque error of the model on {test['before']['source']}: {shares}"
        sources = [test["before"]["source"] for test in file["others"]]
        tests = [test for test in tests[1:] if test["source"] not in sources]
    for test in tests:
        share = test["relative_error"]
        relative = "" if share is None else f" ({percent(share)})"
        yield f"Validation on {test['source']}: {test['rmse']:.4f} N·m{relative}"


def clamping_lines(
    report: DamiaoExportReport | None, joints: Sequence[str]
) -> list[str]:
    """Return what the Damiao export clamped of each joint's command, and its warnings.

    Nothing where there was no export. The joints are those of the report, in its order.
    """
    if report is None:
        return []
    lines = ["Damiao export, clamped to motor limits:"]
    for joint, motor, share in zip(joints, report.joints, report.clamped_percent):
        lines.append(f"  {joint} ({motor.motor_type}): {share:.1f} %")
    return [*lines, *map("  {}".format, report.warnings)]


def folder_text(folder: Path) -> str:
    """Return a folder as the user would type it, with a trailing slash: ./sysid_output/."""
    text = folder.as_posix()
    prefix = "" if folder.is_absolute() or text.startswith(".") else "./"
    return f"{prefix}{text}/" if text != "." else "./"
