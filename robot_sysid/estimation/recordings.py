"""Several recordings: what each says alone, and whether those of a kind agree."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.dynamics.equations import N_INERTIAL
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation.algebra.identifiability import visible_space
from robot_sysid.estimation.algebra.information import combined, restricted, sample_counts
from robot_sysid.estimation.algebra.least_squares import least_squares, weighted
from robot_sysid.estimation.algebra.nuisances import with_prior
from robot_sysid.estimation.columns import PAYLOAD_NAMES
from robot_sysid.estimation.dataset import DecimatedSamples, JoinedSamples, information_of
from robot_sysid.estimation.fit import ChosenRows, Evidence, Fit
from robot_sysid.estimation.held_out import HeldOut
from robot_sysid.estimation.unknowns import WEIGHT
from robot_sysid.records import Array, Flange, SquareRootInformation, Validation
from robot_sysid.records.results import validation_of
from robot_sysid.results.record import OneRecording

DISAGREE, SURE = 2.0, 3.0
"""Scatter over stated errors beyond which logs do not agree; standard errors between a recording
and all others above which it is said to disagree."""
LEAST_MISFIT, SURE_MISFIT = 0.1, 4.0
"""Share of the payload, and standard errors, by which recordings of one kind differ at least where
that is refused."""


@dataclass(frozen=True)
class Alone:
    """What some of the recordings say by themselves.

    Attributes:
        values: (k,) of what is sought.
        noise: (k,) standard errors of noise alone, white.
        errors: (k,) whole ones.
    """

    values: Array
    noise: Array
    errors: Array


def alone(fit: Fit, parts: Sequence[SquareRootInformation]) -> Alone:
    """Return what some recordings say with the noise and the priors of the whole fit.

    Args:
        parts: information of some, in all parameters.
    """
    weights, sought = 1.0 / fit.weighted.noise, fit.unknowns
    plain = restricted(combined(parts), sought.kept_names, sought.held)
    matrix, right = with_prior(plain, sought.groups).stacked(weights)
    of_data = plain.stacked(weights)[0]
    space, prior = visible_space(matrix), fit.columns.prior[sought.kept]
    inverse = space.inverse()
    data = np.sqrt(np.maximum(np.sum((of_data @ inverse) ** 2, axis=0), 0.0))
    errors = np.where(space.identified, np.sqrt(np.maximum(np.diag(inverse), 0.0)), np.inf)
    return Alone(prior + space.solve(right - matrix @ prior), data, errors)


def logs_compared(
    fit: Fit, names: Sequence[str], stretch: float
) -> tuple[tuple[str, ...], tuple[Validation, ...]]:
    """Return (sentences on the logs' own masses, each log predicted from the others).

    Args:
        names: per dataset, the log that it is of.
        stretch: by how much correlated noise makes errors larger than white noise would.
    """
    logs = {
        name: combined([s.information() for s, n in zip(fit.samples, names) if n == name])
        for name in dict.fromkeys(names)
    }
    if len(logs) < 2:
        return (), ()
    each = {name: alone(fit, [part]) for name, part in logs.items()}
    squares = [
        np.sum([s.squared_torque() for s, n in zip(fit.samples, names) if n == name], axis=0)
        for name in logs
    ]
    data = Evidence(tuple(logs.values()), np.array(squares), fit.evidence.torque)
    wrong = HeldOut(data, fit.weighted.noise).of(fit)
    joints = [joint.joint for joint in fit.information.joints]
    tests = tuple(
        validation_of(
            joints, error, square, sample_counts(part), f"{name}, predicted from the other logs"
        )
        for (name, part), error, square in zip(logs.items(), wrong, squares)
    )
    return tuple(_sentences(each, stretch)), tests


def _sentences(logs: Mapping[str, Alone], stretch: float) -> Iterator[str]:
    said, masses, errors = [], [], []
    for name, one in logs.items():
        error = float(np.hypot(one.errors[0], stretch * one.noise[0]))
        if not np.isfinite(error) or error <= 0.0:
            said.append(f"{name} does not tell the mass")
            continue
        masses.append(float(one.values[0]))
        errors.append(error)
        said.append(f"{name} {masses[-1]:.4g} \u00b1 {error:.2g} kg")
    yield f"mass of each log alone: {'; '.join(said)}"
    if len(masses) < 2:
        return
    weights = 1.0 / np.square(errors)
    mean = float(np.sum(weights * masses) / np.sum(weights))
    ratio = float(np.sqrt(np.sum(weights * (np.array(masses) - mean) ** 2) / (len(masses) - 1)))
    if ratio > DISAGREE:
        yield (
            f"the logs do not agree: their masses scatter by {ratio:.2g} times their stated "
            "errors; did the arm carry the same, and were all recorded in the same way?"
        )
    else:
        yield f"the logs agree: their masses scatter by {ratio:.2g} times their stated errors"


def each_recording(fit: Fit, flange: Flange, stretch: float) -> tuple[OneRecording, ...]:
    """Return the payload of each recording against all of the other kind.

    Args:
        flange: frame of the centres of mass.
        stretch: see ``logs_compared``.
    """
    informations = [part.information() for part in fit.samples]
    recordings, found = fit.columns.datasets, []
    places = np.searchsorted(fit.unknowns.kept, fit.columns.at(PAYLOAD_NAMES))
    for kind in (False, True):
        same = [k for k, each in enumerate(recordings) if each.is_loaded is kind]
        others = [k for k, each in enumerate(recordings) if each.is_loaded is not kind]
        for k in same if len(same) > 1 else ():
            one = alone(fit, [informations[i] for i in (k, *others)])
            theta, noise = flange.to_flange(one.values[places]), stretch * one.noise[places[0]]
            rest = np.sqrt(max(one.errors[places[0]] ** 2 - one.noise[places[0]] ** 2, 0.0))
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


def contradictions(fit: Fit) -> tuple[tuple[str, float], ...]:
    """Return (name, mass on the arm) of all recordings where those of one kind are not alike.

    A fit to recordings on the wrong side has scaled torques to explain them; the masses are then
    taken around the model's values instead.
    """
    if not _misfits(fit, *masses_apart(fit, fit.samples)):
        return ()
    return _misfits(fit, *masses_apart(fit, fit.columns.samples(fit.columns.start())))


def masses_apart(fit: Fit, samples: Sequence[DecimatedSamples]) -> tuple[Array, Array]:
    """Return (masses (d,), standard errors (d,)) on the arm, each recording with its own.

    The first recording is the reference: its mass is zero and so is its error. Nothing is taken
    from what a recording was said to be.
    """
    sought, count = fit.unknowns, len(samples) - 1
    kept = np.setdiff1d(sought.kept, fit.columns.at(PAYLOAD_NAMES))
    fewer = replace(sought, kept=kept)
    names = (*fewer.kept_names, *(f"{n}({k})" for k in range(count) for n in PARAMETER_NAMES))
    parts = []
    for number, part in enumerate(samples):
        rows = ChosenRows(JoinedSamples((part,)), fewer)
        stay = [np.searchsorted(kept, c[np.isin(c, kept)]) for c in part.columns]
        own = len(kept) + N_INERTIAL * (number - 1) + np.arange(N_INERTIAL)
        columns = [np.concatenate((s, own)) if number else s for s in stay]
        wider = [
            (k, np.hstack((block, full[:, :N_INERTIAL])) if number else block, tau)
            for (k, block, tau), full in zip(rows, part.rows)
        ]
        parts.append(information_of(wider, names, part.joints, columns))
    # Recordings on the wrong side widen priors that have nothing to do with it.
    priors = [replace(g, widened=1.0) for g in sought.groups if g.cause != WEIGHT]
    known = with_prior(_summed(parts, names), priors)
    prior = np.append(fit.columns.prior[kept], np.zeros(N_INERTIAL * count))
    found = weighted(known, prior)
    space = visible_space(found.whitened()[0])
    values = least_squares(known, prior, 1.0 / found.noise)
    places = [names.index(f"m({k})") for k in range(count)]
    errors = np.sqrt(np.diag(space.inverse())[places])
    return np.append(0.0, values[places]), np.append(0.0, errors)


def _summed(
    parts: Sequence[SquareRootInformation], names: tuple[str, ...]
) -> SquareRootInformation:
    """Return the information of parts whose rows have different columns."""
    every = []
    for part in parts:
        joints = []
        for joint in part.joints:
            triangle = np.zeros((len(names) + 1, len(names) + 1))
            triangle[: len(joint.triangle), np.append(joint.columns, len(names))] = joint.triangle
            joints.append(
                replace(joint, columns=np.arange(len(names), dtype=np.int64), triangle=triangle)
            )
        every.append(replace(part, joints=tuple(joints)))
    return combined(every)


def _misfits(fit: Fit, masses: Array, errors: Array) -> tuple[tuple[str, float], ...]:
    """Return (name, mass) of all recordings where those of one kind are not alike."""
    recordings = fit.columns.datasets
    kinds = np.array([each.is_loaded for each in recordings])
    middle = {kind: float(np.median(masses[kinds == kind])) for kind in (False, True)}
    size = abs(middle[True] - middle[False])
    off = np.abs(masses - np.where(kinds, middle[True], middle[False]))
    allowed = np.maximum(SURE_MISFIT * np.hypot(errors, np.max(errors)), LEAST_MISFIT * size)
    if not np.any(off > allowed):
        return ()
    return tuple((each.name, float(mass)) for each, mass in zip(recordings, masses))
