"""Priors of nuisances: how far the parameters of a real arm may be off their nominal values.

Nuisances d (parameters of the other links, torque scales, encoder zeros, the direction of gravity)
are estimated together with the terminal link under d ~ N(d0, F F^T), one group per cause. Where the
data contradicts the prior of a group that may be widened, its standard deviations are multiplied by

    alpha^2 = |F^-1 (d - d0)|^2 / gamma,   gamma = sum_k (1 - [F^-1 C F^-T]_kk),

gamma the number of directions that the data determines (MacKay, "Bayesian interpolation", Neural
Computation 4(3), 1992, eq. 22 and 33), C the covariance of the estimate; never below 1.

The widths of the other links' prior are estimated by kind of parameter. The user states a relative
uncertainty of the links (the prior ``link``, the share), and real models exceed it: masses are
off by 10 to 20 %, one link by 40 %. Confounded links predict torques equally well, so that held-out
errors do not show such deviations; the marginal likelihood does. With the links' deviations

    delta = T S z,    z ~ N(0, 1),

T the directions in which links may be off (``link_directions``) and S their scales, and with the
curvature L and the gradient b of data and all other priors, 1/2 delta' L delta - b' delta,

    log p(S) = 1/2 v' S (1 + S M S)^-1 S v - 1/2 log |1 + S M S|,    M = T' L T,  v = T' b.

Masses, centres of mass and inertias have one scale each: a single scale for all would widen the
prior of the centres of mass so far that they absorb errors in mass. Scales are averaged on a grid.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.algebra.least_squares import (
    eliminate_others,
    normal_matrix,
    solve_normal,
    solve_rows,
)
from robot_sysid.records import Array, PriorConflict, RobotModel, SquareRootInformation

ROD = float(np.sqrt(3.0))
"""Length of a uniform rod over the root mean square distance of its mass from its end."""
LEAST_SIZE = 0.02
"""Smallest size of a link in its prior [m]."""
SURE = 0.99
"""Confidence level above which a contradiction between data and prior is reported."""
WIDEST = 20.0
"""Largest factor alpha of a widened prior: 20 times 5 % is 100 %."""
# Squared deviation of a link or joint above which a conflict names it as well, as a share of the
# largest one in its group; a choice.
_SHARE_OF_WORST = 0.3
# Largest number of rounds of widening.
_ROUNDS = 30
# Relative change of a factor alpha below which it has converged.
_SETTLED = 1e-3
# Smallest factor alpha where a prior may become narrower.
_NARROWEST = 0.01
# Factor alpha that holds a group at its mean.
_FIXED = 1e-4


@dataclass(frozen=True)
class LinkScales:
    """Factors on the stated standard deviations of all links but the last, by kind of error.

    Attributes:
        mass: factor on the independent error of each link's mass.
        centre_of_mass: factor on the independent error of each link's centre of mass.
        inertia: factor on the independent error of each link's inertia.
        common: factor on the relative errors in mass and in distance that all links share.
    """

    mass: float = 1.0
    centre_of_mass: float = 1.0
    inertia: float = 1.0
    common: float = 1.0

    def of_directions(self, n_links: int) -> Array:
        """Return the factor (10 L + 2,) on each column of ``link_directions`` of L links."""
        one_link = np.repeat((self.mass, self.centre_of_mass, self.inertia), (1, 3, 6))
        return np.append(np.tile(one_link, n_links), (self.common, self.common))


AS_STATED = LinkScales()
"""Factors of one: the prior as the user states it."""


@dataclass(frozen=True)
class NuisanceGroup:
    """The nuisances with one cause, and their prior N(mean, (widened factor) (widened factor)^T).

    Attributes:
        cause: cause of the nuisances' errors in words, such as "links".
        names: (k,) parameter names of the nuisances.
        mean: (k,) prior mean d0.
        factor: (k, k) F, the prior covariance is F F^T before widening.
        members: (k,) name of the link or joint that each nuisance belongs to.
        may_widen: whether the prior is widened where the data contradicts it.
        widened: factor alpha on all standard deviations.
        aspects: returns matrices (m, k), each the combinations of nuisances that may contradict
            their prior while the others do not, such as all masses; none by default.
    """

    cause: str
    names: tuple[str, ...]
    mean: Array
    factor: Array
    members: tuple[str, ...]
    may_widen: bool = False
    widened: float = 1.0
    aspects: Callable[[], tuple[Array, ...]] = tuple

    def prior_rows(self, names: Sequence[str]) -> Array:
        """Return the prior as equations [A b] (k, p + 1) of unit variance in parameters (p,)."""
        inverse = np.linalg.inv(self.widened * self.factor)
        rows = np.zeros((len(self.names), len(names) + 1))
        rows[:, self.indices(names)] = inverse
        rows[:, -1] = inverse @ self.mean
        return rows

    def indices(self, names: Sequence[str]) -> list[int]:
        """Return the indices of the nuisances among the parameters ``names``."""
        return [names.index(name) for name in self.names]

    def covariance_rows(self, names: Sequence[str], inverse: Array) -> Array:
        """Return rows R (k, p), R^T R the part of an estimate's covariance due to this prior.

        Args:
            names: (p,) names of the estimated parameters.
            inverse: C (p, p), the inverse of the normal matrix of data and priors.
        """
        rows = inverse[self.indices(names)]
        return np.asarray(np.linalg.solve(self.widened * self.factor, rows))


def independent_prior(
    cause: str,
    names: Sequence[str],
    members: Sequence[str],
    standard_deviation: float | Array,
    may_widen: bool = False,
) -> NuisanceGroup:
    """Return the prior of k nuisances with independent errors around zero.

    Args:
        cause: cause of the errors, as it is called in results.
        names: (k,) names of the parameters.
        members: (k,) name of each nuisance's link or joint, for messages.
        standard_deviation: one for all, or (k,) [SI].
        may_widen: whether the data may widen the prior.
    """
    mean = np.zeros(len(names))
    factor = standard_deviation * np.eye(len(names))
    return NuisanceGroup(cause, tuple(names), mean, factor, tuple(members), may_widen)


def with_prior(
    information: SquareRootInformation, groups: Sequence[NuisanceGroup]
) -> SquareRootInformation:
    """Return the information with the groups' priors in place of its own; itself without groups."""
    if not groups:
        return information
    return replace(information, prior=_prior_equations(groups, information.names))


