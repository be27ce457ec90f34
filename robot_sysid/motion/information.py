"""Information about the arm's bodies that a motion will give, and its gradient.

Joint j delivers equations tau_j = Y_j theta + Z_j x_j, theta the parameters of all links and x_j
what only this joint has. Its friction and the inertia of its rotor are free; its torque scale and
what friction may have that its model lacks are known to be small, x ~ N(0, s^2), which is one more
row of unit variance. What is left for theta after eliminating them is the Schur complement

    L = sum_j E_j^T E_j / sigma_j^2 + C_j^T D C_j,   E_j = Y_j - Z_j C_j,
    C_j = (Z_j^T Z_j / sigma_j^2 + D)^-1 Z_j^T Y_j / sigma_j^2,

D the precision of x_j. With the precision P of what the model knows of the other links
(L + P)^-1 is the covariance of the estimate (P and s: ``expected_errors``).
Encoder zeros, gravity's direction and a delay are in the promise, not here: of two arms they are
less than a twentieth of any variance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import NamedTuple

import numpy as np

from robot_sysid.dynamics.newton_euler import (
    LinkDynamics,
    LinksMotion,
    bracket_transposed,
)
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.records import Array
from robot_sysid.regressor import wrench_regressor

_RIDGE = 1e-10
"""Keeps the elimination defined where a joint stands still and its friction has no columns."""
_STILL = 1e-9
"""Speed below which a square root of it has no slope any more [rad/s]."""
_HIDDEN = 1e-9
"""Share of the largest information below which a direction is not seen."""
OWN = ("coulomb", "viscous", "offset", "armature", "scale", "load", "sqrt")
"""What only one joint's equations contain."""
_MOST_ROWS = 400_000
"""Rows of random motion times joints: as much of 60 joints as fits into 50 MB."""

Gradient = tuple[Array, Array, Array]
"""Of a scalar, with respect to q, qd and qdd (N, n)."""


@dataclass(frozen=True)
class Known:
    """What an estimate knows beforehand.

    Attributes:
        factor: (10 L, 10 L) F, the parameters of the L other links with mass, in descending order,
            have the covariance F F^T; empty where they are taken as they are.
        own: (7, rows) standard deviations of ``OWN`` in each joint's equations; infinite where
            nothing is known, zero where it is no unknown.
        asked: what the motion is for: "link", "arm" for every link, or "payload".
    """

    factor: Array
    own: Array
    asked: str = "link"


def known_arm(problem: ExcitationProblem) -> Known:
    """Return what is known of an arm of which all but the terminal link and friction is known."""
    own = np.zeros((len(OWN), len(problem.rows)))
    # From one torque rotor inertias are not estimated: they are the link's.
    own[: 4 if len(problem.rows) > 1 else 3] = np.inf
    return Known(np.zeros((0, 0)), own)


class Information(NamedTuple):
    """Information (10 L, 10 L) of a motion about all links with mass, the terminal one first. From
    G (10 L, r), ``vjp`` gives the gradient of a scalar whose derivative by it is -G G^T.
    """

    information: Array
    vjp: Callable[[Array], Gradient]


