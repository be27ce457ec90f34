"""What may be believed: what speaks against a fit, a link, a file, a payload.

A wide error is an answer, a wrong one is a defect: nothing is refused because it is not known well,
but what cannot hang on this arm, what does not follow from the motion, and a file that predicts no
better than the one before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.algebra.information import sample_counts
from robot_sysid.estimation.columns import PLACEHOLDER, usual_bodies
from robot_sysid.estimation.errors import BODIES
from robot_sysid.estimation.fit import Fit
from robot_sysid.model.inertia import link_reach
from robot_sysid.records import Array, InertialParameters, RobotModel, Validation, WrongLink
from robot_sysid.records.figures import percent, with_error
from robot_sysid.results.record import BodyEstimate, JointEstimate, Verdict

NOISE_EXPLAINS = 3.0
"""Held-out error over noise up to which noise, and not a wrong model, may be its cause."""
HARMLESS = 0.02
"""Held-out error, as a part of the torque, that is no reason to doubt whatever the noise is."""
UNUSUAL, UNEXPLAINED = 0.035, 0.05
"""Part of all torque that neither the model nor noise accounts for, from which on it is
told, and from which on numbers are not believed: logs of right models have 0.4 to 3 %."""
ODD_JOINT, ODD_NOISE = 10.0, 0.3
"""A joint is odd whose noise, as a part of its torque, is so many times the others' and large."""
MEMORY = 0.5
"""Share of independent samples from which residuals are noise, which is no misfit: white noise has
0.6 to 1, torque that belongs to something else 0.1."""
DRY_FRICTION = 3.0
"""Dry friction over the usual torque of the strongest other joint that no joint has."""
COM_BEYOND, GYRATION_BEYOND = 0.3, 0.1
"""How far beyond the link of the model, in parts of the arm's reach, centre of mass and radius of
gyration may be: something may be bolted to it that the model does not have."""
MOVED_UNSEEN = 2.0
"""Factor between the model's mass and a mass that only consistency or a prior has moved."""
COARSE = 0.2
"""Expected error of the acceleration, as a part of it, beyond which it says nothing."""
LEAST_WRONG = 0.1
"""Share by which mass times distance of the centre of mass of a link is off where it is named."""
LARGEST_RATIO, FARTHEST_LINK = 20.0, 1.5
"""By how much another link's mass may differ from the model's; how many times the link's size its
centre of mass may move, or its radius of gyration be."""
WORST, CLEARLY_LOWER, WORSE, NEGLIGIBLE = 0.5, 0.9, 1.1, 1e-3
"""Held-out error of a file, as a part of the torque, above which nothing is written; parts of the
error before below which it is clearly better, and above which it is worse; an error that is none.
"""
FARTHEST_PAYLOAD, LEAST_REACH = 0.5, 0.6
"""How far a payload's centre of mass may be from the flange, as a share of the arm's reach, and the
reach that an arm is taken to have at least [m]."""
MOST_FACTOR = 2.0
"""How far a known mass and its weighing may be apart, as a factor: gears lose a third at most."""
# Standard errors that a mass has to be away from zero, and a size beyond its bound (95 %).
_SURE = 2.0
# A link's smallest size [m].
_LEAST_SIZE = 0.02

Judged = tuple[Verdict, str]
"""A verdict and its reason in words."""


def first(findings: Iterable[Judged], otherwise: Verdict) -> tuple[Verdict, tuple[str, ...]]:
    """Return (the first verdict that is found, every reason), or what it is otherwise."""
    found = list(findings)
    return (found[0][0] if found else otherwise), tuple(reason for _, reason in found)


def _beyond_chance(squared: Array, chance: Array) -> float:
    """Return errors over what chance makes them, of squares (blocks, joints) of both."""
    some = np.any(chance > 0.0, axis=0)
    return float(np.sqrt(np.mean(squared.sum(axis=0)[some] / chance.sum(axis=0)[some])))


