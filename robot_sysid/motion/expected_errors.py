"""What an identification will make of a recording of a planned motion, before there is one.

The planned motion is treated like a log of it would be: its ends are cut off, all columns pass the
low-pass, and moments in which a joint is too slow are left out. What remains has the covariance
that the estimate itself states, with the same unknowns and the same priors, cause by cause. The
search for a motion gets these priors from here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from robot_sysid.dynamics.newton_euler import split_motion
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.consistent_bodies import (
    project_errors,
    projected_covariance,
)
from robot_sysid.estimation.algebra.identifiability import describe, triangle_space
from robot_sysid.estimation.algebra.priors import (
    EXPECTED,
    NuisanceGroup,
    false_alarms,
    with_prior,
)
from robot_sysid.estimation.algebra.uncertainty import (
    Uncertainty,
    triangle_of,
    uncertainty,
    whole_triangle,
)
from robot_sysid.estimation.choices import CANDIDATES, couplings_of
from robot_sysid.estimation.columns import PAYLOAD_NAMES, Columns
from robot_sysid.estimation.dataset import Dataset, mean_torque
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
    common_error,
    expected_dry_friction,
    scale_spread,
)
from robot_sysid.motion import information, prediction
from robot_sysid.motion.information import Criterion, Known
from robot_sysid.motion.prediction import Prediction, Remedy
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.records import Array, Measurement, MotionPlan, SquareRootInformation
from robot_sysid.records.messages import percent
from robot_sysid.signals.resampling import join_measurements
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import motion_chunks, sample_count

UNUSABLE = "that is from all samples, but they cannot all be used"
HIGHEST_RATE_HZ = 200.0
"""Rate at which the motion is processed: far above its band. Noise is scaled to it."""
MOST_SAMPLES = 200_000
"""Samples beyond which processing a motion beforehand would take too long."""
LONGER = 4.0
FASTER = 1.5
BETTER = 0.5
"""By how much longer and faster, and to which part of the error of the links, remedies are told."""
_INSTANTS = 10.0
_FEWEST = 100
_MOST = 4000
"""Instants of a motion per second that a remedy is worked out from, and at least and at most."""
_NOISELESS = 1e-4
"""Torque noise that hides nothing [N m]."""
_NEARLY = 1.0 - 1e-6
"""Share of the variance of a mass that weighing takes away."""
_NOTHING = 100.0
"""How many times its size a parameter may be off where all that is told is rounding."""
NOISE = "torque noise"
DOUBTED = (
    "links that are all off alike look like a scale of all torques (--scale-uncertainty says how "
    "far those may be off at most)"
)
_OFTEN = 0.05
"""Share of recordings from which on that is told."""
_PAYLOAD = prediction.WEIGHED * np.eye(10)[0]
"""One at the origin of the last link."""
_How = tuple[float, EstimationOptions, str]
"""The sample rate and what follows it in ``expect``."""


def known_of(
    problem: ExcitationProblem, options: EstimationOptions, asked: str
) -> Known:
    """Return what an estimate knows of the arm before there is a recording, and what is asked."""
    robot = problem.robot
    own = np.zeros((len(information.OWN), len(problem.rows)))
    if asked == "payload":
        # Of the difference of two recordings only what changes between them is left.
        own[0] = DRIFTS * robot.friction.coulomb[list(problem.rows)]
        own[1] = DRIFTS * robot.friction.viscous[list(problem.rows)]
        return Known(np.zeros((0, 0)), own, asked)
    choice = _choice(problem, options)
    question = Question(options)
    columns = Columns(robot, (), options.torques, choice.couplings)
    rng = np.random.default_rng(0)
    limits = problem.limits
    poses = rng.uniform(limits.lower, limits.upper, (100, robot.n_joints))
    torque = np.sqrt(np.mean(problem.torque_at(poses) ** 2, axis=0))
    choice = replace(choice, dry_friction=expected_dry_friction(columns, torque))
    sought = build_unknowns(
        columns, question, choice, torque, np.ones(len(columns.names), dtype=bool)
    )
    factor = np.zeros((0, 0))
    sure = dict[str, float]()
    for group in sought.groups:
        sure.update(zip(group.names, np.sqrt(np.sum(group.factor**2, axis=1)).tolist()))
        if group.cause == LINKS:
            n = len(group.mean)
            factor = group.factor.reshape(-1, 10, n)[::-1].reshape(-1, n)
    for place, term in enumerate(information.OWN):
        for row, joint in enumerate(columns.joints):
            name = f"{term}[{joint}]"
            free = (
                np.inf
                if term in choice.friction[columns.joint_indices[row]].terms
                else 0.0
            )
            own[place, row] = sure.get(name, free)
    return Known(factor, own, asked)


def _choice(problem: ExcitationProblem, options: EstimationOptions) -> Choice:
    """Return the friction that the estimate begins with, and the couplings that are known."""
    given = (
        options if options.friction else replace(options, friction_model=CANDIDATES[0])
    )
    assert given.friction is not None
    motors, offered = couplings_of(problem.robot, options)
    friction = (given.friction,) * problem.robot.n_joints
    return Choice(friction, motors[: len(motors) - len(offered)], link_scales=EXPECTED)


def expect(
    problem: ExcitationProblem,
    plan: MotionPlan,
    sample_rate: float,
    options: EstimationOptions,
    asked: str = "link",
) -> Prediction:
    """Predict what an identification of a recording of a motion will state.

    Args:
        problem: the arm, its limits, and the torque noise.
        sample_rate: at which it will be recorded, with independent noise in each sample [Hz].
        options: how it will be identified.
        asked: what is to be identified, see ``Known``.
    """
    how = sample_rate, options, asked
    robot = problem.robot
    known = known_of(problem, options, asked)
    told = information.criterion(problem, known)
    own_size = prediction.sizes(problem)
    of = robot.body_name
    theta = robot.prior.theta
    size = own_size
    scaled = 0.0
    if asked == "payload":
        of = f"a payload of {prediction.WEIGHED:g} kg"
        theta = _PAYLOAD
        size = own_size / robot.prior.mass
        scaled = _read_alike(problem, options)
    others = dict[str, float]()
    missing = ""
    doubt = None
    try:
        after = _posterior(problem, plan, how)
    except InputError as error:
        missing = f"{UNUSABLE}: {error}"
        covariance = told.covariance(_told(problem, plan, sample_rate, known)).copy()
        variance = np.diag(covariance)
        # What is known to no part of its size is not known.
        shown = (variance > 0.0) & (variance < (_NOTHING * own_size) ** 2)
        np.fill_diagonal(covariance, np.where(shown, variance, np.inf))
        causes = {NOISE: covariance}
    else:
        names = PAYLOAD_NAMES if asked == "payload" else PARAMETER_NAMES
        sought = after.sought
        found = after.found
        places = [sought.estimated_names.index(name) for name in names]
        own = np.ix_(places, places)
        parts = {cause: rows[:, places] for cause, rows in after.causes.items()}
        causes = {
            NOISE: found.noise[own],
            **{c: rows.T @ rows for c, rows in parts.items()},
        }
        covariance = found.covariance[own]
        np.fill_diagonal(covariance, found.standard_errors[places] ** 2)
        others = dict(_masses(problem, sought, found)) if asked == "arm" else {}
        if after.doubted > _OFTEN:
            words = f"In about {percent(after.doubted)} of recordings {DOUBTED}"
            then = projected_covariance(theta, after.then.covariance[own])
            doubt = Remedy(words, *information.spread_of(theta, then))
    rest = _never(problem, told), _best_first(problem, plan, how, known, told)
    return Prediction(
        of, theta, size, covariance, causes, others, *rest, missing, scaled, doubt
    )


def _read_alike(problem: ExcitationProblem, options: EstimationOptions) -> float:
    """Return by what share all torques, a payload's weight too, may read too much alike."""
    columns = Columns(problem.robot, (), options.torques)
    return common_error(scale_spread(columns, options, loaded=True))


