"""Numbers as text: with the digits that their errors deserve, readable shares, and units."""

from __future__ import annotations

import math
from collections.abc import Mapping

THETA = ("kg", *["kg·m"] * 3, *["kg·m²"] * 6)
"""Units of the ten inertial parameters."""
_TERMS: Mapping[str, tuple[str, str]] = {
    **dict.fromkeys(("coulomb", "offset", "stribeck", "sigmoid"), ("N·m", "N")),
    **dict.fromkeys(("fading_fast", "fading", "fading_slow"), ("N·m", "N")),
    "viscous": ("N·m·s/rad", "N·s/m"),
    "armature": ("kg·m²", "kg"),
    "sqrt": ("N·m·√(s/rad)", "N·√(s/m)"),
    "quadratic": ("N·m·s²/rad²", "N·s²/m²"),
    "cubic": ("N·m·s³/rad³", "N·s³/m³"),
    **dict.fromkeys(("stribeck_speed", "sigmoid_speed"), ("rad/s", "m/s")),
    "zero": ("rad", "m"),
}
"""Friction term, speed of a bent one or nuisance to its unit in a hinge and in a slide."""
_MOST_PLACES = 6
_MOST_PERCENT = 1000.0


def figure(value: float, error: float | None = None) -> str:
    """Return a number with as many digits as its standard error deserves, of which two count, and
    never 0.000 for one that is not zero; four of its own where the error is None or infinite.
    """
    if not math.isfinite(value):
        return "not known"
    if value == 0.0:
        return "0"
    if error is None or not 0.0 < error < math.inf:
        return f"{value:.4g}"
    places = 1 - math.floor(math.log10(error))
    if places <= _MOST_PLACES:
        text = f"{value:.{max(places, 0)}f}"
        return text if abs(float(text) - value) <= 0.5 * abs(value) else f"{value:.1g}"
    return f"{value:.{max(math.floor(math.log10(abs(value))) + places + 1, 1)}g}"


def with_error(value: float, error: float | None, unit: str = "") -> str:
    """Return "1.551 ± 0.087 kg"; "1.551 kg (± not known)" for an infinite error; none for None."""
    if not error:
        return f"{figure(value)} {unit}".rstrip()
    if not math.isfinite(error):
        return f"{f'{figure(value)} {unit}'.rstrip()} (± not known)"
    return f"{figure(value, error)} ± {figure(error, error)} {unit}".rstrip()


def percent(share: float) -> str:
    """Return a share in percent with two digits; beyond ten times the whole that is all it says."""
    hundredths = 100.0 * abs(share)
    if not hundredths <= _MOST_PERCENT:
        return "over 1000 %" if hundredths > _MOST_PERCENT else "not known"
    return f"{100.0 * share:.2g} %" if hundredths < 99.5 else f"{100.0 * share:.0f} %"


def torque(is_slide: bool) -> str:
    """Return the unit of a joint's torque."""
    return "N" if is_slide else "N·m"


def position(is_slide: bool) -> str:
    """Return the unit of a joint's position."""
    return "m" if is_slide else "rad"


def term_unit(term: str, is_slide: bool) -> str:
    """Return the unit of a friction term's coefficient; "" for one without."""
    return _TERMS[term][is_slide] if term in _TERMS else ""
