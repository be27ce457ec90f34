"""Standard errors to expect of an identification from a recording of a planned motion.

The motion is simulated and processed like a log: its ends are cut off, all columns pass the
low-pass, and rows in which a joint is too slow are left out. The covariance of the estimate is then
computed for the remaining rows with the unknowns and priors of the identification, cause by cause.
``prior_knowledge`` returns these priors for the search of a motion too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.common_scale import common_error
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
from robot_sysid.motion.information import JOINT_TERMS, PriorKnowledge, design_criterion
from robot_sysid.motion.prediction import Prediction, invisible_combinations
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.records import Array, MotionPlan, SquareRootInformation
from robot_sysid.records.messages import percent
from robot_sysid.signals.resampling import join_measurements
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import sample_times

HIGHEST_RATE_HZ = 200.0
"""Highest rate at which a motion is simulated and processed [Hz], far above its band. The noise of
a sample is scaled to the lower rate."""
MOST_SAMPLES = 200_000
"""Largest number of samples that are simulated and processed; of a longer motion the first ones.
The errors are then those of a recording of that part."""
NOISE = "torque noise"
"""Name of the cause of errors that is in every recording."""
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
    """

    sample_rate: float
    options: EstimationOptions
    target: str = "link"

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

    Raises:
        InputError: the motion cannot be processed like a log.
    """
    robot = problem.robot
    knowledge = prior_knowledge(problem, recording.options, recording.target)
    criterion = design_criterion(problem, knowledge)
    names: tuple[str, ...] = PARAMETER_NAMES
    recordings = "Recorded once"
    subject = robot.body_name
    theta = robot.prior.theta
    size = problem.scale
    if recording.is_payload:
        names = PAYLOAD_NAMES
        recordings = RECORDED_FOR_PAYLOAD
        theta = typical_load(problem)
        subject = f"a load of {load_text(problem)} ({_load_reason(problem)})"
        size = theta[0] / robot.prior.mass * size
    posterior = predict_posterior(problem, plan, recording)
    covariance, by_cause = posterior.errors_of(names)
    link_errors = dict[str, float]()
    if recording.target == "arm":
        link_errors = _link_mass_errors(problem, posterior)
    return Prediction(
        recordings=recordings,
        subject=subject,
        theta=theta,
        size=size,
        covariance=covariance,
        covariance_by_cause=by_cause,
        link_mass_errors=link_errors,
        invisible=invisible_combinations(problem, criterion),
    )


@dataclass(frozen=True)
class ExpectedPosterior:
    """Errors that an estimate from a recording of a planned motion will have.

    Attributes:
        unknowns: the k parameters of the estimate.
        errors: covariance of these parameters.
        causes: cause of errors to rows R (m, k); the cause adds R^T R to the covariance by noise.
    """

    unknowns: Unknowns
    errors: Uncertainty
    causes: Mapping[str, Array]

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
    load = typical_load(problem)
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
    errors = _errors_with_priors(information, noise, triangle, unknowns.groups)
    causes = {}
    for group in unknowns.groups:
        causes[group.cause] = group.covariance_rows(information.names, errors.inverse)
    if is_loaded:
        # An error of all torque scales together changes every parameter of the payload alike.
        common = common_scale_error(problem, options)
        row = np.zeros(len(information.names))
        row[[information.names.index(name) for name in PAYLOAD_NAMES]] = common * load
        causes[SCALES] = np.vstack((causes.get(SCALES, row[None][:0]), row))
        errors = errors.with_cause(np.outer(row, row))
    return ExpectedPosterior(unknowns, errors, causes)


def _processed_motion(
    problem: ExcitationProblem, plan: MotionPlan, recording: RecordingPlan
) -> Dataset:
    """Return a recording of a motion without noise, processed like a log.

    Raises:
        InputError: the motion cannot be processed as a log.
    """
    rate = recording.simulated_rate
    times = sample_times(plan.duration, rate, end=MOST_SAMPLES / rate)
    chunks = simulate_inverse(problem.robot, map(plan.evaluate, times))
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
    total = np.hypot(density, unmodelled)
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
