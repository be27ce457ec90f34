"""From an answer to the Result record: the model file, the verdict, notes for the user, traces.

Shapes: the arm's chain has n joints, a fit p parameters (``Columns.names``), and a body ten
inertial parameters (``PARAMETER_NAMES``), the first four its mass and first moments.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from robot_sysid.dynamics.equations import split_name
from robot_sysid.dynamics.inverse_dynamics import gravity_vector, tilt_angles
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation.algebra.common_scale import LEAST_SCALE
from robot_sysid.estimation.algebra.priors import LINK_KINDS
from robot_sysid.estimation.answer import (
    Answer,
    estimate_of,
    model_file,
    written_payload,
)
from robot_sysid.estimation.columns import PAYLOAD_NAMES
from robot_sysid.estimation.dataset import DecimatedSamples, motion_signals
from robot_sysid.estimation.payload_recordings import (
    contradiction,
    payloads_by_recording,
)
from robot_sysid.estimation.trust import (
    UNEXPLAINED,
    UNUSUAL,
    Judgement,
    find_misfits,
    first,
    implausible_joints,
    implausible_link,
    implausible_links,
    judge_file,
    judge_known_mass,
    judge_payload,
    noise_share,
    unexplained_share,
    wrong_links,
)
from robot_sysid.records import (
    Array,
    DataOrigin,
    Flange,
    JointLimits,
    Motion,
    RobotModel,
    WrongLink,
)
from robot_sysid.records.data import Traces
from robot_sysid.records.messages import Detail, with_error
from robot_sysid.results.record import (
    LINK,
    PAYLOAD,
    BodyEstimate,
    JointEstimate,
    ModelFile,
    Payload,
    Quantity,
    RecordingPayload,
    Result,
    Verdict,
)

WIDER = 2.0
"""Factor on a prior's standard deviation, estimated from the data, above which a note is added."""
# Distance of an encoder zero from zero, in standard errors, above which it is significant.
_CLEAR = 3.0
# Size of an encoder zero up to which no note is added, even if it is significant [rad].
_SMALL_ZERO = 1e-3


def result_of(answer: Answer, data: DataOrigin) -> Result:
    """Return the result for an arm from recordings without a payload.

    Its verdict is that of the first reason against the fit, the links or the model file; without
    such a reason, it is that on the model file or, without a file, whether the data identifies all
    parameters. Where too much torque is unexplained (``UNEXPLAINED``), or the given friction model
    misses terms that the torques show, it is never better than ``Verdict.TORQUES_ONLY``.

    Args:
        answer: the identified arm.
        data: where the recordings come from.
    """
    fit = answer.fit
    robot = answer.robot
    file = None
    links = tuple(answer.links())
    tests = (answer.validation, *answer.tests)
    notes = answer.notes
    common = _common(answer, data)
    independent_share = common.estimate.independent_share
    # Pairs (verdict, reason); the verdict of the first one counts.
    findings = [*find_misfits(fit, tests, answer.acceleration_error, independent_share)]
    share, sentence = unexplained_share(fit, independent_share)
    notes += (sentence,) if share > UNUSUAL else ()
    findings += implausible_link(robot, links[-1])
    findings += implausible_joints(robot, common.joints, fit.evidence.torque)
    identifiability = common.estimate.identifiability
    is_full = identifiability.rank >= identifiability.n_parameters
    verdict = Verdict.OK if is_full else Verdict.PARTLY_FROM_MODEL
    judgement = _file_verdict(answer)
    if judgement is not None:
        file, file_notes = model_file(answer)
        notes += file_notes
        findings += implausible_links(robot, file.thetas)
        verdict, _ = judgement
        if not verdict.is_trustworthy:
            findings.append(judgement)
    status, reasons = first(findings, verdict)
    doubts = [sentence] if share > UNEXPLAINED else []
    if answer.missed_friction:
        doubts.append(answer.missed_friction)
    if doubts:
        # A file that clearly predicts better is written all the same, for torques only.
        if status is Verdict.BETTER:
            status = Verdict.TORQUES_ONLY
        else:
            status, _ = first(findings, Verdict.UNEXPLAINED)
        reasons = (*reasons, *doubts)
    # Links that took up the torque of missed friction say nothing of the model's.
    contradicted = () if answer.missed_friction else tuple(wrong_links(links[:-1]))
    notes += tuple(map(_wrong_link_line, contradicted))
    all_notes = (*robot.notes, *notes, *_result_notes(answer, file))
    return replace(
        common,
        verdict=status,
        reasons=reasons,
        links=links,
        wrong_links=contradicted,
        file=file,
        validation=tests,
        notes=tuple(dict.fromkeys(all_notes)),
    )


