"""Equations of a made-up arm, for tests of the estimators: no model file, no simulator.

The wrench rows here are typed in from Newton and Euler, independently of the package's regressor.
"""

from __future__ import annotations

import numpy as np

from rigs.arms import random_theta
from robot_sysid import spatial
from robot_sysid.estimate.rows import Sums

Z = np.array([0.0, 0.0, 1.0])
ORIGIN = np.zeros(3)


def batch_skew(vectors):
    """(N, 3, 3) cross-product matrices of (N, 3) vectors."""
    return np.cross(vectors[:, None, :], np.eye(3)).swapaxes(1, 2)


def inertia_rows(vectors):
    """(N, 3, 6) matrices with inertia_rows(w) [Ixx Ixy Ixz Iyy Iyz Izz] = I w."""
    rows = np.zeros((len(vectors), 3, 6))
    for k, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        rows[:, i, k] += vectors[:, j]
        if i != j:
            rows[:, j, k] += vectors[:, i]
    return rows


def wrench_rows(omega, alpha, acceleration):
    """(N, 6, 10) rows of [moment, force] about the body origin."""
    spin = batch_skew(omega)
    rows = np.zeros((len(omega), 6, 10))
    rows[:, :3, 1:4] = -batch_skew(acceleration)
    rows[:, :3, 4:] = inertia_rows(alpha) + spin @ inertia_rows(omega)
    rows[:, 3:, 0] = acceleration
    rows[:, 3:, 1:4] = batch_skew(alpha) + spin @ spin
    return rows


def joint_rows(rng, count, axis=Z, offset=ORIGIN):
    """(count, 12) rows of one hinge joint: ten inertial columns, Coulomb, viscous."""
    screw = np.concatenate((axis, np.cross(offset, axis)))
    omega, alpha, acceleration = rng.normal(size=(3, count, 3))
    speed = rng.normal(size=count)
    inertial = np.einsum("i,nik->nk", screw, wrench_rows(omega, alpha, acceleration))
    return np.column_stack((inertial, np.sign(speed), speed))


def arm_equations(rng, joints=3, count=60):
    """[(rows (count, 12), columns (12,))] and names of an arm whose joints point everywhere."""
    names = list(spatial.PARAMETER_NAMES)
    equations = []
    for j in range(joints):
        axis = rng.normal(size=3)
        rows = joint_rows(rng, count, axis / np.linalg.norm(axis), rng.normal(size=3))
        columns = np.append(np.arange(10), [len(names), len(names) + 1])
        names += [f"coulomb[joint{j}]", f"viscous[joint{j}]"]
        equations.append((rows, columns))
    return equations, tuple(names)


def sums_of(equations, names, truth, noise=0.0, rng=None):
    """Sums of equations with tau = rows truth + noise."""
    torques = []
    for rows, columns in equations:
        error = 0.0 if rng is None else noise * rng.normal(size=len(rows))
        torques.append(rows @ truth[columns] + error)
    return Samples(equations, torques).sums(names)


class Samples:
    """An arm's equations with given torques, readable several times."""

    def __init__(self, equations, torques):
        self.equations = equations
        self.torques = torques

    def sums(self, names):
        """Their sums, nothing but triangles, which are those of all rows at once."""
        size = len(names) + 1
        triangles = np.zeros((len(self.equations), size, size))
        for triangle, (rows, columns), tau in zip(
            triangles, self.equations, self.torques
        ):
            full = np.zeros((max(len(rows), size), size))
            full[: len(rows), [*columns, size - 1]] = np.column_stack((rows, tau))
            triangle[:] = np.linalg.qr(full, mode="r")
        joints = tuple(f"joint{j}" for j in range(len(self.equations)))
        counts = np.array([[float(len(tau)) for tau in self.torques]])
        return Sums(tuple(names), joints, (), (), counts, ("",), triangles)


def noisy_samples(seed, noises=(0.1, 0.1, 0.1), count=200):
    """(Samples of a three-joint arm, names, truth, generator), noise [N m] per joint."""
    rng = np.random.default_rng(seed)
    equations, names = arm_equations(rng, joints=3, count=count)
    truth = np.concatenate((random_theta(rng), rng.uniform(0.1, 1.0, 6)))
    torques = []
    for (rows, columns), noise in zip(equations, noises):
        torques.append(rows @ truth[columns] + noise * rng.normal(size=len(rows)))
    return Samples(equations, torques), names, truth, rng


def autocorrelated(white, memory, start=None):
    """Return unit noise (N, n) with autocorrelation exp(-lag / memory), made from white noise.

    Args:
        white: (N, n) white noise of unit variance.
        memory: time constant [samples], 0 for white noise.
        start: (1, n) value before the first sample; None for 0, so that the first samples are
            smaller than the others.
    """
    from scipy.signal import lfilter

    decay = np.exp(-1.0 / memory) if memory else 0.0
    state = decay * (np.zeros_like(white[:1]) if start is None else start)
    weights = [np.sqrt(1.0 - decay**2)], [1.0, -decay]
    return lfilter(*weights, white, axis=0, zi=state)[0]


def terminal_sums(rng, truth, axis=Z, offset=ORIGIN, count=80, noise=0.0):
    """What ``--torques terminal`` collects: one joint, ten inertial and two friction columns."""
    equations = [(joint_rows(rng, count, axis, offset), np.arange(12))]
    names = (*spatial.PARAMETER_NAMES, "coulomb[joint0]", "viscous[joint0]")
    return sums_of(equations, names, truth, noise, rng)
