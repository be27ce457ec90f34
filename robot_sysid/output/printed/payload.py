"""What the payload command prints of its result."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.output.cards import ERROR_NAMES, load_errors
from robot_sysid.output.printed.before_after import BeforeAfter, table_lines
from robot_sysid.records import Array
from robot_sysid.records.figures import figure, percent, with_error
from robot_sysid.records.payload import BodyEstimate, PayloadIdentification

_SMALL = 0.05
"""Causes below this share of the whole error are not listed."""
_STEP = 1e-4


def payload_lines(found: PayloadIdentification, verbose: bool = False) -> list[str]:
    """Return the block "Identified payload ..." line by line."""
    return [
        f"Identified payload, in the frame of {found.flange.name}:",
        *_payload(found.payload),
        *_causes(found.payload),
        f"Terminal link without it: {_short(found.link)}",
        f"Terminal link with it: {_short(found.total)}",
        *_scatter(found),
        *_scales(found),
        *_quality(found),
        *(_parameters(found) if verbose else []),
    ]


def payload_rows(body: BodyEstimate) -> list[BeforeAfter]:
    """Return the rows of a payload: mass, and centre of mass and inertia where they are known."""
    inertial, errors = body.inertial, body.errors
    mass = BeforeAfter("mass", None, inertial.mass, float(errors[0]), "kg")
    if not inertial.mass > 0.0 or not np.all(np.isfinite(errors[:4])):
        return [mass]
    known = load_errors(inertial, body.covariance)
    places = [
        BeforeAfter(f"centre of mass {axis}", None, float(value), known[name], "m")
        for axis, value, name in zip("xyz", inertial.com, ERROR_NAMES[1:])
    ]
    return [mass, *places, *(_inertia(body) if np.all(body.shown) else [])]


def _payload(body: BodyEstimate) -> list[str]:
    rows = payload_rows(body)
    unseen = len(rows) > 1 and not np.all(body.shown)
    ball = ["  Inertia: not seen; what is written is that of a ball of aluminium"]
    return [*table_lines(rows), *(ball if unseen else [])]


def _inertia(body: BodyEstimate) -> list[BeforeAfter]:
    about = spatial.six_from_symmetric(body.inertial.inertia_com)
    rows = zip(("xx", "xy", "xz", "yy", "yz", "zz"), about, _inertia_errors(body))
    return [
        BeforeAfter(f"inertia {axes} about it", None, float(value), float(error), "kg·m²")
        for axes, value, error in rows
    ]


def _causes(body: BodyEstimate) -> list[str]:
    parts = {"noise": float(body.noise_errors[0])}
    parts.update({cause: float(part[0]) for cause, part in body.budget.items()})
    least = _SMALL * float(body.errors[0])
    named = sorted((item for item in parts.items() if item[1] > least), key=lambda i: -i[1])
    if not np.isfinite(least) or not named:
        return []
    return ["  Error of the mass by cause, kg: " + ", ".join(f"{k} {v:.2g}" for k, v in named)]


def _short(body: BodyEstimate) -> str:
    com = "[" + ", ".join(figure(float(value)) for value in body.inertial.com) + "]"
    return f"{with_error(body.inertial.mass, body.errors[0], 'kg')}, centre of mass {com} m"


def _scatter(found: PayloadIdentification) -> list[str]:
    if not found.scatter:
        return []
    return [
        "Mass according to each recording alone (± noise):",
        *(
            f"  {one.name} ({'loaded' if one.is_loaded else 'empty'}): "
            f"{with_error(one.mass, one.noise_error, 'kg')}"
            for one in found.scatter
        ),
    ]


def _scales(found: PayloadIdentification) -> list[str]:
    if not found.torque_scale:
        return []
    return [
        f"Torque scales by the known mass of {found.known_mass:g} kg (what the log reads over what "
        "is there, 95 % interval):",
        *(
            f"  {joint}: {scale:.4f} [{scale - 1.96 * error:.4f}, {scale + 1.96 * error:.4f}]"
            for joint, (scale, error) in found.torque_scale.items()
        ),
    ]


def _quality(found: PayloadIdentification) -> list[str]:
    test = found.validation
    lines = []
    if test is not None:
        share = "" if test.relative_error is None else f" ({percent(test.relative_error)})"
        lines.append(f"Held out, {test.source}: {test.rmse:.4f} N·m{share}")
    return [*lines, f"Result: {found.status.value}", *(f"  {text}" for text in found.reasons)]


def _parameters(found: PayloadIdentification) -> list[str]:
    return [
        f"Friction ({found.friction_model}) and nuisances:",
        *(
            f"  {name}: {with_error(value, error)}" + (" (held)" if np.isnan(error) else "")
            for name, (value, error) in found.parameters.items()
        ),
    ]


def _inertia_errors(body: BodyEstimate) -> Array:
    """Return standard errors (6,) of the inertia about the centre of mass, to first order."""

    def inertia(theta: Array) -> Array:
        return spatial.six_from_symmetric(spatial.com_from_theta(theta)[2])

    change = _slope(inertia, body.inertial.theta)
    return np.sqrt(np.maximum(np.diag(change @ body.covariance @ change.T), 0.0))


def _slope(function: Callable[[Array], Array], at: Array) -> Array:
    """Return the derivative (k, 10) of a function of theta."""
    steps = _STEP * spatial.parameter_scale(at[0], spatial.characteristic_length(at))
    sides = [(function(at + step) - function(at - step)) for step in np.diag(steps)]
    return np.stack(sides, axis=-1) / (2.0 * steps)
