"""Whether there are enough independent samples for what is asked."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from robot_sysid.checks.evidence import Evidence
from robot_sysid.checks.finding import Finding, Level
from robot_sysid.records import Measurement
from robot_sysid.signals.resampling import usual_period

SHORTEST = 1.0
"""Length of a log below which no arm does anything worth fitting [s]."""
ROWS = 40
"""Independent samples per joint that ten parameters and its friction need at least."""
SLOWEST_RATE = 10.0
"""Samples per second below which a motion cannot be differentiated [Hz]."""
SLOWEST = 0.05
"""Speed that one joint at least has to reach [rad/s]."""


def length_findings(pieces: Sequence[Measurement]) -> Iterator[Finding]:
    """Yield a finding where a log, or what its gaps leave of it, is too short for anything."""
    span = _length(pieces)
    if span < SHORTEST:
        text = f"the log is {span:.2g} s long, too short; record ten seconds or more"
        yield Finding("too-little", Level.REFUSE, text)


def _length(pieces: Sequence[Measurement]) -> float:
    return sum(float(piece.time[-1] - piece.time[0]) for piece in pieces)


def slow_findings(evidence: Evidence) -> Iterator[Finding]:
    """Yield a finding where no joint moves fast enough to be told from its friction."""
    fastest = float(np.max(np.abs(evidence.sample.qd)))
    if fastest < SLOWEST:
        text = f"no joint moves faster than {fastest:.2g} rad/s; record a faster motion"
        yield Finding("too-little", Level.REFUSE, text)


def enough_findings(evidence: Evidence) -> Iterator[Finding]:
    """Yield what there is too little of."""
    span = _length(evidence.pieces)
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
