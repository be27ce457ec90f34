"""A motion as a film, with how near it comes to its limits; or in MuJoCo's viewer."""

from __future__ import annotations

import copy
import importlib.util
import os
import subprocess
import sys
import time
from functools import lru_cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.preview.motion import RATE, Shown, at_times
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.atomic_files import require_writable, whole_files
from robot_sysid.records.progress import Progress

Picture = NDArray[np.uint8]
Colour = tuple[float, float, float, float]
# Multiples of sixteen, which every player can show.
_SIZE, _PANEL = (640, 480), 400
_GIF_STEP = 2
"""Every which picture goes into a .gif: half of them, for it packs each one for itself."""
NO_DISPLAY = "--view needs a display and there is none here; --video FILE.mp4 renders without one"
_PAUSE = 1.0
"""Rest before the viewer plays the motion again [s]."""
_INK, _LINE, _LIMIT, _CURSOR = "#1b1f24", "#0b62a8", "#b02a1c", (176, 42, 28)


NO_RENDERER = (
    "no pictures of the arm: MuJoCo finds neither EGL nor OSMesa here (Debian: apt-get install "
    "libegl1 libosmesa6); MUJOCO_GL chooses one"
)
_WHITE: Colour = (1.0, 1.0, 1.0, 1.0)
_BONE: Colour = (0.55, 0.58, 0.62, 1.0)
_PROBE = (
    "import importlib, sys; "
    "c = importlib.import_module('mujoco.' + sys.argv[1]).GLContext(64, 64); "
    "c.make_current(); c.free()"
)


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


@lru_cache(maxsize=1)
def backend() -> str | None:
    """Return what can draw without a screen, or None: tried in a process of its own, which may die.

    MUJOCO_GL, where it is set, is the only one tried.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower()
    usual = ("egl", "osmesa", "glfw") if sys.platform.startswith("linux") else ("glfw",)
    for name in (chosen,) if chosen else usual:
        call = [sys.executable, "-c", _PROBE, name]
        try:
            tried = subprocess.run(call, capture_output=True, timeout=60.0)
        except (OSError, subprocess.TimeoutExpired):
            continue
        if tried.returncode == 0:
            return name
    return None


class Studio:
    """One arm in front of a plain background; a context manager. Needs EGL or OSMesa."""

    def __init__(self, robot: RobotModel, width: int, height: int) -> None:
        name = backend()
        if name is None:
            raise InputError(NO_RENDERER)
        self.robot = robot
        self._model = copy.copy(robot.mj_model)
        shown = self._model.vis.global_
        shown.offwidth, shown.offheight = width, height
        # MuJoCo has made its own choice when it was imported, without trying what works here.
        chooser = sys.modules[mujoco.Renderer.__module__].gl_context
        chooser.GLContext = importlib.import_module(f"mujoco.{name}").GLContext
        self.data = mujoco.MjData(self._model)
        self._renderer = mujoco.Renderer(self._model, height, width)
        self.scene, self.camera = self._renderer.scene, mujoco.MjvCamera()
        self.camera.azimuth, self.camera.elevation = 135.0, -15.0
        self.pose(robot.reference)

    def __enter__(self) -> Studio:
        """Return itself."""
        return self

    def __exit__(self, *failure: object) -> None:
        """Let go of the graphics memory."""
        # Early releases of MuJoCo 3 have no close; they let go when it is collected.
        getattr(self._renderer, "close", lambda: None)()

    def pose(self, q: Array) -> None:
        """Put the arm at chain positions q (n,) [rad] and start a new picture with it."""
        self.data.qpos[:] = self.robot.reference_qpos
        self.data.qpos[self.robot.qpos_index] = q
        mujoco.mj_kinematics(self._model, self.data)
        mujoco.mj_comPos(self._model, self.data)
        mujoco.mj_camlight(self._model, self.data)
        self._renderer.update_scene(self.data, self.camera)
        flags = mujoco.mjtRndFlag
        for flag in (flags.mjRND_SKYBOX, flags.mjRND_HAZE, flags.mjRND_SHADOW):
            self.scene.flags[flag] = False
        # A white wall closes the view; MuJoCo's own background is black.
        ahead, far = self.scene.camera[0].forward, 4.0 * float(self.camera.distance)
        near, behind = (self.camera.lookat + (far + side) * ahead for side in (-0.01, 0.01))
        self._connect(mujoco.mjtGeom.mjGEOM_CYLINDER, 4.0 * far, _WHITE, near, behind)
        self.scene.geoms[self.scene.ngeom - 1].emission = 1.0
        ids = [link.body_id for link in self.robot.links]
        if not np.any(np.isin(self._model.geom_bodyid, ids)):
            # A model without shapes to show, as many URDF files: the links' origins are joined.
            for start, end in zip(self.data.xpos[ids[:-1]], self.data.xpos[ids[1:]]):
                self._connect(mujoco.mjtGeom.mjGEOM_CAPSULE, 0.015, _BONE, start, end)

    def look_at_arm(self, postures: Array) -> None:
        """Point the camera so that the arm stays in the picture in all postures (N, n)."""
        points = np.concatenate([self._corners(q) for q in postures])
        low, high = np.min(points, axis=0), np.max(points, axis=0)
        self.camera.lookat = 0.5 * (low + high)
        self.camera.distance = 0.75 * float(np.linalg.norm(high - low)) + 0.1
        self.pose(postures[0])

    def _corners(self, q: Array) -> Array:
        """Return points (m, 3) around the geoms of the chain's bodies in a posture [m]."""
        self.data.qpos[self.robot.qpos_index] = q
        mujoco.mj_kinematics(self._model, self.data)
        ids = [link.body_id for link in self.robot.links]
        moving = np.isin(self._model.body_rootid, self._model.body_rootid[ids])
        geoms = moving[self._model.geom_bodyid] & (self._model.geom_rbound > 0.0)
        centres = self.data.geom_xpos[geoms]
        radii = self._model.geom_rbound[geoms][:, None]
        return np.concatenate((self.data.xpos[ids], centres - radii, centres + radii))

    def _connect(self, kind: Any, width: float, colour: Colour, start: Array, end: Array) -> None:
        """Add a shape that reaches from one place (3,) to another one, if they differ."""
        if np.all(start == end) or self.scene.ngeom >= self.scene.maxgeom:
            return
        geom, rgba = self.scene.geoms[self.scene.ngeom], np.array(colour, dtype=np.float32)
        mujoco.mjv_initGeom(geom, kind, np.ones(3), start, np.eye(3).ravel(), rgba)
        mujoco.mjv_connector(geom, kind, width, start, end)
        self.scene.ngeom += 1

    def picture(self) -> Picture:
        """Return the picture (height, width, 3)."""
        return self._renderer.render()


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
        with window.lock():
            data.qpos[robot.qpos_index] = at_times(now, shown.time, shown.q)
            mujoco.mj_forward(robot.mj_model, data)
        window.sync()
        time.sleep(0.01)
