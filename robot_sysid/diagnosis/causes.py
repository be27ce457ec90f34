"""What may be wrong with a log or its model: each cause is a term with a wide prior.

An error that every fit allows for, such as a joint's zero, has a second term here, with the same
columns and a wider prior. To add a cause, add a function to ``CAUSES`` that takes the fit of a log
and yields explanations.

Throughout, m is the number of rows of a chunk, J that of joints, e that of a cause's parameters. In
texts {value} stands for the number with its error, {joint} for the joint's name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from robot_sysid.diagnosis import Level
from robot_sysid.diagnosis.log_fit import typical_torque
from robot_sysid.dynamics.equations import names_of
from robot_sysid.dynamics.inverse_dynamics import (
    LinkDynamics,
    LinksMotion,
    gravity_vector,
)
from robot_sysid.dynamics.spatial import parameter_scale
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.rows import Rows
from robot_sysid.estimate.terms import (
    DELAY,
    LAST_LINK,
    TILT,
    ZEROS,
    ArmTerms,
    Point,
    Term,
    independent,
)
from robot_sysid.records import Array
from robot_sysid.records.messages import percent, with_error

STEPS = 15
"""Number of evenly spaced instants at which a change of payload is tried."""
RIPPLES = tuple(range(4, 41))
"""Numbers of torque waves per turn of a joint that are tried."""
LIKELY = 3
"""Number of them, those most like what is left of the torque, that are tried first."""
GROSS_ZERO = 0.05
"""Error of a joint's zero position from which it is harmful in any case [rad]."""
GROSS_DELAY = 0.03
"""Delay of one joint's torque from which it is harmful in any case [s]."""
LONGEST_DELAY = 0.15
"""Longest delay that changes torques in proportion [s]."""
WARM_UP = (10.0, 30.0, 100.0)
"""Time constants over which friction falls as a gear warms up [s]."""
SURE = 2.0
"""Standard errors that count as sure."""
Values = Callable[[Array, Array], str]
"""Function that returns the user's text from values (e,) and standard errors (e,)."""
Column = Callable[[Rows, Point], Array]
"""Function that returns a torque (m, J) or (m, J, e) of a chunk of rows around a point [N m]."""


@dataclass(frozen=True)
class Explanation:
    """One fault that a log or its model may have.

    Attributes:
        term: its parameters and prior. The cause is the name of the check that reports it, a key of
            ``logs.CHECKS``; the text is the fault and what to do, with {value}.
        family: term whose columns hold those of this one and of others like it.
        level: severity of the finding, where a result without the explanation would be wrong.
        joint: index of the joint that it acts on; None for all.
        factor, unit, shift: the number in the text is (first value + shift) factor.
        is_norm: whether the number is the Euclidean norm of the first three values, not the first.
        words: returns the text where it takes more than one number.
        choices: number of similar explanations that are tried, of which only the best one counts.
        is_possible: whether values (e,) with standard errors (e,) fit the text.
        harmful_from: size of the first value from which it is harmful in any case.
        nearby: returns similar explanations to try where this one wins.
    """

    term: Term
    family: Term
    level: Level = Level.WARN
    joint: int | None = None
    factor: float = 1.0
    unit: str = ""
    shift: float = 0.0
    is_norm: bool = False
    words: Values | None = None
    choices: int = 1
    is_possible: Callable[[Array, Array], bool] = lambda values, errors: True
    harmful_from: float = np.inf
    nearby: Callable[[], list[Explanation]] = list

    @property
    def subject(self) -> tuple[str, int | None]:
        """The name of the check and the joint; a log's findings name each subject once."""
        return self.term.cause, self.joint

    def text(self, values: Array, errors: Array) -> str:
        """Return the fault in words, with values (e,) and standard errors (e,)."""
        if self.words is not None:
            return self.words(values, errors)
        value = float(values[0])
        error = float(errors[0])
        if self.is_norm:
            value = float(np.linalg.norm(values[:3]))
            error = float(np.max(errors[:3]))
        number = with_error(
            self.factor * (value + self.shift), abs(self.factor) * error, self.unit
        )
        return self.term.text.replace("{value}", number)


