"""How often the stated 95 % interval of the mass holds the truth on arms that are not as modelled.

    python -m tests.benchmarks.honest_intervals MODELS_FOLDER [--runs 40] [--arms kinova panda]

Each run draws an arm: the other links off by 2 % (mass, centre of mass as part of the link's size,
twice that for the inertia; each link for itself), torque scales, encoder zeros and the base's tilt
off as the cell says, torque noise of 1 % of each joint's largest torque, encoder steps of 1e-4 rad.
The mass is then identified with priors as wide as what was drawn. Printed per arm and cell:
coverage, root mean square error, and that error over the stated one; for comparison coverage with
noise alone taken for the whole error, and the root mean square error with the links taken as known.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robot_sysid.dynamics.equations import other_links
from robot_sysid.dynamics.gravity import gravity, turned, with_gravity
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.estimation.nuisances import own_errors
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.fit import fit_measured
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Measurement, RobotModel
from robot_sysid.records.progress import Progress
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import generate_excitation_trajectory

ARMS = {
    "kinova": "kinova_gen3/gen3.xml",
    "panda": "franka_panda/panda_nohand.xml",
    "ur5e": "universal_robots_ur5e/ur5e.xml",
    "xarm7": "ufactory_xarm7/xarm7.xml",
}
RATE, DURATION, STEP = 250.0, 15.0, 1e-4


@dataclass(frozen=True)
class Cell:
    """How far an arm is off: links, scale [%], zeros [mrad], tilt [deg]."""

    links: float
    scale: float
    zero: float
    tilt: float

    def options(self, **changes: float) -> EstimationOptions:
        """Return the options that say so."""
        known = {
            "link_uncertainty": self.links,
            "scale_uncertainty": self.scale,
            "zero_uncertainty": self.zero,
            "gravity_uncertainty": self.tilt,
        }
        return EstimationOptions(**{**known, **changes})


CELLS = (Cell(2.0, 1.0, 1.0, 0.1), Cell(2.0, 3.0, 10.0, 0.3))


def log_of(robot: RobotModel, cell: Cell, rng: np.random.Generator) -> Measurement:
    """Return what the sensors of an arm drawn for this cell say along a random trajectory."""
    angles = np.radians(cell.tilt) * rng.standard_normal(2)
    arm = with_gravity(robot, turned(gravity(robot), angles))
    plan, _ = generate_excitation_trajectory(robot, rng, DURATION)
    motion = plan.evaluate(np.arange(int(RATE * DURATION)) / RATE)
    exact = next(iter(simulate_inverse(arm, iter([motion]))))
    links = other_links(robot)
    wrong = []
    for link in links:
        length = float(np.linalg.norm(robot.links[link + 1].translation))
        factor, _ = own_errors(robot.links[link].theta, 0.01 * cell.links, length)
        wrong.append(factor @ rng.standard_normal(10))
    motion = LinkDynamics(arm).motion(exact.q, exact.qd, exact.qdd)
    rigid = (
        exact.tau - arm.friction.torque(exact.qd) + motion.columns(links) @ np.concatenate(wrong)
    )
    scales = 1.0 + 0.01 * cell.scale * rng.standard_normal(robot.n_joints)
    tau = scales * rigid + arm.friction.torque(exact.qd)
    tau += 0.01 * np.max(np.abs(tau), axis=0) * rng.standard_normal(tau.shape)
    q = exact.q + 1e-3 * cell.zero * rng.standard_normal(robot.n_joints)
    return Measurement(exact.time, np.round(q / STEP) * STEP, None, tau)


def study(robot: RobotModel, cell: Cell, runs: int) -> str:
    """Return one line of the table."""
    errors, stated, noise, known = [], [], [], []
    for seed in range(runs):
        log = log_of(robot, cell, np.random.default_rng(seed))
        found = fit_measured(robot, [log], cell.options(validate=0.0), Progress()).estimate
        errors.append(found.values[0] / robot.prior.mass - 1.0)
        stated.append(found.standard_errors[0] / robot.prior.mass)
        plain = {"link_uncertainty": 0.0, "validate": 0.0}
        noise.append(found.noise_errors[0] / robot.prior.mass)
        bare = fit_measured(robot, [log], cell.options(**plain), Progress()).estimate
        known.append(bare.values[0] / robot.prior.mass - 1.0)
    off, sigma = np.array(errors), np.array(stated)
    rms = float(np.sqrt(np.mean(off**2)))
    ratio = rms / float(np.sqrt(np.mean(sigma**2)))
    inside = 100.0 * np.mean(np.abs(off) < 1.96 * sigma)
    narrow = 100.0 * np.mean(np.abs(off) < 1.96 * np.array(noise))
    links_known = 100.0 * float(np.sqrt(np.mean(np.square(known))))
    return f"{inside:6.0f} %{100.0 * rms:8.2f} %{ratio:8.2f}{narrow:12.0f} %{links_known:12.2f} %"


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("models", type=Path)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=list(ARMS))
    chosen = parser.parse_args()
    head = "coverage     rms  rms/stated  noise alone  links known"
    print(f"{'arm':<8}{'links scale zeros tilt':<26}{head}")
    for name in chosen.arms:
        robot = load_robot_model(chosen.models / ARMS[name])
        for cell in CELLS:
            words = f"{cell.links:g} % {cell.scale:g} % {cell.zero:g} mrad {cell.tilt:g} deg"
            print(f"{name:<8}{words:<26}{study(robot, cell, chosen.runs)}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
