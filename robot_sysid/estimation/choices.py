"""Model selection from recordings: each joint's friction terms, couplings, the prior of links.

In-sample errors fall with every friction term, so that terms are chosen by cross-validation
(``held_out``): from the simplest candidate on, as long as another one is clearly better.

A coupling is a motor that turns several joints, as where a wrist's last motor sits in the forearm.
One that turns at s = sum_j r_j qd_j (joint units) puts its torque tau_m on each of these joints as
r_j tau_m, because power is the same on both sides; its friction and rotor inertia follow s.

Shapes: the chain has n joints; "joints" counts those with equations; p parameters
(``Columns.names``), of which k are estimated; "blocks" are those of cross-validation.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from robot_sysid.dynamics.equations import names_of, split_name
from robot_sysid.dynamics.friction import (
    DEFAULT_MEASURED,
    NONLINEAR_TERMS,
    Coupling,
    FrictionModel,
    friction_model,
)
from robot_sysid.estimation.algebra.common_scale import is_notable_scale
from robot_sysid.estimation.algebra.least_squares import sample_counts
from robot_sysid.estimation.algebra.priors import (
    LinkEvidence,
    NuisanceGroup,
    WithPriors,
    average_scales,
    independent_prior,
    link_directions,
    link_evidence,
    link_lengths,
)
from robot_sysid.estimation.columns import Columns, Point
from robot_sysid.estimation.dataset import Dataset
from robot_sysid.estimation.fit import Fit, Fitter
from robot_sysid.estimation.held_out import HeldOut, is_clearly_lower
from robot_sysid.estimation.question import Choice, EstimationOptions, Question
from robot_sysid.estimation.unknowns import (
    COMMON_SCALE,
    LEAST_COULOMB,
    LINKS,
    PER_CENT,
    Unknowns,
)
from robot_sysid.model.chain import shared_motors
from robot_sysid.records import Array, RobotModel

CANDIDATES = (
    "coulomb-viscous-offset-armature",
    "coulomb-viscous-offset-armature-sqrt",
    "coulomb-viscous-offset-armature-stribeck",
    "coulomb-viscous-offset-armature-load",
    "sigmoid-viscous-offset-armature",
    "coulomb-viscous-offset-armature-sqrt-load",
    "coulomb-viscous-offset-armature-stribeck-load",
)
"""Friction models that are compared for each joint, simplest first."""
IN_FILE = CANDIDATES[0]
"""Friction model from which a model file gets the terms that it can hold."""
WITH_ALL = "coulomb-viscous-offset-armature-sqrt-stribeck-load"
"""Friction model flexible enough that large residuals under it mean bad rows of a recording."""
Errors = Mapping[str, Mapping[str, float]]
"""Joint to friction model to its held-out root mean square error [N m]."""


def choose(
    fitter: Fitter,
    question: Question,
    model: FrictionModel | None,
    couplings: tuple[Coupling, ...] | None = None,
) -> tuple[Choice, Errors, Point]:
    """Return (choice, held-out errors of friction models, point at which a fit may start).

    The choice contains friction terms, couplings, the common torque scale, dry friction, the
    autocorrelation of residuals and factors on the uncertainty of links.

    Args:
        fitter: fits the recordings; its cached rows and its noise are replaced.
        question: which parameters are wanted.
        model: friction of every joint; None selects it by joint, otherwise errors are empty.
        couplings: result of ``select_couplings``; None for all couplings that have columns.
    """
    couplings = fitter.columns.couplings if couplings is None else couplings
    # Most fits are one linearisation at the last point with the choices so far; () drops rows.
    joint_model = model or friction_model(CANDIDATES[0])
    choice = Choice((joint_model,) * fitter.columns.robot.n_joints, couplings)
    fit = replace(fitter.fit(question, choice, rounds=choice.speed_rounds), samples=())
    errors: Errors = {}
    if model is None and fitter.columns.torques == "chain":
        point = replace(fit.point, values=fit.values)
        noise = 1.0 / fit.weights
        del fit  # its evidence, before other rows are made
        choice, errors, point = _select_friction(fitter, question, choice, point, noise)
        fit = fitter.fit(question, choice, point, choice.speed_rounds)
        fit = replace(fit, samples=())
    if is_scaled(fit, question, choice):
        choice = replace(choice, common_scale=COMMON_SCALE)
        fit = fitter.fit(question, choice, fit.point, rounds=1)
    choice = replace(choice, dry_friction=dry_friction(fit))
    fit = fitter.fit(question, choice, fit.point, rounds=1)
    choice = replace(
        choice, correlation_factors=tuple(fitter.correlation_factors(fit).tolist())
    )
    fit = replace(fitter.fit(question, choice, fit.point, rounds=1), samples=())
    evidence = _link_evidence(fit)
    if evidence is not None:
        choice = replace(choice, link_scales=average_scales(evidence))
    return choice, errors, fit.point


def _link_evidence(fit: Fit) -> LinkEvidence | None:
    """Return the evidence of a fit on how far the other links are off the model's values.

    Only links count whose inertia the model states, not placeholders; None where there is none.
    """
    others = [group for group in fit.unknowns.groups if group.cause != LINKS]
    groups = fit.unknowns.groups_of(LINKS)
    if not groups:
        return None
    (group,) = groups
    columns = fit.columns
    # Whether the model states each link of the prior; indices and bodies of those that it states.
    is_stated = []
    stated = []
    bodies = []
    for index, link in enumerate(columns.robot.links):
        # Of several joints that move one body, all but the last have a link without mass.
        if link.has_mass and link.body_name in group.members:
            is_stated.append(columns.usual_bodies[link.body_name] is link.theta)
            if is_stated[-1]:
                stated.append(index)
                bodies.append(tuple(link.theta))
    if not stated:
        return None
    share = PER_CENT * fit.question.options.priors.link
    lengths = link_lengths(columns.robot, stated)
    # (10 L, 10 L + 2) effect of each error of the L stated links on their parameters.
    directions = share * link_directions(tuple(bodies), tuple(lengths))
    data = fit.evidence.of(fit.unknowns)
    return link_evidence(
        data, fit.weights, others, group, directions, np.array(is_stated)
    )


def _select_friction(
    fitter: Fitter, question: Question, choice: Choice, point: Point, noise: Array
) -> tuple[Choice, Errors, Point]:
    """Return (choice with selected friction terms, errors of all candidates, point).

    Terms are selected where they predict held-out torques clearly better. The point has the speeds
    of the selected nonlinear terms.

    Args:
        choice: all other choices, which stay.
        point: linearisation point, with the estimate for the simplest friction.
        noise: (joints,) effective standard deviation of torque noise around the point [N m].
    """
    squared, speeds, counts = _candidate_errors(fitter, question, choice, point, noise)
    friction = list(choice.friction)
    point_speeds = dict(point.speed or {})
    errors: dict[str, dict[str, float]] = {}
    # ``row`` counts the joints with equations, ``index`` those of the chain.
    for row, joint in enumerate(fitter.columns.joints):
        index = fitter.columns.joint_indices[row]
        block_counts = np.maximum(counts[:, row], 1.0)
        count = max(np.sum(counts[:, row]), 1.0)
        scores = {}
        errors[joint] = {}
        for name, error in squared.items():
            scores[name] = error[:, row] / block_counts
            errors[joint][name] = float(np.sqrt(np.sum(error[:, row]) / count))
        best = clearly_best(scores)
        friction[index] = friction_model(best)
        for term in friction[index].nonlinear_terms:
            point_speeds[term] = point_speeds[term].copy()
            point_speeds[term][index] = speeds[best][row]
    choice = replace(choice, friction=tuple(friction))
    return choice, errors, replace(point, speed=point_speeds)


def _candidate_errors(
    fitter: Fitter, question: Question, choice: Choice, point: Point, noise: Array
) -> tuple[dict[str, Array], dict[str, Array], Array]:
    """Return the held-out errors of all friction models in ``CANDIDATES``.

    A term that is nonlinear in a speed is tried at several speeds; each joint keeps the best one.

    Args:
        choice: all choices but friction.
        point: linearisation point, whose speeds are replaced by those on trial.
        noise: (joints,) effective standard deviation of torque noise [N m].

    Returns:
        (candidate to its squared errors (blocks, joints) [N^2 m^2], candidate to the speed
        (joints,) of its nonlinear term [rad/s], number of rows (blocks, joints)).
    """
    robot = fitter.columns.robot
    squared: dict[str, Array] = {}
    speeds: dict[str, Array] = {}
    n_trials = max(len(term.trial_speeds) for term in NONLINEAR_TERMS.values())
    for number in range(n_trials):
        trial_speeds = {}
        for term, nonlinear in NONLINEAR_TERMS.items():
            speed = nonlinear.trial_speeds[number]
            trial_speeds[term] = np.full(robot.n_joints, speed)
        data, _ = fitter.around(replace(point, speed=trial_speeds, exact_load=True))
        judge = HeldOut(data, noise)
        for name in CANDIDATES:
            model = friction_model(name)
            if number and not model.nonlinear_terms:  # all trials are the same
                continue
            trial = replace(choice, friction=(model,) * robot.n_joints)
            unknowns = data.unknowns(fitter.columns, question, trial)
            error = judge.squared_errors(unknowns)
            trial_speed = np.zeros(error.shape[1])
            for term in model.nonlinear_terms:
                trial_speed[:] = trial_speeds[term][0]
            # Each joint keeps the errors and the speed of its best trial so far.
            least = squared.setdefault(name, np.full_like(error, np.inf))
            lower = error.sum(axis=0) < least.sum(axis=0)
            squared[name] = np.where(lower, error, least)
            speeds[name] = np.where(lower, trial_speed, speeds.get(name, 0.0))
        counts = judge.counts
        # Before the next ones are made: they take as much memory as the rows.
        del data, judge
    return squared, speeds, counts


def clearly_best(scores: Mapping[str, Array]) -> str:
    """Return the friction model than which no other candidate is clearly better.

    The search starts at the first candidate. Of the candidates that are clearly better than the
    present one, it moves to the best of those with the fewest terms, until none is clearly better.

    Args:
        scores: name of a friction model to its mean squared held-out errors (blocks,) [N^2 m^2],
            simplest first.
    """
    best = next(iter(scores))
    while True:
        better = {}
        for name, score in scores.items():
            if is_clearly_lower(score, scores[best]):
                n_terms = len(friction_model(name).terms)
                better[name] = (n_terms, float(np.mean(score)))
        if not better:
            return best
        best = min(better, key=lambda name: better[name])


def is_scaled(fit: Fit, question: Question, choice: Choice) -> bool:
    """Tell whether recordings show a significant error that the torque scales of all joints share.

    Torques that read too large and model links that are too heavy by one factor give the same
    rows, so that the error may as well be that of all links. Always false where an option states
    the scales, or with a payload.
    """
    scaled_choice = replace(choice, common_scale=COMMON_SCALE)
    unknowns = fit.evidence.unknowns(fit.columns, question, scaled_choice)
    if not unknowns.may_be_scaled(question):
        return False
    names = names_of("scale", fit.columns.joints)
    scales, covariance = posterior_of(fit, unknowns, names)
    return is_notable_scale(scales, covariance)


def posterior_of(
    fit: Fit, unknowns: Unknowns, names: Sequence[str]
) -> tuple[Array, Array]:
    """Return the estimate (m,) and covariance (m, m) of named unknowns, around a fit's point.

    Args:
        fit: gives the data and the weights of equations.
        unknowns: parameters to estimate and their priors, which replace those of the fit.
        names: (m,) of estimated parameters among ``unknowns``.
    """
    problem = WithPriors(fit.evidence.of(unknowns), 1.0 / fit.weights)
    values, covariance, _ = problem.solve(unknowns.groups)
    indices = np.searchsorted(unknowns.estimated, fit.columns.indices(names))
    return values[indices], covariance[np.ix_(indices, indices)]


def dry_friction(fit: Fit) -> tuple[float, ...]:
    """Return the dry friction (joints,) of a fit [N m]: Coulomb and sigmoid terms added up."""
    sizes = np.zeros(len(fit.columns.joints))
    for term in ("coulomb", "sigmoid"):
        indices = fit.columns.indices(names_of(term, fit.columns.joints))
        sizes += np.abs(fit.values[indices])
    return tuple(sizes.tolist())


CLEAR_EVIDENCE = 15.0
"""Least increase of the log marginal likelihood that shows a coupling. The coupling of a Staubli
TX40's wrist gives 114 to 148. Arms without couplings give 3 at most on three logs of a KUKA LWR4+,
and 13 on 12 s of a UR10e."""
# Factor on the prior standard deviations of a motor's parameters that makes the motor absent.
_ABSENT = 1e-4
# Least prior standard deviation of a motor's parameters [SI].
_LEAST = 1e-9
# Least distance of one of a motor's parameters from zero, in standard errors.
_CLEAR = 3.0
# Cosine between speed ratios of two motors above which they are one motor.
_SAME_DIRECTION = 1.0 - 1e-9


def _coupling_name(robot: RobotModel, ratios: Array) -> str:
    """Return the name of a coupling with ratios (n,), such as "joint_5+0.5*joint_6"."""
    text = ""
    for joint, ratio in zip(robot.joint_names, ratios):
        if ratio < 0.0:
            text += "-"
        elif ratio > 0.0 and text:
            text += "+"
        if ratio != 0.0:
            text += joint if abs(ratio) == 1.0 else f"{abs(ratio):g}*{joint}"
    return text


def coupling(robot: RobotModel, ratios: Array, tendon: int | None = None) -> Coupling:
    """Return the coupling of a motor with several joints, named after them ("joint_5+joint_6").

    Args:
        ratios: (n,) motor speed per joint speed, zero for joints it does not turn with.
        tendon: MuJoCo id of the model's fixed tendon that is this motor, which gives the model's
            friction and rotor inertia; None where the model has none.
    """
    name = _coupling_name(robot, ratios)
    motor = Coupling(np.asarray(ratios, dtype=float), name)
    if tendon is None:
        return motor
    model = robot.mj_model
    tendon_values = {
        "coulomb": model.tendon_frictionloss[tendon],
        "viscous": model.tendon_damping[tendon],
    }
    if hasattr(model, "tendon_armature"):  # since MuJoCo 3.2.7
        tendon_values["armature"] = model.tendon_armature[tendon]
    of_model = np.array([float(tendon_values.get(term, 0.0)) for term in motor.terms])
    return replace(motor, model=of_model, tendon=tendon)


def couplings_of_model(robot: RobotModel) -> tuple[Coupling, ...]:
    """Return the model's fixed tendons that are motors which turn several joints of the arm.

    A tendon without friction and rotor inertia is no motor, but a spring or a gripper's fingers.
    """
    motors = []
    for tendon, ratios in shared_motors(robot.mj_model, robot.dof_index).items():
        motor = coupling(robot, ratios, tendon)
        if np.any(motor.model):
            motors.append(motor)
    return tuple(motors)


def neighbours(robot: RobotModel) -> Iterator[Coupling]:
    """Yield the couplings of each joint with the next one, with ratios (1, 1) and (1, -1)."""
    for joint in range(robot.n_joints - 1):
        for sign in (1.0, -1.0):
            ratios = np.zeros(robot.n_joints)
            ratios[joint : joint + 2] = 1.0, sign
            yield coupling(robot, ratios)


def couplings_of(
    robot: RobotModel, options: EstimationOptions
) -> tuple[tuple[Coupling, ...], tuple[Coupling, ...]]:
    """Return (couplings that get regressor columns, the offered ones of these, which come last).

    Offered couplings are used only where the recordings show them (``select_couplings``).
    Couplings of the model are used without evidence. Torques of the last joint alone identify no
    coupling.
    """
    if options.torques != "chain":
        return (), ()
    of_model = couplings_of_model(robot)
    offered = tuple(_missing(neighbours(robot), of_model))
    return (*of_model, *offered), offered


def columns_of(
    robot: RobotModel, datasets: Sequence[Dataset], options: EstimationOptions
) -> Columns:
    """Return the columns of recordings with all couplings of ``couplings_of``."""
    return Columns(robot, datasets, options.torques, couplings_of(robot, options)[0])


def _missing(
    motors: Iterable[Coupling], present: Sequence[Coupling]
) -> Iterator[Coupling]:
    """Yield the motors whose ratios are not parallel to those of any present one."""
    for motor in motors:
        direction = motor.ratios / np.linalg.norm(motor.ratios)
        cosines = [0.0]
        for other in present:
            other_direction = other.ratios / np.linalg.norm(other.ratios)
            cosines.append(abs(float(direction @ other_direction)))
        if max(cosines) <= _SAME_DIRECTION:
            yield motor


def select_couplings(
    fitter: Fitter,
    question: Question,
    model: FrictionModel | None,
    offered: tuple[Coupling, ...],
) -> tuple[Coupling, ...]:
    """Return the couplings that need no evidence and the offered ones that have clear evidence.

    A motor is selected where it makes the torques clearly more likely, with noise estimated anew,
    and one of its parameters is clearly not zero. Joint torque sensors behind the gears do not
    measure the friction of motors, so that no coupling is selected with them.

    Args:
        model: friction of every joint, where the user states it; None for the default.
        offered: couplings that need evidence, the last ones of ``fitter.columns.couplings``.
    """
    couplings = fitter.columns.couplings
    joint_model = model or friction_model(DEFAULT_MEASURED)
    choice = Choice(
        (joint_model,) * fitter.columns.robot.n_joints,
        couplings[: len(couplings) - len(offered)],
    )
    fit = fitter.fit(question, choice, rounds=1)
    while True:
        best_gain = CLEAR_EVIDENCE
        best = fit
        for motors in _promising_couplings(fit, question, offered):
            wider_choice = replace(fit.choice, couplings=motors)
            wider = fitter.solve_around(fit.point, question, wider_choice)
            gain = _evidence_gain(fit, wider)
            if gain > best_gain:
                best_gain = gain
                best = wider
        if best is fit:
            return fit.choice.couplings
        fit = best


def _promising_couplings(
    fit: Fit, question: Question, offered: Sequence[Coupling]
) -> list[tuple[Coupling, ...]]:
    """Return at most two sets of couplings: those of a fit and one of the two best offered motors.

    A motor's gain is the increase of the log marginal likelihood when its prior has its full width
    in place of ``_ABSENT`` times that, which holds its parameters at zero. Gains are compared with
    the noise of the fit and without bounds on friction, which is cheaper than a fit of each motor;
    motors without a gain are left out.
    """
    present = fit.choice.couplings
    present_names = [motor.name for motor in present]
    candidates = [motor for motor in offered if motor.name not in present_names]
    if not candidates:
        return []
    choice = replace(fit.choice, couplings=(*present, *candidates))
    unknowns = fit.evidence.unknowns(fit.columns, question, choice)
    problem = WithPriors(
        fit.evidence.of(unknowns), np.sqrt(fit.residual_correlation) * fit.noise
    )
    priors = [_motor_prior(fit, unknowns, motor) for motor in candidates]
    absent = [replace(prior, widened=_ABSENT) for prior in priors]
    _, evidence_without = problem.log_evidence([*unknowns.groups, *absent])
    gains = []
    for k, prior in enumerate(priors):
        groups = [*unknowns.groups, *absent[:k], prior, *absent[k + 1 :]]
        _, evidence_with = problem.log_evidence(groups)
        gains.append(evidence_with - evidence_without)
    best = np.argsort(gains)[::-1][:2]
    return [(*present, candidates[k]) for k in best if gains[k] > 0.0]


def _evidence_gain(fit: Fit, wider: Fit) -> float:
    """Return the increase of the log marginal likelihood by the last motor of a wider fit.

    Each fit counts with its own noise, so that sum_j n_j log(noise_j / noise of the wider fit) is
    added, n_j the number of independent samples, from the residuals of the wider fit. The result is
    minus infinity where none of the motor's parameters is clearly not zero.

    Args:
        fit: without the motor.
        wider: with the motor as the last of its couplings.
    """
    prior = _motor_prior(fit, wider.unknowns, wider.choice.couplings[-1])
    priors = [*wider.unknowns.groups, prior]
    correlation = wider.residual_correlation
    problem = WithPriors(
        wider.evidence.of(wider.unknowns), np.sqrt(correlation) * wider.noise
    )
    values, covariance, _ = problem.solve(priors)
    indices = prior.indices(wider.unknowns.estimated_names)
    errors = np.sqrt(np.diag(covariance)[indices])
    if not np.any(np.abs(values[indices]) > _CLEAR * errors):
        return -np.inf
    problem_without = WithPriors(
        fit.evidence.of(fit.unknowns), np.sqrt(correlation) * fit.noise
    )
    counts = np.array(sample_counts(fit.evidence.total)) / correlation
    less_noise = float(counts @ np.log(fit.noise / wider.noise))
    _, evidence_with = problem.log_evidence(priors)
    _, evidence_without = problem_without.log_evidence(fit.unknowns.groups)
    return evidence_with - evidence_without + less_noise


def _motor_prior(fit: Fit, unknowns: Unknowns, motor: Coupling) -> NuisanceGroup:
    """Return the prior of the parameters of a motor that turns several joints, around zero.

    The standard deviation of a term (Coulomb friction, rotor inertia, ...) is the largest value
    that the term has at one of these joints in a fit, and at least such that it makes a share
    ``LEAST_COULOMB`` of a joint's root mean square torque.
    """
    columns = fit.columns
    names = [name for name in motor.parameter_names if name in unknowns.estimated_names]
    sizes = []
    for name in names:
        term, _ = split_name(name)
        size = _LEAST
        for joint in np.flatnonzero(motor.ratios):
            joint_name = columns.robot.joint_names[joint]
            joint_value = float(fit.values[columns.index[f"{term}[{joint_name}]"]])
            size = max(size, abs(joint_value))
            # Root mean square of the motor's column in the joint's rows: torque per unit.
            rows = fit.evidence.total.joints[joint]
            column = rows.triangle[:, :-1][:, rows.columns == columns.index[name]]
            root = np.sqrt(max(rows.n_samples, 1))
            column_size = float(np.linalg.norm(column)) / root
            if column_size > 0.0:
                least_torque = LEAST_COULOMB * fit.evidence.torque[joint]
                size = max(size, least_torque / column_size)
        sizes.append(size)
    return independent_prior("couplings", names, names, np.array(sizes))