@dataclass(frozen=True)
class PredictedInformation:
    """Maps motions to information about all links with mass.

    Attributes:
        dynamics: motion of all links.
        links: numbers (L,) of those with mass, in descending order.
        theta: (L, 10) of these in the model.
        joints: chain joints whose torque is used.
        sigma: (len(joints),) standard deviation of their torque noise [N m].
        smoothing: (n,) speed below which sign(qd) is rounded off to tanh [rad/s]; 0 for none.
        own: see ``Known``.
    """

    dynamics: LinkDynamics
    links: tuple[int, ...]
    theta: Array
    joints: tuple[int, ...]
    sigma: Array
    smoothing: Array
    own: Array

    def evaluate(self, q: Array, qd: Array, qdd: Array) -> Information:
        """Return the information of one sample per row of q, qd, qdd (N, n)."""
        move = self.dynamics.motion(q, qd, qdd)
        used = list(self.joints)
        links = list(self.links)
        twists = [
            np.stack(each, axis=1)[:, links]
            for each in (move.velocity, move.acceleration)
        ]
        # Of each sample, all links' wrenches in the base's frame side by side, (N, 6, 10 L).
        own_frame = body_wrench(*twists).transpose(2, 3, 0, 1)
        wrench = (move.to_links[links].swapaxes(-1, -2) @ own_frame).transpose(
            1, 2, 0, 3
        )
        wrench = wrench.reshape(len(q), 6, -1)
        joint_twists = move.joint_twists[:, used]
        rows = np.empty((len(used), len(q), self.theta.size))
        np.matmul(joint_twists.transpose(2, 1, 0), wrench, out=rows.swapaxes(0, 1))
        self._keep_carried(rows)
        own, slopes = self._own(
            qd[:, used].T, qdd[:, used].T, rows @ self.theta.ravel()
        )
        weight = 1.0 / self.sigma[:, None, None]
        rows *= weight
        own *= weight
        # The regression of each joint's rows on what only it has.
        transposed = own.transpose(0, 2, 1)
        normal = transposed @ own
        ridge = _RIDGE * np.trace(normal, axis1=1, axis2=2)[:, None]
        # What is known of what only one joint has is one more row, in units of it.
        ridge = ridge + np.isfinite(self.own).T
        gain = np.linalg.solve(
            normal + ridge[:, None] * np.eye(len(OWN)), transposed @ rows
        )
        residual = rows - own @ gain
        information = np.zeros((self.theta.size, self.theta.size))
        for ours, left, count in zip(rows, residual, self._carried):
            information[:count, :count] += ours[:, :count].T @ left[:, :count]
        residual *= weight
        vjp = partial(
            self._vjp, move, (qd, qdd), twists[0], wrench, slopes, gain, residual
        )
        return Information(0.5 * (information + information.T), vjp)

    @cached_property
    def _carried(self) -> list[int]:
        """How many of the parameters each joint's equations have: those of links that it moves."""
        return [10 * sum(link >= joint for link in self.links) for joint in self.joints]

    def _keep_carried(self, rows: Array) -> None:
        """Make zero what stands in rows (joints, N, 10 L) for links that a joint does not move."""
        for block, count in zip(rows, self._carried):
            block[:, count:] = 0.0

    def _own(self, qd: Array, qdd: Array, torque: Array) -> tuple[Array, list[Array]]:
        """Return Z (rows, N, 7), and what it changes by with speed, acceleration and torque."""
        speed = self.smoothing[list(self.joints)][:, None]
        rounded = np.where(speed > 0.0, speed, 1.0)
        smooth = np.tanh(qd / rounded)
        sign = np.where(speed > 0.0, smooth, np.sign(qd))
        slope = np.where(speed > 0.0, (1.0 - smooth**2) / rounded, 0.0)
        root = np.sqrt(np.abs(qd))
        one = np.ones_like(qd)
        none = np.zeros_like(qd)
        bend = 0.5 * np.abs(sign) / np.maximum(root, _STILL)
        size = np.where(np.isfinite(self.own), self.own, 1.0).T[:, None]
        load = np.abs(torque)
        tables = (
            (sign, qd, one, qdd, torque, sign * load, sign * root),
            (slope, one, none, none, none, slope * load, slope * root + bend),
            (none, none, none, one, none, none, none),
            (none, none, none, none, one, sign * np.sign(torque), none),
        )
        found, *slopes = (size * np.stack(columns, axis=2) for columns in tables)
        return found, slopes

    def _vjp(
        self,
        move: LinksMotion,
        rates: tuple[Array, Array],
        velocity: Array,
        wrench: Array,
        slopes: list[Array],
        gain: Array,
        residual: Array,
        factor: Array,
    ) -> Gradient:
        """Reverse mode. C needs no derivative: it minimises what is left."""
        rows_adjoint = (-2.0 * residual @ factor) @ factor.T
        adjoint = -rows_adjoint @ gain.transpose(0, 2, 1)
        by_speed, by_acceleration, by_torque = (
            np.sum(adjoint * slope, axis=2) for slope in slopes
        )
        rows_adjoint += by_torque[:, :, None] * self.theta.ravel()
        self._keep_carried(rows_adjoint)
        used = list(self.joints)
        links = list(self.links)
        by_sample = rows_adjoint.swapaxes(0, 1)
        screws, turns, *by_twists = np.zeros((4, *move.joint_twists.shape))
        screws[:, used] = (by_sample @ wrench.swapaxes(1, 2)).transpose(2, 1, 0)
        felt = move.joint_twists[:, used].transpose(2, 0, 1) @ by_sample
        split = (len(wrench), 6, len(links), 10)
        felt, wrench = (
            each.reshape(split).transpose(1, 2, 3, 0) for each in (felt, wrench)
        )
        turns[:, links] = np.sum(bracket_transposed(felt, wrench), axis=2)
        own_frame = (move.to_links[links] @ felt.transpose(1, 3, 0, 2)).transpose(
            2, 3, 0, 1
        )
        for by_twist, part in zip(by_twists, _wrench_vjp(velocity, own_frame)):
            by_twist[:, links] = part
        total = move.gradient(rates, screws, by_twists, turns)
        total[1][:, used] += by_speed.T
        total[2][:, used] += by_acceleration.T
        return total


