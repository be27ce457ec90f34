"""The flange: the frame, fixed to the terminal body, in which controllers want a payload.

A site or a body of the model, or plain numbers. A frame that moves against the terminal body is no
flange.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import mujoco
import numpy as np

from robot_sysid.dynamics.inverse_dynamics import data_at_pose
from robot_sysid.errors import ModelError
from robot_sysid.records import Array, Flange, RobotModel

# Names by which models call the frame that a tool is bolted to, the surest first.
_NAMES = ("attachment", "(?:tool_?)?flange", "tool0", "eef?|end_?effector")
_PATTERNS = tuple(
    re.compile(rf"(?:.*[/_.:-])?(?:{name})(?:[_-](?:site|frame|link))?", re.IGNORECASE)
    for name in _NAMES
)
_DOUBT = "; an end effector's frame may also be the tip of the tool: check"
REACH = 3.0
"""Distance of a flange from its link beyond which the numbers must be millimetres [m]: no arm is as
long."""


def find_flange(robot: RobotModel, text: str | None = None) -> Flange:
    """Return the frame that a user named, or the one that looks like a flange.

    Args:
        text: name of a site or body fixed to the terminal body; "x,y,z" in metres or
            "x,y,z,roll,pitch,yaw" with degrees about the fixed axes x, y, z, in the terminal body's
            frame; None for the site or body that is called like a flange, else the terminal body.

    Raises:
        ModelError: no frame, or several, could be meant, or it moves against the terminal body.
    """
    sites, bodies = _fixed_frames(robot)
    if text is None:
        return _guess_flange(robot, sites, bodies)
    name = text.strip()
    frames = {**bodies, **sites}
    if name in frames:
        return frames[name]
    if "," in name:
        return _parse_flange(robot, name)
    fault = "no such site or body"
    for object_type, mj_type in _OBJECTS.items():
        if mujoco.mj_name2id(robot.mj_model, int(mj_type), name) >= 0:
            fault = f"{object_type} '{name}' moves against the terminal body, or stands before it"
    listed = _list_names([*sites.values(), *bodies.values()])
    remedy = f"fixed to body '{robot.body_name}' are: {listed}; or give x,y,z in metres"
    raise ModelError(f"flange {name}: {fault}; {remedy}")


def _list_names(flanges: Sequence[Flange]) -> str:
    """Return the names of frames, separated by commas."""
    return ", ".join(flange.name for flange in flanges)


def place_in_carrier(robot: RobotModel, flange: Flange) -> tuple[Array, Array]:
    """Return (rotation (3, 3), translation (3,)) of a flange in the frame of its carrier [m]."""
    bodies = _fixed_frames(robot)[1].values()
    carrier = next(body for body in bodies if body.carrier == flange.carrier)
    rotation = carrier.rotation.T @ flange.rotation
    translation = carrier.rotation.T @ (flange.translation - carrier.translation)
    # A distance that is left after adding and subtracting it is no distance.
    return np.round(rotation, 15), np.round(translation, 15)


_OBJECTS = {"site": mujoco.mjtObj.mjOBJ_SITE, "body": mujoco.mjtObj.mjOBJ_BODY}
_Frames = Mapping[str, Flange]
"""Name of a site or body to its frame."""


def _fixed_frames(robot: RobotModel) -> tuple[_Frames, _Frames]:
    """Return the frames of all sites, and of all bodies, that are fixed to the terminal body."""
    mj_model = robot.mj_model
    terminal = robot.body_id
    data = data_at_pose(mj_model, robot.reference_qpos)
    axes = data.xmat[terminal].reshape(3, 3)
    origin = data.xpos[terminal]
    fixed = {body.body_id: body.name for body in robot.bodies if body.welded}

    def frame(label: str, carrier: int, xmat: Array, xpos: Array) -> Flange:
        """Return a frame, at world axes (9,) and position (3,), relative to the terminal body."""
        rotation = axes.T @ xmat.reshape(3, 3)
        translation = axes.T @ (xpos - origin)
        return Flange(label, rotation, translation, robot.body_name, carrier)

    sites = {}
    for i, carrier in enumerate(mj_model.site_bodyid.tolist()):
        name = mj_model.site(i).name
        if name and carrier in fixed:
            label = f"site '{name}'"
            sites[name] = frame(label, carrier, data.site_xmat[i], data.site_xpos[i])
    bodies = {}
    for i, name in fixed.items():
        bodies[name] = frame(f"body '{name}'", i, data.xmat[i], data.xpos[i])
    return sites, bodies


def _guess_flange(robot: RobotModel, sites: _Frames, bodies: _Frames) -> Flange:
    """Return the frame that is called like a flange, else the terminal body, with a note."""
    others = {**bodies}
    terminal = others.pop(robot.body_name)
    for pattern in _PATTERNS:
        # A site counts more than a body.
        matches = [sites[name] for name in sites if pattern.fullmatch(name)]
        if not matches:
            matches = [others[name] for name in others if pattern.fullmatch(name)]
        if not matches:
            continue
        poses = [np.column_stack((f.rotation, f.translation)) for f in matches]
        if not np.allclose(poses, poses[0], rtol=0.0, atol=1e-9):
            listed = _list_names(matches)
            raise ModelError(
                f"{listed} could each be the flange; choose one by its name"
            )
        note = f"{matches[0].name} was taken for the flange, because of its name"
        note += _DOUBT if pattern is _PATTERNS[-1] else ""
        return replace(matches[0], note=note)
    listed = _list_names([*sites.values(), *others.values()]) or "none"
    note = (
        f"no site or body that is fixed to body '{robot.body_name}' is called like a flange, so "
        f"the frame of that body is taken; others that can be named: {listed}"
    )
    return replace(terminal, note=note)


def _parse_flange(robot: RobotModel, text: str) -> Flange:
    """Return the frame of "x,y,z" or "x,y,z,roll,pitch,yaw", or raise ModelError."""
    from scipy.spatial.transform import Rotation

    try:
        numbers = [float(number) for number in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (3, 6) or not np.all(np.isfinite(numbers)):
        remedy = "wanted are x,y,z in metres or x,y,z,roll,pitch,yaw with degrees"
        raise ModelError(f"flange {text}: neither a name nor numbers; {remedy}")
    translation = np.array(numbers[:3])
    if np.max(np.abs(translation)) > REACH:
        fault = f"more than {REACH:g} m away from body '{robot.body_name}'"
        raise ModelError(
            f"flange {text}: {fault}; the numbers are metres, not millimetres"
        )
    # Rz(yaw) Ry(pitch) Rx(roll), as in a URDF.
    angles = numbers[3:] or [0.0] * 3
    rotation = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    name = text.replace(" ", "")
    return Flange(name, rotation, translation, robot.body_name, robot.body_id)
