"""How far off the other links of a model are, by what the recordings make likely.

A model states its links to a share (``--link-uncertainty``), and real models miss it: masses by 10
to 20 %, one link by 40 %. Links that hide behind each other predict torques equally well, so that
held-out torques do not show it. The marginal likelihood does (MacKay, "Bayesian interpolation",
Neural Computation 4(3), 1992). With the deviations of all links from the model

    delta = T S z,    z ~ N(0, 1),

T the directions in which links may be off (``nuisances.link_directions``) and S their scales, and
with what data and all other priors say of the links, 1/2 delta' L delta - b' delta,

    log p(S) = 1/2 v' S (1 + S M S)^-1 S v - 1/2 log |1 + S M S|,    M = T' L T,  v = T' b.

Masses, centres of mass and inertias have a scale each: one for all would loosen the centres of mass
so far that they take the part of wrong masses. Scales are averaged over a grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from robot_sysid.estimation.algebra.information import eliminate_others, normal_matrix
from robot_sysid.estimation.algebra.nuisances import LinkScales, NuisanceGroup
from robot_sysid.records import Array, SquareRootInformation

MASS_SCALES = (2.0, 4.0, 8.0)
"""Multiples of the stated share that masses may be off by, each as likely: 10, 20, 40 % of 5 %."""
COM_SCALES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
INERTIA_SCALES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
USUAL_COM_SCALE = 1.5
USUAL_INERTIA_SCALE = 2.0
"""Medians of the log-normal priors of these scales, whose standard deviation is one octave."""
EXPECTED = LinkScales(4.0, USUAL_COM_SCALE, USUAL_INERTIA_SCALE)
"""Expected scales before any recording."""
LINK_KINDS = ("mass", "centre_of_mass", "inertia")


@dataclass(frozen=True)
class LinkEvidence:
    """Marginal likelihood of the other links' deviations from the model.

    Attributes:
        n_links: L, of links that the model states.
        curvature: (10 L + 2, 10 L + 2) M.
        pull: (10 L + 2,) v.
    """

    n_links: int
    curvature: Array
    pull: Array

    def log_likelihood(self, scale: Array) -> float:
        """Return log p(S) of scales (10 L + 2,), but for a constant."""
        matrix = np.eye(len(scale)) + scale[:, None] * self.curvature * scale
        factor = np.linalg.cholesky(matrix)
        half = np.linalg.solve(factor, scale * self.pull)
        return float(0.5 * half @ half - np.sum(np.log(np.diag(factor))))


def link_evidence(
    information: SquareRootInformation,
    weights: Array,
    others: Sequence[NuisanceGroup],
    links: NuisanceGroup,
    directions: Array,
    is_stated: NDArray[np.bool_],
) -> LinkEvidence:
    """Return the evidence of data and all other priors about the links that the model states.

    Args:
        information: of the p parameters that are sought, without priors.
        weights: (joints,) by which each joint's equations count [1/(N m)].
        others: priors of everything but the links.
        links: the prior of all other links.
        directions: (10 L, 10 L + 2) T of the L links that the model states, for the stated share.
        is_stated: (links,) whether the model states a link; the prior of one of which it has a
            placeholder only stays.
    """
    normal = normal_matrix(information, weights)
    for group in others:
        rows = group.rows(information.names)
        normal += rows.T @ rows
    rows = links.rows(information.names)[np.repeat(np.logical_not(is_stated), 10)]
    normal += rows.T @ rows
    stated = np.repeat(is_stated, 10)
    indices = np.array(links.indices(information.names))[stated]
    curvature, pull = eliminate_others(normal, indices)
    pull = pull - curvature @ links.mean[stated]
    count = int(np.count_nonzero(is_stated))
    return LinkEvidence(
        count, directions.T @ curvature @ directions, directions.T @ pull
    )


def average_scales(evidence: LinkEvidence) -> LinkScales:
    """Return the root mean square of each scale over its posterior on the grid.

    Not the most likely one: where the data determines a scale badly, the errors have to cover its
    large values, too.
    """
    grid = np.array(list(product(MASS_SCALES, COM_SCALES, INERTIA_SCALES)))
    medians = np.array([USUAL_COM_SCALE, USUAL_INERTIA_SCALE])
    log_posterior = -0.5 * np.sum(np.log2(grid[:, 1:] / medians) ** 2, axis=1)
    for point, scales in enumerate(grid.tolist()):
        scale = LinkScales(*scales).of_directions(evidence.n_links)
        log_posterior[point] += evidence.log_likelihood(scale)
    probability = np.exp(log_posterior - np.max(log_posterior))
    probability /= np.sum(probability)
    return LinkScales(*np.sqrt(probability @ grid**2).tolist())
