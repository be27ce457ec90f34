"""Several recordings: what each says alone, and whether those of a kind agree."""

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
from robot_sysid.estimation.algebra.autocorrelation import memory
from robot_sysid.estimation.algebra.between_logs import BetweenLogs, compare_logs
from robot_sysid.estimation.algebra.identifiability import visible_space
from robot_sysid.estimation.algebra.information import (
    combined,
    normal_matrix,
    restricted,
    sample_counts,
)
from robot_sysid.estimation.algebra.least_squares import solver, weighted
from robot_sysid.estimation.algebra.nuisances import NuisanceGroup, with_prior
from robot_sysid.estimation.choices import HeldOut, held_out
from robot_sysid.estimation.columns import PAYLOAD_NAMES
from robot_sysid.estimation.dataset import DecimatedSamples
from robot_sysid.estimation.fit import ChosenRows, Fit, evidence_of
from robot_sysid.estimation.unknowns import FRICTION, WEIGHT, Unknowns, independent_prior
from robot_sysid.estimation.verdict import speaks
from robot_sysid.records import Array, Flange, SquareRootInformation, Validation
from robot_sysid.records.figures import percent
from robot_sysid.records.results import validation_of
from robot_sysid.results.record import OneRecording

DISAGREE = 2.0
"""Scatter over stated errors beyond which logs do not agree."""
SURE_MISFIT = 4.0
LEAST_MASS, LEAST_PLACE, LEAST_GYRATION = 0.03, 0.01, 0.05
"""By how much recordings of one kind differ at least where that is refused: root mean square in
standard errors; a share of the payload's mass; of that mass, its place and its radius of gyration
[m]. Of 60 simulated right sets none exceeds 1.9 errors, of a real arm with elastic joints 3.3."""
MOST_NAMED = 2
"""Joints whose friction differs between logs that are named; ``params.json`` has all."""
LEAST_DIFFERENCE = 0.02
"""Share of a joint's friction torque below which a difference between logs is not worth a word."""
NOISE_FLOOR, SIZE_FLOOR = 0.01, 1e-6
"""Part of the fit's noise that a log has at least beside friction of its own, and of the largest
size of a friction term that the others have at least."""
UNSEEN = 100.0
"""Standard deviation of a body's parameters that keeps those in bounds that nothing shows [SI]."""


def within(part: DecimatedSamples, sought: Unknowns) -> DecimatedSamples:
    """Return a recording's rows in what is sought alone, the rest taken off."""
    chosen = list(ChosenRows((part,), sought))
    places = [np.searchsorted(sought.kept, at[np.isin(at, sought.kept)]) for at in part.columns]
    return replace(
        part,
        names=sought.kept_names,
        columns=tuple(places),
        rows=tuple(rows for _, rows, _ in chosen),
        tau=tuple(tau for _, _, tau in chosen),
    )


def alone(
    parts: Sequence[DecimatedSamples],
    groups: Sequence[NuisanceGroup],
    prior: Array,
    start: Array | None = None,
) -> tuple[Array, Array, Array]:
    """Return (values (k,), covariance (k, k) of noise, whole covariance; infinite where nothing is
    seen) of some recordings by themselves, with what is known beforehand.

    Their noise, sought from ``start`` (joints,) [N m] on, and its memory are those of what they
    leave themselves: what they do not agree on with others is no noise of theirs.
    """
    plain = combined([part.information() for part in parts])
    known = with_prior(plain, groups)
    solved = solver(known, prior)
    noise = weighted(known, solved, start)
    values, slow = solved(1.0 / noise)[0], []
    for joint, at in enumerate(parts[0].columns):
        left = [part.tau[joint] - part.rows[joint] @ values[at] for part in parts]
        slow.append(memory(np.concatenate(left)))
    weights = 1.0 / (noise * np.sqrt(slow))
    space = visible_space(known.stacked(weights)[0])
    inverse, seen = space.inverse(), space.identified
    of_noise = plain.stacked(weights)[0] @ inverse
    whole = np.where(np.outer(seen, seen), inverse, np.inf)
    return solved(weights)[0], of_noise.T @ of_noise, whole


