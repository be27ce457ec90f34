"""Information about the arm's bodies that a motion will give, and its gradient.

Joint j delivers equations tau_j = Y_j theta + Z_j x_j, theta the parameters of all links and x_j
the unknowns of this joint alone (``JOINT_TERMS``). Its friction and the inertia of its rotor are
free; the error of its torque scale and the friction terms that the friction model lacks have the
prior x ~ N(0, s^2), which is one more row of unit variance. The information about theta after
eliminating x_j is the Schur complement

    L = sum_j E_j^T E_j / sigma_j^2 + C_j^T D C_j,   E_j = Y_j - Z_j C_j,
    C_j = (Z_j^T Z_j / sigma_j^2 + D)^-1 Z_j^T Y_j / sigma_j^2,

D the prior precision of x_j. With the prior precision P of the other links' parameters,
(L + P)^-1 is the covariance of the estimate (``expected_errors`` computes P and s).
Encoder zeros, gravity's direction and a delay are part of the predicted errors (``prediction``) but
not of this criterion: for two arms they are less than a twentieth of any variance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import LinksMotion, bracket_transposed
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.records import Array
from robot_sysid.regressor import wrench_regressor

_RIDGE = 1e-10
"""Share of the trace of Z^T Z that is added to its diagonal: x_j can then be eliminated too where a
joint stands still and its friction columns are zero."""
_STILL = 1e-9
"""Least divisor in the derivative of sqrt(abs(qd)) [(rad/s)^0.5]: it keeps the derivative finite at
zero speed."""
_INVISIBLE = 1e-9
"""Information along a direction, over the largest along any, up to which the direction is not
identifiable."""
JOINT_TERMS = ("coulomb", "viscous", "offset", "armature", "scale", "load", "sqrt")
"""Unknowns of one joint's equations alone: friction terms, rotor inertia, torque scale."""
_N_TERMS = len(JOINT_TERMS)
_RANDOM_SIZE = 400_000
"""Largest number of samples of random motion times the square of the number of joints: bounds the
memory for arms with many joints (50 MB for 60 joints)."""

Gradient = tuple[Array, Array, Array]
"""Gradient of a scalar with respect to q, qd and qdd, (N, n) each."""


@dataclass(frozen=True)
class PriorKnowledge:
    """Priors of an estimate: what is known about an arm before there is a recording.

    Attributes:
        link_factor: (10 L, 10 L) F; the parameters of the L links with mass other than the terminal
            one, from the tool to the base, have the prior covariance F F^T. (0, 0) where they are
            taken as known.
        joint_deviations: (7, rows) prior standard deviations of ``JOINT_TERMS`` in each joint's
            equations; infinite where nothing is known, zero where the term is no unknown.
        target: what the motion is to identify: "link", "arm" for every link, or "payload".
    """

    link_factor: Array
    joint_deviations: Array
    target: str = "link"


class Information(NamedTuple):
    """Information of a motion about the parameters of all L links with mass.

    Attributes:
        information: (10 L, 10 L) inverse covariance of the parameters, priors of links not
            included; the terminal link first, then towards the base.
        vjp: takes G (10 L, r) and returns the gradient, by q, qd and qdd (N, n) each, of a scalar
            whose derivative with respect to the information is -G G^T.
    """

    information: Array
    vjp: Callable[[Array], Gradient]


