"""An arm with everything that real arms have wrong at once, for proofs of the payload command.

Links, torque scales, encoder zeros, a tilted base, a late torque, friction that grows with the load
and torque noise with a memory: none of it is in the model that the identification gets.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigs.synthetic_data import autocorrelated
from robot_sysid import spatial
from robot_sysid.dynamics.friction import FADING_SPEEDS
from robot_sysid.dynamics.inverse_dynamics import (
    LinkDynamics,
    gravity_vector,
    turn_gravity,
)
from robot_sysid.records import Measurement

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
        step: of the encoders [rad].
    """

    links: float = 0.02
    scale: float = 0.0
    zero: float = 2e-3
    tilt: float = np.radians(0.5)
    lag: float = 2e-3
    load: float = 0.06
    noise: float = 0.3
    memory: float = 0.03
    step: float = 1e-4


class ImperfectArm:
    """One arm drawn at random.

    Args:
        robot: what its model says.
        rng: source of randomness.
        off: how much is wrong.
        scale: (n,) torque scales; None draws them.
    """

    def __init__(self, robot, rng, off=Imperfections(), scale=None):
        n = robot.n_joints
        self.robot = robot
        self.off = off
        strong = np.arange(n) < n // 2 + 1
        self.size = np.where(strong, STRONG, WEAK)
        thetas = [_wrong(link.theta, off.links, rng) for link in robot.links]
        self.thetas = np.array(thetas)
        drawn = 1.0 + off.scale * rng.standard_normal(n)
        self.scale = drawn if scale is None else scale
        self.zero = off.zero * rng.standard_normal(n)
        direction = rng.uniform(0.0, 2.0 * np.pi)
        self.tilt = off.tilt * np.array([np.cos(direction), np.sin(direction)])
        gravity = turn_gravity(gravity_vector(robot), self.tilt)
        self.dynamics = LinkDynamics(robot, gravity)
        self.coulomb = rng.uniform(0.5, 1.5, n) * self.size
        self.viscous = rng.uniform(0.3, 1.0, n) * self.size
        self.load = np.where(strong, off.load * rng.uniform(0.7, 1.3, n), 0.0)
        self.rotor = rng.uniform(0.05, 0.3, n) * self.size**2
        self.offset = 0.3 * self.size * rng.standard_normal(n)

    def sensors(self):
        """What is true of its sensors and base, by the names of ``Result.sensors``."""
        truth = {"delay": self.off.lag, "tilt_1": self.tilt[0], "tilt_2": self.tilt[1]}
        for index, joint in enumerate(self.robot.joint_names):
            truth[f"scale[{joint}]"] = self.scale[index] - 1.0
            truth[f"zero[{joint}]"] = self.zero[index]
            truth[f"load[{joint}]"] = self.load[index]
            for term in ("sqrt", *FADING_SPEEDS):
                truth[f"{term}[{joint}]"] = 0.0
        return truth

    def log(self, plan, payload, rng):
        """What its sensors say along a plan with a payload (10,) on the terminal body."""
        off = self.off
        time = np.arange(0.0, plan.duration, 1.0 / RATE)
        motion = plan.evaluate(time)
        delayed_motion = plan.evaluate(np.clip(time - off.lag, 0.0, plan.duration))
        thetas = self.thetas.copy()
        thetas[-1] += payload
        qd = delayed_motion.qd
        links = self.dynamics.motion(delayed_motion.q, qd, delayed_motion.qdd)
        rigid = links.torque(thetas)
        dry = self.coulomb + self.load * np.abs(rigid)
        tau = self.scale * rigid + (dry * np.sign(qd) + self.viscous * qd)
        tau = tau + self.rotor * delayed_motion.qdd + self.offset
        q = np.round((motion.q + self.zero) / off.step) * off.step
        return Measurement(time, q, None, tau + self._noise(tau.shape, rng))

    def _noise(self, shape, rng):
        slow = autocorrelated(rng.standard_normal(shape), self.off.memory * RATE)
        fast = rng.standard_normal(shape)
        return self.off.noise * self.size * np.sqrt(0.5) * (slow + fast)


def _wrong(theta, share, rng):
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
