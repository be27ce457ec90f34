"""Cards for controllers: one payload in every form that controllers and libraries take it in.

Each form was read in its maker's own documentation or source; one that could not be confirmed is
not here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap
from typing import Any

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.inertial import mjcf_inertial, number, numbers, urdf_inertial_about_com
from robot_sysid.records import Array, Flange, InertialParameters
from robot_sysid.results.record import BodyEstimate

DIGITS = 9
"""Significant digits of the numbers that people type into a controller."""
UR_LIMIT = 133.0
"""Largest element of an inertia matrix that a UR controller takes [kg m^2]."""
_NOTHING = 1e-12
"""Share of the largest number of a group below which another one is only rounding."""


@dataclass(frozen=True)
class Load:
    """A payload in flange axes: what every form is computed from.

    The first two are exact, the others have the digits of a card.

    Attributes:
        body: in the flange frame.
        inertia: (3, 3) about the centre of mass, axes of the flange [kg m^2].
        kg: the mass.
        com_m, com_mm: centre of mass [m], [mm].
        six: Ixx Iyy Izz Ixy Ixz Iyz about the centre of mass.
        nine: the inertia about the centre of mass column by column.
        moments: principal moments [kg m^2].
        yaw_pitch_roll: of their axes [degrees].
        turn: the quaternion w x y z of their axes.
    """

    body: InertialParameters
    inertia: Array
    kg: float
    com_m: list[float]
    com_mm: list[float]
    six: list[float]
    nine: list[float]
    moments: list[float]
    yaw_pitch_roll: list[float]
    turn: list[float]


@dataclass(frozen=True)
class Form:
    """One way to state a payload, named as in ``Card``.

    Attributes:
        values: the numbers by name.
        text: with a %s for each of them, for all numbers of a list one; or what makes it.
        exact: whether the text has all digits of the numbers.
        most: largest element of an inertia matrix that the target takes [kg m^2].
    """

    name: str
    title: str
    values: Callable[[Load], dict[str, Any]]
    text: str | Callable[[Load], str]
    explanation: str
    in_mm: bool = False
    exact: bool = False
    most: float = np.inf


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


def _named(names: str, values: Iterable[Any]) -> dict[str, Any]:
    return dict(zip(names.split(), values))


def _texts(value: Any, text_of: Callable[[float], str]) -> list[str]:
    """Return the texts of named or listed numbers, one for the numbers of a list together."""
    if isinstance(value, dict) or (isinstance(value, list) and isinstance(value[0], list)):
        parts = value.values() if isinstance(value, dict) else value
        return [text for part in parts for text in _texts(part, text_of)]
    return [", ".join(map(text_of, value if isinstance(value, list) else [value]))]


def _mjcf(load: Load) -> str:
    body = load.body
    if np.any(load.inertia):
        return mjcf_inertial(body.theta)
    return f'<inertial pos="{numbers(body.com)}" mass="{body.mass!r}" diaginertia="0 0 0"/>'


def _central(load: Load, names: str) -> dict[str, Any]:
    """Return mass, centre of mass and xx yy zz xy xz yz about it under these names."""
    six = spatial.fullinertia_from_symmetric(load.inertia).tolist()
    return _named(names, (load.body.mass, load.body.com.tolist(), six))


# m, m c, then xx xy yy xz yz zz: the lower triangle row by row.
_PINOCCHIO = [0, 1, 2, 3, 4, 5, 7, 6, 8, 9]
_ALL_OF_IT = (
    "The controller wants everything that is bolted to the flange: where the empty runs carried a "
    "tool already, that tool is not in these numbers and must be added."
)
FORMS = (
    Form(
        "franka_set_load",
        "Franka load: libfranka Robot::setLoad(load_mass, F_x_Cload, load_inertia)",
        lambda load: _named("load_mass F_x_Cload load_inertia", (load.kg, load.com_m, load.nine)),
        "robot.setLoad(%s, {{%s}}, {{%s}});",
        "load_mass kg; F_x_Cload from the flange to the centre of mass, m; load_inertia 3x3 about "
        "the centre of mass, axes of the flange, column by column, kg m^2. franka_msgs/SetLoad "
        "takes the same three. The LOAD is what the hand holds, and the arm adds it to the END "
        "EFFECTOR that is set in Desk: enter a payload as one of the two, never as both.",
    ),
    Form(
        "franka_end_effector",
        "Franka end effector: the mechanical data of endeffector-config.json, set in Desk",
        lambda load: _named(
            "mass centerOfMass inertia transformation",
            (load.kg, load.com_m, load.nine, np.eye(4).ravel().tolist()),
        ),
        '{"mass": %s, "centerOfMass": [%s], "inertia": [%s], "transformation": [%s]}',
        "mass kg; centerOfMass from the flange, m; inertia 3x3 about the centre of mass, axes of "
        "the flange, column by column, kg m^2; transformation 4x4 flange to tool tip, column by "
        "column, m: not identified, the identity stands there, put your own in. The END EFFECTOR "
        "is the tool that stays mounted, not the load in its hand (see the card above). Desk adds "
        "nothing to it: these numbers have to be the whole tool.",
        exact=True,
    ),
    Form(
        "ur_set_target_payload",
        "Universal Robots: set_target_payload(m, cog, inertia)",
        lambda load: {"m": load.kg, "cog": load.com_m, "inertia": load.six},
        "set_target_payload(%s, [%s], [%s])",
        "m kg; cog from the tool flange, m; inertia [Ixx, Iyy, Izz, Ixy, Ixz, Iyz] about the "
        f"centre of gravity, axes of the tool flange, kg m^2. {_ALL_OF_IT}",
        most=UR_LIMIT,
    ),
    Form(
        "ur_msgs_set_payload",
        "Universal Robots under ROS 2: request of ur_msgs/srv/SetPayload",
        lambda load: {
            "mass": load.kg,
            "center_of_gravity": _named("x y z", load.com_m),
            **_named("ixx iyy izz ixy ixz iyz", load.six),
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
        lambda load: {
            "M": load.kg,
            "CM": _named("X Y Z A B C", load.com_mm + load.yaw_pitch_roll),
            "J": _named("X Y Z", load.moments),
        },
        "{M %s, CM {X %s, Y %s, Z %s, A %s, B %s, C %s}, J {X %s, Y %s, Z %s}}",
        "M kg; CM X, Y, Z centre of mass in the FLANGE coordinate system, mm; CM A, B, C turn of "
        "the principal axes, degrees: A about Z, then B about the new Y, then C about the new X; J "
        f"X, Y, Z principal moments about those axes, kg m^2. {_ALL_OF_IT}",
        in_mm=True,
    ),
    Form(
        "abb_loaddata",
        "ABB: loaddata [mass, cog, aom, ix, iy, iz]",
        lambda load: _named(
            "mass cog aom ix iy iz", (load.kg, load.com_mm, load.turn, *load.moments)
        ),
        "[%s, [%s], [%s], %s, %s, %s]",
        "mass kg; cog x, y, z in mm; aom turn of the principal axes, quaternion q1 q2 q3 q4 with "
        "q1 the real part; ix, iy, iz moments about those axes through the centre of gravity, kg "
        "m^2. Right as it stands for the tload of a tooldata, which is stated in the wrist "
        "coordinate system (the flange, tool0). For GripLoad it has to be stated in the frame of "
        "the TOOL: make the card for that frame.",
        in_mm=True,
    ),
    Form(
        "xarm_set_tcp_load",
        "UFACTORY xArm: set_tcp_load(weight, center_of_gravity)",
        lambda load: {"weight": load.kg, "center_of_gravity": load.com_mm},
        "arm.set_tcp_load(%s, [%s])",
        "weight kg; center_of_gravity x, y, z in the default tool coordinate system at the centre "
        f"of the flange, mm. It takes no inertia. {_ALL_OF_IT}",
        in_mm=True,
    ),
    Form(
        "mecademic_set_payload",
        "Mecademic: SetPayload(m, cx, cy, cz)",
        lambda load: _named("m cx cy cz", (load.kg, *load.com_mm)),
        "SetPayload(%s, %s, %s, %s)",
        "m kg; cx, cy, cz centre of mass in the flange reference frame (FRF), mm. It takes no "
        f"inertia. {_ALL_OF_IT}",
        in_mm=True,
    ),
    Form(
        "urdf_inertial",
        "URDF: <inertial> of a link whose frame is the flange",
        lambda load: {
            **{"mass": load.body.mass, "origin": load.body.com.tolist()},
            **_named("ixx ixy ixz iyy iyz izz", spatial.six_from_symmetric(load.inertia).tolist()),
        },
        lambda load: urdf_inertial_about_com(load.body.mass, load.body.com, load.inertia),
        "mass kg; origin xyz centre of mass, m; ixx ixy ixz iyy iyz izz about the centre of mass, "
        "axes of the link (rpy 0), kg m^2.",
    ),
    Form(
        "mjcf_inertial",
        "MuJoCo: <inertial> of a body whose frame is the flange",
        lambda load: _central(load, "mass pos fullinertia"),
        _mjcf,
        "mass kg; pos centre of mass, m; fullinertia xx yy zz xy xz yz about the centre of mass, "
        "axes of the body, kg m^2.",
    ),
    Form(
        "pinocchio_inertia",
        "Pinocchio: Inertia(mass, lever, inertia) and Inertia.FromDynamicParameters(v)",
        lambda load: {
            "mass": load.body.mass,
            "lever": load.body.com.tolist(),
            "inertia": load.inertia.tolist(),
            "dynamic_parameters": load.body.theta[_PINOCCHIO].tolist(),
        },
        "pinocchio.Inertia(%s, np.array([%s]), np.array([[%s], [%s], [%s]]))\n"
        "pinocchio.Inertia.FromDynamicParameters(np.array([%s]))",
        "In the frame of the flange: mass kg; lever centre of mass, m; inertia 3x3 about the "
        "centre of mass, kg m^2. The ten dynamic parameters are m, m cx, m cy, m cz, Ixx, Ixy, "
        "Iyy, Ixz, Iyz, Izz with the inertia about the ORIGIN of the flange; kg, kg m, kg m^2.",
        exact=True,
    ),
    Form(
        "drake_spatial_inertia",
        "Drake: SpatialInertia.MakeFromCentralInertia(mass, p_PScm_E, I_SScm_E)",
        lambda load: _central(load, "mass p_PScm_E I_SScm_E"),
        "SpatialInertia.MakeFromCentralInertia(%s, [%s], RotationalInertia(%s))",
        "P the origin and E the axes of the flange: mass kg; p_PScm_E centre of mass, m; I_SScm_E "
        "RotationalInertia(Ixx, Iyy, Izz, Ixy, Ixz, Iyz) about the centre of mass, kg m^2.",
        exact=True,
    ),
)


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
        explanation: unit, frame and order of the numbers.
        values: what the numbers are called there, JSON-able.
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
        errors: standard errors by ``ERROR_NAMES``; what is missing counts as not known.

    Raises:
        ExportError: no rigid body has these parameters, so no controller may get them.
    """
    load = _load(payload)
    cards = [_plain_card(load, flange, errors)]
    for form in FORMS:
        values, text = form.values(load), form.text
        if isinstance(text, str):
            text %= tuple(_texts(values, number if form.exact else plain))
        else:
            text = text(load)
        notes = _error_notes(errors, form.in_mm)
        if max(map(abs, load.six)) > form.most:
            refused = "The controller refuses this: no element of the inertia may exceed"
            notes += (f"{refused} {form.most:g}.",)
        cards.append(Card(form.name, form.title, form.explanation, values, text, notes))
    return tuple(cards)


