"""What is not known of a real arm, as a prior: how much each nuisance may be off.

Nuisances d (the other links' parameters, torque scales, encoder zeros, the direction of gravity)
are estimated together with the terminal link under d ~ N(d0, F F^T), one group per cause. Where the
data asks for more than the prior of the other links or of friction allows, the group is widened by

    alpha^2 = |F^-1 (d - d0)|^2 / gamma,   gamma = sum_k (1 - [F^-1 C F^-T]_kk),

gamma the number of directions that the data determines (MacKay, "Bayesian interpolation", Neural
Computation 4(3), 1992, eq. 22 and 33), C the covariance of the estimate; never below 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.algebra.information import normal_matrix
from robot_sysid.estimation.algebra.least_squares import solve_normal, solve_rows
from robot_sysid.records import Array, PriorConflict, RobotModel, SquareRootInformation

ROD = float(np.sqrt(3.0))
"""Length of a uniform rod over the root mean square distance of its mass from its end."""
LEAST_SIZE = 0.02
"""Size that a link has at least, where its prior is made [m]."""
SURE = 0.99
"""Probability with which the data must contradict what was thought before it is said."""
WIDEST = 20.0
"""Factor that no prior is widened by more than: 20 times 5 % is all."""
# A member is named with the worst one from this share of its squared deviation on; chosen.
_SHARE_OF_WORST = 0.3
# Most rounds until a width rests, and to what; widths for "may be narrower" and "is known".
_ROUNDS, _SETTLED, _NARROWEST, _FIXED = 30, 1e-3, 0.01, 1e-4


@dataclass(frozen=True)
class LinkScales:
    """By how many times the stated share links may be off, in each kind of their numbers.

    ``common`` is for what all links have in common.
    """

    mass: float = 1.0
    centre_of_mass: float = 1.0
    inertia: float = 1.0
    common: float = 1.0

    def of_directions(self, n_links: int) -> Array:
        """Return the scale (10 L + 2,) of each column of ``link_directions``."""
        one_link = np.repeat((self.mass, self.centre_of_mass, self.inertia), (1, 3, 6))
        return np.append(np.tile(one_link, n_links), (self.common, self.common))


AS_STATED = LinkScales()


@dataclass(frozen=True)
class NuisanceGroup:
    """Nuisances with one cause.

    Attributes:
        cause: in words, such as "other links".
        names: (k,) their parameter names.
        mean: (k,) what they are thought to be.
        factor: (k, k) F, their covariance is F F^T.
        members: (k,) whose they are: the link's or the joint's name.
        may_widen: whether the data may ask for more than the prior allows.
        widened: alpha, by how much it did.
        aspects: makes (m, k) combinations each that may be off while all others are not.
    """

    cause: str
    names: tuple[str, ...]
    mean: Array
    factor: Array
    members: tuple[str, ...]
    may_widen: bool = False
    widened: float = 1.0
    aspects: Callable[[], tuple[Array, ...]] = tuple

    def rows(self, names: Sequence[str]) -> Array:
        """Return the prior as equations of unit variance, (k, p+1) [A b] in these parameters."""
        inverse = np.linalg.inv(self.widened * self.factor)
        rows = np.zeros((len(self.names), len(names) + 1))
        rows[:, self.places(names)] = inverse
        rows[:, -1] = inverse @ self.mean
        return rows

    def places(self, names: Sequence[str]) -> list[int]:
        """Return where the nuisances stand among the parameters ``names``."""
        return [names.index(name) for name in self.names]

    def explained(self, names: Sequence[str], inverse: Array) -> Array:
        """Return rows (k, p) whose squares are the part of an estimate's covariance that the prior
        makes, by its C.
        """
        return np.asarray(np.linalg.solve(self.widened * self.factor, inverse[self.places(names)]))

    def deviations(self, names: Sequence[str], values: Array) -> Array:
        """Return (k,) by how many prior standard deviations, not widened, each direction is off."""
        return np.asarray(np.linalg.solve(self.factor, values[self.places(names)] - self.mean))


def with_prior(
    information: SquareRootInformation, groups: Sequence[NuisanceGroup]
) -> SquareRootInformation:
    """Return the information with what was known of the nuisances beforehand."""
    if not groups:
        return information
    rows = [group.rows(information.names) for group in groups]
    return replace(information, prior=np.vstack(rows))


def link_factor(
    thetas: Sequence[Array], share: float, lengths: Sequence[float], scales: LinkScales = AS_STATED
) -> Array:
    """Return F (10 L, 10 L) of L links whose numbers are known to a share.

    Each mass is off by the share, each centre of mass by that share of the link's size, each
    inertia about the centre of mass by twice the share of its mean moment. A drawing that is wrong
    is often wrong for all links alike (another density, shells for solids), so that all masses,
    and all distances of a centre of mass from its joint, have an error of that size in common too.

    Args:
        thetas: per link (10,), the model's values.
        share: 0.05 for 5 %.
        lengths: per link, from its joint to the next one [m]; its size is that, or the length of
            the uniform rod whose mass is as far from its end, where that is more.
        scales: multiples of the share.
    """
    directions = link_directions(tuple(map(tuple, thetas)), tuple(lengths))
    scaled = directions * scales.of_directions(len(thetas))
    return share * np.linalg.cholesky(scaled @ scaled.T)


def link_lengths(robot: RobotModel, links: Sequence[int]) -> list[float]:
    """Return how far it is from each link's joint to the next one [m]; 0 for the last link."""
    ends = [*(link.translation for link in robot.links[1:]), np.zeros(3)]
    return [float(np.linalg.norm(ends[link])) for link in links]


