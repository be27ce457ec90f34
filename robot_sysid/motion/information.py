"""Information about the ten inertial parameters that a motion will give, and its gradient.

Joint j delivers equations tau_j = Y_j theta + Z_j x_j with its own nuisances x_j: Coulomb friction,
viscous friction, a torque offset and, where it is estimated, the inertia of its rotor, Z_j =
[sign(qd_j), qd_j, 1, qdd_j]. What is left for theta after eliminating them is the Schur complement

    L = sum_j E_j^T E_j / sigma_j^2,   E_j = Y_j - Z_j C_j,   C_j = (Z_j^T Z_j)^-1 Z_j^T Y_j,

and L^-1 is the covariance of the least-squares estimate in white noise (Cramer-Rao bound).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.equations import Equations, other_links
from robot_sysid.dynamics.friction import DEFAULT_MEASURED, friction_model
from robot_sysid.dynamics.screws import ChainMotion, ScrewChain
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.records import Array, Measurement, MotionPlan
from robot_sysid.regressor import wrench_regressor

_RIDGE = 1e-10
"""Keeps the elimination defined where a joint stands still and its friction has no columns."""
ARM_RATE_HZ = 20.0
"""How densely a candidate for a whole arm is looked at: 33 times per period of 0.6 Hz."""
KNOWN = 0.3
"""How well the model is taken to know each link, as a share of its numbers.

Chosen rough: it only has to keep what no motion shows from counting.
"""
_OWN = friction_model("coulomb-viscous-offset-armature")
_UNIT_ROTOR = 0.1
"""Size of a rotor's inertia at its joint [kg m^2]: 1e-5 kg m^2 behind a gear of 1:100."""

Gradient = tuple[Array, Array, Array]
"""Of a scalar, with respect to q, qd and qdd (N, n)."""


class Information(NamedTuple):
    """Information of a motion.

    Attributes:
        information: (r, r) L.
        signal: sum of the squared rows before elimination: what counts as large.
        vjp: gives the gradient, from the symmetric derivative (r, r) of a scalar with respect to L.
    """

    information: Array
    signal: float
    vjp: Callable[[Array], Gradient]


