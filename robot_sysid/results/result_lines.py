"""The lines that the command line prints of a result, and its table of numbers before -> after."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.inverse_dynamics import TILT_NAMES
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.inertial import plan_write_back
from robot_sysid.records import DELAY_NAME, Array, Validation
from robot_sysid.records.messages import (
    PARAMETER_UNITS,
    Detail,
    aligned_lines,
    number_text,
    percent,
    term_unit,
    with_error,
)
from robot_sysid.results.cards import INERTIA, NOT_KNOWN, load_errors
from robot_sysid.results.record import (
    BaseParameters,
    BodyEstimate,
    JointEstimate,
    Payload,
    Quantity,
    Result,
    RolloutTest,
)
from robot_sysid.results.verdict import before_after_text, limitations, verdict_lines

if TYPE_CHECKING:
    from robot_sysid.damiao.trajectory import DamiaoExportReport

_MAX_BODY_NAMES = 3
"""Number of bodies of a link that are named; more make a line too long."""
_FRICTION_ROUNDING = 1e-9
"""Friction below which a number is rounding error [N m]."""
_MIN_CAUSE_SHARE = 0.05
"""Share of the standard error below which a cause is not listed: it changes the error by 0.1 %."""
_BLOCK_ROWS = ("CoM moment", "inertia")
"""Starts of the rows of the table whose values stand in the block already."""
_FIT_GAIN = 0.1
"""Relative difference between torque errors of fit and file up to which the fit's is left out."""


def result_lines(result: Result, links: bool = False) -> list[str]:
    """Return the lines that the command line prints of a result without --verbose.

    Args:
        result: what to print.
        links: whether the table shows mass and first moment of every link.
    """
    lines = (*block_lines(result), *more_lines(result, links), *verdict_lines(result))
    return [line for line in lines if not isinstance(line, Detail)]


def block_lines(result: Result) -> list[str]:
    """Return the block "Identified parameters: ..." or "Identified payload ..." line by line."""
    if result.payload is not None:
        rows = parameter_rows(result)
        lines = [f"Identified payload, in the frame of {result.payload.flange.name}:"]
        lines += table_lines(rows)
        if len(rows) > 1 and not np.all(result.payload.body.is_determined):
            lines.append(f"  {NOT_KNOWN}")
        return lines
    estimate = result.estimate
    joint = result.robot.terminal_joint
    is_slide = joint in result.robot.slides
    theta = without_rounding(estimate.inertial.theta, estimate.inertial.scale)
    lines = [
        "Identified parameters:",
        f"  Mass: {_decimals_text(theta[:1])} kg",
        f"  CoM moment: [{_decimals_text(theta[1:4])}] kg·m",
        f"  Inertia: [{_decimals_text(theta[4:])}] kg·m²",
    ]
    coulomb = estimate.value(f"coulomb[{joint}]")
    viscous = estimate.value(f"viscous[{joint}]")
    if coulomb is not None and viscous is not None:
        lines += [
            f"  Coulomb friction: {_friction_text(coulomb)} {term_unit('coulomb', is_slide)}",
            f"  Viscous friction: {_friction_text(viscous)} {term_unit('viscous', is_slide)}",
        ]
    return [
        *lines,
        f"  RMSE: {estimate.rmse:.4f} N·m",
        f"  Condition number: {estimate.identifiability.condition_number:.1f}",
        f"  Base parameters: {estimate.identifiability.rank}",
    ]


def more_lines(result: Result, links: bool = False) -> list[str]:
    """Return the lines below the block; those for --verbose only are ``Detail``.

    Args:
        result: what to print.
        links: whether the table shows mass and first moment of every link.
    """
    lines = list(_table_of_result(result, links))
    if result.payload is not None:
        lines += _payload_lines(result.payload)
    lines += _sensor_lines(result)
    lines += _validation_lines(result)
    if result.rollout is not None:
        lines += rollout_lines(result.rollout)
    # A limitation that is a Detail stays one.
    lines += [type(text)(f"  Limit: {text}") for text in limitations(result)]
    if result.file is not None and result.file.unchanged:
        unchanged = ", ".join(result.file.unchanged)
        lines.append(Detail(f"Left in the file as it was: {unchanged}"))
    return [*lines, *map(Detail, _detail_lines(result))]


