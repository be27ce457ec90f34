"""Motion whose derivatives are known exactly, for tests of everything that filters signals."""

from __future__ import annotations

import numpy as np

from robot_sysid.records import Measurement
from robot_sysid.signals.process import process
from robot_sysid.signals.resampling import resample_uniformly

FREQUENCIES = np.array([0.13, 0.29, 0.43, 0.59])


class Swing:
    """Sums of sines with exact derivatives, three joints."""

    def __init__(self, seed: int = 0, frequencies: np.ndarray = FREQUENCIES) -> None:
        rng = np.random.default_rng(seed)
        self.omega = 2.0 * np.pi * frequencies
        self.amplitude = rng.uniform(0.1, 0.4, (len(frequencies), 3))
        self.phase = rng.uniform(0.0, 6.0, (len(frequencies), 3))

    def q(self, time: np.ndarray, order: int = 0) -> np.ndarray:
        """The derivative of this order (N, 3)."""
        omega = self.omega[:, None]
        angle = time[:, None, None] * omega + self.phase + order * np.pi / 2.0
        return np.sum(self.amplitude * omega**order * np.sin(angle), axis=1)

    def measurement(self, time: np.ndarray, resolution: float = 0.0) -> Measurement:
        """A log whose torque is 2 q + 3 qd + 0.5 qdd."""
        q = self.q(time)
        positions = np.round(q / resolution) * resolution if resolution else q
        return Measurement(time, positions, None, self.tau(time))

    def tau(self, time: np.ndarray) -> np.ndarray:
        """Torque at any time (N, 3)."""
        return 2.0 * self.q(time) + 3.0 * self.q(time, 1) + 0.5 * self.q(time, 2)


def seconds(duration: float, rate: float) -> np.ndarray:
    """Evenly spaced instants from zero on."""
    return np.arange(round(duration * rate) + 1) / rate


def processed(log, joint_names=("joint0", "joint1", "joint2"), *args, **options):
    """Return the processed signals of a log."""
    return process(resample_uniformly(log), joint_names, *args, **options)
