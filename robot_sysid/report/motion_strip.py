"""Still pictures of the arm along a recorded motion, side by side."""

from __future__ import annotations

import numpy as np

from robot_sysid.records import Array, RobotModel
from robot_sysid.report.drawing import Figure
from robot_sysid.report.studio import Studio, png_bytes

_POSES = 6
"""Number of pictures in a strip."""
_SIZE = (300, 300)
"""Width and height of one of them [pixels]."""
_FARTHER = 1.35
"""Distance of the camera over the one at which the arm fits into a picture that is wider than
high."""


def motion_strip(robot: RobotModel, time: Array, q: Array) -> Figure:
    """Return the figure of the arm at instants evenly spread over a motion.

    SysidError if there is no graphics library to render with.

    Args:
        robot: the arm that moves.
        time: (K,) instants [s].
        q: (K, n) positions of its joints [rad or m].
    """
    # Most motions end where they begin.
    shown = np.linspace(0, len(time), _POSES, endpoint=False).astype(int)
    poses = q[shown].astype(float)
    pictures = []
    with Studio(robot, *_SIZE) as studio:
        studio.look_at_arm(poses)
        studio.camera.distance *= _FARTHER
        for pose in poses:
            studio.pose(pose)
            pictures.append(studio.render())
    instants = ", ".join(f"{instant:.1f}" for instant in time[shown])
    caption = f"Six postures along the motion, from left to right at {instants} s."
    return Figure(caption, png=png_bytes(np.hstack(pictures)))
