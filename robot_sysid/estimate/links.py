"""What is known of an arm's links: priors, and how far the data says that models are off.

The user states a relative uncertainty of the links (the prior ``link``), and real models exceed it:
masses are off by 10 to 20 %, one link by 40 %. Confounded links predict torques equally well, so
that held-out errors do not show such deviations; the marginal likelihood does. With the links'
deviations

    delta = T S z,    z ~ N(0, 1),

T the directions in which links may be off (``link_directions``) and S their standard deviations,
and with the curvature L and the gradient b of data and all other priors, 1/2 delta' L delta - b'
delta,

    log p(S) = 1/2 v' S (1 + S M S)^-1 S v - 1/2 log |1 + S M S|,    M = T' L T,  v = T' b

(MacKay, "Bayesian interpolation", Neural Computation 4(3), 1992). Masses, centres of mass and
inertias have one scale each: a single scale for all would widen the prior of the centres of mass so
far that they absorb errors in mass. Scales are averaged on a grid. Evidence widens the prior and
never narrows it: the last link is free and takes up what the links before it have wrong, so that
the data says the same of a right model and of one that is wrong in a single link.

One link may be far more off than the others: its mass in the file is a quarter of the true one, or
a kilogram was bolted on. A scale that all links share cannot hold that, and says that each may be
off by 40 %. Where the evidence of one mass with an error as large as itself, and the others' scales
found anew, is larger by ``ODD``, that mass has such an error. An error that all links share, as of
torques in another scale, may explain the same; then no link is odd.

Torques show a centre of mass in one or two directions and hardly in the others: along a joint's
axis it makes no torque, and along the link it is confounded with the masses behind it. What counts
is the direction in which it is off for sure by most (``centre_off``). One that is off by more than
a part of the link (a wrong sign, or another frame) counts as not known as well, by its distance and
not by evidence: a centre and its inertia that are free cost nine numbers. Without that a forearm's
centre with the wrong sign came out many stated errors off. No inertia is told: freeing a wrong one
gains less log evidence than freeing a right one.

Of the mistakes that a model may have in its links (``model.mistakes``), one or two at once are
compared by the evidence with other reference bodies. Which are likely is seen with the links'
errors as they usually are, F F' their covariance: a shift d of the reference bodies gains

    g' d - 1/2 d' Q d,    Q = L - L F (1 + F' L F)^-1 F' L,    g = (1 - L F (1 + F' L F)^-1 F') b,

with L and b at the reference bodies.

Placeholders have errors as large as themselves, whatever the scales. All sizes come from the arm's
geometry, and no link counts as smaller or lighter than a share of the arm: a model that is too
small or too light is not better known for that.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid import spatial
from robot_sysid.model.mistakes import Mistake, mistake_shifts, usual_mistakes
from robot_sysid.records import KINDS, ArmLink, Array, RobotModel
from robot_sysid.records.levels import CLEAR, INTERVAL
from robot_sysid.spatial import N_INERTIAL, ROD_MOMENT

INERTIA_OVER_MASS = 2.0
"""Error of a link's moments of inertia over that of its mass, as shares (``usual_errors.LINK``)."""
PLACEHOLDER_INERTIA = 1.5
"""The same of moments that stand for a body of the link's geometry, whose error is as large as the
body's: at a share of one, it lies between nothing and two and a half times as much."""
BETWEEN_ENDS = 0.5
"""Where the centre of mass lies of a link that does not state it, as a share of its size: somewhere
between its ends."""


ODD = 2.5
"""Least gain in the log evidence at which one mass is taken to be far off: more than right logs
gain, also with one link as wrong as it may be, or with all torques in another scale, and less than
most forearms gain whose mass is a fraction of the true one."""
COMMON = 0.5
"""Error of all masses together, as a share of them, that is compared with one odd mass."""


ODD_AMONG_USUAL = 4.0
"""The same with the other links as far off as they usually are, which one mass that is far off does
not hide: between what right logs gain and what a forearm that is ten times too heavy does."""
ODD_OVER_COMMON = 0.5
"""Least difference to the gain of an error of all masses then: more than logs with a common factor
have, as good as always, and less than a forearm that is ten times too heavy has."""
ODD_ALONE = 3.0
"""The same difference from which on the mass alone is the cause, and no factor."""
FAR_OFF_CENTRE = 0.15
"""Share of a link's size by which its centre of mass is off for sure, to count as not known: more
than right logs show, and than a maker's own table differs from the arm; a centre with the wrong
sign often shows more."""
COMMON_SCALES = (0.1, 0.2, 0.4)
"""Errors that all torques may share, of which the evidence chooses, as shares."""


