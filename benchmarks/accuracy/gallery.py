"""Three pictures of the pages, drawn by the tool itself from its example.

    pip install -e ".[report]"
    python -m benchmarks.accuracy.gallery

Half a minute. MuJoCo draws the arm off-screen, on EGL or OSMesa.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import mujoco
import numpy as np

from rigs.files.places import ROOT
from robot_sysid.api.calls import plan
from robot_sysid.cli import main as run_command
from robot_sysid.records import Traces
from robot_sysid.report import figures
from robot_sysid.report.drawing import COLOURS, drawing_style
from robot_sysid.report.pictures import pictures
from robot_sysid.report.runs import load_run
from robot_sysid.report.studio import Studio, png_bytes
from robot_sysid.spatial import theta_from_com

IMAGES = ROOT / "docs" / "images"
MODEL = "kinova/model/kinova_fullinertia_guess.xml"
IDENTIFY = ["identify", MODEL, "kinova/true_arm.csv", "--output-dir", "found"]
WIDTH = 800
HEIGHT = 620
PATH_COLOUR = (0.05, 0.38, 0.75, 1.0)


def joint_of_largest_change(traces: Traces) -> int:
    """Return the index of the joint whose root mean square residual has changed most."""
    before = np.nanmean((traces.measured - traces.prior_prediction) ** 2, axis=0)
    after = np.nanmean(traces.residual**2, axis=0)
    return int(np.argmax(np.abs(np.sqrt(before) - np.sqrt(after))))


def torques() -> str:
    """Return the report's figure of the joint that changed most, as an SVG file."""
    traces = load_run(Path("found")).traces
    with drawing_style():
        text = figures.torque_figure(traces, joint_of_largest_change(traces)).svg
    for name, colour in COLOURS.items():
        text = text.replace(f"var(--{name})", colour)
    names = (
        'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'
    )
    style = 'font-family="sans-serif" style="background:white"'
    return text.replace('aria-hidden="true"', f"{names} {style}", 1) + "\n"


def motion() -> bytes:
    """Return a picture of the arm at rest and of the path of its last link in a designed motion."""
    designed = plan(MODEL, seed=1)
    robot = designed.robot
    data = mujoco.MjData(robot.mj_model)
    path = []
    for q in designed.checked.plan.evaluate(np.arange(0.0, designed.duration, 0.005)).q:
        data.qpos[robot.qpos_index] = q
        mujoco.mj_kinematics(robot.mj_model, data)
        path.append(data.xipos[robot.body_id].copy())
    points = np.vstack((path, np.zeros(3)))
    middle = 0.5 * (np.min(points, axis=0) + np.max(points, axis=0))
    distance = 1.0 * float(np.linalg.norm(np.ptp(points, axis=0)))
    with Studio(robot, WIDTH, HEIGHT) as studio:
        studio.start(middle, distance)
        for point in path:
            # A ball of 1 kg in the frame of the world, which is body 0.
            ball = theta_from_com(1.0, point, 1e-5 * np.eye(3))
            studio.add_ellipsoid(0, ball, PATH_COLOUR)
        return png_bytes(studio.render())


def main() -> None:
    """Draw all pictures."""
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        run_command(["example", "kinova"])
        run_command(IDENTIFY)
        (IMAGES / "gallery_torques.svg").write_text(torques(), encoding="utf-8")
        arm = pictures(load_run(Path("found")))[0][0].png
        (IMAGES / "gallery_links.png").write_bytes(arm)
        (IMAGES / "gallery_motion.png").write_bytes(motion())


if __name__ == "__main__":
    main()
