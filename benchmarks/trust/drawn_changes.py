"""A grammar of what goes wrong with logs and models, from which changes are drawn at random.

A change is composed of a quantity, joints, a time, a function and a size. It says in words what it
does, by which names it would be named rightly, and which joints or bodies are its culprits. Changes
that need the arm's true torques, or an edit of its model, are drawn of simulated arms only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks.trust.confusion_causes import Edit, Scene, multiply_body
from rigs.arms.wrong_arms import link_torque, noise_samples
from robot_sysid.records import Array, Recording
from robot_sysid.records.fault_names import FaultName

Random = np.random.Generator
Names = frozenset[FaultName]
"""Names of findings; each of them is right."""


@dataclass(frozen=True)
class Subject:
    """A log that changes, and what a change may look at.

    Attributes:
        joint_names: (n,) of the arm.
        log: without velocities.
        loads: (n,) usual torque of each joint, at least 2 % of the strongest joint's [N m].
        scene: the simulated arm with its right log; None of a real one.
        edits: of the model's ``MjSpec``.
    """

    joint_names: tuple[str, ...]
    log: Recording
    loads: Array
    scene: Scene | None = None
    edits: tuple[Edit, ...] = ()

    @property
    def n_joints(self) -> int:
        """Return the number of joints."""
        return len(self.joint_names)

    def with_columns(self, quantity: str, columns: Array) -> Subject:
        """Return the subject with other positions or torques (N, n)."""
        return replace(self, log=replace(self.log, **{quantity: columns}))


@dataclass(frozen=True)
class Change:
    """Something that is wrong with a log or a model.

    Attributes:
        kind: quantity and function.
        words: what is done, in plain English.
        names: by which a finding would name it rightly.
        culprits: joints or bodies that are wrong; () where it is all of them, or none.
        spoil: returns the changed subject.
    """

    kind: str
    words: str
    names: Names
    culprits: tuple[str, ...]
    spoil: Callable[[Subject], Subject]


def log_uniform(rng: Random, least: float, most: float) -> float:
    """Return a number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(least), np.log(most))))


def either_way(rng: Random, factor: float) -> float:
    """Return a factor or its inverse."""
    return factor if rng.random() < 0.5 else 1.0 / factor


def either_sign(rng: Random, size: float) -> float:
    """Return a number with either sign."""
    return size if rng.random() < 0.5 else -size


# ---- which joints, and when


@dataclass(frozen=True)
class Joints:
    """Joints that a change is of: their places, and words for them."""

    places: tuple[int, ...]
    words: str
    culprits: tuple[str, ...]


def draw_joints(rng: Random, names: Sequence[str]) -> Joints:
    """Return one joint, two neighbours, the wrist, or all of them."""
    n = len(names)
    which = rng.choice(["one", "two", "wrist", "all"], p=[0.55, 0.15, 0.1, 0.2])
    if which == "all":
        return Joints(tuple(range(n)), "all joints", ())
    if which == "wrist":
        places = tuple(range(n - 3, n))
        return Joints(places, "the wrist", tuple(names[place] for place in places))
    first = int(rng.integers(n - (which == "two")))
    places = (first, first + 1) if which == "two" else (first,)
    own = tuple(names[place] for place in places)
    return Joints(places, " and ".join(own), own)


def draw_pair(rng: Random, names: Sequence[str]) -> Joints:
    """Return two joints in any order, mostly neighbours."""
    n = len(names)
    first = int(rng.integers(n - 1))
    second = first + 1
    if rng.random() < 0.4:
        second = int(rng.choice(np.delete(np.arange(n), first)))
    own = (names[first], names[second])
    return Joints((first, second), " and ".join(own), own)


@dataclass(frozen=True)
class When:
    """The time of a change: its weight (N,) at shares of the log's rows, and words for it."""

    words: str
    weight: Callable[[Array], Array]

    @property
    def is_always(self) -> bool:
        """Return whether it is all the time."""
        return not self.words


ALWAYS = When("", np.ones_like)


def draw_when(rng: Random, can_grow: bool) -> When:
    """Return a time; a change that cannot grow is there all at once."""
    which = rng.choice(
        ["always", "from", "between", "growing"], p=[0.6, 0.15, 0.1, 0.15]
    )
    if which == "from":
        start = float(rng.uniform(0.2, 0.7))
        return When(f" from {start:.0%} on", lambda share: (share >= start) * 1.0)
    if which == "between":
        start = float(rng.uniform(0.15, 0.5))
        end = start + float(rng.uniform(0.1, 0.35))
        words = f" between {start:.0%} and {end:.0%}"
        return When(words, lambda share: ((share >= start) & (share < end)) * 1.0)
    if which == "growing" and can_grow:
        return When(" growing from nothing", lambda share: share)
    return ALWAYS


