"""Recordings of small arms with and without a payload, exact or with noise and model errors.

``exact_recording`` has exact derivatives and no filter, so that the truth solves the equations to
rounding.
"""

from dataclasses import replace

import numpy as np

from rigs.arms import small_arms
from rigs.arms.wrong_arms import WrongArm
from rigs.logs.swing import Swing
from robot_sysid import spatial
from robot_sysid.estimate.terms import PAYLOAD_NAMES
from robot_sysid.records import Motion
from robot_sysid.signals.filters import LowPass
from robot_sysid.signals.process import FilteredRecording

RATE = 50.0
DURATION = 8.0
UNFILTERED = LowPass(20.0, RATE, np.ones(1), 1)
"""A low-pass that passes everything: columns and torques agree to rounding."""
PAYLOAD = spatial.theta_from_com(
    1.2,
    np.array([0.03, -0.02, 0.08]),
    np.array([[6, 1, 0.5], [1, 7, -0.4], [0.5, -0.4, 4]]) * 1e-3,
)
_FREQUENCIES = np.array([0.23, 0.47, 0.71, 1.03])


def four_joint_xml(joint='range="-2.5 2.5"'):
    """Return the model of an arm whose motion shows all parameters of a payload."""
    return small_arms.serial_arm(
        (small_arms.Z, small_arms.Y, small_arms.Y, small_arms.X), joint=joint
    )


def four_joint_arm(joint='range="-2.5 2.5"'):
    """Return the RobotModel of ``four_joint_xml``."""
    return small_arms.robot_of(four_joint_xml(joint))


def wide_motion(seed, joints=4, duration=DURATION, rate=RATE):
    """Return a motion in which every joint follows a random sum of sines."""
    swing = Swing(seed, _FREQUENCIES, joints, (0.15, 0.5))
    time = np.arange(round(duration * rate)) / rate
    return Motion(time, *(swing.q(time, order) for order in range(3)))


class TrueArm(WrongArm):
    """An arm whose links, friction and torque sensors differ from its model.

    Args:
        robot: the model.
        seed: draws what differs.
        model_error: each link differs by up to this share of its mass and size.
        payload: (10,) body that loaded recordings carry beside the terminal link.
        fields: those of ``WrongArm`` that are not to be drawn.
    """

    def __init__(self, robot, seed, model_error=0.3, payload=PAYLOAD, **fields):
        rng = np.random.default_rng(seed)
        thetas = [perturb_body(link.theta, model_error, rng) for link in robot.links]
        coulomb, viscous = rng.uniform(0.1, 1.0, (2, robot.n_joints))
        offset, rotor = rng.uniform(0.0, 0.3, (2, robot.n_joints))
        drawn = {
            "coulomb": coulomb,
            "viscous": viscous,
            # As small beside the strongest joint's torque as offsets usually are.
            "offset": 0.1 * offset,
            "rotor": rotor,
        }
        super().__init__(robot, np.array(thetas), np.zeros(2), **{**drawn, **fields})
        self.__dict__["payload"] = payload

    def values(self, names):
        """Return the true values (p,) of parameters, those of the payload among them."""
        of_payload = dict(zip(PAYLOAD_NAMES, self.payload))
        others = zip(names, super().values(names))
        return np.array([of_payload.get(name, value) for name, value in others])

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
        """Return the exact recording of a motion; friction drifts with the place."""
        rigid, friction = self.torques(motion, self.payload * is_loaded)
        tau = self.scales * rigid + (1.0 + drift * place) * friction + self.offset
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
