"""Does an arm identified from its torques move more like itself than the model before?

    OMP_NUM_THREADS=1 python -m benchmarks.rollout_torque [ARM...]

Five public arms play the real one: every link 2 % off, rotor inertia from 0.01 to 1 kg m^2, Coulomb
friction with a Stribeck drop, unequal in the two directions and growing with the load. Torque noise
is 0.1 N m, an encoder step 1e-4 rad. Two designed logs of 30 s at 500 Hz; the errors are those that
``robot-sysid identify --verify-rollout`` prints, on the last fifth of each log.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.real_arms import ARMS
from robot_sysid.config import SysidConfig
from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.parser import load_robot_model
from robot_sysid.pipeline.stages import run
from robot_sysid.records import Measurement
from robot_sysid.simulator import ArmTorque
from robot_sysid.trajectory import generate_excitation_trajectory, motion_chunks
from tests.support.places import MODELS

NAMES = ("panda", "iiwa14", "ur5e", "xarm7", "gen3")
RATE = 500.0
SECONDS = 30.0
LOGS = 2
NOISE = 0.1
STEP = 1e-4
WRONG = 0.02


def main(*names: str) -> None:
    """Print a table."""
    for name in names or NAMES:
        robot = load_robot_model(MODELS / ARMS[name])
        begun = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            logs = write_logs(robot, Path(folder), np.random.default_rng(7))
            config = SysidConfig.of(
                robot.path,
                measurements=logs,
                verify_rollout=True,
                output_dir=Path(folder) / "out",
            )
            outcome = run(config)
        print(
            f"{name}: {time.monotonic() - begun:.0f} s; {outcome.failure or 'model written'}"
        )
        for error in outcome.result.rollout.errors:
            old_error, new_error = error.overall
            print(
                f"  {error.loop} {error.horizon:g} s: {old_error:.3g} -> {new_error:.3g} rad, "
                f"{old_error / new_error:.1f} times smaller"
            )


def write_logs(robot, folder: Path, rng) -> tuple[Path, ...]:
    """Write logs of an arm that differs from its model; return their paths."""
    arm = StandIn(robot, rng)
    paths = []
    for number in range(LOGS):
        plan = generate_excitation_trajectory(robot, rng, SECONDS, ArmTorque(robot))[0]
        chunks = [arm.measure(motion, rng) for motion in motion_chunks(plan, RATE)]
        paths.append(folder / f"log{number}.csv")
        write_measurement_csv(paths[-1], robot.joint_names, chunks)
    return tuple(paths)


class StandIn:
    """The arm behind the logs."""

    def __init__(self, robot, rng) -> None:
        n = robot.n_joints
        self.dynamics = LinkDynamics(robot)
        self.thetas = np.array([other_link(link.theta, rng) for link in robot.links])
        heavy = np.linspace(1.0, 0.2, n)
        self.armature = np.geomspace(1.0, 0.01, n)
        self.coulomb = rng.uniform(2.0, 6.0, n) * heavy
        self.viscous = rng.uniform(2.0, 8.0, n) * heavy
        self.stribeck = 0.3 * self.coulomb
        self.unequal = rng.uniform(-0.1, 0.1, n)
        self.load = rng.uniform(0.02, 0.05, n)

    def measure(self, motion, rng) -> Measurement:
        """Return what the sensors report of a motion."""
        tau = self.dynamics.motion(motion.q, motion.qd, motion.qdd).torque(self.thetas)
        tau += self.armature * motion.qdd
        sign = np.sign(motion.qd)
        dry = self.coulomb * (1.0 + self.unequal * sign) + self.load * np.abs(tau)
        dry += self.stribeck * np.exp(-((motion.qd / 0.05) ** 2))
        tau += dry * sign + self.viscous * motion.qd
        tau += NOISE * rng.normal(size=tau.shape)
        return Measurement(motion.time, STEP * np.round(motion.q / STEP), None, tau)


def other_link(theta, rng):
    """Return a link (10,) with mass, centre of mass and inertia 2 % off."""
    if not np.any(theta):
        return theta
    mass, com, inertia = spatial.com_from_theta(theta)
    factor = 1.0 + WRONG * rng.normal(size=3)
    return spatial.theta_from_com(
        factor[0] * mass, factor[1] * com, factor[2] * inertia
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
