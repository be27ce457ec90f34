"""How well a log fits its model, once the model is allowed to be as wrong as models usually are.

Minimised is

    sum_j (K_e / K) sum_k ((tau_jk - Y_jk theta - friction_jk) / sigma_j)^2
        + sum_i ((theta_i - theta_i,model) / s_i)^2

over the parameters theta of ALL links and each joint's friction. The terminal link may be nearly
anything (that is what will be identified), the other links a few per cent off; K_e is how many
independent samples a log is taken to have. The minimum over n K_e is the cost: below one, nothing
is wrong that could be seen in the torques.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.diagnosis.evidence import TOLERANCE, Evidence, Sample
from robot_sysid.dynamics.kinematics import ArmDynamics, has_only_armature
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.dynamics.nuisances import with_gravity
from robot_sysid.dynamics.spatial import characteristic_length, com_from_theta, parameter_scale
from robot_sysid.records import Array, RobotModel

LINK_ERROR = 0.05
"""Standard deviation of another link's parameters as a part of a body of its mass and size."""
PAYLOAD = 0.3
"""Standard deviation of the terminal link's mass as a part of the whole arm's."""
LIGHTEST, HEAVIEST = -0.03, 0.6
"""Mass of a plausible terminal link, as a part of the whole arm's."""
INDEPENDENT = 100
"""Independent samples that a log is taken to have per joint."""
N_FRICTION = 4
_SLOW = 0.05


@dataclass(frozen=True)
class Fit:
    """One fit.

    Attributes:
        cost: what was minimised, over the number of joints and independent samples.
        per_joint: (n,) each joint's residuals in it.
        residual: (K, n) torque that is not explained [N m].
        friction_torque: (K, n) torque of Coulomb and viscous friction [N m].
        coulomb: (n,) Coulomb friction [N m].
        thetas: (n, 10) the links.
    """

    cost: float
    per_joint: Array
    residual: Array
    friction_torque: Array
    coulomb: Array
    thetas: Array
    extra: Array
    error: Array


class ModelFit:
    """Fits samples of one log to the model.

    Attributes:
        links: (n, 10) the model's links.
        model_torque: (K, n) what the model says of the motion as recorded, without friction.
    """

    def __init__(self, evidence: Evidence) -> None:
        robot = evidence.robot
        self.robot = robot
        self._dynamics = LinkDynamics(robot)
        self._weightless = LinkDynamics(with_gravity(robot, np.zeros(3)))
        self._beyond = None if has_only_armature(robot.mj_model) else ArmDynamics(robot)
        self.links = np.array([link.theta for link in robot.links])
        self._armature = np.array(robot.mj_model.dof_armature)[robot.dof_index]
        self._scales = _link_scales(robot)
        sample = evidence.sample
        self.model_torque = self.torque(sample, self.links) + self._springs(sample)

    def torque(self, sample: Sample, links: Array) -> Array:
        """Return (K, n) the torque of links (n, 10), without friction, armature and springs."""
        return self._dynamics.motion(sample.q, sample.qd, sample.qdd).torque(links)

    def fit(
        self,
        sample: Sample,
        extra: Array | None = None,
        prior: Sequence[float] | Array = (),
        weightless: bool = False,
        known_links: bool = False,
        only_friction: bool = False,
    ) -> Fit:
        """Fit one sample.

        Args:
            extra: (K, n, e) further columns.
            prior: (e,) standard deviations of their coefficients.
            known_links: whether all links but the terminal one are taken to be right.
            only_friction: whether there is nothing but friction, neither links nor rotors.
        """
        count, n = sample.q.shape
        dynamics = self._weightless if weightless else self._dynamics
        links = dynamics.motion(sample.q, sample.qd, sample.qdd).columns(range(n))
        friction = _friction_columns(sample)
        rows = np.concatenate([links, friction] + ([] if extra is None else [extra]), axis=2)
        bodies = float(not only_friction)
        scales = bodies * self._scales
        scales[:-1] *= not known_links
        own = np.tile([1.0, 1.0, 1.0, bodies], n)
        armature = np.outer(self._armature, [0.0, 0.0, 0.0, 1.0]).ravel()
        known = bodies * self.links.ravel()
        start = np.concatenate((known, own * armature, np.zeros(len(prior))))
        spread = np.concatenate((scales.ravel(), own * self._friction_spread(sample), prior))
        right = sample.tau - self._springs(sample) - rows @ start
        weight = np.sqrt(INDEPENDENT / count) / sample.sigma
        values, covariance = _ridge(rows, right, weight, spread)
        residual = right - rows @ values
        per_joint = np.sum((residual * weight) ** 2, axis=0) / INDEPENDENT
        # What the priors ask for values that are not zero.
        held = spread > 0.0
        penalty = float(np.sum((values[held] / spread[held]) ** 2))
        cost = (float(np.sum(per_joint)) + penalty / INDEPENDENT) / n
        thetas, of_friction, extras = np.split(start + values, (10 * n, (10 + N_FRICTION) * n))
        lost, coulomb = of_friction * np.tile([1.0, 1.0, 0.0, 0.0], n), of_friction[::N_FRICTION]
        error = np.sqrt(np.diag(covariance)[(10 + N_FRICTION) * n :])
        torque, thetas = friction @ lost, thetas.reshape(n, 10)
        return Fit(cost, per_joint, residual, torque, coulomb, thetas, extras, error)

    def _springs(self, sample: Sample) -> Array:
        """Return (K, n) the torque of springs, tendons and actuators."""
        still = np.zeros_like(sample.q)
        beyond = self._beyond
        return beyond.beyond_rigid_bodies(sample.q, sample.qd, still) if beyond else still

    def _friction_spread(self, sample: Sample) -> Array:
        """Return (4 n,) how large friction may be: up to about what the joint carries."""
        usual = sample.sigma / TOLERANCE
        speed, turning = rms(sample.qd), rms(sample.qdd)
        viscous = usual / np.where(speed > 0.0, speed, 1.0)
        armature = 0.5 * usual / np.where(turning > 0.0, turning, 1.0)
        return np.column_stack((usual, viscous, 0.5 * usual, armature)).ravel()


