"""Parameters to estimate and their priors: the only place where questions differ.

Nuisance parameters come in groups, each with one cause of error. A question selects which
parameters are free, which have a prior and which are held; all later steps are common to the last
link, all links and a payload. A ``Question`` says which parameters are wanted, a ``Choice`` holds
the settings that are selected from the recordings, such as each joint's friction terms.

Shapes: n joints of the chain, "joints" those with equations; p parameters (``Columns.names``), k of
them unknown. A body has ten inertial parameters in the order of ``PARAMETER_NAMES``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.equations import link_names, names_of, other_links
from robot_sysid.dynamics.friction import FADING_SPEEDS, speed_name
from robot_sysid.dynamics.spatial import N_INERTIAL
from robot_sysid.estimation.algebra.common_scale import hold_mean, with_common
from robot_sysid.estimation.algebra.priors import (
    AS_STATED,
    NuisanceGroup,
    independent_prior,
    link_aspects,
    link_factor,
    link_lengths,
)
from robot_sysid.estimation.columns import PAYLOAD_NAMES, Columns
from robot_sysid.estimation.dataset import DecimatedSamples
from robot_sysid.estimation.question import (
    FILE_FRICTION,
    FILE_GRAVITY,
    FILE_LINKS,
    Choice,
    EstimationOptions,
    Question,
)
from robot_sysid.records import DELAY_NAME, Array
from robot_sysid.records.option_fields import joint_values

# Causes of error, as they are called in results.
LINKS = "links"
SCALES = "torque scale"
ZEROS = "joint offsets"
TILT = "gravity"
DELAY = "delay"
DRIFT = "drift of friction"
FRICTION = "friction model"
COMMON = "common torque scale"
WEIGHT = "known mass"
OFFSETS = "sensor offsets"
CURVATURE = 5.0
"""Prior standard deviation of the term "sqrt", divided by dry friction times the option
the prior ``friction`` (a share, the default is 2 %)."""
FADING = 15.0
"""Prior standard deviation of each term that fades with speed, divided by dry friction times the
prior ``friction``: a Stribeck curve of 30 % with the default of 2 %."""
LARGEST_USUAL_LOSS = 2.5
"""Largest prior standard deviation of the share of its load that a gear loses, which is reached
where dry friction is large, divided by the prior ``friction``."""
LEAST_COULOMB = 0.02
"""Least dry friction assumed before a fit, as a share of the joint's root mean square torque."""
LEAST_FITTED_COULOMB = 1e-3
"""Least dry friction assumed after a fit, as a share of the joint's root mean square torque."""
LARGEST_LOSS = 0.3
"""Share of its load that a gear loses at most: one that lost half of it would lock backwards."""
DRIFTS = 0.2
"""Prior standard deviation of friction's relative drift from the middle of the recordings to their
ends."""
LOADED_LOSS = 0.1
"""Prior standard deviation of the share of its load that a gear loses, in weighing a payload."""
FILE_TILT = np.radians(2.0)
"""Prior standard deviation of gravity's direction, where a model file's gravity is fitted [rad]."""
USUAL_SCALE = 2.0
"""Default standard deviation of a joint's torque scale [%]."""
LOADED_SCALE = 3.0
"""Default standard deviation of a joint's torque scale where a payload is weighed [%], whose mass
depends on it alone: motor currents of a UR10e read 3 % low to 5 % high."""
COMMON_SCALE = 0.15
"""Standard deviation of an error that all torque scales share, where the logs show one and no
option states it: constants of a motor's data sheet and losses of its gear are off by as much."""
# Prior standard deviation of a coefficient that is known exactly [SI].
_EXACT = 1e-9
# Prior standard deviation of a mass that is known exactly, as a share of the mass.
_EXACT_MASS = 1e-6
# Friction terms whose coefficient may be negative.
_FREE_SIGN = ("offset", "sqrt")
PER_CENT = 0.01
"""One per cent."""
MILLI = 1e-3
"""One thousandth."""


