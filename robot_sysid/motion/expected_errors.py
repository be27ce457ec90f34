"""Standard errors to expect of an identification from a recording of a planned motion.

The motion is simulated and processed like a log: its ends are cut off, all columns pass the
low-pass, and rows in which a joint is too slow are left out. The errors are then those that the
fit of these rows has with the terms and priors of the identification, without any torque measured.
``prior_knowledge`` returns these priors for the search of a motion too.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robot_sysid.estimate.choose import fastest_of, motors_of, speeds_in
from robot_sysid.estimate.fit import Fit, Problem
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
from robot_sysid.motion import LOADED, PAYLOAD_ORDER, RECORDED_FOR_PAYLOAD, AimOptions
from robot_sysid.motion.expected_file import Judgement, is_held
from robot_sysid.motion.information import Criterion, FileKnowledge, PriorKnowledge
from robot_sysid.motion.prediction import Prediction
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.records import Array, MotionPlan, join_recordings
from robot_sysid.records.usual_errors import FRICTION_DRIFT
from robot_sysid.signals.process import FilteredRecording, low_pass_recordings
from robot_sysid.simulator import simulate_inverse
from robot_sysid.spatial import N_INERTIAL, PARAMETER_NAMES
from robot_sysid.trajectory import sample_times
from robot_sysid.wording import option_name

TYPICAL_LOAD = 0.025
"""Mass of a payload before it is known, as a share of the arm's moving mass: about a tenth of what
arms of this mass are rated for."""
UNMODELLED_TORQUE = 0.002
"""Torque that the model of an arm does not explain, such as friction at reversals, over a joint's
root mean square torque. Where a payload is weighed, all larger errors cancel and it adds to the
noise. Simulated arms leave 0.15 to 0.25 % (benchmarks.trust.payload_plan)."""

# Causes of terms that each joint has.
_OF_JOINTS = (FRICTION, FURTHER_FRICTION, SCALES)
HIGHEST_RATE_HZ = 200.0
"""Highest rate at which a motion is processed like a log [Hz], far above its band: the noise of a
sample is scaled to the lower rate."""


def _arm_terms(
    problem: ExcitationProblem,
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
    problem: ExcitationProblem, options: EstimationOptions, target: str
) -> PriorKnowledge:
    """Return the priors of an identification of an arm before there is a recording.

    Args:
        problem: the arm, its limits and the joints whose torques are used.
        options: of the identification, with the uncertainties that the user states.
        target: "link", "arm" or "payload": what the motion is to identify.
    """
    if target == "arm":
        return _file_knowledge(problem, options)
    robot = problem.robot
    deviations: dict[str, Array] = {}
    link_factor = np.zeros((N_INERTIAL * len(problem.links[1:]), 0))
    if target == "payload":
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


def _file_knowledge(
    problem: ExcitationProblem, options: EstimationOptions
) -> PriorKnowledge:
    """Return the priors of all terms of an arm whose whole file is to be identified."""
    arm = _arm_terms(problem, options)
    judgement = Judgement.of(problem, arm)
    terms = judgement.terms(options, is_replaced=False)
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
    motions = [(motion.q, motion.qd, motion.qdd) for motion in judgement.motions]
    elsewhere = np.concatenate(motions, axis=1)
    file = FileKnowledge(factors[LAST_LINK], tuple(held), elsewhere)
    return PriorKnowledge(factors[LINKS], deviations, file)


def typical_load(problem: ExcitationProblem) -> Array:
    """Return the parameters (10,) of the payload that errors are stated for, before it is known.

    It has the shape of the terminal link. Its mass is the one that torque is reserved for
    (``--payload-reserve``) or, without one, a share ``TYPICAL_LOAD`` of the moving mass.
    """
    robot = problem.robot
    mass = problem.reserve or TYPICAL_LOAD * np.sum(robot.thetas[:, 0])
    body = robot.links[-1].reference
    return mass / body[0] * body


def predict(
    problem: ExcitationProblem,
    plan: MotionPlan,
    sample_rate: float,
    options: EstimationOptions,
    aim: AimOptions,
) -> Prediction:
    """Return the standard errors to expect of an identification from recordings of a motion.

    The arguments are those of ``expected_fit``.

    Raises:
        InputError: the motion cannot be processed like a log.
    """
    robot = problem.robot
    names: tuple[str, ...] = PARAMETER_NAMES
    recordings = "Recorded once"
    subject = robot.body_name
    theta = robot.prior.theta
    size = robot.prior.scale
    if aim.target == "payload":
        names = PAYLOAD_NAMES
        recordings = RECORDED_FOR_PAYLOAD
        theta = typical_load(problem)
        reserve = option_name("payload_reserve")
        subject = f"a load of {theta[0]:.3g} kg ({reserve} states another one)"
        size = theta[0] / robot.prior.mass * size
    fitted = expected_fit(problem, plan, sample_rate, options, aim)
    file = None
    if aim.target != "payload":
        # A motion for the last link is one for a link with another tool than the model's.
        is_replaced = aim.target == "link"
        judgement = Judgement.of(problem, fitted.arm)
        file = judgement.expected_file(fitted, is_replaced)
    at = fitted.at(names)
    selection = np.eye(len(fitted.names))[at]
    mass_errors = fitted.budget(selection[:1])
    centre_errors = fitted.budget(centre_slopes(theta) @ selection)
    by_cause = {
        cause: (float(mass_errors[cause][0]), float(np.linalg.norm(errors)))
        for cause, errors in centre_errors.items()
    }

    link_errors = {}
    for index in fitted.arm.others if aim.target == "arm" else ():
        link = robot.links[index]
        mass, *_ = fitted.arm.links[index]
        if mass in fitted.names:
            link_errors[link.body_name] = fitted.error_of(mass) / float(link.theta[0])
    # What no motion shows of a body is a question of the body alone, whatever else is identified.
    of_body = "payload" if aim.target == "payload" else "link"
    knowledge = prior_knowledge(problem, options, of_body)
    return Prediction(
        recordings=recordings,
        subject=subject,
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
    problem: ExcitationProblem,
    plan: MotionPlan,
    sample_rate: float,
    options: EstimationOptions,
    aim: AimOptions,
) -> Fit:
    """Return the fit to expect of recordings of a motion: errors without an estimate.

    Args:
        problem: the arm and its torque noise.
        plan: the motion.
        sample_rate: of the recording, with independent noise in each sample [Hz].
        options: of the identification.
        aim: purpose of the motion. One for a payload is recorded in the order ``PAYLOAD_ORDER``.

    Raises:
        InputError: the motion cannot be processed as a log.
    """
    loaded = aim.target == "payload"
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
    problem: ExcitationProblem,
    plan: MotionPlan,
    rate: float,
    options: EstimationOptions,
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
