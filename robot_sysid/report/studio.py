"""Pictures of an arm without a screen, from MuJoCo's renderer on EGL or OSMesa."""

from __future__ import annotations

import copy
import importlib
import io
import os
import subprocess
import sys
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import data_at_pose
from robot_sysid.errors import InputError
from robot_sysid.records import Array, RobotModel

Picture = NDArray[np.uint8]
"""Pixels (height, width, 3), red, green and blue."""
Colour = tuple[float, float, float, float]
"""Red, green, blue and opacity, from 0 to 1."""

PROBE_TIMEOUT = 60.0
"""Time that a graphics library has to open a context [s]; one that hangs is none."""
AZIMUTH = 135.0
"""Direction in which the camera looks, about the vertical [deg]: from the front, at an angle."""
ELEVATION = -15.0
"""Direction in which the camera looks, from the horizontal [deg]: slightly from above."""
ARM_OPACITY = 0.35
"""Opacity of the arm in front of the ellipsoids, over that in its model."""
WALL_DISTANCE = 4.0
"""Distance of the wall behind the arm, over that of the camera in front of it."""
WALL_SIZE = 16.0
"""Radius of the wall, over the camera's distance: it fills the view."""
WALL_HALF_THICKNESS = 0.01
"""Half of the thickness of the wall [m]."""
VIEW_DISTANCE = (0.75, 0.1)
"""Distance at which an arm fits into the picture: a share of its bounding box's diagonal, and a
margin [m]."""
DOT_RADIUS = 0.008
"""Radius of the dot at a centre of mass [m]."""

NO_RENDERER = (
    "no pictures of the arm: MuJoCo finds neither EGL nor OSMesa here (Debian: apt-get install "
    "libegl1 libosmesa6); MUJOCO_GL chooses one"
)
# Program that opens a graphics context of the library that it is given, and may crash. It loads
# that part of MuJoCo without the rest, which takes three times as long.
_PROBE = """
import importlib, importlib.util, sys, types
package = types.ModuleType("mujoco")
package.__path__ = importlib.util.find_spec("mujoco").submodule_search_locations
sys.modules["mujoco"] = package
context = importlib.import_module("mujoco." + sys.argv[1]).GLContext(64, 64)
context.make_current()
context.free()
"""


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
            probe = subprocess.run(call, capture_output=True, timeout=PROBE_TIMEOUT)
        except (OSError, subprocess.TimeoutExpired):
            continue
        if probe.returncode == 0:
            return name
    return None


class Studio:
    """One arm in its reference posture, in front of a white background; a context manager.

    A picture is begun by ``start``, may be added to, and is returned by ``render``.

    Args:
        robot: the arm; its compiled model is copied and stays as it is.
        width: width of the pictures [pixels].
        height: height of the pictures [pixels].

    Attributes:
        robot: as given.
        data: MuJoCo's data of the arm.

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
        self.data = data_at_pose(self._model, robot.reference_qpos)
        mujoco.mj_comPos(self._model, self.data)
        mujoco.mj_camlight(self._model, self.data)
        self._renderer = mujoco.Renderer(self._model, height, width)
        self._scene = self._renderer.scene

    def __enter__(self) -> Studio:
        """Return the studio."""
        return self

    def __exit__(self, *failure: object) -> None:
        """Release the graphics memory."""
        # Early releases of MuJoCo 3 have no close; they release it when it is collected.
        getattr(self._renderer, "close", lambda: None)()

    def start(self, target: Array, distance: float) -> None:
        """Start a new picture of the arm, which is half transparent, before a white wall.

        Args:
            target: (3,) point in the middle of the picture [m].
            distance: of the camera from it [m].
        """
        camera = mujoco.MjvCamera()
        camera.azimuth = AZIMUTH
        camera.elevation = ELEVATION
        camera.lookat = target
        camera.distance = distance
        self._renderer.update_scene(self.data, camera)
        flags = mujoco.mjtRndFlag
        for flag in (flags.mjRND_SKYBOX, flags.mjRND_HAZE, flags.mjRND_SHADOW):
            self._scene.flags[flag] = False
        for geom in self._scene.geoms[: self._scene.ngeom]:
            # The ellipsoids inside are seen through the arm, and not through a floor.
            if geom.type != mujoco.mjtGeom.mjGEOM_PLANE:
                geom.rgba[3] *= ARM_OPACITY
        # A white wall closes the view; MuJoCo's own background is black.
        view_direction = self._scene.camera[0].forward
        middle = WALL_DISTANCE * distance
        front = target + (middle - WALL_HALF_THICKNESS) * view_direction
        back = target + (middle + WALL_HALF_THICKNESS) * view_direction
        wall = mujoco.mjtGeom.mjGEOM_CYLINDER
        geom = self._add_geom(wall, np.ones(3), front, np.eye(3), (1.0, 1.0, 1.0, 1.0))
        mujoco.mjv_connector(geom, wall, WALL_SIZE * distance, front, back)
        geom.emission = 1.0

    def arm_view(self) -> tuple[Array, float]:
        """Return (middle of the arm (3,), distance from which all of it is in the picture) [m]."""
        ids = [link.body_id for link in self.robot.links]
        is_arm = np.isin(self._model.body_rootid, self._model.body_rootid[ids])
        # A plane has no bounding sphere.
        geoms = is_arm[self._model.geom_bodyid] & (self._model.geom_rbound > 0.0)
        centres = self.data.geom_xpos[geoms]
        radii = self._model.geom_rbound[geoms][:, None]
        points = np.concatenate((self.data.xpos[ids], centres - radii, centres + radii))
        low = np.min(points, axis=0)
        high = np.max(points, axis=0)
        share, margin = VIEW_DISTANCE
        diagonal = float(np.linalg.norm(high - low))
        return 0.5 * (low + high), share * diagonal + margin

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
        self._add_geom(sphere, np.full(3, DOT_RADIUS), centre, np.eye(3), dot_colour)
        if is_possible:
            ellipsoid = mujoco.mjtGeom.mjGEOM_ELLIPSOID
            self._add_geom(ellipsoid, np.sqrt(squares), centre, rotation @ axes, colour)
        return is_possible

    def _add_geom(
        self, shape: Any, size: Array, centre: Array, rotation: Array, colour: Colour
    ) -> Any:
        """Add a geom to the picture and return it; the renderer's scene has room for thousands.

        Args:
            shape: MuJoCo's ``mjtGeom``.
            size: (3,) half axes or half lengths [m], as MuJoCo takes them of this shape.
            centre: (3,) in the world frame [m].
            rotation: (3, 3) from the geom's axes to those of the world.
            colour: red, green, blue and opacity, 0 to 1.
        """
        geom = self._scene.geoms[self._scene.ngeom]
        rgba = np.array(colour, dtype=np.float32)
        matrix = np.ascontiguousarray(rotation).ravel()
        mujoco.mjv_initGeom(geom, shape, size, centre, matrix, rgba)
        self._scene.ngeom += 1
        return geom

    def render(self) -> Picture:
        """Return the picture (height, width, 3)."""
        return self._renderer.render()


def png_bytes(picture: Picture) -> bytes:
    """Return the content of a PNG file of a picture."""
    from matplotlib.image import imsave

    buffer = io.BytesIO()
    imsave(buffer, picture, format="png")
    return buffer.getvalue()