def plausible(fit: ModelFit, found: Fit, heaviest: float = HEAVIEST) -> bool:
    """Return whether a terminal link's mass could be that of a link with a payload."""
    arm = float(np.sum(fit.links[:, 0]))
    share, own = float(found.thetas[-1, 0]) / arm, float(fit.links[-1, 0]) / arm
    # An arm of one joint is all terminal link; one of two often is half of it.
    return LIGHTEST < share < max(heaviest, own + PAYLOAD)


def _ridge(rows: Array, right: Array, weight: Array, spread: Array) -> tuple[Array, Array]:
    """Return (values, covariance) of least squares with independent priors around zero.

    Equations (K, n, p), (K, n) with a weight for each joint (n,); ``spread`` (p,) of the priors.
    """
    scaled = (rows * weight[None, :, None]).reshape(-1, len(spread)) * spread
    inverse = np.linalg.inv(scaled.T @ scaled + np.eye(len(spread)))
    values = inverse @ (scaled.T @ (right * weight).ravel())
    return spread * values, inverse * np.outer(spread, spread)


def _friction_columns(sample: Sample) -> Array:
    """Return (K, n, 4 n) Coulomb, viscous, offset and armature of each joint."""
    count, n = sample.q.shape
    slow = slow_speed(sample.qd)
    sign = np.clip(sample.qd / np.where(slow > 0.0, slow, 1.0), -1.0, 1.0)
    own = np.stack((sign, sample.qd, np.ones_like(sign), sample.qdd), axis=2)
    columns = np.zeros((count, n, n, N_FRICTION))
    joints = np.arange(n)
    columns[:, joints, joints] = own
    return columns.reshape(count, n, -1)


def slow_speed(qd: Array) -> Array:
    """Return (n,) below which of its speeds (K, n) a joint's friction has no sure direction."""
    return _SLOW * np.asarray(np.max(np.abs(qd), axis=0))


def _link_scales(robot: RobotModel) -> Array:
    """Return (n, 10) how far each link's parameters may be off."""
    masses = np.array([max(float(link.theta[0]), 0.0) for link in robot.links])
    total, reach = float(np.sum(masses)), sum(np.linalg.norm(b.translation) for b in robot.links)
    scales = []
    for link, mass in zip(robot.links, masses):
        length = _length(link.theta) if mass > 0.0 else 0.0
        scales.append(LINK_ERROR * parameter_scale(mass, length) if mass > 0.0 else np.zeros(10))
    wide = max(0.15 * float(reach), _length(robot.links[-1].theta) if masses[-1] > 0.0 else 0.0)
    scales[-1] = parameter_scale(PAYLOAD * total, wide)
    return np.array(scales)


def _length(theta: Array) -> float:
    """Return the size of a link: of its body, and of where that stands."""
    return max(characteristic_length(theta), float(np.linalg.norm(com_from_theta(theta)[1])))


def rms(values: Array) -> Array:
    """Return (n,) the root mean square over samples (K, n)."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))
