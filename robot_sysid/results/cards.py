"""Cards: a payload in the form of each controller or library, as text to copy.

Each form is confirmed by its maker's own documentation or source. A form takes its numbers from
named groups (``_number_groups``), such as "com_mm", the centre of mass [mm].

A payload's ten parameters theta (10,) are mass m [kg], first moments h [kg m] and the inertia about
the origin of its frame [kg m^2], six elements; its centre of mass is c = h / m.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap
from typing import Any

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.inertial import (
    format_numbers,
    mjcf_inertial,
    urdf_inertial_about_com,
)
from robot_sysid.records import Array, Flange, InertialParameters
from robot_sysid.records.messages import with_error
from robot_sysid.results.record import BodyEstimate, Payload

DIGITS = 9
"""Significant digits of the numbers that people type into a controller: far below any error."""
UR_LIMIT = 133.0
"""Largest element of an inertia matrix that a UR controller takes [kg m^2], by the notes on
``set_target_payload`` in Universal Robots' script manual."""
_ROUNDING = 1e-12
"""Share of the largest number of a group below which a number is rounding error: about 1e4 times
the relative rounding error of a double."""
_CONSISTENCY_TOLERANCE = 1e-6
"""Relative violation of physical consistency that a card tolerates: below the digits that a
controller keeps."""
_LINE_WIDTH = 98
"""Largest number of characters in a line of payload_card.txt, apart from the numbers to copy."""
INERTIA = PARAMETER_NAMES[4:]
"""Names of the six elements of an inertia matrix: Ixx Ixy Ixz Iyy Iyz Izz."""
ERROR_NAMES = (
    "mass",
    "com_x",
    "com_y",
    "com_z",
    *(f"{name}_about_com" for name in INERTIA),
)
"""Keys of the standard errors of mass [kg], centre of mass [m] and inertia about the centre of mass
[kg m^2], in the axes of the body's frame."""
NOT_KNOWN = "Inertia not known: a ball of aluminium of that mass stands in its place."
"""Note of a card whose inertia the data does not determine."""
MOMENT_SIGNIFICANCE = 2.5
"""Standard errors from zero from which on a principal moment counts as known.

Estimates that had to be made physically consistent have too large moments: of 48 payloads in
simulation, all 11 that count as known at 2.5 are nearer the truth than the ball of aluminium (arms
of benchmarks/payload_by_difference.py); at 2, some are 183 times too large."""
_MAX_AXIS_ERROR = 45.0
"""Error of an axis' direction [degrees] beyond which it is not known: two axes change places."""
_MULTIPLICITY = np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])
"""How often each of xx, xy, xz, yy, yz, zz stands in a symmetric matrix."""


@dataclass(frozen=True)
class Form:
    """The form in which one controller or library takes a payload; names are as in ``Card``.

    Attributes:
        name: key in params.json.
        title: heading of the card.
        values: name of a value to its group of numbers in ``_number_groups``; a name of several
            words takes the numbers of the group one by one; a dict is a nested value.
        text: text to copy, with a %s for each value in the order of ``values``; or a function that
            returns it for a body and the body's inertia (3, 3) about the centre of mass [kg m^2].
        explanation: unit, frame and order of the numbers.
        max_inertia: largest element of an inertia matrix that the target accepts [kg m^2].
    """

    name: str
    title: str
    values: Mapping[str, Any]
    text: str | Callable[[InertialParameters, Array], str]
    explanation: str
    max_inertia: float = np.inf


def _mjcf_text(body: InertialParameters, inertia: Array) -> str:
    """Return the <inertial> element of a body with an inertia (3, 3) about its centre of mass."""
    if np.any(inertia):
        return mjcf_inertial(body.theta)
    return f'<inertial pos="{format_numbers(body.com)}" mass="{body.mass!r}" diaginertia="0 0 0"/>'