def speaks(squared: Array, noise: Array, chance: Callable[[], Array]) -> bool:
    """Tell whether squares of errors (blocks, joints) say something of a fit: they are noise, or
    more than what is left open makes by ``chance``, which has no bound where it is infinite.
    """
    if _beyond_chance(squared, noise) <= NOISE_EXPLAINS:
        return True
    most = chance()
    told = np.all(np.isfinite(most), axis=0)
    squared, most = squared[:, told], most[:, told]
    return bool(np.any(most)) and _beyond_chance(squared, most) > NOISE_EXPLAINS


def unexplained(
    fit: Fit, tests: Sequence[Validation], acceleration_error: float, apart: Mapping[str, float]
) -> Iterator[Judged]:
    """Yield why torques do not follow from the motion as far as noise would let them.

    The acceleration's expected error is a part of it, 0 where unknown; ``apart`` says which share
    of a joint's residuals is independent samples.
    """
    noise = fit.noise_per_joint
    if acceleration_error > COARSE:
        yield (
            Verdict.UNEXPLAINED,
            "the positions are too coarse or too seldom to have accelerations: expected error "
            f"{percent(acceleration_error)}",
        )
    for test in (each for each in tests if each.told_enough):
        errors = test.rmse_per_joint
        squares = [(errors[joint] / noise[joint]) ** 2 for joint in noise if joint in errors]
        ratio = float(np.sqrt(np.mean(squares or [0.0])))
        if ratio > NOISE_EXPLAINS and (test.relative_error or 0.0) > HARMLESS:
            yield (
                Verdict.UNEXPLAINED,
                f"torques of {test.source} are predicted {ratio:.1f} times worse than the noise "
                "of the fit allows",
            )
    torque = dict(zip(fit.columns.robot.joint_names, fit.evidence.torque.tolist()))
    shares = {joint: noise[joint] / torque[joint] for joint in noise if torque.get(joint)}
    for joint, share in shares.items():
        others = [shares[other] for other in shares if other != joint]
        if (
            others
            and apart.get(joint, 0.0) < MEMORY
            and share > max(ODD_NOISE, ODD_JOINT * float(np.median(others)))
        ):
            yield (
                Verdict.UNEXPLAINED,
                f"{percent(share)} of the torque of {joint} is unexplained, of the other "
                f"joints' {percent(float(np.median(others)))}",
            )


def unexplained_share(fit: Fit, apart: Mapping[str, float]) -> tuple[float, str]:
    """Return the part of all torque that neither model nor noise accounts for, and that by joint
    in words.

    Noise changes from one sample to the next; ``apart`` says how much of a joint's residuals
    does.
    """
    torque = dict(zip(fit.columns.robot.joint_names, fit.evidence.torque.tolist()))
    slow = {
        joint: noise * np.sqrt(max(1.0 - apart.get(joint, 0.0), 0.0))
        for joint, noise in fit.noise_per_joint.items()
        if torque.get(joint)
    }
    whole = np.linalg.norm([torque[joint] for joint in slow])
    share = float(np.linalg.norm([*slow.values()]) / whole) if slow else 0.0
    largest = sorted(slow, key=lambda joint: -slow[joint])[:3]
    by_joint = ", ".join(f"{percent(slow[joint] / torque[joint])} of {joint}" for joint in largest)
    return share, (
        f"{percent(share)} of the torque is explained by neither the model nor noise ({by_joint})"
    )


def implausible_link(robot: RobotModel, link: BodyEstimate) -> Iterator[Judged]:
    """Yield why a terminal link cannot hang on this arm."""
    body, errors = link.inertial, link.errors
    if not body.mass > 0.0:
        return
    reach = link_reach(robot.mj_model, robot.reference_qpos, robot.body_id)
    arm = reach + sum(float(np.linalg.norm(each.translation)) for each in robot.links[1:])
    off = _SURE * float(np.linalg.norm(errors[1:4])) / body.mass
    distance = float(np.linalg.norm(body.com))
    where = f"on a link that reaches {reach:.2g} m"
    if distance - off > reach + COM_BEYOND * arm:
        yield Verdict.IMPLAUSIBLE, f"the centre of mass is {distance:.2g} m away {where}"
    moment, slack = float(body.principal_moments[-1]), _SURE * float(np.max(errors[4:10]))
    if moment - slack > body.mass * (reach + GYRATION_BEYOND * arm) ** 2:
        radius = np.sqrt(moment / body.mass)
        yield Verdict.IMPLAUSIBLE, f"the radius of gyration is {radius:.2g} m {where}"
    ratio = body.mass / robot.prior.mass
    if not np.isfinite(errors[0]) and not 1.0 / MOVED_UNSEEN <= ratio <= MOVED_UNSEEN:
        yield (
            Verdict.IMPLAUSIBLE,
            f"these torques do not show the mass, yet the rest is only possible with "
            f"{body.mass:.3g} kg where the model has {robot.prior.mass:.3g} kg",
        )