def single(
    check: str, text: str, key: str, columns: Column, spread: Any, **fields: Any
) -> Explanation:
    """Return an explanation of columns (m, J), or (m, J, e), that no other one has.

    Args:
        check: name of the check.
        text: see ``Explanation.term``.
        key: tells the parameters' names from all others.
        columns: torque per unit of each parameter.
        spread: prior standard deviations, (e,) or one number.
        fields: of the explanation.
    """
    deviations = np.atleast_1d(np.asarray(spread, dtype=float))
    names = tuple(f"{check} {key} {k}" for k in range(len(deviations)))

    def stacked(rows: Rows, point: Point) -> Array:
        """Return the columns (m, J, e)."""
        torque = columns(rows, point)
        return torque if torque.ndim == 3 else torque[:, :, None]

    term = Term(check, names, stacked, independent(deviations), text=text)
    return Explanation(term, term, **fields)


def per_joint(
    arm: ArmTerms,
    check: str,
    text: str,
    key: str,
    columns: Column,
    spread: float,
    common: str = "",
    **fields: Any,
) -> Iterator[Explanation]:
    """Yield an error that all joints have in common, if that has a text, then that of each joint.

    Arguments are as in ``single``, but for these:

    Args:
        arm: all terms.
        columns: (m, J, J), per unit of each joint's error.
        common: text for the error that all have in common.
    """
    owners = ("all", *arm.joints)
    names = tuple(f"{check} {key} {owner}" for owner in owners)

    def with_sum(rows: Rows, point: Point) -> Array:
        """Return the columns (m, J, 1 + J), the sum of all joints first."""
        own = columns(rows, point)
        return np.concatenate((np.sum(own, axis=2, keepdims=True), own), axis=2)

    family = Term(check, names, with_sum, independent(np.full(len(names), spread)))
    for number, owner in enumerate(owners):
        sentence = text.replace("{joint}", owner) if number else common
        if sentence and (number or len(owners) > 2):
            term = part_of(family, number, sentence)
            joint = number - 1 if number else None
            yield Explanation(term, family, joint=joint, **fields)


def part_of(family: Term, number: int, text: str) -> Term:
    """Return the term of one parameter of a family."""

    def columns(rows: Rows, point: Point) -> Array:
        """Return the columns (m, J, 1)."""
        return family.columns(rows, point)[:, :, [number]]

    term = family.only([family.names[number]])
    return replace(term, columns=columns, text=text)


def rigid(arm: ArmTerms, rows: Rows, point: Point) -> Array:
    """Return the torque (m, J) of the point's links [N m]."""
    thetas = point.carried(rows.is_loaded)
    return rows.links_torque(arm.robot, point.gravity, thetas)[:, arm.indices]


def at_rest(arm: ArmTerms, rows: Rows, gravity: Array) -> LinksMotion:
    """Return all links at rest in the positions of rows, under a gravity (3,)."""
    q = rows.motion.q
    still = np.zeros_like(q)
    return LinkDynamics(arm.robot, gravity).motion(q, still, still)


def weight(arm: ArmTerms, rows: Rows, point: Point) -> Array:
    """Return the torque (m, J) of the weight of the point's links [N m]."""
    moves = at_rest(arm, rows, point.gravity)
    return moves.torque(point.carried(rows.is_loaded))[:, arm.indices]


def last_weight(arm: ArmTerms, rows: Rows, gravity: Array) -> Array:
    """Return the torque (m, J, 4) of the last link's weight, per unit of mass and first moments."""
    moves = at_rest(arm, rows, gravity)
    return moves.columns([arm.robot.n_joints - 1])[:, arm.indices, :4]


def diagonal(columns: Column) -> Column:
    """Return a torque (m, J) as columns (m, J, J): each joint's own."""

    def spread(rows: Rows, point: Point) -> Array:
        """Return the columns (m, J, J)."""
        torque = columns(rows, point)
        return torque[:, :, None] * np.eye(torque.shape[1])

    return spread