LIKELY = 1.0
"""Least gain for each with the errors of links as they usually are, to be compared with all that
they may be."""
MOST_TRIED = 6
"""Mistakes that are compared with all errors that links may have, of those that are likely."""

MASS, CENTRE, _ = KINDS


@dataclass(frozen=True)
class OddNumber:
    """A number of the model that is far more off than the others.

    Attributes:
        link: number in the arm of the link that it is of.
        kind: which of ``KINDS`` it is.
    """

    link: int
    kind: str


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


AS_STATED = LinkScales()
"""Factors of one: the prior as the user states it."""
EXPECTED = LinkScales(*usual_errors.EXPECTED_SCALES)
"""Factors that are expected without any recording."""
# The factors that are tried, of each kind.
_GRID = (
    usual_errors.MASS_SCALES,
    usual_errors.CENTRE_SCALES,
    usual_errors.INERTIA_SCALES,
)
LARGEST = LinkScales(*(scales[-1] for scales in _GRID))
"""The largest factors: for a check of an arm whose model may be a guess."""


def link_factor(
    robot: RobotModel,
    links: Sequence[int],
    share: float,
    scales: LinkScales = EXPECTED,
    odd: OddNumber | None = None,
    further: Array | None = None,
) -> Array:
    """Return the Cholesky factor F (10 L, 10 L) of the prior covariance of L links of an arm.

    Independent standard deviations are ``share`` of each mass, ``share`` of the link's size for its
    centre of mass, and twice ``share`` of the mean moment for inertias about the centre of mass. A
    drawing is often wrong for all links alike (another density, shells for solids), so that common
    errors of this size act on all masses and on all distances of centres of mass from joints.

    Args:
        robot: the arm.
        links: L indices in ``robot.links``.
        share: relative standard deviation, 0.05 for 5 %; zero where the links are exact.
        scales: factors on these standard deviations, per kind of error.
        odd: the number that has an error as large as itself; None for none.
        further: (10 L, d) further errors, for one standard deviation of each; None for none.
    """
    directions = link_directions(robot, links, odd)
    if share == 0.0:
        return np.zeros((len(directions), len(directions)))
    common = common_error(robot, share)
    stated = stated_kinds(robot, links, odd)
    (sizes,) = deviations(stated, share, np.array([astuple(scales)]), common)
    scaled = directions * sizes
    if further is not None:
        scaled = np.hstack((scaled, further))
    return np.asarray(np.linalg.cholesky(scaled @ scaled.T))


def common_error(robot: RobotModel, share: float) -> float:
    """Return the error that all masses share: the one of links, and that of the user's factor."""
    return float(np.hypot(share, robot.mass_error))


def reference_links(robot: RobotModel, links: Sequence[int]) -> Array:
    """Return the reference bodies of links, all their parameters (10 L,) in a row."""
    return np.concatenate([robot.links[link].reference for link in links])


def stated_kinds(
    robot: RobotModel, links: Sequence[int], odd: OddNumber | None = None
) -> NDArray[np.bool_]:
    """Return which of ``KINDS`` (L, 3) the model states of links, not with a placeholder.

    An odd number counts as not stated. With a centre of mass goes the inertia, which a model states
    about it.
    """
    stated = np.array(
        [[k not in robot.links[link].placeholders for k in KINDS] for link in links]
    )
    if odd is not None:
        kinds = KINDS[1:] if odd.kind == CENTRE else (odd.kind,)
        stated[np.ix_(np.equal(links, odd.link), np.isin(KINDS, kinds))] = False
    return stated


def deviations(
    stated: NDArray[np.bool_], share: float, factors: Array, common: float = 0.0
) -> Array:
    """Return the standard deviations (m, 10 L + 2) along the columns of ``link_directions``.

    They are those of factors (m, 3), each the numbers of ``LinkScales``. The error that all masses
    share is the links', or ``common``.
    """
    sizes = np.where(stated, share * factors[:, None], 1.0)
    own = np.repeat(sizes, (1, 3, 6), axis=2).reshape(len(factors), -1)
    of_all = np.full(len(factors), common or share)
    return np.column_stack((own, of_all, share * factors[:, 1]))