def load_errors(body: BodyEstimate) -> dict[str, float]:
    """Return the standard errors of mass and centre of mass, c = h / m to first order.

    Infinite where the mass or the first moment is not known.
    """
    found = body.inertial
    if not found.mass > 0.0 or not np.all(body.shown[:4]):
        return dict(zip(ERROR_NAMES, (float(body.errors[0]), *[float("inf")] * 3)))
    jacobian = np.zeros((4, 10))
    jacobian[0, 0] = 1.0
    jacobian[1:, 0] = -found.com / found.mass
    jacobian[1:, 1:4] = np.eye(3) / found.mass
    spread = np.diag(jacobian @ body.covariance @ jacobian.T)
    return dict(zip(ERROR_NAMES, np.sqrt(np.maximum(spread, 0.0)).tolist()))


def card_text(cards: Sequence[Card], heading: Sequence[str] = ()) -> str:
    """Return the text of payload_card.txt, under the lines of a heading."""
    blocks = ["\n".join(heading)] if any(heading) else []
    for card in cards:
        said = (card.explanation, *card.notes)
        about = [f"# {line}" for part in said for line in wrap(part, _WIDTH - 2)]
        blocks.append("\n".join([f"== {card.title} ==", *about, card.text]))
    return "\n\n".join(blocks) + "\n"