@dataclass(frozen=True)
class Unknowns:
    """Which parameters are unknown, and their priors and bounds.

    Attributes:
        names: (p,) of all parameters.
        estimated: (k,) indices of the unknown parameters, ascending.
        held: (p,) values of all other parameters, which are held.
        groups: priors of unknown parameters; the others have none.
        lower, upper: (p,) bounds; infinite where there is none.
        bodies: name to (indices of its ten parameters, a usual body (10,)) of each unknown body,
            which has to be physically consistent.
        increments: names of the unknown parameters that count from the linearisation point's value.
        names_at_bound: names of the parameters that are held at a bound that they would cross.
    """

    names: tuple[str, ...]
    estimated: NDArray[np.int64]
    held: Array
    groups: tuple[NuisanceGroup, ...]
    lower: Array
    upper: Array
    bodies: Mapping[str, tuple[NDArray[np.int64], Array]]
    increments: tuple[str, ...] = ()
    names_at_bound: tuple[str, ...] = ()

    @cached_property
    def estimated_names(self) -> tuple[str, ...]:
        """Names (k,) of the unknown parameters."""
        return tuple(self.names[index] for index in self.estimated)

    @cached_property
    def nuisance_friction(self) -> set[str]:
        """Names of the friction terms that only a prior allows for (cause ``FRICTION``)."""
        return _names_by_cause(self.groups, FRICTION)

    def has_consistent_bodies(self, values: Array) -> bool:
        """Tell whether all unknown bodies are physically consistent at parameters (p,)."""
        bodies = [values[indices] for indices, _ in self.bodies.values()]
        return all(map(spatial.is_consistent, bodies))

    def groups_of(self, cause: str) -> list[NuisanceGroup]:
        """Return the priors with a cause of error: one, or none."""
        return [group for group in self.groups if group.cause == cause]

    def full(self, estimate: Array) -> Array:
        """Return all parameters (p,) from the estimate (k,) of the unknown ones."""
        values = self.held.copy()
        values[self.estimated] = estimate
        return values

    def may_be_scaled(self, question: Question) -> bool:
        """Tell whether to try an error that all torque scales share.

        It is tried without a payload, where no option states the scales and other links have a
        prior: only their masses, as the model states them, show such an error.
        """
        if question.loaded or question.options.priors.scale is not None:
            return False
        return bool(self.groups_of(LINKS))

    def hold_at_bounds(self, values: Array) -> Unknowns | None:
        """Return the unknowns with fewer parameters: those that cross a bound are held at it.

        ``values`` (p,) decide which ones cross; None where none does.
        """
        inside = np.clip(values, self.lower, self.upper)
        slack = 1e-9 * (1.0 + np.abs(inside))  # for rounding
        crosses = np.abs(values - inside) > slack
        crossing = self.estimated[crosses[self.estimated]]
        if not len(crossing):
            return None
        held = self.held.copy()
        held[crossing] = inside[crossing]
        names = tuple(self.names[k] for k in crossing)
        unknown_names = set(self.estimated_names).difference(names)
        return replace(
            self,
            estimated=np.setdiff1d(self.estimated, crossing),
            held=held,
            groups=tuple(_restrict_groups(self.groups, unknown_names)),
            names_at_bound=(*self.names_at_bound, *names),
        )


def _names_by_cause(groups: Iterable[NuisanceGroup], cause: str) -> set[str]:
    """Return the names of all nuisances with a cause of error."""
    names = set[str]()
    for group in groups:
        if group.cause == cause:
            names.update(group.names)
    return names


