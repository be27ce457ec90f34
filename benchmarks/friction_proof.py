"""Friction and rotor inertia of simulated arms whose truth is known, from designed motions.

Run from the checkout; needs the public models, a few minutes per arm:

    OMP_NUM_THREADS=1 python -m benchmarks.friction_proof [ARM...]

Truth: links 2 % off the model (mass, centre of mass, inertia), rotor inertia from 1 kg m^2 at the
base to 0.01 at the wrist, Coulomb friction that is larger one way than the other, viscous friction,
a Stribeck drop, and a loss of 5 % of what the gear carries; 0.1 N m of noise and encoder steps of
1e-4 rad at 500 Hz. The user's model is the public one, with its own armature and friction. Logs:
three of sines of 30 s (`plan --for arm`), and one of the first of them five times slower (`--speed
0.2`), with `--max-velocity 2`, which is within the limits of all arms.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from benchmarks.arm_results import result_of_logs
from rigs.places import MODELS
from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.motion import ExcitationOptions, LimitOptions
from robot_sysid.motion.expected_errors import prior_knowledge
from robot_sysid.motion.problem import build_problem
from robot_sysid.motion.search import Design, design_excitation
from robot_sysid.motion.trajectories import at_speed
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Recording
from robot_sysid.records.messages import Progress
from robot_sysid.trajectory import TrajectoryOptions

ARMS = {
    "Kinova Gen3": "kinova_gen3/gen3.xml",
    "Franka Panda": "franka_panda/panda_nohand.xml",
    "KUKA iiwa 14": "kuka_iiwa_14/iiwa14.xml",
    "UR5e": "universal_robots_ur5e/ur5e.xml",
    "xArm 7": "ufactory_xarm7/xarm7_nohand.xml",
}
RATE = 500.0
NOISE = 0.1
STEP = 1e-4
WRONG = 0.02
SINES = (1, 2, 3)
DRAWS = 40
FASTEST = 2.0
GOALS = {"armature": 0.03, "coulomb": 0.05, "viscous": 0.05}


class Truth:
    """An arm that differs from its model, with friction that no MJCF can hold.

    Attributes:
        robot: the user's model.
        thetas: (n, 10) its true links.
        armature, coulomb, viscous, stribeck, speed, load, offset: (n,).
    """

    def __init__(self, robot, rng: np.random.Generator) -> None:
        joints = robot.n_joints
        self.robot = robot
        thetas = [draw_wrong_link(link.theta, rng) for link in robot.links]
        self.thetas = np.array(thetas)
        self.armature = np.geomspace(1.0, 0.01, joints)
        self.coulomb = np.geomspace(6.0, 1.0, joints) * rng.uniform(0.8, 1.2, joints)
        self.viscous = self.coulomb * rng.uniform(0.5, 1.5, joints)
        self.stribeck = 0.4 * self.coulomb
        self.speed = rng.uniform(0.03, 0.1, joints)
        self.load = np.full(joints, 0.05)
        self.offset = 0.1 * self.coulomb * rng.choice((-1.0, 1.0), joints)

    def torque(self, motion) -> np.ndarray:
        """Return the motors' torques (N, n)."""
        links = LinkDynamics(self.robot).motion(motion.q, motion.qd, motion.qdd)
        carried = links.torque(self.thetas)
        sign = np.sign(motion.qd)
        level = self.coulomb + self.stribeck * np.exp(-((motion.qd / self.speed) ** 2))
        level = level + self.load * np.abs(carried)
        smooth = self.armature * motion.qdd + self.viscous * motion.qd + self.offset
        return carried + smooth + sign * level

    def log(self, plan, rng: np.random.Generator) -> Recording:
        """Return what sensors report along a plan."""
        clock = np.arange(0.0, plan.duration, 1.0 / RATE)
        motion = plan.evaluate(clock)
        tau = self.torque(motion) + NOISE * rng.normal(size=motion.q.shape)
        q = np.round(motion.q / STEP) * STEP
        return Recording(clock, q, None, tau)


def draw_wrong_link(theta, rng):
    """Return a link's parameters (10,) with mass, centre of mass and inertia 2 % off."""
    if not np.any(theta):
        return theta
    mass, com, inertia = spatial.com_from_theta(theta)
    size = spatial.characteristic_length(theta)
    com = com + WRONG * size * rng.normal(size=3)
    factor, other = 1.0 + WRONG * rng.normal(size=2)
    return spatial.theta_from_com(factor * mass, com, other * inertia)


def plans(robot):
    """Return the designed motions: a slow one for friction, then sines at full speed."""
    problem = build_problem(robot, LimitOptions(max_velocity=FASTEST))
    options = ExcitationOptions(kind="optimal", draws=DRAWS)
    knowledge = prior_knowledge(problem, EstimationOptions(), "arm")
    design = Design(problem, options, TrajectoryOptions(duration=30.0), knowledge)
    sines = [
        design_excitation(design, np.random.default_rng(seed), Progress())
        for seed in SINES
    ]
    return [at_speed(sines[0], 0.2), *sines]


def prove(name: str, path: str) -> None:
    """Print the table of one arm."""
    robot = load_robot_model(MODELS / path)
    rng = np.random.default_rng(0)
    truth = Truth(robot, rng)
    start = time.perf_counter()
    motions = plans(robot)
    designed = time.perf_counter() - start
    logs = [truth.log(plan, rng) for plan in motions]
    start = time.perf_counter()
    result = result_of_logs(robot, logs, EstimationOptions())
    spent = time.perf_counter() - start
    lengths = ", ".join(f"{plan.duration:.0f} s" for plan in motions)
    print(
        f"{name}: motions {lengths} designed in {designed:.0f} s; identified in {spent:.0f} s"
    )
    scales = ", ".join(
        f"{quantity} {scale:.2g}" for quantity, scale in result.link_scales.items()
    )
    print(
        f"  links off by so many times their share: {scales}; low-pass {result.cutoff:g} Hz"
    )
    for index, joint in enumerate(robot.joint_names):
        cells = [
            _cell(result.quantity(term, joint), getattr(truth, term)[index])
            for term in GOALS
        ]
        print(f"  {joint:22s} " + " ".join(cells))


def _cell(row, true_value) -> str:
    """Return the table's cell of one number of a joint: relative error and stated error."""
    term = row.name
    off = row.value / true_value - 1.0
    error = row.error / true_value
    mark = " " if abs(off) <= GOALS[term] else "!"
    return f"{term} {100 * off:+6.1f} ±{100 * error:4.1f} %{mark}"


if __name__ == "__main__":
    arm_names = sys.argv[1:] or list(ARMS)
    for arm in arm_names:
        prove(arm, ARMS[arm])
