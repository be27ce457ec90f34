"""The result for an arm: its numbers, verdict and notes, from the fit of all terms and of the file.

Shapes: n joints of the chain.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace

import numpy as np

from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.held_out import held_out_logs, validation
from robot_sysid.estimate.quantities import (
    beyond_model,
    file_quantities,
    fit_quantities,
    friction_curves,
    link_estimates,
    quality_of,
)
from robot_sysid.estimate.questions import usual_last_link
from robot_sysid.estimate.restricted_fit import (
    errors_of,
    errors_on,
    gravity_in,
    offsets_of_model,
    straight_of,
)
from robot_sysid.estimate.terms import PAYLOAD_NAMES
from robot_sysid.estimate.trust import missed_friction
from robot_sysid.expected.errors import ExpectedSquares
from robot_sysid.expected.other_motions import OtherMotions
from robot_sysid.records import DataOrigin, Motion, Traces, Validation
from robot_sysid.records.messages import Remark, says
from robot_sysid.records.quantities import (
    CURVED,
    FILE,
    BodyEstimate,
    FrictionCurve,
    Quantity,
)
from robot_sysid.results.notes import (
    curve_notes,
    file_notes,
    link_notes,
    other_motion_notes,
    part_names,
    result_notes,
    scale_notes,
    unshown_scales,
    wrong_links,
)
from robot_sysid.results.reasons import is_hardly_better
from robot_sysid.results.record import (
    Elsewhere,
    ErrorPart,
    Identification,
    ModelFile,
    MotionErrors,
    NextMotion,
    Payload,
)
from robot_sysid.results.rules import OF_ARM, OF_OTHER_MOTIONS, ArmEvidence
from robot_sysid.results.traces import FitTraces
from robot_sysid.results.verdicts import judge
from robot_sysid.results.verification import CHECKPOINTS
from robot_sysid.signals.process import FilteredRecording

PARTS = 5
"""Number of causes that are listed of an error on other motions."""
FASTER = 2.0
"""Times the error at the log's speeds from which the faster motions' is said to come from speed."""


def link_result(
    fitted: Fit,
    file: Fit,
    tests: Sequence[Validation],
    origin: DataOrigin,
    notes: Sequence[str] = (),
    others: Sequence[tuple[Sequence[FilteredRecording], str]] = (),
) -> Identification:
    """Return the result for an arm from recordings without a payload.

    Its remarks are reasons against the fit, the links or the model file first. Where too much
    torque is unexplained (``UNEXPLAINED``), or the given friction model misses terms that the
    torques show, its verdict is never better than ``Verdict.TORQUES_ONLY``.

    Args:
        fitted: the fit of all terms.
        file: the fit of the model file, whose friction may bend.
        tests: errors of the fit on logs that were not fitted.
        origin: where the recordings come from.
        notes: sentences for the user so far.
        others: the same logs, low-passed, and their names.
    """
    first = fitted.recordings[0]
    samples = np.linspace(0, len(first.time) - 1, CHECKPOINTS).astype(int)
    tests = (validation(fitted), *tests, *held_out_logs(fitted))
    links = link_estimates(fitted, file)
    *other_links, last_link = links
    usual = usual_last_link(fitted.arm, fitted.question)
    rows = [*fit_quantities(fitted, file, links), *beyond_model(last_link, usual)]
    written = model_file(file, others)
    files = judged_files(written, fitted.arm.model_bends)
    missed = missed_friction(fitted)
    evidence = ArmEvidence(
        fitted=fitted,
        tests=tests,
        link=last_link,
        rows=rows,
        files=[each.held_out for each in files],
        others=[errors for each in files for errors in each.others],
        missed=missed,
    )
    remarks = judge(OF_ARM, evidence)
    # Links that took up the torque of missed friction say nothing of the model's.
    if missed is None:
        robot = fitted.arm.robot
        odd = fitted.question.odd_number
        kinds = {} if odd is None else {robot.links[odd.link].body_name: odd.kind}
        # What judges the log has named the mistakes of the model, but no number that is odd beside.
        mistaken = {
            robot.links[number].body_name
            for mistake in fitted.question.mistakes
            for number in mistake.links
        }
        asked = [
            link
            for link in other_links
            if link.name not in mistaken or link.name in kinds
        ]
        remarks += wrong_links(asked, written, kinds)
    return result_of(
        fitted,
        file,
        links,
        rows,
        remarks,
        [*notes, *link_notes(fitted)],
        data=origin,
        total=last_link,
        standard_errors=dict(zip(fitted.names, fitted.errors.tolist())),
        file=written,
        validation=tests,
        checkpoints=first.samples(samples),
        traces=FitTraces(file),
    )


def result_of(
    fitted: Fit,
    file_fit: Fit | None,
    links: Iterable[BodyEstimate],
    rows: Iterable[Quantity],
    remarks: Iterable[Remark],
    notes: Iterable[str],
    *,
    data: DataOrigin,
    total: BodyEstimate,
    standard_errors: Mapping[str, float],
    file: ModelFile | None,
    validation: tuple[Validation, ...],
    checkpoints: Motion,
    traces: Callable[..., Traces],
    payload: Payload | None = None,
) -> Identification:
    """Return the result of recordings: its own rows, remarks and notes, then those of the file.

    Args:
        fitted: the fit of all terms.
        file_fit: the fit of the model file; None where that has the links as they are.
        links: those that were estimated.
        rows: identified numbers.
        remarks: reasons against the result, or for it.
        notes: sentences for the user so far.
        data: see ``Identification``; so for the other fields.
        total: the terminal link with all that moves with it.
        standard_errors: of parameters, by name.
        file: what is said of the model file; None where ``file_fit`` is.
        validation: errors in predicting torques.
        checkpoints: motion on which a written model is compared.
        traces: computes what a report draws.
        payload: None of an arm.
    """
    robot = fitted.arm.robot
    thetas = robot.thetas
    file_rows: list[Quantity] = []
    sentences = [*robot.notes, *notes]
    curves: list[FrictionCurve] = []
    scales: dict[str, float] = {}
    if file_fit is not None:
        straight = straight_of(file_fit)
        thetas = file_fit.thetas
        file_rows += file_quantities(fitted, straight, FILE)
        sentences += file_notes(fitted, straight, file_rows)
        scales = unshown_scales(fitted, file_rows)
        sentences += scale_notes(scales)
        if straight is not file_fit:
            file_rows += file_quantities(fitted, file_fit, CURVED)
            curves += friction_curves(fitted, file_fit)
            assert file is not None
            sentences += curve_notes(file, curves)
    sentences += result_notes(fitted, file_fit)
    return Identification(
        robot=robot,
        quality=quality_of(fitted),
        data=data,
        torques="chain" if len(fitted.arm.joints) == robot.n_joints else "terminal",
        thetas=thetas,
        quantities=(*rows, *file_rows),
        remarks=(*remarks, *says(sentences)),
        total=total,
        standard_errors=standard_errors,
        file=file,
        payload=payload,
        validation=validation,
        checkpoints=checkpoints,
        traces=traces,
        links={link.name: link for link in links},
        curves=tuple(curves),
        tops={owner: fitted.arm.top_of(owner) for owner in fitted.arm.owners},
        unshown_scales=scales,
        friction_model="-".join(fitted.question.friction) or "none",
        cutoff=min(recording.cutoff for recording in fitted.recordings),
        link_scales=asdict(fitted.question.link_scales),
    )


def model_file(
    file: Fit, logs: Sequence[tuple[Sequence[FilteredRecording], str]] = ()
) -> ModelFile:
    """Return what is said of a fitted model file, and of that beside it whose friction bends.

    Args:
        file: its fit.
        logs: further logs on which it is judged, low-passed, and their names.
    """
    model = offsets_of_model(file)

    def written_file(fit: Fit) -> ModelFile:
        """Return what is said of the file of a fit."""
        return ModelFile(
            errors=(errors_of(fit, model), *(errors_on(fit, *log) for log in logs)),
            gravity=gravity_in(file),
            kept=file.question.options.kept,
            motors=file.arm.motors,
        )

    straight = straight_of(file)
    if straight is file:
        return written_file(file)
    return replace(written_file(straight), curved=written_file(file))


def judged_files(file: ModelFile, model_bends: bool) -> list[ModelFile]:
    """Return the written files by which a result is judged, that whose friction bends first.

    A straight line is no better than the curve of a model that bends already: the other file is
    then judged alone.

    Args:
        file: what is said of the files.
        model_bends: whether friction of the given model bends.
    """
    files = [each for each in (file.curved, file) if each is not None]
    return files[:1] if model_bends else files


def with_other_motions(
    result: Identification, fitted: Fit, file: Fit
) -> Identification:
    """Return a result with the errors to expect of its model files on other motions, and notes.

    Nothing is expected where the fit does not fit.

    Args:
        result: of the fit and the file.
        fitted: the fit of all terms.
        file: the fit of the model file, whose friction may bend.
    """
    if result.file is None or not result.verdict.is_trustworthy:
        return result
    motions = OtherMotions(fitted)
    written = replace(
        result.file, elsewhere=errors_elsewhere(motions, straight_of(file))
    )
    if written.curved is not None:
        curved = replace(written.curved, elsewhere=errors_elsewhere(motions, file))
        written = replace(written, curved=curved)
    remarks = [*result.remarks, *says(other_motion_notes(motions))]
    elsewhere = (written.curved or written).elsewhere
    # A payload is what was asked for, whatever the file beside it is worth.
    if result.payload is None and elsewhere is not None:
        remarks += judge(OF_OTHER_MOTIONS, elsewhere)
    return replace(result, file=written, remarks=tuple(remarks))


def errors_elsewhere(motions: OtherMotions, file: Fit) -> Elsewhere:
    """Return the errors to expect of a model file, ``file`` its fit, and of the model before."""
    fitted = motions.fitted
    model = dict(fitted.arm.model)
    if fitted.question.loaded:
        model.update((name, file.by_name[name]) for name in PAYLOAD_NAMES)
    before = motions.errors(model, motions.fast)
    after = motions.errors(file.by_name, motions.fast)
    of_log = motions.errors(file.by_name, motions.slow)
    share = after.relative_error
    is_slow = share >= FASTER * of_log.relative_error
    parts = after.parts(part_names(fitted.arm, motions.fast))
    further, error = motions.next_motion(file, share)
    return Elsewhere(
        speed=motions.speed,
        speed_unit=motions.speed_unit,
        before=_motion_errors(before),
        after=_motion_errors(after),
        at_log_speeds=_motion_errors(of_log),
        log_speed=motions.log_speed,
        faster=after.worst_joint if is_slow else "",
        still=motions.still,
        parts=tuple(itertools.starmap(ErrorPart, [*parts.items()][:PARTS])),
        for_like_motions=is_hardly_better(before.relative_error, share),
        next=None if further is None else NextMotion(further.words, error),
    )


def _motion_errors(squares: ExpectedSquares) -> MotionErrors:
    """Return expected squares as errors over the torque."""
    return MotionErrors(squares.relative_error, squares.relative_error_per_joint)
