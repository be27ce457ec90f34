"""Tables before -> after: what the model says, what was found, and how far that may be off."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.records import Array
from robot_sysid.records.figures import THETA, figure, percent, term_unit, with_error
from robot_sysid.results.cards import INERTIA, load_errors
from robot_sysid.results.record import BodyEstimate, Result

LABELS: Mapping[str, str] = {
    "m": "mass",
    **{f"h{axis}": f"CoM moment {axis}" for axis in "xyz"},
    **{name: f"inertia {name[1:]}" for name in spatial.PARAMETER_NAMES[4:]},
}
"""Parameter name to what it is called in a table."""
HEADINGS = ("", "model", "identified", "±", "unit", "change")
_NUMBERS = ("model", "identified", "±")
_ROUNDING = 1e-9
"""Share of a body's size below which a number is nothing: what is written is exact to 1e-9 too."""
_LEAST = 1e-9
"""Mass [kg] and length [m] that stand for those of a body that has none."""
_TEN_TIMES = 10.0
"""Change beyond which a number says more than a percentage."""
_WHOLE = 0.995
"""Share of the data that rounds to 100 %."""


@dataclass(frozen=True)
class BeforeAfter:
    """One number before and after an identification.

    Attributes:
        before: the model's value; None where the model has none.
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
        partly = f"partly the model's (data {100.0 * self.share:.0f} %)"
        if self.error is None or np.isfinite(self.error):
            return self._by + (f"; {partly}" if self.share < _WHOLE else "")
        unseen = "not seen: the model's" if self.after == self.before else "not seen"
        return unseen if self.share < 1.0 - _WHOLE else partly

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


def table_lines(rows: Sequence[BeforeAfter], title: str = "") -> list[str]:
    """Return rows as aligned lines under their headings; a column without entries is left out."""
    headings = (title, *HEADINGS[1:])
    columns = [c for c in zip(headings, *(row.cells for row in rows)) if any(c[1:])]
    widths = [max(map(len, column)) for column in columns]
    aligned = [
        [f"{cell:>{width}}" if column[0] in _NUMBERS else f"{cell:<{width}}" for cell in column]
        for column, width in zip(columns, widths)
    ]
    return ["  " + "  ".join(row).rstrip() for row in zip(*aligned)]


def theta_rows(body: BodyEstimate) -> list[BeforeAfter]:
    """Return the rows of ten inertial parameters; an error of zero is none that is stated."""
    theta, before = body.inertial.theta, None if body.before is None else body.before.theta
    pairs, shares = _from_to(before, theta, _sizes(theta)), body.data_share.tolist()
    rows = zip(spatial.PARAMETER_NAMES, pairs, body.errors.tolist(), THETA, shares)
    return [BeforeAfter(LABELS[n], *pair, error or None, *rest) for n, pair, error, *rest in rows]


def _from_to(
    before: Array | None, after: Array, size: Array | float
) -> list[tuple[float | None, float]]:
    """Return pairs of numbers (before, after), zero where they are nothing but rounding."""
    old = [None] * len(after) if before is None else without_rounding(before, size)
    return list(zip(old, without_rounding(after, size)))


def shown(theta: Array) -> Array:
    """Return ten parameters (10,), zero where they are nothing but rounding."""
    return np.array(without_rounding(theta, _sizes(theta)))


def without_rounding(values: Array, size: Array | float) -> list[float]:
    """Return numbers, zero where they are nothing but rounding beside ``size``."""
    return [float(value) for value in np.where(np.abs(values) < _ROUNDING * size, 0.0, values)]


def _sizes(theta: Array) -> Array:
    mass, length = max(float(theta[0]), _LEAST), spatial.characteristic_length(theta)
    return spatial.parameter_scale(mass, length)


def asked_rows(result: Result) -> list[BeforeAfter]:
    """Return the rows of a payload, or of the terminal link with its joint's friction."""
    body = result.body
    first, *rest = theta_rows(body)
    place = list(_com_rows(body))
    if result.payload is None:
        return [first, *place, *rest, *_friction_rows(result)]
    return [first, *place, *(_inertia_rows(body) if place else [])]


def link_rows(result: Result) -> list[BeforeAfter]:
    """Return the rows of every link that has mass: its mass and first moments."""
    return [replace(r, name=f"{b.name} {r.name}") for b in result.links for r in theta_rows(b)[:4]]


def _com_rows(body: BodyEstimate) -> Iterator[BeforeAfter]:
    """Yield the centre of mass where its error is known, or none is stated."""
    errors = load_errors(body)[1:4]
    if not np.all(np.isfinite(errors)):
        return
    length = max(spatial.characteristic_length(body.inertial.theta), _LEAST)
    pairs = _from_to(None if body.before is None else body.before.com, body.inertial.com, length)
    for axis, pair, error in zip("xyz", pairs, errors.tolist()):
        yield BeforeAfter(f"centre of mass {axis}", *pair, error or None, "m")


def _inertia_rows(body: BodyEstimate) -> Iterator[BeforeAfter]:
    """Yield the inertia about the centre of mass; none where it is not known."""
    errors, about = load_errors(body)[4:], spatial.six_from_symmetric(body.inertial.inertia_com)
    for name, error, value in zip(INERTIA, errors.tolist(), about.tolist()):
        if np.isfinite(error):
            yield BeforeAfter(f"inertia {name[1:]} about it", None, value, error, "kg·m²")


def _friction_rows(result: Result) -> Iterator[BeforeAfter]:
    joint, estimate = result.joint_name, result.estimate
    model = result.joints[joint].before if joint in result.joints else {}
    for term, words in (("coulomb", "Coulomb friction"), ("viscous", "viscous friction")):
        value = estimate.value(f"{term}[{joint}]")
        if value is not None:
            error = estimate.error(f"{term}[{joint}]") if result.is_measured else None
            after = without_rounding(np.array([value]), 1.0)[0]
            unit = term_unit(term, joint in result.slides)
            yield BeforeAfter(words, model.get(term), after, error, unit)


def friction_text(
    term: str, before: float | None, after: float, error: float | None, unit: str
) -> str:
    """Return one friction term of a joint, such as "coulomb 0.4 -> 0.133 ± 0.004 N·m"."""
    if error is not None and np.isinf(error):
        return f"{term} not visible"
    old = "" if before is None else f"{figure(before)} -> "
    if error is not None and np.isnan(error):
        return f"{term} {old}{figure(after)} (held at its bound)"
    return f"{term} {old}{with_error(after, error, unit)}"