def along(fitted: Fit, columns: Column) -> Column:
    """Return a torque (m, J) times the time, from -1 at the begin of the log to 1 at its end."""
    first = fitted.recordings[0].motion.time[0]
    last = fitted.recordings[-1].motion.time[-1]

    def drifting(rows: Rows, point: Point) -> Array:
        """Return the torque (m, J)."""
        time = (2.0 * rows.motion.time - first - last) / (last - first)
        return np.asarray(columns(rows, point)) * time[:, None]

    return drifting


def sensors(fitted: Fit) -> Iterator[Explanation]:
    """Yield errors of torque and position sensors: scales, their drift, zeros, delays, gears.

    A common scale and links that are all too heavy make the same torques.
    """
    arm = fitted.arm
    links = partial(rigid, arm)
    yield from per_joint(
        arm,
        "torque-scale",
        "torque of joint {joint} reads {value} what links and the other joints say; weigh a "
        "known mass (payload --known-mass) and pass the file that it writes as --torque-scale",
        "",
        diagonal(links),
        0.4,
        "torques are {value} what the model's links make: either the torques of all joints read "
        "that many times too much, or the masses of all links are that many times the model's; "
        "torques cannot tell these apart: weigh the arm, or a known mass (payload --known-mass)",
        unit="times",
        shift=1.0,
        is_possible=lambda v, e: bool(v[0] > -0.5),
    )
    drift = "changes its scale by {value} over the log; let motors and sensors warm up, and record "
    drift += "again"
    yield from per_joint(
        arm,
        "torque-scale",
        f"the torque of joint {{joint}} {drift}",
        "drift",
        diagonal(along(fitted, links)),
        0.15,
        f"the torque of all joints {drift}",
        # The time runs from -1 to 1.
        factor=200.0,
        unit="%",
    )
    yield from per_joint(
        arm,
        "zero",
        "the position of joint {joint} reads {value} too much; correct its zero",
        "",
        lambda rows, point: arm.terms[ZEROS].columns(rows, point)[:, :, arm.indices],
        0.1,
        unit="rad",
        harmful_from=GROSS_ZERO,
    )
    late = per_joint(
        arm,
        "delay",
        "torque of joint {joint} alone lags position by {value}; record all joints at once",
        "",
        diagonal(lambda rows, point: arm.terms[DELAY].columns(rows, point)[:, :, 0]),
        0.04,
        "torque lags position by {value}; record both at the same instant",
        factor=1e3,
        unit="ms",
        is_possible=lambda v, e: bool(abs(v[0]) < LONGEST_DELAY),
    )
    for delay in late:
        gross = np.inf if delay.joint is None else GROSS_DELAY
        yield replace(delay, harmful_from=gross)
    yield single(
        "friction",
        "every gear loses {value} of its load, which no model file can hold; friction is right at "
        "this load alone",
        "load",
        partial(arm.friction_column, "load"),
        0.15,
        level=Level.NOTE,
        factor=100.0,
        unit="%",
        is_possible=lambda v, e: bool(0.0 < v[0] < 0.5),
    )


def tilt(fitted: Fit) -> Iterator[Explanation]:
    """Yield a tilt of the base, by two angles [rad]; nothing where the model has no gravity."""
    if TILT in fitted.arm.terms:
        yield single(
            "tilt",
            "the base is tilted by {value} against the model's; level it, or turn the model",
            "",
            fitted.arm.terms[TILT].columns,
            np.full(2, 0.15),
            factor=float(np.degrees(1.0)),
            unit="degrees",
            is_norm=True,
        )


