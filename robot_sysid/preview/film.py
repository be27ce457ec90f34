"""Pictures of an arm without a screen, and films of a motion with its distance to all limits.

Pictures come from MuJoCo's renderer on EGL or OSMesa. A film shows the arm beside plots over time.
"""

from __future__ import annotations

import copy
import importlib.util
import os
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.errors import InputError
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.records import Array, Measurement, MotionPlan, RobotModel
from robot_sysid.records.file_access import atomic_files, require_writable
from robot_sysid.records.installation import install_hint
from robot_sysid.records.messages import Progress
from robot_sysid.simulation.playback import interpolate

Picture = NDArray[np.uint8]
"""Pixels (height, width, 3), red, green and blue."""
Colour = tuple[float, float, float, float]
"""Red, green, blue and opacity, from 0 to 1."""

NO_RENDERER = (
    "no pictures of the arm: MuJoCo finds neither EGL nor OSMesa here (Debian: apt-get install "
    "libegl1 libosmesa6); MUJOCO_GL chooses one"
)
NO_DISPLAY = "--view needs a display and there is none here; --video FILE.mp4 renders without one"
"""What is said where no window can be opened."""
_WHITE: Colour = (1.0, 1.0, 1.0, 1.0)
"""Colour of the background."""
_BONE: Colour = (0.55, 0.58, 0.62, 1.0)
"""Colour of the lines between joints of an arm without shapes."""
_PROBE = """
import importlib, importlib.util, sys, types
package = types.ModuleType("mujoco")
package.__path__ = importlib.util.find_spec("mujoco").submodule_search_locations
sys.modules["mujoco"] = package
context = importlib.import_module("mujoco." + sys.argv[1]).GLContext(64, 64)
context.make_current()
context.free()
"""
"""Program that opens a graphics context of the library that it is given, and may crash. It loads
that part of MuJoCo without the rest, which takes three times as long."""
RATE = 20.0
"""Pictures per second of a film."""
_MAX_CLEARANCE = 0.3
"""Clearance above which the plot stays level [m]: thirty times the least that a plan keeps."""
# Widths and heights of films are multiples of sixteen, which every player can show.
_SIZE = (640, 480)
"""Width and height of the picture of the arm [pixels]."""
_PANEL = 400
"""Width of the panel of plots beside the picture [pixels]."""
_GIF_STEP = 2
"""A .gif has every second picture only, as it compresses each picture by itself."""
_PAUSE = 1.0
"""Rest before the viewer plays the motion again [s]."""
_INK = "#1b1f24"
"""Colour of text in the panel of plots (RGB, hexadecimal)."""
_LINE = "#0b62a8"
"""Colour of a curve."""
_LIMIT = "#b02a1c"
"""Colour of the dashed line of a limit."""
_CURSOR = (176, 42, 28)
"""Red, green and blue (0 to 255) of the column of pixels at the present instant."""


@lru_cache(maxsize=1)
def renderer_library() -> str | None:
    """Return the graphics library that can draw without a screen, or None.

    Each is tried in a process of its own, which may crash. Where MUJOCO_GL names one, no other is
    tried ("disable" names none). The result is cached.
    """
    library = os.environ.get("MUJOCO_GL", "").lower().replace("disable", "")
    names = ["egl", "osmesa", "glfw"] if sys.platform.startswith("linux") else ["glfw"]
    if library:
        names = [library]
    for name in names:
        call = [sys.executable, "-c", _PROBE, name]
        try:
            probe = subprocess.run(call, capture_output=True, timeout=60.0)
        except (OSError, subprocess.TimeoutExpired):
            continue
        if probe.returncode == 0:
            return name
    return None


