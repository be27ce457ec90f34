"""Changes of a planned motion, or of what is known beforehand, and the errors expected after each.

All errors follow from ``expected_errors.predict_posterior``, the rule of the errors that a plan
states, so that they may be compared with these.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.consistent_bodies import projected_covariance
from robot_sysid.estimation.columns import PAYLOAD_NAMES
from robot_sysid.estimation.unknowns import LINKS, SCALES
from robot_sysid.motion.expected_errors import (
    RecordingPlan,
    predict,
    predict_posterior,
    prior_knowledge,
)
from robot_sysid.motion.information import (
    design_criterion,
    mass_and_centre_errors,
    random_information,
)
from robot_sysid.motion.prediction import LARGE_SHARE, Improvement, Prediction
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.records import Array, Motion, MotionPlan

LONGER = 4.0
"""Duration of the longer motion that is suggested, over that of the plan."""
FASTER = 1.5
"""Speed of the faster motion that is suggested, over that of the plan."""
BETTER_LINKS = 0.5
"""Share of the links' uncertainty that remains in the suggestion to know them better."""
KNOWN_MASS = 1.0
"""Mass of the weight from which torque scales are determined [kg]."""
_NO_NOISE = 1e-4
"""Torque noise so low that priors make nearly all of the errors [N m]."""
_LEAST_GAIN = 0.95
"""Error after a change, over that before it, above which the change is not worth a line."""


@dataclass(frozen=True)
class _FasterMotion:
    """A motion that passes the path of a plan ``factor`` times as fast; it may break limits."""

    plan: MotionPlan
    factor: float

    @property
    def duration(self) -> float:
        """Duration of the motion [s]."""
        return self.plan.duration / self.factor

    def evaluate(self, time: Array) -> Motion:
        """Return the motion at instants (N,) [s]."""
        motion = self.plan.evaluate(self.factor * time)
        qd = self.factor * motion.qd
        qdd = self.factor**2 * motion.qdd
        return Motion(time, motion.q, qd, qdd)


def expected_improvements(
    problem: ExcitationProblem,
    plan: MotionPlan,
    recording: RecordingPlan,
    prediction: Prediction,
) -> tuple[Improvement, ...]:
    """Return changes that make errors of mass and centre of mass smaller, the largest gain first.

    () for a motion that rests, and where only one joint's torque is used.

    Args:
        problem: the arm, its limits and the joints whose torques are used.
        plan: the motion.
        recording: how it will be recorded and identified.
        prediction: errors that are expected without any change.
    """
    # Nine instants are enough to see whether the arm moves.
    poses = plan.evaluate(np.linspace(0.0, plan.duration, 9)).q
    if len(problem.rows) == 1 or np.all(poses == poses[0]):
        return ()
    error = prediction.combined_error(*prediction.errors_of(prediction.covariance))
    changes = [*_other_recordings(problem, plan, recording, prediction)]
    changes += _known_masses(recording, prediction)
    gains = {}
    for change in changes:
        ratio = (
            prediction.combined_error(change.mass_error, change.centre_error) / error
        )
        if ratio < _LEAST_GAIN:
            gains[change] = ratio
    return tuple(sorted(gains, key=lambda change: gains[change]))


