"""What may be believed: the one judge of all questions.

A wide error is an answer, a wrong one is a defect: nothing is refused because it is not known well,
but what cannot hang on this arm, what does not follow from the motion, and a file that predicts no
better than the one before.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.algebra.information import sample_counts
from robot_sysid.estimation.fit import Fit
from robot_sysid.estimation.unknowns import PLACEHOLDER, usual_bodies
from robot_sysid.model.inertia import link_reach
from robot_sysid.records import Array, Estimate, InertialParameters, RobotModel, Validation
from robot_sysid.records.figures import percent
from robot_sysid.results.record import BodyEstimate, Verdict

NOISE_EXPLAINS = 3.0
"""Held-out error over noise up to which noise, and not a wrong model, may be its cause."""
HARMLESS = 0.02
"""Held-out error, as a part of the torque, that is no reason to doubt whatever the noise is."""
ODD_JOINT, ODD_NOISE = 10.0, 0.3
"""A joint is odd whose noise, as a part of its torque, is so many times the others' and large."""
COM_BEYOND, GYRATION_BEYOND = 0.3, 0.1
"""How far beyond the link of the model, in parts of the arm's reach, centre of mass and radius of
gyration may be: something may be bolted to it that the model does not have."""
MOVED_UNSEEN = 2.0
"""Factor between the model's mass and a mass that only consistency or a prior has moved."""
COARSE = 0.2
"""Expected error of the acceleration, as a part of it, beyond which it says nothing."""
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
_SURE = 2.0
# Standard error of the mass that is never too large [kg].
_KNOWN_MASS = 1e-6
_LEAST_SIZE = 0.02

Finding = tuple[Verdict, str]


def first(findings: Iterable[Finding], otherwise: Verdict) -> tuple[Verdict, tuple[str, ...]]:
    """Return (the first verdict that is found, every reason), or what it is otherwise."""
    found = list(findings)
    return (found[0][0] if found else otherwise), tuple(reason for _, reason in found)


def unexplained(
    fit: Fit, tests: Sequence[Validation], acceleration_error: float
) -> Iterator[Finding]:
    """Yield why torques do not follow from the motion as far as noise would let them.

    Args:
        tests: its prediction of what was not fitted.
        acceleration_error: expected error of the acceleration, as a part of it; 0 where unknown.
    """
    noise = noise_per_joint(fit)
    if acceleration_error > COARSE:
        yield (
            Verdict.UNEXPLAINED,
            "the positions are too coarse or too seldom to have accelerations: expected error "
            f"{percent(acceleration_error)}",
        )
    for test in tests:
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
    for reason in _odd_joints(noise, torque):
        yield Verdict.UNEXPLAINED, reason


def noise_per_joint(fit: Fit) -> dict[str, float]:
    """Return joint to standard deviation of its torque noise [N m], of joints with samples."""
    pairs = zip(fit.information.joints, fit.noise.tolist())
    return {each.joint: noise for each, noise in pairs if each.n_samples}


def _odd_joints(noise: Mapping[str, float], torque: Mapping[str, float]) -> Iterator[str]:
    """Yield a phrase per joint whose torque follows from nothing while the others' do."""
    shares = {joint: noise[joint] / torque[joint] for joint in noise if torque.get(joint)}
    for joint, share in shares.items():
        others = [shares[other] for other in shares if other != joint]
        if others and share > max(ODD_NOISE, ODD_JOINT * float(np.median(others))):
            yield (
                f"{percent(share)} of the torque of {joint} is unexplained, of the other "
                f"joints' {percent(float(np.median(others)))}"
            )


def implausible_link(robot: RobotModel, link: BodyEstimate) -> Iterator[Finding]:
    """Yield why a terminal link cannot hang on this arm."""
    body, errors = link.inertial, link.errors
    if not body.mass > 0.0:
        return
    reach = link_reach(robot.mj_model, robot.reference_qpos, robot.body_id)
    arm = reach + sum(float(np.linalg.norm(each.translation)) for each in robot.links[1:])
    off = _SURE * float(np.linalg.norm(errors[1:4])) / body.mass
    distance = float(np.linalg.norm(body.com))
    if distance - off > reach + COM_BEYOND * arm:
        said = f"the centre of mass is {distance:.2g} m away on a link that reaches {reach:.2g} m"
        yield Verdict.IMPLAUSIBLE, said
    moment, slack = float(body.principal_moments[-1]), _SURE * float(np.max(errors[4:10]))
    if moment - slack > body.mass * (reach + GYRATION_BEYOND * arm) ** 2:
        radius = np.sqrt(moment / body.mass)
        said = f"the radius of gyration is {radius:.2g} m on a link that reaches {reach:.2g} m"
        yield Verdict.IMPLAUSIBLE, said
    ratio = body.mass / robot.prior.mass
    if not np.isfinite(errors[0]) and not 1.0 / MOVED_UNSEEN <= ratio <= MOVED_UNSEEN:
        yield (
            Verdict.IMPLAUSIBLE,
            f"these torques do not show the mass, yet the rest is only possible with "
            f"{body.mass:.3g} kg where the model has {robot.prior.mass:.3g} kg",
        )


