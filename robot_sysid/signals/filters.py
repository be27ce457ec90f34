"""One zero-phase low-pass for positions, torques and regressor columns; derivatives; shifts.

A least-squares fit does not change under a linear filter as long as both sides of Y theta = tau
pass the same one (parallel filtering: Gautier, "Dynamic identification of robots with power model",
ICRA 1997). The filter is symmetric and of finite length, a sinc times a Kaiser window: it delays
nothing, assumes nothing beyond the ends of a log (they are cut off), and gives the same numbers
whether the rows come at once or in chunks.

Derivatives and shifts are symmetric finite stencils, exact for polynomials up to their order: at a
tenth of the sample rate an eighth-order difference is exact to 4e-5, one of order sixteen to 2e-9.
How other methods do on encoder data: benchmarks/differentiation_accuracy.py.
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
ATTENUATION = 90.0
"""Usual attenuation [dB]. The gain is within 1e-4 of one below 0.4 times the cut-off and below 1e-4
above 1.6 times. That is 80 dB; the other 10 make up for the formulas being approximate for short
kernels."""
_TRANSITION = 1.2
"""Width of the transition band over the cut-off."""
_FINEST_STRIDE = 6
"""Fewest input samples per decimated sample that a smooth signal needs; the rate of the input is
then twelve times the cut-off."""
_COARSEST_STRIDE = 9
"""Most input samples per decimated sample, where that divides the decimation better (chosen)."""
_FREQUENCIES_PER_WEIGHT = 12
"""Frequencies per weight at which ``LowPass.at_lower_rate`` fits the response of the new filter to
that of the old one (chosen)."""
_STOP_BAND_WEIGHT = 1e-5
"""Weight of frequencies above three cut-offs in the fit of ``LowPass.at_lower_rate``; frequencies
below have weight 1 (chosen)."""
CHUNK = 2048
"""Samples processed at a time: as many as fit into a cache."""
_LONGEST_HALF_WIDTH = 1e7
"""Largest half width of a kernel [samples]; no log is that long: three hours at 1 kHz."""
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
        """Largest spacing [samples] that divides ``step`` and ``half_width`` and suffices for a
        signal without power above nine cut-offs.
        """
        divisor = math.gcd(self.step, self.half_width)
        largest = max(1, self.step // _FINEST_STRIDE)
        return max(width for width in range(1, largest + 1) if divisor % width == 0)

    def at_lower_rate(self, stride: int) -> LowPass:
        """Return the filter for a signal of which only every ``stride``-th sample is given, counted
        from the first; ``stride`` divides ``half_width`` and ``step``.

        The weights minimise the squared difference of the two filters' responses: up to three
        cut-offs they differ by less than 1e-8, above by less than 1e-3. The filter has images
        around multiples of the lower rate.
        """
        if stride == 1:
            return self
        rate = self.rate / stride
        half = self.half_width // stride
        frequency = np.linspace(0.0, rate / 2.0, _FREQUENCIES_PER_WEIGHT * half)
        in_band = frequency <= 3.0 * self.cutoff
        weight = np.where(in_band, 1.0, _STOP_BAND_WEIGHT)[:, None]

        def weighted_cosines(half_width: int, sample_rate: float) -> Array:
            """Return the weighted response (F, half_width + 1) at ``frequency`` per weight of one
            half of a symmetric kernel for a sample rate [Hz], middle first.
            """
            time = np.arange(half_width + 1) / sample_rate
            cosines = weight * np.cos(2.0 * np.pi * np.outer(frequency, time))
            cosines[:, 1:] *= 2.0  # both sides of the centre
            return cosines

        response = weighted_cosines(self.half_width, self.rate)
        target = response @ self.kernel[self.half_width :]
        cosines = weighted_cosines(half, rate)
        # The weights from the middle to one end of the symmetric kernel.
        half_kernel = np.linalg.lstsq(cosines, target, rcond=None)[0]
        kernel = np.concatenate((half_kernel[:0:-1], half_kernel))
        return LowPass(self.cutoff, rate, kernel, self.step // stride)

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
        return Decimator(self).push(values)

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


def design_low_pass(
    cutoff: float, rate: float, attenuation: float = ATTENUATION
) -> LowPass:
    """Return the low-pass with a cut-off [Hz] at a sample rate [Hz].

    The rate of decimated samples is about twice the cut-off, so that white noise stays nearly white
    and the number of rows measures the information in the data.

    Args:
        cutoff: frequency that is passed with half its amplitude [Hz].
        rate: of the samples [Hz].
        attenuation: of the stop band [dB]; it also bounds the ripple of the pass band.

    Raises:
        InputError: the cut-off is too high for the rate, or its kernel longer than any log.
    """
    if not 0.0 < cutoff <= HIGHEST_CUTOFF * rate:
        remedy = f"choose a cut-off between 0 and {HIGHEST_CUTOFF * rate:g} Hz"
        raise InputError(
            f"cut-off {cutoff:g} Hz does not fit a rate of {rate:g} Hz; {remedy}"
        )
    transition = 2.0 * math.pi * _TRANSITION * cutoff / rate
    least_half = (attenuation - 8.0) / (2.285 * transition) / 2.0
    if least_half > _LONGEST_HALF_WIDTH:
        duration = 2.0 * least_half / rate
        fault = f"cut-off {cutoff:g} Hz would average over {duration:.3g} s"
        raise InputError(f"{fault}, longer than any log; choose a higher cut-off")
    step = max(1, int(rate / (2.0 * cutoff)))
    # ``LowPass.stride`` has to divide the step and the half width: of the strides that suffice, the
    # one that shortens the step least, of equal ones the largest.
    fewest = max(2, step // _COARSEST_STRIDE)
    strides = range(fewest, step // _FINEST_STRIDE + 1) or (1,)
    stride = min(strides, key=lambda width: (step % width, -width))
    half = math.ceil(least_half / stride) * stride
    ideal = np.sinc(2.0 * cutoff / rate * np.arange(-half, half + 1))
    kernel = ideal * np.kaiser(2 * half + 1, _kaiser_beta(attenuation))
    return LowPass(cutoff, rate, kernel / np.sum(kernel), step - step % stride)


def _kaiser_beta(attenuation: float) -> float:
    """Return beta of the Kaiser window for an attenuation above 50 dB (sec. 7.5.3)."""
    return 0.1102 * (attenuation - 8.7)


class Decimator:
    """Filters and decimates a stream of samples that arrives in chunks of any size.

    Args:
        low_pass: the filter, which also states how many samples become one.
    """

    def __init__(self, low_pass: LowPass) -> None:
        self._kernel = low_pass.kernel
        self._step = low_pass.step
        # (..., m) samples that later decimated samples need, the latest last; None at first.
        self._waiting: Array | None = None
        # Number of coming samples that no decimated sample needs: for steps longer than the kernel.
        self._skip = 0

    def push(self, values: Array) -> Array:
        """Take the next samples (N, ...) of the stream and return the decimated samples (K, ...),
        K >= 0, that are complete with them.

        ``values`` is not changed, and may be changed after the call: samples that are needed for
        later decimated samples are copied.
        """
        # Successive samples side by side in memory: up to eight times as fast as otherwise.
        waiting = np.ascontiguousarray(np.moveaxis(values, 0, -1), dtype=float)
        if self._waiting is not None:
            waiting = np.concatenate((self._waiting, waiting), axis=-1)
        skipped = min(self._skip, waiting.shape[-1])
        self._skip -= skipped
        waiting = waiting[..., skipped:]
        # Decimated samples that are complete, and the samples from the first window to the next.
        count = max(0, (waiting.shape[-1] - len(self._kernel)) // self._step + 1)
        span = count * self._step
        decimated = np.empty((0, *waiting.shape[:-1]))
        if count:
            windows = sliding_window_view(waiting, len(self._kernel), axis=-1)
            windows = windows[..., :: self._step, :]
            # Not by BLAS, so that a column's digits depend neither on the columns beside it nor on
            # the number of threads.
            decimated = np.einsum("...kt,t->k...", windows, self._kernel)
        self._skip += max(0, span - waiting.shape[-1])
        self._waiting = waiting[..., span:].copy()
        return decimated


REACH = 4
"""Samples lost at each end by a derivative of the usual order, eight."""
FINE_REACH = 8
"""Samples lost at each end by a derivative of order sixteen, for positions nearly without noise."""
SHIFT_REACH = 32
"""Samples lost at each end by a shift, besides the shift itself."""
_SHIFT_ATTENUATION = 100.0
"""Attenuation of the Kaiser window of ``shift_samples`` [dB]: its gain is 1 to within 1e-5 up to
0.8 times the Nyquist frequency."""


def first_derivative(values: Array, rate: float, reach: int = REACH) -> Array:
    """Return the time derivative of values (N, ...) sampled at ``rate`` [Hz], (N - 2 reach, ...).

    A central difference of order 2 reach: the sample k steps later has the weight w_k / k, the
    sample k steps earlier -w_k / k, w_k = (-1)^(k + 1) C(2 reach, reach - k) / C(2 reach, reach)
    (Fornberg, "Generation of finite difference formulas", Math. Comp. 51, 1988).
    """
    ahead, weights = _central_weights(reach)
    later = weights / ahead
    stencil = np.concatenate((-later[::-1], [0.0], later))
    return rate * _correlate(values, stencil)


def second_derivative(values: Array, rate: float, reach: int = REACH) -> Array:
    """Return the second time derivative of values (N, ...) sampled at ``rate`` [Hz],
    (N - 2 reach, ...).

    A central difference of order 2 reach: the samples k steps later and earlier have the weight
    2 w_k / k^2, w_k = (-1)^(k + 1) C(2 reach, reach - k) / C(2 reach, reach); the weight of the
    middle sample makes the sum of all weights zero.
    """
    ahead, weights = _central_weights(reach)
    later = 2.0 * weights / ahead**2
    stencil = np.concatenate((later[::-1], [-2.0 * np.sum(later)], later))
    return rate**2 * _correlate(values, stencil)


def _central_weights(reach: int) -> tuple[Array, Array]:
    """Return k = 1 ... reach, and w_k = (-1)^(k + 1) C(2 reach, reach - k) / C(2 reach, reach), of
    which the weights of central differences are made; each (reach,).
    """
    ahead = range(1, reach + 1)
    weights = [-((-1) ** k) * math.comb(2 * reach, reach - k) for k in ahead]
    return np.array(ahead, dtype=float), np.array(weights) / math.comb(2 * reach, reach)


def shift_samples(values: Array, samples: float) -> tuple[Array, int]:
    """Return (shifted (K, ...), first): values (N, ...) as they are ``samples`` sample steps later.

    shifted[k] is the value at the position k + first + samples; ``samples`` may be negative and
    need not be whole. Values at the ends that cannot be computed are left out.

    The fraction of a sample is a sinc series, exact for band-limited signals, cut off by a window;
    whole samples are shifted by slicing, without any error.
    """
    whole_samples = math.floor(samples + 0.5)
    fraction = samples - whole_samples
    offset = np.arange(-SHIFT_REACH, SHIFT_REACH + 1) - fraction
    inside = np.maximum(0.0, 1.0 - (offset / (SHIFT_REACH + 1)) ** 2)
    window = np.i0(_kaiser_beta(_SHIFT_ATTENUATION) * np.sqrt(inside))
    stencil = np.sinc(offset) * window
    inner = _correlate(values, stencil / stencil.sum())
    if whole_samples < 0:
        return inner[:whole_samples], SHIFT_REACH - whole_samples
    return inner[whole_samples:], SHIFT_REACH


def _correlate(values: Array, stencil: Array) -> Array:
    """Return the sums of values (N, ...) under a stencil (S,), (N - S + 1, ...)."""
    from scipy.ndimage import correlate1d

    reach = len(stencil) // 2
    sums = correlate1d(values, stencil, axis=0)
    return np.asarray(sums[reach : len(values) - reach])