def weights(log: Recording, when: When) -> Array:
    """Return the weight (N, 1) of a change in each row of a log."""
    return when.weight(np.linspace(0.0, 1.0, len(log)))[:, None]


# ---- what happens to a column


@dataclass(frozen=True)
class Column:
    """A column that changes, and what its new values may depend on.

    Attributes:
        values: (N,) of the column.
        time: (N,) [s].
        size: its usual size: of torques the joint's load, of positions 1 rad.
        rng: of its noise.
    """

    values: Array
    time: Array
    size: float
    rng: Random


ColumnChange = Callable[[Column], Array]
"""Function that returns the new values (N,) of a column."""


def shifted(seconds: float, column: Column) -> Array:
    """Return values that are late."""
    return np.interp(column.time - seconds, column.time, column.values)


def low_passed(seconds: float, column: Column) -> Array:
    """Return values behind a low-pass of first order with a time constant [s]."""
    values = column.values.copy()
    steps = np.diff(column.time)
    for row, step in enumerate(steps, 1):
        gain = step / (seconds + step) if step > 0.0 else 0.0
        values[row] = values[row - 1] + gain * (column.values[row] - values[row - 1])
    return values


def held(rate: float, column: Column) -> Array:
    """Return values that are sampled at a rate [Hz] and held in between."""
    ticks = np.floor((column.time - column.time[0]) * rate)
    starts = np.searchsorted(ticks, ticks, side="left")
    return column.values[starts]


def saturated(share: float, column: Column) -> Array:
    """Return values at the ends of their range in all but a share of the time."""
    middle = float(np.median(column.values))
    reach = float(np.quantile(np.abs(column.values - middle), share))
    return np.clip(column.values, middle - reach, middle + reach)


def quantised(step: float, column: Column) -> Array:
    """Return values rounded to steps, over the usual size."""
    size = step * column.size
    return np.round(column.values / size) * size


def noisy(share: float, white: bool, column: Column) -> Array:
    """Return values with noise, over the usual size."""
    noise = noise_samples(column.rng, (len(column.values), 1), white)[:, 0]
    return column.values + share * column.size * noise


def humming(share: float, rate: float, column: Column) -> Array:
    """Return values with a sine of a rate [Hz], over the usual size."""
    phase = column.rng.uniform(0.0, 2.0 * np.pi)
    wave = np.sin(2.0 * np.pi * rate * column.time + phase)
    return column.values + share * column.size * wave


def unsigned(column: Column) -> Array:
    """Return values without their signs."""
    return np.abs(column.values)


SCALE = frozenset({FaultName.TORQUE_SCALE, FaultName.TORQUE_UNIT})
TIMING = frozenset({FaultName.DELAY, FaultName.HELD, FaultName.CLOCK})
STRETCH = frozenset({FaultName.CONTACT, FaultName.FORCE, FaultName.PAYLOAD_STEP})
"""Names for torque that is wrong for a time only."""
LINKS = frozenset({FaultName.MODEL})
NONE: Names = frozenset()
CLOCK = frozenset({FaultName.CLOCK, FaultName.GRAVITY})
"""Too long a time makes less of accelerations, as if gravity were more."""


@dataclass(frozen=True)
class Function:
    """What happens to each column of a quantity, with its size drawn.

    Attributes:
        words: of it, with its size.
        apply: returns new values of a column.
        names: by which it would be named rightly.
        can_grow: whether a part of it means something.
    """

    words: str
    apply: ColumnChange
    names: Names
    can_grow: bool = False


def torque_factor(rng: Random) -> Function:
    """Return a wrong factor."""
    factor = either_way(rng, log_uniform(rng, 1.15, 30.0))
    return Function(f"times {factor:.3g}", lambda c: factor * c.values, SCALE, True)


def torque_offset(rng: Random) -> Function:
    """Return an offset over the load."""
    share = either_sign(rng, log_uniform(rng, 0.05, 3.0))
    names = frozenset({FaultName.FORCE})
    words = f"{share:+.2g} times its load added"
    return Function(words, lambda c: c.values + share * c.size, names, True)


def torque_sign(rng: Random) -> Function:
    """Return the wrong sign."""
    names = frozenset({FaultName.SIGN})
    return Function("turned in sign", lambda c: -c.values, names)


def late(rng: Random) -> Function:
    """Return a delay, or values that are early."""
    seconds = log_uniform(rng, 0.008, 0.25) * (1.0 if rng.random() < 0.7 else -1.0)
    names = frozenset({FaultName.DELAY})
    return Function(f"late by {1e3 * seconds:.0f} ms", partial(shifted, seconds), names)


