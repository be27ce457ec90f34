"""Huber's robust regression: samples far off the fit lose weight, found in passes over the data.

Minimises sum rho(r / sigma_j) with rho quadratic up to a threshold k and linear beyond, by
iteratively reweighted least squares with weights min(1, k sigma_j / |r|) (Huber, "Robust estimation
of a location parameter", 1964; Holland, Welsch 1977). sigma_j is 1.4826 times the median of |r|.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.information import InformationAccumulator, joint_rmse
from robot_sysid.estimation.algebra.least_squares import (
    MOST_ROUNDS,
    WeightedEquations,
    least_squares,
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
    start: Array | None = None,
) -> WeightedEquations:
    """Down-weight outliers.

    Args:
        information: all samples, unweighted.
        prior: (p,) the model's values.
        samples: the same equations sample by sample.
        start: (joints,) noise to begin with.

    Raises:
        InputError: no samples.
    """
    if samples is None:
        raise InputError("the method 'robust' needs the samples themselves; use 'ols' or 'wls'")
    first = weighted(information, prior, start=start)
    values = least_squares(information, prior, 1.0 / first.noise)
    never = np.full(len(first.noise), np.inf)
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
    rms, floor = joint_rmse(information, values), noise_floor(information)
    noise = np.zeros(len(joints))
    for index, rows, tau in samples:
        used = np.isfinite(tau)
        rows, tau = rows[used], tau[used]
        size = np.abs(tau - rows @ values[joints[index].columns])
        noise[index] = _MEDIAN_TO_SIGMA * _binned_median(size, max(rms[index], floor))
        root = np.sqrt(np.minimum(1.0, clip[index] / np.maximum(size, floor)))
        accumulator.add(index, root[:, None] * rows, root * tau)
    return replace(accumulator.result(), prior=information.prior), np.maximum(noise, floor)


def _binned_median(numbers: Array, scale: float) -> float:
    """Return the median of positive numbers to within a logarithmic bin, 1.2 % wide.

    Args:
        numbers: (N,) of any size.
        scale: near the middle of the bins.
    """
    half = _DECADES * _BINS_PER_DECADE // 2
    edges = scale * 10.0 ** (np.arange(-half, half + 1) / _BINS_PER_DECADE)
    counts = np.bincount(np.searchsorted(edges, numbers), minlength=len(edges) + 1)
    below = np.cumsum(counts)
    k = int(np.searchsorted(below, 0.5 * below[-1]))
    return float(edges[min(k, len(edges) - 1)])