_WHOLE_LOAD = (
    "The controller wants everything that is bolted to the flange: where the empty runs carried a "
    "tool already, that tool is not in these numbers and must be added."
)
"""End of the explanation of a card whose controller takes the load including all tools."""
FORMS = (
    Form(
        "franka_set_load",
        "Franka load: libfranka Robot::setLoad(load_mass, F_x_Cload, load_inertia)",
        {"load_mass": "kg", "F_x_Cload": "com_m", "load_inertia": "nine"},
        "robot.setLoad(%s, {{%s}}, {{%s}});",
        "load_mass kg; F_x_Cload from the flange to the centre of mass, m; load_inertia 3x3 about "
        "the centre of mass, axes of the flange, column by column, kg m^2. franka_msgs/SetLoad "
        "takes the same three. The LOAD is what the hand holds, and the arm adds it to the END "
        "EFFECTOR that is set in Desk: enter a payload as one of the two, never as both.",
    ),
    Form(
        "franka_end_effector",
        "Franka end effector: the mechanical data of endeffector-config.json, set in Desk",
        {
            "mass": "kg",
            "centerOfMass": "com_m",
            "inertia": "nine",
            "transformation": "no_turn",
        },
        '{"mass": %s, "centerOfMass": [%s], "inertia": [%s], "transformation": [%s]}',
        "mass kg; centerOfMass from the flange, m; inertia 3x3 about the centre of mass, axes of "
        "the flange, column by column, kg m^2; transformation 4x4 flange to tool tip, column by "
        "column, m: not identified, the identity stands there, put your own in. The END EFFECTOR "
        "is the tool that stays mounted, not the load in its hand (see the card above). Desk adds "
        "nothing to it: these numbers have to be the whole tool.",
    ),
    Form(
        "ur_set_target_payload",
        "Universal Robots: set_target_payload(m, cog, inertia)",
        {"m": "kg", "cog": "com_m", "inertia": "six"},
        "set_target_payload(%s, [%s], [%s])",
        "m kg; cog from the tool flange, m; inertia [Ixx, Iyy, Izz, Ixy, Ixz, Iyz] about the "
        f"centre of gravity, axes of the tool flange, kg m^2. {_WHOLE_LOAD}",
        max_inertia=UR_LIMIT,
    ),
    Form(
        "ur_msgs_set_payload",
        "Universal Robots under ROS 2: request of ur_msgs/srv/SetPayload",
        {
            "mass": "kg",
            "center_of_gravity": {"x y z": "com_m"},
            "ixx iyy izz ixy ixz iyz": "six",
        },
        "{mass: %s, center_of_gravity: {x: %s, y: %s, z: %s}, ixx: %s, iyy: %s, izz: %s, ixy: %s, "
        "ixz: %s, iyz: %s}",
        "mass kg; center_of_gravity from the tool flange, m; ixx iyy izz ixy ixz iyz about the "
        "centre of gravity, axes of the tool flange, kg m^2. Older releases of the message have "
        f"mass and center_of_gravity only. {_WHOLE_LOAD}",
        max_inertia=UR_LIMIT,
    ),
    Form(
        "kuka_load",
        "KUKA: LOAD_DATA[n] of type LOAD",
        {
            "M": "kg",
            "CM": {"X Y Z": "com_mm", "A B C": "yaw_pitch_roll"},
            "J": {"X Y Z": "moments"},
        },
        "{M %s, CM {X %s, Y %s, Z %s, A %s, B %s, C %s}, J {X %s, Y %s, Z %s}}",
        "M kg; CM X, Y, Z centre of mass in the FLANGE coordinate system, mm; CM A, B, C turn of "
        "the principal axes, degrees: A about Z, then B about the new Y, then C about the new X; J "
        f"X, Y, Z principal moments about those axes, kg m^2. {_WHOLE_LOAD}",
    ),
    Form(
        "abb_loaddata",
        "ABB: loaddata [mass, cog, aom, ix, iy, iz]",
        {"mass": "kg", "cog": "com_mm", "aom": "turn", "ix iy iz": "moments"},
        "[%s, [%s], [%s], %s, %s, %s]",
        "mass kg; cog x, y, z in mm; aom turn of the principal axes, quaternion q1 q2 q3 q4 with "
        "q1 the real part; ix, iy, iz moments about those axes through the centre of gravity, kg "
        "m^2. Right as it stands for the tload of a tooldata, which is stated in the wrist "
        "coordinate system (the flange, tool0). For GripLoad it has to be stated in the frame of "
        "the TOOL: make the card for that frame.",
    ),
    Form(
        "xarm_set_tcp_load",
        "UFACTORY xArm: set_tcp_load(weight, center_of_gravity)",
        {"weight": "kg", "center_of_gravity": "com_mm"},
        "arm.set_tcp_load(%s, [%s])",
        "weight kg; center_of_gravity x, y, z in the default tool coordinate system at the centre "
        f"of the flange, mm. It takes no inertia. {_WHOLE_LOAD}",
    ),
    Form(
        "mecademic_set_payload",
        "Mecademic: SetPayload(m, cx, cy, cz)",
        {"m": "kg", "cx cy cz": "com_mm"},
        "SetPayload(%s, %s, %s, %s)",
        "m kg; cx, cy, cz centre of mass in the flange reference frame (FRF), mm. It takes no "
        f"inertia. {_WHOLE_LOAD}",
    ),
    Form(
        "urdf_inertial",
        "URDF: <inertial> of a link whose frame is the flange",
        {"mass": "mass", "origin": "com", "ixx ixy ixz iyy iyz izz": "upper"},
        lambda body, inertia: urdf_inertial_about_com(body.mass, body.com, inertia),
        "mass kg; origin xyz centre of mass, m; ixx ixy ixz iyy iyz izz about the centre of mass, "
        "axes of the link (rpy 0), kg m^2.",
    ),
    Form(
        "mjcf_inertial",
        "MuJoCo: <inertial> of a body whose frame is the flange",
        {"mass": "mass", "pos": "com", "fullinertia": "full"},
        _mjcf_text,
        "mass kg; pos centre of mass, m; fullinertia xx yy zz xy xz yz about the centre of mass, "
        "axes of the body, kg m^2.",
    ),
)