def _decimals_text(values: Array) -> str:
    """Return numbers with three decimals; if all are below 0.01, with two digits of the largest."""
    largest = float(np.max(np.abs(values)))
    is_small = 0.0 < largest < 0.01
    decimals = 1 - math.floor(math.log10(largest)) if is_small else 3
    return ", ".join(f"{value:.{decimals}f}" for value in values)


def _friction_text(value: float) -> str:
    """Return a number with two decimals, or with one significant digit instead of 0.00."""
    # Adding zero turns the -0.00 that rounding leaves into 0.00.
    rounded = round(value, 2) + 0.0
    is_hidden = rounded == 0.0 and abs(value) > _FRICTION_ROUNDING
    return f"{value:.1g}" if is_hidden else f"{rounded:.2f}"


def _table_of_result(result: Result, links: bool) -> Iterator[str]:
    """Yield the lines of the table before -> after, ``Detail`` if the block has their numbers.

    It shows the terminal link, or every link with ``links``; nothing for a payload or a self-test.
    """
    if not result.is_measured or result.payload is not None:
        return
    yield from _mass_lines(result)
    rows = parameter_rows(result)
    if links and result.links:
        rows = []
        for body in result.links:
            for row in theta_rows(body)[:4]:
                rows.append(replace(row, name=f"{body.name} {row.name}"))
    heading, *lines = table_lines(rows, "Before -> after")
    yield heading
    for row, line in zip(rows, lines):
        is_in_block = any(start in row.name for start in _BLOCK_ROWS)
        yield Detail(line) if is_in_block else line


def _mass_lines(result: Result) -> Iterator[str]:
    """Yield a line on the bodies that share the mass of the terminal link, where there are several.

    It says how much of the mass is written to the terminal body of the file.
    """
    bodies = result.robot.bodies
    names = [body.name for body in bodies if body.theta[0] > 0.0]
    if len(names) < 2 or bodies[0].name not in names:
        return
    listed = names
    if len(names) > _MAX_BODY_NAMES + 1:
        listed = names[:_MAX_BODY_NAMES]
        listed.append(f"{len(names) - _MAX_BODY_NAMES} more")
    line = f"The mass is that of {' + '.join(listed)}"
    theta = result.estimate.inertial.theta
    if result.file is not None:
        theta = result.file.thetas[-1]
    try:
        plan = plan_write_back(theta, bodies)
    except ExportError:
        yield line
        return
    bodies_text = " + ".join([names[0], *(body.name for body in plan.emptied)])
    written = f"{bodies_text} {'together' if plan.emptied else 'alone'}"
    yield f"{line}; {written}, as written in the file: {plan.theta[0]:.4g} kg"


def _payload_lines(payload: Payload) -> Iterator[str]:
    """Yield lines on the link without and with a payload, single recordings and torque scales."""
    for preposition, body in (("without", payload.link), ("with", payload.total)):
        mass_error, *com_errors = load_errors(body)[:4].tolist()
        com = ", ".join(map(with_error, body.inertial.com.tolist(), com_errors))
        mass = with_error(body.inertial.mass, mass_error, "kg")
        yield Detail(
            f"Terminal link {preposition} it: {mass}, centre of mass [{com}] m"
        )
    if payload.scatter:
        yield Detail("Mass according to each recording alone (± noise):")
    for recording in payload.scatter:
        side = "loaded" if recording.is_loaded else "empty"
        mass = with_error(recording.mass, recording.noise_error, "kg")
        yield Detail(f"  {recording.name} ({side}): {mass}")
    if payload.torque_scale and payload.known_mass is not None:
        yield (
            f"Torque scales by the known mass of {payload.known_mass:g} kg (what the log reads "
            "over what is there, 95 % interval):"
        )
    for joint, scale in payload.torque_scale.items():
        low, high = scale.interval
        yield f"  {joint}: {scale.value:.4f} [{low:.4f}, {high:.4f}]"


