"""The result block that the command line prints."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robot_sysid.dynamics.gravity import TILT_NAMES
from robot_sysid.output.limitations import limitations
from robot_sysid.output.params_json import friction_entries
from robot_sysid.records import DELAY_NAME, Estimate, Identification, Status

if TYPE_CHECKING:
    from robot_sysid.damiao.trajectory.csv_file import DamiaoExportReport


WHOLE = 0.995
"""Share of the data in a value above which it goes without saying."""


def result_lines(identification: Identification) -> list[str]:
    """Return the block "Identified parameters: ..." line by line."""
    estimate = identification.estimate
    link = estimate.inertial
    moment = ", ".join(f"{value:.3f}" for value in link.first_moment)
    inertia = ", ".join(f"{value:.3f}" for value in link.theta[4:])
    return [
        "Identified parameters:",
        f"  Mass: {link.mass:.3f} kg",
        f"  CoM moment: [{moment}] kg·m",
        f"  Inertia: [{inertia}] kg·m²",
        *_friction_lines(identification),
        f"  RMSE: {estimate.rmse:.4f} N·m",
        f"  Condition number: {estimate.identifiability.condition_number:.1f}",
        f"  Base parameters: {estimate.identifiability.rank}",
        *_unidentifiable_lines(identification),
        *_measured_lines(identification),
    ]


def _measured_lines(identification: Identification) -> list[str]:
    """Return what only measured data can tell: errors, friction of all joints, validation."""
    if not identification.data.source.is_measured:
        return []
    return [
        *_error_lines(identification.estimate),
        *_all_friction_lines(identification),
        *_noise_lines(identification.estimate),
        *_alignment_lines(identification),
        *_validation_lines(identification),
        *(f"  Limit: {sentence}" for sentence in limitations(identification)),
    ]


def _error_lines(estimate: Estimate) -> list[str]:
    errors, relative = estimate.standard_errors, estimate.relative_errors
    if errors is None or relative is None:
        return []
    noise = errors if estimate.noise_errors is None else estimate.noise_errors
    share = np.ones(len(errors)) if estimate.data_share is None else estimate.data_share
    rows = zip(estimate.names[:10], estimate.values, errors, relative, noise, share)
    return [
        "Standard errors, all causes together (and of noise alone):",
        *(f"  {name}: {_with_error(*figures)}" for name, *figures in rows),
        *_budget_line(estimate),
    ]


def _with_error(value: float, error: float, relative: float, noise: float, data: float) -> str:
    if not np.isfinite(error):
        return f"{value:.4g}, at least partly from the model (data {100.0 * data:.0f} %)"
    parts = [_percent(relative)] if np.isfinite(relative) else []
    parts += [f"noise {noise:.2g}"]
    parts += [f"data {100.0 * data:.0f} %"] if data < WHOLE else []
    return f"{value:.4g} ± {error:.2g} ({'; '.join(parts)})"


def _budget_line(estimate: Estimate) -> list[str]:
    """Return what the mass's error comes from."""
    if not estimate.error_budget or estimate.noise_errors is None:
        return []
    parts = {"noise": estimate.noise_errors, **estimate.error_budget}
    listed = ", ".join(f"{cause} {values[0]:.2g}" for cause, values in parts.items())
    return [f"The mass's error by cause, kg: {listed}"]


def _percent(share: float) -> str:
    """Return a share in percent with two digits, also where it is large."""
    percent = 100.0 * share
    return f"{percent:.2g} %" if percent < 99.5 else f"{percent:.0f} %"


def _all_friction_lines(identification: Identification) -> list[str]:
    per_joint = friction_entries(identification)
    if not per_joint:
        return []
    estimate = identification.estimate
    return [
        f"Friction ({identification.friction_model}):",
        *(
            f"  {joint}: " + ", ".join(_term_text(estimate, joint, term) for term in terms)
            for joint, terms in per_joint.items()
        ),
    ]


def _term_text(estimate: Estimate, joint: str, term: str) -> str:
    name = f"{term}[{joint}]"
    value, error = estimate.value(name), estimate.error(name)
    if error is not None and not np.isfinite(error):
        return f"{term} not visible"
    return f"{term} {value:.3g}" + ("" if error is None else f" ± {error:.1g}")


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
        + ("" if test.relative_error is None else f" ({100.0 * test.relative_error:.2f} %)")
        for test in identification.validation
    ]


def _friction_lines(identification: Identification) -> list[str]:
    joint, estimate = identification.joint_name, identification.estimate
    coulomb = estimate.value(f"coulomb[{joint}]")
    viscous = estimate.value(f"viscous[{joint}]")
    if coulomb is None or viscous is None:
        return []
    units = ("N", "N·s/m") if identification.is_slide else ("N·m", "N·m·s/rad")
    # Adding zero turns the -0.00 that rounding leaves into 0.00.
    return [
        f"  Coulomb friction: {round(coulomb, 2) + 0.0:.2f} {units[0]}",
        f"  Viscous friction: {round(viscous, 2) + 0.0:.2f} {units[1]}",
    ]


def _unidentifiable_lines(identification: Identification) -> list[str]:
    estimate = identification.estimate
    # Of measured data, the limits of the result tell it.
    measured = identification.data.source.is_measured
    if measured or estimate.status is not Status.PARTLY_FROM_MODEL:
        return []
    listed = "; ".join(estimate.identifiability.unidentifiable)
    return [f"  Not visible in these torques, kept from the model: {listed}"]


def detail_lines(identification: Identification) -> list[str]:
    """Return what --verbose adds: residual per joint, scaled condition number, centre of mass."""
    estimate = identification.estimate
    link = estimate.inertial
    com = ", ".join(f"{value:.4f}" for value in link.com)
    scaled = estimate.identifiability.scaled_condition_number
    residuals = [
        f"    {joint}: {value:.2e} N·m" for joint, value in estimate.rmse_per_joint.items()
    ]
    return [
        f"  Centre of mass: [{com}] m",
        f"  Condition number, columns scaled: {scaled:.1f}",
        "  RMSE per joint:",
        *residuals,
        f"  Status: {estimate.status.value}",
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
