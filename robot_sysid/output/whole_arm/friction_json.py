"""friction.json: each joint's friction for controllers, and what BAM users can load.

Strict JSON. The torque that friction takes is the sum of all terms' values times their formulas,
with ``qd`` the joint's speed and ``load`` the torque its gear transmits (that of the links alone).

``bam`` holds a joint's numbers under the names of BAM ("better actuator models", Duclusaud,
Passault, Padois, Ly, "Extended friction models for the physics simulation of servo actuators",
ICRA 2025), its models m1 to m4. BAM takes the sum of motor and external torque for the load, which
at rest is twice what the gear transmits, so that its loss per load is half of ours. It also wants
the name of an actuator, which says how voltage makes torque and is not identified here.
"""

from __future__ import annotations

import json
from typing import Any

from robot_sysid.records.whole_arm import ArmEstimate, ArmIdentification, HeldFriction

FRICTION_SCHEMA = "robot-sysid friction 1"
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


def friction_json_text(found: ArmIdentification) -> str:
    """Return the text of friction.json."""
    estimate = found.estimate
    content = {
        "schema": FRICTION_SCHEMA,
        "status": found.status.name,
        "joints": {joint: _joint(found, joint) for joint in found.joint_names},
        "motors": {name: {"terms": terms_of(estimate, name)} for name in estimate.couplings},
        "formulas": FORMULAS,
    }
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def _joint(found: ArmIdentification, joint: str) -> dict[str, Any]:
    estimate = found.estimate
    terms = terms_of(estimate, joint)
    ways = {
        f"coulomb_{way}": figure(*pair)
        for way, pair in zip(("forward", "backward"), estimate.two_way.get(joint, ()))
    }
    return {
        "model": estimate.friction[joint],
        "terms": terms,
        **ways,
        "armature": _named(estimate, f"armature[{joint}]"),
        "bam": _bam(estimate, joint, found.model_friction[joint]) if terms else None,
    }


def terms_of(estimate: ArmEstimate, owner: str) -> dict[str, Any]:
    """Return the friction terms of a joint or a motor, and the speeds of nonlinear ones."""
    speeds = [f"{term}_speed" for term in FORMULAS]
    found = {term: _named(estimate, f"{term}[{owner}]") for term in (*FORMULAS, *speeds)}
    return {term: value for term, value in found.items() if value is not None}


def _named(estimate: ArmEstimate, name: str) -> dict[str, Any] | None:
    value, error = estimate.value(name), estimate.error(name)
    return None if value is None or error is None else figure(value, error)


def figure(value: float, error: float) -> dict[str, Any]:
    """Return a value, its standard error and its 95 % interval."""
    reach = _SURE * error
    return {"value": value, "standard_error": error, "interval": [value - reach, value + reach]}


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
