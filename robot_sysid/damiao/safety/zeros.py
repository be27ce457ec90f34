"""Whether a joint's zero has moved since its map was made: what the torques of a motion say.

A joint that stands elsewhere than it says loads itself and the joints beyond it in another way than
the model expects. Links that weigh something else do that too, so both compete: the measured
torques tau are

    tau = model(q, qd, qdd) + Y dtheta + d(model)/dq_j shift_j + friction + noise,

with a prior for what the model's links, its friction and an unknown load at its end may be off. A
moved zero is named where it raises the log marginal likelihood by a margin, and more than that of
any other joint. (Rasmussen and Williams, Gaussian Processes, 2006, equation 2.30.)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robot_sysid.damiao.protocol.joints import DamiaoJoint
from robot_sysid.damiao.references import torque_doubt
from robot_sysid.dynamics.equations import other_links
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.estimation.algebra.nuisances import model_link_factor
from robot_sysid.records import Array, Measurement, RobotModel

# Samples that are averaged: so far apart that their errors are not alike [s].
_WINDOW = 0.2
_LEAST_WINDOWS = 15
_MOST_WINDOWS = 80
# Judgements, standard deviations: links of a guessed model [share], an unknown load at the end [kg]
# and how far from there its mass is [m], a zero that moved [rad].
_LINKS = 0.3
_LOAD = 3.0
_LEVER = 0.2
_SHIFT = 0.3
# Of the torque that says nothing: what is left of averages over a window; the likeliest is taken.
_NOISES = (0.05, 0.15, 0.5)
_DIFFERENCE = 0.01
# In nats: how much better than no moved zero, and than that of any other joint.
_MARGIN = 15.0
_APART = 5.0
# A smaller shift is within what people measure with a ruler [rad].
_LEAST_SHIFT = 0.08


def describe_moved_zero(
    robot: RobotModel, joints: Sequence[DamiaoJoint], samples: Measurement
) -> str:
    """Return a sentence about the joint whose zero has moved; "" where none has surely.

    Args:
        robot: the arm's model.
        joints: its motors, base to terminal.
        samples: motion and torque (N, n) of a whole run.
    """
    motion = _average_over_windows(samples)
    if motion is None:
        return ""
    dynamics = LinkDynamics(robot)
    q, qd, qdd, tau = motion
    doubt = torque_doubt(joints) + robot.friction.coulomb
    weights = np.tile(1.0 / doubt, len(q))
    friction = robot.friction.torque(qd) + robot.armature * qdd
    needed = dynamics.motion(q, qd, qdd).torque(robot.thetas) + friction
    residual = (tau - needed).ravel() * weights
    links = _link_errors(robot, dynamics, q, qd, qdd)
    errors = np.column_stack([links, _friction_errors(qd, doubt)]) * weights[:, None]
    spread = errors @ errors.T
    slopes = [_slope(robot, dynamics, q, qd, qdd, j) * weights for j in range(robot.n_joints)]

    without_shift, _ = _likeliest_noise(residual, spread)
    likelihoods = []
    noises = []
    for slope in slopes:
        likelihood, noise = _likeliest_noise(residual, spread + _SHIFT**2 * np.outer(slope, slope))
        likelihoods.append(likelihood)
        noises.append(noise)
    joint = int(np.argmax(likelihoods))
    others = np.delete(likelihoods, joint)
    is_sure = likelihoods[joint] > without_shift + _MARGIN
    is_sure &= likelihoods[joint] > np.max(others, initial=without_shift) + _APART
    covariance = spread + noises[joint] ** 2 * np.eye(len(residual))
    shift, error = _posterior_shift(residual, covariance, slopes[joint])
    if not is_sure or abs(shift) < _LEAST_SHIFT + 2.0 * error:
        return ""
    return (
        f"the zero of {joints[joint].label} has moved by about {abs(shift):.1f} rad since "
        "its map was made, as the torques of this motion say; look at its mounting and make the "
        "map again: see 'motors map'"
    )


def _posterior_shift(residual: Array, covariance: Array, slope: Array) -> tuple[float, float]:
    """Return the posterior mean and standard deviation of a zero's shift [rad]."""
    weighted_slope = np.linalg.solve(covariance, slope)
    information = float(slope @ weighted_slope) + 1.0 / _SHIFT**2
    return float(residual @ weighted_slope) / information, information**-0.5


def _average_over_windows(samples: Measurement) -> tuple[Array, ...] | None:
    """Return q, qd, qdd and tau (K, n) averaged over windows, None where they are too few.

    Of a long run as many windows are taken as a covariance of all their torques has room for.
    """
    assert samples.qd is not None
    number = ((samples.time - samples.time[0]) / _WINDOW).astype(int)
    count = np.bincount(number)
    full = np.flatnonzero(count >= 0.5 * np.median(count))
    if len(full) < _LEAST_WINDOWS:
        return None
    full = full[:: 1 + (len(full) - 1) // _MOST_WINDOWS]
    qdd = np.gradient(samples.qd, samples.time, axis=0)
    means = []
    for signal in (samples.q, samples.qd, qdd, samples.tau):
        sums = [np.bincount(number, column) for column in signal.T]
        means.append((np.array(sums) / np.maximum(count, 1)).T[full])
    return tuple(means)


def _link_errors(
    robot: RobotModel, dynamics: LinkDynamics, q: Array, qd: Array, qdd: Array
) -> Array:
    """Return torques (K n, m) that one standard deviation of each link error makes."""
    links = [*other_links(robot), robot.n_joints - 1]
    columns = dynamics.motion(q, qd, qdd).columns(links)
    factor = model_link_factor(robot, links, _LINKS)
    load = np.zeros((len(factor), 4))
    load[-10:-6] = _LOAD * np.diag([1.0, _LEVER, _LEVER, _LEVER])
    return (columns @ np.column_stack([factor, load])).reshape(q.size, -1)


def _friction_errors(qd: Array, doubt: Array) -> Array:
    """Return torques (K n, 2 n) that one standard deviation of each joint's friction makes."""
    units = np.eye(qd.shape[1])
    dry = np.tanh(qd / 0.02) * doubt
    viscous = qd * doubt
    columns = [signal[:, :, None] * units for signal in (dry, viscous)]
    return np.concatenate(columns, axis=2).reshape(qd.size, -1)


def _slope(
    robot: RobotModel, dynamics: LinkDynamics, q: Array, qd: Array, qdd: Array, joint: int
) -> Array:
    """Return how torques (K n,) change with one joint's position [N m/rad]."""
    step = _DIFFERENCE * np.eye(q.shape[1])[joint]
    ahead = dynamics.motion(q + step, qd, qdd).torque(robot.thetas)
    behind = dynamics.motion(q - step, qd, qdd).torque(robot.thetas)
    return ((ahead - behind) / (2.0 * _DIFFERENCE)).ravel()


def _likeliest_noise(residual: Array, spread: Array) -> tuple[float, float]:
    """Return the largest log likelihood over the noises, and the noise that has it."""
    return max((_log_likelihood(residual, spread, noise), noise) for noise in _NOISES)


def _log_likelihood(residual: Array, spread: Array, noise: float) -> float:
    """Return log N(residual; 0, spread + noise^2 I) but for a constant."""
    factor = np.linalg.cholesky(spread + noise**2 * np.eye(len(residual)))
    white = np.linalg.solve(factor, residual)
    return float(-0.5 * white @ white - np.sum(np.log(np.diag(factor))))
