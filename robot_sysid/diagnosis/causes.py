"""What may be wrong with a log or its model: each cause is an effect on the fit's own columns.

Most causes have columns in every fit: a scale of torques, a zero, a tilt, a body. The others get
theirs from ``beside``, in the same rows. Where a cause acts at one joint, in one log or more and
more, its effect says so, and needs no column of its own. To add a cause, add a function to
``explanations`` that takes a fit and yields them.

Throughout, m is the number of rows of a chunk, J that of joints, B that of blocks.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from robot_sysid.dynamics.friction import COULOMB, OFFSET
from robot_sysid.dynamics.inverse_dynamics import (
    TILT_NAMES,
    LinksMotion,
    gravity_vector,
)
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.offers import Effect, Offer
from robot_sysid.estimate.rows import Rows
from robot_sysid.estimate.terms import PAYLOAD_NAMES, SCALES, Point, Term
from robot_sysid.records import Array
from robot_sysid.records.levels import CLEAR, UNEXPLAINED
from robot_sysid.records.messages import Level, position_unit, torque_unit, with_error
from robot_sysid.records.parameters import SCALE, ZERO, Parameter
from robot_sysid.spatial import PARAMETER_NAMES, parameter_scale
from robot_sysid.wording import option_name

INERTIAL = "inertia"
"""Name of the column of the links' torque without their weight."""
TIME = 0.5
"""Relative error of time per relative change of inertial torque: accelerations and squared speeds
are too small by twice the share by which time stamps are too long."""
WEIGHT = "weight"
"""Name of the column of the links' weight."""
SPRING = ("position", "sine of position", "cosine of position")
HUM = ("cosine of time", "sine of time")
NEIGHBOURS = ("torque of joint before", "torque of joint after")
LAST_WEIGHT = tuple(f"weight of last {name}" for name in PARAMETER_NAMES[:4])
FORCE = tuple(f"force {axis} {name}" for name in PARAMETER_NAMES[:4] for axis in "xyz")
SHAPES = ("force", "contact", "crosstalk")
"""Checks whose causes at one joint are torque of any shape."""
# Numbers of units that are no SI units.
_UNITS = {"%": 100.0, "ms": 1e3, "degrees": np.degrees(1.0)}
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
        unit: of the number [SI without one].
        level: level of the finding, where a result without the explanation would be wrong.
        sizes: least and largest number that exists.
        is_norm: whether the number is the Euclidean norm of the first three values, not the first.
        factor: the number is the value times it.
        relative_error: of the number, beside the standard error of the fit.
        choices: number of similar explanations that are tried, of which only the best one counts.
        log: name of the only log in which it acts; "" for all.
    """

    check: str
    effect: Effect
    text: str
    remedy: str = ""
    unit: str = ""
    level: Level = Level.DOUBTS
    sizes: tuple[float, float] = (-np.inf, np.inf)
    is_norm: bool = False
    factor: float = 1.0
    relative_error: float = 0.0
    choices: int = 1
    log: str = ""

    @property
    def subject(self) -> tuple[str, str, str]:
        """The check, the words and the log; a finding names each subject once."""
        return self.check, self.text.partition("{instant}")[0], self.log

    @property
    def is_shape(self) -> bool:
        """Whether it is torque of a shape at one joint, which may stand for other terms."""
        return self.check in SHAPES and self.effect.joint is not None


@dataclass(frozen=True)
class Score:
    """An explanation, and what a fit says of it.

    Attributes:
        explanation: the fault.
        offer: its values, and what it leaves.
        gain: of the offer, minus the log of ``Explanation.choices``.
        fitted: the fit that it was offered to.
        distance: its value in its own errors; zero where it is of no size that exists.
        level: the explanation's where an estimate that ignores it would be wrong, else SAYS.
        is_reportable: whether it explains enough for a finding.
        text, remedy: of the explanation, with the number.
    """

    explanation: Explanation
    offer: Offer
    gain: float
    fitted: Fit
    distance: float
    level: Level
    is_reportable: bool
    text: str
    remedy: str


def scored(
    explanation: Explanation, offer: Offer, gain: float, fitted: Fit, errors: Array
) -> Score:
    """Return what a fit says of an explanation.

    Args:
        explanation, offer, gain, fitted: as in ``Score``.
        errors: standard errors (10,) of what was asked, as they are printed.
    """
    value, *_ = offer.values.tolist()
    error, *_ = offer.errors.tolist()
    if explanation.is_norm:
        value = float(np.linalg.norm(offer.values[:3]))
        error = float(np.max(offer.errors[:3]))
    least, largest = explanation.sizes
    distance = abs(value) / max(error, 1e-300)
    # What has no single number is judged by all its values.
    if explanation.is_norm or "{value}" not in explanation.text:
        distance = offer.distance
    # The torque that is left unexplained without it only, as a share of all torque.
    sums = fitted.sums
    left = np.maximum(offer.successive, 0.0) / sums.row_counts
    explained = np.sum(np.maximum(fitted.unexplained**2 - left, 0.0))
    share = np.sqrt(explained / np.sum(sums.rms_torque**2))
    # What was asked may change by more than a standard error. Other terms take less for a shape.
    change = np.abs(offer.change[fitted.at(asked(fitted))])
    is_harmful = share > (0.015 if explanation.is_shape else UNEXPLAINED)
    # An arm that is compared with its model is asked for no link: only its torques count.
    is_of_link = not explanation.is_shape and fitted.question.differing is None
    is_harmful |= is_of_link and np.any(change > errors)
    level = explanation.level if is_harmful else Level.SAYS
    is_of_log = explanation.effect.joint is None
    is_of_log &= explanation.level is not Level.SAYS
    # What is as clear as this is noted however small it is.
    is_clear = gain > 3.0 * CLEAR
    is_large = level is not Level.SAYS or share > 0.005
    size = explanation.factor * _UNITS.get(explanation.unit, 1.0)
    error = math.hypot(error, explanation.relative_error * value)
    number = with_error(size * abs(value), size * error, explanation.unit)
    # Values of other causes, which do not show it, may be below -1.
    inverse = f"{max(1.0 + value, 1e-9) ** -0.5:.3g}"
    sentences = []
    for template in (explanation.text, explanation.remedy):
        words = _BY_SIGN.sub(r"\1" if value > 0.0 else r"\2", template)
        sentences.append(words.replace("{value}", number).replace("{inverse}", inverse))
    text, remedy = sentences
    return Score(
        explanation,
        offer,
        gain,
        fitted,
        distance if least < value < largest else 0.0,
        level,
        is_of_log or is_clear or is_large,
        f"in {explanation.log}, {text}" if explanation.log else text,
        remedy,
    )


def asked(fitted: Fit) -> Sequence[str]:
    """Return the names of the ten parameters that are asked for."""
    return PAYLOAD_NAMES if fitted.question.loaded else PARAMETER_NAMES


# ---- columns beside those of a fit


def beside(fitted: Fit) -> list[Term]:
    """Return the terms whose columns causes need, beside those of every fit."""
    arm = fitted.arm
    robot = arm.robot
    recordings = fitted.recordings
    time = np.concatenate([recording.motion.time for recording in recordings])
    first = np.min(time)
    residuals = np.nan_to_num(fitted.residuals)
    rates = [strongest_rate(time - first, residual) for residual in residuals.T]

    def of_last(moves: LinksMotion) -> Array:
        """Return the torque (m, J, 4) of the last link's mass and first moments, one each."""
        return moves.columns([robot.n_joints - 1])[:, arm.indices, :4]

    def columns(rows: Rows, point: Point) -> Array:
        """Return the columns (m, J, 25): each cause's own, in the order of the names."""
        moves = rows.at_rest(robot, point.gravity)
        weight = moves.torque(point.carried(rows.is_loaded))[:, arm.indices]
        torque = arm.links_torque(rows, point)
        # The weight of one kilogram under a gravity of one along an axis stands for a unit force.
        forces = np.stack([of_last(rows.at_rest(robot, axis)) for axis in -np.eye(3)])
        own = rows.motion.q[:, arm.indices]
        # Waves at each joint's own rate.
        phases = np.outer(rows.motion.time - first, rates)
        beside = [torque @ np.eye(len(rates), k=side) for side in (1, -1)]
        return np.dstack(
            (
                torque - weight,
                weight,
                of_last(moves),
                *np.moveaxis(forces, -1, 0).reshape(len(FORCE), *own.shape),
                own,
                np.sin(own),
                np.cos(own),
                np.cos(phases),
                np.sin(phases),
                *beside,
            )
        )

    names = (INERTIAL, WEIGHT, *LAST_WEIGHT, *FORCE, *SPRING, *HUM, *NEIGHBOURS)
    return [Term("", tuple(map(Parameter, names)), columns)]


