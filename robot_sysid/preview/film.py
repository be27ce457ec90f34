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

from robot_sysid.errors import InputError
from robot_sysid.preview.motion import RATE, Shown, at_times
from robot_sysid.preview.studio import NO_RENDERER, Colour, Picture, Studio, add_ghost, backend
from robot_sysid.records import RobotModel
from robot_sysid.records.atomic_files import require_writable, whole_files
from robot_sysid.records.progress import Progress

# Multiples of sixteen, which every player can show.
_SIZE, _PANEL = (640, 480), 400
_GIF_STEP = 2
GHOST: Colour = (0.90, 0.45, 0.05, 0.45)
NO_DISPLAY = "--view needs a display and there is none here; --video FILE.mp4 renders without one"
_PAUSE = 1.0
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
    step = _GIF_STEP if path.suffix.lower() == ".gif" else 1
    frames = range(0, len(shown.time), step)
    panel = Panel(shown)
    with whole_files() as files, Studio(robot, *_SIZE) as studio:
        studio.look_at_arm(shown.q[:: max(1, len(shown.q) // 50)])
        with _writer(files.draft(path), RATE / step) as writer:
            for done, k in enumerate(frames, start=1):
                writer.append_data(np.hstack((_arm(studio, shown, k), panel.at(k))))
                progress.advance("Rendering", done, len(frames), "")


def _writer(path: Path, rate: float) -> Any:
    import imageio.v2 as imageio

    if path.suffix.lower() == ".gif":
        return imageio.get_writer(path, mode="I", duration=1000.0 / rate, loop=0)
    return imageio.get_writer(path, fps=rate, codec="libx264", quality=7)


def _arm(studio: Studio, shown: Shown, k: int) -> Picture:
    studio.pose(shown.q[k])
    if shown.ghost is not None:
        add_ghost(studio.robot, shown.ghost[k], GHOST, studio.scene)
    return studio.picture()


class Panel:
    """The strips of a motion, drawn once; a line goes through them as time goes by."""

    def __init__(self, shown: Shown) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(_PANEL / 100, _SIZE[1] / 100), dpi=100, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        axes = figure.subplots(len(shown.strips), 1, sharex=True)
        for ax, strip in zip(axes, shown.strips):
            _draw(ax, shown, strip)
        axes[-1].set_xlabel("time [s]", fontsize=8, color=_INK)
        canvas.draw()
        self._picture = np.array(canvas.buffer_rgba())[..., :3]
        ends = [axes[-1].transData.transform((t, 0.0))[0] for t in shown.time]
        self._columns = np.clip(np.round(ends).astype(int), 0, _PANEL - 1)

    def at(self, k: int) -> Picture:
        """Return the panel (height, width, 3) at one picture's time."""
        picture = self._picture.copy()
        picture[:, self._columns[k]] = _CURSOR
        return picture


def _draw(ax: Any, shown: Shown, strip: Any) -> None:
    if np.any(np.isfinite(strip.values)):
        ax.plot(shown.time, strip.values, color=_LINE, lw=1.2)
    else:
        ax.text(0.5, 0.5, "no limit in the model", transform=ax.transAxes, ha="center", fontsize=8)
    if strip.limit is not None:
        ax.axhline(strip.limit, color=_LIMIT, ls="--", lw=1.0)
    ax.set_title(strip.title, fontsize=8, loc="left", color=_INK)
    ax.tick_params(labelsize=7, colors=_INK)
    ax.margins(x=0.0)
    ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))


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