def model_link_factor(robot: RobotModel, links: Sequence[int], share: float) -> Array:
    """Return ``link_factor`` (10 L, 10 L) of a model's links, each known to a share."""
    thetas = [robot.links[link].theta for link in links]
    return link_factor(thetas, share, link_lengths(robot, links))


@lru_cache(maxsize=8)
def link_directions(thetas: tuple[tuple[float, ...], ...], lengths: tuple[float, ...]) -> Array:
    """Return independent errors (10 L, 10 L + 2) of L links for a share of one.

    Columns are each link's mass (1), centre of mass (3) and inertia (6), then what all links have
    in common: all masses, all distances of a centre of mass from its joint.
    """
    directions = np.zeros((10 * len(thetas), 10 * len(thetas) + 2))
    for place, (theta, length) in enumerate(zip(np.array(thetas), lengths)):
        block = slice(10 * place, 10 * (place + 1))
        directions[block, block], moved = own_errors(theta, 1.0, length)
        com = spatial.com_from_theta(theta)[1]
        distance = float(np.linalg.norm(com))
        directions[block, -2] = theta
        directions[block, -1] = moved @ com / distance if distance > 0.0 else 0.0
    return directions


def link_aspects(thetas: Sequence[Array], lengths: Sequence[float]) -> tuple[Array, ...]:
    """Return what picks masses, centres of mass and inertias of L links, (m, 10 L) each."""
    whole = np.zeros((10 * len(thetas), 10 * len(thetas)))
    for place, (theta, length) in enumerate(zip(thetas, lengths)):
        block = slice(10 * place, 10 * (place + 1))
        whole[block, block] = np.linalg.inv(own_errors(theta, 1.0, length)[0])
    kinds = np.tile(np.repeat((0, 1, 2), (1, 3, 6)), len(thetas))
    return tuple(whole[kinds == kind] for kind in range(3))


def own_errors(theta: Array, share: float, length: float) -> tuple[Array, Array]:
    """Return one link's independent errors (10, 10), and those of its centre of mass (10, 3)."""
    mass, com, inertia = spatial.com_from_theta(theta)
    size = max(ROD * spatial.characteristic_length(theta), length, LEAST_SIZE)
    moment = max(float(np.trace(inertia)) / 3.0, mass * (0.1 * size) ** 2)
    columns = []
    for step in share * size * np.eye(3):
        ahead, behind = (spatial.theta_from_com(mass, com + s * step, inertia) for s in (1.0, -1.0))
        columns.append(0.5 * (ahead - behind))
    turns = list(2.0 * share * moment * np.eye(10)[4:])
    return np.column_stack([share * theta, *columns, *turns]), np.column_stack(columns)


def widened_groups(
    information: SquareRootInformation,
    noise: Array,
    groups: Sequence[NuisanceGroup],
    least: float = 1.0,
) -> tuple[NuisanceGroup, ...]:
    """Return the groups, each as wide as data with torque noise (joints,) [N m] asks for.

    None becomes narrower than ``least`` times what it was.
    """
    found = tuple(groups)
    if least >= 1.0 and not any(group.may_widen for group in found):
        return found
    problem = WithPriors(information, noise)
    for _ in range(_ROUNDS if found else 0):
        values, covariance, _ = problem.solve(found)
        before = found
        found = tuple(
            replace(
                group,
                widened=max(
                    _asked(group, np.eye(len(group.names)), problem.names, values, covariance)[0],
                    least,
                ),
            )
            if group.may_widen or least < 1.0
            else group
            for group in before
        )
        if all(abs(a.widened / b.widened - 1.0) < _SETTLED for a, b in zip(found, before)):
            break
    return found


