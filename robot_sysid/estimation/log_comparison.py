"""How several logs of an arm agree: in mass, in friction, and each predicted from the others.

L logs give estimates x_1 ... x_L of the same f numbers, with all other parameters in common, and a
joint covariance of these estimates. In orthonormal contrasts d of the logs (Helmert's), which leave
out the mean, a model with a variance of its own for what differs between logs is

    d ~ N(0, C + T),    T = diag(t^2),

with C the covariance of the contrasts by noise: its likelihood is the restricted one of
meta-analysis (Harville, "Maximum likelihood approaches to variance component estimation", JASA 72,
1977). Numbers count one by one in it, as if noise were not correlated between them: with many logs
all of C is large. Two logs give a single difference per number, so that numbers of one kind, such
as the Coulomb friction of all joints, have a share r of their size in common, t = r * size, which
is averaged over a grid. A number's own differences then count as well, as in a scaled inverse
chi-square prior.

Shapes: a fit has p parameters (``Columns.names``), k of them estimated; "joints" counts the joints
that have equations. [A b]^T [A b] is the Gram matrix of weighted equations A x = b.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import split_name
from robot_sysid.dynamics.friction import TERMS
from robot_sysid.estimation.algebra.identifiability import visible_space
from robot_sysid.estimation.algebra.least_squares import (
    combine,
    eliminate_others,
    estimate_noise,
    normal_matrix,
    restrict,
    solver,
)
from robot_sysid.estimation.algebra.priors import (
    NuisanceGroup,
    is_significant,
    with_prior,
)
from robot_sysid.estimation.algebra.uncertainty import residual_correlation_time
from robot_sysid.estimation.dataset import DecimatedSamples
from robot_sysid.estimation.fit import Fit, evidence_of, residuals_of
from robot_sysid.estimation.held_out import HeldOut, is_informative_test
from robot_sysid.estimation.unknowns import Unknowns, restrict_samples
from robot_sysid.records import Array, SquareRootInformation, Validation
from robot_sysid.records.data import validation_of
from robot_sysid.records.messages import percent, with_error
from robot_sysid.results.record import Quantity

DISAGREE = 2.0
"""Ratio of the scatter of masses to their standard errors above which logs do not agree."""
MOST_NAMED = 2
"""Largest number of joints with different friction that the note names; ``params.json`` has all."""
LEAST_DIFFERENCE = 0.02
"""Share of a joint's friction torque below which a difference between logs is not reported."""
NOISE_FLOOR = 0.01
"""Least noise of a log whose friction is fitted to it alone, as a share of the fit's noise."""
SIZE_FLOOR = 1e-6
"""Least size of a friction term, as a share of the largest."""


def estimate_alone(
    logs: Sequence[DecimatedSamples],
    groups: Sequence[NuisanceGroup],
    prior: Array,
    start: Array | None = None,
) -> tuple[Array, Array, Array]:
    """Return the estimate from some recordings and the priors, without the other recordings.

    The noise of each joint and its autocorrelation are those of these recordings' own residuals:
    a contradiction to other recordings does not count as noise.

    Args:
        logs: rows of the recordings in the k estimated parameters.
        groups: priors of these parameters.
        prior: (k,) values for parameters that are not identified.
        start: (joints,) noise at which the iteration starts [N m]; None for a default.

    Returns:
        (values (k,), covariance (k, k) due to torque noise, covariance (k, k) of the whole error,
        infinite for parameters that are not identifiable).
    """
    data = combine(list(map(DecimatedSamples.information, logs)))
    information = with_prior(data, groups)
    # Returns (values (k,), leverage of each joint's equations) for their weights (joints,).
    solve = solver(information, prior)
    noise = estimate_noise(information, solve, start)
    first_values, _ = solve(1.0 / noise)
    residuals = residuals_of(logs, first_values)
    # Residuals that are correlated over m rows count as one independent row of m.
    correlation_times = list(map(residual_correlation_time, residuals))
    weights = 1.0 / (noise * np.sqrt(correlation_times))
    values, _ = solve(weights)
    matrix, _ = information.equations(weights)
    space = visible_space(matrix)
    inverse = space.inverse()
    is_identified = np.outer(space.is_identified, space.is_identified)
    # The estimate is C A^T b, and b of the data has unit noise: C A^T A C is its covariance.
    data_matrix, _ = data.equations(weights)
    noise_root = data_matrix @ inverse
    covariance = np.where(is_identified, inverse, np.inf)
    return values, noise_root.T @ noise_root, covariance