class InformationModel:
    """Maps motions to the information that torques along them hold about all links with mass.

    Args:
        problem: the arm, and its joints whose torque is used.
        sigma: (rows,) standard deviation of the torque noise of each used joint [N m].
        knowledge: priors of the joint terms.
        smoothing: share of the speed limits below which Coulomb friction's jump is rounded off.
    """

    def __init__(
        self,
        problem: ExcitationProblem,
        sigma: Array,
        knowledge: PriorKnowledge,
        smoothing: float = 0.0,
    ) -> None:
        self._dynamics = problem.dynamics
        self._links = list(problem.links)
        self._theta = np.ravel([problem.robot.links[k].theta for k in self._links])
        self._joints = list(problem.rows)
        self._sigma = sigma
        # (rows, 1) speed below which sign(qd) is rounded off to tanh [rad/s]; 0 for none.
        smooth_speed = smoothing * problem.limits.velocity[self._joints]
        self._smooth_speed = smooth_speed[:, None]
        self._joint_deviations = knowledge.joint_deviations
        # Number of link parameters in each used joint's equation: ten per link that it moves.
        n_moved = np.less_equal.outer(self._joints, self._links).sum(axis=1)
        self._n_carried = (10 * n_moved).tolist()

    def evaluate(self, q: Array, qd: Array, qdd: Array) -> Information:
        """Return the information of a motion with one sample per row of q, qd, qdd (N, n).

        ``Information.vjp`` keeps the arrays of this motion in memory.
        """
        motion = self._dynamics.motion(q, qd, qdd)
        joints = self._joints
        links = self._links
        velocity = np.stack(motion.velocity, axis=1)[:, links]
        acceleration = np.stack(motion.acceleration, axis=1)[:, links]
        # (N, 6, 10 L): of each sample, the wrench regressors of all links in the base's frame.
        in_link_frame = body_wrench(velocity, acceleration).transpose(2, 3, 0, 1)
        to_base = motion.to_links[links].swapaxes(-1, -2)
        wrench = to_base @ in_link_frame
        wrench = wrench.transpose(1, 2, 0, 3).reshape(len(q), 6, -1)
        # Y (rows, N, 10 L): the power of each wrench along the twist of each used joint.
        joint_twists = motion.joint_twists[:, joints]
        rows = np.empty((len(joints), len(q), len(self._theta)))
        np.matmul(joint_twists.transpose(2, 1, 0), wrench, out=rows.swapaxes(0, 1))
        self._clear_uncarried(rows)
        torque = rows @ self._theta
        terms, slopes = self._joint_terms(qd[:, joints].T, qdd[:, joints].T, torque)
        weight = 1.0 / self._sigma[:, None, None]
        rows *= weight
        terms *= weight
        # C (rows, 7, 10 L): the regression of each joint's rows on the terms of this joint alone.
        transposed = terms.transpose(0, 2, 1)
        normal = transposed @ terms
        ridge = _RIDGE * np.trace(normal, axis1=1, axis2=2)[:, None]
        # A term with a prior is in units of its standard deviation, so that its precision is 1.
        ridge = ridge + np.isfinite(self._joint_deviations).T
        precision = normal + ridge[:, None] * np.eye(_N_TERMS)
        gain = np.linalg.solve(precision, transposed @ rows)
        residual = rows - terms @ gain
        # Y^T E / sigma^2 equals the two terms of L, as E is the residual of a regression.
        information = np.zeros((len(self._theta), len(self._theta)))
        for row, joint_residual, count in zip(rows, residual, self._n_carried):
            block = row[:, :count].T @ joint_residual[:, :count]
            information[:count, :count] += block
        residual *= weight
        vjp = partial(
            self._vjp, motion, (qd, qdd), velocity, wrench, slopes, gain, residual
        )
        return Information(0.5 * (information + information.T), vjp)

    def _clear_uncarried(self, rows: Array) -> None:
        """Set to zero the columns of rows (joints, N, 10 L) of links that a joint does not move."""
        for block, count in zip(rows, self._n_carried):
            block[:, count:] = 0.0

    def _joint_terms(
        self, qd: Array, qdd: Array, torque: Array
    ) -> tuple[Array, list[Array]]:
        """Return the columns Z (rows, N, 7) of ``JOINT_TERMS``, in units of their prior standard
        deviations where these are finite, and a list of their derivatives (rows, N, 7) by speed,
        acceleration and torque.

        Args:
            qd: (rows, N) speeds of the used joints [rad/s].
            qdd: (rows, N) accelerations [rad/s^2].
            torque: (rows, N) torques of the model's links [N m].
        """
        speed = self._smooth_speed
        divisor = np.where(speed > 0.0, speed, 1.0)
        smooth = np.tanh(qd / divisor)
        sign = np.where(speed > 0.0, smooth, np.sign(qd))
        slope = np.where(speed > 0.0, (1.0 - smooth**2) / divisor, 0.0)
        root = np.sqrt(np.abs(qd))
        one = np.ones_like(qd)
        zero = np.zeros_like(qd)
        root_slope = 0.5 * np.abs(sign) / np.maximum(root, _STILL)
        is_prior = np.isfinite(self._joint_deviations)
        unit = np.where(is_prior, self._joint_deviations, 1.0).T[:, None]
        load = np.abs(torque)
        # In the order of ``JOINT_TERMS``: the terms, their derivatives by speed, by acceleration
        # and by torque.
        tables = (
            (sign, qd, one, qdd, torque, sign * load, sign * root),
            (slope, one, zero, zero, zero, slope * load, slope * root + root_slope),
            (zero, zero, zero, one, zero, zero, zero),
            (zero, zero, zero, zero, one, sign * np.sign(torque), zero),
        )
        terms, *slopes = (unit * np.stack(columns, axis=2) for columns in tables)
        return terms, slopes

    def _vjp(
        self,
        motion: LinksMotion,
        rates: tuple[Array, Array],
        velocity: Array,
        wrench: Array,
        slopes: list[Array],
        gain: Array,
        residual: Array,
        factor: Array,
    ) -> Gradient:
        """Return the gradient of a scalar with the derivative -G G^T by the information, G being
        ``factor`` (10 L, r), with respect to q, qd and qdd (N, n) each, in reverse mode.

        The regression C_j (``gain``) needs no derivative: it minimises the residual.

        Args:
            motion: of all links.
            rates: qd and qdd, (N, n) each.
            velocity: (6, L, N) twists of the links with mass, in their frames.
            wrench: (N, 6, 10 L) wrench regressors in the base's frame.
            slopes: derivatives (rows, N, 7) of the joint terms by speed, acceleration and torque.
            gain: (rows, 7, 10 L) C_j.
            residual: (rows, N, 10 L) E_j over the variance of the torque noise.
            factor: (10 L, r) G.
        """
        # An x_adjoint is the scalar's gradient with respect to x: of the rows Y and the terms Z.
        rows_adjoint = (-2.0 * residual @ factor) @ factor.T
        terms_adjoint = -rows_adjoint @ gain.transpose(0, 2, 1)
        adjoints = [np.sum(terms_adjoint * slope, axis=2) for slope in slopes]
        by_qd, by_qdd, by_torque = adjoints
        rows_adjoint += by_torque[:, :, None] * self._theta
        self._clear_uncarried(rows_adjoint)
        # Each row is a product of a joint's twist and a link's wrench, both in the base's frame.
        joints = self._joints
        links = self._links
        sample_adjoint = rows_adjoint.swapaxes(0, 1)
        by_screws, by_turns, *by_motion = np.zeros((4, *motion.joint_twists.shape))
        screw_adjoint = sample_adjoint @ wrench.swapaxes(1, 2)
        by_screws[:, joints] = screw_adjoint.transpose(2, 1, 0)
        twists = motion.joint_twists[:, joints].transpose(2, 0, 1)
        shape = (len(wrench), 6, len(links), 10)
        by_wrench = (twists @ sample_adjoint).reshape(shape).transpose(1, 2, 3, 0)
        wrench = wrench.reshape(shape).transpose(1, 2, 3, 0)
        # A turn of a link turns its wrenches.
        by_turns[:, links] = np.sum(bracket_transposed(by_wrench, wrench), axis=2)
        in_link_frame = motion.to_links[links] @ by_wrench.transpose(1, 3, 0, 2)
        gradients = _wrench_vjp(velocity, in_link_frame.transpose(2, 3, 0, 1))
        for by_twist, gradient in zip(by_motion, gradients):
            by_twist[:, links] = gradient
        total = motion.gradient(rates, by_screws, by_motion, by_turns)
        # The joint terms depend on qd and qdd directly too.
        total[1][:, joints] += by_qd.T
        total[2][:, joints] += by_qdd.T
        return total


