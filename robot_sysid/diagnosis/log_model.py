"""A log as a linear model with normal priors and noise, and its log marginal likelihood.

Rows are those of ``estimation.columns`` around the model, with every friction term. Two more kinds
of friction have columns here, because their torque would be mistaken for other faults: friction
that builds up over some distance after a reversal, and dry friction that varies over a turn. Rows
are uniform in time, so that a cosine transform makes autocorrelated noise independent: its variance
is then a function of the frequency alone.

With rows A_j of joint j in units of prior standard deviations, x ~ N(0, P), P the prior
correlations, and noise of variance S_j(f) at each frequency f of the cosine transform,

    log p(tau) = -1/2 [sum_jf (r^2 / S + log 2 pi S) + x' P^-1 x + log |I + P sum_j A_j' S^-1 A_j|]

at the most likely x, with residuals r = tau - A x (MacKay, "Bayesian interpolation", Neural
Computation 4(3), 1992). A joint's noise is white plus exponentially correlated noise; its power and
mixture are the most likely ones, found by expectation maximisation with the expected squares
r^2 + diag(A L^-1 A'), L the inverse posterior covariance.

This noise model, in the frequency domain, serves to compare explanations. Standard errors of an
estimate have another model of correlated noise (``estimation.algebra.uncertainty``).

Throughout, K is the number of instants (rows per joint), n that of joints, p that of parameters, k
that of estimated ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import names_of
from robot_sysid.dynamics.friction import friction_model
from robot_sysid.dynamics.inverse_dynamics import TILT_NAMES, LinkDynamics
from robot_sysid.dynamics.spatial import (
    PARAMETER_NAMES,
    characteristic_length,
    parameter_scale,
)
from robot_sysid.estimation.algebra.priors import EXPECTED, NuisanceGroup
from robot_sysid.estimation.choices import WITH_ALL, neighbours
from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.dataset import Dataset
from robot_sysid.estimation.question import Choice, EstimationOptions, Question
from robot_sysid.estimation.unknowns import build_unknowns
from robot_sysid.records import DELAY_NAME, Array, Motion, RobotModel
from robot_sysid.signals.process import ProcessedSignals

WINDOW = 16.0
"""Longest window of rows that are transformed together [s]."""
LINK_SCALES = tuple(replace(EXPECTED, mass=scale) for scale in (2.0, 6.0))
"""Scales of the other links' prior over which the evidence is averaged."""
PAYLOAD = 0.3
"""Prior standard deviation of the last link's mass, as a share of the arm's mass."""
REACH = 0.15
"""Least size of the last link in its prior, as a share of the arm's reach."""
FRICTION = {
    **{"coulomb": 1.0, "viscous": 1.0, "offset": 0.3, "armature": 0.5},
    **{"sqrt": 0.05, "stribeck": 0.05, "load": 0.04},
}
"""Prior standard deviation of each friction term: its torque at the joint's typical speed and
acceleration, as a share of the typical torque; of "load" (a gear's loss), as a share of the load.
"""
BUILD_UP = (0.004, 0.02)
"""Distances after a reversal over which friction builds up [rad]."""
BUILT_UP = 0.15
"""Prior standard deviation of friction that builds up after a reversal, as a share of the typical
torque."""
UNEVEN = 0.03
"""Prior standard deviation of dry friction that varies over a turn, as a share of the typical
torque."""
WIDE_TILT = 0.15
"""Prior standard deviation of the base's tilt where the estimate is asked to find it [rad]."""
WIDE_DELAY = 0.04
"""Prior standard deviation of the delay where the estimate is asked to find it [s]."""
WORTH_A_WORD = 2.0
"""Largest prior standard deviation of the delay where the estimate is not asked to find it [ms]: a
larger delay is worth a finding."""
LEAST_TORQUE = 0.02
"""Least typical torque of a joint, as a share of the strongest joint's."""
SHARES = (0.4, 0.75, 0.95)
"""Candidate shares of correlated noise in the noise's power; zero is a candidate as well."""
MEMORIES = (0.15, 0.5, 1.5)
"""Candidate time constants of correlated noise [s]."""
LEAST_NOISE = 0.003
"""Least standard deviation of a joint's noise, as a share of its typical torque: no model is more
exact."""
# Speed below which the direction of a joint's friction is uncertain, as a share of its top speed.
_SLOW = 0.01
# Rounds of expectation maximisation that begin with white noise.
_ROUNDS = 5
# Rounds of expectation maximisation that begin with the noise of a similar model.
_MORE_ROUNDS = 2
# Standard deviation of the white noise to begin with, as a share of the typical torque.
_FIRST_NOISE = 0.05