@dataclass(frozen=True)
class Card:
    """A payload in one form.

    Attributes:
        name: key in params.json.
        title: heading of the card.
        explanation: unit, frame and order of the numbers.
        values: name in the target to number or numbers, as JSON can hold them.
        text: text to copy into a program or a configuration of the target.
        notes: standard errors, and whether the target would refuse these numbers.
    """

    name: str
    title: str
    explanation: str
    values: Mapping[str, Any]
    text: str
    notes: tuple[str, ...]


def payload_cards(body: BodyEstimate, flange: Flange) -> tuple[Card, ...]:
    """Return a payload in every form, the plain numbers with their frame first.

    Args:
        body: in the FLANGE frame, inertia about that frame's origin; where the inertia is not
            determined, that of a ball of aluminium.
        flange: the frame of the payload.

    Raises:
        ExportError: no rigid body has these parameters, so no controller may get them.
    """
    inertia, groups = _number_groups(body.inertial)
    errors = load_errors(body)
    error_texts = _error_texts(body)
    cards = [_plain_card(groups, flange, errors, error_texts)]
    for form in FORMS:
        values = _fill_values(form.values, groups)
        notes = _error_notes(error_texts, form.values)
        if max(map(abs, groups["six"])) > form.max_inertia:
            notes.append(
                "The controller refuses this: no element of the inertia may exceed "
                f"{form.max_inertia:g}."
            )
        if isinstance(form.text, str):
            text = form.text % tuple(_value_texts(values))
        else:
            text = form.text(body.inertial, inertia)
        cards.append(
            Card(form.name, form.title, form.explanation, values, text, tuple(notes))
        )
    return tuple(cards)


