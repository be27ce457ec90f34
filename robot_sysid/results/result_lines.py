"""The lines that the command line prints of a result."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robot_sysid.records import Array, Validation
from robot_sysid.records.messages import Detail, percent, term_unit, with_error
from robot_sysid.results.body_errors import load_errors
from robot_sysid.results.cards import NOT_KNOWN
from robot_sysid.results.link_table import (
    FILE_REASON,
    file_masses,
    joint_lines,
    link_lines,
)
from robot_sysid.results.parameter_table import (
    parameter_rows,
    table_lines,
    without_rounding,
)
from robot_sysid.results.record import Payload, Result
from robot_sysid.results.verdict import (
    before_after_text,
    cause_text,
    limitations,
    verdict_line,
)

if TYPE_CHECKING:
    from robot_sysid.damiao.trajectory import DamiaoExportReport

_MAX_BODY_NAMES = 3
"""Number of bodies of a link that are named; more make a line too long."""


def result_lines(result: Result, links: bool = False) -> list[str]:
    """Return the lines that the command line prints of a result without --verbose.

    Args:
        result: what to print.
        links: whether every link and every joint is shown.
    """
    lines = (
        *block_lines(result, links),
        *more_lines(result, links),
        verdict_line(result),
    )
    return [line for line in lines if not isinstance(line, Detail)]


def block_lines(result: Result, links: bool = False) -> list[str]:
    """Return the identified numbers line by line: a table, or the block of a self-test.

    Args:
        result: what to print.
        links: whether a table shows every link and every joint in place of the last ones.
    """
    if result.payload is not None:
        rows = parameter_rows(result)
        lines = [f"Identified payload, in the frame of {result.payload.flange.name}:"]
        lines += table_lines(rows)
        if len(rows) > 1 and not np.all(result.payload.body.is_determined):
            lines.append(f"  {NOT_KNOWN}")
        return lines
    if not result.is_measured:
        return _self_test_lines(result)
    if links and result.links:
        return [*_mass_lines(result), *link_lines(result)]
    rows = parameter_rows(result)
    table = table_lines(rows, "Before -> after")
    return [*_mass_lines(result), *table, *_file_mass_lines(result)]


def _self_test_lines(result: Result) -> list[str]:
    """Return the block "Identified parameters: ..." of the model's own simulation."""
    estimate = result.estimate
    joint = result.robot.terminal_joint
    is_slide = joint in result.robot.slides
    theta = without_rounding(estimate.inertial.theta, estimate.inertial.scale)
    lines = [
        "Identified parameters:",
        f"  Mass: {_decimals_text(theta[:1])} kg",
        f"  CoM moment: [{_decimals_text(theta[1:4])}] kg·m",
        f"  Inertia: [{_decimals_text(theta[4:])}] kg·m²",
    ]
    for term in ("coulomb", "viscous"):
        value = estimate.value(f"{term}[{joint}]")
        if value is not None:
            number = f"{_friction_text(value)} {term_unit(term, is_slide)}"
            lines.append(f"  {term.capitalize()} friction: {number}")
    return [*lines, *_quality_lines(result)]


def _quality_lines(result: Result) -> list[str]:
    """Return the lines on residual, condition number and base parameters of the regressor."""
    estimate = result.estimate
    return [
        f"  RMSE: {estimate.rmse:.4f} N·m",
        f"  Condition number: {estimate.identifiability.condition_number:.1f}",
        f"  Base parameters: {estimate.identifiability.rank}",
    ]


def more_lines(result: Result, links: bool = False) -> list[str]:
    """Return the lines below the block; those for --verbose only are ``Detail``.

    Args:
        result: what to print.
        links: whether the block shows every link and every joint.
    """
    lines: list[str] = []
    if result.payload is not None:
        lines += _payload_lines(result.payload)
    lines += _validation_lines(result)
    lines += [f"  Limit: {text}" for text in limitations(result)]
    if result.file is not None and result.file.unchanged:
        unchanged = ", ".join(result.file.unchanged)
        lines.append(Detail(f"Left in the file as it was: {unchanged}"))
    if result.is_measured:
        lines += map(Detail, _quality_lines(result))
        if not links:
            lines += map(Detail, joint_lines(result))
    return [*lines, *map(Detail, _detail_lines(result))]


def _decimals_text(values: Array) -> str:
    """Return numbers with three decimals; if all are below 0.01, with two digits of the largest."""
    largest = float(np.max(np.abs(values)))
    is_small = 0.0 < largest < 0.01
    decimals = 1 - math.floor(math.log10(largest)) if is_small else 3
    return ", ".join(f"{value:.{decimals}f}" for value in values.tolist())


