"""The table of a body's numbers and its joint's friction: the model's, the identified ones and ±.

Console, report and Python read the same rows. Numbers have as many digits as make two of their
standard error.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.records import Array
from robot_sysid.records.messages import (
    PARAMETER_UNITS,
    aligned_lines,
    number_text,
    percent,
    term_unit,
)
from robot_sysid.results.body_errors import INERTIA, load_errors
from robot_sysid.results.record import BodyEstimate, Result
from robot_sysid.results.verdict import PRIOR_SHARE

LABELS: Mapping[str, str] = {
    "m": "mass",
    **{f"h{axis}": f"CoM moment {axis}" for axis in "xyz"},
    **{name: f"inertia {name[1:]}" for name in INERTIA},
}
"""Parameter name to its label in a table."""
TERM_LABELS = {
    "coulomb": "Coulomb friction",
    "viscous": "viscous friction",
    "offset": "friction offset",
    "armature": "rotor inertia",
}
"""Friction term to its label in a table; other terms are called "friction TERM"."""
HEADINGS = ("", "model", "identified", "±", "unit", "change")
"""Headings of the table of parameters, in the order of ``BeforeAfter.cells``."""
_RIGHT_ALIGNED = ("model", "identified", "±")
"""Headings of the columns whose cells are aligned to the right."""
_ROUNDING = 1e-9
"""Share of a body's scale below which a number is rounding error: models are written to 1e-9."""
_MIN_LENGTH = 1e-9
"""Length [m] in place of the characteristic length of a body without extent."""
_WITHIN = "within ±"
"""Cell of a change that is smaller than the standard error."""
_MAX_RELATIVE_CHANGE = 10.0
"""Relative change beyond which the change itself is stated, not a percentage."""


@dataclass(frozen=True)
class BeforeAfter:
    """One number before and after an identification.

    Attributes:
        name: label of the row.
        before: the model's value; None where the model has none.
        after: the identified value.
        error: standard error of ``after``; infinite where it is not identifiable, NaN where it was
            held at a bound, None where none is stated.
        unit: unit of ``before``, ``after`` and ``error``.
        share: share of ``after`` that the data determines, 0 to 1; the prior determines the other
            share.
    """

    name: str
    before: float | None
    after: float
    error: float | None
    unit: str
    share: float = 1.0

    @property
    def change(self) -> str:
        """How the value has changed; with "prior" where most of it comes from the prior."""
        if self.error is not None and not np.isfinite(self.error):
            return "at its bound" if np.isnan(self.error) else "not identifiable"
        difference = self._difference
        if self.share >= PRIOR_SHARE:
            return difference
        is_prior_alone = difference in ("", "none", _WITHIN)
        return "prior" if is_prior_alone else f"{difference}, prior"

    @property
    def _difference(self) -> str:
        """The change as a percentage where that is below 1000 %, else as a number."""
        if self.before is None:
            return ""
        difference = self.after - self.before
        if abs(difference) <= _ROUNDING * abs(self.before):
            return "none"
        if self.error is not None and abs(difference) <= self.error:
            return _WITHIN
        sign = "+" if difference > 0.0 else ""
        ratio = difference / self.before if self.before else np.inf
        if self.before * self.after > 0.0 and abs(ratio) <= _MAX_RELATIVE_CHANGE:
            return f"{sign if ratio > 0.0 else ''}{percent(ratio)}"
        return f"{sign}{number_text(difference, self.error)}"

    @property
    def cells(self) -> tuple[str, ...]:
        """The row as text, one cell per heading."""
        error = self.error
        before = "" if self.before is None else number_text(self.before, error)
        plus_minus = ""
        if error is not None and np.isfinite(error):
            plus_minus = number_text(error, error)
        after = number_text(self.after, error)
        return (self.name, before, after, plus_minus, self.unit, self.change)


def table_lines(rows: Sequence[BeforeAfter], title: str = "") -> list[str]:
    """Return rows as aligned lines under their headings, without columns that have no entries.

    The title stands above the first column.
    """
    columns = zip((title, *HEADINGS[1:]), *(row.cells for row in rows))
    shown_columns = [column for column in columns if any(column[1:])]
    lines = aligned_lines(zip(*shown_columns), _RIGHT_ALIGNED)
    return list(map("  {}".format, lines))


