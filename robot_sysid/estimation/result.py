"""From an answer to the result: the file, the verdict, and what the user should know."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.nuisances import gravity
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation import verdict
from robot_sysid.estimation.answer import Answer, base_parameters, estimate_of
from robot_sysid.estimation.columns import PAYLOAD_NAMES
from robot_sysid.estimation.fit import Fit
from robot_sysid.estimation.recordings import contradictions, disagreeing, each_recording
from robot_sysid.estimation.unknowns import FILE_FRICTION
from robot_sysid.model.inertia import subtree_bodies
from robot_sysid.records import DELAY_NAME, Array, DataOrigin, Flange, RobotModel
from robot_sysid.results.model import versions
from robot_sysid.results.record import (
    LINK,
    PAYLOAD,
    BodyEstimate,
    Figure,
    ModelFile,
    Payload,
    Result,
    Verdict,
)

WIDER = 2.0
"""Factor beyond which a prior that had to be widened is told of."""
_CLEAR = 3.0


def model_file(answer: Answer, write_offset: bool) -> tuple[ModelFile, tuple[str, ...]]:
    """Return what is written, and sentences on what is not."""
    assert answer.file is not None
    fit, robot = answer.file.fit, answer.robot
    own = replace(answer, fit=fit, file=None, errors=answer.file.errors)
    thetas = fit.columns.thetas(fit.values)
    spread = np.zeros_like(thetas)
    for body in own.links():
        spread[robot.joint_names.index(str(body.joint))] = body.errors
    joints, notes = {}, []
    kept = set(answer.file.kept)
    for index, (joint, each) in enumerate(list(own.joints())[: robot.n_joints]):
        written = {name: figure for name, figure in each.terms.items() if name != "offset"}
        if write_offset and "offset" in each.terms and FILE_FRICTION not in kept:
            reason = _why_no_offset(robot, index, each.terms)
            notes += [f"{joint}: no offset is written, {reason}"] if reason else []
            written.update({} if reason else {"offset": each.terms["offset"]})
        if written:
            joints[joint] = written
        else:
            notes.append(
                f"{joint} does not move fast enough in these logs: nothing is learnt of its "
                "friction and rotor inertia, the model's own stay"
            )
    turned = fit.next_point.gravity if fit.unknowns.settle else None
    if turned is not None and np.array_equal(turned, gravity(robot)):
        turned = None
    tested = answer.file.before, answer.file.after
    found = ModelFile(thetas, spread, joints, turned, *tested, kept=tuple(sorted(kept)))
    return found, tuple(notes if FILE_FRICTION not in kept else ())


def _why_no_offset(robot: RobotModel, index: int, terms: Mapping[str, Figure]) -> str | None:
    """Return why a file must not get an offset, or None."""
    offset, coulomb = terms["offset"], terms.get("coulomb", Figure(0.0, 0.0))
    if robot.kind != "mjcf":
        return "a URDF cannot hold it"
    joint = robot.mj_model.dof_jntid[robot.dof_index[index]]
    further = getattr(robot.mj_model, "jnt_stiffnesspoly", np.zeros((joint + 1, 1)))
    if robot.mj_model.jnt_stiffness[joint] or np.any(further[joint]):
        return "its spring is the model's own"
    if abs(offset.value) <= 2.0 * offset.error:
        return "it is within two standard errors of zero"
    if abs(offset.value) >= coulomb.value:
        return (
            f"{abs(offset.value):.2g} is more than its Coulomb friction of {coulomb.value:.2g}: "
            "the joint would creep by itself"
        )
    return None


def result_of(answer: Answer, data: DataOrigin, write_offset: bool = False) -> Result:
    """Return everything that is said of the arm from recordings of it alone."""
    fit, robot = answer.fit, answer.robot
    links = tuple(answer.links())
    tests, notes = (answer.validation, *answer.tests), answer.notes
    file, judged = None, _file_verdict(answer)
    if answer.file is not None:
        file, said = model_file(answer, write_offset)
        notes += said
    findings = [
        *verdict.inconsistent(fit),
        *verdict.unexplained(fit, tests, answer.acceleration_error),
        *verdict.implausible_link(robot, links[-1]),
        *(() if file is None else verdict.implausible_links(robot, file.thetas)),
        *(() if judged is None or judged[0].is_trustworthy else (judged,)),
    ]
    common = _common(answer, data)
    seen = common.estimate.identifiability
    ended = Verdict.OK if seen.rank >= seen.n_parameters else Verdict.PARTLY_FROM_MODEL
    status, reasons = verdict.first(findings, ended if judged is None else judged[0])
    return replace(
        common,
        verdict=status,
        reasons=reasons,
        links=links,
        file=file,
        validation=tests,
        notes=tuple(dict.fromkeys((*robot.notes, *notes, *_said(answer, file)))),
        base=None if fit.columns.torques == "terminal" else base_parameters(fit, answer.errors),
    )


def _file_verdict(answer: Answer) -> verdict.Finding | None:
    """Return how the written file predicts beside the one before; None where none is asked for."""
    if answer.file is None:
        return None
    return verdict.of_file(answer.file.before, answer.file.after, verdict.noise_share(answer.fit))


def about(robot: RobotModel) -> dict[str, Any]:
    """Return what a result says of the arm itself, whatever was asked of it."""
    return {
        "model_path": robot.path,
        "model_sha256": robot.sha256,
        "joint_name": robot.terminal_joint,
        "body_name": robot.body_name,
        "joint_names": robot.joint_names,
        "prior": robot.prior,
        "versions": versions(),
        "slides": robot.slides,
        "bodies": subtree_bodies(robot.mj_model, robot.reference_qpos, robot.body_id),
    }


def _common(answer: Answer, data: DataOrigin) -> Result:
    """Return what results of all questions have in common."""
    fit, robot, options = answer.fit, answer.robot, answer.fit.question.options
    joints = dict(answer.joints())
    signals = [each.signals for each in fit.columns.datasets if each.signals is not None]
    models = {model.name for model in fit.choice.friction}
    return Result(
        **about(robot),
        question=PAYLOAD if fit.question.loaded else LINK,
        estimate=estimate_of(answer),
        verdict=Verdict.OK,
        torques=fit.columns.torques,
        data=data,
        joints={name: joints[name] for name in robot.joint_names},
        couplings={name: each for name, each in joints.items() if name not in robot.joint_names},
        sensors=answer.sensors(),
        friction_model=models.pop() if len(models) == 1 else "per joint",
        cutoff=signals[0].cutoff if signals else None,
        prior_scale=fit.choice.prior_scale,
        conflicts=answer.errors.conflicts,
        delay=fit.value(DELAY_NAME) if options.delay == "auto" else None,
        tilt=_turned(robot, fit.point.gravity) if options.tilt == "auto" else None,
    )


def _turned(robot: RobotModel, down: Array) -> float:
    """Return the angle between some gravity (3,) and the model's [rad]."""
    there = gravity(robot)
    return float(np.arctan2(np.linalg.norm(np.cross(down, there)), down @ there))


