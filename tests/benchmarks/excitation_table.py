"""Designed trajectories of all public arms: what they buy, how near and fast they get, the cost.

    python -m tests.benchmarks.excitation_table [--arms PART] [--seeds 0 1 2] [--weight W]
        [--iterations K]

One line per arm: mass and centre of mass of random sinusoids (median of ten) over those of a design
with criterion D (median of the seeds), by the bound for all samples; the smallest distance that the
plan states and the real one, by MuJoCo's contacts at 500 Hz; the speed of the tool's fastest point;
processor time of one design.
"""

from __future__ import annotations

import argparse
import copy
import time

import mujoco
import numpy as np

from robot_sysid.excitation.design import optimise
from robot_sysid.excitation.design.optimise import Design
from robot_sysid.excitation.design.search import design_excitation
from robot_sysid.excitation.limit_check import DISTANCE_RESOLUTION
from robot_sysid.excitation.options import ExcitationOptions, LimitOptions
from robot_sysid.excitation.prediction import predict
from robot_sysid.excitation.problem import build_problem
from robot_sysid.parser import load_robot_model
from robot_sysid.simulator import ArmTorque
from robot_sysid.trajectory import (
    TrajectoryOptions,
    generate_excitation_trajectory,
    motion_chunks,
)
from tests.excitation.test_zoo import ARMS
from tests.support.places import GUESS, MODELS

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


def line(path, joint, seeds, iterations):
    """The table's line of one arm."""
    robot = load_robot_model(path, joint=joint)
    options = ExcitationOptions(workers=1, iterations=iterations, time_budget=1e6, starts=2)
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
    stated = min(check.nearest.distance, neighbours) - DISTANCE_RESOLUTION
    real = nearest(robot, result.trajectory)
    name = f"{path.parent.name}/{path.stem}"
    return (
        f"{name:38s} {robot.n_joints} joints  mass {ratio[0]:5.1f}  centre {ratio[1]:5.1f}  "
        f"stated {1e3 * stated:6.1f} mm  real {1e3 * real:6.1f} mm  "
        f"tool {check.tool_speed:4.2f} m/s  {spent:4.0f} s  J {np.log(result.objective):.4f}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--arms", default="")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--weight", type=float, default=optimise.FIRST_WEIGHT)
    parser.add_argument("--iterations", type=int, default=ExcitationOptions.iterations)
    chosen = parser.parse_args()
    optimise.FIRST_WEIGHT = chosen.weight
    for path, joint in [(GUESS, None), *((MODELS / model, joint) for model, joint in ARMS)]:
        if chosen.arms in str(path):
            print(line(path, joint, chosen.seeds, chosen.iterations), flush=True)


if __name__ == "__main__":
    main()
