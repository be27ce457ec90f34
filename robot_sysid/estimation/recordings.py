"""Several recordings: what each says alone, and whether those of a kind agree."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import N_INERTIAL
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation.algebra.identifiability import visible_space
from robot_sysid.estimation.algebra.information import combined, restricted, sample_counts
from robot_sysid.estimation.algebra.least_squares import least_squares, weighted
from robot_sysid.estimation.algebra.nuisances import with_prior
from robot_sysid.estimation.choices import HeldOut
from robot_sysid.estimation.columns import PAYLOAD_NAMES
from robot_sysid.estimation.dataset import DecimatedSamples
from robot_sysid.estimation.fit import ChosenRows, Fit, evidence_of
from robot_sysid.estimation.unknowns import WEIGHT, independent
from robot_sysid.records import Array, Flange, SquareRootInformation, Validation
from robot_sysid.records.results import validation_of
from robot_sysid.results.record import OneRecording

DISAGREE, SURE = 2.0, 3.0
"""Scatter over stated errors beyond which logs do not agree; standard errors between a recording
and all others above which it is said to disagree (one in 370 by chance)."""
SURE_MISFIT = 4.0
LEAST_MASS, LEAST_PLACE, LEAST_GYRATION = 0.03, 0.01, 0.05
"""By how much recordings of one kind differ at least where that is refused: root mean square in
standard errors; a share of the payload's mass; of that mass, its place and its radius of gyration
[m]. Of 90 simulated right sets none exceeds 1.8 errors, of a real arm with elastic joints 3.2."""
UNSEEN = 100.0
"""Standard deviation of a body's parameters that keeps those in bounds that nothing shows [SI]."""


def alone(fit: Fit, parts: Sequence[SquareRootInformation]) -> tuple[Array, Array, Array]:
    """Return what some recordings say with the noise and the priors of the whole fit.

    That is (values (k,) of what is sought, their errors by white noise alone, their whole errors).
    """
    weights, sought = fit.weights, fit.unknowns
    plain = restricted(combined(parts), sought.kept_names, sought.held)
    matrix, right = with_prior(plain, sought.groups).stacked(weights)
    of_data = plain.stacked(weights)[0]
    space, prior = visible_space(matrix), fit.columns.prior[sought.kept]
    inverse = space.inverse()
    noise = np.sqrt(np.maximum(np.sum((of_data @ inverse) ** 2, axis=0), 0.0))
    errors = np.where(space.identified, np.sqrt(np.maximum(np.diag(inverse), 0.0)), np.inf)
    return prior + space.solve(right - matrix @ prior), noise, errors


def logs_compared(
    fit: Fit, names: Sequence[str], stretch: float
) -> tuple[tuple[str, ...], tuple[Validation, ...]]:
    """Return (sentences on the logs' own masses, each log predicted from the others).

    Each dataset is of the log that ``names`` says; correlated noise makes errors ``stretch`` times
    as large as white noise would.
    """
    logs = {name: [s for s, n in zip(fit.samples, names) if n == name] for name in names}
    if len(logs) < 2:
        return (), ()
    data = evidence_of(logs.values(), fit.evidence.torque)
    parts, squares = data.blocks, data.squared_torque
    wrong = HeldOut(data, 1.0 / fit.weights).of(fit)
    joints = [joint.joint for joint in fit.information.joints]
    tests = tuple(
        validation_of(
            joints, error, square, sample_counts(part), f"{name}, predicted from the other logs"
        )
        for name, part, error, square in zip(logs, parts, wrong, squares)
    )
    masses = {}
    for name, part in zip(logs, parts):
        values, noise, errors = alone(fit, [part])
        masses[name] = float(values[0]), float(np.hypot(errors[0], stretch * noise[0]))
    return tuple(_agreement(masses)), tests