def _other_recordings(
    problem: ExcitationProblem,
    plan: MotionPlan,
    recording: RecordingPlan,
    prediction: Prediction,
) -> Iterator[Improvement]:
    """Yield a longer and a faster motion; for a link also other links that are known better, and
    the identification of what is bolted to it as a payload.

    Arguments are as in ``expected_improvements``. A recording that cannot be processed is left out.
    """
    options = recording.options
    longer = ("--duration", f"{LONGER * plan.duration:.3g}")
    changes = [
        (
            f"a motion {LONGER:g} times as long",
            plan,
            replace(recording, repetitions=LONGER),
            longer,
        ),
        (
            f"a motion {FASTER:g} times as fast, over the same time",
            _FasterMotion(plan, FASTER),
            replace(recording, repetitions=FASTER),
            (),
        ),
    ]
    if not recording.is_payload:
        if LINKS in prediction.covariance_by_cause:
            percentage = BETTER_LINKS * options.link_uncertainty
            better = replace(options, link_uncertainty=percentage)
            description = f"other links known to {percentage:g} % (--link-uncertainty)"
            changes.append((description, plan, replace(recording, options=better), ()))
        payload = replace(recording, target="payload", load=prediction.theta)
        changes.append(
            (
                "what is bolted to it weighed by difference",
                plan,
                payload,
                ("--for", "payload"),
            )
        )
    for description, changed_plan, changed, arguments in changes:
        try:
            posterior = predict_posterior(problem, changed_plan, changed)
        except InputError:
            continue
        names = PAYLOAD_NAMES if changed.is_payload else PARAMETER_NAMES
        covariance, _ = posterior.errors_of(names)
        errors = prediction.errors_of(covariance)
        yield Improvement(description, *errors, arguments)


def _known_masses(
    recording: RecordingPlan, prediction: Prediction
) -> Iterator[Improvement]:
    """Yield the change that a measured mass makes: that of the part itself or, for a payload, that
    of a weight from which torque scales are determined.
    """
    covariance = prediction.covariance
    if not np.all(np.isfinite(covariance[:4, :4])):
        return
    if not recording.is_payload:
        # The covariance of a Gaussian, given one of its variables.
        column = covariance[0]
        conditional = covariance - np.outer(column, column) / column[0]
        _, centre_error = prediction.errors_of(conditional)
        description = "its mass known, by weighing the part"
        yield Improvement(description, 0.0, centre_error)
        return
    scales = prediction.covariance_by_cause.get(SCALES, np.zeros((10, 10)))
    without_scales = covariance - scales
    # The scales are as uncertain as the weight's mass in recordings of this motion.
    theta = prediction.theta
    scale_error = np.sqrt(max(without_scales[0, 0], 0.0)) / KNOWN_MASS
    with_scales = without_scales + scale_error**2 * np.outer(theta, theta)
    description = f"torque scales from a weight of {KNOWN_MASS:g} kg"
    yield Improvement(description, *prediction.errors_of(with_scales))


def identifiability_note(
    problem: ExcitationProblem, plan: MotionPlan, recording: RecordingPlan
) -> str:
    """Return a note that no motion can identify the terminal link's mass well, with suggestions; ""
    where a motion can, and for payloads.

    The lower bound of the errors is that of a recording without noise, in which only the priors
    leave errors. The effects of the suggestions are computed along ``plan``, which may be any
    motion: no designed one exists before the search.
    """
    if recording.is_payload:
        return ""
    options = recording.options
    mass_error, centre_error = least_errors(problem, recording)
    prior = problem.robot.prior
    if not mass_error > LARGE_SHARE * prior.mass:
        return ""
    prediction = predict(problem, plan, recording)
    improvements = expected_improvements(problem, plan, recording, prediction)
    suggestions = [f"{change.description}: {change.figures}" for change in improvements]
    return (
        f"no motion of this arm determines the mass of {problem.robot.body_name}, "
        f"{prior.mass:.2g} kg, better than ± {mass_error:.2g} kg and its centre of mass better "
        f"than ± {1e3 * centre_error:.2g} mm, because the links before it are known to "
        f"{options.link_uncertainty:g} % only. What would help, along a random motion: "
        f"{'; '.join(suggestions)}"
    )


def least_errors(
    problem: ExcitationProblem, recording: RecordingPlan
) -> tuple[float, float]:
    """Return the standard errors of the terminal link's mass [kg] and centre of mass [m] that the
    priors leave, whatever the motion and however low the noise is.
    """
    knowledge = prior_knowledge(problem, recording.options, recording.target)
    criterion = design_criterion(problem, knowledge)
    information = random_information(problem, knowledge, _NO_NOISE)
    theta: Array = problem.robot.prior.theta
    covariance = projected_covariance(theta, criterion.covariance(information))
    return mass_and_centre_errors(theta, covariance)