class WithPriors:
    """Whitened data, to be solved under different priors."""

    def __init__(self, information: SquareRootInformation, noise: Array) -> None:
        self.names, self._weights = information.names, 1.0 / noise
        self._data = replace(information, prior=None)
        self._gram = normal_matrix(self._data, self._weights)

    def solve(self, groups: Sequence[NuisanceGroup]) -> tuple[Array, Array, float]:
        """Return (values (p,), covariance (p, p), misfit of data and priors)."""
        known = np.vstack((self._gram[:0], *(group.rows(self.names) for group in groups)))
        size, squares = len(self.names), np.append(self._weights, 1.0) ** 2
        parts = [(np.append(joint.columns, size), joint.triangle) for joint in self._data.joints]
        parts.append((np.arange(size + 1), known))
        found = solve_normal(self._gram + known.T @ known, parts, squares, np.zeros(size))
        if found is None:
            found = solve_rows(np.vstack((*self._data.blocks(self._weights), known)))
        values, root = found
        left = self._weights**2 @ self._data.squared_residuals(values)
        return values, root @ root.T, float(left + np.sum((known @ np.append(values, -1.0)) ** 2))

    def likely(self, groups: Sequence[NuisanceGroup]) -> tuple[Array, float]:
        """Return (values (p,), logarithm of how likely priors make the data, but for a constant).

        With C the covariance of what is found, and F of each prior, p is
        exp(-misfit / 2) |C|^1/2 / |F| (MacKay 1992, eq. 7 and 8).
        """
        values, spread, misfit = self.solve(groups)
        known = sum(np.linalg.slogdet(group.widened * group.factor)[1] for group in groups)
        return values, float(0.5 * (np.linalg.slogdet(spread)[1] - misfit) - known)


def _asked(
    group: NuisanceGroup, some: Array, names: Sequence[str], values: Array, covariance: Array
) -> tuple[float, float]:
    """Return the factor by which the data asks to widen a prior, of combinations (m, k) of it.

    The second number is how many of them the data determines, at least one.
    """
    root = np.linalg.cholesky(some @ group.factor @ group.factor.T @ some.T)
    off = np.linalg.solve(root, some @ (values[group.places(names)] - group.mean))
    determined = max(float(np.sum(_determined(group, some, names, covariance))), 1.0)
    return float(min(np.sqrt(np.sum(off**2) / determined), WIDEST)), determined


def _determined(
    group: NuisanceGroup, some: Array, names: Sequence[str], covariance: Array
) -> Array:
    """Return (m,) how much of each direction the data determines, between 0 and 1."""
    places = group.places(names)
    root = group.widened * np.linalg.cholesky(some @ group.factor @ group.factor.T @ some.T)
    left = np.linalg.solve(root, some @ covariance[np.ix_(places, places)] @ some.T)
    return np.clip(1.0 - np.diag(np.linalg.solve(root, left.T)), 0.0, 1.0)


def misfits(
    information: SquareRootInformation, noise: Array, groups: Sequence[NuisanceGroup]
) -> tuple[PriorConflict, ...]:
    """Return the causes that the data asks for more clearly than chance does.

    A cause is asked for where leaving it at what it is thought to be makes the misfit worse by more
    than chi-square allows any of them. It is as wide then as its worst aspect asks for: links of
    another density contradict their masses alone, which would be lost among ten numbers of each.
    Noise (joints,) is in N m, groups are as wide as they were used.
    """
    problem = WithPriors(information, noise)
    values, covariance, with_all = problem.solve(groups)
    wanted, wider, found = tuple[NuisanceGroup, ...](), (values, covariance), []
    for index, group in enumerate(groups):
        fixed = [*groups[:index], replace(group, widened=_FIXED), *groups[index + 1 :]]
        gained = problem.solve(fixed)[2] - with_all
        every = np.eye(len(group.names))
        freedom = max(float(np.sum(_determined(group, every, problem.names, covariance))), 1.0)
        if is_no_chance(gained, freedom, 1.0 - SURE ** (1.0 / len(groups))):
            if not wanted:
                wanted = widened_groups(information, noise, groups, _NARROWEST)
                wider = problem.solve(wanted)[:2]
            off = group.deviations(problem.names, values)
            worst, wide = _worst_members(group, off), wanted[index]
            some = (every, *group.aspects())
            pairs = [_asked(wide, each, problem.names, *wider) for each in some]
            # Beyond what chance makes of a group that is as far off as it was thought to be.
            clear = [a for a, free in pairs if is_no_chance(a**2 * free, free, 1.0 - SURE)]
            asked = max(clear, default=min(pairs[0][0], 1.0))
            found.append(PriorConflict(group.cause, worst, asked, group.widened))
    return tuple(found)


def is_no_chance(squared: float, freedom: float, chance: float) -> bool:
    """Tell whether chi-square is as large with less than a chance."""
    return squared > largest_by_chance(freedom, chance)


def largest_by_chance(freedom: float, chance: float) -> float:
    """Return what chi-square exceeds with a chance."""
    from scipy.special import chdtri

    return float(chdtri(freedom, chance))


def _worst_members(group: NuisanceGroup, off: Array) -> tuple[str, ...]:
    members = np.array(group.members)
    squares = {name: float(np.sum(off[members == name] ** 2)) for name in group.members}
    clear = [n for n in squares if squares[n] > _SHARE_OF_WORST * max(squares.values())]
    return tuple(sorted(clear, key=lambda name: -squares[name]))