def low_pass(rng: Random) -> Function:
    """Return a low-pass."""
    seconds = log_uniform(rng, 0.02, 0.4)
    words = f"behind a low-pass of {1e3 * seconds:.0f} ms"
    return Function(words, partial(low_passed, seconds), frozenset({FaultName.DELAY}))


def hold(rate_range: tuple[float, float], rng: Random) -> Function:
    """Return values that are held."""
    rate = log_uniform(rng, *rate_range)
    words = f"sampled at {rate:.2g} Hz and held"
    return Function(words, partial(held, rate), TIMING)


def saturation(rng: Random) -> Function:
    """Return a range that is too small."""
    share = float(rng.uniform(0.5, 0.97))
    names = frozenset({FaultName.SATURATED, FaultName.HELD})
    words = f"at the end of its range for {1.0 - share:.0%} of the time"
    return Function(words, partial(saturated, share), names)


def torque_quantisation(rng: Random) -> Function:
    """Return coarse steps over the load, between which torque stands still."""
    step = log_uniform(rng, 0.05, 2.0)
    words = f"in steps of {step:.2g} times its load"
    return Function(words, partial(quantised, step), frozenset({FaultName.HELD}))


def torque_noise(rng: Random) -> Function:
    """Return noise over the load."""
    share = log_uniform(rng, 0.03, 1.0)
    white = bool(rng.integers(2))
    words = f"with {'white' if white else 'slow'} noise of {share:.2g} times its load"
    return Function(words, partial(noisy, share, white), NONE, True)


def torque_sine(rng: Random) -> Function:
    """Return a sine over the load."""
    share = log_uniform(rng, 0.03, 1.0)
    rate = log_uniform(rng, 0.05, 5.0)
    names = frozenset({FaultName.CONTACT, FaultName.FORCE})
    words = f"with a sine of {rate:.2g} Hz, {share:.2g} times its load"
    return Function(words, partial(humming, share, rate), names, True)


def no_sign(rng: Random) -> Function:
    """Return sizes without signs: of torque that is below zero throughout, the opposite."""
    names = frozenset({FaultName.UNSIGNED, FaultName.SIGN})
    return Function("without its sign", unsigned, names)


def position_factor(rng: Random) -> Function:
    """Return a wrong factor, as of another gear."""
    factor = either_way(rng, log_uniform(rng, 1.1, 4.0))
    names = frozenset({FaultName.ANGLE_UNIT})
    return Function(f"times {factor:.3g}", lambda c: factor * c.values, names)


def position_offset(rng: Random) -> Function:
    """Return another zero."""
    angle = either_sign(rng, log_uniform(rng, 0.03, 1.6))
    names = frozenset({FaultName.ZERO})
    words = f"with its zero off by {angle:+.2g} rad"
    return Function(words, lambda c: c.values + angle, names, True)


def position_quantisation(rng: Random) -> Function:
    """Return coarse steps."""
    step = log_uniform(rng, 0.003, 0.3)
    return Function(f"in steps of {step:.2g} rad", partial(quantised, step), NONE)


def position_noise(rng: Random) -> Function:
    """Return noise."""
    share = log_uniform(rng, 1e-3, 0.1)
    words = f"with noise of {share:.2g} rad"
    return Function(words, partial(noisy, share, True), NONE)


def position_sine(rng: Random) -> Function:
    """Return a sine, as of an encoder that is not centred."""
    share = log_uniform(rng, 3e-3, 0.3)
    rate = log_uniform(rng, 0.05, 3.0)
    words = f"with a sine of {rate:.2g} Hz and {share:.2g} rad"
    return Function(words, partial(humming, share, rate), frozenset({FaultName.ZERO}))


Draw = Callable[[Random], Function]
TORQUE_FUNCTIONS: Mapping[str, Draw] = {
    "factor": torque_factor,
    "offset": torque_offset,
    "sign": torque_sign,
    "delay": late,
    "low-pass": low_pass,
    "hold": partial(hold, (3.0, 30.0)),
    "saturation": saturation,
    "quantisation": torque_quantisation,
    "noise": torque_noise,
    "sine": torque_sine,
    "unsigned": no_sign,
}
POSITION_FUNCTIONS: Mapping[str, Draw] = {
    "factor": position_factor,
    "offset": position_offset,
    "sign": torque_sign,
    "delay": late,
    "low-pass": low_pass,
    "hold": partial(hold, (3.0, 30.0)),
    "saturation": saturation,
    "quantisation": position_quantisation,
    "noise": position_noise,
    "sine": position_sine,
}


