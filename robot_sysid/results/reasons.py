"""The conditions of verdicts: what speaks against a fit, a link, a file or a payload, in sentences.

Each condition yields one sentence per reason that holds, and nothing where it does not hold. A
large standard error alone is no reason. Refused are bodies that this arm cannot carry, torques that
do not follow from the motion, and files that predict no better than the given model.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from robot_sysid.dynamics.friction import ROTOR, TERMS
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.held_out import is_clearly_lower
from robot_sysid.estimate.payload import Contradiction
from robot_sysid.estimate.questions import NEGLIGIBLE
from robot_sysid.estimate.trust import (
    MissedFriction,
    misfit_ratio,
    odd_joints,
    worse_joints,
)
from robot_sysid.model.bodies import link_reach
from robot_sysid.records import (
    Array,
    Flange,
    InertialParameters,
    ModelErrors,
    RobotModel,
    Validation,
)
from robot_sysid.records.levels import INTERVAL, LIKE_LOG, SURE
from robot_sysid.records.messages import Remark, percent, torque_unit, with_error
from robot_sysid.records.quantities import BodyEstimate, Quantity
from robot_sysid.results.record import Elsewhere
from robot_sysid.wording import option_name

TOOL_REACH = 0.3
"""How far beyond a link its centre of mass may lie, over the arm's reach: a tool that the model
does not have may be bolted to the link."""
TOOL_GYRATION = 0.1
"""How far the link's radius of gyration may exceed it, over the arm's reach, with such a tool."""
LIKELY_MASS = (0.5, 2.0)
"""Least and largest mass of a link whose mass the torques do not show, over the model's."""
STRONGEST_FRICTION = 3.0
"""Most dry friction of a joint, over the largest torque of the other joints of its type."""
WORST_FILE = 0.5
"""Largest torque error of a file that is good for anything, over the torque."""
WORST_WEIGHING = 0.25
"""Largest held-out error of a fit with a payload, over the torque: several times that of real
arms."""
FARTHEST_PAYLOAD = 0.5
"""Largest size of a payload, over the arm's reach."""
SHORTEST_REACH = 0.6
"""Reach below which an arm may carry what one of this reach may [m]."""
WEIGHED_SHARES = (0.5, 2.0)
"""Least and largest weighing of a known mass, over it: gears lose a third of the torque at most."""


