"""Torque that the model does not explain: in a burst, or all along.

A burst is contact, a collision or a moving gripper. A model that would need an impossible terminal
link, or leaves much of the torque, is that of another arm, or several mistakes come together.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot_sysid.checks.evidence import Evidence
from robot_sysid.checks.finding import Finding, Level
from robot_sysid.checks.model_fit import Fit, ModelFit, plausible, slow_speed
from robot_sysid.records import Array
from robot_sysid.records.figures import percent

UNEXPLAINED = 0.3
"""Torque that is left, as a part of what is measured, beyond which the model is not of this arm."""
LENGTH = 0.3
"""Over so long a time a burst is looked for [s]."""
STRONG, ABOVE = 30.0, 20.0
"""Mean square of residual over tolerance in a burst, and how far it stands above the usual."""


def model_findings(evidence: Evidence, fit: ModelFit) -> Iterator[Finding]:
    """Yield a finding where the model would need an impossible terminal link, or does not fit."""
    found = fit.fit(evidence.sample, known_links=True)
    arm = float(np.sum(fit.links[:, 0]))
    mass = float(found.thetas[-1, 0])
    left = float(np.sqrt(np.sum(found.residual**2) / np.sum(evidence.sample.tau**2)))
    remedy = (
        "is the model of this arm, with what is fixed to its other links, and its base mounted as "
        "the model says?"
    )
    if not plausible(fit, found):
        yield Finding(
            "model",
            Level.REFUSE,
            f"to fit this log, the terminal link would have {mass:.3g} kg on an arm of {arm:.3g} "
            f"kg: {remedy}",
        )
    elif left > UNEXPLAINED:
        yield Finding(
            "model",
            Level.REFUSE,
            f"the model leaves {percent(left)} of the torque unexplained, whatever the "
            f"terminal link is: {remedy}",
        )


def contact_findings(evidence: Evidence, base: Fit) -> Iterator[Finding]:
    """Yield a finding at the strongest burst."""
    residual = _beyond_friction(evidence, base)
    squares = (residual / evidence.sample.sigma) ** 2
    step = float(np.median(np.diff(evidence.time)))
    width = max(3, round(LENGTH / step))
    if len(squares) < 4 * width:
        return
    pooled = np.convolve(np.mean(squares, axis=1), np.ones(width) / width, mode="valid")
    worst, usual = int(np.argmax(pooled)), float(np.median(pooled))
    if pooled[worst] < STRONG or pooled[worst] < ABOVE * usual:
        return
    part = slice(worst, worst + width)
    joint = int(np.argmax(np.mean(squares[part], axis=0)))
    peak = float(np.max(np.abs(residual[part, joint])))
    yield Finding(
        "contact",
        Level.WARN,
        f"from {evidence.time[worst]:.2f} s to {evidence.time[part][-1]:.2f} s something else acts "
        f"on the arm: {peak:.3g} N m at joint {evidence.robot.joint_names[joint]} that the model "
        "does not explain; was there contact, or did a gripper move? cut it out, or record again",
    )


def _beyond_friction(evidence: Evidence, base: Fit) -> Array:
    """Return (K, n) residuals less what dry friction of a joint that hardly moves may account for.

    An arm that creeps to its rest still has all of its dry friction, in a direction that the
    low-passed speed does not tell.
    """
    speed = np.abs(evidence.sample.qd)
    unsure = np.where(speed < slow_speed(evidence.sample.qd), 2.0 * np.abs(base.coulomb), 0.0)
    return np.asarray(np.sign(base.residual) * np.maximum(np.abs(base.residual) - unsure, 0.0))
