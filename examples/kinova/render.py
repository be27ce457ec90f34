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
GUESS, TRUTH = "kinova_fullinertia_guess.xml", "kinova_fullinertia.xml"
BACKENDS = ("egl", "osmesa")
BACKGROUND = ".865 .88 .89"
PROBE = "import mujoco; mujoco.GLContext(64, 64).make_current()"


def main() -> int:
    """Draw all pictures; returns the exit code."""
    backend = find_backend()
    if backend is None:
        print("No pictures drawn: neither EGL nor OSMesa works here (Debian: libegl1 libosmesa6).")
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
    chosen = os.environ.get("MUJOCO_GL")
    for backend in (chosen,) if chosen else BACKENDS:
        environment = {**os.environ, "MUJOCO_GL": backend}
        tried = subprocess.run([sys.executable, "-c", PROBE], env=environment, capture_output=True)
        if tried.returncode == 0:
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
        self.model = mujoco.MjModel.from_xml_string(_with_background(HERE / "model" / file))
        self.data = mujoco.MjData(self.model)
        self.renderer = mujoco.Renderer(self.model, size[1], size[0], max_geom=4000)
        self.options = mujoco.MjvOption()
        self.camera = mujoco.MjvCamera()
        self.home = self.model.key("home").qpos.copy()

    def look(self, at: Sequence[float], distance: float, azimuth: float) -> None:
        """Place the camera: the point it looks at [m], its distance [m] and azimuth [degree]."""
        self.camera.lookat = at
        self.camera.distance, self.camera.azimuth, self.camera.elevation = distance, azimuth, -18

    def pose(self, qpos: Array) -> None:
        """Put the arm at joint positions (7,) [rad] and start a new picture with it."""
        self.data.qpos[:] = qpos
        self.mujoco.mj_forward(self.model, self.data)
        self.renderer.update_scene(self.data, self.camera, self.options)
        self.renderer.scene.flags[self.mujoco.mjtRndFlag.mjRND_HAZE] = 1

    def ghost(self, qpos: Array, opacity: float) -> None:
        """Add the arm at joint positions (7,) [rad] to the picture, as if made of glass."""
        scene, before = self.renderer.scene, self.renderer.scene.ngeom
        self.data.qpos[:] = qpos
        self.mujoco.mj_forward(self.model, self.data)
        self.mujoco.mjv_addGeoms(
            self.model,
            self.data,
            self.options,
            self.mujoco.MjvPerturb(),
            self.mujoco.mjtCatBit.mjCAT_DYNAMIC,
            scene,
        )
        for geom in scene.geoms[before : scene.ngeom]:
            geom.rgba[3] *= opacity

    def show_inertia(self, body: int) -> None:
        """Make a body's geoms glass and add the box of its mass and inertia, centre as a dot.

        A homogeneous box with edges a, b, c has I_xx = m (b^2 + c^2) / 12, so that
        (a / 2)^2 = 1.5 (I_yy + I_zz - I_xx) / m.
        """
        scene, model = self.renderer.scene, self.model
        for geom in scene.geoms[: scene.ngeom]:
            if geom.objid >= 0 and model.geom_bodyid[geom.objid] == body:
                geom.rgba[3] = 0.3
        inertia = model.body_inertia[body]
        half = np.sqrt(1.5 * (inertia.sum() - 2.0 * inertia) / model.body_mass[body])
        box, ball = self.mujoco.mjtGeom.mjGEOM_BOX, self.mujoco.mjtGeom.mjGEOM_SPHERE
        self._add(box, half, body, (0.90, 0.45, 0.10, 0.45))
        self._add(ball, np.full(3, 0.008), body, (0.75, 0.10, 0.10, 1.0))

    def picture(self) -> Picture:
        """Return the picture (height, width, 3)."""
        return self.renderer.render()

    def _add(self, kind: Any, size: Array, body: int, rgba: tuple[float, ...]) -> None:
        scene = self.renderer.scene
        place = (self.data.xipos[body], self.data.ximat[body])
        geom = scene.geoms[scene.ngeom]
        self.mujoco.mjv_initGeom(geom, kind, size, *place, np.array(rgba, dtype=np.float32))
        scene.ngeom += 1


def draw_home() -> Picture:
    """The guess at its home pose."""
    return _arm(GUESS, (1400, 1000)).picture()


def draw_both() -> Picture:
    """Guess and ground truth side by side."""
    return np.hstack([_arm(file, (800, 900)).picture() for file in (GUESS, TRUTH)])


def draw_sweep() -> Picture:
    """The poses that an excitation trajectory of 15 s passes, half a second apart."""
    from robot_sysid.parser import load_robot_model
    from robot_sysid.trajectory import generate_excitation_trajectory

    robot = load_robot_model(HERE / "model" / GUESS)
    plan, _ = generate_excitation_trajectory(robot, np.random.default_rng(0))
    studio = _arm(GUESS, (1400, 1000))
    for qpos in plan.evaluate(np.arange(0.5, plan.duration, 0.5)).q:
        studio.ghost(qpos, 0.07)
    return studio.picture()


def draw_terminal_links() -> Picture:
    """Both terminal links as glass, each with the homogeneous box of the same inertia."""
    pictures = []
    for file in (GUESS, TRUTH):
        studio = Studio(file, (800, 640))
        body = studio.model.body("link6").id
        studio.pose(studio.home)
        studio.look(studio.data.xipos[body], 0.75, 140.0)
        studio.pose(studio.home)
        studio.show_inertia(body)
        pictures.append(studio.picture())
    return np.hstack(pictures)


def _arm(file: str, size: tuple[int, int]) -> Studio:
    """Return a model at its home pose, seen as a whole."""
    studio = Studio(file, size)
    studio.look((0.22, 0.0, 0.40), 1.45, 140.0)
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
    sky = {"type": "skybox", "builtin": "flat", "rgb1": BACKGROUND, "width": "64", "height": "64"}
    ET.SubElement(root.find("asset"), "texture", sky)
    ET.SubElement(root.find("visual"), "rgba", haze=BACKGROUND + " 1")
    ET.SubElement(root.find("visual"), "map", haze=".35")
    return ET.tostring(root, encoding="unicode")


if __name__ == "__main__":
    sys.exit(main())
