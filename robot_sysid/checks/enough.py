"""Whether there are enough independent samples for what is asked."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot_sysid.checks.evidence import Evidence
from robot_sysid.checks.finding import Finding, Level
from robot_sysid.signals.resampling import usual_period

ROWS = 40
"""Independent samples per joint that ten parameters and its friction need at least."""
SLOWEST_RATE = 10.0
"""Samples per second below which a motion cannot be differentiated [Hz]."""
SLOWEST = 0.05
"""Speed that one joint at least has to reach [rad/s]."""


def slow_findings(evidence: Evidence) -> Iterator[Finding]:
    """Yield a finding where no joint moves fast enough to be told from its friction."""
    fastest = float(np.max(np.abs(evidence.sample.qd)))
    if fastest < SLOWEST:
        text = f"no joint moves faster than {fastest:.2g} rad/s; record a faster motion"
        yield Finding("too-little", Level.REFUSE, text)


def enough_findings(evidence: Evidence) -> Iterator[Finding]:
    """Yield what there is too little of."""
    span = sum(float(piece.time[-1] - piece.time[0]) for piece in evidence.pieces)
    rows = int(2.0 * evidence.cutoff * span)
    rate = 1.0 / usual_period(evidence.pieces[0].time)
    for fault, text in (
        (rate < SLOWEST_RATE, f"{rate:.3g} samples per second are too few; record at 100 or more"),
        (
            rows < ROWS,
            f"{span:.3g} s behind a low-pass of {evidence.cutoff:.3g} Hz hold about {rows} "
            f"independent samples per joint, and {ROWS} are needed; record longer",
        ),
    ):
        if fault:
            yield Finding("too-little", Level.REFUSE, text)
