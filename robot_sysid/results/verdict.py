"""The verdict on a result in two lines, which console, report and params.json share; its limits.

The first line says whether to use it, how much better it is than what was there, and what limits
it; the second what to type next.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from robot_sysid.dynamics.friction import friction_model
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.motion.plan_options import WEIGHT
from robot_sysid.records import DELAY_NAME, Source
from robot_sysid.records.file_access import (
    CARD_NAME,
    DAMIAO_NAME,
    MODEL_NAMES,
    plan_settings,
)
from robot_sysid.records.messages import Detail, percent
from robot_sysid.results.record import BodyEstimate, Result, Verdict

UNKNOWN = 0.5
"""Relative error of a mass from which on it is not known: two of them reach zero."""
LARGE = 0.02
"""Error of the mass, as a part of it, above which something is to be done about it: what
friction and sensors leave of it at best."""
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
_REMEDIES = {
    **dict.fromkeys(
        ("noise", "delay", "filtering"),
        "robot-sysid plan {model} (a wider, faster motion of all joints shows more)",
    ),
    "links": "robot-sysid plan {model} (a wider, faster motion of all joints shows more; after "
    "one, robot-sysid plan --for payload weighs what is bolted on)",
    "other links": "record the empty arm as long and as widely as the loaded one",
    **dict.fromkeys(
        ("torque scale", "common torque scale"),
        "robot-sysid payload {model} --empty LOG --loaded LOG --known-mass KG "
        "--save-torque-scale scale.json (then identify with --torque-scale scale.json)",
    ),
    "joint offsets": "calibrate the joints' zero positions",
    "gravity": "level the base, and say how well with --gravity-uncertainty",
    "friction model": "warm the arm up before recording",
}
"""Cause of error to what makes it smaller."""
_USES = {
    Verdict.TORQUES_ONLY: "Only for torques of motions like the log's, not for its numbers",
    Verdict.AS_GOOD: "Usable, but the model was about as good before",
    Verdict.PARTLY_FROM_MODEL: "Usable (not seen, so kept from the model: {unseen})",
    Verdict.INERTIA_NOT_KNOWN: "Usable for mass and centre of mass (the inertia is not known)",
}
_RECORDED = "robot-sysid identify {model} LOG (the log that was recorded)"
_AFTER_PLAN = {
    "arm": "robot-sysid identify {model} LOG --links (the log that was recorded)",
    "payload": "robot-sysid payload {model} --empty LOG --loaded LOG (without and with it)",
}
_CONFLICTS = {
    "links": "the model's numbers of other links do not fit this arm",
    "torque scale": "the scale of the torques does not fit the model",
    "joint offsets": "zero positions of joints do not fit the model",
    "gravity": "the base is not level as in the model",
    "friction model": "the joints' friction follows another law than the one that was fitted",
}


def two_lines(use: str, then: str) -> tuple[str, ...]:
    """Return the two lines: what comes of it, and what to do next."""
    return use, f"Next: {then}"


def verdict_lines(
    result: Result, failure: str | None = None, then: str = ""
) -> tuple[str, ...]:
    """Return one or two lines: whether to use a result, or why not (a failure, of a result that may
    be used for itself), and what to do next, unless ``then`` says it.
    """
    failure = refusal(result) or failure
    if failure is not None:
        return (f"Not usable: {failure}",)
    unseen = ", ".join(result.estimate.identifiability.unidentifiable)
    use = _USES.get(result.verdict, "Usable").format(unseen=unseen)
    if result.data.source is Source.ITSELF:
        came = "the model's own numbers came back from its own simulation"
        passed = f"Self-test passed: {came}, which says nothing of the real arm"
        passed += f" (not seen: {unseen})" if unseen else ""
        return two_lines(
            passed,
            f"{_command(result, 'robot-sysid plan {model}')} (a motion to record)",
        )
    return two_lines(f"{use}: {'; '.join(_gains(result))}", then or _next(result))


def plan_verdict(
    arm: Sequence[str],
    files: Sequence[Path],
    failure: str | None,
    purpose: str = "link",
    limits: Sequence[str] = (),
    shortfalls: Sequence[str] = (),
    remedy: str = "",
) -> tuple[str, ...]:
    """Return whether to play a motion planned for a purpose (``--for``), and what to do next.

    Args:
        arm: words of the command line that say which one it is.
        files: what was written.
        failure: why the motion must not be run, or None.
        limits: words of the command line that motors are to keep.
        shortfalls: what keeps the motion from its purpose, though it keeps all limits.
        remedy: the command that plans a motion for the purpose; "" where none is known.
    """
    if failure is not None:
        return (f"Not usable: {failure}",)
    then = _AFTER_PLAN.get(purpose, _RECORDED).format(model=shlex.join(arm))
    for path in files:
        if path.name == DAMIAO_NAME:
            words = (str(path), "--channel", "CHANNEL", "--model", *arm, *limits)
            then = f"robot-sysid motors check {shlex.join(words)}"
    if shortfalls:
        return two_lines(f"Not ready: {'; '.join(shortfalls)}", remedy or then)
    return two_lines("Usable: play it on the arm, slowly at first, and record it", then)


def command_after_weighing(folder: Path, model: Path, written: Path) -> str:
    """Return the command that plans the next motion, with the model that a weighing log led to.

    Args:
        folder: holds the settings of the plan whose motion was recorded.
        model: the model that was identified; the settings of another arm are not used.
        written: the model that the log has led to.

    Returns:
        "" where the recorded motion was not planned for weighing this arm.
    """
    settings = plan_settings(folder)
    if settings is None:
        return ""
    path, content = settings
    if content.get("for_") != WEIGHT or content.get("path") != str(model):
        return ""
    command = ["robot-sysid", "plan", str(written), "--config", str(path)]
    command += ["--for", "link", "--output-dir", str(folder / "planned")]
    return shlex.join(command)


def shortfalls_of_plan(
    body_name: str, mass_share: float | None, contact: str | None
) -> list[str]:
    """Return what keeps a motion from its purpose: a mass that stays unknown, a blocked way.

    Args:
        body_name: the body whose mass is asked for.
        mass_share: error that the mass will have, as share of it; None where it is not asked for.
        contact: what the way to the start comes too near to, or None.
    """
    shortfalls = []
    # A mass that no motion of these torques shows is another matter, which the plan's lines say.
    if mass_share is not None and UNKNOWN < mass_share < np.inf:
        shortfalls.append(
            f"after this motion the mass of {body_name} is known to {percent(mass_share)} only"
        )
    if contact is not None:
        shortfalls.append(
            "the straight way from the model's pose at rest to the start of this motion is not "
            f"free, by the clearance of {contact}; bring the arm to the start another way first"
        )
    return shortfalls


def refusal(result: Result) -> str | None:
    """Return why nothing but numbers is written, or None where the result may be used."""
    what = "no model was" if result.payload is None else "no model and no card were"
    if result.payload is not None and result.payload.known_mass is not None:
        what = "no torque scales were"
    return None if result.failure is None else f"{what} written: {result.failure}"


def _gains(result: Result) -> Iterator[str]:
    if result.file is not None:
        tests = (result.file.validation_before, result.file.validation_after)
        shares = [None if test is None else test.relative_error for test in tests]
        known = [percent(share) for share in shares if share is not None]
        yield f"torque error on held-out data {' -> '.join(known) or 'not known'}"
    if result.payload is not None and result.payload.known_mass is not None:
        yield "torque scales follow from the known mass"
        return
    share = result.relative_mass_error
    cause = largest_cause(result.body)
    known_to = "the mass alone is not known"
    if share is not None and share < UNKNOWN:
        known_to = f"the mass is known to {percent(share)}"
    yield known_to + (f", limited by {cause}" if cause else "")


def largest_cause(body: BodyEstimate) -> str:
    """Return the cause of most of a mass's error, or "" where it is not known."""
    causes = body.mass_causes
    known = np.isfinite(body.errors[0]) and np.isfinite(list(causes.values())).all()
    return max(causes, key=lambda cause: causes[cause]) if known else ""


