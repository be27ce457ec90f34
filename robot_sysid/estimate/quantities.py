"""From fits to rows: the numbers of bodies, joints, motors, sensors and of the model file.

Dry, viscous, bending and fading friction trade with one another, so that none of them is known well
where their sum is: friction at rest is what is left when a curve is drawn on beyond the slowest
rows. What a log does tell is the line that is nearest to the sum at its own speeds and loads. With
the columns F of all friction of a joint in its rows, of which L are those of the line, it is

    (L' L)^-1 L' F x,

a combination of the parameters x, whose error follows from their covariance. The line of friction
that is curved also depends on the speeds that a log happens to have: its error has the jackknife of
that over blocks (``fit``) as well.

Shapes: n joints of the chain, J joints with equations; k estimated parameters; B blocks; a body has
ten inertial parameters (``PARAMETER_NAMES``).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import BEND, OFFSET, POLYNOMIAL, ROTOR, TERMS
from robot_sysid.estimate.choose import fastest_of, speeds_in
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.identifiability import fit_quality, square_root
from robot_sysid.estimate.restricted_fit import bent_owners, straight_of
from robot_sysid.estimate.terms import (
    FRICTION,
    FURTHER_FRICTION,
    LAST_LINK,
    MOTORS,
    PAYLOAD,
    ZEROS,
    ArmTerms,
    Term,
)
from robot_sysid.records import Array, FitQuality, InertialParameters
from robot_sysid.records.levels import BARE, FALSE_ALARMS
from robot_sysid.records.messages import position_unit, torque_unit
from robot_sysid.records.parameters import INERTIAL, Parameter
from robot_sysid.records.quantities import (
    BEYOND,
    BEYOND_INERTIA,
    BOUND,
    DATA,
    DIFFERENCE,
    LEAST_SEEN,
    MODEL,
    MOMENT,
    NOT_SHOWN,
    PRIOR_SHARE,
    BodyEstimate,
    FrictionCurve,
    Quantity,
    body_quantities,
)
from robot_sysid.records.usual_errors import FRICTION_CHANGE

# Causes that are of joints and their motors.
_OF_JOINTS = (FRICTION, MOTORS)
FURTHER = "further_"
"""Beginning of the name of friction that the friction model lacks, which errors allow for."""
CURVE_SHARES = (0.1, 0.4, 1.0)
"""Speeds at which friction that bends is stated, over the highest one of the logs: where most of
it is dry, in the bend, and at the end of what is known."""


def beyond_model(link: BodyEstimate, usual: Array) -> Iterator[Quantity]:
    """Yield numbers of what is on a link beyond its model.

    Whether anything is there is asked of all ten numbers together, and of the mass alone, which
    whatever is there adds. With the difference d to the model, the covariance C of its errors and
    that U of the usual errors of a model's link, d' (C + U)^-1 d is a chi-square where nothing is
    there. The first row is this over the value that by chance it exceeds too seldom (``BARE``, of
    the mass ``FALSE_ALARMS``), the larger one of both; the second the mass that is seen by itself.

    The other rows are of the difference, beside which the model's numbers count as exact: mass
    times distance of its centre from the link's frame, mass, centre of mass, and the moments of
    inertia about the frame's origin.

    Args:
        link: estimated without a prior.
        usual: Cholesky factor (10, 10) of U.
    """
    if link.prior is None:
        return
    theta = link.theta - link.prior.theta
    covariance = link.covariance + usual @ usual.T
    of_all = _chi_square(theta, covariance, link.is_determined)
    of_all /= chi_square_level(max(int(np.sum(link.is_determined)), 1), BARE)
    least = math.sqrt(chi_square_level(1, FALSE_ALARMS) * covariance[0, 0])
    ratio = max(of_all, (theta[0] / least) ** 2 * link.is_determined[0])
    yield Quantity(DIFFERENCE, BEYOND, "", None, float(ratio), 0.0)
    yield Quantity(LEAST_SEEN, BEYOND, "kg", None, least, 0.0)
    beyond = replace(link, name=BEYOND, theta=theta, prior=None)
    moment, error = beyond.moment_along(beyond.first_moment)
    yield Quantity(MOMENT, BEYOND, INERTIAL[1].unit, None, moment, error)
    rows = [*body_quantities(beyond)]
    yield from rows[:4]
    for row in rows:
        if row.name in BEYOND_INERTIA:
            yield replace(row, name=BEYOND_INERTIA[row.name])


def _chi_square(off: Array, covariance: Array, shown: NDArray[np.bool_]) -> float:
    """Return the square of numbers (k,) over their covariance (k, k), of those that are shown."""
    scale = np.sqrt(np.diag(covariance)[shown])
    relative = off[shown] / scale
    correlation = covariance[np.ix_(shown, shown)] / np.outer(scale, scale)
    return float(relative @ np.linalg.solve(correlation, relative))


def chi_square_level(count: int, share: float) -> float:
    """Return the value that a chi-square of some numbers exceeds in a share of all cases.

    Of k numbers it is k (1 - 2 / (9 k) + z sqrt(2 / (9 k)))^3, where z is what a normal number
    exceeds as often (Wilson and Hilferty, "The distribution of chi-square", PNAS 17(12), 1931).
    """
    ninth = 2.0 / (9.0 * count)
    normal = NormalDist().inv_cdf(1.0 - share)
    return float(count * (1.0 - ninth + normal * math.sqrt(ninth)) ** 3)


def fit_quantities(
    fitted: Fit, file: Fit | None, links: Iterable[BodyEstimate]
) -> list[Quantity]:
    """Return the rows of a fit: of its links, of joints and motors, of sensors and recordings.

    Friction is that of the model file, ``file``, where there is one.
    """
    rows = [row for link in links for row in body_quantities(link)]
    rows += joint_quantities(fitted) if file is None else friction_in(fitted, file)
    # A bend that is written is no further friction.
    told = {(row.name, row.of) for row in rows}
    for row in sensors(fitted):
        if (row.name.removeprefix(FURTHER), row.of) not in told or row.of == "arm":
            rows.append(row)
    return rows


def select(fitted: Fit, names: Sequence[str]) -> Array:
    """Return the 0/1 matrix (m, k) that selects named estimated parameters."""
    return np.eye(len(fitted.names))[fitted.at(names)]


def body_estimate(
    fitted: Fit,
    name: str,
    combinations: Array,
    values: Array,
    prior: InertialParameters | None = None,
) -> BodyEstimate:
    """Return a body whose parameters are combinations (10, k) of the estimated ones.

    Args:
        values: (k,) of the estimated ones.
        prior: parameters in the model; None where the model lacks the body.
    """
    budget = fitted.budget(combinations)
    covariance = combinations @ fitted.covariance @ combinations.T
    if fitted.question.odd_zeros:
        # A file lacks zeros: its bodies take up the torque of one that is far off.
        taken = combinations @ (values - fitted.values)
        covariance = covariance + np.outer(taken, taken)
        budget[ZEROS] = np.hypot(budget.get(ZEROS, 0.0), taken)
    weight = np.abs(combinations)
    share = weight @ fitted.share() / np.maximum(np.sum(weight, axis=1), 1e-300)
    hidden = weight[:, fitted.is_hidden]
    return BodyEstimate(
        theta=combinations @ values,
        name=name,
        covariance=covariance,
        is_determined=np.max(hidden, axis=1, initial=0.0) < 1e-9,
        budget=budget,
        data_share=np.clip(share, 0.0, 1.0),
        prior=prior,
    )


def values_with_bodies_of(fitted: Fit, file: Fit | None) -> Array:
    """Return the values (k,) of a fit, with those of the model file for bodies that it changes.

    The table and the file have the same links: a fit of a file is near the one of all terms, as
    near as the errors of that, which hold for both.
    """
    values = fitted.values.copy()
    if file is not None:
        bodies = [term for term in file.equations.terms if term.bodies]
        names = [name for term in bodies for name in term.names]
        values[fitted.at(names)] = file.values[file.at(names)]
    return values


def link_estimates(fitted: Fit, file: Fit | None) -> list[BodyEstimate]:
    """Return the estimate of every link whose parameters were estimated, base to terminal."""
    links = fitted.arm.robot.links
    values = values_with_bodies_of(fitted, file)
    return [
        body_estimate(
            fitted,
            links[index].body_name,
            select(fitted, names),
            values,
            InertialParameters(links[index].theta),
        )
        for index, names in fitted.arm.links.items()
        if names[0] in fitted.names
    ]


def term_quantities(fitted: Fit, terms: Iterable[Term]) -> Iterator[Quantity]:
    """Yield the parameters of terms, with the model's values where the arm has them."""
    pairs = [(term, parameter) for term in terms for parameter in term.parameters]
    causes = fitted.budget(np.eye(len(fitted.names)))
    shares = fitted.share()
    for term, parameter in pairs:
        key = parameter.key
        index = fitted.names.index(key)
        value, error = quantity(fitted, key)
        reason = max(causes, key=lambda cause: causes[cause][index])
        source = DATA if shares[index] >= PRIOR_SHARE else MODEL
        if math.isnan(error):
            source = BOUND
            reason = "it would cross its bound"
        elif math.isinf(error):
            reason = NOT_SHOWN
        # A joint's friction beyond its terms, which errors allow for, is none of these terms.
        further = FURTHER if term.cause == FURTHER_FRICTION else ""
        yield Quantity(
            f"{further}{parameter.name}",
            parameter.of or "arm",
            parameter.unit,
            fitted.arm.model.get(key),
            value,
            error,
            source,
            reason,
        )