def _wrong_link_line(link: WrongLink) -> str:
    """Return a sentence for the user on a link of the model that the recordings contradict."""
    moment = with_error(link.first_moment, link.error, "kg m")
    return (
        f"{link.name} of the model is probably wrong: its mass times the distance of its centre of "
        f"mass is {moment}, in the model {link.first_moment_of_model:.3g}; the torques do not "
        "separate mass and distance"
    )


def _file_verdict(answer: Answer) -> Judgement | None:
    """Return (verdict, reason) on the written file compared with the given model.

    None where no file was fitted.
    """
    file = answer.file
    if file is None or file.model_validation is None:
        return None
    return judge_file(file.model_validation, file.validation, noise_share(answer.fit))


def _common(answer: Answer, data: DataOrigin) -> Result:
    """Return a result with the fields that do not depend on whether a payload is identified.

    Its verdict, ``Verdict.OK``, is a placeholder that callers replace.
    """
    fit = answer.fit
    robot = answer.robot
    scales = fit.choice.link_scales
    joints: dict[str, JointEstimate] = {}
    motors: dict[str, JointEstimate] = {}
    for name, joint in answer.joints():
        owners = joints if name in robot.joint_names else motors
        owners[name] = joint
    signals = motion_signals(fit.columns.datasets)
    models = {model.name for model in fit.choice.friction}
    return Result(
        robot=robot,
        question=PAYLOAD if fit.question.loaded else LINK,
        estimate=estimate_of(answer),
        verdict=Verdict.OK,
        torques=fit.columns.torques,
        data=data,
        joints=joints,
        couplings=motors,
        sensors=answer.sensors(),
        friction_model=models.pop() if len(models) == 1 else "per joint",
        cutoff=signals[0].cutoff if signals else None,
        link_scales={name: getattr(scales, name) for name in LINK_KINDS},
        conflicts=answer.errors.conflicts,
    )


def _result_notes(answer: Answer, file: ModelFile | None) -> Iterator[str]:
    """Yield sentences for the user on torque scale, couplings, priors, encoder zeros and gravity.

    Args:
        answer: the fit with its errors.
        file: the written model file; None where none is written.
    """
    left_out = answer.fit.question.options.left_out_terms
    if answer.missed_friction:
        yield answer.missed_friction
    elif left_out:
        yield (
            f"not estimated, as the friction model is given without: {', '.join(left_out)}"
        )
    sensors = answer.sensors()
    common_scale = 0.0
    if answer.fit.choice.common_scale:
        scales = [sensors[n].value for n in sensors if n.startswith("scale[")]
        common_scale = float(np.mean(scales))
    # A first fit calls for the common scale; the last one may find it to be near zero.
    if abs(common_scale) > LEAST_SCALE:
        yield (
            f"all torques read about {1.0 + common_scale:.3g} times what the model takes: either "
            "the torque scale is off (--torque-scale), or the masses of all links in the model "
            "have a common scale error; one log cannot separate these two, and the stated errors "
            "include both"
        )
    for motor in answer.fit.choice.couplings:
        if motor.tendon is None:
            why = "the torques give clear evidence of it"
            yield f"a motor turns with {motor.name}: {why}"
    # A group is the prior of the parameters with one cause of error.
    for group in answer.fit.unknowns.groups:
        if group.may_widen and group.widened > WIDER:
            yield (
                f"the data contradicts the prior on {group.cause}: its standard deviation was "
                f"raised {group.widened:.1f} times, and the stated errors include this"
            )
    for name, quantity in sensors.items():
        large = abs(quantity.value) > max(_CLEAR * quantity.error, _SMALL_ZERO)
        # The joint's name is between the brackets of "zero[...]".
        if name.startswith("zero[") and large:
            yield (
                f"the log reads {name[5:-1]} {1e3 * quantity.value:.1f} \u00b1 "
                f"{1e3 * quantity.error:.1g} mrad too large; the links are those of the true "
                "positions"
            )
    if file is not None and file.gravity is not None:
        angle = math.degrees(
            math.hypot(*tilt_angles(gravity_vector(answer.robot), file.gravity))
        )
        yield (
            f"the written model's gravity is turned by {angle:.2f} degrees: the base is tilted by "
            "that, or encoder zeros look like it (--keep gravity leaves it alone)"
        )