def _joint_lines(result: Result) -> Iterator[str]:
    """Yield the friction terms of each joint and of each motor that turns several joints."""
    owners = dict(result.joints)
    for name, motor in result.couplings.items():
        owners[f"motor that turns with {name}"] = motor
    if any(joint.terms for joint in owners.values()):
        yield f"Friction of the joints ({result.friction_model}), model -> identified ± error:"
        for name, joint in owners.items():
            is_slide = name in result.robot.slides
            texts = [_term_text(term, joint, is_slide) for term in joint.terms]
            yield f"  {name}: {', '.join(texts) or 'not shown by these logs'}"


def _term_text(term: str, joint: JointEstimate, is_slide: bool) -> str:
    """Return a friction term of a joint, such as "coulomb 0.4 -> 0.133 ± 0.004 N·m".

    Args:
        term: name of the term, such as "coulomb".
        joint: the estimate of the joint that has it.
        is_slide: whether the joint is a slide, which determines the unit.
    """
    value, error = joint.terms[term]
    prior = joint.model_terms.get(term)
    start = term if prior is None else f"{term} {number_text(prior)} ->"
    if math.isinf(error):
        text = f"{term} not visible"
    elif math.isnan(error):
        text = f"{start} {number_text(value)} (held at its bound)"
    else:
        text = f"{start} {with_error(value, error, term_unit(term, is_slide))}"
    other_day = joint.other_day_terms.get(term)
    if other_day is None or not math.isfinite(other_day.error):
        return text
    return f"{text} (on another day ± {number_text(other_day.error, other_day.error)})"


def _sensor_lines(result: Result) -> Iterator[str]:
    """Yield a line on the delay of the torque and one on the tilt of the base, where estimated."""
    sensors = result.sensors
    if result.delay is not None:
        error = sensors.get(DELAY_NAME, Quantity(0.0, 0.0)).error
        yield f"Delay of torque behind position: {1e3 * result.delay:.3f} ± {1e3 * error:.2g} ms"
    if result.tilt is not None:
        errors = [sensors[name].error for name in TILT_NAMES if name in sensors]
        error = math.degrees(math.hypot(*errors))
        yield f"Tilt of the base: {math.degrees(result.tilt):.3f} ± {error:.2g} degrees"


def _validation_lines(result: Result) -> Iterator[str]:
    """Yield lines on torque errors of data that was not fitted.

    They are errors of the written file on other logs; where there is no file, errors of the fit.
    """
    fits = result.validation
    file = result.file
    if file is None:
        yield from map(_fit_error_text, fits)
        return
    fit_by_source = {test.source: test for test in reversed(fits[1:])}
    if file.validation_after is not None and fits:
        # The verdict states this error of the file.
        yield from _fit_gain_lines("held-out data", file.validation_after, fits[0])
    for before, after in file.other_validations:
        source = before.source
        shares = before_after_text(before, after)
        yield f"Torque error of the model on {source}: {shares}"
        if source in fit_by_source:
            yield from _fit_gain_lines(source, after, fit_by_source[source])
    file_sources = [before.source for before, _ in file.other_validations]
    for test in fits[1:]:
        if test.source not in file_sources:
            yield _fit_error_text(test)


def _fit_error_text(test: Validation) -> str:
    """Return a line on the error of the fit on some data."""
    share = test.relative_error
    relative = "" if share is None else f" ({percent(share)})"
    return f"Validation on {test.source}: {test.rmse:.4f} N·m{relative}"