@lru_cache(maxsize=1)
def _coefficients() -> tuple[Array, Array]:
    """Return A (60, 6) and B (60, 6, 6), symmetric in its last two axes, of the wrench regressor as
    a function of acceleration V' and twist V: Y6 = A V' + B V V, with the (6, 10) entries of Y6 as
    60 rows. Computed once and cached: do not change the arrays.
    """
    # From values of ``wrench_regressor`` (polarisation), so that its formula is written only once.
    unit = np.eye(6)
    zero = np.zeros((6, 6))
    linear = wrench_regressor(zero, unit).reshape(60, 6)
    sums = (unit[:, None] + unit).reshape(36, 6)
    of_sums = wrench_regressor(sums, np.zeros_like(sums)).reshape(60, 6, 6)
    of_units = wrench_regressor(unit, zero).reshape(60, 6)
    return linear, 0.5 * (of_sums - of_units[:, :, None] - of_units[:, None, :])


def body_wrench(velocity: Array, acceleration: Array) -> Array:
    """Return the wrench regressor Y6 (6, 10, ...) for twists (6, ...) and spatial accelerations
    minus gravity (6, ...), as ``regressor.wrench_regressor`` does for one body.
    """
    linear, quadratic = _coefficients()
    products = (velocity[:, None] * velocity[None, :]).reshape(36, -1)
    wrench = linear @ acceleration.reshape(6, -1) + quadratic.reshape(60, 36) @ products
    return wrench.reshape(6, 10, *velocity.shape[1:])


