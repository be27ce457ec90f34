"""What limits a result, in plain words, read off its own figures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot_sysid.records import Estimate, Identification
from robot_sysid.spatial import PARAMETER_NAMES, characteristic_length, parameter_scale

WEAK = 0.1
"""Standard error, relative to a body of this mass and size, above which a parameter is weak."""
COLOURED = 0.3
"""Share of independent samples below which residuals are called correlated in time."""
WORSE = 1.5
"""Held-out error over fitted error above which the model, not noise, is the limit."""
PRIOR_SHARE = 0.5


def limitations(found: Identification) -> tuple[str, ...]:
    """Return one sentence per thing that limits the accuracy of an identification."""
    estimate = found.estimate
    return (
        *_blind(estimate),
        *_weak(estimate),
        *_prior(estimate),
        *_coloured(estimate, found.sample_rate),
        *_generalises(found),
        *_constrained(estimate),
    )


def _blind(estimate: Estimate) -> Iterator[str]:
    if estimate.identifiability.blind:
        blind = "; ".join(estimate.identifiability.blind)
        yield f"not visible in these torques, kept from the model: {blind}"


def _weak(estimate: Estimate) -> Iterator[str]:
    """Name the parameters whose standard error is large for a body of this mass and size."""
    if estimate.standard_errors is None:
        return
    theta = estimate.values[:10]
    scale = parameter_scale(max(float(theta[0]), 1e-9), characteristic_length(theta))
    relative = estimate.standard_errors[:10] / scale
    weak = [k for k in np.argsort(-relative) if np.isfinite(relative[k]) and relative[k] > WEAK]
    if weak:
        listed = ", ".join(f"{PARAMETER_NAMES[k]} (±{100.0 * relative[k]:.0f} %)" for k in weak)
        yield (
            f"weakly seen, in percent of what a body of this mass and size has: {listed}; move "
            "faster, wider or longer, or use --excitation optimal"
        )


def _prior(estimate: Estimate) -> Iterator[str]:
    if estimate.data_share is None:
        return
    share = estimate.data_share[:10]
    names = [n for n, s in zip(PARAMETER_NAMES, share) if 0.0 < s < PRIOR_SHARE]
    if names:
        yield f"more model than data in {', '.join(names)}: the prior outweighs the torques there"


def _coloured(estimate: Estimate, rate: float) -> Iterator[str]:
    """Tell when residuals are correlated in time: then more samples do not help."""
    slow = [name for name, share in estimate.independent_share.items() if share < COLOURED]
    if slow:
        yield (
            f"residuals of {', '.join(slow)} are correlated in time: errors of the other links' "
            "parameters or of the friction model limit the result, not sensor noise"
        )


def _generalises(found: Identification) -> Iterator[str]:
    for test in found.validation:
        if test.rmse > WORSE * found.estimate.rmse:
            yield (
                f"torques of {test.source} are predicted {test.rmse / found.estimate.rmse:.1f} "
                "times worse than the fitted ones: the model misses something that motion shows"
            )


def _constrained(estimate: Estimate) -> Iterator[str]:
    if estimate.constrained:
        yield (
            "the plain estimate was no possible rigid body, so the best possible one was taken; "
            "its standard errors are those of the plain estimate"
        )
