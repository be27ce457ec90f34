"""Standard errors to expect of an identification from a recording of a planned motion.

The motion is simulated and processed like a log: its ends are cut off, all columns pass the
low-pass, and rows in which a joint is too slow are left out. The covariance of the estimate is then
computed for the remaining rows with the unknowns and priors of the identification, cause by cause.
``prior_knowledge`` returns these priors for the search of a motion too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.common_scale import common_error, false_alarms
from robot_sysid.estimation.algebra.consistent_bodies import (
    project_errors,
    projected_covariance,
)
from robot_sysid.estimation.algebra.identifiability import triangle_space
from robot_sysid.estimation.algebra.priors import EXPECTED, NuisanceGroup, with_prior
from robot_sysid.estimation.algebra.uncertainty import (
    Uncertainty,
    triangle_of,
    uncertainty,
    whole_triangle,
)
from robot_sysid.estimation.choices import CANDIDATES, couplings_of
from robot_sysid.estimation.columns import PAYLOAD_NAMES, Columns
from robot_sysid.estimation.dataset import Dataset, rms_torque
from robot_sysid.estimation.fit import evidence_of
from robot_sysid.estimation.identify import Piece, low_pass_recordings
from robot_sysid.estimation.question import Choice, EstimationOptions, Question
from robot_sysid.estimation.unknowns import (
    COMMON_SCALE,
    DRIFTS,
    LINKS,
    SCALES,
    Unknowns,
    build_unknowns,
    expected_dry_friction,
    scale_spread,
)
from robot_sysid.motion.information import (
    JOINT_TERMS,
    Criterion,
    PriorKnowledge,
    design_criterion,
    mass_and_centre_errors,
    plan_information,
    random_information,
)
from robot_sysid.motion.prediction import (
    LOOSE_SHARE,
    PAYLOAD_MASS,
    Improvement,
    Prediction,
    invisible_combinations,
    parameter_sizes,
)
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.records import Array, Measurement, MotionPlan, SquareRootInformation
from robot_sysid.records.messages import percent
from robot_sysid.signals.resampling import join_measurements
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import motion_chunks, sample_count

ALL_SAMPLES = "that is from all samples, but they cannot all be used"
"""Beginning of the caveat on errors of a motion that cannot be processed like a log."""
HIGHEST_RATE_HZ = 200.0
"""Highest rate at which a motion is simulated and processed [Hz], far above its band. The noise of
a sample is scaled to the lower rate."""
MOST_SAMPLES = 200_000
"""Number of samples beyond which simulating and processing a motion would take too long."""
LONGER = 4.0
"""Duration of the longer motion that is suggested, over that of the plan."""
FASTER = 1.5
"""Speed of the faster motion that is suggested, over that of the plan."""
BETTER_LINKS = 0.5
"""Share of the links' uncertainty that remains in the suggestion to know them better."""
_NO_NOISE = 1e-4
"""Torque noise so low that priors make nearly all of the errors [N m]."""
_WEIGHING = "its mass known, by weighing the part"
"""Description of the change after which the mass has no error."""
_PAYLOAD_BY_DIFFERENCE = (
    "what is bolted to it as a payload by difference (plan --for payload)"
)
"""Description of the change to identify the part as a payload instead."""
_WEIGHED_SHARE = 1.0 - 1e-6
"""Share of the variance of a mass that weighing removes."""
_LARGEST_ERROR = 100.0
"""Standard error over the parameter's size beyond which a parameter counts as not identifiable: its
variance is then rounding."""
NOISE = "torque noise"
"""Name of the cause of errors that is in every recording."""
SUSPICION = (
    "links that are all off alike look like a scale of all torques (--scale-uncertainty says how "
    "far those may be off at most)"
)
"""Why a scale of all torques may be suspected."""
_SUSPICION_SHARE = 0.05
"""Share of recordings with a suspected scale above which the suspicion is reported."""
_PAYLOAD = PAYLOAD_MASS * np.eye(10)[0]
"""Parameters (10,) of a payload at the origin of the last link."""


