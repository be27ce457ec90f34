"""A payload: its result, what each recording weighs, and whether recordings agree.

Shapes: k estimated parameters; a body has ten inertial parameters (``PARAMETER_NAMES``).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from robot_sysid import spatial
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.held_out import validation
from robot_sysid.estimate.offers import Effect, Offers
from robot_sysid.estimate.restricted_fit import model_file
from robot_sysid.estimate.result import (
    body_estimate,
    fit_quantities,
    link_estimates,
    quantity,
    result_of,
    select,
    traces_of,
    values_with_bodies_of,
)
from robot_sysid.estimate.terms import PAYLOAD_NAMES
from robot_sysid.estimate.trust import (
    judge_files,
    judge_known_mass,
    judge_payload,
    missed_friction,
)
from robot_sysid.records import Array, DataOrigin, Flange
from robot_sysid.records.levels import CLEAR
from robot_sysid.records.messages import Detail, Level, Remark, with_error
from robot_sysid.records.parameters import SCALE
from robot_sysid.results.quantities import (
    body_quantities,
    is_inertia_known,
    principal_moments,
)
from robot_sysid.results.record import (
    PAYLOAD,
    BodyEstimate,
    Identification,
    Payload,
    Quantity,
    Verdict,
)
from robot_sysid.spatial import PARAMETER_NAMES


def written_payload(fitted: Fit) -> tuple[Array, str]:
    """Return the payload (10,) to write into a model, and why its inertia is not identified.

    The reason is "" where the inertia is identified. Otherwise the payload is replaced by a ball of
    aluminium of the estimated mass at the estimated centre of mass. The parameters are in the frame
    of the terminal body.
    """
    body = body_estimate(
        fitted, "payload", select(fitted, PAYLOAD_NAMES), fitted.values
    )
    if body.mass <= 0.0 or is_inertia_known(body):
        return body.theta, ""
    moments, errors = principal_moments(body)
    listed = ", ".join(map(with_error, moments.tolist(), errors.tolist()))
    reason = (
        f"the payload's principal moments of inertia, {listed} kg·m², do not differ significantly "
        "from zero"
    )
    if not np.all(np.isfinite(errors)):
        reason = "the payload's inertia is not identifiable from these torques"
    return spatial.aluminium_ball(body.mass, body.com), reason


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
    file_notes: list[str] = []
    if file is not None:
        written = model_file(file)
        judgement, *_ = judge_files(written, fitted.arm.model_bends)
        if judgement.level is not Level.SAYS:
            file = None
            written = None
            file_notes = [
                f"the written model is the arm's own with the payload on it: {judgement.text}"
            ]
    remarks = _refusals(weighed, flange, known_mass)
    values = fitted.free.copy()
    unknown_inertia = ""
    if not remarks:
        values = values_with_bodies_of(fitted, file)
        theta, unknown_inertia = written_payload(fitted)
        values[fitted.at(PAYLOAD_NAMES)] = theta
    both = select(fitted, PARAMETER_NAMES) + select(fitted, PAYLOAD_NAMES)
    body = _in_flange(fitted, flange, values)
    name = f"{fitted.arm.robot.body_name} with payload"
    total = body_estimate(fitted, name, both, values)
    notes = [*sentences]
    if unknown_inertia:
        body, total = map(_without_inertia, (body, total))
        notes.append(Detail(unknown_inertia))
        if known_mass is None:
            remarks.append(Verdict.INERTIA_NOT_KNOWN.remark())
    missed = missed_friction(fitted)
    remarks += [Remark(Level.DOUBTS, "friction", missed)] if missed else []
    links = link_estimates(fitted, file)
    rows = [*body_quantities(body), *body_quantities(total)]
    if known_mass is not None:
        rows += _torque_scales(fitted, divided)
    rows += fit_quantities(fitted, file, links)
    of_flange = Payload(**vars(body), flange=flange, recordings=_recordings(fitted))
    return result_of(
        fitted,
        file,
        links,
        rows,
        remarks,
        [*notes, *file_notes],
        question=PAYLOAD,
        data=origin,
        standard_errors=dict(zip(PARAMETER_NAMES, body.errors.tolist())),
        payload=replace(of_flange, known_mass=known_mass),
        total=total,
        file=written,
        validation=(validation(fitted),),
        checkpoints=fitted.recordings[-1].motion,
        traces=partial(traces_of, fitted),
    )


def _refusals(weighed: Fit, flange: Flange, known_mass: float | None) -> list[Remark]:
    """Return reasons against a payload, or against torque scales from its known mass [kg].

    Judged is the payload before bodies were made possible: that step hides a negative mass.
    """
    free = _in_flange(weighed, flange, weighed.free)
    reason = contradiction(weighed, flange)
    test = validation(weighed)
    remarks = [*judge_payload(weighed.arm.robot, free, reason, test)]
    if known_mass is None:
        return remarks
    return [*judge_known_mass(remarks, free.mass, known_mass)]


def _torque_scales(fitted: Fit, divided: Array) -> Iterator[Quantity]:
    """Yield the torque scales by a known mass: what the log reads over what is there.

    ``divided``: (n,) torque scales by which the torques were divided already.
    """
    for joint, factor in zip(fitted.arm.joints, divided[fitted.arm.indices].tolist()):
        value, error = quantity(fitted, SCALE.key_of(joint))
        scale = factor * (1.0 + value)
        yield Quantity("torque_scale", joint, "", 1.0, scale, factor * error)


def _in_flange(fitted: Fit, flange: Flange, values: Array) -> BodyEstimate:
    """Return the payload at parameters (k,), in the flange frame."""
    # The change of frame is linear: its matrix has the images of the ten unit bodies as columns.
    to_flange = np.stack(list(map(flange.to_flange, np.eye(10))), axis=1)
    combinations = to_flange @ select(fitted, PAYLOAD_NAMES)
    return body_estimate(fitted, PAYLOAD, combinations, values)


def _without_inertia(body: BodyEstimate) -> BodyEstimate:
    """Return a body with all moments of inertia marked as not identified."""
    is_first = np.arange(10) < 4  # mass and first moments
    return replace(
        body,
        is_determined=body.is_determined & is_first,
        data_share=body.data_share * is_first,
    )


def _recordings(fitted: Fit) -> dict[str, tuple[str, ...]]:
    """Return "empty" and "loaded" to the names of the logs without and with the payload."""
    kinds = {log.name: log.is_loaded for log in fitted.recordings}
    return {
        "empty": tuple(name for name in kinds if not kinds[name]),
        "loaded": tuple(name for name in kinds if kinds[name]),
    }


def contradiction(fitted: Fit, flange: Flange) -> str:
    """Return a sentence on recordings of one kind that contradict each other; "" where they agree.

    Each recording that is not the only one of its kind is offered a body of its own beside the
    payload: the gain in the log marginal likelihood says whether it has one.
    """
    kinds = {log.name: log.is_loaded for log in fitted.recordings}
    mass = abs(fitted.by_name[PAYLOAD_NAMES[0]])
    # Differences in mass, and of 1 cm in its centre, below which recordings agree.
    least = 0.03 * mass
    phrases = []
    offers = Offers(fitted, fitted.weights)
    factor = np.diag(spatial.parameter_scale(max(mass, 0.1), 0.1))
    for name, is_loaded in kinds.items():
        same = [other for other in kinds if kinds[other] == is_loaded and other != name]
        if not same:
            continue
        shares = fitted.sums.is_of(name).astype(float)
        offer = offers.offer(Effect(PARAMETER_NAMES, factor, shares=shares))
        expected = fitted.free[fitted.at(PAYLOAD_NAMES)] * is_loaded
        total = expected + offer.values
        moved = 0.0
        if total[0] > 0.0 and expected[0] > 0.0:
            places = total[1:4] / total[0] - expected[1:4] / expected[0]
            moved = float(np.linalg.norm(places))
        if offer.gain > CLEAR and (abs(offer.values[0]) > least or moved > 0.01):
            body = _describe(flange.to_flange(total), least)
            text = f"{name} differs from {', '.join(same)}: it carries {body}"
            phrases.append((offer.gain, text))
    return max(phrases)[1] if phrases else ""


def _describe(theta: Array, least: float) -> str:
    """Return a phrase with mass and centre of mass of a body, "nothing" up to a least mass [kg]."""
    if theta[0] <= least:
        return "nothing"
    position = ", ".join(f"{1e3 * x:.0f}" for x in theta[1:4] / theta[0])
    return f"{theta[0]:.3g} kg at ({position}) mm"
