"""arm.json: every link, every joint and how far to trust them, in full precision.

Strict JSON. Inertia is about the body ORIGIN in ``inertia_tensor`` and about the centre of mass in
``inertia_about_com``, all in the frame of the link's body.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.output.params_json import inertial_entries
from robot_sysid.output.printed.rollout import rollout_entry
from robot_sysid.output.whole_arm.friction_json import figure
from robot_sysid.records import InertialParameters
from robot_sysid.records.whole_arm import (
    ArmEstimate,
    ArmIdentification,
    FrictionCurve,
    HeldFriction,
)

ARM_SCHEMA = "robot-sysid arm 1"
ARM_NAME = "arm.json"


def arm_json_text(found: ArmIdentification) -> str:
    """Return the text of arm.json."""
    estimate = found.estimate
    content = {
        "schema": ARM_SCHEMA,
        "status": found.status.name,
        "status_text": found.status.value,
        "reasons": found.reasons,
        "links": [_link(found, index) for index in range(len(found.link_names))],
        "joints": {joint: _joint(found, joint) for joint in found.joint_names},
        "motors": {name: _named(estimate, name) for name in estimate.couplings},
        "tilt": {name: _figure(estimate, name) for name in estimate.names if "tilt" in name},
        "model_weight": estimate.gamma,
        "base_parameters": _base(estimate),
        "structural_rank": estimate.base.structural_rank,
        "held_out": asdict(found.held_out),
        "held_out_error_of_the_model": found.model_error,
        "validation": [asdict(test) for test in found.validation],
        "rollout": rollout_entry(found.rollout),
        "cutoff": found.cutoff,
        "source": found.data.words,
        "duration": found.data.duration,
        "sample_rate": found.data.sample_rate,
        "model": {"path": str(found.model_path), "sha256": found.model_sha256},
        "versions": dict(found.versions),
        "notes": found.notes,
    }
    return json.dumps(content, indent=2, allow_nan=False, default=_plain) + "\n"


def _link(found: ArmIdentification, index: int) -> dict[str, Any]:
    estimate = found.estimate
    errors = estimate.theta_errors[index]
    return {
        "body": found.link_names[index],
        "joint": found.joint_names[index],
        "identified": _entries(estimate.thetas[index]),
        "standard_errors": dict(zip(PARAMETER_NAMES, errors.tolist())),
        "model": _entries(found.model_thetas[index]),
    }


def _entries(theta: Any) -> dict[str, Any] | None:
    """Return a link's numbers; None for one without mass."""
    return inertial_entries(InertialParameters(theta)) if np.any(theta) else None


def _joint(found: ArmIdentification, joint: str) -> dict[str, Any]:
    return {
        **_named(found.estimate, joint),
        "friction_model": found.estimate.friction[joint],
        "held_out_rmse_by_friction_model": dict(found.choices.get(joint, {})),
        "in_the_model": _held(found.model_friction[joint]),
        "not_in_the_model": dict(found.model_friction[joint].missing),
        "friction_curve": _curve(found.model_friction[joint].curve),
        "torque_noise": found.estimate.noise_per_joint[joint],
        "held_out_error": found.held_out.relative_error_per_joint[joint],
    }


def _held(held: HeldFriction) -> dict[str, Any]:
    """Return what the file gets, with errors; what the data does not prove stays as it was."""
    return {
        term: {
            "value": held.written(term),
            "found": value,
            "standard_error": held.errors[term],
        }
        for term, value in held.values.items()
    }


def _curve(curve: FrictionCurve) -> dict[str, Any]:
    return {
        "speed": curve.speed,
        "torque": curve.torque,
        "measured": {
            "speed": curve.measured_speed,
            "torque": curve.measured_torque,
            "standard_error": curve.standard_error,
            "rows": curve.rows,
        },
    }


def _named(estimate: ArmEstimate, owner: str) -> dict[str, Any]:
    """Return what was found of a joint or a motor, by term."""
    ending = f"[{owner}]"
    names = [name for name in estimate.names if name.endswith(ending)]
    return {name[: -len(ending)]: _figure(estimate, name) for name in names}


def _figure(estimate: ArmEstimate, name: str) -> dict[str, Any]:
    """Return a value, its standard error and its 95 % interval."""
    value, error = estimate.value(name), estimate.error(name)
    if value is None or error is None:
        return {"value": value, "standard_error": error}
    return figure(value, error)


def _base(estimate: ArmEstimate) -> list[dict[str, Any]]:
    base = estimate.base
    rows = zip(base.combinations, base.values, base.standard_errors, base.essential)
    return [
        {"combination": words, "value": value, "standard_error": error, "essential": bool(kept)}
        for words, value, error, kept in rows
    ]


def _plain(value: Any) -> Any:
    """Return what JSON can hold of a numpy number or array."""
    return value.tolist()
