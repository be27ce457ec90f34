"""A motion in MuJoCo's viewer, again and again until its window is closed."""

from __future__ import annotations

import os
import sys
import time
from typing import Any

import mujoco
import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.preview.film import GHOST
from robot_sysid.preview.motion import Shown
from robot_sysid.records import Array, RobotModel

NO_DISPLAY = "--view needs a display and there is none here; --video FILE.mp4 renders without one"
_PAUSE = 1.0


def require_display() -> None:
    """Raise InputError where no window can be opened; asked before a long run."""
    there = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform.startswith("linux") and not there:
        raise InputError(NO_DISPLAY)


def view(robot: RobotModel, shown: Shown) -> None:
    """Play a motion until the window is closed.

    Raises:
        InputError: no window can be opened.
    """
    import mujoco.viewer

    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = robot.reference_qpos
    try:
        window = mujoco.viewer.launch_passive(robot.mj_model, data)
    except RuntimeError as error:
        raise InputError(f"the viewer does not start: {error}") from None
    with window:
        while window.is_running():
            _play_once(robot, shown, data, window)


def _play_once(robot: RobotModel, shown: Shown, data: Any, window: Any) -> None:
    began = time.monotonic()
    while window.is_running():
        now = time.monotonic() - began
        if now > shown.time[-1] + _PAUSE:
            return
        q = _at(shown.time, shown.q, now)
        with window.lock():
            data.qpos[robot.qpos_index] = q
            mujoco.mj_forward(robot.mj_model, data)
            if shown.ghost is not None and window.user_scn is not None:
                _add_ghost(robot, _at(shown.time, shown.ghost, now), window.user_scn)
        window.sync()
        time.sleep(0.01)


def _at(time_axis: Array, values: Array, now: float) -> Array:
    return np.array([np.interp(now, time_axis, column) for column in values.T])


def _add_ghost(robot: RobotModel, q: Array, scene: Any) -> None:
    """Draw the arm once more, where it was measured."""
    scene.ngeom = 0
    if not np.all(np.isfinite(q)):
        return
    ghost = mujoco.MjData(robot.mj_model)
    ghost.qpos[:] = robot.reference_qpos
    ghost.qpos[robot.qpos_index] = q
    mujoco.mj_kinematics(robot.mj_model, ghost)
    options, nothing = mujoco.MjvOption(), mujoco.MjvPerturb()
    moving = mujoco.mjtCatBit.mjCAT_DYNAMIC
    mujoco.mjv_addGeoms(robot.mj_model, ghost, options, nothing, moving, scene)
    for geom in scene.geoms[: scene.ngeom]:
        geom.rgba[:] = GHOST