@lru_cache(maxsize=1)
def _coefficients() -> tuple[Array, Array]:
    """Return the constants of Y6 = A V' + B V V: (60, 6) and (60, 6, 6), symmetric in V V."""
    # By polarisation, so that there is one derivation only.
    one = np.eye(6)
    none = np.zeros((6, 6))
    linear = wrench_regressor(none, one).reshape(60, 6)
    pairs = np.array([one[k] + one[m] for k in range(6) for m in range(6)])
    both = wrench_regressor(pairs, np.zeros_like(pairs)).reshape(60, 6, 6)
    alone = wrench_regressor(one, none).reshape(60, 6)
    return linear, 0.5 * (both - alone[:, :, None] - alone[:, None, :])


def body_wrench(velocity: Array, acceleration: Array) -> Array:
    """Return Y6 (6, 10, ...) for twists and accelerations (6, ...)."""
    linear, quadratic = _coefficients()
    products = (velocity[:, None] * velocity[None, :]).reshape(36, -1)
    wrench = linear @ acceleration.reshape(6, -1) + quadratic.reshape(60, 36) @ products
    return wrench.reshape(6, 10, *velocity.shape[1:])


def _wrench_vjp(velocity: Array, wrench_adjoint: Array) -> tuple[Array, Array]:
    """Return the gradient (6, ...) with respect to the twist and the acceleration."""
    linear, quadratic = _coefficients()
    adjoint = wrench_adjoint.reshape(60, -1)
    products_adjoint = (quadratic.reshape(60, 36).T @ adjoint).reshape(
        6, 6, *velocity.shape[1:]
    )
    turned = 2.0 * np.sum(products_adjoint * velocity, axis=1)
    return turned, (linear.T @ adjoint).reshape(velocity.shape)


_SINGULAR = 1e-14
"""Smallest eigenvalue, of a precision with a unit diagonal, that is more than rounding."""


