"""Recordings of a payload one by one: what each weighs, and whether those of one kind agree.

Shapes: p parameters (``Columns.names``), k of them estimated; "joints" counts the joints that have
equations; a body has ten inertial parameters (``PARAMETER_NAMES``).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.spatial import N_INERTIAL, PARAMETER_NAMES
from robot_sysid.estimation.algebra.identifiability import visible_space
from robot_sysid.estimation.algebra.least_squares import combine, estimate_noise, solver
from robot_sysid.estimation.algebra.priors import (
    NuisanceGroup,
    independent_prior,
    with_prior,
)
from robot_sysid.estimation.algebra.uncertainty import residual_correlation_time
from robot_sysid.estimation.columns import PAYLOAD_NAMES
from robot_sysid.estimation.dataset import DecimatedSamples
from robot_sysid.estimation.fit import Fit, residuals_of
from robot_sysid.estimation.unknowns import WEIGHT, restrict_samples
from robot_sysid.records import Array, Flange
from robot_sysid.results.record import RecordingPayload

SURE_MISFIT = 4.0
"""Root mean square difference of recordings of one kind (empty or loaded), in standard errors,
above which they are refused: none of 60 simulated sets exceeds 1.9, a real arm with elastic joints
reaches 3.3."""
LEAST_MASS = 0.03
"""Difference in mass below which recordings agree, as a share of the payload's mass."""
LEAST_PLACE = 0.01
"""Difference in the payload's centre of mass below which recordings agree [m]."""
LEAST_GYRATION = 0.05
"""Difference in the payload's radius of gyration below which recordings agree [m]."""
UNSEEN = 100.0
"""Prior standard deviation of a body's ten parameters, each in its SI unit: wide, and only there to
keep parameters without data finite."""


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


def payloads_by_recording(fit: Fit, flange: Flange) -> tuple[RecordingPayload, ...]:
    """Return the payload according to each recording, compared with those of the other kind.

    The kinds are recordings without and with the payload; those without come first. A recording
    that is the only one of its kind gets no entry. Payloads are in the flange frame. The fit needs
    its rows (``Fit.samples``).
    """
    unknowns = fit.unknowns
    recordings = fit.columns.datasets
    payloads = []
    logs = [restrict_samples(samples, unknowns) for samples in fit.samples]
    prior = fit.columns.model_values[unknowns.estimated]
    indices = np.searchsorted(unknowns.estimated, fit.columns.indices(PAYLOAD_NAMES))
    kinds = np.array([log.is_loaded for log in recordings])
    for k in np.argsort(kinds, kind="stable"):
        is_loaded = recordings[k].is_loaded
        if np.count_nonzero(kinds == is_loaded) < 2:
            continue
        selected = [logs[k]]
        for other in np.flatnonzero(kinds != is_loaded):
            selected.append(logs[other])
        values, *covariances = estimate_alone(
            selected, unknowns.groups, prior, fit.noise
        )
        # Of the mass, the first parameter of the payload: due to noise, and of the whole error.
        variances = np.array(covariances)[:, indices[0], indices[0]]
        noise, error = np.sqrt(variances).tolist()
        theta = flange.to_flange(values[indices])
        mass = float(theta[0])
        com = theta[1:4] / mass if mass else np.full(3, np.nan)
        name = recordings[k].name
        payload = RecordingPayload(name, is_loaded, mass, com, noise, error)
        payloads.append(payload)
    return tuple(payloads)


def contradiction(fit: Fit, flange: Flange) -> str:
    """Return a sentence on recordings of one kind that contradict each other; "" where they agree.

    The kinds are recordings without and with the payload; with fewer than three recordings, none
    can be compared. Torque scales of the fit may have been adapted to a recording of the wrong
    kind, so that a difference has to show in a second linearisation, around the model's own values,
    too.

    Args:
        fit: with the rows of recordings (``Fit.samples``).
        flange: frame in which the sentence states bodies.
    """
    recordings = fit.columns.datasets
    kinds = np.array([log.is_loaded for log in recordings])
    if len(kinds) < 3:
        return ""
    bodies, covariance = bodies_apart(fit, fit.samples)
    if not any(_differences(kinds, bodies, covariance)):
        return ""
    samples_of_model = fit.columns.samples(fit.columns.start())
    bodies, covariance = bodies_apart(fit, samples_of_model)
    differences = sorted(_differences(kinds, bodies, covariance))
    if not differences:
        return ""
    # The largest one, in standard errors.
    _, number, quantity = differences[-1]
    same = [k for k in np.flatnonzero(kinds == kinds[number]) if k != number]
    lightest = int(np.argmin(bodies[:, 0]))
    carried = bodies - bodies[lightest]
    least = LEAST_MASS * float(np.max(carried[:, 0]))
    phrases = []
    for log, theta in zip(recordings, carried):
        if log is not recordings[lightest]:
            body = _describe_body(flange.to_flange(theta), least)
            phrases.append(f"{log.name} {body}")
    return (
        f"{recordings[number].name} differs from {', '.join(recordings[k].name for k in same)} in "
        f"{quantity}; compared with {recordings[lightest].name} the arm carries: "
        f"{', '.join(phrases)}"
    )


