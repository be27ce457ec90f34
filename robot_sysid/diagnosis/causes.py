"""What may be wrong with a log or its model: each cause is an effect on the fit's own columns.

Most causes have columns in every fit: a scale of torques, a zero, a tilt, a body. The others get
theirs from ``beside``, in the same rows. Where a cause acts at one joint, in one log or more and
more, its effect says so, and needs no column of its own. To add a cause, add a function to
``explanations`` that takes a fit and yields them.

Throughout, m is the number of rows of a chunk, J that of joints, B that of blocks.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from robot_sysid.dynamics.friction import names_of
from robot_sysid.dynamics.inverse_dynamics import (
    TILT_NAMES,
    LinkDynamics,
    LinksMotion,
    gravity_vector,
)
from robot_sysid.dynamics.spatial import PARAMETER_NAMES, parameter_scale
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.offers import Effect, Offer
from robot_sysid.estimate.rows import Rows, Sums
from robot_sysid.estimate.terms import ArmTerms, Point, Term
from robot_sysid.records import Array
from robot_sysid.records.messages import Level, position_unit, torque_unit, with_error

LONGEST_DELAY = 0.15
"""Longest delay that changes torques in proportion [s]."""
LONGEST_TIME = 0.4
"""Largest relative error of time stamps: beyond it, torque lacks inertia."""
INERTIAL = "inertial torque"
"""Name of the column of the links' torque without their weight."""
WEIGHT = "weight"
"""Name of the column of the links' weight."""
SPRING = ("position", "sine of position", "cosine of position")
HUM = ("cosine of time", "sine of time")
NEIGHBOURS = ("torque of joint before", "torque of joint after")
LAST_WEIGHT = tuple(f"weight of last {name}" for name in PARAMETER_NAMES[:4])
FORCE = tuple(f"force {axis} {name}" for name in PARAMETER_NAMES[:4] for axis in "xyz")
# Words of a text for a positive number, and for a negative one.
_BY_SIGN = re.compile(r"\{([^|{}]*)\|([^|{}]*)\}")


@dataclass(frozen=True)
class Explanation:
    """One fault that a log or its model may have.

    In text and remedy {value} stands for the size of the number with its standard error,
    {more|less} for the word that its sign needs, and {inverse} for 1 / sqrt(1 + first value), by
    which time has to be multiplied where inertial torque is off by the value.

    Attributes:
        check: name of the check that reports it, a key of ``logs.CHECKS``.
        effect: its columns, where they act, and their prior.
        text: the fault.
        remedy: what to do; "" for nothing.
        level: level of the finding, where a result without the explanation would be wrong.
        factor: the number in the text is the first value times it.
        unit: of the number.
        relative_error: of the number, beside the standard error of the fit.
        is_norm: whether the number is the Euclidean norm of the first three values, not the first.
        choices: number of similar explanations that are tried, of which only the best one counts.
        is_possible: whether values with their standard errors are of a size that exists.
        log: name of the only log in which it acts; "" for all.
    """

    check: str
    effect: Effect
    text: str
    remedy: str = ""
    level: Level = Level.DOUBTS
    factor: float = 1.0
    unit: str = ""
    relative_error: float = 0.0
    is_norm: bool = False
    choices: int = 1
    is_possible: Callable[[Array, Array], bool] = lambda values, errors: True
    log: str = ""

    @property
    def subject(self) -> tuple[str, str, str]:
        """The check, the words and the log; a finding names each subject once."""
        return self.check, self.text.partition("{instant}")[0], self.log

    def number(self, offer: Offer) -> tuple[float, float]:
        """Return the number that an offer gives, and its standard error."""
        if self.is_norm:
            return float(np.linalg.norm(offer.values[:3])), np.max(offer.errors[:3])
        return offer.values[0], offer.errors[0]

    def describe(self, offer: Offer) -> tuple[str, str]:
        """Return (text, remedy) with the number of an offer."""
        value, error = self.number(offer)
        error = abs(self.factor) * np.hypot(error, self.relative_error * value)
        number = with_error(abs(self.factor * value), error, self.unit)

        def fill_in(template: str) -> str:
            """Return a text with the number and the words for its sign."""
            words = _BY_SIGN.sub(r"\1" if value > 0.0 else r"\2", template)
            # Values of other causes, which do not show it, may be below -1.
            inverse = f"{max(1.0 + value, 1e-9) ** -0.5:.3g}"
            return words.replace("{value}", number).replace("{inverse}", inverse)

        where = f"in {self.log}, " if self.log else ""
        return where + fill_in(self.text), fill_in(self.remedy)

    def in_log(self, fitted: Fit, log: str) -> Explanation:
        """Return the explanation for one log of several."""
        mask = fitted.sums.is_of(log).astype(float)
        shares = mask if self.effect.shares is None else mask * self.effect.shares
        return replace(self, effect=replace(self.effect, shares=shares), log=log)


