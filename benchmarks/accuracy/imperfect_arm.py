"""Arms with everything that real arms have wrong at once, for proofs of the payload command.

Links, torque scales, encoder zeros, a tilted base, a late torque, friction that grows with the load
and torque noise with a memory: none of it is in the model that the identification gets.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigs.arms.synthetic_data import autocorrelated
from rigs.arms.wrong_arms import WrongArm
from robot_sysid import spatial
from robot_sysid.records import Array, MotionPlan, Recording, RobotModel

RATE = 200.0
STRONG = 1.0
WEAK = 0.3
"""Size of friction and noise in the first half of the joints and in the others."""


@dataclass(frozen=True)
class Imperfections:
    """How large each of them is.

    Attributes:
        links: each link's mass, centre of mass (as part of its size) and moments are off by this.
        scale: standard deviation of the torque scales.
        zero: of the encoder zeros [rad].
        tilt: of the base, in a random direction [rad].
        lag: of the torque behind the position [s].
        load: gear loss per load of the strong joints, give or take 30 %.
        noise: standard deviation of the torque noise of a strong joint [N m], half of it white.
        memory: of the other half [s].
    """

    links: float = 0.02
    scale: float = 0.0
    zero: float = 2e-3
    tilt: float = np.radians(0.5)
    lag: float = 2e-3
    load: float = 0.06
    noise: float = 0.3
    memory: float = 0.03


@dataclass(frozen=True)
class ImperfectArm(WrongArm):
    """An arm whose sensors have noise with a memory.

    Attributes:
        noise: (n,) standard deviation of each joint's torque noise [N m].
        memory: of half of it [samples].
    """

    noise: Array | float = 0.0
    memory: float = 0.0

    def record(
        self, plan: MotionPlan, rng: np.random.Generator, payload: Array | float = 0.0
    ) -> Recording:
        """Return what its sensors say along a plan with a payload (10,) on the terminal body."""
        motion = plan.evaluate(np.arange(0.0, plan.duration, 1.0 / RATE))
        slow = autocorrelated(rng.standard_normal(motion.q.shape), self.memory)
        fast = rng.standard_normal(motion.q.shape)
        noise = self.noise * np.sqrt(0.5) * (slow + fast)
        return self.log(motion, noise, payload)


def draw_imperfect_arm(
    robot: RobotModel, rng: np.random.Generator, off: Imperfections
) -> ImperfectArm:
    """Return an arm drawn at random."""
    n = robot.n_joints
    is_strong = np.arange(n) < n // 2 + 1
    size = np.where(is_strong, STRONG, WEAK)
    thetas = [_wrong(link.theta, off.links, rng) for link in robot.links]
    scales = 1.0 + off.scale * rng.standard_normal(n)
    zeros = off.zero * rng.standard_normal(n)
    direction = rng.uniform(0.0, 2.0 * np.pi)
    return ImperfectArm(
        robot,
        np.array(thetas),
        off.tilt * np.array([np.cos(direction), np.sin(direction)]),
        coulomb=rng.uniform(0.5, 1.5, n) * size,
        viscous=rng.uniform(0.3, 1.0, n) * size,
        loss=np.where(is_strong, off.load * rng.uniform(0.7, 1.3, n), 0.0),
        rotor=rng.uniform(0.05, 0.3, n) * size**2,
        offset=0.3 * size * rng.standard_normal(n),
        scales=scales,
        zeros=zeros,
        lag=off.lag,
        noise=off.noise * size,
        memory=off.memory * RATE,
    )


def _wrong(theta: Array, share: float, rng: np.random.Generator) -> Array:
    """A body that is off by a share in all numbers, with random signs."""
    if not np.any(theta):
        return theta
    mass, com, inertia = spatial.com_from_theta(theta)
    size = max(spatial.characteristic_length(theta), 0.02)
    moments, axes = np.linalg.eigh(inertia)
    moments = moments * (1.0 + share * rng.choice([-1.0, 1.0], 3))
    moved = com + share * size * rng.choice([-1.0, 1.0], 3)
    heavier = mass * (1.0 + share * rng.choice([-1.0, 1.0]))
    return spatial.theta_from_com(heavier, moved, (axes * moments) @ axes.T)
