"""The flange: the frame, fixed to the terminal body, in which controllers want a payload.

A site or a body of the model, or plain numbers. What moves against the terminal body is no flange.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

import mujoco
import numpy as np

from robot_sysid.dynamics.inverse_dynamics import data_at_pose
from robot_sysid.errors import ModelError
from robot_sysid.records import Array, Flange, RobotModel

# Names by which models call the frame that a tool is bolted to, the surest first.
_LIKELY = tuple(
    re.compile(rf"(?:.*[/_.:-])?(?:{words})(?:[_-](?:site|frame|link))?", re.IGNORECASE)
    for words in ("attachment", "(?:tool_?)?flange", "tool0", "eef?|end_?effector")
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
        return _likely(robot, sites, bodies)
    wanted = text.strip()
    if wanted in (known := {**bodies, **sites}):
        return known[wanted]
    if "," in wanted:
        return _from_numbers(robot, wanted)
    listed = ", ".join(flange.name for flange in (*sites.values(), *bodies.values()))
    fault = "no such site or body"
    for kind in _OBJECTS:
        if mujoco.mj_name2id(robot.mj_model, int(_OBJECTS[kind]), wanted) >= 0:
            fault = f"{kind} '{wanted}' moves against the terminal body, or stands before it"
    there = f"fixed to body '{robot.body_name}' are: {listed}; or give x,y,z in metres"
    raise ModelError(f"flange {wanted}: {fault}; {there}")


def place_in_carrier(robot: RobotModel, flange: Flange) -> tuple[Array, Array]:
    """Return (rotation (3, 3), translation (3,)) of a flange in the frame of its carrier [m]."""
    carrier = next(
        f for f in _fixed_frames(robot)[1].values() if f.carrier == flange.carrier
    )
    turned = carrier.rotation.T @ flange.rotation
    moved = carrier.rotation.T @ (flange.translation - carrier.translation)
    # What is left of a distance after adding and subtracting it is no distance.
    return np.round(turned, 15), np.round(moved, 15)


_OBJECTS = {"site": mujoco.mjtObj.mjOBJ_SITE, "body": mujoco.mjtObj.mjOBJ_BODY}
_Frames = Mapping[str, Flange]
"""Name of what frames belong to, and the frames."""


def _fixed_frames(robot: RobotModel) -> tuple[_Frames, _Frames]:
    """Return all sites, and all bodies, that are fixed to the terminal body."""
    mj_model = robot.mj_model
    top = robot.body_id
    data = data_at_pose(mj_model, robot.reference_qpos)
    axes = data.xmat[top].reshape(3, 3)
    origin = data.xpos[top]
    fixed = {body.body_id: body.name for body in robot.bodies if body.welded}

    def frame(words: str, carrier: int, xmat: Array, xpos: Array) -> Flange:
        rotation = axes.T @ xmat.reshape(3, 3)
        translation = axes.T @ (xpos - origin)
        return Flange(words, rotation, translation, robot.body_name, carrier)

    sites = {}
    for i, carrier in enumerate(mj_model.site_bodyid.tolist()):
        name = mj_model.site(i).name
        if name and carrier in fixed:
            sites[name] = frame(
                f"site '{name}'", carrier, data.site_xmat[i], data.site_xpos[i]
            )
    return sites, {
        name: frame(f"body '{name}'", i, data.xmat[i], data.xpos[i])
        for i, name in fixed.items()
    }


def _likely(robot: RobotModel, sites: _Frames, bodies: _Frames) -> Flange:
    """Return the frame that is called like a flange, with a note on the choice."""
    terminal = bodies[robot.body_name]
    beside = {**bodies}
    del beside[robot.body_name]
    for pattern in _LIKELY:
        # A site counts more than a body.
        called = (
            [frames[n] for n in frames if pattern.fullmatch(n)]
            for frames in (sites, beside)
        )
        found = next(filter(None, called), [])
        if not found:
            continue
        poses = [
            np.column_stack((flange.rotation, flange.translation)) for flange in found
        ]
        if not np.allclose(poses, poses[0], rtol=0.0, atol=1e-9):
            listed = ", ".join(flange.name for flange in found)
            raise ModelError(
                f"{listed} could each be the flange; choose one by its name"
            )
        words = f"{found[0].name} was taken for the flange, because of its name"
        return replace(found[0], note=words + _DOUBT * (pattern is _LIKELY[-1]))
    listed = (
        ", ".join(flange.name for flange in (*sites.values(), *beside.values()))
        or "none"
    )
    note = (
        f"no site or body that is fixed to body '{robot.body_name}' is called like a flange, so "
        f"the frame of that body is taken; others that can be named: {listed}"
    )
    return replace(terminal, note=note)


def _from_numbers(robot: RobotModel, text: str) -> Flange:
    from scipy.spatial.transform import Rotation

    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (3, 6) or not np.all(np.isfinite(numbers)):
        wanted = "wanted are x,y,z in metres or x,y,z,roll,pitch,yaw with degrees"
        raise ModelError(f"flange {text}: neither a name nor numbers; {wanted}")
    translation = np.array(numbers[:3])
    if np.max(np.abs(translation)) > REACH:
        fault = f"more than {REACH:g} m away from body '{robot.body_name}'"
        raise ModelError(
            f"flange {text}: {fault}; the numbers are metres, not millimetres"
        )
    # Rz(yaw) Ry(pitch) Rx(roll), as in a URDF.
    turn = Rotation.from_euler(
        "xyz", numbers[3:] or [0.0] * 3, degrees=True
    ).as_matrix()
    return Flange(
        text.replace(" ", ""), turn, translation, robot.body_name, robot.body_id
    )
