"""The result block that the command line prints, and what limits a result, in plain words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robot_sysid.dynamics.friction import friction_model
from robot_sysid.dynamics.gravity import TILT_NAMES
from robot_sysid.dynamics.spatial import PARAMETER_NAMES, characteristic_length, parameter_scale
from robot_sysid.estimation.uncertainty import OTHER_LINKS, TORQUE_SCALE
from robot_sysid.output.params_json import friction_entries
from robot_sysid.records import DELAY_NAME, Estimate, Identification, Status

if TYPE_CHECKING:
    from robot_sysid.damiao.trajectory.csv_file import DamiaoExportReport


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
        *_blind_lines(identification),
        *_measured_lines(identification),
    ]


def _measured_lines(identification: Identification) -> list[str]:
    """Return what only measured data can tell: errors, friction of all joints, validation."""
    if identification.friction_model is None:
        return []
    return [
        *_error_lines(identification.estimate),
        *_all_friction_lines(identification),
        *_noise_lines(identification.estimate),
        *_alignment_lines(identification),
        *_validation_lines(identification),
        *(f"  Limit: {sentence}" for sentence in identification.limitations),
    ]


def _error_lines(estimate: Estimate) -> list[str]:
    errors, relative = estimate.standard_errors, estimate.relative_errors
    if errors is None or relative is None:
        return []
    share = np.ones(len(errors)) if estimate.data_share is None else estimate.data_share
    rows = zip(estimate.names[:10], estimate.values, errors, relative, share)
    return [
        "Standard errors (and share of the data in each value):",
        *(f"  {name}: {_with_error(*figures)}" for name, *figures in rows),
    ]


def _with_error(value: float, error: float, relative: float, data: float) -> str:
    if not np.isfinite(error):
        return f"{value:.4g}, at least partly from the model (data {100.0 * data:.0f} %)"
    share = f"{_percent(relative)}; " if np.isfinite(relative) else ""
    return f"{value:.4g} ± {error:.2g} ({share}data {100.0 * data:.0f} %)"


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


def _blind_lines(identification: Identification) -> list[str]:
    estimate = identification.estimate
    # Of measured data, the limits of the result tell it.
    measured = identification.friction_model is not None
    if measured or estimate.status is not Status.PARTLY_FROM_MODEL:
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


WEAK = 0.1
"""Standard error, relative to a body of this mass and size, above which a parameter is weak."""
COLOURED = 0.3
"""Share of independent samples below which residuals are called correlated in time."""
WORSE = 1.5
"""Held-out error over fitted error above which the model, not noise, is the limit."""
PRIOR_SHARE = 0.5
"""Share of the data in a value below which the model has more say."""
SURE = 3.0
"""Standard errors from zero beyond which a sign is sure."""
_VISIBLE = 1e-4


def limitations(found: Identification) -> tuple[str, ...]:
    """Return one sentence per thing that limits the accuracy of an identification."""
    estimate = found.estimate
    return (
        *_blind(estimate),
        *_weak(estimate),
        *_prior(estimate),
        *_hidden(found),
        *_negative_friction(found),
        *_coloured(estimate),
        *_generalises(found),
        *_constrained(estimate),
    )


def _blind(estimate: Estimate) -> Iterator[str]:
    if estimate.identifiability.blind:
        blind = "; ".join(estimate.identifiability.blind)
        yield f"not visible in these torques, kept from the model: {blind}"


def _weak(estimate: Estimate) -> Iterator[str]:
    """Name the parameters whose standard error is large for a body of this mass and size."""
    if estimate.standard_errors is None:
        return
    theta = estimate.values[:10]
    scale = parameter_scale(max(float(theta[0]), 1e-9), characteristic_length(theta))
    relative = estimate.standard_errors[:10] / scale
    weak = [k for k in np.argsort(-relative) if np.isfinite(relative[k]) and relative[k] > WEAK]
    if weak:
        listed = ", ".join(f"{PARAMETER_NAMES[k]} (±{100.0 * relative[k]:.0f} %)" for k in weak)
        yield (
            f"weakly seen, in percent of what a body of this mass and size has: {listed}; move "
            "faster, wider or longer, or use --excitation optimal"
        )


def _prior(estimate: Estimate) -> Iterator[str]:
    if estimate.data_share is None:
        return
    rows = zip(PARAMETER_NAMES, estimate.data_share, estimate.identifiability.identified)
    names = [name for name, share, seen in rows if seen and share < PRIOR_SHARE]
    if names:
        yield f"more model than data in {', '.join(names)}: the prior outweighs the torques there"


def _hidden(found: Identification) -> Iterator[str]:
    """Tell what errors do that the residuals cannot show."""
    causes = (
        (OTHER_LINKS, "if the other links take 1 % more torque than the model says"),
        (TORQUE_SCALE, "if each joint's torque scale is off by 1 %"),
    )
    moves = [f"{words}, {move}" for cause, words in causes for move in _moves(found, cause)]
    if moves:
        yield f"errors that residuals do not show: {'; '.join(moves)}"


def _moves(found: Identification, cause: str) -> Iterator[str]:
    """Yield what 1 % of a cause does, where it does anything."""
    change, link = found.sensitivity.get(cause, {}), found.estimate.inertial
    if not change or abs(change["m"]) <= _VISIBLE * link.mass:
        return
    mass = abs(change["m"])
    text = f"the mass moves by {mass:.2g} kg"
    if mass < 0.5 * link.mass:
        com = np.array([change["hx"], change["hy"], change["hz"]]) - change["m"] * link.com
        text += f" ({100.0 * mass / link.mass:.2g} %) and the centre of mass by "
        text += f"{1e3 * np.linalg.norm(com) / link.mass:.2g} mm"
    yield text


def _negative_friction(found: Identification) -> Iterator[str]:
    """Name joints that would drive themselves, more clearly than noise explains."""
    if found.friction_model is None:
        return
    model, estimate = friction_model(found.friction_model), found.estimate
    bounded = [term for term, bound in zip(model.terms, model.non_negative) if bound]
    clear = []
    for joint in found.joint_names:
        for term in bounded:
            value, error = (f(f"{term}[{joint}]") for f in (estimate.value, estimate.error))
            if value is not None and error is not None and value < -SURE * error:
                clear.append(f"{term} {value:.2g} of {joint}")
    if clear:
        yield (
            f"friction that drives instead of brakes ({', '.join(clear)}): check the sign and the "
            "scale of these torques, or let --friction-model auto choose other terms"
        )


def _coloured(estimate: Estimate) -> Iterator[str]:
    """Tell when residuals are correlated in time: then more samples do not help."""
    slow = [name for name, share in estimate.independent_share.items() if share < COLOURED]
    if slow:
        yield (
            f"residuals of {', '.join(slow)} are correlated in time: errors of the other links' "
            "parameters or of the friction model limit the result, not sensor noise"
        )


def _generalises(found: Identification) -> Iterator[str]:
    for test in found.validation:
        if test.rmse > WORSE * found.estimate.rmse:
            yield (
                f"torques of {test.source} are predicted {test.rmse / found.estimate.rmse:.1f} "
                "times worse than the fitted ones: the model misses something that motion shows"
            )


def _constrained(estimate: Estimate) -> Iterator[str]:
    if estimate.constrained:
        yield (
            "the plain estimate was no possible rigid body, so the best possible one was taken; "
            "its standard errors are those of the plain estimate"
        )