@dataclass(frozen=True)
class RecordingPlan:
    """How a motion will be recorded and identified.

    Attributes:
        sample_rate: of the recording, with independent noise in each sample [Hz].
        options: of the identification.
        target: what is to be identified, see ``PriorKnowledge``.
    """

    sample_rate: float
    options: EstimationOptions
    target: str = "link"

    @property
    def is_payload(self) -> bool:
        """Whether a payload is identified, by the difference of two recordings."""
        return self.target == "payload"


def prior_knowledge(
    problem: ExcitationProblem, options: EstimationOptions, target: str
) -> PriorKnowledge:
    """Return the priors of an identification of an arm before there is a recording.

    Args:
        problem: the arm, its limits and the joints whose torques are used.
        options: of the identification, with the uncertainties that the user states.
        target: "link", "arm" or "payload", see ``PriorKnowledge``.
    """
    robot = problem.robot
    deviations = np.zeros((len(JOINT_TERMS), len(problem.rows)))
    if target == "payload":
        # In the difference of two recordings only the drift of friction between them remains.
        joints = list(problem.rows)
        deviations[0] = DRIFTS * robot.friction.coulomb[joints]
        deviations[1] = DRIFTS * robot.friction.viscous[joints]
        return PriorKnowledge(np.zeros((0, 0)), deviations, target)
    choice = _initial_choice(problem, options)
    columns = Columns(
        robot, datasets=(), torques=options.torques, couplings=choice.couplings
    )
    # Dry friction is guessed from the mean torque (n,) of each joint at rest in random poses.
    rng = np.random.default_rng(0)
    limits = problem.limits
    poses = rng.uniform(limits.lower, limits.upper, (100, robot.n_joints))
    torque = np.sqrt(np.mean(problem.torque_at(poses) ** 2, axis=0))
    choice = replace(choice, dry_friction=expected_dry_friction(columns, torque))
    is_visible = np.ones(len(columns.names), dtype=bool)
    unknowns = build_unknowns(columns, Question(options), choice, torque, is_visible)
    link_factor = np.zeros((0, 0))
    prior_deviations = dict[str, float]()
    for group in unknowns.groups:
        errors = np.sqrt(np.sum(group.factor**2, axis=1)).tolist()
        prior_deviations.update(zip(group.names, errors))
        if group.cause == LINKS:
            # Ten rows per link: from the order base to tool to the order tool to base.
            n = len(group.mean)
            factor_by_link = group.factor.reshape(-1, 10, n)
            link_factor = factor_by_link[::-1].reshape(-1, n)
    for row, joint in enumerate(columns.joints):
        friction = choice.friction[columns.joint_indices[row]]
        for index, term in enumerate(JOINT_TERMS):
            without_prior = np.inf if term in friction.terms else 0.0
            name = f"{term}[{joint}]"
            deviations[index, row] = prior_deviations.get(name, without_prior)
    return PriorKnowledge(link_factor, deviations, target)


def _initial_choice(problem: ExcitationProblem, options: EstimationOptions) -> Choice:
    """Return the choice of friction terms and known couplings of motors with which an
    identification begins.
    """
    if not options.friction:
        options = replace(options, friction_model=CANDIDATES[0])
    assert options.friction is not None
    motors, candidates = couplings_of(problem.robot, options)
    friction = (options.friction,) * problem.robot.n_joints
    # The candidates, which only a recording can confirm, are the last ones.
    known_motors = motors[: len(motors) - len(candidates)]
    return Choice(friction, known_motors, link_scales=EXPECTED)


