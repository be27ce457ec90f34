"""The rows of a result: numbers of bodies with their errors, in the order of the tables.

A body's ten parameters theta (10,) are mass m [kg], first moments h [kg m] and the inertia about
the origin of its frame [kg m^2], six elements; its centre of mass is c = h / m. Errors of the
centre of mass, of the inertia about it and of principal axes follow from those of theta.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid import spatial
from robot_sysid.records.arm import InertialParameters
from robot_sysid.records.arrays import Array
from robot_sysid.records.levels import SURE
from robot_sysid.records.parameters import INERTIAL, Parameter

DATA = "data"
"""Source of a number that follows from the recordings more than from the model."""
MODEL = "model"
"""Source of a number that the recordings determine less than the model, or not at all."""
BOUND = "bound"
"""Source of a number that is held at its bound, without a standard error."""
FILE = "file"
"""Source of a number of the written model, fitted under the restrictions of its format."""
CURVED = "curved file"
"""Source of a number of the written model whose friction bends with speed."""


@dataclass(frozen=True)
class Quantity:
    """One number of a result: a row of params.json, of the console's tables and of the report.

    Attributes:
        name: what it is, such as "mass", "com_x", "Ixx_about_com", "coulomb" or "scale".
        of: body, joint, motor or recording that has it; "arm" for what concerns all.
        unit: of the three numbers.
        model: the value in the original model; None where that has none.
        value: the identified value.
        error: standard error of ``value``, all causes together; infinite where the recordings do
            not determine it, NaN where it is held at a bound, None of a simulation of the model
            itself, which has rounding errors alone.
        source: ``DATA``, ``MODEL``, ``BOUND``, ``FILE`` or ``CURVED``.
        reason: the cause of most of the error, or why there is none.
    """

    name: str
    of: str
    unit: str
    model: float | None
    value: float
    error: float | None
    source: str = DATA
    reason: str = ""


@dataclass(frozen=True)
class BodyEstimate(InertialParameters):
    """The ten inertial parameters of one body, estimated, and their errors.

    Attributes:
        theta: (10,) the parameters, in the body's frame; of a payload in the flange frame.
        name: name of the body.
        covariance: (10, 10) covariance of the parameters' errors, all causes together; zero where
            it is not known.
        is_determined: (10,) whether data and priors determine a parameter at all.
        budget: cause, "noise" of the torques first, to the standard errors (10,) due to it alone.
        data_share: (10,) share of each value that comes from the data, 0 to 1; the model gives the
            other share.
        prior: the parameters in the model; None of a payload.
    """

    name: str
    covariance: Array = field(default_factory=lambda: np.zeros((10, 10)))
    is_determined: NDArray[np.bool_] = field(
        default_factory=lambda: np.ones(10, dtype=bool)
    )
    budget: Mapping[str, Array] = field(default_factory=dict)
    data_share: Array = field(default_factory=lambda: np.ones(10))
    prior: InertialParameters | None = None

    @property
    def errors(self) -> Array:
        """Standard errors (10,), all causes together; infinite where not determined."""
        errors = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return np.where(self.is_determined, errors, np.inf)

    def moment_along(self, vector: Array) -> tuple[float, float]:
        """Return the first moment along a vector (3,), and its standard error [kg m].

        The error is infinite where the first moment is not determined.
        """
        direction = vector / max(float(np.linalg.norm(vector)), 1e-300)
        variance = direction @ self.covariance[1:4, 1:4] @ direction
        is_determined = np.all(self.is_determined[1:4])
        error = float(np.sqrt(variance)) if is_determined else np.inf
        return float(direction @ self.first_moment), error

    def largest_cause(self, index: int) -> str:
        """Return the cause of the largest part of a parameter's error; "" where that is not known.

        ``index``: of the parameter, 0 for the mass.
        """
        causes = {cause: errors[index] for cause, errors in self.budget.items()}
        if not np.all(np.isfinite([self.errors[index], *causes.values()])):
            return ""
        return max(causes, key=causes.__getitem__, default="")


@dataclass(frozen=True)
class FrictionCurve:
    """Friction of a joint that bends with speed, at three speeds.

    Attributes:
        of: the joint, or a motor that turns several.
        unit: of the torques.
        speed_unit: of the speeds.
        known_to: highest speed of the logs, up to which friction is known.
        speeds: at which friction is stated, the last one ``known_to``.
        model: friction in the original model.
        torque: the identified friction.
        errors: standard errors of the identified friction.
    """

    of: str
    unit: str
    speed_unit: str
    known_to: float
    speeds: tuple[float, ...]
    model: tuple[float, ...]
    torque: tuple[float, ...]
    errors: tuple[float, ...]


_CENTRAL = (
    Parameter("mass", "mass", ("kg",)),
    *(Parameter(f"com_{axis}", f"centre of mass {axis}", ("m",)) for axis in "xyz"),
    *(
        replace(each, name=f"{each.name}_about_com", label=f"{each.label} about CoM")
        for each in INERTIAL[4:]
    ),
)
CENTRAL = tuple(each.name for each in _CENTRAL)
"""Names of a body's mass [kg], centre of mass [m] and inertia about the centre of mass [kg m^2], in
the axes of the body's frame."""
# How often each of xx, xy, xz, yy, yz, zz stands in a symmetric matrix.
_MULTIPLICITY = np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])
BODY = (*_CENTRAL, *INERTIAL[1:])
"""What a body's rows are: mass, centre of mass, inertia about it; then what torques are linear in,
first moments and inertia about the origin of the body's frame."""
WRITTEN = 1e-9
"""Relative rounding error of numbers in a written model."""
PRIOR_SHARE = 0.5
"""Share of a value that comes from the data below which the model's prior dominates."""
BEYOND = "beyond the model"
"""Body of the rows on what is on the terminal link beyond its model."""
MOMENT = "mass_times_distance"
"""Name of the row on the mass of what is there, times the distance of its centre of mass."""
DIFFERENCE = "difference"
"""Name of the row on how far all numbers together are from the model's, over what chance leaves: at
one and above something is there."""
LEAST_SEEN = "least_seen"
"""Name of the row on the mass that is seen by itself."""
BEYOND_INERTIA = {"Ixx": "inertia_xx", "Iyy": "inertia_yy", "Izz": "inertia_zz"}
"""Names of moments of inertia about the frame's origin to those of the rows on what is there."""
NOT_SHOWN = "these torques do not show it"
"""Reason of a number that the recordings do not determine."""
# Index of the inertial parameter whose share and causes a row has.
_INDICES = (*range(10), *range(1, 10))


