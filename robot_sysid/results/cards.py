"""Cards: a payload in the form of each controller or library, as text to copy.

Numbers end at the second digit of their standard error, which is stated once, above the cards.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap
from typing import Any

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.records import Array, Flange, RobotModel
from robot_sysid.records.controllers import ALL, AUTO, CHOICES, MAKERS, makers_of
from robot_sysid.records.messages import with_error
from robot_sysid.results.body_errors import (
    ERROR_NAMES,
    INERTIA,
    load_errors,
    principal_moments,
)
from robot_sysid.results.card_forms import FORMS
from robot_sysid.results.record import BodyEstimate, Payload

DIGITS = 9
"""Largest number of significant digits of a number that people type into a controller."""
_UNKNOWN_DIGITS = 3
"""Significant digits of a number whose standard error is not known."""
_QUATERNION_DIGITS = 6
"""Decimals of a quaternion: controllers refuse one whose length is not 1."""
_ROUNDING = 1e-12
"""Share of the largest number of a group below which a number is rounding error: about 1e4 times
the relative rounding error of a double."""
_CONSISTENCY_TOLERANCE = 1e-6
"""Relative violation of physical consistency that a card tolerates: below the digits that a
controller keeps."""
_MIN_MOMENT_SHARE = 0.5
"""Share of the smallest principal moment that has to remain after rounding: none becomes zero."""
_LINE_WIDTH = 98
"""Largest number of characters in a line of payload_card.txt, apart from the numbers to copy."""
NOT_KNOWN = "Inertia not known: a ball of aluminium of that mass stands in its place."
"""Note of a card whose inertia the data does not determine."""


@dataclass(frozen=True)
class Card:
    """A payload in one form.

    Attributes:
        name: key in params.json.
        title: heading of the card.
        explanation: unit, frame and order of the numbers.
        values: name in the target to number or numbers, as JSON can hold them.
        text: text to copy into a program or a configuration of the target.
        notes: what holds for this form alone, one sentence each: standard errors of numbers that
            no other form has, and whether the target would refuse the numbers.
    """

    name: str
    title: str
    explanation: str
    values: Mapping[str, Any]
    text: str
    notes: tuple[str, ...]


def payload_cards(body: BodyEstimate, flange: Flange) -> tuple[Card, ...]:
    """Return a payload in every form, the plain numbers with their frame and errors first.

    Args:
        body: in the FLANGE frame, inertia about that frame's origin; where the inertia is not
            determined, that of a ball of aluminium.
        flange: the frame of the payload.

    Raises:
        ExportError: no rigid body has these parameters, so no controller may get them.
    """
    groups = number_groups(body)
    axes_notes = _axes_notes(body)
    cards = [_plain_card(groups, flange, body)]
    for form in FORMS:
        values = _fill_values(form.values, groups)
        notes = axes_notes if "moments" in _leaves(form.values) else []
        if max(map(abs, groups["six"])) > form.max_inertia:
            refusal = (
                "The controller refuses this: no element of the inertia may exceed "
                f"{form.max_inertia:g}."
            )
            notes = [*notes, refusal]
        if isinstance(form.text, str):
            numbers = map(np.ravel, _leaves(values))
            text = form.text % tuple(map(join_numbers, numbers))
        else:
            text = form.text(groups)
        card = Card(form.name, form.title, form.explanation, values, text, tuple(notes))
        cards.append(card)
    return tuple(cards)


def card_text(
    cards: Sequence[Card], payload: Payload, robot: RobotModel, choice: str = AUTO
) -> str:
    """Return the text of payload_card.txt: the payload with its errors, then the chosen cards.

    Args:
        cards: all cards that ``payload_cards`` returned, in their order.
        payload: the payload that they state.
        robot: the arm, whose names tell the controller.
        choice: of ``controllers.CHOICES``; ``AUTO`` for the arm's own controller.
    """
    mass_error = float(payload.body.errors[0])
    mass = with_error(payload.body.inertial.mass, mass_error, "kg")
    recordings = payload.recordings
    blocks = [
        f"Payload of {mass}, identified with {robot.path.name} from {len(recordings['empty'])} "
        f"empty and {len(recordings['loaded'])} loaded recordings."
    ]
    plain_card, *form_cards = cards
    comments = _comments(*plain_card.notes, plain_card.explanation)
    blocks.append("\n".join([plain_card.text, *comments]))
    controllers, remark = _chosen_controllers(robot, choice)
    for form, card in zip(FORMS, form_cards):
        if form.controller in controllers:
            comments = _comments(card.explanation, *card.notes)
            blocks.append("\n".join([f"== {card.title} ==", *comments, card.text]))
    if remark:
        blocks.append("\n".join(_comments(remark)))
    return "\n\n".join(blocks) + "\n"


def _chosen_controllers(robot: RobotModel, choice: str) -> tuple[Sequence[str], str]:
    """Return the keys of the controllers whose cards are written, and a remark on the choice."""
    if choice == ALL:
        return CHOICES, ""
    if choice != AUTO:
        return [choice], ""
    keys = makers_of(robot)
    others = ", ".join(key for key in CHOICES if key not in (*keys, AUTO, ALL))
    remark = f"Other forms: --cards all, or --cards with one of {others}."
    titles = [MAKERS[key].title for key in keys]
    if len(titles) > 1:
        listed = " and ".join(titles)
        remark = (
            f"The names in the arm's model fit {listed}, so each has a card. {remark}"
        )
    elif not titles:
        remark = f"No name in the arm's model is that of a known maker. {remark}"
    return keys, remark


def _comments(*paragraphs: str) -> Iterator[str]:
    """Yield paragraphs as lines of comment that fit into a line."""
    for paragraph in paragraphs:
        yield from map("# {}".format, wrap(paragraph, _LINE_WIDTH - 2))


def number_groups(body: BodyEstimate) -> dict[str, Any]:
    """Return group name to number or numbers of a payload, from which every form takes its own.

    Numbers end at the second digit of their error. The inertia gets more where fewer would make an
    impossible body of it.

    Raises:
        ExportError: no rigid body has these parameters.
    """
    mass, com, inertia = spatial.com_from_theta(body.inertial.theta)
    moments, axes = spatial.principal_axes(inertia)
    # Rounding of an inertia about a distant origin hides a small one about the centre of mass.
    rounding = _ROUNDING * abs(mass) * float(com @ com)
    if np.max(np.abs(moments)) <= rounding:
        inertia = np.zeros((3, 3))
        moments = np.zeros(3)
        axes = np.eye(3)
    if np.ptp(moments) <= rounding + _ROUNDING * np.max(np.abs(moments)):
        # Any axes are principal ones: those of the frame, not those that rounding happens to give.
        moments = np.diag(inertia)
        axes = np.eye(3)
    if mass <= 0.0 or not _is_possible(moments, rounding):
        listed = ", ".join(f"{moment:.4g}" for moment in moments)
        raise ExportError(
            f"a payload of {mass:.4g} kg with principal moments of inertia {listed} kg m^2 is not "
            "a possible rigid body, so there is no card for a controller; record longer or faster "
            "motion"
        )
    errors = load_errors(body)
    _, moment_errors, turn_errors = principal_moments(body)
    six = spatial.six_from_symmetric(inertia)
    upper = _round_to_possible(six, errors[4:], _principal_moments_of, rounding)
    rounded = spatial.symmetric_from_six(np.array(upper))
    principal = _round_to_possible(moments, moment_errors, np.sort, rounding)
    angles = np.degrees(spatial.roll_pitch_yaw(axes)[::-1])
    quaternion = np.round(spatial.quaternion(axes), _QUATERNION_DIGITS) + 0.0
    return {
        "kg": round_to_errors([mass], errors[:1])[0],
        "com_m": round_to_errors(com, errors[1:4]),
        "com_mm": round_to_errors(1e3 * com, 1e3 * errors[1:4]),
        # Ixx Iyy Izz Ixy Ixz Iyz, Ixx Ixy Ixz Iyy Iyz Izz, and column by column, about c.
        "six": spatial.fullinertia_from_symmetric(rounded).tolist(),
        "upper": upper,
        "nine": rounded.T.ravel().tolist(),
        "moments": principal,
        "yaw_pitch_roll": round_to_errors(angles, np.full(3, np.min(turn_errors))),
        "turn": quaternion.tolist(),
        "no_turn": np.eye(4).ravel().tolist(),
    }


def _is_possible(moments: Array, rounding: float) -> bool:
    """Return whether a rigid body has these principal moments (3,) [kg m^2], but for rounding."""
    tolerance = _CONSISTENCY_TOLERANCE * float(np.sum(np.abs(moments))) + rounding
    negativity = -float(np.min(moments))
    triangle_excess = float(2.0 * np.max(moments) - np.sum(moments))
    return max(negativity, triangle_excess) <= tolerance


def _principal_moments_of(six: Array) -> Array:
    """Return the principal moments (3,), ascending, of an inertia's six elements [kg m^2]."""
    return np.asarray(np.linalg.eigvalsh(spatial.symmetric_from_six(six)))


