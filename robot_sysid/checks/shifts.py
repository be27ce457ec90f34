"""What shifts a log without spoiling it: a joint's zero, and torque behind position."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot_sysid.checks.evidence import DELAYS, Evidence
from robot_sysid.checks.finding import Finding, Level
from robot_sysid.checks.hypotheses import explains
from robot_sysid.checks.model_fit import Fit, ModelFit
from robot_sysid.dynamics.nuisances import NuisanceColumns
from robot_sysid.records import Array, Motion

SMALL_ZERO, LARGE_ZERO = 0.02, 0.04
"""Error of a joint's zero that is told, and that stops an identification [rad]."""
SURE = 3.5
"""Standard errors that a zero has to be away from nothing."""
SHORT_DELAY = 0.015
"""Delay that is only told [s]: friction that builds up over some speed looks like one."""
_LIKELY = 0.5
_ROUNDS = 4


def zero_findings(evidence: Evidence, fit: ModelFit, base: Fit) -> Iterator[Finding]:
    """Yield a finding per joint whose position is surely off by a constant."""
    zeros, errors, after = joint_zeros(evidence, fit)
    # How sure each zero is decides; the fit as a whole need not fall as much as for a mistake.
    if not explains(base, after, certain=False):
        return
    far = int(np.argmax(np.abs(zeros) * (np.abs(zeros) > SURE * errors)))
    if abs(zeros[far]) > _LIKELY:
        name = evidence.robot.joint_names[far]
        yield Finding(
            "model",
            Level.REFUSE,
            f"to fit this log, the position of joint {name} would have to be off by "
            f"{zeros[far]:.2g} rad: is the model of this arm, with zeros in the same places?",
        )
        return
    for joint, name in enumerate(evidence.robot.joint_names):
        size = abs(zeros[joint])
        if size < max(SMALL_ZERO, SURE * errors[joint]):
            continue
        level = Level.WARN if size >= LARGE_ZERO else Level.NOTE
        yield Finding(
            "zero",
            level,
            f"the position of joint {name} reads {zeros[joint]:+.3g} rad too much (standard error "
            f"{errors[joint]:.1g}); correct its zero",
        )


def joint_zeros(evidence: Evidence, fit: ModelFit) -> tuple[Array, Array, Fit]:
    """Return (what each position reads too much (n,) [rad], standard errors (n,), what is left)."""
    sample, joints = evidence.sample, evidence.robot.n_joints
    total, thetas = np.zeros(joints), fit.links
    for _ in range(_ROUNDS):
        columns = NuisanceColumns(evidence.robot, thetas)
        motion = Motion(evidence.time, sample.q, sample.qd, sample.qdd)
        found = fit.fit(sample, columns.zero(motion), np.full(joints, _LIKELY))
        step = np.clip(found.extra, -_LIKELY, _LIKELY)
        total, thetas = total + step, found.thetas
        sample = sample.turned_by(-step)
    return total, found.error, fit.fit(sample)


def delay_findings(evidence: Evidence, fit: ModelFit, base: Fit) -> Iterator[Finding]:
    """Yield a finding where torque belongs to an earlier or later position."""
    fits = {delay: fit.fit(evidence.with_later_torque(delay)) for delay in DELAYS}
    delay = min(fits, key=lambda each: fits[each].cost)
    if not explains(base, fits[delay]):
        return
    yield Finding(
        "delay",
        Level.WARN if abs(delay) > SHORT_DELAY else Level.NOTE,
        f"torque lags position by about {1e3 * delay:.0f} ms; add --delay auto, or record both at "
        "the same instant",
    )
