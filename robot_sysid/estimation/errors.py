"""How far off all parameters may be, cause by cause.

The low-pass of positions is one of the causes. Equations do not care for a filter that both their
sides pass (``signals.low_pass``). Positions x pass one of their own, F, before anything is built on
them. What that takes from motion, x - F x, is not known; what a second pass takes, F x - F F x, is,
and it is the same wherever F hardly changes motion. The torque of the identified arm differs by d
between F x and F F x, which moves the estimate by C Y^T W d: that is taken for one more standard
error, of size and of direction.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.equations import N_INERTIAL, Equations
from robot_sysid.dynamics.friction import TERMS
from robot_sysid.dynamics.newton_euler import in_parts
from robot_sysid.estimation.algebra.autocorrelation import JointResiduals, collect_residuals
from robot_sysid.estimation.algebra.information import normal_matrix, restricted, sample_counts
from robot_sysid.estimation.algebra.nuisances import SURE, WithPriors, largest_by_chance, misfits
from robot_sysid.estimation.algebra.possible_errors import BODIES, once_possible
from robot_sysid.estimation.algebra.uncertainty import Uncertainty, joint_space, uncertainty
from robot_sysid.estimation.columns import Columns, Point
from robot_sysid.estimation.dataset import Dataset, DecimatedSamples
from robot_sysid.estimation.fit import ChosenRows, Fit, release_memory, squared_effect
from robot_sysid.estimation.unknowns import (
    COMMON,
    LINKS,
    SCALES,
    build_unknowns,
    common_error,
    scale_spread,
)
from robot_sysid.records import Array, Measurement, Motion, PriorConflict

FILTERING, HELD = "filtering", "friction at its bound"
"""What these causes of error are called in results."""
# Weight of a hidden parameter in a combination that is rounding alone.
_ROUNDING = 1e-9
# Share of the largest eigenvalue from which on data tells what is held at bounds.
_SEEN = 1e-12
# Logarithm of odds that leave nothing of the other; more would not be finite. Where rounding alone
# tells them apart, either is as likely.
_SURE = 500.0


@dataclass(frozen=True)
class FitErrors:
    """The errors of the k parameters of a fit that are sought: ``whole`` of all causes, noise
    correlated in time, and rows (m, k) whose squares are the covariance that each cause explains.

    ``common`` is how far all torque scales may be off together, where nothing tells it (a share),
    ``conflicts`` are causes that the data asks for more clearly than chance does.
    """

    whole: Uncertainty
    causes: Mapping[str, Array]
    common: float = 0.0
    conflicts: tuple[PriorConflict, ...] = ()

    def of(
        self, change: Array, theta: Array | None = None
    ) -> tuple[Array, Array, dict[str, Array]]:
        """Return (covariance, noise errors, budget) of linear combinations (m, k).

        Their values theta (m,) are given where they grow with a scale that all joints share.
        """
        blind, used = ~self.shown(change), np.flatnonzero(np.any(change != 0.0, axis=0))
        few, own = change[:, used], np.ix_(used, used)

        def spread(products: Array) -> Array:
            return np.where(blind, np.inf, np.sqrt(np.maximum(np.sum(products, axis=1), 0.0)))

        covariance, noise = few @ self.whole.covariance[own] @ few.T, few @ self.whole.noise[own]
        parts = ((name, part[:, used]) for name, part in self.causes.items() if name != COMMON)
        budget = {name: spread((few @ part.T) ** 2) for name, part in parts}
        if self.common and theta is not None:
            covariance = covariance + self.common**2 * np.outer(theta, theta)
            budget[SCALES] = np.hypot(budget[SCALES], self.common * np.abs(theta))
        return covariance, spread(noise * few), budget

    def shown(self, change: Array) -> NDArray[np.bool_]:
        """Return (m,) whether combinations (m, k) contain nothing that the data hides."""
        hidden = np.isinf(self.whole.standard_errors)
        return np.asarray(np.max(np.abs(change[:, hidden]), axis=1, initial=0.0) < _ROUNDING)

    def share(self, fit: Fit) -> Array:
        """Return (k,) how much of each value comes from the data: 1 all, 0 all from before."""
        found = self.whole.data_share.copy()
        names = fit.unknowns.kept_names
        for group in fit.unknowns.groups:
            places = group.places(names)
            known = np.diag(group.widened**2 * group.factor @ group.factor.T)
            left = np.diag(self.whole.inverse)[places] / known
            found[places] = np.minimum(found[places], np.clip(1.0 - left, 0.0, 1.0))
        return found


def fit_errors(
    fit: Fit, residuals: Sequence[JointResiduals] = (), pull: Array | None = None
) -> FitErrors:
    """Return the errors of a fit; noise may be correlated in time.

    Args:
        residuals: per joint, what a pass over the rows left; empty takes that pass, and where there
            are no rows, noise without memory.
        pull: (joints, p) what the low-pass may move the estimate by, see ``filtering_bias``; None
            works it out from the rows.
    """
    if pull is None:
        point = replace(fit.point, values=fit.values)
        pairs = zip([each.delayed(point.delay) for each in fit.columns.datasets], fit.samples)
        pull = np.sum([filtering_bias(fit.columns, point, *pair) for pair in pairs], axis=0)
    whole, weights = _of_noise(fit, residuals), fit.weights
    causes = {
        group.cause: group.explained(fit.unknowns.kept_names, whole.inverse)
        for group in fit.unknowns.groups
    }
    found = _conflicts(fit, whole.effective)
    bias = whole.inverse @ (weights**2 @ pull[:, fit.unknowns.kept])
    more = _more(fit, whole.inverse, causes, found)
    for name, part in (*more, (FILTERING, bias[None])):
        causes[name] = np.vstack((causes.get(name, part[:0]), part))
        whole = whole.with_part(part.T @ part)
    if not (fit.question.in_file or fit.question.loaded):
        at, usual = fit.unknowns.bodies[fit.columns.robot.body_name]
        places = np.searchsorted(fit.unknowns.kept, at)
        whole, causes = once_possible(whole, causes, places, fit.values[at], usual)
    moved = _unlikely_move(fit)
    if len(moved):
        causes[BODIES] = np.vstack((causes.get(BODIES, moved[:0]), moved))
        whole = whole.with_part(moved.T @ moved)
    counts = tuple(n / d for n, d in zip(whole.effective, fit.inflation.tolist()))
    whole = replace(whole, effective=counts)
    return FitErrors(whole, causes, _common(fit), found)


def _unlikely_move(fit: Fit) -> Array:
    """Return what the estimate was moved by to be possible beyond chance, rows (0 or 1, k).

    The cost of the move, in units of noise and priors, is at most chi-square of the bodies' numbers
    if the truth is possible: errors that allow for noise and priors then allow for the move, too.
    What it costs beyond that has another cause, which may make the estimate as far off as it was
    moved.
    """
    moved = (fit.values - fit.free)[None, fit.unknowns.kept]
    cost = squared_effect(fit, fit.values - fit.free)
    bodies = [fit.free[at] for at, _ in fit.unknowns.bodies.values()]
    impossible = sum(not spatial.is_consistent(theta) for theta in bodies)
    chance = largest_by_chance(float(N_INERTIAL * max(impossible, 1)), 1.0 - SURE)
    return np.sqrt(1.0 - chance / cost) * moved if cost > chance else moved[:0]


def _of_noise(fit: Fit, residuals: Sequence[JointResiduals]) -> Uncertainty:
    """Return the errors that noise and priors explain; see ``fit_errors``."""
    release_memory()
    information, weights = fit.information, fit.weights
    left, space = list(residuals), joint_space(information, weights)
    if fit.samples and not left:
        given = fit.rows, fit.values[fit.unknowns.kept], space.inverse_root(), weights
        left = collect_residuals(information, *given)
    left = [replace(r, products=d * r.products) for r, d in zip(left, fit.inflation)]
    if left:  # which take as much memory as the triangles, and stand for them
        information = replace(information, joints=())
    release_memory()
    return uncertainty(information, weights, 1.0 / weights, left, space)


def _conflicts(fit: Fit, effective: Sequence[float]) -> tuple[PriorConflict, ...]:
    """Return the causes that the data asks for more clearly than chance does.

    Noise counts as it does in the errors: ``effective`` (joints,) independent samples, which are
    fewer than residuals show where the fit has taken slow noise out of them.
    """
    if fit.question.loaded or fit.question.in_file:
        return ()
    slow = sample_counts(fit.evidence.whole) / np.maximum(effective, 1.0)
    noise = np.sqrt(np.maximum(slow, 1.0) * fit.inflation) * fit.noise
    conflicts = misfits(fit.evidence.of(fit.unknowns), noise, fit.unknowns.groups)
    # How far off links are is averaged already (``link_scales``), and named by its own evidence.
    return tuple(conflict for conflict in conflicts if conflict.cause != LINKS)


def _more(
    fit: Fit, inverse: Array, causes: Mapping[str, Array], found: Sequence[PriorConflict]
) -> Iterator[tuple[str, Array]]:
    """Yield (cause, rows (m, k) whose squares are its covariance) of what stands in no prior.

    A prior that the data contradicts counts as wide as the data asks for. Where a scale of all
    torques is allowed for there may be none. What is held at a bound counts as if it were free: the
    bound may be where noise has pushed it.
    """
    for conflict in found:
        asked = (conflict.asked / conflict.scale) ** 2 - 1.0
        if asked > 0.0:
            yield conflict.cause, np.sqrt(asked) * causes[conflict.cause]
    if fit.choice.common_scale:
        yield SCALES, _unscaled(fit)
    if not fit.question.in_file:
        yield SCALES, _scaled_friction(fit)
    places = fit.columns.at(fit.unknowns.at_bound)
    places = places[fit.evidence.nonzero[places]]
    if len(places):
        normal, kept = normal_matrix(fit.evidence.whole, fit.weights), fit.unknowns.kept
        crossed = normal[np.ix_(kept, places)]
        moved = inverse @ crossed
        size, axes = np.linalg.eigh(normal[np.ix_(places, places)] - crossed.T @ moved)
        seen = size > _SEEN * size[-1]
        yield HELD, (moved @ (axes[:, seen] / np.sqrt(size[seen]))).T


def _scaled_friction(fit: Fit) -> Array:
    """Return how far friction and rotors are off by torque scales, rows (joints, k).

    The columns of a scale hold the torque of the links alone, so that friction and rotors come out
    as the torque column has them: off by as much as the scale is.
    """
    spread = scale_spread(fit.columns, fit.question.options, fit.question.loaded)
    names = fit.unknowns.kept_names
    rows = np.zeros((len(spread), len(names)))
    for row, joint in enumerate(fit.columns.joints):
        for place, name in enumerate(names):
            term, _, member = name.partition("[")
            if term in TERMS and term != "load" and member == f"{joint}]":
                rows[row, place] = spread[row] * fit.values[fit.unknowns.kept[place]]
    return rows


def _unscaled(fit: Fit) -> Array:
    """Return what a common torque scale changes (1, k), root mean square, that may not be there.

    With and without one count by how likely they make the data (Hoeting, Madigan, Raftery,
    Volinsky, "Bayesian model averaging: a tutorial", Statistical Science 14(4), 1999, eq. 1, 2).
    """
    known, choice = fit.unknowns, replace(fit.choice, common_scale=0.0)
    given = fit.evidence.torque, fit.evidence.nonzero
    plain = build_unknowns(fit.columns, fit.question, choice, *given).groups
    others = [group for group in known.groups if group.cause != SCALES]
    scales = (next(g for g in groups if g.cause == SCALES) for groups in (known.groups, plain))
    likely = WithPriors(fit.evidence.of(known), 1.0 / fit.weights).likely
    (values, one), (unscaled, other) = (likely([*others, each]) for each in scales)
    share = 1.0 / (1.0 + np.exp(min(np.nan_to_num(one - other), _SURE)))
    return np.asarray(np.sqrt(share) * (values - unscaled))[None]


def residuals_to_add(fit: Fit, samples: DecimatedSamples) -> list[JointResiduals]:
    """Return sums over lags of other rows than the fit's, in the columns of all parameters.

    A fit of their sum may hold other friction at its bound than this one.
    """
    sought, weights = fit.unknowns, fit.weights
    every = replace(sought, kept=np.union1d(sought.kept, fit.columns.at(sought.at_bound)))
    names, own = fit.columns.names, joint_space(fit.information, weights).inverse_root()
    root = np.zeros((len(names), own.shape[1]))
    root[sought.kept] = own
    given = restricted(fit.evidence.whole, every.kept_names, sought.held), fit.values[every.kept]
    rows = ChosenRows((samples,), every)
    found = collect_residuals(given[0], rows, given[1], root[every.kept], weights, True)
    return [replace(each, columns=every.kept[each.columns]) for each in found]


def residuals_within(fit: Fit, residuals: Sequence[JointResiduals]) -> list[JointResiduals]:
    """Return sums in the columns of all parameters as those in the columns of a fit."""
    kept, found = fit.unknowns.kept, []
    for each in residuals:
        stay = np.isin(each.columns, kept)
        at = np.searchsorted(kept, each.columns[stay])
        found.append(replace(each, columns=at, sums=each.sums[:, stay][:, :, stay]))
    return found


def _common(fit: Fit) -> float:
    """Return how far all torque scales may be off together, where nothing tells it."""
    groups = {group.cause: group for group in fit.unknowns.groups}
    if COMMON not in groups or SCALES not in groups:
        return 0.0
    scale = groups[SCALES]
    return scale.widened * common_error(np.diag(scale.factor))


def filtering_bias(
    columns: Columns, point: Point, dataset: Dataset, samples: DecimatedSamples
) -> Array:
    """Return Y_j^T d_j of each joint j, (joints, p), of one recording; zero at rest.

    That is at a point, which holds the estimate, of the recording's rows.
    """
    pull = np.zeros((len(samples.joints), len(samples.names)))
    if dataset.signals is None:
        return pull
    rows, again = dataset.signals.refiltered
    once = dataset.signals.decimated_motion()
    first = Motion(once.time[rows], once.q[rows], once.qd[rows], once.qdd[rows])
    same = np.sign(first.qd) == np.sign(again.qd)
    equations, own = columns.arm_torque(point, dataset.is_loaded)
    pairs = zip(_torques(equations, first, own), _torques(equations, again, own))
    for (index, block, tau), joint, (one, two) in zip(samples, equations.rows_of, pairs):
        # Where a joint turns round between the two, only the sign of its friction differs.
        counts = np.isfinite(tau[rows]) & same[:, joint]
        apart = (one - two)[counts]
        pull[index, samples.columns[index]] = block[rows][counts].T @ apart
    return pull


def _torques(equations: Equations, motion: Motion, values: Array) -> list[Array]:
    """Return the torque (K,) of each joint by the equations' own parameters (p,) [N m]."""
    width, found = motion.q.shape[1] * len(values), []
    for time, q, qd, qdd in in_parts(width, *vars(motion).values()):
        measurement = Measurement(time, q, qd, np.zeros_like(q), qdd)
        pairs = zip(equations.rows(measurement), equations.columns)
        found.append([block @ values[columns] - right for (block, right), columns in pairs])
    return [np.concatenate(parts) for parts in zip(*found)]
