"""arm.json and friction.json: every link and every joint, and how far to trust them.

Strict JSON in full precision. Inertia is about the body ORIGIN in ``inertia_tensor`` and about the
centre of mass in ``inertia_about_com``, all in the frame of the link's body.

friction.json is each joint's friction for controllers. The torque that friction takes is the sum of
all terms' values times their formulas, with ``qd`` the joint's speed and ``load`` the torque its
gear transmits (that of the links alone). ``bam`` holds a joint's numbers under the names of BAM
("better actuator models", Duclusaud, Passault, Padois, Ly, "Extended friction models for the
physics simulation of servo actuators", ICRA 2025), its models m1 to m4. BAM takes the sum of motor
and external torque for the load, which at rest is twice what the gear transmits, so that its loss
per load is half of ours. It also wants the name of an actuator, which says how voltage makes torque
and is not identified here.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.output.params_json import inertial_entries, json_text
from robot_sysid.output.printed.rollout import rollout_entry
from robot_sysid.records import InertialParameters
from robot_sysid.records.whole_arm import ArmEstimate, ArmIdentification, HeldFriction

ARM_SCHEMA, FRICTION_SCHEMA = "robot-sysid arm 1", "robot-sysid friction 1"
FRICTION_NAME = "friction.json"
FORMULAS = {
    "coulomb": "sign(qd)",
    "viscous": "qd",
    "offset": "1",
    "sqrt": "sign(qd) * sqrt(abs(qd))",
    "stribeck": "sign(qd) * exp(-(qd / stribeck_speed)**2)",
    "load": "sign(qd) * abs(load)",
    "quadratic": "qd * abs(qd)",
    "cubic": "qd**3",
    "sigmoid": "tanh(qd / sigmoid_speed)",
}
"""What each term's value is multiplied by."""
_SURE = 1.96
_IN_BAM = {
    "viscous": ("friction_viscous", 1.0),
    "stribeck": ("friction_stribeck", 1.0),
    "stribeck_speed": ("dtheta_stribeck", 1.0),
    "load": ("load_friction_base", 0.5),
    "armature": ("armature", 1.0),
}


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
        "motors": {name: _figures(estimate, name) for name in estimate.couplings},
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
    return json_text(content)


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
        **_figures(found.estimate, joint),
        "friction_model": found.estimate.friction[joint],
        "held_out_rmse_by_friction_model": dict(found.choices.get(joint, {})),
        "in_the_model": _held(found.model_friction[joint]),
        "not_in_the_model": dict(found.model_friction[joint].missing),
        "friction_curve": _curve(found.model_friction[joint]),
        "torque_noise": found.estimate.noise_per_joint[joint],
        "held_out_error": found.held_out.relative_error_per_joint[joint],
    }


def _held(held: HeldFriction) -> dict[str, Any]:
    """Return what the file gets, with errors; what the data does not prove stays as it was."""
    return {
        term: {"value": held.written(term), "found": value, "standard_error": held.errors[term]}
        for term, value in held.values.items()
    }


def _curve(held: HeldFriction) -> dict[str, Any]:
    curve = held.curve
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


def _figures(estimate: ArmEstimate, owner: str) -> dict[str, Any]:
    """Return what was found of a joint or a motor, by term."""
    ending = f"[{owner}]"
    names = [name for name in estimate.names if name.endswith(ending)]
    return {name[: -len(ending)]: _figure(estimate, name) for name in names}


def _figure(estimate: ArmEstimate, name: str) -> dict[str, Any] | None:
    """Return a value, its standard error and its 95 % interval; None where it is not there."""
    value, error = estimate.value(name), estimate.error(name)
    return None if value is None or error is None else _with_interval(value, error)


def _with_interval(value: float, error: float) -> dict[str, Any]:
    reach = _SURE * error
    return {"value": value, "standard_error": error, "interval": [value - reach, value + reach]}


def _base(estimate: ArmEstimate) -> list[dict[str, Any]]:
    base = estimate.base
    rows = zip(base.combinations, base.values, base.standard_errors, base.essential)
    return [
        {"combination": words, "value": value, "standard_error": error, "essential": bool(kept)}
        for words, value, error, kept in rows
    ]


def friction_json_text(found: ArmIdentification) -> str:
    """Return the text of friction.json."""
    estimate = found.estimate
    content = {
        "schema": FRICTION_SCHEMA,
        "status": found.status.name,
        "joints": {joint: _friction(found, joint) for joint in found.joint_names},
        "motors": {name: {"terms": _terms(estimate, name)} for name in estimate.couplings},
        "formulas": FORMULAS,
    }
    return json_text(content)


def _friction(found: ArmIdentification, joint: str) -> dict[str, Any]:
    estimate = found.estimate
    terms = _terms(estimate, joint)
    ways = {
        f"coulomb_{way}": _with_interval(*pair)
        for way, pair in zip(("forward", "backward"), estimate.two_way.get(joint, ()))
    }
    return {
        "model": estimate.friction[joint],
        "terms": terms,
        **ways,
        "armature": _figure(estimate, f"armature[{joint}]"),
        "bam": _bam(estimate, joint, found.model_friction[joint]) if terms else None,
    }


def _terms(estimate: ArmEstimate, owner: str) -> dict[str, Any]:
    """Return the friction terms of a joint or a motor, and the speeds of nonlinear ones."""
    speeds = [f"{term}_speed" for term in FORMULAS]
    found = {term: _figure(estimate, f"{term}[{owner}]") for term in (*FORMULAS, *speeds)}
    return {term: value for term, value in found.items() if value is not None}


def _bam(estimate: ArmEstimate, joint: str, held: HeldFriction) -> dict[str, Any]:
    """Return what BAM's load_model_from_dict reads, but for the actuator's name."""
    terms = set(estimate.friction[joint].split("-"))
    if terms - {"coulomb", "viscous", "offset", "armature", "stribeck", "load"}:
        # BAM has no such curve: the nearest Coulomb and viscous friction.
        terms, values = {"coulomb", "viscous", "armature"}, dict(held.values)
    else:
        every = {name: estimate.value(f"{name}[{joint}]") for name in ("coulomb", *_IN_BAM)}
        values = {name: value for name, value in every.items() if value is not None}
    number = 1 + ("stribeck" in terms) + 2 * ("load" in terms)
    found: dict[str, Any] = {"model": f"m{number}", "friction_base": values["coulomb"]}
    found["friction_viscous"] = 0.0
    for term, (name, share) in _IN_BAM.items():
        if term in values:
            found[name] = share * values[term]
    if "stribeck" in terms:
        found["alpha"] = 2.0
    if number == 4:
        found["load_friction_stribeck"] = 0.0
    return found
