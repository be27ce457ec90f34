"""How often stated 95 % intervals hold the truth on arms that are not as modelled.

    python -m benchmarks.honest_intervals MODELS_FOLDER [--runs 40] [--arms kinova panda]

Each run draws an arm: the other links off by 2 % (mass, centre of mass as part of the link's size,
twice that for the inertia; each link for itself, and all alike), torque scales, encoder zeros and
the base's tilt off as the cell says, torque noise of 1 % of each joint's largest torque, encoder
steps of 1e-4 rad. Everything is then identified with priors as wide as what was drawn. Printed per
arm and cell, for
the mass of the terminal link and of one in the middle, and Coulomb friction of all joints:
coverage, root mean square error, and that error over the stated one.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robot_sysid.dynamics.equations import other_links
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.dynamics.nuisances import gravity, turned, with_gravity
from robot_sysid.estimation.algebra.nuisances import link_factor
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Measurement, RobotModel
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import generate_excitation_trajectory
from tests.support.core_fits import result_of_logs

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


def log_of(
    robot: RobotModel, cell: Cell, rng: np.random.Generator
) -> tuple[Measurement, np.ndarray, np.ndarray]:
    """Return (what the sensors of an arm drawn for this cell say, its links, its dry friction)."""
    angles = np.radians(cell.tilt) * rng.standard_normal(2)
    arm = with_gravity(robot, turned(gravity(robot), angles))
    plan, _ = generate_excitation_trajectory(robot, rng, DURATION)
    motion = plan.evaluate(np.arange(int(RATE * DURATION)) / RATE)
    exact = next(iter(simulate_inverse(arm, iter([motion]))))
    links = other_links(robot)
    lengths = [float(np.linalg.norm(robot.links[link + 1].translation)) for link in links]
    factor = link_factor([robot.links[link].theta for link in links], 0.01 * cell.links, lengths)
    wrong = factor @ rng.standard_normal(len(factor))
    motion = LinkDynamics(arm).motion(exact.q, exact.qd, exact.qdd)
    rigid = exact.tau - arm.friction.torque(exact.qd) + motion.columns(links) @ wrong
    scales = 1.0 + 0.01 * cell.scale * rng.standard_normal(robot.n_joints)
    dry = 0.03 * np.max(np.abs(rigid), axis=0)
    viscous = dry / np.max(np.abs(exact.qd), axis=0)
    tau = scales * rigid + dry * np.sign(exact.qd) + viscous * exact.qd
    tau += 0.01 * np.max(np.abs(tau), axis=0) * rng.standard_normal(tau.shape)
    q = exact.q + 1e-3 * cell.zero * rng.standard_normal(robot.n_joints)
    truth = np.array([link.theta for link in robot.links])
    for link, change in zip(links, wrong.reshape(-1, 10)):
        truth[link] += change
    return Measurement(exact.time, np.round(q / STEP) * STEP, None, tau), truth, dry


def study(robot: RobotModel, cell: Cell, runs: int) -> dict[str, str]:
    """Return one line per quantity."""
    middle = other_links(robot)[len(other_links(robot)) // 2]
    joint = robot.joint_names[middle]
    found: dict[str, list[tuple[float, float, float]]] = {}
    for seed in range(runs):
        log, truth, friction = log_of(robot, cell, np.random.default_rng(seed))
        result = result_of_logs(robot, [log], cell.options())
        for name, body, link in (
            ("terminal mass", result.links[-1], len(robot.links) - 1),
            ("middle mass", next(b for b in result.links if b.joint == joint), middle),
        ):
            off = body.inertial.mass - truth[link][0]
            found.setdefault(name, []).append((off, body.errors[0], truth[link][0]))
        for each, dry in zip(robot.joint_names, friction.tolist()):
            terms = result.joints[each].terms
            level = terms.get("coulomb") or terms["sigmoid"]
            found.setdefault("Coulomb", []).append((level.value - dry, level.error, dry))
    return {name: _line(*np.array(rows).T) for name, rows in found.items()}


def _line(off: np.ndarray, sigma: np.ndarray, size: np.ndarray) -> str:
    inside = 100.0 * np.mean(np.abs(off) < 1.96 * sigma)
    share = 100.0 * float(np.sqrt(np.mean((off / size) ** 2)))
    return f"{inside:6.0f} %{share:8.2f} %{float(np.sqrt(np.mean((off / sigma) ** 2))):8.2f}"


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("models", type=Path)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=list(ARMS))
    chosen = parser.parse_args()
    head = "coverage     rms  rms/stated"
    print(f"{'arm':<8}{'links scale zeros tilt':<26}{'':<14}{head}")
    for name in chosen.arms:
        robot = load_robot_model(chosen.models / ARMS[name])
        for cell in CELLS:
            words = f"{cell.links:g} % {cell.scale:g} % {cell.zero:g} mrad {cell.tilt:g} deg"
            for quantity, line in study(robot, cell, chosen.runs).items():
                print(f"{name:<8}{words:<26}{quantity:<14}{line}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
