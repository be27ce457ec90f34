"""May this payload go into a model and a controller?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.records import Array, RobotModel, Validation
from robot_sysid.records.figures import percent
from robot_sysid.records.payload import BodyEstimate, PayloadStatus

LARGEST_ERROR = 0.1
"""Whole error of the mass beyond which the result is refused, as a share."""
FARTHEST = 0.5
"""How far a payload's centre of mass may be from the flange, as a share of the arm's reach."""
MOST_FACTOR = 2.0
"""How far a known mass and its weighing may be apart, as a factor: gears lose a third at most."""
LEAST_REACH = 0.6
"""Reach that an arm is taken to have at least [m]."""
WORST_PREDICTION, WORST_RATIO = 0.3, 3.0
"""Relative torque error of held-out stretches, and its ratio to that of the fit."""


def verdict(
    robot: RobotModel,
    payload: BodyEstimate,
    misfit: Sequence[tuple[str, float]],
    validation: Validation | None,
    rmse: float,
) -> tuple[PayloadStatus, tuple[str, ...]]:
    """Return the first reason to refuse a payload, or OK; and sentences on it.

    Args:
        robot: the arm.
        payload: in the flange frame, before it was made a possible body.
        misfit: name and mass of each recording, where those of one kind are not alike.
        validation: prediction of what was not fitted.
        rmse: residual of the fit [N m].
    """
    for status, sentence in _refusals(robot, payload, misfit, validation, rmse):
        return status, (sentence,)
    return PayloadStatus.OK, ()


def _refusals(
    robot: RobotModel,
    payload: BodyEstimate,
    misfit: Sequence[tuple[str, float]],
    validation: Validation | None,
    rmse: float,
) -> Iterator[tuple[PayloadStatus, str]]:
    mass, error = payload.inertial.mass, float(payload.errors[0])
    said = f"the payload comes out as {mass:.4g} ± {error:.2g} kg"
    if misfit:
        listed = ", ".join(f"{name} {carried:.3g} kg" for name, carried in misfit)
        yield PayloadStatus.DISAGREE, f"compared with {misfit[0][0]} the arm carries: {listed}"
    if mass < -2.0 * error:
        yield PayloadStatus.SWAPPED, said
    if not np.isfinite(error) or mass <= 2.0 * error:
        yield PayloadStatus.NOT_SEEN, said
    yield from _poor(validation, rmse)
    if error > LARGEST_ERROR * mass:
        yield PayloadStatus.TOO_UNCERTAIN, said
    yield from _implausible(robot, payload.inertial.theta)


def of_known_mass(
    status: PayloadStatus, weighed: BodyEstimate, known: float
) -> tuple[PayloadStatus, tuple[str, ...]]:
    """Return the verdict on torque scales from a known mass.

    Args:
        status: of the payload as if its mass were not known.
        weighed: that payload.
        known: its mass [kg].
    """
    mass = weighed.inertial.mass
    said = (f"weighed with torques as they are, {known:g} kg come out as {mass:.4g} kg",)
    # Errors and sizes that a known mass puts right are no reason to refuse it.
    if status not in (PayloadStatus.OK, PayloadStatus.TOO_UNCERTAIN, PayloadStatus.IMPLAUSIBLE):
        return status, said
    if not known / MOST_FACTOR < mass < known * MOST_FACTOR:
        return PayloadStatus.WRONG_WEIGHT, said
    return PayloadStatus.OK, said


def _poor(validation: Validation | None, rmse: float) -> Iterator[tuple[PayloadStatus, str]]:
    if validation is None:
        return
    relative = validation.relative_error or 0.0
    if relative > WORST_PREDICTION or (validation.rmse > WORST_RATIO * rmse and relative > 1e-6):
        said = (
            f"held-out stretches are predicted with an error of {validation.rmse:.3g} N·m "
            f"({percent(relative)}), the fitted ones with {rmse:.3g} N·m"
        )
        yield PayloadStatus.UNPREDICTED, said


def _implausible(robot: RobotModel, theta: Array) -> Iterator[tuple[PayloadStatus, str]]:
    farthest = FARTHEST * reach(robot)
    mass, com, inertia = spatial.com_from_theta(theta)
    distance = float(np.linalg.norm(com))
    if distance > farthest:
        yield (
            PayloadStatus.IMPLAUSIBLE,
            f"its centre of mass is {distance:.3g} m from the flange; more than {farthest:.3g} m, "
            "half the arm's reach, is not believed",
        )
    gyration = float(np.sqrt(max(np.trace(inertia), 0.0) / (2.0 * mass)))
    if gyration > farthest:
        yield (
            PayloadStatus.IMPLAUSIBLE,
            f"its radius of gyration is {gyration:.3g} m; more than {farthest:.3g} m is not "
            "believed",
        )


def reach(robot: RobotModel) -> float:
    """Return how far the arm reaches at most, stretched out [m]."""
    lengths = [float(np.linalg.norm(link.translation)) for link in robot.links[1:]]
    return max(sum(lengths), LEAST_REACH)