def parts_compared(fit: Fit) -> Validation:
    """Return a fit's own prediction of stretches that were not fitted."""
    judge = held_out(fit, fit.unknowns)
    wrong, noise = judge.of(fit), judge.counts * fit.noise**2
    told = speaks(wrong, noise, lambda: judge.chance(fit))
    return replace(judge.validation(wrong), told_enough=told)


@dataclass(frozen=True)
class FrictionOfLogs:
    """Friction of each log, and how much it differs between them.

    Attributes:
        logs: (L,) their names.
        names: (f,) friction terms, such as "coulomb[joint_1]".
        between: what the logs say of them.
        differences: joint, or motor that turns several, whose friction differs by more than its
            errors, to by how much at most, as a share of its friction torque; the largest first.
    """

    logs: tuple[str, ...]
    names: tuple[str, ...]
    between: BetweenLogs
    differences: Mapping[str, float]

    def terms_of(self, owner: str) -> dict[str, int]:
        """Return friction term of a joint, or of a motor, to its place among all of them."""
        split = [name.partition("[") for name in self.names]
        return {term: k for k, (term, _, rest) in enumerate(split) if rest == f"{owner}]"}

    @property
    def note(self) -> tuple[str, ...]:
        """A sentence on the joints whose friction differs; none where there are none."""
        if not self.differences:
            return ()
        worst = list(self.differences.items())
        listed = ", ".join(f"{joint} by {percent(share)}" for joint, share in worst[:MOST_NAMED])
        more = f" and {len(worst) - MOST_NAMED} more" if len(worst) > MOST_NAMED else ""
        return (
            f"friction differs between the logs by more than its errors: {listed}{more}; "
            "params.json has the friction of each log, and its error on another day",
        )


@dataclass(frozen=True)
class LogComparison:
    """How several logs of an arm compare: sentences, each log predicted from the others, friction;
    nothing of a single log.
    """

    notes: tuple[str, ...] = ()
    tests: tuple[Validation, ...] = ()
    friction: FrictionOfLogs | None = None


def logs_compared(fit: Fit, names: Sequence[str]) -> LogComparison:
    """Return how the logs of a fit compare.

    Each dataset is of the log that ``names`` says. A log of which the others do not tell enough, as
    of joints that move in it alone, is no test of them.
    """
    logs = {name: [s for s, n in zip(fit.samples, names) if n == name] for name in names}
    if len(logs) < 2:
        return LogComparison()
    data = evidence_of(logs.values(), fit.evidence.torque)
    parts, squares = data.blocks, data.squared_torque
    judge = HeldOut(data, 1.0 / fit.weights, fit.unknowns)
    wrong, noise = judge.of(fit), judge.counts * fit.noise**2
    chance = cache(partial(judge.chance, fit))

    def told(k: int) -> bool:
        return speaks(wrong[[k]], noise[[k]], lambda: chance()[[k]])

    joints = [joint.joint for joint in fit.evidence.whole.joints]
    tests = tuple(
        validation_of(
            joints, error, square, sample_counts(part), f"{name}, predicted from the other logs"
        )
        for k, (name, part, error, square) in enumerate(zip(logs, parts, wrong, squares))
        if told(k)
    )
    sought = fit.unknowns
    own_rows = {name: [within(part, sought) for part in log] for name, log in logs.items()}
    friction = friction_of_logs(fit, own_rows, parts)
    masses = {}
    for name, log in own_rows.items():
        values, _, whole = alone(log, sought.groups, fit.columns.prior[sought.kept], fit.noise)
        masses[name] = float(values[0]), float(np.sqrt(whole[0, 0]))
    note = () if friction is None else friction.note
    return LogComparison((*_agreement(masses, not note), *note), tests, friction)