def implausible_joints(
    robot: RobotModel, joints: Mapping[str, JointEstimate], torque: Array
) -> Iterator[Judged]:
    """Yield what no joint of this arm can have, of usual torques (n,) [N m]."""
    reach = sum(float(np.linalg.norm(link.translation)) for link in robot.links)
    inertia = sum(float(link.theta[0]) for link in robot.links) * reach**2
    for index, (name, slide) in enumerate(zip(robot.joint_names, robot.is_slide)):
        terms = {term: each.value - _SURE * each.error for term, each in joints[name].terms.items()}
        dry, rotor = terms.get("coulomb", terms.get("sigmoid", 0.0)), terms.get("armature", 0.0)
        others = np.delete(torque, index)[np.delete(robot.is_slide, index) == slide]
        strongest = DRY_FRICTION * float(np.max(others, initial=0.0)) or np.inf
        # A limit of zero is one that nobody filled in.
        if dry > min(robot.limits.torque[index] or np.inf, strongest):
            yield Verdict.IMPLAUSIBLE, f"{name} would have {dry:.3g} N m of dry friction or more"
        if not slide and rotor > inertia > 0.0:
            yield Verdict.IMPLAUSIBLE, f"{name} would have a rotor of {rotor:.3g} kg m^2 or more"


def wrong_links(links: Sequence[BodyEstimate]) -> Iterator[WrongLink]:
    """Yield the links of the model that recordings contradict, of the estimates of all links.

    Mass and centre of mass of a link hide behind each other and behind its neighbours'; mass times
    distance of the centre, which is the torque that the link's weight makes at its joint, is seen
    better. The direction is the model's.
    """
    for link in links:
        if link.before is None or not np.any(link.before.theta[1:4]):
            continue
        expected = float(np.linalg.norm(link.before.theta[1:4]))
        direction = link.before.theta[1:4] / expected
        moment = float(direction @ link.inertial.theta[1:4])
        error = float(np.sqrt(direction @ link.covariance[1:4, 1:4] @ direction))
        off = abs(moment - expected)
        if np.all(link.shown[1:4]) and off > max(_SURE * error, LEAST_WRONG * expected):
            yield WrongLink(link.name, expected, moment, error)


def implausible_links(robot: RobotModel, thetas: Array) -> Iterator[Judged]:
    """Yield what none of the other links (n, 10) of this arm can be like."""
    typical = float(np.median([body[0] for body in usual_bodies(robot).values()]))
    for index, (link, theta) in enumerate(zip(robot.links[:-1], thetas)):
        if link.has_mass and link.theta[0] >= PLACEHOLDER * typical:
            own = np.sqrt(3.0) * spatial.characteristic_length(link.theta)
            reach = float(np.linalg.norm(robot.links[index + 1].translation))
            size = max(float(own), reach, _LEAST_SIZE)
            reason = _strangeness(link.body_name, link.theta, theta, size)
            if reason:
                yield Verdict.IMPLAUSIBLE, reason


def _strangeness(name: str, before: Array, theta: Array, size: float) -> str:
    """Return why a link of some size [m] cannot be like that; "" where it can."""
    if not spatial.is_consistent(theta):
        return f"{name} is no possible rigid body"
    mass, com, inertia = spatial.com_from_theta(theta)
    model_mass, centre, _ = spatial.com_from_theta(before)
    moved = float(np.linalg.norm(com - centre))
    radius = float(np.sqrt(0.5 * np.trace(inertia) / mass))
    if not 1.0 / LARGEST_RATIO <= mass / model_mass <= LARGEST_RATIO:
        return f"{name} would weigh {mass:.3g} kg (model: {model_mass:.3g})"
    if moved > FARTHEST_LINK * size:
        return f"the centre of mass of {name} would be {moved:.2g} m from the model's"
    if radius > FARTHEST_LINK * size:
        return f"{name} would have a radius of gyration of {radius:.2g} m"
    return ""