def _next(result: Result) -> str:
    body = result.body
    payload = result.payload
    share = result.relative_mass_error
    if payload is not None and payload.known_mass is not None:
        return "give these scales to every later run with --torque-scale"
    cause = largest_cause(body)
    if cause in _REMEDIES and (share is None or share > LARGE):
        return _command(result, _REMEDIES[cause])
    if payload is not None:
        return f"copy {CARD_NAME} into the controller; it is in the frame of {payload.flange.name}"
    written = " or ".join(MODEL_NAMES.values())
    if result.file is not None and result.file.other_validations:
        return f"load {written} in place of {result.robot.path}"
    test = "robot-sysid identify {model} {log} --validation-measurements OTHER_LOG"
    return _command(result, test) + " (another motion tests the written model)"


def _command(result: Result, text: str) -> str:
    is_file = len(result.data.files) == 1 and result.data.files != ("-",)
    log = result.data.detail if is_file else "LOG"
    return text.format(model=shlex.quote(str(result.robot.path)), log=shlex.quote(log))


def limitations(result: Result) -> tuple[str, ...]:
    """Return one sentence per thing that limits the accuracy of a result.

    What a user has to know is a plain one; what the errors allow for already is a ``Detail``.
    """
    return tuple(_sentences(result)) if result.is_measured else ()