def _round_to_possible(
    values: Array, errors: Array, moments_of: Callable[[Array], Array], rounding: float
) -> list[float]:
    """Return numbers of an inertia with as few digits as their errors allow a possible body.

    Args:
        values: (m,) numbers [kg m^2].
        errors: (m,) their standard errors [kg m^2].
        moments_of: returns the principal moments (3,), ascending, of such numbers.
        rounding: rounding error of the values [kg m^2].
    """
    least_moment = _MIN_MOMENT_SHARE * float(moments_of(values)[0])
    rounded: list[float] = []
    for extra_digits in range(DIGITS + 1):
        rounded = round_to_errors(values, errors, extra_digits)
        moments = moments_of(np.array(rounded))
        if _is_possible(moments, rounding) and moments[0] >= least_moment:
            break
    return rounded


def round_to_errors(
    values: Iterable[float], errors: Iterable[float], extra_digits: int = 0
) -> list[float]:
    """Return m numbers rounded at the second digit of their standard errors.

    Zero where they are below ``_ROUNDING`` times the largest.

    Args:
        values: (m,) numbers.
        errors: (m,) standard errors, in the numbers' unit; infinite where not known.
        extra_digits: number of further digits.
    """
    numbers = np.array(list(values), dtype=float)
    sizes = np.abs(numbers)
    numbers[sizes < _ROUNDING * np.max(sizes)] = 0.0
    pairs = zip(numbers.tolist(), errors)
    return [_round_to_error(value, error, extra_digits) for value, error in pairs]


