"""Draws the pictures of docs/excitation.md.

    python docs/excitation_figures.py [FOLDER]

Needs the extra ``report`` (matplotlib). Takes about a minute: it designs the trajectory it shows.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import mujoco
import numpy as np
from robot_sysid.motion.expected_errors import prior_knowledge

from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.motion import ExcitationOptions, LimitOptions
from robot_sysid.motion.problem import build_problem
from robot_sysid.motion.search import Design, design_excitation
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, MotionPlan, RobotModel
from robot_sysid.trajectory import TrajectoryOptions, generate_excitation_trajectory

HERE = Path(__file__).resolve().parent
MODEL = HERE.parent / "examples/kinova/model/kinova_fullinertia_guess.xml"
SEED = 0
SINES = "tab:gray"
OPTIMAL = "tab:blue"


def draw_trajectories(
    robot: RobotModel, plans: dict[str, MotionPlan], path: Path
) -> None:
    """Draw joint positions over time, one column per trajectory."""
    figure, axes = plt.subplots(
        robot.n_joints, 2, figsize=(9, 9), sharex=True, sharey="row"
    )
    time = np.linspace(0.0, 15.0, 1501)
    for column, (title, plan) in enumerate(plans.items()):
        motion = plan.evaluate(time)
        axes[0, column].set_title(title)
        for joint, axis in enumerate(axes[:, column]):
            axis.plot(time, motion.q[:, joint], color=(SINES, OPTIMAL)[column], lw=1.2)
            axis.grid(alpha=0.3)
            if column == 0:
                axis.set_ylabel(f"{robot.joint_names[joint]} [rad]", fontsize=8)
        axes[-1, column].set_xlabel("time [s]")
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def draw_sweep(robot: RobotModel, plans: dict[str, MotionPlan], path: Path) -> None:
    """Draw the path of the terminal link and the arm in some postures."""
    figure = plt.figure(figsize=(9, 4.6))
    for column, (title, plan) in enumerate(plans.items()):
        axis: Any = figure.add_subplot(1, 2, column + 1, projection="3d")
        tip = np.array([skeleton(robot, q)[-1] for q in postures(plan, 400)])
        axis.plot(*tip.T, color=(SINES, OPTIMAL)[column], lw=1.2)
        for q in postures(plan, 12):
            axis.plot(*skeleton(robot, q).T, color="black", alpha=0.25, lw=1.5)
        axis.set(xlim=(-0.8, 0.8), ylim=(-0.8, 0.8), zlim=(-0.1, 1.4), title=title)
        axis.set_box_aspect((1.6, 1.6, 1.5))
        axis.tick_params(labelsize=6)
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def postures(plan: MotionPlan, count: int) -> Array:
    """Return joint positions at equal time steps."""
    return plan.evaluate(np.linspace(0.0, plan.duration, count)).q


def skeleton(robot: RobotModel, q: Array) -> Array:
    """Return the positions of the base, the joints and the terminal link's centre of mass."""
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = robot.reference_qpos
    data.qpos[robot.qpos_index] = q
    mujoco.mj_kinematics(robot.mj_model, data)
    joints = data.xanchor[robot.mj_model.dof_jntid[robot.dof_index]]
    return np.vstack((np.zeros(3), joints, data.xipos[robot.body_id]))


def main(folder: Path) -> None:
    """Design a motion and draw its pictures into a folder."""
    robot = load_robot_model(MODEL)
    problem = build_problem(robot, LimitOptions())
    prior = prior_knowledge(problem, EstimationOptions(), "link")
    design = Design(problem, ExcitationOptions(), TrajectoryOptions(), prior)
    sines = generate_excitation_trajectory(robot, np.random.default_rng(SEED), 15.0)
    optimal = design_excitation(design, np.random.default_rng(SEED))
    plans: dict[str, MotionPlan] = {"random sinusoids": sines, "optimal, D": optimal}
    draw_trajectories(robot, plans, folder / "excitation_trajectories.png")
    draw_sweep(robot, plans, folder / "excitation_sweep.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "images")