def change_columns(
    quantity: str,
    joints: Joints,
    when: When,
    apply: ColumnChange,
    rng: Random,
    subject: Subject,
) -> Subject:
    """Return a subject of which columns of a quantity are changed."""
    log = subject.log
    columns = getattr(log, quantity).copy()
    weight = weights(log, when)[:, 0]
    for place in joints.places:
        size = float(subject.loads[place]) if quantity == "tau" else 1.0
        values = columns[:, place]
        changed = apply(Column(values.copy(), log.time, size, rng))
        columns[:, place] = values + weight * (changed - values)
    return subject.with_columns(quantity, columns)


def draw_column_change(rng: Random, subject: Subject) -> Change:
    """Return a change of columns of torques or of positions, each joint's by itself."""
    is_torque = rng.random() < 0.6
    functions = TORQUE_FUNCTIONS if is_torque else POSITION_FUNCTIONS
    name = str(rng.choice([*functions]))
    function = functions[name](rng)
    joints = draw_joints(rng, subject.joint_names)
    when = draw_when(rng, function.can_grow)
    names = function.names
    if not when.is_always:
        names |= STRETCH if is_torque else {FaultName.CLOCK}
    if names >= SCALE and not joints.culprits:
        names |= LINKS
    word = "torque" if is_torque else "position"
    spoil = partial(
        change_columns,
        "tau" if is_torque else "q",
        joints,
        when,
        function.apply,
        np.random.default_rng(rng.integers(2**32)),
    )
    words = f"{word} of {joints.words} {function.words}{when.words}"
    return Change(f"{word} {name}", words, names, joints.culprits, spoil)


# ---- two joints at once


def mix(
    quantity: str, pair: tuple[int, int], matrix: Array, when: When, subject: Subject
) -> Subject:
    """Return a subject in which a matrix (2, 2) mixes the columns of two joints."""
    columns = getattr(subject.log, quantity).copy()
    places = [*pair]
    old = columns[:, places]
    weight = weights(subject.log, when)
    columns[:, places] = old + weight * (old @ matrix.T - old)
    return subject.with_columns(quantity, columns)


EXCHANGE = np.array([[0.0, 1.0], [1.0, 0.0]])
WRIST_GEARS = (
    [[1.0, 1.0], [0.0, 1.0]],
    [[1.0, 0.0], [1.0, 1.0]],
    [[1.0, -1.0], [0.0, 1.0]],
    [[1.0, 0.0], [-1.0, 1.0]],
    [[1.0, 1.0], [1.0, -1.0]],
    [[1.0, 1.0], [-1.0, 1.0]],
    [[2.0, 1.0], [0.0, 1.0]],
)
"""Turns of two motors per turn of two joints of a wrist."""


def draw_exchange(rng: Random, subject: Subject) -> Change:
    """Return two joints that are exchanged in positions, torques, or both."""
    pair = draw_pair(rng, subject.joint_names)
    which = str(rng.choice(["positions", "torques", "positions and torques"]))
    quantities = {"positions": ("q",), "torques": ("tau",)}.get(which, ("q", "tau"))

    def spoil(changed: Subject) -> Subject:
        for quantity in quantities:
            changed = mix(quantity, pair.places, EXCHANGE, ALWAYS, changed)
        return changed

    words = f"{which} of {pair.words} exchanged"
    names = frozenset({FaultName.ORDER})
    return Change(f"exchange of {which}", words, names, pair.culprits, spoil)


def draw_wrist_motors(rng: Random, subject: Subject) -> Change:
    """Return the positions and torques of motors that turn two joints of a wrist.

    Of turns q_m = R q of the motors, the torques are tau_m = R^-T tau.
    """
    matrix = np.array(WRIST_GEARS[int(rng.integers(len(WRIST_GEARS)))])
    n = subject.n_joints
    first = n - 2 - int(rng.integers(2))
    inverse = np.linalg.inv(matrix).T

    def spoil(changed: Subject) -> Subject:
        changed = mix("q", (first, first + 1), matrix, ALWAYS, changed)
        return mix("tau", (first, first + 1), inverse, ALWAYS, changed)

    own = subject.joint_names[first : first + 2]
    words = f"motors that turn {' and '.join(own)}, by {matrix.astype(int).tolist()}"
    names = frozenset({FaultName.COUPLING, FaultName.CROSSTALK, FaultName.ORDER})
    return Change("motors of a wrist", words, names, own, spoil)


def draw_gear(rng: Random, subject: Subject) -> Change:
    """Return a wrong gear ratio of one joint, in position and torque."""
    ratio = either_way(rng, log_uniform(rng, 1.1, 4.0))
    place = int(rng.integers(subject.n_joints))
    factors = np.where(np.arange(subject.n_joints) == place, ratio, 1.0)

    def spoil(changed: Subject) -> Subject:
        log = changed.log
        return replace(
            changed, log=replace(log, q=factors * log.q, tau=log.tau / factors)
        )

    name = subject.joint_names[place]
    words = f"gear ratio of {name} wrong: position times {ratio:.3g}, torque divided"
    names = SCALE | {FaultName.ANGLE_UNIT}
    return Change("gear ratio", words, names, (name,), spoil)


