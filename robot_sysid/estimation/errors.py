"""Covariance of the estimated parameters, cause by cause.

Shapes: a fit has p parameters (``Columns.names``), of which k are estimated, in the order of
``Unknowns.estimated_names``; "joints" counts the joints that have equations; an equation of joint j
reads Y_j x = tau_j and has weight W_j = w_j^2, w_j = 1 / effective noise (``Fit.weights``). The
matrix C (k, k) is the inverse of the normal matrix sum_j Y_j^T W_j Y_j, with that of the priors
added. A prior (``NuisanceGroup``) belongs to one cause of error; F is its ``factor``, and its
covariance (widened F) (widened F)^T.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import split_name
from robot_sysid.dynamics.friction import TERMS
from robot_sysid.estimation.algebra.common_scale import common_error
from robot_sysid.estimation.algebra.least_squares import normal_matrix, sample_counts
from robot_sysid.estimation.algebra.priors import WithPriors, misfits
from robot_sysid.estimation.algebra.uncertainty import (
    JointResiduals,
    Uncertainty,
    collect_residuals,
    joint_space,
    uncertainty,
)
from robot_sysid.estimation.dataset import release_memory
from robot_sysid.estimation.fit import Fit
from robot_sysid.estimation.unknowns import COMMON, LINKS, SCALES, scale_spread
from robot_sysid.records import Array, PriorConflict

# Cause in results: parameters that are held at a bound.
HELD = "friction at its bound"
# Size below which the coefficient of an unidentified parameter in a combination is rounding error.
_ROUNDING = 1e-9
# Eigenvalue of information, as a share of the largest one, above which data determines a direction
# of the parameters that are held at bounds.
_SEEN = 1e-12
# Largest log odds of two models: above it the less likely one has no weight, and exp may overflow.
_SURE = 500.0


@dataclass(frozen=True)
class FitErrors:
    """Errors of the k estimated parameters of a fit.

    Attributes:
        total: errors of all causes together, including torque noise that is correlated in time.
        causes: cause of error other than torque noise to the rows A (m, k) of its covariance A^T A.
        common: standard deviation of an error that all torque scales share, as a share of the
            torque, from its prior; zero where the estimate determines it.
        conflicts: causes whose errors exceed their priors by more than chance.
    """

    total: Uncertainty
    causes: Mapping[str, Array]
    common: float = 0.0
    conflicts: tuple[PriorConflict, ...] = ()

    def of(
        self, combinations: Array, theta: Array | None = None
    ) -> tuple[Array, Array, dict[str, Array]]:
        """Return the errors of m linear combinations of the estimated parameters.

        Args:
            combinations: (m, k) coefficients of the combinations.
            theta: (m,) values of the combinations, which an error shared by all torque scales
                multiplies; None for combinations that torque scales leave alone.

        Returns:
            (covariance (m, m), standard errors (m,) due to noise, cause to standard errors (m,)).
            Standard errors are infinite where a combination is not identified.
        """
        is_hidden = ~self.are_identified(combinations)
        used = np.flatnonzero(np.any(combinations != 0.0, axis=0))
        used_combinations = combinations[:, used]
        block = np.ix_(used, used)

        def standard_errors(products: Array) -> Array:
            """Return standard errors (m,) from the terms (m, terms) that add up to variances."""
            variances = np.maximum(np.sum(products, axis=1), 0.0)
            return np.where(is_hidden, np.inf, np.sqrt(variances))

        covariance = (
            used_combinations @ self.total.covariance[block] @ used_combinations.T
        )
        # The diagonal of U N U^T is the sum over each row of (U N) * U.
        noise_products = used_combinations @ self.total.noise[block] * used_combinations
        budget = {}
        for cause, rows in self.causes.items():
            if cause != COMMON:
                effects = used_combinations @ rows[:, used].T
                budget[cause] = standard_errors(effects**2)
        if self.common and theta is not None:
            covariance = covariance + self.common**2 * np.outer(theta, theta)
            budget[SCALES] = np.hypot(budget[SCALES], self.common * np.abs(theta))
        return covariance, standard_errors(noise_products), budget

    def are_identified(self, combinations: Array) -> NDArray[np.bool_]:
        """Return whether each of m combinations (m, k) has identified parameters only (m,)."""
        hidden = np.isinf(self.total.standard_errors)
        return np.asarray(
            np.max(np.abs(combinations[:, hidden]), axis=1, initial=0.0) < _ROUNDING
        )

    def share(self, fit: Fit) -> Array:
        """Return the share (k,), 0 to 1, of each estimated value that comes from data, not priors.

        Of a parameter with a prior, it is at most the share by which data reduces the variance.

        Args:
            fit: the fit whose errors these are.
        """
        shares = self.total.data_share.copy()
        names = fit.unknowns.estimated_names
        for group in fit.unknowns.groups:
            indices = group.indices(names)
            prior_variance = np.diag(group.widened**2 * group.factor @ group.factor.T)
            variance_ratio = np.diag(self.total.inverse)[indices] / prior_variance
            data_share = np.clip(1.0 - variance_ratio, 0.0, 1.0)
            shares[indices] = np.minimum(shares[indices], data_share)
        return shares


def fit_errors(fit: Fit) -> FitErrors:
    """Return the errors of a fit from all causes, with torque noise that is correlated in time.

    Args:
        fit: the fit; without its rows, noise is white.
    """
    # Noise and priors, then causes without a prior.
    total = _noise_errors(fit)
    names = fit.unknowns.estimated_names
    causes = {}
    for group in fit.unknowns.groups:
        causes[group.cause] = group.covariance_rows(names, total.inverse)
    conflicts = _conflicts(fit, total.effective)

    for cause, rows in _further_causes(fit, total.inverse, causes, conflicts):
        causes[cause] = np.vstack((causes.get(cause, rows[:0]), rows))
        total = total.with_cause(rows.T @ rows)

    return FitErrors(total, causes, _common_scale_error(fit), conflicts)


def _noise_errors(fit: Fit) -> Uncertainty:
    """Return the errors of a fit that torque noise and priors explain.

    Memory that is free is given back to the system on the way. Without the fit's rows, noise is
    white.
    """
    release_memory()
    information = fit.information
    weights = fit.weights
    space = joint_space(information, weights)
    residuals = list[JointResiduals]()
    if fit.samples:
        values = fit.values[fit.unknowns.estimated]
        root = space.inverse_root()
        residuals = collect_residuals(information, fit.rows, values, root, weights)
    if residuals:
        # The sums take as much memory as the triangles, which are no longer needed.
        information = replace(information, joints=())
    release_memory()
    return uncertainty(information, weights, 1.0 / weights, residuals, space)


def _conflicts(fit: Fit, effective: Sequence[float]) -> tuple[PriorConflict, ...]:
    """Return the causes of error that are larger than their priors allow, by more than chance.

    The noise of a row is enlarged by the square root of the rows per independent sample. Fits with
    a payload and fits for a file have no conflicts here.

    Args:
        fit: the fit with its priors and data.
        effective: (joints,) number of independent samples. The autocorrelation of the residuals
            would give more of them, because the fit follows slow noise.
    """
    if fit.question.loaded or fit.question.in_file:
        return ()
    rows_per_sample = sample_counts(fit.evidence.total) / np.maximum(effective, 1.0)
    noise = np.sqrt(np.maximum(rows_per_sample, 1.0)) * fit.noise
    conflicts = misfits(fit.evidence.of(fit.unknowns), noise, fit.unknowns.groups)
    # The prior of links is widened already (``Choice.link_scales``), and has its own test.
    return tuple(conflict for conflict in conflicts if conflict.cause != LINKS)


def _further_causes(
    fit: Fit,
    inverse: Array,
    causes: Mapping[str, Array],
    conflicts: Sequence[PriorConflict],
) -> Iterator[tuple[str, Array]]:
    """Yield (cause, rows A (m, k) of its covariance A^T A) of errors that the fit's priors lack.

    A prior that the data contradicts is widened until they agree. Torque scales whose common part
    was estimated may have none. Friction and rotors have the scale error of their joint, which a
    fit for a model file leaves out. A parameter at its bound counts as free: noise may
    have pushed it there.

    Args:
        fit: the fit.
        inverse: (k, k) inverse of the information of data and priors.
        causes: cause to the rows of its covariance according to the priors.
        conflicts: the priors that the data contradicts.
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
        yield HELD, _bound_errors(fit, inverse, at_bound)