_ASKED = "held-out torques ask for it"


def _said(answer: Answer, file: ModelFile | None) -> Iterator[str]:
    """Yield sentences on what the user should know of the estimate."""
    scale = answer.fit.choice.prior_scale
    if scale > 1.0:
        yield (
            f"the other links are allowed to be off by {scale:g} times --link-uncertainty: {_ASKED}"
        )
    given = answer.fit.question.options.coupling is not None
    for motor in answer.fit.choice.couplings:
        yield f"a motor turns with {motor.name}: {'as given' if given else _ASKED}"
    for group in answer.fit.unknowns.groups:
        if group.may_widen and group.widened > WIDER:
            yield (
                f"the recordings ask for errors by {group.cause} {group.widened:.1f} times as "
                "large as was thought; those that are printed allow for it"
            )
    zeros = {n: f for n, f in answer.sensors().items() if n.startswith("zero[")}
    for name, figure in zeros.items():
        if abs(figure.value) > max(_CLEAR * figure.error, 1e-3):
            yield (
                f"the log reads {name[5:-1]} {1e3 * figure.value:.1f} \u00b1 "
                f"{1e3 * figure.error:.1g} mrad too large; the links are those of the true "
                "positions"
            )
    if file is not None and file.gravity is not None:
        angle = np.degrees(_turned(answer.robot, file.gravity))
        yield (
            f"the written model's gravity is turned by {angle:.2f} degrees: the base is tilted by "
            "that, or encoder zeros look like it (--keep gravity leaves it alone)"
        )


