"""The table of faults of the torque: what may be wrong with a log or its model, a row each.

A fault is an effect on columns of the fit's own rows, with a wide prior. Most have columns in every
fit: a scale of torques, a zero, a tilt, a body. The others get theirs from ``columns``. Where
a fault acts at one joint, in one log or more and more, its effect says so, and needs no column of
its own. To add a fault, add a row to ``FAULTS`` and, where no place of another row fits, a function
that yields the places at which it may be.

Mistakes that no small change explains (signs, exchanged joints, units) are rows of ``readings``.

Throughout, J is the number of joints, B that of blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, product
from typing import Any

import numpy as np

from robot_sysid.dynamics.friction import COULOMB, OFFSET, VISCOUS
from robot_sysid.dynamics.inverse_dynamics import TILT_NAMES, gravity_vector
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.offers import Effect, Offer
from robot_sysid.estimate.terms import SCALES
from robot_sysid.faults.columns import (
    ECCENTRIC_SPRING,
    FORCE,
    HUM,
    INERTIAL,
    LAST_WEIGHT,
    NEIGHBOURS,
    SPRING,
    WEIGHT,
)
from robot_sysid.faults.plausibility import typical_torque
from robot_sysid.records import Array
from robot_sysid.records.controllers import torque_to_record
from robot_sysid.records.fault_names import FaultName, StandsFor
from robot_sysid.records.levels import SURE
from robot_sysid.records.messages import Level, position_unit, torque_unit, with_error
from robot_sysid.records.parameters import DELAY, SCALE, ZERO
from robot_sysid.spatial import PARAMETER_NAMES, parameter_scale

STANDARD_GRAVITY = 9.81
"""Gravity by which the weight of an arm that has none is taken to size a force [m/s^2]."""
TIME = 0.5
"""Relative error of time per relative change of inertial torque: accelerations and squared speeds
are too small by twice the share by which time stamps are too long."""
FORCE_PRIOR = (0.1, 0.01)
"""A force on the last link as a share of the arm's weight, and its moment over a metre: a hand that
leans on an arm, at a tenth of a metre from the flange."""
LOAD_PRIOR = (0.1, 0.1)
"""What holds a part of the last link: its mass as a share of the arm's, and its size [m]."""
STEP_PRIOR = (0.05, 0.1)
"""A load that is picked up: its mass as a share of the arm's, its size as one of the arm's length.
The heaviest tool that arms may carry is a tenth to a half of their mass."""

DRY_AND_VISCOUS = (COULOMB.name, VISCOUS.name)
"""Friction of every fit."""

Words = Mapping[str, str]


@dataclass(frozen=True)
class Fault:
    """A row of the table: one kind of fault.

    In text and remedy, ``{value}`` stands for the size of the number with its standard error,
    ``{inverse}`` for 1 / sqrt(1 + value), by which time has to be multiplied where inertial torque
    is off by the value, and ``{joint}`` and the like for words of its place. A word of
    ``judge.BY_SIGN``, such as ``{more}``, becomes its opposite where the number is negative.
    ``{values}`` is what ``describe`` says. Any other field is the name of an option.

    Attributes:
        name: of its findings.
        text: the fault.
        remedy: what to do; "" for nothing.
        places: yields an explanation for each place at which the fault may be, in a fit.
        prior: how far the number may be off, as a standard deviation, in what ``places`` says.
        unit: of the number [SI without one].
        level: level of the finding, where a result without the fault would be wrong.
        sizes: least and largest number that exists.
        is_norm: whether the number is the Euclidean norm of the first three values, not the first.
        describe: returns what all its values say, where no single number does; then all count.
        factor: the number is the value times it.
        is_of_any_log: whether it may be in one of several logs alone.
    """

    name: FaultName
    text: str
    remedy: str
    places: Callable[[Fit, Fault], Iterable[Explanation]]
    prior: float = 1.0
    unit: str = ""
    level: Level = Level.DOUBTS
    sizes: tuple[float, float] = (-np.inf, np.inf)
    is_norm: bool = False
    describe: Callable[[Fit, Offer], str] | None = None
    factor: float = 1.0
    is_of_any_log: bool = True

    @property
    def has_number(self) -> bool:
        """Whether a single number says it."""
        return self.describe is None