def predict(
    problem: ExcitationProblem, plan: MotionPlan, recording: RecordingPlan
) -> Prediction:
    """Return the standard errors to expect of an identification from a recording of a motion.

    Where the motion cannot be processed like a log, the errors are a lower bound, computed from all
    samples, and ``Prediction.caveat`` states the reason.
    """
    robot = problem.robot
    knowledge = prior_knowledge(problem, recording.options, recording.target)
    criterion = design_criterion(problem, knowledge)
    subject = robot.body_name
    theta = robot.prior.theta
    size = parameter_sizes(problem)
    scale_error = 0.0
    if recording.is_payload:
        subject = f"a payload of {PAYLOAD_MASS:g} kg"
        theta = _PAYLOAD
        size = size / robot.prior.mass
        scale_error = _common_scale_error(problem, recording.options)
    caveat = ""
    link_errors = dict[str, float]()
    common_scale = None
    try:
        posterior = predict_posterior(problem, plan, recording)
    except InputError as error:
        caveat = f"{ALL_SAMPLES}: {error}"
        covariance = _bound_from_all_samples(problem, plan, recording, knowledge)
        by_cause = {NOISE: covariance}
    else:
        names = PAYLOAD_NAMES if recording.is_payload else PARAMETER_NAMES
        covariance, by_cause = posterior.errors_of(names)
        if recording.target == "arm":
            link_errors = _link_mass_errors(problem, posterior)
        if posterior.suspicion > _SUSPICION_SHARE:
            common_scale = posterior.suspicion_case(names, theta)
    return Prediction(
        subject=subject,
        theta=theta,
        size=size,
        covariance=covariance,
        covariance_by_cause=by_cause,
        link_mass_errors=link_errors,
        invisible=invisible_combinations(problem, criterion),
        improvements=_improvements(problem, plan, recording, knowledge, criterion),
        caveat=caveat,
        scale_error=scale_error,
        common_scale=common_scale,
    )


def _bound_from_all_samples(
    problem: ExcitationProblem,
    plan: MotionPlan,
    recording: RecordingPlan,
    knowledge: PriorKnowledge,
) -> Array:
    """Return the covariance (10, 10) that all samples of a motion would give, a lower bound.

    The diagonal is infinite for parameters whose errors are many times their sizes: these are not
    identifiable, and their variances are rounding.
    """
    size = parameter_sizes(problem)
    criterion = design_criterion(problem, knowledge)
    information = plan_information(problem, plan, recording.sample_rate, knowledge)
    covariance = criterion.covariance(information).copy()
    variance = np.diag(covariance)
    is_known = (variance > 0.0) & (variance < (_LARGEST_ERROR * size) ** 2)
    np.fill_diagonal(covariance, np.where(is_known, variance, np.inf))
    return covariance


def _common_scale_error(
    problem: ExcitationProblem, options: EstimationOptions
) -> float:
    """Return the relative standard error of a common scale of all torques, and so of a payload's
    mass.
    """
    columns = Columns(problem.robot, datasets=(), torques=options.torques)
    return common_error(scale_spread(columns, options, loaded=True))


@dataclass(frozen=True)
class ExpectedPosterior:
    """Errors that an estimate from a recording of a planned motion will have.

    Attributes:
        unknowns: the k parameters of the estimate.
        errors: covariance of these parameters.
        causes: cause of errors to rows R (m, k); the cause adds R^T R to the covariance by noise.
        suspicion: share of recordings in which a scale of all torques is suspected.
        suspected_errors: covariance of the parameters that is stated in these recordings.
    """

    unknowns: Unknowns
    errors: Uncertainty
    causes: Mapping[str, Array]
    suspicion: float
    suspected_errors: Uncertainty

    def errors_of(self, names: Sequence[str]) -> tuple[Array, dict[str, Array]]:
        """Return the covariance (10, 10) of ten named parameters, and its parts (10, 10) by cause;
        a variance is infinite where the parameter is not identifiable.
        """
        indices = self._indices(names)
        block = np.ix_(indices, indices)
        by_cause = {NOISE: self.errors.noise[block]}
        for cause, rows in self.causes.items():
            by_cause[cause] = rows[:, indices].T @ rows[:, indices]
        covariance = self.errors.covariance[block]
        np.fill_diagonal(covariance, self.errors.standard_errors[indices] ** 2)
        return covariance, by_cause

    def suspicion_case(self, names: Sequence[str], theta: Array) -> Improvement:
        """Return, with a description, the errors of a body's mass and centre of mass that are
        stated in recordings in which a scale of all torques is suspected.

        Args:
            names: of the body's ten parameters.
            theta: (10,) their values.
        """
        indices = self._indices(names)
        covariance = self.suspected_errors.covariance[np.ix_(indices, indices)]
        return Improvement(
            f"In about {percent(self.suspicion)} of recordings {SUSPICION}",
            *mass_and_centre_errors(theta, projected_covariance(theta, covariance)),
        )

    def _indices(self, names: Sequence[str]) -> list[int]:
        """Return the indices of the named parameters among the estimated ones."""
        return [self.unknowns.estimated_names.index(name) for name in names]


