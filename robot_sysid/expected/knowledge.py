"""What is known of an arm: values of its parameters, and the covariance of their errors.

After logs (``knowledge_of``) the covariance is that of data, priors and, of what the fit lets free,
priors as wide as an unknown joint or link: a short log leaves combinations free of which other
motions see much. It is raised by the jackknife like every printed error. The covariance of the
file's own fit in its place promises two to four times too little. docs/method.md has how well it
holds.

Shapes: p parameters of motions, J joints with equations.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.dynamics.friction import COULOMB, OFFSET, VISCOUS
from robot_sysid.estimate.equations.inverse import solve
from robot_sysid.estimate.fit import Fit, settled_values
from robot_sysid.estimate.links import last_link_scale
from robot_sysid.estimate.questions import LEAST_DRY
from robot_sysid.estimate.rows import Sums
from robot_sysid.estimate.terms import (
    FRICTION,
    FURTHER_FRICTION,
    LAST_LINK,
    MOTORS,
    Term,
)
from robot_sysid.expected.motions import grams
from robot_sysid.records import Array

MOST_RAISED = 2.0
"""Most by which the jackknife raises an error here: it is uncertain itself, and of ten blocks its
largest values are chance. Without it, 92 % of 36 pairs of real logs were within 1.5, with it 97 %.
"""


@dataclass(frozen=True)
class Knowledge:
    """What is known of the p parameters of motions, in the order of their sums.

    Attributes:
        values: (p,) of the parameters.
        covariance: (p, p) of the errors of these values.
    """

    values: Array
    covariance: Array

    def of(self, is_part: NDArray[np.bool_]) -> Knowledge:
        """Return what is known of some parameters (p,), the others being zero and known."""
        of_parts = np.outer(is_part, is_part)
        return Knowledge(
            np.where(is_part, self.values, 0.0),
            np.where(of_parts, self.covariance, 0.0),
        )


@dataclass(frozen=True)
class LogKnowledge:
    """What a fit knows of the p parameters of made-up motions, those that its logs lack included.

    Attributes:
        values: (p,) of the fit, what it lets free drawn to what it is without any log: the last
            link to the model's, friction and rotors to none; the model's of those that it does
            not estimate.
        precision: (p, p) of data and priors, as little as the jackknife says.
        wide: (p,) precision of wide priors; zero of what the fit has a prior of, or takes as known.
        raised: (p,) times its error by which the jackknife raises that of a parameter.
        of_scales: (p, p) covariance of what torque scales do beyond their columns.
        weights: (J,) of each joint's rows [1/(N m)].
        row_rate: rows per second of its logs [Hz].
    """

    values: Array
    precision: Array
    wide: Array
    raised: Array
    of_scales: Array
    weights: Array
    row_rate: float

    def after(self, further: Array | float = 0.0) -> Knowledge:
        """Return what is known after the products (p, p) of ``further`` rows are added."""
        # What the jackknife raises is the error of data, not of what nothing is known of.
        raised = self.raised[:, None] * self.raised
        normal = with_zero_torque(
            (self.precision + further) / raised + np.diag(self.wide)
        )
        is_free = np.diag(self.precision) + self.wide > 0.0
        _, inverse = solve(normal, self.values, is_free)
        share = usual_errors.ERRORS_AS_THEY_ARE
        return Knowledge(self.values, share**2 * (inverse + self.of_scales))

    def rows(self, sums: Sums, length: float, weights: Array) -> Array:
        """Return the products (p, p) of the rows of a log that moves as the motions of sums do.

        Args:
            sums: of made-up motions.
            length: of the log [s].
            weights: (J,) of each joint's rows [1/(N m)].
        """
        total = np.zeros(self.precision.shape)
        shares = self.row_rate * length / sums.row_counts
        for weight, share, gram in zip(weights, shares, grams(sums)):
            total += weight**2 * share * gram[:-1, :-1]
        return total


def knowledge_of(fitted: Fit, sums: Sums) -> LogKnowledge:
    """Return what a fit of all terms knows of the parameters of made-up motions.

    Of a joint that stood still no row tells anything: its rows weigh as those of an average one.
    """
    is_still = is_without_rows(fitted)
    noise = fitted.noise * np.sqrt(fitted.correlation)
    average = np.sqrt(np.mean(noise[~is_still] ** 2))
    known = [name in fitted.names for name in sums.names]
    at = np.flatnonzero(known)
    of_fit = fitted.at([*itertools.compress(sums.names, known)])
    precision = np.zeros((len(known), len(known)))
    precision[at[:, None], at] = _marginal_precision(fitted.normal[:-1, :-1], of_fit)
    formal = np.maximum(np.diag(fitted.inverse), 1e-300)
    of_data = np.sqrt(np.clip(fitted.jackknife / formal, 1.0, MOST_RAISED**2))
    raised = np.ones(len(known))
    raised[at] = np.where(fitted.is_hidden, 1.0, of_data)[of_fit]
    of_scales = np.zeros_like(precision)
    of_scales[at[:, None], at] = fitted.scale_errors[of_fit[:, None], of_fit]
    wide = np.zeros(len(known))
    for name, error in _wide_errors(fitted, sums):
        wide[sums.names.index(name)] = error**-2
    loosened = _loosened_offsets(fitted, sums)
    precision -= np.diag(loosened)
    settled = settled_values(fitted)
    of_sums = np.array([settled[name] for name in sums.names])
    last = sums.at(fitted.arm.terms[LAST_LINK].names)
    values = _drawn_values(of_sums, last, precision, wide, loosened)
    for name, error in _still_errors(fitted, sums, of_sums):
        wide[sums.names.index(name)] = error**-2
    first = fitted.recordings[0]
    return LogKnowledge(
        values,
        precision,
        wide,
        raised,
        of_scales,
        1.0 / np.where(is_still, average, noise),
        first.rate / (first.low_pass.step * first.every),
    )


def _loosened_offsets(fitted: Fit, sums: Sums) -> Array:
    """Return by how much the priors of torque offsets in a fit are too precise here (p,).

    An offset of which a fit knows that it is as small as usual is taken for weight where it is not,
    and the file has that weight.
    """
    loosened = np.zeros(len(sums.names))
    for term in fitted.equations.terms:
        if term.key == OFFSET.name and term.prior is not None:
            kept = usual_errors.LARGE_OFFSET**-2
            loosened[sums.at(term.names)] = (1.0 - kept) / term.prior.variances
    return loosened


def _drawn_values(
    values: Array,
    last: NDArray[np.int64],
    precision: Array,
    wide: Array,
    loosened: Array,
) -> Array:
    """Return the values (p,) of a fit under other priors than its own.

    Args:
        values: (p,) of the fit.
        last: (10,) indices of the last link's, which its wide prior has drawn already.
        precision: (p, p) of data and priors.
        wide: (p,) precision of wide priors, around zero.
        loosened: (p,) precision that priors around zero have lost.
    """
    mean = np.zeros(len(values))
    mean[last] = values[last]
    normal = precision + np.diag(wide)
    _, inverse = solve(with_zero_torque(normal), values, np.diag(normal) > 0.0)
    return values + inverse @ (wide * (mean - values) + loosened * values)


def with_zero_torque(normal: Array) -> Array:
    """Return products (p, p) of columns as (p + 1, p + 1), those with a torque of zero beside."""
    return np.pad(normal, (0, 1))


def is_without_rows(fitted: Fit) -> NDArray[np.bool_]:
    """Return which joints with equations (J,) have no row that could be used: they stood still."""
    return np.sum(fitted.sums.counts, axis=0) == 0


def _marginal_precision(normal: Array, at: NDArray[np.int64]) -> Array:
    """Return the marginal precision (m, m) of some parameters: the others are not known either.

    Made-up motions lack a column of a log, that of its delay.
    """
    others = np.setdiff1d(np.arange(len(normal)), at)
    across = normal[at[:, None], others]
    of_others = normal[others[:, None], others]
    return normal[at[:, None], at] - across @ np.linalg.solve(of_others, across.T)


def _wide_errors(fitted: Fit, sums: Sums) -> Iterator[tuple[str, float]]:
    """Yield the names of parameters that a fit lets free, and how large they may be if unknown.

    The last link may be as far off as a link of the arm is large; friction and rotors make a share
    of a joint's torque.
    """
    for term in fitted.equations.terms:
        if term.prior is None and term.cause == LAST_LINK:
            yield from zip(term.names, last_link_scale(fitted.arm.robot).tolist())
        elif term.prior is None and term.cause in (FRICTION, MOTORS):
            yield from _unknown_sizes(fitted, sums, term)


def _unknown_sizes(fitted: Fit, sums: Sums, term: Term) -> Iterator[tuple[str, float]]:
    """Yield the names of a joint's or motor's parameters to how large they may be if unknown.

    A parameter whose column made-up motions lack is left out.
    """
    torque = fitted.sums.rms_torque
    sizes = usual_errors.UNKNOWN_JOINT * torque
    if term.key == VISCOUS.name:
        dry = np.maximum(fitted.question.dry or 0.0, LEAST_DRY * torque)
        sizes = np.minimum(sizes, usual_errors.VISCOUS_OVER_DRY * dry)
    columns = np.sqrt(sums.squares / sums.row_counts[:, None])
    for name in term.names:
        own = columns[:, sums.names.index(name)]
        is_seen = (own > 0.0) & (torque > 0.0)
        if np.any(is_seen):
            yield name, float(np.max(sizes[is_seen] / own[is_seen]))


def _still_errors(
    fitted: Fit, sums: Sums, values: Array
) -> Iterator[tuple[str, float]]:
    """Yield the dry friction of each joint that stood still, and how far off it may be [N m].

    It is as far off as that of the joint of which the model's friction clearly is farthest off, by
    the root of their torques, but no farther: where the model states none, friction is at most the
    largest that was found. Friction of strong and weak joints is neither the same nor in
    proportion.
    """
    is_still = is_without_rows(fitted)
    if not np.any(is_still):
        return
    names = [
        parameter.key
        for term in fitted.equations.terms
        if term.cause in (FRICTION, FURTHER_FRICTION, MOTORS)
        for parameter in term.parameters
        if parameter.is_friction and parameter.key in sums.names
    ]
    at = sums.at(names)
    own = fitted.at(names)
    off = np.zeros(len(sums.names) + 1)
    off[at] = [fitted.by_name[name] - fitted.arm.model.get(name, 0.0) for name in names]
    errors = np.zeros((len(off), len(off)))
    errors[at[:, None], at] = fitted.covariance[own[:, None], own]
    whole = np.append(values, -1.0)
    sizes = []
    torques = []
    for gram, count in zip(grams(sums), sums.row_counts):
        clear = max(off @ gram @ off - np.vdot(errors, gram), 0.0)
        sizes.append(np.sqrt(clear / count))
        torques.append(np.sqrt(whole @ gram @ whole / count))
    shares = np.array(sizes) / np.sqrt(np.maximum(torques, 1e-300))
    share = np.max(shares[~is_still], initial=0.0)
    largest = np.max(np.array(sizes)[~is_still], initial=0.0)
    for index in np.flatnonzero(is_still):
        size = float(min(share * np.sqrt(torques[index]), largest))
        yield COULOMB.key_of(sums.joints[index]), max(size, 1e-9)
