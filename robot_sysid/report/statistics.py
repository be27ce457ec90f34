"""What residuals look like: how large, how long they last, at which speeds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robot_sysid.records import Array

BINS, SPEED_BINS = 31, 24
LONGEST_LAG = 2.0
"""Up to which lag the autocorrelation is computed [s]."""
_MOST_LAGS = 80
_WIDE = 4.0
_LEAST_IN_BIN = 4


def histogram(residual: Array) -> tuple[Array, Array]:
    """Return (edges (n, B + 1), counts (n, B)) of residuals (K, n), out to four times their rms.

    What is farther out is counted in the outermost bins.
    """
    edges, counts = [], []
    for column in residual.T:
        known = column[np.isfinite(column)]
        rms = float(np.sqrt(np.mean(known**2))) if len(known) else 0.0
        reach = _WIDE * rms or 1.0
        limits = np.linspace(-reach, reach, BINS + 1)
        edges.append(limits)
        counts.append(np.histogram(np.clip(known, -reach, reach), limits)[0])
    return np.array(edges), np.array(counts, dtype=float)


def autocorrelation(time: Array, residual: Array) -> tuple[Array, Array, Array]:
    """Return (lags (L,) [s], correlation (n, L), independent (n,)) of residuals (K, n).

    r(l) = mean(e_k e_{k+l}) / mean(e_k^2) over the pairs of samples that were both used. Noise
    without memory exceeds 1.96 / sqrt(pairs) in one lag of twenty (Box, Jenkins, "Time Series
    Analysis", 1970, ch. 2).

    Args:
        time: (K,) [s].
        residual: (K, n); NaN where a sample was not used.
    """
    step = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    step = step if step > 0.0 else 1.0
    last = int(min(LONGEST_LAG / step, len(time) // 4))
    shifts = np.unique(np.linspace(0, last, min(last, _MOST_LAGS) + 1).round().astype(int))
    used = np.isfinite(residual)
    values = np.where(used, residual, 0.0)
    power = np.mean(values**2, axis=0, where=used) if np.any(used) else np.zeros(used.shape[1])
    found = np.zeros((residual.shape[1], len(shifts)))
    for k, shift in enumerate(shifts):
        end = len(values) - shift
        pairs = np.sum(used[:end] & used[shift:], axis=0)
        total = np.sum(values[:end] * values[shift:], axis=0)
        scale = power * np.maximum(pairs, 1)
        found[:, k] = np.divide(total, scale, out=np.zeros_like(total), where=scale > 0.0)
    independent = 1.96 / np.sqrt(np.maximum(np.sum(used, axis=0), 1))
    return shifts * step, found, independent


def by_speed(qd: Array, quantities: Sequence[Array]) -> tuple[Array, tuple[Array, ...], Array]:
    """Return the means of quantities (K, n) in bins of each joint's own speed.

    Returns:
        (middles (n, S), NaN where a bin has hardly any samples; means (n, S) per quantity;
        standard deviation (n, S) of the first quantity).
    """
    shape = (qd.shape[1], SPEED_BINS)
    middles, spread = np.full(shape, np.nan), np.full(shape, np.nan)
    means = tuple(np.full(shape, np.nan) for _ in quantities)
    for joint, speed in enumerate(qd.T):
        used = np.isfinite(quantities[0][:, joint])
        if not np.any(used):
            continue
        fastest = float(np.max(np.abs(speed[used]))) or 1.0
        edges = np.linspace(-fastest, fastest, SPEED_BINS + 1)
        place = np.clip(np.digitize(speed, edges) - 1, 0, SPEED_BINS - 1)
        for k in range(SPEED_BINS):
            here = used & (place == k)
            if np.count_nonzero(here) < _LEAST_IN_BIN:
                continue
            middles[joint, k] = np.mean(speed[here])
            spread[joint, k] = np.std(quantities[0][here, joint])
            for mean, quantity in zip(means, quantities):
                mean[joint, k] = np.mean(quantity[here, joint])
    return middles, means, spread
