"""Whether a result is trustworthy: reasons against a fit, a link, a file or a payload.

A large standard error alone is no reason. Refused are bodies that this arm cannot carry, torques
that do not follow from the motion, and files that predict no better than the given model.

A body has ten inertial parameters (``PARAMETER_NAMES``); the chain has n joints. "Independent
samples" are those that count after the autocorrelation of residuals.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from robot_sysid.estimate.contacts import LITTLE
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.held_out import is_clearly_lower, validation
from robot_sysid.estimate.questions import NEGLIGIBLE
from robot_sysid.model.bodies import link_reach
from robot_sysid.records import InertialParameters, RobotModel, Validation
from robot_sysid.records.levels import INTERVAL, SURE
from robot_sysid.records.messages import Level, Remark, percent, torque_unit, with_error
from robot_sysid.results.record import (
    BodyEstimate,
    ModelErrors,
    ModelFile,
    Quantity,
    Verdict,
)
from robot_sysid.wording import option_name


def find_misfits(fitted: Fit, tests: Sequence[Validation]) -> Iterator[Remark]:
    """Yield reasons why the torques do not follow from the motion within their noise.

    A joint without data has no noise, a joint without torque no ratio of noise to torque; both are
    left out.

    Args:
        fitted: the fit with its noise.
        tests: held-out errors and errors on other logs; only informative ones count.
    """
    noise = fitted.noise_per_joint
    for test in tests:
        if not test.is_informative or (test.relative_error or 0.0) <= LITTLE:
            continue
        errors = test.rmse_per_joint
        ratios = [errors[joint] / noise[joint] for joint in errors if joint in noise]
        ratio = np.sqrt(np.mean(np.square(ratios or [0.0])))
        if ratio > SURE:
            yield Verdict.UNEXPLAINED.remark(
                f"torques of {test.source} are predicted {ratio:.2g} times worse than the noise "
                "of the fit allows"
            )
    torque = fitted.torque
    shares = {joint: noise[joint] / torque[joint] for joint in noise if torque[joint]}
    independent = dict(zip(fitted.arm.joints, 1.0 / fitted.correlation))
    for joint, share in shares.items():
        others = shares.keys() - {joint}
        # Of white noise, 0.6 to 1 of the samples are independent, of torque with another cause 0.1.
        if not others or independent[joint] >= 0.5:
            continue
        median = np.median([shares[other] for other in others])
        # Of a wrist that carries nearly nothing, sensors show little but their own slow errors.
        # Only a torque that is not there makes a residual larger than what is measured.
        sensor = max(noise[other] for other in others)
        is_odd = share > 1.0 or noise[joint] > sensor
        if is_odd and share > max(0.3, 10.0 * median):
            yield Verdict.UNEXPLAINED.remark(
                f"{percent(share)} of the torque of {joint} is unexplained, of the other "
                f"joints' {percent(median)}"
            )


def unexplained_torque(fitted: Fit) -> str:
    """Return a sentence on the torque that neither model nor noise explains."""
    torque = np.maximum(fitted.sums.rms_torque, 1e-300)
    largest = np.argsort(-fitted.unexplained)[:3].tolist()
    phrases = [
        f"{percent(float(fitted.unexplained[k] / torque[k]))} of {fitted.arm.joints[k]}"
        for k in largest
    ]
    return (
        f"{percent(fitted.unexplained_share)} of the torque is explained by neither the model nor "
        f"noise ({', '.join(phrases)})"
    )


def missed_friction(fitted: Fit) -> str:
    """Return a sentence on friction terms that the user left out but the torques clearly show.

    Links and other terms take up the torque of such terms, which no standard error allows for. It
    is "" where no joint's held-out error is clearly lower with the terms.
    """
    options = fitted.question.options
    missed = options.left_out_terms
    if not missed:
        return ""
    terms = {term.key: term for term in fitted.equations.terms}
    terms |= {name: fitted.arm.terms[name] for name in missed}
    complete = fitted.refit([*terms.values()], possible=True)
    joints = []
    torques = np.sum(fitted.sums.squared_torque, axis=0)
    rows = zip(fitted.arm.joints, torques, fitted.held_out.T, complete.held_out.T)
    for joint, torque, given, better in rows:
        is_large = np.sum(given) > NEGLIGIBLE**2 * torque
        if is_large and is_clearly_lower(better, given):
            joints.append(joint)
    if not joints:
        return ""
    errors = [
        percent(validation(each).relative_error or 0.0) for each in (fitted, complete)
    ]
    model = option_name("friction_model")
    remedy = f"leave out {model}, or add {'-'.join(missed)} to it"
    return (
        f"the torques of {', '.join(joints)} clearly show friction terms that were left out "
        f"({', '.join(missed)}), and that links and other terms take up: the torque error on "
        f"held-out data is {errors[0]}, with them {errors[1]}; "
        f"{'identify friction, too' if options.no_friction else remedy}"
    )


def implausible_link(robot: RobotModel, link: BodyEstimate) -> Iterator[Remark]:
    """Yield reasons why this arm cannot have the estimated terminal link.

    Bounds on its centre of mass and radius of gyration follow from the extent of the link's
    geometry in the model and from the reach of the arm. A link without a positive mass has neither,
    so nothing is yielded. A mass that the data does not identify is compared with the model's.
    """
    errors = link.errors
    if not link.mass > 0.0:
        return
    # Largest distances from the link's origin and from the arm's first joint [m].
    reach = link_reach(robot)
    arm = reach + robot.reach
    slack = INTERVAL * np.linalg.norm(errors[1:4]) / link.mass
    distance = np.linalg.norm(link.com)
    where = f"on a link that reaches {reach:.2g} m"
    # A tool that the model does not have may be bolted to the link: its centre of mass may lie 30 %
    # of the arm's reach beyond it, and the radius of gyration exceed it by 10 %.
    if distance - slack > reach + 0.3 * arm:
        yield Verdict.IMPLAUSIBLE.remark(
            f"the centre of mass is {distance:.2g} m away {where}"
        )
    moment = link.principal_moments[-1]
    slack = INTERVAL * np.max(errors[4:10])
    if moment - slack > link.mass * (reach + 0.1 * arm) ** 2:
        radius = np.sqrt(moment / link.mass)
        yield Verdict.IMPLAUSIBLE.remark(
            f"the radius of gyration is {radius:.2g} m {where}"
        )
    ratio = link.mass / robot.prior.mass
    if not np.isfinite(errors[0]) and not 0.5 <= ratio <= 2.0:
        yield Verdict.IMPLAUSIBLE.remark(
            f"these torques do not show the mass, yet the rest is only possible with "
            f"{link.mass:.3g} kg where the model has {robot.prior.mass:.3g} kg"
        )


def implausible_joints(
    robot: RobotModel, quantities: Iterable[Quantity], torque: Mapping[str, float]
) -> Iterator[Remark]:
    """Yield reasons why this arm cannot have the estimated friction and rotor inertia.

    Dry friction is compared with the joint's torque limit and with the torques of the other joints
    of its type (hinge or slide), a rotor with the inertia of the outstretched arm, as if all mass
    were at its end.

    Args:
        robot: the arm with its model.
        quantities: identified numbers, among them those of its joints.
        torque: joint to the root mean square of its measured torque [N m].
    """
    inertia = robot.mass * robot.length**2
    # Least values that the errors allow. A term at its bound has the error NaN, and no comparison
    # with NaN is true.
    least = {
        (row.of, row.name): row.value - INTERVAL * row.error
        for row in quantities
        if row.error is not None
    }
    torques = np.array([torque.get(name, 0.0) for name in robot.joint_names])
    for index, (name, slide) in enumerate(zip(robot.joint_names, robot.is_slide)):
        dry = least.get((name, "coulomb"), least.get((name, "sigmoid"), 0.0))
        rotor = least.get((name, "armature"), 0.0)
        is_other = robot.is_slide == slide
        is_other[index] = False
        strongest = 3.0 * np.max(torques[is_other], initial=0.0) or np.inf
        if dry > min(robot.limits.torque[index], strongest):
            yield Verdict.IMPLAUSIBLE.remark(
                f"{name} would have {dry:.3g} {torque_unit(slide)} of dry friction or more"
            )
        if not slide and rotor > inertia > 0.0:
            yield Verdict.IMPLAUSIBLE.remark(
                f"{name} would have a rotor of {rotor:.3g} kg·m² or more"
            )


def wrong_links(links: Sequence[BodyEstimate], remedy: str) -> Iterator[Remark]:
    """Yield a doubt on each link whose first moment in the model the recordings contradict.

    Mass and centre of mass of a link are confounded with each other and with those of neighbouring
    links; the first moment along the model's centre of mass, which makes the torque of the link's
    weight, is identified better.

    Args:
        links: estimates, with the model's bodies as their ``prior``.
        remedy: what is done about it in the written model.
    """
    for link in links:
        if link.prior is None:
            continue
        expected = float(np.linalg.norm(link.prior.first_moment))
        moment, error = link.moment_along(link.prior.first_moment)
        if abs(moment - expected) > max(INTERVAL * error, 0.1 * expected):
            text = (
                f"{link.name} of the model is probably wrong: its mass times the distance of its "
                f"centre of mass is {with_error(moment, error, 'kg·m')}, in the model "
                f"{expected:.3g}, and torques show no more than that product"
            )
            yield Remark(Level.DOUBTS, link.name, text, remedy)


def judge_file(errors: ModelErrors, data: str = "held-out data") -> Remark:
    """Return the verdict on a written file from its error and that of the given model.

    What is clearly higher in paired blocks of time is worse, over all or at one joint, and so is an
    error of more than half the torque. One that is small beside the torque does not count. It is
    judged as it will be used, too: an offset that no file holds is then an error, like weight that
    the fit took for one.

    Args:
        errors: of both, in the same blocks.
        data: what the errors are of, in words.
    """
    old = errors.before.relative_error
    new = errors.after.relative_error
    if old is None or new is None:
        return Verdict.NO_BETTER.remark("the measured torque is zero")
    sentence = f"torque error of the model on {data}: {percent(old)} -> {percent(new)}"
    before = np.sum(errors.before.blocks, axis=1)
    after = np.sum(errors.after.blocks, axis=1)
    if new > 0.5 or (new > NEGLIGIBLE and is_clearly_lower(before, after)):
        return Verdict.NO_BETTER.remark(sentence)
    used = errors.before_as_used, errors.after_as_used
    shares = [each.relative_error or 0.0 for each in used]
    squares = [np.sum(each.blocks, axis=1) for each in used]
    if shares[1] > NEGLIGIBLE and is_clearly_lower(*squares):
        return Verdict.NO_BETTER.remark(
            f"torque error of the model on {data}, with the offsets of its sensors, which no file "
            f"holds, counted as errors: {percent(shares[0])} -> {percent(shares[1])}"
        )
    worse = worse_joints(errors.before, errors.after)
    if worse:
        return Verdict.NO_BETTER.remark(f"{sentence}, but worse at {', '.join(worse)}")
    is_better = is_clearly_lower(after, before)
    return (Verdict.BETTER if is_better else Verdict.AS_GOOD).remark()


def judge_files(file: ModelFile, model_bends: bool) -> list[Remark]:
    """Return the verdict on written files, of that whose friction bends first, and on other logs.

    A straight line is no better than the curve of a model that bends already: the other file is
    then judged alone.

    Args:
        file: what is said of the files.
        model_bends: whether friction of the given model bends.
    """
    judged = [each for each in (file.curved, file) if each is not None]
    if model_bends:
        judged = judged[:1]
    remarks = sorted(map(judge_file, judged), key=lambda r: [*Level].index(r.level))[:1]
    for each in judged:
        # A file that is worse on another log than the given model is not trustworthy.
        on_others = (judge_file(o, data=o.before.source) for o in each.others)
        remarks += (r for r in on_others if r.level is Level.REFUSES)
    return remarks


def worse_joints(model: Validation, written: Validation) -> list[str]:
    """Return the joints whose torque a file predicts clearly worse than the given model, in words.

    An error that is small beside the joint's torque does not count.
    """
    worse = []
    errors = written.relative_error_per_joint.items()
    for (joint, new), before, after in zip(errors, model.blocks.T, written.blocks.T):
        old = model.relative_error_per_joint[joint]
        if old is None or new is None or new <= LITTLE:
            continue
        if is_clearly_lower(before, after):
            worse.append(f"{joint} ({percent(old)} -> {percent(new)})")
    return worse


def judge_payload(
    robot: RobotModel, payload: BodyEstimate, contradicting: str, validation: Validation
) -> Iterator[Remark]:
    """Yield reasons why a payload is not trustworthy.

    Args:
        robot: the arm with its model.
        payload: in the flange frame, from the estimate with bodies that may be inconsistent.
        contradicting: sentence on a contradiction between recordings; "" where there is none.
        validation: held-out error of the fit.
    """
    mass = payload.mass
    error = payload.errors[0]
    sentence = f"the payload comes out as {with_error(mass, error, 'kg')}"
    share = validation.relative_error or 0.0
    if contradicting:
        yield Verdict.DISAGREE.remark(contradicting)
    if mass < -INTERVAL * error:
        yield Verdict.SWAPPED.remark(sentence)
    elif not np.isfinite(error) or mass <= INTERVAL * error:
        yield Verdict.NOT_SEEN.remark(sentence)
    elif share > 0.25:  # logs of real arms have 0.4 to 5 %
        yield Verdict.UNEXPLAINED.remark(
            f"held-out torques are predicted with an error of {percent(share)}"
        )
    else:
        yield from _far_payload(robot, payload)


def _far_payload(robot: RobotModel, payload: InertialParameters) -> Iterator[Remark]:
    """Yield a reason for each size of a payload that is too large for the reach of the arm.

    Sizes are the distance of the centre of mass from the flange, and the radius of gyration. Arms
    that reach less than 0.6 m may carry what those of 0.6 m may.
    """
    farthest = 0.5 * max(robot.reach, 0.6)
    distance = np.linalg.norm(payload.com)
    trace = max(np.trace(payload.inertia_com), 0.0)
    gyration = np.sqrt(trace / (2.0 * payload.mass))
    for quantity, size in (
        ("centre of mass is", distance),
        ("radius of gyration is", gyration),
    ):
        if size > farthest:
            yield Verdict.IMPLAUSIBLE.remark(
                f"its {quantity} {size:.3g} m (from the flange); more than {farthest:.3g} m, "
                "half the arm's reach, is not believed"
            )


def judge_known_mass(
    findings: Sequence[Remark], weighed: float, mass: float
) -> Iterator[Remark]:
    """Yield reasons why torque scales may not be taken from a known mass [kg].

    Args:
        findings: reasons against the payload that was estimated without the known mass.
        weighed: the payload's mass in that estimate [kg].
        mass: the known mass [kg].
    """
    # An implausible size may come from the torque scales, which a known mass corrects.
    for finding in findings:
        if finding.about != Verdict.IMPLAUSIBLE.name:
            yield finding
    # Gears lose a third of the torque at most.
    if not 0.5 * mass < weighed < 2.0 * mass:
        yield Verdict.WRONG_WEIGHT.remark(
            f"weighed with torques as they are, {mass:g} kg come out as {weighed:.4g} kg"
        )
