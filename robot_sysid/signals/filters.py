"""One zero-phase low-pass for positions, torques and regressor columns, and derivatives.

A least-squares fit does not change under a linear filter as long as both sides of Y theta = tau
pass the same one (parallel filtering: Gautier, "Dynamic identification of robots with power model",
ICRA 1997). The filter is symmetric and of finite length, a sinc times a Kaiser window: it delays
nothing, and assumes nothing beyond the ends of a log (they are cut off).

Derivatives are symmetric finite stencils of order sixteen: at a tenth of the sample rate they are
exact to 2e-9. How other methods do on encoder data: benchmarks/differentiation_accuracy.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array

# Kaiser's design formulas (Oppenheim, Schafer, "Discrete-Time Signal Processing", sec. 7.5.3).
_ATTENUATION = 90.0
"""Attenuation [dB]. The gain is within 1e-4 of one below 0.4 times the cut-off and below 1e-4 above
1.6 times. That is 80 dB; the other 10 make up for the formulas being approximate for short kernels.
"""
_FINE_ATTENUATION = 170.0
"""Attenuation of what is removed before a signal gets the coarse rate [dB]: smooth signals do not
pass it."""
_TRANSITION = 1.2
"""Width of the transition band over the cut-off."""
_COARSE_RATE = 24.0
"""Rate that a smooth signal needs, over the cut-off."""
_LOWEST_CUTOFF = 1e-3
"""Lowest cut-off [Hz]; no log that is filtered in one piece is long enough for a lower one."""
HIGHEST_CUTOFF = 0.3
"""Largest cut-off over the sample rate for which the stop band begins below Nyquist."""


@dataclass(frozen=True)
class LowPass:
    """A zero-phase low-pass that also decimates samples to its own bandwidth.

    Attributes:
        cutoff: frequency that is passed with half its amplitude [Hz].
        rate: of the samples [Hz].
        kernel: (2 M + 1,) symmetric weights that add up to one.
        step: number of input samples per decimated sample.
        stride: spacing of the samples that suffice for a smooth signal, without power above twenty
            cut-offs.
        coarse: (2 m + 1,) weights of these samples: ``kernel`` without what they do not need.
    """

    cutoff: float
    rate: float
    kernel: Array
    step: int
    stride: int
    coarse: Array

    @property
    def half_width(self) -> int:
        """Samples M lost at each end."""
        return len(self.kernel) // 2

    def filter(self, values: Array) -> Array:
        """Return (N - 2 M, ...) filtered samples of values (N, ...): all but M at each end."""
        # scipy.signal does the same, and costs more to import than the filter takes.
        from scipy.fft import irfft, next_fast_len, rfft

        if len(values) < len(self.kernel):
            return values[:0]
        size = next_fast_len(len(values), real=True)
        gain = rfft(self.kernel, size).reshape(-1, *(1,) * (np.ndim(values) - 1))
        convolution = irfft(gain * rfft(values, size, axis=0), size, axis=0)
        return np.asarray(convolution[len(self.kernel) - 1 : len(values)])

    def decimate(self, values: Array) -> Array:
        """Return (K, ...) filtered samples of values (N, ...), one per ``step`` samples."""
        return _decimate(values, self.kernel, self.step)

    def decimate_smooth(self, values: Array) -> Array:
        """Return ``decimate`` of a smooth signal, of which every ``stride``-th sample is given,
        from the first that ``coarse`` needs (``window``).
        """
        return _decimate(values, self.coarse, self.step // self.stride)

    def window(self, start: int, count: int, smooth: bool) -> slice:
        """Return the samples that ``count`` decimated samples need, from number ``start`` on: all
        of them, or those that are enough for a smooth signal.
        """
        first = start * self.step
        last = first + (count - 1) * self.step + len(self.kernel)
        if not smooth:
            return slice(first, last)
        margin = self.half_width - len(self.coarse) // 2 * self.stride
        return slice(first + margin, last - margin, self.stride)

    def weight_shares(self, is_marked: NDArray[np.bool_]) -> Array:
        """Return (K, ...) the share of each decimated sample's weight that lies on marked samples
        (N, ...).
        """
        weight = np.abs(self.kernel)
        averaging = replace(self, kernel=weight / np.sum(weight))
        return averaging.decimate(is_marked.astype(float))

    def centres(self, n_samples: int) -> NDArray[np.int64]:
        """Return the indices (K,) of the input samples, of ``n_samples``, at the instants of the
        decimated samples.
        """
        return np.arange(self.half_width, n_samples - self.half_width, self.step)


def design_low_pass(cutoff: float, rate: float) -> LowPass:
    """Return the low-pass with a cut-off [Hz] at a sample rate [Hz].

    The rate of decimated samples is about twice the cut-off, so that white noise stays nearly white
    and the number of rows measures the information in the data.

    Args:
        cutoff: frequency that is passed with half its amplitude [Hz].
        rate: of the samples [Hz].

    Raises:
        InputError: the cut-off is too high for the rate, or its kernel longer than any log.
    """
    if not 0.0 < cutoff <= HIGHEST_CUTOFF * rate:
        remedy = f"choose a cut-off between 0 and {HIGHEST_CUTOFF * rate:g} Hz"
        raise InputError(
            f"cut-off {cutoff:g} Hz does not fit a rate of {rate:g} Hz; {remedy}"
        )
    if cutoff < _LOWEST_CUTOFF:
        raise InputError(
            f"cut-off {cutoff:g} Hz would average over {4.0 / cutoff:.3g} s, longer than any log; "
            "choose a higher cut-off"
        )
    stride = max(1, int(rate / (_COARSE_RATE * cutoff)))
    transition = _TRANSITION * cutoff
    coarse = _sinc_kernel(cutoff, transition, rate / stride, _ATTENUATION)
    kernel = coarse
    if stride > 1:
        # What lies around multiples of the coarse rate is removed first.
        spread = np.zeros(stride * (len(coarse) - 1) + 1)
        spread[::stride] = coarse
        middle = 0.5 * _COARSE_RATE * cutoff
        width = (_COARSE_RATE - 2.0) * cutoff - transition
        fine = _sinc_kernel(middle, width, rate, _FINE_ATTENUATION)
        kernel = np.convolve(spread, fine)
    step = stride * max(1, int(rate / stride / (2.0 * cutoff)))
    return LowPass(cutoff, rate, kernel, step, stride, coarse)


def _sinc_kernel(
    cutoff: float, transition: float, rate: float, attenuation: float
) -> Array:
    """Return the weights of a low-pass with a cut-off and a transition band around it [Hz], for a
    sample rate [Hz] and an attenuation [dB].
    """
    half = math.ceil((attenuation - 8.0) / (2.285 * 4.0 * math.pi * transition / rate))
    ideal = np.sinc(2.0 * cutoff / rate * np.arange(-half, half + 1))
    kernel = ideal * np.kaiser(2 * half + 1, 0.1102 * (attenuation - 8.7))
    return np.asarray(kernel / np.sum(kernel))


def _decimate(values: Array, kernel: Array, step: int) -> Array:
    """Return (K, ...) filtered samples of values (N, ...), one per ``step`` samples."""
    if len(values) < len(kernel):
        return np.zeros((0, *np.shape(values)[1:]))
    # Successive samples side by side in memory: up to eight times as fast as otherwise.
    samples = np.ascontiguousarray(np.moveaxis(values, 0, -1), dtype=float)
    windows = sliding_window_view(samples, len(kernel), axis=-1)[..., ::step, :]
    # Not by BLAS, so that a column's digits depend neither on the columns beside it nor on the
    # number of threads.
    return np.einsum("...kt,t->k...", windows, kernel)


REACH = 8
"""Samples lost at each end by a derivative."""


def derivatives(values: Array, rate: float) -> tuple[Array, Array]:
    """Return the first and second time derivatives (N - 2 REACH, ...) of values (N, ...) sampled at
    a rate [Hz].

    They are central differences of order 2 r, r = REACH: the samples k steps later and earlier have
    the weights w_k / k and -w_k / k in the first one and 2 w_k / k^2 in the second one, where
    w_k = (-1)^(k + 1) C(2 r, r - k) / C(2 r, r) (Fornberg, "Generation of finite difference
    formulas", Math. Comp. 51, 1988); the weight of the middle sample makes their sum zero.
    """
    from scipy.ndimage import correlate1d

    ahead = np.arange(1.0, REACH + 1.0)
    binomials = [math.comb(2 * REACH, REACH - int(k)) for k in ahead]
    weights = -((-1.0) ** ahead) * binomials / math.comb(2 * REACH, REACH)
    slope = weights / ahead
    curvature = 2.0 * weights / ahead**2
    first = np.concatenate((-slope[::-1], [0.0], slope))
    middle = [-2.0 * np.sum(curvature)]
    second = np.concatenate((curvature[::-1], middle, curvature))
    inner = slice(REACH, len(values) - REACH)
    return (
        rate * correlate1d(values, first, axis=0)[inner],
        rate**2 * correlate1d(values, second, axis=0)[inner],
    )
