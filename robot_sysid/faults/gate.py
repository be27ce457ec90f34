"""One gate for all commands: logs are checked, low-passed, fitted once, and the fit is judged.

What one command refuses, all refuse, with the same sentence. A fault that does not change what was
asked is a note: an error that an empty and a loaded log share cancels in their difference.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np

from robot_sysid.errors import InputError, SysidError
from robot_sysid.estimate.choose import answer_of, solve_question
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.options import Priors
from robot_sysid.estimate.questions import Question
from robot_sysid.faults import Finding
from robot_sysid.faults.columns import fault_columns
from robot_sysid.faults.findings import findings
from robot_sysid.faults.misfits import lost_links
from robot_sysid.faults.reading_search import Evidence
from robot_sysid.faults.refusal import refuse_for
from robot_sysid.faults.samples import (
    check_recording,
    time_share,
    velocity_notes,
    velocity_ratios,
)
from robot_sysid.faults.stretches import stretch_findings
from robot_sysid.records import Recording, RobotModel
from robot_sysid.records.fault_names import FaultName, Needs, StandsFor
from robot_sysid.records.messages import Level, Progress, position_unit
from robot_sysid.records.option_fields import SCALE as TORQUE_SCALE
from robot_sysid.records.option_fields import joint_factors
from robot_sysid.records.usual_errors import SCALE
from robot_sysid.signals.process import (
    FilteredRecording,
    low_pass_recordings,
    shared_notes,
)
from robot_sysid.signals.resampling import duration, split_at_gaps
from robot_sysid.wording import option_setting

TRYING = "Trying explanations"
"""Label of the progress of the search for faults."""
SLOWEST = 0.05
"""Speed that at least one joint of a moving arm reaches [rad/s]."""
LEAST_ROWS = 26
"""Independent samples of a joint that are needed: two for each of the last link's ten parameters
and the joint's friction. What they do not show keeps the model's numbers, and its ± are as wide."""


@dataclass(frozen=True)
class Judged:
    """Logs that were judged together.

    Attributes:
        logs: that were read.
        findings: what is wrong with them, the most severe first.
        notes: on the low-pass.
        fit: of the question, with all that the data decides; None where a recording by itself is
            refused.
    """

    logs: tuple[Recording, ...]
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    fit: Fit | None


def judge(
    robot: RobotModel,
    logs: Sequence[Recording],
    question: Question,
    progress: Progress,
    is_loaded: Sequence[bool] = (),
    order: Sequence[float] = (),
) -> Judged:
    """Return logs with the fit of a question to all of them, and what is wrong with them.

    Args:
        robot: the arm with its model.
        logs: that were read.
        question: what is asked of them.
        progress: is advanced while they are looked at.
        is_loaded: of each log, whether the arm carries the payload; () for none.
        order: of each log, its position in the order of recording; () where it is not known.

    Raises:
        InputError: a log is too short to be looked at.
    """
    sides = is_loaded or [False] * len(logs)
    places = order or [0.0] * len(logs)
    checked = [
        checked_log(robot, log, side, place)
        for log, side, place in zip(logs, sides, places)
    ]
    found = [finding for each in checked for finding in each.findings]
    pieces = [piece for each in checked for piece in each.pieces]
    options = question.options
    notes: tuple[str, ...] = ()
    if not refusals(found):
        recordings, notes = low_pass_recordings(robot, pieces, options.cutoff)
        # A low-pass of f [Hz] leaves 2 f independent samples per second.
        cutoff, span = mean_cutoff(pieces, recordings), duration(pieces)
        found += few_findings(2.0 * cutoff * span, span, cutoff)
    if refusals(found):
        return Judged(tuple(logs), in_order(found), notes, None)
    fitted = solve_question(robot, recordings, question, progress, fault_columns)
    most = float(np.max(fitted.sums.row_counts))
    found += few_findings(most, span, cutoff)
    if refusals(found):
        return Judged(tuple(logs), in_order(found), notes, None)
    usual = replace(
        options, friction_model=None, no_friction=False, priors=wide(options.priors)
    )
    judged = fitted
    if usual != options:
        judged = solve_question(
            robot, recordings, replace(question, options=usual), beside=fault_columns
        )
    rounds = count(1)

    def advance() -> None:
        """Show that one more round is done."""
        n_tried = next(rounds)
        progress.advance(TRYING, n_tried / (n_tried + 3.0), 1.0, "")

    known = [each.time_share for each in checked if each.time_share is not None]
    share = max(known, key=abs, default=None)
    given = logs[0].options.get("torque_scale")
    divided, _ = joint_factors(given, robot.joint_names, TORQUE_SCALE)
    evidence = Evidence(divided, share, advance)
    progress.advance(TRYING, 0.0, 1.0, "")
    explained = findings(judged, evidence)
    progress.advance(TRYING, 1.0, 1.0, "")
    wrong = [*explained.findings]
    if robot.lacks_masses:
        wrong = [
            each
            for each in wrong
            if not each.about.stands_for & StandsFor.LINKS or each.is_common_factor
        ]
    wrong = wrong or [*slow_findings(robot, recordings)]
    doubtful = [each.about.stands_for & StandsFor.MOMENT for each in [*found, *wrong]]
    if not any(doubtful):
        touched = [each for log in explained.right.recordings for each in log.touched]
        found += stretch_findings(explained.right.arm.joints, touched)
    if not any(finding.about is FaultName.CLOCK for finding in wrong):
        found += [note for each in checked for note in each.velocities]
    answer = explained.answer if judged is fitted else None
    answer = answer_of(fitted) if answer is None else answer
    # What was asked of the log alone is not kept with its answer.
    terms = [term for term in answer.arm.terms.values() if term.cause]
    answer = replace(answer, arm=answer.arm.of(terms))
    lost = () if refusals([*found, *wrong]) else lost_links(answer)
    return Judged(tuple(logs), in_order([*found, *wrong, *lost]), notes, answer)


@dataclass(frozen=True)
class CheckedLog:
    """What the samples of a log show.

    Attributes:
        findings: what is wrong with them, whatever the model.
        pieces: of the log that may be used, without recorded velocities.
        time_share: by which share time is too long by these; None where there are none.
        velocities: what is said of them.
    """

    findings: tuple[Finding, ...]
    pieces: tuple[Recording, ...]
    time_share: float | None
    velocities: tuple[Finding, ...]


def checked_log(
    robot: RobotModel, log: Recording, is_loaded: bool, order: float
) -> CheckedLog:
    """Return the pieces of a log that may be used, and what their samples show.

    Args:
        robot: the arm with its model.
        log: that was read.
        is_loaded: whether the arm carries the payload.
        order: position of the log in the order of recording.
    """
    found, kept = check_recording(robot, split_at_gaps(log))
    ratios = velocity_ratios(kept)
    pieces = (
        replace(piece, qd=None, notes=(), is_loaded=is_loaded, order=order)
        for piece in kept
    )
    velocities = velocity_notes(ratios, robot.joint_names)
    return CheckedLog(
        tuple(found), tuple(pieces), time_share(ratios), tuple(velocities)
    )


def wide(priors: Priors) -> Priors:
    """Return priors that are no narrower than the default ones: a log is judged by these."""
    usual = Priors()
    wider: dict[str, Any] = {
        name: max(getattr(priors, name), getattr(usual, name))
        for name in ("link", "zero", "gravity", "delay", "friction")
    }
    if priors.scale is not None:
        wider["scale"] = tuple(np.maximum(np.ravel(priors.scale), SCALE).tolist())
    return replace(priors, **wider)


def in_order(found: Sequence[Finding]) -> tuple[Finding, ...]:
    """Return findings, each once: the most severe first, then those that need less of a log.

    Beside doubts of the samples, or of what the torque is, what is only said of the model is their
    consequence.
    """
    is_doubted = any(
        each.about.needs <= Needs.TORQUE and each.level is not Level.SAYS
        for each in found
    )
    kept = [
        each
        for each in dict.fromkeys(found)
        if not (is_doubted and each.about is FaultName.MODEL)
        or each.level is not Level.SAYS
    ]
    return tuple(sorted(kept, key=lambda f: ([*Level].index(f.level), f.about.needs)))


def refusals(found: Iterable[Finding]) -> list[Finding]:
    """Return the findings that forbid the use of logs."""
    return [finding for finding in found if finding.level is Level.REFUSES]


def slow_findings(
    robot: RobotModel, recordings: Sequence[FilteredRecording]
) -> Iterator[Finding]:
    """Yield a finding where no speed reaches ``SLOWEST``, too slow for friction."""
    speeds = np.concatenate([each.motion.qd for each in recordings])
    fastest = np.max(np.abs(speeds), axis=0)
    joint = np.argmax(fastest)
    if fastest[joint] < SLOWEST:
        unit = position_unit(robot.is_slide[joint])
        text = f"no joint moves faster than {fastest[joint]:.2g} {unit}/s"
        yield Finding(
            Level.REFUSES, FaultName.TOO_LITTLE, text, "record a faster motion"
        )


def mean_cutoff(
    pieces: Sequence[Recording], recordings: Sequence[FilteredRecording]
) -> float:
    """Return the mean cut-off [Hz] over the time of pieces of logs, low-passed as recordings."""
    spans = [duration([piece]) for piece in pieces]
    cutoffs = [recording.cutoff for recording in recordings]
    return float(np.average(cutoffs, weights=spans))


def few_findings(rows: float, span: float, cutoff: float) -> Iterator[Finding]:
    """Yield a finding where logs hold too few independent samples of every joint.

    Args:
        rows: how many of one joint, at most.
        span: of the logs [s].
        cutoff: of their low-passes [Hz].
    """
    if rows < LEAST_ROWS:
        text = (
            f"{span:.3g} s behind a low-pass of {cutoff:.3g} Hz hold about {rows:.0f} independent "
            f"samples of a joint that moves, and {LEAST_ROWS} are needed"
        )
        remedy = "record longer, with the time at which each sample was taken"
        yield Finding(Level.REFUSES, FaultName.TOO_LITTLE, text, remedy)


def usable_fit(
    judged: Judged, accepted: Collection[str], progress: Progress
) -> tuple[Fit, tuple[str, ...]]:
    """Return the fit of logs and the notes on them; raise an error where a finding forbids its use.

    The findings that do not forbid it become notes. The error has the refusals or, if there are
    none, the doubts that are not accepted; the other notes are then reported.

    Args:
        judged: the logs.
        accepted: names of checks whose doubts are accepted.
        progress: receives the notes of logs that are not used.

    Raises:
        InputError: a finding refuses the logs.
        SysidError: there is a doubt that is not accepted.
    """
    notes = [*shared_notes({log.name: log.notes for log in judged.logs})]
    passed = accepted_doubts(judged.findings, accepted)
    for finding in judged.findings:
        if finding.level is Level.SAYS or finding in passed:
            start = "accepted: " if finding in passed else ""
            notes.append(f"{start}{finding.sentence} [{finding.about}]")
    try:
        require_acceptable(judged.logs, judged.findings, accepted)
    except SysidError:
        progress.note(*notes)
        raise
    assert judged.fit is not None
    return judged.fit, (*notes, *judged.notes)


def accepted_doubts(
    found: Iterable[Finding], accepted: Collection[str]
) -> list[Finding]:
    """Return the findings that are doubts of accepted names."""
    return [f for f in found if f.level is Level.DOUBTS and f.about in accepted]


def require_acceptable(
    logs: Sequence[Recording], found: Sequence[Finding], accepted: Collection[str] = ()
) -> None:
    """Raise an error where a finding refuses logs or is a doubt that is not accepted.

    A doubt that needs less of the logs than what refuses them comes first: that may follow from it.

    Args:
        logs: that were read.
        found: the findings of all checks.
        accepted: names of checks whose doubts are accepted.

    Raises:
        ColumnsError: a finding refuses a log, and other columns put it right.
        InputError: a finding refuses the logs.
        SysidError: there is a doubt that is not accepted.
    """
    refused = refusals(found)
    stated = not_acceptable(found, accepted)
    # A remedy is none where something else is wrong as well.
    corrections = {finding.correction for finding in refused}
    is_one = len(refused) == 1 or (len(corrections) == 1 and None not in corrections)
    if is_one and stated == refused:
        raise refuse_for(logs, refused)
    names = ", ".join(log.name for log in logs)
    texts = "; ".join(finding.sentence for finding in stated)
    if refused:
        raise InputError(f"{names}: {texts}{_still_refused(found, accepted)}")
    if stated:
        # Each name once, in the order of the findings.
        checks = dict.fromkeys(finding.about for finding in stated)
        accepting = option_setting("accept", *checks)
        advice = f"nothing was written (to go on all the same: {accepting})"
        message = f"{names}: {texts}; {advice}"
        if len(stated) == 1:
            raise SysidError(message, stated[0].options, stated[0].command)
        raise SysidError(message)


def not_acceptable(
    found: Sequence[Finding], accepted: Collection[str] = ()
) -> list[Finding]:
    """Return the findings that the error of ``require_acceptable`` states; none where it is none.

    They are what refuses the logs, and doubts that come first; without a refusal all doubts that
    are not accepted.
    """
    refused = [*refusals(found)]
    doubts = [f for f in found if f.level is Level.DOUBTS and f.about not in accepted]
    if not refused:
        return doubts
    least = min(each.about.needs for each in refused)
    return [*(doubt for doubt in doubts if doubt.about.needs < least), *refused]


def _still_refused(found: Sequence[Finding], accepted: Collection[str]) -> str:
    """Return what refusals do to the doubts that were accepted; "" without any."""
    passed = accepted_doubts(found, accepted)
    if not passed:
        return ""
    option = option_setting("accept", *dict.fromkeys(f.about for f in passed))
    return f" ({option} accepts doubts of that name alone, and these findings refuse)"
