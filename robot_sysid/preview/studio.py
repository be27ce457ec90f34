"""Pictures of an arm without a screen, by MuJoCo's renderer on EGL or OSMesa."""

from __future__ import annotations

import copy
import importlib
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
Colour = tuple[float, float, float, float]

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


@lru_cache(maxsize=1)
def backend() -> str | None:
    """Return what can draw without a screen, or None: tried in a process of its own, which may die.

    MUJOCO_GL, where it names one, is the only one tried.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower().replace("disable", "")
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
        shown.offwidth = width
        shown.offheight = height
        # MuJoCo has made its own choice when it was imported, without trying what works here.
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
        ahead = self.scene.camera[0].forward
        far = 4.0 * float(self.camera.distance)
        near, behind = (
            self.camera.lookat + (far + side) * ahead for side in (-0.01, 0.01)
        )
        self._connect(mujoco.mjtGeom.mjGEOM_CYLINDER, 4.0 * far, _WHITE, near, behind)
        self.scene.geoms[self.scene.ngeom - 1].emission = 1.0
        ids = [link.body_id for link in self.robot.links]
        if not np.any(np.isin(self._model.geom_bodyid, ids)):
            # A model without shapes to show, as many URDF files: the links' origins are joined.
            for start, end in zip(self.data.xpos[ids[:-1]], self.data.xpos[ids[1:]]):
                self._connect(mujoco.mjtGeom.mjGEOM_CAPSULE, 0.015, _BONE, start, end)

    def look(self, at: Array, distance: float) -> None:
        """Point the camera at a place (3,) from a distance [m]; holds from the next pose on."""
        self.camera.lookat = at
        self.camera.distance = distance

    def look_at_arm(self, postures: Array) -> None:
        """Point the camera so that the arm stays in the picture in all postures (N, n)."""
        points = np.concatenate([self._corners(q) for q in postures])
        low = np.min(points, axis=0)
        high = np.max(points, axis=0)
        self.look(0.5 * (low + high), 0.75 * float(np.linalg.norm(high - low)) + 0.1)
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

    def glass(self, opacity: float) -> None:
        """Make what is in the picture so far transparent, floor and wall apart."""
        for geom in self.scene.geoms[: self.scene.ngeom]:
            if geom.type != mujoco.mjtGeom.mjGEOM_PLANE and geom.emission < 1.0:
                geom.rgba[3] *= opacity

    def add_ellipsoid(self, body: int, theta: Array, colour: Colour) -> bool:
        """Add the homogeneous ellipsoid of a body's mass and inertia, its centre as a dot.

        With half axes a, b, c it has I_xx = m (b^2 + c^2) / 5, so that
        a^2 = 5 (I_yy + I_zz - I_xx) / (2 m). Returns whether there is such an ellipsoid; none has
        where theta is no possible body.
        """
        mass, com, inertia = spatial.com_from_theta(theta)
        moments, axes = spatial.principal_axes(inertia)
        squares = 2.5 * (np.sum(moments) - 2.0 * moments) / max(mass, 1e-12)
        turn = self.data.xmat[body].reshape(3, 3)
        place = self.data.xpos[body] + turn @ com
        possible = mass > 0.0 and bool(np.all(squares > 0.0))
        dot = (*colour[:3], 1.0)
        self._add(
            mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, 0.008), place, np.eye(3), dot
        )
        if possible:
            self._add(
                mujoco.mjtGeom.mjGEOM_ELLIPSOID,
                np.sqrt(squares),
                place,
                turn @ axes,
                colour,
            )
        return possible

    def _add(
        self, kind: Any, size: Array, place: Array, turn: Array, colour: Colour
    ) -> None:
        if self.scene.ngeom >= self.scene.maxgeom:
            return
        geom = self.scene.geoms[self.scene.ngeom]
        rgba = np.array(colour, dtype=np.float32)
        mujoco.mjv_initGeom(
            geom, kind, size, place, np.ascontiguousarray(turn).ravel(), rgba
        )
        self.scene.ngeom += 1

    def _connect(
        self, kind: Any, width: float, colour: Colour, start: Array, end: Array
    ) -> None:
        """Add a shape that reaches from one place (3,) to another one, if they differ."""
        if np.any(start != end) and self.scene.ngeom < self.scene.maxgeom:
            self._add(kind, np.ones(3), start, np.eye(3), colour)
            mujoco.mjv_connector(
                self.scene.geoms[self.scene.ngeom - 1], kind, width, start, end
            )

    def picture(self) -> Picture:
        """Return the picture (height, width, 3)."""
        return self._renderer.render()
