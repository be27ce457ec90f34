"""Residuals that remember: how values that follow each other are alike."""

from __future__ import annotations

import numpy as np

from robot_sysid.records import Array

CHANCE = 2.0
"""Standard errors of an autocorrelation of independent values that are taken for none."""
# How many channels are transformed at a time: memory against calls.
_CHANNELS = 8


def memory(residual: Array, repeats: float = 1.0) -> float:
    """Return ``memory_of`` a residual (K,) that repeats; NaN stands for what is left out."""
    covariance, pairs = autocovariance(residual, max(len(residual) // 10, 1) - 1)
    return memory_of(covariance, pairs[0] / repeats)


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
    power = np.zeros(size // 2 + 1)
    # A few channels at a time: all of a long log's are as large as the log.
    for start in range(0, signal.shape[1], _CHANNELS):
        some = np.fft.rfft(signal[:, start : start + _CHANNELS], size, axis=0)
        power += np.sum(np.abs(some) ** 2, axis=1)
    return np.fft.irfft(power, size)[: lags + 1]
