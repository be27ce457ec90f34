"""Units as text, of hinges and of slides."""

from __future__ import annotations

from collections.abc import Mapping

THETA = ("kg", *["kg·m"] * 3, *["kg·m²"] * 6)
"""Units of the ten inertial parameters."""
_TERMS: Mapping[str, tuple[str, str]] = {
    **dict.fromkeys(("coulomb", "offset", "stribeck", "sigmoid"), ("N·m", "N")),
    "viscous": ("N·m·s/rad", "N·s/m"),
    "armature": ("kg·m²", "kg"),
    "sqrt": ("N·m·√(s/rad)", "N·√(s/m)"),
    "quadratic": ("N·m·s²/rad²", "N·s²/m²"),
    "cubic": ("N·m·s³/rad³", "N·s³/m³"),
    **dict.fromkeys(("stribeck_speed", "sigmoid_speed"), ("rad/s", "m/s")),
    "zero": ("rad", "m"),
}
"""Friction term, speed of a bent one or nuisance to its unit in a hinge and in a slide."""


def torque(is_slide: bool) -> str:
    """Return the unit of a joint's torque."""
    return "N" if is_slide else "N·m"


def position(is_slide: bool) -> str:
    """Return the unit of a joint's position."""
    return "m" if is_slide else "rad"


def term_unit(term: str, is_slide: bool) -> str:
    """Return the unit of a friction term's coefficient; "" for one without."""
    return _TERMS[term][is_slide] if term in _TERMS else ""
