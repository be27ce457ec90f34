"""Whether a result of measured data may be trusted: what noise alone does not tell.

A small standard error is not enough. The whole error has to be small, the link has to be one that
can hang on this arm, and torques that were not fitted have to be predicted about as well as noise
allows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from robot_sysid.model.inertia import link_reach
from robot_sysid.records import Estimate, Identification, RobotModel, Status
from robot_sysid.records.figures import percent

LARGEST_ERROR = 0.1
"""Whole standard error of the mass, as a part of it, up to which a result is trusted."""
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
_SURE = 2.0


def judged(
    found: Identification, robot: RobotModel, torque: Mapping[str, float], acceleration_error: float
) -> Identification:
    """Return the identification with the status it deserves, and why.

    Args:
        found: the result of measured data.
        robot: the arm.
        torque: joint name to root mean square of its measured torque [N m].
        acceleration_error: expected error of the acceleration, as a part of it; 0 where unknown.
    """
    if not found.estimate.status.is_trustworthy:
        return found
    checks = (
        (Status.UNEXPLAINED, tuple(_unexplained(found, torque, acceleration_error))),
        (Status.IMPLAUSIBLE, tuple(_implausible(found, robot))),
        (Status.UNCERTAIN, tuple(_uncertain(found.estimate))),
    )
    reasons = tuple(reason for _, listed in checks for reason in listed)
    statuses = [status for status, listed in checks if listed]
    status = statuses[0] if statuses else found.estimate.status
    return replace(found, estimate=replace(found.estimate, status=status), reasons=reasons)


def _uncertain(estimate: Estimate) -> Iterator[str]:
    error, mass = estimate.error("m"), estimate.inertial.mass
    if error is None or not np.isfinite(error) or error <= LARGEST_ERROR * mass:
        return
    parts = {cause: float(values[0]) for cause, values in estimate.error_budget.items()}
    if estimate.noise_errors is not None:
        parts["noise"] = float(estimate.noise_errors[0])
    largest = sorted(parts, key=lambda cause: -parts[cause])[:3]
    listed = ", ".join(f"{cause} {parts[cause]:.2g}" for cause in largest)
    yield f"the mass is {mass:.3g} \u00b1 {error:.2g} kg, mostly because of: {listed} kg"


def _implausible(found: Identification, robot: RobotModel) -> Iterator[str]:
    estimate, link = found.estimate, found.estimate.inertial
    if estimate.standard_errors is None:
        return
    errors = estimate.standard_errors
    seen = np.isfinite(errors)
    reach, arm = reaches(robot)
    off = _SURE * float(np.linalg.norm(errors[1:4])) / link.mass
    distance = float(np.linalg.norm(link.com))
    if distance - off > reach + COM_BEYOND * arm:
        yield f"the centre of mass is {distance:.2g} m away on a link that reaches {reach:.2g} m"
    moment, slack = float(link.principal_moments[-1]), _SURE * float(np.max(errors[4:10]))
    if moment - slack > link.mass * (reach + GYRATION_BEYOND * arm) ** 2:
        radius = np.sqrt(moment / link.mass)
        yield f"the radius of gyration is {radius:.2g} m on a link that reaches {reach:.2g} m"
    ratio = link.mass / found.prior.mass
    if not seen[0] and not 1.0 / MOVED_UNSEEN <= ratio <= MOVED_UNSEEN:
        yield (
            f"these torques do not show the mass, yet the rest is only possible with "
            f"{link.mass:.3g} kg where the model has {found.prior.mass:.3g} kg"
        )


def _unexplained(
    found: Identification, torque: Mapping[str, float], acceleration_error: float
) -> Iterator[str]:
    if acceleration_error > COARSE:
        yield (
            f"the positions are too coarse or too seldom to have accelerations: expected error "
            f"{percent(acceleration_error)}"
        )
    noise = found.estimate.noise_per_joint
    for test in found.validation:
        errors = test.rmse_per_joint
        squares = [(errors[joint] / noise[joint]) ** 2 for joint in noise if joint in errors]
        ratio = float(np.sqrt(np.mean(squares or [0.0])))
        if ratio > NOISE_EXPLAINS and (test.relative_error or 0.0) > HARMLESS:
            yield (
                f"torques of {test.source} are predicted {ratio:.1f} times worse than the noise "
                "of the fit allows"
            )
    yield from _odd_joints(noise, torque)


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


def reaches(robot: RobotModel) -> tuple[float, float]:
    """Return how far the terminal link reaches from its body's origin, and the whole arm [m]."""
    own = link_reach(robot.mj_model, robot.reference_qpos, robot.body_id)
    return own, own + sum(float(np.linalg.norm(link.translation)) for link in robot.links[1:])