@dataclass(frozen=True)
class _Posterior:
    """What is sought, how well it is known, and why beside noise (see ``FitErrors``); in which
    share of recordings all torque scales are doubted, and how well it is known then.
    """

    sought: Unknowns
    found: Uncertainty
    causes: Mapping[str, Array]
    doubted: float
    then: Uncertainty


def _posterior(problem: ExcitationProblem, plan: MotionPlan, how: _How) -> _Posterior:
    """Return what an estimate from a recording knows."""
    sample_rate, options, asked = how
    rate = min(sample_rate, HIGHEST_RATE_HZ)
    sigma = problem.sigma * np.sqrt(rate / sample_rate)
    robot = problem.robot
    choice = _choice(problem, options)
    is_loaded = asked == "payload"
    (dataset,), _ = low_pass_recordings(
        robot, [Piece("", _rehearsal(problem, plan, rate))], options
    )
    datasets: Sequence[Dataset] = (dataset,)
    assert dataset.signals is not None
    if is_loaded:
        datasets = (
            replace(dataset, order=-1.0),
            replace(dataset, is_loaded=True, order=1.0),
        )
    columns = Columns(robot, datasets, options.torques, choice.couplings)
    torque = mean_torque(datasets)
    data = evidence_of([columns.samples(columns.start())], torque)
    choice = replace(choice, dry_friction=expected_dry_friction(columns, torque))
    question = Question(options, loaded=is_loaded, drifts=is_loaded)
    told = torque, data.nonzero
    sought = build_unknowns(columns, question, choice, *told)
    plain = data.of(sought)
    # Rows count by the noise that is left in each. They are slow: what counts of white noise that
    # passed the filter is its density at low frequencies, which the filter leaves alone, spread
    # over the samples each row stands for.
    low_pass = dataset.signals.low_pass
    left = sigma * np.sqrt(np.sum(low_pass.kernel**2))
    counts = 1.0 / left, sigma / np.sqrt(low_pass.step)
    known = partial(_with_known, plain, counts, whole_triangle(plain, counts[0]))
    found = known(sought.groups)
    causes = {
        g.cause: g.covariance_rows(plain.names, found.inverse) for g in sought.groups
    }
    doubt = 0.0, found
    if sought.may_be_scaled(question):
        wider = build_unknowns(
            columns, question, replace(choice, common_scale=COMMON_SCALE), *told
        )
        doubt = _doubt(sought, found, wider, known(wider.groups))
    if not is_loaded:
        at, usual = sought.bodies[robot.body_name]
        found, causes = project_errors(
            found, causes, np.searchsorted(sought.estimated, at), usual, usual
        )
    return _Posterior(sought, found, causes, *doubt)