def _restrict_groups(
    groups: Iterable[NuisanceGroup], names: set[str]
) -> Iterator[NuisanceGroup]:
    """Yield the priors restricted to named parameters; groups without any of them are left out.

    Only groups with independent errors may be cut. ``NuisanceGroup.aspects`` of a group that is cut
    returns no aspects.
    """
    for group in groups:
        is_kept = np.isin(group.names, [*names])
        if np.all(is_kept):
            yield group
        elif np.any(is_kept):
            yield replace(
                group,
                names=tuple(compress(group.names, is_kept)),
                mean=group.mean[is_kept],
                factor=group.factor[np.ix_(is_kept, is_kept)],
                members=tuple(compress(group.members, is_kept)),
                aspects=tuple,
            )


def build_unknowns(
    columns: Columns,
    question: Question,
    choice: Choice,
    torque: Array,
    nonzero: NDArray[np.bool_],
) -> Unknowns:
    """Return the unknowns of a question, with their priors and bounds.

    Args:
        columns: names of all parameters, the model's values, and the arm.
        question: which parameters are wanted, and the prior uncertainties that the user states.
        choice: friction terms of each joint, couplings, known rotors and sensor offsets.
        torque: (n,) root mean square of each joint's measured torque [N m].
        nonzero: (p,) which parameters have a column that is not zero.
    """
    groups = list(_prior_groups(columns, question, choice, torque))
    bodies = dict(_bodies(columns, question))
    increments = tuple(_increment_names(columns, question, choice))
    nuisance_friction = _names_by_cause(groups, FRICTION)
    is_unknown = np.zeros(len(columns.names), dtype=bool)
    is_unknown[columns.indices(increments)] = True
    for group in groups:
        is_unknown[columns.indices(group.names)] = True
    for indices, _ in bodies.values():
        is_unknown[indices] = True
    lower = np.full(len(columns.names), -np.inf)
    upper = np.full(len(columns.names), np.inf)
    for owner, terms in _terms(columns, choice):
        for term in terms:
            name = f"{term}[{owner}]"
            index = columns.index[name]
            # A column of zeros identifies nothing: the value would be that of the first point.
            is_unknown[index] |= nonzero[index]
            # Friction terms that only a prior allows for may have either sign, too.
            if not _may_be_negative(term, terms) and name not in nuisance_friction:
                lower[index] = 0.0
                upper[index] = LARGEST_LOSS if term == "load" else np.inf
    if question.known_mass is not None:
        error = _EXACT_MASS * question.known_mass
        # The first parameter of the payload is its mass.
        payload = independent_prior(WEIGHT, PAYLOAD_NAMES[:1], ("payload",), error)
        groups.append(replace(payload, mean=np.array([question.known_mass])))
    elif question.loaded:
        for group in [*groups]:  # a copy, as the list grows
            if group.cause == SCALES:
                groups.append(hold_mean(group, COMMON))
    return Unknowns(
        names=columns.names,
        estimated=np.flatnonzero(is_unknown),
        held=_held_values(columns, question, choice),
        groups=tuple(groups),
        lower=lower,
        upper=upper,
        bodies=bodies,
        increments=increments,
    )


def _may_be_negative(term: str, terms: set[str]) -> bool:
    """Tell whether the coefficient of a friction term may be negative.

    Viscous friction may where "sqrt", which bends the same curve, is among its joint's ``terms``.
    """
    if term == "viscous":
        return "sqrt" in terms
    return term in _FREE_SIGN or term.endswith("_speed")


def _terms(columns: Columns, choice: Choice) -> Iterator[tuple[str, set[str]]]:
    """Yield (joint or motor, names of its friction terms and of their speeds "<term>_speed").

    A motor that turns several joints has the terms of all these joints that a motor can have; its
    rotor is left out where its inertia is known.
    """
    for row, joint in zip(columns.joint_indices, columns.joints):
        model = choice.friction[row]
        terms = set(model.terms)
        for term in model.nonlinear_terms:
            terms.add(f"{term}_speed")
        yield joint, terms
    for motor in choice.couplings:
        terms = set()
        for index in np.flatnonzero(motor.ratios):
            terms.update(choice.friction[index].terms)
        terms &= {*motor.terms}
        if motor.name in choice.rotors:
            terms.discard("armature")
        yield motor.name, terms


