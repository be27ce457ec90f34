"""The flange: the frame, fixed to the terminal body, in which controllers want a payload.

A site or a body of the model, or plain numbers. What moves against the terminal body is no flange.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from robot_sysid.dynamics.kinematics import posed
from robot_sysid.errors import ModelError
from robot_sysid.model.chain import body_label
from robot_sysid.model.inertia import subtree_bodies
from robot_sysid.records import Array, Flange, RobotModel

# Names by which models call the frame that a tool is bolted to, the surest first.
_LIKELY = tuple(
    re.compile(rf"(?:.*[/_.:-])?(?:{words})(?:[_-](?:site|frame|link))?", re.IGNORECASE)
    for words in ("attachment", "(?:tool_?)?flange", "tool0", "eef?|end_?effector")
)
_DOUBT = "; an end effector's frame may also be the tip of the tool: check"
REACH = 3.0
"""Distance of a flange from its link beyond which the numbers must be millimetres [m]."""


def find_flange(robot: RobotModel, text: str | None = None) -> Flange:
    """Return the frame that a user named, or the one that looks like a flange.

    Args:
        text: name of a site or body fixed to the terminal body; "x,y,z" in metres or
            "x,y,z,roll,pitch,yaw" with degrees about the fixed axes x, y, z, in the terminal body's
            frame; None for the site or body that is called like a flange, else the terminal body.

    Raises:
        ModelError: there is no such frame (lists those there are), it moves against the terminal
            body, several could be meant, or the numbers are none.
    """
    frames = tuple(_fixed_frames(robot))
    if text is None:
        chosen, note = _likely(robot, frames)
        return replace(chosen, note=note)
    wanted = text.strip()
    for _, name, flange in frames:
        if name == wanted:
            return flange
    if "," in wanted:
        return _from_numbers(robot, wanted)
    raise ModelError(_unknown(robot, wanted, frames))


def place_in_carrier(robot: RobotModel, flange: Flange) -> tuple[Array, Array]:
    """Return (rotation (3, 3), translation (3,)) of a flange in the frame of its carrier [m]."""
    carrier = _frame_of(flange.carrier, _fixed_frames(robot))
    turned = carrier.rotation.T @ flange.rotation
    moved = carrier.rotation.T @ (flange.translation - carrier.translation)
    # What is left of a distance after adding and subtracting it is no distance.
    return np.round(turned, 15), np.round(moved, 15)


_Frame = tuple[str, str, Flange]
"""Kind and name of what a frame belongs to, and the frame."""


def _fixed_frames(robot: RobotModel) -> Iterator[_Frame]:
    """Yield all sites and bodies that are fixed to the terminal body, sites first."""
    mj_model, top = robot.mj_model, robot.body_id
    data = posed(mj_model, robot.reference_qpos)
    axes, origin = data.xmat[top].reshape(3, 3), data.xpos[top]
    bodies = subtree_bodies(mj_model, robot.reference_qpos, top)
    fixed = {body.body_id: body.name for body in bodies if body.welded}

    def frame(kind: str, name: str, carrier: int, xmat: Array, xpos: Array) -> _Frame:
        rotation, translation = axes.T @ xmat.reshape(3, 3), axes.T @ (xpos - origin)
        words = f"{kind} '{name}'"
        return kind, name, Flange(words, rotation, translation, robot.body_name, carrier)

    for name, site in _sites(mj_model).items():
        carrier = int(mj_model.site_bodyid[site])
        if carrier in fixed:
            yield frame("site", name, carrier, data.site_xmat[site], data.site_xpos[site])
    for i, name in fixed.items():
        yield frame("body", name, i, data.xmat[i], data.xpos[i])


def _frame_of(body: int, frames: Iterable[_Frame]) -> Flange:
    return next(f for kind, _, f in frames if kind == "body" and f.carrier == body)


def _is_at(ours: Flange, theirs: Flange) -> bool:
    pairs = ((ours.rotation, theirs.rotation), (ours.translation, theirs.translation))
    return all(np.allclose(*pair, rtol=0.0, atol=1e-9) for pair in pairs)


def _sites(mj_model: Any) -> Mapping[str, int]:
    kind = int(mujoco.mjtObj.mjOBJ_SITE)
    names = [mujoco.mj_id2name(mj_model, kind, i) for i in range(mj_model.nsite)]
    return {name: i for i, name in enumerate(names) if name}


def _likely(robot: RobotModel, frames: tuple[_Frame, ...]) -> tuple[Flange, str]:
    """Return the frame that is called like a flange, and a sentence on the choice."""
    terminal = _frame_of(robot.body_id, frames)
    others = [each for each in frames if each[2] is not terminal]
    for pattern in _LIKELY:
        called = [each for each in others if pattern.fullmatch(each[1])]
        sites = [flange for kind, _, flange in called if kind == "site"]
        found = sites or [flange for _, _, flange in called]
        if found and not all(_is_at(flange, found[0]) for flange in found):
            listed = ", ".join(flange.name for flange in found)
            raise ModelError(f"{listed} could each be the flange; choose one by its name")
        if found:
            words = f"{found[0].name} was taken for the flange, because of its name"
            return found[0], words + _DOUBT * (pattern is _LIKELY[-1])
    listed = ", ".join(flange.name for _, _, flange in others) or "none"
    return terminal, (
        f"no site or body that is fixed to body '{robot.body_name}' is called like a flange, so "
        f"the frame of that body is taken; others that can be named: {listed}"
    )


def _from_numbers(robot: RobotModel, text: str) -> Flange:
    from scipy.spatial.transform import Rotation

    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (3, 6) or not np.all(np.isfinite(numbers)):
        raise ModelError(
            f"flange {text}: neither a name nor numbers; wanted are x,y,z in metres or "
            "x,y,z,roll,pitch,yaw with degrees, in the terminal body's frame"
        )
    translation = np.array(numbers[:3])
    if np.max(np.abs(translation)) > REACH:
        raise ModelError(
            f"flange {text}: more than {REACH:g} m away from body '{robot.body_name}'; the "
            "numbers are metres, not millimetres"
        )
    # Rz(yaw) Ry(pitch) Rx(roll), as in a URDF.
    turn = Rotation.from_euler("xyz", numbers[3:] or [0.0] * 3, degrees=True).as_matrix()
    return Flange(text.replace(" ", ""), turn, translation, robot.body_name, robot.body_id)


def _unknown(robot: RobotModel, name: str, frames: tuple[_Frame, ...]) -> str:
    mj_model = robot.mj_model
    bodies = {body_label(mj_model, i) for i in range(mj_model.nbody)}
    known = (
        f"fixed to body '{robot.body_name}' are: {', '.join(flange.name for *_, flange in frames)}"
    )
    if name in bodies or name in _sites(mj_model):
        kind = "body" if name in bodies else "site"
        return (
            f"flange {name}: {kind} '{name}' moves against the terminal body, or stands before "
            f"it, so it is no flange; {known}; or give x,y,z in metres"
        )
    return f"flange {name}: no such site or body; {known}; or give x,y,z in metres"
