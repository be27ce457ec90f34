"""How much more an optimised trajectory tells than the random sinusoids, and what it costs.

    python -m benchmarks.excitation_proof [MODEL.xml] [--searches N] [--workers W]

Prints for each seed the predicted standard deviations of mass, centre of mass and Izz, for the
median of ten random sinusoids and for the optimised trajectory; then how far 1000 simulated noisy
runs spread, relative to the prediction; then how coarse the time grid may be.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import numpy as np

from robot_sysid.motion.design.optimise import Design
from robot_sysid.motion.design.search import design_excitation
from robot_sysid.motion.information import PredictedInformation
from robot_sysid.motion.options import ExcitationOptions, LimitOptions
from robot_sysid.motion.prediction import predict
from robot_sysid.motion.problem import build_problem
from robot_sysid.parser import load_robot_model
from robot_sysid.simulator import ArmTorque
from robot_sysid.trajectory import TrajectoryOptions, generate_excitation_trajectory
from tests.motion.test_prediction import empirical_deviation_of
from tests.support.places import GUESS

RATE, SIGMA = 1000.0, 0.3


def three(problem, plan):
    """Mass [%], centre of mass [mm], Izz [%]."""
    promised = predict(problem, plan, RATE)
    return np.array(
        [100 * promised.share[0], 1000 * promised.com_deviation, 100 * promised.share[9]]
    )


def processor_seconds():
    """Processor time of this process and of its finished children [s]."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def compare(robot, design, searches):
    """Print the comparison; return the last trajectory."""
    problem = design.problem
    torque = ArmTorque(robot)
    sines = [
        three(
            problem,
            generate_excitation_trajectory(robot, np.random.default_rng(s), 15.0, torque)[0],
        )
        for s in range(10)
    ]
    middle = np.median(sines, axis=0)
    print("                 mass %   CoM mm    Izz %")
    print("sinusoids      ", *(f"{v:8.3f}" for v in middle))
    for seed in range(searches):
        wall, cpu = time.time(), processor_seconds()
        result = design_excitation(design, np.random.default_rng(seed))
        found = three(problem, result.trajectory)
        wall, cpu = time.time() - wall, processor_seconds() - cpu
        ratios = " ".join(f"{v:.1f}x" for v in middle / found)
        print(f"optimal seed {seed:2d}", *(f"{v:8.3f}" for v in found), end="  ")
        print(f"{ratios}  {wall:.0f} s, {cpu:.0f} s of processor time", flush=True)
    return result.trajectory


def grid_errors(design, plan):
    """Print the largest error of a predicted deviation for grids of several densities."""
    problem = design.problem

    def deviations(rate):
        time_grid = (np.arange(int(plan.duration * rate)) + 0.5) / rate
        motion = plan.evaluate(time_grid)
        sigma, still = problem.sigma * np.sqrt(len(time_grid)), np.zeros(problem.n_joints)
        chosen = (problem.chain, problem.rows, sigma, still, design.coordinates)
        cache = PredictedInformation(*chosen).evaluate(motion.q, motion.qd, motion.qdd)
        return np.sqrt(np.diag(np.linalg.inv(cache.information)))

    fine = deviations(RATE)
    for per_cycle in (5, 8, 10, 15, 25, 50):
        error = np.max(np.abs(deviations(per_cycle * design.basis.top_frequency_hz) / fine - 1.0))
        print(f"grid of {per_cycle:2d} points per shortest period: {100 * error:.2f} % off at most")


def main():
    """Run all three."""
    parser = argparse.ArgumentParser()
    parser.add_argument("model", nargs="?", type=Path, default=GUESS)
    parser.add_argument("--searches", type=int, default=10)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    robot = load_robot_model(arguments.model)
    options = ExcitationOptions(workers=arguments.workers)
    design = Design(build_problem(robot, LimitOptions()), options, TrajectoryOptions())
    plan = compare(robot, design, arguments.searches)
    promised = predict(design.problem, plan, RATE).deviation
    seen = empirical_deviation_of(robot, plan, RATE, SIGMA, 1000)
    print("Monte Carlo spread over prediction:", *(f"{v:.3f}" for v in seen / promised))
    grid_errors(design, plan)


if __name__ == "__main__":
    main()