def _increment_names(
    columns: Columns, question: Question, choice: Choice
) -> Iterator[str]:
    """Yield the names of the unknown parameters that count from the linearisation point's value."""
    if question.in_file:
        if FILE_GRAVITY not in question.unchanged_parts:
            yield from columns.tilts
        return
    for row, joint in zip(columns.joint_indices, columns.joints):
        for term in choice.friction[row].nonlinear_terms:
            yield speed_name(term, joint)


def _held_values(columns: Columns, question: Question, choice: Choice) -> Array:
    """Return the values (p,) at which parameters are held where they are not estimated.

    Links, friction and rotors that are not estimated have the model's values, a carried payload and
    known rotors the given ones; all others are zero. Those of unknown parameters have no effect.
    """
    held = np.zeros(len(columns.names))
    for name, indices in columns.bodies().items():
        if name != "payload":
            held[indices] = columns.model_values[indices]
    if question.carried is not None:
        held[columns.indices(PAYLOAD_NAMES)] = question.carried
    for joint, model in zip(columns.robot.joint_names, choice.friction):
        kept_terms = set[str]()
        if not model.terms or FILE_FRICTION in question.unchanged_parts:
            kept_terms = {"coulomb", "viscous"}
        # A URDF holds no rotor inertia.
        if question.file_kind != "urdf" and "armature" not in model.terms:
            kept_terms.add("armature")
        for term in kept_terms:
            index = columns.index.get(f"{term}[{joint}]")
            if index is not None:
                held[index] = columns.model_values[index]
    for motor in columns.couplings:
        indices = columns.indices(motor.parameter_names)
        held[indices] = columns.model_values[indices]
    for owner, rotor in choice.rotors.items():
        held[columns.index[f"armature[{owner}]"]] = rotor
    return held


def _bodies(
    columns: Columns, question: Question
) -> Iterator[tuple[str, tuple[NDArray[np.int64], Array]]]:
    """Yield each unknown body's name, indices of its parameters (10,) and a usual body (10,)."""
    last = columns.robot.body_name
    are_kept = FILE_LINKS in question.unchanged_parts
    others_are_unknown = question.options.priors.link > 0.0 and not are_kept
    for name, indices in columns.bodies().items():
        if name == "payload":
            # A payload is expected to be like the link that carries it.
            if question.loaded:
                yield name, (indices, columns.usual_bodies[last])
        elif name == last or others_are_unknown:
            yield name, (indices, columns.usual_bodies[name])


def _prior_groups(
    columns: Columns, question: Question, choice: Choice, torque: Array
) -> Iterator[NuisanceGroup]:
    """Yield the priors of a question, one group per cause of error.

    Args:
        torque: (n,) root mean square of each joint's measured torque [N m].
    """
    links = _link_group(columns, question, choice)
    if links is not None:
        yield links
    if choice.offsets:
        names = names_of("offset", choice.offsets)
        deviations = np.maximum([*choice.offsets.values()], _EXACT)
        yield independent_prior(OFFSETS, names, tuple(choice.offsets), deviations)
    tilts = columns.tilts
    if question.in_file:
        if tilts and FILE_GRAVITY not in question.unchanged_parts:
            yield independent_prior(TILT, tilts, ("the base",) * 2, FILE_TILT)
        return
    options = question.options
    may_widen = question.loaded
    joints = columns.joints
    joint_priors = (
        (SCALES, "scale", joints, scale_spread(columns, options, question.loaded)),
        (ZEROS, "zero", columns.robot.joint_names, MILLI * options.priors.zero),
        (DRIFT, "drift", joints, DRIFTS if question.drifts else 0.0),
    )
    for cause, prefix, members, deviation in joint_priors:
        if not np.any(np.greater(deviation, 0.0)):
            continue
        names = names_of(prefix, members)
        deviations = np.maximum(deviation, _EXACT)
        prior = independent_prior(cause, names, members, deviations, may_widen)
        if cause == SCALES:
            prior = with_common(prior, choice.common_scale)
        yield prior
    delay_error = 0.0 if question.resting else MILLI * options.priors.delay
    if delay_error > 0.0:
        yield independent_prior(
            DELAY, (DELAY_NAME,), ("the torque",), delay_error, may_widen
        )
    if tilts and options.priors.gravity > 0.0:
        deviation = float(np.radians(options.priors.gravity))
        yield independent_prior(TILT, tilts, ("the base",) * 2, deviation, may_widen)
    if not question.resting:
        yield from _friction_group(columns, question, choice, torque)