def strongest_rate(time: Array, residual: Array) -> float:
    """Return the rate of the strongest sine in a residual (K,) at times (K,) [rad/s].

    From 2 periods per log on, in steps of a quarter of a period, by a Fourier transform of the
    residual on an even grid.
    """
    step = max(np.median(np.diff(time)), 1e-9)
    grid = np.bincount(np.rint(time / step).astype(int), residual)
    size = 4 * len(grid)
    spectrum = np.abs(np.fft.rfft(grid, size))[: int(0.4 * size)]
    return float(2.0 * np.pi * (8 + np.argmax(spectrum[8:])) / (size * step))


def typical_torque(fitted: Fit) -> Array:
    """Return the root mean square torque (J,), at least 2 % of the largest [N m]."""
    torque = fitted.sums.rms_torque
    return np.maximum(torque, 0.02 * np.max(torque))


# ---- explanations


def explanations(fitted: Fit) -> list[Explanation]:
    """Return all explanations for a fit that has the columns of ``beside``."""
    every = [*of_arm(fitted), *of_joints(fitted), *over_time(fitted)]
    logs = dict.fromkeys(fitted.sums.logs)
    in_logs = []
    for each, log in product(every, logs if len(logs) > 1 else ()):
        own = each.effect.shares
        shares = fitted.sums.is_of(log) * (1.0 if own is None else own)
        acting = replace(each.effect, shares=shares)
        in_logs.append(replace(each, effect=acting, log=log))
    return [*every, *in_logs, *changes_of_load(fitted), *changes_of_joints(fitted)]


