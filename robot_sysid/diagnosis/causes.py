"""What may be wrong with a log or its model: each cause is an effect on the fit's own columns.

Most causes have columns in every fit: a scale of torques, a zero, a tilt, a body. The others get
theirs from ``beside``, in the same rows. Where a cause acts at one joint, in one log or more and
more, its effect says so, and needs no column of its own. To add a cause, add a function to
``explanations`` that takes a fit and yields them.

Throughout, m is the number of rows of a chunk, J that of joints, B that of blocks.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import TILT_NAMES, gravity_vector
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.offers import Effect, Offer
from robot_sysid.estimate.rows import Rows
from robot_sysid.estimate.terms import SCALES, ArmTerms, Point, Term
from robot_sysid.records import Array
from robot_sysid.records.messages import Level, position_unit, torque_unit, with_error
from robot_sysid.records.parameters import SCALE, ZERO, Parameter
from robot_sysid.spatial import PARAMETER_NAMES, parameter_scale
from robot_sysid.wording import option_name

INERTIAL = "inertial torque"
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
        factor: the number is the first value times it.
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

    def number(self, offer: Offer) -> tuple[float, float]:
        """Return the number that an offer gives, and its standard error."""
        value = float(offer.values[0])
        error = float(offer.errors[0])
        if self.is_norm:
            value = float(np.linalg.norm(offer.values[:3]))
            error = float(np.max(offer.errors[:3]))
        return self.factor * value, self.factor * error

    def distance(self, offer: Offer) -> float:
        """Return an offer's number in its own errors; zero where it is of no size that exists."""
        value, error = self.number(offer)
        least, largest = self.sizes
        if not least < value < largest:
            return 0.0
        # What has no single number is judged by all its values.
        if self.is_norm or "{value}" not in self.text:
            return offer.distance
        return abs(value) / max(error, 1e-300)

    def describe(self, offer: Offer) -> tuple[str, str]:
        """Return (text, remedy) with the number of an offer."""
        value, error = self.number(offer)
        size = _UNITS.get(self.unit, 1.0)
        error = size * float(np.hypot(error, self.relative_error * value))
        number = with_error(size * abs(value), error, self.unit)

        def fill_in(template: str) -> str:
            """Return a text with the number and the words for its sign."""
            words = _BY_SIGN.sub(r"\1" if value > 0.0 else r"\2", template)
            # Values of other causes, which do not show it, may be below -1.
            inverse = f"{max(1.0 + offer.values[0], 1e-9) ** -0.5:.3g}"
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
    return [
        Term("", tuple(map(Parameter, names)), make) for names, make in columns.items()
    ]


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


def weight(arm: ArmTerms, rows: Rows, point: Point) -> Array:
    """Return the torque (m, J) of the weight of the point's links [N m]."""
    moves = rows.at_rest(arm.robot, point.gravity)
    return moves.torque(point.carried(rows.is_loaded))[:, arm.indices]


def last_weight(arm: ArmTerms, rows: Rows, gravity: Array) -> Array:
    """Return the torque (m, J, 4) of the last link's weight, per unit of mass and first moments."""
    moves = rows.at_rest(arm.robot, gravity)
    return moves.columns([arm.robot.n_joints - 1])[:, arm.indices, :4]


def typical_torque(fitted: Fit) -> Array:
    """Return the root mean square torque (J,), at least 2 % of the largest [N m]."""
    torque = fitted.sums.rms_torque
    return np.maximum(torque, 0.02 * np.max(torque))


# ---- explanations


def explanations(fitted: Fit) -> list[Explanation]:
    """Return all explanations for a fit that has the columns of ``beside``."""
    every = [*of_arm(fitted), *of_joints(fitted), *over_time(fitted)]
    logs = dict.fromkeys(fitted.sums.logs)
    if len(logs) > 1:
        every += [each.in_log(fitted, log) for each in every for log in logs]
    return [*every, *changes_of_load(fitted)]


def effect(
    names: Sequence[str],
    spread: Any,
    joint: int | None = None,
    shares: Array | None = None,
) -> Effect:
    """Return the effect of columns with independent prior standard deviations."""
    factor = np.diag(np.broadcast_to(spread, len(names)))
    return Effect(tuple(names), factor, joint, shares)


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
        effect([INERTIAL], 0.2),
        "time in the log is {value} too {long, or a balancer carries a part of the weight|short}, "
        "as the torque of inertia shows beside that of gravity",
        "record the controller's own time stamps, or scale these with a line in "
        f"{option_name('columns', 'FILE')}: time = {{inverse}} * TITLE",
        "%",
        # Beyond it, torque lacks inertia.
        sizes=(-0.4, 0.4),
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
    arm = fitted.arm
    joints = arm.joints
    torque = typical_torque(fitted)
    for joint, name in enumerate(joints):
        is_slide = name in arm.robot.slides
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
    # The time of each block, from -1/2 to 1/2.
    along = np.zeros(len(fitted.sums.logs))
    for log in dict.fromkeys(fitted.sums.logs):
        own = np.flatnonzero(fitted.sums.is_of(log))
        along[own] = (np.arange(len(own)) + 0.5) / len(own) - 0.5
    scales = fitted.arm.terms[SCALES].names
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
    if "coulomb" in fitted.arm.terms:
        dry = fitted.arm.terms["coulomb"].names
        sizes = np.abs([fitted.by_name[name] for name in dry])
        least = 0.01 * typical_torque(fitted)
        yield Explanation(
            "friction",
            effect(dry, 0.6 * np.maximum(sizes, least), None, along),
            "friction changes over the log",
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