def _with_known(
    plain: SquareRootInformation,
    counts: tuple[Array, Array],
    triangle: Array,
    groups: Sequence[NuisanceGroup],
) -> Uncertainty:
    """Return how well data, whose triangle it is by its weights, and priors tell all."""
    both = with_prior(plain, groups)
    whole = triangle if both.prior is None else triangle_of((triangle, both.prior))
    return uncertainty(both, *counts, space=triangle_space(whole[:, :-1]))


def _doubt(
    sought: Unknowns, found: Uncertainty, wider: Unknowns, then: Uncertainty
) -> tuple[float, Uncertainty]:
    """Return in which share of recordings a scale of all torques is doubted, and how well what is
    sought is known then, where there may as well be none.

    Args:
        sought, found: without a scale of all torques; ``wider`` and ``then``: with one.
    """
    pairs = []
    for asked, after in ((sought, found), (wider, then)):
        scales = next(group for group in asked.groups if group.cause == SCALES)
        places = scales.indices(asked.estimated_names)
        pairs.append(
            (scales.factor @ scales.factor.T, after.inverse[np.ix_(places, places)])
        )
    share, told = false_alarms(*pairs)
    moved = then.inverse[:, places]
    return share, then.with_cause(0.5 * moved @ told @ moved.T)


def friction_lines(
    problem: ExcitationProblem,
    plan: MotionPlan,
    rate: float,
    options: EstimationOptions,
) -> Iterator[str]:
    """Say how well an identification of one recording will know each joint's friction."""
    try:
        after = _posterior(problem, plan, (rate, options, "link"))
    except InputError:
        return
    for term, unit in (("coulomb", "N·m"), ("viscous", "N·m·s/rad")):
        errors = dict(zip(after.sought.estimated_names, after.found.standard_errors))
        names = {joint: f"{term}[{joint}]" for joint in problem.joint_names}
        listed = ", ".join(
            f"{j} {errors[n]:.2g}" for j, n in names.items() if n in errors
        )
        yield f"{term.capitalize()} friction will be known to ± {listed} {unit}"


def _rehearsal(
    problem: ExcitationProblem, plan: MotionPlan, rate: float
) -> Measurement:
    """Return what a recording of the motion at ``rate`` [Hz] would look like, without noise."""
    if sample_count(plan.duration, rate) > MOST_SAMPLES:
        raise InputError(
            f"only motions up to {MOST_SAMPLES / rate:.0f} s are processed beforehand"
        )
    exact = join_measurements(
        simulate_inverse(problem.robot, motion_chunks(plan, rate))
    )
    return replace(exact, qd=None, qdd=None)


def _masses(
    problem: ExcitationProblem, sought: Unknowns, found: Uncertainty
) -> Iterator[tuple[str, float]]:
    """Yield other link and the share that its mass will be known to."""
    masses = {link.body_name: float(link.theta[0]) for link in problem.robot.links}
    for name, (places, _) in sought.bodies.items():
        if name != problem.robot.body_name:
            place = int(np.searchsorted(sought.estimated, places[0]))
            yield name, float(found.standard_errors[place]) / masses[name]


def _never(problem: ExcitationProblem, told: Criterion) -> tuple[str, ...]:
    """Return what no motion of these joints can show, in words."""
    possible = told.seen / problem.scale[:, None]
    left, singular, _ = np.linalg.svd(possible, full_matrices=True)
    space = left[:, len(singular) :]
    return (
        tuple(describe(space, problem.scale, PARAMETER_NAMES)) if space.shape[1] else ()
    )


