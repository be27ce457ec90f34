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
from robot_sysid.model.bodies import usual_bodies
from robot_sysid.motion import LOADED, PAYLOAD_ORDER, RECORDED_FOR_PAYLOAD
from robot_sysid.motion.information import (
    JOINT_TERMS,
    PriorKnowledge,
    design_criterion,
    mass_and_centre_errors,
    plan_information,
)
from robot_sysid.motion.prediction import (
    Improvement,
    Prediction,
    invisible_combinations,
    parameter_sizes,
)
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.records import Array, MotionPlan, SquareRootInformation
from robot_sysid.records.messages import percent
from robot_sysid.signals.resampling import join_measurements
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import motion_chunks, sample_count

ALL_SAMPLES = "these are lower bounds from all samples, not all of which can be used"
"""Beginning of the caveat on errors of a motion that cannot be processed like a log."""
HIGHEST_RATE_HZ = 200.0
"""Highest rate at which a motion is simulated and processed [Hz], far above its band. The noise of
a sample is scaled to the lower rate."""
MOST_SAMPLES = 200_000
"""Number of samples beyond which simulating and processing a motion would take too long."""
_LARGEST_ERROR = 100.0
"""Standard error over the parameter's size beyond which a parameter counts as not identifiable: its
variance is then rounding."""
NOISE = "torque noise"
"""Name of the cause of errors that is in every recording."""
SUSPICION = (
    "links that are all too heavy, or all too light, look like a common torque scale "
    "(--scale-uncertainty states how large that may be)"
)
"""Why a scale of all torques may be suspected."""
_SUSPICION_SHARE = 0.05
"""Share of recordings with a suspected scale above which the suspicion is reported."""
TYPICAL_LOAD = 0.025
"""Mass of a payload before it is known, as a share of the arm's moving mass: about a tenth of what
arms of this mass are rated for."""
UNMODELLED_TORQUE = 0.002
"""Torque that the model of an arm does not explain, such as friction at reversals, over a joint's
root mean square torque. Where a payload is weighed, all larger errors cancel and it adds to the
noise. Simulated arms leave 0.15 to 0.25 % (benchmarks.payload_plan)."""


@dataclass(frozen=True)
class RecordingPlan:
    """How a motion will be recorded and identified.

    Attributes:
        sample_rate: of the recording, with independent noise in each sample [Hz].
        options: of the identification.
        target: what is to be identified, see ``PriorKnowledge``. A motion for a payload is recorded
            in the order ``PAYLOAD_ORDER``.
        repetitions: how often the motion is passed in each recording.
        load: (10,) the payload; None for ``typical_load``.
    """

    sample_rate: float
    options: EstimationOptions
    target: str = "link"
    repetitions: float = 1.0
    load: Array | None = None

    @property
    def is_payload(self) -> bool:
        """Whether a payload is identified, by the difference of recordings without and with it."""
        return self.target == "payload"

    @property
    def simulated_rate(self) -> float:
        """Rate at which the motion is simulated and processed [Hz]."""
        return min(self.sample_rate, HIGHEST_RATE_HZ)


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


def typical_load(problem: ExcitationProblem) -> Array:
    """Return the parameters (10,) of the payload that errors are stated for, before it is known.

    It has the shape of the terminal link. Its mass is the one that torque is reserved for
    (``--payload-reserve``) or, without one, a share ``TYPICAL_LOAD`` of the moving mass.
    """
    robot = problem.robot
    mass = problem.reserve or TYPICAL_LOAD * float(np.sum(robot.thetas[:, 0]))
    body = usual_bodies(robot)[robot.body_name]
    return mass / body[0] * body


def load_text(problem: ExcitationProblem) -> str:
    """Return the mass of ``typical_load`` with its unit; with the digits of the option if given."""
    if problem.reserve:
        return f"{problem.reserve:.12g} kg"
    return f"{typical_load(problem)[0]:.2g} kg"


def _load_reason(problem: ExcitationProblem) -> str:
    """Return, in words, why ``typical_load`` has its mass."""
    if problem.reserve:
        return "of --payload-reserve"
    share = percent(TYPICAL_LOAD)
    return f"{share} of the arm's moving mass; --payload-reserve states another one"


def common_scale_error(problem: ExcitationProblem, options: EstimationOptions) -> float:
    """Return the standard error that all torque scales share where a payload is weighed, as a share
    of the torque.
    """
    columns = Columns(problem.robot, datasets=(), torques=options.torques)
    return common_error(scale_spread(columns, options, loaded=True))