def draw_both_signs(rng: Random, subject: Subject) -> Change:
    """Return position and torque of joints with the wrong sign."""
    joints = draw_joints(rng, subject.joint_names)
    signs = np.where(np.isin(np.arange(subject.n_joints), joints.places), -1.0, 1.0)

    def spoil(changed: Subject) -> Subject:
        log = changed.log
        return replace(changed, log=replace(log, q=signs * log.q, tau=signs * log.tau))

    words = f"position and torque of {joints.words} turned in sign"
    names = frozenset({FaultName.SIGN})
    return Change("both signs", words, names, joints.culprits, spoil)


def draw_degrees(rng: Random, subject: Subject) -> Change:
    """Return positions of all joints, or of one, in degrees, or radians read as such."""
    joints = draw_joints(rng, subject.joint_names)
    factor = either_way(rng, float(np.degrees(1.0)))
    word = "in degrees" if factor > 1.0 else "read as degrees"
    factors = np.where(np.isin(np.arange(subject.n_joints), joints.places), factor, 1.0)

    def spoil(changed: Subject) -> Subject:
        return changed.with_columns("q", factors * changed.log.q)

    words = f"positions of {joints.words} {word}"
    names = frozenset({FaultName.ANGLE_UNIT})
    return Change("degrees", words, names, joints.culprits, spoil)


def standard(values: Array) -> Array:
    """Return values (N,) less their mean, with an rms of one."""
    centred = values - np.mean(values)
    return np.asarray(centred / max(float(np.std(centred)), 1e-9))


SOURCES: Mapping[str, Names] = {
    "position": frozenset({FaultName.FORCE}),
    "speed": frozenset({FaultName.FRICTION, FaultName.SIGN, FaultName.COMPUTED}),
}
"""What of the same joint torque may be proportional to, to right names."""
OF_OTHER = frozenset({FaultName.CROSSTALK, FaultName.COUPLING})


def draw_proportional(rng: Random, subject: Subject) -> Change:
    """Return further torque of a joint in proportion to something of the same or another one."""
    pair = draw_pair(rng, subject.joint_names)
    is_other = rng.random() < 0.5
    sources = ["position", "speed", "torque"] if is_other else [*SOURCES]
    source = str(rng.choice(sources))
    share = either_sign(rng, log_uniform(rng, 0.05, 1.5))
    # More of a joint's own viscous friction would be another arm, not a wrong log.
    share = -abs(share) if source == "speed" and not is_other else share
    when = draw_when(rng, True)
    first, second = pair.places
    origin = second if is_other else first

    def spoil(changed: Subject) -> Subject:
        log = changed.log
        values = log.tau[:, origin] if source == "torque" else log.q[:, origin]
        if source == "speed":
            values = np.gradient(values, log.time)
        tau = log.tau.copy()
        further = share * changed.loads[first] * standard(values)
        tau[:, first] += weights(log, when)[:, 0] * further
        return changed.with_columns("tau", tau)

    culprit = subject.joint_names[first]
    names = OF_OTHER if is_other else SOURCES[source]
    if is_other and source == "position":
        names |= {FaultName.FORCE}
    if is_other and source == "speed":
        names |= {FaultName.FRICTION}
    if not when.is_always:
        names |= STRETCH
    owner = subject.joint_names[origin] if is_other else "its own"
    words = (
        f"torque of {culprit} with {share:+.2g} times its load in proportion to the "
        f"{source} of {owner}{when.words}"
    )
    kind = f"torque by {'another' if is_other else 'its own'} {source}"
    return Change(kind, words, names, (culprit,), spoil)


def draw_crosstalk_of_positions(rng: Random, subject: Subject) -> Change:
    """Return positions of a joint that hold a part of another one's, or of its torque."""
    pair = draw_pair(rng, subject.joint_names)
    first, second = pair.places
    is_torque = rng.random() < 0.4
    share = either_sign(rng, log_uniform(rng, 0.03, 1.0) * (0.1 if is_torque else 1.0))

    def spoil(changed: Subject) -> Subject:
        log = changed.log
        q = log.q.copy()
        if is_torque:
            q[:, first] += share * log.tau[:, first] / changed.loads[first]
        else:
            q[:, first] += share * log.q[:, second]
        return changed.with_columns("q", q)

    culprit = subject.joint_names[first]
    if is_torque:
        words = f"position of {culprit} yields by {share:+.2g} rad per load"
        names = frozenset({FaultName.ZERO, FaultName.DELAY})
        return Change("position by its own torque", words, names, (culprit,), spoil)
    words = f"position of {culprit} with {share:+.2g} times that of {pair.culprits[1]}"
    names = frozenset({FaultName.COUPLING, FaultName.CROSSTALK, FaultName.ORDER})
    return Change("position by another position", words, names, (culprit,), spoil)