@dataclass(frozen=True)
class FrictionOfLogs:
    """Friction of each log, and how much it differs between them.

    Attributes:
        logs: (L,) names of the logs.
        names: (f,) friction terms, such as "coulomb[joint_1]".
        between: values and errors of these terms by log.
        differences: joint or coupled motor to the largest difference of its friction between two
            logs, as a share of its friction torque, largest first. Only significant differences of
            more than ``LEAST_DIFFERENCE`` are among them.
    """

    logs: tuple[str, ...]
    names: tuple[str, ...]
    between: BetweenLogs
    differences: Mapping[str, float]

    def _indices(self, owner: str) -> dict[str, int]:
        """Return friction term to its index in ``names``, for the joint or motor ``owner``."""
        indices = {}
        for index, name in enumerate(self.names):
            term, member = split_name(name)
            if member == owner:
                indices[term] = index
        return indices

    def by_log(self, owner: str) -> dict[str, dict[str, Quantity]]:
        """Return name of a log to friction term of a joint to its value according to that log.

        The errors are those due to the noise of each log.

        Args:
            owner: the joint, or a motor that turns several joints.
        """
        terms = self._indices(owner)
        columns = [*terms.values()]
        by_log = {}
        for row, log in enumerate(self.logs):
            values = self.between.values[row, columns].tolist()
            errors = self.between.errors[row, columns].tolist()
            by_log[log] = dict(zip(terms, map(Quantity, values, errors)))
        return by_log

    def on_another_day(
        self, owner: str, terms: Mapping[str, Quantity]
    ) -> dict[str, Quantity]:
        """Return friction term of a joint to its value, with the error for another day's log.

        The error includes the scatter of friction from log to log.

        Args:
            owner: the joint.
            terms: friction term of the joint to its estimate from all logs together.
        """
        other_day = {}
        for term, index in self._indices(owner).items():
            # Of these errors (f,), only the one of this term is used.
            errors = np.full(len(self.names), terms[term].error)
            error = self.between.next_log(errors)[index]
            other_day[term] = Quantity(terms[term].value, float(error))
        return other_day

    @property
    def note(self) -> tuple[str, ...]:
        """One sentence, in a tuple, on the joints whose friction differs; () without these."""
        if not self.differences:
            return ()
        worst = list(self.differences.items())
        phrases = [
            f"{joint} by {percent(share)}" for joint, share in worst[:MOST_NAMED]
        ]
        listed = ", ".join(phrases)
        more = f" and {len(worst) - MOST_NAMED} more" if len(worst) > MOST_NAMED else ""
        return (
            f"friction differs between the logs by more than its errors: {listed}{more}; "
            "params.json has the friction of each log, and its error on another day",
        )