def quantity(fitted: Fit, name: str) -> tuple[float, float]:
    """Return a named parameter and its standard error, NaN where it is held at a bound."""
    error = math.nan if name in fitted.at_bound else fitted.error_of(name)
    return fitted.by_name[name], error


def joint_quantities(fitted: Fit) -> list[Quantity]:
    """Return friction and rotor inertia of chain joints, and of motors that turn several."""
    terms = [t for t in fitted.equations.terms if t.cause in _OF_JOINTS]
    owners = fitted.arm.owners
    return sorted(term_quantities(fitted, terms), key=lambda row: owners.index(row.of))


def friction_in(fitted: Fit, file: Fit) -> list[Quantity]:
    """Return friction and rotors of joints and motors as the straight file has them, as measured.

    A file holds few of the terms that friction has, and their numbers are those of the line that is
    nearest to all of it in the logs (``friction_lines``). Where friction bends in a file beside it,
    its bend is told as well.

    Args:
        fitted: the fit of all terms.
        file: that of the model file.
    """
    lines = friction_lines(fitted, straight_of(file))
    rows = [_on_line(row, lines) for row in joint_quantities(fitted)]
    bends = [term for term in fitted.equations.terms if term.key == BEND.name]
    bent = {*bent_owners(file)}
    rows += [
        replace(row, name=BEND.name)
        for row in term_quantities(fitted, bends)
        if row.of in bent
    ]
    owners = fitted.arm.owners
    return sorted(rows, key=lambda row: owners.index(row.of))


