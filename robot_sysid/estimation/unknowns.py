"""What is sought, what is known of it beforehand: the only place where questions differ.

Unknowns come in groups, each with a cause. A question chooses which are free, which have a prior
and which are held; everything after that is the same for the last link, all links and a payload.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import other_links
from robot_sysid.dynamics.friction import FADING_SPEEDS, Coupling, FrictionModel, speed_name
from robot_sysid.dynamics.nuisances import TILT_NAMES
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation.algebra.nuisances import (
    AS_STATED,
    LinkScales,
    NuisanceGroup,
    link_aspects,
    link_factor,
    link_lengths,
)
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.estimation.columns import PAYLOAD_NAMES, Columns
from robot_sysid.records import DELAY_NAME, Array
from robot_sysid.records.options import per_joint

LINKS, SCALES, ZEROS, TILT = "links", "torque scale", "joint offsets", "gravity"
DELAY, DRIFT, FRICTION = "delay", "drift of friction", "friction model"
COMMON, WEIGHT, OFFSETS = "common torque scale", "known mass", "sensor offsets"
"""Causes of error, as they are called in results."""
FILE_FRICTION, FILE_ROTORS, FILE_GRAVITY, FILE_LINKS = "friction", "rotors", "gravity", "links"
"""Parts of a model file that may be kept as they are."""
CURVATURE = 5.0
"""How curved friction may be, as part of its dry friction and in units of what it may grow with the
gear's torque (documented with --friction-uncertainty)."""
FADING = 15.0
"""How much of friction may fade with speed, the same way: a Stribeck curve of 30 %."""
LARGEST_USUAL_LOSS = 2.5
"""What a gear may lose of its load where it has much dry friction, in the same units."""
LEAST_COULOMB, LEAST_FOUND = 0.02, 1e-3
"""Dry friction is at least so much of a joint's usual torque: before a fit, and after one."""
LARGEST_LOSS = 0.3
"""Share of its load that a gear loses at most: one that lost half of it would lock backwards."""
DRIFTS, LOADED_LOSS = 0.2, 0.1
"""Standard deviations: of friction's drift from the middle of the recordings to their ends (a
share), of a gear's loss where loads differ."""
FILE_TILT = np.radians(2.0)
"""Standard deviation of the direction of gravity that a file is given [rad]."""
USUAL_SCALE, LOADED_SCALE = 2.0, 3.0
"""How far a joint's torque scale may be off where nobody says [%], and where a payload is weighed,
whose mass hangs on it alone: motor currents of a UR10e read 3 % low to 5 % high."""
COMMON_SCALE = 0.15
"""Standard deviation of what all torque scales are off by together, where the logs ask for it and
nobody says: constants of a motor's data sheet and losses of its gear are off by as much."""
# Standard deviations of what is known exactly: of coefficients, and of a mass as a share.
_EXACT, _EXACT_MASS = 1e-9, 1e-6
_FREE_SIGN = ("offset", "sqrt")
PER_CENT, MILLI = 0.01, 1e-3


@dataclass(frozen=True)
class Question:
    """What is asked of some recordings.

    Attributes:
        options: how far the arm may be off, and what else the user says.
        loaded: whether recordings carry something that is sought.
        drifts: whether a drift of friction over the recordings is sought.
        known_mass: of the payload [kg], where torque scales are sought with it.
        in_file: whether what is sought has to fit into a model file.
        file_kind: kind of that file; a "urdf" holds no rotor inertia.
        kept_parts: parts of that file that stay as they are, ``FILE_FRICTION`` and the like.
        carried: the payload (10,) that loaded recordings carry, where it is known.
        resting: whether the recordings are poses at rest.
    """

    options: EstimationOptions
    loaded: bool = False
    drifts: bool = False
    known_mass: float | None = None
    in_file: bool = False
    file_kind: str = "mjcf"
    kept_parts: tuple[str, ...] = ()
    carried: Array | None = None
    resting: bool = False


