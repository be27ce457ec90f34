"""Torques without gravity, without the whole model, or computed instead of measured."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot_sysid.checks.evidence import Evidence
from robot_sysid.checks.finding import Finding, Level
from robot_sysid.checks.model_fit import Fit, ModelFit, plausible, rms
from robot_sysid.checks.torque_scale import torque_scales
from robot_sysid.records.figures import percent

SMALL = 0.6
"""Size of a torque without gravity over that of the model, at most."""
_NO_MORE = 1.3
_EXACT, _FRICTIONLESS = 0.02, 5e-3
# Noise in a torque that somebody computed, as a part of it.
_QUIET = 1e-3
# Joints that carry less than this part of the strongest are not asked.
_LOADED = 0.1


def gravity_findings(evidence: Evidence, fit: ModelFit, best: float) -> Iterator[Finding]:
    """Yield a finding where the torque fits without gravity or without any link.

    Args:
        evidence: the log.
        fit: its fits.
        best: least cost of a fit with another explanation, or with none.
    """
    sample = evidence.sample
    size = float(np.median((rms(sample.tau) / rms(fit.model_torque))[loaded(fit)]))
    if size > SMALL:
        return
    alone = fit.fit(sample, known_links=True, links_out=True, no_terminal=True, rotor=False)
    weightless = fit.fit(sample, weightless=True)
    scale, _ = torque_scales(evidence, fit)
    scaled = fit.fit(sample.with_torque(1.0 / scale))
    least = min(alone.cost, weightless.cost)
    if least > best or (scaled.cost < least and plausible(fit, scaled)):
        return
    if alone.cost >= _NO_MORE * weightless.cost and not plausible(fit, weightless):
        return
    if alone.cost < _NO_MORE * weightless.cost:
        text = (
            f"the torque is {size:.2g} times as large as the model's and has nothing of its motion "
            "but friction: this is an external torque, what is left after the controller's model; "
            "record the measured joint torque"
        )
    else:
        text = (
            f"the torque is {size:.2g} times as large as the model's and fits it without gravity: "
            "gravity is compensated in it already; record the measured joint torque, not the "
            "command"
        )
    yield Finding("gravity", Level.REFUSE, text)


def computed_findings(evidence: Evidence, fit: ModelFit, base: Fit) -> Iterator[Finding]:
    """Yield a finding where the torque is the model's own, without noise and friction."""
    sample, joints = evidence.sample, loaded(fit)
    usual = rms(sample.tau)
    exact = rms(base.residual) < _EXACT * usual
    friction = rms(base.friction_torque) < _FRICTIONLESS * usual
    quiet = evidence.noise < _QUIET * usual
    if np.all((exact & friction & quiet)[joints]):
        yield Finding(
            "computed",
            Level.WARN,
            "the torque follows rigid-body dynamics to "
            f"{percent(float(np.max((rms(base.residual) / usual)[joints])))} and has no "
            "friction: it was computed, or commanded, not measured; record the measured torque",
        )


def loaded(fit: ModelFit) -> np.ndarray:
    """Return (n,) whether a joint carries a fair part of what the strongest of its kind carries.

    A lift carries many more newtons than the arm on it newton metres.
    """
    usual, slide = rms(fit.model_torque), fit.robot.is_slide
    strongest = [np.max(usual[slide == kind], initial=0.0) for kind in (False, True)]
    return np.asarray(usual >= _LOADED * np.where(slide, strongest[1], strongest[0]))