def _agreement(masses: Mapping[str, tuple[float, float]]) -> Iterator[str]:
    """Yield what the masses of logs and their errors [kg] say of each other."""
    known = {name: pair for name, pair in masses.items() if 0.0 < pair[1] < np.inf}
    said = [
        f"{name} {masses[name][0]:.4g} \u00b1 {masses[name][1]:.2g} kg"
        if name in known
        else f"{name} does not tell the mass"
        for name in masses
    ]
    yield f"mass of each log alone: {'; '.join(said)}"
    if len(known) < 2:
        return
    each, errors = np.array(list(known.values())).T
    weights = 1.0 / np.square(errors)
    mean = float(np.sum(weights * each) / np.sum(weights))
    ratio = float(np.sqrt(np.sum(weights * (each - mean) ** 2) / (len(each) - 1)))
    scatter = f"their masses scatter by {ratio:.2g} times their stated errors"
    if ratio > DISAGREE:
        yield (
            f"the logs do not agree: {scatter}; did the arm carry the same, and were all recorded "
            "in the same way?"
        )
    else:
        yield f"the logs agree: {scatter}"


def each_recording(fit: Fit, flange: Flange, stretch: float) -> tuple[OneRecording, ...]:
    """Return the payload of each recording against all of the other kind, in the flange's frame.

    Correlated noise makes errors ``stretch`` times as large as white noise would.
    """
    informations = [part.information() for part in fit.samples]
    recordings, found = fit.columns.datasets, []
    places = np.searchsorted(fit.unknowns.kept, fit.columns.at(PAYLOAD_NAMES))
    for kind in (False, True):
        same = [k for k, each in enumerate(recordings) if each.is_loaded is kind]
        others = [k for k, each in enumerate(recordings) if each.is_loaded is not kind]
        for k in same if len(same) > 1 else ():
            values, white, errors = alone(fit, [informations[i] for i in (k, *others)])
            theta, noise = flange.to_flange(values[places]), stretch * white[places[0]]
            rest = np.sqrt(max(errors[places[0]] ** 2 - white[places[0]] ** 2, 0.0))
            mass = float(theta[0])
            com = theta[1:4] / mass if mass else np.full(3, np.nan)
            error = float(np.hypot(rest, noise))
            found.append(OneRecording(recordings[k].name, kind, mass, com, float(noise), error))
    return tuple(found)


def disagreeing(scatter: Sequence[OneRecording], mass: float) -> Iterator[str]:
    """Yield a sentence per recording that is further from the mass [kg] than noise explains."""
    for one in scatter:
        if abs(one.mass - mass) > SURE * one.noise_error:
            yield (
                f"{one.name} alone says {one.mass:.4g} \u00b1 {one.noise_error:.2g} kg (noise "
                f"alone), all recordings together say {mass:.4g} kg: more apart than noise explains"
            )


def contradiction(fit: Fit, flange: Flange, stretch: float) -> str:
    """Return how recordings of one kind are not alike, in the flange's frame; "" where they are.

    Correlated noise makes errors ``stretch`` times as large as white noise would. A fit to
    recordings on the wrong side has scaled torques to explain them; the bodies are then taken
    around the model's values instead.
    """
    recordings = fit.columns.datasets
    kinds, bodies = np.array([each.is_loaded for each in recordings]), np.zeros((0, N_INERTIAL))
    found: list[tuple[float, int, str]] = []
    if len(kinds) < 3:
        return ""
    for samples in (lambda: fit.samples, lambda: fit.columns.samples(fit.columns.start())):
        bodies, covariance = bodies_apart(fit, samples())
        found = sorted(_differences(kinds, bodies, stretch**2 * covariance))
        if not found:
            return ""
    _, number, what = found[-1]
    same = [k for k in np.flatnonzero(kinds == kinds[number]) if k != number]
    lightest = int(np.argmin(bodies[:, 0]))
    listed = [
        f"{recordings[k].name} {_carried(flange.to_flange(bodies[k] - bodies[lightest]))}"
        for k in range(len(kinds))
        if k != lightest
    ]
    return (
        f"{recordings[number].name} differs from {', '.join(recordings[k].name for k in same)} in "
        f"{what}; compared with {recordings[lightest].name} the arm carries: {', '.join(listed)}"
    )