class Studio:
    """One arm in front of a plain background; a context manager.

    A picture is begun by ``pose``, may be added to, and is returned by ``render``.

    Args:
        robot: the arm; its compiled model is copied and stays as it is.
        width: width of the pictures [pixels].
        height: height of the pictures [pixels].

    Attributes:
        robot: as given.
        data: MuJoCo's data of the arm in the pose of the picture.
        scene: MuJoCo's scene: the geoms of the picture.
        camera: MuJoCo's camera, used from the next pose on.

    Raises:
        InputError: there is neither EGL nor OSMesa.
    """

    def __init__(self, robot: RobotModel, width: int, height: int) -> None:
        name = renderer_library()
        if name is None:
            raise InputError(NO_RENDERER)
        self.robot = robot
        self._model = copy.copy(robot.mj_model)
        self._model.vis.global_.offwidth = width
        self._model.vis.global_.offheight = height
        # MuJoCo made its own choice when it was imported, without trying whether it works here.
        chooser = sys.modules[mujoco.Renderer.__module__].gl_context
        chooser.GLContext = importlib.import_module(f"mujoco.{name}").GLContext
        self.data = mujoco.MjData(self._model)
        self._renderer = mujoco.Renderer(self._model, height, width)
        self.scene = self._renderer.scene
        self.camera = mujoco.MjvCamera()
        self.camera.azimuth = 135.0
        self.camera.elevation = -15.0
        self.pose(robot.reference)

    def __enter__(self) -> Studio:
        """Return the studio."""
        return self

    def __exit__(self, *failure: object) -> None:
        """Release the graphics memory."""
        # Early releases of MuJoCo 3 have no close; they release it when it is collected.
        getattr(self._renderer, "close", lambda: None)()

    def pose(self, q: Array) -> None:
        """Put the arm at chain positions q (n,) [rad or m] and start a new picture with it.

        The picture has a white wall behind the arm; what was added to the last one is gone.
        """
        self._set_positions(q)
        mujoco.mj_comPos(self._model, self.data)
        mujoco.mj_camlight(self._model, self.data)
        self._renderer.update_scene(self.data, self.camera)
        flags = mujoco.mjtRndFlag
        for flag in (flags.mjRND_SKYBOX, flags.mjRND_HAZE, flags.mjRND_SHADOW):
            self.scene.flags[flag] = False
        # A white wall closes the view; MuJoCo's own background is black.
        view_direction = self.scene.camera[0].forward
        distance = 4.0 * float(self.camera.distance)
        front = self.camera.lookat + (distance - 0.01) * view_direction
        back = self.camera.lookat + (distance + 0.01) * view_direction
        cylinder = mujoco.mjtGeom.mjGEOM_CYLINDER
        self._connect(cylinder, 4.0 * distance, _WHITE, front, back)
        self.scene.geoms[self.scene.ngeom - 1].emission = 1.0
        ids = [link.body_id for link in self.robot.links]
        if not np.any(np.isin(self._model.geom_bodyid, ids)):
            # A model without shapes to draw, as many URDF files: the links' origins are joined.
            capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
            for start, end in zip(self.data.xpos[ids[:-1]], self.data.xpos[ids[1:]]):
                self._connect(capsule, width=0.015, colour=_BONE, start=start, end=end)

    def _set_positions(self, q: Array) -> None:
        """Put the chain at positions q (n,), all other joints at the reference configuration."""
        self.data.qpos[:] = self.robot.reference_qpos
        self.data.qpos[self.robot.qpos_index] = q
        mujoco.mj_kinematics(self._model, self.data)

    def point_camera(self, target: Array, distance: float) -> None:
        """Point the camera at a target (3,) from a distance [m], beginning with the next pose."""
        self.camera.lookat = target
        self.camera.distance = distance

    def look_at_arm(self, postures: Array) -> None:
        """Point the camera so that the arm stays in the picture in all postures (N, n).

        Postures are chain positions [rad or m]; the arm is put into the first one.
        """
        points = np.concatenate([self._corners(q) for q in postures])
        low = np.min(points, axis=0)
        high = np.max(points, axis=0)
        distance = 0.75 * float(np.linalg.norm(high - low)) + 0.1
        self.point_camera(0.5 * (low + high), distance)
        self.pose(postures[0])

    def _corners(self, q: Array) -> Array:
        """Return points (m, 3) around the arm [m] at chain positions q (n,) [rad or m].

        They are the links' origins, and two opposite corners of a cube around each geom of the
        arm's tree of bodies. The arm is left at these positions.
        """
        self._set_positions(q)
        ids = [link.body_id for link in self.robot.links]
        is_arm = np.isin(self._model.body_rootid, self._model.body_rootid[ids])
        # A plane has no bounding sphere.
        geoms = is_arm[self._model.geom_bodyid] & (self._model.geom_rbound > 0.0)
        centres = self.data.geom_xpos[geoms]
        radii = self._model.geom_rbound[geoms][:, None]
        return np.concatenate((self.data.xpos[ids], centres - radii, centres + radii))

    def make_transparent(self, opacity: float) -> None:
        """Multiply the opacity of all geoms in the picture so far by ``opacity``, from 0 to 1.

        Planes (a floor) and the white wall, which emits light, stay as they are.
        """
        for geom in self.scene.geoms[: self.scene.ngeom]:
            if geom.type != mujoco.mjtGeom.mjGEOM_PLANE and geom.emission < 1.0:
                geom.rgba[3] *= opacity

    def add_ellipsoid(self, body: int, theta: Array, colour: Colour) -> bool:
        """Add the homogeneous ellipsoid of a body's mass and inertia, its centre as a dot.

        With half axes a, b, c it has I_xx = m (b^2 + c^2) / 5, so that
        a^2 = 5 (I_yy + I_zz - I_xx) / (2 m).

        Args:
            body: MuJoCo body id.
            theta: (10,) mass, first moment and inertia about the body's origin, in its frame.
            colour: colour of the ellipsoid; the dot has it too, without transparency.

        Returns:
            Whether there is such an ellipsoid: a theta of no possible body has none, and only its
            centre of mass is added.
        """
        mass, com, inertia = spatial.com_from_theta(theta)
        moments, axes = spatial.principal_axes(inertia)
        squares = 2.5 * (np.sum(moments) - 2.0 * moments) / max(mass, 1e-12)
        rotation = self.data.xmat[body].reshape(3, 3)
        centre = self.data.xpos[body] + rotation @ com
        is_possible = mass > 0.0 and bool(np.all(squares > 0.0))
        sphere = mujoco.mjtGeom.mjGEOM_SPHERE
        dot_colour = (*colour[:3], 1.0)
        self._add_geom(sphere, np.full(3, 0.008), centre, np.eye(3), dot_colour)
        if is_possible:
            ellipsoid = mujoco.mjtGeom.mjGEOM_ELLIPSOID
            half_axes = np.sqrt(squares)
            self._add_geom(ellipsoid, half_axes, centre, rotation @ axes, colour)
        return is_possible

    def _add_geom(
        self, shape: Any, size: Array, centre: Array, rotation: Array, colour: Colour
    ) -> None:
        """Add a geom to the picture; do nothing if the scene has no room.

        Args:
            shape: MuJoCo's ``mjtGeom``.
            size: (3,) half axes or half lengths [m], as MuJoCo takes them of this shape.
            centre: (3,) in the world frame [m].
            rotation: (3, 3) from the geom's axes to those of the world.
            colour: red, green, blue and opacity, 0 to 1.
        """
        if self.scene.ngeom >= self.scene.maxgeom:
            return
        geom = self.scene.geoms[self.scene.ngeom]
        rgba = np.array(colour, dtype=np.float32)
        matrix = np.ascontiguousarray(rotation).ravel()
        mujoco.mjv_initGeom(geom, shape, size, centre, matrix, rgba)
        self.scene.ngeom += 1

    def _connect(
        self, shape: Any, width: float, colour: Colour, start: Array, end: Array
    ) -> None:
        """Add a shape that reaches from one point to another one, if they differ and there is room.

        Args:
            shape: MuJoCo's ``mjtGeom``, a cylinder or a capsule.
            width: radius of the shape [m].
            colour: red, green, blue and opacity, 0 to 1.
            start: (3,) in the world frame [m].
            end: (3,) in the world frame [m].
        """
        if np.any(start != end) and self.scene.ngeom < self.scene.maxgeom:
            self._add_geom(shape, np.ones(3), start, np.eye(3), colour)
            geom = self.scene.geoms[self.scene.ngeom - 1]
            mujoco.mjv_connector(geom, shape, width, start, end)

    def render(self) -> Picture:
        """Return the picture (height, width, 3)."""
        return self._renderer.render()