def card_entries(cards: Sequence[Card]) -> dict[str, Any]:
    """Return the cards as JSON entries by name."""
    return {card.name: {k: v for k, v in vars(card).items() if k != "name"} for card in cards}


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
    return Load(
        payload,
        inertia,
        kg=rounded([mass])[0],
        com_m=rounded(com),
        com_mm=rounded(1e3 * com),
        six=rounded(spatial.fullinertia_from_symmetric(inertia)),
        nine=rounded(inertia.T.ravel()),
        moments=rounded(moments),
        yaw_pitch_roll=rounded(np.degrees(spatial.roll_pitch_yaw(axes)[::-1])),
        turn=rounded(spatial.quaternion(axes)),
    )


def _plain_card(load: Load, flange: Flange, errors: Mapping[str, float] | None) -> Card:
    place, turn = flange.translation, spatial.quaternion(flange.rotation)
    values = {
        "flange": flange.name,
        "terminal_body": flange.terminal,
        "flange_position": place.tolist(),
        "flange_quaternion": turn.tolist(),
        "mass": load.body.mass,
        "center_of_mass": load.body.com.tolist(),
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
    finite = {name: float(error) for name, error in errors.items() if np.isfinite(error)}
    return {name: finite.get(name) for name in ERROR_NAMES}


def _error_notes(errors: Mapping[str, float] | None, in_mm: bool = False) -> tuple[str, ...]:
    known = _known(errors)
    if known is None:
        return ()
    factor, unit = (1e3, "mm") if in_mm else (1.0, "m")
    mass, *com = known.values()
    place = ", ".join("not known" if value is None else f"{factor * value:.2g}" for value in com)
    weight = "not known" if mass is None else f"{mass:.2g} kg"
    return (f"Standard errors: mass {weight}; centre of mass {place} {unit}.",)
