"""The rows of a result: numbers of bodies, in the order of the tables, and the words of causes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.records import Array, InertialParameters
from robot_sysid.records.messages import PARAMETER_UNITS
from robot_sysid.results.body_errors import ERROR_NAMES, load_errors
from robot_sysid.results.record import DATA, FILE, MODEL, BodyEstimate, Quantity

BODY_NAMES = (*ERROR_NAMES, *PARAMETER_NAMES[1:])
"""Names of a body's rows: mass, centre of mass, inertia about it; then what torques are linear in,
first moments and inertia about the origin of the body's frame."""
PRIOR_SHARE = 0.5
"""Share of a value that comes from the data below which the model's prior dominates."""
BEYOND = "beyond the model"
"""Body of the rows on what is on the terminal link beyond its model."""
MOMENT = "mass_times_distance"
"""Name of the row on the mass of what is there, times the distance of its centre of mass."""
NOT_SHOWN = "these torques do not show it"
"""Reason of a number that the recordings do not determine."""
_UNITS = ("kg", *"mmm", *PARAMETER_UNITS[4:], *PARAMETER_UNITS[1:])
# Index of the inertial parameter whose share and causes a row has.
_INDICES = (*range(10), *range(1, 10))


def without_rounding(values: Array, scale: Array | float) -> Array:
    """Return values, zero where they are rounding errors beside their scale.

    Args:
        values: numbers of any shape.
        scale: size of a large value, in the unit of the values and of a shape that fits theirs.
    """
    # Models are written to 1e-9.
    return np.where(np.abs(values) < 1e-9 * scale, 0.0, values)


def _numbers(body: InertialParameters) -> list[float]:
    """Return the numbers of a body in the order of ``BODY_NAMES``, without rounding errors."""
    scale = body.scale
    theta = without_rounding(body.theta, scale)
    scale[1:4] = spatial.characteristic_length(body.theta)
    inertia = spatial.six_from_symmetric(body.inertia_com)
    central = np.concatenate(([body.mass], body.com, inertia))
    return [*without_rounding(central, scale).tolist(), *theta[1:].tolist()]


def body_quantities(body: BodyEstimate) -> Iterator[Quantity]:
    """Yield the rows of a body, whose model is its ``prior``.

    A centre of mass comes from the data as far as both the mass and its first moment do. A body
    whose covariance is zero has no errors.
    """
    before: list[float | None] = [None] * len(BODY_NAMES)
    if body.prior is not None:
        before = [*_numbers(body.prior)]
    errors = [*load_errors(body).tolist(), *body.errors[1:].tolist()]
    rows = zip(BODY_NAMES, _UNITS, before, _numbers(body), errors, _INDICES)
    for name, unit, model, value, error, index in rows:
        share = body.data_share[index]
        if name.startswith("com"):
            share = min(share, body.data_share[0])
        reason = body.largest_cause(index)
        if np.isinf(error):
            reason = NOT_SHOWN
        is_from_data = body.prior is None or share >= PRIOR_SHARE
        source = DATA if is_from_data and np.isfinite(error) else MODEL
        yield Quantity(
            name, body.name, unit, model, value, error or None, source, reason
        )


def file_quantities(theta: Array, prior: Array, of: str) -> Iterator[Quantity]:
    """Yield the rows of a written link, parameters (10,); those of the model are ``prior``."""
    models = _numbers(InertialParameters(prior))
    values = _numbers(InertialParameters(theta))
    for name, unit, model, value in zip(BODY_NAMES, _UNITS, models, values):
        yield Quantity(name, of, unit, model, value, None, FILE)
