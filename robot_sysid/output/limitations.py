"""What limits a result, in plain words, read off its own figures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot_sysid.dynamics.friction import friction_model
from robot_sysid.dynamics.spatial import PARAMETER_NAMES, characteristic_length, parameter_scale
from robot_sysid.records import DELAY_NAME, Estimate, Identification
from robot_sysid.records.figures import percent

WEAK = 0.1
"""Standard error, relative to a body of this mass and size, above which a parameter is weak."""
COLOURED = 0.3
"""Share of independent samples below which residuals are called correlated in time."""
WORSE = 1.5
"""Held-out error over fitted error above which the model, not noise, is the limit."""
PRIOR_SHARE = 0.5
"""Share of the data in a value below which the model has more say."""
SURE = 3.0
"""Standard errors from zero beyond which a sign is sure."""


def limitations(found: Identification) -> tuple[str, ...]:
    """Return one sentence per thing that limits the accuracy of an identification."""
    if not found.data.source.is_measured:
        return ()
    estimate = found.estimate
    return (
        *_unidentifiable(estimate),
        *_weak(estimate),
        *_prior(estimate),
        *_misfits(found),
        *_early_torque(found),
        *_negative_friction(found),
        *_coloured(estimate),
        *_generalises(found),
        *_constrained(estimate),
    )


def _unidentifiable(estimate: Estimate) -> Iterator[str]:
    if estimate.identifiability.unidentifiable:
        listed = "; ".join(estimate.identifiability.unidentifiable)
        yield f"not visible in these torques, kept from the model: {listed}"


def _weak(estimate: Estimate) -> Iterator[str]:
    """Name the parameters whose standard error is large for a body of this mass and size."""
    if estimate.standard_errors is None:
        return
    theta = estimate.values[:10]
    scale = parameter_scale(max(float(theta[0]), 1e-9), characteristic_length(theta))
    relative = estimate.standard_errors[:10] / scale
    weak = [k for k in np.argsort(-relative) if np.isfinite(relative[k]) and relative[k] > WEAK]
    if weak:
        listed = ", ".join(f"{PARAMETER_NAMES[k]} (± {percent(relative[k])})" for k in weak)
        yield (
            f"weakly seen, in percent of what a body of this mass and size has: {listed}; move "
            "faster, wider or longer, or use --excitation optimal"
        )


def _prior(estimate: Estimate) -> Iterator[str]:
    if estimate.data_share is None:
        return
    rows = zip(PARAMETER_NAMES, estimate.data_share, estimate.identifiability.identified)
    names = [name for name, share, seen in rows if seen and share < PRIOR_SHARE]
    if names:
        yield f"more model than data in {', '.join(names)}: the prior outweighs the torques there"


_EARLY = 2.0
_MISFIT = {
    "links": "the model's numbers of other links do not fit this arm",
    "torque scale": "the scale of the torques does not fit the model",
    "joint offsets": "zero positions of joints do not fit the model",
    "gravity": "the base is not level as in the model",
    "friction model": "the joints' friction follows another law than the one that was fitted",
}


def _misfits(found: Identification) -> Iterator[str]:
    """Tell what the data asks for that the model does not have."""
    for misfit in found.misfits:
        words = f"{_MISFIT[misfit.cause]} (most: {', '.join(misfit.members[:3])})"
        if misfit.widened > 1.0:
            yield (
                f"{words}: they are {misfit.asked:.2g} times as far off as was allowed, and the "
                "errors above were widened for it"
            )
        else:
            yield f"{words}; the errors above allow for that"


def _early_torque(found: Identification) -> Iterator[str]:
    """Tell of a torque that comes before the motion it belongs to, which no sensor does."""
    error = found.estimate.error(DELAY_NAME)
    if found.delay is not None and error is not None and found.delay < -_EARLY * error:
        yield (
            f"the torque seems to come {-1e3 * found.delay:.2g} ms before the motion: the "
            "positions are late, or friction turns earlier than the speed does; trust neither"
        )


def _negative_friction(found: Identification) -> Iterator[str]:
    """Name joints that would drive themselves, more clearly than noise explains."""
    model, estimate = friction_model(found.friction_model or "none"), found.estimate
    bounded = [term for term, bound in zip(model.terms, model.non_negative) if bound]
    clear = []
    for joint in found.joint_names:
        for term in bounded:
            value, error = (f(f"{term}[{joint}]") for f in (estimate.value, estimate.error))
            if value is not None and error is not None and value < -SURE * error:
                clear.append(f"{term} {value:.2g} of {joint}")
    if clear:
        yield (
            f"friction that drives instead of brakes ({', '.join(clear)}): check the sign and the "
            "scale of these torques, or let --friction-model auto choose other terms"
        )


def _coloured(estimate: Estimate) -> Iterator[str]:
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