def _told(
    problem: ExcitationProblem,
    plan: MotionPlan,
    rate: float,
    known: Known,
    faster: float = 1.0,
) -> Array:
    """Return the information of a path that is recorded at a rate [Hz], gone along faster."""
    count = int(np.clip(_INSTANTS * plan.duration, _FEWEST, _MOST))
    motion = plan.evaluate((np.arange(count) + 0.5) * plan.duration / count)
    sigma = problem.sigma * np.sqrt(count / (rate * plan.duration))
    moved = motion.q, faster * motion.qd, faster**2 * motion.qdd
    predicted = information.predicted_information(problem, sigma, known)
    parts = split_motion(10 * problem.n_joints**2, *moved)
    return np.asarray(sum(predicted.evaluate(*part).information for part in parts))


def _remedies(
    problem: ExcitationProblem,
    plan: MotionPlan,
    how: _How,
    known: Known,
    told: Criterion,
) -> Iterator[Remedy]:
    """Yield what would tell more than a motion does, with the errors of mass and centre then."""
    rate, options, asked = how
    theta = _PAYLOAD if asked == "payload" else problem.robot.prior.theta
    tell = partial(_told, problem, plan, rate)
    here = tell(known)
    quick = tell(known, faster=FASTER)

    def remedy(
        words: str, covariance: Array, *planned: str, loaded: bool = asked == "payload"
    ) -> Remedy:
        scaled = loaded * _read_alike(problem, options) * theta[0]
        covariance = covariance if loaded else projected_covariance(theta, covariance)
        mass, centre = information.spread_of(theta, covariance)
        return Remedy(words, float(np.hypot(mass, scaled)), centre, planned)

    longer = ("--duration", f"{LONGER * plan.duration:.3g}")
    yield remedy(
        f"a motion {LONGER:g} times as long", told.covariance(LONGER * here), *longer
    )
    yield remedy(
        f"a motion {FASTER:g} times as fast, over the same time", told.covariance(quick)
    )
    if asked == "payload":
        return
    if len(known.factor):
        better = replace(told, factor=BETTER * known.factor).covariance(here)
        half = f"{BETTER * options.link_uncertainty:g}"
        yield remedy(f"other links known to {half} % (--link-uncertainty)", better)
    covariance = told.covariance(here)
    sure = (
        covariance - _NEARLY * np.outer(covariance[0], covariance[0]) / covariance[0, 0]
    )
    weighed = remedy("its mass known, by weighing the part", sure)
    yield replace(weighed, mass=0.0)
    apart = known_of(problem, options, "payload")
    difference = information.criterion(problem, apart).covariance(tell(apart))
    bolted = "what is bolted to it as a payload by difference (plan --for payload)"
    yield remedy(bolted, difference, "--for", "payload", loaded=True)


def _best_first(
    problem: ExcitationProblem,
    plan: MotionPlan,
    how: _How,
    known: Known,
    told: Criterion,
) -> tuple[Remedy, ...]:
    """Return what would tell more, what leaves the least error of the centre of mass first."""
    places = plan.evaluate(np.linspace(0.0, plan.duration, 9)).q
    if len(problem.rows) == 1 or np.all(places == places[0]):
        return ()
    found = _remedies(problem, plan, how, known, told)
    return tuple(sorted(found, key=lambda each: each.centre))


def outlook(problem: ExcitationProblem, plan: MotionPlan, how: _How) -> str:
    """Say before a search what no motion tells of a link, and what would; "" where one can.

    Any motion leaves what the priors leave where there is no noise. Remedies are worked out along
    a motion that is not designed yet.
    """
    _, options, asked = how
    known = known_of(problem, options, asked)
    mass = problem.robot.prior.mass
    told = information.criterion(problem, known)
    least = told.covariance(information.random_information(problem, known, _NOISELESS))
    least = (
        least
        if asked == "payload"
        else projected_covariance(problem.robot.prior.theta, least)
    )
    floor, centre = information.spread_of(problem.robot.prior.theta, least)
    if asked == "payload" or not floor > prediction.LOOSE_SHARE * mass:
        return ""
    remedies = _best_first(problem, plan, how, known, told)
    listed = "; ".join(
        f"{each.words}: {prediction.remedy_figures(each)}" for each in remedies
    )
    return (
        f"no motion of this arm tells the mass of {problem.robot.body_name}, {mass:.2g} kg, better "
        f"than ± {floor:.2g} kg and its centre of mass than ± {1e3 * centre:.2g} mm: that much may "
        f"be in the links before it, known to {options.link_uncertainty:g} %. What would help, "
        f"along a random motion: {listed}"
    )
