"""How far the payload may be off, cause by cause."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.estimation.autocorrelation import collect_residuals
from robot_sysid.estimation.identifiability import visible_space
from robot_sysid.estimation.least_squares import no_clip
from robot_sysid.estimation.uncertainty import Uncertainty, coloured_uncertainty
from robot_sysid.identify.judgement.filtering import FILTERING
from robot_sysid.identify.payload.equations import Recording
from robot_sysid.identify.payload.joint_fit import JointFit
from robot_sysid.identify.samples import joined
from robot_sysid.records import Array

_ROUNDING = 1e-9


@dataclass(frozen=True)
class FitErrors:
    """The errors of all parameters of a fit.

    Attributes:
        whole: of all causes, noise correlated in time.
        noise: (p, p) covariance of what torque noise explains.
        causes: cause to (p, p) covariance of what it explains.
        data: (p, p) normal matrix of the data alone, weighted.
    """

    whole: Uncertainty
    noise: Array
    causes: Mapping[str, Array]
    data: Array

    def white(self, change: Array) -> Array:
        """Return (k,) what the noise errors would be if the noise were white."""
        root = change @ self.whole.inverse
        return np.sqrt(np.maximum(np.diag(root @ self.data @ root.T), 0.0))

    def of(self, change: Array) -> tuple[Array, Array, Mapping[str, Array]]:
        """Return (covariance, noise errors, budget) of linear combinations (k, p)."""
        blind = ~self.shown(change)

        def spread(covariance: Array) -> Array:
            root = np.sqrt(np.maximum(np.diag(change @ covariance @ change.T), 0.0))
            return np.where(blind, np.inf, root)

        covariance = change @ self.whole.covariance @ change.T
        budget = {cause: spread(part) for cause, part in self.causes.items()}
        return covariance, spread(self.noise), budget

    def shown(self, change: Array) -> NDArray[np.bool_]:
        """Return (k,) whether combinations (k, p) contain nothing that the data hides."""
        hidden = np.isinf(self.whole.standard_errors)
        return np.asarray(np.max(np.abs(change[:, hidden]), axis=1, initial=0.0) < _ROUNDING)


def fit_errors(fit: JointFit, recordings: Sequence[Recording]) -> FitErrors:
    """Return the errors of a fit to recordings; noise may be correlated in time."""
    information, weights = fit.weighted.information, 1.0 / fit.weighted.noise
    root = visible_space(fit.weighted.whitened()[0]).inverse_root()
    samples = joined(fit.samples)
    clip = no_clip(information)
    residuals = collect_residuals(information, samples, fit.values, clip, root, weights)
    whole, _ = coloured_uncertainty(information, weights, residuals)
    names = information.names
    causes = {
        group.cause: whole.inverse @ group.precision(names) @ whole.inverse for group in fit.groups
    }
    noise = whole.covariance - np.sum(list(causes.values()), axis=0)
    matrix = replace(information, prior=None).stacked(weights)[0]
    logs = zip(recordings, fit.samples)
    pull = np.sum([fit.equations.filtering_pull(*log, fit.values) for log in logs], axis=0)
    bias = whole.inverse @ (weights**2 @ pull)
    causes[FILTERING] = np.outer(bias, bias)
    whole = replace(
        whole,
        covariance=whole.covariance + causes[FILTERING],
        standard_errors=np.hypot(whole.standard_errors, bias),
    )
    return FitErrors(whole, noise, causes, matrix.T @ matrix)