@dataclass(frozen=True)
class Explanation:
    """A fault at a place, as it is offered to a fit.

    Attributes:
        fault: the row.
        effect: its columns, where they act, and their prior.
        words: of the place, for text and remedy.
        unit: of the number, where the place decides it; "" for the fault's.
        largest: number that exists, where the place decides it.
        relative_error: of the number, beside the standard error of the fit.
        choices: number of similar explanations that are tried, of which only the best one counts.
        log: name of the only log in which it acts; "" for all.
    """

    fault: Fault
    effect: Effect
    words: Words = field(default_factory=dict)
    unit: str = ""
    largest: float = np.inf
    relative_error: float = 0.0
    choices: int = 1
    log: str = ""

    @property
    def subject(self) -> tuple[object, ...]:
        """The name, the words and the log; a finding names each subject once."""
        return self.fault.name, self.fault.text, *self.words.items(), self.log

    @property
    def is_shape(self) -> bool:
        """Whether it is torque of a shape at one joint, which may stand for other terms."""
        is_of_any = bool(self.fault.name.stands_for & StandsFor.SHAPE)
        return is_of_any and self.effect.joint is not None


def explanations(fitted: Fit) -> list[Explanation]:
    """Return every fault at every place, for a fit with the columns of ``fault_columns``."""
    every = [(fault, list(fault.places(fitted, fault))) for fault in FAULTS]
    logs = dict.fromkeys(fitted.sums.logs)
    in_logs = []
    for (fault, at), log in product(every, logs if len(logs) > 1 else ()):
        for each in at if fault.is_of_any_log else ():
            own = each.effect.shares
            shares = fitted.sums.is_of(log) * (1.0 if own is None else own)
            acting = replace(each.effect, shares=shares)
            in_logs.append(replace(each, effect=acting, log=log))
    return [*chain.from_iterable(at for _, at in every), *in_logs]


def effect(
    names: Sequence[str],
    spread: Any,
    joint: int | None = None,
    shares: Array | None = None,
) -> Effect:
    """Return the effect of columns with independent prior standard deviations."""
    factor = np.diag(np.broadcast_to(spread, len(names)))
    return Effect(tuple(names), factor, joint, shares)


def common_effect(
    names: Sequence[str],
    spread: float | Array,
    joint: int | None = None,
    shares: Array | None = None,
) -> Effect:
    """Return the effect of columns that have one number in common.

    ``spread`` is its prior standard deviation in each column (k,), or in all alike.
    """
    column = np.broadcast_to(spread, len(names))[:, None]
    return Effect(tuple(names), column, joint, shares)


# ---- places: the arm as a whole


