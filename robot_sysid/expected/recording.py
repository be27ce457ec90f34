"""Standard errors to expect of an identification from a recording of a planned motion.

The motion is simulated and processed like a log: its ends are cut off, all columns pass the
low-pass, and rows in which a joint is too slow are left out. The errors are then those that the
fit of these rows has with the terms and priors of the identification, without any torque measured.
``prior_knowledge`` returns these priors for the search of a motion too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.estimate.choose import fastest_of, motors_of, speeds_in
from robot_sysid.estimate.fit import NOISE, Fit, Problem
from robot_sysid.estimate.identifiability import describe
from robot_sysid.estimate.links import EXPECTED
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import Question, arm_question
from robot_sysid.estimate.terms import (
    FRICTION,
    FURTHER_FRICTION,
    LAST_LINK,
    LINKS,
    PAYLOAD_NAMES,
    SCALES,
    ArmTerms,
)
from robot_sysid.expected.criterion import Criterion, FileKnowledge, PriorKnowledge
from robot_sysid.expected.planned_arm import PlannedArm
from robot_sysid.expected.unrecorded_arm import ExpectedFile, UnrecordedArm, is_held
from robot_sysid.records import Array, MotionPlan, join_recordings
from robot_sysid.records.option_fields import LOADED, PAYLOAD_ORDER
from robot_sysid.records.usual_errors import FRICTION_DRIFT
from robot_sysid.signals.process import FilteredRecording, low_pass_recordings
from robot_sysid.simulator import simulate_inverse
from robot_sysid.spatial import N_INERTIAL, PARAMETER_NAMES
from robot_sysid.trajectory import sample_times

LINK_TARGET = "link"
ARM_TARGET = "arm"
PAYLOAD_TARGET = "payload"
"""What a motion is to identify: the last link, the whole arm's file, a payload by difference."""
TYPICAL_LOAD = 0.025
"""Mass of a payload before it is known, as a share of the arm's moving mass: about a tenth of what
arms of this mass are rated for."""
UNMODELLED_TORQUE = 0.002
"""Torque that the model of an arm does not explain, such as friction at reversals, over a joint's
root mean square torque, as of simulated arms (benchmarks.trust.payload_plan). Where a payload is
weighed, all larger errors cancel and it adds to the noise."""

# Causes of terms that each joint has.
_OF_JOINTS = (FRICTION, FURTHER_FRICTION, SCALES)
HIGHEST_RATE_HZ = 200.0
"""Highest rate at which a motion is processed like a log [Hz], far above its band: the noise of a
sample is scaled to the lower rate."""


@dataclass(frozen=True)
class Prediction:
    """Standard errors that are expected of an identification of one recording of a motion.

    Attributes:
        body: name of the last link, which is identified where no load is weighed.
        load: mass of the payload that the errors are of [kg]; None where none is weighed.
        size: (10,) magnitude that each error is compared with: m, m L and m L^2 with a length L
            of the body.
        errors: (10,) of its parameters; infinite where the model's value stays.
        by_cause: cause of errors to the errors that it alone makes of the mass [kg] and of the
            centre of mass [m].
        link_mass_errors: name of every other link to the standard error of its mass over its mass.
        invisible: combinations of parameters that no motion of these joints shows, in words.
        file: what the written file is expected to be; None where a payload is weighed.
    """

    body: str
    load: float | None
    size: Array
    errors: Array
    by_cause: Mapping[str, tuple[float, float]]
    link_mass_errors: Mapping[str, float]
    invisible: tuple[str, ...]
    file: ExpectedFile | None = None

    @property
    def relative_mass_error(self) -> float:
        """Predicted standard error of the mass over the mass; infinite if not identified."""
        return float(self.errors[0] / self.size[0])

    def relative_mass_error_after(self, factor: float) -> float:
        """Return what it is if the motion lasts so many times as long, and shows as much a second.

        Noise averages out, what the model does not explain stays.
        """
        variances = {cause: mass**2 for cause, (mass, _) in self.by_cause.items()}
        variances[NOISE] = variances.get(NOISE, 0.0) / factor
        return float(math.sqrt(sum(variances.values())) / self.size[0])

    @property
    def centre_error(self) -> float:
        """Predicted standard error of the centre of mass [m]; infinite if not identified."""
        if not np.all(np.isfinite(self.errors[:4])):
            return np.inf
        return math.hypot(*(centre for _, centre in self.by_cause.values()))


def _arm_terms(
    problem: PlannedArm,
    options: EstimationOptions,
    loaded: bool = False,
    speeds: Array | None = None,
) -> ArmTerms:
    """Return all terms of an arm; its motors are those that the model states.

    ``speeds`` (K, n) are the joints' velocities in the recording; None without one.
    """
    robot = problem.robot
    motors, _ = motors_of(robot, options.torques, speeds)
    fastest = None if speeds is None else fastest_of(speeds, np.eye(robot.n_joints))
    return ArmTerms(robot, options.torques, motors, options.friction, loaded, fastest)


