"""One zero-phase low-pass for positions, torques and regressor columns alike.

A least-squares fit does not care about a linear filter as long as both sides of Y theta = tau pass
the same one (parallel filtering: Gautier, "Dynamic identification of robots with power model",
ICRA 1997). The filter is a symmetric window of finite length, a sinc times a Kaiser window, so that
it delays nothing, needs no assumption about what happens beyond the ends of a log (the ends are cut
off), and gives the same numbers whether the rows come at once or in chunks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array, checked_array

# Kaiser's design formulas (Oppenheim, Schafer, "Discrete-Time Signal Processing", sec. 7.5.3).
ATTENUATION = 90.0
"""Usual attenuation [dB]: within 1e-4 of one below 0.4 times the cut-off, below 1e-4 above 1.6
times. That is 80 dB; the rest makes up for the formulas being approximate for short kernels."""
_TRANSITION = 1.2
_LONGEST = 1e7
HIGHEST_CUTOFF = 0.3
"""Largest cut-off, as a part of the sample rate, whose stop band still fits below Nyquist."""


@dataclass(frozen=True)
class LowPass:
    """A zero-phase low-pass that also decimates samples out to its own bandwidth.

    Attributes:
        cutoff: frequency passed with half its amplitude [Hz].
        rate: sample rate it works at [Hz].
        kernel: (2 M + 1,) symmetric weights that add up to one.
        step: every how many samples one filtered sample is kept when decimating.
    """

    cutoff: float
    rate: float
    kernel: Array
    step: int

    def __post_init__(self) -> None:
        kernel = checked_array(self.kernel, (None,), "filter kernel")
        if len(kernel) % 2 == 0 or not np.array_equal(kernel, kernel[::-1]):
            raise InputError("a zero-phase filter kernel must be symmetric and of odd length")
        object.__setattr__(self, "kernel", kernel)

    @property
    def half_width(self) -> int:
        """Samples M lost at each end."""
        return len(self.kernel) // 2

    def filtered(self, values: Array) -> Array:
        """Return (N - 2 M, ...) filtered samples of values (N, ...), one per inner sample."""
        from scipy.signal import oaconvolve

        if len(values) < len(self.kernel):
            return np.empty((0, *np.shape(values)[1:]))
        kernel = self.kernel.reshape(-1, *(1,) * (np.ndim(values) - 1))
        return oaconvolve(values, kernel, mode="valid", axes=0)

    def decimated(self, values: Array) -> Array:
        """Return (K, ...) filtered samples of values (N, ...), one per ``step``."""
        return Decimator(self).push(values)

    def centres(self, n_samples: int) -> NDArray[np.int64]:
        """Return (K,) which of ``n_samples`` each decimated sample is centred on."""
        return np.arange(self.half_width, n_samples - self.half_width, self.step)


def design_low_pass(cutoff: float, rate: float, attenuation: float = ATTENUATION) -> LowPass:
    """Return the low-pass with this cut-off.

    Decimated samples come at about twice the cut-off, so that white noise stays nearly white and
    their number says how much the data really holds.

    Args:
        cutoff: [Hz].
        rate: sample rate [Hz].
        attenuation: of the stop band, and how flat the pass band is [dB].

    Raises:
        InputError: the cut-off is not between zero and 0.3 times the sample rate.
    """
    from scipy.signal import firwin, kaiser_beta

    if not 0.0 < cutoff <= HIGHEST_CUTOFF * rate:
        raise InputError(
            f"cut-off {cutoff:g} Hz does not fit a sample rate of {rate:g} Hz; choose --cutoff "
            f"between 0 and {HIGHEST_CUTOFF * rate:g} Hz"
        )
    width = 2.0 * math.pi * _TRANSITION * cutoff / rate
    half = (attenuation - 8.0) / (2.285 * width) / 2.0
    if half > _LONGEST:
        raise InputError(
            f"cut-off {cutoff:g} Hz would average over {2.0 * half / rate:.3g} s, longer than any "
            "log; choose a higher --cutoff"
        )
    half = math.ceil(half)
    kernel = firwin(2 * half + 1, cutoff, window=("kaiser", kaiser_beta(attenuation)), fs=rate)
    return LowPass(cutoff, rate, kernel, max(1, int(rate / (2.0 * cutoff))))


class Decimator:
    """Filters and decimates a stream of samples that arrives in chunks of any size.

    Args:
        low_pass: the filter.
    """

    def __init__(self, low_pass: LowPass) -> None:
        self._kernel = low_pass.kernel
        self._step = low_pass.step
        self._waiting: Array | None = None
        self._skip = 0

    def push(self, values: Array) -> Array:
        """Take the next samples (N, ...) and return the decimated ones (K, ...) they complete."""
        waiting = np.asarray(values, dtype=float)
        if self._waiting is not None:
            waiting = np.concatenate((self._waiting, waiting))
        skipped = min(self._skip, len(waiting))
        self._skip -= skipped
        waiting = waiting[skipped:]
        count = max(0, (len(waiting) - len(self._kernel)) // self._step + 1)
        span = count * self._step
        flat = waiting.reshape(len(waiting), math.prod(waiting.shape[1:]))
        rows, columns = flat.strides
        # What each result sees, (count, taps, columns), without a copy of it.
        size = (count, len(self._kernel), flat.shape[1])
        seen = as_strided(flat, size, (self._step * rows, rows, columns), writeable=False)
        # Not by BLAS: a column comes out alike beside whatever others, with any number of threads.
        out = np.einsum("t,ktc->kc", self._kernel, seen).reshape(count, *waiting.shape[1:])
        self._skip += max(0, span - len(waiting))
        self._waiting = waiting[span:].copy()
        return out
