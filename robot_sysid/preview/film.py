"""A motion as a film, with how near it comes to its limits; or in MuJoCo's viewer."""

from __future__ import annotations

import importlib.util
import os
import sys
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.preview.motion import RATE, Shown, at_times
from robot_sysid.preview.studio import NO_RENDERER, Colour, Picture, Studio, add_ghost, backend
from robot_sysid.records import RobotModel
from robot_sysid.records.atomic_files import require_writable, whole_files
from robot_sysid.records.progress import Progress

# Multiples of sixteen, which every player can show.
_SIZE, _PANEL = (640, 480), 400
_GIF_STEP = 2
"""Every which picture goes into a .gif: half of them, for it packs each one for itself."""
GHOST: Colour = (0.90, 0.45, 0.05, 0.45)
NO_DISPLAY = "--view needs a display and there is none here; --video FILE.mp4 renders without one"
_PAUSE = 1.0
"""Rest before the viewer plays the motion again [s]."""
_INK, _LINE, _LIMIT, _CURSOR = "#1b1f24", "#0b62a8", "#b02a1c", (176, 42, 28)


def require_film(path: Path) -> None:
    """Raise InputError where a film cannot be made; asked before a long run."""
    needed = ["matplotlib", "imageio"]
    needed += ["imageio_ffmpeg"] if path.suffix.lower() == ".mp4" else []
    missing = [name for name in needed if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f'--video needs {", ".join(missing)}; install with: pip install "robot-sysid[report]"'
        )
    if backend() is None:
        raise InputError(NO_RENDERER)
    require_writable(path.absolute().parent)


def write_film(robot: RobotModel, shown: Shown, path: Path, progress: Progress) -> None:
    """Write a motion as .mp4 or .gif; it appears whole or not at all."""
    import imageio.v2 as imageio

    is_gif = path.suffix.lower() == ".gif"
    step = _GIF_STEP if is_gif else 1
    options: dict[str, Any] = {"fps": RATE, "codec": "libx264", "quality": 7}
    if is_gif:
        options = {"mode": "I", "duration": 1000.0 * step / RATE, "loop": 0}
    frames, (strips, columns) = range(0, len(shown.time), step), _strips(shown)
    no_ghost = np.full_like(shown.q[0], np.nan)
    with whole_files() as files, Studio(robot, *_SIZE) as studio:
        studio.look_at_arm(shown.q[:: max(1, len(shown.q) // 50)])
        writer: Any
        with imageio.get_writer(files.draft(path), **options) as writer:
            for done, k in enumerate(frames, start=1):
                studio.pose(shown.q[k])
                ghost = no_ghost if shown.ghost is None else shown.ghost[k]
                add_ghost(studio.robot, ghost, GHOST, studio.scene)
                beside = strips.copy()
                beside[:, columns[k]] = _CURSOR
                writer.append_data(np.hstack((studio.picture(), beside)))
                progress.advance("Rendering", done, len(frames), "")


def _strips(shown: Shown) -> tuple[Picture, NDArray[np.int64]]:
    """Return the strips of a motion as a picture, and the column in it of each instant (T,)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_PANEL / 100, _SIZE[1] / 100), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(len(shown.strips), 1, sharex=True)
    for ax, strip in zip(axes, shown.strips):
        if np.any(np.isfinite(strip.values)):
            ax.plot(shown.time, strip.values, color=_LINE, lw=1.2)
        else:
            told = {"transform": ax.transAxes, "ha": "center", "fontsize": 8}
            ax.text(0.5, 0.5, "no limit in the model", **told)
        ax.axhline(strip.limit, color=_LIMIT, ls="--", lw=1.0)
        ax.set_title(strip.title, fontsize=8, loc="left", color=_INK)
        ax.tick_params(labelsize=7, colors=_INK)
        ax.margins(x=0.0)
        ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
    axes[-1].set_xlabel("time [s]", fontsize=8, color=_INK)
    canvas.draw()
    places = axes[-1].transData.transform(np.column_stack((shown.time, 0.0 * shown.time)))[:, 0]
    columns = np.clip(np.round(places).astype(np.int64), 0, _PANEL - 1)
    return np.array(canvas.buffer_rgba())[..., :3], columns


def require_display() -> None:
    """Raise InputError where no window can be opened; asked before a long run."""
    there = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform.startswith("linux") and not there:
        raise InputError(NO_DISPLAY)


def view(robot: RobotModel, shown: Shown) -> None:
    """Play a motion until the window is closed; InputError where none can be opened."""
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
        q = at_times(now, shown.time, shown.q)
        with window.lock():
            data.qpos[robot.qpos_index] = q
            mujoco.mj_forward(robot.mj_model, data)
            if shown.ghost is not None and window.user_scn is not None:
                window.user_scn.ngeom = 0
                add_ghost(robot, at_times(now, shown.time, shown.ghost), GHOST, window.user_scn)
        window.sync()
        time.sleep(0.01)
