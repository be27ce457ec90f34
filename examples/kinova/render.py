"""Draw the example's pictures off-screen into the folder images/.

MuJoCo needs EGL or OSMesa for that; where neither is installed, this script says so and stops with
exit code 0, because pictures are not what the example is about. Needs matplotlib to write PNG.
"""

from __future__ import annotations

import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

HERE = Path(__file__).resolve().parent
GUESS = "kinova_fullinertia_guess.xml"
TRUTH = "kinova_fullinertia.xml"
BACKENDS = ("egl", "osmesa")
BACKGROUND = ".865 .88 .89"
PROBE = "import mujoco; mujoco.GLContext(64, 64).make_current()"


def main() -> int:
    """Draw all pictures; returns the exit code."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        print(
            "No pictures drawn: they are written by matplotlib (pip install matplotlib)."
        )
        return 0
    backend = find_backend()
    if backend is None:
        print(
            "No pictures drawn: neither EGL nor OSMesa works here (Debian: libegl1 libosmesa6)."
        )
        return 0
    os.environ["MUJOCO_GL"] = backend
    pictures = {
        "home.png": draw_home,
        "sweep.png": draw_sweep,
        "guess_and_truth.png": draw_both,
        "terminal_link.png": draw_terminal_links,
    }
    (HERE / "images").mkdir(exist_ok=True)
    for name, draw in pictures.items():
        save(HERE / "images" / name, draw())
    return 0


def find_backend() -> str | None:
    """Return the first backend that can open a context, tried in a process of its own."""
    requested = os.environ.get("MUJOCO_GL")
    for backend in (requested,) if requested else BACKENDS:
        environment = {**os.environ, "MUJOCO_GL": backend}
        trial = subprocess.run(
            [sys.executable, "-c", PROBE], env=environment, capture_output=True
        )
        if trial.returncode == 0:
            return backend
    return None


class Studio:
    """One model in front of a plain background.

    Args:
        file: name of the model in the folder model/.
        size: (width, height) of the picture [pixels].
    """

    def __init__(self, file: str, size: tuple[int, int]) -> None:
        import mujoco

        self.mujoco = mujoco
        self.model = mujoco.MjModel.from_xml_string(
            _with_background(HERE / "model" / file)
        )
        self.data = mujoco.MjData(self.model)
        self.renderer = mujoco.Renderer(self.model, size[1], size[0], max_geom=4000)
        self.options = mujoco.MjvOption()
        self.camera = mujoco.MjvCamera()
        self.home = self.model.key("home").qpos.copy()

    def look(self, at: Sequence[float], distance: float, azimuth: float) -> None:
        """Place the camera: the point it looks at [m], its distance [m] and azimuth [degree]."""
        self.camera.lookat = at
        self.camera.distance = distance
        self.camera.azimuth = azimuth
        self.camera.elevation = -18

    def pose(self, qpos: Array, shadow: bool = True) -> None:
        """Put the arm at joint positions (7,) [rad] and start a new picture with it."""
        self.data.qpos[:] = qpos
        self.mujoco.mj_forward(self.model, self.data)
        self.renderer.update_scene(self.data, self.camera, self.options)
        flags = self.renderer.scene.flags
        names = self.mujoco.mjtRndFlag
        flags[names.mjRND_HAZE] = True
        flags[names.mjRND_SHADOW] = shadow

    def silhouette(self) -> NDArray[np.bool_]:
        """Return which pixels show something else than floor and sky (height, width)."""
        self.renderer.enable_segmentation_rendering()
        identity = self.renderer.render()[..., 0]
        self.renderer.disable_segmentation_rendering()
        return (identity != -1) & (identity != self.model.geom("floor").id)

    def empty(self) -> Picture:
        """Return the picture without the arm."""
        self.options.geomgroup[2] = 0
        self.pose(self.home)
        self.options.geomgroup[2] = 1
        return self.picture()

    def tips(self, poses: Array) -> Array:
        """Return where the tool's tip is (N, 3) [m] at joint positions (N, 7) [rad]."""
        points = []
        for qpos in poses:
            self.data.qpos[:] = qpos
            self.mujoco.mj_kinematics(self.model, self.data)
            link = self.data.body("link6")
            points.append(link.xpos + link.xmat.reshape(3, 3) @ (0.0, 0.0, 0.3))
        return np.array(points)

    def trail(self, points: Array, radius: float, rgba: tuple[float, ...]) -> None:
        """Add a line through points (N, 3) [m] to the picture."""
        capsule = self.mujoco.mjtGeom.mjGEOM_CAPSULE
        for start, end in zip(points[:-1], points[1:]):
            geom = self._new_geom(
                capsule, np.zeros(3), np.zeros(3), np.eye(3).ravel(), rgba
            )
            self.mujoco.mjv_connector(geom, capsule, radius, start, end)

    def show_inertia(self, body: int) -> None:
        """Make a body's geoms glass and add the box of its mass and inertia, centre as a dot.

        A homogeneous box with edges a, b, c has I_xx = m (b^2 + c^2) / 12, so that
        (a / 2)^2 = 1.5 (I_yy + I_zz - I_xx) / m.
        """
        scene = self.renderer.scene
        model = self.model
        for geom in scene.geoms[: scene.ngeom]:
            if geom.objid >= 0 and model.geom_bodyid[geom.objid] == body:
                geom.rgba[3] = 0.3
        inertia = model.body_inertia[body]
        half = np.sqrt(1.5 * (inertia.sum() - 2.0 * inertia) / model.body_mass[body])
        box = self.mujoco.mjtGeom.mjGEOM_BOX
        ball = self.mujoco.mjtGeom.mjGEOM_SPHERE
        pose = (self.data.xipos[body], self.data.ximat[body])
        self._new_geom(box, half, *pose, (0.90, 0.45, 0.10, 0.45))
        self._new_geom(ball, np.full(3, 0.008), *pose, (0.75, 0.10, 0.10, 1.0))

    def picture(self) -> Picture:
        """Return the picture (height, width, 3)."""
        return self.renderer.render()

    def _new_geom(
        self,
        shape: Any,
        size: Array,
        centre: Array,
        rotation: Array,
        rgba: tuple[float, ...],
    ) -> Any:
        """Add a shape to the scene; return it."""
        scene = self.renderer.scene
        geom = scene.geoms[scene.ngeom]
        self.mujoco.mjv_initGeom(
            geom, shape, size, centre, rotation, np.array(rgba, dtype=np.float32)
        )
        geom.segid = -1
        scene.ngeom += 1
        return geom