def effect(
    names: Sequence[str],
    spread: Any,
    joint: int | None = None,
    shares: Array | None = None,
) -> Effect:
    """Return the effect of columns with independent prior standard deviations."""
    factor = np.diag(np.broadcast_to(spread, len(names)))
    return Effect(tuple(names), factor, joint, shares)


CLOCK = effect([INERTIAL], 0.2)
"""The effect of time stamps that are all too long or too short."""


def of_arm(fitted: Fit) -> Iterator[Explanation]:
    """Yield errors of the base, of gears and of the torque as a whole, and forces on the last link.

    The weight of the last link is free beside that of a balancer: its mass and first moments.
    """
    arm = fitted.arm
    if "load" in arm.terms:
        loads = arm.terms["load"].names
        yield Explanation(
            "friction",
            Effect(loads, np.full((len(loads), 1), 0.15)),
            "every gear loses {value} of its load, which no model file can hold: friction in the "
            "file is right at this load alone",
            unit="%",
            level=Level.SAYS,
            sizes=(0.0, 0.5),
        )
    if arm.has_gravity:
        yield Explanation(
            "tilt",
            effect(TILT_NAMES, 0.15),
            "the base is tilted by {value} against the model's",
            "level it, or turn the base in the model",
            "degrees",
            is_norm=True,
        )
    yield Explanation(
        "computed",
        effect([INERTIAL], 1.0),
        "the torque holds the links' weight and lacks {value} of their inertia: it is that of a "
        "controller's model, or of an arm that is guided by hand",
        "record the measured joint torque of an arm that its motors move",
        "%",
        sizes=(-1.2, -0.8),
    )
    yield Explanation(
        "clock",
        CLOCK,
        "time in the log is {value} too {long, or a balancer carries a part of the weight|short}, "
        "as the torque of inertia shows beside that of gravity",
        "record the controller's own time stamps, or scale these with a line in "
        f"{option_name('columns', 'FILE')}: time = {{inverse}} * TITLE",
        "%",
        # Beyond it, torque lacks inertia.
        sizes=(-0.8, 0.8),
        factor=TIME,
    )
    total = arm.robot.mass
    down = float(np.linalg.norm(gravity_vector(arm.robot))) or 9.81
    yield Explanation(
        "force",
        effect(FORCE, total * down * np.repeat((0.1, 0.01), (3, 9))),
        "a constant force of {value} acts on the last link, as of a hand, a cable or a spring",
        "take it away, and record again",
        "N",
        Level.REFUSES,
        is_norm=True,
    )
    load = parameter_scale(0.1 * total, 0.1)[:4]
    yield Explanation(
        "force",
        effect(LAST_WEIGHT, load),
        "the last link weighs {value} {more|less} than its inertia says: a hand, a hose or a "
        "support holds a part of it or draws at it",
        "take it away, and record again",
        "kg",
        Level.REFUSES,
    )
    yield Explanation(
        "gravity",
        effect((WEIGHT, *LAST_WEIGHT), np.append(0.5, load)),
        "{value} of the links' weight is missing from the torque: a spring balancer that the model "
        "lacks, or gravity that is compensated in part",
        "record the measured joint torque, not the command",
        "%",
        Level.REFUSES,
        sizes=(-1.2, -0.05),
    )


