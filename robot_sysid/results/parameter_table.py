"""The table of a body's numbers and its joint's friction: the model's, the identified ones and ±.

Console, report and Python read the same rows. Numbers have as many digits as make two of their
standard error.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.records import Array, InertialParameters
from robot_sysid.records.messages import (
    PARAMETER_UNITS,
    aligned_lines,
    number_text,
    percent,
    term_unit,
)
from robot_sysid.results.body_errors import INERTIA, load_errors
from robot_sysid.results.record import BodyEstimate, Quantity, Result
from robot_sysid.results.verdict import PRIOR_SHARE

_THETA_LABELS = (
    "mass",
    *map("CoM moment {}".format, "xyz"),
    *(f"inertia {name[1:]}" for name in INERTIA),
)
"""Labels of the ten inertial parameters."""
CENTRAL_LABELS = (
    "mass",
    *map("centre of mass {}".format, "xyz"),
    *(f"inertia {name[1:]} about CoM" for name in INERTIA),
)
"""Labels of mass, centre of mass and inertia about it."""
CENTRAL_UNITS = ("kg", *"mmm", *PARAMETER_UNITS[4:])
"""Their units."""
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


def table_cells(rows: Sequence[BeforeAfter], title: str) -> Iterator[tuple[str, ...]]:
    """Yield the headings and the rows as texts of cells, without columns that have no entries.

    The title stands above the first column.
    """
    columns = zip((title, *HEADINGS[1:]), *(row.cells for row in rows))
    return zip(*(column for column in columns if any(column[1:])))


def table_lines(rows: Sequence[BeforeAfter], title: str = "") -> list[str]:
    """Return rows as aligned lines under their headings, see ``table_cells``."""
    lines = aligned_lines(table_cells(rows, title), _RIGHT_ALIGNED)
    return list(map("  {}".format, lines))


def parameter_rows(result: Result) -> list[BeforeAfter]:
    """Return the rows of a payload, or of the terminal link with its joint's friction.

    They are those of ``central_rows``. Where the centre of mass is not identifiable, a link has the
    first moments and the inertia about its frame's origin instead.
    """
    rows = central_rows(result.body)
    if result.payload is not None:
        return rows
    if len(rows) == 1:
        rows = theta_rows(result.body)
    joint_name = result.robot.terminal_joint
    joint = result.joints.get(joint_name)
    if joint is None:
        return rows
    is_slide = joint_name in result.robot.slides
    return [*rows, *friction_rows(joint.terms, joint.model_terms, is_slide)]


def theta_rows(body: BodyEstimate) -> list[BeforeAfter]:
    """Return the rows of the ten inertial parameters."""
    columns = (_THETA_LABELS, PARAMETER_UNITS, body.errors, body.data_share)
    return _number_rows(body, attrgetter("theta"), body.scale, *columns)


def central_rows(body: BodyEstimate) -> list[BeforeAfter]:
    """Return the rows of mass, centre of mass and inertia about it.

    The first is the mass; centre of mass (3) and inertia (6) follow where their errors are finite.
    A centre of mass comes from the data as far as both the mass and its first moment do.
    """
    scale = body.scale
    scale[1:4] = spatial.characteristic_length(body.theta)
    shares = body.data_share.copy()
    shares[1:4] = np.minimum(shares[0], shares[1:4])
    errors = load_errors(body)
    columns = (CENTRAL_LABELS, CENTRAL_UNITS, errors, shares)
    rows = _number_rows(body, _central_values, scale, *columns)
    return [*rows[:1], *itertools.compress(rows[1:], np.isfinite(errors[1:]))]


def _central_values(inertial: InertialParameters) -> Array:
    """Return mass, centre of mass and inertia about it (10,), in the order of ``ERROR_NAMES``."""
    mass, com, inertia = spatial.com_from_theta(inertial.theta)
    return np.concatenate(([mass], com, spatial.six_from_symmetric(inertia)))


def _number_rows(
    body: BodyEstimate,
    values_of: Callable[[InertialParameters], Array],
    scale: Array,
    labels: Sequence[str],
    units: Sequence[str],
    errors: Array,
    shares: Array,
) -> list[BeforeAfter]:
    """Return the rows of ten numbers of a body before and after an identification.

    Args:
        body: the body.
        values_of: returns the numbers (10,) of the model's or the identified parameters.
        scale: (10,) sizes of large values; a number far below its own is shown as zero.
        labels: (10,) labels of the rows.
        units: (10,) units of the numbers.
        errors: (10,) standard errors of the identified numbers; one of zero counts as not stated.
        shares: (10,) shares of the identified numbers that the data determines.
    """
    priors: list[float | None] = [None] * len(errors)
    if body.prior is not None:
        priors = without_rounding(values_of(body.prior), scale).tolist()
    values = without_rounding(values_of(body), scale).tolist()
    stated_errors = [error or None for error in errors.tolist()]
    columns = (labels, priors, values, stated_errors, units, shares.tolist())
    return list(map(BeforeAfter, *columns))


def without_rounding(values: Array, scale: Array | float) -> Array:
    """Return values, zero where they are below ``_ROUNDING`` times their scale.

    Args:
        values: numbers of any shape.
        scale: size of a large value, in the unit of the values and of a shape that fits theirs.
    """
    return np.where(np.abs(values) < _ROUNDING * scale, 0.0, values)


def friction_rows(
    terms: Mapping[str, Quantity], model_terms: Mapping[str, float], is_slide: bool
) -> Iterator[BeforeAfter]:
    """Yield the rows of a joint's friction terms and rotor inertia.

    Args:
        terms: friction term to its estimate; an error of zero counts as not stated.
        model_terms: friction term to its value in the model, where that has one.
        is_slide: whether the joint is a slide, which determines the units.
    """
    for term, (value, error) in terms.items():
        value = float(without_rounding(np.array(value), scale=1.0))
        label = TERM_LABELS.get(term, f"friction {term}")
        prior = model_terms.get(term)
        unit = term_unit(term, is_slide)
        yield BeforeAfter(label, prior, value, error or None, unit)
