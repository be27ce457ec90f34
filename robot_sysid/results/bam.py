"""A joint's friction under the names of BAM, for its simulation of servos.

BAM is "better actuator models" (Duclusaud, Passault, Padois, Ly, "Extended friction models for the
physics simulation of servo actuators", ICRA 2025), here its models m1 to m4. BAM takes the sum of
motor and external torque for the load, which at rest is twice what the gear transmits, so that its
loss per load is half of ours. It also wants the name of an actuator, which says how voltage makes
torque and is not identified here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from robot_sysid.results.record import JointEstimate, Quantity

_BAM_NAMES = {
    "viscous": ("friction_viscous", 1.0),
    "stribeck": ("friction_stribeck", 1.0),
    "stribeck_speed": ("dtheta_stribeck", 1.0),
    "load": ("load_friction_base", 0.5),
    "armature": ("armature", 1.0),
}
"""Friction term to its name in BAM, and the factor from our coefficient to that of BAM."""


def bam_entry(
    joint: JointEstimate, written_terms: Mapping[str, Quantity]
) -> dict[str, Any] | None:
    """Return the arguments of BAM's load_model_from_dict, but for the actuator's name.

    None without Coulomb friction. Where BAM lacks a term, Coulomb and viscous friction as written
    to the model take the place of all terms.
    """
    names = set(joint.friction_model.split("-")) - {"none"}
    terms = joint.terms
    if names - {"coulomb", "viscous", "offset", "armature", "stribeck", "load"}:
        names = {"coulomb", "viscous", "armature"}
        terms = written_terms
    if "coulomb" not in terms:
        return None
    # m1 has Coulomb and viscous friction, m2 the Stribeck term too, m3 that of load, m4 both.
    number = 1 + ("stribeck" in names) + 2 * ("load" in names)
    entry: dict[str, Any] = {
        "model": f"m{number}",
        "friction_base": terms["coulomb"].value,
        "friction_viscous": 0.0,
    }
    for term, (bam_name, factor) in _BAM_NAMES.items():
        if term in terms:
            entry[bam_name] = factor * terms[term].value
    if "stribeck" in names:
        entry["alpha"] = 2.0
    if number == 4:
        entry["load_friction_stribeck"] = 0.0
    return entry