def compare_recordings(
    fit: Fit,
) -> tuple[tuple[str, ...], list[Validation], FrictionOfLogs | None]:
    """Return how the logs of a fit compare; nothing where there is a single log.

    Recordings of one name are one log, a block of the cross-validation. A log whose error does not
    test the fit (``is_informative_test``) is left out, as one with joints that the other logs do
    not identify. The fit needs its rows (``Fit.samples``).

    Returns:
        (sentences on masses and friction, error of each log predicted from the others, friction by
        log or None).
    """
    logs: dict[str, list[DecimatedSamples]] = {}
    for dataset, samples in zip(fit.columns.datasets, fit.samples):
        logs.setdefault(dataset.name, []).append(samples)
    if len(logs) < 2:
        return (), [], None
    data = evidence_of(logs.values(), fit.evidence.torque)
    judge = HeldOut(data, 1.0 / fit.weights, fit.unknowns)
    # Squared errors (logs, joints), and those to expect; the last are computed where needed.
    errors = judge.consistent_squared_errors(fit.unknowns)
    noise = judge.counts * fit.noise**2
    expected_errors = cache(partial(judge.expected_squared_errors, fit))

    def tests_fit(k: int) -> bool:
        """Tell whether the error of log k, predicted from the others, tests the fit."""
        return is_informative_test(
            errors[[k]], noise[[k]], lambda: expected_errors()[[k]]
        )

    joints = fit.columns.joints
    tests = []
    for k, name in enumerate(logs):
        if tests_fit(k):
            source = f"{name}, predicted from the other logs"
            squares = data.squared_torque[k]
            tests.append(
                validation_of(joints, errors[k], squares, judge.counts[k], source)
            )
    unknowns = fit.unknowns
    log_rows = {}
    for name, log in logs.items():
        log_rows[name] = [restrict_samples(samples, unknowns) for samples in log]
    friction = friction_of_logs(fit, log_rows, data.blocks)
    masses = {}
    model_values = fit.columns.model_values[unknowns.estimated]
    for name, log in log_rows.items():
        values, _, covariance = estimate_alone(
            log, unknowns.groups, model_values, fit.noise
        )
        masses[name] = float(values[0]), float(np.sqrt(covariance[0, 0]))
    note = () if friction is None else friction.note
    notes = (*_agreement(masses, not note), *note)
    return notes, tests, friction


def friction_of_logs(
    fit: Fit,
    logs: Mapping[str, Sequence[DecimatedSamples]],
    blocks: Sequence[SquareRootInformation],
) -> FrictionOfLogs | None:
    """Return friction of each log with all other parameters in common; None without friction.

    Args:
        fit: the fit to all logs together.
        logs: name of a log to its recordings' rows in the fit's estimated parameters.
        blocks: information of each log about all p parameters, in the order of ``logs``.
    """
    unknowns = fit.unknowns
    names = _friction_names(unknowns)
    if not names:
        return None
    indices = np.flatnonzero(np.isin(unknowns.estimated_names, names))
    values = fit.values[unknowns.estimated[indices]]
    restriction = unknowns.estimated_names, unknowns.held
    plain = [restrict(block, *restriction) for block in blocks]
    # Y^T Y (f, f) of the friction columns Y of all joints and logs, not weighted.
    ones = np.ones(len(fit.weights))
    squares = np.zeros((len(names), len(names)))
    for log in plain:
        squares += normal_matrix(log, ones)[np.ix_(indices, indices)]
    terms, owners = np.array(list(map(split_name, names))).T
    has_same_owner = owners[:, None] == owners
    # The typical size of a coefficient makes its joint's usual friction torque by itself, so that
    # a coefficient near zero may differ as much as the others.
    diagonal = np.diag(squares)
    sizes = np.sqrt(has_same_owner @ (values**2 * diagonal) / diagonal)
    largest_size = max(float(np.max(sizes)), SIZE_FLOOR)
    sizes = np.maximum(sizes, SIZE_FLOOR * largest_size)
    normals = []
    for log, rows in zip(plain, logs.values()):
        weights = _weights_beside_friction(fit, rows, indices)
        normals.append(normal_matrix(log, weights))
    prior = np.zeros_like(normals[0])
    for group in unknowns.groups:
        prior_rows = group.prior_rows(unknowns.estimated_names)
        prior += prior_rows.T @ prior_rows
    # Equal terms are one kind, whatever their joint.
    kinds = np.unique(terms, return_inverse=True)[1]
    between = compare_logs(normals, prior, indices, values, sizes, kinds)

    joints = dict.fromkeys(owners.tolist())
    differences = {}
    for joint in joints:
        columns = np.flatnonzero((owners == joint) & (terms != "offset"))
        if len(columns) and between.differ(columns, len(joints)):
            friction = between.values[:, columns]
            share = _largest_difference(friction, squares[columns][:, columns])
            if share > LEAST_DIFFERENCE:
                differences[joint] = share
    ordered = sorted(differences.items(), key=lambda item: -item[1])
    return FrictionOfLogs(tuple(logs), tuple(names), between, dict(ordered))