# ---- columns beside those of a fit


def beside(fitted: Fit) -> list[Term]:
    """Return the terms whose columns causes need, beside those of every fit."""
    arm = fitted.arm
    rates = np.zeros(len(arm.joints))
    residuals = np.nan_to_num(fitted.residuals)
    recordings = fitted.recordings
    time = np.concatenate([recording.motion.time for recording in recordings])
    first = np.min(time)
    for joint, residual in enumerate(residuals.T):
        rates[joint] = strongest_rate(time - first, residual)
    eye = np.eye(len(arm.joints))

    def inertial(rows: Rows, point: Point) -> Array:
        """Return the torque (m, J, 1) of the links without their weight."""
        return (arm.links_torque(rows, point) - weight(arm, rows, point))[:, :, None]

    def spring(rows: Rows, point: Point) -> Array:
        """Return each joint's position (m, J, 3), its sine and its cosine."""
        own = rows.motion.q[:, arm.indices]
        return np.stack((own, np.sin(own), np.cos(own)), axis=-1)

    def hum(rows: Rows, point: Point) -> Array:
        """Return waves (m, J, 2) over time, at each joint's own rate."""
        phases = np.outer(rows.motion.time - first, rates)
        return np.stack((np.cos(phases), np.sin(phases)), axis=-1)

    def neighbours(rows: Rows, point: Point) -> Array:
        """Return the links' torque (m, J, 2) of the joint before, and of that after."""
        torque = arm.links_torque(rows, point)
        return np.stack(
            (torque @ np.eye(len(eye), k=1), torque @ np.eye(len(eye), k=-1)), -1
        )

    def force(rows: Rows, point: Point) -> Array:
        """Return the torque (m, J, 12) of forces on the last link, and of their offsets."""
        # The weight of one kilogram under a gravity of one along an axis stands for a unit force.
        axes = [-last_weight(arm, rows, axis) for axis in np.eye(3)]
        return np.stack(axes, axis=-1).reshape(len(rows.motion.time), -1, len(FORCE))

    columns = {
        (INERTIAL,): inertial,
        (WEIGHT,): lambda rows, point: weight(arm, rows, point)[:, :, None],
        LAST_WEIGHT: lambda rows, point: last_weight(arm, rows, point.gravity),
        FORCE: force,
        SPRING: spring,
        HUM: hum,
        NEIGHBOURS: neighbours,
    }
    return [Term("", names, make) for names, make in columns.items()]


def strongest_rate(time: Array, residual: Array) -> float:
    """Return the rate of the strongest sine in a residual (K,) at times (K,) [rad/s].

    From 2 periods per log on, in steps of a quarter of a period, by a Fourier transform of the
    residual on an even grid.
    """
    step = max(float(np.median(np.diff(time))), 1e-9)
    grid = np.bincount(np.rint(time / step).astype(int), residual)
    spectrum = np.abs(np.fft.rfft(grid, 4 * len(grid)))
    highest = int(0.4 * 4 * len(grid))
    return float(
        2.0 * np.pi * (8 + np.argmax(spectrum[8:highest])) / (4 * len(grid) * step)
    )


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


def typical_torque(fitted: Fit) -> Array:
    """Return the root mean square torque (J,), at least 2 % of the largest [N m]."""
    torque = fitted.sums.rms_torque
    return np.maximum(torque, 0.02 * np.max(torque))


# ---- explanations


def explanations(fitted: Fit) -> list[Explanation]:
    """Return all explanations for a fit that has the columns of ``beside``."""
    every = [
        *sensors(fitted),
        *over_time(fitted),
        *forces(fitted),
        *shapes_of_joints(fitted),
    ]
    logs = dict.fromkeys(fitted.sums.logs)
    if len(logs) > 1:
        whole = [each for each in every if each.check != "payload-step"]
        every += [each.in_log(fitted, log) for each in whole for log in logs]
    return every


def effect(
    names: Sequence[str],
    spread: Any,
    joint: int | None = None,
    shares: Array | None = None,
) -> Effect:
    """Return the effect of columns with independent prior standard deviations."""
    return Effect(
        tuple(names), np.diag(np.broadcast_to(spread, len(names))), joint, shares
    )