def _prior_equations(groups: Sequence[NuisanceGroup], names: Sequence[str]) -> Array:
    """Return the equations [A b] (r, p + 1) of all priors, r nuisances and p named parameters."""
    blocks = [np.zeros((0, len(names) + 1))]
    for group in groups:
        blocks.append(group.prior_rows(names))
    return np.vstack(blocks)


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
    directions = link_directions(tuple(map(tuple, thetas)), tuple(lengths))
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


@lru_cache(maxsize=8)
def link_directions(
    thetas: tuple[tuple[float, ...], ...], lengths: tuple[float, ...]
) -> Array:
    """Return the effects (10 L, 10 L + 2) of independent errors on the parameters of L links.

    One column per error, for a relative standard deviation of one: each link's mass (1), centre of
    mass (3) and inertia (6), then the common errors of all masses and of all distances of a centre
    of mass from its joint. The array is cached: do not change it. Per link, ``thetas`` has the ten
    inertial parameters of the model, ``lengths`` the distance from its joint to the next one [m].
    """
    directions = np.zeros((10 * len(thetas), 10 * len(thetas) + 2))
    for index, (theta, length) in enumerate(zip(np.array(thetas), lengths)):
        block = slice(10 * index, 10 * (index + 1))
        directions[block, block], moved = own_errors(theta, share=1.0, length=length)
        _, com, _ = spatial.com_from_theta(theta)
        distance = float(np.linalg.norm(com))
        # Common errors scale all parameters with the mass, and move the centre of mass outwards.
        directions[block, -2] = theta
        directions[block, -1] = moved @ com / distance if distance > 0.0 else 0.0
    return directions


def link_aspects(
    thetas: Sequence[Array] | Array, lengths: Sequence[float] | Array
) -> tuple[Array, ...]:
    """Return three matrices (L, 10 L), (3 L, 10 L), (6 L, 10 L) that turn deviations of the ten
    inertial parameters of L links into those of masses, of centres of mass and of inertias, as
    multiples of the errors in ``own_errors`` for a share of one.
    """
    selection = np.zeros((10 * len(thetas), 10 * len(thetas)))
    for index, (theta, length) in enumerate(zip(thetas, lengths)):
        block = slice(10 * index, 10 * (index + 1))
        effects, _ = own_errors(theta, share=1.0, length=length)
        selection[block, block] = np.linalg.inv(effects)
    # Of a link's ten rows the first is its mass, then three of its centre of mass, six of inertia.
    rows = np.arange(len(selection)) % 10
    return selection[rows < 1], selection[(rows >= 1) & (rows < 4)], selection[rows > 3]