def _friction_names(unknowns: Unknowns) -> list[str]:
    """Return the names of the estimated friction terms that may differ between logs, in order.

    Rotor inertia, and friction terms that only a prior allows for, are not among them.
    """
    terms = TERMS.keys() - {"armature"}
    names = []
    for name in unknowns.estimated_names:
        term, _ = split_name(name)
        if term in terms and name not in unknowns.nuisance_friction:
            names.append(name)
    return names


def _weights_beside_friction(
    fit: Fit, log: Sequence[DecimatedSamples], indices: NDArray[np.int64]
) -> Array:
    """Return the weights (joints,) of the equations of one log, 1 / noise [1/(N m)].

    The noise is that of the log's residuals after friction was fitted to this log alone. It is
    enlarged for its autocorrelation. A joint without used rows has the weight 0.

    Args:
        fit: all logs together, which gives the other parameters.
        log: rows of the log's recordings in the k estimated parameters.
        indices: (f,) of the friction terms among the k estimated parameters.
    """
    values = fit.values[fit.unknowns.estimated]
    weights = np.zeros(len(log[0].columns))
    for joint, columns in enumerate(log[0].columns):
        pieces = [samples.in_use(joint) for samples in log]
        rows, tau = map(np.concatenate, zip(*pieces))
        if not len(tau):
            continue
        residual = tau - rows @ values[columns]
        friction = rows[:, np.isin(columns, indices)]
        residual -= friction @ np.linalg.lstsq(friction, residual, rcond=None)[0]
        correlation_time = residual_correlation_time(residual)
        noise = max(float(np.std(residual)), NOISE_FLOOR * fit.noise[joint])
        weights[joint] = 1.0 / (noise * np.sqrt(correlation_time))
    return weights


def _largest_difference(values: Array, squares: Array) -> float:
    """Return the largest difference of a joint's friction torque between any two of L >= 2 logs.

    It is the root mean square over the rows, as a share of the torque of the mean friction;
    infinite where that torque is zero.

    Args:
        values: (L, m) friction coefficients by log.
        squares: (m, m) Y^T Y of the columns Y of these coefficients.
    """
    mean = np.mean(values, axis=0)
    squared_differences = []
    for first, second in itertools.combinations(values, 2):
        difference = first - second
        squared_differences.append(float(difference @ squares @ difference))
    squared_torque = float(mean @ squares @ mean)
    largest = max(squared_differences)
    return math.sqrt(largest / squared_torque) if squared_torque > 0.0 else math.inf


def _agreement(
    masses: Mapping[str, tuple[float, float]], has_same_friction: bool
) -> Iterator[str]:
    """Yield sentences on how far the masses of the terminal link by log agree.

    Args:
        masses: name of a log to (mass, standard error) from that log alone [kg].
        has_same_friction: whether no difference in friction between the logs is reported.
    """
    identified = {name: pair for name, pair in masses.items() if 0.0 < pair[1] < np.inf}
    phrases = []
    for name, (mass, error) in masses.items():
        phrase = f"{name} does not determine the mass"
        if name in identified:
            phrase = f"{name} {with_error(mass, error, 'kg')}"
        phrases.append(phrase)
    yield f"mass of each log alone: {'; '.join(phrases)}"
    if len(identified) < 2:
        return
    values, errors = np.array(list(identified.values())).T
    weights = 1.0 / np.square(errors)
    mean = float(np.sum(weights * values) / np.sum(weights))
    ratio = float(np.sqrt(np.sum(weights * (values - mean) ** 2) / (len(values) - 1)))
    scatter = f"their masses scatter by {ratio:.2g} times their stated errors"
    if ratio > DISAGREE:
        yield (
            f"the logs do not agree: {scatter}; did the arm carry the same, and were all recorded "
            "in the same way?"
        )
    elif has_same_friction:
        yield f"the logs agree: {scatter}"
    else:
        yield f"the logs agree on the mass, not on friction: {scatter}"


