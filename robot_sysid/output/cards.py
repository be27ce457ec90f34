"""Cards for controllers: one payload in every form that controllers and libraries take it in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap
from typing import Any

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.output.controller_forms import FORMS, Load, listed, plain, rounded
from robot_sysid.records import Array, Flange, InertialParameters

ERROR_NAMES = ("mass", "com_x", "com_y", "com_z")
"""Keys of standard errors: of the mass [kg] and of the centre of mass in flange axes [m]."""
_EDGE = 1e-6
"""How far, relative to its size, a body may be from possible for a card to be written."""
_ROUNDING = 1e-12
_WIDTH = 98


@dataclass(frozen=True)
class Card:
    """A payload in one form.

    Attributes:
        name: key in params.json.
        title: which controller or library, and which call.
        explanation: unit, frame and order of the numbers.
        values: what the numbers are called there, JSON-able.
        text: what to type or to copy.
        notes: standard errors, and what the target would refuse.
    """

    name: str
    title: str
    explanation: str
    values: Mapping[str, Any]
    text: str
    notes: tuple[str, ...] = ()


def payload_cards(
    payload: InertialParameters, flange: Flange, errors: Mapping[str, float] | None = None
) -> tuple[Card, ...]:
    """Return a payload in every form, the plain numbers with their frame first.

    Args:
        payload: in the FLANGE frame, inertia about that frame's origin.
        flange: that frame.
        errors: standard errors by ``ERROR_NAMES``; what is missing counts as not known.

    Raises:
        ExportError: no rigid body has these parameters, so no controller may get them.
    """
    load = _load(payload)
    cards = [_plain_card(load, flange, errors)]
    for form in FORMS:
        values, text = form.fill(load)
        notes = (*_error_notes(errors, form.in_mm), *form.limits(load))
        cards.append(Card(form.name, form.title, form.explanation, values, text, notes))
    return tuple(cards)


def load_errors(payload: InertialParameters, covariance: Array) -> dict[str, float]:
    """Return the standard errors of mass and centre of mass, c = h / m to first order.

    Args:
        payload: in the flange frame.
        covariance: (10, 10) of its theta, in the same frame.
    """
    jacobian = np.zeros((4, 10))
    jacobian[0, 0] = 1.0
    jacobian[1:, 0] = -payload.com / payload.mass
    jacobian[1:, 1:4] = np.eye(3) / payload.mass
    spread = np.diag(jacobian @ covariance @ jacobian.T)
    return dict(zip(ERROR_NAMES, np.sqrt(np.maximum(spread, 0.0)).tolist()))


def card_text(cards: Sequence[Card], heading: Sequence[str] = ()) -> str:
    """Return the text of payload_card.txt.

    Args:
        cards: what ``payload_cards`` returned.
        heading: lines to put first.
    """
    blocks = [block for block in ("\n".join(heading), *(_block(card) for card in cards)) if block]
    return "\n\n".join(blocks) + "\n"


def card_entries(cards: Sequence[Card]) -> dict[str, Any]:
    """Return the cards as JSON entries by name."""
    return {
        card.name: {
            "title": card.title,
            "explanation": card.explanation,
            "values": dict(card.values),
            "text": card.text,
            "notes": list(card.notes),
        }
        for card in cards
    }


def _block(card: Card) -> str:
    about = [line for part in (card.explanation, *card.notes) for line in wrap(part, _WIDTH - 2)]
    return "\n".join([f"== {card.title} ==", *(f"# {line}" for line in about), card.text])


def _load(payload: InertialParameters) -> Load:
    mass, com, inertia = spatial.com_from_theta(payload.theta)
    moments, axes = spatial.principal_axes(inertia)
    # Rounding of an inertia about a distant origin hides a small one about the centre of mass.
    rounding = _ROUNDING * abs(mass) * float(com @ com)
    if np.max(np.abs(moments)) <= rounding:
        inertia, moments, axes = np.zeros((3, 3)), np.zeros(3), np.eye(3)
    slack = _EDGE * float(np.sum(np.abs(moments))) + rounding
    beyond = max(-float(np.min(moments)), float(2.0 * np.max(moments) - np.sum(moments)))
    if mass <= 0.0 or beyond > slack:
        raise ExportError(
            f"a payload of {mass:.4g} kg with principal moments of inertia "
            f"{', '.join(f'{moment:.4g}' for moment in moments)} kg m^2 is not a possible rigid "
            "body, so there is no card for a controller; record longer or faster motion"
        )
    return Load(payload.theta, mass, com, inertia, moments, axes)


def _plain_card(load: Load, flange: Flange, errors: Mapping[str, float] | None) -> Card:
    place, turn = flange.translation, spatial.quaternion(flange.rotation)
    values = {
        "flange": flange.name,
        "terminal_body": flange.terminal,
        "flange_position": place.tolist(),
        "flange_quaternion": turn.tolist(),
        "mass": load.mass,
        "center_of_mass": load.com.tolist(),
        "inertia_about_com": spatial.six_from_symmetric(load.inertia).tolist(),
        "standard_errors": _known(errors),
    }
    text = [
        f"frame           {flange.name}: origin at {listed(rounded(place))} m, turned by the "
        f"quaternion w x y z {listed(rounded(turn))}, both in the frame of body "
        f"'{flange.terminal}'",
        f"mass            {plain(load.kg)} kg",
        f"centre of mass  {listed(load.com_m)} m",
        f"inertia         {listed(load.six)} kg m^2 (xx yy zz xy xz yz)",
    ]
    explanation = (
        "All cards below state this one body. It is what the loaded runs carried and the empty "
        "ones did not. All numbers hold in the frame named here, the inertia about the centre of "
        "mass in axes of that frame, products of inertia as they stand in the matrix (Ixy is "
        "minus the integral of x y). A controller takes them for numbers in the frame of ITS "
        "flange: where that is another one, make the cards again for it."
    )
    notes = ((flange.note,) if flange.note else ()) + _error_notes(errors)
    if not np.any(load.six):
        notes += ("The inertia is zero: every card states a point mass.",)
    return Card("payload", "Payload", explanation, values, "\n".join(text), notes)


def _known(errors: Mapping[str, float] | None) -> dict[str, float | None] | None:
    if errors is None:
        return None
    found = {name: float(errors.get(name, np.inf)) for name in ERROR_NAMES}
    return {name: value if np.isfinite(value) else None for name, value in found.items()}


def _error_notes(errors: Mapping[str, float] | None, in_mm: bool = False) -> tuple[str, ...]:
    """Return the standard errors in the units of a card."""
    known = _known(errors)
    if known is None:
        return ()
    factor, unit = (1e3, "mm") if in_mm else (1.0, "m")
    mass, *com = known.values()
    place = ", ".join("not known" if value is None else f"{factor * value:.2g}" for value in com)
    weight = "not known" if mass is None else f"{mass:.2g} kg"
    return (f"Standard errors: mass {weight}; centre of mass {place} {unit}.",)