def link_directions(
    robot: RobotModel, links: Sequence[int], odd: OddNumber | None = None
) -> Array:
    """Return the effects (10 L, 10 L + 2) of independent errors on the parameters of L links.

    One column per error, for a relative standard deviation of one: each link's mass (1), centre of
    mass (3) and inertia (6), then the common errors of all masses and of all distances of a centre
    of mass from its joint. ``links`` are indices in ``robot.links``.

    Where a centre of mass is odd, and off by a distance d, moments about the joint are off by m d²,
    which is no part of a small error: the error of the inertia is then as large as that.
    """
    size = N_INERTIAL * len(links)
    directions = np.zeros((size, size + 2))
    for number, index in enumerate(links):
        link = robot.links[index]
        block = slice(N_INERTIAL * number, N_INERTIAL * (number + 1))
        errors = own_errors(link, usual_errors.LEAST_MASS_SHARE * robot.mass)
        if odd == OddNumber(index, CENTRE):
            moment = link.reference[0] * link.size**2
            errors[4:, 4:] = np.maximum(errors[4:, 4:], moment * np.eye(6))
        directions[block, block] = errors
        _, com, _ = spatial.com_from_theta(link.reference)
        distance = np.linalg.norm(com)
        # Common errors scale all parameters with the mass, and move the centre of mass outwards.
        directions[block, -2] = link.reference
        if distance > 0.0:
            directions[block, -1] = errors[:, 1:4] @ com / distance
    return directions


def own_errors(link: ArmLink, least_mass: float) -> Array:
    """Return the effects of a link's independent errors on its ten inertial parameters.

    Returns (10, 10), one column per error, for a relative standard deviation of one: mass (1),
    centre of mass along x, y, z (3), inertia (6).

    Args:
        link: with its reference body and size.
        least_mass: that errors are taken of [kg].
    """
    mass, com, inertia = spatial.com_from_theta(link.reference)
    weight = max(1.0, least_mass / mass)
    # No link counts as smaller than a rod.
    moment = max(np.trace(inertia) / 3.0, weight * mass * ROD_MOMENT * link.size**2)
    reach = link.size * (BETWEEN_ENDS if KINDS[1] in link.placeholders else 1.0)
    columns = [weight * link.reference]
    for step in reach * np.eye(3):
        ahead = spatial.theta_from_com(mass, com + step, inertia)
        behind = spatial.theta_from_com(mass, com - step, inertia)
        columns.append(0.5 * weight * (ahead - behind))  # central difference
    is_placeholder = KINDS[2] in link.placeholders
    spread = PLACEHOLDER_INERTIA if is_placeholder else INERTIA_OVER_MASS
    return np.column_stack([*columns, *(spread * moment * np.eye(10)[4:])])


def last_link_scale(robot: RobotModel) -> Array:
    """Return how far off the last link (10,) may be, of which nothing is known: as a link is large.

    That is the model's own, or a usual one of the arm: what is bolted to a flange of 0.2 kg may
    weigh as much as any other link, but not a hundred times that.
    """
    masses = robot.thetas[:, 0]
    length = robot.length / robot.n_joints
    usual = spatial.parameter_scale(float(np.mean(masses[masses > 0.0])), length)
    return np.maximum(robot.prior.scale, usual)


@dataclass(frozen=True)
class CentreOff:
    """How far a centre of mass is off, in the direction in which it is off for sure by most.

    Attributes:
        distance, error: by which it is off, and its standard error [m].
        direction: (3,) a unit vector in the body's frame.
    """

    distance: float
    error: float
    direction: Array

    @property
    def sure(self) -> float:
        """Distance by which it is off for sure [m]."""
        return self.distance - INTERVAL * self.error


def centre_off(theta: Array, covariance: Array, expected: Array) -> CentreOff:
    """Return how far the centre of mass of a body is off the expected one.

    Args:
        theta: (10,) the body.
        covariance: (10, 10) its.
        expected: (3,) centre of mass [m].
    """
    centre = theta[1:4] / theta[0]
    slopes = np.column_stack((-centre, np.eye(3))) / theta[0]
    variances, directions = np.linalg.eigh(slopes @ covariance[:4, :4] @ slopes.T)
    errors = np.sqrt(np.maximum(variances, 0.0))
    off = directions.T @ (centre - expected)
    most = int(np.argmax(np.abs(off) - INTERVAL * errors))
    direction = directions[:, most] * np.copysign(1.0, off[most])
    return CentreOff(float(abs(off[most])), float(errors[most]), direction)


