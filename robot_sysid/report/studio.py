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

from robot_sysid.dynamics import spatial
from robot_sysid.errors import InputError
from robot_sysid.records import Array, RobotModel

Picture = NDArray[np.uint8]
"""Pixels (height, width, 3), red, green and blue."""
Colour = tuple[float, float, float, float]
"""Red, green, blue and opacity, from 0 to 1."""

NO_RENDERER = (
    "no pictures of the arm: MuJoCo finds neither EGL nor OSMesa here (Debian: apt-get install "
    "libegl1 libosmesa6); MUJOCO_GL chooses one"
)
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

    def look_at_arm(self, postures: Array) -> None:
        """Point the camera so that the arm stays in the picture in all postures (N, n).

        Postures are chain positions [rad or m]; the arm is put into the first one.
        """
        points = np.concatenate([self._corners(q) for q in postures])
        low = np.min(points, axis=0)
        high = np.max(points, axis=0)
        distance = 0.75 * float(np.linalg.norm(high - low)) + 0.1
        self.camera.lookat = 0.5 * (low + high)
        self.camera.distance = distance
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


def png_bytes(picture: Picture) -> bytes:
    """Return the content of a PNG file of a picture."""
    from matplotlib.image import imsave

    buffer = io.BytesIO()
    imsave(buffer, picture, format="png")
    return buffer.getvalue()
