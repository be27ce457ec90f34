"""All checks of a log, in the order in which one finding explains another."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

from robot_sysid.diagnosis import Finding, Level, recording, torque
from robot_sysid.diagnosis.model_fit import Fit, ModelFit
from robot_sysid.diagnosis.offsets import joint_zeros, offset_findings, zero_findings
from robot_sysid.errors import InputError, SysidError, named
from robot_sysid.logs.reader import MeasurementLog
from robot_sysid.records import Array, Measurement, RobotModel
from robot_sysid.records.progress import Progress

OF_LINKS = ("torque-scale", "zero", "model", "contact", "clock")
"""Findings that other links than the model's would bring as well."""


def check_against_model(
    robot: RobotModel,
    pieces: Sequence[Measurement],
    cutoff: float | None = None,
    links_known: bool = True,
    divided: Sequence[float] | Array | None = None,
) -> tuple[Finding, ...]:
    """Return what looks wrong with a log.

    Args:
        cutoff: of the low-pass [Hz]; None chooses it from the data.
        links_known: whether the model's links are right; where they are to be found, what wrong
            ones would bring as well is only told.
        divided: (n,) scale that torques were divided by already.

    Raises:
        InputError: the log is too short to be looked at.
    """
    raw = [*recording.length_findings(pieces), *recording.clock_findings(pieces)]
    raw += recording.velocity_findings(pieces, robot.joint_names)
    raw += recording.sensor_findings(pieces, robot.joint_names)
    if any(each.level is Level.REFUSE for each in raw):
        return tuple(raw)
    log = ModelFit(robot, pieces, cutoff, divided)
    found = [*recording.enough_findings(log)] or _of_torque(log)
    if not links_known:
        found = [replace(f, level=Level.NOTE) if f.name in OF_LINKS else f for f in found]
    return (*raw, *found)


def look_at(
    robot: RobotModel,
    log: MeasurementLog,
    accepted: Collection[str],
    progress: Progress,
    cutoff: float | None = None,
    links_known: bool = True,
) -> None:
    """Tell what ``check_against_model`` finds wrong with a log, and ``require_acceptable``."""
    with named(str(log.path)):
        found = check_against_model(robot, log.pieces, cutoff, links_known, log.torque_scale)
    for each in found:
        # What stops a log is told when it does.
        if each.level is Level.NOTE or (each.level is Level.WARN and each.name in accepted):
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
        names = " ".join(f"--accept {name}" for name in dict.fromkeys(f.name for f in warned))
        texts = "; ".join(each.text for each in warned)
        raise SysidError(f"{log}: {texts}; nothing was written (to go on all the same: {names})")


def _of_torque(log: ModelFit) -> list[Finding]:
    """Return what the torques say; the first mistake that explains them stands alone."""
    base, explained = log.fit(), torque.explanations(log)
    best = min((after.cost for after, _ in explained), default=base.cost)
    found = [*torque.gravity_findings(log, best)]
    if found or explained:
        return found or _likelier(log, base, *explained[0])
    found = [*torque.unit_findings(log)] or [*torque.scale_findings(log)]
    found = found or [*torque.contact_findings(log, base), *torque.computed_findings(log, base)]
    if found:
        return found
    found = offset_findings(log, base)
    # What a model of another arm leaves may look like a hum.
    if not found or found[0].name == "contact":
        found = [*torque.model_findings(log)] or found
    return found or [*recording.slow_findings(log)]


def _likelier(log: ModelFit, base: Fit, after: Fit, mistake: Finding) -> list[Finding]:
    """Return a scale or zeros where they explain a log better than a mistake does, else that."""
    scales = [*torque.scale_findings(log)]
    if scales:
        undone = log.sample.with_torque(1.0 / torque.torque_scales(log)[0])
        if log.fit(undone).cost < after.cost:
            return scales
    zeros = joint_zeros(log)
    if zeros.after.cost < after.cost:
        return [*zero_findings(log, base, zeros)] or [mistake]
    return [mistake]