def draw_home() -> Picture:
    """Draw the guess at its home pose."""
    return _arm(GUESS, (1400, 1000)).picture()


def draw_both() -> Picture:
    """Draw guess and ground truth side by side."""
    return np.hstack([_arm(file, (800, 900)).picture() for file in (GUESS, TRUTH)])


def draw_sweep() -> Picture:
    """Draw the arm at home, pale copies along 15 s of a trajectory, and the path of the tool."""
    from robot_sysid.parser import load_robot_model
    from robot_sysid.trajectory import generate_excitation_trajectory

    robot = load_robot_model(HERE / "model" / GUESS)
    plan = generate_excitation_trajectory(robot, np.random.default_rng(0))
    studio = _arm(GUESS, (1400, 1000))
    empty = studio.empty()
    copies = plan.evaluate(np.linspace(2.0, 13.0, 12)).q
    picture = empty.astype(float)
    for qpos in copies:
        studio.pose(qpos, shadow=False)
        picture = over(picture, studio, empty, 0.22)
    tips = studio.tips(plan.evaluate(np.arange(0.0, plan.duration, 0.03)).q)
    studio.pose(studio.home)
    studio.trail(tips, 0.0015, (0.90, 0.45, 0.10, 1.0))
    return over(picture, studio, empty, 1.0).astype(np.uint8)


def over(below: Array, studio: Studio, empty: Picture, opacity: float) -> Array:
    """Return ``below`` with the studio's arm, and the shadow if it has one, laid over it."""
    above = studio.picture()
    shadow = np.any(np.abs(above.astype(float) - empty) > 6.0, axis=2)
    drawn = (shadow | studio.silhouette())[..., None]
    return np.where(drawn, (1.0 - opacity) * below + opacity * above, below)


def draw_terminal_links() -> Picture:
    """Draw both terminal links as glass, each with the homogeneous box of its inertia."""
    pictures = []
    for file in (GUESS, TRUTH):
        studio = Studio(file, (800, 640))
        body = studio.model.body("link6").id
        studio.pose(studio.home)
        studio.look(studio.data.xipos[body], 0.66, 140.0)
        studio.pose(studio.home, shadow=False)
        studio.show_inertia(body)
        pictures.append(studio.picture())
    return np.hstack(pictures)


def _arm(file: str, size: tuple[int, int]) -> Studio:
    """Return a model at its home pose, seen as a whole."""
    studio = Studio(file, size)
    studio.look((0.24, 0.0, 0.39), 1.3, 140.0)
    studio.pose(studio.home)
    return studio


def save(path: Path, picture: Picture) -> None:
    """Write a picture as PNG."""
    from matplotlib.image import imsave

    imsave(path, picture)
    print(f"wrote {path}")


def _with_background(path: Path) -> str:
    """Return the model as text with a plain sky; meshes are found by their full path."""
    root = ET.parse(path).getroot()
    root.find("compiler").set("meshdir", str(path.parent / "meshes"))
    sky = {
        "type": "skybox",
        "builtin": "flat",
        "rgb1": BACKGROUND,
        "width": "64",
        "height": "64",
    }
    ET.SubElement(root.find("asset"), "texture", sky)
    ET.SubElement(root.find("visual"), "rgba", haze=BACKGROUND + " 1")
    ET.SubElement(root.find("visual"), "map", haze=".35")
    return ET.tostring(root, encoding="unicode")


if __name__ == "__main__":
    sys.exit(main())