def rms(values: Array) -> Array:
    """Return the root mean square (n,) over samples (K, n)."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))


@dataclass(frozen=True)
class LogRows:
    """Equations of all joints at K instants of a log.

    Attributes:
        columns: names and indices of the estimate's parameters.
        motion: (K, n) positions, velocities and accelerations at the instants.
        torque: (K, n) measured torque, low-passed [N m].
        indices: per joint (m,) indices of the parameters of its columns; indices from
            len(columns.names) on are those of friction that only ``Prior`` has.
        rows: per joint (K, m) torque per unit of each parameter.
        right_sides: (K, n) right-hand sides [N m].
        used: (K, n) bool, whether a row counts: the joint moves fast enough for its friction to
            have a direction, and all numbers are finite.
        windows: slices of instants without gaps, which are transformed together.
    """

    columns: Columns
    motion: Motion
    torque: Array
    indices: tuple[NDArray[np.int64], ...]
    rows: tuple[Array, ...]
    right_sides: Array
    used: NDArray[np.bool_]
    windows: tuple[slice, ...]

    @property
    def robot(self) -> RobotModel:
        """The arm."""
        return self.columns.robot

    @cached_property
    def typical_torque(self) -> Array:
        """Root mean square torque (n,), at least ``LEAST_TORQUE`` of the largest [N m]."""
        torque = rms(self.torque)
        return np.maximum(torque, LEAST_TORQUE * float(np.max(torque)))

    @cached_property
    def model_torque(self) -> Array:
        """Root mean square torque (n,) of the model's links along the log [N m]."""
        motion = self.motion
        moves = LinkDynamics(self.robot).motion(motion.q, motion.qd, motion.qdd)
        return rms(moves.torque(self.robot.thetas))

    def with_torque(self, torque: Array) -> LogRows:
        """Return the equations with the measured torques replaced by others (K, n) [N m]."""
        right_sides = self.right_sides + torque - self.torque
        return replace(self, torque=torque, right_sides=right_sides)

    def links_torque(self, values: Array) -> Array:
        """Return the torque (K, n) of all links [N m] for parameters ``values`` (p,)."""
        bodies = np.zeros_like(values)
        links = np.concatenate([*self.columns.bodies().values()])
        bodies[links] = values[links]
        return self.torque_of(bodies)

    def torque_of(self, values: Array) -> Array:
        """Return the torque (K, n) of the rows [N m] for parameters ``values`` (p,)."""
        torques = [rows @ values[at] for rows, at in zip(self.rows, self.indices)]
        return np.column_stack(torques)

    def friction_indices(self, term: str) -> NDArray[np.int64]:
        """Return the indices (n,) of one friction term of all joints, such as "coulomb"."""
        return self.columns.indices(names_of(term, self.robot.joint_names))

    def columns_of(self, names: Sequence[str]) -> Array:
        """Return the columns (K, n, e) of parameters ``names`` (e,); zero at joints without one."""
        columns = np.zeros((*self.torque.shape, len(names)))
        for k, name in enumerate(names):
            index = self.columns.index.get(name, -1)
            for joint, (indices, rows) in enumerate(zip(self.indices, self.rows)):
                columns[:, joint, k] = np.sum(rows[:, indices == index], axis=1)
        return columns