@dataclass(frozen=True)
class PredictedInformation:
    """Maps motions to information about x, theta = coordinates @ x, and says from which equations.

    Attributes:
        joints: chain joints whose torque is used.
        sigma: (len(joints),) standard deviation of their torque noise [N m].
        smoothing: (n,) speed below which sign(qd) is rounded off to tanh [rad/s]; 0 for none.
        coordinates: (10, r) scaling, and restriction to what can be seen.
        rotors: whether the inertia of each joint's rotor is a nuisance too.
    """

    chain: ScrewChain
    joints: tuple[int, ...]
    sigma: Array
    smoothing: Array
    coordinates: Array
    rotors: bool = False

    def evaluate(self, q: Array, qd: Array, qdd: Array) -> Information:
        """Return the information of one sample per row of q, qd, qdd (N, n)."""
        motion = self.chain.evaluate(q, qd, qdd)
        wrench = body_wrench(motion.velocity, motion.acceleration)
        jacobian = motion.jacobian[:, list(self.joints)]
        rows = np.einsum("ijn,ikn->jnk", jacobian, wrench, optimize=True)
        rows = rows @ self.coordinates / self.sigma[:, None, None]
        friction, slope = self._nuisances(qd[:, list(self.joints)].T, qdd[:, list(self.joints)].T)
        # The regression of each joint's rows on its nuisances.
        transposed = friction.transpose(0, 2, 1)
        normal = transposed @ friction
        ridge = _RIDGE * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(len(normal[0]))
        gain = np.linalg.solve(normal + ridge, transposed @ rows)
        residual = rows - friction @ gain
        information = np.einsum("jnk,jnl->kl", residual, residual, optimize=True)
        vjp = partial(self._vjp, motion, wrench, slope, gain, residual)
        return Information(information, float(np.sum(rows**2)), vjp)

    def _nuisances(self, qd: Array, qdd: Array) -> tuple[Array, Array]:
        """Return Z (rows, N, 3 or 4) and the derivative of its first column with respect to qd."""
        speed = self.smoothing[list(self.joints)][:, None]
        smooth = np.tanh(qd / np.where(speed > 0.0, speed, 1.0))
        sign = np.where(speed > 0.0, smooth, np.sign(qd))
        slope = np.where(speed > 0.0, (1.0 - smooth**2) / np.where(speed > 0.0, speed, 1.0), 0.0)
        rotors = (qdd,) if self.rotors else ()
        return np.stack((sign, qd, np.ones_like(qd), *rotors), axis=2), slope

    def _vjp(
        self,
        motion: ChainMotion,
        wrench: Array,
        slope: Array,
        gain: Array,
        residual: Array,
        adjoint: Array,
    ) -> Gradient:
        """Reverse mode. C needs no derivative: it minimises the residual."""
        joints = list(self.joints)
        rows_adjoint = 2.0 * residual @ adjoint
        friction_adjoint = -rows_adjoint @ gain.transpose(0, 2, 1)
        scale = self.coordinates.T
        theta_adjoint = rows_adjoint @ scale / self.sigma[:, None, None]
        jacobian_adjoint = np.zeros_like(motion.jacobian)
        jacobian_adjoint[:, joints] = np.einsum(
            "jnk,ikn->ijn", theta_adjoint, wrench, optimize=True
        )
        jacobian = motion.jacobian[:, joints]
        wrench_adjoint = np.einsum("ijn,jnk->ikn", jacobian, theta_adjoint, optimize=True)
        q_adjoint, qd_adjoint, qdd_adjoint = motion.vjp(
            jacobian_adjoint, *_wrench_vjp(motion.velocity, wrench_adjoint)
        )
        qd_adjoint[:, joints] += (friction_adjoint[..., 0] * slope + friction_adjoint[..., 1]).T
        if self.rotors:
            qdd_adjoint[:, joints] += friction_adjoint[..., 3].T
        return q_adjoint, qd_adjoint, qdd_adjoint


@lru_cache(maxsize=1)
def _coefficients() -> tuple[Array, Array]:
    """Return the constants of Y6 = A V' + B V V: (60, 6) and (60, 6, 6), symmetric in V V.

    Read off ``regressor.wrench_regressor`` by polarisation, so that there is one derivation only.
    """
    one, none = np.eye(6), np.zeros((6, 6))
    linear = wrench_regressor(none, one).reshape(60, 6)
    pairs = np.array([one[k] + one[m] for k in range(6) for m in range(6)])
    both = wrench_regressor(pairs, np.zeros_like(pairs)).reshape(60, 6, 6)
    alone = wrench_regressor(one, none).reshape(60, 6)
    return linear, 0.5 * (both - alone[:, :, None] - alone[:, None, :])


def body_wrench(velocity: Array, acceleration: Array) -> Array:
    """Return Y6 (6, 10, N) for twists and accelerations (6, N)."""
    linear, quadratic = _coefficients()
    products = (velocity[:, None] * velocity[None, :]).reshape(36, -1)
    return (linear @ acceleration + quadratic.reshape(60, 36) @ products).reshape(6, 10, -1)


def _wrench_vjp(velocity: Array, wrench_adjoint: Array) -> tuple[Array, Array]:
    """Return the gradient (6, N) with respect to the twist and the acceleration."""
    linear, quadratic = _coefficients()
    adjoint = wrench_adjoint.reshape(60, -1)
    products_adjoint = (quadratic.reshape(60, 36).T @ adjoint).reshape(6, 6, -1)
    return 2.0 * np.einsum("kmn,mn->kn", products_adjoint, velocity), linear.T @ adjoint


_SINGULAR = 1e-14
"""Smallest eigenvalue, of L with a unit diagonal, that an inverse in double precision survives."""