def _describe_body(theta: Array, least: float) -> str:
    """Return a phrase with mass and centre of mass of a body.

    Args:
        theta: (10,) inertial parameters of the body.
        least: mass up to which the phrase is "nothing" [kg].
    """
    if theta[0] <= least:
        return "nothing"
    position = ", ".join(f"{1e3 * x:.0f}" for x in theta[1:4] / theta[0])
    return f"{theta[0]:.3g} kg at ({position}) mm"


def _differences(
    kinds: NDArray[np.bool_], bodies: Array, covariance: Array
) -> Iterator[tuple[float, int, str]]:
    """Yield the significant differences of each recording from the others of its kind.

    The kinds are recordings without and with the payload. Differences that are small compared with
    the payload are left out (``LEAST_MASS``, ``LEAST_PLACE``, ``LEAST_GYRATION``).

    Args:
        kinds: (d,) whether each recording carries the payload.
        bodies: (d, 10) inertial parameters of the body on the arm in each recording, in the frame
            of the terminal body.
        covariance: (d, 10, d, 10) of the bodies.

    Yields:
        (root mean square difference in standard errors, number of the recording, quantity that
        differs: "mass", "centre of mass" or "inertia").
    """
    payload = np.mean(bodies[kinds], axis=0) - np.mean(bodies[~kinds], axis=0)
    mass = max(abs(float(payload[0])), np.finfo(float).tiny)
    for number, is_loaded in enumerate(kinds):
        others = (kinds == is_loaded) & (np.arange(len(kinds)) != number)
        if not np.any(others):
            continue
        # The body in this recording less the mean one in the others, with the change's covariance.
        weights = (np.arange(len(kinds)) == number) - others / np.sum(others)
        change = weights @ bodies
        spread = np.einsum("i,iajb,j", weights, covariance, weights)
        # Change of the first moment that no change of the mass explains [kg m].
        moved = change[1:4] - change[0] * payload[1:4] / mass
        inertia = np.max(np.abs(change[4:]))
        # Quantity, size of its change, least size per kg of the payload, parameters that it is of.
        for quantity, size, least, block in (
            ("mass", abs(change[0]), LEAST_MASS, slice(0, 4)),
            ("centre of mass", np.linalg.norm(moved), LEAST_PLACE, slice(0, 4)),
            ("inertia", inertia, LEAST_GYRATION**2, slice(4, 10)),
        ):
            changes = change[block]
            squared = changes @ np.linalg.solve(spread[block, block], changes)
            ratio = float(np.sqrt(squared / len(changes)))
            if size > least * mass and ratio > SURE_MISFIT:
                yield ratio, number, quantity


def bodies_apart(fit: Fit, samples: Sequence[DecimatedSamples]) -> tuple[Array, Array]:
    """Return the bodies (d, 10) on the arm in each of d recordings, and their covariance.

    A body is its ten inertial parameters, the covariance (d, 10, d, 10). Each recording gets a body
    of its own in place of the payload. The first recording is the
    reference: its body and its error are zero. Labels of recordings as empty or loaded are not
    used. Bodies are in the frame of the terminal body.

    Args:
        fit: gives all other unknowns and their priors.
        samples: rows of each recording.
    """
    count = len(samples) - 1
    common = np.setdiff1d(fit.unknowns.estimated, fit.columns.indices(PAYLOAD_NAMES))
    fewer = replace(fit.unknowns, estimated=common)
    added = list[str]()
    for number in range(count):
        added += [f"{name}({number})" for name in PARAMETER_NAMES]
    names = (*fewer.estimated_names, *added)

    def add_body_columns(number: int, samples: DecimatedSamples) -> DecimatedSamples:
        """Return a recording's rows with columns of all bodies, zero but for that of its number."""
        narrow = restrict_samples(samples, fewer)
        body_columns = np.arange(len(common), len(names))
        rows = []
        columns = []
        # The first ten columns of a joint's rows are those of the terminal link.
        for block, full, block_columns in zip(
            narrow.rows, samples.rows, narrow.columns
        ):
            bodies = np.zeros((len(block), count, N_INERTIAL))
            if number:
                bodies[:, number - 1] = full[:, :N_INERTIAL]
            rows.append(np.hstack((block, bodies.reshape(len(block), -1))))
            columns.append(np.append(block_columns, body_columns))
        return replace(narrow, names=names, columns=tuple(columns), rows=tuple(rows))

    # A recording of the wrong kind widens priors that have nothing to do with it. A known mass
    # (cause ``WEIGHT``) is that of the payload, which these bodies replace.
    priors = [replace(g, widened=1.0) for g in fit.unknowns.groups if g.cause != WEIGHT]
    priors.append(independent_prior("unseen", added, added, UNSEEN))
    prior = np.append(fit.columns.model_values[common], np.zeros(len(added)))
    logs = list(itertools.starmap(add_body_columns, enumerate(samples)))
    values, _, errors = estimate_alone(logs, priors, prior)
    last = slice(len(common), None)
    bodies = np.zeros((count + 1, N_INERTIAL))
    covariance = np.zeros((count + 1, N_INERTIAL) * 2)
    bodies[1:] = values[last].reshape(count, -1)
    covariance[1:, :, 1:] = errors[last, last].reshape((count, N_INERTIAL) * 2)
    return bodies, covariance