# ---- time


def with_rows(subject: Subject, rows: Array, time: Array) -> Subject:
    """Return a subject with some rows of its log, at times (m,) [s]."""
    log = subject.log
    return replace(
        subject, log=replace(log, time=time, q=log.q[rows], tau=log.tau[rows])
    )


def time_factor(factor: float, subject: Subject) -> Subject:
    """Return a log whose time is too long by a factor."""
    log = subject.log
    return replace(subject, log=replace(log, time=factor * log.time))


def time_drift(share: float, subject: Subject) -> Subject:
    """Return a log whose clock is fast by more and more."""
    log = subject.log
    passed = (log.time - log.time[0]) / (log.time[-1] - log.time[0])
    return replace(subject, log=replace(log, time=log.time * (1.0 + share * passed)))


def time_jump(seconds: float, at: float, subject: Subject) -> Subject:
    """Return a log whose clock jumps ahead at a share of the rows."""
    log = subject.log
    late_rows = np.arange(len(log)) >= at * len(log)
    return replace(subject, log=replace(log, time=log.time + seconds * late_rows))


def lost_rows(share: float, rng: Random, subject: Subject) -> Subject:
    """Return a log without a share of its rows, its time counted from the rows."""
    rows = np.flatnonzero(rng.random(len(subject.log)) > share)
    return with_rows(subject, rows, subject.log.time[: len(rows)])


def lost_stretch(seconds: float, at: float, subject: Subject) -> Subject:
    """Return a log without a stretch, its time counted from the rows."""
    time = subject.log.time - subject.log.time[0]
    start = at * time[-1]
    rows = np.flatnonzero((time < start) | (time > start + seconds))
    return with_rows(subject, rows, subject.log.time[: len(rows)])


def repeated_rows(share: float, rng: Random, subject: Subject) -> Subject:
    """Return a log in which rows hold the values of the row before."""
    rows = np.arange(len(subject.log))
    rows -= (rng.random(len(rows)) < share) & (rows > 0)
    return with_rows(subject, rows, subject.log.time)


def exchanged_stretches(seconds: float, at: float, subject: Subject) -> Subject:
    """Return a log in which a stretch is written after the one behind it."""
    time = subject.log.time - subject.log.time[0]
    rows = np.arange(len(time))
    length = int(seconds / float(np.median(np.diff(time))))
    start = int(at * (len(rows) - 2 * length))
    middle = start + length
    order = [rows[:start], rows[middle : middle + length], rows[start:middle]]
    order.append(rows[middle + length :])
    return with_rows(subject, np.concatenate(order), subject.log.time)


def draw_time(rng: Random, subject: Subject) -> Change:
    """Return a change of the clock or of the rows."""
    own_rng = np.random.default_rng(rng.integers(2**32))
    factor = either_way(rng, log_uniform(rng, 1.03, 3.0))
    share = log_uniform(rng, 0.005, 0.3)
    seconds = log_uniform(rng, 0.05, 2.0)
    at = float(rng.uniform(0.2, 0.6))
    choices: dict[str, tuple[str, Callable[[Subject], Subject]]] = {
        "factor": (f"too long by {factor:.3g}", partial(time_factor, factor)),
        "drift": (f"fast by more and more, to {share:.1%}", partial(time_drift, share)),
        "jump": (f"jumps by {seconds:.2g} s", partial(time_jump, seconds, at)),
        "lost rows": (
            f"counted from rows of which {share:.1%} are lost",
            partial(lost_rows, share, own_rng),
        ),
        "lost stretch": (
            f"counted from rows of which {seconds:.2g} s are lost",
            partial(lost_stretch, seconds, at),
        ),
        "repeated rows": (
            f"with {share:.1%} of the rows repeating the one before",
            partial(repeated_rows, share, own_rng),
        ),
        "exchanged stretches": (
            f"with two stretches of {seconds:.2g} s exchanged",
            partial(exchanged_stretches, seconds, at),
        ),
    }
    kind = str(rng.choice([*choices], p=[0.34, *[0.11] * 6]))
    words, spoil = choices[kind]
    names = CLOCK if kind in ("factor", "drift") else CLOCK - {FaultName.GRAVITY}
    return Change(f"time {kind}", f"time {words}", names, (), spoil)


# ---- torque whose parts are known


def true_scene(subject: Subject) -> Scene:
    """Return the simulated arm; changes that need one are drawn of no other."""
    assert subject.scene is not None
    return subject.scene


