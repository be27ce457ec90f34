"""Estimates from single recordings, and tests of whether the recordings agree."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import N_INERTIAL
from robot_sysid.dynamics.friction import TERMS
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation.algebra.between_logs import BetweenLogs, compare_logs
from robot_sysid.estimation.algebra.identifiability import visible_space
from robot_sysid.estimation.algebra.least_squares import (
    combine,
    estimate_noise,
    normal_matrix,
    restrict,
    sample_counts,
    solver,
)
from robot_sysid.estimation.algebra.priors import NuisanceGroup, with_prior
from robot_sysid.estimation.algebra.uncertainty import memory
from robot_sysid.estimation.choices import HeldOut, held_out
from robot_sysid.estimation.columns import PAYLOAD_NAMES
from robot_sysid.estimation.dataset import DecimatedSamples
from robot_sysid.estimation.fit import ChosenRows, Fit, evidence_of
from robot_sysid.estimation.unknowns import (
    FRICTION,
    WEIGHT,
    Unknowns,
    independent_prior,
)
from robot_sysid.estimation.verdict import is_informative
from robot_sysid.records import Array, Flange, SquareRootInformation, Validation
from robot_sysid.records.figures import percent
from robot_sysid.records.results import validation_of
from robot_sysid.results.record import OneRecording

DISAGREE = 2.0
"""Scatter over stated errors beyond which logs do not agree."""
SURE_MISFIT = 4.0
"""Root mean square difference of recordings of one kind, in standard errors, beyond which they are
refused: no set of 60 simulated ones exceeds 1.9, a real arm with elastic joints reaches 3.3."""
LEAST_MASS = 0.03
"""Difference in mass below which recordings agree, as a share of the payload's mass."""
LEAST_PLACE = 0.01
"""Difference in the payload's centre of mass below which recordings agree [m]."""
LEAST_GYRATION = 0.05
"""Difference in the payload's radius of gyration below which recordings agree [m]."""
MOST_NAMED = 2
"""Joints whose friction differs between logs that are named; ``params.json`` has all."""
LEAST_DIFFERENCE = 0.02
"""Share of a joint's friction torque below which a difference between logs is not worth a word."""
NOISE_FLOOR = 0.01
"""Least noise of a log whose friction is fitted to it alone, as a share of the fit's noise."""
SIZE_FLOOR = 1e-6
"""Least size of a friction term, as a share of the largest."""
UNSEEN = 100.0
"""Prior standard deviation of a body's parameters, which bounds those without data [SI]."""


def restrict_samples(samples: DecimatedSamples, unknowns: Unknowns) -> DecimatedSamples:
    """Return a recording's rows in the estimated parameters, with all held ones subtracted."""
    rows_by_joint = list(ChosenRows((samples,), unknowns))
    columns = [
        np.searchsorted(unknowns.kept, at[np.isin(at, unknowns.kept)])
        for at in samples.columns
    ]
    return replace(
        samples,
        names=unknowns.kept_names,
        columns=tuple(columns),
        rows=tuple(rows for _, rows, _ in rows_by_joint),
        tau=tuple(tau for _, _, tau in rows_by_joint),
    )


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
        start: (joints,) noise at which the iteration starts [N m].

    Returns:
        (values (k,), covariance (k, k) due to torque noise, covariance (k, k) of the whole error,
        infinite for parameters that are not identifiable).
    """
    plain = combine([log.information() for log in logs])
    information = with_prior(plain, groups)
    solved = solver(information, prior)
    noise = estimate_noise(information, solved, start)
    values = solved(1.0 / noise)[0]
    memories = []
    for joint, at in enumerate(logs[0].columns):
        residuals = [log.tau[joint] - log.rows[joint] @ values[at] for log in logs]
        memories.append(memory(np.concatenate(residuals)))
    weights = 1.0 / (noise * np.sqrt(memories))
    space = visible_space(information.stacked(weights)[0])
    inverse = space.inverse()
    identified = space.identified
    noise_root = plain.stacked(weights)[0] @ inverse
    covariance = np.where(np.outer(identified, identified), inverse, np.inf)
    return solved(weights)[0], noise_root.T @ noise_root, covariance


def held_out_validation(fit: Fit) -> Validation:
    """Return the held-out errors of a fit's own recordings."""
    judge = held_out(fit, fit.unknowns)
    errors = judge.of(fit)
    noise = judge.counts * fit.noise**2
    return replace(
        judge.validation(errors),
        told_enough=is_informative(errors, noise, lambda: judge.chance(fit)),
    )


