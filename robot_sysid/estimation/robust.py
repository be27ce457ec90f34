"""Huber's robust regression: samples far off the fit lose weight, found in passes over the data.

Minimises sum rho(r / sigma_j) with rho quadratic up to a threshold k and linear beyond, by
iteratively reweighted least squares with weights min(1, k sigma_j / |r|) (Huber, "Robust estimation
of a location parameter", 1964; Holland, Welsch 1977). sigma_j is 1.4826 times the median of |r|,
read off a histogram, so that memory does not grow with the number of samples.
"""

from __future__ import annotations

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.estimation.information import InformationAccumulator
from robot_sysid.estimation.least_squares import (
    MOST_ROUNDS,
    WeightedEquations,
    least_squares,
    left_in,
    noise_floor,
    weighted,
)
from robot_sysid.records import Array, SampleSource, SquareRootInformation

THRESHOLD = 1.345
"""Residuals beyond so many noise standard deviations lose weight; 1.345 costs 5 % efficiency where
there are no outliers (Huber 1964)."""
_SETTLED = 1e-3
_MEDIAN_TO_SIGMA = 1.4826
_BINS_PER_DECADE = 200
_DECADES = 8


def huber(
    information: SquareRootInformation,
    prior: Array,
    samples: SampleSource | None = None,
) -> WeightedEquations:
    """Down-weight outliers.

    Args:
        information: all samples, unweighted.
        prior: (p,) the model's values.
        samples: the same equations sample by sample, readable several times.

    Raises:
        InputError: no samples, or samples that can be read only once.
    """
    if samples is None:
        raise InputError("the method 'robust' needs the samples themselves; use 'ols' or 'wls'")
    start = weighted(information, prior)
    values = least_squares(information, prior, 1.0 / start.noise)
    never = np.full(len(start.noise), np.inf)
    noise = _reweigh(information, samples, values, never)[1]
    for _ in range(MOST_ROUNDS):
        clip = THRESHOLD * noise
        reweighed, next_noise = _reweigh(information, samples, values, clip)
        before, values = values, least_squares(reweighed, prior, 1.0 / noise)
        moved = reweighed.stacked(1.0 / noise)[0] @ (values - before)
        if moved @ moved < _SETTLED**2:
            break
        noise = next_noise
    return WeightedEquations(reweighed, noise, clip)


def _reweigh(
    information: SquareRootInformation, samples: SampleSource, values: Array, clip: Array
) -> tuple[SquareRootInformation, Array]:
    """Return (reweighted information, (joints,) robust noise of the residuals at ``values``)."""
    joints = information.joints
    accumulator = InformationAccumulator(
        information.names, [j.joint for j in joints], [j.columns for j in joints]
    )
    rms = np.sqrt(information.squared_residuals(values) / np.maximum(_counts(information), 1.0))
    floor = noise_floor(information)
    medians = [_StreamingMedian(max(scale, floor)) for scale in rms]
    for index, rows, tau in left_in(samples):
        residual = tau - rows @ values[joints[index].columns]
        medians[index].add(np.abs(residual))
        root = np.sqrt(np.minimum(1.0, clip[index] / np.maximum(np.abs(residual), floor)))
        accumulator.add(index, root[:, None] * rows, root * tau)
    result = accumulator.result()
    if result.n_samples != information.n_samples:
        raise InputError(
            f"the samples gave {result.n_samples} equations, not {information.n_samples} as "
            "before; they must be readable several times and stay the same"
        )
    noise = np.array([_MEDIAN_TO_SIGMA * median.value for median in medians])
    return result, np.maximum(noise, floor)


def _counts(information: SquareRootInformation) -> Array:
    return np.array([joint.n_samples for joint in information.joints], dtype=float)


class _StreamingMedian:
    """Median of positive numbers from a histogram with logarithmic bins, 1.2 % wide."""

    def __init__(self, scale: float) -> None:
        half = _DECADES * _BINS_PER_DECADE // 2
        self._edges = scale * 10.0 ** (np.arange(-half, half + 1) / _BINS_PER_DECADE)
        self._counts = np.zeros(len(self._edges) + 1, dtype=np.int64)

    def add(self, numbers: Array) -> None:
        where = np.searchsorted(self._edges, numbers)
        self._counts += np.bincount(where, minlength=len(self._counts))

    @property
    def value(self) -> float:
        """The median, to within a bin."""
        below = np.cumsum(self._counts)
        k = int(np.searchsorted(below, 0.5 * below[-1]))
        return float(self._edges[min(k, len(self._edges) - 1)])
