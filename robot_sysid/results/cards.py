"""Cards for controllers: one payload in every form that controllers and libraries take it in.

Each form was read in its maker's own documentation or source; one that could not be confirmed is
not here.
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
from robot_sysid.results.record import BodyEstimate

DIGITS = 9
"""Significant digits of the numbers that people type into a controller: far below any error."""
UR_LIMIT = 133.0
"""Largest element of an inertia matrix that a UR controller takes [kg m^2], by the notes on
``set_target_payload`` in Universal Robots' script manual."""
_NOTHING = 1e-12
"""Share of the largest number of a group below which another one is only rounding: about 1e4
times the rounding of a double."""
_EDGE = 1e-6
"""How far, relative to its size, a body may be from possible for a card to be written: below the
digits that a controller keeps."""
_WIDTH = 98
INERTIA = PARAMETER_NAMES[4:]
ERROR_NAMES = (
    "mass",
    "com_x",
    "com_y",
    "com_z",
    *(f"{name}_about_com" for name in INERTIA),
)
"""Keys of standard errors: of the mass [kg], of the centre of mass [m] and of the inertia about it
[kg m^2], in the axes of the body's frame."""
NOT_KNOWN = "Inertia not known: a ball of aluminium of that mass stands in its place."
TOLD = 2.5
"""Standard errors from zero from which on a principal moment is told. A body that was made possible
has too large ones: of 48 payloads in simulation, all 11 that are kept at 2.5 are nearer the truth
than the ball (arms of benchmarks/payload_by_difference.py); at 2, some are 183 times too large."""
_MOST_TURN = 45.0
"""Error of an axis' direction [degrees] beyond which it is not known: two axes change places."""
# Share of each of [xx, xy, xz, yy, yz, zz] in a sum over all elements of a symmetric matrix.
_TWICE = np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])


@dataclass(frozen=True)
class Form:
    """One way to state a payload, named as in ``Card``.

    Attributes:
        values: name of a number to its group in ``_groups``; a name of several words takes the
            numbers of the group one by one.
        text: with a %s for each number or group, in the order of ``values``; or what makes it of
            the body and its inertia (3, 3) about the centre of mass.
        most: largest element of an inertia matrix that the target takes [kg m^2].
    """

    name: str
    title: str
    values: Mapping[str, Any]
    text: str | Callable[[InertialParameters, Array], str]
    explanation: str
    most: float = np.inf


def _mjcf(body: InertialParameters, inertia: Array) -> str:
    if np.any(inertia):
        return mjcf_inertial(body.theta)
    return f'<inertial pos="{format_numbers(body.com)}" mass="{body.mass!r}" diaginertia="0 0 0"/>'


_ALL_OF_IT = (
    "The controller wants everything that is bolted to the flange: where the empty runs carried a "
    "tool already, that tool is not in these numbers and must be added."
)
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
        f"centre of gravity, axes of the tool flange, kg m^2. {_ALL_OF_IT}",
        most=UR_LIMIT,
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
        f"mass and center_of_gravity only. {_ALL_OF_IT}",
        most=UR_LIMIT,
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
        f"X, Y, Z principal moments about those axes, kg m^2. {_ALL_OF_IT}",
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
        f"of the flange, mm. It takes no inertia. {_ALL_OF_IT}",
    ),
    Form(
        "mecademic_set_payload",
        "Mecademic: SetPayload(m, cx, cy, cz)",
        {"m": "kg", "cx cy cz": "com_mm"},
        "SetPayload(%s, %s, %s, %s)",
        "m kg; cx, cy, cz centre of mass in the flange reference frame (FRF), mm. It takes no "
        f"inertia. {_ALL_OF_IT}",
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
        _mjcf,
        "mass kg; pos centre of mass, m; fullinertia xx yy zz xy xz yz about the centre of mass, "
        "axes of the body, kg m^2.",
    ),
)


