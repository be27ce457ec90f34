"""The result block that the command line prints."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robot_sysid.dynamics.gravity import TILT_NAMES
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.write_back import plan_write_back
from robot_sysid.output.limitations import limitations
from robot_sysid.output.params_json import friction_entries
from robot_sysid.output.printed.before_after import (
    friction_text,
    link_rows,
    model_friction,
    shown,
    table_lines,
)
from robot_sysid.output.printed.rollout import rollout_lines
from robot_sysid.records import DELAY_NAME, Array, Estimate, Identification, Status
from robot_sysid.records.figures import THETA, percent, term_unit

if TYPE_CHECKING:
    from robot_sysid.damiao.trajectory.csv_file import DamiaoExportReport


_NAMED = 3
"""So many bodies of a link are named."""
_ROUNDING = 1e-9
"""Friction below this is nothing [N m]."""


def result_lines(identification: Identification) -> list[str]:
    """Return the block "Identified parameters: ..." line by line."""
    estimate = identification.estimate
    theta = shown(estimate.inertial.theta)
    moment, inertia = (_listed(values) for values in (theta[1:4], theta[4:]))
    return [
        "Identified parameters:",
        f"  Mass: {_listed(theta[:1])} kg",
        f"  CoM moment: [{moment}] kg·m",
        f"  Inertia: [{inertia}] kg·m²",
        *_friction_lines(identification),
        f"  RMSE: {estimate.rmse:.4f} N·m",
        f"  Condition number: {estimate.identifiability.condition_number:.1f}",
        f"  Base parameters: {estimate.identifiability.rank}",
    ]


def _listed(values: Array) -> str:
    """Return numbers with three decimals; where all are small, with two digits of the largest."""
    largest = float(np.max(np.abs(values)))
    small = 0.0 < largest < 0.01
    places = 1 - math.floor(math.log10(largest)) if small else 3
    return ", ".join(f"{value:.{places}f}" for value in values)


def more_lines(identification: Identification) -> list[str]:
    """Return what stands under that block: before -> after, and what else the data can tell."""
    return [
        *_mass_line(identification),
        *_table(identification),
        *_unidentifiable_lines(identification),
        *_measured_lines(identification),
        *([] if identification.rollout is None else rollout_lines(identification.rollout)),
    ]


def _mass_line(identification: Identification) -> list[str]:
    """Return what the mass is the mass of, where the link carries more bodies."""
    names = [body.name for body in identification.bodies if body.theta[0] > 0.0]
    if len(names) < 2 or identification.bodies[0].name not in names:
        return []
    theta = identification.estimate.inertial.theta
    rest = len(names) - _NAMED
    told = names if rest < 2 else [*names[:_NAMED], f"{rest} more"]
    line = f"The mass is that of {' + '.join(told)} = {theta[0]:.4g} kg"
    try:
        plan = plan_write_back(theta, identification.bodies)
    except ExportError:
        return [line]
    lumped = [body.name for body in plan.lumped]
    alone = " + ".join([names[0], *lumped]) + (" together" if lumped else " alone")
    return [f"{line}; {alone}, as written in the file: {plan.theta[0]:.4g} kg"]


def _table(identification: Identification) -> list[str]:
    heading = "Before -> after:"
    if identification.data.source.is_measured:
        causes = ", ".join(["noise", *identification.estimate.error_budget])
        heading = f"Before -> after, ± one standard error of all causes ({causes}):"
    return [heading, *table_lines(link_rows(identification))]


def _measured_lines(identification: Identification) -> list[str]:
    """Return what only measured data can tell: errors, friction of all joints, validation."""
    if not identification.data.source.is_measured:
        return []
    return [
        *_budget_line(identification.estimate),
        *_all_friction_lines(identification),
        *_noise_lines(identification.estimate),
        *_alignment_lines(identification),
        *_validation_lines(identification),
        *(f"  Limit: {sentence}" for sentence in limitations(identification)),
    ]


def _budget_line(estimate: Estimate) -> list[str]:
    """Return what the mass's error comes from."""
    if not estimate.error_budget or estimate.noise_errors is None:
        return []
    parts = {"noise": estimate.noise_errors, **estimate.error_budget}
    listed = ", ".join(f"{cause} {values[0]:.2g}" for cause, values in parts.items())
    return [f"The mass's error by cause, kg: {listed}"]


def _all_friction_lines(identification: Identification) -> list[str]:
    per_joint = friction_entries(identification)
    if not per_joint:
        return []
    return [
        f"Friction of the joints ({identification.friction_model}), model -> identified ± error:",
        *(
            f"  {joint}: {', '.join(_terms(identification, joint, terms))}"
            for joint, terms in per_joint.items()
        ),
    ]