def predict(
    problem: ExcitationProblem, plan: MotionPlan, recording: RecordingPlan
) -> Prediction:
    """Return the standard errors to expect of an identification from recordings of a motion.

    Where the motion cannot be processed like a log, the errors are a lower bound, computed from all
    samples, and ``Prediction.caveat`` states the reason.
    """
    robot = problem.robot
    knowledge = prior_knowledge(problem, recording.options, recording.target)
    criterion = design_criterion(problem, knowledge)
    names: tuple[str, ...] = PARAMETER_NAMES
    recordings = "Recorded once"
    subject = robot.body_name
    theta = robot.prior.theta
    size = parameter_sizes(problem)
    if recording.is_payload:
        names = PAYLOAD_NAMES
        recordings = RECORDED_FOR_PAYLOAD
        theta = typical_load(problem)
        subject = f"a load of {load_text(problem)} ({_load_reason(problem)})"
        size = theta[0] / robot.prior.mass * size
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
        covariance, by_cause = posterior.errors_of(names)
        if recording.target == "arm":
            link_errors = _link_mass_errors(problem, posterior)
        if posterior.suspicion > _SUSPICION_SHARE:
            common_scale = posterior.suspicion_case(names, theta)
    return Prediction(
        recordings=recordings,
        subject=subject,
        theta=theta,
        size=size,
        covariance=covariance,
        covariance_by_cause=by_cause,
        link_mass_errors=link_errors,
        invisible=invisible_combinations(problem, criterion),
        caveat=caveat,
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
    if recording.is_payload:
        common = common_scale_error(problem, recording.options)
        load = typical_load(problem)
        covariance += common**2 * np.outer(load, load)
    variance = np.diag(covariance)
    is_known = (variance > 0.0) & (variance < (_LARGEST_ERROR * size) ** 2)
    np.fill_diagonal(covariance, np.where(is_known, variance, np.inf))
    return covariance


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
    """Return the errors that an estimate from recordings of a motion will have.

    Args:
        problem: the arm and its torque noise.
        plan: the motion.
        recording: sample rate, options and target of the identification.

    Raises:
        InputError: the motion cannot be processed as a log.
    """
    options = recording.options
    is_loaded = recording.is_payload
    robot = problem.robot
    choice = _initial_choice(problem, options)
    dataset = _processed_motion(problem, plan, recording)
    datasets = _payload_recordings(dataset) if is_loaded else (dataset,)
    # Columns of all parameters that a question may free, linearised at the model's values.
    columns = Columns(robot, datasets, options.torques, choice.couplings)
    torque = rms_torque(datasets)
    point = columns.start()
    load = typical_load(problem) if recording.load is None else recording.load
    if is_loaded:
        values = point.values.copy()
        values[columns.indices(PAYLOAD_NAMES)] = load
        point = replace(point, values=values)
    # The filtered equations in all parameters; ``data.of`` selects the columns of the unknowns.
    data = evidence_of([columns.samples(point)], torque)
    choice = replace(choice, dry_friction=expected_dry_friction(columns, torque))
    question = Question(options, loaded=is_loaded, drifts=is_loaded)
    unknowns = build_unknowns(columns, question, choice, torque, data.nonzero)
    information = data.of(unknowns)
    noise = _row_noise(problem, dataset, recording, torque[list(columns.joint_indices)])
    triangle = whole_triangle(information, noise[0])
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
    if is_loaded:
        # An error of all torque scales together changes every parameter of the payload alike.
        common = common_scale_error(problem, options)
        row = np.zeros(len(information.names))
        row[[information.names.index(name) for name in PAYLOAD_NAMES]] = common * load
        causes[SCALES] = np.vstack((causes.get(SCALES, row[None][:0]), row))
        errors = errors.with_cause(np.outer(row, row))
    else:
        indices, body = unknowns.bodies[robot.body_name]
        estimated = np.searchsorted(unknowns.estimated, indices)
        errors, causes = project_errors(errors, causes, estimated, body, body)
    return ExpectedPosterior(unknowns, errors, causes, suspicion, suspected_errors)


def _processed_motion(
    problem: ExcitationProblem, plan: MotionPlan, recording: RecordingPlan
) -> Dataset:
    """Return a recording of a motion without noise, processed like a log.

    Raises:
        InputError: the motion cannot be processed as a log.
    """
    rate = recording.simulated_rate
    if sample_count(plan.duration, rate) > MOST_SAMPLES:
        raise InputError(
            f"only motions up to {MOST_SAMPLES / rate:.0f} s are processed beforehand"
        )
    chunks = simulate_inverse(problem.robot, motion_chunks(plan, rate))
    samples = replace(join_measurements(chunks), qd=None, qdd=None)
    pieces = [Piece("", samples)]
    (dataset,), _ = low_pass_recordings(problem.robot, pieces, recording.options)
    return dataset


def _payload_recordings(dataset: Dataset) -> tuple[Dataset, ...]:
    """Return the recordings of one motion without and with a payload, in ``PAYLOAD_ORDER``."""
    positions = np.linspace(-1.0, 1.0, len(PAYLOAD_ORDER)).tolist()
    recordings = []
    for letter, position in zip(PAYLOAD_ORDER, positions):
        is_loaded = letter == LOADED
        recordings.append(replace(dataset, is_loaded=is_loaded, order=position))
    return tuple(recordings)


def _row_noise(
    problem: ExcitationProblem,
    dataset: Dataset,
    recording: RecordingPlan,
    torque: Array,
) -> tuple[Array, Array]:
    """Return weights of the filtered rows and the density of their noise, (joints,) each.

    Rows are weighted by the standard deviation of their filtered noise. The regressor's columns
    vary slowly along the rows, so the variance of an estimate depends on the density of the noise
    at low frequencies, which the filter does not change: sigma^2 over the samples per row.

    Args:
        problem: has the torque noise of one sample.
        dataset: the processed recording.
        recording: how the motion is recorded.
        torque: (joints,) root mean square torque [N m].

    Returns:
        (1 / standard deviation [1/(N m)], standard deviation of the density [N m]).
    """
    assert dataset.signals is not None
    low_pass = dataset.signals.low_pass
    rate_ratio = recording.simulated_rate / recording.sample_rate
    sigma = problem.sigma * np.sqrt(rate_ratio)
    filtered_sigma = sigma * np.sqrt(np.sum(low_pass.kernel**2))
    density = sigma / np.sqrt(low_pass.step)
    unmodelled = UNMODELLED_TORQUE * torque if recording.is_payload else 0.0
    total = np.hypot(density, unmodelled) / np.sqrt(recording.repetitions)
    return density / (total * filtered_sigma), total


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