def of_joints(fitted: Fit) -> Iterator[Explanation]:
    """Yield errors of each joint's sensors, and torque that is none of the joint's motion."""
    joints = fitted.arm.joints
    torque = typical_torque(fitted)
    for joint, name in enumerate(joints):
        is_slide = name in fitted.arm.robot.slides
        yield Explanation(
            "torque-scale",
            effect([SCALE.key_of(name)], 0.4, joint),
            f"torque of joint {name} reads {{value}} too {{much|little}} for the model's links, or "
            "the links that it carries are {heavier|lighter} than in the model",
            f"weigh a known mass ({option_name('known_mass')} of payload), and pass the file that "
            f"it writes as {option_name('torque_scale')}",
            "%",
            sizes=(-0.5, np.inf),
        )
        yield Explanation(
            "zero",
            effect([ZERO.key_of(name)], 0.1),
            f"the position of joint {name} reads {{value}} too {{much|little}}",
            "correct the joint's zero",
            position_unit(is_slide),
        )
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
                sizes=(0.0, largest),
                is_norm=True,
            )
        yield Explanation(
            "contact",
            effect(HUM, 0.1 * torque[joint], joint),
            f"torque of joint {name} hums: a sine of {{value}} that neither motion nor friction "
            "makes",
            "find its source",
            torque_unit(is_slide),
            is_norm=True,
            choices=sum(map(len, fitted.recordings)),
        )
        for side, other in zip(NEIGHBOURS, (joint - 1, joint + 1)):
            if 0 <= other < len(torque):
                ratio = min(1.0, torque[joint] / torque[other])
                yield Explanation(
                    "crosstalk",
                    effect([side], 0.1 * ratio, joint),
                    f"the torque of joint {name} holds {{value}} of that of joint "
                    f"{joints[other]}{{|, with the opposite sign}}",
                    "calibrate its sensor",
                    "%",
                )


