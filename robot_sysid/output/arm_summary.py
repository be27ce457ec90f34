"""The result block of an identification of every link."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot_sysid.records import Validation
from robot_sysid.records.whole_arm import ArmEstimate, ArmIdentification


def arm_lines(found: ArmIdentification, verbose: bool = False) -> list[str]:
    """Return the block line by line; ``verbose`` adds the base parameters."""
    estimate = found.estimate
    return [
        "Identified links, model -> identified ± standard error (centre of mass in body axes):",
        *_link_lines(found),
        f"Friction of the joints ({estimate.friction}):",
        *_friction_lines(estimate, found.joint_names),
        *_motor_lines(estimate),
        *_base_lines(estimate, verbose),
        f"Weight of the model: {estimate.gamma:g}",
        _error_line("Held-out torque error, each part of the log predicted from the others", found),
        *(_test_line(f"Validation on {test.source}", test) for test in found.validation),
        *(f"  Problem: {reason}" for reason in found.reasons),
    ]


def _link_lines(found: ArmIdentification) -> Iterator[str]:
    estimate = found.estimate
    for name, before, after, errors in zip(
        found.link_names, found.model_thetas, estimate.thetas, estimate.theta_errors
    ):
        if not np.any(before):
            continue
        mass = f"{before[0]:.3f} -> {after[0]:.3f} ± {errors[0]:.2g} kg"
        old, new = (_vector(theta[1:4] / theta[0]) for theta in (before, after))
        yield f"  {name}: {mass}; {old} -> {new} m"


def _vector(values: np.ndarray) -> str:
    # Adding zero turns the -0.000 that rounding leaves into 0.000.
    return "[" + ", ".join(f"{round(float(v), 3) + 0.0:.3f}" for v in values) + "]"


def _friction_lines(estimate: ArmEstimate, joints: tuple[str, ...]) -> Iterator[str]:
    for joint in joints:
        yield f"  {joint}: {_terms(estimate, joint)}"


def _motor_lines(estimate: ArmEstimate) -> Iterator[str]:
    for name in estimate.couplings:
        yield f"  motor that turns with {name}: {_terms(estimate, name)}"


def _terms(estimate: ArmEstimate, owner: str) -> str:
    ending, parts = f"[{owner}]", []
    for name, value, error in zip(estimate.names, estimate.values, estimate.standard_errors):
        if name.endswith(ending) and not name.startswith("zero"):
            parts.append(f"{name[: -len(ending)]} {value:.3g} ± {error:.1g}")
    return ", ".join(parts)


def _base_lines(estimate: ArmEstimate, verbose: bool) -> Iterator[str]:
    base = estimate.base
    kept = sum(base.essential)
    yield (
        f"Base parameters: {base.rank} of {base.structural_rank} that any motion can show; "
        f"{kept} of them essential to these logs"
    )
    if verbose:
        rows = zip(base.combinations, base.values, base.standard_errors, base.essential)
        for words, value, error, is_kept in rows:
            yield f"  {value:.4g} ± {error:.2g} = {words}" + ("" if is_kept else " (not essential)")


def _error_line(label: str, found: ArmIdentification) -> str:
    ratio = f"the model with fitted friction: {100.0 * found.model_error:.2f} %"
    return f"{_test_line(label, found.held_out)}; {ratio}"


def _test_line(label: str, test: Validation) -> str:
    whole = "" if test.relative_error is None else f" ({100.0 * test.relative_error:.2f} %"
    joints = ", ".join(
        f"{name} {100.0 * error:.3g} %"
        for name, error in test.relative_error_per_joint.items()
        if error is not None
    )
    return f"{label}: {test.rmse:.4f} N·m" + (f"{whole}; {joints})" if whole else "")