def _friction_group(
    columns: Columns, question: Question, choice: Choice, torque: Array
) -> Iterator[NuisanceGroup]:
    """Yield the prior of friction terms that the joints' friction models lack, one group at most.

    Standard deviations follow from a joint's dry friction, times the prior ``friction``.

    Args:
        torque: (n,) root mean square of each joint's measured torque [N m].
    """
    share = PER_CENT * question.options.priors.friction
    if share == 0.0:
        return
    rows = list(columns.joint_indices)
    usual_torque = torque[rows]
    if choice.dry_friction is None:
        dry = np.array(expected_dry_friction(columns, torque))
        loss = np.full_like(dry, share)
    else:
        dry = np.maximum(choice.dry_friction, LEAST_FITTED_COULOMB * usual_torque)
        # A gear that loses much of its load has much dry friction without load, too.
        share_of_torque = dry / np.maximum(usual_torque, _EXACT)
        loss = np.clip(share_of_torque, share, LARGEST_USUAL_LOSS * share)
    if question.loaded:
        loss = np.full_like(dry, max(share, LOADED_LOSS))
    # Term to standard deviation (joints,) of its coefficient.
    sizes = {"load": loss, "sqrt": CURVATURE * share * dry}
    if choice.dry_friction is not None:
        sizes |= dict.fromkeys(FADING_SPEEDS, FADING * share * dry)
    names = list[str]()
    members = list[str]()
    deviations = list[float]()
    for term, joint_deviations in sizes.items():
        for k, joint in enumerate(columns.joints):
            model = choice.friction[rows[k]]
            if model.terms and term not in model.terms:
                names.append(f"{term}[{joint}]")
                members.append(joint)
                deviations.append(max(float(joint_deviations[k]), _EXACT))
    if names:
        yield independent_prior(
            FRICTION, names, members, np.array(deviations), question.loaded
        )


def expected_dry_friction(columns: Columns, torque: Array) -> tuple[float, ...]:
    """Return the dry friction (joints,) to expect before a fit [N m].

    It is the model's Coulomb friction, and at least a share ``LEAST_COULOMB`` of the torque.

    Args:
        torque: (n,) root mean square of each joint's measured torque [N m].
    """
    rows = list(columns.joint_indices)
    dry = np.maximum(columns.robot.friction.coulomb[rows], LEAST_COULOMB * torque[rows])
    return tuple(dry.tolist())