@dataclass(frozen=True)
class Criterion:
    """How much a motion leaves unknown of what is asked for; factor and asked as in ``Known``.

    Some motion shows the scaled directions ``seen`` (10, r) of the terminal link.
    """

    seen: Array
    factor: Array
    asked: str

    def eliminated(self, information: Array, count: int) -> tuple[Array, Array]:
        """Return (T, S): theta = T x for the first ``count`` unknowns x, with all others at their
        best, and S the precision of x, priors included.
        """
        seen = self.seen.shape[1]
        others = len(self.factor)
        change = np.zeros((len(information), seen + others))
        change[:10, :seen] = self.seen
        change[10 : 10 + others, seen:] = self.factor
        # The difference of two recordings has twice the noise.
        told = 0.5 * information if self.asked == "payload" else information
        precision = change.T @ told @ change
        precision[range(seen, seen + others), range(seen, seen + others)] += 1.0
        cross = precision[:count, count:]
        best = np.linalg.solve(precision[count:, count:], cross.T)
        asked = change[:, :count] - change[:, count:] @ best
        return asked, precision[:count, :count] - cross @ best

    def evaluate(self, information: Array) -> tuple[float, Array]:
        """Return (ln det C / 2r, G) of information (10 L, 10 L); infinite if singular.

        C (r, r) is the covariance of what is asked for, all others eliminated. That is the
        logarithm of the geometric mean of the standard deviations along the axes of its confidence
        ellipsoid: a change of 0.01 is one of about 1 % (Bayesian D-optimality; Chaloner,
        Verdinelli, "Bayesian experimental design: a review", Statistical Science 10(3), 1995). Its
        derivative with respect to the information is -G G^T.
        """
        nothing = np.inf, np.zeros((len(information), 0))
        if not np.all(np.isfinite(information)):
            return nothing
        count = self.seen.shape[1] + (len(self.factor) if self.asked == "arm" else 0)
        change, precision = self.eliminated(information, count)
        root = np.sqrt(np.maximum(np.diag(precision), np.finfo(float).tiny))
        values, vectors = np.linalg.eigh(precision / np.outer(root, root))
        if values[0] <= _SINGULAR:
            return nothing
        told = 0.5 if self.asked == "payload" else 1.0
        factor = (
            np.sqrt(0.5 * told / count) * (change / root) @ (vectors / np.sqrt(values))
        )
        return -0.5 * float(np.sum(np.log(values * root**2))) / count, factor

    def covariance(self, information: Array) -> Array:
        """Return the covariance (10, 10) of what is seen of the terminal link."""
        change, precision = self.eliminated(information, self.seen.shape[1])
        return np.asarray(change[:10] @ np.linalg.solve(precision, change[:10].T))


def spread_of(theta: Array, covariance: Array) -> tuple[float, float]:
    """Return (standard deviation of the mass [kg], of the centre of mass: root of summed squares
    [m]) of a body (10,) with covariance (10, 10); the centre of mass c = h / m to first order.
    """
    slope = np.hstack((-theta[1:4, None] / theta[0], np.eye(3))) / theta[0]
    centre = slope @ covariance[:4, :4] @ slope.T
    # What is known exactly may be less than nothing by rounding.
    mass, spread = np.sqrt(
        np.maximum((covariance[0, 0], np.trace(centre)), 0.0)
    ).tolist()
    return mass, spread


def predicted_information(
    problem: ExcitationProblem, sigma: Array, known: Known, smoothing: float = 0.0
) -> PredictedInformation:
    """Return what tells the information of motions about the arm.

    From torques with noise sigma (rows,) [N m]; Coulomb friction's jump is rounded off below a
    share of the speed limits.
    """
    theta = np.array([problem.robot.links[link].theta for link in problem.links])
    smooth = smoothing * problem.limits.velocity
    arm = problem.dynamics, problem.links, theta, problem.rows
    return PredictedInformation(*arm, sigma, smooth, known.own)


def criterion(problem: ExcitationProblem, known: Known) -> Criterion:
    """Return what is minimised, about all that some motion of this arm can show.

    That is found from unrelated positions, velocities and accelerations, a fixed set of random
    numbers. What such data cannot see, no trajectory of these joints can.
    """
    scale = np.diag(problem.scale)
    information = random_information(problem, known)
    told = Criterion(scale, known.factor, known.asked).eliminated(information, 10)[1]
    values, vectors = np.linalg.eigh(told)
    seen = scale @ vectors[:, values > _HIDDEN * values[-1]]
    return Criterion(seen, known.factor, known.asked)


def random_information(
    problem: ExcitationProblem, known: Known, noise: float = 1.0
) -> Array:
    """Return the information of unrelated random motion with some torque noise [N m]."""
    rng = np.random.default_rng(0)
    count = min(400, _MOST_ROWS // problem.n_joints**2)
    q, qd, qdd = rng.normal(size=(3, count, problem.n_joints))
    q = np.clip(problem.rest + 2.0 * q, problem.limits.lower, problem.limits.upper)
    sigma = np.full(len(problem.rows), noise)
    return predicted_information(problem, sigma, known).evaluate(q, qd, qdd).information