def sensors(fitted: Fit) -> Iterator[Explanation]:
    """Yield errors of torque and position sensors, of the base and of the clock."""
    arm = fitted.arm
    joints = arm.joints
    scales = names_of("scale", joints)
    for joint, (name, scale) in enumerate(zip(joints, scales)):
        owner = f"joint {name}"
        is_slide = name in arm.robot.slides
        yield Explanation(
            "torque-scale",
            effect([scale], 0.4, joint),
            f"torque of {owner} reads {{value}} too {{much|little}} for the model's links, or the "
            "links that it carries are {heavier|lighter} than in the model",
            "weigh a known mass (--known-mass of payload), and pass the file that it writes as "
            "--torque-scale",
            factor=100.0,
            unit="%",
            is_possible=lambda v, e: v[0] > -0.5,
        )
        yield Explanation(
            "zero",
            replace(effect([f"zero[{name}]"], 0.1), joint=None),
            f"the position of {owner} reads {{value}} too {{much|little}}",
            "correct the joint's zero",
            unit=position_unit(is_slide),
        )
        yield Explanation(
            "delay",
            effect(["delay"], 0.04, joint),
            f"torque of {owner} is {{value}} {{later|earlier}} than position",
            "record torques and positions of all joints at the same instant",
            factor=1e3,
            unit="ms",
            is_possible=lambda v, e: abs(v[0]) < LONGEST_DELAY,
        )
    if len(joints) > 1:
        yield Explanation(
            "delay",
            effect(["delay"], 0.04),
            "torque of all joints is {value} {later|earlier} than position",
            "record torques and positions of all joints at the same instant",
            factor=1e3,
            unit="ms",
            is_possible=lambda v, e: abs(v[0]) < LONGEST_DELAY,
        )
    if "load" in arm.terms:
        loads = names_of("load", joints)
        yield Explanation(
            "friction",
            Effect(loads, np.full((len(loads), 1), 0.15)),
            "every gear loses {value} of its load, which no model file can hold: friction in the "
            "file is right at this load alone",
            level=Level.SAYS,
            factor=100.0,
            unit="%",
            is_possible=lambda v, e: 0.0 < v[0] < 0.5,
        )
    if arm.has_gravity:
        yield Explanation(
            "tilt",
            effect(TILT_NAMES, 0.15),
            "the base is tilted by {value} against the model's",
            "level it, or turn the base in the model",
            factor=np.degrees(1.0),
            unit="degrees",
            is_norm=True,
        )
    yield Explanation(
        "computed",
        Effect((INERTIAL,), np.ones((1, 1))),
        "the torque holds the links' weight and lacks {value} of their inertia: it is that of a "
        "controller's model, or of an arm that is guided by hand",
        "record the measured joint torque of an arm that its motors move",
        factor=-100.0,
        unit="%",
        is_possible=lambda v, e: abs(v[0] + 1.0) < max(0.2, 3.0 * e[0]) and e[0] < 0.1,
    )
    # Time stamps that are too long by a small share s make accelerations and squared speeds too
    # small by 2 s, so they change inertial torque alone.
    yield Explanation(
        "clock",
        Effect((INERTIAL,), np.full((1, 1), 0.2)),
        "time in the log is {value} too {long, or a balancer carries a part of the weight|short}, "
        "as the torque of inertia shows beside that of gravity",
        "record the controller's own time stamps, or scale these with a line in --columns FILE: "
        "time = {inverse} * TITLE",
        factor=50.0,
        unit="%",
        is_possible=lambda v, e: abs(v[0]) < 2.0 * LONGEST_TIME,
    )


def over_time(fitted: Fit) -> Iterator[Explanation]:
    """Yield what changes over a log: scales, the clock, the load."""
    arm = fitted.arm
    sums = fitted.sums
    blocks = np.arange(len(sums.logs))
    along = np.zeros(len(blocks))
    for log in dict.fromkeys(sums.logs):
        own = np.flatnonzero(sums.is_of(log))
        along[own] = (2.0 * np.arange(len(own)) + 1.0) / len(own) - 1.0
    owners: dict[str, int | None] = {f"joint {n}": k for k, n in enumerate(arm.joints)}
    scales = names_of("scale", arm.joints)
    for owner, joint in {**owners, "all joints": None}.items():
        names = scales if joint is None else [scales[joint]]
        yield Explanation(
            "torque-scale",
            Effect(tuple(names), np.full((len(names), 1), 0.15), joint, along),
            f"the torque scale of {owner} {{rises|falls}} by {{value}} over the log",
            "let motors and sensors warm up, and record again",
            # The time runs from -1 to 1.
            factor=200.0,
            unit="%",
        )
    yield Explanation(
        "clock",
        Effect((INERTIAL,), np.full((1, 1), 0.2), None, along),
        "the clock drifts, as the torque of inertia shows beside that of gravity: time stamps grow "
        "by {value} {more|less} at the end of the log than at its begin",
        "record the controller's own time stamps",
        factor=100.0,
        unit="%",
    )
    dry = names_of("coulomb", arm.joints)
    if "coulomb" in arm.terms:
        least = 0.01 * typical_torque(fitted)
        sizes = np.array([abs(fitted.by_name[name]) for name in dry])
        yield Explanation(
            "friction",
            effect(dry, 0.3 * np.maximum(sizes, least), None, along),
            "friction changes over the log",
            "let the arm warm up before it is recorded",
            level=Level.SAYS,
        )
    spread = parameter_scale(0.05 * arm.robot.mass, 0.1 * arm.robot.length)
    scale_errors = fitted.errors[fitted.at([n for n in fitted.names if n in scales])]
    for first in blocks[1:].tolist():
        if sums.logs[first] == sums.logs[first - 1]:
            yield Explanation(
                "payload-step",
                effect(PARAMETER_NAMES, spread, None, _after(sums, first)),
                "from about {instant} on the last link carries {value} {more|less}: something was "
                "picked up, dropped or moved",
                "record each state in a log of its own",
                level=Level.REFUSES,
                unit="kg",
                # The torque scales multiply the load, too.
                relative_error=float(np.max(scale_errors, initial=0.0)),
                choices=len(blocks),
            )