def _sentences(result: Result) -> Iterator[str]:
    estimate = result.estimate
    body = result.body
    if estimate.identifiability.unidentifiable:
        listed = "; ".join(estimate.identifiability.unidentifiable)
        yield Detail(f"not visible in these torques, kept from the model: {listed}")
    yield from map(Detail, _weak(body))
    rows = zip(PARAMETER_NAMES, body.data_share, body.is_determined)
    names = [name for name, share, seen in rows if seen and share < PRIOR_SHARE]
    if names:
        listed = ", ".join(names)
        yield Detail(
            f"more model than data in {listed}: the prior outweighs the torques there"
        )
    yield from _conflicts(result)
    sought = result.sensors.get(DELAY_NAME)
    if (
        result.delay is not None
        and sought is not None
        and result.delay < -_EARLY * sought.error
    ):
        # No sensor reads a torque before the motion it belongs to.
        yield (
            f"the torque seems to come {-1e3 * result.delay:.2g} ms before the motion: the "
            "positions are late, or friction turns earlier than the speed does; trust neither"
        )
    yield from _negative_friction(result)
    yield from _beyond_noise(result)
    if estimate.constrained:
        yield Detail(
            "the plain estimate was no possible rigid body, so the best possible one was taken; "
            "the errors allow for that"
        )


def _weak(body: BodyEstimate) -> Iterator[str]:
    relative = body.errors / body.inertial.scale
    weak = [
        k
        for k in np.argsort(-relative)
        if np.isfinite(relative[k]) and relative[k] > WEAK
    ]
    if weak:
        listed = ", ".join(
            f"{PARAMETER_NAMES[k]} (± {percent(relative[k])})" for k in weak
        )
        yield (
            f"weakly seen, in percent of what a body of this mass and size has: {listed}; move "
            "faster, wider or longer (robot-sysid plan designs such a motion)"
        )


def _conflicts(result: Result) -> Iterator[str]:
    for conflict in result.conflicts:
        cause = _CONFLICTS.get(conflict.cause, f"{conflict.cause}: not as was thought")
        said = f"{cause} (most: {', '.join(conflict.members[:3])})"
        off = (
            f"{conflict.deviation:.2g} times as far off as was allowed, and the errors were "
            "widened"
        )
        if conflict.scale > 1.0:
            yield f"{said}: they are {off} for it"
        else:
            yield Detail(f"{said}; the errors allow for that")


def _negative_friction(result: Result) -> Iterator[str]:
    clear = []
    given = False
    for name, joint in result.joints.items():
        model = friction_model(joint.friction_model)
        bounded = {
            term for term, bound in zip(model.terms, model.non_negative) if bound
        }
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
    slow = [
        name for name, share in estimate.independent_share.items() if share < COLOURED
    ]
    if slow:
        yield Detail(
            f"residuals of {', '.join(slow)} are correlated in time: slow noise, or something that "
            "the model lacks; the errors allow for it"
        )
    # Of exact data a fit may leave far less than what counts as its noise.
    noise = np.sqrt(
        np.mean(np.square(list(estimate.noise_per_joint.values()) or [0.0]))
    )
    for test in result.validation:
        if test.rmse > max(WORSE * estimate.rmse, noise):
            why = "the model misses something that motion shows"
            if not test.is_informative:
                why = "no worse than expected of motion that the fitted logs tell too little of, "
                why += "as of joints that hardly move in them; fit a log that moves like that"
            yield (
                f"torques of {test.source} are predicted {test.rmse / estimate.rmse:.1f} "
                f"times worse than the fitted ones: {why}"
            )
