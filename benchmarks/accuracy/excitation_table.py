"""Designed trajectories of all public arms: what they buy, how near and fast they get, the cost.

    python -m benchmarks.accuracy.excitation_table [--arms PART] [--seeds 0 1 2]

One line per arm: what a recording of random sinusoids (median of five) leaves unknown over what
one of a design leaves (median of the seeds), all unknowns of an estimate counted: standard
deviations of mass, centre of mass, Izz, the median of ten and the mean of the axes of the
confidence ellipsoid; in brackets the share of the error that any motion leaves. Then the smallest
distance that the plan states and the real one, by MuJoCo's contacts at 500 Hz; the speed of the
tool's fastest point; and processor time of one design.
"""

from __future__ import annotations

import argparse
import copy
import time

import mujoco
import numpy as np

from rigs.arms.excitation_arms import link_covariance
from rigs.files.places import GUESS, MODELS
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.expected.criterion import Criterion, random_motion
from robot_sysid.expected.recording import centre_slopes, prior_knowledge
from robot_sysid.motion import ExcitationOptions, LimitOptions
from robot_sysid.motion.limit_check import check_limits
from robot_sysid.motion.problem import build_problem
from robot_sysid.motion.search import Design, design_excitation
from robot_sysid.parser import load_robot_model
from robot_sysid.records.messages import Progress
from robot_sysid.trajectory import (
    TrajectoryOptions,
    generate_excitation_trajectory,
    motion_chunks,
)

ARMS = [
    ("kinova_gen3/gen3.xml", None),
    ("kinova_gen3/gen3_official.xml", None),
    ("kinova_gen3/gen3_7dof_2023.xml", None),
    ("kinova_gen3/scene.xml", None),
    ("franka_panda/panda.xml", None),
    ("franka_panda/panda_nohand.xml", None),
    ("franka_panda/scene.xml", None),
    ("franka_fr3/FrankaFR3_7DoF.urdf", None),
    ("kuka_iiwa_14/iiwa14.xml", None),
    ("kuka_iiwa_14/scene.xml", None),
    ("universal_robots_ur5e/ur5e.xml", None),
    ("universal_robots_ur5e/scene.xml", None),
    ("ufactory_xarm7/xarm7.xml", None),
    ("ufactory_xarm7/xarm7_nohand.xml", None),
    ("ufactory_xarm7/scene.xml", None),
    ("trossen/wxai/wxai_follower.xml", None),
    ("trossen/wxai/wxai_base.xml", None),
    ("openarm_v2/openarm_bimanual.xml", "openarm_left_joint7"),
    ("openarm_v2/openarm_bimanual.xml", "openarm_right_joint7"),
    ("aloha/aloha.xml", "left/wrist_rotate"),
    ("aloha/scene.xml", "right/wrist_rotate"),
    ("so101/so101_new_calib.xml", "wrist_roll"),
    ("so101/so101_new_calib.urdf", "gripper"),
]
NOISELESS = 1e8
"""Samples of a recording that leaves what any motion leaves: with 1e7 as many errors of mass and
centre are the same within 0.2 %, and with 1e12 the equations are singular in floating point."""
NAMES = ("mass", "centre", "Izz", "ten", "mean")


def left_by(design, plan):
    """Return standard deviations of mass, centre of mass, Izz and the ten, and the mean axis."""
    motion = plan.evaluate(design.grid)
    return figures(design, design.criterion, (motion.q, motion.qd, motion.qdd))


def figures(design, criterion, motion):
    """Return standard deviations of mass, centre of mass, Izz and the ten, and the mean axis."""
    covariance = link_covariance(criterion, motion)
    standard_errors = np.sqrt(np.diag(covariance))
    scale = design.problem.robot.prior.scale
    slopes = centre_slopes(design.problem.robot.prior.theta)
    centre = np.sqrt(np.trace(slopes @ covariance @ slopes.T))
    mean = np.exp(criterion.evaluate(motion))
    median = np.median(standard_errors / scale)
    return np.array([standard_errors[0], centre, standard_errors[9], median, mean])


def nearest(robot, plan):
    """Return the smallest distance of bodies that move and do not overlap at rest [m]."""
    model = copy.copy(robot.mj_model)
    moving_groups = parts_by_joints(robot)
    model.geom_margin[:] = 0.1
    model.geom_gap[:] = 0.0
    model.body_margin[:] = 0.1
    data = mujoco.MjData(model)
    allowed_pairs = None
    data.qpos[:] = robot.reference_qpos
    least = np.inf
    for motion in motion_chunks(plan, 500.0):
        for q in motion.q:
            data.qpos[robot.qpos_index] = q
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_collision(model, data)
            bodies = np.sort(model.geom_bodyid[data.contact.geom], axis=1)
            moving = moving_groups[bodies[:, 0]] != moving_groups[bodies[:, 1]]
            if allowed_pairs is None:
                inside = moving & (data.contact.dist <= 0.0)
                allowed_pairs = {tuple(pair) for pair in bodies[inside].tolist()}
            counted = [tuple(pair) not in allowed_pairs for pair in bodies.tolist()]
            least = np.min(
                data.contact.dist[moving & np.array(counted, dtype=bool)], initial=least
            )
    return float(least)


def parts_by_joints(robot):
    """Return the number of chain joints above each body."""
    model = robot.mj_model
    joint_bodies = model.dof_bodyid[robot.dof_index]
    groups = np.bincount(joint_bodies, minlength=model.nbody)
    for body in range(1, model.nbody):
        groups[body] += groups[model.body_parentid[body]]
    return groups


def line(path, joint, seeds):
    """Return the table's line of one arm."""
    robot = load_robot_model(path, joint=joint)
    motion = TrajectoryOptions()
    options = ExcitationOptions()
    problem = build_problem(robot, LimitOptions())
    prior = prior_knowledge(problem, EstimationOptions(), "link")
    design = Design(problem, options, motion, prior)
    rows = []
    for rng in map(np.random.default_rng, range(5)):
        plan = generate_excitation_trajectory(robot, rng, 15.0)
        rows.append(left_by(design, plan))
    sines = np.median(rows, axis=0)
    exact = Criterion(problem, prior, NOISELESS)
    least = figures(design, exact, random_motion(problem))
    began = time.process_time()
    ratios = []
    for seed in seeds:
        plan = design_excitation(design, np.random.default_rng(seed), Progress())
        ratios.append(left_by(design, plan))
    spent = (time.process_time() - began) / len(seeds)
    best = np.median(ratios, axis=0)
    check = check_limits(problem, plan)
    stated = check.closest.distance
    real = nearest(robot, plan)
    pairs = zip(NAMES, sines / best, least / best)
    ratio_text = "  ".join(
        f"{name} {ratio:5.1f} ({100.0 * f:3.0f} %)" for name, ratio, f in pairs
    )
    text = f"{path.parent.name}/{path.stem:24s} {ratio_text}  stated {1e3 * stated:6.1f} mm"
    tool_speed = check.uses[-1].value
    text += f"  real {1e3 * real:6.1f} mm  tool {tool_speed:4.2f} m/s  {spent:4.1f} s"
    return text


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--arms", default="")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    options = parser.parse_args()
    for path, joint in [
        (GUESS, None),
        *((MODELS / model, joint) for model, joint in ARMS),
    ]:
        if options.arms in str(path):
            print(line(path, joint, options.seeds), flush=True)


if __name__ == "__main__":
    main()