def predict_posterior(
    problem: ExcitationProblem, plan: MotionPlan, recording: RecordingPlan
) -> ExpectedPosterior:
    """Return the errors that an estimate from a recording of a motion will have.

    Args:
        problem: the arm and its torque noise.
        plan: the motion.
        recording: sample rate, options and target of the identification.

    Raises:
        InputError: the motion cannot be processed as a log.
    """
    options = recording.options
    rate = min(recording.sample_rate, HIGHEST_RATE_HZ)
    sigma = problem.sigma * np.sqrt(rate / recording.sample_rate)
    robot = problem.robot
    choice = _initial_choice(problem, options)
    is_loaded = recording.is_payload
    pieces = [Piece("", _simulated_recording(problem, plan, rate))]
    (dataset,), _ = low_pass_recordings(robot, pieces, options)
    datasets: Sequence[Dataset] = (dataset,)
    assert dataset.signals is not None
    if is_loaded:
        # The same motion without the payload, recorded before, and with it, recorded after.
        empty = replace(dataset, order=-1.0)
        datasets = (empty, replace(dataset, is_loaded=True, order=1.0))
    # Columns of all parameters that a question may free, linearised at the model's values.
    columns = Columns(robot, datasets, options.torques, choice.couplings)
    torque = rms_torque(datasets)
    # The filtered equations in all parameters; ``data.of`` selects the columns of the unknowns.
    data = evidence_of([columns.samples(columns.start())], torque)
    choice = replace(choice, dry_friction=expected_dry_friction(columns, torque))
    question = Question(options, loaded=is_loaded, drifts=is_loaded)
    unknowns = build_unknowns(columns, question, choice, torque, data.nonzero)
    information = data.of(unknowns)
    # Rows are weighted by the standard deviation of their filtered noise. The regressor's columns
    # vary slowly along the rows, so the variance of an estimate depends on the density of the noise
    # at low frequencies, which the filter does not change: sigma^2 over the samples per row.
    low_pass = dataset.signals.low_pass
    filtered_sigma = sigma * np.sqrt(np.sum(low_pass.kernel**2))
    weights = 1.0 / filtered_sigma
    noise = (weights, sigma / np.sqrt(low_pass.step))
    triangle = whole_triangle(information, weights)
    errors_with = partial(_errors_with_priors, information, noise, triangle)
    errors = errors_with(unknowns.groups)
    causes = {}
    for group in unknowns.groups:
        causes[group.cause] = group.covariance_rows(information.names, errors.inverse)
    suspicion = 0.0
    suspected_errors = errors
    if unknowns.may_be_scaled(question):
        choice = replace(choice, common_scale=COMMON_SCALE)
        scaled = build_unknowns(columns, question, choice, torque, data.nonzero)
        scaled_errors = errors_with(scaled.groups)
        suspicion, suspected_errors = _suspected_scale(
            (unknowns, errors), (scaled, scaled_errors)
        )
    if not is_loaded:
        indices, body = unknowns.bodies[robot.body_name]
        estimated = np.searchsorted(unknowns.estimated, indices)
        errors, causes = project_errors(errors, causes, estimated, body, body)
    return ExpectedPosterior(unknowns, errors, causes, suspicion, suspected_errors)


def _errors_with_priors(
    information: SquareRootInformation,
    noise: tuple[Array, Array],
    triangle: Array,
    groups: Sequence[NuisanceGroup],
) -> Uncertainty:
    """Return the errors of an estimate from data and priors.

    Args:
        information: of the data.
        noise: (joints,) weights of the rows [1/(N m)], and (joints,) density of their noise [N m].
        triangle: (p + 1, p + 1) QR triangle of the weighted equations [A b] of the data, p
            parameters.
        groups: the priors.
    """
    with_priors = with_prior(information, groups)
    if with_priors.prior is not None:
        triangle = triangle_of((triangle, with_priors.prior))
    # The right-hand side b has no part in the errors.
    space = triangle_space(triangle[:, :-1])
    return uncertainty(with_priors, *noise, space=space)