def _terms(identification: Identification, joint: str, terms: Mapping[str, float]) -> Iterator[str]:
    for term, value in terms.items():
        error = identification.estimate.error(f"{term}[{joint}]")
        before = model_friction(identification, joint, term)
        unit = term_unit(term, joint in identification.slides)
        yield friction_text(term, before, value, error, unit)


def _noise_lines(estimate: Estimate) -> list[str]:
    if not estimate.noise_per_joint:
        return []
    listed = ", ".join(f"{joint} {v:.2g}" for joint, v in estimate.noise_per_joint.items())
    return [f"Torque noise per joint after filtering, N·m: {listed}"]


def _alignment_lines(identification: Identification) -> list[str]:
    lines, estimate = [], identification.estimate
    if identification.delay is not None:
        error = 1e3 * (estimate.error(DELAY_NAME) or 0.0)
        delay = f"{1e3 * identification.delay:.3f} ± {error:.2g} ms"
        lines.append(f"Delay of torque behind position: {delay}")
    if identification.tilt is not None:
        both = [estimate.error(name) or 0.0 for name in TILT_NAMES]
        error = float(np.degrees(np.linalg.norm(both)))
        tilt = f"{np.degrees(identification.tilt):.3f} ± {error:.2g} degrees"
        lines.append(f"Tilt of the base: {tilt}")
    return lines


def _validation_lines(identification: Identification) -> list[str]:
    return [
        f"Validation on {test.source}: {test.rmse:.4f} N·m"
        + ("" if test.relative_error is None else f" ({percent(test.relative_error)})")
        for test in identification.validation
    ]


def _friction_lines(identification: Identification) -> list[str]:
    joint, estimate = identification.joint_name, identification.estimate
    coulomb = estimate.value(f"coulomb[{joint}]")
    viscous = estimate.value(f"viscous[{joint}]")
    if coulomb is None or viscous is None:
        return []
    units = [term_unit(term, joint in identification.slides) for term in ("coulomb", "viscous")]
    return [
        f"  Coulomb friction: {_two_decimals(coulomb)} {units[0]}",
        f"  Viscous friction: {_two_decimals(viscous)} {units[1]}",
    ]


def _two_decimals(value: float) -> str:
    """Return a number with two decimals; one that would look like zero with its first digit."""
    # Adding zero turns the -0.00 that rounding leaves into 0.00.
    rounded = round(value, 2) + 0.0
    return f"{value:.1g}" if rounded == 0.0 and abs(value) > _ROUNDING else f"{rounded:.2f}"


def _unidentifiable_lines(identification: Identification) -> list[str]:
    estimate = identification.estimate
    # Of measured data, the limits of the result tell it.
    measured = identification.data.source.is_measured
    if measured or estimate.status is not Status.PARTLY_FROM_MODEL:
        return []
    listed = "; ".join(estimate.identifiability.unidentifiable)
    return [f"  Not visible in these torques, kept from the model: {listed}"]


def detail_lines(identification: Identification) -> list[str]:
    """Return what --verbose adds: residuals, errors of noise alone, scaled condition number."""
    estimate = identification.estimate
    scaled = estimate.identifiability.scaled_condition_number
    residuals = [
        f"    {joint}: {value:.2e} N·m" for joint, value in estimate.rmse_per_joint.items()
    ]
    return [
        f"  Condition number, columns scaled: {scaled:.1f}",
        "  RMSE per joint:",
        *residuals,
        *_noise_share(estimate),
        f"  Status: {estimate.status.value}",
    ]


def _noise_share(estimate: Estimate) -> list[str]:
    if estimate.noise_errors is None or not estimate.error_budget:
        return []
    named = zip(estimate.names[:10], estimate.noise_errors, THETA)
    return [
        "  Standard errors of noise alone: "
        + ", ".join(f"{name} {error:.2g} {unit}" for name, error, unit in named)
    ]


def clamping_lines(report: DamiaoExportReport | None, joints: Sequence[str]) -> list[str]:
    """Return what the Damiao export did, or nothing where there was none."""
    if report is None:
        return []
    shares = zip(joints, report.joints, report.clamped_percent)
    return [
        "Damiao export, clamped to motor limits:",
        *(f"  {joint} ({motor.motor_type}): {share:.1f} %" for joint, motor, share in shares),
        *(f"  {warning}" for warning in report.warnings),
    ]


def folder_text(folder: Path) -> str:
    """Return a folder as the user would type it, with a trailing slash: ./sysid_output/."""
    text = folder.as_posix()
    prefix = "" if folder.is_absolute() or text.startswith(".") else "./"
    return f"{prefix}{text}/" if text != "." else "./"
