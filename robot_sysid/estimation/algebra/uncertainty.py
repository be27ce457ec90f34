"""Errors of an estimate: covariance and standard errors, with torque noise correlated in time.

The estimate is x = C (Y^T W tau + P d0) with C = (Y^T W Y + P)^-1, W the squared weights w_j^2 of
joint j's rows, P the prior precision of the nuisances (``priors``), so that its covariance is

    C (sum_j w_j^4 Omega_j + P) C,

Omega_j the covariance of joint j's score Y_j^T e_j: sigma_j^2 Y_j^T Y_j for white noise. For noise
that is correlated in time this is a sandwich covariance (Newey, West, "A simple, positive
semi-definite, heteroskedasticity and autocorrelation consistent covariance matrix", Econometrica
55(3), 1987). The sum splits by cause: C P_c C is the contribution of the nuisances of cause c.
Directions that neither data nor P identify have zero covariance and infinite standard errors.

There are two models of the autocorrelation of noise, for two purposes. ``autocorrelation_time`` is
one number per joint, by which rows are weighted while choices are compared. Standard errors need
more, because the effect of slow noise depends on how fast a column of Y varies: fast columns
average it out. For them, residuals of a joint are described by a sum of decaying exponentials,

    gamma(l) = c_0 [l = 0] + sum_i c_i exp(-|l| / T_i),   c >= 0,  T_i = 1, 2, 4, ... samples,

fitted to their autocovariance (``JointResiduals.fit``). The variance of the score is then
sum_i c_i Q_i with

    Q_i = sum_(t, s) y_t exp(-|t - s| / T_i) y_s^T,

which first-order recursive filters collect in one pass; white noise gives sigma^2 Y^T Y.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.estimation.algebra.identifiability import VisibleSpace, triangle_space
from robot_sysid.estimation.algebra.least_squares import (
    sample_counts,
    stretches,
    update_triangle,
)
from robot_sysid.records import Array, SampleSource, SquareRootInformation

# Rounds of noise and errors: a fourth changes errors by less than 0.2 %, the third by 0.8 %.
_ROUNDS = 3
# Rows per parameter that are factorised together: the previous triangle adds little cost then.
_AT_ONCE = 2


@dataclass(frozen=True)
class Uncertainty:
    """Errors of an estimate of p parameters.

    Attributes:
        covariance: (p, p) of the errors by all causes.
        noise: (p, p) covariance of the errors by torque noise alone.
        standard_errors: (p,) infinite for parameters that are not identifiable.
        data_share: (p,) share of each parameter's squared scaled axis in identified directions.
        inverse: (p, p) C, the inverse of the normal matrix of data and prior.
        effective: (joints,) equivalent number of independent samples of each joint.
    """

    covariance: Array
    noise: Array
    standard_errors: Array
    data_share: Array
    inverse: Array
    effective: tuple[float, ...]

    def with_cause(self, covariance: Array) -> Uncertainty:
        """Return the errors with those of one more, independent cause, of covariance (p, p)."""
        further = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        errors = np.hypot(self.standard_errors, further)
        total = self.covariance + covariance
        return replace(self, covariance=total, standard_errors=errors)


def uncertainty(
    information: SquareRootInformation,
    weights: Array,
    noise: Array,
    residuals: Sequence[JointResiduals] = (),
    space: VisibleSpace | None = None,
) -> Uncertainty:
    """Return the errors of an estimate of p parameters.

    Args:
        information: equations of all joints, and the prior.
        weights: (joints,) of each joint's equations in the estimate [1/(N m)].
        noise: (joints,) standard deviation of white noise [N m]; counts only without residuals.
        residuals: sums of each joint's residuals, for noise that is correlated in time.
        space: ``joint_space`` of these equations; None to compute it.
    """
    space = space or joint_space(information, weights)
    inverse = space.inverse()
    size = len(information.names)
    if residuals:
        columns = [joint.columns for joint in residuals]
        weighted = zip(residuals, weights)
        alone = [_alone(joint, weight, inverse) for joint, weight in weighted]
        # Residuals contain errors that other joints' noise causes: kernels and errors are iterated.
        score = np.zeros((size, size))
        for _ in range(_ROUNDS):
            kernels = list(_kernels(residuals, alone, inverse @ score @ inverse))
            omegas = map(JointResiduals.score, residuals, kernels)
            score = _score(columns, omegas, weights, size)
        effective = list(map(JointResiduals.effective_samples, residuals, kernels))
    else:
        effective = sample_counts(information).tolist()
        columns = [joint.columns for joint in information.joints]
        score = _score(columns, _white_omegas(information, noise), weights, size)
    of_noise = inverse @ score @ inverse
    prior = information.prior
    of_prior = np.zeros((0, size)) if prior is None else prior[:, :-1] @ inverse
    covariance = of_noise + of_prior.T @ of_prior
    covariance = 0.5 * (covariance + covariance.T)
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    errors = np.where(space.is_identified, errors, np.inf)
    # The squared part of each parameter's unit vector that lies in the visible directions.
    share = np.clip(1.0 - np.sum(space.null**2, axis=1), 0.0, 1.0)
    return Uncertainty(covariance, of_noise, errors, share, inverse, tuple(effective))


def joint_space(information: SquareRootInformation, weights: Array) -> VisibleSpace:
    """Return the space that data and prior identify, by weights (joints,); its inverse() is C."""
    return triangle_space(whole_triangle(information, weights)[:, :-1])


def whole_triangle(information: SquareRootInformation, weights: Array) -> Array:
    """Return the triangle (p + 1, p + 1) of all equations [A b], by weights (joints,) [1/(N m)]."""
    # Last joints first: their rows have the columns of few links, so that triangles stay small.
    backwards = replace(information, joints=information.joints[::-1])
    return triangle_of(backwards.equation_blocks(weights[::-1]))


def triangle_of(blocks: Iterable[Array]) -> Array:
    """Return the QR triangle (k, k) of the rows of all blocks (m, k), one block at least."""
    # In batches: the rows of all joints together may exceed the memory. A batch becomes a triangle
    # of its columns that are not zero, which is the first block of the next batch.
    waiting: list[Array] = []
    for block in blocks:
        waiting.append(block)
        if sum(map(len, waiting)) > _AT_ONCE * block.shape[1]:
            rows = np.vstack(waiting)
            is_used = np.any(rows != 0.0, axis=0)
            waiting = []  # frees the blocks
            rows = rows[:, is_used]
            triangle = update_triangle(rows[:0], rows)
            waiting = [np.zeros((len(triangle), len(is_used)))]
            waiting[0][:, is_used] = triangle
    return update_triangle(waiting[0][:0], np.vstack(waiting))


def _white_omegas(information: SquareRootInformation, noise: Array) -> Iterator[Array]:
    """Yield joint by joint sigma^2 Y^T Y (k, k), with noise (joints,) the sigmas [N m]."""
    for joint, sigma in zip(information.joints, noise):
        yield sigma**2 * joint.triangle[:, :-1].T @ joint.triangle[:, :-1]


def _score(
    columns: Sequence[NDArray[np.int64]],
    omegas: Iterable[Array],
    weights: Array,
    size: int,
) -> Array:
    """Return sum_j w_j^4 Omega_j (p, p), p = ``size``.

    ``columns`` are per joint the (k,) indices of its parameters, ``omegas`` the (k, k) Omega_j.
    """
    score = np.zeros((size, size))
    for at, omega, weight in zip(columns, omegas, weights):
        for source, target in stretches(at):
            score[target] += weight**4 * omega[source]
    return score


def _alone(
    joint: JointResiduals, weight: float, inverse: Array
) -> tuple[Array, Array, float]:
    """Return (absorbed share (1 + m,), kernel coefficients c (1 + m,), energy) of a single joint.

    c are fitted as if the noise of other joints had no effect on this joint's residuals. The energy
    is that of the torque errors that the joint's own noise causes [N^2 m^2]. ``weight`` is that of
    the joint's equations [1/(N m)], ``inverse`` C (p, p), the inverse of the normal matrix.
    """
    hat = weight**2 * inverse[np.ix_(joint.columns, joint.columns)]
    absorbed = joint.absorbed_share(hat)
    kernels = joint.fit(absorbed, leaked=0.0)
    errors = hat @ np.tensordot(kernels, joint.sums, axes=1) @ hat
    return absorbed, kernels, float(np.vdot(errors, joint.sums[0]))


def _kernels(
    residuals: Sequence[JointResiduals],
    alone: Sequence[tuple[Array, Array, float]],
    spread: Array,
) -> Iterator[Array]:
    """Yield each joint's kernel coefficients (1 + m,), with the effect of other joints' noise.

    Args:
        residuals: per joint its sums over lags and kernels.
        alone: per joint (absorbed share, kernel coefficients, energy) of ``_alone``.
        spread: (p, p) covariance of the estimate's errors by noise, of the previous round.
    """
    for joint, (absorbed, kernels, energy) in zip(residuals, alone):
        total_energy = joint.energy(spread[np.ix_(joint.columns, joint.columns)])
        leaked = (total_energy - energy) / max(joint.count, 1)
        yield joint.fit(absorbed, leaked) if leaked > 0.0 else kernels


CHANCE = 2.0
"""Standard errors up to which an autocorrelation counts as zero."""
# Number of stretches of time that ``concentration`` compares.
_STRETCHES = 25
# Number of channels that are transformed at a time: a compromise between memory and calls.
_CHANNELS = 4
# Largest lag [samples]: limits the cost.
_MAX_LAG = 2000
# Number of bins over the lags: limits the cost.
_LAG_BINS = 60
# Largest gradient at a minimum, as a share of that at zero: rounding of squared equations.
_FLAT = 1e-9
# Number of rows that one matrix product filters: chosen for speed.
_CHUNK = 32
# Largest absorbed share: the noise is the residual divided by one minus this share.
_MOST_ABSORBED = 0.8


@dataclass(frozen=True)
class JointResiduals:
    """Sums over time lags and over kernels exp(-|l| / T_i), from one pass over a joint's samples.

    Y (n, k) are the joint's rows and r (n,) its residuals [N m]; m is the number of kernels.

    Attributes:
        columns: (k,) indices of the parameters of this joint's equations.
        count: number of samples n.
        decay: (m,) exp(-1 / T_i).
        sums: (1 + m, k, k) the Q_i, the first is Y^T Y.
        lags: (v,) lags l = 0, 1, 2, ... [samples].
        products: (v,) mean of r_t r_(t+l) over t [N^2 m^2].
        hats: (v,) mean of H_(t,t+l) over t, H the hat matrix from this joint's torque to its fit.
    """

    columns: NDArray[np.int64]
    count: int
    decay: Array
    sums: Array
    lags: NDArray[np.int64]
    products: Array
    hats: Array

    def energy(self, spread: Array) -> float:
        """Return tr(Y C Y^T), the torque energy of errors of covariance C (k, k) [N^2 m^2]."""
        return float(np.vdot(spread, self.sums[0]))

    def score(self, kernels: Array) -> Array:
        """Return sum_i c_i Q_i (k, k), the score's covariance; ``kernels`` (1 + m,) are the c_i."""
        return np.asarray(np.tensordot(kernels, self.sums, axes=1))

    def absorbed_share(self, hat: Array) -> Array:
        """Return the share (1 + m,) of each kernel's noise energy that is missing in residuals.

        With H = Y hat Y^T, residuals of noise V have the energy tr V - 2 tr H V + tr H V H.

        Args:
            hat: w^2 C (k, k), w the joint's weight, C the inverse normal matrix.
        """
        once = np.tensordot(self.sums, hat, axes=2)
        twice = np.tensordot(self.sums, hat @ self.sums[0] @ hat, axes=2)
        lost = 2.0 * once - twice
        return np.clip(lost / max(self.count, 1), 0.0, _MOST_ABSORBED)

    def fit(self, absorbed: Array, leaked: float) -> Array:
        """Return kernel coefficients c >= 0 (1 + m,) [N^2 m^2], white noise first.

        The estimate absorbs slow noise, which changes the residuals' autocovariance in the shape of
        ``hats``; this is subtracted from the expected shape of each kernel.

        Args:
            absorbed: (1 + m,) ``absorbed_share``.
            leaked: mean square of the errors due to the noise of other joints [N^2 m^2].
        """
        energy = float(self.products[0])
        if energy <= 0.0:
            return np.zeros(1 + len(self.decay))
        count = len(self.lags)
        # (v,) autocovariance of the torque errors of the estimate, relative to that of lag 0.
        shape = self.hats / self.hats[0] if self.hats[0] > 0.0 else np.zeros(count)
        # At most half of the energy counts as leaked, so that some noise remains to be fitted.
        products = self.products - min(leaked, 0.5 * energy) * shape
        kernels = np.ones((count, 1 + len(self.decay)))
        kernels[1:, 0] = 0.0
        kernels[:, 1:] = self.decay ** self.lags[:, None]
        shapes = kernels - np.outer(shape, absorbed)
        # The first lag of each bin; bins widen in proportion to the lag.
        edges = np.floor(np.geomspace(1.0, max(count - 1, 1), _LAG_BINS)).astype(int)
        bins = np.unique(np.clip(np.append(0, edges), 0, count - 1))
        binned_products = _sum_bins(products / energy, bins)
        shares = _simplest_fit(_sum_bins(shapes, bins), binned_products, self.count)
        # The fitted autocovariance at lag 0 is the measured one.
        return shares * products[0] / float(shares @ shapes[0])

    def effective_samples(self, kernels: Array) -> float:
        """Return the equivalent number of independent samples, n gamma(0) / sum_l gamma(l).

        The sum is over all lags l, positive and negative: (1 + a) / (1 - a) of a kernel a^|l|.
        ``kernels`` are its coefficients c (1 + m,).
        """
        summed = np.append(1.0, (1.0 + self.decay) / (1.0 - self.decay))
        spread = float(kernels @ summed)
        if spread <= 0.0:
            return float(self.count)
        return self.count * float(np.sum(kernels)) / spread