def _suspected_scale(
    separate: tuple[Unknowns, Uncertainty], common: tuple[Unknowns, Uncertainty]
) -> tuple[float, Uncertainty]:
    """Return the share of recordings in which a scale of all torques is suspected although there is
    none, and the errors that an estimate states in these recordings.

    Args:
        separate: unknowns and errors of an estimate without a scale of all torques.
        common: unknowns and errors of an estimate with a scale of all torques.
    """
    covariances = []
    for unknowns, errors in (separate, common):
        scales = next(group for group in unknowns.groups if group.cause == SCALES)
        indices = scales.indices(unknowns.estimated_names)
        prior = scales.factor @ scales.factor.T
        covariances.append((prior, errors.inverse[np.ix_(indices, indices)]))
    share, products = false_alarms(*covariances)
    # The mean square change of the estimate by the common scale, times the probability that there
    # is none: one half. The ``indices`` are those of the scales in ``common``, the last pair.
    common_errors = common[1]
    gain = common_errors.inverse[:, indices]
    return share, common_errors.with_cause(0.5 * gain @ products @ gain.T)


def friction_lines(
    problem: ExcitationProblem,
    plan: MotionPlan,
    rate: float,
    options: EstimationOptions,
) -> Iterator[str]:
    """Yield a line per friction term with its expected standard error at each joint, for an
    identification from one recording at a rate [Hz]; nothing where the motion cannot be processed.
    """
    try:
        posterior = predict_posterior(problem, plan, RecordingPlan(rate, options))
    except InputError:
        return
    names = posterior.unknowns.estimated_names
    errors = dict(zip(names, posterior.errors.standard_errors))
    for term, unit in (("coulomb", "N·m"), ("viscous", "N·m·s/rad")):
        listed = []
        for joint in problem.joint_names:
            name = f"{term}[{joint}]"
            if name in errors:
                listed.append(f"{joint} {errors[name]:.2g}")
        title = f"{term.capitalize()} friction will be known to ±"
        yield f"{title} {', '.join(listed)} {unit}"


def _simulated_recording(
    problem: ExcitationProblem, plan: MotionPlan, rate: float
) -> Measurement:
    """Return a recording of the motion at a rate [Hz] as the model predicts it, without noise;
    raises InputError for more than ``MOST_SAMPLES`` samples.
    """
    if sample_count(plan.duration, rate) > MOST_SAMPLES:
        raise InputError(
            f"only motions up to {MOST_SAMPLES / rate:.0f} s are processed beforehand"
        )
    chunks = simulate_inverse(problem.robot, motion_chunks(plan, rate))
    return replace(join_measurements(chunks), qd=None, qdd=None)


def _link_mass_errors(
    problem: ExcitationProblem, posterior: ExpectedPosterior
) -> dict[str, float]:
    """Return the mass error over the mass of each link but the terminal one, by its name."""
    masses = {link.body_name: float(link.theta[0]) for link in problem.robot.links}
    unknowns = posterior.unknowns
    mass_errors = {}
    for name, (indices, _) in unknowns.bodies.items():
        if name != problem.robot.body_name:
            # The mass is the first of a body's ten parameters.
            index = int(np.searchsorted(unknowns.estimated, indices[0]))
            error = float(posterior.errors.standard_errors[index])
            mass_errors[name] = error / masses[name]
    return mass_errors