@dataclass(frozen=True)
class FrictionOfLogs:
    """Friction of each log, and how much it differs between them.

    Attributes:
        logs: (L,) their names.
        names: (f,) friction terms, such as "coulomb[joint_1]".
        between: their values and errors by log.
        differences: joint or coupled motor to the largest difference of its friction between two
            logs, as a share of its friction torque; only where it exceeds its errors; the largest
            first.
    """

    logs: tuple[str, ...]
    names: tuple[str, ...]
    between: BetweenLogs
    differences: Mapping[str, float]

    def terms_of(self, owner: str) -> dict[str, int]:
        """Return the friction terms of a joint or a motor, each with its index in ``names``."""
        split = [name.partition("[") for name in self.names]
        return {
            term: k
            for k, (term, _, suffix) in enumerate(split)
            if suffix == f"{owner}]"
        }

    @property
    def note(self) -> tuple[str, ...]:
        """A sentence on the joints whose friction differs; none where there are none."""
        if not self.differences:
            return ()
        worst = list(self.differences.items())
        listed = ", ".join(
            f"{joint} by {percent(share)}" for joint, share in worst[:MOST_NAMED]
        )
        more = f" and {len(worst) - MOST_NAMED} more" if len(worst) > MOST_NAMED else ""
        return (
            f"friction differs between the logs by more than its errors: {listed}{more}; "
            "params.json has the friction of each log, and its error on another day",
        )


@dataclass(frozen=True)
class LogComparison:
    """How several logs of an arm compare: sentences, the error of each log predicted from the
    others, and friction by log. Empty for a single log.
    """

    notes: tuple[str, ...] = ()
    tests: tuple[Validation, ...] = ()
    friction: FrictionOfLogs | None = None


def compare_recordings(fit: Fit, names: Sequence[str]) -> LogComparison:
    """Return how the logs of a fit compare.

    A log with joints that the others do not identify is not used as a test.

    Args:
        names: the log of each dataset.
    """
    logs = {
        name: [s for s, n in zip(fit.samples, names) if n == name] for name in names
    }
    if len(logs) < 2:
        return LogComparison()
    data = evidence_of(logs.values(), fit.evidence.torque)
    judge = HeldOut(data, 1.0 / fit.weights, fit.unknowns)
    errors = judge.of(fit)
    noise = judge.counts * fit.noise**2
    chance = cache(partial(judge.chance, fit))

    def is_test(k: int) -> bool:
        return is_informative(errors[[k]], noise[[k]], lambda: chance()[[k]])

    joints = [joint.joint for joint in fit.evidence.whole.joints]
    tests = tuple(
        validation_of(
            joints,
            error,
            square,
            sample_counts(block),
            f"{name}, predicted from the other logs",
        )
        for k, (name, block, error, square) in enumerate(
            zip(logs, data.blocks, errors, data.squared_torque)
        )
        if is_test(k)
    )
    unknowns = fit.unknowns
    own_rows = {
        name: [restrict_samples(block, unknowns) for block in log]
        for name, log in logs.items()
    }
    friction = friction_of_logs(fit, own_rows, data.blocks)
    masses = {}
    for name, log in own_rows.items():
        values, _, covariance = estimate_alone(
            log, unknowns.groups, fit.columns.prior[unknowns.kept], fit.noise
        )
        masses[name] = float(values[0]), float(np.sqrt(covariance[0, 0]))
    note = () if friction is None else friction.note
    return LogComparison((*_agreement(masses, not note), *note), tests, friction)