def _wrench_vjp(velocity: Array, wrench_adjoint: Array) -> tuple[Array, Array]:
    """Return the gradients (6, ...) of a scalar with respect to the twist and the acceleration that
    are given to ``body_wrench``.

    Args:
        velocity: (6, ...) the twist.
        wrench_adjoint: (6, 10, ...) gradient of the scalar with respect to the wrench regressor.
    """
    linear, quadratic = _coefficients()
    adjoint = wrench_adjoint.reshape(60, -1)
    by_products = quadratic.reshape(60, 36).T @ adjoint
    by_products = by_products.reshape(6, 6, *velocity.shape[1:])
    by_velocity = 2.0 * np.sum(by_products * velocity, axis=1)
    return by_velocity, (linear.T @ adjoint).reshape(velocity.shape)


_SINGULAR = 1e-14
"""Smallest eigenvalue, of a precision with a unit diagonal, that is more than rounding."""


@dataclass(frozen=True)
class Criterion:
    """The number that a design minimises: the logarithm of the mean standard deviation that a
    motion leaves of the parameters it is to identify.

    Attributes:
        visible: (10, r) directions in the space of the terminal link's parameters that are
            identifiable by some motion, in units of the typical sizes of the parameters.
        link_factor: (10 L, 10 L), see ``PriorKnowledge``.
        target: "link", "arm" or "payload", see ``PriorKnowledge``.
    """

    visible: Array
    link_factor: Array
    target: str

    def eliminate(self, information: Array, count: int) -> tuple[Array, Array]:
        """Return (T (10 L, count), S (count, count)) with all but the first ``count`` unknowns
        eliminated.

        The unknowns are the coordinates of theta in ``visible``, then those of the other links in
        ``link_factor``. S is the precision of the first ``count`` unknowns x, priors included;
        theta = T x where the other unknowns have the values that fit best with x.

        Args:
            information: (10 L, 10 L) of a motion, the terminal link first.
            count: number of unknowns that stay.
        """
        n_visible = self.visible.shape[1]
        n_others = len(self.link_factor)
        # theta = change @ unknowns; the unknowns of the other links have unit prior covariance.
        change = np.zeros((len(information), n_visible + n_others))
        change[:10, :n_visible] = self.visible
        change[10 : 10 + n_others, n_visible:] = self.link_factor
        precision = change.T @ information @ change
        prior = range(n_visible, n_visible + n_others)
        precision[prior, prior] += 1.0
        cross = precision[:count, count:]
        best = np.linalg.solve(precision[count:, count:], cross.T)
        directions = change[:, :count] - change[:, count:] @ best
        return directions, precision[:count, :count] - cross @ best

    def evaluate(self, information: Array) -> tuple[float, Array]:
        """Return (ln det C / 2r, G (10 L, r)) of information (10 L, 10 L); infinite if singular.

        C (r, r) is the covariance of the target's parameters, all others eliminated. The value is
        the logarithm of the geometric mean of the standard deviations along the axes of the
        confidence ellipsoid: a change of 0.01 is one of about 1 % (Bayesian D-optimality; Chaloner,
        Verdinelli, "Bayesian experimental design: a review", Statistical Science 10(3), 1995). The
        derivative of the value with respect to the information is -G G^T.
        """
        singular = np.inf, np.zeros((len(information), 0))
        if not np.all(np.isfinite(information)):
            return singular
        count = self.visible.shape[1]
        if self.target == "arm":
            count += len(self.link_factor)
        change, precision = self.eliminate(information, count)
        root = np.sqrt(np.maximum(np.diag(precision), np.finfo(float).tiny))
        values, vectors = np.linalg.eigh(precision / np.outer(root, root))
        if values[0] <= _SINGULAR:
            return singular
        scale = np.sqrt(0.5 / count)
        factor = scale * (change / root) @ (vectors / np.sqrt(values))
        return -0.5 * float(np.sum(np.log(values * root**2))) / count, factor

    def covariance(self, information: Array) -> Array:
        """Return the covariance (10, 10) of the terminal link's parameters that information
        (10 L, 10 L) and the priors leave; zero along directions that no motion shows.
        """
        change, precision = self.eliminate(information, self.visible.shape[1])
        return change[:10] @ np.linalg.solve(precision, change[:10].T)


