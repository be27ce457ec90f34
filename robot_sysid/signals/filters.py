"""One zero-phase low-pass for positions, torques and regressor columns alike; derivatives; shifts.

A least-squares fit does not care about a linear filter as long as both sides of Y theta = tau pass
the same one (parallel filtering: Gautier, "Dynamic identification of robots with power model",
ICRA 1997). The filter is symmetric and of finite length, a sinc times a Kaiser window: it delays
nothing, assumes nothing beyond the ends of a log (they are cut off), and gives the same numbers
whether the rows come at once or in chunks.

Derivatives and shifts are symmetric finite stencils, exact for polynomials up to their order: at a
tenth of the sample rate an eighth-order difference is exact to 4e-5, one of order sixteen to 2e-9.
What others leave on encoder data: benchmarks/differentiation_accuracy.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array

# Kaiser's design formulas (Oppenheim, Schafer, "Discrete-Time Signal Processing", sec. 7.5.3).
ATTENUATION = 90.0
"""Usual attenuation [dB]: within 1e-4 of one below 0.4 times the cut-off, below 1e-4 above 1.6
times. That is 80 dB; the rest makes up for the formulas being approximate for short kernels."""
_TRANSITION = 1.2
# Of what is smooth, so many samples a decimated one, least and most: twelve times the cut-off, or
# what fits the decimation better (chosen).
_STRIDES = 6
_MOST_STRIDES = 9
# Of the weights for them: frequencies per weight, what those above three cut-offs count (chosen).
_RESPONSES = 12
_BEYOND = 1e-5
CHUNK = 2048
"""Samples at a time: what fits into a cache."""
# Samples of half a kernel that no log has: three hours at 1 kHz.
_LONGEST = 1e7
HIGHEST_CUTOFF = 0.3
"""Largest cut-off, as a part of the sample rate, whose stop band still fits below Nyquist."""


@dataclass(frozen=True)
class LowPass:
    """A zero-phase low-pass that also decimates samples out to its own bandwidth.

    Attributes:
        cutoff, rate: frequency passed with half its amplitude, and of the samples [Hz].
        kernel: (2 M + 1,) symmetric weights that add up to one.
        step: every how many samples one filtered sample is kept when decimating.
    """

    cutoff: float
    rate: float
    kernel: Array
    step: int

    @property
    def half_width(self) -> int:
        """Samples M lost at each end."""
        return len(self.kernel) // 2

    @property
    def stride(self) -> int:
        """Every how many samples are enough of what has nothing above nine cut-offs."""
        even = math.gcd(self.step, self.half_width)
        most = max(1, self.step // _STRIDES)
        return max(each for each in range(1, most + 1) if even % each == 0)

    def at_every(self, stride: int) -> LowPass:
        """Return the filter for every so many samples, from the first on.

        Its weights are those whose response is, up to three cut-offs, nearest to this one's: within
        1e-8, above within 1e-3 (least squares). It has images around multiples of its rate.
        """
        if stride == 1:
            return self
        rate = self.rate / stride
        half = self.half_width // stride
        frequency = np.linspace(0.0, rate / 2.0, _RESPONSES * half)
        counts = np.where(frequency <= 3.0 * self.cutoff, 1.0, _BEYOND)[:, None]

        def responses(half: int, rate: float) -> Array:
            found = counts * np.cos(
                2.0 * np.pi * np.outer(frequency, np.arange(half + 1) / rate)
            )
            found[:, 1:] *= 2.0  # both sides of the centre
            return found

        wanted = responses(self.half_width, self.rate) @ self.kernel[self.half_width :]
        later = np.linalg.lstsq(responses(half, rate), wanted, rcond=None)[0]
        kernel = np.concatenate((later[:0:-1], later))
        return LowPass(self.cutoff, rate, kernel, self.step // stride)

    def filtered(self, values: Array) -> Array:
        """Return (N - 2 M, ...) filtered samples of values (N, ...), one per inner sample.

        By Fourier transforms of overlapping blocks (Oppenheim, Schafer, sec. 8.7.3).
        """
        width = len(self.kernel)
        count = max(0, len(values) - len(self.kernel) + 1)
        if width == 1:
            return self.kernel[0] * values
        size = 1 << (4 * width).bit_length()
        gain = np.fft.rfft(self.kernel, size).reshape(-1, *(1,) * (np.ndim(values) - 1))
        out = np.empty((count, *np.shape(values)[1:]))
        for start in range(0, count, size - width + 1):
            seen = np.fft.rfft(values[start : start + size], size, axis=0)
            block = out[start : start + size - width + 1]
            block[:] = np.fft.irfft(gain * seen, size, axis=0)[
                width - 1 : width - 1 + len(block)
            ]
        return out

    def decimated(self, values: Array) -> Array:
        """Return (K, ...) filtered samples of values (N, ...), one per ``step``."""
        return Decimator(self).push(values)

    def centres(self, n_samples: int) -> NDArray[np.int64]:
        """Return (K,) which of ``n_samples`` each decimated sample is centred on."""
        return np.arange(self.half_width, n_samples - self.half_width, self.step)


def design_low_pass(
    cutoff: float, rate: float, attenuation: float = ATTENUATION
) -> LowPass:
    """Return the low-pass with a cut-off [Hz] at a sample rate [Hz], or raise InputError.

    Decimated samples come at about twice the cut-off, so that white noise stays nearly white and
    their number says how much the data really holds. The stop band's attenuation [dB] is also how
    flat the pass band is.
    """
    if not 0.0 < cutoff <= HIGHEST_CUTOFF * rate:
        remedy = f"choose --cutoff between 0 and {HIGHEST_CUTOFF * rate:g} Hz"
        raise InputError(
            f"cut-off {cutoff:g} Hz does not fit a rate of {rate:g} Hz; {remedy}"
        )
    width = 2.0 * math.pi * _TRANSITION * cutoff / rate
    half = (attenuation - 8.0) / (2.285 * width) / 2.0
    if half > _LONGEST:
        fault = f"cut-off {cutoff:g} Hz would average over {2.0 * half / rate:.3g} s"
        raise InputError(f"{fault}, longer than any log; choose a higher --cutoff")
    step = max(1, int(rate / (2.0 * cutoff)))
    strides = range(max(2, step // _MOST_STRIDES), step // _STRIDES + 1) or (1,)
    stride = min(strides, key=lambda each: (step % each, -each))
    half = math.ceil(half / stride) * stride
    ideal = np.sinc(2.0 * cutoff / rate * np.arange(-half, half + 1))
    kernel = ideal * np.kaiser(2 * half + 1, _kaiser_beta(attenuation))
    return LowPass(cutoff, rate, kernel / np.sum(kernel), step - step % stride)


def _kaiser_beta(attenuation: float) -> float:
    """Return the shape of the window that attenuates so much [dB], above 50 (sec. 7.5.3)."""
    return 0.1102 * (attenuation - 8.7)


class Decimator:
    """Filters and decimates a stream of samples that arrives in chunks of any size."""

    def __init__(self, low_pass: LowPass) -> None:
        self._kernel = low_pass.kernel
        self._step = low_pass.step
        self._waiting: Array | None = None
        self._skip = 0

    def push(self, values: Array) -> Array:
        """Take the next samples (N, ...) and return the decimated ones (K, ...) they complete."""
        # Samples of one number side by side in memory: up to eight times as fast as otherwise.
        waiting = np.ascontiguousarray(np.moveaxis(values, 0, -1), dtype=float)
        if self._waiting is not None:
            waiting = np.concatenate((self._waiting, waiting), axis=-1)
        skipped = min(self._skip, waiting.shape[-1])
        self._skip -= skipped
        waiting = waiting[..., skipped:]
        count = max(0, (waiting.shape[-1] - len(self._kernel)) // self._step + 1)
        span = count * self._step
        out = np.empty((0, *waiting.shape[:-1]))
        if count:
            seen = sliding_window_view(waiting, len(self._kernel), axis=-1)[
                ..., :: self._step, :
            ]
            # Not by BLAS: a column is alike beside whatever others, with any number of threads.
            out = np.einsum("...kt,t->k...", seen, self._kernel)
        self._skip += max(0, span - waiting.shape[-1])
        self._waiting = waiting[..., span:].copy()
        return out


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
    return _correlated(values, np.concatenate((-later[::-1], [0.0], later)), 1, rate)


def second_derivative(values: Array, rate: float, reach: int = REACH) -> Array:
    """Return the second time derivative of values (N, ...), (N - 2 reach, ...).

    With the same w_k: weights 2 w_k / k^2 on both sides, and what makes their sum zero between.
    """
    ahead, weights = _central_weights(reach)
    later = 2.0 * weights / ahead**2
    stencil = np.concatenate((later[::-1], [-2.0 * np.sum(later)], later))
    return _correlated(values, stencil, 2, rate**2)


def _central_weights(reach: int) -> tuple[Array, Array]:
    """Return k = 1 ... reach and w_k."""
    ahead = np.arange(1.0, reach + 1.0)
    weights = [
        -((-1) ** k) * math.comb(2 * reach, reach - k) for k in range(1, reach + 1)
    ]
    return ahead, np.array(weights) / math.comb(2 * reach, reach)


def advanced(values: Array, samples: float) -> tuple[Array, int]:
    """Return (values (K, ...) at later instants, ``first``), k-th = values(k + first + samples).

    A band-limited signal (N, ...) is shifted exactly by its sinc series, here cut off by a window;
    whole samples are shifted by slicing, without any loss.
    """
    whole = math.floor(samples + 0.5)
    fraction = samples - whole
    at = np.arange(-SHIFT_REACH, SHIFT_REACH + 1) - fraction
    inside = np.maximum(0.0, 1.0 - (at / (SHIFT_REACH + 1)) ** 2)
    window = np.i0(_kaiser_beta(_SHIFT_ATTENUATION) * np.sqrt(inside))
    stencil = np.sinc(at) * window
    inner = _correlated(values, stencil / stencil.sum())
    first = SHIFT_REACH + max(0, -whole)
    start = max(0, whole)
    stop = len(inner) + min(0, whole)
    return inner[start:stop], first


def _correlated(
    values: Array, stencil: Array, order: int = 0, scale: float = 1.0
) -> Array:
    """Return scaled sums of a stencil that is blind to polynomials below an order.

    Sum_k s_k x_k = -sum_k S_k (x_(k+1) - x_k), S_k = s_0 + ... + s_k. Neighbours' differences have
    no rounding errors, which the square of the rate would make large.
    """
    reach = len(stencil) - 1
    count = max(0, len(values) - len(stencil) + 1)
    out = np.zeros((count, *np.shape(values)[1:]))
    for _ in range(order):
        stencil = -np.cumsum(stencil)[:-1]
    for start in range(0, count, CHUNK):
        block = out[start : start + CHUNK]
        moved = np.diff(values[start : start + len(block) + reach], order, axis=0)
        for offset, weight in enumerate(stencil):
            block += weight * moved[offset : offset + len(block)]
        block *= scale
    return out
