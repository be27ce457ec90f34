"""What joint torques show of a link, by MuJoCo alone: differences by parameter, and an SVD.

Nothing of the package's regressor is in it. The torque is linear in a body's ten parameters, so a
difference of any size is exact.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from robot_sysid.dynamics.equations import TERMINAL_FRICTION, Equations, friction_per_joint
from robot_sysid.estimation.algebra.identifiability import analyse_identifiability, visible_space
from robot_sysid.estimation.algebra.information import InformationAccumulator
from robot_sysid.records import Measurement
from tests.support import arms

CUT = 1e-10
"""Share of the largest singular value, and of a column's usual length, that is nothing."""
BODY = np.array([2.0, 0.1, -0.2, 0.3, 0.4, 0.02, -0.03, 0.5, 0.01, 0.6])
STEPS = np.array([0.5, *[0.1] * 3, *[0.1] * 6])
UNITS = (slice(0, 1), slice(1, 4), slice(4, 10), slice(10, 11), slice(11, 12))


@dataclass(frozen=True)
class Seen:
    """What a motion shows of the link's ten parameters and the last joint's two of friction.

    Attributes:
        matrix: (M, 12) scaled columns.
        scale: (12,) parameters of a unit share theirs.
        null: (12, d) orthonormal basis of what is hidden, in scaled coordinates.
        ranks: least and largest rank that a cut ten times larger or smaller gives.
    """

    matrix: np.ndarray
    scale: np.ndarray
    null: np.ndarray
    ranks: tuple[int, int]

    @property
    def rank(self):
        """Number of visible combinations."""
        return 12 - self.null.shape[1]

    @property
    def identified(self):
        """Whether each parameter is in no hidden combination."""
        return tuple((np.linalg.norm(self.null, axis=1) < 1e-6).tolist())


def mujoco_columns(robot, q, qd, qdd):
    """(N, n, 12) what each chain joint's torque changes by per unit of each parameter."""
    model = copy.copy(robot.mj_model)
    columns = np.zeros((*q.shape, 12))
    for k, step in enumerate(np.diag(STEPS)):
        ahead, behind = (_torques(robot, model, BODY + s * step, q, qd, qdd) for s in (1.0, -1.0))
        columns[:, :, k] = (ahead - behind) / (2.0 * STEPS[k])
    columns[:, -1, 10], columns[:, -1, 11] = np.sign(qd[:, -1]), qd[:, -1]
    return columns


def _torques(robot, model, theta, q, qd, qdd):
    """(N, n) inverse dynamics with these parameters in the last body, contacts and springs out."""
    arms.write_body(model, robot.body_id, theta)
    data, tau = mujoco.MjData(model), np.zeros((len(q), model.nv))
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = robot.reference_qpos, 0.0, 0.0
        data.qpos[robot.qpos_index] = q[k]
        data.qvel[robot.dof_index], data.qacc[robot.dof_index] = qd[k], qdd[k]
        for step in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
            step(model, data)
        mujoco.mj_rne(model, data, 1, tau[k])
    return tau[:, robot.dof_index]


def oracle(columns):
    """What stacked columns (N, joints, 12) show."""
    matrix = columns.reshape(-1, 12)
    length = np.linalg.norm(matrix, axis=0)
    scale = np.concatenate([np.full_like(length[unit], np.max(length[unit])) for unit in UNITS])
    nothing = scale <= CUT * np.max(length, initial=0.0)
    scale = 1.0 / np.where(nothing, 1.0, scale)
    scaled = np.where(nothing, 0.0, matrix * scale)
    _, singular, right = np.linalg.svd(scaled)
    shares = np.zeros(12)
    shares[: len(singular)] = singular / max(np.max(singular, initial=0.0), 1e-300)
    least, rank, most = (int(np.count_nonzero(shares > CUT * k)) for k in (10.0, 1.0, 0.1))
    return Seen(scaled, scale, right[rank:].T, (least, most))


def moves(robot, rng, joints, samples):
    """(q, qd, qdd) of random states in which these joints move and the others rest."""
    q, qd, qdd = arms.random_motion(rng, robot.n_joints, samples)
    moving = np.isin(np.arange(robot.n_joints), joints)
    return np.where(moving, q, robot.reference), qd * moving, qdd * moving


def rows_of(robot, torques, motion):
    """(columns, per joint rows (N, k)) of the package's own equations for a motion."""
    friction = friction_per_joint(robot, "terminal", TERMINAL_FRICTION)
    equations = Equations(robot, torques, friction)
    q, qd, qdd = motion
    measurement = Measurement(np.arange(len(q)) / 100.0, q, qd, np.zeros_like(q), qdd)
    return equations, [rows for rows, _ in equations.rows(measurement)]


def information_of(equations, rows):
    """Square-root information of some rows of each joint."""
    accumulator = InformationAccumulator(equations.names, equations.joints, equations.columns)
    for index, block in enumerate(rows):
        accumulator.add(index, block, np.zeros(len(block)))
    return accumulator.result()


def assert_same(information, seen):
    """Rank, parameters and directions are those that MuJoCo shows.

    Where a combination shows by about as much as the cut asks for, another motion may decide
    otherwise, and the rank alone is compared.
    """
    found = analyse_identifiability(information)
    assert found.n_parameters == 12
    assert seen.ranks[0] <= found.rank <= seen.ranks[1]
    if seen.ranks[0] < seen.ranks[1]:
        return
    assert found.identified == seen.identified
    assert len(found.unidentifiable) == 12 - seen.rank
    space = visible_space(information.stacked()[0])
    hidden = space.scale[:, None] * space.null / seen.scale[:, None]
    hidden /= np.linalg.norm(hidden, axis=0)
    left = np.linalg.norm(seen.matrix @ hidden)
    assert left <= 1e-6 * max(np.linalg.norm(seen.matrix), 1e-300)