def _bound_errors(fit: Fit, inverse: Array, at_bound: NDArray[np.int64]) -> Array:
    """Return the errors (m, k) of the estimate due to b parameters that are held at bounds.

    N_ee, N_eb and N_bb are the parts of the normal matrix for estimated (e) and held (b)
    parameters. A change x of the held ones moves the estimate by -C N_eb x. Its covariance would be
    the inverse of N_bb - N_be C N_eb if they were free, of which only the m directions count that
    the data determines.

    Args:
        fit: the fit, in which these parameters are held.
        inverse: C (k, k), inverse of the information of data and priors.
        at_bound: (b,) indices of the held parameters among all p.
    """
    normal = normal_matrix(fit.evidence.total, fit.weights)
    crossed = normal[np.ix_(fit.unknowns.estimated, at_bound)]
    move = inverse @ crossed
    held = normal[np.ix_(at_bound, at_bound)]
    eigenvalues, axes = np.linalg.eigh(held - crossed.T @ move)
    is_seen = eigenvalues > _SEEN * eigenvalues[-1]
    scaled_axes = axes[:, is_seen] / np.sqrt(eigenvalues[is_seen])
    return (move @ scaled_axes).T


def _scaled_friction(fit: Fit) -> Array:
    """Return the errors (joints, k) of friction and rotor inertia due to each joint's torque scale.

    The regressor column of a scale is the torque of the links alone, so that friction and rotors
    are estimated in units of the sensor: their relative error is that of the scale. The term "load"
    is a share of the links' torque and has no unit.
    """
    spread = scale_spread(fit.columns, fit.question.options, fit.question.loaded)
    names = fit.unknowns.estimated_names
    joints = fit.columns.joints
    rows = np.zeros((len(joints), len(names)))
    for column, name in enumerate(names):
        term, owner = split_name(name)
        if term in TERMS and term != "load" and owner in joints:
            row = joints.index(owner)
            value = fit.values[fit.unknowns.estimated[column]]
            rows[row, column] = spread[row] * value
    return rows