def own_errors(theta: Array, share: float, length: float) -> tuple[Array, Array]:
    """Return the effects of a link's independent errors on its ten inertial parameters.

    Returns (10, 10), one column per error, of one standard deviation: mass (1), centre of mass
    along x, y, z (3), inertia (6); and (10, 3), the columns of the centre of mass alone.

    Args:
        theta: (10,) the model's parameters of the link.
        share: relative standard deviation of the errors.
        length: distance from the link's joint to the next one [m].
    """
    mass, com, inertia = spatial.com_from_theta(theta)
    size = max(ROD * spatial.characteristic_length(theta), length, LEAST_SIZE)
    # A link with little or no inertia in the model counts as a tenth of its size wide.
    moment = max(float(np.trace(inertia)) / 3.0, mass * (0.1 * size) ** 2)
    columns = []
    for step in share * size * np.eye(3):
        ahead = spatial.theta_from_com(mass, com + step, inertia)
        behind = spatial.theta_from_com(mass, com - step, inertia)
        columns.append(0.5 * (ahead - behind))  # central difference
    turns = list(2.0 * share * moment * np.eye(10)[4:])
    return np.column_stack([share * theta, *columns, *turns]), np.column_stack(columns)


def widened_groups(
    information: SquareRootInformation,
    noise: Array,
    groups: Sequence[NuisanceGroup],
    least: float = 1.0,
) -> tuple[NuisanceGroup, ...]:
    """Return the groups with the factors alpha on their standard deviations that the data implies.

    Args:
        information: equations of all joints; their prior does not count.
        noise: (joints,) standard deviation of the torque noise [N m].
        groups: all priors; not changed. A tuple is returned itself where no group may change.
        least: smallest alpha; below one, groups that may not widen get such a factor as well.
    """
    widened = list(groups)
    may_change = [group.may_widen or least < 1.0 for group in groups]
    if not any(may_change):
        return tuple(groups)
    problem = WithPriors(information, noise)
    for _ in range(_ROUNDS):
        values, covariance, _ = problem.solve(widened)
        changes = []
        for k in np.flatnonzero(may_change):
            group = widened[k]
            aspect = np.eye(len(group.names))
            alpha, _ = _widening(group, aspect, problem.names, values, covariance)
            alpha = max(alpha, least)
            changes.append(abs(alpha / group.widened - 1.0))
            widened[k] = replace(group, widened=alpha)
        if all(change < _SETTLED for change in changes):
            break
    return tuple(widened)


class WithPriors:
    """Data with fixed noise, solved with different priors to compare the results.

    Args:
        information: equations of all joints; their prior does not count.
        noise: (joints,) standard deviation of the torque noise [N m].

    Attributes:
        names: (p,) of the parameters.
    """

    def __init__(self, information: SquareRootInformation, noise: Array) -> None:
        self.names = information.names
        self._weights = 1.0 / noise
        self._data = replace(information, prior=None)
        self._gram = normal_matrix(self._data, self._weights)

    def solve(self, groups: Sequence[NuisanceGroup]) -> tuple[Array, Array, float]:
        """Return (estimate (p,), covariance (p, p), misfit) under the priors of these groups.

        The misfit is the sum of all squared residuals, of data and priors, in standard deviations.
        """
        prior = _prior_equations(groups, self.names)
        size = len(self.names)
        squares = np.append(self._weights, 1.0) ** 2
        blocks = []
        for joint in self._data.joints:
            blocks.append((np.append(joint.columns, size), joint.triangle))
        blocks.append((np.arange(size + 1), prior))
        normal = self._gram + prior.T @ prior
        solution = solve_normal(normal, blocks, squares, np.zeros(size))
        if solution is None:
            rows = np.vstack((*self._data.equation_blocks(self._weights), prior))
            solution = solve_rows(rows)
        values, root = solution
        residual = self._weights**2 @ self._data.squared_residuals(values)
        misfit = residual + np.sum((prior @ np.append(values, -1.0)) ** 2)
        return values, root @ root.T, float(misfit)

    def log_evidence(self, groups: Sequence[NuisanceGroup]) -> tuple[Array, float]:
        """Return (estimate (p,), log marginal likelihood under the priors up to a constant).

        With C the covariance of the estimate, and F of each prior, the likelihood is
        exp(-misfit / 2) |C|^1/2 / |F| (MacKay 1992, eq. 7 and 8).
        """
        values, covariance, misfit = self.solve(groups)
        log_prior = 0.0
        for group in groups:
            log_prior += np.linalg.slogdet(group.widened * group.factor)[1]
        log_covariance = np.linalg.slogdet(covariance)[1]
        return values, float(0.5 * (log_covariance - misfit) - log_prior)