def prior_knowledge(
    problem: PlannedArm, options: EstimationOptions, target: str
) -> PriorKnowledge:
    """Return the priors of an identification of an arm before there is a recording.

    Args:
        problem: the arm, its limits and the joints whose torques are used.
        options: of the identification, with the uncertainties that the user states.
        target: what the motion is to identify.
    """
    if target == ARM_TARGET:
        return _file_knowledge(problem, options)
    robot = problem.robot
    deviations: dict[str, Array] = {}
    link_factor = np.zeros((N_INERTIAL * len(problem.links[1:]), 0))
    if target == PAYLOAD_TARGET:
        # In the difference of two recordings only the drift of friction between them remains.
        for name in ("coulomb", "viscous"):
            friction = vars(robot.friction)[name]
            deviations[name] = FRICTION_DRIFT * friction[list(problem.rows)]
        return PriorKnowledge(link_factor, deviations)
    arm = _arm_terms(problem, options)
    # Dry friction is guessed from the mean torque (n,) of each joint at rest in random poses.
    rng = np.random.default_rng(0)
    limits = problem.limits
    poses = rng.uniform(limits.lower, limits.upper, (100, robot.n_joints))
    torque = np.sqrt(np.mean(problem.torque_at(poses) ** 2, axis=0))[arm.indices]
    question = Question(options, link_scales=EXPECTED)
    for term in arm_question(arm, question, torque):
        if term.cause == LINKS and term.prior is not None:
            link_factor = term.prior.factor
        first = term.parameters[0]
        # What slow motion alone tells from Coulomb friction is left to the predicted errors.
        is_told = term.cause == FURTHER_FRICTION and not first.is_dry_torque
        if is_told or term.cause in (FRICTION, SCALES):
            deviations[first.name] = np.full(len(term.names), np.inf)
            if term.prior is not None:
                deviations[first.name] = np.sqrt(term.prior.variances)
    return PriorKnowledge(link_factor, deviations)


def _file_knowledge(problem: PlannedArm, options: EstimationOptions) -> PriorKnowledge:
    """Return the priors of all terms of an arm whose whole file is to be identified."""
    arm = _arm_terms(problem, options)
    unrecorded = UnrecordedArm.of(problem, arm)
    terms = unrecorded.terms(options, is_replaced=False)
    factors = {LINKS: np.zeros((N_INERTIAL * len(arm.others), 0))}
    deviations: dict[str, Array] = {}
    for term in terms:
        assert term.prior is not None
        if term.cause in (LAST_LINK, LINKS):
            factors[term.cause] = term.prior.factor
        elif term.cause in _OF_JOINTS:
            # Motors of several joints, which a search does not know, come behind the joints.
            of_joints = np.sqrt(term.prior.variances)[: len(arm.joints)]
            deviations[term.parameters[0].name] = of_joints
    held = [
        term.parameters[0].name
        for term in terms
        if term.cause in _OF_JOINTS and is_held(term, options.kept)
    ]
    motions = [(motion.q, motion.qd, motion.qdd) for motion in unrecorded.motions]
    elsewhere = np.concatenate(motions, axis=1)
    file = FileKnowledge(factors[LAST_LINK], tuple(held), elsewhere)
    return PriorKnowledge(factors[LINKS], deviations, file)


def typical_load(problem: PlannedArm) -> Array:
    """Return the parameters (10,) of the payload that errors are stated for, before it is known.

    It has the shape of the terminal link. Its mass is the one that torque is reserved for
    (``--payload-reserve``) or, without one, a share ``TYPICAL_LOAD`` of the moving mass.
    """
    robot = problem.robot
    mass = problem.reserve or TYPICAL_LOAD * np.sum(robot.thetas[:, 0])
    body = robot.links[-1].reference
    return mass / body[0] * body