def noise_share(fit: Fit) -> float:
    """Return the torque noise of a fit as a part of the torque."""
    squares = float(np.sum(fit.noise**2 * sample_counts(fit.evidence.whole)))
    torque = float(np.sum(fit.evidence.squared_torque))
    return float(np.sqrt(squares / torque)) if torque > 0.0 else 0.0


def of_file(before: Validation, after: Validation, noise: float = 0.0) -> Judged:
    """Return how a written file predicts held-out data beside the one before, and that in words.

    A model that was no worse before than the noise, a part of the torque, was right.
    """
    old, new = before.relative_error, after.relative_error
    if old is None or new is None:
        return Verdict.NO_BETTER, "the measured torque is zero"
    said = f"torque error of the model on held-out data: {percent(old)} -> {percent(new)}"
    right = old <= WORSE * max(noise, NEGLIGIBLE)
    if new > WORST or (new > WORSE * old + 1e-9 and not right):
        return Verdict.NO_BETTER, said
    return (Verdict.BETTER if new < CLEARLY_LOWER * old else Verdict.AS_GOOD), said


def of_payload(
    robot: RobotModel, payload: BodyEstimate, contradicting: str, validation: Validation
) -> Iterator[Judged]:
    """Yield why a payload may not go into a model and a controller.

    Args:
        payload: in the flange frame, before it was made a possible body.
        contradicting: how recordings of one kind are not alike; "" where they are.
    """
    # It was not moved yet by what makes bodies possible.
    moved = payload.budget.get(BODIES, np.zeros(10))[0]
    mass, error = payload.inertial.mass, float(payload.errors[0])
    error = float(np.sqrt(error**2 - moved**2)) if np.isfinite(error) else error
    said = f"the payload comes out as {with_error(mass, error, 'kg')}"
    if contradicting:
        yield Verdict.DISAGREE, contradicting
    if mass < -_SURE * error:
        yield Verdict.SWAPPED, said
    elif not np.isfinite(error) or mass <= _SURE * error:
        yield Verdict.NOT_SEEN, said
    elif (validation.relative_error or 0.0) > WORST:
        share = percent(validation.relative_error or 0.0)
        yield Verdict.UNEXPLAINED, f"held-out torques are predicted with an error of {share}"
    else:
        yield from _far_payload(robot, payload.inertial)


def _far_payload(robot: RobotModel, payload: InertialParameters) -> Iterator[Judged]:
    lengths = [float(np.linalg.norm(link.translation)) for link in robot.links[1:]]
    farthest = FARTHEST_PAYLOAD * max(sum(lengths), LEAST_REACH)
    distance = float(np.linalg.norm(payload.com))
    gyration = float(np.sqrt(max(np.trace(payload.inertia_com), 0.0) / (2.0 * payload.mass)))
    for what, size in (("centre of mass is", distance), ("radius of gyration is", gyration)):
        if size > farthest:
            yield (
                Verdict.IMPLAUSIBLE,
                f"its {what} {size:.3g} m (from the flange); more than {farthest:.3g} m, half the "
                "arm's reach, is not believed",
            )


def of_known_mass(found: Sequence[Judged], weighed: float, known: float) -> Iterator[Judged]:
    """Yield why torque scales may not be taken from a known mass [kg].

    Found is what speaks against the payload as if its mass, weighed then, were not known.
    """
    # Sizes that a known mass puts right are no reason to refuse it.
    yield from (each for each in found if each[0] is not Verdict.IMPLAUSIBLE)
    if not known / MOST_FACTOR < weighed < known * MOST_FACTOR:
        said = f"weighed with torques as they are, {known:g} kg come out as {weighed:.4g} kg"
        yield Verdict.WRONG_WEIGHT, said
