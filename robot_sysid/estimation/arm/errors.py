"""How far the links' parameters may be off.

The estimate is x = C A^T b + (model's part), C = (A^T A + P)^-1, with P the curvature of the
divergence at the model's own links: what the model says is taken to be good to 1 / sqrt(gamma) of
each link, and never to better than the link itself. With e the noise and f_j how much longer
joint j's residuals stay the same than white noise would, and g what the low-pass of positions may
pull by (``identify.judgement.filtering``), the covariance is

    C (sum_j f_j A_j^T A_j + P + g g^T) C.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.arm.consistent_links import LinksProblem, possible_links
from robot_sysid.records import Array, SquareRootInformation

_STRONGEST = 1.0


def covariance(
    information: SquareRootInformation, noise: Array, stretch: Array, precision: Array, pull: Array
) -> Array:
    """Return (p, p) of the parameters the information has.

    Args:
        information: the data.
        noise: (joints,) standard deviation of each joint's equations [N m].
        stretch: (joints,) f, see ``correlation_stretch``.
        precision: (p, p) P.
        pull: (p,) g.
    """
    normal, score = precision.copy(), precision + np.outer(pull, pull)
    for joint, sigma, longer in zip(information.joints, noise, stretch):
        rows = joint.triangle[:, :-1] / sigma
        own, place = rows.T @ rows, np.ix_(joint.columns, joint.columns)
        normal[place] += own
        score[place] += longer * own
    size = 1.0 / np.sqrt(np.where(np.diag(normal) > 0.0, np.diag(normal), 1.0))
    inverse = np.linalg.pinv(normal * size * size[:, None], rcond=1e-14, hermitian=True)
    inverse = inverse * size * size[:, None]
    return np.asarray(inverse @ score @ inverse)


def link_precision(problem: LinksProblem, gamma: float, prior: Array) -> Array:
    """Return P (p, p): the divergence's curvature at the model, and what else was known before.

    What has to lie between two bounds has the variance of a uniform distribution.

    Args:
        problem: links and bounds.
        gamma: weight of the model.
        prior: (p,) standard deviation of what was known, infinite where nothing was.
    """
    width = problem.upper - problem.lower
    precision = np.diag(prior**-2.0 + np.where(np.isfinite(width), 12.0 / width**2, 0.0))
    origin, weight = possible_links(problem), min(gamma, _STRONGEST)
    inside = np.concatenate(problem.links)
    held = np.setdiff1d(np.flatnonzero(problem.prior > 0.0), inside)
    precision[held, held] += weight / problem.prior[held] ** 2
    basis = spatial.pseudo_inertia(np.eye(10))
    for link in problem.links:
        turned = np.linalg.inv(spatial.pseudo_inertia(origin[link])) @ basis
        block = np.einsum("kij,lji->kl", turned, turned)
        precision[np.ix_(link, link)] += weight * block
    return precision


def correlation_stretch(residuals: Sequence[Array]) -> Array:
    """Return (joints,) 1 + 2 sum of the autocorrelation up to where it first falls below zero.

    Args:
        residuals: per joint (K,) in the order of time, NaN where a sample is not used.
    """
    return np.array([_stretch(residual) for residual in residuals])


def _stretch(residual: Array) -> float:
    used = np.isfinite(residual)
    if np.count_nonzero(used) < 3:
        return 1.0
    filled = np.where(used, residual, 0.0)
    energy, total = float(filled @ filled) / np.count_nonzero(used), 1.0
    for lag in range(1, len(filled) // 4):
        pairs = int(np.count_nonzero(used[lag:] & used[:-lag]))
        mean = float(filled[lag:] @ filled[:-lag]) / (pairs or 1)
        if mean <= 0.0 or energy == 0.0:
            break
        total += 2.0 * mean / energy
    return total