def load_covariance(body: BodyEstimate) -> Array:
    """Return the covariance (10, 10) of mass, centre of mass c and inertia about c of a body.

    The order is that of ``CENTRAL``. It follows to first order from I_com = I - m (|c|^2 1 -
    c c^T) and c = h / m, by their slopes: dc = (dh - c dm) / m, and with a = dh along an axis
    dI_com = dI - dm (c c^T - |c|^2 1) - (2 (a c) 1 - a c^T - c a^T). The change of c is not
    symmetric in the mass, larger where the mass is smaller: its slope is therefore that to the body
    that is lighter by one standard error of the mass, at most twice that of the body itself.
    Variances of what is not determined are infinite.
    """
    is_com_known = body.mass > 0.0 and np.all(body.is_determined[:4])
    is_inertia_known = is_com_known and np.all(body.is_determined)
    mass = body.mass if is_com_known else 1.0
    mass_error = np.sqrt(max(body.covariance[0, 0], 0.0))
    com = body.com
    identity = np.eye(3)
    jacobian = np.eye(10)
    com_slopes = np.column_stack((-com, identity))
    jacobian[1:4, :4] = com_slopes / max(mass - mass_error, 0.5 * mass)
    # Of the inertia about c: by the mass, then by each first moment.
    inertia_slopes = [com @ com * identity - np.outer(com, com)]
    for axis in identity:
        products = np.outer(axis, com) + np.outer(com, axis)
        inertia_slopes.append(products - 2.0 * (axis @ com) * identity)
    for column, slope in enumerate(inertia_slopes):
        jacobian[4:, column] = spatial.six_from_symmetric(slope)
    covariance = jacobian @ body.covariance @ jacobian.T
    is_known = [body.is_determined[0], is_com_known, is_inertia_known]
    is_hidden = ~np.repeat(is_known, [1, 3, 6])
    covariance[is_hidden] = 0.0
    covariance[:, is_hidden] = 0.0
    covariance[is_hidden, is_hidden] = np.inf
    return covariance


def load_errors(body: BodyEstimate) -> Array:
    """Return the standard errors (10,) of mass, centre of mass and inertia about it of a body.

    The order and units are those of ``CENTRAL``. An error that is not known is infinite.
    """
    return np.sqrt(np.maximum(np.diag(load_covariance(body)), 0.0))


def principal_moments(body: BodyEstimate) -> tuple[Array, Array]:
    """Return the principal moments (3,) of a body and their standard errors (3,).

    They are about the centre of mass [kg m^2]; infinite errors where not known. To first order,
    the moment about the axis a changes by a^T dI a.
    """
    moments, axes = spatial.principal_axes(body.inertia_com)
    covariance = load_covariance(body)[4:, 4:]
    if not np.all(np.isfinite(covariance)):
        return moments, np.full(3, np.inf)
    # Rows (3, 6) that take the six elements of dI to a^T dI a.
    squares = [spatial.six_from_symmetric(np.outer(axis, axis)) for axis in axes.T]
    rows = _MULTIPLICITY * np.array(squares)
    variances = np.diag(rows @ covariance @ rows.T)
    return moments, np.sqrt(np.maximum(variances, 0.0))


def is_inertia_known(body: BodyEstimate) -> bool:
    """Return whether any principal moment exceeds ``SURE`` standard errors.

    One is enough: the smallest moment of a rod never does, and a wrist that only spins determines
    one moment alone. Bodies that had to be made possible ones have too large moments, some of
    simulated payloads by orders of magnitude (arms of
    benchmarks/accuracy/payload_by_difference.py).
    """
    moments, errors = principal_moments(body)
    return bool(np.any(moments > SURE * errors))


def without_rounding(values: Array, scale: Array | float) -> Array:
    """Return values, zero where they are rounding errors beside their scale.

    Args:
        values: numbers of any shape.
        scale: size of a large value, in the unit of the values and of a shape that fits theirs.
    """
    return np.where(np.abs(values) < WRITTEN * scale, 0.0, values)


def _numbers(body: InertialParameters) -> list[float]:
    """Return the numbers of a body in the order of ``BODY``, without rounding errors."""
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
    before: list[float | None] = [None] * len(BODY)
    if body.prior is not None:
        before = [*_numbers(body.prior)]
    errors = [*load_errors(body).tolist(), *body.errors[1:].tolist()]
    rows = zip(BODY, before, _numbers(body), errors, _INDICES)
    for entry, model, value, error, index in rows:
        share = body.data_share[index]
        if entry.unit == "m":
            share = min(share, body.data_share[0])
        reason = body.largest_cause(index)
        if np.isinf(error):
            reason = NOT_SHOWN
        is_from_data = body.prior is None or share >= PRIOR_SHARE
        source = DATA if is_from_data and np.isfinite(error) else MODEL
        about = entry.name, body.name, entry.unit
        yield Quantity(*about, model, value, error or None, source, reason)