def load_covariance(body: BodyEstimate) -> Array:
    """Return the covariance (10, 10) of mass, centre of mass c and inertia about c of a body.

    The order is that of ``ERROR_NAMES``. It follows to first order from I_com = I - m (|c|^2 1 -
    c c^T) and c = h / m, by their slopes: dc = (dh - c dm) / m, and with a = dh along an axis
    dI_com = dI - dm (c c^T - |c|^2 1) - (2 (a c) 1 - a c^T - c a^T). The change of c is not
    symmetric in the mass, larger where the mass is smaller: its slope is therefore that to the body
    that is lighter by one standard error of the mass, at most twice that of the body itself.
    Variances of what is not determined are infinite.
    """
    inertial = body.inertial
    is_com_known = inertial.mass > 0.0 and bool(np.all(body.is_determined[:4]))
    is_inertia_known = is_com_known and bool(np.all(body.is_determined))
    mass = inertial.mass if is_com_known else 1.0
    mass_error = float(np.sqrt(max(body.covariance[0, 0], 0.0)))
    com = inertial.com
    identity = np.eye(3)
    jacobian = np.eye(10)
    com_slopes = np.column_stack((-com, identity))
    jacobian[1:4, :4] = com_slopes / max(mass - mass_error, 0.5 * mass)
    # Of the inertia about c: by the mass, then by each first moment.
    inertia_slopes = [com @ com * identity - np.outer(com, com)]
    for axis in identity:
        products = np.outer(axis, com) + np.outer(com, axis)
        inertia_slopes.append(products - 2.0 * (axis @ com) * identity)
    for column, slope in enumerate(inertia_slopes):
        jacobian[4:, column] = spatial.six_from_symmetric(slope)
    covariance = jacobian @ body.covariance @ jacobian.T
    is_known = [bool(body.is_determined[0]), is_com_known, is_inertia_known]
    is_hidden = ~np.repeat(is_known, [1, 3, 6])
    covariance[is_hidden] = 0.0
    covariance[:, is_hidden] = 0.0
    covariance[is_hidden, is_hidden] = np.inf
    return covariance


def load_errors(body: BodyEstimate) -> Array:
    """Return the standard errors (10,) of mass, centre of mass and inertia about it of a body.

    The order and units are those of ``ERROR_NAMES``. An error that is not known is infinite.
    """
    return np.sqrt(np.maximum(np.diag(load_covariance(body)), 0.0))


def principal_moments(body: BodyEstimate) -> tuple[Array, Array, Array]:
    """Return the principal moments of a body, their errors, and those of the principal axes.

    To first order, the moment i changes by a_i^T dI a_i, and the axes i and j turn by a_i^T dI a_j
    over the difference of the moments i and j.

    Returns:
        Moments (3,) about the centre of mass, ascending [kg m^2]; their standard errors (3,);
        standard errors (3,) of the turn about each axis [degrees], infinite where not known.
    """
    moments, axes = spatial.principal_axes(body.inertial.inertia_com)
    covariance = load_covariance(body)[4:, 4:]
    if not np.all(np.isfinite(covariance)):
        return moments, np.full(3, np.inf), np.full(3, np.inf)
    # Rows (6, 6) that take the six elements of dI to a_i^T dI a_j, for i <= j.
    rows = []
    for i, j in zip(*np.triu_indices(3)):
        product = np.outer(axes[:, i], axes[:, j])
        symmetric = 0.5 * (product + product.T)
        rows.append(_MULTIPLICITY * spatial.six_from_symmetric(symmetric))
    variances = np.diag(np.array(rows) @ covariance @ np.array(rows).T)
    xx, xy, xz, yy, yz, zz = np.sqrt(np.maximum(variances, 0.0))
    # The turn about an axis moves the other two: y and z, x and z, x and y.
    gaps = np.abs(moments[[1, 0, 0]] - moments[[2, 2, 1]])
    turns = np.degrees(np.array([yz, xz, xy]) / np.maximum(gaps, 1e-300))
    turns = np.where(turns <= _MAX_AXIS_ERROR, turns, np.inf)
    return moments, np.array([xx, yy, zz]), turns


def is_inertia_known(body: BodyEstimate) -> bool:
    """Return whether any principal moment exceeds ``MOMENT_SIGNIFICANCE`` standard errors.

    One is enough: the smallest moment of a rod never does, and a wrist that only spins determines
    one moment alone.
    """
    moments, errors, _ = principal_moments(body)
    return bool(np.any(moments > MOMENT_SIGNIFICANCE * errors))