def friction_of_logs(
    fit: Fit,
    logs: Mapping[str, Sequence[DecimatedSamples]],
    blocks: Sequence[SquareRootInformation],
) -> FrictionOfLogs | None:
    """Return friction of each log with all other parameters in common; None without friction.

    Args:
        logs: rows of each log in the fit's estimated parameters.
        blocks: information of each log about all parameters.
    """
    unknowns = fit.unknowns
    names = _friction_names(unknowns)
    if not names:
        return None
    indices = np.array([unknowns.kept_names.index(name) for name in names])
    values = fit.values[unknowns.kept[indices]]
    plain = [restrict(block, unknowns.kept_names, unknowns.held) for block in blocks]
    ones = np.ones(len(fit.weights))
    squares = sum(normal_matrix(one, ones)[np.ix_(indices, indices)] for one in plain)
    owners = np.array([name.partition("[")[2][:-1] for name in names])
    has_same_owner = owners[:, None] == owners
    # A term counts by its share of its joint's usual friction torque, so that a coefficient near
    # zero may differ as much as the others.
    diagonal = np.diag(squares)
    sizes = np.sqrt(has_same_owner @ (values**2 * diagonal) / diagonal)
    sizes = np.maximum(sizes, SIZE_FLOOR * max(float(np.max(sizes)), SIZE_FLOOR))
    terms = np.array([name.partition("[")[0] for name in names])
    weights = [_weights_beside_friction(fit, log, indices) for log in logs.values()]
    normals = [normal_matrix(*pair) for pair in zip(plain, weights)]
    prior = np.zeros_like(normals[0])
    for group in unknowns.groups:
        rows = group.rows(unknowns.kept_names)
        prior += rows.T @ rows
    kinds = np.unique(terms, return_inverse=True)[1]
    between = compare_logs(normals, prior, indices, values, sizes, kinds)

    joints = dict.fromkeys(owners.tolist())
    rubbing = {
        joint: np.flatnonzero((owners == joint) & (terms != "offset"))
        for joint in joints
    }
    differences = {}
    for joint, terms_of_joint in rubbing.items():
        if len(terms_of_joint) and between.differ(terms_of_joint, len(joints)):
            share = _largest_difference(
                between.values[:, terms_of_joint],
                squares[terms_of_joint][:, terms_of_joint],
            )
            if share > LEAST_DIFFERENCE:
                differences[joint] = share
    ordered = sorted(differences.items(), key=lambda item: -item[1])
    return FrictionOfLogs(tuple(logs), tuple(names), between, dict(ordered))


def _friction_names(unknowns: Unknowns) -> list[str]:
    """Return the estimated friction terms, without rotor inertia, which does not change between
    logs, and without the terms that are nuisances.
    """
    nuisances = {
        name
        for group in unknowns.groups
        if group.cause == FRICTION
        for name in group.names
    }
    terms = TERMS.keys() - {"armature"}
    return [
        n
        for n in unknowns.kept_names
        if n not in nuisances and n.partition("[")[0] in terms
    ]


def _weights_beside_friction(
    fit: Fit, log: Sequence[DecimatedSamples], indices: NDArray[np.int64]
) -> Array:
    """Return the weights (joints,) of a log [1/(N m)]: one over the noise of its residuals after
    friction was fitted to it alone, enlarged for the autocorrelation of that noise.
    """
    values = fit.values[fit.unknowns.kept]
    weights = np.zeros(len(log[0].columns))
    for joint, columns in enumerate(log[0].columns):
        rows, tau = (
            np.concatenate(pieces) for pieces in zip(*[p.in_use(joint) for p in log])
        )
        if not len(tau):
            continue
        residual = tau - rows @ values[columns]
        friction = rows[:, np.isin(columns, indices)]
        residual -= friction @ np.linalg.lstsq(friction, residual, rcond=None)[0]
        slow = memory(residual)
        floor = NOISE_FLOOR * fit.noise[joint]
        weights[joint] = 1.0 / (max(float(np.std(residual)), floor) * np.sqrt(slow))
    return weights


