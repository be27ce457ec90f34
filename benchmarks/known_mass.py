"""Torque scales from known masses: errors of payloads that are weighed with them.

    python -m benchmarks.known_mass MODELS [--runs 5] [--sets 2] [--arms gen3 panda]

Each run draws an imperfect arm whose torque scales are 3 % off per joint, calibrates it with 2 kg
on several sets of recordings, each starting from the scales of the set before, and weighs three
other payloads on new recordings along new trajectories, without and with these scales.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.imperfect_arm import Imperfections, draw_imperfect_arm
from benchmarks.payload_by_difference import recordings, rms, weigh
from rigs.wrong_arms import ARMS
from robot_sysid import spatial
from robot_sysid.estimate.options import EstimationOptions, Priors
from robot_sysid.parser import load_robot_model

WEIGHT = 2.0
PAYLOADS = (0.7, 1.2, 1.9)
SCALE = 0.03


def body(mass):
    """Return a payload (10,) of this mass [kg], with its centre of mass off the axis."""
    inertia = mass * np.diag([0.004, 0.005, 0.003])
    return spatial.theta_from_com(mass, np.array([0.03, -0.02, 0.08]), inertia)


def divide_by_scale(recording, scale):
    """Return a recording with its torques divided by scales (n,)."""
    samples = replace(recording, tau=recording.tau / scale)
    return replace(recording, samples=samples)


def calibration(robot, arm, rng, sets):
    """Return torque scales (n,) by recordings with a weight, and their errors (n,) [%]."""
    scale = np.ones(robot.n_joints)
    sure = None
    for _ in range(sets):
        raw = recordings(robot, arm, rng, payload=body(WEIGHT))
        logs = [divide_by_scale(recording, scale) for recording in raw]
        options = EstimationOptions(priors=Priors(scale=sure))
        result = weigh(robot, logs, options, known_mass=WEIGHT)
        rows = [result.quantity("torque_scale", joint) for joint in robot.joint_names]
        more = np.array([row.value for row in rows])
        errors = np.array([row.error for row in rows])
        scale = scale * more
        sure = tuple((100.0 * errors / more).tolist())
    return scale, sure


def run(robot, seed, sets):
    """Return relative errors as measured and with scales, stated errors, scales' coverage."""
    rng = np.random.default_rng([seed, 78])
    arm = draw_imperfect_arm(robot, rng, Imperfections(scale=SCALE))
    scale, sure = calibration(robot, arm, rng, sets)
    off = [abs(scale / arm.scales - 1.0) < 1.96e-2 * np.array(sure)]
    plain = []
    scaled = []
    stated = []
    for mass in PAYLOADS:
        raw = recordings(robot, arm, rng, payload=body(mass))
        plain.append(weigh(robot, raw).payload.mass / mass - 1.0)
        better = [divide_by_scale(recording, scale) for recording in raw]
        options = EstimationOptions(priors=Priors(scale=sure))
        result = weigh(robot, better, options).payload
        scaled.append(result.mass / mass - 1.0)
        stated.append(result.errors[0] / mass)
    return plain, scaled, stated, off


def main():
    """Print a line per arm."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", type=Path)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--sets", type=int, default=1)
    parser.add_argument(
        "--arms", nargs="+", default=["gen3", "panda"], choices=list(ARMS)
    )
    options = parser.parse_args()
    for name in options.arms:
        robot = load_robot_model(options.models / ARMS[name])
        rows = []
        for seed in range(options.runs):
            rows.append(run(robot, seed, options.sets))
            print(
                f"  {name} run {seed}: {np.round(100 * np.array(rows[-1][:2]), 2)} %",
                file=sys.stderr,
            )
        plain, scaled, stated, off = zip(*rows)
        print(
            f"{name}, scales 3 % off, {len(rows)} arms, {len(rows) * len(PAYLOADS)} payloads: "
            f"rms {100.0 * rms(plain):.2f} % as measured, {100.0 * rms(scaled):.2f} % with the "
            f"scales of {WEIGHT:g} kg in {options.sets} sets "
            f"(stated {100.0 * rms(stated):.2f} %); "
            f"95 % intervals of the scales cover {100.0 * np.mean(off):.0f} %",
            flush=True,
        )


if __name__ == "__main__":
    main()