def collect_residuals(
    information: SquareRootInformation,
    samples: SampleSource,
    values: Array,
    root: Array,
    weights: Array,
) -> list[JointResiduals]:
    """Return each joint's residuals in sums over time lags and kernels, by one pass over samples.

    Args:
        information: equations of all joints.
        samples: rows and torque of each joint.
        values: (p,) the estimate.
        root: (p, r) with root root^T = C, the inverse of the normal matrix.
        weights: (joints,) of each joint's equations [1/(N m)].
    """
    residuals = []
    for index, rows, tau in samples:
        columns = information.joints[index].columns
        residual = tau - rows @ values[columns]
        scaled = weights[index] * root[columns]
        residuals.append(joint_residuals(columns, scaled, rows, residual))
    return residuals


def joint_residuals(
    columns: NDArray[np.int64], root: Array, rows: Array, residual: Array
) -> JointResiduals:
    """Return one joint's residuals in sums over time lags and kernels exp(-|l| / T_i).

    Lags and time constants stay below a tenth of the number of samples.

    Args:
        columns: (k,) indices of the parameters of the joint's rows.
        root: (k, r) with root root^T = w^2 C, w the joint's weight, C the inverse normal matrix.
        rows: (N, k) equations of the joint.
        residual: (N,) [N m]; NaN where a sample is left out.
    """
    is_used = np.isfinite(residual)
    count = int(np.count_nonzero(is_used))
    lags, kernels = _reach(count)
    products, pairs = autocovariance(residual, lags)
    decay = _decay(kernels)
    sums = _sums(rows, is_used, decay)
    hats = np.zeros(lags + 1)
    # A few channels at a time: all channels together would be as large as the log.
    batches = -(-root.shape[1] // _CHANNELS)  # rounded up
    for channels in np.array_split(root, batches, axis=1):
        image = np.where(is_used[:, None], rows @ channels, 0.0)
        hats += lagged_sums(image, lags)
    hats = hats / np.maximum(pairs, 1.0)
    lag = np.arange(lags + 1)
    return JointResiduals(columns, count, decay, sums, lag, products, hats)


def _decay(kernels: int) -> Array:
    """Return exp(-1 / T_i) (m,) for a number m of kernels with T_i = 1, 2, 4, ... samples."""
    return np.exp(-1.0 / 2.0 ** np.arange(kernels))


def _sums(rows: Array, is_used: NDArray[np.bool_], decay: Array) -> Array:
    """Return the Q_i (1 + m, k, k) of rows y (N, k), taken as zero where not ``is_used`` (N,).

    Q_i = Q_0 + B + B^T with B = y^T u, u_t = a (u_(t-1) + y_(t-1)), a = exp(-1 / T_i). A chunk of
    rows is filtered by one matrix product: u = W y + a^t s, W the powers a^(t-t') below the
    diagonal, s = a (u + y) of the last row of the chunk before, ``state``.
    """
    lags = np.subtract.outer(np.arange(_CHUNK), np.arange(_CHUNK))
    factor = decay[:, None, None]
    powers = factor ** np.abs(lags)
    width = rows.shape[1]
    within = np.where(lags > 0, powers, 0.0)  # W
    state = np.zeros((len(decay), 1, width))
    normal = np.zeros((width, width))
    half = np.zeros((len(decay), width, width))  # B
    n_chunks = len(rows) // _CHUNK + 1  # of at most _CHUNK rows
    chunks = zip(np.array_split(rows, n_chunks), np.array_split(is_used, n_chunks))
    for block, mask in chunks:
        chunk = np.where(mask[:, None], block, 0.0)
        size = len(block)
        filtered = within[:, :size, :size] @ chunk + powers[:, :size, :1] * state
        normal += chunk.T @ chunk
        half += chunk.T @ filtered
        state = factor * (filtered[:, -1:] + chunk[-1:])
    return np.array([normal, *(normal + half + half.swapaxes(1, 2))])


def _reach(count: int) -> tuple[int, int]:
    """Return (largest lag [samples], number of kernels), no lag or T_i above ``count`` / 10."""
    lags = int(np.clip(count // 10, 1, _MAX_LAG))
    return lags, max(int(np.log2(max(lags / 2.0, 1.0))) + 1, 1)


def _simplest_fit(shapes: Array, products: Array, count: int) -> Array:
    """Return kernel coefficients c >= 0 (1 + m,) with shapes c ~ products, and few slow kernels.

    Among the fits with the first 1, 2, ... kernels the one of least Akaike's criterion is taken;
    the variance of an autocovariance is (1 / n) sum_l rho_l^2 (Bartlett 1946).

    Args:
        shapes: (bins, 1 + m) expected autocovariance of each kernel.
        products: (bins,) measured autocovariance, relative to that of lag 0.
        count: number of samples n.
    """
    size = shapes.shape[1]
    variance = (1.0 + 2.0 * float(np.sum(products[1:] ** 2))) / max(count, 1)
    fits = np.zeros((size, size))
    criteria = np.zeros(size)
    for k in range(size):
        fits[k, : k + 1], misfit = non_negative(shapes[:, : k + 1], products)
        criteria[k] = misfit**2 / variance + 2.0 * np.count_nonzero(fits[k])
    best = fits[np.argmin(criteria)]
    if not np.any(best):
        best[0] = 1.0  # white noise
    return best


def non_negative(matrix: Array, right_side: Array) -> tuple[Array, float]:
    """Return (x >= 0, |A x - b|) of non-negative least squares, A (M, p) and b (M,).

    By MuJoCo, which is imported already: SciPy's solver takes a tenth of a second and 20 MB to
    import. SciPy takes over where MuJoCo's stops too early: where the gradient along a positive x,
    or towards a positive x, is not zero but for rounding.
    """
    size = matrix.shape[1]
    goal = matrix.T @ right_side
    x = np.zeros(size)
    # MuJoCo minimises 1/2 x^T gram x - goal^T x over x >= 0, and asks for a workspace of this size.
    workspace = np.zeros((size, size + 7))
    gram = matrix.T @ matrix
    rank = mujoco.mju_boxQP(x, workspace, None, gram, -goal, np.zeros(size), None)
    slope = goal - matrix.T @ (matrix @ x)
    uphill = np.max(np.where(x > 0.0, np.abs(slope), slope))
    if rank < 0 or uphill > _FLAT * np.max(np.abs(goal)):
        from scipy.optimize import nnls

        x = nnls(matrix, right_side)[0]
    return x, float(np.linalg.norm(matrix @ x - right_side))


def _sum_bins(values: Array, bins: NDArray[np.int64]) -> Array:
    """Return sums of values (v, ...) over bins, divided by the root of their width.

    Equal variances of values stay equal. ``bins`` are the indices at which bins begin.
    """
    width = np.diff(np.append(bins, len(values)))
    sums = np.add.reduceat(values, bins, axis=0)
    return sums / np.sqrt(width).reshape((-1,) + (1,) * (values.ndim - 1))


def residual_correlation_time(residual: Array) -> float:
    """Return the integrated autocorrelation time of a residual (K,) of one joint [samples], NaN
    where a sample is left out.
    """
    covariance, pairs = autocovariance(residual, max(len(residual) // 10, 1) - 1)
    return autocorrelation_time(covariance, pairs[0])


def concentration(residual: Array) -> float:
    """Return the factor by which bursts reduce the effective number of rows of a residual (K,).

    Of B stretches with energies E_b, (sum E_b)^2 / sum E_b^2 count (Kish, "Survey Sampling", 1965):
    all of them where the energy is spread evenly, one where a single burst holds it. The residual
    is NaN where a sample is left out.
    """
    squares = residual[np.isfinite(residual)] ** 2
    if len(squares) < 2 * _STRETCHES or not np.any(squares):
        return 1.0
    stretches_of_squares = np.array_split(squares, _STRETCHES)
    energies = np.array(list(map(np.sum, stretches_of_squares)))
    return float(_STRETCHES * np.sum(energies**2) / np.sum(energies) ** 2)


def autocorrelation_time(covariance: Array, count: float) -> float:
    """Return the integrated autocorrelation time 1 + 2 sum_l rho_l [samples].

    It is the factor by which the variance of a mean is larger than that of independent values
    (Bartlett, "On the theoretical specification ... of autocorrelated time-series", 1946). The sum
    ends before the first lag l whose autocorrelation rho_l is not significant.

    Args:
        covariance: (v,) autocovariance at lags 0, 1, 2, ... samples.
        count: number of samples; with infinitely many, the sum ends at the first negative value.
    """
    if not covariance[0] > 0.0:
        return 1.0
    correlation = np.append(covariance, 0.0) / covariance[0]  # zero at the end
    last = int(np.argmax(correlation <= CHANCE / np.sqrt(count)))
    return float(1.0 + 2.0 * np.sum(correlation[1:last]))


def autocovariance(residual: Array, lags: int) -> tuple[Array, Array]:
    """Return (mean of r_t r_(t+l), number of pairs) for l = 0 .. lags of a residual (K,).

    The residual is NaN where a sample is left out.
    """
    is_used = np.isfinite(residual)
    pairs = np.rint(lagged_sums(is_used.astype(float)[:, None], lags))
    products = lagged_sums(np.where(is_used, residual, 0.0)[:, None], lags)
    return products / np.maximum(pairs, 1.0), pairs


def lagged_sums(signal: Array, lags: int) -> Array:
    """Return sums (lags + 1,) over t of s_t . s_(t+l), l = 0 .. lags, of a signal s (N, r)."""
    size = 1 << int(np.ceil(np.log2(max(len(signal) + lags + 1, 2))))
    power = np.sum(np.abs(np.fft.rfft(signal, size, axis=0)) ** 2, axis=1)
    return np.fft.irfft(power, size)[: lags + 1]