SHARES = (0.0, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64, 1.28)
"""Grid of differences from log to log, as shares of a number's size, equally likely."""
COMMON_FREEDOM = 4.0
"""Weight of the spread that all numbers of a kind have in common, against the weight 1 of one
contrast of a number's own."""
SURE_DIFFERENCE = 0.999
"""Confidence level from which logs contradict each other: the errors of differences are themselves
off by up to a fifth (measured), which 0.99 would not cover."""
# Prior standard deviation, in sizes, of a number that a log does not identify.
_UNSEEN = 100.0


@dataclass(frozen=True)
class BetweenLogs:
    """Estimates of the same f numbers from L logs.

    Attributes:
        values: (L, f) numbers according to each log, with all other parameters in common.
        errors: (L, f) standard errors of ``values`` due to the noise of each log.
        spread: (f,) standard deviation from log to log, beyond these errors.
        contrasts: (L - 1, f) orthonormal contrasts of the logs.
        noise: (L - 1, f, L - 1, f) covariance of the contrasts that noise makes.
    """

    values: Array
    errors: Array
    spread: Array
    contrasts: Array
    noise: Array

    def next_log(self, errors: Array) -> Array:
        """Return standard errors (f,) for another log, from those (f,) of all logs together.

        The difference of another log from the mean of L has the variance spread^2 (1 + 1 / L).
        """
        factor = 1.0 + 1.0 / len(self.values)
        return np.asarray(np.sqrt(np.square(errors) + factor * self.spread**2))

    def differ(self, numbers: NDArray[np.int64], tests: int) -> bool:
        """Tell whether the logs contradict each other in the numbers of given indices.

        Args:
            numbers: (m,) indices among the f numbers.
            tests: number of such tests, by which the significance of one is corrected.
        """
        # All (L - 1) m contrasts as one vector, with their covariance.
        contrasts = self.contrasts[:, numbers].ravel()
        size = len(contrasts)
        noise = self.noise[:, numbers][:, :, :, numbers].reshape(size, size)
        squared = float(contrasts @ np.linalg.solve(noise, contrasts))
        chance = 1.0 - SURE_DIFFERENCE ** (1.0 / tests)
        return is_significant(squared, float(size), chance)


def compare_logs(
    normals: Sequence[Array],
    prior: Array,
    indices: NDArray[np.int64],
    center: Array,
    sizes: Array,
    kinds: NDArray[np.int64],
) -> BetweenLogs:
    """Return estimates of f numbers for each of L logs, and how much they differ between logs.

    Args:
        normals: (L) matrices (k + 1, k + 1) [A b]^T [A b] of each log's weighted equations.
        prior: (k + 1, k + 1) [A b]^T [A b] of the priors of all other parameters.
        indices: (f,) of the numbers among the k estimated parameters.
        center: (f,) their values from all logs together.
        sizes: (f,) their typical sizes.
        kinds: (f,) the kind of each number, as an integer.
    """
    count = len(normals)
    values, covariance = _of_each_log(normals, prior, indices, center, sizes)
    change = _helmert(count)
    contrasts = change @ values
    noise = np.einsum("ia,afbg,jb->ifjg", change, covariance, change, optimize=True)
    spread = _spread(contrasts, noise, sizes, kinds)

    # Errors of single logs have a part in common. So the variances of the contrasts are divided
    # between the logs as the variances of each log alone, with all other parameters known.
    weak = np.diag((_UNSEEN * sizes) ** -2)
    variances = []
    for normal in normals:
        precision = normal[np.ix_(indices, indices)] + weak
        variances.append(np.diag(np.linalg.inv(precision)))
    # Of independent errors, the contrasts have a share (1 - 1 / L) of the summed variances.
    total = np.einsum("ifif->f", noise) / (1.0 - 1.0 / count)
    errors = np.sqrt(np.array(variances) * total / np.sum(variances, axis=0))
    return BetweenLogs(values, errors, spread, contrasts, noise)


