"""What torque noise that is correlated in time does to an estimate, from one pass over the samples.

Residuals of a joint are described by a sum of decaying exponentials,

    gamma(l) = c_0 [l = 0] + sum_i c_i exp(-|l| / T_i),   c >= 0,  T_i = 1, 2, 4, ... samples,

fitted to their autocovariance. The variance of the score Y^T e is then sum_i c_i Q_i with

    Q_i = sum_(t, s) y_t exp(-|t - s| / T_i) y_s^T,

which first-order recursive filters collect in one pass. Slow rows and slow noise add up,
fast ones average out; white noise gives sigma^2 Y^T Y.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import starmap

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.records import Array, SampleSource, SquareRootInformation

CHANCE = 2.0
"""Standard errors of an autocorrelation of independent values that are taken for none."""
# Stretches that a residual's energy is compared in.
_STRETCHES = 25
# How many channels are transformed at a time: memory against calls.
_CHANNELS = 4
# Largest lag that is looked at [samples], and bins over the lags: chosen for cost.
_MAX_LAG, _LAG_BINS = 2000, 60
# Slope at a minimum, beside that at the beginning: rounding of squared equations.
_FLAT = 1e-9
# Rows that are filtered at a time, by one product of matrices: chosen for cost.
_CHUNK = 32
# Largest share of a kernel's noise that a fit is said to take out: noise is divided by the rest.
_MOST_ABSORBED = 0.8


@dataclass(frozen=True)
class JointResiduals:
    """What a pass over one joint's samples leaves: sums over lags and kernels.

    Attributes:
        columns: (k,) which parameters this joint's equations contain.
        count: number of samples n.
        decay: (m,) exp(-1 / T_i).
        sums: (1 + m, k, k) the Q_i; the first is Y^T Y. Of fewer rows than columns, (1 + m, n, n).
        basis: those rows (n, k), with Q_i = basis^T sums_i basis; None where the sums are the Q_i.
        lags: (v,) lags 0, 1, 2, ... [samples].
        products: (v,) mean of r_t r_(t+l) [N^2 m^2].
        hats: (v,) mean of h_(t,t+l), H the matrix that turns this joint's torque into the fit.
        pairs: (v,) of how many pairs these are means.
    """

    columns: NDArray[np.int64]
    count: int
    decay: Array
    sums: Array
    lags: NDArray[np.int64]
    products: Array
    hats: Array
    pairs: Array
    basis: Array | None = None

    def inside(self, spread: Array) -> Array:
        """Return what some C (k, k) is to ``sums``: tr Q_i C = tr sums_i inside(C)."""
        return spread if self.basis is None else self.basis @ spread @ self.basis.T

    def energy(self, spread: Array) -> float:
        """Return tr Q_0 C, the energy that errors of covariance C (k, k) make in the torque."""
        rows = self.sums[0] if self.basis is None else self.basis
        return float(np.vdot(spread if self.basis is None else rows @ spread, rows))

    def score(self, kernels: Array) -> Array:
        """Return sum_i c_i Q_i (k, k) of coefficients c (1 + m,)."""
        found = np.tensordot(kernels, self.sums, axes=1)
        return found if self.basis is None else self.basis.T @ found @ self.basis

    def __add__(self, other: JointResiduals) -> JointResiduals:
        """Return the sums of both logs' samples, no lag reaching from one into the other.

        Both have the same lags and kernels.
        """
        pairs = self.pairs + other.pairs

        def mean(ours: Array, theirs: Array) -> Array:
            return (self.pairs * ours + other.pairs * theirs) / np.maximum(pairs, 1.0)

        return replace(
            self,
            count=self.count + other.count,
            sums=self.sums + other.sums,
            products=mean(self.products, other.products),
            hats=mean(self.hats, other.hats),
            pairs=pairs,
        )

    def shortened(self) -> JointResiduals:
        """Return it without the lags and time constants above a tenth of the samples."""
        lags, kernels = _reach(self.count)
        first = slice(lags + 1)
        return replace(
            self,
            decay=self.decay[:kernels],
            sums=self.sums[: 1 + kernels],
            **{name: getattr(self, name)[first] for name in ("lags", "products", "hats", "pairs")},
        )

    def absorbed(self, own: Array) -> Array:
        """Return (1 + m,) the share of each kernel's noise that the fit takes out of residuals.

        With H = Y own Y^T, residuals of noise V have the energy tr V - 2 tr H V + tr H V H; own is
        ``inside`` of w^2 C, weight times the estimate's inverse normal matrix.
        """
        twice = own @ self.sums[0] @ own
        lost = 2.0 * np.tensordot(self.sums, own, axes=2) - np.tensordot(self.sums, twice, axes=2)
        return np.clip(lost / max(self.count, 1), 0.0, _MOST_ABSORBED)

    def fit(self, absorbed: Array, leaked: float) -> Array:
        """Return kernel coefficients c >= 0 (1 + m,) [N^2 m^2].

        The fit takes slow noise out of the residuals in the shape of ``hats``; that is part of what
        each kernel is expected to look like. Errors that others' noise makes add ``leaked``, a mean
        square [N^2 m^2].
        """
        energy = float(self.products[0])
        shape = self.hats / self.hats[0] if self.hats[0] > 0.0 else np.zeros(len(self.lags))
        seen = self.products - min(leaked, 0.5 * energy) * shape
        if energy <= 0.0:
            return np.zeros(1 + len(self.decay))
        kernels = np.column_stack((self.lags == 0, self.decay ** self.lags[:, None])).astype(float)
        shapes = kernels - np.outer(shape, absorbed)
        # The first lag of each bin; bins widen in proportion to the lag.
        count = len(self.lags)
        edges = np.floor(np.geomspace(1.0, max(count - 1, 1), _LAG_BINS)).astype(np.int64)
        bins = np.unique(np.clip(np.append(0, edges), 0, count - 1))
        found = _simplest_fit(_pooled(shapes, bins), _pooled(seen / energy, bins), self.count)
        return found * seen[0] / float(found @ shapes[0])

    def effective_samples(self, kernels: Array) -> float:
        """Return how many independent samples average as well: n gamma(0) / sum_l gamma(l)."""
        summed = np.concatenate(([1.0], (1.0 + self.decay) / (1.0 - self.decay)))
        spread = float(kernels @ summed)
        return self.count * float(np.sum(kernels)) / spread if spread > 0.0 else float(self.count)


def collect_residuals(
    information: SquareRootInformation,
    samples: SampleSource,
    values: Array,
    root: Array,
    weights: Array,
    to_add: bool = False,
) -> list[JointResiduals]:
    """Return each joint's sums, from one pass: of the estimate (p,) by weights (joints,) [1/(N m)]
    with C = root root^T, root (p, r); ``to_add`` as in ``joint_residuals``.
    """

    def of(index: int, rows: Array, tau: Array) -> JointResiduals:
        columns = information.joints[index].columns
        residual, scaled = tau - rows @ values[columns], weights[index] * root[columns]
        return joint_residuals(columns, scaled, rows, residual, to_add)

    return list(starmap(of, samples))


def joint_residuals(
    columns: NDArray[np.int64], root: Array, rows: Array, residual: Array, to_add: bool = False
) -> JointResiduals:
    """Return one joint's sums over lags and kernels.

    Lags and time constants stay below a tenth of the number of samples.

    Args:
        columns: which parameters the joint's rows contain.
        root: (k, r) with w^2 C = root root^T.
        rows: (N, k) its equations.
        residual: (N,) [N m]; NaN where a sample is left out.
        to_add: keep all lags, however few samples there are.
    """
    kept = np.isfinite(residual)
    count = int(np.count_nonzero(kept))
    lags, kernels = _reach(10 * _MAX_LAG if to_add else count)
    products, pairs = autocovariance(residual, lags)
    decay, basis = _decay(kernels), None
    if len(rows) < len(columns) and not to_add:
        basis = np.where(kept[:, None], rows, 0.0)
        sums, seen = _sums_of_ones(len(rows), kernels), basis @ root
        hat = seen @ seen.T
        hats = np.array([np.trace(hat, lag) for lag in range(lags + 1)])
    else:
        sums = _sums(rows, kept, decay)
        # A few channels at a time: all of a long log's are as large as the log.
        parts = np.array_split(root, -(-root.shape[1] // _CHANNELS), axis=1)
        hats = np.sum([lagged(np.where(kept[:, None], rows @ p, 0.0), lags) for p in parts], axis=0)
    return JointResiduals(
        columns=columns,
        count=count,
        decay=decay,
        sums=sums,
        lags=np.arange(lags + 1),
        products=products,
        hats=hats / np.maximum(pairs, 1.0),
        pairs=pairs,
        basis=basis,
    )


def _decay(kernels: int) -> Array:
    return np.exp(-1.0 / 2.0 ** np.arange(kernels))


@lru_cache(maxsize=2)
def _sums_of_ones(count: int, kernels: int) -> Array:
    """Return the Q_i (1 + m, n, n) of rows that are those of a unit matrix."""
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    return np.asarray(np.append(0.0, _decay(kernels))[:, None, None] ** apart)


def _sums(rows: Array, kept: NDArray[np.bool_], decay: Array) -> Array:
    """Return the Q_i (1 + m, k, k) of rows y (N, k), zero where they are not kept (N,).

    Half of Q_i - Q_0 is y^T u with the filters u_t = a (u_(t-1) + y_(t-1)), a = exp(-1 / T_i).
    """
    since, each = np.subtract.outer(np.arange(_CHUNK), np.arange(_CHUNK)), decay[:, None, None]
    powers, width = each ** np.abs(since), rows.shape[1]
    within, state = np.where(since > 0, powers, 0.0), np.zeros((len(decay), 1, width))
    normal, half = np.zeros((width, width)), np.zeros((len(decay), width, width))
    parts = (np.array_split(every, len(rows) // _CHUNK + 1) for every in (rows, kept))
    for some, counts in zip(*parts):
        part, size = np.where(counts[:, None], some, 0.0), len(some)
        passed = within[:, :size, :size] @ part + powers[:, :size, :1] * state
        normal += part.T @ part
        half += part.T @ passed
        state = each * (passed[:, -1:] + part[-1:])
    return np.array([normal, *(normal + half + half.swapaxes(1, 2))])


def _reach(count: int) -> tuple[int, int]:
    """Return (largest lag, number of kernels) that so many samples can show."""
    lags = int(np.clip(count // 10, 1, _MAX_LAG))
    return lags, max(int(np.log2(max(lags / 2.0, 1.0))) + 1, 1)


def _simplest_fit(shapes: Array, seen: Array, count: int) -> Array:
    """Return c >= 0 with shapes c ~ seen, without slow kernels that chance alone would call for.

    Among the fits with the first 1, 2, ... kernels the one of least Akaike's criterion is taken;
    the variance of an autocovariance is (1 / n) sum_l rho_l^2 (Bartlett 1946).
    """
    size = shapes.shape[1]
    fits = [non_negative(shapes[:, :m], seen) for m in range(1, size + 1)]
    variance = (1.0 + 2.0 * float(np.sum(seen[1:] ** 2))) / max(count, 1)
    scores = [misfit**2 / variance + 2.0 * np.count_nonzero(found) for found, misfit in fits]
    found = fits[int(np.argmin(scores))][0]
    full = np.append(found, np.zeros(size - len(found)))
    full[0] += float(not np.any(full))
    return full


def non_negative(matrix: Array, right: Array) -> tuple[Array, float]:
    """Return (x >= 0, |A x - b|) of least squares, by MuJoCo, which is there: SciPy's solver takes
    a tenth of a second and 20 MB to import. It takes over where that one stops too early.
    """
    size, goal = matrix.shape[1], matrix.T @ right
    found, room = np.zeros(size), np.zeros((size, size + 7))
    given = matrix.T @ matrix, -goal, np.zeros(size), None
    failed = mujoco.mju_boxQP(found, room, None, *given) < 0
    slope = goal - matrix.T @ (matrix @ found)
    uphill = np.max(np.where(found > 0.0, np.abs(slope), slope))
    if failed or uphill > _FLAT * np.max(np.abs(goal)):
        from scipy.optimize import nnls

        found = nnls(matrix, right)[0]
    return found, float(np.linalg.norm(matrix @ found - right))


def _pooled(values: Array, bins: NDArray[np.int64]) -> Array:
    """Return sums over bins divided by the root of their width: means with equal variance."""
    width = np.diff(np.append(bins, len(values)))
    sums = np.add.reduceat(values, bins, axis=0)
    return sums / np.sqrt(width).reshape((-1,) + (1,) * (values.ndim - 1))


def memory(residual: Array, repeats: float = 1.0) -> float:
    """Return ``memory_of`` a residual (K,) that repeats; NaN stands for what is left out."""
    covariance, pairs = autocovariance(residual, max(len(residual) // 10, 1) - 1)
    return memory_of(covariance, pairs[0] / repeats)


def concentration(residual: Array) -> float:
    """Return by how much less than its rows a residual (K,) counts whose squares stand in bursts.

    Of stretches with energies E_b, (sum E_b)^2 / sum E_b^2 count: all of them where the energy is
    spread evenly, one where a single burst holds it. NaN stands for what is left out.
    """
    squares = residual[np.isfinite(residual)] ** 2
    if len(squares) < 2 * _STRETCHES or not np.any(squares):
        return 1.0
    energies = np.array([np.sum(part) for part in np.array_split(squares, _STRETCHES)])
    return float(_STRETCHES * np.sum(energies**2) / np.sum(energies) ** 2)


def memory_of(covariance: Array, count: float) -> float:
    """Return 1 + 2 sum of an autocorrelation, up to where it first falls to what chance brings.

    By so much is the variance of a slow sum larger than that of independent values (Bartlett,
    "On the theoretical specification ... of autocorrelated time-series", 1946). The covariance
    (v,) is that of values 0, 1, 2, ... apart, ``count`` of them; infinitely many sum it up to where
    it first falls to zero.
    """
    if not covariance[0] > 0.0:
        return 1.0
    alike = np.append(covariance, 0.0) / covariance[0]
    last = int(np.argmax(alike <= CHANCE / np.sqrt(count)))
    return float(1.0 + 2.0 * np.sum(alike[1:last]))


def autocovariance(residual: Array, lags: int) -> tuple[Array, Array]:
    """Return (mean of r_t r_(t+l), of how many pairs) for l = 0 .. lags of a residual (K,).

    NaN stands for what is left out.
    """
    kept = np.isfinite(residual)
    pairs = np.rint(lagged(kept.astype(float)[:, None], lags))
    products = lagged(np.where(kept, residual, 0.0)[:, None], lags)
    return products / np.maximum(pairs, 1.0), pairs


def lagged(signal: Array, lags: int) -> Array:
    """Return sum_t s_t . s_(t+l) for l = 0 .. lags of a signal (N, r), by FFT."""
    size = 1 << int(np.ceil(np.log2(max(len(signal) + lags + 1, 2))))
    power = np.sum(np.abs(np.fft.rfft(signal, size, axis=0)) ** 2, axis=1)
    return np.fft.irfft(power, size)[: lags + 1]