def design_criterion(
    problem: ExcitationProblem, knowledge: PriorKnowledge
) -> Criterion:
    """Return the criterion that a design minimises, over all identifiable parameter combinations.

    A combination counts as identifiable if ``random_information`` has information about it: no
    trajectory of these joints can show more than unrelated random positions, velocities and
    accelerations do.
    """
    scale = np.diag(problem.scale)
    information = random_information(problem, knowledge)
    # All ten directions at first, in units of the typical sizes of the parameters.
    criterion = Criterion(
        visible=scale, link_factor=knowledge.link_factor, target=knowledge.target
    )
    _, precision = criterion.eliminate(information, count=10)
    values, vectors = np.linalg.eigh(precision)
    visible = scale @ vectors[:, values > _INVISIBLE * values[-1]]
    return replace(criterion, visible=visible)


def random_information(
    problem: ExcitationProblem, knowledge: PriorKnowledge, noise: float = 1.0
) -> Array:
    """Return the information (10 L, 10 L) about all L links with mass, the terminal one first, of
    unrelated random positions, velocities and accelerations, which are the same in every call.

    Args:
        problem: the arm; its position limits bound the positions.
        knowledge: priors of the joint terms.
        noise: standard deviation of the torque noise of all joints [N m].
    """
    rng = np.random.default_rng(0)
    count = min(400, _RANDOM_SIZE // problem.n_joints**2)
    q, qd, qdd = rng.normal(size=(3, count, problem.n_joints))
    q = np.clip(problem.rest + 2.0 * q, problem.limits.lower, problem.limits.upper)
    sigma = np.full(len(problem.rows), noise)
    return InformationModel(problem, sigma, knowledge).evaluate(q, qd, qdd).information