def _link_group(
    columns: Columns, question: Question, choice: Choice
) -> NuisanceGroup | None:
    """Return the prior of all links but the terminal one; None where none of them is unknown.

    Its mean is the model's body with the stated uncertainty. For a placeholder, it is a usual body
    with a standard deviation as large as that body.
    """
    robot = columns.robot
    if columns.torques != "chain":
        return None
    bodies = dict(_bodies(columns, question))
    links = list[int]()
    names = list[str]()
    members = list[str]()
    # Numbers among ``links`` of those that the model states, and of its placeholders.
    stated = list[int]()
    placeholders = list[int]()
    usual_bodies = []
    for link in other_links(robot):
        name = robot.links[link].body_name
        if name in bodies:
            _, usual_body = bodies[name]
            # Placeholders have another array than the model's.
            numbers = stated if usual_body is robot.links[link].theta else placeholders
            numbers.append(len(links))
            usual_bodies.append(usual_body)
            links.append(link)
            names += link_names(robot, link)
            members += [name] * N_INERTIAL
    if not links:
        return None
    share = PER_CENT * question.options.priors.link
    lengths = np.array(link_lengths(robot, links))
    thetas = np.array(usual_bodies)
    # Stated links share errors, placeholders do not: (numbers of links, share, factors).
    blocks = [([number], 1.0, AS_STATED) for number in placeholders]
    if stated:
        blocks.append((stated, share, choice.link_scales))
    factor = np.zeros((len(names), len(names)))
    rows = np.arange(len(names)).reshape(thetas.shape)
    for numbers, deviation, scales in blocks:
        block = link_factor(thetas[numbers], deviation, lengths[numbers], scales)
        block_rows = rows[numbers].ravel()
        factor[np.ix_(block_rows, block_rows)] = block
    aspects = partial(link_aspects, thetas, lengths)
    return NuisanceGroup(
        LINKS, tuple(names), thetas.ravel(), factor, tuple(members), aspects=aspects
    )


def scale_spread(columns: Columns, options: EstimationOptions, loaded: bool) -> Array:
    """Return the prior standard deviation (joints,) of each joint's torque scale, 0.02 for 2 %.

    Args:
        loaded: whether a payload is weighed, for which the default is larger.
    """
    percent = options.priors.scale
    if percent is None:
        percent = LOADED_SCALE if loaded else USUAL_SCALE
    scale = joint_values(percent, columns.robot.n_joints, "scale of --priors")
    return PER_CENT * scale[list(columns.joint_indices)]


@dataclass(frozen=True)
class EstimatedRows:
    """Rows of recordings in the estimated parameters, the torque of held ones subtracted.

    Iterating makes the rows of one joint at a time, as those of all joints take much memory. The
    recordings ``samples`` all have the same columns, of all p parameters.
    """

    samples: tuple[DecimatedSamples, ...]
    unknowns: Unknowns

    def __iter__(self) -> Iterator[tuple[int, Array, Array]]:
        """Yield (joint number, rows (M, k), right-hand sides (M,)) of each joint.

        M counts the rows of all recordings, one recording below the other; k are the estimated
        parameters in the joint's equations.
        """
        for joint in range(len(self.samples[0].columns)):
            # No variable here keeps rows in memory while the next ones are made.
            yield (joint, *self._joint_rows(joint))

    def _joint_rows(self, joint: int) -> tuple[Array, Array]:
        """Return a joint's (rows (M, k), right-hand sides (M,)), in new arrays."""
        columns = self.samples[0].columns[joint]
        is_estimated = np.isin(columns, self.unknowns.estimated)
        held = self.unknowns.held[columns[~is_estimated]]
        n_rows = sum(map(len, self.samples))
        all_rows = np.empty((n_rows, np.count_nonzero(is_estimated)))
        right_sides = []
        start = 0
        for recording in self.samples:
            rows = recording.rows[joint]
            all_rows[start : start + len(rows)] = rows[:, is_estimated]
            start += len(rows)
            right_sides.append(recording.tau[joint] - rows[:, ~is_estimated] @ held)
        return all_rows, np.concatenate(right_sides)


def restrict_samples(samples: DecimatedSamples, unknowns: Unknowns) -> DecimatedSamples:
    """Return a recording's rows in the estimated parameters, the torque of held ones subtracted.

    The result's names are those of the estimated parameters, ``Unknowns.estimated_names``.
    """
    columns = []
    for indices in samples.columns:
        estimated = indices[np.isin(indices, unknowns.estimated)]
        # Their positions among the estimated parameters, which ascend.
        columns.append(np.searchsorted(unknowns.estimated, estimated))
    _, rows, right_sides = zip(*EstimatedRows((samples,), unknowns))
    return replace(
        samples,
        names=unknowns.estimated_names,
        columns=tuple(columns),
        rows=rows,
        tau=right_sides,
    )