@dataclass(frozen=True)
class Card:
    """A payload in one form.

    Attributes:
        name: key in params.json.
        explanation: unit, frame and order of the numbers.
        values: what the numbers are called there, JSON-able.
        notes: standard errors, and what the target would refuse.
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
        body: in the FLANGE frame, inertia about that frame's origin; where its inertia is not
            shown, that of a ball of aluminium.

    Raises:
        ExportError: no rigid body has these parameters, so no controller may get them.
    """
    payload = body.inertial
    inertia, groups = _groups(payload)
    errors = load_errors(body)
    said = _error_texts(body)
    cards = [_plain_card(groups, flange, errors, said)]
    for form in FORMS:
        values = _filled(form.values, groups)
        notes = [*_error_notes(said, form.values)]
        if max(map(abs, groups["six"])) > form.most:
            refused = (
                "The controller refuses this: no element of the inertia may exceed"
            )
            notes.append(f"{refused} {form.most:g}.")
        make = form.text
        text = (
            make % tuple(_texts(values))
            if isinstance(make, str)
            else make(payload, inertia)
        )
        cards.append(
            Card(form.name, form.title, form.explanation, values, text, tuple(notes))
        )
    return tuple(cards)


def load_covariance(body: BodyEstimate) -> Array:
    """Return the covariance (10, 10) of what ``ERROR_NAMES`` names.

    I_com = I - m (|c|^2 1 - c c^T) to first order. c = h / m changes more where the mass is smaller
    than where it is larger: slopes of c are those to the body that is lighter by one standard
    error of the mass, and at most twice those of the body itself. Variances are infinite where the
    mass, the first moment or the inertia is not known.
    """
    inertial = body.inertial
    is_place_known = inertial.mass > 0.0 and bool(np.all(body.is_determined[:4]))
    mass = inertial.mass if is_place_known else 1.0
    mass_error = float(np.sqrt(max(body.covariance[0, 0], 0.0)))
    com = inertial.com
    identity = np.eye(3)
    slopes = [com @ com * identity - np.outer(com, com)]
    slopes += [
        np.outer(axis, com) + np.outer(com, axis) - 2.0 * (axis @ com) * identity
        for axis in identity
    ]
    change = np.eye(10)
    change[1:4, :4] = np.column_stack((-com, identity)) / max(
        mass - mass_error, 0.5 * mass
    )
    change[4:, :4] = np.column_stack(
        [spatial.six_from_symmetric(slope) for slope in slopes]
    )
    covariance = change @ body.covariance @ change.T
    is_known = [
        bool(body.is_determined[0]),
        is_place_known,
        is_place_known and bool(np.all(body.is_determined)),
    ]
    hidden = ~np.repeat(is_known, [1, 3, 6])
    covariance[hidden] = covariance[:, hidden] = 0.0
    covariance[hidden, hidden] = np.inf
    return covariance


def load_errors(body: BodyEstimate) -> Array:
    """Return the standard errors (10,) of ``ERROR_NAMES``; infinite where one is not known."""
    return np.sqrt(np.maximum(np.diag(load_covariance(body)), 0.0))


def principal_moments(body: BodyEstimate) -> tuple[Array, Array, Array]:
    """Return (principal moments (3,), their standard errors, those of the axes' turn [degrees]).

    To first order, a_i^T dI a_i, and a_i^T dI a_j over the difference of the moments i and j.
    """
    moments, axes = spatial.principal_axes(body.inertial.inertia_com)
    covariance = load_covariance(body)[4:, 4:]
    if not np.all(np.isfinite(covariance)):
        return moments, np.full(3, np.inf), np.full(3, np.inf)
    pairs = [np.outer(axes[:, i], axes[:, j]) for i, j in zip(*np.triu_indices(3))]
    rows = np.array(
        [_TWICE * spatial.six_from_symmetric(0.5 * (p + p.T)) for p in pairs]
    )
    xx, xy, xz, yy, yz, zz = np.sqrt(
        np.maximum(np.diag(rows @ covariance @ rows.T), 0.0)
    )
    apart = np.abs(moments[[1, 0, 0]] - moments[[2, 2, 1]])
    turns = np.degrees(np.array([yz, xz, xy]) / np.maximum(apart, 1e-300))
    return moments, np.array([xx, yy, zz]), np.where(turns <= _MOST_TURN, turns, np.inf)


