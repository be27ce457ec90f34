"""One zero-phase low-pass for positions, torques and regressor columns, and derivatives.

A least-squares fit does not change under a linear filter as long as both sides of Y theta = tau
pass the same one (parallel filtering: Gautier, "Dynamic identification of robots with power model",
ICRA 1997). The filter is symmetric and of finite length, a sinc times a Kaiser window: it delays
nothing, and assumes nothing beyond the ends of a log (they are cut off).

Derivatives are symmetric finite stencils of order sixteen: at a tenth of the sample rate they are
exact to 2e-9. How other methods do on encoder data:
benchmarks/accuracy/differentiation_accuracy.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array


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

    def decimate(self, values: Array) -> Array:
        """Return (K, ...) filtered samples of values (N, ...), one per ``step`` samples."""
        return _weighted_sums(values, self.kernel, self.step)

    def weight_shares(self, is_marked: NDArray[np.bool_]) -> Array:
        """Return (K, ...) the share of each decimated sample's weight that lies on marked samples
        (N, ...).
        """
        weight = np.abs(self.kernel)
        return _weighted_sums(
            is_marked.astype(float), weight / np.sum(weight), self.step
        )


LOWEST_CUTOFF = 1e-3
"""Lowest cut-off [Hz]: no log that is filtered in one piece is long enough for a lower one."""
HIGHEST_CUTOFF = 0.3
"""Highest cut-off over the sample rate: the stop band of a higher one would begin above Nyquist."""
ATTENUATION = 90.0
"""Attenuation of the stop band [dB]: 80, or a gain below 1e-4, and 10 that make up for the design
formulas being approximate for short kernels."""
TRANSITION = 1.2
"""Width of the transition over the cut-off: from 0.4 to 1.6 times the cut-off."""


def design_low_pass(cutoff: float, rate: float) -> LowPass:
    """Return the low-pass with a cut-off [Hz] at a sample rate [Hz].

    It is a sinc times a Kaiser window. The rate of decimated samples is about twice the cut-off, so
    that white noise stays nearly white and the number of rows measures the information in the data.

    Args:
        cutoff: frequency that is passed with half its amplitude [Hz].
        rate: of the samples [Hz].

    Raises:
        InputError: the cut-off is too high for the rate, or its kernel longer than any log.
    """
    highest = HIGHEST_CUTOFF * rate
    if not LOWEST_CUTOFF <= cutoff <= highest:
        raise InputError(
            f"cut-off {cutoff:g} Hz does not fit a rate of {rate:g} Hz; choose a cut-off between "
            f"{LOWEST_CUTOFF:g} and {highest:g} Hz"
        )
    # Kaiser's design formulas (Oppenheim, Schafer, "Discrete-Time Signal Processing", sec. 7.5.3).
    # The gain is within 1e-4 of one below the transition, and below 1e-4 above it.
    band = 4.0 * math.pi * TRANSITION * cutoff / rate
    half = math.ceil((ATTENUATION - 8.0) / (2.285 * band))
    ideal = np.sinc(2.0 * cutoff / rate * np.arange(-half, half + 1))
    kernel = ideal * np.kaiser(2 * half + 1, 0.1102 * (ATTENUATION - 8.7))
    step = max(1, int(rate / (2.0 * cutoff)))
    return LowPass(cutoff, rate, kernel / np.sum(kernel), step)


def _weighted_sums(values: Array, weights: Array, step: int = 1) -> Array:
    """Return (K, ...) sums of values (N, ...) with weights (2 M + 1,) around each sample that has
    M neighbours on both sides, or around every ``step``-th of these.
    """
    if len(values) < len(weights):
        return np.zeros((0, *np.shape(values)[1:]))
    # Successive samples side by side in memory: up to eight times as fast as otherwise.
    samples = np.ascontiguousarray(np.moveaxis(values, 0, -1), dtype=float)
    windows = sliding_window_view(samples, len(weights), axis=-1)
    # Not by BLAS, so that a column's digits depend neither on the columns beside it nor on the
    # number of threads.
    return np.einsum("...kt,t->k...", windows[..., ::step, :], weights)


def integrate(values: Array, time: Array) -> Array:
    """Return the integrals (N, n) of values (N, n) from the first instant on, by trapezoids.

    ``time``: (N,) [s].
    """
    means = 0.5 * (values[1:] + values[:-1])
    steps = np.diff(time)[:, None] * means
    return np.concatenate((np.zeros_like(steps[:1]), np.cumsum(steps, axis=0)))


REACH = 8
"""Samples lost at each end by a derivative."""


def derivatives(values: Array, rate: float) -> tuple[Array, Array]:
    """Return the first and second time derivatives (N - 2 REACH, ...) of values (N, ...) sampled at
    a rate [Hz].

    They are central differences of order 2 r, r = REACH: the sample k steps later, or earlier for
    a negative k, has the weights w_k / k in the first one and 2 w_k / k^2 in the second one, where
    w_k = (-1)^(k + 1) C(2 r, r - k) / C(2 r, r) (Fornberg, "Generation of finite difference
    formulas", Math. Comp. 51, 1988); the weight of the middle sample makes their sum zero.
    """
    steps = np.arange(-REACH, REACH + 1.0)
    counts = [math.comb(2 * REACH, k) for k in range(2 * REACH + 1)]
    weights = -((-1.0) ** steps) * counts / math.comb(2 * REACH, REACH)
    steps[REACH] = np.inf
    first = weights / steps
    second = 2.0 * first / steps
    second[REACH] = -np.sum(second)
    return (
        rate * _weighted_sums(values, first),
        rate**2 * _weighted_sums(values, second),
    )
