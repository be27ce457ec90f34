"""Does ``payload`` state the errors that ``plan --for payload`` predicts? On six public arms.

    python -m benchmarks.trust.payload_plan [--arms PART] [--runs N] [--budget S]

Each run plans a motion with default options, lets a simulated arm play it without and with a load
(empty, loaded, loaded, empty) and weighs the load. The arm's links are 6 % off (standard
deviation), its joints have friction, and its sensors have noise of 1 % of each joint's usual
torque, which the prior `noise` states to the plan (rigs/arms/walk.py).
Printed per arm: predicted and stated standard errors of the mass and of the centre of mass (medians
over the runs), stated over predicted, and the true error over the stated one (root mean square).
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

import robot_sysid as rs
from rigs.arms.walk import RATE, TrueArm
from rigs.files.places import GUESS, MODELS
from robot_sysid.expected.recording import predict, typical_load
from robot_sysid.parser import load_robot_model
from robot_sysid.records.quantities import load_covariance

ARMS = (
    GUESS,
    MODELS / "universal_robots_ur5e/ur5e.xml",
    MODELS / "franka_panda/panda_nohand.xml",
    MODELS / "franka_fr3/FrankaFR3_7DoF.urdf",
    MODELS / "kuka_iiwa_14/iiwa14.xml",
    MODELS / "ufactory_xarm7/xarm7_nohand.xml",
)
LOADS = (0.0, 1.0, 1.0, 0.0)
"""Recordings in order, as shares of the load."""


def weigh(robot, plan, load_mass, seed, folder):
    """Return what ``payload`` identifies from recordings of a simulated arm, without options."""
    arm = TrueArm(robot, seed)
    recordings = []
    for number, share in enumerate(LOADS):
        recording = folder / f"{robot.path.stem}_{seed}_{number}.csv"
        arm.record(recording, plan, share * load_mass)
        recordings.append(recording)
    first, second, third, last = recordings
    identified = rs.payload(robot.path, [first, last], [second, third], order="ABBA")
    return identified.body


def line_of_arm(path, runs, budget, folder):
    """Return the line of one arm."""
    arm = TrueArm(load_robot_model(path))
    planned = rs.plan(
        path,
        for_="payload",
        seed=1,
        sample_rate=RATE,
        priors={"noise": arm.noise.tolist()},
        excitation_time_budget=budget,
    )
    problem = planned.checked.problem
    plan = planned.checked.plan
    options = planned.config.estimation
    prediction = predict(problem, plan, RATE, options, "payload")
    predicted = np.array([prediction.errors[0], prediction.centre_error])
    load_mass = float(typical_load(problem)[0])
    stated = []
    misses = []
    for seed in range(runs):
        body = weigh(planned.robot, plan, load_mass, seed, folder)
        mass_error = float(body.errors[0])
        variances = np.diag(load_covariance(body))[1:4]
        stated.append((mass_error, float(np.sqrt(np.sum(variances)))))
        misses.append((body.mass - load_mass) / mass_error)
    typical = np.median(np.array(stated), axis=0)
    ratio = typical / predicted
    miss = float(np.sqrt(np.mean(np.square(misses))))
    return (
        f"{path.stem:26s} load {load_mass:5.2f} kg  mass {predicted[0]:.2g} -> "
        f"{typical[0]:.2g} kg ({ratio[0]:.2f})  centre {1e3 * predicted[1]:.2g} -> "
        f"{1e3 * typical[1]:.2g} mm ({ratio[1]:.2f})  true over stated {miss:.2f}"
    )


def main():
    """Print a line per arm."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", default="", help="part of the file's name")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--budget", type=float, default=20.0, help="search [s]")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for path in ARMS:
            if options.arms in path.stem:
                line = line_of_arm(path, options.runs, options.budget, Path(folder))
                print(line, flush=True)


if __name__ == "__main__":
    main()