def time_base(fitted: Fit) -> Iterator[Explanation]:
    """Yield errors of the time stamps' scale: a constant one, and one that also drifts.

    Time stamps that are too long by a small share s make accelerations and squared speeds too small
    by 2 s, so they change inertial torque alone.
    """
    arm = fitted.arm
    advice = "record the controller's own time stamps"

    def both(rows: Rows, point: Point) -> Array:
        """Return the torque (m, J, 2) per unit of a constant error and its change to the end."""
        inertial = 2.0 * (rigid(arm, rows, point) - weight(arm, rows, point))
        change = along(fitted, lambda *_: inertial)(rows, point)
        return np.stack((inertial, change), axis=-1)

    def describe(v: Array, e: Array) -> str:
        """Return the text of an error v, constant or with its change, with standard errors e."""
        if len(v) == 1:
            return (
                f"by inertia beside gravity, time in the log is {too_long(v[0])} "
                f"(\u00b1 {percent(float(e[0]))}); {advice}, or scale them with --columns FILE: "
                f"time = {1.0 / (1.0 + float(v[0])):.3g} * TITLE"
            )
        return (
            f"by inertia beside gravity, the clock drifts: time is {too_long(v[0] - v[1])} at "
            f"first, {too_long(v[0] + v[1])} at the end; {advice}"
        )

    drifting = single(
        "clock", "", "", both, [0.1, 0.1], words=describe, harmful_from=0.0
    )
    yield replace(drifting, term=part_of(drifting.term, 0, ""))
    yield drifting


def too_long(share: float) -> str:
    """Return "3 % too long" for a share of 0.03, "3 % too short" for -0.03."""
    return f"{percent(abs(float(share)))} too {'long' if share > 0.0 else 'short'}"


def payload_steps(fitted: Fit) -> Iterator[Explanation]:
    """Yield a change of the last link's load at each of ``STEPS`` evenly spaced instants."""
    start = fitted.recordings[0].motion.time[0]
    end = fitted.recordings[-1].motion.time[-1]
    instants, spacing = np.linspace(start, end, STEPS + 2, retstep=True)
    for instant in instants[1:-1].tolist():
        yield payload_step(fitted, instant, float(spacing))


def payload_step(fitted: Fit, instant: float, spacing: float) -> Explanation:
    """Return the explanation that the last link's load changes at an instant [s].

    An instant that is off by half a row moves the change by several standard errors. ``spacing`` is
    the time between the instants that are tried [s].
    """
    arm = fitted.arm
    last = arm.terms[LAST_LINK]

    def columns(rows: Rows, point: Point) -> Array:
        """Return the torque (m, J, 10) per unit of the last link's parameters after the instant."""
        key = "after", instant
        after = rows.low_passed(key, lambda m: (m.time >= instant).astype(float))
        return last.columns(rows, point) * after[:, None, None]

    def describe(v: Array, e: Array) -> str:
        """Return the text for the ten changes v (10,) with standard errors e (10,)."""
        # The torque scales multiply the load, too.
        scales = fitted.at([n for n in fitted.names if n.startswith("scale[")])
        error = float(np.hypot(e[0], np.max(fitted.errors[scales], initial=0.0) * v[0]))
        change = with_error(abs(float(v[0])), error, "kg")
        return (
            f"from about {instant:.3g} s on the last link carries {change} "
            f"{'more' if v[0] > 0.0 else 'less'}: was something picked up, dropped or moved? "
            "record each state in a log of its own"
        )

    def nearby() -> list[Explanation]:
        """Return steps at eleven instants around this one, a sixth of the spacing apart."""
        period = float(np.median(np.diff(fitted.recordings[0].motion.time)))
        finer = spacing / 6.0
        if finer < 0.1 * period:
            return []
        instants = instant + finer * np.arange(-5, 6)
        return [payload_step(fitted, at, finer) for at in instants.tolist()]

    spread = parameter_scale(0.05 * arm.robot.mass, 0.1 * arm.robot.length)
    return single(
        "payload-step",
        "",
        f"{instant}",
        columns,
        spread,
        level=Level.REFUSE,
        words=describe,
        choices=STEPS,
        nearby=nearby,
    )