def _fit_gain_lines(source: str, file: Validation, fit: Validation) -> Iterator[Detail]:
    """Yield a line on the fit's torque error where it differs from that of the file.

    The file has fewer terms than the fit. Both errors are those on the data ``source``.
    """
    file_error = file.relative_error
    fit_error = fit.relative_error
    if file_error is None or fit_error is None:
        return
    if abs(fit_error - file_error) > _FIT_GAIN * file_error:
        yield Detail(
            f"The fit itself reaches a torque error of {percent(fit_error)} on {source}"
        )


def _detail_lines(result: Result) -> Iterator[str]:
    """Yield the lines that --verbose adds: errors by cause, residuals, sensors, friction models."""
    mass_error = float(result.body.errors[0])
    causes = result.body.mass_causes
    large = [c for c in causes if causes[c] > _MIN_CAUSE_SHARE * mass_error]
    if np.isfinite(mass_error) and large:
        large.sort(key=lambda cause: -causes[cause])
        listed = ", ".join(f"{cause} {causes[cause]:.2g}" for cause in large)
        yield f"Error of the mass by cause, kg: {listed}"
    if result.is_measured:
        yield from _joint_lines(result)
    estimate = result.estimate
    scaled = estimate.identifiability.scaled_condition_number
    yield f"  Condition number, columns scaled: {scaled:.1f}"
    yield "  RMSE per joint:"
    for joint_name, rmse in estimate.rmse_per_joint.items():
        noise = estimate.noise_per_joint.get(joint_name)
        noise_text = "" if noise is None else f", noise {noise:.2g}"
        yield f"    {joint_name}: {rmse:.2e} N·m{noise_text}"
    if result.is_measured:
        texts = []
        columns = (estimate.names, result.body.noise_errors, PARAMETER_UNITS)
        for name, error, unit in zip(*columns):
            if np.isfinite(error):
                texts.append(f"{name} {error:.2g} {unit}")
        yield f"  Standard errors of noise alone: {', '.join(texts)}"
    if result.sensors:
        yield "  Sensors:"
    for name, (value, error) in result.sensors.items():
        is_held = math.isnan(error)
        text = f"{number_text(value)} (held)" if is_held else with_error(value, error)
        yield f"    {name}: {text}"
    for name, joint in result.joints.items():
        if joint.candidates:
            candidates = sorted(joint.candidates.items(), key=lambda item: item[1])
            listed = ", ".join(f"{model} {error:.4g}" for model, error in candidates)
            yield f"  Held-out error of {name} by friction model, N·m: {listed}"
    if result.base is not None:
        yield from _base_lines(result.base)


def _base_lines(base: BaseParameters) -> Iterator[str]:
    """Yield a line on the number of base parameters, then one per base parameter."""
    yield (
        f"  Base parameters of all links: {len(base.values)} of {base.structural_rank} that any "
        f"motion can show; {sum(base.essential)} of them essential to these logs"
    )
    rows = zip(base.combinations, base.values, base.standard_errors, base.essential)
    for combination, value, error, is_essential in rows:
        note = "" if is_essential else " (not essential)"
        yield f"    {with_error(value, error)} = {combination}{note}"


def clamping_lines(
    report: DamiaoExportReport | None, joints: Sequence[str]
) -> list[str]:
    """Return what the Damiao export clamped of each joint's command, and its warnings.

    Nothing where there was no export. The joints are those of the report, in its order.
    """
    if report is None:
        return []
    lines = ["Damiao export, clamped to motor limits:"]
    for joint, motor, share in zip(joints, report.joints, report.clamped_percent):
        lines.append(f"  {joint} ({motor.motor_type}): {share:.1f} %")
    return [*lines, *map("  {}".format, report.warnings)]


def folder_text(folder: Path) -> str:
    """Return a folder as the user would type it, with a trailing slash: ./sysid_output/."""
    text = folder.as_posix()
    prefix = "" if folder.is_absolute() or text.startswith(".") else "./"
    return f"{prefix}{text}/" if text != "." else "./"