@dataclass(frozen=True)
class Choice:
    """What the recordings themselves decide.

    Attributes:
        friction: per chain joint, its friction terms.
        couplings: motors that turn with several joints.
        link_scales: by how many times the stated share the other links may be off.
        common_scale: how far all torque scales may be off together, which only links tell.
        offsets: joint to how far its torque sensor may be off [N m]; that of others is free.
        rotors: joint or motor to its rotor's inertia, where that is known [kg m^2].
        dry_friction: (joints,) about how much dry friction each row's joint has [N m], which says
            how curved its friction may be; None while friction terms are chosen: beside curves
            that are allowed for, a term that is there would gain nothing.
        noise_memory: (joints,) how many rows of a joint count as one independent row; None for one.
    """

    friction: tuple[FrictionModel, ...]
    couplings: tuple[Coupling, ...] = ()
    link_scales: LinkScales = AS_STATED
    common_scale: float = 0.0
    offsets: Mapping[str, float] = field(default_factory=dict)
    rotors: Mapping[str, float] = field(default_factory=dict)
    dry_friction: tuple[float, ...] | None = None
    noise_memory: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Unknowns:
    """Which parameters are sought, and what is known of them.

    Attributes:
        names: (p,) of all parameters.
        kept: (k,) which are sought, ascending.
        held: (p,) values of the others.
        groups: what is known of some of those that are sought.
        lower, upper: (p,) bounds.
        bodies: name to (places of ten parameters, a usual body (10,)) of what has to be a possible
            body.
        settle: names of those that are small changes of what the rows are made around.
        at_bound: names of those that are held at a bound that they would cross.
    """

    names: tuple[str, ...]
    kept: NDArray[np.int64]
    held: Array
    groups: tuple[NuisanceGroup, ...]
    lower: Array
    upper: Array
    bodies: Mapping[str, tuple[NDArray[np.int64], Array]]
    settle: tuple[str, ...] = ()
    at_bound: tuple[str, ...] = ()

    @property
    def kept_names(self) -> tuple[str, ...]:
        """Names (k,) of what is sought."""
        return tuple(self.names[index] for index in self.kept)

    def full(self, found: Array) -> Array:
        """Return all parameters (p,) from those that are sought (k,)."""
        values = self.held.copy()
        values[self.kept] = found
        return values

    def may_be_scaled(self, question: Question) -> bool:
        """Tell whether a common torque scale is looked for: links are sought that tell it."""
        said = question.loaded or question.options.scale_uncertainty is not None
        return not said and any(group.cause == LINKS for group in self.groups)

    def bounded(self, values: Array) -> Unknowns | None:
        """Return the unknowns with what crosses a bound held there; None where nothing does."""
        inside = np.clip(values, self.lower, self.upper)
        slack = 1e-9 * (1.0 + np.abs(inside))
        wrong = [k for k in self.kept if abs(values[k] - inside[k]) > slack[k]]
        if not wrong:
            return None
        held = self.held.copy()
        held[wrong] = inside[wrong]
        names = {self.names[k] for k in wrong}
        groups = tuple(each for g in self.groups for each in _without(g, names))
        kept = np.setdiff1d(self.kept, wrong)
        bound = (*self.at_bound, *(self.names[k] for k in wrong))
        return replace(self, kept=kept, held=held, groups=groups, at_bound=bound)


def _without(group: NuisanceGroup, names: set[str]) -> Iterator[NuisanceGroup]:
    """Yield a group without some of its parameters, which have to be independent of the others."""
    stay = [k for k, name in enumerate(group.names) if name not in names]
    if len(stay) == len(group.names):
        yield group
    elif stay:
        yield replace(
            group,
            names=tuple(group.names[k] for k in stay),
            mean=group.mean[stay],
            factor=group.factor[np.ix_(stay, stay)],
            members=tuple(group.members[k] for k in stay),
            aspects=tuple,
        )