def _after(sums: Sums, first: int) -> Array:
    """Return 1 for the blocks (B,) of a log from one of them on, 0 for all others."""
    is_later = np.array(sums.blocks) >= first
    return (sums.is_of(sums.logs[first]) & is_later).astype(float)


def forces(fitted: Fit) -> Iterator[Explanation]:
    """Yield forces on the last link: a constant one, one that carries it, and a balancer's.

    The weight of the last link is free beside that of a balancer: its mass and first moments.
    """
    arm = fitted.arm
    total = arm.robot.mass
    down = float(np.linalg.norm(gravity_vector(arm.robot))) or 9.81
    load = parameter_scale(0.1 * total, 0.1)[:4]
    yield Explanation(
        "force",
        effect(FORCE, total * down * np.repeat((0.1, 0.01), (3, 9))),
        "a constant force of {value} acts on the last link, as of a hand, a cable or a spring",
        "take it away, and record again",
        level=Level.REFUSES,
        is_possible=lambda v, e: bool(np.any(np.abs(v[:3]) > 3.0 * e[:3])),
        unit="N",
        is_norm=True,
    )
    yield Explanation(
        "force",
        effect(LAST_WEIGHT, load),
        "the last link weighs {value} {more|less} than its inertia says: a hand, a hose or a "
        "support holds a part of it or draws at it",
        "take it away, and record again",
        level=Level.REFUSES,
        unit="kg",
    )
    yield Explanation(
        "gravity",
        effect((WEIGHT, *LAST_WEIGHT), np.append(0.5, load)),
        "{value} of the links' weight is missing from the torque: a spring balancer that the model "
        "lacks, or gravity that is compensated in part",
        "record the measured joint torque, not the command",
        level=Level.REFUSES,
        factor=-100.0,
        unit="%",
        is_possible=lambda v, e: -1.0 - 3.0 * e[0] < v[0] < -max(0.05, 2.0 * e[0]),
    )


def shapes_of_joints(fitted: Fit) -> Iterator[Explanation]:
    """Yield torque at each joint in its position, in time or in another joint's torque."""
    arm = fitted.arm
    torque = typical_torque(fitted)
    count = sum(map(len, fitted.recordings))
    for joint, name in enumerate(arm.joints):
        # A spring at the joint, and one that pulls from a point beside it.
        for shape, largest in ((SPRING[:1], np.inf), (SPRING[1:], 2.0 * torque[joint])):
            yield Explanation(
                "force",
                # The prior is the joint's own torque within a tenth of a radian, or of a metre.
                effect(shape, 10.0 * torque[joint], joint),
                f"at joint {name} a torque follows the position, as of a spring, a balancer or a "
                "hose",
                "take it away, or add it to the model",
                level=Level.REFUSES,
                is_possible=partial(is_within, largest),
            )
        yield Explanation(
            "contact",
            effect(HUM, 0.1 * torque[joint], joint),
            f"torque of joint {name} hums: a sine of {{value}} that neither motion nor friction "
            "makes",
            "find its source",
            unit=torque_unit(name in arm.robot.slides),
            is_norm=True,
            choices=count,
        )
        for side, other in zip(NEIGHBOURS, (joint - 1, joint + 1)):
            if 0 <= other < len(torque):
                yield Explanation(
                    "crosstalk",
                    effect(
                        [side], 0.1 * min(1.0, torque[joint] / torque[other]), joint
                    ),
                    f"the torque of joint {name} holds {{value}} of that of joint "
                    f"{arm.joints[other]}{{|, with the opposite sign}}",
                    "calibrate its sensor",
                    factor=100.0,
                    unit="%",
                )


def is_within(largest: float, values: Array, errors: Array) -> bool:
    """Return whether no value is larger than one that exists."""
    return bool(np.max(np.abs(values)) < largest)