def _widening(
    group: NuisanceGroup,
    aspect: Array,
    names: Sequence[str],
    values: Array,
    covariance: Array,
) -> tuple[float, float]:
    """Return (alpha, gamma) of the module's formulas for some combinations of a group's nuisances.

    alpha is at most ``WIDEST``, gamma at least one.

    Args:
        group: k nuisances with their prior.
        aspect: (m, k) weights of the nuisances in m combinations.
        names: (p,) names of the estimated parameters.
        values: (p,) the estimate.
        covariance: (p, p) of the estimate.
    """
    root = np.linalg.cholesky(aspect @ group.factor @ group.factor.T @ aspect.T)
    off = np.linalg.solve(root, aspect @ (values[group.indices(names)] - group.mean))
    determined = _count_determined(group, aspect, names, covariance)
    return float(min(np.sqrt(np.sum(off**2) / determined), WIDEST)), determined


def _count_determined(
    group: NuisanceGroup, aspect: Array, names: Sequence[str], covariance: Array
) -> float:
    """Return gamma, the number of combinations ``aspect`` (m, k) of a group that the data
    determines, at least one: the sum of 1 - posterior / prior variance over whitened directions.

    ``covariance`` (p, p) is that of the estimate in the order of ``names`` (p,).
    """
    indices = group.indices(names)
    prior = aspect @ group.factor @ group.factor.T @ aspect.T
    root = group.widened * np.linalg.cholesky(prior)
    posterior = aspect @ covariance[np.ix_(indices, indices)] @ aspect.T
    whitened = np.linalg.solve(root, np.linalg.solve(root, posterior).T)
    shares = np.clip(1.0 - np.diag(whitened), 0.0, 1.0)
    return max(float(np.sum(shares)), 1.0)


def misfits(
    information: SquareRootInformation, noise: Array, groups: Sequence[NuisanceGroup]
) -> tuple[PriorConflict, ...]:
    """Return a conflict for each group whose prior the data contradicts significantly.

    It does where holding the group at its mean increases the misfit by more than chi-square allows,
    at the confidence ``SURE`` for all groups together. The conflict's factor is that of the worst
    aspect: links of another density contradict it in masses alone, which an average would hide.

    Args:
        information: equations of all joints; their prior does not count.
        noise: (joints,) standard deviation of the torque noise [N m].
        groups: all priors, widened as in the estimate.
    """
    problem = WithPriors(information, noise)
    # The probability of a false alarm for one group, with 1 - SURE for all of them together.
    chance = 1.0 - SURE ** (1.0 / max(len(groups), 1))
    values, covariance, misfit = problem.solve(groups)
    wide_groups = tuple[NuisanceGroup, ...]()
    wide_solution = values, covariance
    conflicts = []
    for index, group in enumerate(groups):
        fixed = [*groups[:index], replace(group, widened=_FIXED), *groups[index + 1 :]]
        _, _, fixed_misfit = problem.solve(fixed)
        freedom = _count_determined(
            group, np.eye(len(group.names)), problem.names, covariance
        )
        if is_significant(fixed_misfit - misfit, freedom, chance):
            if not wide_groups:  # computed once, and only for a conflict
                wide_groups = widened_groups(information, noise, groups, _NARROWEST)
                wide_solution = problem.solve(wide_groups)[:2]
            worst = _worst_members(group, problem.names, values)
            wide = wide_groups[index]
            factor = _contradicted_factor(wide, problem.names, *wide_solution)
            conflicts.append(PriorConflict(group.cause, worst, factor, group.widened))
    return tuple(conflicts)