def predict(
    problem: PlannedArm,
    plan: MotionPlan,
    sample_rate: float,
    options: EstimationOptions,
    target: str,
) -> Prediction:
    """Return the standard errors to expect of an identification from recordings of a motion.

    The arguments are those of ``expected_fit``.

    Raises:
        InputError: the motion cannot be processed like a log.
    """
    robot = problem.robot
    names: tuple[str, ...] = PARAMETER_NAMES
    load = None
    theta = robot.prior.theta
    size = robot.prior.scale
    if target == PAYLOAD_TARGET:
        names = PAYLOAD_NAMES
        theta = typical_load(problem)
        load = float(theta[0])
        size = load / robot.prior.mass * size
    fitted = expected_fit(problem, plan, sample_rate, options, target)
    file = None
    if target != PAYLOAD_TARGET:
        # A motion for the last link is one for a link with another tool than the model's.
        is_replaced = target == LINK_TARGET
        unrecorded = UnrecordedArm.of(problem, fitted.arm)
        file = unrecorded.expected_file(fitted, is_replaced)
    at = fitted.at(names)
    selection = np.eye(len(fitted.names))[at]
    mass_errors = fitted.budget(selection[:1])
    centre_errors = fitted.budget(centre_slopes(theta) @ selection)
    by_cause = {
        cause: (float(mass_errors[cause][0]), float(np.linalg.norm(errors)))
        for cause, errors in centre_errors.items()
    }

    link_errors = {}
    for index in fitted.arm.others if target == ARM_TARGET else ():
        link = robot.links[index]
        mass, *_ = fitted.arm.links[index]
        if mass in fitted.names:
            link_errors[link.body_name] = fitted.error_of(mass) / float(link.theta[0])
    # What no motion shows of a body is a question of the body alone, whatever else is identified.
    of_body = PAYLOAD_TARGET if target == PAYLOAD_TARGET else LINK_TARGET
    knowledge = prior_knowledge(problem, options, of_body)
    return Prediction(
        body=robot.body_name,
        load=load,
        size=size,
        errors=fitted.errors[at],
        by_cause=by_cause,
        link_mass_errors=link_errors,
        invisible=describe(Criterion(problem, knowledge).hidden, PARAMETER_NAMES),
        file=file,
    )


def centre_slopes(theta: Array) -> Array:
    """Return the derivative (3, 10) of a body's centre of mass h / m by its parameters (10,)."""
    slopes = np.zeros((3, N_INERTIAL))
    slopes[:, 0] = -theta[1:4] / theta[0] ** 2
    slopes[:, 1:4] = np.eye(3) / theta[0]
    return slopes


def expected_fit(
    problem: PlannedArm,
    plan: MotionPlan,
    sample_rate: float,
    options: EstimationOptions,
    target: str,
) -> Fit:
    """Return the fit to expect of recordings of a motion: errors without an estimate.

    Args:
        problem: the arm and its torque noise.
        plan: the motion.
        sample_rate: of the recording, with independent noise in each sample [Hz].
        options: of the identification.
        target: what the motion is to identify. One for a payload is recorded in the order
            ``PAYLOAD_ORDER``.

    Raises:
        InputError: the motion cannot be processed as a log.
    """
    loaded = target == PAYLOAD_TARGET
    rate = min(sample_rate, HIGHEST_RATE_HZ)
    processed = _processed_motion(problem, plan, rate, options)
    arm = _arm_terms(problem, options, loaded, speeds_in([processed]))
    recordings = _payload_recordings(processed) if loaded else (processed,)
    point = replace(arm.start(), friction=arm.model)
    values = {}
    if loaded:
        point = replace(point, payload=typical_load(problem))
        values = dict(zip(PAYLOAD_NAMES, point.payload.tolist()))
    sums = arm.sums(recordings, point, in_blocks=False)
    torque = sums.rms_torque
    # Columns vary slowly along the rows, so that what counts is the density of the noise at low
    # frequencies, which the low-pass does not change: sigma^2 over the samples per row.
    samples_per_row = sample_rate / rate * processed.low_pass.step
    noise = problem.sigma / np.sqrt(samples_per_row)
    if loaded:
        noise = np.hypot(noise, UNMODELLED_TORQUE * torque)
    question = Question(options, loaded, drifts=loaded, link_scales=EXPECTED)
    rows = Problem(arm, recordings, point, sums, question)
    return rows.expected_fit(values, noise)


def _processed_motion(
    problem: PlannedArm, plan: MotionPlan, rate: float, options: EstimationOptions
) -> FilteredRecording:
    """Return a recording of a motion at a rate [Hz] without noise, processed like a log.

    Raises:
        InputError: the motion cannot be processed as a log.
    """
    # Of a long motion the first samples: the errors are those of a recording of that part.
    times = sample_times(min(plan.duration, 200_000 / rate), rate)
    chunks = simulate_inverse(problem.robot, map(plan.evaluate, times))
    samples = replace(join_recordings(chunks), qd=None, qdd=None)
    (processed,), _ = low_pass_recordings(problem.robot, [samples], options.cutoff)
    return processed


def _payload_recordings(processed: FilteredRecording) -> tuple[FilteredRecording, ...]:
    """Return the recordings of one motion without and with a payload, in ``PAYLOAD_ORDER``."""
    positions = np.linspace(-1.0, 1.0, len(PAYLOAD_ORDER)).tolist()
    return tuple(
        replace(processed, is_loaded=letter == LOADED, order=position)
        for letter, position in zip(PAYLOAD_ORDER, positions)
    )