def rollout_lines(test: RolloutTest) -> Iterator[str]:
    """Yield the position errors of the old and the new model; those of single joints as details."""
    yield (
        f"Played on {test.held_out}: root mean square position error [rad or m], model before -> "
        "new model"
    )
    for error in test.errors:
        ratio = "" if error.ratio is None else f", {error.ratio:.3g} times"
        old_error, new_error = error.overall
        yield (
            f"  {error.loop}, {error.horizon:g} s ({error.windows} windows): {old_error:.3g} -> "
            f"{new_error:.3g}{ratio}"
        )
        joint_errors = zip(test.joint_names, error.errors_before, error.errors_after)
        for name, old_joint_error, new_joint_error in joint_errors:
            yield Detail(f"    {name}: {old_joint_error:.3g} -> {new_joint_error:.3g}")
    yield from map("  {}".format, test.notes)
    if test.errors:
        longest = test.errors[-1]
        texts = []
        for k in np.flatnonzero(longest.errors_after > longest.errors_before):
            ratio_of_joint = longest.errors_after[k] / longest.errors_before[k]
            name = test.joint_names[k]
            texts.append(f"{name} ({longest.loop}, {ratio_of_joint:.2g} times)")
        if texts:
            yield f"  worse than before over the longest horizon: {', '.join(texts)}"


LABELS: Mapping[str, str] = {
    "m": "mass",
    **{f"h{axis}": f"CoM moment {axis}" for axis in "xyz"},
    **{name: f"inertia {name[1:]}" for name in INERTIA},
}
"""Parameter name to its label in a table."""
HEADINGS = ("", "model", "identified", "±", "unit", "change")
"""Headings of the table of parameters, in the order of ``BeforeAfter.cells``."""
_RIGHT_ALIGNED = ("model", "identified", "±")
"""Headings of the columns whose cells are aligned to the right."""
_ROUNDING = 1e-9
"""Share of a body's scale below which a number is rounding error: models are written to 1e-9."""
_MIN_LENGTH = 1e-9
"""Length [m] in place of the characteristic length of a body without extent."""
_MAX_RELATIVE_CHANGE = 10.0
"""Relative change beyond which the change itself is stated, not a percentage."""
_ALL_DATA = 0.995
"""Share of the data that rounds to 100 %."""


