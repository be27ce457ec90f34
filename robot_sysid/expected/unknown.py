"""How large may be what a log does not show: as large as the same thing is at this arm's joints.

A short, slow or partial log lets friction, rotors and the last link free, or takes sensors to be as
good as usual ones. Parameters of one kind, x_j at joint j, are alike in units s_j, m_j = x_j / s_j:
a gear's friction grows with its size and with its load, so that s_j makes a torque in proportion to
the root of both. What is found at the n joints that the log shows sizes the rest,

    m_j ~ N(mean, spread^2),    mean = sum m_j / n,
    spread^2 = (w usual^2 + sum ((m_j - mean)^2 + v_j)) / (w + n),

v_j the variance of m_j, in turns with the fit under these priors (expectation maximisation of the
evidence; Dempster, Laird, Rubin, J. R. Stat. Soc. B 39, 1977). Where nothing is found, v_j is the
square of the usual spread, which stays.

Shapes: p parameters of motions, J joints with equations; k parameters of a kind.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.dynamics.friction import OFFSET
from robot_sysid.estimate.equations.inverse import solve
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.links import last_link_scale
from robot_sysid.estimate.rows import Sums
from robot_sysid.estimate.terms import (
    FRICTION,
    FURTHER_FRICTION,
    LAST_LINK,
    MOTORS,
    Prior,
    Term,
)
from robot_sysid.expected.motions import grams
from robot_sysid.records import Array

USUAL_COUNT = 0.05
"""Number of joints that the usual spread counts as, beside those of the arm: enough for a log that
shows one of them."""
LEAST_SPREAD = 0.75
"""Least spread of friction and rotors over their mean: root mean square of the spreads of dry
friction in these units over the joints of real arms of several makers."""
ROUNDS = 10
"""Rounds in which priors are learnt, after which they change by a few per cent."""


@dataclass(frozen=True)
class Kind:
    """Parameters of one kind, which are alike in units of their sizes.

    Attributes:
        at: (k,) indices of the parameters.
        centre: (k,) values that they have if nothing is different from the model.
        sizes: (k,) units in which they are alike.
        usual: spread of arms of which nothing is known.
        replaced: (k,) precision of the fit's own priors about zero, in whose place this one comes.
        is_shown: (k,) which of them tell of the others; none where they are not alike.
        is_positive: whether they cannot be negative, so that they have a mean.
    """

    at: NDArray[np.int64]
    centre: Array
    sizes: Array
    usual: float
    replaced: Array
    is_shown: NDArray[np.bool_]
    is_positive: bool

    def learn(self, values: Array, variances: Array) -> tuple[float, float]:
        """Return mean and spread, of values and their variances (p,) under the last ones."""
        at = self.at[self.is_shown]
        sizes = self.sizes[self.is_shown]
        if not len(at):
            return 0.0, self.usual
        alike = (values[at] - self.centre[self.is_shown]) / sizes
        mean = 0.0
        if self.is_positive:
            alike = np.maximum(alike, 0.0)
            mean = float(np.sum(alike)) / len(at)
        squares = np.sum((alike - mean) ** 2 + variances[at] / sizes**2)
        count = USUAL_COUNT + len(at)
        spread = np.sqrt((USUAL_COUNT * self.usual**2 + squares) / count)
        return mean, float(np.clip(spread, LEAST_SPREAD * mean, self.usual))


@dataclass(frozen=True)
class LearntPriors:
    """Priors of kinds, and the fit under them.

    Attributes:
        values: (p,) of the fit.
        wide: (p,) precision of the priors; zero of parameters of no kind.
    """

    values: Array
    wide: Array


def learn_priors(
    kinds: Sequence[Kind], precision: Array, values: Array
) -> LearntPriors:
    """Return the priors that evidence gives kinds of parameters, and the fit under them.

    Args:
        kinds: of the parameters.
        precision: (p, p) of data and the priors that stay.
        values: (p,) of the fit with its own priors.
    """
    found = [(0.0, kind.usual) for kind in kinds]
    for _ in range(ROUNDS):
        wide = np.zeros(len(values))
        pull = np.zeros(len(values))
        for kind, (mean, spread) in zip(kinds, found):
            at = kind.at
            wide[at] = (spread * kind.sizes) ** -2.0
            expected = kind.centre + mean * kind.sizes
            pull[at] = wide[at] * (expected - values[at]) + kind.replaced * values[at]
        normal = precision + np.diag(wide)
        _, inverse = solve(with_zero_torque(normal), values, np.diag(normal) > 0.0)
        fitted = values + inverse @ pull
        variances = np.diag(inverse)
        found = [kind.learn(fitted, variances) for kind in kinds]
    return LearntPriors(fitted, wide)


def with_zero_torque(normal: Array) -> Array:
    """Return products (p, p) of columns as (p + 1, p + 1), those with a torque of zero beside."""
    return np.pad(normal, (0, 1))


def is_without_rows(fitted: Fit) -> NDArray[np.bool_]:
    """Return which joints with equations (J,) have no row that could be used: they stood still."""
    return np.sum(fitted.sums.counts, axis=0) == 0


def kinds_of(fitted: Fit, sums: Sums) -> list[Kind]:
    """Return the kinds of parameters of which a fit knows too little.

    These are the last link, dry and viscous friction and rotors, and offsets of torque sensors: of
    one that a fit takes to be as small as usual it takes the rest for weight, and the file has that
    weight. Of joints that stood still it is all friction.
    """
    torque = joint_torques(fitted, sums)
    kinds = []
    for term in fitted.equations.terms:
        if term.prior is None and term.cause == LAST_LINK:
            at = sums.at(term.names)
            sizes = last_link_scale(fitted.arm.robot)
            usual = usual_errors.UNKNOWN_LAST_LINK
            none = np.zeros(len(at))
            kinds.append(
                Kind(at, term.reference, sizes, usual, none, none > 0.0, False)
            )
        elif term.prior is None and term.cause in (FRICTION, MOTORS):
            kinds += _friction_kinds(fitted, sums, term, torque)
        elif term.prior is not None and term.key == OFFSET.name:
            kinds.append(_offset_kind(fitted, sums, term, term.prior, torque))
        elif term.prior is not None and term.cause == FURTHER_FRICTION:
            kinds += _still_kinds(fitted, sums, term, term.prior, torque)
    return kinds


def _friction_kinds(
    fitted: Fit, sums: Sums, term: Term, torque: Array
) -> Iterator[Kind]:
    """Yield the kind of a term of friction or rotors, or of a motor that turns several joints.

    Parameters whose column made-up motions lack are left out.

    Args:
        fitted: the fit.
        sums: of made-up motions.
        term: as the fit has it, of joints that moved.
        torque: (J,) see ``joint_torques``.
    """
    whole = fitted.arm.terms[term.key] if term.cause == FRICTION else term
    at = sums.at(whole.names)
    sizes = _alike_sizes(sums, at, torque)
    is_used = sizes > 0.0
    if np.any(is_used):
        names = np.array(whole.names)[is_used]
        is_shown = np.isin(names, term.names) & (term.cause == FRICTION)
        zero = np.zeros(len(names))
        usual = usual_errors.UNKNOWN_JOINT
        is_positive = whole.parameters[0].lower == 0.0
        yield Kind(
            at[is_used], zero, sizes[is_used], usual, zero, is_shown, is_positive
        )


def _still_kinds(
    fitted: Fit, sums: Sums, term: Term, prior: Prior, torque: Array
) -> Iterator[Kind]:
    """Yield the kind of a term that friction models lack, of joints that stood still.

    It is as large there as the fit's own ``prior`` allows at the others, over their torques; the
    other arguments are those of ``_friction_kinds``.
    """
    at = sums.at(term.names)
    sizes = _alike_sizes(sums, at, torque)
    is_still = _is_of(term, still_joints(fitted))
    acts = sizes > 0.0
    is_used = is_still & acts
    others = acts & ~is_still
    if np.any(is_used) and np.any(others):
        zero = np.zeros(np.count_nonzero(is_used))
        usual = float(np.sqrt(np.mean(prior.variances[others] / sizes[others] ** 2)))
        none = zero > 0.0
        yield Kind(at[is_used], zero, sizes[is_used], usual, zero, none, False)


def _offset_kind(
    fitted: Fit, sums: Sums, term: Term, prior: Prior, torque: Array
) -> Kind:
    """Return the kind of the torque offsets of joints, which are alike over their own torques.

    ``prior`` is the fit's own; the other arguments are those of ``_friction_kinds``.
    """
    variances = prior.variances
    moved = ~_is_of(term, still_joints(fitted))
    joints = [sums.joints.index(parameter.of) for parameter in term.parameters]
    at = sums.at(term.names)
    measured = _not_too_small(fitted.sums.rms_torque)
    own = np.where(moved, measured[joints], torque[joints])
    sizes = own * np.sqrt(np.mean(variances[moved]) / np.mean(own[moved] ** 2))
    zero = np.zeros(len(at))
    usual = usual_errors.LARGE_OFFSET
    replaced = np.where(moved, 1.0 / variances, 0.0)
    return Kind(at, zero, sizes, usual, replaced, moved, False)


def still_joints(fitted: Fit) -> tuple[str, ...]:
    """Return the names of the joints that stood still."""
    return tuple(itertools.compress(fitted.arm.joints, is_without_rows(fitted)))


def is_told(fitted: Fit, names: Sequence[str]) -> NDArray[np.bool_]:
    """Return which parameters (p,) a fit tells of: none of friction where joints stood still."""
    still = still_joints(fitted)
    untold = {
        parameter.key
        for term in fitted.equations.terms
        if term.cause in (FRICTION, FURTHER_FRICTION) or term.key == OFFSET.name
        for parameter in term.parameters
        if parameter.of in still
    }
    return np.isin(names, fitted.names) & ~np.isin(names, [*untold])


def _is_of(term: Term, joints: Collection[str]) -> NDArray[np.bool_]:
    """Return which parameters (k,) of a term are those of some joints."""
    return np.array([parameter.of in joints for parameter in term.parameters])


def _alike_sizes(sums: Sums, at: NDArray[np.int64], torque: Array) -> Array:
    """Return the sizes (k,) that make parameters as large as torques (J,) of the joints they move.

    They are zero of those whose column made-up motions lack.
    """
    columns = np.sqrt(sums.squares[:, at] / sums.row_counts[:, None])
    # A motor's friction is felt at several joints.
    return np.max(torque[:, None] / np.where(columns > 0.0, columns, np.inf), axis=0)


def _not_too_small(torque: Array) -> Array:
    """Return torques of joints (J,), of those that carry next to nothing the least usual one."""
    return np.maximum(torque, usual_errors.PLANNED_LEAST * np.max(torque))


def joint_torques(fitted: Fit, sums: Sums) -> Array:
    """Return a torque of each joint (J,) to which its friction is in proportion [N m].

    It is the root of what the joint carries by the model and of what it is built for, its effort
    limit, where the model states them; over the joints that moved, as large as their torque.
    """
    model = [fitted.arm.model.get(name, 0.0) for name in sums.names]
    whole = np.append(model, -1.0)
    squares = np.array([whole @ gram @ whole for gram in grams(sums)])
    carried = _not_too_small(np.sqrt(np.maximum(squares, 0.0) / sums.row_counts))
    efforts = fitted.arm.robot.limits.torque[[*fitted.arm.indices]]
    if not np.all(np.isfinite(efforts)):
        efforts = np.ones(len(carried))
    alike = np.sqrt(carried * efforts)
    moved = ~is_without_rows(fitted)
    own = np.mean(fitted.sums.rms_torque[moved] ** 2)
    return alike * np.sqrt(own / np.mean(alike[moved] ** 2))
