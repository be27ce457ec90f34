"""What the command line prints of a result, and what limits it, read off its own figures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robot_sysid.dynamics.friction import friction_model
from robot_sysid.dynamics.nuisances import TILT_NAMES
from robot_sysid.dynamics.spatial import PARAMETER_NAMES, characteristic_length, parameter_scale
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.write_back import plan_write_back
from robot_sysid.records import DELAY_NAME, Array
from robot_sysid.records.figures import THETA, figure, percent, term_unit, with_error
from robot_sysid.results.cards import NOT_KNOWN, load_errors
from robot_sysid.results.record import BaseParameters, BodyEstimate, Payload, Result
from robot_sysid.results.rollout import rollout_lines
from robot_sysid.results.tables import asked_rows, friction_text, link_rows, shown, table_lines

if TYPE_CHECKING:
    from robot_sysid.damiao.trajectory import DamiaoExportReport

UNKNOWN = 0.5
"""Relative error of a mass from which on it is not known: two of them reach zero."""
_NAMED = 3
"""Bodies of a link that are named; more make a line too long."""
_ROUNDING = 1e-9
"""Friction below this is nothing [N m]."""
_SMALL = 0.05
"""Causes below this share of the whole error are not listed: they change it by 0.1 %."""
_CLOSE = 0.1
"""Difference, relative to the file's error, up to which the fit's is no news."""
WEAK = 0.1
"""Standard error, relative to a body of this mass and size, above which a parameter is weak: a
tenth, as docs/measurements.md says."""
COLOURED = 0.3
"""Share of independent samples below which residuals are called correlated in time: errors are
1 / sqrt(0.3) = 1.8 times those of white noise then."""
WORSE = 1.5
"""Held-out error over fitted error above which the model, not noise, is the limit: noise alone
differs by percents between stretches of hundreds of samples."""
PRIOR_SHARE = 0.5
"""Share of the data in a value below which the model has more say."""
SURE = 3.0
"""Standard errors from zero beyond which a sign is sure: noise passes it once in 700 times."""
_EARLY = 2.0
"""Standard errors before zero beyond which a delay is called early: once in 44 times by noise."""


def result_lines(result: Result, links: bool = False, verbose: bool = False) -> list[str]:
    """Return all that is printed of a result: ``block_lines``, then ``more_lines``."""
    return [*block_lines(result), *more_lines(result, links, verbose)]


def block_lines(result: Result) -> list[str]:
    """Return the block "Identified parameters: ..." or "Identified payload ..." line by line."""
    if result.payload is not None:
        rows, payload = asked_rows(result), result.payload
        ball = [f"  {NOT_KNOWN}"]
        unseen = len(rows) > 1 and not np.all(payload.body.shown)
        heading = f"Identified payload, in the frame of {payload.flange.name}:"
        return [heading, *table_lines(rows), *(ball if unseen else [])]
    estimate, joint = result.estimate, result.joint_name
    theta, slides = shown(estimate.inertial.theta), joint in result.slides
    moment, inertia = (_listed(values) for values in (theta[1:4], theta[4:]))
    friction = [(term, estimate.value(f"{term}[{joint}]")) for term in ("coulomb", "viscous")]
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


def more_lines(result: Result, links: bool = False, verbose: bool = False) -> list[str]:
    """Return what stands under that block; ``verbose`` adds what only an expert reads."""
    return [
        *_tables(result, links),
        *_causes(result.body),
        *([] if result.payload is None else _payload_lines(result.payload)),
        *(_joint_lines(result) if result.is_measured else []),
        *_sensor_lines(result),
        *_error_lines(result),
        *([] if result.rollout is None else rollout_lines(result.rollout, verbose)),
        *_verdict_lines(result),
        *(f"  Limit: {sentence}" for sentence in limitations(result)),
        *(_details(result) if verbose else []),
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
    return f"{value:.1g}" if rounded == 0.0 and abs(value) > _ROUNDING else f"{rounded:.2f}"


def _tables(result: Result, links: bool) -> Iterator[str]:
    causes = ", ".join(["noise", *result.body.budget])
    if links and result.links:
        yield f"Links, before -> after, ± one standard error of all causes ({causes}), body axes:"
        yield from table_lines(link_rows(result))
    elif result.payload is None:
        yield from _mass_line(result)
        errors = f", ± one standard error of all causes ({causes})"
        yield f"Before -> after{errors if result.is_measured else ''}:"
        yield from table_lines(asked_rows(result))


def _mass_line(result: Result) -> Iterator[str]:
    names = [body.name for body in result.bodies if body.theta[0] > 0.0]
    if len(names) < 2 or result.bodies[0].name not in names:
        return
    rest = len(names) - _NAMED
    told = names if rest < 2 else [*names[:_NAMED], f"{rest} more"]
    found = result.estimate.inertial.theta
    line = f"The mass is that of {' + '.join(told)} = {found[0]:.4g} kg"
    try:
        plan = plan_write_back(
            found if result.file is None else result.file.thetas[-1], result.bodies
        )
    except ExportError:
        yield line
        return
    lumped = [body.name for body in plan.lumped]
    alone = " + ".join([names[0], *lumped]) + (" together" if lumped else " alone")
    yield f"{line}; {alone}, as written in the file: {plan.theta[0]:.4g} kg"


def _causes(body: BodyEstimate) -> Iterator[str]:
    parts = {"noise": body.noise_errors[0], **{k: part[0] for k, part in body.budget.items()}}
    least = _SMALL * float(body.errors[0])
    named = sorted((item for item in parts.items() if item[1] > least), key=lambda i: -i[1])
    if np.isfinite(least) and named:
        yield "Error of the mass by cause, kg: " + ", ".join(f"{k} {v:.2g}" for k, v in named)


def _payload_lines(payload: Payload) -> Iterator[str]:
    for words, body in (("without", payload.link), ("with", payload.total)):
        mass, *errors = load_errors(body)[:4].tolist()
        com = ", ".join(map(with_error, body.inertial.com.tolist(), errors))
        total = with_error(body.inertial.mass, mass, "kg")
        yield f"Terminal link {words} it: {total}, centre of mass [{com}] m"
    if payload.scatter:
        yield "Mass according to each recording alone (± noise):"
    for one in payload.scatter:
        kind = "loaded" if one.is_loaded else "empty"
        yield f"  {one.name} ({kind}): {with_error(one.mass, one.noise_error, 'kg')}"
    if payload.torque_scale and payload.known_mass is not None:
        yield (
            f"Torque scales by the known mass of {payload.known_mass:g} kg (what the log reads "
            "over what is there, 95 % interval):"
        )
    for joint, (scale, error) in payload.torque_scale.items():
        yield f"  {joint}: {scale:.4f} [{scale - 1.96 * error:.4f}, {scale + 1.96 * error:.4f}]"


def _joint_lines(result: Result) -> Iterator[str]:
    motors = {f"motor that turns with {name}": each for name, each in result.couplings.items()}
    owners = {**result.joints, **motors}
    if any(joint.terms for joint in owners.values()):
        yield f"Friction of the joints ({result.friction_model}), model -> identified ± error:"
        for name, joint in owners.items():
            slides = name in result.slides
            terms = ", ".join(
                friction_text(term, joint.before.get(term), *found, term_unit(term, slides))
                for term, found in joint.terms.items()
            )
            yield f"  {name}: {terms or 'not shown by these logs'}"


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
    fits, file, told = result.validation, result.file, set()
    if file is not None:
        own = {test.source: test for test in reversed(fits[1:])}
        tests = [("held-out data", file.before, file.after, fits[0] if fits else None)]
        tests += [(old.source, old, new, own.get(old.source)) for old, new in file.others]
        for on, before, after, fit in tests:
            shares = [None if t is None else t.relative_error for t in (before, after, fit)]
            known = [percent(each) for each in shares[:2] if each is not None]
            line = f"Torque error of the model on {on}: {' -> '.join(known) or 'not known'}"
            new, fitted = shares[1:]
            if new is not None and fitted is not None and abs(fitted - new) > _CLOSE * new:
                line += f"; the fit itself reaches {percent(fitted)}"
            yield line
        told = {before.source for before, _ in file.others}
    for test in fits if file is None else fits[1:]:
        if test.source not in told:
            share = "" if test.relative_error is None else f" ({percent(test.relative_error)})"
            yield f"Validation on {test.source}: {test.rmse:.4f} N·m{share}"
    if file is not None and file.kept:
        yield f"Left in the file as it was: {', '.join(file.kept)}"


def _verdict_lines(result: Result) -> Iterator[str]:
    unseen = result.estimate.identifiability.unidentifiable
    # Of measured data, the limits of the result tell it.
    if not result.is_measured and unseen:
        yield f"  Not visible in these torques, kept from the model: {'; '.join(unseen)}"
    yield f"Result: {result.verdict.value}"
    share, body = result.known_to, result.body
    if share is not None and share < UNKNOWN:
        yield f"The mass is known to {percent(share)}"
    elif result.is_measured and not np.isfinite(body.errors[0]):
        yield "The mass is not known: these torques do not show it"
    elif result.is_measured:
        mass = with_error(body.inertial.mass, float(body.errors[0]), "kg")
        yield f"The mass is not known: {mass} does not tell it from zero"
    yield from (f"  Problem: {reason}" for reason in result.reasons)


def _details(result: Result) -> Iterator[str]:
    estimate = result.estimate
    scaled = estimate.identifiability.scaled_condition_number
    yield f"  Condition number, columns scaled: {scaled:.1f}"
    yield "  RMSE per joint:"
    for joint, value in estimate.rmse_per_joint.items():
        noise = estimate.noise_per_joint.get(joint)
        yield f"    {joint}: {value:.2e} N·m" + ("" if noise is None else f", noise {noise:.2g}")
    if result.is_measured:
        named = zip(estimate.names, result.body.noise_errors, THETA)
        listed = ", ".join(f"{name} {error:.2g} {unit}" for name, error, unit in named)
        yield f"  Standard errors of noise alone: {listed}"
    if result.sensors:
        yield "  Sensors:"
    for name, (value, error) in result.sensors.items():
        held = math.isnan(error)
        yield f"    {name}: {f'{figure(value)} (held)' if held else with_error(value, error)}"
    for joint, each in result.joints.items():
        if each.candidates:
            tried = sorted(each.candidates.items(), key=lambda item: item[1])
            listed = ", ".join(f"{model} {error:.4g}" for model, error in tried)
            yield f"  Held-out error of {joint} by friction model, N·m: {listed}"
    yield from [] if result.base is None else _base_lines(result.base)


def _base_lines(base: BaseParameters) -> Iterator[str]:
    yield (
        f"  Base parameters of all links: {base.rank} of {base.structural_rank} that any motion "
        f"can show; {sum(base.essential)} of them essential to these logs"
    )
    rows = zip(base.combinations, base.values, base.standard_errors, base.essential)
    for words, value, error, kept in rows:
        yield f"    {with_error(value, error)} = {words}{'' if kept else ' (not essential)'}"


def clamping_lines(report: DamiaoExportReport | None, joints: Sequence[str]) -> list[str]:
    """Return what the Damiao export did, or nothing where there was none."""
    if report is None:
        return []
    shares = zip(joints, report.joints, report.clamped_percent)
    return [
        "Damiao export, clamped to motor limits:",
        *(f"  {joint} ({motor.motor_type}): {share:.1f} %" for joint, motor, share in shares),
        *(f"  {warning}" for warning in report.warnings),
    ]


def folder_text(folder: Path) -> str:
    """Return a folder as the user would type it, with a trailing slash: ./sysid_output/."""
    text = folder.as_posix()
    prefix = "" if folder.is_absolute() or text.startswith(".") else "./"
    return f"{prefix}{text}/" if text != "." else "./"


_CONFLICTS = {
    "links": "the model's numbers of other links do not fit this arm",
    "torque scale": "the scale of the torques does not fit the model",
    "joint offsets": "zero positions of joints do not fit the model",
    "gravity": "the base is not level as in the model",
    "friction model": "the joints' friction follows another law than the one that was fitted",
}


def limitations(result: Result) -> tuple[str, ...]:
    """Return one sentence per thing that limits the accuracy of a result."""
    return tuple(_sentences(result)) if result.is_measured else ()


def _sentences(result: Result) -> Iterator[str]:
    estimate, body = result.estimate, result.body
    if estimate.identifiability.unidentifiable:
        listed = "; ".join(estimate.identifiability.unidentifiable)
        yield f"not visible in these torques, kept from the model: {listed}"
    yield from _weak(body)
    rows = zip(PARAMETER_NAMES, body.data_share, body.shown)
    names = [name for name, share, seen in rows if seen and share < PRIOR_SHARE]
    if names:
        yield f"more model than data in {', '.join(names)}: the prior outweighs the torques there"
    yield from _conflicts(result)
    sought = result.sensors.get(DELAY_NAME)
    if result.delay is not None and sought is not None and result.delay < -_EARLY * sought.error:
        # No sensor reads a torque before the motion it belongs to.
        yield (
            f"the torque seems to come {-1e3 * result.delay:.2g} ms before the motion: the "
            "positions are late, or friction turns earlier than the speed does; trust neither"
        )
    yield from _negative_friction(result)
    yield from _beyond_noise(result)
    if estimate.constrained:
        yield (
            "the plain estimate was no possible rigid body, so the best possible one was taken; "
            "the errors above allow for how far it was moved"
        )


def _weak(body: BodyEstimate) -> Iterator[str]:
    theta = body.inertial.theta
    scale = parameter_scale(max(float(theta[0]), 1e-9), characteristic_length(theta))
    relative = body.errors / scale
    weak = [k for k in np.argsort(-relative) if np.isfinite(relative[k]) and relative[k] > WEAK]
    if weak:
        listed = ", ".join(f"{PARAMETER_NAMES[k]} (± {percent(relative[k])})" for k in weak)
        yield (
            f"weakly seen, in percent of what a body of this mass and size has: {listed}; move "
            "faster, wider or longer (robot-sysid plan designs such a motion)"
        )


def _conflicts(result: Result) -> Iterator[str]:
    for conflict in result.conflicts:
        cause = _CONFLICTS.get(conflict.cause, f"{conflict.cause}: not as was thought")
        allowed = (
            f": they are {conflict.asked:.2g} times as far off as was allowed, and the errors "
            "above were widened for it"
        )
        allowed = allowed if conflict.scale > 1.0 else "; the errors above allow for that"
        yield f"{cause} (most: {', '.join(conflict.members[:3])}){allowed}"


def _negative_friction(result: Result) -> Iterator[str]:
    clear, given = [], False
    for name, joint in result.joints.items():
        model = friction_model(joint.friction_model)
        bounded = {term for term, bound in zip(model.terms, model.non_negative) if bound}
        for term, (value, error) in joint.terms.items():
            if term in bounded and value < -SURE * error:
                clear.append(f"{term} {value:.2g} of {name}")
                given = given or not joint.candidates
    if clear:
        other = ", or let --friction-model auto choose other terms" if given else ""
        yield (
            f"friction that drives instead of brakes ({', '.join(clear)}): check the sign and the "
            f"scale of these torques{other}"
        )


def _beyond_noise(result: Result) -> Iterator[str]:
    """Tell where residuals are more than noise: correlated in time, or larger on other data."""
    estimate = result.estimate
    slow = [name for name, share in estimate.independent_share.items() if share < COLOURED]
    if slow:
        yield (
            f"residuals of {', '.join(slow)} are correlated in time: slow noise, or something that "
            "the model lacks; the errors above allow for it"
        )
    for test in result.validation:
        if test.rmse > WORSE * estimate.rmse:
            yield (
                f"torques of {test.source} are predicted {test.rmse / estimate.rmse:.1f} "
                "times worse than the fitted ones: the model misses something that motion shows"
            )