def _common_scale_change(fit: Fit) -> Array:
    """Return the root mean square change (1, k) of the estimate without a common torque scale.

    The models with and without one are weighted by their evidence (Hoeting, Madigan, Raftery,
    Volinsky, "Bayesian model averaging: a tutorial", Statistical Science 14(4), 1999, eq. 1, 2).
    They differ in the prior of the torque scales alone.
    """
    unknowns = fit.unknowns
    choice = replace(fit.choice, common_scale=0.0)
    data = fit.evidence
    plain = data.unknowns(fit.columns, fit.question, choice)
    groups = [group for group in unknowns.groups if group.cause != SCALES]
    problem = WithPriors(data.of(unknowns), 1.0 / fit.weights)
    values, evidence = problem.log_evidence([*groups, *unknowns.groups_of(SCALES)])
    plain_values, plain_evidence = problem.log_evidence(
        [*groups, *plain.groups_of(SCALES)]
    )
    log_odds = min(np.nan_to_num(evidence - plain_evidence), _SURE)
    plain_share = 1.0 / (1.0 + np.exp(log_odds))
    return np.asarray(np.sqrt(plain_share) * (values - plain_values))[None]


def _common_scale_error(fit: Fit) -> float:
    """Return the standard deviation of a relative error that all torque scales share.

    It is zero unless the fit holds the mean of all scales (cause ``COMMON``), which data does not
    determine; the error of that mean is then that of its prior.
    """
    scale_priors = fit.unknowns.groups_of(SCALES)
    if not scale_priors or not fit.unknowns.groups_of(COMMON):
        return 0.0
    (scales,) = scale_priors
    return scales.widened * common_error(np.diag(scales.factor))