def unknowns(
    columns: Columns, question: Question, choice: Choice, torque: Array, shown: NDArray[np.bool_]
) -> Unknowns:
    """Return what a question seeks.

    Usual torques (n,) are root mean squares [N m]; ``shown`` (p,) says which columns are not zero.
    """
    groups = list(_groups(columns, question, choice, torque))
    bodies = dict(_bodies(columns, question))
    wanted = {name for group in groups for name in group.names}
    wanted |= {columns.names[k] for places, _ in bodies.values() for k in places}
    terms = dict(_terms(columns, choice))
    own = {f"{term}[{owner}]" for owner, each in terms.items() for term in each}
    # What no row shows is not sought: its value would be whatever the search began with.
    wanted |= {name for name in own if shown[columns.place[name]]}
    settle = tuple(_settled(columns, question, choice))
    wanted |= set(settle)
    groups = [each for g in groups for each in _without(g, set(g.names) - wanted)]
    lower, upper = np.full(len(columns.names), -np.inf), np.full(len(columns.names), np.inf)
    # What friction is only allowed for has a sign of its own.
    allowed = {name for group in groups if group.cause == FRICTION for name in group.names}
    for name in own - allowed:
        term, _, owner = name.partition("[")
        curved = term == "viscous" and "sqrt" in terms[owner[:-1]]
        if not (curved or term in _FREE_SIGN or term.endswith("_speed")):
            lower[columns.place[name]] = 0.0
            upper[columns.place[name]] = LARGEST_LOSS if term == "load" else np.inf
    held = _held(columns, question, choice)
    kept = np.array(sorted(columns.place[name] for name in wanted), dtype=np.int64)
    if question.known_mass is not None:
        own_mass, exact = np.array([question.known_mass]), _EXACT_MASS * question.known_mass
        payload = independent(WEIGHT, PAYLOAD_NAMES[:1], ("payload",), exact)
        groups.append(replace(payload, mean=own_mass))
    elif question.loaded:
        groups += [_no_common_scale(group) for group in groups if group.cause == SCALES]
    return Unknowns(columns.names, kept, held, tuple(groups), lower, upper, bodies, settle)


def _terms(columns: Columns, choice: Choice) -> Iterator[tuple[str, set[str]]]:
    """Yield joint or motor to its friction terms; a motor has those of all joints it turns with."""
    for row, joint in zip(columns.rows_of, columns.joints):
        model = choice.friction[row]
        yield joint, {*model.terms, *(f"{term}_speed" for term in model.bent)}
    for motor in choice.couplings:
        turned = [choice.friction[k] for k in np.flatnonzero(motor.ratios)]
        terms = {term for model in turned for term in model.terms} & {*motor.terms}
        yield motor.name, terms - ({"armature"} if motor.name in choice.rotors else set())


def _settled(columns: Columns, question: Question, choice: Choice) -> Iterator[str]:
    """Yield the names of what moves into the point that the rows are made around."""
    tilts = [name for name in TILT_NAMES if name in columns.place]
    if question.in_file:
        yield from tilts if FILE_GRAVITY not in question.kept_parts else ()
        return
    if question.options.delay == "auto":
        yield DELAY_NAME
    if question.options.tilt == "auto":
        yield from TILT_NAMES
    for row, joint in zip(columns.rows_of, columns.joints):
        yield from (speed_name(term, joint) for term in choice.friction[row].bent)


def _held(columns: Columns, question: Question, choice: Choice) -> Array:
    """Return (p,) what parameters are that are not sought."""
    held = np.zeros(len(columns.names))
    for name, places in columns.bodies().items():
        if name != "payload":
            held[places] = columns.prior[places]
    if question.carried is not None:
        held[columns.at(PAYLOAD_NAMES)] = question.carried
    for joint, model in zip(columns.robot.joint_names, choice.friction):
        keeps = not model.terms or FILE_FRICTION in question.kept_parts
        own = ("coulomb", "viscous") if keeps else ()
        armature = "armature" not in model.terms and question.file_kind != "urdf"
        for term in (*own, *(("armature",) if armature else ())):
            place = columns.place.get(f"{term}[{joint}]")
            if place is not None:
                held[place] = columns.prior[place]
    for motor in columns.couplings:
        places = columns.at(motor.parameter_names)
        held[places] = columns.prior[places]
    for owner, rotor in choice.rotors.items():
        held[columns.place[f"armature[{owner}]"]] = rotor
    return held


