"""A run on a 7-joint, 15 000-sample log of an arm, and the same by pinocchio and lstsq."""

from __future__ import annotations

import numpy as np

from robot_sysid.dynamics.equations import other_links
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.records import Measurement
from tests.support.core_fits import BASIC, result_of_logs

SAMPLES = 15_000
RATE = 1000.0
CUTOFF = 10.0
GIVEN = EstimationOptions(cutoff=CUTOFF, friction_model=BASIC)
CHOSEN = EstimationOptions(cutoff=CUTOFF)


def measured(robot, seed=0):
    """(log, exact motion) of an arm with friction on six harmonics per joint."""
    rng = np.random.default_rng(seed)
    time = np.arange(SAMPLES) / RATE
    rates = 2.0 * np.pi * 0.1 * np.arange(1, 7)
    size = rng.normal(size=(6, robot.n_joints)) * 0.4
    phase = rng.uniform(0.0, 6.0, (6, robot.n_joints))
    angle = rates[:, None, None] * time[:, None] + phase[:, None]
    q = np.sum(size[:, None] * np.sin(angle), axis=0)
    qd = np.sum((rates[:, None] * size)[:, None] * np.cos(angle), axis=0)
    qdd = -np.sum((rates[:, None] ** 2 * size)[:, None] * np.sin(angle), axis=0)
    thetas = np.array([1.1 * link.theta for link in robot.links])
    tau = LinkDynamics(robot).motion(q, qd, qdd).torque(thetas)
    tau += 0.5 * np.sign(qd) + 0.3 * qd + 0.2 * rng.normal(size=q.shape)
    return Measurement(time, q, None, tau), (q, qd, qdd)


def ours(robot, log, options=GIVEN):
    """From the log to all links and to what the model file is given."""
    return result_of_logs(robot, [log], options, ())


def regressor_columns(robot, motion):
    """(N, n, 10 n) our regressor alone."""
    links = (*other_links(robot), robot.n_joints - 1)
    return LinkDynamics(robot).motion(*motion).columns(links)


def pinocchio_regressor(model, data, motion):
    """(N, n, 10 n) by pinocchio's own loop."""
    import pinocchio

    q, qd, qdd = motion
    blocks = [
        pinocchio.computeJointTorqueRegressor(model, data, *row)
        for row in zip(q, qd, qdd)
    ]
    return np.array(blocks)


def pinocchio_fit(model, data, motion, tau):
    """Least squares of all links with Coulomb and viscous friction and offset, as people do it."""
    links = pinocchio_regressor(model, data, motion)
    qd = motion[1]
    samples, joints = qd.shape
    own = [
        column[:, :, None] * np.eye(joints)
        for column in (np.sign(qd), qd, np.ones_like(qd))
    ]
    rows = np.concatenate((links, *own), axis=-1).reshape(samples * joints, -1)
    return np.linalg.lstsq(rows, tau.ravel(), rcond=None)[0]