def _friction_text(value: float) -> str:
    """Return a number with two decimals, or with one significant digit instead of 0.00."""
    value = float(without_rounding(np.array(value), scale=1.0))
    # Adding zero turns the -0.00 that rounding leaves into 0.00.
    rounded = round(value, 2) + 0.0
    return f"{value:.1g}" if value and not rounded else f"{rounded:.2f}"


def _mass_lines(result: Result) -> Iterator[str]:
    """Yield a line on the bodies that share the terminal link's mass, where there are several."""
    bodies = result.robot.bodies
    names = [body.name for body in bodies if body.theta[0] > 0.0]
    if len(names) < 2 or not bodies[0].theta[0] > 0.0:
        return
    if len(names) > _MAX_BODY_NAMES + 1:
        names[_MAX_BODY_NAMES:] = [f"{len(names) - _MAX_BODY_NAMES} more"]
    yield f"The mass is that of {' + '.join(names)} together"


def _file_mass_lines(result: Result) -> Iterator[str]:
    """Yield a line on the terminal link's mass in the written file where it is not the table's."""
    mass = file_masses(result).get(result.body.name)
    if mass is not None:
        reason = FILE_REASON.format(result.model_name)
        yield f"  {reason}; its mass of {result.body.name} is {mass} kg"


def _payload_lines(payload: Payload) -> Iterator[str]:
    """Yield lines on the link without and with a payload, single recordings and torque scales."""
    for preposition, body in (("without", payload.link), ("with", payload.total)):
        mass_error, *com_errors = load_errors(body)[:4].tolist()
        com = ", ".join(map(with_error, body.com.tolist(), com_errors))
        mass = with_error(body.mass, mass_error, "kg")
        yield Detail(
            f"Terminal link {preposition} it: {mass}, centre of mass [{com}] m"
        )
    if payload.scatter:
        yield Detail("Mass according to each recording alone (± noise):")
    for recording in payload.scatter:
        side = "loaded" if recording.is_loaded else "empty"
        mass = with_error(recording.mass, recording.noise_error, "kg")
        yield Detail(f"  {recording.name} ({side}): {mass}")
    if payload.torque_scale and payload.known_mass is not None:
        yield (
            f"Torque scales by the known mass of {payload.known_mass:g} kg (what the log reads "
            "over what is there, 95 % interval):"
        )
    for joint, scale in payload.torque_scale.items():
        low, high = scale.interval
        yield f"  {joint}: {scale.value:.4f} [{low:.4f}, {high:.4f}]"


def _validation_lines(result: Result) -> Iterator[str]:
    """Yield lines on torque errors of data that was not fitted.

    They are errors of the written file on other logs; where there is no file, errors of the fit.
    """
    fits = result.validation
    file = result.file
    if file is None:
        yield from map(_fit_error_text, fits)
        return
    # The verdict states the error of the file on held-out data.
    for model_test, file_test in file.other_validations:
        source = model_test.source
        shares = before_after_text(model_test, file_test)
        yield f"Torque error of the model on {source}: {shares}"
    file_sources = [test.source for test, _ in file.other_validations]
    for test in fits[1:]:
        if test.source not in file_sources:
            yield _fit_error_text(test)


def _fit_error_text(test: Validation) -> str:
    """Return a line on the error of the fit on some data."""
    share = test.relative_error
    relative = "" if share is None else f" ({percent(share)})"
    return f"Validation on {test.source}: {test.rmse:.4f} N·m{relative}"


def _detail_lines(result: Result) -> Iterator[str]:
    """Yield the lines that --verbose adds: errors of the mass by cause, residuals by joint."""
    causes = result.body.mass_causes
    if np.isfinite(result.body.errors[0]) and causes:
        largest = sorted(causes, key=lambda cause: -causes[cause])
        listed = ", ".join(f"{cause_text(c)} {causes[c]:.2g}" for c in largest)
        yield f"Error of the mass by cause, kg: {listed}"
    estimate = result.estimate
    yield "  RMSE per joint:"
    for joint_name, rmse in estimate.rmse_per_joint.items():
        noise = estimate.noise_per_joint.get(joint_name)
        noise_text = "" if noise is None else f", noise {noise:.2g}"
        yield f"    {joint_name}: {rmse:.2e} N·m{noise_text}"


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
