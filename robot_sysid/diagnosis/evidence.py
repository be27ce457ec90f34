"""Log marginal likelihood of a log under a linear model with normal priors and noise.

With rows A_j of joint j in units of prior standard deviations, x ~ N(0, P), P the prior
correlations, and noise of variance S_j(f) at each frequency f of a cosine transform over time,

    log p(tau) = -1/2 [sum_jf (r^2 / S + log 2 pi S) + x' P^-1 x + log |I + P sum_j A_j' S^-1 A_j|]

at the most likely x, with residuals r = tau - A x. A joint's noise is white plus exponentially
correlated noise; its power and mixture are the most likely ones, found by expectation maximisation
with the expected squares r^2 + diag(A L^-1 A'), L the inverse posterior covariance.

This noise model, in the frequency domain, serves to compare explanations. Standard errors of an
estimate have another model of correlated noise (``estimation.algebra.uncertainty``).
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robot_sysid.diagnosis.rows import LogRows, Prior
from robot_sysid.records import Array

SHARES = (0.4, 0.75, 0.95)
"""Candidate shares of correlated noise in the noise's power; zero is a candidate as well."""
MEMORIES = (0.15, 0.5, 1.5)
"""Candidate time constants of correlated noise [s]."""
LEAST_NOISE = 0.003
"""Least standard deviation of a joint's noise, as a share of its typical torque: no model is more
exact."""
# Rounds of expectation maximisation that begin with white noise.
_ROUNDS = 5
# Rounds of expectation maximisation that begin with the noise of a similar hypothesis.
_MORE_ROUNDS = 2
# Standard deviation of the white noise to begin with, as a share of the typical torque.
_FIRST_NOISE = 0.05


@dataclass(frozen=True)
class Posterior:
    """Posterior of a hypothesis about a log.

    Attributes:
        log_evidence: log marginal likelihood [nats].
        values: (m,) posterior means in units of the prior standard deviations, coefficients of
            explanations last.
        covariance: (m, m) posterior covariance in these units.
        noise: (K, n) variance of each transformed row [N^2 m^2].
        residual: (K, n) transformed residual torque [N m].
    """

    log_evidence: float
    values: Array
    covariance: Array
    noise: Array
    residual: Array


class Transform:
    """Orthonormal cosine transform over time of each window of a log's K rows.

    Rows that ``log.used`` excludes are set to zero before.

    Attributes:
        frequency: (K,) angular frequency of each transformed row [rad per row].
        period: time between rows [s].
    """

    def __init__(self, log: LogRows) -> None:
        self._windows = log.windows
        self._used = log.used
        self.frequency = np.empty(len(log.torque))
        self.period = float(np.median(np.diff(log.motion.time)))
        for window in log.windows:
            count = window.stop - window.start
            self.frequency[window] = np.pi / count * np.arange(count)

    def of_joint(self, joint: int, rows: Array) -> Array:
        """Return the transform (K, m) of rows (K, m) of the joint with the index ``joint``."""
        from scipy.fft import dct

        used = rows * self._used[:, joint, None]
        return np.concatenate(
            [dct(used[w], axis=0, norm="ortho") for w in self._windows]
        )

    def inverse(self, transformed: Array) -> Array:
        """Return the rows (K, n) of all joints from their transform (K, n)."""
        from scipy.fft import idct

        return np.concatenate(
            [idct(transformed[w], axis=0, norm="ortho") for w in self._windows]
        )


