"""Units of what is drawn, by kind of joint."""

from __future__ import annotations

THETA = ("kg", *["kg·m"] * 3, *["kg·m²"] * 6)
"""Units of the ten inertial parameters."""
_TERMS = {
    "coulomb": "{t}",
    "viscous": "{t}·s/{q}",
    "offset": "{t}",
    "armature": "{i}",
    "sqrt": "{t}·(s/{q})^0.5",
    "stribeck": "{t}",
    "load": "",
    "zero": "{q}",
    "scale": "",
    "drift": "",
}


def torque(is_slide: bool) -> str:
    """Return the unit of a joint's torque."""
    return "N" if is_slide else "N·m"


def position(is_slide: bool) -> str:
    """Return the unit of a joint's position."""
    return "m" if is_slide else "rad"


def term(name: str, is_slide: bool) -> str:
    """Return the unit of a friction term; "" for one without, or not known."""
    inertia = "kg" if is_slide else "kg·m²"
    words = _TERMS.get(name, "")
    return words.format(t=torque(is_slide), q=position(is_slide), i=inertia)
