"""The result block of an identification of every link."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from robot_sysid.output.printed.before_after import (
    BeforeAfter,
    friction_text,
    table_lines,
    theta_rows,
)
from robot_sysid.output.printed.rollout import rollout_lines
from robot_sysid.records import Validation
from robot_sysid.records.figures import percent, term_unit, torque, with_error
from robot_sysid.records.whole_arm import ArmEstimate, ArmIdentification


def arm_lines(found: ArmIdentification, verbose: bool = False) -> list[str]:
    """Return the block line by line; ``verbose`` adds the base parameters."""
    estimate = found.estimate
    return [
        "Identified links, before -> after, ± one standard error (moments in body axes):",
        *table_lines(list(link_rows_of(found))),
        "Friction of the joints, with the terms that predict held-out torques best:",
        *_friction_lines(found),
        *_missing_lines(found),
        *_base_lines(estimate, verbose),
        f"Weight of the model: {estimate.gamma:g}",
        _error_line("Held-out torque error, each part of the log predicted from the others", found),
        *(_test_line(f"Validation on {test.source}", test) for test in found.validation),
        *([] if found.rollout is None else rollout_lines(found.rollout, verbose)),
        *(f"  Problem: {reason}" for reason in found.reasons),
    ]


def link_rows_of(found: ArmIdentification) -> Iterator[BeforeAfter]:
    """Yield mass and first moments of the links that have mass."""
    rows = zip(found.link_names, found.model_thetas, found.estimate.thetas)
    for (name, before, after), errors in zip(rows, found.estimate.theta_errors):
        if np.any(before):
            for row in theta_rows(before, after, errors)[:4]:
                yield replace(row, name=f"{name} {row.name}")


def _friction_lines(found: ArmIdentification) -> Iterator[str]:
    for joint in found.joint_names:
        yield f"  {joint}: {_terms(found, joint) or 'not shown by these logs'}"
    for name in found.estimate.couplings:
        yield f"  motor that turns with {name}: {_terms(found, name)}"


_MISSING = {
    "stribeck_drop": "Stribeck drop",
    "offset_or_asymmetry": "offset, or Coulomb friction larger forward than backward",
    "load_dependent_rms": "friction that grows with the load, rms",
    "left_over_rms": "all that the file's friction leaves over, rms",
}


def _missing_lines(found: ArmIdentification) -> Iterator[str]:
    yield "Friction that a model file cannot hold:"
    for joint, held in found.model_friction.items():
        if not held.missing:
            continue
        unit = torque(joint in found.slides)
        sizes = ", ".join(f"{_MISSING[k]} {v:.2g} {unit}" for k, v in held.missing.items())
        yield f"  {joint}: {sizes}"


def _terms(found: ArmIdentification, owner: str) -> str:
    estimate, ending, parts = found.estimate, f"[{owner}]", []
    for name, value, error in zip(estimate.names, estimate.values, estimate.standard_errors):
        term = name[: -len(ending)]
        if name.endswith(ending) and term != "zero":
            unit = term_unit(term, owner in found.slides)
            parts.append(friction_text(term, None, value, error, unit))
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
            yield f"  {with_error(value, error)} = {words}" + (
                "" if is_kept else " (not essential)"
            )


def _error_line(label: str, found: ArmIdentification) -> str:
    ratio = f"the model with fitted friction: {percent(found.model_error)}"
    return f"{_test_line(label, found.held_out)}; {ratio}"


def _test_line(label: str, test: Validation) -> str:
    whole = "" if test.relative_error is None else f" ({percent(test.relative_error)}"
    joints = ", ".join(
        f"{name} {percent(error)}"
        for name, error in test.relative_error_per_joint.items()
        if error is not None
    )
    return f"{label}: {test.rmse:.4f} N·m" + (f"{whole}; {joints})" if whole else "")