def implausible_links(robot: RobotModel, thetas: Array) -> Iterator[Finding]:
    """Yield what none of the other links (n, 10) of this arm can be like."""
    typical = float(np.median([body[0] for body in usual_bodies(robot).values()]))
    for index, (link, theta) in enumerate(zip(robot.links[:-1], thetas)):
        if not link.has_mass or link.theta[0] < PLACEHOLDER * typical:
            continue
        reason = next(_strangeness(link.body_name, link.theta, theta, _size(robot, index)), None)
        if reason is not None:
            yield Verdict.IMPLAUSIBLE, reason


def _strangeness(name: str, before: Array, theta: Array, size: float) -> Iterator[str]:
    if not spatial.is_consistent(theta):
        yield f"{name} is no possible rigid body"
        return
    mass, com, inertia = spatial.com_from_theta(theta)
    model_mass, centre, _ = spatial.com_from_theta(before)
    moved = float(np.linalg.norm(com - centre))
    radius = float(np.sqrt(0.5 * np.trace(inertia) / mass))
    if not 1.0 / LARGEST_RATIO <= mass / model_mass <= LARGEST_RATIO:
        yield f"{name} would weigh {mass:.3g} kg (model: {model_mass:.3g})"
    elif moved > FARTHEST_LINK * size:
        yield f"the centre of mass of {name} would be {moved:.2g} m from the model's"
    elif radius > FARTHEST_LINK * size:
        yield f"{name} would have a radius of gyration of {radius:.2g} m"


def _size(robot: RobotModel, index: int) -> float:
    """Return a link's size [m]: as its mass is spread, or to the next joint."""
    own = np.sqrt(3.0) * spatial.characteristic_length(robot.links[index].theta)
    after = robot.links[index + 1 : index + 2]
    reach = max((float(np.linalg.norm(link.translation)) for link in after), default=0.0)
    return max(float(own), reach, _LEAST_SIZE)


def noise_share(fit: Fit) -> float:
    """Return the torque noise of a fit as a part of the torque."""
    squares = float(np.sum(fit.noise**2 * sample_counts(fit.information)))
    torque = float(np.sum(fit.evidence.squared_torque))
    return float(np.sqrt(squares / torque)) if torque > 0.0 else 0.0


def of_file(before: Validation, after: Validation, noise: float = 0.0) -> Finding:
    """Return how a written file predicts beside the one before, and that in words.

    Args:
        before, after: their errors on held-out data.
        noise: of the torque, as a part of it; a model that was no worse than that before was right.
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
    robot: RobotModel,
    payload: BodyEstimate,
    contradicting: Sequence[tuple[str, float]],
    validation: Validation,
) -> Iterator[Finding]:
    """Yield why a payload may not go into a model and a controller.

    Args:
        payload: in the flange frame, before it was made a possible body.
        contradicting: name and mass of each recording, where those of one kind are not alike.
        validation: prediction of what was not fitted.
    """
    mass, error = payload.inertial.mass, float(payload.errors[0])
    said = f"the payload comes out as {mass:.4g} \u00b1 {error:.2g} kg"
    if contradicting:
        listed = ", ".join(f"{name} {carried:.3g} kg" for name, carried in contradicting)
        yield Verdict.DISAGREE, f"compared with {contradicting[0][0]} the arm carries: {listed}"
    if mass < -_SURE * error:
        yield Verdict.SWAPPED, said
    elif not np.isfinite(error) or mass <= _SURE * error:
        yield Verdict.NOT_SEEN, said
    elif (validation.relative_error or 0.0) > WORST:
        share = percent(validation.relative_error or 0.0)
        yield Verdict.UNEXPLAINED, f"held-out torques are predicted with an error of {share}"
    else:
        yield from _far_payload(robot, payload.inertial)


def _far_payload(robot: RobotModel, payload: InertialParameters) -> Iterator[Finding]:
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


def of_known_mass(found: Sequence[Finding], weighed: float, known: float) -> Iterator[Finding]:
    """Yield why torque scales may not be taken from a known mass.

    Args:
        found: what speaks against the payload as if its mass were not known.
        weighed: its mass then [kg].
        known: what it weighs [kg].
    """
    # Sizes that a known mass puts right are no reason to refuse it.
    yield from (each for each in found if each[0] is not Verdict.IMPLAUSIBLE)
    if not known / MOST_FACTOR < weighed < known * MOST_FACTOR:
        said = f"weighed with torques as they are, {known:g} kg come out as {weighed:.4g} kg"
        yield Verdict.WRONG_WEIGHT, said


def inconsistent(fit: Fit) -> Iterator[Finding]:
    """Yield what is left of an impossible terminal link, where it was not made possible."""
    if not spatial.is_consistent(fit.values[:10]):
        yield Verdict.INCONSISTENT, "the terminal link is not a possible rigid body"


def of_own_simulation(estimate: Estimate) -> Verdict:
    """Return how the identification of a model's own simulation ended."""
    errors = estimate.standard_errors
    weak = np.inf if errors is None else errors[0]
    if not estimate.inertial.is_consistent:
        return Verdict.INCONSISTENT
    if np.isfinite(weak) and weak > max(_KNOWN_MASS, 0.5 * estimate.inertial.mass):
        return Verdict.TOO_WEAK
    seen = estimate.identifiability
    return Verdict.OK if seen.rank >= seen.n_parameters else Verdict.PARTLY_FROM_MODEL