@dataclass(frozen=True)
class BeforeAfter:
    """One number before and after an identification.

    Attributes:
        name: label of the row.
        before: the model's value; None where the model has none.
        after: the identified value.
        error: standard error of ``after``; infinite where it is not determined, None where none is
            stated.
        unit: unit of ``before``, ``after`` and ``error``.
        share: share of ``after`` that the data determines, 0 to 1; the model determines the other
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
        """How the value has changed, and how much of it comes from the model, as text of a cell."""
        partly = f"partly the model's (data {100.0 * self.share:.0f} %)"
        if self.error is None or np.isfinite(self.error):
            is_partly_prior = self.share < _ALL_DATA
            return self._difference + (f"; {partly}" if is_partly_prior else "")
        if self.share >= 1.0 - _ALL_DATA:
            return partly
        return "not seen: the model's" if self.after == self.before else "not seen"

    @property
    def _difference(self) -> str:
        """The change as a percentage where that is below 1000 %, else as a number."""
        if self.before is None:
            return ""
        difference = self.after - self.before
        if abs(difference) <= _ROUNDING * abs(self.before):
            return "none"
        if self.error is not None and abs(difference) <= self.error:
            return "within ±"
        ratio = difference / self.before if self.before else np.inf
        if self.before * self.after > 0.0 and abs(ratio) <= _MAX_RELATIVE_CHANGE:
            return f"{'+' if ratio > 0.0 else ''}{percent(ratio)}"
        sign = "+" if difference > 0.0 else ""
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


def theta_rows(body: BodyEstimate) -> list[BeforeAfter]:
    """Return the rows of the ten inertial parameters; an error of zero counts as not stated."""
    prior = None if body.prior is None else body.prior.theta
    rows = _number_rows(
        LABELS.values(),
        prior,
        body.inertial.theta,
        body.errors,
        PARAMETER_UNITS,
        body.inertial.scale,
    )
    shares = body.data_share.tolist()
    return [replace(row, share=share) for row, share in zip(rows, shares)]


def _number_rows(
    labels: Iterable[str],
    prior: Array | None,
    identified: Array,
    errors: Array,
    units: Iterable[str],
    scale: Array | float,
) -> list[BeforeAfter]:
    """Return the rows of m numbers before and after an identification.

    Args:
        labels: (m,) labels of the rows.
        prior: (m,) the model's values; None where it has none.
        identified: (m,) identified values.
        errors: (m,) their standard errors; one of zero counts as not stated.
        units: (m,) their units.
        scale: sizes (m,) of large values, or one size; far below it, a number is shown as zero.
    """
    values_before: list[float | None] = [None] * len(identified)
    if prior is not None:
        values_before = without_rounding(prior, scale).tolist()
    values_after = without_rounding(identified, scale).tolist()
    stated_errors = [error or None for error in errors.tolist()]
    columns = (labels, values_before, values_after, stated_errors, units)
    return list(map(BeforeAfter, *columns))


def without_rounding(values: Array, scale: Array | float) -> Array:
    """Return values, zero where they are below ``_ROUNDING`` times their scale.

    Args:
        values: numbers of any shape.
        scale: size of a large value, in the unit of the values and of a shape that fits theirs.
    """
    return np.where(np.abs(values) < _ROUNDING * scale, 0.0, values)


def parameter_rows(result: Result) -> list[BeforeAfter]:
    """Return the rows of a payload, or of the terminal link with its joint's friction."""
    body = result.body
    mass, *others = theta_rows(body)
    com = _com_rows(body)
    if result.payload is None:
        return [mass, *com, *others, *_friction_rows(result)]
    return [mass, *com, *(_inertia_rows(body) if com else [])]


def _com_rows(body: BodyEstimate) -> list[BeforeAfter]:
    """Return the rows of the centre of mass; none where its error is infinite."""
    errors = load_errors(body)[1:4]
    if not np.all(np.isfinite(errors)):
        return []
    length = max(spatial.characteristic_length(body.inertial.theta), _MIN_LENGTH)
    prior = None if body.prior is None else body.prior.com
    labels = map("centre of mass {}".format, "xyz")
    units = ["m"] * 3
    return _number_rows(labels, prior, body.inertial.com, errors, units, length)


def _inertia_rows(body: BodyEstimate) -> Iterator[BeforeAfter]:
    """Yield the elements of the inertia about the centre of mass whose errors are finite."""
    errors = load_errors(body)[4:].tolist()
    inertia = spatial.six_from_symmetric(body.inertial.inertia_com).tolist()
    for name, value, error in zip(INERTIA, inertia, errors):
        if np.isfinite(error):
            yield BeforeAfter(
                f"inertia {name[1:]} about it", None, value, error, "kg·m²"
            )


def _friction_rows(result: Result) -> Iterator[BeforeAfter]:
    """Yield Coulomb and viscous friction of the terminal joint, where estimated."""
    joint = result.robot.terminal_joint
    estimate = result.estimate
    is_slide = joint in result.robot.slides
    model = result.joints[joint].model_terms if joint in result.joints else {}
    labels = {"coulomb": "Coulomb friction", "viscous": "viscous friction"}
    for term, label in labels.items():
        value = estimate.value(f"{term}[{joint}]")
        if value is not None:
            error = estimate.error(f"{term}[{joint}]") if result.is_measured else None
            identified = float(without_rounding(np.array(value), scale=1.0))
            unit = term_unit(term, is_slide)
            yield BeforeAfter(label, model.get(term), identified, error, unit)