def card_text(cards: Sequence[Card], payload: Payload, model_name: str) -> str:
    """Return the text of payload_card.txt: a heading, then each card with its explanation.

    Args:
        cards: cards that ``payload_cards`` returned.
        payload: the payload that they state.
        model_name: file name of the arm's model, for the heading.
    """
    mass_error = float(payload.body.errors[0])
    mass = with_error(payload.body.inertial.mass, mass_error, "kg")
    recordings = payload.recordings
    blocks = [
        f"Payload of {mass}, identified with {model_name} from {len(recordings['empty'])} empty "
        f"and {len(recordings['loaded'])} loaded recordings."
    ]
    for card in cards:
        lines = [f"== {card.title} =="]
        for paragraph in (card.explanation, *card.notes):
            lines += map("# {}".format, wrap(paragraph, _LINE_WIDTH - 2))
        blocks.append("\n".join([*lines, card.text]))
    return "\n\n".join(blocks) + "\n"


def _number_groups(payload: InertialParameters) -> tuple[Array, dict[str, Any]]:
    """Return (inertia (3, 3) about the centre of mass [kg m^2], group name to number or numbers).

    Every form takes its numbers from these groups. Raises ExportError where no rigid body has the
    payload's parameters.
    """
    mass, com, inertia = spatial.com_from_theta(payload.theta)
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
    tolerance = _CONSISTENCY_TOLERANCE * float(np.sum(np.abs(moments))) + rounding
    negativity = -float(np.min(moments))
    triangle_excess = float(2.0 * np.max(moments) - np.sum(moments))
    if mass <= 0.0 or max(negativity, triangle_excess) > tolerance:
        listed = ", ".join(f"{moment:.4g}" for moment in moments)
        raise ExportError(
            f"a payload of {mass:.4g} kg with principal moments of inertia {listed} kg m^2 is not "
            "a possible rigid body, so there is no card for a controller; record longer or faster "
            "motion"
        )
    full = spatial.fullinertia_from_symmetric(inertia)
    return inertia, {
        # In full precision: Ixx Iyy Izz Ixy Ixz Iyz, and Ixx Ixy Ixz Iyy Iyz Izz, about c.
        "mass": payload.mass,
        "com": payload.com.tolist(),
        "full": full.tolist(),
        "upper": spatial.six_from_symmetric(inertia).tolist(),
        # With the digits of a card; nine: column by column, no_turn: a 4x4 identity.
        "kg": round_group([mass])[0],
        "com_m": round_group(com),
        "com_mm": round_group(1e3 * com),
        "six": round_group(full),
        "nine": round_group(inertia.T.ravel()),
        "moments": round_group(moments),
        "yaw_pitch_roll": round_group(np.degrees(spatial.roll_pitch_yaw(axes)[::-1])),
        "turn": round_group(spatial.quaternion(axes)),
        "no_turn": np.eye(4).ravel().tolist(),
    }


def round_group(values: Sequence[float] | Array) -> list[float]:
    """Return numbers rounded to ``DIGITS`` digits; zero below ``_ROUNDING`` times the largest."""
    smallest = _ROUNDING * float(np.max(np.abs(values)))
    cleared = np.where(np.abs(values) < smallest, 0.0, values)
    return list(map(float, map(plain, cleared)))


def plain(value: float) -> str:
    """Return a number as text of ``DIGITS`` digits without exponent, which not all targets read."""
    text = np.format_float_positional(value, DIGITS, fractional=False, trim="0")
    return "0.0" if float(text) == 0.0 else text


def join_numbers(values: Sequence[float]) -> str:
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


def _value_texts(values: Mapping[str, Any]) -> Iterator[str]:
    """Yield the text of each value of a form; the numbers of a list are one text."""
    for value in values.values():
        if isinstance(value, dict):
            yield from _value_texts(value)
        else:
            yield join_numbers(value if isinstance(value, list) else [value])


