"""Tables before -> after: what the model says, what was found, and how far that may be off."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.output.cards import ERROR_NAMES, load_errors
from robot_sysid.records import Array, Identification
from robot_sysid.records.figures import THETA, figure, percent, term_unit, with_error

LABELS: Mapping[str, str] = {
    "m": "mass",
    **{f"h{axis}": f"CoM moment {axis}" for axis in "xyz"},
    **{name: f"inertia {name[1:]}" for name in spatial.PARAMETER_NAMES[4:]},
}
"""Parameter name to what it is called in a table."""
HEADINGS = ("", "model", "identified", "±", "unit", "change")
_ROUNDING = 1e-9
_TEN_TIMES = 10.0
_WHOLE = 0.995


@dataclass(frozen=True)
class BeforeAfter:
    """One number before and after an identification.

    Attributes:
        name: what it is, in words.
        before: the model's value; None where the model has none.
        after: the identified value.
        error: its whole standard error; infinite where the data does not show it, None where
            nothing is stated.
        unit: of all three.
        share: how much of the value comes from the data: 1 all, 0 all from the model.
    """

    name: str
    before: float | None
    after: float
    error: float | None
    unit: str
    share: float = 1.0

    @property
    def change(self) -> str:
        """How the value has changed, in words."""
        if self.error is not None and not np.isfinite(self.error):
            return self._unseen if self.share < 1.0 - _WHOLE else self._partly
        partly = f"; {self._partly}" if self.share < _WHOLE else ""
        return self._by + partly

    @property
    def _unseen(self) -> str:
        return "not seen: the model's" if self.after == self.before else "not seen"

    @property
    def _partly(self) -> str:
        return f"partly the model's (data {100.0 * self.share:.0f} %)"

    @property
    def _by(self) -> str:
        if self.before is None:
            return ""
        by = self.after - self.before
        if abs(by) <= _ROUNDING * abs(self.before):
            return "none"
        if self.error is not None and abs(by) <= self.error:
            return "within ±"
        ratio = by / self.before if self.before else np.inf
        if self.before * self.after > 0.0 and abs(ratio) <= _TEN_TIMES:
            return f"{'+' if ratio > 0.0 else ''}{percent(ratio)}"
        return f"{'+' if by > 0.0 else ''}{figure(by, self.error)}"

    @property
    def cells(self) -> tuple[str, ...]:
        """The row as text, one cell per heading."""
        error, known = self.error, self.error is not None and np.isfinite(self.error)
        return (
            self.name,
            "" if self.before is None else figure(self.before, error),
            figure(self.after, error),
            figure(error, error) if known and error is not None else "",
            self.unit,
            self.change,
        )


def table_lines(rows: Sequence[BeforeAfter], indent: str = "  ") -> list[str]:
    """Return rows as aligned lines under their headings; a column without entries is left out."""
    cells = [row.cells for row in rows]
    shown = [k for k in range(len(HEADINGS)) if any(row[k] for row in cells)]
    cells = [tuple(row[k] for k in shown) for row in (HEADINGS, *cells)]
    widths = [max(map(len, column)) for column in zip(*cells)]
    numbers = {HEADINGS.index(name) for name in ("model", "identified", "±")}
    return [
        indent
        + "  ".join(
            f"{cell:>{width}}" if k in numbers else f"{cell:<{width}}"
            for k, cell, width in zip(shown, row, widths)
        ).rstrip()
        for row in cells
    ]


def theta_rows(
    before: Array | None, after: Array, errors: Array | None, share: Array | None = None
) -> list[BeforeAfter]:
    """Return the rows of ten inertial parameters; arrays (10,), None where nothing is known."""
    size = _sizes(after)
    nothing: list[None] = [None] * 10
    columns = zip(
        spatial.PARAMETER_NAMES,
        nothing if before is None else _without_rounding(before, size),
        _without_rounding(after, size),
        nothing if errors is None else errors.tolist(),
        THETA,
        np.ones(10).tolist() if share is None else share.tolist(),
    )
    return [BeforeAfter(LABELS[name], *rest) for name, *rest in columns]


def shown(theta: Array) -> Array:
    """Return ten parameters (10,), zero where they are nothing but rounding."""
    return np.array(_without_rounding(theta, _sizes(theta)))


def _sizes(theta: Array) -> Array:
    mass, length = max(float(theta[0]), 1e-9), spatial.characteristic_length(theta)
    return spatial.parameter_scale(mass, length)


def link_rows(found: Identification) -> list[BeforeAfter]:
    """Return the rows of a terminal link, with its centre of mass and its joint's friction."""
    estimate = found.estimate
    errors = estimate.standard_errors if found.data.source.is_measured else None
    share = None if estimate.data_share is None else estimate.data_share[:10]
    inertial = theta_rows(
        found.prior.theta,
        estimate.inertial.theta,
        None if errors is None else errors[:10],
        None if errors is None else share,
    )
    return [inertial[0], *_com_rows(found, errors), *inertial[1:], *_friction_rows(found, errors)]


def _com_rows(found: Identification, errors: Array | None) -> Iterator[BeforeAfter]:
    """Yield the centre of mass where its error is known, or none is stated."""
    estimate = found.estimate
    known = errors is None or np.all(np.isfinite(errors[:4]))
    if not known or (errors is not None and estimate.covariance is None):
        return
    theta = estimate.inertial.theta
    after, before = estimate.inertial.com, found.prior.com
    spread: Sequence[float | None] = [None] * 3
    if errors is not None and estimate.covariance is not None:
        known_errors = load_errors(estimate.inertial, estimate.covariance[:10, :10])
        spread = [known_errors[name] for name in ERROR_NAMES[1:]]
    length = max(spatial.characteristic_length(theta), 1e-9)
    columns = (_without_rounding(values, length) for values in (before, after))
    for axis, old, new, error in zip("xyz", *columns, spread):
        yield BeforeAfter(f"centre of mass {axis}", old, new, error, "m")


def _friction_rows(found: Identification, errors: Array | None) -> Iterator[BeforeAfter]:
    joint = found.joint_name
    for term, words in (("coulomb", "Coulomb friction"), ("viscous", "viscous friction")):
        value = found.estimate.value(f"{term}[{joint}]")
        if value is not None:
            error = None if errors is None else found.estimate.error(f"{term}[{joint}]")
            after = _without_rounding(np.array([value]), 1.0)[0]
            unit = term_unit(term, joint in found.slides)
            yield BeforeAfter(words, model_friction(found, joint, term), after, error, unit)


def model_friction(found: Identification, joint: str, term: str) -> float | None:
    """Return a friction coefficient as the model has it; None where a model has no such term."""
    if found.model_friction is None or term not in ("coulomb", "viscous"):
        return None
    return float(getattr(found.model_friction, term)[found.joint_names.index(joint)])


def friction_text(
    term: str, before: float | None, after: float, error: float | None, unit: str
) -> str:
    """Return one friction term of a joint, such as "coulomb 0.4 -> 0.133 ± 0.004 N·m"."""
    if error is not None and not np.isfinite(error):
        return f"{term} not visible"
    old = "" if before is None else f"{figure(before)} -> "
    return f"{term} {old}{with_error(after, error, unit)}"


def _without_rounding(values: Array, size: Array | float) -> list[float]:
    """Return numbers, zero where they are nothing but rounding beside ``size``."""
    return [float(value) for value in np.where(np.abs(values) < _ROUNDING * size, 0.0, values)]