def inertia_is_known(body: BodyEstimate) -> bool:
    """Tell whether any principal moment is told from zero.

    One is enough: the least one of a rod never is, and a wrist that spins shows one alone.
    """
    moments, errors, _ = principal_moments(body)
    return bool(np.any(moments > TOLD * errors))


def card_text(cards: Sequence[Card], heading: str) -> str:
    """Return the text of payload_card.txt."""
    blocks = [heading]
    for card in cards:
        said = (card.explanation, *card.notes)
        about = [f"# {line}" for part in said for line in wrap(part, _WIDTH - 2)]
        blocks.append("\n".join([f"== {card.title} ==", *about, card.text]))
    return "\n\n".join(blocks) + "\n"


def _groups(payload: InertialParameters) -> tuple[Array, dict[str, Any]]:
    """Return the inertia (3, 3) about the centre of mass, and the numbers of all cards by group."""
    mass, com, inertia = spatial.com_from_theta(payload.theta)
    moments, axes = spatial.principal_axes(inertia)
    # Rounding of an inertia about a distant origin hides a small one about the centre of mass.
    rounding = _NOTHING * abs(mass) * float(com @ com)
    if np.max(np.abs(moments)) <= rounding:
        inertia = np.zeros((3, 3))
        moments = np.zeros(3)
        axes = np.eye(3)
    if np.ptp(moments) <= rounding + _NOTHING * np.max(np.abs(moments)):
        # Any axes will do: those of the frame, not those that rounding has.
        moments = np.diag(inertia)
        axes = np.eye(3)
    slack = _EDGE * float(np.sum(np.abs(moments))) + rounding
    beyond = max(
        -float(np.min(moments)), float(2.0 * np.max(moments) - np.sum(moments))
    )
    if mass <= 0.0 or beyond > slack:
        raise ExportError(
            f"a payload of {mass:.4g} kg with principal moments of inertia "
            f"{', '.join(f'{moment:.4g}' for moment in moments)} kg m^2 is not a possible rigid "
            "body, so there is no card for a controller; record longer or faster motion"
        )
    full = spatial.fullinertia_from_symmetric(inertia)
    return inertia, {
        # As they are: Ixx Iyy Izz Ixy Ixz Iyz and Ixx Ixy Ixz Iyy Iyz Izz about the centre of mass.
        "mass": payload.mass,
        "com": payload.com.tolist(),
        "full": full.tolist(),
        "upper": spatial.six_from_symmetric(inertia).tolist(),
        # With the digits of a card; nine: column by column, no_turn: a 4x4 identity.
        "kg": rounded([mass])[0],
        "com_m": rounded(com),
        "com_mm": rounded(1e3 * com),
        "six": rounded(full),
        "nine": rounded(inertia.T.ravel()),
        "moments": rounded(moments),
        "yaw_pitch_roll": rounded(np.degrees(spatial.roll_pitch_yaw(axes)[::-1])),
        "turn": rounded(spatial.quaternion(axes)),
        "no_turn": np.eye(4).ravel().tolist(),
    }


def rounded(values: Sequence[float] | Array) -> list[float]:
    """Return a group of numbers with the digits of a card; what is only rounding is zero."""
    least = _NOTHING * float(np.max(np.abs(values)))
    return [float(plain(value)) if abs(value) >= least else 0.0 for value in values]


def plain(value: float) -> str:
    """Return a number without exponent, which not every controller reads."""
    text = np.format_float_positional(value, DIGITS, fractional=False, trim="0")
    return "0.0" if float(text) == 0.0 else text


def listed(values: Sequence[float]) -> str:
    """Return numbers without exponent, separated by commas."""
    return ", ".join(plain(value) for value in values)


