"""Motion whose derivatives are known exactly, for tests of everything that filters signals."""

import numpy as np

from rigs.logs.log_files import arm_of
from robot_sysid.records import Recording
from robot_sysid.signals.process import low_pass_recordings

FREQUENCIES = np.array([0.13, 0.29, 0.43, 0.59])


class Swing:
    """Sums of sines with exact derivatives, of amplitudes in a range [rad]."""

    def __init__(self, seed=0, frequencies=FREQUENCIES, joints=3, sizes=(0.1, 0.4)):
        rng = np.random.default_rng(seed)
        shape = (len(frequencies), joints)
        self.omega = 2.0 * np.pi * frequencies
        self.amplitude = rng.uniform(*sizes, shape)
        self.phase = rng.uniform(0.0, 6.0, shape)

    def q(self, time, order=0):
        """The derivative of this order (N, joints)."""
        omega = self.omega[:, None]
        angle = time[:, None, None] * omega + self.phase + order * np.pi / 2.0
        return np.sum(self.amplitude * omega**order * np.sin(angle), axis=1)

    def measurement(self, time, resolution=0.0):
        """A log whose torque is 2 q + 3 qd + 0.5 qdd."""
        q = self.q(time)
        positions = np.round(q / resolution) * resolution if resolution else q
        return Recording(time, positions, None, self.tau(time))

    def tau(self, time):
        """Torque at any time (N, joints)."""
        return 2.0 * self.q(time) + 3.0 * self.q(time, 1) + 0.5 * self.q(time, 2)


def seconds(duration, rate):
    """Evenly spaced instants from zero on."""
    return np.arange(round(duration * rate) + 1) / rate


def filtered(log, *more, cutoff=None, joint_names=None, is_slide=()):
    """Return a log behind its low-pass; ``more`` are further stretches of it."""
    robot = arm_of(joint_names or "abc"[: log.q.shape[1]], is_slide=is_slide)
    return low_pass_recordings(robot, [log, *more], cutoff)[0][0]