def log_rows(
    robot: RobotModel,
    signals: Sequence[ProcessedSignals],
    used: NDArray[np.bool_] | None = None,
) -> LogRows:
    """Return the equations of a log, linearised around the model.

    Args:
        robot: the arm with its model.
        signals: low-passed signals, one per piece of the log.
        used: (K, n) bool, the rows that count; None for those in which the joint moves.
    """
    datasets = [Dataset("log", piece) for piece in signals]
    columns = Columns(robot, datasets, couplings=tuple(neighbours(robot)))
    samples = columns.samples(columns.start())
    motions = [dataset.motion for dataset in datasets]
    motion = Motion(*map(np.concatenate, zip(*(vars(m).values() for m in motions))))
    speed = np.abs(motion.qd)
    if used is None:
        used = speed > _SLOW * np.max(speed, axis=0)
    torque = np.concatenate([np.stack(rows.measured, axis=1) for rows in samples])
    right_sides = np.concatenate([np.stack(rows.tau, axis=1) for rows in samples])
    used = used & np.isfinite(right_sides)

    further = np.concatenate([_further_friction(piece) for piece in signals])
    count = further.shape[2]
    indices = []
    rows = []
    for joint in range(robot.n_joints):
        estimated = np.concatenate([piece.rows[joint] for piece in samples])
        used[:, joint] &= np.all(np.isfinite(estimated), axis=1)
        rows.append(np.nan_to_num(np.hstack((estimated, further[:, joint]))))
        first = len(columns.names) + count * joint
        further_indices = np.arange(first, first + count)
        indices.append(np.append(samples[0].columns[joint], further_indices))
    return LogRows(
        columns,
        motion,
        torque,
        tuple(indices),
        tuple(rows),
        np.nan_to_num(right_sides),
        used,
        tuple(_windows([len(piece) for piece in samples], signals[0])),
    )