@dataclass(frozen=True)
class Plot:
    """One quantity over time and its limit.

    Attributes:
        title: text above the plot, with the unit of the quantity.
        values: (T,) the quantity at T instants; NaN where it is unknown.
        limit: limit of the quantity, drawn as a dashed line, in the same unit.
    """

    title: str
    values: Array
    limit: float


@dataclass(frozen=True)
class Preview:
    """A motion to be shown, sampled at T pictures.

    Attributes:
        time: (T,) instants [s].
        q: (T, n) chain positions [rad or m].
        plots: quantities over the same instants, drawn beside the arm, the first one on top.
    """

    time: Array
    q: Array
    plots: tuple[Plot, ...]


def plan_preview(problem: ExcitationProblem, plan: MotionPlan) -> Preview:
    """Return the preview of a planned motion with its limits, clearance included.

    The clearance is the least distance of two bodies of the arm, or of one and an obstacle, beyond
    the distance that has to be kept.

    Args:
        problem: the arm, its limits and its obstacles.
        plan: the motion.
    """
    motion = plan.evaluate(_picture_times(plan.duration))
    limits = problem.limits
    torque = problem.torque(motion)
    distances = problem.obstacles.distances
    slacks = np.array([distances.slack_at(q)[0] for q in motion.q])
    clearance = np.minimum(slacks, _MAX_CLEARANCE)
    # Where there is nothing to collide with, the clearance is unknown.
    if not np.isfinite(distances.closest(motion.q[0]).distance):
        clearance *= np.nan
    half_range, speed, _, torque_limit = limits.largest
    signals = motion.q - limits.center, motion.qd, torque
    plots = _share_plots(signals, (half_range, speed, torque_limit))
    clearance_plot = Plot("clearance [mm]", 1000.0 * clearance, limit=0.0)
    return Preview(motion.time, motion.q, (*plots, clearance_plot))