def _largest_difference(values: Array, squares: Array) -> float:
    """Return the largest difference of a joint's friction between two logs, as a share of its
    friction torque.

    Args:
        values: (L, m) friction coefficients by log.
        squares: (m, m) Y^T Y of their columns.
    """
    mean = np.mean(values, axis=0)
    pairs = itertools.combinations(values, 2)
    squared = max(float((a - b) @ squares @ (a - b)) for a, b in pairs)
    torque = float(mean @ squares @ mean)
    return math.sqrt(squared / torque) if torque > 0.0 else math.inf


def _agreement(
    masses: Mapping[str, tuple[float, float]], has_same_friction: bool
) -> Iterator[str]:
    """Yield sentences on how far the masses of the logs agree, (mass, standard error) each [kg]."""
    identified = {name: pair for name, pair in masses.items() if 0.0 < pair[1] < np.inf}
    phrases = [
        f"{name} {masses[name][0]:.4g} \u00b1 {masses[name][1]:.2g} kg"
        if name in identified
        else f"{name} does not tell the mass"
        for name in masses
    ]
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


def payloads_by_recording(fit: Fit, flange: Flange) -> tuple[OneRecording, ...]:
    """Return the payload from each recording and all of the other kind, in the flange's frame."""
    unknowns = fit.unknowns
    recordings = fit.columns.datasets
    payloads = []
    logs = [restrict_samples(samples, unknowns) for samples in fit.samples]
    prior = fit.columns.prior[unknowns.kept]
    indices = np.searchsorted(unknowns.kept, fit.columns.at(PAYLOAD_NAMES))
    for is_loaded in (False, True):
        same = [k for k, log in enumerate(recordings) if log.is_loaded is is_loaded]
        others = [
            k for k, log in enumerate(recordings) if log.is_loaded is not is_loaded
        ]
        for k in same if len(same) > 1 else ():
            values, *spread = estimate_alone(
                [logs[i] for i in (k, *others)], unknowns.groups, prior, fit.noise
            )
            theta = flange.to_flange(values[indices])
            noise, error = (
                float(np.sqrt(matrix[indices[0], indices[0]])) for matrix in spread
            )
            mass = float(theta[0])
            com = theta[1:4] / mass if mass else np.full(3, np.nan)
            payloads.append(
                OneRecording(recordings[k].name, is_loaded, mass, com, noise, error)
            )
    return tuple(payloads)


def contradiction(fit: Fit, flange: Flange) -> str:
    """Return a sentence on recordings of one kind that contradict each other; "" where they agree.

    Bodies are in the flange's frame. Torque scales of the fit may have been bent to explain a
    recording of the wrong kind, so that a difference has to show in a second linearisation, around
    the model's own values, too.
    """
    recordings = fit.columns.datasets
    kinds = np.array([log.is_loaded for log in recordings])
    bodies = np.zeros((0, N_INERTIAL))
    differences: list[tuple[float, int, str]] = []
    if len(kinds) < 3:
        return ""
    for samples in (
        lambda: fit.samples,
        lambda: fit.columns.samples(fit.columns.start()),
    ):
        bodies, covariance = bodies_apart(fit, samples())
        differences = sorted(_differences(kinds, bodies, covariance))
        if not differences:
            return ""
    _, number, quantity = differences[-1]
    same = [k for k in np.flatnonzero(kinds == kinds[number]) if k != number]
    lightest = int(np.argmin(bodies[:, 0]))
    carried = bodies - bodies[lightest]
    least = LEAST_MASS * float(np.max(carried[:, 0]))
    listed = [
        f"{log.name} {_describe_body(flange.to_flange(theta), least)}"
        for log, theta in zip(recordings, carried)
        if log is not recordings[lightest]
    ]
    return (
        f"{recordings[number].name} differs from {', '.join(recordings[k].name for k in same)} in "
        f"{quantity}; compared with {recordings[lightest].name} the arm carries: "
        f"{', '.join(listed)}"
    )