def _filled(values: Mapping[str, Any], groups: Mapping[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, group in values.items():
        if isinstance(group, dict):
            found[name] = _filled(group, groups)
        elif " " in name:
            found.update(zip(name.split(), groups[group]))
        else:
            found[name] = groups[group]
    return found


def _texts(value: Any) -> list[str]:
    """Return the texts of named numbers, one for the numbers of a list together."""
    if isinstance(value, dict):
        return [text for part in value.values() for text in _texts(part)]
    return [listed(value if isinstance(value, list) else [value])]


def _plain_card(
    groups: Mapping[str, Any], flange: Flange, errors: Array, said: Mapping[str, str]
) -> Card:
    place = flange.translation
    turn = spatial.quaternion(flange.rotation)
    known = [each if np.isfinite(each) else None for each in errors.tolist()]
    values = {
        "flange": flange.name,
        "terminal_body": flange.terminal,
        "flange_position": place.tolist(),
        "flange_quaternion": turn.tolist(),
        "mass": groups["mass"],
        "center_of_mass": groups["com"],
        "inertia_about_com": groups["upper"],
        "standard_errors": dict(zip(ERROR_NAMES, known)),
    }
    text = [
        f"frame           {flange.name}: origin at {listed(rounded(place))} m, turned by the "
        f"quaternion w x y z {listed(rounded(turn))}, both in the frame of body "
        f"'{flange.terminal}'",
        f"mass            {plain(groups['kg'])} kg",
        f"centre of mass  {listed(groups['com_m'])} m",
        f"inertia         {listed(groups['six'])} kg m^2 (xx yy zz xy xz yz)",
    ]
    explanation = (
        "All cards below state this one body. It is what the loaded runs carried and the empty "
        "ones did not. All numbers hold in the frame named here, the inertia about the centre of "
        "mass in axes of that frame, products of inertia as they stand in the matrix (Ixy is "
        "minus the integral of x y). A controller takes them for numbers in the frame of ITS "
        "flange: where that is another one, make the cards again for it."
    )
    point = (
        ()
        if any(groups["six"])
        else ("The inertia is zero: every card states a point mass.",)
    )
    own = _error_notes(
        said, {"mass": "kg", "center_of_mass": "com_m", "inertia": "six"}
    )
    notes = (*([flange.note] if flange.note else []), *own, *point)
    return Card("payload", "Payload", explanation, values, "\n".join(text), notes)


def _error_texts(body: BodyEstimate) -> dict[str, str]:
    """Return what is said of the errors of each group of numbers in ``_groups``."""
    errors = load_errors(body)
    (_, moments, turns) = principal_moments(body)
    com = errors[1:4]
    inertia = errors[4:]
    mass = f"mass {_listed(errors[:1], 'kg')}"
    place = f"centre of mass {_listed(com, 'm')}"
    elements = NOT_KNOWN
    principal = NOT_KNOWN
    axes = NOT_KNOWN
    if np.all(np.isfinite(inertia)):
        named = ", ".join(
            f"{name[1:]} {each:.2g}" for name, each in zip(INERTIA, inertia)
        )
        elements = f"inertia {named} kg m^2"
        principal = f"moments {_listed(moments, 'kg m^2')}"
        axes = f"turn about the axes X, Y, Z {_listed(turns, 'degrees')}"
    return {
        "kg": mass,
        "mass": mass,
        "com_m": place,
        "com": place,
        "com_mm": f"centre of mass {_listed(1e3 * com, 'mm')}",
        **dict.fromkeys(("six", "nine", "upper", "full"), elements),
        "moments": principal,
        "yaw_pitch_roll": axes,
        "turn": axes,
    }


def _listed(errors: Sequence[float] | Array, unit: str) -> str:
    texts = [f"{each:.2g}" if np.isfinite(each) else "not known" for each in errors]
    return f"{', '.join(texts)} {unit}" if np.any(np.isfinite(errors)) else "not known"


def _error_notes(said: Mapping[str, str], values: Mapping[str, Any]) -> Iterator[str]:
    """Yield what is said of the errors of a form's numbers."""
    parts = (
        each.values() if isinstance(each, dict) else (each,) for each in values.values()
    )
    told = dict.fromkeys(
        said[group] for part in parts for group in part if group in said
    )
    yield f"Standard errors: {'; '.join(each for each in told if each != NOT_KNOWN)}."
    if NOT_KNOWN in told:
        yield NOT_KNOWN
