"""What the command line prints of a result, read off its own figures; its tables before -> after:
what the model says, what was found, and how far that may be off.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.newton_euler import TILT_NAMES
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.inertial import plan_write_back
from robot_sysid.records import DELAY_NAME, Array, Validation
from robot_sysid.records.messages import (
    PARAMETER_UNITS,
    Detail,
    number_text,
    percent,
    term_unit,
    with_error,
)
from robot_sysid.results.cards import INERTIA, NOT_KNOWN, load_errors
from robot_sysid.results.record import (
    BaseParameters,
    BodyEstimate,
    Payload,
    Quantity,
    Result,
    RolloutTest,
)
from robot_sysid.results.verdict import limitations, verdict_lines

if TYPE_CHECKING:
    from robot_sysid.damiao.trajectory import DamiaoExportReport

_NAMED = 3
"""Bodies of a link that are named; more make a line too long."""
_ROUNDING = 1e-9
"""Friction below this is nothing [N m]."""
_SMALL = 0.05
"""Causes below this share of the whole error are not listed: they change it by 0.1 %."""
_IN_THE_BLOCK = ("CoM moment", "inertia")
"""Rows of a table whose values stand in the block already."""
_CLOSE = 0.1
"""Difference, relative to the file's error, up to which the fit's is no news."""


def result_lines(result: Result, links: bool = False) -> list[str]:
    """Return what the command line prints of a result, without its details."""
    lines = (*block_lines(result), *more_lines(result, links), *verdict_lines(result))
    return [line for line in lines if not isinstance(line, Detail)]


def block_lines(result: Result) -> list[str]:
    """Return the block "Identified parameters: ..." or "Identified payload ..." line by line."""
    if result.payload is not None:
        rows = asked_rows(result)
        payload = result.payload
        ball = [f"  {NOT_KNOWN}"]
        unseen = len(rows) > 1 and not np.all(payload.body.is_determined)
        heading = f"Identified payload, in the frame of {payload.flange.name}:"
        return [heading, *table_lines(rows), *(ball if unseen else [])]
    estimate = result.estimate
    joint = result.robot.terminal_joint
    found = estimate.inertial
    slides = joint in result.robot.slides
    theta = without_rounding(found.theta, found.scale)
    moment, inertia = (_listed(values) for values in (theta[1:4], theta[4:]))
    friction = [
        (term, estimate.value(f"{term}[{joint}]")) for term in ("coulomb", "viscous")
    ]
    return [
        "Identified parameters:",
        f"  Mass: {_listed(theta[:1])} kg",
        f"  CoM moment: [{moment}] kg·m",
        f"  Inertia: [{inertia}] kg·m²",
        *(
            f"  {term.capitalize()} friction: {_two_decimals(value)} {term_unit(term, slides)}"
            for term, value in friction
            if value is not None and None not in dict(friction).values()
        ),
        f"  RMSE: {estimate.rmse:.4f} N·m",
        f"  Condition number: {estimate.identifiability.condition_number:.1f}",
        f"  Base parameters: {estimate.identifiability.rank}",
    ]


def more_lines(result: Result, links: bool = False) -> list[str]:
    """Return what stands under that block; what --verbose adds is ``Detail`` lines."""
    held = [] if result.file is None else result.file.unchanged
    return [
        *_tables(result, links),
        *([] if result.payload is None else _payload_lines(result.payload)),
        *_sensor_lines(result),
        *_error_lines(result),
        *([] if result.rollout is None else rollout_lines(result.rollout)),
        *(type(sentence)(f"  Limit: {sentence}") for sentence in limitations(result)),
        *map(
            Detail, [f"Left in the file as it was: {', '.join(held)}"] if held else []
        ),
        *map(Detail, _details(result)),
    ]


def _listed(values: Array) -> str:
    """Return numbers with three decimals; where all are small, with two digits of the largest."""
    largest = float(np.max(np.abs(values)))
    small = 0.0 < largest < 0.01
    places = 1 - math.floor(math.log10(largest)) if small else 3
    return ", ".join(f"{value:.{places}f}" for value in values)


def _two_decimals(value: float) -> str:
    """Return a number with two decimals; one that would look like zero with its first digit."""
    # Adding zero turns the -0.00 that rounding leaves into 0.00.
    rounded = round(value, 2) + 0.0
    return (
        f"{value:.1g}"
        if rounded == 0.0 and abs(value) > _ROUNDING
        else f"{rounded:.2f}"
    )


def _tables(result: Result, links: bool) -> Iterator[str]:
    if not result.is_measured or result.payload is not None:
        return
    yield from _mass_line(result)
    rows = asked_rows(result)
    if links and result.links:
        named = (
            (body.name, row) for body in result.links for row in theta_rows(body)[:4]
        )
        rows = [replace(row, name=f"{name} {row.name}") for name, row in named]
    heading, *lines = table_lines(rows, "Before -> after")
    yield heading
    for row, line in zip(rows, lines):
        yield Detail(line) if any(word in row.name for word in _IN_THE_BLOCK) else line


def _mass_line(result: Result) -> Iterator[str]:
    bodies = result.robot.bodies
    names = [body.name for body in bodies if body.theta[0] > 0.0]
    if len(names) < 2 or bodies[0].name not in names:
        return
    rest = len(names) - _NAMED
    told = names if rest < 2 else [*names[:_NAMED], f"{rest} more"]
    theta = (
        result.estimate.inertial.theta
        if result.file is None
        else result.file.thetas[-1]
    )
    line = f"The mass is that of {' + '.join(told)}"
    try:
        plan = plan_write_back(theta, bodies)
    except ExportError:
        yield line
        return
    lumped = [body.name for body in plan.emptied]
    alone = " + ".join([names[0], *lumped]) + (" together" if lumped else " alone")
    yield f"{line}; {alone}, as written in the file: {plan.theta[0]:.4g} kg"


def _payload_lines(payload: Payload) -> Iterator[str]:
    for words, body in (("without", payload.link), ("with", payload.total)):
        mass, *errors = load_errors(body)[:4].tolist()
        com = ", ".join(map(with_error, body.inertial.com.tolist(), errors))
        total = with_error(body.inertial.mass, mass, "kg")
        yield Detail(f"Terminal link {words} it: {total}, centre of mass [{com}] m")
    if payload.scatter:
        yield Detail("Mass according to each recording alone (± noise):")
    for one in payload.scatter:
        kind = "loaded" if one.is_loaded else "empty"
        yield Detail(
            f"  {one.name} ({kind}): {with_error(one.mass, one.noise_error, 'kg')}"
        )
    if payload.torque_scale and payload.known_mass is not None:
        yield (
            f"Torque scales by the known mass of {payload.known_mass:g} kg (what the log reads "
            "over what is there, 95 % interval):"
        )
    for joint, (scale, error) in payload.torque_scale.items():
        yield f"  {joint}: {scale:.4f} [{scale - 1.96 * error:.4f}, {scale + 1.96 * error:.4f}]"


def _joint_lines(result: Result) -> Iterator[str]:
    motors = {
        f"motor that turns with {name}": each for name, each in result.couplings.items()
    }
    owners = {**result.joints, **motors}
    if any(joint.terms for joint in owners.values()):
        yield f"Friction of the joints ({result.friction_model}), model -> identified ± error:"
        for name, joint in owners.items():
            slides = name in result.robot.slides
            terms = ", ".join(
                friction_text(
                    term, joint.model_terms.get(term), *found, term_unit(term, slides)
                )
                + _another_day(joint.other_day_terms.get(term))
                for term, found in joint.terms.items()
            )
            yield f"  {name}: {terms or 'not shown by these logs'}"


def _another_day(term: Quantity | None) -> str:
    if term is None or not math.isfinite(term.error):
        return ""
    return f" (on another day ± {number_text(term.error, term.error)})"


def _sensor_lines(result: Result) -> Iterator[str]:
    sensors = result.sensors
    if result.delay is not None:
        error = sensors[DELAY_NAME].error if DELAY_NAME in sensors else 0.0
        yield f"Delay of torque behind position: {1e3 * result.delay:.3f} ± {1e3 * error:.2g} ms"
    if result.tilt is not None:
        both = [sensors[name].error for name in TILT_NAMES if name in sensors]
        error = math.degrees(math.hypot(*both))
        yield f"Tilt of the base: {math.degrees(result.tilt):.3f} ± {error:.2g} degrees"


def _error_lines(result: Result) -> Iterator[str]:
    fits = result.validation
    file = result.file
    told = set()
    if file is not None:
        own = {test.source: test for test in reversed(fits[1:])}
        if file.validation_after is not None and fits:
            # The verdict says how well the file predicts them.
            yield from map(
                Detail, _beside("held-out data", file.validation_after, fits[0])
            )
        for old, new in file.other_validations:
            shares = [t.relative_error for t in (old, new)]
            known = " -> ".join(percent(each) for each in shares if each is not None)
            yield f"Torque error of the model on {old.source}: {known or 'not known'}"
            if old.source in own:
                yield from map(Detail, _beside(old.source, new, own[old.source]))
        told = {before.source for before, _ in file.other_validations}
    for test in fits if file is None else fits[1:]:
        if test.source not in told:
            share = (
                ""
                if test.relative_error is None
                else f" ({percent(test.relative_error)})"
            )
            yield f"Validation on {test.source}: {test.rmse:.4f} N·m{share}"


def _beside(on: str, file: Validation, fit: Validation) -> Iterator[str]:
    """Yield by how much the fit, which has terms that a file cannot hold, predicts better."""
    new = file.relative_error
    fitted = fit.relative_error
    if new is not None and fitted is not None and abs(fitted - new) > _CLOSE * new:
        yield f"The fit itself reaches a torque error of {percent(fitted)} on {on}"


def _details(result: Result) -> Iterator[str]:
    parts = result.body.mass_causes.items()
    least = _SMALL * float(result.body.errors[0])
    causes = sorted(
        (item for item in parts if item[1] > least), key=lambda item: -item[1]
    )
    if np.isfinite(least) and causes:
        yield "Error of the mass by cause, kg: " + ", ".join(
            f"{k} {v:.2g}" for k, v in causes
        )
    yield from _joint_lines(result) if result.is_measured else ()
    estimate = result.estimate
    scaled = estimate.identifiability.scaled_condition_number
    yield f"  Condition number, columns scaled: {scaled:.1f}"
    yield "  RMSE per joint:"
    for joint, value in estimate.rmse_per_joint.items():
        noise = estimate.noise_per_joint.get(joint)
        yield f"    {joint}: {value:.2e} N·m" + (
            "" if noise is None else f", noise {noise:.2g}"
        )
    if result.is_measured:
        named = zip(estimate.names, result.body.noise_errors, PARAMETER_UNITS)
        known = (each for each in named if np.isfinite(each[1]))
        listed = ", ".join(f"{name} {error:.2g} {unit}" for name, error, unit in known)
        yield f"  Standard errors of noise alone: {listed}"
    if result.sensors:
        yield "  Sensors:"
    for name, (value, error) in result.sensors.items():
        held = math.isnan(error)
        yield f"    {name}: {f'{number_text(value)} (held)' if held else with_error(value, error)}"
    for joint, each in result.joints.items():
        if each.candidates:
            tried = sorted(each.candidates.items(), key=lambda item: item[1])
            listed = ", ".join(f"{model} {error:.4g}" for model, error in tried)
            yield f"  Held-out error of {joint} by friction model, N·m: {listed}"
    yield from [] if result.base is None else _base_lines(result.base)


def _base_lines(base: BaseParameters) -> Iterator[str]:
    yield (
        f"  Base parameters of all links: {len(base.values)} of {base.structural_rank} that any "
        f"motion can show; {sum(base.essential)} of them essential to these logs"
    )
    rows = zip(base.combinations, base.values, base.standard_errors, base.essential)
    for words, value, error, kept in rows:
        yield f"    {with_error(value, error)} = {words}{'' if kept else ' (not essential)'}"


def clamping_lines(
    report: DamiaoExportReport | None, joints: Sequence[str]
) -> list[str]:
    """Return what the Damiao export did, or nothing where there was none."""
    if report is None:
        return []
    shares = zip(joints, report.joints, report.clamped_percent)
    return [
        "Damiao export, clamped to motor limits:",
        *(
            f"  {joint} ({motor.motor_type}): {share:.1f} %"
            for joint, motor, share in shares
        ),
        *(f"  {warning}" for warning in report.warnings),
    ]


def folder_text(folder: Path) -> str:
    """Return a folder as the user would type it, with a trailing slash: ./sysid_output/."""
    text = folder.as_posix()
    prefix = "" if folder.is_absolute() or text.startswith(".") else "./"
    return f"{prefix}{text}/" if text != "." else "./"


def rollout_lines(test: RolloutTest) -> Iterator[str]:
    """Yield the lines of the result block, those of every joint as details."""
    yield (
        f"Played on {test.held_out}: root mean square position error [rad or m], model before -> "
        "new model"
    )
    for error in test.errors:
        ratio = "" if error.ratio is None else f", {error.ratio:.3g} times"
        old, new = error.overall
        yield (
            f"  {error.loop}, {error.horizon:g} s ({error.windows} windows): {old:.3g} -> "
            f"{new:.3g}{ratio}"
        )
        for name, one, other in zip(
            test.joint_names, error.errors_before, error.errors_after
        ):
            yield Detail(f"    {name}: {one:.3g} -> {other:.3g}")
    yield from (f"  {note}" for note in test.notes)
    worse = []
    for last in test.errors[-1:]:
        pairs = zip(test.joint_names, last.errors_before, last.errors_after)
        worse = [
            f"{n} ({last.loop}, {new / old:.2g} times)"
            for n, old, new in pairs
            if new > old
        ]
    if worse:
        yield f"  worse than before over the longest horizon: {', '.join(worse)}"


LABELS: Mapping[str, str] = {
    "m": "mass",
    **{f"h{axis}": f"CoM moment {axis}" for axis in "xyz"},
    **{name: f"inertia {name[1:]}" for name in spatial.PARAMETER_NAMES[4:]},
}
"""Parameter name to what it is called in a table."""
HEADINGS = ("", "model", "identified", "±", "unit", "change")
_NUMBERS = ("model", "identified", "±")
_NOTHING = 1e-9
"""Share of a body's size below which a number is nothing: what is written is exact to 1e-9 too."""
_LEAST = 1e-9
"""Length [m] that stands for that of a body that has none."""
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
        if abs(by) <= _NOTHING * abs(self.before):
            return "none"
        if self.error is not None and abs(by) <= self.error:
            return "within ±"
        ratio = by / self.before if self.before else np.inf
        if self.before * self.after > 0.0 and abs(ratio) <= _TEN_TIMES:
            return f"{'+' if ratio > 0.0 else ''}{percent(ratio)}"
        return f"{'+' if by > 0.0 else ''}{number_text(by, self.error)}"

    @property
    def cells(self) -> tuple[str, ...]:
        """The row as text, one cell per heading."""
        error = self.error
        known = self.error is not None and np.isfinite(self.error)
        return (
            self.name,
            "" if self.before is None else number_text(self.before, error),
            number_text(self.after, error),
            number_text(error, error) if known and error is not None else "",
            self.unit,
            self.change,
        )