def _contradicted_factor(
    group: NuisanceGroup, names: Sequence[str], values: Array, covariance: Array
) -> float:
    """Return the largest significant factor alpha of a group's aspects and of all its parameters.

    Without a significant one, return the factor of all parameters, at most one. ``values`` (p,) and
    ``covariance`` (p, p) are the estimate of the parameters ``names`` (p,).
    """
    factors = []
    identity = np.eye(len(group.names))
    for aspect in (*group.aspects(), identity):
        alpha, freedom = _widening(group, aspect, names, values, covariance)
        squared = alpha**2 * freedom  # sum of squared deviations, by alpha's definition
        if is_significant(squared, freedom, 1.0 - SURE):
            factors.append(alpha)
    # The last alpha is that of all parameters.
    return max(factors, default=min(alpha, 1.0))


def is_significant(squared: float, freedom: float, chance: float) -> bool:
    """Return whether a sum of squares is larger than chance explains.

    Args:
        squared: sum of squared deviations, each in standard deviations.
        freedom: degrees of freedom of chi-square, the number of independent deviations.
        chance: probability of a false alarm, such as 0.01.
    """
    return squared > chi_square_limit(freedom, chance)


def chi_square_limit(freedom: float, chance: float) -> float:
    """Return the value that chi-square exceeds with probability ``chance``, such as 0.01.

    ``freedom`` is its number of degrees of freedom.
    """
    from scipy.special import chdtri

    return float(chdtri(freedom, chance))


def _worst_members(
    group: NuisanceGroup, names: Sequence[str], values: Array
) -> tuple[str, ...]:
    """Return the links or joints of a group that contradict its prior, the worst one first.

    They are all those whose squared deviation from the prior, in standard deviations, is above
    ``_SHARE_OF_WORST`` of the largest one. ``values`` (p,) are the estimate of the parameters
    ``names`` (p,).
    """
    off = np.linalg.solve(group.factor, values[group.indices(names)] - group.mean)
    members = np.array(group.members)
    squares = {}
    for name in group.members:
        squares[name] = float(np.sum(off[members == name] ** 2))
    least = _SHARE_OF_WORST * max(squares.values())
    descending = sorted(squares, key=lambda name: -squares[name])
    return tuple(name for name in descending if squares[name] > least)


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
LINK_KINDS = ("mass", "centre_of_mass", "inertia")
"""Fields of ``LinkScales`` that are estimated."""


@dataclass(frozen=True)
class LinkEvidence:
    """Marginal likelihood of the scales S of links' deviations from the model (module's formula).

    Attributes:
        n_links: L, number of other links whose parameters the model states.
        curvature: (10 L + 2, 10 L + 2) M, second derivative along ``link_directions``.
        pull: (10 L + 2,) v, gradient along them.
    """

    n_links: int
    curvature: Array
    pull: Array

    def log_likelihood(self, scale: Array) -> float:
        """Return log p(S) up to a constant, S = diag(scale) with ``scale`` (10 L + 2,)."""
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
        information: of the p estimated parameters, without priors.
        weights: (joints,) of each joint's equations [1/(N m)].
        others: priors of all nuisances but the links.
        links: the prior of all other links.
        directions: (10 L, 10 L + 2) T of the L links that the model states, for the stated share.
        is_stated: (links,) whether the model states a link; links of which it only has a
            placeholder keep their prior.
    """
    names = information.names
    stated = np.repeat(is_stated, 10)
    normal = normal_matrix(information, weights)
    for group in others:
        rows = group.prior_rows(names)
        normal += rows.T @ rows
    # Errors of stated links and of placeholders are independent: no row contains both.
    rows = links.prior_rows(names)[~stated]
    normal += rows.T @ rows
    curvature, pull = eliminate_others(normal, np.array(links.indices(names))[stated])
    pull = directions.T @ (pull - curvature @ links.mean[stated])
    count = int(np.count_nonzero(is_stated))
    return LinkEvidence(count, directions.T @ curvature @ directions, pull)


def average_scales(evidence: LinkEvidence) -> LinkScales:
    """Return the root mean square of each factor on the links' prior over its posterior on a grid.

    The factor ``common`` stays at one. A root mean square and not the most likely factor, because
    the prior has to allow for large values where the data hardly determines a factor.
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
