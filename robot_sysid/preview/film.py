"""A motion with how near it comes to its limits, as a film; or in MuJoCo's viewer."""

from __future__ import annotations

import importlib.util
import os
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.preview.studio import NO_RENDERER, Picture, Studio, backend
from robot_sysid.records import Array, Measurement, MotionPlan, RobotModel
from robot_sysid.records.atomic_files import require_writable, whole_files
from robot_sysid.records.progress import Progress
from robot_sysid.simulation.playback import interpolate

RATE = 20.0
"""Pictures per second."""
_FARTHEST = 0.3
"""Clearance above which it is all the same [m]: thirty times the least that a plan keeps."""


@dataclass(frozen=True)
class Strip:
    """One quantity over time (T,), NaN where nothing is known, and what it has to keep."""

    title: str
    values: Array
    limit: float


@dataclass(frozen=True)
class Shown:
    """What is shown of a motion: T pictures of positions (T, n), and what is drawn over time."""

    time: Array
    q: Array
    strips: tuple[Strip, ...]


def shown_plan(problem: ExcitationProblem, plan: MotionPlan) -> Shown:
    """Return a planned motion with its limits."""
    motion = plan.evaluate(np.linspace(0.0, plan.duration, _count(plan.duration)))
    limits = problem.limits
    largest = problem.limits.largest
    torque = problem.torque(motion)
    clearances = problem.obstacles.distances
    near = np.array([min(clearances.slack_at(q)[0], _FARTHEST) for q in motion.q])
    known = (
        near if np.isfinite(clearances.closest(motion.q[0]).distance) else near * np.nan
    )
    shares = _shares((motion.q - limits.center, motion.qd, torque), largest[[0, 1, 3]])
    strips = (*shares, Strip("clearance [mm]", 1000.0 * known, 0.0))
    return Shown(motion.time, motion.q, strips)


def shown_log(robot: RobotModel, log: Measurement) -> Shown:
    """Return the motion of a log with the model's limits."""
    time = log.time - log.time[0]
    at = np.linspace(0.0, float(time[-1]), _count(float(time[-1])))
    q, tau = (interpolate(at, time, values) for values in (log.q, log.tau))
    qd = np.gradient(q, at, axis=0) if log.qd is None else interpolate(at, time, log.qd)
    limits = robot.limits
    span = 0.5 * (limits.upper - limits.lower)
    center = np.where(np.isfinite(span), limits.upper, 0.0) - np.where(
        np.isfinite(span), span, 0.0
    )
    largest = (span, limits.velocity, limits.torque)
    return Shown(at, q, tuple(_shares((q - center, qd, tau), largest)))


def _count(duration: float) -> int:
    return max(2, round(duration * RATE) + 1)


def _shares(signals: Iterable[Array], limits: Iterable[Array]) -> Iterator[Strip]:
    """Yield each signal's (T, n) largest share of its limit (n,) [%], NaN without limits."""
    titles = ("position [% of range]", "speed [% of limit]", "torque [% of limit]")
    for title, values, limit in zip(titles, signals, limits):
        shares = 100.0 * np.max(np.abs(values) / limit, axis=1)
        yield Strip(
            title, shares if np.any(np.isfinite(limit)) else shares * np.nan, 100.0
        )


# Multiples of sixteen, which every player can show.
_SIZE = (640, 480)
_PANEL = 400
_GIF_STEP = 2
"""Every which picture goes into a .gif: half of them, for it packs each one for itself."""
NO_DISPLAY = "--view needs a display and there is none here; --video FILE.mp4 renders without one"
_PAUSE = 1.0
"""Rest before the viewer plays the motion again [s]."""
_INK = "#1b1f24"
_LINE = "#0b62a8"
_LIMIT = "#b02a1c"
_CURSOR = (176, 42, 28)


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
    frames = range(0, len(shown.time), step)
    (strips, columns) = _strips(shown)
    with whole_files() as files, Studio(robot, *_SIZE) as studio:
        studio.look_at_arm(shown.q[:: max(1, len(shown.q) // 50)])
        writer: Any
        with imageio.get_writer(files.draft(path), **options) as writer:
            for done, k in enumerate(frames, start=1):
                studio.pose(shown.q[k])
                beside = strips.copy()
                beside[:, columns[k]] = _CURSOR
                writer.append_data(np.hstack((studio.picture(), beside)))
                progress.advance("Rendering", done, len(frames), "")


def _strips(shown: Shown) -> tuple[Picture, NDArray[np.int64]]:
    """Return the strips of a motion as a picture, and the column in it of each instant (T,)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(
        figsize=(_PANEL / 100, _SIZE[1] / 100), dpi=100, layout="constrained"
    )
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
    places = axes[-1].transData.transform(
        np.column_stack((shown.time, 0.0 * shown.time))
    )[:, 0]
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
        q = interpolate(now, shown.time, shown.q)
        with window.lock():
            data.qpos[robot.qpos_index] = q
            mujoco.mj_forward(robot.mj_model, data)
        window.sync()
        time.sleep(0.01)