def over_time(fitted: Fit) -> Iterator[Explanation]:
    """Yield delays, and what changes over a log: scales, the clock, friction."""
    joints = fitted.arm.joints
    logs = fitted.sums.logs
    # The time of each block, from -1/2 to 1/2: each log has as many.
    count = logs.count(logs[0])
    along = np.tile(np.arange(0.5, count) / count - 0.5, len(logs) // count)
    terms = fitted.arm.terms
    scales = terms[SCALES].names
    owners: dict[str, int | None] = {f"joint {n}": k for k, n in enumerate(joints)}
    for owner, joint in {**owners, "all joints": None}.items():
        yield Explanation(
            "delay",
            effect(["delay"], 0.04, joint),
            f"torque of {owner} is {{value}} {{later|earlier}} than position",
            "record torques and positions of all joints at the same instant",
            "ms",
            # Torques change in proportion to delays that are no longer.
            sizes=(-0.15, 0.15),
        )
        names = scales if joint is None else scales[joint : joint + 1]
        yield Explanation(
            "torque-scale",
            Effect(names, np.full((len(names), 1), 0.3), joint, along),
            f"the torque scale of {owner} {{rises|falls}} by {{value}} over the log",
            "let motors and sensors warm up, and record again",
            "%",
        )
    yield Explanation(
        "clock",
        effect([INERTIAL], 0.4, None, along),
        "the clock drifts, as the torque of inertia shows beside that of gravity: time stamps grow "
        "by {value} {more|less} at the end of the log than at its begin",
        "record the controller's own time stamps",
        "%",
        factor=TIME,
    )
    if "coulomb" in terms:
        names = terms["coulomb"].names + terms["viscous"].names
        spread = 0.6 * np.abs([fitted.by_name[name] for name in names])
        for shares, change in (
            (along, "changes over the log"),
            (None, "is not that of the other logs"),
        ):
            yield Explanation(
                "friction",
                effect(names, spread, None, shares),
                f"friction {change}",
                "let the arm warm up before it is recorded",
                level=Level.SAYS,
            )


def changes_of_load(fitted: Fit) -> Iterator[Explanation]:
    """Yield a change of what the last link carries, from each block on."""
    robot = fitted.arm.robot
    logs = fitted.sums.logs
    blocks = np.arange(len(logs))
    spread = parameter_scale(0.05 * robot.mass, 0.1 * robot.length)
    # Torque scales multiply the load, too.
    scales = fitted.arm.terms[SCALES].names
    errors = [fitted.error_of(name) for name in scales if name in fitted.names]
    error = max(errors, default=0.0)
    for first in blocks[1:].tolist():
        if logs[first] == logs[first - 1]:
            after = fitted.sums.is_of(logs[first]) & (blocks >= first)
            yield Explanation(
                "payload-step",
                effect(PARAMETER_NAMES, spread, None, after.astype(float)),
                "from about {instant} on the last link carries {value} {more|less}: something was "
                "picked up, dropped or moved",
                "record each state in a log of its own",
                "kg",
                Level.REFUSES,
                relative_error=error,
                choices=len(blocks),
            )


def changes_of_joints(fitted: Fit) -> Iterator[Explanation]:
    """Yield what begins at a joint in the middle of a log, of an arm that is compared with a model.

    Such a log is a single run: a cable that catches, a brake, a motor that gets weaker.
    """
    if fitted.question.differing is None:
        return
    joints = fitted.arm.joints
    logs = fitted.sums.logs
    blocks = np.arange(len(logs))
    strongest = float(np.max(fitted.sums.rms_torque))
    terms = fitted.arm.terms
    scales = terms[SCALES].names
    since = "from a moment of the run on"
    for first in blocks[1:].tolist():
        if logs[first] != logs[first - 1]:
            continue
        is_after = fitted.sums.is_of(logs[first]) & (blocks >= first)
        after = is_after.astype(float)
        yield Explanation(
            "torque-scale",
            Effect(scales, np.full((len(scales), 1), 0.3), None, after),
            f"{since}, the torque of all joints reads {{value}} {{more|less}}",
            "look after the motors' supply and temperature",
            "%",
            choices=len(blocks),
        )
        for joint, name in enumerate(joints):
            unit = torque_unit(name in fitted.arm.robot.slides)
            yield Explanation(
                "torque-scale",
                effect([SCALE.key_of(name)], 0.4, joint, after),
                f"{since}, the torque of {name} reads {{value}} {{more|less}} for what it moves",
                "look after the joint's motor",
                "%",
                choices=len(blocks),
            )
            yield Explanation(
                "force",
                effect([OFFSET.key_of(name)], 0.5 * strongest, joint, after),
                f"{since}, a constant torque of {{value}} acts at {name}, as of a cable or a hose",
                "take it away",
                unit,
                Level.REFUSES,
                choices=len(blocks),
            )
            yield Explanation(
                "friction",
                effect([COULOMB.key_of(name)], 0.5 * strongest, joint, after),
                f"{since}, the dry friction of {name} is {{value}} {{higher|lower}}",
                "look after its brake and gear",
                unit,
                choices=len(blocks),
            )
