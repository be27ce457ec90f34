"""Estimators by name; a new one is one more line here."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from robot_sysid.errors import InputError
from robot_sysid.estimation.least_squares import (
    EstimatorOptions,
    WeightedEquations,
    ordinary,
    weighted,
)
from robot_sysid.estimation.robust import huber
from robot_sysid.records import Array, SampleSource, SquareRootInformation

Estimator = Callable[
    [SquareRootInformation, Array, EstimatorOptions, "SampleSource | None"], WeightedEquations
]

ESTIMATORS: Mapping[str, Estimator] = {"ols": ordinary, "wls": weighted, "robust": huber}


def estimator(name: str) -> Estimator:
    """Return the estimator with this name.

    Raises:
        InputError: there is none; lists those there are.
    """
    if name not in ESTIMATORS:
        raise InputError(f"unknown method {name!r}; valid: {', '.join(ESTIMATORS)}")
    return ESTIMATORS[name]