@dataclass(frozen=True)
class LinkEvidence:
    """Marginal likelihood of the scales of links' deviations from the model (module's formula).

    Attributes:
        stated: (L, 3) ``stated_kinds`` of the links.
        share: relative standard deviation that the user states.
        curvature: (10 L + 2 + d, 10 L + 2 + d) M, second derivative along ``link_directions`` and d
            further errors.
        gradient: (10 L + 2 + d,) v, first derivative along them.
        common: error that all masses share, where it is not the links'.
        of_reference: log likelihood of the reference bodies themselves, up to a constant that all
            references share.
    """

    stated: NDArray[np.bool_]
    share: float
    curvature: Array
    gradient: Array
    common: float = 0.0
    of_reference: float = 0.0

    def with_common(self, error: float) -> LinkEvidence:
        """Return the evidence where all masses, or all torques, share one more error."""
        return replace(self, common=float(np.hypot(self.common, error)))

    def with_odd_mass(self, number: int) -> LinkEvidence:
        """Return the evidence where one of the L links has a mass with an error as large."""
        stated = self.stated.copy()
        stated[number, 0] = False
        return replace(self, stated=stated)

    def with_simple_errors(self) -> Iterator[LinkEvidence]:
        """Yield the evidence of each simple error of masses: of all alike, and of each one."""
        yield self.with_common(COMMON)
        for number in np.flatnonzero(self.stated[:, 0]).tolist():
            yield self.with_odd_mass(number)

    def log_likelihood(self, scales: LinkScales) -> float:
        """Return log p(S) up to a constant."""
        return float(self.log_likelihoods(np.array([astuple(scales)]))[0])

    def log_likelihoods(self, factors: Array) -> Array:
        """Return the same (m,) of factors (m, 3), each the numbers of ``LinkScales``, at once."""
        sizes = deviations(self.stated, self.share, factors, self.common)
        scale = np.ones((len(factors), len(self.gradient)))
        scale[:, : sizes.shape[1]] = sizes
        gradient = scale * self.gradient
        count, size = scale.shape
        # The root of a matrix with the gradient as one more row has L^-1 gradient in that row.
        bordered = np.zeros((count, size + 1, size + 1))
        np.multiply(self.curvature, scale[:, :, None], out=bordered[:, :-1, :-1])
        bordered[:, :-1, :-1] *= scale[:, None, :]
        bordered[:, range(size), range(size)] += 1.0
        bordered[:, -1, :-1] = gradient
        bordered[:, -1, -1] = 1.0 + 2.0 * np.sum(gradient**2, axis=1)
        try:
            triangles = np.linalg.cholesky(bordered)
        except np.linalg.LinAlgError:
            # Rounding has made the curvature indefinite.
            values, vectors = np.linalg.eigh(bordered[:, :-1, :-1])
            roots = np.sqrt(np.maximum(values, 1.0))
            halves = (gradient[:, None] @ vectors)[:, 0] / roots
        else:
            roots = np.diagonal(triangles, axis1=1, axis2=2)[:, :-1]
            halves = triangles[:, -1, :-1]
        logs = np.sum(np.log(roots), axis=1)
        return np.asarray(self.of_reference + 0.5 * np.sum(halves**2, axis=1) - logs)


def average_scales(evidence: LinkEvidence) -> LinkScales:
    """Return the root mean square of each factor on the links' prior over its posterior on a grid.

    A root mean square and not the most likely factor, because the prior has to allow for large
    values where the data hardly determines a factor.
    """
    grid, log_posterior = _scale_posterior(evidence)
    probability = np.exp(log_posterior - np.max(log_posterior))
    probability /= np.sum(probability)
    return LinkScales(*np.sqrt(probability @ grid**2).tolist())


def _scale_posterior(evidence: LinkEvidence) -> tuple[Array, Array]:
    """Return factors of mass, centre of mass and inertia (k, 3), and their log posterior (k,)."""
    grid = np.array(list(product(*_GRID)))
    octaves = np.log2(grid / np.array(usual_errors.USUAL_SCALES))
    log_posterior = -0.5 * np.sum(octaves**2, axis=1)
    return grid, log_posterior + evidence.log_likelihoods(grid)


def log_evidence(evidence: LinkEvidence) -> float:
    """Return the log evidence of what is assumed of links, whatever their scales."""
    _, log_posterior = _scale_posterior(evidence)
    return float(np.logaddexp.reduce(log_posterior))


def common_scale(evidence: LinkEvidence) -> float:
    """Return how far all torques may be off together, as a share; zero where nothing shows it.

    It shows as an error of all masses, from which no torque tells it.
    """
    before = log_evidence(evidence)
    gains = np.array(
        [log_evidence(evidence.with_common(each)) - before for each in COMMON_SCALES]
    )
    if np.max(gains) <= CLEAR:
        return 0.0
    probability = np.exp(gains - np.max(gains))
    squares = np.square(COMMON_SCALES)
    return float(np.sqrt(probability @ squares / np.sum(probability)))


