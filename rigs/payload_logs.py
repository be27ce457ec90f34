"""Recordings of small arms with and without a payload, exact or with noise and model errors.

``exact_recording`` has exact derivatives and no filter, so that the truth solves the equations to
rounding.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigs import arms
from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics, link_names
from robot_sysid.estimate.terms import PAYLOAD_NAMES
from robot_sysid.records import Motion
from robot_sysid.signals.filters import LowPass
from robot_sysid.signals.process import FilteredRecording
from robot_sysid.spatial import PARAMETER_NAMES

RATE = 50.0
DURATION = 12.0
UNFILTERED = LowPass(20.0, RATE, np.ones(1), 1)
"""A low-pass that passes everything: columns and torques agree to rounding."""
PAYLOAD = spatial.theta_from_com(
    1.2,
    np.array([0.03, -0.02, 0.08]),
    np.array([[6, 1, 0.5], [1, 7, -0.4], [0.5, -0.4, 4]]) * 1e-3,
)
_FREQUENCIES = np.array([0.23, 0.47, 0.71, 1.03])
_JOINT_TERMS = ("coulomb", "viscous", "offset", "armature")


def four_joint_xml(joint='range="-2.5 2.5"'):
    """Return the model of an arm whose motion shows all parameters of a payload."""
    return arms.serial_arm((arms.Z, arms.Y, arms.Y, arms.X), joint=joint)


def four_joint_arm(joint='range="-2.5 2.5"'):
    """Return the RobotModel of ``four_joint_xml``."""
    return arms.robot_of(four_joint_xml(joint))


def wide_motion(seed, joints=4, duration=DURATION, rate=RATE, delay=0.0):
    """Return a motion in which every joint follows a random sum of sines, all of it late [s]."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(duration * rate)) / rate
    shape = (len(_FREQUENCIES), joints)
    size = rng.uniform(0.15, 0.5, shape)
    phase = rng.uniform(0.0, 6.0, shape)
    omega = 2.0 * np.pi * _FREQUENCIES[:, None]
    angle = (time - delay)[:, None, None] * omega + phase
    derivatives = []
    for k in range(3):
        waves = size * omega**k * np.sin(angle + k * np.pi / 2.0)
        derivatives.append(np.sum(waves, axis=1))
    return Motion(time, *derivatives)


class TrueArm:
    """An arm whose links, friction and torque sensors differ from its model.

    Args:
        robot: the model.
        seed: draws what differs.
        model_error: each link differs by up to this share of its mass and size.
        payload: (10,) body that loaded recordings carry beside the terminal link.
        scale: (n,) torque scales; None are ones.
    """

    def __init__(self, robot, seed, model_error=0.3, payload=PAYLOAD, scale=None):
        rng = np.random.default_rng(seed)
        self.robot = robot
        self.payload = payload
        thetas = [perturb_body(link.theta, model_error, rng) for link in robot.links]
        self.thetas = np.array(thetas)
        self.coulomb, self.viscous = rng.uniform(0.1, 1.0, (2, robot.n_joints))
        self.offset, self.armature = rng.uniform(0.0, 0.3, (2, robot.n_joints))
        self.scale = np.ones(robot.n_joints) if scale is None else scale

    def rigid_torque(self, motion, is_loaded):
        """Return the torque (N, n) of the links and the payload alone."""
        thetas = self.thetas.copy()
        thetas[-1] += self.payload * is_loaded
        dynamics = LinkDynamics(self.robot)
        return dynamics.motion(motion.q, motion.qd, motion.qdd).torque(thetas)

    def torque(self, motion, is_loaded, drift=0.0):
        """Return the readings of the torque sensors (N, n)."""
        rigid = self.rigid_torque(motion, is_loaded)
        friction = self.coulomb * np.sign(motion.qd) + self.viscous * motion.qd
        rotor_and_offset = self.armature * motion.qdd + self.offset
        return self.scale * rigid + (1.0 + drift) * friction + rotor_and_offset

    def values(self, names, drift=0.0):
        """Return the true values (p,) of named parameters."""
        value_of = dict(zip(PARAMETER_NAMES, self.thetas[-1]))
        value_of.update(zip(PAYLOAD_NAMES, self.payload))
        for number, joint in enumerate(self.robot.joint_names):
            for term in _JOINT_TERMS:
                value_of[f"{term}[{joint}]"] = getattr(self, term)[number]
            value_of[f"scale[{joint}]"] = self.scale[number] - 1.0
            value_of[f"drift[{joint}]"] = drift
        for number in range(self.robot.n_joints - 1):
            value_of.update(zip(link_names(self.robot, number), self.thetas[number]))
        return np.array([float(value_of.get(name, 0.0)) for name in names])

    def abba(self, seed, drift=0.0, sigma=0.0):
        """Return four recordings in the order empty, loaded, loaded, empty."""
        recordings = []
        for number, is_loaded in enumerate((False, True, True, False)):
            motion = wide_motion([seed, number], self.robot.n_joints)
            place = np.linspace(-1.0, 1.0, 4)[number]
            name = f"log{number}"
            recording = self.recording(motion, is_loaded, place, name, drift)
            recordings.append(add_noise(recording, sigma, [seed, number]))
        return recordings

    def recording(self, motion, is_loaded, place=0.0, name="log", drift=0.0):
        """Return the exact recording of a motion."""
        tau = self.torque(motion, is_loaded, drift * place)
        return exact_recording(motion, tau, is_loaded, place, name)


def perturb_body(theta, share, rng):
    """Return a possible body that differs by up to a share in mass, centre of mass and inertia."""
    mass, com, inertia = spatial.com_from_theta(theta)
    mass_factor, inertia_factor = 1.0 + share * rng.uniform(-1.0, 1.0, 2)
    shift = share * spatial.characteristic_length(theta) * rng.uniform(-1.0, 1.0, 3)
    return spatial.theta_from_com(
        mass * mass_factor, com + shift, inertia_factor * inertia
    )


def exact_recording(motion, tau, is_loaded, place=0.0, name="log"):
    """Return a recording whose velocities and accelerations are exact and whose rows all count."""
    fields = {"name": name, "is_loaded": is_loaded, "order": place}
    return FilteredRecording.exact(motion, tau, UNFILTERED, **fields)


def add_noise(recording, sigma, seed):
    """Return a recording with additional white torque noise [N m]."""
    rng = np.random.default_rng(seed)
    return add_torque(recording, sigma * rng.standard_normal(recording.torque.shape))


def add_torque(recording, torque):
    """Return a recording with additional torque (N, n)."""
    return replace(recording, tau=recording.tau + torque)