def _of_each_log(
    normals: Sequence[Array],
    prior: Array,
    indices: NDArray[np.int64],
    center: Array,
    sizes: Array,
) -> tuple[Array, Array]:
    """Return estimates of f numbers for each of L logs, with all other parameters in common.

    Args:
        normals: (L) matrices (k + 1, k + 1) [A b]^T [A b] of each log's weighted equations.
        prior: (k + 1, k + 1) [A b]^T [A b] of the priors of all other parameters.
        indices: (f,) of the numbers among the k estimated parameters.
        center: (f,) their values from all logs together, of a weak prior for what a log hides.
        sizes: (f,) their typical sizes, which scale that prior.

    Returns:
        (estimates (L, f), covariance (L, f, L, f)).
    """
    count = len(normals)
    size = len(indices)
    right_side_index = len(prior) - 1
    common = np.setdiff1d(np.arange(right_side_index), indices)
    # Columns of the system: common parameters, the numbers of each log in turn, right-hand side.
    last = len(common) + count * size
    system = np.zeros((last + 1, last + 1))
    common_columns = np.arange(len(common))
    columns = np.append(common_columns, last)
    sources = np.append(common, right_side_index)
    system[np.ix_(columns, columns)] = prior[np.ix_(sources, sources)]
    sources = np.concatenate((common, indices, [right_side_index]))
    for log, normal in enumerate(normals):
        log_columns = len(common) + log * size + np.arange(size)
        columns = np.concatenate((common_columns, log_columns, [last]))
        system[np.ix_(columns, columns)] += normal[np.ix_(sources, sources)]
    matrix, right_side = eliminate_others(system, np.arange(len(common), last))
    weak = np.tile((_UNSEEN * sizes) ** -2, count)
    covariance = np.linalg.inv(matrix + np.diag(weak))
    values = covariance @ (right_side + weak * np.tile(center, count))
    covariance_by_log = np.asarray(covariance.reshape(count, size, count, size))
    return np.asarray(values.reshape(count, size)), covariance_by_log


def _helmert(count: int) -> Array:
    """Return orthonormal contrasts (count - 1, count), each row of which adds up to zero.

    Row i compares log i + 1 with the mean of all logs before it.
    """
    rows = np.tril(np.ones((count, count)), -1)[1:]
    rows[np.arange(count - 1), np.arange(1, count)] = -np.arange(1.0, count)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def _spread(
    contrasts: Array, noise: Array, sizes: Array, kinds: NDArray[np.int64]
) -> Array:
    """Return the standard deviation (f,) of each number from log to log, beyond noise.

    Args:
        contrasts: (L - 1, f) orthonormal contrasts of the logs.
        noise: (L - 1, f, L - 1, f) their covariance by noise.
        sizes: (f,) typical sizes of the numbers.
        kinds: (f,) the kind of each number, as an integer.
    """
    # In the principal axes of its noise (f, L - 1, L - 1), a number's contrasts are independent.
    variances, axes = np.linalg.eigh(np.einsum("ifjf->fij", noise))
    turned = np.einsum("fij,if->fj", axes, contrasts)
    # Scatter (f,) by the share of the size that all numbers of a kind have in common.
    common = np.zeros(len(sizes))
    for label in np.unique(kinds):
        is_kind = kinds == label
        # Axes: shares of the grid, numbers of the kind, contrasts.
        between = np.multiply.outer(np.square(SHARES), sizes[is_kind, None] ** 2)
        variance = variances[is_kind] + between
        log_likelihood = -0.5 * np.sum(
            turned[is_kind] ** 2 / variance + np.log(variance), axis=(1, 2)
        )
        probability = np.exp(log_likelihood - np.max(log_likelihood))
        share = np.sqrt(np.square(SHARES) @ probability / np.sum(probability))
        common[is_kind] = share * sizes[is_kind]
    # The expected square of each contrast without its noise.
    gain = common[:, None] ** 2 / (variances + common[:, None] ** 2)
    squares = (gain * turned) ** 2 + gain * variances
    freedom = len(contrasts)
    pooled = COMMON_FREEDOM * common**2 + np.sum(squares, axis=1)
    return np.asarray(np.sqrt(pooled / (COMMON_FREEDOM + freedom)))
