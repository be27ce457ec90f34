"""Logs of arms whose truth is known, for tests of what is wrong with a log.

The truth is the public model with every link a little off, a payload on the terminal link, dry
friction with a Stribeck bump, and torque noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.records import Measurement, MotionPlan, RobotModel
from robot_sysid.trajectory import generate_excitation_trajectory

RATE = 250.0
DURATION = 12.0


@dataclass(frozen=True)
class Truth:
    """A log and what it was made from.

    Attributes:
        robot: the model as the user has it.
        plan: the motion that the seed gives.
        theta: (10,) the true terminal link.
        log: a right log.
        still: (N, n) the torque at rest, by the truth [N m].
        rigid, friction: (N, n) the torque without friction and noise, and friction [N m].
        rng: for what goes wrong.
    """

    robot: RobotModel
    plan: MotionPlan
    theta: np.ndarray
    log: Measurement
    still: np.ndarray
    rigid: np.ndarray
    friction: np.ndarray
    rng: np.random.Generator


def truth_of(
    robot: RobotModel,
    seed: int,
    wrong_links: float = 0.02,
    rate: float = RATE,
    load: float = 0.0,
    played: MotionPlan | None = None,
) -> Truth:
    """A right log of an arm whose links are a little off and that carries something.

    Args:
        robot, seed, wrong_links, rate: of the model, its arm and its log.
        load: mass of a weight that is bolted on beside it [kg].
        played: the motion of the log; None for the one that the seed gives.
    """
    rng = np.random.default_rng(seed)
    plan = generate_excitation_trajectory(robot, rng, DURATION)
    played = played or plan
    time = np.arange(round(rate * played.duration)) / rate
    motion = played.evaluate(time)
    thetas = robot.thetas
    thetas *= 1.0 + wrong_links * rng.normal(size=(len(thetas), 1))
    total = float(np.sum(thetas[:, 0]))
    mass = float(thetas[-1, 0] + total * rng.uniform(0.04, 0.1))
    reach = 0.1 * robot.length
    com = rng.normal(size=3) * 0.3 * reach
    radius = 0.3 * reach * np.diag(rng.uniform(0.5, 1.0, 3))
    second = mass * radius @ radius
    moments = np.trace(second) * np.eye(3) - second
    thetas[-1] = spatial.theta_from_com(mass, com, moments)
    thetas[-1] += spatial.theta_from_com(load, com, load / mass * moments)
    dynamics = LinkDynamics(robot)
    rigid = dynamics.motion(motion.q, motion.qd, motion.qdd).torque(thetas)
    rigid = rigid + robot.armature * motion.qdd
    zero = np.zeros_like(motion.q)
    still = dynamics.motion(motion.q, zero, zero).torque(thetas)
    friction = _friction(rng, rigid, motion.qd)
    tau = rigid + friction
    noise = min(0.3, 0.02 * float(np.max(np.abs(rigid))))
    tau = tau + noise * rng.normal(size=tau.shape)
    step = 2.0 * np.pi / 2**17
    q = np.round(motion.q / step) * step
    log = Measurement(time, q, motion.qd, tau)
    return Truth(robot, plan, thetas[-1], log, still, rigid, friction, rng)


def _friction(rng, rigid, qd):
    """Coulomb, viscous and Stribeck friction of about a tenth of what a joint carries."""
    typical_torque = np.sqrt(np.mean(rigid**2, axis=0))
    typical_torque = np.maximum(typical_torque, 0.03 * typical_torque.max())
    coulomb = typical_torque * rng.uniform(0.02, 0.1, len(typical_torque))
    stribeck = 0.5 * coulomb * np.exp(-((qd / 0.1) ** 2))
    speed = np.maximum(np.sqrt(np.mean(qd**2, axis=0)), 1e-9)
    return np.sign(qd) * (coulomb + stribeck) + 0.05 * typical_torque / speed * qd