def parameter_rows(result: Result) -> list[BeforeAfter]:
    """Return the rows of a payload, or of the terminal link with its joint's friction.

    They are mass, centre of mass and inertia about it. Where the centre of mass is not
    identifiable, a link has the first moments and the inertia about its frame's origin instead.
    """
    body = result.body
    mass, *moments = theta_rows(body)
    com = com_rows(body)
    if result.payload is not None:
        return [mass, *com, *(inertia_rows(body) if com else [])]
    body_rows = [*com, *inertia_rows(body)] if com else moments
    return [mass, *body_rows, *_friction_rows(result)]


def theta_rows(body: BodyEstimate) -> list[BeforeAfter]:
    """Return the rows of the ten inertial parameters; an error of zero counts as not stated."""
    prior = None if body.prior is None else body.prior.theta
    theta = body.inertial.theta
    scale = body.inertial.scale
    labels = LABELS.values()
    errors = body.errors
    shares = body.data_share
    return _number_rows(labels, prior, theta, errors, PARAMETER_UNITS, scale, shares)


def com_rows(body: BodyEstimate) -> list[BeforeAfter]:
    """Return the rows of a centre of mass; none where its error is infinite.

    It comes from the data as far as both the mass and its first moment do.
    """
    errors = load_errors(body)[1:4]
    if not np.all(np.isfinite(errors)):
        return []
    length = max(spatial.characteristic_length(body.inertial.theta), _MIN_LENGTH)
    prior = None if body.prior is None else body.prior.com
    labels = map("centre of mass {}".format, "xyz")
    com = body.inertial.com
    shares = np.minimum(body.data_share[0], body.data_share[1:4])
    return _number_rows(labels, prior, com, errors, ["m"] * 3, length, shares)


def inertia_rows(body: BodyEstimate) -> list[BeforeAfter]:
    """Return the rows of the inertia about the centre of mass; none where it is not known."""
    errors = load_errors(body)[4:]
    if not np.all(np.isfinite(errors)):
        return []
    prior = None
    if body.prior is not None:
        prior = spatial.six_from_symmetric(body.prior.inertia_com)
    inertia = spatial.six_from_symmetric(body.inertial.inertia_com)
    labels = [f"inertia {name[1:]} about CoM" for name in INERTIA]
    units = ["kg·m²"] * 6
    scale = body.inertial.scale[4:]
    shares = body.data_share[4:]
    return _number_rows(labels, prior, inertia, errors, units, scale, shares)


def _number_rows(
    labels: Iterable[str],
    prior: Array | None,
    identified: Array,
    errors: Array,
    units: Iterable[str],
    scale: Array | float,
    shares: Array,
) -> list[BeforeAfter]:
    """Return the rows of m numbers before and after an identification.

    Args:
        labels: (m,) labels of the rows.
        prior: (m,) the model's values; None where it has none.
        identified: (m,) identified values.
        errors: (m,) their standard errors; one of zero counts as not stated.
        units: (m,) their units.
        scale: sizes (m,) of large values, or one size; far below it, a number is shown as zero.
        shares: (m,) shares of the identified values that the data determines.
    """
    values_before: list[float | None] = [None] * len(identified)
    if prior is not None:
        values_before = without_rounding(prior, scale).tolist()
    values_after = without_rounding(identified, scale).tolist()
    stated_errors = [error or None for error in errors.tolist()]
    columns = (labels, values_before, values_after, stated_errors, units)
    return list(map(BeforeAfter, *columns, shares.tolist()))


def without_rounding(values: Array, scale: Array | float) -> Array:
    """Return values, zero where they are below ``_ROUNDING`` times their scale.

    Args:
        values: numbers of any shape.
        scale: size of a large value, in the unit of the values and of a shape that fits theirs.
    """
    return np.where(np.abs(values) < _ROUNDING * scale, 0.0, values)


def _friction_rows(result: Result) -> Iterator[BeforeAfter]:
    """Yield the friction terms and the rotor inertia of the terminal joint, where estimated."""
    joint_name = result.robot.terminal_joint
    estimate = result.estimate
    is_slide = joint_name in result.robot.slides
    joint = result.joints.get(joint_name)
    if joint is not None:
        for term, (value, error) in joint.terms.items():
            label = TERM_LABELS.get(term, f"friction {term}")
            before = joint.model_terms.get(term)
            yield BeforeAfter(label, before, value, error, term_unit(term, is_slide))
        return
    for term in ("coulomb", "viscous"):
        name = f"{term}[{joint_name}]"
        friction = estimate.value(name)
        if friction is not None:
            stated_error = estimate.error(name) if result.is_measured else None
            identified = float(without_rounding(np.array(friction), scale=1.0))
            unit = term_unit(term, is_slide)
            yield BeforeAfter(TERM_LABELS[term], None, identified, stated_error, unit)