def with_part(
    part: Callable[[Scene], Array], share: float, when: When, subject: Subject
) -> Subject:
    """Return a log with a share of a part of its torque (N, n) added."""
    further = share * part(true_scene(subject))
    tau = subject.log.tau + weights(subject.log, when) * further
    return subject.with_columns("tau", tau)


PARTS: Mapping[str, tuple[Callable[[Scene], Array], Names]] = {
    "gravity": (lambda s: s.still, frozenset({*CLOCK, FaultName.MODEL})),
    "inertia": (lambda s: s.rigid - s.still, frozenset({*CLOCK, FaultName.MODEL})),
    "links": (lambda s: s.rigid, frozenset({FaultName.GRAVITY, *SCALE})),
    "friction": (
        lambda s: s.friction,
        frozenset({FaultName.FRICTION, FaultName.COMPUTED, FaultName.SIGN}),
    ),
}
"""Part of the torque to its function and right names."""


def draw_part(rng: Random, subject: Subject) -> Change:
    """Return a part of the torque of gravity, inertia or friction that is removed or added."""
    part = str(rng.choice([*PARTS]))
    share = -log_uniform(rng, 0.15, 1.0)
    if part == "friction":
        # Less friction, and more of it, are a right log of another arm.
        share = -float(rng.uniform(1.1, 2.0))
    elif rng.random() < 0.25:
        share = log_uniform(rng, 0.15, 1.0)
    when = draw_when(rng, True)
    function, names = PARTS[part]
    if not when.is_always:
        names |= STRETCH
    words = f"{share:+.0%} of the torque of {part}{when.words}"
    spoil = partial(with_part, function, share, when)
    return Change(f"part of {part}", words, names, (), spoil)


FADING = 0.02
"""Speed over which a controller's Coulomb friction turns round, over the highest."""


FEED_FORWARD = "feed-forward"
COMPUTED_KINDS = (FEED_FORWARD, "drives compensate friction")
"""Kinds of torque that a controller computes, with and without the friction of the gears."""


def computed_torque(
    wrong: float, has_friction: bool, noise: float, rng: Random, subject: Subject
) -> Subject:
    """Return a log of the torque of a controller's model, whose links may be slightly wrong."""
    scene = true_scene(subject)
    motion = scene.motion
    n = subject.n_joints
    thetas = scene.arm.thetas * (1.0 + wrong * rng.standard_normal((n, 1)))
    tau = scene.rigid - link_torque(scene.robot, motion, scene.arm.thetas)
    tau = tau + link_torque(scene.robot, motion, thetas)
    if has_friction:
        fastest = np.maximum(np.max(np.abs(motion.qd), axis=0), 1e-3)
        dry = scene.arm.coulomb * np.tanh(motion.qd / (FADING * fastest))
        tau = tau + dry + scene.arm.viscous * motion.qd
    white = bool(rng.integers(2))
    tau = tau + noise * subject.loads * noise_samples(rng, tau.shape, white)
    return subject.with_columns("tau", tau)


def draw_computed(rng: Random, subject: Subject) -> Change:
    """Return torque that was computed, with or without friction, or compensated in the drives."""
    own_rng = np.random.default_rng(rng.integers(2**32))
    wrong = float(rng.choice([0.0, log_uniform(rng, 0.005, 0.05)]))
    kind = str(rng.choice(COMPUTED_KINDS))
    has_friction = kind == FEED_FORWARD
    noise = (
        float(rng.uniform(0.0, 0.01)) if has_friction else log_uniform(rng, 3e-3, 0.03)
    )
    words = f"{kind}: links off by {wrong:.1%}, noise {noise:.1%}"
    spoil = partial(computed_torque, wrong, has_friction, noise, own_rng)
    return Change(kind, words, frozenset({FaultName.COMPUTED}), (), spoil)


# ---- the model


def with_edit(edit: Edit, subject: Subject) -> Subject:
    """Return a subject whose model is edited once more."""
    return replace(subject, edits=(*subject.edits, edit))


def of_body(name: str, change: Callable[[Any], None]) -> Edit:
    """Return an edit of one body; of each with mass where no name is given."""

    def edit(spec: Any) -> None:
        for body in spec.bodies:
            if body.name == name or (not name and body.mass > 0.0):
                change(body)

    return edit


def tilted(angles: Array, subject: Subject) -> Subject:
    """Return a log of an arm whose base is turned by two angles (2,) [rad]."""
    scene = true_scene(subject)
    arm = replace(scene.arm, tilt=scene.arm.tilt + angles)
    rigid, _ = arm.torques(scene.motion)
    tau = subject.log.tau + rigid - scene.rigid
    changed = replace(subject, scene=replace(scene, arm=arm, rigid=rigid))
    return changed.with_columns("tau", tau)


