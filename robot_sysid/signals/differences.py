"""Derivatives of, and shifts in time of, evenly sampled signals.

Both are symmetric finite stencils, exact for polynomials up to their order, which suits signals
that a low-pass has already been over: an eighth-order difference is exact to 1e-6 at a tenth of the
sample rate. On low-passed encoder data it leaves only the noise inside the pass band; on the same
data a Savitzky-Golay window over the raw positions leaves nearly three times as much, a Fourier
derivative more than ten times, and a recursive filter run both ways as much, but errs near the ends
(tests/benchmarks/differentiation_accuracy.py).
"""

from __future__ import annotations

import math

import numpy as np

from robot_sysid.records import Array

REACH = 4
"""Samples lost at each end by a derivative."""

SHIFT_REACH = 32
"""Samples lost at each end by a shift, besides the shift itself."""

# Fornberg, "Generation of finite difference formulas", Math. Comp. 51, 1988, table 1, order 8.
_FIRST = np.array([3, -32, 168, -672, 0, 672, -168, 32, -3]) / 840.0
_SECOND = np.array([-9, 128, -1008, 8064, -14350, 8064, -1008, 128, -9]) / 5040.0
# Of the shift's Kaiser window [dB]: flat to 1e-5 up to 0.8 times the Nyquist frequency.
_SHIFT_ATTENUATION = 100.0


def first_derivative(values: Array, rate: float) -> Array:
    """Return (N - 8, ...) the time derivative of values (N, ...) sampled at ``rate`` [Hz]."""
    return _correlated(values, _FIRST) * rate


def second_derivative(values: Array, rate: float) -> Array:
    """Return (N - 8, ...) the second time derivative of values (N, ...)."""
    return _correlated(values, _SECOND) * rate**2


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


def _correlated(values: Array, stencil: Array) -> Array:
    count = max(0, len(values) - len(stencil) + 1)
    out = np.zeros((count, *np.shape(values)[1:]))
    for offset, weight in enumerate(stencil):
        out += weight * values[offset : offset + count]
    return out
