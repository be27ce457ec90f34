"""How likely a log is under a model with normal priors: one figure for every explanation.

With rows A_j of joint j in units of prior standard deviations, x ~ N(0, P), and noise of variance
S_j(f) at each frequency f of a cosine transform,

    log p(tau) = -1/2 [sum_jf (r^2 / S + log 2 pi S) + x' P^-1 x + log |I + P sum_j A_j' S^-1 A_j|]

at the most likely x, with residuals r = tau - A x. Noise is white plus an exponential memory; its
size and mix per joint are the most likely ones, found by expectation maximisation with the expected
squares r^2 + diag(A L^-1 A'), L the inverse posterior covariance.
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
MEMORIES = (0.15, 0.5, 1.5)
"""Parts of the noise's power that have a memory, and how long that is [s]; or none has."""
LEAST_NOISE = 0.003
"""Noise that a joint has at least, as a part of its usual torque: no model is more exact."""
# Rounds of the noise from nowhere, and from that of a nearby hypothesis.
_ROUNDS = 5
_MORE_ROUNDS = 2
_FIRST_NOISE = 0.05


@dataclass(frozen=True)
class Posterior:
    """What a hypothesis makes of a log.

    Attributes:
        log_evidence: log marginal likelihood [nats].
        values: (m,) most likely coefficients in units of their prior standard deviations, those of
            an explanation last.
        covariance: (m, m) in these units.
        noise: (K, n) variance of each transformed row [N^2 m^2].
        residual: (K, n) transformed torque that is left [N m].
    """

    log_evidence: float
    values: Array
    covariance: Array
    noise: Array
    residual: Array


class Transform:
    """Orthonormal cosine transform of each window of a log's rows; unused rows count nothing."""

    def __init__(self, log: LogRows) -> None:
        self._windows = log.windows
        self._used = log.used
        self.frequency = np.empty(len(log.torque))
        self.period = float(np.median(np.diff(log.motion.time)))
        for window in log.windows:
            count = window.stop - window.start
            self.frequency[window] = np.pi / count * np.arange(count)

    def of_joint(self, joint: int, rows: Array) -> Array:
        """Return a joint's rows (K, m) transformed."""
        from scipy.fft import dct

        used = rows * self._used[:, joint, None]
        return np.concatenate(
            [dct(used[w], axis=0, norm="ortho") for w in self._windows]
        )

    def undone(self, transformed: Array) -> Array:
        """Return the rows (K, n) of all joints of which some are the transform."""
        from scipy.fft import idct

        return np.concatenate(
            [idct(transformed[w], axis=0, norm="ortho") for w in self._windows]
        )


