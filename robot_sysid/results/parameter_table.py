"""The table of a body's numbers and its joint's friction: the model's, the identified ones and ±.

Console, report and Python read the same rows. Numbers have as many digits as make two of their
standard error.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

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
    texts = (_THETA_LABELS, PARAMETER_UNITS)
    return _rows(texts, body, body.prior, _theta_numbers, body.errors, body.data_share)


def central_rows(body: BodyEstimate) -> list[BeforeAfter]:
    """Return the rows of mass, centre of mass and inertia about it, of these what is determined.

    The first is the mass; centre of mass (3) and inertia (6) follow where their errors are finite.
    """
    errors = load_errors(body)
    rows = ten_rows(body, body.prior, errors, body.data_share)
    return [*rows[:1], *itertools.compress(rows[1:], np.isfinite(errors[1:]))]


def ten_rows(
    body: InertialParameters,
    prior: InertialParameters | None,
    errors: Array,
    shares: Array,
) -> list[BeforeAfter]:
    """Return the rows of mass, centre of mass and inertia about it.

    A centre of mass comes from the data as far as both the mass and its first moment do.

    Args:
        body: the identified parameters.
        prior: those of the model; None where it has none.
        errors: (10,) standard errors of mass, centre of mass and inertia about it; one of zero
            counts as not stated.
        shares: (10,) shares of the parameters that come from the data.
    """
    shares = shares.copy()
    shares[1:4] = np.minimum(shares[0], shares[1:4])
    texts = (CENTRAL_LABELS, CENTRAL_UNITS)
    return _rows(texts, body, prior, central_numbers, errors, shares)


def _rows(
    texts: tuple[Sequence[str], Sequence[str]],
    body: InertialParameters,
    prior: InertialParameters | None,
    numbers_of: Callable[[InertialParameters], Array],
    errors: Array,
    shares: Array,
) -> list[BeforeAfter]:
    """Return rows of ten numbers, as of ``ten_rows``; ``texts`` are their labels and units."""
    labels, units = texts
    before: list[float | None] = [None] * 10
    if prior is not None:
        before = numbers_of(prior).tolist()
    after = numbers_of(body).tolist()
    stated_errors = [error or None for error in errors.tolist()]
    columns = (labels, before, after, stated_errors, units, shares.tolist())
    return list(map(BeforeAfter, *columns))


def _theta_numbers(body: InertialParameters) -> Array:
    """Return the ten parameters without rounding errors."""
    return without_rounding(body.theta, body.scale)


def central_numbers(body: InertialParameters) -> Array:
    """Return mass, centre of mass and inertia about it (10,) without rounding errors."""
    scale = body.scale
    scale[1:4] = spatial.characteristic_length(body.theta)
    inertia = spatial.six_from_symmetric(body.inertia_com)
    return without_rounding(np.concatenate(([body.mass], body.com, inertia)), scale)


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
