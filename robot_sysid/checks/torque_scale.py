"""Unit and scale of torque: what is measured over what the model says, joint by joint.

The links before the terminal one are known, so that their torque is a column whose coefficient is
the scale; the terminal link, which is not known, keeps ten columns of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.checks.evidence import Evidence, Sample
from robot_sysid.checks.finding import Finding, Level
from robot_sysid.checks.hypotheses import explains
from robot_sysid.checks.model_fit import Fit, ModelFit, plausible, rms
from robot_sysid.records import Array

REFUSED, WARNED = 1.6, 1.3
"""Factors by which torque may be too large or too small before a log is refused, or warned of."""
SURE = 3.0
"""Standard errors that a joint's scale has to be away from one."""
UNITS = {
    1e3: "mN·m",
    100.0: "N·cm",
    10.197: "kgf·cm",
    8.851: "lbf·in",
    0.7376: "lbf·ft",
    141.6: "ozf·in",
    1e-3: "kN·m",
}
"""Newton metre in other units."""
_CLOSE = 1.25
_SAME = 1.35
# Torque at the joint per ampere of its motor, at most and at least [N m/A].
_PER_AMPERE = (2.0, 25.0)
_ROUNDS = 6
# Mass of a terminal link, as a part of the arm's, that speaks for a wrong scale.
_RATHER_HEAVY = 0.35
# Relative standard error of a joint's scale beyond which it is taken from the other joints.
_KNOWN = 0.3
# Part of the strongest joint's load, by the known links, below which a joint's scale is not asked.
_LOADED = 0.1
_LEAST, _MOST = 1e-4, 1e5
# How far a scale may be from where a round begins.
_FAR = 0.7
_IGNORED = 1e3


def torque_scales(evidence: Evidence, fit: ModelFit) -> tuple[Array, Array]:
    """Return (scale (n,), its relative standard error (n,)): torque column over true torque.

    It begins with the ratio of the usual torques. In each round the torque of the known links is
    one more column in each joint's equation; its coefficient is what is left of the joint's scale.
    """
    sample = evidence.sample
    rest, model = fit.rest_torque(sample), rms(fit.model_torque)
    loaded = rms(rest) > _LOADED * float(np.max(rms(rest)))
    floor = 1e-6 * float(np.max(model))
    scale = np.clip(rms(sample.tau) / np.maximum(model, floor), _LEAST, _MOST)
    # A joint that the known links hardly load tells nothing of its own scale.
    sample = _without(sample, ~loaded)
    own = rest[:, :, None] * np.eye(rest.shape[1])
    spread = np.full(rest.shape[1], _FAR)
    for _ in range(_ROUNDS):
        found = fit.fit(sample.with_torque(1.0 / scale), own, spread, known_links=True)
        left = np.clip(1.0 + found.extra, 0.2, 5.0)
        error = np.where(loaded, found.error / left, np.inf)
        known = error < _KNOWN
        scale = np.clip(np.where(known, scale * left, scale), _LEAST, _MOST)
    if np.any(known):
        scale = np.where(known, scale, np.median(scale[known]))
    return scale, error


def _without(sample: Sample, joints: NDArray[np.bool_]) -> Sample:
    """Return a sample in which some joints (n,) hardly count."""
    return replace(sample, sigma=np.where(joints, _IGNORED, 1.0) * sample.sigma)


def scale_findings(evidence: Evidence, fit: ModelFit, base: Fit) -> Iterator[Finding]:
    """Yield what the scales of the joints that are sure of it say."""
    scale, error = torque_scales(evidence, fit)
    off = np.abs(np.log(scale))
    sure = off > SURE * error
    if not np.any(sure & (off > np.log(WARNED))):
        return
    known = np.flatnonzero(error <= max(_KNOWN, float(np.min(error))))
    if not _better(evidence, fit, scale, known):
        return
    weight = 1.0 / error[known] ** 2
    typical = float(np.exp(np.sum(weight * np.log(scale[known])) / np.sum(weight)))
    spread = float(np.max(scale[known]) / np.min(scale[known]))
    listed = ", ".join(f"{evidence.robot.joint_names[j]} {scale[j]:.3g}" for j in known)
    yield Finding(
        "torque-scale",
        Level.REFUSE if np.any(sure & (off > np.log(REFUSED))) else Level.WARN,
        f"torque reads {typical:.3g} times what the model takes ({listed}): "
        f"{_meaning(typical, spread, float(np.sum(weight) ** -0.5))}",
    )


def _better(evidence: Evidence, fit: ModelFit, scale: Array, known: NDArray[np.int64]) -> bool:
    """Return whether the log is more likely with these scales than without.

    With a wrong scale the terminal link has to make up for the whole arm's torque.
    """
    before = fit.fit(evidence.sample, known_links=True)
    asked = _without(evidence.sample, ~np.isin(np.arange(len(scale)), known))
    after = fit.fit(asked.with_torque(1.0 / scale), known_links=True)
    if not plausible(fit, after):
        return False
    if not plausible(fit, before, _RATHER_HEAVY):
        return True
    return explains(fit.fit(asked, known_links=True), after)


def _meaning(typical: float, spread: float, error: float) -> str:
    """Return what a scale with this relative standard error probably is, and what to do."""
    remedy = "if the model is this arm's, pass --torque-scale"
    if spread > _SAME:
        if typical < 0.5:
            return (
                "a factor of its own for every joint, as motor currents in amperes have (give the "
                "torque per ampere with --torque-constants), or the model of another arm"
            )
        return (
            "a factor of its own for every joint, as per cent of rated torque has, or the model of "
            f"another arm; {remedy} per joint"
        )
    nearest = min(UNITS, key=lambda factor: abs(np.log(typical / factor)))
    if abs(np.log(typical / nearest)) < max(np.log(_CLOSE), SURE * error):
        return f"as in {UNITS[nearest]}; {remedy} {nearest:.4g}"
    if _PER_AMPERE[0] < 1.0 / typical < _PER_AMPERE[1]:
        return "as motor currents in amperes have; give N·m per ampere with --torque-constants"
    if 1.0 / 200.0 < typical < 1.0 / _PER_AMPERE[1]:
        return (
            f"as on the motor's side of a gear of 1:{1.0 / typical:.0f}, or in amperes; give the "
            f"ratio as --torque-scale {typical:.4g}, or --torque-constants"
        )
    return f"another scale, or the model of another arm; {remedy} {typical:.3g}"