def _on_line(row: Quantity, lines: Mapping[str, LineNumber]) -> Quantity:
    """Return the row of a joint or motor with the number of the line nearest to its friction.

    Rotors and offsets are not on it; what is not on a line is held at its bound.
    """
    term = TERMS[row.name]
    key = term.key_of(row.of)
    if not term.is_friction:
        return row
    if key not in lines:
        return replace(row, value=0.0, error=math.nan, source=BOUND)
    number = lines[key]
    reason = max(number.budget, key=lambda cause: number.budget[cause])
    return replace(
        row, value=number.value, error=number.error, source=DATA, reason=reason
    )


@dataclass(frozen=True)
class LineNumber:
    """A number of the line nearest to the friction of a joint or motor.

    Attributes:
        value, error: of it, and its standard error [SI].
        budget: cause to the standard error that it alone makes.
    """

    value: float
    error: float
    budget: Mapping[str, float]


def friction_lines(fitted: Fit, file: Fit) -> dict[str, LineNumber]:
    """Return the names of numbers of the lines nearest to friction to what they are.

    Args:
        fitted: the fit of all terms.
        file: that of the model file; what it holds at a bound is on no line.
    """
    sums = fitted.sums
    equal = np.ones(len(sums.joints))
    blocks = np.array([fitted.equations.data(equal, [block]) for block in sums.blocks])
    numbers: dict[str, LineNumber] = {}
    for owner in fitted.arm.owners:
        numbers.update(_line_of(fitted, file, owner, blocks))
    return numbers