def log_preview(robot: RobotModel, log: Measurement) -> Preview:
    """Return the preview of a recorded motion with position, speed and torque over the limits.

    Speeds that the log does not have are differences of its positions.
    """
    time = log.time - log.time[0]
    picture_times = _picture_times(float(time[-1]))
    q = interpolate(picture_times, time, log.q)
    tau = interpolate(picture_times, time, log.tau)
    if log.qd is None:
        qd = np.gradient(q, picture_times, axis=0)
    else:
        qd = interpolate(picture_times, time, log.qd)
    limits = robot.limits
    half_range = 0.5 * (limits.upper - limits.lower)
    # A joint without limits has its centre at zero; no position is a share of its range.
    has_range = np.isfinite(half_range)
    upper = np.where(has_range, limits.upper, 0.0)
    center = upper - np.where(has_range, half_range, 0.0)
    largest = (half_range, limits.velocity, limits.torque)
    plots = _share_plots((q - center, qd, tau), largest)
    return Preview(picture_times, q, tuple(plots))


def _picture_times(duration: float) -> Array:
    """Return the instants [s] of the pictures of a motion, evenly spaced, two at least."""
    return np.linspace(0.0, duration, max(2, round(duration * RATE) + 1))


def _share_plots(signals: Iterable[Array], limits: Iterable[Array]) -> Iterator[Plot]:
    """Yield plots of position, speed and torque (T, n) as shares of their limits (n,) [%].

    Each plot shows at every instant the largest share of any joint; NaN where no joint has a limit.

    Args:
        signals: position from the middle of its range, speed and torque, (T, n) each.
        limits: half the range, and the largest speed and torque, (n,) each; infinite for none.
    """
    titles = ("position [% of range]", "speed [% of limit]", "torque [% of limit]")
    for title, values, limit in zip(titles, signals, limits):
        shares = 100.0 * np.max(np.abs(values) / limit, axis=1)
        if not np.any(np.isfinite(limit)):
            shares *= np.nan
        yield Plot(title, shares, limit=100.0)


