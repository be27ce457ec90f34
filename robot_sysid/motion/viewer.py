"""A motion in MuJoCo's viewer."""

from __future__ import annotations

import os
import sys
import time

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import MotionPlan, RobotModel

_PAUSE = 1.0
"""Rest before the motion is played again [s]."""


def require_display() -> None:
    """Raise InputError where no window can be opened; called before a long run."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform.startswith("linux") and not display:
        raise InputError("--view needs a display and there is none here; leave it out")


def play_in_viewer(robot: RobotModel, plan: MotionPlan) -> None:
    """Play a motion again and again until the window is closed; InputError where none opens.

    The arm's compiled model is shown, not changed; joints outside the chain stay at the reference.
    """
    import mujoco.viewer

    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = robot.reference_qpos
    try:
        window = mujoco.viewer.launch_passive(robot.mj_model, data)
    except RuntimeError as error:
        raise InputError(f"the viewer does not start: {error}") from None
    start = time.monotonic()
    with window:
        while window.is_running():
            elapsed = (time.monotonic() - start) % (plan.duration + _PAUSE)
            instant = min(elapsed, plan.duration)
            with window.lock():
                data.qpos[robot.qpos_index] = plan.evaluate(np.array([instant])).q[0]
                mujoco.mj_forward(robot.mj_model, data)
            window.sync()
            time.sleep(0.01)