def payload_of(
    answer: Answer, weighed: Answer, flange: Flange, data: DataOrigin
) -> Result:
    """Return the result for a payload.

    Args:
        answer: the fit whose scales and payload are reported, with the known mass if there is one.
        weighed: the fit without the known mass; equal to ``answer`` where there is none.
        flange: the frame in which the payload is stated.
        data: where the recordings come from.
    """
    fit = answer.fit
    robot = answer.robot
    known_mass = fit.question.known_mass
    # Judged is the payload before bodies were made consistent: that step hides a negative mass.
    free = _payload(weighed, flange, weighed.fit.free)
    sentence = contradiction(weighed.fit, flange)
    findings = list(judge_payload(robot, free, sentence, weighed.validation))
    if known_mass is not None:
        findings = list(judge_known_mass(findings, free.inertial.mass, known_mass))
    status, reasons = first(findings, Verdict.OK)
    values = fit.free.copy()
    unknown_inertia = ""
    if status.is_trustworthy:
        values = fit.values.copy()
        theta, unknown_inertia = written_payload(answer)
        values[fit.columns.indices(PAYLOAD_NAMES)] = theta
    scatter = payloads_by_recording(weighed.fit, flange) if known_mass is None else ()
    payload = _payload_estimate(answer, flange, values, scatter)
    notes = (*robot.notes, *answer.notes)
    if unknown_inertia:
        payload = _without_inertia(payload)
        status = Verdict.INERTIA_NOT_KNOWN if known_mass is None else status
        notes += (Detail(unknown_inertia),)
    file, file_notes = _arm_file(answer)
    notes += (*file_notes, *_result_notes(answer, file))
    return replace(
        _common(answer, data),
        verdict=status,
        reasons=reasons,
        links=tuple(answer.links()),
        payload=payload,
        file=file,
        validation=(answer.validation, *answer.tests),
        notes=tuple(dict.fromkeys(notes)),
    )


def _payload_estimate(
    answer: Answer, flange: Flange, values: Array, scatter: tuple[RecordingPayload, ...]
) -> Payload:
    """Return the record of the payload, and of the terminal link without and with the payload.

    Args:
        answer: the fit with its errors.
        flange: the frame in which the payload is stated.
        values: (p,) values of all parameters, from which the three bodies are taken.
        scatter: the payload according to each recording alone.
    """
    columns = answer.fit.columns
    known_mass = answer.fit.question.known_mass
    torque_scale = {}
    if known_mass:
        for joint in columns.joints:
            scale = answer.quantity(f"scale[{joint}]")
            torque_scale[joint] = Quantity(1.0 + scale.value, scale.error)
    recordings: dict[str, tuple[str, ...]] = {"empty": (), "loaded": ()}
    for log in columns.datasets:
        recordings["loaded" if log.is_loaded else "empty"] += (log.name,)
    return Payload(
        flange,
        _payload(answer, flange, values),
        _link(answer, values, loaded=False),
        _link(answer, values, loaded=True),
        recordings,
        scatter,
        torque_scale,
        known_mass,
    )


def _without_inertia(payload: Payload) -> Payload:
    """Return the payload with all moments of inertia marked as not identified.

    This holds for the payload and for the terminal link with the payload.
    """
    is_first = np.arange(10) < 4  # mass and first moments
    body = replace(
        payload.body,
        is_determined=payload.body.is_determined & is_first,
        data_share=payload.body.data_share * is_first,
    )
    is_determined = payload.total.is_determined & is_first
    total = replace(payload.total, is_determined=is_determined)
    return replace(payload, body=body, total=total)


def _arm_file(answer: Answer) -> tuple[ModelFile | None, tuple[str, ...]]:
    """Return (model file of the arm without its payload, notes on the file for the user).

    The file is None where none was fitted, and where its verdict is not trustworthy, as of a file
    that predicts worse than the given model; a note then has the reason.
    """
    judgement = _file_verdict(answer)
    if judgement is None:
        return None, ()
    verdict, reason = judgement
    if verdict.is_trustworthy:
        return model_file(answer)
    note = f"the written model is the arm's own with the payload on it: {reason}"
    return None, (note,)


def _payload(answer: Answer, flange: Flange, values: Array) -> BodyEstimate:
    """Return the payload with its errors, in the flange frame.

    Args:
        answer: the fit with its errors.
        flange: the frame in which the payload is stated.
        values: (p,) values of all parameters, from which the payload is taken.
    """
    # The change of frame is linear: its matrix has the images of the ten unit bodies as columns.
    to_flange = np.stack(list(map(flange.to_flange, np.eye(10))), axis=1)
    theta = to_flange @ values[answer.fit.columns.indices(PAYLOAD_NAMES)]
    combinations = to_flange @ answer.selection_matrix(PAYLOAD_NAMES)
    return answer.body("payload", combinations, theta, model_theta=None)


