"""Equations of a made-up arm, for tests of the estimators: no model file, no simulator."""

import numpy as np

from robot_sysid import spatial
from robot_sysid.estimate.rows import Sums
from robot_sysid.regressor import wrench_regressor

Z = np.array([0.0, 0.0, 1.0])
ORIGIN = np.zeros(3)


def joint_rows(rng, count, axis=Z, offset=ORIGIN):
    """(count, 12) rows of one hinge joint: ten inertial columns, Coulomb, viscous."""
    screw = np.concatenate((axis, np.cross(offset, axis)))
    omega, alpha, acceleration = rng.normal(size=(3, count, 3))
    speed = rng.normal(size=count)
    twist = np.hstack((omega, 0.0 * omega))
    regressor = wrench_regressor(twist, np.hstack((alpha, acceleration)))
    inertial = np.einsum("i,ikn->nk", screw, regressor)
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
    """Sums of equations with tau = rows truth + noise, which is one number or one per joint.

    They are nothing but triangles, which are those of all rows at once.
    """
    size = len(names) + 1
    noises = np.broadcast_to(noise, len(equations))
    triangles = np.zeros((len(equations), size, size))
    for triangle, (rows, columns), level in zip(triangles, equations, noises):
        error = 0.0 if rng is None else level * rng.normal(size=len(rows))
        full = np.zeros((max(len(rows), size), size))
        tau = rows @ truth[columns] + error
        full[: len(rows), [*columns, size - 1]] = np.column_stack((rows, tau))
        triangle[:] = np.linalg.qr(full, mode="r")
    counts = np.array([[float(len(rows)) for rows, _ in equations]])
    labels = tuple(f"joint{j}" for j in range(len(equations)))
    return Sums(tuple(names), labels, (), (), counts, ("",), triangles)


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