def friction_of_logs(
    fit: Fit,
    logs: Mapping[str, Sequence[DecimatedSamples]],
    blocks: Sequence[SquareRootInformation],
) -> FrictionOfLogs | None:
    """Return friction of each log, links and all else in common; None where none is sought.

    Args:
        logs: rows of each log in what the fit has sought.
        blocks: what each log says of all parameters.
    """
    sought = fit.unknowns
    names = _friction_names(sought)
    if not names:
        return None
    places = np.array([sought.kept_names.index(name) for name in names])
    values = fit.values[sought.kept[places]]
    plain = [restricted(block, sought.kept_names, sought.held) for block in blocks]
    ones = np.ones(len(fit.weights))
    squares = sum(normal_matrix(one, ones)[np.ix_(places, places)] for one in plain)
    owners = np.array([name.partition("[")[2][:-1] for name in names])
    has_same_owner = owners[:, None] == owners
    # A term counts by its share of the usual friction torque of its joint, so that one that is next
    # to nothing may differ as much as the others.
    diagonal = np.diag(squares)
    sizes = np.sqrt(has_same_owner @ (values**2 * diagonal) / diagonal)
    sizes = np.maximum(sizes, SIZE_FLOOR * max(float(np.max(sizes)), SIZE_FLOOR))
    terms = np.array([name.partition("[")[0] for name in names])
    weights = [_weights_beside_friction(fit, log, places) for log in logs.values()]
    normals = [normal_matrix(*pair) for pair in zip(plain, weights)]
    prior = np.zeros_like(normals[0])
    for group in sought.groups:
        rows = group.rows(sought.kept_names)
        prior += rows.T @ rows
    kinds = np.unique(terms, return_inverse=True)[1]
    between = compare_logs(normals, prior, places, values, sizes, kinds)

    joints = dict.fromkeys(owners.tolist())
    rubbing = {joint: np.flatnonzero((owners == joint) & (terms != "offset")) for joint in joints}
    differences = {}
    for joint, own in rubbing.items():
        if len(own) and between.differ(own, len(joints)):
            share = _largest_difference(between.values[:, own], squares[own][:, own])
            if share > LEAST_DIFFERENCE:
                differences[joint] = share
    ordered = sorted(differences.items(), key=lambda item: -item[1])
    return FrictionOfLogs(tuple(logs), tuple(names), between, dict(ordered))


def _friction_names(sought: Unknowns) -> list[str]:
    """Return the friction terms that are sought, without rotors, which stay as they are, and what
    friction is only allowed for.
    """
    allowed = {name for group in sought.groups if group.cause == FRICTION for name in group.names}
    terms = TERMS.keys() - {"armature"}
    return [n for n in sought.kept_names if n not in allowed and n.partition("[")[0] in terms]


def _weights_beside_friction(
    fit: Fit, log: Sequence[DecimatedSamples], places: NDArray[np.int64]
) -> Array:
    """Return by which weights (joints,) a log counts [1/(N m)]: one over the noise that the fit
    leaves in it beside friction of its own, with the noise's memory.
    """
    values = fit.values[fit.unknowns.kept]
    weights = np.zeros(len(log[0].columns))
    for joint, columns in enumerate(log[0].columns):
        rows, tau = (np.concatenate(parts) for parts in zip(*[p.in_use(joint) for p in log]))
        if not len(tau):
            continue
        residual = tau - rows @ values[columns]
        own = rows[:, np.isin(columns, places)]
        residual -= own @ np.linalg.lstsq(own, residual, rcond=None)[0]
        slow = memory(residual)
        floor = NOISE_FLOOR * fit.noise[joint]
        weights[joint] = 1.0 / (max(float(np.std(residual)), floor) * np.sqrt(slow))
    return weights


def _largest_difference(values: Array, squares: Array) -> float:
    """Return by how much a joint's friction (L, m) differs at most between two logs, as a share of
    its friction torque, whose squares are (m, m).
    """
    mean = np.mean(values, axis=0)
    pairs = itertools.combinations(values, 2)
    squared = max(float((a - b) @ squares @ (a - b)) for a, b in pairs)
    torque = float(mean @ squares @ mean)
    return math.sqrt(squared / torque) if torque > 0.0 else math.inf


def _agreement(masses: Mapping[str, tuple[float, float]], has_same_friction: bool) -> Iterator[str]:
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
    elif has_same_friction:
        yield f"the logs agree: {scatter}"
    else:
        yield f"the logs agree on the mass, not on friction: {scatter}"