def _link(answer: Answer, values: Array, loaded: bool) -> BodyEstimate:
    """Return the terminal link with its errors, in the frame of its body.

    Args:
        answer: the fit with its errors.
        values: (p,) values of all parameters, the first ten those of the link.
        loaded: whether the payload is part of the link.
    """
    combinations = answer.selection_matrix(PARAMETER_NAMES)
    theta = values[:10]
    if loaded:
        combinations = combinations + answer.selection_matrix(PAYLOAD_NAMES)
        theta = theta + values[answer.fit.columns.indices(PAYLOAD_NAMES)]
    robot = answer.robot
    model_theta = None if loaded else robot.prior.theta
    return answer.body(robot.body_name, combinations, theta, model_theta)


# Terms of parameter names with a joint in brackets that are no torque of friction.
_NOT_FRICTION = ("armature", "zero", "scale", "drift")


def make_traces(
    robot: RobotModel,
    samples: Sequence[DecimatedSamples],
    motions: Sequence[Motion],
    estimate: Mapping[str, float],
    prior: Mapping[str, float],
) -> Traces:
    """Return the measured and the predicted torques of all logs, one log after the other.

    Args:
        robot: the arm, for the types and limits of its joints.
        samples: equations of each log, at least of one; all logs have the same parameter names.
        motions: motion of each log, which is interpolated here to the instants of its equations.
        estimate: parameter name to estimated value; missing parameters are zero.
        prior: parameter name to the model's value; missing parameters are zero.
    """
    joints = samples[0].joints
    indices = [robot.joint_names.index(joint) for joint in joints]

    def join_logs(signals: Iterable[Sequence[Array]]) -> Array:
        """Return signals (K,) of each joint in each log as one array (K of all logs, joints)."""
        return np.concatenate(list(map(np.column_stack, signals)))

    def interpolate_motion(name: str) -> Array:
        """Return a field of the motions, "q" or "qd", at the instants of all rows (K, joints)."""
        interpolated = []
        for log, motion in zip(samples, motions):
            signals = getattr(motion, name).T[indices]
            interpolated.append([np.interp(log.time, motion.time, x) for x in signals])
        return join_logs(interpolated)

    def predict(values: Mapping[str, float]) -> Array:
        """Return the torque (K, joints) of all rows that named parameters make [N m]."""
        coefficients = np.array([values.get(name, 0.0) for name in samples[0].names])
        return join_logs(log.torque(coefficients) for log in samples)

    right_sides = join_logs(log.tau for log in samples)
    measured = join_logs(log.measured for log in samples)
    limits = robot.limits
    friction = {}
    for name, value in estimate.items():
        term, owner = split_name(name)
        if owner and term not in _NOT_FRICTION:
            friction[name] = value
    return Traces(
        joints=joints,
        is_slide=tuple(robot.is_slide[indices].tolist()),
        time=np.concatenate([log.time for log in samples]),
        q=interpolate_motion("q"),
        qd=interpolate_motion("qd"),
        measured=np.where(np.isfinite(right_sides), measured, np.nan),
        # A right-hand side lacks the torque that depends on no parameter: it is added back.
        predicted=measured - right_sides + predict(estimate),
        prior_prediction=measured - right_sides + predict(prior),
        friction=predict(friction),
        limits=JointLimits(
            limits.lower[indices],
            limits.upper[indices],
            limits.velocity[indices],
            limits.torque[indices],
        ),
    )


def traces_of(answer: Answer) -> Traces:
    """Return the measured torques, and the predictions of the written file and the given model.

    Without a file, the fit's predictions replace those of the file. Both predictions contain the
    estimated offsets of the torque sensors. With a payload, the second prediction is that of the
    fit without the payload.
    """
    fit = answer.fit if answer.file is None else answer.file.fit
    names = fit.columns.names
    estimate = dict(zip(names, fit.values.tolist()))
    prior = dict(zip(names, fit.columns.model_values.tolist()))
    if fit.question.loaded:
        prior = estimate | dict.fromkeys(PAYLOAD_NAMES, 0.0)
    for name, value in estimate.items():
        if name.startswith("offset["):
            prior[name] = value
    motions = []
    for dataset in fit.columns.datasets:
        motions.append(dataset.remove_delay(fit.point.delay).motion)
    return make_traces(fit.columns.robot, fit.samples, motions, estimate, prior)