def _bodies(
    columns: Columns, question: Question
) -> Iterator[tuple[str, tuple[NDArray[np.int64], Array]]]:
    """Yield each body that is sought, with where it stands and a usual body of its kind."""
    last, options = columns.robot.body_name, question.options
    others = options.link_uncertainty > 0.0 and FILE_LINKS not in question.kept_parts
    usual = columns.usual
    for name, places in columns.bodies().items():
        wanted = question.loaded if name == "payload" else name == last or others
        if wanted:
            yield name, (places, usual[last if name == "payload" else name])


def independent(
    cause: str,
    names: Sequence[str],
    members: Sequence[str],
    size: float | Array,
    may_widen: bool = False,
) -> NuisanceGroup:
    """Return the prior of nuisances that are each off on their own, by one size or (k,) sizes."""
    count, factor = len(names), size * np.eye(len(names))
    return NuisanceGroup(cause, tuple(names), np.zeros(count), factor, tuple(members), may_widen)


def with_common(group: NuisanceGroup, size: float) -> NuisanceGroup:
    """Return the prior of nuisances that are also all off together, by one size."""
    if not size:
        return group
    both = group.factor @ group.factor.T + size**2
    values, vectors = np.linalg.eigh(both)
    return replace(group, factor=vectors @ (np.sqrt(values)[:, None] * vectors.T))


def _groups(
    columns: Columns, question: Question, choice: Choice, torque: Array
) -> Iterator[NuisanceGroup]:
    links = _link_group(columns, question, choice)
    if links is not None:
        yield links
    if choice.offsets:
        own = [f"offset[{joint}]" for joint in choice.offsets]
        sizes = np.maximum([*choice.offsets.values()], _EXACT)
        yield independent(OFFSETS, own, tuple(choice.offsets), sizes)
    tilts = tuple(name for name in TILT_NAMES if name in columns.place)
    if question.in_file:
        if tilts and FILE_GRAVITY not in question.kept_parts:
            yield independent(TILT, tilts, ("the base",) * 2, FILE_TILT)
        return
    options, wide, joints = question.options, question.loaded, columns.joints
    sized = (
        (SCALES, "scale", joints, scale_spread(columns, options, question.loaded)),
        (ZEROS, "zero", columns.robot.joint_names, MILLI * options.zero_uncertainty),
        (DRIFT, "drift", joints, DRIFTS if question.drifts else 0.0),
    )
    for cause, kind, members, size in sized:
        names = tuple(f"{kind}[{joint}]" for joint in members)
        if np.any(np.greater(size, 0.0)):
            each = independent(cause, names, members, np.maximum(size, _EXACT), wide)
            yield with_common(each, choice.common_scale) if cause == SCALES else each
    late = 0.0 if question.resting else MILLI * options.delay_uncertainty
    if options.delay == "off" and late > 0.0:
        yield independent(DELAY, (DELAY_NAME,), ("the torque",), late, wide)
    if tilts and options.tilt == "off" and options.gravity_uncertainty > 0.0:
        size = float(np.radians(options.gravity_uncertainty))
        yield independent(TILT, tilts, ("the base",) * 2, size, wide)
    if not question.resting:
        yield from _friction_group(columns, question, choice, torque)


def _friction_group(
    columns: Columns, question: Question, choice: Choice, torque: Array
) -> Iterator[NuisanceGroup]:
    """Yield what friction may have that its model lacks, of a size that its dry friction says."""
    share = PER_CENT * question.options.friction_uncertainty
    if share == 0.0:
        return
    rows = list(columns.rows_of)
    usual_torque = torque[rows]
    if choice.dry_friction is None:
        dry = np.array(expected_dry_friction(columns, torque))
        loss = np.full_like(dry, share)
    else:
        dry = np.maximum(choice.dry_friction, LEAST_FOUND * usual_torque)
        # A gear that loses much of its load has much dry friction without load, too.
        share_of_torque = dry / np.maximum(usual_torque, _EXACT)
        loss = np.clip(share_of_torque, share, LARGEST_USUAL_LOSS * share)
    if question.loaded:
        loss = np.full_like(dry, max(share, LOADED_LOSS))
    sizes = {"load": loss, "sqrt": CURVATURE * share * dry}
    if choice.dry_friction is not None:
        sizes |= dict.fromkeys(FADING_SPEEDS, FADING * share * dry)
    names, members, spread = list[str](), list[str](), list[float]()
    for term, size in sizes.items():
        for place, joint in enumerate(columns.joints):
            model = choice.friction[rows[place]]
            if model.terms and term not in model.terms:
                names.append(f"{term}[{joint}]")
                members.append(joint)
                spread.append(max(float(size[place]), _EXACT))
    if names:
        yield independent(FRICTION, names, members, np.array(spread), question.loaded)