def each_recording(fit: Fit, flange: Flange) -> tuple[OneRecording, ...]:
    """Return the payload of each recording against all of the other kind, in the flange's frame."""
    sought, recordings, found = fit.unknowns, fit.columns.datasets, []
    parts = [within(part, sought) for part in fit.samples]
    given = sought.groups, fit.columns.prior[sought.kept], fit.noise
    places = np.searchsorted(sought.kept, fit.columns.at(PAYLOAD_NAMES))
    for kind in (False, True):
        same = [k for k, each in enumerate(recordings) if each.is_loaded is kind]
        others = [k for k, each in enumerate(recordings) if each.is_loaded is not kind]
        for k in same if len(same) > 1 else ():
            values, *spread = alone([parts[i] for i in (k, *others)], *given)
            theta = flange.to_flange(values[places])
            noise, error = (float(np.sqrt(each[places[0], places[0]])) for each in spread)
            mass = float(theta[0])
            com = theta[1:4] / mass if mass else np.full(3, np.nan)
            found.append(OneRecording(recordings[k].name, kind, mass, com, noise, error))
    return tuple(found)


def contradiction(fit: Fit, flange: Flange) -> str:
    """Return how recordings of one kind are not alike, in the flange's frame; "" where they are.

    A fit to recordings on the wrong side has scaled torques to explain them; the bodies are then
    taken around the model's values instead.
    """
    recordings = fit.columns.datasets
    kinds, bodies = np.array([each.is_loaded for each in recordings]), np.zeros((0, N_INERTIAL))
    found: list[tuple[float, int, str]] = []
    if len(kinds) < 3:
        return ""
    for samples in (lambda: fit.samples, lambda: fit.columns.samples(fit.columns.start())):
        bodies, covariance = bodies_apart(fit, samples())
        found = sorted(_differences(kinds, bodies, covariance))
        if not found:
            return ""
    _, number, what = found[-1]
    same = [k for k in np.flatnonzero(kinds == kinds[number]) if k != number]
    lightest = int(np.argmin(bodies[:, 0]))
    carried = bodies - bodies[lightest]
    least = LEAST_MASS * float(np.max(carried[:, 0]))
    listed = [
        f"{each.name} {_carried(flange.to_flange(theta), least)}"
        for each, theta in zip(recordings, carried)
        if each is not recordings[lightest]
    ]
    return (
        f"{recordings[number].name} differs from {', '.join(recordings[k].name for k in same)} in "
        f"{what}; compared with {recordings[lightest].name} the arm carries: {', '.join(listed)}"
    )


def _carried(theta: Array, least: float) -> str:
    """Return mass and centre of mass of a body (10,) in words; it is nothing below a mass [kg]."""
    if theta[0] <= least:
        return "nothing"
    place = ", ".join(f"{1e3 * x:.0f}" for x in theta[1:4] / theta[0])
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

    def wider(number: int, part: DecimatedSamples) -> DecimatedSamples:
        own, rows = within(part, fewer), []
        for block, full in zip(own.rows, part.rows):
            bodies = np.zeros((len(block), count, N_INERTIAL))
            if number:
                bodies[:, number - 1] = full[:, :N_INERTIAL]
            rows.append(np.hstack((block, bodies.reshape(len(block), -1))))
        last = np.arange(len(kept), len(names))
        columns = tuple(np.append(at, last) for at in own.columns)
        return replace(own, names=names, columns=columns, rows=tuple(rows))

    # Recordings on the wrong side widen priors that have nothing to do with it.
    priors = [replace(g, widened=1.0) for g in sought.groups if g.cause != WEIGHT]
    priors.append(independent_prior("unseen", added, added, UNSEEN))
    prior = np.append(fit.columns.prior[kept], np.zeros(len(added)))
    parts = [wider(*pair) for pair in enumerate(samples)]
    values, _, whole = alone(parts, priors, prior)
    own = slice(len(kept), None)
    bodies, covariance = np.zeros((count + 1, N_INERTIAL)), np.zeros((count + 1, N_INERTIAL) * 2)
    bodies[1:] = values[own].reshape(count, -1)
    covariance[1:, :, 1:] = whole[own, own].reshape((count, N_INERTIAL) * 2)
    return bodies, covariance