def forces(fitted: Fit) -> Iterator[Explanation]:
    """Yield forces on the last link: a constant one, one that carries it, and a balancer's.

    The weight of the last link is free beside that of a balancer: its mass and first moments.
    """
    arm = fitted.arm
    total = arm.robot.mass
    down = float(np.linalg.norm(gravity_vector(arm.robot))) or 9.81
    load = parameter_scale(0.1 * total, 0.1)[:4]

    def pull(rows: Rows, point: Point) -> Array:
        """Return the torque (m, J, 12) of forces along three axes, and of their offsets."""
        # The weight of one kilogram under a gravity of one along an axis stands for a unit force.
        axes = [-last_weight(arm, rows, axis) for axis in np.eye(3)]
        torque = np.stack(axes, axis=-1)
        return torque.reshape(*torque.shape[:2], 12)

    def share(rows: Rows, point: Point) -> Array:
        """Return the torque (m, J, 5) of all links' weight, and of the last link's."""
        own = weight(arm, rows, point)[:, :, None]
        return np.concatenate((own, last_weight(arm, rows, point.gravity)), axis=-1)

    yield single(
        "force",
        "a constant force of {value} acts on the last link, as of a hand, a cable or a spring; "
        "take it away, and record again",
        "tip",
        pull,
        total * down * np.repeat((0.1, 0.01), (3, 9)),
        level=Level.REFUSE,
        is_possible=lambda v, e: bool(np.any(np.abs(v[:3]) > 3.0 * e[:3])),
        unit="N",
        is_norm=True,
    )
    yield single(
        "force",
        "the last link weighs {value} more than its inertia says: something holds a part of it, "
        "or pulls, as a hand or a hose does; take it away, record again",
        "weight",
        lambda rows, point: last_weight(arm, rows, point.gravity),
        load,
        level=Level.REFUSE,
        unit="kg",
    )
    yield single(
        "gravity",
        "{value} of the links' weight is missing from the torque: is there a spring balancer that "
        "the model lacks, or is gravity compensated in part? record the measured joint torque, not "
        "the command",
        "share",
        share,
        np.append(0.5, load),
        level=Level.REFUSE,
        factor=-100.0,
        unit="%",
        is_possible=lambda v, e: bool(
            -1.0 - 3.0 * e[0] < v[0] < -max(0.05, SURE * e[0])
        ),
    )


def shapes_at(
    fitted: Fit, joint: int, shapes: Callable[[Any, int], list[Array]]
) -> Column:
    """Return the torque (m, J, e) of shapes (m,) of the motion that act at one joint."""
    arm = fitted.arm

    def columns(rows: Rows, point: Point) -> Array:
        """Return the torque (m, J, e)."""
        stacked = np.stack(shapes(rows.motion, arm.indices[joint]), axis=-1)
        return stacked[:, None, :] * np.eye(len(arm.joints))[joint][:, None]

    return columns


def spring(motion: Any, k: int) -> list[Array]:
    """Return the shapes (m,) of a joint's position."""
    q = motion.q[:, k]
    return [q, np.sin(q), np.cos(q)]


def shapes_of_joints(fitted: Fit) -> Iterator[Explanation]:
    """Yield torque at each joint in its position or in time: a spring, a hum, a ripple.

    Of a hum and a ripple, the strongest sine in the joint's residual torque is tried: over time
    from 2 periods per log to 0.4 periods per row, over position with ``RIPPLES`` waves per turn.
    """
    arm = fitted.arm
    torque = typical_torque(fitted.sums)
    residual = np.nan_to_num(fitted.residuals())
    q = np.concatenate([recording.motion.q for recording in fitted.recordings])
    time = np.concatenate([recording.motion.time for recording in fitted.recordings])
    span = float(time[-1] - time[0])
    step = float(np.median(np.diff(time)))
    rates = 2.0 * np.pi * np.arange(2.0 / span, 0.4 / step, 0.25 / span)
    in_time = np.abs(np.exp(1j * np.outer(rates, time)) @ residual)
    for joint, name in enumerate(arm.joints):
        yield single(
            "force",
            f"at joint {name} a torque follows the position, as of a spring, a balancer or a hose; "
            "the model has to have it, or take it away",
            f"spring {name}",
            shapes_at(fitted, joint, spring),
            np.full(3, 0.5 * torque[joint]),
            level=Level.REFUSE,
            joint=joint,
        )
        rate = float(rates[np.argmax(in_time[:, joint])])
        yield single(
            "contact",
            f"torque of joint {name} hums: a sine of {rate / (2.0 * np.pi):.2g} Hz and {{value}} "
            "that neither motion nor friction makes; find its source",
            name,
            shapes_at(fitted, joint, partial(waves, rate, True)),
            np.full(2, 0.1 * torque[joint]),
            joint=joint,
            unit="N m",
            is_norm=True,
            choices=len(rates),
        )
        in_turn = np.exp(1j * np.outer(RIPPLES, q[:, arm.indices[joint]]))
        sizes = np.abs(in_turn @ residual[:, joint])
        for at in np.argsort(sizes)[-LIKELY:].tolist():
            yield ripple(fitted, joint, RIPPLES[at])


