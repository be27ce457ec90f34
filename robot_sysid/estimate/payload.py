"""A payload: its result, what each recording weighs, and whether recordings agree.

Shapes: k estimated parameters; a body has ten inertial parameters (``PARAMETER_NAMES``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.held_out import validation
from robot_sysid.estimate.offers import Effect, Offers
from robot_sysid.estimate.restricted_fit import RestrictedFit
from robot_sysid.estimate.result import (
    body_estimate,
    common_result,
    model_file,
    quantity,
    result_notes,
    select,
)
from robot_sysid.estimate.terms import PAYLOAD_NAMES
from robot_sysid.estimate.trust import (
    judge_file,
    judge_known_mass,
    judge_payload,
    missed_friction,
)
from robot_sysid.records import Array, DataOrigin, Flange
from robot_sysid.records.levels import CLEAR
from robot_sysid.records.messages import Detail, Level, Remark, says, with_error
from robot_sysid.results.body_errors import is_inertia_known, principal_moments
from robot_sysid.results.quantities import body_quantities
from robot_sysid.results.record import (
    PAYLOAD,
    BodyEstimate,
    ModelFile,
    Payload,
    Quantity,
    Result,
    Verdict,
)

LEAST_MASS = 0.03
"""Difference in mass below which recordings agree, as a share of the payload's mass."""
LEAST_PLACE = 0.01
"""Difference in the payload's centre of mass below which recordings agree [m]."""


def written_payload(fitted: Fit) -> tuple[Array, str]:
    """Return the payload (10,) to write into a model, and why its inertia is not identified.

    The reason is "" where the inertia is identified. Otherwise the payload is replaced by a ball of
    aluminium of the estimated mass at the estimated centre of mass. The parameters are in the frame
    of the terminal body.
    """
    theta = fitted.values[fitted.at(PAYLOAD_NAMES)]
    mass, com, _ = spatial.com_from_theta(theta)
    body = body_estimate(
        fitted, "payload", select(fitted, PAYLOAD_NAMES), fitted.values
    )
    if mass <= 0.0 or is_inertia_known(body):
        return theta, ""
    moments, errors = principal_moments(body)
    listed = ", ".join(map(with_error, moments.tolist(), errors.tolist()))
    reason = (
        f"the payload's principal moments of inertia, {listed} kg·m², do not differ significantly "
        "from zero"
    )
    if not np.all(np.isfinite(errors)):
        reason = "the payload's inertia is not identifiable from these torques"
    return spatial.aluminium_ball(mass, com), reason


def payload_result(
    fitted: Fit,
    weighed: Fit,
    file: RestrictedFit | None,
    flange: Flange,
    origin: DataOrigin,
    sentences: Sequence[str],
    divided: Array,
) -> Result:
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
    robot = fitted.arm.robot
    known_mass = fitted.question.known_mass
    # Judged is the payload before bodies were made possible: that step hides a negative mass.
    free = _in_flange(weighed, flange, weighed.free)
    test = validation(weighed)
    remarks = list(judge_payload(robot, free, contradiction(weighed, flange), test))
    if known_mass is not None:
        remarks = list(judge_known_mass(remarks, free.mass, known_mass))
    values = fitted.free.copy()
    unknown_inertia = ""
    if not remarks:
        values = fitted.values.copy()
        theta, unknown_inertia = written_payload(fitted)
        values[fitted.at(PAYLOAD_NAMES)] = theta
    payload = _payload_record(fitted, flange, values, divided)
    missed = missed_friction(fitted)
    notes = [*robot.notes, *sentences]
    if unknown_inertia:
        payload = _without_inertia(payload)
        notes.append(Detail(unknown_inertia))
        if known_mass is None:
            remarks.append(Verdict.INERTIA_NOT_KNOWN.remark())
    remarks += [Remark(Level.DOUBTS, "friction", missed)] if missed else []
    written: ModelFile | None = None
    rows: list[Quantity] = []
    if file is not None:
        judgement = judge_file(file.before, file.after)
        if judgement.level is Level.SAYS:
            written, rows, file_notes = model_file(fitted, file)
            notes += file_notes
        else:
            notes.append(
                f"the written model is the arm's own with the payload on it: {judgement.text}"
            )
    notes += result_notes(fitted, written)
    common = common_result(fitted, origin, PAYLOAD)
    return replace(
        common,
        remarks=(*remarks, *says(notes)),
        quantities=(*_payload_quantities(fitted, payload), *common.quantities, *rows),
        payload=payload,
        file=written,
        validation=(validation(fitted),),
    )


