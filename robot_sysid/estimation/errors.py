"""Covariance of all parameters, cause by cause.

The low-pass of positions is one of the causes. Equations stay right under a filter that both their
sides pass (``signals.low_pass``), but positions x pass one of their own, F, before velocities are
computed. The motion that it removes, x - F x, is not known; the motion that a second pass removes,
F x - F F x, is known, and nearly equal wherever F hardly changes motion. The torque of the
identified arm differs by d between F x and F F x, which moves the estimate by C Y^T W d: that
vector counts as one more standard error, in size and direction.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.equations import N_INERTIAL, Equations
from robot_sysid.dynamics.friction import TERMS
from robot_sysid.dynamics.newton_euler import split_motion
from robot_sysid.estimation.algebra.consistent_bodies import BODIES, project_errors
from robot_sysid.estimation.algebra.least_squares import (
    normal_matrix,
    restrict,
    sample_counts,
)
from robot_sysid.estimation.algebra.priors import (
    SURE,
    WithPriors,
    largest_by_chance,
    misfits,
)
from robot_sysid.estimation.algebra.uncertainty import (
    JointResiduals,
    Uncertainty,
    collect_residuals,
    joint_space,
    uncertainty,
)
from robot_sysid.estimation.columns import Columns, Point
from robot_sysid.estimation.dataset import Dataset, DecimatedSamples, release_memory
from robot_sysid.estimation.fit import EstimatedRows, Fit, squared_effect
from robot_sysid.estimation.unknowns import (
    COMMON,
    LINKS,
    SCALES,
    build_unknowns,
    common_error,
    scale_spread,
)
from robot_sysid.records import Array, Measurement, Motion, PriorConflict

# Causes of error, as they are called in results.
FILTERING = "filtering"
HELD = "friction at its bound"
# Weight of a parameter without data below which it counts as rounding in a combination.
_ROUNDING = 1e-9
# Share of the largest eigenvalue from which on data determines parameters that are held at bounds.
_SEEN = 1e-12
# Largest logarithm of odds: beyond it the less likely model has no weight, and exp would overflow.
_SURE = 500.0


@dataclass(frozen=True)
class FitErrors:
    """Errors of the k unknowns of a fit.

    Attributes:
        total: errors of all causes together; noise is correlated in time.
        causes: cause to rows A (m, k) of its covariance A^T A.
        common: standard deviation of an error that all torque scales share, where neither data nor
            prior determines it (a share).
        conflicts: causes whose errors exceed their priors by more than chance.
    """

    total: Uncertainty
    causes: Mapping[str, Array]
    common: float = 0.0
    conflicts: tuple[PriorConflict, ...] = ()

    def of(
        self, change: Array, theta: Array | None = None
    ) -> tuple[Array, Array, dict[str, Array]]:
        """Return the errors of linear combinations of the unknowns.

        Args:
            change: (m, k) the combinations.
            theta: (m,) values of the combinations, to which an error of all torque scales applies;
                None where it does not.

        Returns:
            (covariance (m, m), standard errors (m,) due to noise, cause to standard errors (m,)),
            standard errors infinite where a combination is not identified.
        """
        is_hidden = ~self.are_identified(change)
        used = np.flatnonzero(np.any(change != 0.0, axis=0))
        change_used = change[:, used]
        block = np.ix_(used, used)

        def standard_errors(products: Array) -> Array:
            variances = np.maximum(np.sum(products, axis=1), 0.0)
            return np.where(is_hidden, np.inf, np.sqrt(variances))

        covariance = change_used @ self.total.covariance[block] @ change_used.T
        noise = change_used @ self.total.noise[block]
        budget = {}
        for cause, rows in self.causes.items():
            if cause != COMMON:
                budget[cause] = standard_errors((change_used @ rows[:, used].T) ** 2)
        if self.common and theta is not None:
            covariance = covariance + self.common**2 * np.outer(theta, theta)
            budget[SCALES] = np.hypot(budget[SCALES], self.common * np.abs(theta))
        return covariance, standard_errors(noise * change_used), budget

    def are_identified(self, change: Array) -> NDArray[np.bool_]:
        """Return (m,) whether combinations (m, k) contain identified parameters alone."""
        hidden = np.isinf(self.total.standard_errors)
        return np.asarray(
            np.max(np.abs(change[:, hidden]), axis=1, initial=0.0) < _ROUNDING
        )

    def share(self, fit: Fit) -> Array:
        """Return the share (k,) of each estimated value that comes from the data, not priors."""
        shares = self.total.data_share.copy()
        names = fit.unknowns.estimated_names
        for group in fit.unknowns.groups:
            indices = group.indices(names)
            prior_variance = np.diag(group.widened**2 * group.factor @ group.factor.T)
            remaining = np.diag(self.total.inverse)[indices] / prior_variance
            shares[indices] = np.minimum(
                shares[indices], np.clip(1.0 - remaining, 0.0, 1.0)
            )
        return shares


def fit_errors(
    fit: Fit, residuals: Sequence[JointResiduals] = (), pull: Array | None = None
) -> FitErrors:
    """Return the errors of a fit; noise may be correlated in time.

    Args:
        residuals: sums over lags of each joint's residuals; if empty, they are made of the fit's
            rows, and without rows noise is white.
        pull: (joints, p) of ``filtering_bias``; None computes it from the rows.
    """
    if pull is None:
        point = replace(fit.point, values=fit.values)
        pairs = zip(
            [dataset.remove_delay(point.delay) for dataset in fit.columns.datasets],
            fit.samples,
        )
        pull = np.sum(
            [filtering_bias(fit.columns, point, *pair) for pair in pairs], axis=0
        )
    total = _noise_errors(fit, residuals)
    causes = {
        group.cause: group.covariance_rows(fit.unknowns.estimated_names, total.inverse)
        for group in fit.unknowns.groups
    }
    conflicts = _conflicts(fit, total.effective)
    bias = total.inverse @ (fit.weights**2 @ pull[:, fit.unknowns.estimated])
    further = _further_causes(fit, total.inverse, causes, conflicts)
    for name, rows in (*further, (FILTERING, bias[None])):
        causes[name] = np.vstack((causes.get(name, rows[:0]), rows))
        total = total.with_cause(rows.T @ rows)
    if not (fit.question.in_file or fit.question.loaded):
        parameters, usual_body = fit.unknowns.bodies[fit.columns.robot.body_name]
        indices = np.searchsorted(fit.unknowns.estimated, parameters)
        total, causes = project_errors(
            total, causes, indices, fit.values[parameters], usual_body
        )
    move = _unlikely_move(fit)
    if len(move):
        causes[BODIES] = np.vstack((causes.get(BODIES, move[:0]), move))
        total = total.with_cause(move.T @ move)
    counts = tuple(n / d for n, d in zip(total.effective, fit.inflation.tolist()))
    total = replace(total, effective=counts)
    return FitErrors(total, causes, _common_scale_error(fit), conflicts)


def _unlikely_move(fit: Fit) -> Array:
    """Return the part of the move to consistent bodies that chance does not explain, (0 or 1, k).

    The true bodies are consistent, so that the cost of the move, the squared effect in standard
    deviations of noise and priors, is at most chi-square in the bodies' parameters: up to that, the
    errors of noise and priors cover the move. A larger cost has another cause, which may make the
    estimate as wrong as the move is long.
    """
    move = (fit.values - fit.free)[None, fit.unknowns.estimated]
    cost = squared_effect(fit, fit.values - fit.free)
    bodies = [fit.free[indices] for indices, _ in fit.unknowns.bodies.values()]
    impossible = sum(not spatial.is_consistent(theta) for theta in bodies)
    cost_by_chance = largest_by_chance(
        float(N_INERTIAL * max(impossible, 1)), 1.0 - SURE
    )
    return (
        np.sqrt(1.0 - cost_by_chance / cost) * move
        if cost > cost_by_chance
        else move[:0]
    )


def _noise_errors(fit: Fit, residuals: Sequence[JointResiduals]) -> Uncertainty:
    """Return the errors that noise and priors explain; see ``fit_errors``."""
    release_memory()
    information = fit.information
    weights = fit.weights
    space = joint_space(information, weights)
    if fit.samples and not residuals:
        values = fit.values[fit.unknowns.estimated]
        root = space.inverse_root()
        residuals = collect_residuals(information, fit.rows, values, root, weights)
    residuals = [
        replace(r, products=d * r.products) for r, d in zip(residuals, fit.inflation)
    ]
    if (
        residuals
    ):  # they take as much memory as the triangles, which are no longer needed
        information = replace(information, joints=())
    release_memory()
    return uncertainty(information, weights, 1.0 / weights, residuals, space)


def _conflicts(fit: Fit, effective: Sequence[float]) -> tuple[PriorConflict, ...]:
    """Return the causes whose errors exceed their priors by more than chance.

    Noise counts as in the errors: by ``effective`` (joints,) independent samples. Residuals alone
    show more of them, because the fit follows slow noise.
    """
    if fit.question.loaded or fit.question.in_file:
        return ()
    rows_per_sample = sample_counts(fit.evidence.total) / np.maximum(effective, 1.0)
    noise = np.sqrt(np.maximum(rows_per_sample, 1.0) * fit.inflation) * fit.noise
    conflicts = misfits(fit.evidence.of(fit.unknowns), noise, fit.unknowns.groups)
    # The prior of links is widened already (``link_scales``), and has its own test.
    return tuple(conflict for conflict in conflicts if conflict.cause != LINKS)


def _further_causes(
    fit: Fit,
    inverse: Array,
    causes: Mapping[str, Array],
    conflicts: Sequence[PriorConflict],
) -> Iterator[tuple[str, Array]]:
    """Yield (cause, rows A (m, k) of its covariance A^T A) of errors that the fit's priors lack.

    A prior that the data contradicts counts as wide as the data needs it. A common torque scale in
    the fit may be zero in truth. A parameter at its bound counts as free: noise may have pushed it
    there.
    """
    for conflict in conflicts:
        excess = (conflict.deviation / conflict.scale) ** 2 - 1.0
        if excess > 0.0:
            yield conflict.cause, np.sqrt(excess) * causes[conflict.cause]
    if fit.choice.common_scale:
        yield SCALES, _common_scale_change(fit)
    if not fit.question.in_file:
        yield SCALES, _scaled_friction(fit)
    at_bound = fit.columns.indices(fit.unknowns.names_at_bound)
    at_bound = at_bound[fit.evidence.nonzero[at_bound]]
    if len(at_bound):
        normal = normal_matrix(fit.evidence.total, fit.weights)
        crossed = normal[np.ix_(fit.unknowns.estimated, at_bound)]
        move = inverse @ crossed
        eigenvalues, axes = np.linalg.eigh(
            normal[np.ix_(at_bound, at_bound)] - crossed.T @ move
        )
        large = eigenvalues > _SEEN * eigenvalues[-1]
        yield HELD, (move @ (axes[:, large] / np.sqrt(eigenvalues[large]))).T


def _scaled_friction(fit: Fit) -> Array:
    """Return the errors of friction and rotors due to torque scales, rows (joints, k).

    The column of a scale is the torque of the links alone, so that friction and rotors are
    estimated in units of the sensor: their relative error is that of the scale.
    """
    spread = scale_spread(fit.columns, fit.question.options, fit.question.loaded)
    names = fit.unknowns.estimated_names
    rows = np.zeros((len(spread), len(names)))
    for row, joint in enumerate(fit.columns.joints):
        for column, name in enumerate(names):
            term, _, member = name.partition("[")
            if term in TERMS and term != "load" and member == f"{joint}]":
                rows[row, column] = (
                    spread[row] * fit.values[fit.unknowns.estimated[column]]
                )
    return rows


def _common_scale_change(fit: Fit) -> Array:
    """Return the root mean square change (1, k) of the estimate without a common torque scale.

    The models with and without one are weighted by their evidence (Hoeting, Madigan, Raftery,
    Volinsky, "Bayesian model averaging: a tutorial", Statistical Science 14(4), 1999, eq. 1, 2).
    """
    unknowns = fit.unknowns
    choice = replace(fit.choice, common_scale=0.0)
    data = fit.evidence
    plain = build_unknowns(fit.columns, fit.question, choice, data.torque, data.nonzero)
    other_groups = [group for group in unknowns.groups if group.cause != SCALES]
    scales, plain_scales = (
        next(group for group in groups if group.cause == SCALES)
        for groups in (unknowns.groups, plain.groups)
    )
    posterior = WithPriors(data.of(unknowns), 1.0 / fit.weights).log_evidence
    values, evidence = posterior([*other_groups, scales])
    plain_values, plain_evidence = posterior([*other_groups, plain_scales])
    share = 1.0 / (1.0 + np.exp(min(np.nan_to_num(evidence - plain_evidence), _SURE)))
    return np.asarray(np.sqrt(share) * (values - plain_values))[None]


def residuals_to_add(fit: Fit, samples: DecimatedSamples) -> list[JointResiduals]:
    """Return sums over lags of rows other than the fit's, in the columns of all parameters.

    They include friction at its bound: a fit to the sum over all logs may not hold it there.
    """
    unknowns = fit.unknowns
    weights = fit.weights
    indices = np.union1d(
        unknowns.estimated, fit.columns.indices(unknowns.names_at_bound)
    )
    all_unknowns = replace(unknowns, estimated=indices)
    inverse_root = joint_space(fit.information, weights).inverse_root()
    root = np.zeros((len(fit.columns.names), inverse_root.shape[1]))
    root[unknowns.estimated] = inverse_root
    information = restrict(
        fit.evidence.total, all_unknowns.estimated_names, unknowns.held
    )
    rows = EstimatedRows((samples,), all_unknowns)
    values = fit.values[indices]
    sums = collect_residuals(information, rows, values, root[indices], weights, True)
    return [replace(joint, columns=indices[joint.columns]) for joint in sums]


def residuals_within(
    fit: Fit, residuals: Sequence[JointResiduals]
) -> list[JointResiduals]:
    """Return sums over lags, in the columns of all parameters, in those of a fit's unknowns."""
    indices = fit.unknowns.estimated
    restricted_sums = []
    for joint in residuals:
        is_unknown = np.isin(joint.columns, indices)
        columns = np.searchsorted(indices, joint.columns[is_unknown])
        restricted_sums.append(
            replace(
                joint, columns=columns, sums=joint.sums[:, is_unknown][:, :, is_unknown]
            )
        )
    return restricted_sums