def payload_of(
    answer: Answer,
    weighed: Answer,
    flange: Flange,
    data: DataOrigin,
    resting: bool,
    write_offset: bool = False,
) -> Result:
    """Return what came on between recordings.

    Args:
        answer: the fit whose scales and payload count, with a known mass where there is one.
        weighed: the fit as if the payload's mass were not known; the same where it is not.
        resting: whether they are poses at rest, which do not show inertia.
        write_offset: whether the file is to hold the offset of each joint's friction.
    """
    known, robot = answer.fit.question.known_mass, answer.robot
    free = _payload(weighed, flange, weighed.fit.free)
    found = list(verdict.of_payload(robot, free, contradictions(weighed.fit), weighed.validation))
    if known is not None:
        found = list(verdict.of_known_mass(found, free.inertial.mass, known))
    status, reasons = verdict.first(found, Verdict.OK)
    values = answer.fit.values if status.is_trustworthy else answer.fit.free
    if resting and status.is_trustworthy:
        values = _with_ball(answer.fit, values)
    scatter = each_recording(weighed.fit, flange, weighed.stretch()) if known is None else ()
    link, total = (_link(answer, values, loaded) for loaded in (False, True))
    datasets = answer.fit.columns.datasets
    names = {
        kind: tuple(each.name for each in datasets if each.is_loaded is loaded)
        for kind, loaded in (("empty", False), ("loaded", True))
    }
    body, scales = _payload(answer, flange, values), {} if known is None else _scales(answer)
    payload = Payload(flange, body, link, total, names, scatter, scales, known)
    file, said = _arm_file(answer, write_offset)
    notes = (*answer.notes, *said, *_said(answer, file))
    notes = (*notes, *disagreeing(scatter, free.inertial.mass))
    return replace(
        _common(answer, data),
        verdict=status,
        reasons=reasons,
        links=tuple(answer.links()),
        payload=payload,
        file=file,
        validation=(answer.validation, *answer.tests),
        notes=tuple(dict.fromkeys((*robot.notes, *notes))),
    )


def _arm_file(answer: Answer, write_offset: bool) -> tuple[ModelFile | None, tuple[str, ...]]:
    """Return what is written of the arm beneath its payload, and sentences on it."""
    judged = _file_verdict(answer)
    if judged is None or judged[0].is_trustworthy:
        return (None, ()) if judged is None else model_file(answer, write_offset)
    return None, (f"the written model is the arm's own with the payload on it: {judged[1]}",)


def _scales(answer: Answer) -> dict[str, Figure]:
    """Return joint to what its torques are to be divided by."""
    found = {joint: answer.figure(f"scale[{joint}]") for joint in answer.fit.columns.joints}
    return {joint: Figure(1.0 + each.value, each.error) for joint, each in found.items()}


def _payload(answer: Answer, flange: Flange, values: Array) -> BodyEstimate:
    """Return the payload of some values (p,), in the flange frame."""
    change = np.stack([flange.to_flange(unit) for unit in np.eye(10)], axis=1)
    theta = change @ values[answer.fit.columns.at(PAYLOAD_NAMES)]
    return answer.body("payload", change @ answer.pick(PAYLOAD_NAMES), theta, None)


def _link(answer: Answer, values: Array, loaded: bool) -> BodyEstimate:
    """Return the terminal link of some values (p,), without or with the payload."""
    change, theta = answer.pick(PARAMETER_NAMES), values[:10]
    if loaded:
        change = change + answer.pick(PAYLOAD_NAMES)
        theta = theta + values[answer.fit.columns.at(PAYLOAD_NAMES)]
    name = answer.robot.body_name
    return answer.body(name, change, theta, None if loaded else answer.robot.prior.theta)


def _with_ball(fit: Fit, values: Array) -> Array:
    """Return values with the payload's inertia that of a ball of aluminium of its mass.

    At rest nothing shows the inertia; a small body there is as good a guess as any.
    """
    places, found = fit.columns.at(PAYLOAD_NAMES), values.copy()
    mass, com, _ = spatial.com_from_theta(values[places])
    found[places] = spatial.aluminium_ball(mass, com)
    return found
