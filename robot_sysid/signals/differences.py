"""Derivatives of, and shifts in time of, evenly sampled signals.

Both are symmetric finite stencils, exact for polynomials up to their order, which suits signals
that a low-pass has already been over: at a tenth of the sample rate an eighth-order difference is
exact to 4e-5, one of order sixteen to 2e-9. On low-passed encoder data they leave only the noise
inside the pass band; on the same data a Savitzky-Golay window over the raw positions leaves nearly
three times as much, a Fourier derivative more than ten times, and a recursive filter run both ways
as much, but errs near the ends (tests/benchmarks/differentiation_accuracy.py).
"""

from __future__ import annotations

import math

import numpy as np

from robot_sysid.records import Array

REACH = 4
"""Samples lost at each end by a derivative of the usual order, eight."""

FINE_REACH = 8
"""The same where positions are nearly free of noise, and the order is sixteen."""

SHIFT_REACH = 32
"""Samples lost at each end by a shift, besides the shift itself."""

# Of the shift's Kaiser window [dB]: flat to 1e-5 up to 0.8 times the Nyquist frequency.
_SHIFT_ATTENUATION = 100.0


def first_derivative(values: Array, rate: float, reach: int = REACH) -> Array:
    """Return the time derivative of values (N, ...) sampled at ``rate`` [Hz], (N - 2 reach, ...).

    Of order 2 reach: weights w_k / k, w_k = (-1)^(k + 1) C(2 reach, reach - k) / C(2 reach, reach),
    of the samples k later, and their negatives of those k earlier (Fornberg, "Generation of finite
    difference formulas", Math. Comp. 51, 1988).
    """
    ahead, weights = _central_weights(reach)
    later = weights / ahead
    return _of_differences(values, np.concatenate((-later[::-1], [0.0], later)), 1) * rate


def second_derivative(values: Array, rate: float, reach: int = REACH) -> Array:
    """Return the second time derivative of values (N, ...), (N - 2 reach, ...).

    With the same w_k: weights 2 w_k / k^2 on both sides, and what makes their sum zero between.
    """
    ahead, weights = _central_weights(reach)
    later = 2.0 * weights / ahead**2
    stencil = np.concatenate((later[::-1], [-2.0 * np.sum(later)], later))
    return _of_differences(values, stencil, 2) * rate**2


def _central_weights(reach: int) -> tuple[Array, Array]:
    """Return k = 1 ... reach and w_k."""
    ahead = np.arange(1.0, reach + 1.0)
    weights = [-((-1) ** k) * math.comb(2 * reach, reach - k) for k in range(1, reach + 1)]
    return ahead, np.array(weights) / math.comb(2 * reach, reach)


def advanced(values: Array, samples: float) -> tuple[Array, int]:
    """Return values at fractional later instants: result[k] = values(k + first + samples).

    A band-limited signal is shifted exactly by its sinc series, here cut off by a window; whole
    samples are shifted by slicing, without any loss.

    Args:
        values: (N, ...) evenly sampled.
        samples: how many sampling periods later; negative for earlier.

    Returns:
        (K, ...) shifted values, and the index ``first`` that the first one replaces. The same
        ``first`` and K hold for every shift of the same number of whole samples.
    """
    from scipy.signal import kaiser_beta

    whole = math.floor(samples + 0.5)
    fraction = samples - whole
    at = np.arange(-SHIFT_REACH, SHIFT_REACH + 1) - fraction
    inside = np.maximum(0.0, 1.0 - (at / (SHIFT_REACH + 1)) ** 2)
    window = np.i0(kaiser_beta(_SHIFT_ATTENUATION) * np.sqrt(inside))
    stencil = np.sinc(at) * window
    inner = _correlated(values, stencil / stencil.sum())
    first = SHIFT_REACH + max(0, -whole)
    start, stop = max(0, whole), len(inner) + min(0, whole)
    return inner[start:stop], first


def _of_differences(values: Array, stencil: Array, order: int) -> Array:
    """Return ``_correlated`` of a stencil that is blind to polynomials below an order.

    Sum_k s_k x_k = -sum_k S_k (x_(k+1) - x_k), S_k = s_0 + ... + s_k. Neighbours' differences have
    no rounding errors, which the square of the rate would make large.
    """
    for _ in range(order):
        values, stencil = np.diff(values, axis=0), -np.cumsum(stencil)[:-1]
    return _correlated(values, stencil)


def _correlated(values: Array, stencil: Array) -> Array:
    count = max(0, len(values) - len(stencil) + 1)
    out = np.zeros((count, *np.shape(values)[1:]))
    for offset, weight in enumerate(stencil):
        out += weight * values[offset : offset + count]
    return out
