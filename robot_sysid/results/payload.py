"""The result for a payload: numbers, verdict and notes, from fits of logs without and with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.held_out import validation
from robot_sysid.estimate.payload import (
    contradiction,
    payload_estimate,
    payload_in_flange,
    torque_scale_rows,
    without_inertia,
    written_payload,
)
from robot_sysid.estimate.quantities import (
    body_estimate,
    fit_quantities,
    link_estimates,
    select,
    values_with_bodies_of,
)
from robot_sysid.estimate.terms import PAYLOAD_NAMES
from robot_sysid.estimate.trust import missed_friction
from robot_sysid.records import Array, DataOrigin, Flange
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.messages import Detail, Level, Remark
from robot_sysid.records.quantities import body_quantities
from robot_sysid.results.identification import judged_files, model_file, result_of
from robot_sysid.results.notes import unknown_inertia
from robot_sysid.results.reasons import file_faults, missed_terms
from robot_sysid.results.record import Identification, Payload
from robot_sysid.results.rules import AGAINST_PAYLOAD, OF_PAYLOAD, PayloadEvidence
from robot_sysid.results.traces import FitTraces
from robot_sysid.results.verdicts import judge
from robot_sysid.spatial import PARAMETER_NAMES


def payload_result(
    fitted: Fit,
    weighed: Fit,
    file: Fit | None,
    flange: Flange,
    origin: DataOrigin,
    sentences: Sequence[str],
    divided: Array,
) -> Identification:
    """Return the result for a payload.

    Args:
        fitted: the fit whose scales and payload are reported, with the known mass if there is one.
        weighed: the fit without the known mass; ``fitted`` itself where there is none.
        file: the fit of the arm's model file; None where none is written.
        flange: the frame in which the payload is stated.
        origin: where the recordings come from.
        sentences: for the user so far.
        divided: (n,) torque scales by which the torques were divided already.
    """
    known_mass = fitted.question.known_mass
    written = None
    notes = [*sentences]
    file_notes: list[str] = []
    if file is not None:
        written = model_file(file)
        files = judged_files(written, fitted.arm.model_bends)
        against = [*file_faults(each.held_out for each in files)]
        if against:
            file = None
            written = None
            file_notes = [
                f"the written model is the arm's own with the payload on it: {against[0]}"
            ]
    evidence = PayloadEvidence(
        weighed.arm.robot,
        payload_in_flange(weighed, flange, weighed.free),
        contradiction(weighed),
        flange,
        validation(weighed),
        known_mass,
    )
    values = fitted.free.copy()
    if not judge(AGAINST_PAYLOAD, evidence):
        values = values_with_bodies_of(fitted, file)
        theta, needs_ball = written_payload(fitted)
        values[fitted.at(PAYLOAD_NAMES)] = theta
        evidence = replace(evidence, needs_ball=needs_ball)
    remarks = judge(OF_PAYLOAD, evidence)
    both = select(fitted, PARAMETER_NAMES) + select(fitted, PAYLOAD_NAMES)
    body = payload_in_flange(fitted, flange, values)
    name = f"{fitted.arm.robot.body_name} with payload"
    total = body_estimate(fitted, name, both, values)
    if evidence.needs_ball:
        body, total = map(without_inertia, (body, total))
        notes.append(Detail(unknown_inertia(payload_estimate(fitted))))
    missed = missed_friction(fitted)
    if missed is not None:
        sentence = missed_terms(missed, fitted.question.options.no_friction)
        remarks.append(Remark(Level.DOUBTS, FaultName.FRICTION, sentence))
    links = link_estimates(fitted, file)
    rows = [*body_quantities(body), *body_quantities(total)]
    if known_mass is not None:
        rows += torque_scale_rows(fitted, divided)
    rows += fit_quantities(fitted, file, links)
    return result_of(
        fitted,
        file,
        links,
        rows,
        remarks,
        [*notes, *file_notes],
        data=origin,
        standard_errors=dict(zip(PARAMETER_NAMES, body.errors.tolist())),
        payload=Payload(
            **vars(body),
            flange=flange,
            recordings=_recordings(fitted),
            known_mass=known_mass,
        ),
        total=total,
        file=written,
        validation=(validation(fitted),),
        checkpoints=fitted.recordings[-1].motion,
        traces=FitTraces(fitted),
    )


def _recordings(fitted: Fit) -> dict[str, tuple[str, ...]]:
    """Return "empty" and "loaded" to the names of the logs without and with the payload."""
    kinds = {log.name: log.is_loaded for log in fitted.recordings}
    return {
        "empty": tuple(name for name in kinds if not kinds[name]),
        "loaded": tuple(name for name in kinds if kinds[name]),
    }
