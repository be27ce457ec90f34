"""Equations of a made-up arm, for tests of the estimators: no model file, no simulator.

The wrench rows here are typed in from Newton and Euler, independently of the package's regressor.
"""

from __future__ import annotations

import warnings

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.algebra.least_squares import InformationAccumulator

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


def random_body(rng, spread=1.0):
    """theta of a random rigid body: J = L L^T; small ``spread`` brings it near the boundary."""
    factor = np.tril(rng.normal(size=(4, 4))) * np.array([[0.1], [0.1], [0.1], [1.0]])
    factor[:, 0] *= spread
    return spatial.theta_from_pseudo_inertia(
        factor @ factor.T + 1e-6 * np.eye(4) * spread
    )


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


def information_of(equations, names, truth, noise=0.0, rng=None):
    """SquareRootInformation of equations with tau = rows truth + noise."""
    joints = [f"joint{j}" for j in range(len(equations))]
    accumulator = InformationAccumulator(names, joints, [c for _, c in equations])
    for j, (rows, columns) in enumerate(equations):
        error = noise * rng.normal(size=len(rows)) if rng is not None else 0.0
        accumulator.add(j, rows, rows @ truth[columns] + error)
    return accumulator.result()


class Samples:
    """An arm's equations with given torques, readable several times."""

    def __init__(self, equations, torques):
        self.equations = equations
        self.torques = torques

    def __iter__(self):
        for j, (rows, _) in enumerate(self.equations):
            yield j, rows, self.torques[j]

    def information(self, names):
        """What is left of them after one pass."""
        joints = [f"joint{j}" for j in range(len(self.equations))]
        accumulator = InformationAccumulator(
            names, joints, [c for _, c in self.equations]
        )
        for index, rows, tau in self:
            keep = np.isfinite(tau)
            accumulator.add(index, rows[keep], tau[keep])
        return accumulator.result()


def noisy_samples(seed, noises=(0.1, 0.1, 0.1), count=200):
    """(Samples of a three-joint arm, names, truth, generator), noise [N m] per joint."""
    rng = np.random.default_rng(seed)
    equations, names = arm_equations(rng, joints=3, count=count)
    truth = np.concatenate((random_body(rng), rng.uniform(0.1, 1.0, 6)))
    torques = [
        rows @ truth[columns] + noise * rng.normal(size=len(rows))
        for (rows, columns), noise in zip(equations, noises)
    ]
    return Samples(equations, torques), names, truth, rng


def terminal_information(rng, truth, axis=Z, offset=ORIGIN, count=80, noise=0.0):
    """What ``--torques terminal`` collects: one joint, ten inertial and two friction columns."""
    equations = [(joint_rows(rng, count, axis, offset), np.arange(12))]
    names = (*spatial.PARAMETER_NAMES, "coulomb[joint0]", "viscous[joint0]")
    return information_of(equations, names, truth, noise, rng)


def _solved(problem, tolerance):
    import cvxpy

    options = {
        f"tol_{criterion}": tolerance for criterion in ("gap_abs", "gap_rel", "feas")
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            problem.solve(solver=cvxpy.CLARABEL, **options)
        except cvxpy.error.SolverError:
            return False
    return problem.status == "optimal"


def sdp_least_squares(matrix, right_side):
    """Least ||A x - b||^2 with x[:10] a possible body, by cvxpy and clarabel, well scaled."""
    import cvxpy

    triangle = np.linalg.qr(
        np.column_stack((matrix[:, 10:], matrix[:, :10], right_side)), mode="r"
    )
    inner = triangle[matrix.shape[1] - 10 :, matrix.shape[1] - 10 :]
    inverse = np.linalg.inv(inner[:10, :10])
    centre = spatial.pseudo_inertia(inverse @ inner[:10, 10])
    units = np.sqrt(np.abs(np.diag(centre)))
    columns = spatial.pseudo_inertia(inverse.T) / np.outer(units, units)
    step = 1.0 / np.linalg.norm(columns.reshape(10, -1), 2)
    y = cvxpy.Variable(10)
    body = centre / np.outer(units, units) + sum(
        step * y[k] * columns[k] for k in range(10)
    )
    problem = cvxpy.Problem(
        cvxpy.Minimize(cvxpy.sum_squares(y)), [0.5 * (body + body.T) >> 0]
    )
    for tolerance in (1e-12, 1e-10, 1e-9):
        if _solved(problem, tolerance):
            break
    return float(problem.value * step**2 + np.sum(inner[10:, 10] ** 2))
