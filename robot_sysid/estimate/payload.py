"""A payload in numbers: its estimate, the body to write, and whether recordings agree on it.

Shapes: k estimated parameters; a body has ten inertial parameters (``PARAMETER_NAMES``).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from robot_sysid import spatial
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.offers import Effect, Offers
from robot_sysid.estimate.quantities import body_estimate, quantity, select
from robot_sysid.estimate.terms import PAYLOAD, PAYLOAD_NAMES
from robot_sysid.records import Array, Flange
from robot_sysid.records.levels import CLEAR
from robot_sysid.records.parameters import SCALE
from robot_sysid.records.quantities import BodyEstimate, Quantity, is_inertia_known
from robot_sysid.spatial import PARAMETER_NAMES

LEAST_MASS = 0.03
"""Share of the payload's mass up to which recordings of one kind agree on it."""
LEAST_SHIFT = 0.01
"""Distance of their centres of mass up to which they agree [m]."""
SMALL_BODY = (0.1, 0.1)
"""Least mass [kg] and length [m] of the body that is offered to a recording beside the payload."""


def payload_estimate(fitted: Fit) -> BodyEstimate:
    """Return the payload in the frame of the terminal body."""
    return body_estimate(fitted, PAYLOAD, select(fitted, PAYLOAD_NAMES), fitted.values)


def written_payload(fitted: Fit) -> tuple[Array, bool]:
    """Return the payload (10,) to write into a model, and whether it is a ball.

    A ball of aluminium of the estimated mass at the estimated centre of mass takes the place of a
    payload whose inertia is not identified. The parameters are in the frame of the terminal body.
    """
    body = payload_estimate(fitted)
    if body.mass <= 0.0 or is_inertia_known(body):
        return body.theta, False
    return spatial.aluminium_ball(body.mass, body.com), True


def payload_in_flange(fitted: Fit, flange: Flange, values: Array) -> BodyEstimate:
    """Return the payload at parameters (k,), in the flange frame."""
    # The change of frame is linear: its matrix has the images of the ten unit bodies as columns.
    to_flange = np.stack(list(map(flange.to_flange, np.eye(10))), axis=1)
    combinations = to_flange @ select(fitted, PAYLOAD_NAMES)
    return body_estimate(fitted, PAYLOAD, combinations, values)


def torque_scale_rows(fitted: Fit, divided: Array) -> Iterator[Quantity]:
    """Yield the torque scales by a known mass: what the log reads over what is there.

    ``divided``: (n,) torque scales by which the torques were divided already.
    """
    for joint, factor in zip(fitted.arm.joints, divided[fitted.arm.indices].tolist()):
        value, error = quantity(fitted, SCALE.key_of(joint))
        scale = factor * (1.0 + value)
        yield Quantity("torque_scale", joint, "", 1.0, scale, factor * error)


def without_inertia(body: BodyEstimate) -> BodyEstimate:
    """Return a body with all moments of inertia marked as not identified."""
    is_first = np.arange(10) < 4  # mass and first moments
    return replace(
        body,
        is_determined=body.is_determined & is_first,
        data_share=body.data_share * is_first,
    )


class Contradiction(NamedTuple):
    """A recording that contradicts the others of its kind about the payload.

    Attributes:
        recording: its name.
        others: names of the other recordings of its kind, without or with the payload.
        carried: (10,) body that it shows, in the frame of the terminal body.
        least: mass up to which a body is none [kg].
    """

    recording: str
    others: tuple[str, ...]
    carried: Array
    least: float


def contradiction(fitted: Fit) -> Contradiction | None:
    """Return the clearest contradiction between recordings of one kind; None where they agree.

    Each recording that is not the only one of its kind is offered a body of its own beside the
    payload: the gain in the log marginal likelihood says whether it has one.
    """
    kinds = {log.name: log.is_loaded for log in fitted.recordings}
    mass = abs(fitted.by_name[PAYLOAD_NAMES[0]])
    least = LEAST_MASS * mass
    least_mass, length = SMALL_BODY
    found: list[tuple[float, Contradiction]] = []
    offers = Offers(fitted, fitted.weights)
    factor = np.diag(spatial.parameter_scale(max(mass, least_mass), length))
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
        is_other = abs(offer.values[0]) > least or moved > LEAST_SHIFT
        if offer.gain > CLEAR and is_other:
            found.append((offer.gain, Contradiction(name, tuple(same), total, least)))
    return max(found, key=lambda pair: pair[0])[1] if found else None