def _improvements(
    problem: ExcitationProblem,
    plan: MotionPlan,
    recording: RecordingPlan,
    knowledge: PriorKnowledge,
    criterion: Criterion,
) -> tuple[Improvement, ...]:
    """Return changes of the motion or the priors with the errors of mass and centre of mass after
    each, the change with the smallest error of the centre of mass first.

    () for a motion that rests, and where only one joint's torque is used. A payload's mass
    also has the error of torque scales; the covariance of a link is projected onto physically
    consistent bodies.
    """
    # Nine instants are enough to see whether the arm moves.
    poses = plan.evaluate(np.linspace(0.0, plan.duration, 9)).q
    if len(problem.rows) == 1 or np.all(poses == poses[0]):
        return ()
    theta = _PAYLOAD if recording.is_payload else problem.robot.prior.theta
    scale_error = _common_scale_error(problem, recording.options) * theta[0]
    improvements = []
    changes = _changes(problem, plan, recording, knowledge, criterion)
    for description, covariance, is_payload, options in changes:
        if not is_payload:
            covariance = projected_covariance(theta, covariance)
        mass_error, centre_error = mass_and_centre_errors(theta, covariance)
        if is_payload:
            mass_error = float(np.hypot(mass_error, scale_error))
        if description == _WEIGHING:
            mass_error = 0.0
        improvement = Improvement(description, mass_error, centre_error, options)
        improvements.append(improvement)
    return tuple(sorted(improvements, key=lambda change: change.centre_error))


def _changes(
    problem: ExcitationProblem,
    plan: MotionPlan,
    recording: RecordingPlan,
    knowledge: PriorKnowledge,
    criterion: Criterion,
) -> Iterator[tuple[str, Array, bool, tuple[str, ...]]]:
    """Yield changes that may make the errors smaller: a longer and a faster motion; for a link also
    a smaller uncertainty of the other links, a mass known by weighing, and a payload by difference.

    Each is a tuple of its description, the covariance (10, 10) after it, whether that is the one of
    a payload and not of the terminal link, and the command-line options that plan such a motion.
    """
    information_of = partial(plan_information, problem, plan, recording.sample_rate)
    information = information_of(knowledge)
    is_payload = recording.is_payload
    description = f"a motion {LONGER:g} times as long"
    options = ("--duration", f"{LONGER * plan.duration:.3g}")
    covariance = criterion.covariance(LONGER * information)
    yield description, covariance, is_payload, options
    description = f"a motion {FASTER:g} times as fast, over the same time"
    fast_information = information_of(knowledge, speed_factor=FASTER)
    yield description, criterion.covariance(fast_information), is_payload, ()
    if is_payload:
        return
    if len(knowledge.link_factor):
        better = replace(criterion, link_factor=BETTER_LINKS * knowledge.link_factor)
        percentage = f"{BETTER_LINKS * recording.options.link_uncertainty:g}"
        description = f"other links known to {percentage} % (--link-uncertainty)"
        yield description, better.covariance(information), False, ()
    # The covariance of a Gaussian, given one of its variables.
    covariance = criterion.covariance(information)
    mass_column = covariance[0]
    mass_share = _WEIGHED_SHARE * np.outer(mass_column, mass_column)
    yield _WEIGHING, covariance - mass_share / covariance[0, 0], False, ()
    payload = prior_knowledge(problem, recording.options, "payload")
    covariance = design_criterion(problem, payload).covariance(information_of(payload))
    yield _PAYLOAD_BY_DIFFERENCE, covariance, True, ("--for", "payload")


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
    knowledge = prior_knowledge(problem, options, recording.target)
    prior = problem.robot.prior
    criterion = design_criterion(problem, knowledge)
    information = random_information(problem, knowledge, _NO_NOISE)
    least = projected_covariance(prior.theta, criterion.covariance(information))
    mass_error, centre_error = mass_and_centre_errors(prior.theta, least)
    if not mass_error > LOOSE_SHARE * prior.mass:
        return ""
    improvements = _improvements(problem, plan, recording, knowledge, criterion)
    suggestions = [f"{change.description}: {change.figures}" for change in improvements]
    return (
        f"no motion of this arm tells the mass of {problem.robot.body_name}, {prior.mass:.2g} kg, "
        f"better than ± {mass_error:.2g} kg and its centre of mass than "
        f"± {1e3 * centre_error:.2g} mm: that much may be in the links before it, known to "
        f"{options.link_uncertainty:g} %. What would help, along a random motion: "
        f"{'; '.join(suggestions)}"
    )