def expected_dry_friction(columns: Columns, torque: Array) -> tuple[float, ...]:
    """Return about how much dry friction (joints,) rows have before a fit [N m], of usual torques
    (n,) [N m]: the file's, or a share of the torque.
    """
    rows = list(columns.rows_of)
    dry = np.maximum(columns.robot.friction.coulomb[rows], LEAST_COULOMB * torque[rows])
    return tuple(dry.tolist())


def _link_group(columns: Columns, question: Question, choice: Choice) -> NuisanceGroup | None:
    """Return what the model knows of the links but the terminal one; None where nothing is sought.

    A placeholder is not believed: it may be anything between nothing and two usual bodies.
    """
    robot, sought = columns.robot, dict(_bodies(columns, question))
    links = [k for k in other_links(robot) if robot.links[k].body_name in sought]
    if columns.torques != "chain" or not links:
        return None
    share = PER_CENT * question.options.link_uncertainty
    names = [robot.links[link].body_name for link in links]
    usual = [sought[name][1] for name in names]
    lengths = link_lengths(robot, links)
    factor = np.zeros((10 * len(links), 10 * len(links)))
    believed = [usual[k] is robot.links[link].theta for k, link in enumerate(links)]
    alike = [(np.flatnonzero(believed), share, choice.link_scales)]
    alike += [(np.array([k]), 1.0, AS_STATED) for k in np.flatnonzero(np.logical_not(believed))]
    for members_alike, size, scales in alike:
        if len(members_alike):
            at = np.add.outer(10 * members_alike, np.arange(10)).ravel()
            thetas = [usual[k] for k in members_alike]
            sizes = [lengths[k] for k in members_alike]
            factor[np.ix_(at, at)] = link_factor(thetas, size, sizes, scales)
    places = np.concatenate([sought[name][0] for name in names])
    members = tuple(name for name in names for _ in PARAMETER_NAMES)
    own = tuple(columns.names[k] for k in places)
    means, aspects = np.concatenate(usual), partial(link_aspects, usual, lengths)
    return NuisanceGroup(LINKS, own, means, factor, members, aspects=aspects)


def scale_spread(columns: Columns, options: EstimationOptions, loaded: bool) -> Array:
    """Return how far the torque scale of each row's joint may be off beforehand (joints,)."""
    said = options.scale_uncertainty
    if said is None:
        said = LOADED_SCALE if loaded else USUAL_SCALE
    scale = per_joint(said, columns.robot.n_joints, "--scale-uncertainty")
    return PER_CENT * scale[list(columns.rows_of)]


def common_error(spread: Array) -> float:
    """Return how far scales (joints,) may be off together where nothing tells it: the error of
    their mean, each weighted by 1 / its variance; zero where one is known exactly.
    """
    return 1.0 / float(np.linalg.norm(1.0 / spread)) if np.all(spread > 0.0) else 0.0


def _no_common_scale(scales: NuisanceGroup) -> NuisanceGroup:
    """Return what holds the mean of all torque scales at one, each weighted by 1 / its variance.

    A scale that all joints have in common scales every mass alike. Only the model's masses could
    tell it, and they are what is not trusted here, so it goes into the errors instead. Of scales
    that are independent beforehand, this mean is independent of all their differences.
    """
    weights = np.diag(scales.factor) ** -2
    mean = np.outer(weights, weights) / (weights @ weights)
    factor = np.eye(len(weights)) - (1.0 - _EXACT) * mean
    return replace(scales, cause=COMMON, factor=1e3 * factor, may_widen=False)
