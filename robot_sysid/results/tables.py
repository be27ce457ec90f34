"""Tables before -> after: what the model says, what was found, and how far that may be off."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.records import Array
from robot_sysid.records.figures import THETA, figure, percent, term_unit, with_error
from robot_sysid.results.cards import ERROR_NAMES, load_errors
from robot_sysid.results.record import BodyEstimate, Result

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


def table_lines(rows: Sequence[BeforeAfter]) -> list[str]:
    """Return rows as aligned lines under their headings; a column without entries is left out."""
    cells = [row.cells for row in rows]
    shown = [k for k in range(len(HEADINGS)) if any(row[k] for row in cells)]
    cells = [tuple(row[k] for k in shown) for row in (HEADINGS, *cells)]
    widths = [max(map(len, column)) for column in zip(*cells)]
    numbers = {HEADINGS.index(name) for name in ("model", "identified", "±")}
    return [
        "  "
        + "  ".join(
            f"{cell:>{width}}" if k in numbers else f"{cell:<{width}}"
            for k, cell, width in zip(shown, row, widths)
        ).rstrip()
        for row in cells
    ]


def theta_rows(body: BodyEstimate, stated: bool = True) -> list[BeforeAfter]:
    """Return the rows of ten inertial parameters; without errors where none are ``stated``."""
    theta = body.inertial.theta
    before = None if body.before is None else body.before.theta
    values = _from_to(before, theta, _sizes(theta)), body.errors.tolist() if stated else [None] * 10
    shares = body.data_share.tolist() if stated else [1.0] * 10
    return [
        BeforeAfter(LABELS[name], *pair, error, unit, share)
        for name, pair, error, unit, share in zip(spatial.PARAMETER_NAMES, *values, THETA, shares)
    ]


def _from_to(
    before: Array | None, after: Array, size: Array | float
) -> Iterator[tuple[float | None, float]]:
    """Return pairs of numbers (before, after), zero where they are nothing but rounding."""
    old = [None] * len(after) if before is None else _without_rounding(before, size)
    return zip(old, _without_rounding(after, size))


def shown(theta: Array) -> Array:
    """Return ten parameters (10,), zero where they are nothing but rounding."""
    return np.array(_without_rounding(theta, _sizes(theta)))


def _sizes(theta: Array) -> Array:
    mass, length = max(float(theta[0]), 1e-9), spatial.characteristic_length(theta)
    return spatial.parameter_scale(mass, length)


def asked_rows(result: Result) -> list[BeforeAfter]:
    """Return the rows of a payload, or of the terminal link with its joint's friction."""
    body = result.body
    if result.payload is not None:
        inertial = [theta_rows(body)[0], *_com_rows(body)]
        return [*inertial, *(_inertia_rows(body) if len(inertial) > 1 else [])]
    # A model's own simulation has no errors to state.
    stated = result.is_measured
    first, *rest = theta_rows(body, stated)
    return [first, *_com_rows(body, stated), *rest, *_friction_rows(result)]


def link_rows(result: Result) -> list[BeforeAfter]:
    """Return the rows of every link that has mass: its mass and first moments."""
    return [replace(r, name=f"{b.name} {r.name}") for b in result.links for r in theta_rows(b)[:4]]


def _com_rows(body: BodyEstimate, stated: bool = True) -> Iterator[BeforeAfter]:
    """Yield the centre of mass where its error is known, or none is stated."""
    errors = [load_errors(body)[name] for name in ERROR_NAMES[1:]]
    if stated and not np.all(np.isfinite(errors)):
        return
    length = max(spatial.characteristic_length(body.inertial.theta), 1e-9)
    pairs = _from_to(None if body.before is None else body.before.com, body.inertial.com, length)
    for axis, pair, error in zip("xyz", pairs, errors):
        yield BeforeAfter(f"centre of mass {axis}", *pair, error if stated else None, "m")


def _inertia_rows(body: BodyEstimate) -> Iterator[BeforeAfter]:
    """Yield the inertia about the centre of mass, errors to first order; none where not seen."""
    if not np.all(body.shown):
        return
    com, one = body.inertial.com, np.eye(3)
    slopes = [com @ com * one - np.outer(com, com)]
    slopes += [np.outer(e, com) + np.outer(com, e) - 2.0 * (e @ com) * one for e in one]
    change = np.column_stack((*map(spatial.six_from_symmetric, slopes), np.eye(6)))
    errors = np.sqrt(np.maximum(np.diag(change @ body.covariance @ change.T), 0.0))
    about = spatial.six_from_symmetric(body.inertial.inertia_com)
    for axes, value, error in zip(("xx", "xy", "xz", "yy", "yz", "zz"), about, errors):
        yield BeforeAfter(f"inertia {axes} about it", None, float(value), float(error), "kg·m²")


def _friction_rows(result: Result) -> Iterator[BeforeAfter]:
    joint, estimate = result.joint_name, result.estimate
    model = result.joints[joint].before if joint in result.joints else {}
    for term, words in (("coulomb", "Coulomb friction"), ("viscous", "viscous friction")):
        value = estimate.value(f"{term}[{joint}]")
        if value is not None:
            error = estimate.error(f"{term}[{joint}]") if result.is_measured else None
            after = _without_rounding(np.array([value]), 1.0)[0]
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


def _without_rounding(values: Array, size: Array | float) -> list[float]:
    """Return numbers, zero where they are nothing but rounding beside ``size``."""
    return [float(value) for value in np.where(np.abs(values) < _ROUNDING * size, 0.0, values)]