def torque_misfits(fitted: Fit, tests: Sequence[Validation]) -> Iterator[str]:
    """Yield reasons why the torques do not follow from the motion within their noise.

    Args:
        fitted: the fit with its noise.
        tests: held-out errors and errors on other logs.
    """
    for test in tests:
        ratio = misfit_ratio(fitted, test)
        if ratio > SURE:
            yield (
                f"torques of {test.source} are predicted {ratio:.2g} times worse than the noise "
                "of the fit allows"
            )
    independent = dict(zip(fitted.arm.joints, (1.0 / fitted.correlation).tolist()))
    for odd in odd_joints(fitted.noise_per_joint, fitted.torque, independent):
        yield (
            f"{percent(odd.share)} of the torque of {odd.joint} is unexplained, of the other "
            f"joints' {percent(odd.median)}"
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


def missed_terms(missed: MissedFriction, no_friction: bool) -> str:
    """Return a sentence on friction terms that the user left out but the torques clearly show.

    ``no_friction`` is whether the user wants none at all.
    """
    terms = missed.terms
    remedy = (
        f"leave out {option_name('friction_model')}, or add {'-'.join(terms)} to it"
    )
    return (
        f"the torques of {', '.join(missed.joints)} clearly show friction terms that were left out "
        f"({', '.join(terms)}), and that links and other terms take up: the torque error on "
        f"held-out data is {percent(missed.error)}, with them {percent(missed.error_with_terms)}, "
        f"and most of all the {missed.moved.words} is off by "
        f"{with_error(*missed.change, missed.moved.unit)}; "
        f"{'identify friction, too' if no_friction else remedy}"
    )


def impossible_link(robot: RobotModel, link: BodyEstimate) -> Iterator[str]:
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
    # A mass that may be far larger makes both smaller.
    mass = link.mass
    if np.isfinite(errors[0]):
        mass += INTERVAL * errors[0]
    slack = INTERVAL * np.linalg.norm(errors[1:4]) / mass
    distance = np.linalg.norm(link.first_moment) / mass
    where = f"on a link that reaches {reach:.2g} m"
    if distance - slack > reach + TOOL_REACH * arm:
        stated = np.linalg.norm(link.com)
        yield f"the centre of mass is {stated:.2g} m away {where}"
    moment = link.principal_moments[-1]
    slack = INTERVAL * np.max(errors[4:10])
    if moment - slack > mass * (reach + TOOL_GYRATION * arm) ** 2:
        radius = np.sqrt(moment / link.mass)
        yield f"the radius of gyration is {radius:.2g} m {where}"
    ratio = link.mass / robot.prior.mass
    least, largest = LIKELY_MASS
    if not np.isfinite(errors[0]) and not least <= ratio <= largest:
        yield (
            f"these torques do not show the mass, yet the rest is only possible with "
            f"{link.mass:.3g} kg where the model has {robot.prior.mass:.3g} kg"
        )


def impossible_joints(
    robot: RobotModel, quantities: Iterable[Quantity], torque: Mapping[str, float]
) -> Iterator[str]:
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
    coulomb = [name for name, term in TERMS.items() if term.is_coulomb]
    # Least values that the errors allow. A term at its bound has the error NaN, and no comparison
    # with NaN is true.
    least = {
        (row.of, row.name): row.value - INTERVAL * row.error
        for row in quantities
        if row.error is not None
    }
    torques = np.array([torque.get(name, 0.0) for name in robot.joint_names])
    for index, (name, slide) in enumerate(zip(robot.joint_names, robot.is_slide)):
        found = (least[name, term] for term in coulomb if (name, term) in least)
        dry = next(found, 0.0)
        rotor = least.get((name, ROTOR.name), 0.0)
        is_other = robot.is_slide == slide
        is_other[index] = False
        largest_torque = np.max(torques[is_other], initial=0.0)
        strongest = STRONGEST_FRICTION * largest_torque or np.inf
        if dry > min(robot.limits.torque[index], strongest):
            yield (
                f"{name} would have {dry:.3g} {torque_unit(slide)} of dry friction or more"
            )
        if not slide and rotor > inertia > 0.0:
            yield f"{name} would have a rotor of {rotor:.3g} kg·m² or more"


def file_fault(errors: ModelErrors, data: str = "held-out data") -> str:
    """Return why a written file is no better than the given model; "" where it is.

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
        return "the measured torque is zero"
    sentence = f"torque error of the model on {data}: {percent(old)} -> {percent(new)}"
    before = np.sum(errors.before.blocks, axis=1)
    after = np.sum(errors.after.blocks, axis=1)
    if new > WORST_FILE or (new > NEGLIGIBLE and is_clearly_lower(before, after)):
        return sentence
    used = errors.as_used.before, errors.as_used.after
    shares = [each.relative_error or 0.0 for each in used]
    squares = [np.sum(each.blocks, axis=1) for each in used]
    is_worse = shares[1] > NEGLIGIBLE and is_clearly_lower(*squares)
    if shares[1] > WORST_FILE or is_worse:
        return (
            f"torque error of the model on {data}, with the offsets of its sensors, which no file "
            f"holds, counted as errors: {percent(shares[0])} -> {percent(shares[1])}"
        )
    worse = [
        f"{joint} ({percent(of_model)} -> {percent(of_file)})"
        for joint, of_model, of_file in worse_joints(errors)
    ]
    return f"{sentence}, but worse at {', '.join(worse)}" if worse else ""


def file_faults(files: Iterable[ModelErrors]) -> Iterator[str]:
    """Yield why one of several files is no better than the given model, of the first that is so."""
    yield from [*filter(None, map(file_fault, files))][:1]


def faults_on_other_logs(others: Iterable[ModelErrors]) -> Iterator[str]:
    """Yield why a file is worse than the given model on other logs, of each such log.

    A file that is worse on another log is not trustworthy.
    """
    for errors in others:
        reason = file_fault(errors, errors.before.source)
        if reason:
            yield reason


def poor_elsewhere(errors: Elsewhere) -> Iterator[str]:
    """Yield why a written file is of no use for motions that nobody recorded."""
    share = errors.after.relative_error
    if share > WORST_FILE:
        yield f"on other motions about {percent(share)} of the torque is expected to be wrong"


def is_hardly_better(before: float, after: float) -> bool:
    """Return whether a file is so little better than the model on other motions that its use is for
    motions like the logs'.

    Args:
        before, after: errors to expect of the model and of the file.
    """
    return after > LIKE_LOG * before


def in_spite_of_doubts(doubts: Sequence[Remark]) -> Iterator[str]:
    """Yield which doubts of logs were accepted."""
    names = dict.fromkeys(str(doubt.about) for doubt in doubts)
    if names:
        yield f"accepted in spite of doubts: {', '.join(names)}"


def is_better(errors: ModelErrors) -> bool:
    """Return whether a file predicts held-out torques clearly better than the given model."""
    squares = [np.sum(each.blocks, axis=1) for each in (errors.after, errors.before)]
    return is_clearly_lower(*squares)


def payload_size(robot: RobotModel, payload: InertialParameters) -> Iterator[str]:
    """Yield a reason for each size of a payload that is too large for the reach of the arm.

    Sizes are the distance of the centre of mass from the flange, and the radius of gyration.
    """
    farthest = FARTHEST_PAYLOAD * max(robot.reach, SHORTEST_REACH)
    distance = np.linalg.norm(payload.com)
    trace = max(np.trace(payload.inertia_com), 0.0)
    gyration = np.sqrt(trace / (2.0 * payload.mass))
    for quantity, size in (
        ("centre of mass is", distance),
        ("radius of gyration is", gyration),
    ):
        if size > farthest:
            yield (
                f"its {quantity} {size:.3g} m (from the flange); more than {farthest:.3g} m, "
                "half the arm's reach, is not believed"
            )


def payload_weight(payload: BodyEstimate) -> str:
    """Return a sentence with the mass of a payload and its error."""
    return (
        f"the payload comes out as {with_error(payload.mass, payload.errors[0], 'kg')}"
    )


def contradicting_logs(found: Contradiction | None, flange: Flange) -> Iterator[str]:
    """Yield a sentence on recordings of one kind that contradict each other."""
    if found is None:
        return
    body = _body_text(flange.to_flange(found.carried), found.least)
    others = ", ".join(found.others)
    yield f"{found.recording} differs from {others}: it carries {body}"


def _body_text(theta: Array, least: float) -> str:
    """Return a phrase with mass and centre of mass of a body, "nothing" up to a least mass [kg]."""
    if theta[0] <= least:
        return "nothing"
    position = ", ".join(f"{1e3 * x:.0f}" for x in theta[1:4] / theta[0])
    return f"{theta[0]:.3g} kg at ({position}) mm"


def wrong_weight(weighed: float, known_mass: float | None) -> Iterator[str]:
    """Yield why torque scales may not be taken from a known mass [kg].

    ``weighed`` is the payload's mass in the estimate without the known one [kg].
    """
    if known_mass is None:
        return
    least, largest = WEIGHED_SHARES
    if not least * known_mass < weighed < largest * known_mass:
        yield (
            f"weighed with torques as they are, {known_mass:g} kg come out as {weighed:.4g} kg"
        )
