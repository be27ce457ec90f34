"""A log as a linear model with normal priors and noise, and its log marginal likelihood.

Rows are uniform in time, so that a cosine transform makes autocorrelated noise independent: its
variance is then a function of the frequency alone.

With rows A_j of joint j in units of prior standard deviations, x ~ N(0, P), P the prior
correlations, and noise of variance S_j(f) at each frequency f of the cosine transform,

    log p(tau) = -1/2 [sum_jf (r^2 / S + log 2 pi S) + x' P^-1 x + log |I + P sum_j A_j' S^-1 A_j|]

at the most likely x, with residuals r = tau - A x (MacKay, "Bayesian interpolation", Neural
Computation 4(3), 1992). A joint's noise is white plus exponentially correlated noise; its power and
mixture are the most likely ones, found by expectation maximisation with the expected squares
r^2 + diag(A L^-1 A'), where L^-1 is the posterior covariance.

This noise model, in the frequency domain, serves to compare explanations. Standard errors of an
estimate have another model of correlated noise (``estimation.algebra.uncertainty``).

Throughout, K is the number of instants (rows per joint), n that of joints, p that of parameters, k
that of estimated parameters, m that of a joint's columns or of all coefficients, e that of the
columns of explanations.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robot_sysid.diagnosis.log_prior import base_prior
from robot_sysid.diagnosis.log_rows import LogRows
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.records import Array

SHARES = (0.4, 0.75, 0.95)
"""Candidate shares of correlated noise in the noise's power; zero is a candidate as well."""
MEMORIES = (0.15, 0.5, 1.5)
"""Candidate time constants of correlated noise [s]."""
LEAST_NOISE = 0.003
"""Least standard deviation of a joint's noise, as a share of its typical torque: no model fits the
torque more exactly."""
# Rounds of expectation maximisation that begin with white noise.
_ROUNDS = 5
# Rounds of expectation maximisation that begin with the noise of a similar model.
_MORE_ROUNDS = 2
# Standard deviation of the white noise to begin with, as a share of the typical torque.
_FIRST_NOISE = 0.05


@dataclass(frozen=True)
class Posterior:
    """Posterior of the parameters of a log's model and of the explanations that were added to it.

    Attributes:
        model: the model; do not change it.
        log_evidence: log marginal likelihood [nats].
        coefficients: (m,) posterior means of the deviations from the prior's means, in units of the
            prior standard deviations: k estimated parameters, then the explanations' coefficients.
        covariance: (m, m) posterior covariance in the units of ``coefficients``.
        noise: (K, n) variance of each transformed row [N^2 m^2].
        residual: (K, n) transformed residual torque [N m].
    """

    model: LogModel
    log_evidence: float
    coefficients: Array
    covariance: Array
    noise: Array
    residual: Array

    @cached_property
    def values(self) -> Array:
        """Posterior means (p,) of all parameters; the prior mean of one that is not estimated."""
        prior = self.model.prior
        values = prior.mean.copy()
        own_coefficients = self.coefficients[: len(prior.estimated)]
        values[prior.estimated] += prior.spread * own_coefficients
        return values

    @cached_property
    def standard_errors(self) -> Array:
        """Standard errors (k,) of the estimated parameters."""
        spread = self.model.prior.spread
        return spread * np.sqrt(np.diag(self.covariance)[: len(spread)])


