"""What is known of an arm's links: priors, and how far the data says that models are off.

The user states a relative uncertainty of the links (the prior ``link``), and real models exceed it:
masses are off by 10 to 20 %, one link by 40 %. Confounded links predict torques equally well, so
that held-out errors do not show such deviations; the marginal likelihood does. With the links'
deviations

    delta = T S z,    z ~ N(0, 1),

T the directions in which links may be off (``link_directions``) and S their scales, and with the
curvature L and the gradient b of data and all other priors, 1/2 delta' L delta - b' delta,

    log p(S) = 1/2 v' S (1 + S M S)^-1 S v - 1/2 log |1 + S M S|,    M = T' L T,  v = T' b

(MacKay, "Bayesian interpolation", Neural Computation 4(3), 1992). Masses, centres of mass and
inertias have one scale each: a single scale for all would widen the prior of the centres of mass so
far that they absorb errors in mass. Scales are averaged on a grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.records import Array, RobotModel

ROD = float(np.sqrt(3.0))
"""Length of a uniform rod over the root mean square distance of its mass from its end."""
LEAST_SIZE = 0.02
"""Smallest size of a link in its prior [m]."""


@dataclass(frozen=True)
class LinkScales:
    """Factors on the stated standard deviations of all links but the last, by kind of error.

    Attributes:
        mass: factor on the independent error of each link's mass.
        centre_of_mass: factor on the independent error of each link's centre of mass.
        inertia: factor on the independent error of each link's inertia.
    """

    mass: float = 1.0
    centre_of_mass: float = 1.0
    inertia: float = 1.0

    def of_directions(self, n_links: int) -> Array:
        """Return the factor (10 L + 2,) on each column of ``link_directions`` of L links.

        Errors that all links share stay as the user states them.
        """
        one_link = np.repeat((self.mass, self.centre_of_mass, self.inertia), (1, 3, 6))
        return np.append(np.tile(one_link, n_links), (1.0, 1.0))


AS_STATED = LinkScales()
"""Factors of one: the prior as the user states it."""


def link_factor(
    thetas: Sequence[Array] | Array,
    share: float,
    lengths: Sequence[float] | Array,
    scales: LinkScales = AS_STATED,
) -> Array:
    """Return the Cholesky factor F (10 L, 10 L) of the prior covariance of L links.

    Independent standard deviations are ``share`` of each mass, ``share`` of the link's size for its
    centre of mass, and twice ``share`` of the mean moment for inertias about the centre of mass. A
    drawing is often wrong for all links alike (another density, shells for solids), so that common
    errors of this size act on all masses and on all distances of centres of mass from joints.

    Args:
        thetas: per link (10,), the model's values.
        share: relative standard deviation, 0.05 for 5 %.
        lengths: per link, the distance from its joint to the next one [m]. The link's size is
            this distance or, where larger, the length of a uniform rod with the same root mean
            square distance of its mass from the joint.
        scales: factors on these standard deviations, per kind of error.
    """
    directions = link_directions(thetas, lengths)
    scaled = directions * scales.of_directions(len(thetas))
    return share * np.asarray(np.linalg.cholesky(scaled @ scaled.T), dtype=float)


def link_lengths(robot: RobotModel, links: Sequence[int]) -> list[float]:
    """Return the distance from the joint of each of ``links`` to the next [m]; 0 at the last link.

    ``links`` are indices in ``robot.links``, base to terminal.
    """
    lengths = [float(np.linalg.norm(link.translation)) for link in robot.links[1:]]
    lengths.append(0.0)
    return [lengths[link] for link in links]


def model_link_factor(robot: RobotModel, links: Sequence[int], share: float) -> Array:
    """Return the Cholesky factor ``link_factor`` (10 L, 10 L) of the prior of L links: those with
    indices ``links`` in ``robot.links``, each known to a relative standard deviation ``share``.
    """
    thetas = [robot.links[link].theta for link in links]
    return link_factor(thetas, share, link_lengths(robot, links))


def link_directions(
    thetas: Sequence[Array] | Array, lengths: Sequence[float] | Array
) -> Array:
    """Return the effects (10 L, 10 L + 2) of independent errors on the parameters of L links.

    One column per error, for a relative standard deviation of one: each link's mass (1), centre of
    mass (3) and inertia (6), then the common errors of all masses and of all distances of a centre
    of mass from its joint. Per link, ``thetas`` has the ten inertial parameters of the model,
    ``lengths`` the distance from its joint to the next one [m].
    """
    directions = np.zeros((10 * len(thetas), 10 * len(thetas) + 2))
    for index, (theta, length) in enumerate(zip(thetas, lengths)):
        block = slice(10 * index, 10 * (index + 1))
        errors = own_errors(theta, length)
        moved = errors[:, 1:4]
        directions[block, block] = errors
        _, com, _ = spatial.com_from_theta(theta)
        distance = float(np.linalg.norm(com))
        # Common errors scale all parameters with the mass, and move the centre of mass outwards.
        directions[block, -2] = theta
        directions[block, -1] = moved @ com / distance if distance > 0.0 else 0.0
    return directions


def own_errors(theta: Array, length: float) -> Array:
    """Return the effects of a link's independent errors on its ten inertial parameters.

    Returns (10, 10), one column per error, for a relative standard deviation of one: mass (1),
    centre of mass along x, y, z (3), inertia (6).

    Args:
        theta: (10,) the model's parameters of the link.
        length: distance from the link's joint to the next one [m].
    """
    mass, com, inertia = spatial.com_from_theta(theta)
    size = max(ROD * spatial.characteristic_length(theta), length, LEAST_SIZE)
    # A link with little or no inertia in the model counts as a tenth of its size wide.
    moment = max(float(np.trace(inertia)) / 3.0, mass * (0.1 * size) ** 2)
    columns = [theta]
    for step in size * np.eye(3):
        ahead = spatial.theta_from_com(mass, com + step, inertia)
        behind = spatial.theta_from_com(mass, com - step, inertia)
        columns.append(0.5 * (ahead - behind))  # central difference
    return np.column_stack([*columns, *(2.0 * moment * np.eye(10)[4:])])


MASS_SCALES = (2.0, 4.0, 8.0)
"""Grid of ``LinkScales.mass``, equally likely: 10, 20, 40 % for 5 % stated."""
COM_SCALES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Grid of ``LinkScales.centre_of_mass``."""
INERTIA_SCALES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Grid of ``LinkScales.inertia``."""
USUAL_COM_SCALE = 1.5
"""Median of the log-normal prior of ``centre_of_mass``; its standard deviation is one octave."""
USUAL_INERTIA_SCALE = 2.0
"""Median of the log-normal prior of ``inertia``; its standard deviation is one octave."""
EXPECTED = LinkScales(4.0, USUAL_COM_SCALE, USUAL_INERTIA_SCALE)
"""Factors for mass, centre of mass and inertia that are expected without any recording."""


@dataclass(frozen=True)
class LinkEvidence:
    """Marginal likelihood of the scales S of links' deviations from the model (module's formula).

    Attributes:
        n_links: L, number of other links whose parameters the model states.
        curvature: (10 L + 2, 10 L + 2) M, second derivative along ``link_directions``.
        gradient: (10 L + 2,) v, first derivative along them.
    """

    n_links: int
    curvature: Array
    gradient: Array

    def log_likelihood(self, scale: Array) -> float:
        """Return log p(S) up to a constant, S = diag(scale) with ``scale`` (10 L + 2,)."""
        matrix = np.eye(len(scale)) + scale[:, None] * self.curvature * scale
        factor = np.linalg.cholesky(matrix)
        half = np.linalg.solve(factor, scale * self.gradient)
        return float(0.5 * half @ half - np.sum(np.log(np.diag(factor))))


def average_scales(evidence: LinkEvidence) -> LinkScales:
    """Return the root mean square of each factor on the links' prior over its posterior on a grid.

    A root mean square and not the most likely factor, because the prior has to allow for large
    values where the data hardly determines a factor.
    """
    # (combinations, 3): factors of mass, centre of mass and inertia.
    grid = np.array(list(product(MASS_SCALES, COM_SCALES, INERTIA_SCALES)))
    medians = np.array([USUAL_COM_SCALE, USUAL_INERTIA_SCALE])
    log_posterior = -0.5 * np.sum(np.log2(grid[:, 1:] / medians) ** 2, axis=1)
    for point, scales in enumerate(grid.tolist()):
        scale = LinkScales(*scales).of_directions(evidence.n_links)
        log_posterior[point] += evidence.log_likelihood(scale)
    probability = np.exp(log_posterior - np.max(log_posterior))
    probability /= np.sum(probability)
    return LinkScales(*np.sqrt(probability @ grid**2).tolist())