def draw_tilt(rng: Random, subject: Subject) -> Change:
    """Return an arm that is mounted at another angle than its model says."""
    degrees = log_uniform(rng, 2.0, 180.0)
    direction = rng.uniform(0.0, 2.0 * np.pi)
    angles = np.radians(degrees) * np.array([np.cos(direction), np.sin(direction)])
    words = f"the arm is mounted at {degrees:.1f} degrees"
    names = frozenset({FaultName.TILT})
    return Change("model tilt", words, names, (), partial(tilted, angles))


def draw_model(rng: Random, subject: Subject) -> Change:
    """Return a model that is wrong: masses, inertias, a centre of mass, a length, or an axis."""
    scene = true_scene(subject)
    kind = str(
        rng.choice(["masses", "inertias", "link mass", "link centre", "length", "axis"])
    )
    link = scene.robot.links[int(rng.integers(1, subject.n_joints))]
    body = link.body_name
    factor = either_way(rng, log_uniform(rng, 1.3, 10.0))
    if kind == "masses":
        edit = of_body("", partial(multiply_body, factor, factor))
        words = f"masses of the model times {factor:.3g}"
        return Change(
            f"model {kind}", words, LINKS | SCALE, (), partial(with_edit, edit)
        )
    if kind == "inertias":
        edit = of_body("", partial(multiply_body, 1.0, factor))
        words = f"inertias of the model times {factor:.3g}"
        return Change(
            f"model {kind}", words, LINKS | CLOCK, (), partial(with_edit, edit)
        )
    if kind == "link mass":
        edit = of_body(body, partial(multiply_body, factor, factor))
        words = f"mass of {body} in the model times {factor:.3g}"
        return Change(f"model {kind}", words, LINKS, (body,), partial(with_edit, edit))
    if kind == "link centre":
        step = log_uniform(rng, 0.02, 0.3) * unit_vector(rng)

        def move(element: Any) -> None:
            element.ipos = element.ipos + step

        words = (
            f"centre of mass of {body} in the model {np.linalg.norm(step):.2g} m off"
        )
        spoil = partial(with_edit, of_body(body, move))
        return Change(f"model {kind}", words, LINKS, (body,), spoil)
    if kind == "length":
        stretch = 1.0 + either_sign(rng, log_uniform(rng, 0.05, 0.5))

        def lengthen(element: Any) -> None:
            element.pos = stretch * element.pos

        words = f"place of {body} in the model times {stretch:.2g}"
        spoil = partial(with_edit, of_body(body, lengthen))
        return Change(f"model {kind}", words, LINKS, (body,), spoil)
    joint = str(rng.choice(subject.joint_names))

    def turn(spec: Any) -> None:
        element = spec.joint(joint)
        element.axis = -np.asarray(element.axis)

    words = f"axis of {joint} in the model turned round"
    names = frozenset({FaultName.SIGN})
    return Change("model axis", words, names, (joint,), partial(with_edit, turn))


def unit_vector(rng: Random) -> Array:
    """Return a vector (3,) of length one in any direction."""
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


DrawChange = Callable[[Random, Subject], Change]
OF_ANY_LOG: Mapping[DrawChange, float] = {
    draw_column_change: 0.4,
    draw_exchange: 0.06,
    draw_wrist_motors: 0.06,
    draw_gear: 0.04,
    draw_both_signs: 0.04,
    draw_degrees: 0.03,
    draw_proportional: 0.08,
    draw_crosstalk_of_positions: 0.04,
    draw_time: 0.08,
}
"""Function that draws a change of any log to its share of all."""
OF_KNOWN_ARM: Mapping[DrawChange, float] = {
    draw_part: 0.06,
    draw_computed: 0.06,
    draw_model: 0.08,
    draw_tilt: 0.02,
}
"""The same of changes that need the arm's true torques, or edit its model."""
TWO_AT_ONCE = 0.2
"""Share of logs with two changes."""


def draw_changes(rng: Random, subject: Subject) -> list[Change]:
    """Return one change of a log or its model, or two."""
    shares = dict(OF_ANY_LOG)
    if subject.scene is not None:
        shares.update(OF_KNOWN_ARM)
    draws = [*shares]
    p = np.array([*shares.values()])
    count = 1 + (rng.random() < TWO_AT_ONCE)
    # Two of one kind may undo each other.
    places = rng.choice(len(draws), count, replace=False, p=p / np.sum(p))
    changes = [draws[place](rng, subject) for place in places]
    return sorted(changes, key=turn_of)


def turn_of(change: Change) -> int:
    """Return when a change is made: first what replaces the torque, last what changes the rows."""
    if change.kind in COMPUTED_KINDS:
        return 0
    return 2 if change.kind.startswith("time ") else 1
