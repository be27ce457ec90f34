"""Recordings of small arms with and without a payload, with nothing spoiled or with everything.

``exact_recording`` has exact derivatives, so that the truth solves the equations to rounding.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.equations import link_names
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation.columns import PAYLOAD_NAMES
from robot_sysid.estimation.dataset import Dataset
from robot_sysid.records import Motion
from robot_sysid.signals.filters import design_low_pass
from robot_sysid.signals.process import ProcessedSignals
from tests.support import arms

RATE = 50.0
DURATION = 12.0
CUTOFF = 5.0
PAYLOAD = spatial.theta_from_com(
    1.2,
    np.array([0.03, -0.02, 0.08]),
    np.array([[6, 1, 0.5], [1, 7, -0.4], [0.5, -0.4, 4]]) * 1e-3,
)
_FREQUENCIES = np.array([0.23, 0.47, 0.71, 1.03])


def four_joint_arm(joint='range="-2.5 2.5"'):
    """An arm whose motion shows all of a payload."""
    return arms.robot_of(arms.serial_arm((arms.Z, arms.Y, arms.Y, arms.X), joint=joint))


def wide_motion(seed, joints=4, duration=DURATION, rate=RATE):
    """A sum of sines per joint."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(duration * rate)) / rate
    shape = (len(_FREQUENCIES), joints)
    size = rng.uniform(0.15, 0.5, shape)
    phase = rng.uniform(0.0, 6.0, shape)
    omega = 2.0 * np.pi * _FREQUENCIES[:, None]
    angle = time[:, None, None] * omega + phase
    q, qd, qdd = (
        np.sum(size * omega**k * np.sin(angle + k * np.pi / 2.0), axis=1)
        for k in range(3)
    )
    return Motion(time, q, qd, qdd)


class TrueArm:
    """An arm whose links, friction and torque sensors are others than its model says."""

    def __init__(self, robot, seed, wrong=0.3, payload=PAYLOAD, scale=None):
        rng = np.random.default_rng(seed)
        self.robot = robot
        self.payload = payload
        self.thetas = np.array(
            [changed(link.theta, wrong, rng) for link in robot.links]
        )
        self.coulomb, self.viscous = rng.uniform(0.1, 1.0, (2, robot.n_joints))
        self.offset, self.armature = rng.uniform(0.0, 0.3, (2, robot.n_joints))
        self.scale = np.ones(robot.n_joints) if scale is None else scale

    def torque(self, motion, is_loaded, drift=0.0):
        """What the torque sensors read (N, n)."""
        thetas = self.thetas.copy()
        thetas[-1] += self.payload * is_loaded
        dynamics = LinkDynamics(self.robot)
        rigid = dynamics.motion(motion.q, motion.qd, motion.qdd).torque(thetas)
        friction = self.coulomb * np.sign(motion.qd) + self.viscous * motion.qd
        rest = self.armature * motion.qdd + self.offset
        return self.scale * rigid + (1.0 + drift) * friction + rest

    def values(self, columns, drift=0.0):
        """What the parameters of these columns are in truth (p,)."""
        known = dict(zip(PARAMETER_NAMES, self.thetas[-1]))
        known.update(zip(PAYLOAD_NAMES, self.payload))
        for number, joint in enumerate(self.robot.joint_names):
            for term in ("coulomb", "viscous", "offset", "armature"):
                known[f"{term}[{joint}]"] = getattr(self, term)[number]
            known[f"scale[{joint}]"] = self.scale[number] - 1.0
            known[f"drift[{joint}]"] = drift
        for number in range(self.robot.n_joints - 1):
            known.update(zip(link_names(self.robot, number), self.thetas[number]))
        return np.array([float(known.get(name, 0.0)) for name in columns.names])

    def abba(self, seed, drift=0.0, sigma=0.0, same=False):
        """Four recordings in the order empty, loaded, loaded, empty."""
        found = []
        for number, (loaded, place) in enumerate(
            zip((0, 1, 1, 0), np.linspace(-1.0, 1.0, 4))
        ):
            motion = wide_motion([seed, 0 if same else number], self.robot.n_joints)
            each = self.recording(motion, bool(loaded), place, f"log{number}", drift)
            found.append(noisy(each, sigma, [seed, number]) if sigma else each)
        return found

    def recording(self, motion, is_loaded, place=0.0, name="log", drift=0.0):
        """An exact recording of a motion."""
        tau = self.torque(motion, is_loaded, drift * place)
        return exact_recording(motion, tau, is_loaded, place, name)


def changed(theta, share, rng):
    """A possible body that is off by up to a share in mass, centre of mass and inertia."""
    mass, com, inertia = spatial.com_from_theta(theta)
    heavier, rounder = 1.0 + share * rng.uniform(-1.0, 1.0, 2)
    moved = share * spatial.characteristic_length(theta) * rng.uniform(-1.0, 1.0, 3)
    return spatial.theta_from_com(mass * heavier, com + moved, rounder * inertia)


def exact_recording(motion, tau, is_loaded, place=0.0, name="log"):
    """A recording whose velocities and accelerations are exact and whose rows all count."""
    low_pass = design_low_pass(CUTOFF, RATE)
    joints = motion.q.shape[1]
    still = np.zeros(joints)
    bridged = np.zeros(len(motion.time), dtype=bool)
    turning = np.zeros(motion.q.shape, dtype=bool)
    parts = motion.time, motion.q, motion.qd, motion.qdd, tau, bridged, still, turning
    signals = ProcessedSignals(*parts, low_pass, low_pass, ())
    return Dataset(name, signals, is_loaded, place)


def noisy(recording, sigma, seed):
    """The same recording with white torque noise."""
    shape = recording.torque.shape
    return with_torque(
        recording, sigma * np.random.default_rng(seed).standard_normal(shape)
    )


def with_torque(recording, more):
    """The same recording with further torque (N, n)."""
    signals = recording.source
    return replace(recording, source=replace(signals, tau=signals.tau + more))