def _describe_body(theta: Array, least: float) -> str:
    """Return mass and centre of mass of a body (10,) in words, "nothing" up to a mass [kg]."""
    if theta[0] <= least:
        return "nothing"
    position = ", ".join(f"{1e3 * x:.0f}" for x in theta[1:4] / theta[0])
    return f"{theta[0]:.3g} kg at ({position}) mm"


def _differences(
    kinds: NDArray[np.bool_], bodies: Array, covariance: Array
) -> Iterator[tuple[float, int, str]]:
    """Yield (rms difference in standard errors, recording number, quantity) of each recording that
    differs from the others of its kind.

    Args:
        kinds: (d,) whether each recording carries the payload.
        bodies: (d, 10) on the arm.
        covariance: (d, 10, d, 10) of the bodies.
    """
    payload = np.mean(bodies[kinds], axis=0) - np.mean(bodies[~kinds], axis=0)
    mass = max(abs(float(payload[0])), np.finfo(float).tiny)
    for number, is_loaded in enumerate(kinds):
        others = (kinds == is_loaded) & (np.arange(len(kinds)) != number)
        if not np.any(others):
            continue
        weights = (np.arange(len(kinds)) == number) - others / np.sum(others)
        change = weights @ bodies
        spread = np.einsum("i,iajb,j", weights, covariance, weights)
        moved = change[1:4] - change[0] * payload[1:4] / mass
        sizes = {
            "mass": (abs(change[0]), LEAST_MASS * mass, slice(0, 4)),
            "centre of mass": (np.linalg.norm(moved), LEAST_PLACE * mass, slice(0, 4)),
            "inertia": (
                np.max(np.abs(change[4:])),
                LEAST_GYRATION**2 * mass,
                slice(4, 10),
            ),
        }
        for quantity, (size, least, block) in sizes.items():
            off = change[block]
            ratio = float(
                np.sqrt(off @ np.linalg.solve(spread[block, block], off) / len(off))
            )
            if size > least and ratio > SURE_MISFIT:
                yield ratio, number, quantity


def bodies_apart(fit: Fit, samples: Sequence[DecimatedSamples]) -> tuple[Array, Array]:
    """Return (bodies (d, 10), covariance (d, 10, d, 10)): what each recording carries on the arm.

    The first recording is the reference: its body and its error are zero. Whether a recording is
    called empty or loaded is not used.
    """
    count = len(samples) - 1
    common = np.setdiff1d(fit.unknowns.kept, fit.columns.at(PAYLOAD_NAMES))
    fewer = replace(fit.unknowns, kept=common)
    added = tuple(f"{n}({k})" for k in range(count) for n in PARAMETER_NAMES)
    names = (*fewer.kept_names, *added)

    def add_body_columns(number: int, samples: DecimatedSamples) -> DecimatedSamples:
        narrow = restrict_samples(samples, fewer)
        rows = []
        for block, full in zip(narrow.rows, samples.rows):
            bodies = np.zeros((len(block), count, N_INERTIAL))
            if number:
                bodies[:, number - 1] = full[:, :N_INERTIAL]
            rows.append(np.hstack((block, bodies.reshape(len(block), -1))))
        last = np.arange(len(common), len(names))
        columns = tuple(np.append(at, last) for at in narrow.columns)
        return replace(narrow, names=names, columns=columns, rows=tuple(rows))

    # A recording of the wrong kind widens priors that have nothing to do with it.
    priors = [replace(g, widened=1.0) for g in fit.unknowns.groups if g.cause != WEIGHT]
    priors.append(independent_prior("unseen", added, added, UNSEEN))
    prior = np.append(fit.columns.prior[common], np.zeros(len(added)))
    logs = [add_body_columns(*pair) for pair in enumerate(samples)]
    values, _, errors = estimate_alone(logs, priors, prior)
    last = slice(len(common), None)
    bodies = np.zeros((count + 1, N_INERTIAL))
    covariance = np.zeros((count + 1, N_INERTIAL) * 2)
    bodies[1:] = values[last].reshape(count, -1)
    covariance[1:, :, 1:] = errors[last, last].reshape((count, N_INERTIAL) * 2)
    return bodies, covariance