class Hypotheses:
    """The base model of a log, to which explanations are added.

    Attributes:
        prior: of the base model.
        transform: of rows.
        count: (n,) rows of each joint that are used.
        rows: per joint (K, k) transformed rows in units of the prior's standard deviations.
        places: per joint (k,) which parameters of the prior these are.
        right: (K, n) transformed right-hand sides beyond the prior's mean [N m].
        explained: per joint (K, e) the columns of explanations that were added.
    """

    def __init__(self, log: LogRows, prior: Prior) -> None:
        self.prior = prior
        self.transform = Transform(log)
        self.count = np.maximum(np.sum(log.used, axis=0), 1)
        self._usual = log.usual
        position = np.full(len(prior.mean), -1)
        position[prior.kept] = np.arange(len(prior.kept))
        self.places: list[NDArray[np.int64]] = []
        self.rows: list[Array] = []
        for joint, (places, rows) in enumerate(zip(log.places, log.rows)):
            at = position[places]
            scaled = rows[:, at >= 0] * prior.spread[at[at >= 0]]
            self.places.append(at[at >= 0])
            self.rows.append(self.transform.of_joint(joint, scaled))
        self.right = self._transformed_right(log)
        self.explained = tuple(np.zeros((len(self.right), 0)) for _ in self.rows)
        self.determinants = [
            np.linalg.slogdet(precision)[1] for precision in prior.precisions
        ]

    def _transformed_right(self, log: LogRows) -> Array:
        columns = []
        for joint, (places, rows) in enumerate(zip(log.places, log.rows)):
            right = log.right[:, joint] - rows @ self.prior.mean[places]
            columns.append(self.transform.of_joint(joint, right[:, None]))
        return np.hstack(columns)

    def with_columns(self, columns: Sequence[Array]) -> Hypotheses:
        """Return the same with further transformed columns (K, e) per joint in prior units."""
        wider = copy(self)
        wider.explained = tuple(map(np.hstack, zip(self.explained, columns)))
        return wider

    def with_right(self, log: LogRows) -> Hypotheses:
        """Return the same with the torques of another log that has the same rows."""
        other = copy(self)
        other.right = self._transformed_right(log)
        return other

    def equations(self, joint: int) -> tuple[NDArray[np.int64], Array]:
        """Return a joint's places (k + e,) and rows (K, k + e), explanations last."""
        size = len(self.prior.kept)
        added = self.explained[joint]
        places = np.append(self.places[joint], size + np.arange(added.shape[1]))
        return places, np.hstack((self.rows[joint], added))

    @cached_property
    def spectra(self) -> Array:
        """Spectra (m, K) of unit mean that noise may have."""
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
        """Return the posterior under the most likely noise, sought from some (K, n) on."""
        if noise is None:
            noise = np.tile((_FIRST_NOISE * self._usual) ** 2, (len(self.right), 1))
            rounds = _ROUNDS
        posterior = self.at_noise(noise)
        for _ in range(rounds):
            posterior = self.at_noise(self._likely_noise(posterior))
        return posterior

    def at_noise(self, noise: Array) -> Posterior:
        """Return the posterior under some noise (K, n)."""
        size = len(self.prior.kept)
        total = size + self.explained[0].shape[1]
        normal = np.zeros((total, total))
        pull = np.zeros(total)
        equations = [self.equations(joint) for joint in range(len(self.rows))]
        for joint, (places, rows) in enumerate(equations):
            weighted = rows / noise[:, joint, None]
            normal[np.ix_(places, places)] += rows.T @ weighted
            pull[places] += self.right[:, joint] @ weighted
        best: Posterior | None = None
        evidences: list[float] = []
        used_share = self.count / len(self.right)
        noise_size = float(used_share @ np.sum(np.log(2.0 * np.pi * noise), axis=0))
        for precision, determinant in zip(self.prior.precisions, self.determinants):
            prior_precision = np.eye(total)
            prior_precision[:size, :size] = precision
            inverse = normal + prior_precision
            root = np.linalg.cholesky(inverse)
            covariance: Array = np.asarray(np.linalg.inv(inverse), dtype=float)
            values: Array = np.asarray(covariance @ pull)
            residual = self.right.copy()
            for joint, (places, rows) in enumerate(equations):
                residual[:, joint] -= rows @ values[places]
            # Of what is left, not of differences of what is large.
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

    def gain_of_right(self, log: LogRows, posterior: Posterior) -> float:
        """Return by how much likelier other torques are than these, with the noise of these."""
        change = []
        for right in (self._transformed_right(log), self.right):
            pull = np.zeros(len(posterior.values))
            for joint in range(len(self.rows)):
                places, rows = self.equations(joint)
                pull[places] += (right[:, joint] / posterior.noise[:, joint]) @ rows
            squares = float(np.sum(right**2 / posterior.noise))
            change.append(0.5 * (float(pull @ posterior.covariance @ pull) - squares))
        return change[0] - change[1]

    def _likely_noise(self, posterior: Posterior) -> Array:
        """Return the most likely noise (K, n) beside a posterior."""
        noise = np.empty_like(self.right)
        for joint, count in enumerate(self.count):
            places, rows = self.equations(joint)
            spread = rows @ posterior.covariance[np.ix_(places, places)]
            expected = posterior.residual[:, joint] ** 2 + np.sum(spread * rows, axis=1)
            power = np.sum(expected / self.spectra, axis=1) / count
            power = np.maximum(power, (LEAST_NOISE * self._usual[joint]) ** 2)
            used_share = count / len(expected)
            sizes = used_share * np.sum(np.log(self.spectra), axis=1)
            best = int(np.argmin(count * np.log(power) + sizes))
            noise[:, joint] = power[best] * self.spectra[best]
        return noise