def _payload_quantities(fitted: Fit, payload: Payload) -> list[Quantity]:
    """Return the rows of a payload, of the link with it, and of torque scales by a known mass."""
    rows = [*body_quantities(payload.body, PAYLOAD)]
    rows += body_quantities(payload.total, f"{payload.total.name} with payload")
    for joint, scale in payload.torque_scale.items():
        value, error = quantity(fitted, f"scale[{joint}]")
        error *= scale / (1.0 + value)
        rows.append(Quantity("torque_scale", joint, "", 1.0, scale, error))
    return rows


def _in_flange(fitted: Fit, flange: Flange, values: Array) -> BodyEstimate:
    """Return the payload at parameters (k,), in the flange frame."""
    # The change of frame is linear: its matrix has the images of the ten unit bodies as columns.
    to_flange = np.stack(list(map(flange.to_flange, np.eye(10))), axis=1)
    combinations = to_flange @ select(fitted, PAYLOAD_NAMES)
    return body_estimate(fitted, "payload", combinations, values)


def _payload_record(
    fitted: Fit, flange: Flange, values: Array, divided: Array
) -> Payload:
    """Return the record of the payload, and of the terminal link without and with it.

    ``divided``: (n,) torque scales by which the torques were divided already.
    """
    known_mass = fitted.question.known_mass
    torque_scale = {}
    if known_mass:
        for joint, factor in zip(fitted.arm.joints, divided[fitted.arm.indices]):
            scale = 1.0 + fitted.by_name[f"scale[{joint}]"]
            torque_scale[joint] = float(factor * scale)
    recordings: dict[str, tuple[str, ...]] = {"empty": (), "loaded": ()}
    for name, is_loaded in _kinds(fitted).items():
        recordings["loaded" if is_loaded else "empty"] += (name,)
    both = select(fitted, PARAMETER_NAMES) + select(fitted, PAYLOAD_NAMES)
    return Payload(
        flange,
        _in_flange(fitted, flange, values),
        body_estimate(fitted, fitted.arm.robot.body_name, both, values),
        recordings,
        torque_scale,
        known_mass,
    )


def _without_inertia(payload: Payload) -> Payload:
    """Return the payload, and the link with it, with all moments marked as not identified."""
    is_first = np.arange(10) < 4  # mass and first moments
    body = replace(
        payload.body,
        is_determined=payload.body.is_determined & is_first,
        data_share=payload.body.data_share * is_first,
    )
    is_determined = payload.total.is_determined & is_first
    return replace(
        payload, body=body, total=replace(payload.total, is_determined=is_determined)
    )


def _kinds(fitted: Fit) -> dict[str, bool]:
    """Return each log to whether the arm carries the payload in it, empty ones first."""
    kinds = {log.name: log.is_loaded for log in fitted.recordings}
    return dict(sorted(kinds.items(), key=lambda pair: pair[1]))


def contradiction(fitted: Fit, flange: Flange) -> str:
    """Return a sentence on recordings of one kind that contradict each other; "" where they agree.

    Each recording that is not the only one of its kind is offered a body of its own beside the
    payload: the gain in the log marginal likelihood says whether it has one.
    """
    kinds = _kinds(fitted)
    mass = abs(fitted.by_name[PAYLOAD_NAMES[0]])
    phrases = []
    offers = Offers(fitted, fitted.weights)
    for name, is_loaded in kinds.items():
        same = [other for other in kinds if kinds[other] == is_loaded and other != name]
        if not same:
            continue
        factor = np.diag(spatial.parameter_scale(max(mass, 0.1), 0.1))
        shares = fitted.sums.is_of(name).astype(float)
        offer = offers.offer(Effect(PARAMETER_NAMES, factor, shares=shares))
        gain, theta = offer.gain, offer.values
        expected = fitted.free[fitted.at(PAYLOAD_NAMES)] * is_loaded
        total = expected + theta
        moved = 0.0
        if is_loaded and total[0] > 0.0 and expected[0] > 0.0:
            moved = float(
                np.linalg.norm(total[1:4] / total[0] - expected[1:4] / expected[0])
            )
        is_large = abs(theta[0]) > LEAST_MASS * mass or moved > LEAST_PLACE
        if gain > CLEAR and is_large:
            body = _describe(flange.to_flange(total), LEAST_MASS * mass)
            others = ", ".join(same)
            phrases.append((gain, f"{name} differs from {others}: it carries {body}"))
    return max(phrases)[1] if phrases else ""


def _describe(theta: Array, least: float) -> str:
    """Return a phrase with mass and centre of mass of a body, "nothing" up to a least mass [kg]."""
    if theta[0] <= least:
        return "nothing"
    position = ", ".join(f"{1e3 * x:.0f}" for x in theta[1:4] / theta[0])
    return f"{theta[0]:.3g} kg at ({position}) mm"