def _plain_card(
    groups: Mapping[str, Any],
    flange: Flange,
    errors: Array,
    error_texts: Mapping[str, str],
) -> Card:
    """Return the first card, which states frame, numbers and errors for no particular target.

    Args:
        groups: group name to numbers, of ``_number_groups``.
        flange: the frame of the payload.
        errors: (10,) standard errors, of ``load_errors``.
        error_texts: group name to the text on its errors.
    """
    origin = flange.translation
    quaternion = spatial.quaternion(flange.rotation)
    finite_errors = [error if np.isfinite(error) else None for error in errors.tolist()]
    values = {
        "flange": flange.name,
        "terminal_body": flange.terminal,
        "flange_position": origin.tolist(),
        "flange_quaternion": quaternion.tolist(),
        "mass": groups["mass"],
        "center_of_mass": groups["com"],
        "inertia_about_com": groups["upper"],
        "standard_errors": dict(zip(ERROR_NAMES, finite_errors)),
    }
    origin_text = join_numbers(round_group(origin))
    quaternion_text = join_numbers(round_group(quaternion))
    text = "\n".join(
        (
            f"frame           {flange.name}: origin at {origin_text} m, turned by "
            f"the quaternion w x y z {quaternion_text}, both in the frame of body "
            f"'{flange.terminal}'",
            f"mass            {plain(groups['kg'])} kg",
            f"centre of mass  {join_numbers(groups['com_m'])} m",
            f"inertia         {join_numbers(groups['six'])} kg m^2 (xx yy zz xy xz yz)",
        )
    )
    explanation = (
        "All cards below state this one body. It is what the loaded runs carried and the empty "
        "ones did not. All numbers hold in the frame named here, the inertia about the centre of "
        "mass in axes of that frame, products of inertia as they stand in the matrix (Ixy is "
        "minus the integral of x y). A controller takes them for numbers in the frame of ITS "
        "flange: where that is another one, make the cards again for it."
    )
    notes = [flange.note] if flange.note else []
    notes += _error_notes(
        error_texts, {"mass": "kg", "center_of_mass": "com_m", "inertia": "six"}
    )
    if not any(groups["six"]):
        notes.append("The inertia is zero: every card states a point mass.")
    return Card("payload", "Payload", explanation, values, text, tuple(notes))


def _error_texts(body: BodyEstimate) -> dict[str, str]:
    """Return group name, of ``_number_groups``, to the text on the group's standard errors."""
    errors = load_errors(body)
    _, moment_errors, turn_errors = principal_moments(body)
    mass = f"mass {_errors_with_unit(errors[:1], 'kg')}"
    com = f"centre of mass {_errors_with_unit(errors[1:4], 'm')}"
    inertia = NOT_KNOWN
    moments = NOT_KNOWN
    axes = NOT_KNOWN
    if np.all(np.isfinite(errors[4:])):
        elements = [f"{n[1:]} {error:.2g}" for n, error in zip(INERTIA, errors[4:])]
        inertia = f"inertia {', '.join(elements)} kg m^2"
        moments = f"moments {_errors_with_unit(moment_errors, 'kg m^2')}"
        turns = _errors_with_unit(turn_errors, "degrees")
        axes = f"turn about the axes X, Y, Z {turns}"
    return {
        "kg": mass,
        "mass": mass,
        "com_m": com,
        "com": com,
        "com_mm": f"centre of mass {_errors_with_unit(1e3 * errors[1:4], 'mm')}",
        **dict.fromkeys(("six", "nine", "upper", "full"), inertia),
        "moments": moments,
        "yaw_pitch_roll": axes,
        "turn": axes,
    }


def _errors_with_unit(errors: Array, unit: str) -> str:
    """Return standard errors as text with their unit; "not known" in place of infinite ones."""
    if not np.any(np.isfinite(errors)):
        return "not known"
    texts = [f"{e:.2g}" if np.isfinite(e) else "not known" for e in errors]
    return f"{', '.join(texts)} {unit}"


def _error_notes(error_texts: Mapping[str, str], form: Mapping[str, Any]) -> list[str]:
    """Return the notes of a card on the errors of the groups in a form's values.

    Args:
        error_texts: group name to the text on its errors, of ``_error_texts``.
        form: ``Form.values``, name of a value to its group or to further such values.
    """
    groups: list[str] = []
    for group in form.values():
        groups += group.values() if isinstance(group, dict) else [group]
    # One text per quantity, in the order of the values.
    texts: dict[str, None] = {}
    for group in groups:
        if group in error_texts:
            texts[error_texts[group]] = None
    is_unknown = NOT_KNOWN in texts
    texts.pop(NOT_KNOWN, None)
    notes = [f"Standard errors: {'; '.join(texts)}."]
    return [*notes, NOT_KNOWN] if is_unknown else notes