def _line_of(
    fitted: Fit, file: Fit, owner: str, all_blocks: Array
) -> Iterator[tuple[str, LineNumber]]:
    """Yield the names and numbers of the line nearest to the friction of a joint or motor.

    What would cross its bound on a line is not on it either.

    Args:
        fitted: the fit of all terms.
        file: that of the model file.
        owner: the joint or motor.
        all_blocks: (B, k + 1, k + 1) products of the estimated columns in the rows of each block.
    """
    pairs = [*_friction_of(fitted, owner)]
    names = [parameter.key for _, parameter in pairs]
    at = fitted.at(names)
    blocks = all_blocks[:, at[:, None], at]
    rows = np.sum(blocks, axis=0)
    lower = np.array([parameter.lower for _, parameter in pairs])
    on_line = [
        number
        for number, (term, parameter) in enumerate(pairs)
        if term.cause in _OF_JOINTS and parameter.key not in file.at_bound
    ]
    line = _nearest(rows, on_line)
    while not np.all(is_inside := line @ fitted.values[at] >= lower[on_line]):
        on_line = [*itertools.compress(on_line, is_inside)]
        line = _nearest(rows, on_line)
    combinations = np.zeros((len(on_line), len(fitted.names)))
    combinations[:, at] = line
    values = combinations @ fitted.values
    # The loss of a gear is a share of its load, and has no unit.
    of_speed = [fitted.by_name[p.key] if p.unit else 0.0 for _, p in pairs]
    apart = [_nearest(rows - block, on_line) @ of_speed for block in blocks]
    variances = np.sum((combinations @ fitted.covariance) * combinations, axis=1)
    variances += (len(apart) - 1.0) * np.var(apart, axis=0)
    budget = fitted.budget(combinations)
    for number, place in enumerate(on_line):
        causes = {cause: float(errors[number]) for cause, errors in budget.items()}
        error = math.sqrt(max(float(variances[number]), 0.0))
        yield names[place], LineNumber(float(values[number]), error, causes)


def _nearest(products: Array, on_line: Sequence[int]) -> Array:
    """Return the combinations (l, m) of m columns that are the line of l of them in their rows.

    ``products`` (m, m) are those of the columns.
    """
    of_line = products[on_line]
    return np.asarray(np.linalg.pinv(of_line[:, on_line]) @ of_line)


def _friction_of(fitted: Fit, owner: str) -> Iterator[tuple[Term, Parameter]]:
    """Yield the estimated parameters of friction of a joint or motor, each with its term."""
    for term in fitted.equations.terms:
        for parameter in term.parameters:
            entry = TERMS.get(parameter.name)
            if parameter.of == owner and entry is not None and entry.is_friction:
                yield term, parameter


def friction_curves(fitted: Fit, file: Fit) -> Iterator[FrictionCurve]:
    """Yield the friction of each joint and motor that bends in a file, at three speeds.

    Its error is that of the sum of all terms of friction in the fit of all terms, whose parts trade
    with one another.
    """
    arm = fitted.arm
    robot = arm.robot
    speeds = speeds_in(fitted.recordings)
    ratios = dict(zip(robot.joint_names, np.eye(robot.n_joints)))
    ratios |= {motor.name: motor.ratios for motor in arm.motors}
    loads = dict(zip(arm.joints, fitted.sums.rms_torque.tolist()))
    for owner in bent_owners(file):
        known_to = float(fastest_of(speeds, ratios[owner][None])[0])
        of_speeds = known_to * np.array(CURVE_SHARES)
        columns = friction_columns(arm, owner, of_speeds, loads.get(owner, 0.0))
        model, of_fit = (
            friction_sum(columns, values) for values in (arm.model, fitted.by_name)
        )
        errors = friction_errors(fitted, columns)
        is_slide = owner in robot.slides
        yield FrictionCurve(
            of=owner,
            unit=torque_unit(is_slide),
            speed_unit=f"{position_unit(is_slide)}/s",
            known_to=known_to,
            speeds=tuple(of_speeds.tolist()),
            model=tuple(model.tolist()),
            torque=tuple(of_fit.tolist()),
            errors=tuple(errors.tolist()),
        )