class Hypotheses:
    """The transformed equations of a log: of its base model and of explanations added to it.

    Coefficients are deviations from the prior's means in units of its standard deviations. Copies
    share arrays: do not change them.

    Attributes:
        prior: prior of the base model.
        transform: cosine transform of the log's rows.
        count: (n,) number of rows of each joint that are used, at least one.
        rows: per joint (K, k) transformed columns, in units of the prior's standard deviations.
        indices: per joint (k,) indices of its columns among the prior's estimated parameters.
        right_sides: (K, n) transformed right-hand sides minus the torque at the prior's mean [N m].
        explained: per joint (K, e) transformed columns of the explanations that were added.
        determinants: log determinant of each of the prior's precisions.
    """

    def __init__(self, log: LogRows, prior: Prior) -> None:
        self.prior = prior
        self.transform = Transform(log)
        self.count = np.maximum(np.sum(log.used, axis=0), 1)
        self._typical_torque = log.typical_torque
        position = np.full(len(prior.mean), -1)
        position[prior.estimated] = np.arange(len(prior.estimated))
        self.indices: list[NDArray[np.int64]] = []
        self.rows: list[Array] = []
        for joint, (indices, rows) in enumerate(zip(log.indices, log.rows)):
            positions = position[indices]
            scaled = rows[:, positions >= 0] * prior.spread[positions[positions >= 0]]
            self.indices.append(positions[positions >= 0])
            self.rows.append(self.transform.of_joint(joint, scaled))
        self.right_sides = self._transform_right_sides(log)
        self.explained = tuple(np.zeros((len(self.right_sides), 0)) for _ in self.rows)
        self.determinants = [
            np.linalg.slogdet(precision)[1] for precision in prior.precisions
        ]

    def _transform_right_sides(self, log: LogRows) -> Array:
        """Return ``right_sides`` (K, n) for the torques of a log with these rows."""
        columns = []
        for joint, (indices, rows) in enumerate(zip(log.indices, log.rows)):
            right_side = log.right_sides[:, joint] - rows @ self.prior.mean[indices]
            columns.append(self.transform.of_joint(joint, right_side[:, None]))
        return np.hstack(columns)

    def with_columns(self, columns: Sequence[Array]) -> Hypotheses:
        """Return a copy with further transformed columns, per joint (K, e), in prior units."""
        wider = copy(self)
        wider.explained = tuple(map(np.hstack, zip(self.explained, columns)))
        return wider

    def with_torque_of(self, log: LogRows) -> Hypotheses:
        """Return a copy with the torques of another log that has the same rows."""
        other = copy(self)
        other.right_sides = self._transform_right_sides(log)
        return other

    def equations(self, joint: int) -> tuple[NDArray[np.int64], Array]:
        """Return (indices (k + e,), rows (K, k + e)) of a joint, those of explanations last.

        The indices are those of the columns among all coefficients.
        """
        size = len(self.prior.estimated)
        added = self.explained[joint]
        indices = np.append(self.indices[joint], size + np.arange(added.shape[1]))
        return indices, np.hstack((self.rows[joint], added))

    @cached_property
    def spectra(self) -> Array:
        """Candidate spectra (m, K) of noise, of unit mean: white, then each pair of memory and
        share of correlated noise.
        """
        cosine = np.cos(self.transform.frequency)
        spectra = [np.ones_like(cosine)]
        for memory in MEMORIES:
            rho = np.exp(-self.transform.period / memory)
            slow = (1.0 - rho**2) / (1.0 - 2.0 * rho * cosine + rho**2)
            spectra += [1.0 - share + share * slow for share in SHARES]
        return np.array(spectra)

    def posterior(
        self, noise: Array | None = None, rounds: int = _MORE_ROUNDS
    ) -> Posterior:
        """Return the posterior under the most likely noise.

        Args:
            noise: (K, n) variances at which the search begins [N^2 m^2]; None for white noise.
            rounds: rounds of expectation maximisation; ``_ROUNDS`` where ``noise`` is None.
        """
        if noise is None:
            noise = np.tile(
                (_FIRST_NOISE * self._typical_torque) ** 2, (len(self.right_sides), 1)
            )
            rounds = _ROUNDS
        posterior = self.at_noise(noise)
        for _ in range(rounds):
            posterior = self.at_noise(self._likely_noise(posterior))
        return posterior

    def at_noise(self, noise: Array) -> Posterior:
        """Return the posterior under noise of given variances (K, n) [N^2 m^2].

        Its log evidence is averaged over the prior's precisions; all else is of the likeliest one.
        """
        size = len(self.prior.estimated)
        total = size + self.explained[0].shape[1]
        normal = np.zeros((total, total))
        pull = np.zeros(total)
        equations = [self.equations(joint) for joint in range(len(self.rows))]
        for joint, (indices, rows) in enumerate(equations):
            weighted = rows / noise[:, joint, None]
            normal[np.ix_(indices, indices)] += rows.T @ weighted
            pull[indices] += self.right_sides[:, joint] @ weighted
        best: Posterior | None = None
        evidences: list[float] = []
        used_share = self.count / len(self.right_sides)
        noise_size = float(used_share @ np.sum(np.log(2.0 * np.pi * noise), axis=0))
        for precision, determinant in zip(self.prior.precisions, self.determinants):
            prior_precision = np.eye(total)
            prior_precision[:size, :size] = precision
            inverse = normal + prior_precision
            root = np.linalg.cholesky(inverse)
            covariance: Array = np.asarray(np.linalg.inv(inverse), dtype=float)
            values: Array = np.asarray(covariance @ pull)
            residual = self.right_sides.copy()
            for joint, (indices, rows) in enumerate(equations):
                residual[:, joint] -= rows @ values[indices]
            # Computed from residuals: the difference of large sums would lose digits.
            squares = float(
                np.sum(residual**2 / noise) + values @ prior_precision @ values
            )
            shrinking = 2.0 * float(np.sum(np.log(np.diag(root)))) - determinant
            evidence = -0.5 * (squares + shrinking + noise_size)
            if best is None or evidence > max(evidences):
                best = Posterior(evidence, values, covariance, noise, residual)
            evidences.append(evidence)
        assert best is not None
        mean = float(np.logaddexp.reduce(evidences)) - float(np.log(len(evidences)))
        return replace(best, log_evidence=mean)

    def gain_of_torque(self, log: LogRows, posterior: Posterior) -> float:
        """Return the gain in log likelihood [nats] if the torques are replaced by another log's.

        Noise and covariance stay those of the posterior of the present torques.

        Args:
            log: the other log, which has the same rows.
            posterior: posterior of the present torques.
        """
        change = []
        for right_sides in (self._transform_right_sides(log), self.right_sides):
            pull = np.zeros(len(posterior.values))
            for joint in range(len(self.rows)):
                indices, rows = self.equations(joint)
                pull[indices] += (
                    right_sides[:, joint] / posterior.noise[:, joint]
                ) @ rows
            squares = float(np.sum(right_sides**2 / posterior.noise))
            change.append(0.5 * (float(pull @ posterior.covariance @ pull) - squares))
        return change[0] - change[1]

    def _likely_noise(self, posterior: Posterior) -> Array:
        """Return the most likely noise (K, n) given a posterior of the coefficients [N^2 m^2]."""
        noise = np.empty_like(self.right_sides)
        for joint, count in enumerate(self.count):
            indices, rows = self.equations(joint)
            spread = rows @ posterior.covariance[np.ix_(indices, indices)]
            expected = posterior.residual[:, joint] ** 2 + np.sum(spread * rows, axis=1)
            power = np.sum(expected / self.spectra, axis=1) / count
            power = np.maximum(power, (LEAST_NOISE * self._typical_torque[joint]) ** 2)
            used_share = count / len(expected)
            sizes = used_share * np.sum(np.log(self.spectra), axis=1)
            best = int(np.argmin(count * np.log(power) + sizes))
            noise[:, joint] = power[best] * self.spectra[best]
        return noise