def at_inertia(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
    """Yield the torque of inertia, off by a share of it."""
    yield Explanation(fault, effect([INERTIAL], fault.prior))


def at_base(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
    """Yield two angles of the base [rad], where there is gravity."""
    if fitted.arm.has_gravity:
        yield Explanation(fault, effect(TILT_NAMES, fault.prior))


def at_gears(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
    """Yield what all gears lose of their load, as one share."""
    loads = fitted.arm.terms["load"].names
    yield Explanation(fault, common_effect(loads, fault.prior))


def of_hand(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
    """Yield a force on the last link, in units of ``FORCE_PRIOR`` of the arm's weight."""
    robot = fitted.arm.robot
    down = float(np.linalg.norm(gravity_vector(robot))) or STANDARD_GRAVITY
    spread = robot.mass * down * np.repeat(FORCE_PRIOR, (3, 9))
    yield Explanation(fault, effect(FORCE, fault.prior * spread))


def load_spread(fitted: Fit) -> Array:
    """Return the spread (4,) of what holds the last link: its mass and first moments."""
    mass, size = LOAD_PRIOR
    return parameter_scale(mass * fitted.arm.robot.mass, size)[:4]


def of_support(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
    """Yield a weight of the last link that has no inertia, in units of ``LOAD_PRIOR``."""
    yield Explanation(fault, effect(LAST_WEIGHT, fault.prior * load_spread(fitted)))


def of_balancer(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
    """Yield a share of all links' weight. The last link's is free beside it: nothing states it."""
    spread = np.append(fault.prior, load_spread(fitted))
    words = {"torque": torque_to_record(fitted.arm.robot)}
    yield Explanation(fault, effect((WEIGHT, *LAST_WEIGHT), spread), words)


# ---- places: each joint


def at_scales(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
    """Yield the torque scale of each joint, as a share."""
    for joint, name in enumerate(fitted.arm.joints):
        scale = effect([SCALE.key_of(name)], fault.prior, joint)
        yield Explanation(fault, scale, {"joint": name})


def at_zeros(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
    """Yield the zero of each joint [rad or m]."""
    for name in fitted.arm.joints:
        unit = position_unit(name in fitted.arm.robot.slides)
        zero = effect([ZERO.key_of(name)], fault.prior)
        yield Explanation(fault, zero, {"joint": name}, unit)


MOST_OF_SPRING = 2.0
"""Largest torque of a spring that pulls from beside a joint, over the joint's own: a larger one is
the joint's own weight with another sign."""


def of_springs(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
    """Yield torques that follow each joint's position, over its own torque [1/rad or 1/m].

    A spring at the joint is in proportion to it; one that pulls from a point beside the joint goes
    with its sine and cosine.
    """
    torque = typical_torque(fitted)
    for joint, (name, size) in enumerate(zip(fitted.arm.joints, torque)):
        for columns, largest in (
            (SPRING, np.inf),
            (ECCENTRIC_SPRING, MOST_OF_SPRING * size),
        ):
            spring = effect(columns, fault.prior * size, joint)
            yield Explanation(fault, spring, {"joint": name}, largest=largest)


def of_hum(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
    """Yield a sine of time at each joint, over its own torque: the best one of many rates."""
    count = sum(map(len, fitted.recordings))
    for joint, (name, size) in enumerate(
        zip(fitted.arm.joints, typical_torque(fitted))
    ):
        unit = torque_unit(name in fitted.arm.robot.slides)
        wave = effect(HUM, fault.prior * size, joint)
        yield Explanation(fault, wave, {"joint": name}, unit, choices=count)


def of_neighbours(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
    """Yield a share of the torque of each joint's neighbours in its own.

    A neighbour with more torque is felt by a smaller share of it.
    """
    joints = fitted.arm.joints
    torque = typical_torque(fitted)
    for joint, name in enumerate(joints):
        for side, other in zip(NEIGHBOURS, (joint - 1, joint + 1)):
            if 0 <= other < len(torque):
                ratio = min(1.0, torque[joint] / torque[other])
                share = effect([side], fault.prior * ratio, joint)
                words = {"joint": name, "other": joints[other]}
                yield Explanation(fault, share, words)


# ---- places: time


def along(fitted: Fit) -> Array:
    """Return the time (B,) of each block, from -1/2 to 1/2; each log has as many."""
    logs = fitted.sums.logs
    count = logs.count(logs[0])
    return np.tile(np.arange(0.5, count) / count - 0.5, len(logs) // count)


def owners(fitted: Fit) -> Mapping[str, int | None]:
    """Return whom a fault may be of: each joint, by its index, and all of them."""
    joints = {f"joint {name}": k for k, name in enumerate(fitted.arm.joints)}
    return {**joints, "all joints": None}


def of_delay(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
    """Yield a delay of each joint's torque and of all [s]."""
    for owner, joint in owners(fitted).items():
        delay = effect([DELAY.key], fault.prior, joint)
        yield Explanation(fault, delay, {"owner": owner})


def of_drifting_scales(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
    """Yield a torque scale that changes over a log, of each joint and of all, as a share.

    What a motor or its sensor reads has the joint's friction in it, as well as its links.
    """
    terms = fitted.arm.terms
    scales = terms[SCALES].names
    friction = [terms[key].names for key in DRY_AND_VISCOUS]
    for owner, joint in owners(fitted).items():
        which = slice(None) if joint is None else slice(joint, joint + 1)
        rubbing = [name for names in friction for name in names[which]]
        sizes = [fitted.by_name.get(name, 0.0) for name in rubbing]
        spread = fault.prior * np.append(np.ones(len(scales[which])), sizes)
        names = (*scales[which], *rubbing)
        drift = common_effect(names, spread, joint, along(fitted))
        yield Explanation(fault, drift, {"owner": owner})


def of_drifting_clock(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
    """Yield torque of inertia that changes over a log by a share of it."""
    yield Explanation(fault, effect([INERTIAL], fault.prior, None, along(fitted)))


def of_changing_friction(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
    """Yield friction that changes over a log, by a share of what was found."""
    yield from friction_change(fitted, fault, along(fitted))


def of_other_friction(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
    """Yield friction that differs, by a share of what was found: of one log from the others."""
    yield from friction_change(fitted, fault, None)


def friction_change(
    fitted: Fit, fault: Fault, shares: Array | None
) -> Iterator[Explanation]:
    """Yield dry and viscous friction of all joints, changed by shares (B,) of it in each block."""
    terms = fitted.arm.terms
    names = [name for key in DRY_AND_VISCOUS for name in terms[key].names]
    spread = fault.prior * np.abs([fitted.by_name[name] for name in names])
    yield Explanation(fault, effect(names, spread, None, shares))


def friction_changes(fitted: Fit, offer: Offer) -> str:
    """Return by which share the friction of joints changes: of those that clearly do, or of most.

    It is that of the torque of dry and viscous friction, which trade with one another: with values
    f and their change v in columns whose products are G, f'G v / f'G f.
    """
    sums = fitted.sums
    # With the change beside it, friction is that of the middle, or of the other logs.
    friction = {**fitted.by_name}
    for key, change in zip(fitted.names, offer.change.tolist()):
        friction[key] += change
    changes = []
    for joint, (name, columns) in enumerate(zip(fitted.arm.joints, sums.columns)):
        keys = [fitted.arm.terms[key].names[joint] for key in DRY_AND_VISCOUS]
        places = [*columns.tolist()]
        own = [places.index(at) for at in sums.at(keys) if at in places]
        found = np.array([friction[sums.names[places[k]]] for k in own])
        at = [offer.effect.names.index(sums.names[places[k]]) for k in own]
        weights = sums.totals[joint][np.ix_(own, own)] @ found
        size = float(found @ weights)
        if size > 0.0:
            weights = weights / size
            share = float(weights @ offer.values[at])
            error = float(np.sqrt(weights @ offer.covariance[np.ix_(at, at)] @ weights))
            changes.append((share, error, name))
    changes.sort(key=lambda change: -abs(change[0]) / max(change[1], 1e-300))
    clear = [each for each in changes if abs(each[0]) >= SURE * each[1]]
    return ", ".join(
        f"{with_error(100.0 * share, 100.0 * error, '%')} at {name}"
        for share, error, name in clear or changes[:1]
    )


def starts(fitted: Fit) -> Iterator[Array]:
    """Yield the blocks (B,) from each one on to the end of its log, one after the other."""
    logs = fitted.sums.logs
    blocks = np.arange(len(logs))
    for first in blocks[1:].tolist():
        if logs[first] == logs[first - 1]:
            after = fitted.sums.is_of(logs[first]) & (blocks >= first)
            yield after.astype(float)


def of_changing_load(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
    """Yield a change of what the last link carries, in units of ``STEP_PRIOR``, from a block on."""
    robot = fitted.arm.robot
    mass, size = STEP_PRIOR
    spread = parameter_scale(mass * robot.mass, size * robot.length)
    # Torque scales multiply the load, too.
    scales = fitted.arm.terms[SCALES].names
    errors = [fitted.error_of(name) for name in scales if name in fitted.names]
    error = max(errors, default=0.0)
    for after in starts(fitted):
        yield Explanation(
            fault,
            effect(PARAMETER_NAMES, fault.prior * spread, None, after),
            relative_error=error,
            choices=len(fitted.sums.logs),
        )


# ---- places: the middle of a run, of an arm that is compared with its model


def incidents(
    key_of: Callable[[str], str], is_torque: bool
) -> Callable[[Fit, Fault], Iterator[Explanation]]:
    """Return the places of what begins at a joint in the middle of a log.

    Such a log is a single run: a cable that catches, a brake, a motor that gets weaker.

    Args:
        key_of: returns the name of the column that changes from the name of a joint.
        is_torque: whether the number is a torque, over the strongest joint's; else a share.
    """

    def places(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
        """Yield the change at each joint from each block on."""
        if fitted.question.differing is None:
            return
        slides = fitted.arm.robot.slides
        size = float(np.max(fitted.sums.rms_torque)) if is_torque else 1.0
        for after, (joint, name) in product(
            starts(fitted), enumerate(fitted.arm.joints)
        ):
            unit = torque_unit(name in slides) if is_torque else ""
            own = effect([key_of(name)], fault.prior * size, joint, after)
            choices = len(fitted.sums.logs)
            yield Explanation(fault, own, {"joint": name}, unit, choices=choices)

    return places


def of_failing_supply(fitted: Fit, fault: Fault) -> Iterator[Explanation]:
    """Yield torques of all joints that change by a share from a block on."""
    if fitted.question.differing is not None:
        scales = fitted.arm.terms[SCALES].names
        for after in starts(fitted):
            change = common_effect(scales, fault.prior, None, after)
            yield Explanation(fault, change, choices=len(fitted.sums.logs))


# ---- the table

WHOLE_CLOCK = Fault(
    FaultName.CLOCK,
    # Inertia grows with the square of lengths, weight with them.
    "time in the log is {value} too {long}{balancer}, or the arm is {larger} than its model "
    "(measure from joint to joint), as the torque of inertia shows beside that of gravity",
    "record the controller's own time stamps, or scale these with a line in {columns FILE}: "
    "time = {inverse} * TITLE",
    at_inertia,
    0.2,
    "%",
    # Beyond it, torque lacks inertia.
    sizes=(-0.8, 0.8),
    factor=TIME,
)
SUPPORT_REMEDY = "take it away, and record again"
RUN = "from a moment of the run on"

FAULTS = (
    Fault(
        FaultName.FRICTION,
        "every gear loses {value} of its load, which no model file can hold: friction in the file "
        "is right at this load alone",
        "",
        at_gears,
        0.15,
        "%",
        Level.SAYS,
        sizes=(0.0, 0.5),
    ),
    Fault(
        FaultName.TILT,
        "the base is tilted by {value} against the model's",
        "level it, or turn the base in the model",
        at_base,
        0.15,
        "degrees",
        is_norm=True,
    ),
    WHOLE_CLOCK,
    Fault(
        FaultName.FORCE,
        "a constant force of {value} acts on the last link, as of a hand, a cable or a spring",
        SUPPORT_REMEDY,
        of_hand,
        1.0,
        "N",
        Level.REFUSES,
        is_norm=True,
    ),
    Fault(
        FaultName.FORCE,
        "the last link weighs {value} {more} than its inertia says: a hand, a hose or a support "
        "holds a part of it or draws at it",
        SUPPORT_REMEDY,
        of_support,
        1.0,
        "kg",
        Level.REFUSES,
    ),
    Fault(
        FaultName.GRAVITY,
        "{value} of the links' weight is missing from the torque: a spring balancer that the model "
        "lacks, or gravity that is compensated in part",
        "{torque}",
        of_balancer,
        0.5,
        "%",
        Level.REFUSES,
        # Less than a twentieth is an arm whose links are lighter than the model's.
        sizes=(-1.2, -0.05),
    ),
    Fault(
        FaultName.TORQUE_SCALE,
        "torque of joint {joint} reads {value} too {much} for the model's links, or the links that "
        "it carries are {heavier} than in the model",
        "weigh a known mass ({known_mass} of payload), and pass the file that it writes as "
        "{torque_scale}",
        at_scales,
        0.4,
        "%",
        sizes=(-0.5, np.inf),
    ),
    Fault(
        FaultName.ZERO,
        "the position of joint {joint} reads {value} too {much}",
        "correct the joint's zero",
        at_zeros,
        0.1,
    ),
    Fault(
        FaultName.FORCE,
        "at joint {joint} a torque follows the position, as of a spring, a balancer or a hose",
        "take it away, or add it to the model",
        of_springs,
        # The joint's own torque within a tenth of a radian, or of a metre.
        10.0,
        level=Level.REFUSES,
        sizes=(0.0, np.inf),
        is_norm=True,
    ),
    Fault(
        FaultName.CONTACT,
        "torque of joint {joint} hums: a sine of {value} that neither motion nor friction makes",
        "find its source",
        of_hum,
        0.1,
        is_norm=True,
    ),
    Fault(
        FaultName.CROSSTALK,
        "the torque of joint {joint} holds {value} of that of joint {other}{opposite}",
        "calibrate its sensor",
        of_neighbours,
        0.1,
        "%",
    ),
    Fault(
        FaultName.DELAY,
        "torque of {owner} is {value} {later} than position",
        "record torques and positions of all joints at the same instant",
        of_delay,
        0.04,
        "ms",
        # Torques change in proportion to delays that are no longer.
        sizes=(-0.15, 0.15),
    ),
    Fault(
        FaultName.TORQUE_SCALE,
        "the torque scale of {owner} {rises} by {value} over the log",
        "let motors and sensors warm up, and record again",
        of_drifting_scales,
        0.3,
        "%",
    ),
    Fault(
        FaultName.CLOCK,
        "the clock drifts, as the torque of inertia shows beside that of gravity: time stamps grow "
        "by {value} {more} at the end of the log than at its begin",
        "record the controller's own time stamps",
        of_drifting_clock,
        0.4,
        "%",
        factor=TIME,
    ),
    Fault(
        FaultName.FRICTION,
        "friction changes over the log ({values}): what is found is that of its middle, off by "
        "half of this at both ends",
        "let the arm warm up before it is recorded",
        of_changing_friction,
        0.6,
        level=Level.SAYS,
        describe=friction_changes,
    ),
    Fault(
        FaultName.FRICTION,
        "friction is not that of the other logs ({values}): what is found lies between them",
        "let the arm warm up before it is recorded",
        of_other_friction,
        0.6,
        level=Level.SAYS,
        describe=friction_changes,
    ),
    Fault(
        FaultName.PAYLOAD_STEP,
        "from about {instant} on the last link carries {value} {more}: something was picked up, "
        "dropped or moved",
        "record each state in a log of its own",
        of_changing_load,
        1.0,
        "kg",
        Level.REFUSES,
        is_of_any_log=False,
    ),
    Fault(
        FaultName.TORQUE_SCALE,
        f"{RUN}, the torque of all joints reads {{value}} {{more}}",
        "look after the motors' supply and temperature",
        of_failing_supply,
        0.3,
        "%",
        is_of_any_log=False,
    ),
    Fault(
        FaultName.TORQUE_SCALE,
        f"{RUN}, the torque of {{joint}} reads {{value}} {{more}} for what it moves",
        "look after the joint's motor",
        incidents(SCALE.key_of, is_torque=False),
        0.4,
        "%",
        is_of_any_log=False,
    ),
    Fault(
        FaultName.FORCE,
        f"{RUN}, a constant torque of {{value}} acts at {{joint}}, as of a cable or a hose",
        "take it away",
        incidents(OFFSET.key_of, is_torque=True),
        0.5,
        level=Level.REFUSES,
        is_of_any_log=False,
    ),
    Fault(
        FaultName.FRICTION,
        f"{RUN}, the dry friction of {{joint}} is {{value}} {{higher}}",
        "look after its brake and gear",
        incidents(COULOMB.key_of, is_torque=True),
        0.5,
        is_of_any_log=False,
    ),
)
"""Every fault of the torque that is looked for.

Priors are standard deviations of what a fault may be where it is there, so that it is found, not of
how arms usually are: those are in ``records.usual_errors``."""