def friction_columns(
    arm: ArmTerms, owner: str, speeds: Array, load: float
) -> dict[str, Array]:
    """Return the names of a joint's or motor's friction terms to their torque (m,) at some speeds.

    ``load`` is the torque that its gear transmits [N m].
    """
    state = (np.sign(speeds), speeds, 0.0 * speeds, load + 0.0 * speeds)
    return {
        term.key_of(owner): term.of_state(*state, arm.top_of(owner))
        for term in TERMS.values()
        if term.is_friction and term.key_of(owner) in arm.names
    }


def sensors(fitted: Fit) -> Iterator[Quantity]:
    """Return all parameters that are neither of bodies nor of joints."""
    terms = fitted.equations.terms
    others = [t for t in terms if not t.bodies and t.cause not in _OF_JOINTS]
    return term_quantities(fitted, others)


def quality_of(fitted: Fit) -> FitQuality:
    """Return what the equations determine, and how well they are fitted.

    Determined are parameters of interest: those of the terminal link, a payload, friction.
    """
    sums = fitted.sums
    names: list[str] = []
    for term in fitted.equations.terms:
        if term.cause in (LAST_LINK, PAYLOAD, FRICTION):
            names += term.names
    at = fitted.at(names)
    normal = fitted.equations.data(np.ones(len(sums.joints)))[at[:, None], at]
    counts = np.sum(sums.counts, axis=0)
    squares = sums.squared_residuals(fitted.full)
    return fit_quality(
        square_root(normal), names, sums.joints, squares, counts, fitted.noise_per_joint
    )


def friction_sum(columns: Mapping[str, Array], values: Mapping[str, float]) -> Array:
    """Return the torque (m,) of friction terms, ``friction_columns``, by their values [N m]."""
    sizes = [values.get(key, 0.0) for key in columns]
    return np.array(sizes) @ np.array([*columns.values()])


def friction_errors(fitted: Fit, columns: Mapping[str, Array]) -> Array:
    """Return the standard errors (m,) of the torque of friction terms in a fit [N m].

    Terms trade with one another, so that their sum is known better than each.
    """
    estimated = [key for key in columns if key in fitted.names]
    at = fitted.at(estimated)
    slopes = np.array([columns[key] for key in estimated])
    covariance = fitted.covariance[at[:, None], at]
    return np.sqrt(np.maximum(np.sum(slopes * (covariance @ slopes), axis=0), 0.0))


def file_quantities(fitted: Fit, file: Fit, source: str) -> Iterator[Quantity]:
    """Yield the rows of a model file: friction terms and rotor inertia of joints and motors.

    A rotor is written, with its error, where it differs from the model's; so is damping that the
    model bends and the file does not. The offset of a torque sensor is not friction, and is not
    written. What is written has to hold on another day, too: the errors of friction have its change
    in them.

    Args:
        fitted: the fit of all terms.
        file: the fit of the file.
        source: of the rows, ``FILE`` or ``CURVED``.
    """
    bent = {*bent_owners(file)}
    for row in joint_quantities(file):
        if row.name in (OFFSET.name, ROTOR.name):
            continue
        if row.name != BEND.name or row.of in bent:
            assert row.error is not None
            error = math.hypot(row.error, FRICTION_CHANGE * row.value)
            yield replace(row, error=error, source=source, reason="")
    for term in POLYNOMIAL:
        of_arm = file.arm.terms.get(term.name)
        for parameter in of_arm.parameters if of_arm else ():
            model = fitted.arm.model.get(parameter.key, 0.0)
            value = file.by_name[parameter.key]
            if value != model:
                about = parameter.name, parameter.of, parameter.unit
                yield Quantity(*about, model, value, math.nan, source)
    robot = fitted.arm.robot
    for owner in fitted.arm.owners:
        rotor_parameter = ROTOR.at(owner, owner in robot.slides)
        name = rotor_parameter.key
        model_rotor = fitted.arm.model.get(name, 0.0)
        rotor = file.by_name.get(name, model_rotor)
        if rotor != model_rotor:
            # Without an estimate of its own, the joint has the rotor of a motor that it shares.
            is_estimated = name in fitted.names
            error = quantity(fitted, name)[1] if is_estimated else math.nan
            unit = rotor_parameter.unit
            yield Quantity(ROTOR.name, owner, unit, model_rotor, rotor, error, source)