def table_lines(rows: Sequence[BeforeAfter], title: str = "") -> list[str]:
    """Return rows as aligned lines under their headings; a column without entries is left out."""
    headings = (title, *HEADINGS[1:])
    columns = [c for c in zip(headings, *(row.cells for row in rows)) if any(c[1:])]
    widths = [max(map(len, column)) for column in columns]
    aligned = [
        [
            f"{cell:>{width}}" if column[0] in _NUMBERS else f"{cell:<{width}}"
            for cell in column
        ]
        for column, width in zip(columns, widths)
    ]
    return ["  " + "  ".join(row).rstrip() for row in zip(*aligned)]


def theta_rows(body: BodyEstimate) -> list[BeforeAfter]:
    """Return the rows of ten inertial parameters; an error of zero is none that is stated."""
    found = body.inertial
    before = None if body.prior is None else body.prior.theta
    pairs = _from_to(before, found.theta, found.scale)
    shares = body.data_share.tolist()
    rows = zip(
        spatial.PARAMETER_NAMES, pairs, body.errors.tolist(), PARAMETER_UNITS, shares
    )
    return [
        BeforeAfter(LABELS[n], *pair, error or None, *rest)
        for n, pair, error, *rest in rows
    ]


def _from_to(
    before: Array | None, after: Array, size: Array | float
) -> list[tuple[float | None, float]]:
    """Return pairs of numbers (before, after), zero where they are nothing but rounding."""
    old = (
        [None] * len(after)
        if before is None
        else without_rounding(before, size).tolist()
    )
    return list(zip(old, without_rounding(after, size).tolist()))


