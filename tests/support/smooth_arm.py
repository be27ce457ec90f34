"""Equations that look like an arm's log: smooth multi-sine rows, torque noise that has a memory."""

from __future__ import annotations

import numpy as np

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from tests.support.synthetic_data import random_body, wrench_rows

N_JOINTS = 7


def remembering_noise(rng, count, width, memory):
    """(count, width) unit noise with autocorrelation exp(-lag / memory); memory 0 is white."""
    from scipy.signal import lfilter

    white = rng.normal(size=(count, width))
    if memory == 0.0:
        return white
    decay = np.exp(-1.0 / memory)
    start = decay * rng.normal(size=(1, width))
    return lfilter([np.sqrt(1.0 - decay**2)], [1.0, -decay], white, axis=0, zi=start)[0]


class SmoothArm:
    """Seven joints, each with the ten inertial columns, Coulomb, viscous and offset.

    Args:
        rng: draws motion and truth.
        rate: samples per second.
        duration: seconds.
    """

    def __init__(self, rng, rate=200.0, duration=15.0):
        self.rate = rate
        self.count = int(rate * duration)
        self.time = np.arange(self.count) / rate
        omega, alpha = self._pair(rng, 3, 1.0)
        acceleration = 9.81 * self._directions(rng) + 0.5 * self._pair(rng, 3, 1.0)[0]
        wrench = wrench_rows(omega, alpha, acceleration)
        names = list(PARAMETER_NAMES)
        self.columns = []
        self.rows = []
        for j in range(N_JOINTS):
            speed = self._pair(rng, 1, 0.7)[0][:, 0]
            screw = self._screw(rng)
            inertial = np.einsum("ni,nik->nk", screw, wrench)
            friction_rows = np.column_stack(
                (np.sign(speed), speed, np.ones(self.count))
            )
            self.columns.append(np.append(np.arange(10), len(names) + np.arange(3)))
            names += [f"{term}[joint{j}]" for term in ("coulomb", "viscous", "offset")]
            self.rows.append(np.hstack((inertial, friction_rows)))
        self.names = tuple(names)
        nuisance = rng.uniform(0.1, 1.0, 3 * N_JOINTS)
        self.truth = np.concatenate((random_body(rng), nuisance))

    def _pair(self, rng, size, amplitude):
        """(signal, derivative), each (N, size): four sines of 0.1 to 0.6 Hz."""
        frequency = 2.0 * np.pi * rng.uniform(0.1, 0.6, (4, size))
        phase = rng.uniform(0.0, 2.0 * np.pi, (4, size))
        angle = self.time[:, None, None] * frequency + phase
        scale = amplitude * rng.uniform(0.3, 1.0, (4, size))
        return np.sum(scale * np.sin(angle), axis=1), np.sum(
            scale * frequency * np.cos(angle), axis=1
        )

    def _directions(self, rng):
        vectors = self._pair(rng, 3, 1.0)[0] + rng.normal(size=3)
        return vectors / np.linalg.norm(vectors, axis=1)[:, None]

    def _screw(self, rng):
        axis = self._directions(rng)
        return np.hstack((axis, np.cross(0.3 * self._pair(rng, 3, 1.0)[0], axis)))

    def noise(self, rng, sigma, memory):
        """(N, 7) noise; ``memory`` is the time constant of its autocorrelation [s], 0 for white."""
        return sigma * remembering_noise(rng, self.count, N_JOINTS, memory * self.rate)

    def torques(self, noise):
        return [
            r @ self.truth[c] + noise[:, j]
            for j, (r, c) in enumerate(zip(self.rows, self.columns))
        ]


def samples_of(arm, torques):
    """The equations of an arm, readable several times."""
    return [(j, rows, torques[j]) for j, rows in enumerate(arm.rows)]


def information_of_samples(arm, samples):
    from robot_sysid.estimation.algebra.least_squares import InformationAccumulator

    joints = [f"joint{j}" for j in range(N_JOINTS)]
    accumulator = InformationAccumulator(arm.names, joints, arm.columns)
    for index, rows, tau in samples:
        accumulator.add(index, rows, tau)
    return accumulator.result()