def _carried(theta: Array) -> str:
    """Return mass and centre of mass of a body (10,) in words, the latter where there is one."""
    place = ", ".join(f"{1e3 * x:.0f}" for x in theta[1:4] / (theta[0] or np.nan))
    return f"{theta[0]:.3g} kg at ({place}) mm"


def _differences(
    kinds: NDArray[np.bool_], bodies: Array, covariance: Array
) -> Iterator[tuple[float, int, str]]:
    """Yield (rms over errors, number, what) of each recording that is not like its kind.

    Bodies (d, 10) are those on the arm, their covariance is (d, 10, d, 10).
    """
    apart = np.mean(bodies[kinds], axis=0) - np.mean(bodies[~kinds], axis=0)
    mass = max(abs(float(apart[0])), np.finfo(float).tiny)
    for number, kind in enumerate(kinds):
        others = (kinds == kind) & (np.arange(len(kinds)) != number)
        if not np.any(others):
            continue
        weights = (np.arange(len(kinds)) == number) - others / np.sum(others)
        change = weights @ bodies
        spread = np.einsum("i,iajb,j", weights, covariance, weights)
        moved = change[1:4] - change[0] * apart[1:4] / mass
        sizes = {
            "mass": (abs(change[0]), LEAST_MASS * mass, slice(0, 4)),
            "centre of mass": (np.linalg.norm(moved), LEAST_PLACE * mass, slice(0, 4)),
            "inertia": (np.max(np.abs(change[4:])), LEAST_GYRATION**2 * mass, slice(4, 10)),
        }
        for what, (size, least, block) in sizes.items():
            off, known = change[block], spread[block, block]
            ratio = float(np.sqrt(off @ np.linalg.solve(known, off) / len(off)))
            if size > least and ratio > SURE_MISFIT:
                yield ratio, number, what


def bodies_apart(fit: Fit, samples: Sequence[DecimatedSamples]) -> tuple[Array, Array]:
    """Return (bodies (d, 10), covariance (d, 10, d, 10)) on the arm, each recording with its own.

    The first recording is the reference: its body is zero and so is its error. Nothing is taken
    from what a recording was said to be.
    """
    sought, count = fit.unknowns, len(samples) - 1
    kept = np.setdiff1d(sought.kept, fit.columns.at(PAYLOAD_NAMES))
    fewer = replace(sought, kept=kept)
    added = tuple(f"{n}({k})" for k in range(count) for n in PARAMETER_NAMES)
    names = (*fewer.kept_names, *added)

    def wider(number: int, part: DecimatedSamples) -> SquareRootInformation:
        rows, columns = [], []
        for (_, block, _), full, at in zip(ChosenRows((part,), fewer), part.rows, part.columns):
            own = np.zeros((len(block), count, N_INERTIAL))
            if number:
                own[:, number - 1] = full[:, :N_INERTIAL]
            rows.append(np.hstack((block, own.reshape(len(block), -1))))
            stay = np.searchsorted(kept, at[np.isin(at, kept)])
            columns.append(np.append(stay, np.arange(len(kept), len(names))))
        tau = tuple(right for _, _, right in ChosenRows((part,), fewer))
        own_names = replace(part, names=names, columns=tuple(columns))
        return replace(own_names, rows=tuple(rows), tau=tau).information()

    # Recordings on the wrong side widen priors that have nothing to do with it.
    priors = [replace(g, widened=1.0) for g in sought.groups if g.cause != WEIGHT]
    priors.append(independent("unseen", added, added, UNSEEN))
    known = with_prior(combined([wider(*pair) for pair in enumerate(samples)]), priors)
    prior = np.append(fit.columns.prior[kept], np.zeros(len(added)))
    weights = 1.0 / weighted(known, prior)
    own = slice(len(kept), None)
    bodies, covariance = np.zeros((count + 1, N_INERTIAL)), np.zeros((count + 1, N_INERTIAL) * 2)
    bodies[1:] = least_squares(known, prior, weights)[own].reshape(count, -1)
    inverse = visible_space(known.stacked(weights)[0]).inverse()[own, own]
    covariance[1:, :, 1:] = inverse.reshape((count, N_INERTIAL) * 2)
    return bodies, covariance
