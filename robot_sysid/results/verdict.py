"""The verdict on a result in one line, and its limitations: for console, report and params.json.

The line says whether to use the result, how much better it is than the model before, and what
limits it. What to do next is in ``next_steps``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from robot_sysid.records import Validation
from robot_sysid.records.messages import percent
from robot_sysid.results.record import BodyEstimate, Result, Verdict

UNKNOWN = 0.5
"""Relative standard error from which on a mass is not known: two such errors reach zero."""
WORSE = 1.5
"""Held-out error over fitted error above which the model limits the prediction, not noise, which
differs by percents only between stretches of hundreds of samples."""
PRIOR_SHARE = 0.5
"""Share of a value that comes from the data below which the model's prior dominates."""
_USE_TEXTS = {
    Verdict.TORQUES_ONLY: "Only for torques of motions like the log's, not for the numbers",
    Verdict.AS_GOOD: "Usable, but the model was about as good before",
    Verdict.PARTLY_FROM_MODEL: "Usable (not identifiable, model's values kept: {unseen})",
    Verdict.INERTIA_NOT_KNOWN: "Usable for mass and centre of mass (the inertia is not known)",
}
"""Verdict to the sentence on the result's use, where that is not "Usable"."""
_CAUSE_TEXTS = {
    "links": "the other links' parameters",
    "torque scale": "the torque scales",
    "common torque scale": "the common scale of torques and masses",
}
"""Cause of error, as in params.json, to its name in a sentence, where that is another one."""


def verdict_line(result: Result, failure: str | None = None) -> str:
    """Return one line: whether to use a result, how good it is, and what limits it.

    Args:
        result: result to judge.
        failure: why a result that is usable in itself must not be used; None where there is no such
            reason.
    """
    failure = refusal(result) or failure
    if failure is not None:
        return f"Not usable: {failure}"
    unseen = ", ".join(result.estimate.identifiability.unidentifiable)
    if not result.is_measured:
        use = (
            "Self-test passed: the model's own numbers came back from its own simulation, which "
            "says nothing of the real arm"
        )
        return use + (f" (not identifiable: {unseen})" if unseen else "")
    use = _USE_TEXTS.get(result.verdict, "Usable").format(unseen=unseen)
    return f"{use}: {'; '.join(_improvements(result))}"


def plan_verdict(failure: str | None, shortfall: str, conditions: Sequence[str]) -> str:
    """Return one line: whether to play a planned motion.

    Args:
        failure: why the motion must not be run; None where it may.
        shortfall: why the motion does not serve its purpose, though it keeps all limits; "" where
            it does.
        conditions: what has to be done before it is played, each with its reason.
    """
    if failure is not None:
        return f"Not usable: {failure}"
    if shortfall:
        return f"Not ready: {shortfall}"
    if conditions:
        return f"Usable once {', and once '.join(conditions)}"
    return "Usable: play it on the arm, slowly at first, and record it"


def plan_conditions(
    contact: str | None, n_unguarded: int, n_links: int, lacks_meshes: bool
) -> list[str]:
    """Return what has to be done before a motion is played, each with its reason.

    Args:
        contact: what the straight way from the model's pose to the start comes too near to, if
            anything.
        n_unguarded: number of moving links without collision geometry.
        n_links: number of moving links.
        lacks_meshes: whether collision meshes of the model were left out.
    """
    conditions = []
    if contact is not None:
        conditions.append(
            "the arm has been brought to the start of this motion another way: the straight way "
            f"from the model's pose at rest is not free, by the clearance of {contact}"
        )
    if n_unguarded:
        remedy = "watch it in a viewer that shows them"
        if lacks_meshes:
            meshes = "--mesh-dir FOLDER, the folder of its meshes (STL or OBJ)"
            remedy = f"plan again with {meshes}, or {remedy}"
        conditions.append(
            f"contacts have been checked: without collision geometry, {n_unguarded} of {n_links} "
            f"moving links may touch anything; {remedy}"
        )
    return conditions


def refusal(result: Result) -> str | None:
    """Return why neither a model nor a card is written, or None where the result may be used."""
    if result.failure is None:
        return None
    missing = "no model was"
    if result.payload is not None:
        missing = "no model and no card were"
        if result.payload.known_mass is not None:
            missing = "no torque scales were"
    return f"{missing} written: {result.failure}"


def before_after_text(before: Validation, after: Validation | None) -> str:
    """Return the relative errors of two models as text, such as "27 % -> 0.3 %".

    An error that is not known is left out, "not known" stands for both.
    """
    errors = [test.relative_error for test in (before, after) if test is not None]
    texts = [percent(error) for error in errors if error is not None]
    return " -> ".join(texts) or "not known"


def _improvements(result: Result) -> Iterator[str]:
    """Yield phrases on the torque error before and after, and on the error of the mass."""
    if result.file is not None:
        shares = before_after_text(
            result.file.validation_before, result.file.validation_after
        )
        # A payload is part of both models: the change is that of links and friction.
        load = "" if result.payload is None else " with the payload"
        yield f"torque error{load} on held-out data {shares}"
    if result.payload is not None and result.payload.known_mass is not None:
        yield "torque scales follow from the known mass"
        return
    share = result.relative_mass_error
    mass = "the mass is not identifiable by itself"
    if share is not None:
        mass = f"the mass is known to {percent(share)}"
        if share >= UNKNOWN:
            mass = f"the mass is not known (± {percent(share)})"
    cause = largest_cause(result.body)
    yield f"{mass}, limited by {cause_text(cause)}" if cause else mass


def cause_text(cause: str) -> str:
    """Return the name of a cause of error as it stands in a sentence."""
    return _CAUSE_TEXTS.get(cause, cause)


def largest_cause(body: BodyEstimate) -> str:
    """Return the cause of the largest part of a mass's error, or "" where that is not known."""
    causes = body.mass_causes
    if not np.all(np.isfinite([body.errors[0], *causes.values()])):
        return ""
    return max(causes, key=lambda cause: causes[cause], default="")


def limitations(result: Result) -> Iterator[str]:
    """Yield sentences on torques that are predicted worse than the fitted ones.

    There is none of the model's own simulation.
    """
    if not result.is_measured:
        return
    estimate = result.estimate
    # The residual of exact data may be far below the least noise that a fit assumes.
    joint_noise = list(estimate.noise_per_joint.values()) or [0.0]
    noise = np.sqrt(np.mean(np.square(joint_noise)))
    for test in result.validation:
        if test.rmse > max(WORSE * estimate.rmse, noise):
            reason = "the model misses something that motion shows"
            if not test.is_informative:
                reason = (
                    "as expected, because the fitted logs hold too little of this motion (some "
                    "joints hardly move in them); fit a log that moves like it"
                )
            yield (
                f"torques of {test.source} are predicted {test.rmse / estimate.rmse:.1f} "
                f"times worse than the fitted ones: {reason}"
            )