def ripple(fitted: Fit, joint: int, count: int) -> Explanation:
    """Return the explanation that the torque of a joint ripples some times per turn."""
    name = fitted.arm.joints[joint]
    return single(
        "ripple",
        f"torque of joint {name} ripples about {count} times per turn by {{value}}, as of cogging; "
        "errors count it as noise",
        f"{count} {name}",
        shapes_at(fitted, joint, partial(waves, count, False)),
        np.full(2, 0.1 * typical_torque(fitted.sums)[joint]),
        level=Level.NOTE,
        joint=joint,
        unit="N m",
        is_norm=True,
        choices=len(RIPPLES),
        nearby=lambda: [ripple(fitted, joint, count + k) for k in (-1, 1)],
    )


def waves(rate: float, in_time: bool, motion: Any, k: int) -> list[Array]:
    """Return cosine and sine (m,) of the time or a joint's position times a rate."""
    phase = rate * (motion.time if in_time else motion.q[:, k])
    return [np.cos(phase), np.sin(phase)]


def crosstalk(fitted: Fit) -> Iterator[Explanation]:
    """Yield torque sensors that also read a share of the torque of the joint before or after."""
    arm = fitted.arm
    torque = typical_torque(fitted.sums)
    for joint, name in enumerate(arm.joints):
        for other in {joint - 1, joint + 1}.intersection(range(len(arm.joints))):
            own = np.eye(len(arm.joints))[joint]

            def columns(
                rows: Rows, point: Point, other: int = other, own: Array = own
            ) -> Array:
                """Return the torque (m, J) of the other joint at this one."""
                return rigid(arm, rows, point)[:, [other]] * own

            yield single(
                "crosstalk",
                f"the torque of joint {name} holds {{value}} of that of joint "
                f"{arm.joints[other]}; calibrate its sensor",
                f"{name} {other}",
                columns,
                0.1 * min(1.0, torque[joint] / torque[other]),
                joint=joint,
                factor=100.0,
                unit="%",
            )


def warming(fitted: Fit) -> Iterator[Explanation]:
    """Yield dry friction that falls as gears warm up, with each time constant of ``WARM_UP``.

    Nothing is yielded for a log no longer than the first of them.
    """
    arm = fitted.arm
    first = fitted.recordings[0].motion.time[0]
    if fitted.recordings[-1].motion.time[-1] - first <= WARM_UP[0]:
        return
    dry = [fitted.by_name[name] for name in names_of("coulomb", arm.joints)]
    spread = 0.5 * np.maximum(np.abs(dry), 0.01 * typical_torque(fitted.sums))
    for constant in WARM_UP:

        def excess(rows: Rows, point: Point, constant: float = constant) -> Array:
            """Return the torque (m, J) of friction above that at the end."""
            decay = np.exp((first - rows.motion.time) / constant)
            return arm.friction_column("coulomb", rows, point) * decay[:, None]

        yield single(
            "friction",
            "friction falls over the log; let the arm warm up before it is recorded",
            f"{constant}",
            diagonal(excess),
            spread,
            level=Level.NOTE,
            choices=len(WARM_UP),
        )


CAUSES: tuple[Callable[[Fit], Iterator[Explanation]], ...] = (
    sensors,
    tilt,
    time_base,
    payload_steps,
    forces,
    shapes_of_joints,
    crosstalk,
    warming,
)
"""Functions that take the fit of a log and yield explanations."""


def explanations(fitted: Fit) -> list[Explanation]:
    """Return what all functions of ``CAUSES`` yield for the fit of a log."""
    return [explanation for cause in CAUSES for explanation in cause(fitted)]
