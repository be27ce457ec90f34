"""All checks of a log: what the recording shows by itself, then the contest of explanations."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np

from robot_sysid.diagnosis import Finding, Level, recording
from robot_sysid.diagnosis.contest import Contest, findings
from robot_sysid.diagnosis.relabelling import model_torque
from robot_sysid.diagnosis.rows import low_pass, rms
from robot_sysid.errors import InputError, SysidError, prefix_input_errors
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.logs.reader import MeasurementLog
from robot_sysid.records import Array, Measurement, RobotModel
from robot_sysid.records.figures import percent
from robot_sysid.records.progress import Progress
from robot_sysid.signals.process import ProcessedSignals

OF_LINKS = (
    "torque-scale",
    "zero",
    "tilt",
    "model",
    "unexplained",
    "clock",
    "gravity",
    "force",
)
"""Findings that other links than the model's would bring as well."""
# What is left of a torque that follows from rigid bodies alone, its noise and friction, as parts.
_EXACT = 0.004
_QUIET = 5e-4
_FRICTIONLESS = 0.002


def check_against_model(
    robot: RobotModel,
    pieces: Sequence[Measurement],
    options: EstimationOptions | None = None,
    links_known: bool = True,
    divided: Sequence[float] | Array | None = None,
) -> tuple[Finding, ...]:
    """Return what looks wrong with a log.

    Args:
        options: what the estimate allows for; None for what is usual.
        links_known: whether the model's links are right; where they are to be found, what wrong
            ones would bring as well is only told.
        divided: (n,) scale that torques were divided by already.

    Raises:
        InputError: the log is too short to be looked at.
    """
    options = options or EstimationOptions()
    raw = [*recording.length_findings(pieces), *recording.clock_findings(pieces)]
    raw += recording.velocity_findings(pieces, robot.joint_names)
    raw += recording.sensor_findings(pieces, robot.joint_names)
    if any(each.level is Level.REFUSE for each in raw):
        return tuple(raw)
    signals = low_pass(pieces, options.cutoff)
    found = [*recording.enough_findings(pieces, signals[0].cutoff)]
    if not found:
        contest = Contest(robot, signals, options)
        scales = (
            np.ones(robot.n_joints)
            if divided is None
            else np.asarray(divided, dtype=float)
        )
        found = _computed_findings(contest) or findings(contest, scales)
        found = found or [*recording.slow_findings(contest.log.motion.qd)]
    if not links_known:
        found = [
            replace(f, level=Level.NOTE) if f.name in OF_LINKS else f for f in found
        ]
    return (*raw, *found)


def look_at(
    robot: RobotModel,
    log: MeasurementLog,
    accepted: Collection[str],
    progress: Progress,
    options: EstimationOptions | None = None,
    links_known: bool = True,
) -> None:
    """Tell what ``check_against_model`` finds wrong with a log, and ``require_acceptable``."""
    with prefix_input_errors(str(log.path)):
        found = check_against_model(
            robot, log.pieces, options, links_known, log.torque_scale
        )
    for each in found:
        # What stops a log is told when it does.
        if each.level is Level.NOTE or (
            each.level is Level.WARN and each.name in accepted
        ):
            progress.note(each.line().removeprefix("note: "))
    try:
        require_acceptable(str(log.path), found, accepted)
    except SysidError:
        for note in log.notes:
            progress.note(note)
        raise


def require_acceptable(
    log: str, findings: Iterable[Finding], accepted: Collection[str] = ()
) -> None:
    """Stop at what must not become a number; ``accepted`` names warnings that may.

    Raises:
        InputError: a finding refuses the log.
        SysidError: there is a warning that is not accepted.
    """
    found = list(findings)
    refused = [each.text for each in found if each.level is Level.REFUSE]
    if refused:
        raise InputError(f"{log}: {'; '.join(refused)}")
    warned = [f for f in found if f.level is Level.WARN and f.name not in accepted]
    if warned:
        names = " ".join(
            f"--accept {name}" for name in dict.fromkeys(f.name for f in warned)
        )
        texts = "; ".join(each.text for each in warned)
        raise SysidError(
            f"{log}: {texts}; nothing was written (to go on all the same: {names})"
        )


def _computed_findings(contest: Contest) -> list[Finding]:
    """Return a finding where the torque is the model's own, without noise and friction."""
    log = contest.log
    posterior = contest.posterior
    model = model_torque(log)
    loaded = model > 0.1 * float(np.max(model))
    exact = rms(posterior.residual) < _EXACT * log.usual
    quiet = _fast_torque(contest.signals) < _QUIET * log.usual
    friction = contest.friction_share(posterior) < _FRICTIONLESS
    if not np.all((exact & quiet & friction)[loaded]):
        return []
    text = (
        f"the torque follows rigid-body dynamics to {percent(_EXACT)} and has no friction: it was "
        "computed, or commanded, not measured; record the measured torque"
    )
    return [Finding("computed", Level.WARN, text)]


def _fast_torque(signals: Sequence[ProcessedSignals]) -> Array:
    """Return (n,) the usual torque above the low-pass, noise where it was measured [N m]."""
    parts = []
    for each in signals:
        half = each.low_pass.half_width
        parts.append(
            each.tau[half : len(each) - half] - each.low_pass.filtered(each.tau)
        )
    return rms(np.concatenate(parts))
