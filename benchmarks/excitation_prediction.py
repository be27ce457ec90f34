"""Does the error that a plan promises come true? Noisy recordings of one plan, identified each.

    python -m benchmarks.excitation_prediction [--arms PART] [--runs N] [--rate HZ]

One line per arm: spread of the mass, of the centre of mass and of all ten parameters (median) over
the runs, each over what ``plan`` promises of torque noise alone. All but friction of the other
links is known, as the promise says. N runs know a spread to 1 / sqrt(2 N): 9 % for 60.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

from robot_sysid.expected import expect
from robot_sysid.logs.reader import join_measurements
from robot_sysid.motion.design.optimise import Design
from robot_sysid.motion.design.search import design_excitation
from robot_sysid.motion.options import ExcitationOptions, LimitOptions
from robot_sysid.motion.problem import build_problem
from robot_sysid.parser import load_robot_model
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import TrajectoryOptions, motion_chunks
from tests.support.core_fits import BASIC, result_of_logs
from tests.support.places import GUESS, MODELS
from tests.test_expected import KNOWN_ARM

ARMS = (GUESS, MODELS / "franka_panda/panda.xml", MODELS / "universal_robots_ur5e/ur5e.xml")
SIGMA = 0.3
GIVEN = replace(KNOWN_ARM, friction_model=BASIC)
QUICK = ExcitationOptions(draws=60, starts=1, rounds=4, workers=1, time_budget=1e6)


def line(path, runs, rate):
    """The line of one arm."""
    robot = load_robot_model(path)
    problem = build_problem(robot, LimitOptions(), noise_torque=SIGMA)
    motion = TrajectoryOptions(sample_rate=rate)
    plan = design_excitation(Design(problem, QUICK, motion), np.random.default_rng(1)).trajectory
    promised = expect(problem, plan, rate, KNOWN_ARM)
    exact = join_measurements(simulate_inverse(robot, motion_chunks(plan, rate)))
    began, found = time.process_time(), []
    for seed in range(runs):
        noise = SIGMA * np.random.default_rng([seed, 1]).normal(size=exact.tau.shape)
        recording = replace(exact, tau=exact.tau + noise, qd=None, qdd=None)
        found.append(result_of_logs(robot, [recording], GIVEN).links[-1].inertial.theta)
    theta = np.array(found)
    ratio = theta.std(axis=0, ddof=1) / promised.deviation
    centre = theta[:, 1:4] / theta[:, :1]
    com = np.sqrt(np.sum(centre.var(axis=0, ddof=1))) / promised.com_deviation
    return (
        f"{path.parent.name}/{path.stem:28s} {runs} runs at {rate:g} Hz  mass {ratio[0]:.2f}  "
        f"centre {com:.2f}  ten {np.median(ratio):.2f}  ({time.process_time() - began:.0f} s)"
    )


def main() -> None:
    """Print the lines."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--arms", default="")
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--rate", type=float, default=1000.0)
    chosen = parser.parse_args()
    for path in ARMS:
        if chosen.arms in str(path):
            print(line(path, chosen.runs, chosen.rate), flush=True)


if __name__ == "__main__":
    main()