def _round_to_error(value: float, error: float, extra_digits: int) -> float:
    """Return a number rounded at the second digit of its error, with ``DIGITS`` digits at most."""
    digits = DIGITS
    if not math.isfinite(error):
        digits = min(_UNKNOWN_DIGITS + extra_digits, DIGITS)
    elif error > 0.0:
        value = round(value, 1 - math.floor(math.log10(error)) + extra_digits)
    return float(f"{value:.{digits}g}") + 0.0


def plain(value: float) -> str:
    """Return a number as text of ``DIGITS`` digits without exponent, which not all targets read."""
    text = np.format_float_positional(value, DIGITS, fractional=False, trim="0")
    return "0.0" if float(text) == 0.0 else text


def join_numbers(values: Iterable[float]) -> str:
    """Return numbers without exponent, separated by commas."""
    return ", ".join(map(plain, values))


def _fill_values(form: Mapping[str, Any], groups: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a form with the numbers of their groups in place of the group names.

    Args:
        form: ``Form.values``, whose names of several words take one number of the group each.
        groups: group name to a number or numbers, of ``_number_groups``.
    """
    values: dict[str, Any] = {}
    for name, group in form.items():
        if isinstance(group, dict):
            values[name] = _fill_values(group, groups)
        elif " " in name:
            values.update(zip(name.split(), groups[group]))
        else:
            values[name] = groups[group]
    return values


def _leaves(values: Mapping[str, Any]) -> Iterator[Any]:
    """Yield the values of a form, or the names of their groups, those of nested ones included."""
    for value in values.values():
        if isinstance(value, dict):
            yield from _leaves(value)
        else:
            yield value


def _plain_card(groups: Mapping[str, Any], flange: Flange, body: BodyEstimate) -> Card:
    """Return the first card, which states frame, numbers and errors for no particular target.

    Args:
        groups: group name to numbers, of ``number_groups``.
        flange: the frame of the payload.
        body: the payload.
    """
    errors = load_errors(body)
    quaternion = spatial.quaternion(flange.rotation)
    origin_text = join_numbers(round_to_errors(flange.translation, np.zeros(3)))
    turn_text = join_numbers(round_to_errors(quaternion, np.zeros(4)))
    finite_errors = [error if np.isfinite(error) else None for error in errors.tolist()]
    values = {
        "flange": flange.name,
        "terminal_body": flange.terminal,
        "flange_position": flange.translation.tolist(),
        "flange_quaternion": quaternion.tolist(),
        "mass": groups["kg"],
        "center_of_mass": groups["com_m"],
        "inertia_about_com": groups["upper"],
        "standard_errors": dict(zip(ERROR_NAMES, finite_errors)),
    }
    com = ", ".join(map(_number_with_error, groups["com_m"], errors[1:4]))
    moments = []
    for name, moment, error in zip(INERTIA, groups["upper"], errors[4:]):
        moments.append(f"{name[1:]} {_number_with_error(moment, error)}")
    lines = [
        f"frame           {flange.name}: origin at {origin_text} m, turned by the quaternion "
        f"w x y z {turn_text}, both in the frame of body '{flange.terminal}'",
        f"mass            {_number_with_error(groups['kg'], errors[0])} kg",
        f"centre of mass  {com} m",
        f"inertia         {', '.join(moments[:3])} kg m^2",
        f"                {', '.join(moments[3:])} kg m^2",
    ]
    is_point = not any(groups["six"])
    is_inertia_known = bool(np.all(np.isfinite(errors[4:])))
    notes = [] if is_inertia_known else [NOT_KNOWN]
    if is_point:
        notes.append("The inertia is zero: every card states a point mass.")
    if flange.note:
        notes.append(f"{flange.note[:1].upper()}{flange.note[1:]}.")
    explanation = (
        "All cards state this one body: what the loaded runs carried and the empty ones did not. "
        "A tool that the empty runs carried is not in these numbers; add it where a controller "
        "takes everything that is bolted to the flange. The inertia is about the centre of mass, "
        "in axes of the frame above (Ixy is minus the integral of x y). A controller takes the "
        "numbers for ones in the frame of ITS flange: where that is another one, give --flange."
    )
    text = "\n".join(lines)
    return Card("payload", "Payload", explanation, values, text, tuple(notes))


def _number_with_error(value: float, error: float) -> str:
    """Return a number, and its standard error where that is known."""
    return with_error(value, error) if math.isfinite(error) else plain(value)


def _axes_notes(body: BodyEstimate) -> list[str]:
    """Return a note on the errors of principal moments and axes; none where not known."""
    _, moment_errors, turn_errors = principal_moments(body)
    if not np.all(np.isfinite(moment_errors)):
        return []
    moments = ", ".join(f"{error:.2g}" for error in moment_errors)
    turns = ", ".join(
        f"{error:.2g}" if math.isfinite(error) else "not known" for error in turn_errors
    )
    return [
        f"Standard errors: moments {moments} kg m^2; turn about the axes X, Y, Z {turns} degrees."
    ]