def without_rounding(values: Array, size: Array | float) -> Array:
    """Return numbers, zero where they are nothing but rounding beside ``size``."""
    return np.where(np.abs(values) < _NOTHING * size, 0.0, values)


def asked_rows(result: Result) -> list[BeforeAfter]:
    """Return the rows of a payload, or of the terminal link with its joint's friction."""
    body = result.body
    first, *rest = theta_rows(body)
    place = list(_com_rows(body))
    if result.payload is None:
        return [first, *place, *rest, *_friction_rows(result)]
    return [first, *place, *(_inertia_rows(body) if place else [])]


def _com_rows(body: BodyEstimate) -> Iterator[BeforeAfter]:
    """Yield the centre of mass where its error is known, or none is stated."""
    errors = load_errors(body)[1:4]
    if not np.all(np.isfinite(errors)):
        return
    length = max(spatial.characteristic_length(body.inertial.theta), _LEAST)
    pairs = _from_to(
        None if body.prior is None else body.prior.com, body.inertial.com, length
    )
    for axis, pair, error in zip("xyz", pairs, errors.tolist()):
        yield BeforeAfter(f"centre of mass {axis}", *pair, error or None, "m")


def _inertia_rows(body: BodyEstimate) -> Iterator[BeforeAfter]:
    """Yield the inertia about the centre of mass; none where it is not known."""
    errors = load_errors(body)[4:]
    about = spatial.six_from_symmetric(body.inertial.inertia_com)
    for name, error, value in zip(INERTIA, errors.tolist(), about.tolist()):
        if np.isfinite(error):
            yield BeforeAfter(
                f"inertia {name[1:]} about it", None, value, error, "kg·m²"
            )


def _friction_rows(result: Result) -> Iterator[BeforeAfter]:
    joint = result.robot.terminal_joint
    estimate = result.estimate
    model = result.joints[joint].model_terms if joint in result.joints else {}
    for term, words in (
        ("coulomb", "Coulomb friction"),
        ("viscous", "viscous friction"),
    ):
        value = estimate.value(f"{term}[{joint}]")
        if value is not None:
            error = estimate.error(f"{term}[{joint}]") if result.is_measured else None
            after = float(without_rounding(np.array(value), 1.0))
            unit = term_unit(term, joint in result.robot.slides)
            yield BeforeAfter(words, model.get(term), after, error, unit)


def friction_text(
    term: str, before: float | None, after: float, error: float | None, unit: str
) -> str:
    """Return one friction term of a joint, such as "coulomb 0.4 -> 0.133 ± 0.004 N·m"."""
    if error is not None and np.isinf(error):
        return f"{term} not visible"
    old = "" if before is None else f"{number_text(before)} -> "
    if error is not None and np.isnan(error):
        return f"{term} {old}{number_text(after)} (held at its bound)"
    return f"{term} {old}{with_error(after, error, unit)}"