def odd_mass(evidence: LinkEvidence) -> int | None:
    """Return which of the L links has a mass that is far more off than the others'; or None."""
    if not np.any(evidence.stated[:, 0]):
        return None
    most, gain, over_common = _odd_among_usual(evidence)
    if gain > ODD_AMONG_USUAL and over_common > ODD_OVER_COMMON:
        return most
    most, gain, over_common = _odd_of_any(evidence)
    return most if min(gain, over_common) > ODD else None


def is_odd_alone(evidence: LinkEvidence) -> bool:
    """Return whether an odd mass explains clearly more than an error of all masses."""
    _, gain, over_common = _odd_of_any(evidence)
    _, _, over_common_as_usual = _odd_among_usual(evidence)
    return min(gain, over_common) > ODD or over_common_as_usual > ODD_ALONE


def _odd_among_usual(evidence: LinkEvidence) -> tuple[int, float, float]:
    """Return (number of the likeliest odd link, its gain, that over an error of all masses).

    The other links are as far off as they usually are, however far off they seem to be.
    """
    gains = {
        number: evidence.with_odd_mass(number).log_likelihood(EXPECTED)
        for number in np.flatnonzero(evidence.stated[:, 0]).tolist()
    }
    most = max(gains, key=lambda number: gains[number])
    common = evidence.with_common(COMMON).log_likelihood(EXPECTED)
    before = evidence.log_likelihood(EXPECTED)
    return most, gains[most] - before, gains[most] - common


def _odd_of_any(evidence: LinkEvidence) -> tuple[int, float, float]:
    """Return the same with scales of the other links that the evidence gives."""
    before = log_evidence(evidence)
    gains = {
        number: log_evidence(evidence.with_odd_mass(number)) - before
        for number in np.flatnonzero(evidence.stated[:, 0]).tolist()
    }
    most = max(gains, key=lambda number: gains[number])
    if gains[most] <= ODD:
        return most, gains[most], 0.0
    common = log_evidence(replace(evidence, common=COMMON)) - before
    return most, gains[most], gains[most] - max(common, 0.0)


def likely_mistakes(
    robot: RobotModel,
    links: Sequence[int],
    share: float,
    curvature: Array,
    gradient: Array,
) -> list[tuple[Mistake, ...]]:
    """Return one mistake each, and two at once, that are likely with errors of links as usual.

    Args:
        robot: the arm.
        links: numbers of its L links that are estimated.
        share: relative standard deviation of the links that the user states.
        curvature, gradient: (10 L, 10 L), (10 L,) of data and all priors but the links', the latter
            at zero.
    """
    mistakes = list(usual_mistakes(robot, links))
    if not mistakes:
        return []
    stated = reference_links(robot, links)
    shifts = mistake_shifts(robot, links, mistakes).T
    is_wrong = np.array([np.isin(links, each.links) for each in mistakes], dtype=float)
    factor = link_factor(robot, links, share)
    known = curvature @ factor
    inner = np.eye(len(factor)) + factor.T @ known
    off = gradient - curvature @ stated
    at_reference = off - known @ np.linalg.solve(inner, factor.T @ off)
    bend = curvature - known @ np.linalg.solve(inner, known.T)
    squares = shifts @ bend @ shifts.T
    gains = shifts @ at_reference - 0.5 * np.diag(squares)
    for place in np.flatnonzero(np.sum(is_wrong, axis=1) > 1.0).tolist():
        # One link's numbers alone may fit, and the other link make no torque that shows its own.
        spans = np.repeat(np.diag(is_wrong[place]), N_INERTIAL, axis=1)
        parts = spans[is_wrong[place] > 0.0] * shifts[place]
        of_parts = parts @ at_reference - 0.5 * np.sum((parts @ bend) * parts, axis=1)
        if gains[place] - np.max(of_parts) < LIKELY:
            gains[place] = -np.inf
    of_both = gains[:, None] + gains - squares
    # Two mistakes in one link are none; each pair is there once.
    of_both[is_wrong @ is_wrong.T > 0.0] = -np.inf
    of_both[np.tril_indices(len(mistakes))] = -np.inf
    likely: list[tuple[Mistake, ...]] = []
    for place in np.argsort(-gains)[:MOST_TRIED].tolist():
        if gains[place] > LIKELY:
            likely.append((mistakes[place],))
    for pair in np.argsort(-of_both, axis=None)[:MOST_TRIED].tolist():
        first, second = divmod(pair, len(mistakes))
        alone = max(gains[first], gains[second], 0.0)
        if of_both[first, second] - alone > 2.0 * LIKELY:
            likely.append((mistakes[first], mistakes[second]))
    return likely