def require_film(path: Path) -> None:
    """Raise InputError where a film cannot be made and written to ``path``, before a long run."""
    libraries = ["matplotlib", "imageio"]
    if path.suffix.lower() == ".mp4":
        libraries.append("imageio_ffmpeg")
    missing = [name for name in libraries if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"--video {install_hint(', '.join(missing), 'report')}")
    if renderer_library() is None:
        raise InputError(NO_RENDERER)
    require_writable(path.absolute().parent)


def write_film(
    robot: RobotModel, preview: Preview, path: Path, progress: Progress
) -> None:
    """Write a motion as .mp4 or .gif; the file appears complete or not at all.

    Args:
        robot: the arm that moves.
        preview: its positions, and the quantities plotted beside the picture of the arm.
        path: file of the film; its ending chooses the format.
        progress: is advanced with each picture.
    """
    import imageio.v2 as imageio

    is_gif = path.suffix.lower() == ".gif"
    step = _GIF_STEP if is_gif else 1
    options: dict[str, Any] = {"fps": RATE, "codec": "libx264", "quality": 7}
    if is_gif:
        options = {"mode": "I", "duration": 1000.0 * step / RATE, "loop": 0}
    frames = range(0, len(preview.time), step)
    panel, columns = _draw_panel(preview)
    with atomic_files() as files, Studio(robot, *_SIZE) as studio:
        studio.look_at_arm(preview.q[:: max(1, len(preview.q) // 50)])
        writer: Any
        with imageio.get_writer(files.draft(path), **options) as writer:
            for count, k in enumerate(frames, start=1):
                studio.pose(preview.q[k])
                panel_with_cursor = panel.copy()
                panel_with_cursor[:, columns[k]] = _CURSOR
                writer.append_data(np.hstack((studio.render(), panel_with_cursor)))
                progress.advance("Rendering", done=count, total=len(frames), text="")


def png_bytes(picture: Picture) -> bytes:
    """Return the content of a PNG file of a picture; InputError if there is no imageio."""
    try:
        import imageio.v2 as imageio
    except ImportError:
        hint = install_hint("imageio", "report")
        raise InputError(f"a picture of the arm {hint}") from None
    content: bytes = imageio.imwrite("<bytes>", picture, format="png")
    return content


def _draw_panel(preview: Preview) -> tuple[Picture, NDArray[np.int64]]:
    """Return a preview's plots as a picture, and its column of pixels (T,) at each instant.

    The plots lie below each other and share the time axis.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    size = (_PANEL / 100, _SIZE[1] / 100)
    figure = Figure(figsize=size, dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(len(preview.plots), 1, sharex=True)
    for ax, plot in zip(axes, preview.plots):
        if np.any(np.isfinite(plot.values)):
            ax.plot(preview.time, plot.values, color=_LINE, lw=1.2)
        else:
            text = "no limit in the model"
            ax.text(0.5, 0.5, text, transform=ax.transAxes, ha="center", fontsize=8)
        ax.axhline(plot.limit, color=_LIMIT, ls="--", lw=1.0)
        ax.set_title(plot.title, fontsize=8, loc="left", color=_INK)
        ax.tick_params(labelsize=7, colors=_INK)
        ax.margins(x=0.0)
        ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
    axes[-1].set_xlabel("time [s]", fontsize=8, color=_INK)
    canvas.draw()
    # Pixels from the left of the points (time, 0) of the lowest plot; all share its time axis.
    points = np.column_stack((preview.time, 0.0 * preview.time))
    pixels = axes[-1].transData.transform(points)[:, 0]
    columns = np.clip(np.round(pixels).astype(np.int64), 0, _PANEL - 1)
    return np.array(canvas.buffer_rgba())[..., :3], columns


def require_display() -> None:
    """Raise InputError where no window can be opened; called before a long run."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform.startswith("linux") and not display:
        raise InputError(NO_DISPLAY)


def play_in_viewer(robot: RobotModel, preview: Preview) -> None:
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
            elapsed = time.monotonic() - start
            if elapsed > preview.time[-1] + _PAUSE:
                start = time.monotonic()
                continue
            q = interpolate(elapsed, preview.time, preview.q)
            with window.lock():
                data.qpos[robot.qpos_index] = q
                mujoco.mj_forward(robot.mj_model, data)
            window.sync()
            time.sleep(0.01)
