"""Designed trajectories of all public arms: what they buy, how near and fast they get, the cost.

    python -m benchmarks.excitation_table [--arms PART] [--seeds 0 1 2] [--weight W]
        [--iterations K] [--rounds K] [--draws N]

One line per arm: mass and centre of mass of random sinusoids (median of ten) over those of a design
(median of the seeds), by the bound for all samples; the smallest distance that the
plan states and the real one, by MuJoCo's contacts at 500 Hz; the speed of the tool's fastest point;
processor time of one design; and by how much the mean deviation falls, in %, per % that a family
of limits is raised by. A few draws and no rounds show the distances of all arms in minutes.
"""

from __future__ import annotations

import argparse
import copy
import time

import mujoco
import numpy as np

from robot_sysid.motion.design import optimise
from robot_sysid.motion.design.optimise import Design
from robot_sysid.motion.design.search import design_excitation
from robot_sysid.motion.limit_check import DISTANCE_RESOLUTION
from robot_sysid.motion.options import ExcitationOptions, LimitOptions
from robot_sysid.motion.prediction import predict
from robot_sysid.motion.problem import build_problem
from robot_sysid.parser import load_robot_model
from robot_sysid.simulator import ArmTorque
from robot_sysid.trajectory import TrajectoryOptions, generate_excitation_trajectory, motion_chunks
from tests.support.places import GUESS, MODELS

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
RATE = 1000.0


def mass_and_centre(problem, plan):
    """Predicted deviations of mass [kg] and centre of mass [m]."""
    promised = predict(problem, plan, RATE)
    return np.array([promised.deviation[0], promised.com_deviation])


def nearest(robot, plan):
    """Smallest distance of parts that move against each other, without those that overlap."""
    model, parts = copy.copy(robot.mj_model), parts_by_joints(robot)
    model.geom_margin[:], model.geom_gap[:] = 0.1, 0.0
    model.body_margin[:] = 0.1
    data, rest = mujoco.MjData(model), None
    data.qpos[:] = robot.reference_qpos
    least = np.inf
    for motion in motion_chunks(plan, 500.0):
        for q in motion.q:
            data.qpos[robot.qpos_index] = q
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_collision(model, data)
            bodies = np.sort(model.geom_bodyid[data.contact.geom], axis=1)
            moving = parts[bodies[:, 0]] != parts[bodies[:, 1]]
            if rest is None:
                inside = moving & (data.contact.dist <= 0.0)
                rest = {tuple(pair) for pair in bodies[inside].tolist()}
            counted = [tuple(pair) not in rest for pair in bodies.tolist()]
            least = np.min(data.contact.dist[moving & np.array(counted, dtype=bool)], initial=least)
    return float(least)


def parts_by_joints(robot):
    """Number of chain joints above each body."""
    model = robot.mj_model
    joints = set(model.dof_jntid[robot.dof_index].tolist())
    found = np.zeros(model.nbody, dtype=int)
    for body in range(1, model.nbody):
        own = [j for j in range(model.njnt) if model.jnt_bodyid[j] == body and j in joints]
        found[body] = found[model.body_parentid[body]] + len(own)
    return found


def line(path, joint, seeds, **effort):
    """The table's line of one arm."""
    robot = load_robot_model(path, joint=joint)
    options = ExcitationOptions(workers=1, time_budget=1e6, starts=2, **effort)
    motion = TrajectoryOptions()
    top = options.basis(motion.duration).top_frequency_hz
    problem = build_problem(robot, LimitOptions(), top_frequency_hz=top)
    torque = ArmTorque(robot)
    sines = np.median(
        [
            mass_and_centre(problem, generate_excitation_trajectory(robot, rng, 15.0, torque)[0])
            for rng in map(np.random.default_rng, range(10))
        ],
        axis=0,
    )
    began, found = time.process_time(), []
    for seed in seeds:
        result = design_excitation(Design(problem, options, motion), np.random.default_rng(seed))
        found.append(mass_and_centre(problem, result.trajectory))
    spent = (time.process_time() - began) / len(seeds)
    ratio, check = sines / np.median(found, axis=0), result.limit_check
    neighbours = problem.obstacles.neighbours.distance
    stated = min(check.nearest.distance - check.resolution, neighbours - DISTANCE_RESOLUTION)
    real = nearest(robot, result.trajectory)
    name = f"{path.parent.name}/{path.stem}"
    return (
        f"{name:38s} {robot.n_joints} joints  mass {ratio[0]:5.1f}  centre {ratio[1]:5.1f}  "
        f"stated {1e3 * stated:6.1f} mm  real {1e3 * real:6.1f} mm  "
        f"tool {check.tool_speed:4.2f} m/s  {spent:4.0f} s  J {np.log(result.objective):.4f}  "
        + ", ".join(f"{name} {price:.2f}" for name, price in result.prices.items() if price > 0.01)
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--arms", default="")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--weight", type=float, default=optimise.FIRST_WEIGHT)
    for name in ("iterations", "rounds", "draws"):
        usual = getattr(ExcitationOptions, name)
        parser.add_argument(f"--{name}", type=int, default=usual)
    chosen = parser.parse_args()
    effort = {name: getattr(chosen, name) for name in ("iterations", "rounds", "draws")}
    optimise.FIRST_WEIGHT = chosen.weight
    for path, joint in [(GUESS, None), *((MODELS / model, joint) for model, joint in ARMS)]:
        if chosen.arms in str(path):
            print(line(path, joint, chosen.seeds, **effort), flush=True)


if __name__ == "__main__":
    main()