def _common_scale_error(fit: Fit) -> float:
    """Return the standard deviation of a common torque scale error that no data determines."""
    groups = {group.cause: group for group in fit.unknowns.groups}
    if COMMON not in groups or SCALES not in groups:
        return 0.0
    scale = groups[SCALES]
    return scale.widened * common_error(np.diag(scale.factor))


def filtering_bias(
    columns: Columns, point: Point, dataset: Dataset, samples: DecimatedSamples
) -> Array:
    """Return Y_j^T d_j of each joint j, (joints, p), of one recording's rows; zero at rest.

    The point holds the estimate; d is the difference in torque of a second low-pass [N m].
    """
    pull = np.zeros((len(samples.joints), len(samples.names)))
    if dataset.signals is None:
        return pull
    rows, second = dataset.signals.refiltered_motion
    motion = dataset.signals.decimated_motion()
    first = Motion(motion.time[rows], motion.q[rows], motion.qd[rows], motion.qdd[rows])
    same_direction = np.sign(first.qd) == np.sign(second.qd)
    equations, values = columns.arm_torque(point, dataset.is_loaded)
    torques = zip(
        _torques(equations, first, values), _torques(equations, second, values)
    )
    for (index, block, tau), joint, (torque, refiltered) in zip(
        samples, equations.joint_indices, torques
    ):
        # Where the second low-pass reverses a velocity, the difference is the sign of friction.
        is_used = np.isfinite(tau[rows]) & same_direction[:, joint]
        difference = (torque - refiltered)[is_used]
        pull[index, samples.columns[index]] = block[rows][is_used].T @ difference
    return pull


def _torques(equations: Equations, motion: Motion, values: Array) -> list[Array]:
    """Return the torque (K,) of each joint at values (p,) of the equations' parameters [N m]."""
    width = motion.q.shape[1] * len(values)
    pieces = []
    for time, q, qd, qdd in split_motion(width, *vars(motion).values()):
        measurement = Measurement(time, q, qd, np.zeros_like(q), qdd)
        pairs = zip(equations.rows(measurement), equations.columns)
        pieces.append(
            [
                block @ values[columns] - right_side
                for (block, right_side), columns in pairs
            ]
        )
    return [np.concatenate(joint_pieces) for joint_pieces in zip(*pieces)]
