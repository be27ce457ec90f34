"""The result block that the command line prints."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from robot_sysid.damiao.trajectory_csv import DamiaoExportReport
from robot_sysid.records import Estimate, Identification, Status


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
        *_blind_lines(estimate),
    ]


def _friction_lines(identification: Identification) -> list[str]:
    joint, estimate = identification.joint_name, identification.estimate
    coulomb = estimate.value(f"coulomb[{joint}]")
    viscous = estimate.value(f"viscous[{joint}]")
    if coulomb is None or viscous is None:
        return []
    return [
        f"  Coulomb friction: {coulomb:.2f} N·m",
        f"  Viscous friction: {viscous:.2f} N·m·s/rad",
    ]


def _blind_lines(estimate: Estimate) -> list[str]:
    if estimate.status is not Status.PARTLY_FROM_MODEL:
        return []
    blind = "; ".join(estimate.identifiability.blind)
    return [f"  Not visible in these torques, kept from the model: {blind}"]


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
