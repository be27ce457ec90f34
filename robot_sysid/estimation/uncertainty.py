"""How far an estimate may be off: covariance, standard errors, share of data against prior.

The estimate is x = C Y^T W tau + (prior part) with C = (Y^T W Y + P)^-1, so that its covariance is

    C (sum_j w_j^4 Omega_j + P) C,

Omega_j the covariance of joint j's score Y_j^T e_j: sigma_j^2 Y_j^T Y_j for white noise, more where
slow noise meets slow motion (``autocorrelation``). P is the curvature of the prior. Along
directions that neither data nor prior show, nothing is known: the covariance is zero there, the
standard errors are infinite.

Torques that are wrong by d move the estimate by C Y^T W d. Two kinds of d matter on real arms and
hide from the residuals, because a slightly different terminal link explains them nearly as well:
the torque of the other links, which the model predicts with the errors of its own numbers, and the
scale of each joint's torque (``sensitivity``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.autocorrelation import JointResiduals
from robot_sysid.estimation.consistency import lifted_body
from robot_sysid.estimation.identifiability import N_INERTIAL, VisibleSpace, visible_space
from robot_sysid.records import Array, SquareRootInformation

_ROUNDS = 3
_SAFE_FLOOR = 1e-6


@dataclass(frozen=True)
class Uncertainty:
    """What is known about the errors of an estimate.

    Attributes:
        covariance: (p, p).
        standard_errors: (p,) infinite where only the model's value is known.
        data_share: (p,) 1 where the data alone decides, 0 where the prior does.
    """

    covariance: Array
    standard_errors: Array
    data_share: Array


def prior_curvature(theta: Array, weight: float, size: int) -> Array:
    """Return P (p, p) of an entropic prior: half the Hessian of weight d(J(theta) || J0).

    d^2 / dtheta_k dtheta_l = tr(J^-1 B_k J^-1 B_l).

    Args:
        theta: (10,) the estimate, a possible body.
        weight: of the divergence, in units of squared whitened residuals.
        size: number of parameters p.
    """
    curvature = np.zeros((size, size))
    if weight > 0.0:
        safe = lifted_body(theta, theta, _SAFE_FLOOR)
        inverse = np.linalg.inv(spatial.pseudo_inertia(safe))
        product = inverse @ spatial.pseudo_inertia(np.eye(N_INERTIAL))
        block = np.einsum("kij,lji->kl", product, product)
        curvature[:N_INERTIAL, :N_INERTIAL] = 0.5 * weight * block
    return curvature


def white_uncertainty(
    information: SquareRootInformation, weights: Array, noise: Array, prior: Array
) -> Uncertainty:
    """Return the uncertainty if each joint's noise is independent from sample to sample.

    Args:
        information: the equations.
        weights: (joints,) 1 / (what each joint's equations were divided by) [1/(N m)].
        noise: (joints,) noise standard deviation [N m].
        prior: (p, p) curvature P of the prior, zero without one.
    """
    score = np.zeros_like(prior)
    for joint, weight, sigma in zip(information.joints, weights, noise):
        rows = joint.triangle[:, :-1]
        score[np.ix_(joint.columns, joint.columns)] += weight**4 * sigma**2 * rows.T @ rows
    return _uncertainty(joint_space(information, weights, prior), score, prior)


def coloured_uncertainty(
    space: VisibleSpace, weights: Array, residuals: Sequence[JointResiduals], prior: Array
) -> tuple[Uncertainty, list[float]]:
    """Return the uncertainty under noise that is correlated in time.

    Args:
        space: what data and prior see together.
        weights, prior: as in ``white_uncertainty``.
        residuals: what a pass over the samples left.

    Returns:
        (uncertainty, effective number of samples of each joint).
    """
    inverse, score = space.inverse(), np.zeros_like(prior)
    for _ in range(_ROUNDS):
        kernels = _fit_kernels(residuals, weights, inverse, score)
        score = _score(residuals, weights, kernels, len(prior))
    effective = [joint.effective_samples(c) for joint, c in zip(residuals, kernels)]
    return _uncertainty(space, score, prior), effective


def joint_space(information: SquareRootInformation, weights: Array, prior: Array) -> VisibleSpace:
    """Return what data and prior see together; its inverse is C. Arguments as above."""
    values, vectors = np.linalg.eigh(prior)
    strong = values > 1e-14 * max(float(values[-1]), 0.0)
    rows = np.sqrt(np.where(strong, values, 0.0))[:, None] * vectors.T
    return visible_space(np.vstack((information.stacked(weights)[0], rows)))


def _score(
    residuals: Sequence[JointResiduals], weights: Array, kernels: Sequence[Array], size: int
) -> Array:
    """Return sum_j w_j^4 Omega_j (p, p)."""
    score = np.zeros((size, size))
    for joint, weight, kernel in zip(residuals, weights, kernels):
        omega = np.tensordot(kernel, joint.sums, axes=1)
        score[np.ix_(joint.columns, joint.columns)] += weight**4 * omega
    return score


def _fit_kernels(
    residuals: Sequence[JointResiduals], weights: Array, inverse: Array, score: Array
) -> list[Array]:
    """Return each joint's noise; ``score`` from the last round tells what others' noise adds."""
    spread = inverse @ score @ inverse
    found = []
    for joint, weight in zip(residuals, weights):
        at = np.ix_(joint.columns, joint.columns)
        own = weight**2 * inverse[at]
        leaked = 0.0
        if np.any(score):
            kernel = joint.fit(own, 0.0)
            mine = own @ np.tensordot(kernel, joint.sums, axes=1) @ own
            leaked = float(np.sum((spread[at] - mine) * joint.sums[0])) / max(joint.count, 1)
        found.append(joint.fit(own, max(leaked, 0.0)))
    return found


def _uncertainty(space: VisibleSpace, score: Array, prior: Array) -> Uncertainty:
    inverse = space.inverse()
    covariance = inverse @ (score + prior) @ inverse
    covariance = 0.5 * (covariance + covariance.T)
    spread = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    errors = np.where(space.identified, spread, np.inf)
    return Uncertainty(covariance, errors, _data_share(inverse, space, prior))


def _data_share(inverse: Array, space: VisibleSpace, prior: Array) -> Array:
    """Return (p,) 1 - (variance with data and prior) / (variance with the prior alone).

    Without a prior, the same for one that is infinitely weak: 1 minus the part of each parameter
    that lies in the invisible directions.
    """
    share = 1.0 - np.sum(space.null**2, axis=1)
    if np.any(prior):
        block = prior[:N_INERTIAL, :N_INERTIAL]
        alone = np.diag(np.linalg.inv(block))
        share[:N_INERTIAL] = 1.0 - np.diag(inverse)[:N_INERTIAL] / alone
    return np.clip(share, 0.0, 1.0)


OTHER_LINKS = "other_links_1_percent"
TORQUE_SCALE = "torque_scale_1_percent"
_SHARE = 0.01


def sensitivity(
    information: SquareRootInformation,
    weights: Array,
    rows: Sequence[Array],
    rest: Sequence[Array],
    measured: Sequence[Array],
) -> Mapping[str, Mapping[str, float]]:
    """Return cause to parameter to change: of a plain weighted estimate, by 1 % of each cause.

    ``OTHER_LINKS``: the torque of the rest of the arm is 1 % larger than its model says, in all
    joints. ``TORQUE_SCALE``: each joint's torque is 1 % too large, independently of the others;
    root of the summed squares.

    Args:
        information: the equations that were fitted.
        weights: (joints,) 1 / noise of each joint [1/(N m)].
        rows: per joint, its equations' rows (N_j, k).
        rest: per joint (N_j,) the torque that the model says the rest of the arm takes [N m].
        measured: per joint (N_j,) the whole measured torque [N m].
    """
    root = visible_space(information.stacked(weights)[0]).inverse_root()
    columns = [joint.columns for joint in information.joints]
    links = np.sum(_moves(root, columns, weights, rows, rest), axis=0)
    scales = np.linalg.norm(_moves(root, columns, weights, rows, measured), axis=0)
    return {
        OTHER_LINKS: dict(zip(information.names, map(float, links))),
        TORQUE_SCALE: dict(zip(information.names, map(float, scales))),
    }


def _moves(
    root: Array,
    columns: Sequence[NDArray[np.int64]],
    weights: Array,
    rows: Sequence[Array],
    torque: Sequence[Array],
) -> Array:
    """Return (joints, p) how the estimate moves by 1 % of each joint's torque."""
    moves = [
        root @ (root[own].T @ (weight**2 * _SHARE * (block.T @ tau)))
        for own, weight, block, tau in zip(columns, weights, rows, torque)
    ]
    return np.array(moves)