def _windows(counts: Sequence[int], signals: ProcessedSignals) -> list[slice]:
    """Return the slices of rows that are transformed together: pieces, or parts of long ones.

    ``counts`` are the numbers of rows of the pieces; ``signals``, of any piece, have their rate.
    """
    longest = int(WINDOW * signals.rate / signals.low_pass.step)
    windows: list[slice] = []
    start = 0
    for count in counts:
        edges = start + np.linspace(0, count, -(-count // longest) + 1).astype(int)
        windows += map(slice, edges[:-1].tolist(), edges[1:].tolist())
        start += count
    return windows


def _further_friction(signals: ProcessedSignals) -> Array:
    """Return columns (K, n, m) of friction that builds up after reversals and of uneven friction.

    The first len(BUILD_UP) columns are this friction minus dry friction, which acts at once; the
    last two are dry friction times sine and cosine of the position.
    """
    stride = signals.low_pass.stride
    q = signals.q[::stride]
    sign = np.sign(signals.qd[::stride])
    decay = np.exp(-np.abs(np.diff(q, axis=0))[..., None] / np.array(BUILD_UP))
    built = np.empty((*q.shape, len(BUILD_UP)))
    state = built[0] = np.repeat(sign[0][:, None], len(BUILD_UP), axis=1)
    for k, direction in enumerate(sign[1:, :, None]):
        state = built[k + 1] = direction + decay[k] * (state - direction)
    late = built - sign[..., None]
    uneven = sign[..., None] * np.stack((np.sin(q), np.cos(q)), axis=-1)
    low_pass = signals.low_pass.at_lower_rate(stride)
    return low_pass.decimate(np.concatenate((late, uneven), axis=-1))


@dataclass(frozen=True)
class Prior:
    """The normal prior of a log's parameters, a mixture over the widths of links' priors.

    Attributes:
        estimated: (k,) indices of the estimated parameters, ascending.
        mean: (p,) prior means, and values of the parameters that are not estimated.
        spread: (k,) prior standard deviations.
        precisions: inverse covariances (k, k) in units of ``spread``, one per scale of the links'
            prior.
    """

    estimated: NDArray[np.int64]
    mean: Array
    spread: Array
    precisions: tuple[Array, ...]

    def positions(self, indices: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the positions (m,) in ``estimated`` of parameters with given indices (m,)."""
        return np.searchsorted(self.estimated, indices)


def base_prior(log: LogRows, options: EstimationOptions) -> Prior:
    """Return the prior of a log without faults: that of the estimate, with wider friction.

    ``options`` holds the prior uncertainties of the estimate.
    """
    columns = log.columns
    spread = _plain_spread(log)
    mean = np.zeros(len(spread))
    mean[: len(columns.names)] = columns.model_values
    # Faults of a log do not depend on the stated uncertainty of the links; a delay that the
    # estimate would allow for is reported all the same.
    links = max(options.link_uncertainty, EstimationOptions().link_uncertainty)
    late = min(options.delay_uncertainty, WORTH_A_WORD)
    options = replace(options, link_uncertainty=links, delay_uncertainty=late)
    friction = (friction_model(WITH_ALL),) * log.robot.n_joints
    nonzero = np.ones(len(columns.names), dtype=bool)
    mixture: list[tuple[NuisanceGroup, ...]] = []
    for link_scales in LINK_SCALES:
        choice = Choice(friction, link_scales=link_scales)
        unknowns = build_unknowns(
            columns, Question(options), choice, log.typical_torque, nonzero
        )
        mixture.append(unknowns.groups)
        for group in unknowns.groups:
            at = columns.indices(group.names)
            mean[at] = group.mean
            sizes = np.sqrt(np.sum(group.factor**2, axis=1))
            spread[at] = np.maximum(spread[at], sizes)
    wide = {**dict.fromkeys(TILT_NAMES, WIDE_TILT), DELAY_NAME: WIDE_DELAY}
    for name in set(wide) & set(unknowns.increments):
        spread[columns.index[name]] = wide[name]

    estimated = np.flatnonzero(spread)
    precisions = []
    for groups in mixture:
        precision = np.eye(len(estimated))
        for group in groups:
            indices = columns.indices(group.names)
            at = np.searchsorted(estimated, indices)
            scaled = group.factor / spread[indices, None]
            precision[np.ix_(at, at)] = np.linalg.inv(scaled @ scaled.T)
        precisions.append(precision)
    return Prior(estimated, mean, spread[estimated], tuple(precisions))


def _plain_spread(log: LogRows) -> Array:
    """Return the prior standard deviations (p,) of the last link, which may carry any tool, and of
    friction; zero for all other parameters.
    """
    robot = log.robot
    link = robot.prior
    own_size = characteristic_length(link.theta) if link.mass > 0.0 else 0.0
    distance = float(np.linalg.norm(link.com))
    size = max(REACH * robot.length, own_size, distance)
    shares = np.array([BUILT_UP] * len(BUILD_UP) + [UNEVEN] * 2)
    further = np.outer(log.typical_torque, shares).ravel()
    spread = np.append(np.zeros(len(log.columns.names)), further)
    spread[: len(PARAMETER_NAMES)] = parameter_scale(PAYLOAD * robot.mass, size)
    speed = np.maximum(rms(log.motion.qd), 1e-9)
    units = {
        "viscous": speed,
        "armature": np.maximum(rms(log.motion.qdd), 1e-9),
        "sqrt": np.sqrt(speed),
        "load": log.typical_torque,
    }
    for term, share in FRICTION.items():
        sizes = share * log.typical_torque / units.get(term, np.ones_like(speed))
        spread[log.friction_indices(term)] = sizes
    return spread


@dataclass(frozen=True)
class Posterior:
    """Posterior of a log's model.

    Attributes:
        model: the model; do not change it.
        log_evidence: log marginal likelihood [nats].
        coefficients: (m,) posterior means in units of the prior standard deviations, those of
            explanations last.
        covariance: (m, m) posterior covariance in these units.
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
        """Posterior means (p,) of the parameters; those that are not estimated as in the prior."""
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
    """The transformed equations of a log: of its parameters and of explanations added to them.

    Rows go through an orthonormal cosine transform over time, window by window, after those that
    ``log.used`` excludes are set to zero. Coefficients are deviations from the prior's means in
    units of its standard deviations. Copies share arrays: do not change them.

    Args:
        log: equations of the log.
        options: prior uncertainties of the estimate.

    Attributes:
        log: equations of the log.
        prior: ``base_prior`` of the log.
        count: (n,) number of rows of each joint that are used, at least one.
        rows: per joint (K, m) transformed columns, in units of the prior's standard deviations.
        indices: per joint (m,) indices of its columns among the prior's estimated parameters.
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
        self.explained = tuple(np.zeros((len(log.torque), 0)) for _ in self.rows)
        self._determinants = np.linalg.slogdet(np.array(prior.precisions))[1]

    def transform(self, joint: int, rows: Array) -> Array:
        """Return the transform (K, m) of rows (K, m) of the joint with the index ``joint``."""
        from scipy.fft import dct

        return self._by_window(dct, rows * self.log.used[:, joint, None])

    def inverse_transform(self, transformed: Array) -> Array:
        """Return the rows (K, n) of all joints from their transform (K, n)."""
        from scipy.fft import idct

        return self._by_window(idct, transformed)

    def _by_window(self, function: Callable[..., Array], rows: Array) -> Array:
        """Return a function's values (K, m) for the rows (K, m) of one window after another."""
        windows = [rows[window] for window in self.log.windows]
        return np.concatenate([function(w, axis=0, norm="ortho") for w in windows])

    def _transform_right_sides(self, log: LogRows) -> Array:
        """Return ``right_sides`` (K, n) for the torques of a log with these rows."""
        right_sides = log.right_sides - log.torque_of(self.prior.mean)
        joints = range(len(self.rows))
        return np.hstack([self.transform(j, right_sides[:, [j]]) for j in joints])

    def with_columns(self, columns: Sequence[Array]) -> LogModel:
        """Return a copy with further transformed columns, per joint (K, e), in prior units."""
        wider = copy(self)
        wider.explained = tuple(map(np.hstack, zip(self.explained, columns)))
        return wider

    def with_torque_of(self, log: LogRows) -> LogModel:
        """Return a copy with the torques of another log that has the same rows."""
        other = copy(self)
        other.log = log
        other.right_sides = self._transform_right_sides(log)
        return other

    def equations(self, joint: int) -> tuple[NDArray[np.int64], Array]:
        """Return (indices (m + e,), rows (K, m + e)) of a joint, those of explanations last.

        The indices are those of the columns among all coefficients.
        """
        size = len(self.prior.estimated)
        added = self.explained[joint]
        indices = np.append(self.indices[joint], size + np.arange(added.shape[1]))
        return indices, np.hstack((self.rows[joint], added))

    @cached_property
    def spectra(self) -> Array:
        """Candidate spectra (s, K) of noise, of unit mean: white, then each pair of memory and
        share of correlated noise.
        """
        counts = [window.stop - window.start for window in self.log.windows]
        radians_per_row = [np.pi / count * np.arange(count) for count in counts]
        cosine = np.cos(np.concatenate(radians_per_row))
        period = float(np.median(np.diff(self.log.motion.time)))
        spectra = [np.ones_like(cosine)]
        for memory in MEMORIES:
            rho = np.exp(-period / memory)
            slow = (1.0 - rho**2) / (1.0 - 2.0 * rho * cosine + rho**2)
            spectra += [1.0 - share + share * slow for share in SHARES]
        return np.array(spectra)

    def posterior(self, noise: Array | None = None) -> Posterior:
        """Return the posterior under the most likely noise.

        ``noise`` (K, n) are the variances at which the search begins [N^2 m^2]; None for white
        noise.
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
        posteriors = []
        used_share = self.count / len(self.right_sides)
        noise_size = float(used_share @ np.sum(np.log(2.0 * np.pi * noise), axis=0))
        for precision, determinant in zip(self.prior.precisions, self._determinants):
            prior_precision = np.eye(total)
            prior_precision[:size, :size] = precision
            inverse = normal + prior_precision
            root = np.linalg.cholesky(inverse)
            covariance = np.asarray(np.linalg.inv(inverse), dtype=float)
            mean = np.asarray(covariance @ pull)
            residual = self.right_sides.copy()
            for joint, (indices, rows) in enumerate(equations):
                residual[:, joint] -= rows @ mean[indices]
            # Computed from residuals: the difference of large sums would lose digits.
            squares = float(np.sum(residual**2 / noise) + mean @ prior_precision @ mean)
            shrinking = 2.0 * float(np.sum(np.log(np.diag(root)))) - determinant
            evidence = float(-0.5 * (squares + shrinking + noise_size))
            posteriors.append(
                Posterior(self, evidence, mean, covariance, noise, residual)
            )
        evidences = [posterior.log_evidence for posterior in posteriors]
        average = np.logaddexp.reduce(evidences) - np.log(len(evidences))
        best = posteriors[int(np.argmax(evidences))]
        return replace(best, log_evidence=float(average))

    def gain_of_torque(self, log: LogRows, posterior: Posterior) -> float:
        """Return the gain in log likelihood [nats] if the torques are replaced by another log's.

        Noise and covariance stay those of the posterior of the present torques.

        Args:
            log: the other log, which has the same rows.
            posterior: posterior of the present torques.
        """
        log_likelihoods = []
        for right_sides in (self._transform_right_sides(log), self.right_sides):
            weighted = right_sides / posterior.noise
            pull = np.zeros(len(posterior.coefficients))
            for joint in range(len(self.rows)):
                indices, rows = self.equations(joint)
                pull[indices] += weighted[:, joint] @ rows
            squares = float(np.sum(right_sides**2 / posterior.noise))
            explained = float(pull @ posterior.covariance @ pull)
            log_likelihoods.append(0.5 * (explained - squares))
        return log_likelihoods[0] - log_likelihoods[1]

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