class LogModel:
    """The transformed equations of a log, with columns of parameters and of added explanations.

    Rows that ``log.used`` excludes are set to zero; then all go through an orthonormal cosine
    transform over time, window by window. Coefficients are deviations from the prior's means in
    units of its standard deviations. Models made from one another share arrays: do not change them.

    Args:
        log: equations of the log.
        options: prior uncertainties of the estimate.

    Attributes:
        log: equations of the log.
        prior: ``base_prior`` of the log.
        count: (n,) number of rows of each joint that are used, at least one.
        rows: per joint (K, m) transformed columns, in units of the prior's standard deviations.
        indices: per joint (m,) indices of its columns among the k estimated parameters.
        right_sides: (K, n) transformed right-hand sides minus the torque at the prior's mean [N m].
        explained: per joint (K, e) transformed columns of the explanations that were added.
    """

    def __init__(self, log: LogRows, options: EstimationOptions) -> None:
        prior = base_prior(log, options)
        self.log = log
        self.prior = prior
        self.count = np.maximum(np.sum(log.used, axis=0), 1)
        self._typical_torque = log.typical_torque
        self.indices: list[NDArray[np.int64]] = []
        self.rows: list[Array] = []
        for joint, (indices, rows) in enumerate(zip(log.indices, log.rows)):
            is_estimated = np.isin(indices, prior.estimated)
            positions = prior.positions(indices[is_estimated])
            scaled = rows[:, is_estimated] * prior.spread[positions]
            self.indices.append(positions)
            self.rows.append(self.transform(joint, scaled))
        self.right_sides = self._transform_right_sides(log)
        no_columns = np.zeros((len(log.torque), 0))
        self.explained: tuple[Array, ...] = (no_columns,) * len(self.rows)
        self._determinant = float(np.linalg.slogdet(prior.precision)[1])

    def transform(self, joint: int, rows: Array) -> Array:
        """Return rows (K, m) of the joint with index ``joint``, transformed by frequency (K, m).

        Rows that do not count (``LogRows.used``) are set to zero first; the argument is unchanged.
        """
        return self._cosine_transform(rows * self.log.used[:, joint, None])

    def _cosine_transform(self, rows: Array) -> Array:
        """Return rows (K, m) transformed by frequency (K, m), window by window."""
        from scipy.fft import dct

        windows = [rows[window] for window in self.log.windows]
        return np.concatenate([dct(w, axis=0, norm="ortho") for w in windows])

    def _transform_right_sides(self, log: LogRows) -> Array:
        """Return ``right_sides`` (K, n) for the torques of a log with the rows of this model."""
        right_sides = log.right_sides - log.torque_of(self.prior.mean)
        return self._cosine_transform(right_sides * self.log.used)

    def with_columns(self, columns: Sequence[Array]) -> LogModel:
        """Return a copy of the model with columns of an explanation added.

        Args:
            columns: per joint (K, e) transformed columns, per prior standard deviation.
        """
        wider = copy(self)
        wider.explained = tuple(map(np.hstack, zip(self.explained, columns)))
        return wider

    def with_torque_of(self, log: LogRows) -> LogModel:
        """Return a copy of the model with the torques of another log, which has the same rows."""
        other = copy(self)
        other.log = log
        other.right_sides = self._transform_right_sides(log)
        return other

    def equations(self, joint: int) -> tuple[NDArray[np.int64], Array]:
        """Return (indices (m + e,), rows (K, m + e)) of a joint's equations.

        The indices are those of the columns among all coefficients. Columns of explanations come
        last. ``joint`` is the joint's index.
        """
        size = len(self.prior.estimated)
        added = self.explained[joint]
        indices = np.append(self.indices[joint], size + np.arange(added.shape[1]))
        return indices, np.hstack((self.rows[joint], added))

    @cached_property
    def spectra(self) -> Array:
        """The s candidate noise spectra (s, K), relative to white noise of the same power.

        The first is white; then follows one for each pair of ``MEMORIES`` and ``SHARES``.
        """
        counts = [window.stop - window.start for window in self.log.windows]
        angles = [np.pi / count * np.arange(count) for count in counts]
        cosine = np.cos(np.concatenate(angles))
        period = float(np.median(np.diff(self.log.motion.time)))
        spectra = [np.ones_like(cosine)]
        for memory in MEMORIES:
            # Spectrum of a first-order autoregressive process with this time constant.
            rho = np.exp(-period / memory)
            slow = (1.0 - rho**2) / (1.0 - 2.0 * rho * cosine + rho**2)
            spectra += [1.0 - share + share * slow for share in SHARES]
        return np.array(spectra)

    def posterior(self, noise: Array | None = None) -> Posterior:
        """Return the posterior under the most likely noise, found by expectation maximisation.

        Args:
            noise: (K, n) variances at which the search begins [N^2 m^2], with few rounds; None
                begins with white noise, with more rounds.
        """
        rounds = _MORE_ROUNDS
        if noise is None:
            variance = (_FIRST_NOISE * self._typical_torque) ** 2
            noise = np.tile(variance, (len(self.right_sides), 1))
            rounds = _ROUNDS
        posterior = self.at_noise(noise)
        for _ in range(rounds):
            posterior = self.at_noise(self._likely_noise(posterior))
        return posterior

    def at_noise(self, noise: Array) -> Posterior:
        """Return the posterior under noise of given variances (K, n) [N^2 m^2]."""
        size = len(self.prior.estimated)
        total = size + self.explained[0].shape[1]
        # A' S^-1 A and A' S^-1 b of all rows A and right-hand sides b, with noise variances S.
        normal = np.zeros((total, total))
        pull = np.zeros(total)
        equations = [self.equations(joint) for joint in range(len(self.rows))]
        for joint, (indices, rows) in enumerate(equations):
            weighted = rows / noise[:, joint, None]
            normal[np.ix_(indices, indices)] += rows.T @ weighted
            pull[indices] += self.right_sides[:, joint] @ weighted
        # Log determinant of the noise. The transform mixes used rows with zeros, so the sum over
        # all frequencies is scaled by the share of rows that are used.
        used_share = self.count / len(self.right_sides)
        noise_size = float(used_share @ np.sum(np.log(2.0 * np.pi * noise), axis=0))
        prior_precision = np.eye(total)
        prior_precision[:size, :size] = self.prior.precision
        covariance, inverse_determinant = _invert(normal + prior_precision)
        mean = np.asarray(covariance @ pull)
        residual = self.right_sides.copy()
        for joint, (indices, rows) in enumerate(equations):
            residual[:, joint] -= rows @ mean[indices]
        # Computed from residuals: the difference of large sums would lose digits.
        squares = float(np.sum(residual**2 / noise) + mean @ prior_precision @ mean)
        # log |I + P A' S^-1 A|, with prior covariance P.
        occam = inverse_determinant - self._determinant
        evidence = -0.5 * (squares + occam + noise_size)
        return Posterior(self, evidence, mean, covariance, noise, residual)

    def _likely_noise(self, posterior: Posterior) -> Array:
        """Return the most likely variances (K, n) of noise given a posterior [N^2 m^2].

        Each candidate spectrum of a joint's noise gets its most likely power, at least that of
        ``LEAST_NOISE``. The spectrum under which the expected squared residuals are likeliest is
        chosen for the joint.
        """
        noise = np.empty_like(self.right_sides)
        for joint, count in enumerate(self.count):
            indices, rows = self.equations(joint)
            spread = rows @ posterior.covariance[np.ix_(indices, indices)]
            expected = posterior.residual[:, joint] ** 2 + np.sum(spread * rows, axis=1)
            # Power and log determinant (s,) of noise with each candidate spectrum.
            power = np.sum(expected / self.spectra, axis=1) / count
            power = np.maximum(power, (LEAST_NOISE * self._typical_torque[joint]) ** 2)
            used_share = count / len(expected)
            sizes = used_share * np.sum(np.log(self.spectra), axis=1)
            best = int(np.argmin(count * np.log(power) + sizes))
            noise[:, joint] = power[best] * self.spectra[best]
        return noise


def _invert(matrix: Array) -> tuple[Array, float]:
    """Return the inverse (m, m) and the log determinant of a matrix that is positive definite.

    A model with a link of 1e9 times its inertia has columns so large that rounding hides the prior,
    and makes the matrix indefinite: it then gets the nearest eigenvalues above rounding.
    """
    try:
        root = np.linalg.cholesky(matrix)
        determinant = 2.0 * float(np.sum(np.log(np.diag(root))))
        return np.asarray(np.linalg.inv(matrix), dtype=float), determinant
    except np.linalg.LinAlgError:
        scale = np.sqrt(np.diag(matrix))
        values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
        values = np.maximum(values, len(values) * float(np.finfo(float).eps))
        vectors /= scale[:, None]
        determinant = float(np.sum(np.log(values)) + 2.0 * np.sum(np.log(scale)))
        return np.asarray((vectors / values) @ vectors.T), determinant
