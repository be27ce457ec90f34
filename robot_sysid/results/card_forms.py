"""The forms in which controllers and libraries take a payload.

Each form is confirmed by its maker's own documentation or source. A form takes its numbers from
named groups, such as "com_mm", the centre of mass [mm]; ``cards.number_groups`` has them all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.mjcf.inertial import format_numbers, urdf_inertial_about_com

UR_LIMIT = 133.0
"""Largest element of an inertia matrix that a UR controller takes [kg m^2], by the notes on
``set_target_payload`` in Universal Robots' script manual."""


@dataclass(frozen=True)
class Form:
    """The form in which one controller or library takes a payload; names are as in ``Card``.

    Attributes:
        name: key in params.json.
        controller: who takes it, of ``records.controllers.CHOICES``.
        title: heading of the card.
        values: name of a value to its group of numbers; a name of several words takes the numbers
            of the group one by one; a dict is a nested value.
        text: text to copy, with a %s for each value in the order of ``values``; or a function that
            returns it for the groups of numbers.
        explanation: unit, frame and order of the numbers.
        max_inertia: largest element of an inertia matrix that the target accepts [kg m^2].
    """

    name: str
    controller: str
    title: str
    values: Mapping[str, Any]
    text: str | Callable[[Mapping[str, Any]], str]
    explanation: str
    max_inertia: float = np.inf


def _urdf_text(groups: Mapping[str, Any]) -> str:
    """Return the <inertial> element of a URDF's link."""
    inertia = spatial.symmetric_from_six(groups["upper"])
    return urdf_inertial_about_com(groups["kg"], groups["com_m"], inertia)


def _mjcf_text(groups: Mapping[str, Any]) -> str:
    """Return the <inertial> element of an MJCF body; MuJoCo reads no zero as a full inertia."""
    start = f'<inertial pos="{format_numbers(groups["com_m"])}" mass="{groups["kg"]!r}"'
    if not any(groups["six"]):
        return f'{start} diaginertia="0 0 0"/>'
    return f'{start} fullinertia="{format_numbers(groups["six"])}"/>'


_EVERYTHING = "It takes everything that is bolted to the flange as one load."
"""End of the explanation of a card whose controller takes the load including all tools."""
FORMS = (
    Form(
        "franka_set_load",
        "franka",
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
        "franka",
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
        "ur",
        "Universal Robots: set_target_payload(m, cog, inertia)",
        {"m": "kg", "cog": "com_m", "inertia": "six"},
        "set_target_payload(%s, [%s], [%s])",
        "m kg; cog from the tool flange, m; inertia [Ixx, Iyy, Izz, Ixy, Ixz, Iyz] about the "
        f"centre of gravity, axes of the tool flange, kg m^2. {_EVERYTHING}",
        max_inertia=UR_LIMIT,
    ),
    Form(
        "ur_msgs_set_payload",
        "ur",
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
        f"mass and center_of_gravity only. {_EVERYTHING}",
        max_inertia=UR_LIMIT,
    ),
    Form(
        "kuka_load",
        "kuka",
        "KUKA: LOAD_DATA[n] of type LOAD",
        {
            "M": "kg",
            "CM": {"X Y Z": "com_mm", "A B C": "yaw_pitch_roll"},
            "J": {"X Y Z": "moments"},
        },
        "{M %s, CM {X %s, Y %s, Z %s, A %s, B %s, C %s}, J {X %s, Y %s, Z %s}}",
        "M kg; CM X, Y, Z centre of mass in the FLANGE coordinate system, mm; CM A, B, C turn of "
        "the principal axes, degrees: A about Z, then B about the new Y, then C about the new X; J "
        f"X, Y, Z principal moments about those axes, kg m^2. {_EVERYTHING} An LBR iiwa is "
        "programmed without KRL: enter the numbers as the load data of its tool.",
    ),
    Form(
        "abb_loaddata",
        "abb",
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
        "kinova_payload_information",
        "kinova",
        "Kinova Gen3, Kortex API: ControlConfig.SetPayloadInformation(PayloadInformation)",
        {"payload_mass": "kg", "payload_mass_center": {"x y z": "com_m"}},
        "PayloadInformation(payload_mass=%s, payload_mass_center=Position(x=%s, y=%s, z=%s))",
        "payload_mass kg; payload_mass_center x, y, z relative to the TOOL reference frame, m: "
        "these numbers hold where no tool transform is set (ToolConfiguration); else make the card "
        "for that frame. It takes no inertia.",
    ),
    Form(
        "xarm_set_tcp_load",
        "xarm",
        "UFACTORY xArm: set_tcp_load(weight, center_of_gravity)",
        {"weight": "kg", "center_of_gravity": "com_mm"},
        "arm.set_tcp_load(%s, [%s])",
        "weight kg; center_of_gravity x, y, z in the default tool coordinate system at the centre "
        f"of the flange, mm. It takes no inertia. {_EVERYTHING}",
    ),
    Form(
        "mecademic_set_payload",
        "mecademic",
        "Mecademic: SetPayload(m, cx, cy, cz)",
        {"m": "kg", "cx cy cz": "com_mm"},
        "SetPayload(%s, %s, %s, %s)",
        "m kg; cx, cy, cz centre of mass in the flange reference frame (FRF), mm. It takes no "
        f"inertia. {_EVERYTHING}",
    ),
    Form(
        "urdf_inertial",
        "urdf",
        "URDF: <inertial> of a link whose frame is the flange",
        {"mass": "kg", "origin": "com_m", "ixx ixy ixz iyy iyz izz": "upper"},
        _urdf_text,
        "mass kg; origin xyz centre of mass, m; ixx ixy ixz iyy iyz izz about the centre of mass, "
        "axes of the link (rpy 0), kg m^2.",
    ),
    Form(
        "mjcf_inertial",
        "mujoco",
        "MuJoCo: <inertial> of a body whose frame is the flange",
        {"mass": "kg", "pos": "com_m", "fullinertia": "six"},
        _mjcf_text,
        "mass kg; pos centre of mass, m; fullinertia xx yy zz xy xz yz about the centre of mass, "
        "axes of the body, kg m^2.",
    ),
)