def d_criterion(information: Array) -> tuple[float, Array]:
    """Return (-ln det L / 2r, gradient (r, r)) of L (r, r); infinite where L is singular.

    The logarithm of the geometric mean of the standard deviations along the axes of the confidence
    ellipsoid: a change of 0.01 is one of about 1 % (D-optimality; Pukelsheim, "Optimal Design of
    Experiments", 2006, ch. 6).
    """
    diagonal, size = np.diag(information), len(information)
    if not np.all(np.isfinite(information)) or np.any(diagonal <= 0.0):
        return np.inf, np.zeros_like(information)
    root = np.sqrt(diagonal)
    if np.linalg.eigvalsh(information / np.outer(root, root))[0] <= _SINGULAR:
        return np.inf, np.zeros_like(information)
    value = -float(np.linalg.slogdet(information)[1]) / (2.0 * size)
    return value, np.asarray(-np.linalg.inv(information) / (2.0 * size), dtype=float)


def predicted_information(
    problem: ExcitationProblem, sigma: Array, coordinates: Array, smoothing: float = 0.0
) -> PredictedInformation:
    """Return what tells the information of motions about x, theta = coordinates @ x (10, r).

    From torques with noise sigma (rows,) [N m]; Coulomb friction's jump is rounded off below a
    share of the speed limits.
    """
    smooth = smoothing * problem.limits.velocity
    # From one torque rotor inertias are not estimated: they are the link's.
    rotors = "armature" in DEFAULT_MEASURED and len(problem.rows) > 1
    return PredictedInformation(problem.chain, problem.rows, sigma, smooth, coordinates, rotors)


def visible_coordinates(problem: ExcitationProblem) -> Array:
    """Return (10, r): scaled directions of theta that some motion of this arm can show.

    Found from unrelated positions, velocities and accelerations, a fixed set of random numbers.
    What such data cannot see, no trajectory of these joints can.
    """
    scale = np.diag(problem.scale)
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, 400, problem.n_joints))
    q = np.clip(problem.rest + 2.0 * q, problem.limits.lower, problem.limits.upper)
    information = predicted_information(problem, np.ones(len(problem.rows)), scale)
    matrix = information.evaluate(q, qd, qdd).information
    values, vectors = np.linalg.eigh(matrix)
    return scale @ vectors[:, values > 1e-9 * values[-1]]


def arm_criterion(problem: ExcitationProblem, plan: MotionPlan) -> float:
    """Return -ln det L / 2r of what a motion says of all links, rotors and friction, r unknowns.

    L = Y^T Y / sigma^2 + P, with P what the model knows beforehand, so that what no motion shows
    does not count (Bayesian D-optimality; Chaloner, Verdinelli, "Bayesian experimental design: a
    review", Statistical Science 10(3), 1995).
    """
    robot, others = problem.robot, other_links(problem.robot)
    equations = Equations(robot, problem.torques, (_OWN,) * robot.n_joints, links=others)
    own = np.where(np.array(_OWN.terms) == "armature", _UNIT_ROTOR, 1.0)
    last, *rest = (_known(robot.links[link].theta) for link in (-1, *others))
    scale = np.concatenate((last, np.tile(own, len(problem.rows)), *rest))
    motion = plan.evaluate(np.arange(0.0, plan.duration, 1.0 / ARM_RATE_HZ))
    data = Measurement(motion.time, motion.q, motion.qd, np.zeros_like(motion.q), motion.qdd)
    total = np.eye(len(scale))
    for (rows, _), columns, sigma in zip(equations.rows(data), equations.columns, problem.sigma):
        rows = rows * scale[columns] / sigma
        total[np.ix_(columns, columns)] += rows.T @ rows
    return -float(np.linalg.slogdet(total)[1]) / (2.0 * len(total))


def _known(theta: Array) -> Array:
    """Return how well the model is taken to know each of a link's parameters (10,)."""
    length = max(spatial.characteristic_length(theta), 1e-3)
    return KNOWN * spatial.parameter_scale(float(theta[0]), length)
