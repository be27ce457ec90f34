"""What may be wrong with a log or its model: each cause is a term with a wide prior.

A term either has columns of its own, or widens the prior of parameters that every fit has. To add a
cause, add a function to ``CAUSES`` that takes the fit of a log and yields explanations.

Throughout, m is the number of rows of a part, J that of joints, e that of a cause's parameters. In
texts {value} stands for the number with its error, {joint} for the joint's name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from robot_sysid.diagnosis import Level
from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.equations import link_names, names_of
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics, gravity_vector
from robot_sysid.dynamics.spatial import parameter_scale
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.links import link_factor, link_lengths
from robot_sysid.estimate.questions import is_stated
from robot_sysid.estimate.rows import Part
from robot_sysid.estimate.terms import (
    DELAY,
    SCALES,
    TILT,
    ZEROS,
    ArmTerms,
    Point,
    Prior,
    Term,
    independent,
)
from robot_sysid.records import Array
from robot_sysid.records.messages import percent, with_error

STEPS = 15
"""Number of evenly spaced instants at which a change of payload is tried."""
RIPPLES = tuple(range(4, 41))
"""Numbers of torque waves per turn of a joint that are tried."""
GROSS_ZERO = 0.05
"""Error of a joint's zero position from which it is harmful in any case [rad]."""
LARGEST_STRETCH = 0.3
"""Largest relative error of positions that changes torques in proportion."""
LONGEST_DELAY = 0.15
"""Longest delay that changes torques in proportion [s]."""
WARM_UP = (10.0, 30.0, 100.0)
"""Time constants over which friction falls as a gear warms up [s]."""
OTHER_LINK = 0.5
"""Prior standard deviation of a link that the model has wrong, as a share of it."""
Values = Callable[[Array, Array], str]
"""Function that returns the user's text from values (e,) and standard errors (e,)."""
Column = Callable[[Part, Point], Array]
"""Function that returns a torque (m, J) or (m, J, e) of a part around a point [N m]."""


@dataclass(frozen=True)
class Explanation:
    """One fault that a log or its model may have.

    Attributes:
        term: its parameters and prior. The cause is the name of the check that reports it, a key of
            ``logs.CHECKS``; the text is the fault and what to do, with {value}.
        level: severity of the finding, where a result without the explanation would be wrong.
        joint: index of the joint that it acts on; None for all.
        factor, unit, shift: the number in the text is (first value + shift) factor.
        is_norm: whether the number is the Euclidean norm of the values, not the first one.
        words: returns the text where it takes more than one number.
        choices: number of similar explanations that are tried, of which only the best one counts.
        is_possible: whether values (e,) with standard errors (e,) fit the text.
        harmful_from: size of the first value from which it is harmful in any case.
        nearby: returns similar explanations to try where this one wins.
    """

    term: Term
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
            value = float(np.linalg.norm(values))
            error = float(np.max(errors))
        number = with_error(
            self.factor * (value + self.shift), abs(self.factor) * error, self.unit
        )
        return self.term.text.replace("{value}", number)


def new_term(
    check: str, text: str, key: str, columns: Column, spread: Any, **fields: Any
) -> Explanation:
    """Return an explanation with columns of its own, (m, J) for one or (m, J, e).

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

    def stacked(part: Part, point: Point) -> Array:
        """Return the columns (m, J, e)."""
        torque = columns(part, point)
        return torque if torque.ndim == 3 else torque[:, :, None]

    term = Term(check, names, stacked, independent(deviations), text=text)
    return Explanation(term, **fields)


def widened(
    check: str, text: str, arm: ArmTerms, key: str, spread: Any, **fields: Any
) -> Iterator[Explanation]:
    """Yield explanations that widen the prior of parameters that every fit of the arm has.

    One for each parameter of a term of one parameter per joint; else one for all of the term's.

    Args:
        check: name of the check.
        text: see ``Explanation.term``.
        arm: all terms.
        key: of the term in ``arm.terms``.
        spread: prior standard deviation of each parameter.
        fields: of the explanations.
    """
    if key not in arm.terms:
        return
    term = arm.terms[key]
    for joint, name in enumerate(arm.joints):
        if term.names[0].endswith("]"):
            (own,) = (n for n in term.names if n.endswith(f"[{name}]"))
            single = Term(check, (own,), term.columns, independent([spread]))
            text_of_joint = text.replace("{joint}", name)
            yield Explanation(
                Term(check, (own,), single.columns, single.prior, text=text_of_joint),
                joint=joint,
                **fields,
            )
    if not term.names[0].endswith("]"):
        prior = independent(np.full(len(term.names), spread))
        yield Explanation(
            Term(check, term.names, term.columns, prior, text=text), **fields
        )


def of_joint(columns: Column, joint: int, source: int | None = None) -> Column:
    """Return a torque (m, J) that acts at one joint: that of this joint, or of a ``source``."""

    def masked(part: Part, point: Point) -> Array:
        """Return the torque (m, J)."""
        torque = np.asarray(columns(part, point))
        moved = np.zeros_like(torque)
        moved[:, joint] = torque[:, joint if source is None else source]
        return moved

    return masked


def rigid(arm: ArmTerms, part: Part, point: Point) -> Array:
    """Return the torque (m, J) of the point's links [N m]."""
    thetas = point.carried(part.is_loaded)
    return part.links_torque(arm.robot, point.gravity, thetas)[:, arm.indices]


def resting(arm: ArmTerms, part: Part, point: Point) -> Array:
    """Return the torque (m, J) of the weight of the point's links [N m]."""
    q = part.motion.q
    still = np.zeros_like(q)
    moves = LinkDynamics(arm.robot, point.gravity).motion(q, still, still)
    return moves.torque(point.carried(part.is_loaded))[:, arm.indices]


def last_weight(
    arm: ArmTerms, part: Part, point: Point, gravity: Array | None = None
) -> Array:
    """Return the torque (m, J, 4) of the last link's weight, per unit of mass and first moments."""
    q = part.motion.q
    still = np.zeros_like(q)
    vector = point.gravity if gravity is None else gravity
    moves = LinkDynamics(arm.robot, vector).motion(q, still, still)
    return moves.columns([arm.robot.n_joints - 1])[:, arm.indices, :4]


def torque_scales(fitted: Fit) -> Iterator[Explanation]:
    """Yield an error of each joint's torque scale, then of all joints' common one.

    A common scale and links that are all too heavy make the same torques.
    """
    text = "torque of joint {joint} reads {value} what links and the other joints say; weigh a "
    text += "known mass (payload --known-mass) and pass the file that it writes as --torque-scale"
    yield from widened(
        "torque-scale", text, fitted.arm, SCALES, 0.3, unit="times", shift=1.0
    )
    text = (
        "torques are {value} what the model's links make: either the torques of all joints read "
        "that many times too much, or the masses of all links are that many times the model's; "
        "torques cannot tell these apart: weigh the arm, or a known mass (payload --known-mass)"
    )
    columns = partial(rigid, fitted.arm)
    yield new_term(
        "torque-scale",
        text,
        "all",
        columns,
        0.5,
        unit="times",
        shift=1.0,
        is_possible=lambda v, e: bool(v[0] > -0.5),
    )
    text = (
        "the torque has nothing of its motion but friction: this is an external torque, what is "
        "left after the controller's model; record the measured joint torque"
    )
    yield new_term(
        "gravity",
        text,
        "external",
        columns,
        0.5,
        level=Level.REFUSE,
        is_possible=lambda v, e: bool(-1.5 < v[0] < -0.5),
    )


def along(fitted: Fit, columns: Column) -> Column:
    """Return columns times the time, from -1 at the begin of the log to 1 at its end."""
    first = fitted.recordings[0].motion.time[0]
    last = fitted.recordings[-1].motion.time[-1]

    def drifting(part: Part, point: Point) -> Array:
        """Return the columns (m, J)."""
        time = (2.0 * part.motion.time - first - last) / (last - first)
        return np.asarray(columns(part, point)) * time[:, None]

    return drifting


def drifting_scales(fitted: Fit) -> Iterator[Explanation]:
    """Yield torque scales that drift over the log: of all joints alike, then of each."""
    text = "changes its scale by {value} over the log; let motors and sensors warm up, and record "
    text += "again"
    drifting = along(fitted, partial(rigid, fitted.arm))
    for joint, name in ((None, ""), *enumerate(fitted.arm.joints)):
        owner = "all joints" if joint is None else f"joint {name}"
        yield new_term(
            "torque-scale",
            f"the torque of {owner} {text}",
            f"drift {name}",
            drifting if joint is None else of_joint(drifting, joint),
            0.1 if joint is None else 0.15,
            joint=joint,
            # The time runs from -1 to 1.
            factor=200.0,
            unit="%",
        )


def zeros(fitted: Fit) -> Iterator[Explanation]:
    """Yield a constant error of each joint's position [rad]."""
    text = "the position of joint {joint} reads {value} too much; correct its zero"
    yield from widened(
        "zero", text, fitted.arm, ZEROS, 0.1, unit="rad", harmful_from=GROSS_ZERO
    )


def tilt(fitted: Fit) -> Iterator[Explanation]:
    """Yield a tilt of the base, by two angles [rad]; nothing where the model has no gravity."""
    text = (
        "the base is tilted by {value} against the model's; level it, or turn the model"
    )
    yield from widened(
        "tilt",
        text,
        fitted.arm,
        TILT,
        0.15,
        factor=float(np.degrees(1.0)),
        unit="degrees",
        is_norm=True,
    )


MOUNTED = (
    "gravity acts {value} from the model's: the base is mounted otherwise, on a wall or a ceiling; "
    'turn it in the model (MJCF: gravity="{gravity}" of <option>, or euler of the base\'s body; '
    "URDF: rpy of the first joint's origin)"
)
"""Text of the finding that the arm is mounted otherwise than the model says."""


def mounting_text(level: Array, gravity: Array, error: float) -> str:
    """Return the text on a gravity (3,) that is not the model's ``level`` [m/s^2]."""
    angle = turned_by(level, gravity)
    direction = np.linalg.norm(level) * gravity / np.linalg.norm(gravity)
    text = MOUNTED.replace(
        "{value}", with_error(float(np.degrees(angle)), np.degrees(error), "degrees")
    )
    numbers = " ".join(f"{value:.2f}" for value in direction + 0.0)
    return text.replace("{gravity}", numbers)


def turned_by(level: Array, gravity: Array) -> float:
    """Return the angle between two directions of gravity (3,) [rad]."""
    cosine = level @ gravity / (np.linalg.norm(level) * np.linalg.norm(gravity))
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def time_base(fitted: Fit) -> Iterator[Explanation]:
    """Yield errors of the time stamps' scale: a constant one, and one that also drifts.

    Time stamps that are too long by a small share s make accelerations and squared speeds too small
    by 2 s, so they change inertial torque alone.
    """
    arm = fitted.arm
    advice = "record the controller's own time stamps"

    def inertial(part: Part, point: Point) -> Array:
        """Return the torque (m, J) per unit of a constant error."""
        return 2.0 * (rigid(arm, part, point) - resting(arm, part, point))

    def both(part: Part, point: Point) -> Array:
        """Return the torque (m, J, 2) per unit of a constant error and its change to the end."""
        constant = inertial(part, point)
        return np.stack((constant, along(fitted, inertial)(part, point)), axis=-1)

    def describe_scale(v: Array, e: Array) -> str:
        """Return the text of a constant error v (1,) with standard error e (1,)."""
        return (
            f"by inertia beside gravity, time in the log is {_too_long(v[0])} "
            f"(\u00b1 {percent(float(e[0]))}); {advice}, or scale them with --columns FILE: "
            f"time = {1.0 / (1.0 + float(v[0])):.3g} * TITLE"
        )

    def describe_drift(v: Array, e: Array) -> str:
        """Return the text of an error that drifts, v (2,) with standard errors e (2,)."""
        return (
            f"by inertia beside gravity, the clock drifts: time is {_too_long(v[0] - v[1])} at "
            f"first, {_too_long(v[0] + v[1])} at the end; {advice}"
        )

    for columns, size, words in (
        (inertial, 1, describe_scale),
        (both, 2, describe_drift),
    ):
        yield new_term(
            "clock",
            "",
            f"{size}",
            columns,
            np.full(size, 0.1),
            words=words,
            harmful_from=0.0,
        )


def _too_long(share: float) -> str:
    """Return "3 % too long" for a share of 0.03, "3 % too short" for -0.03."""
    return f"{percent(abs(float(share)))} too {'long' if share > 0.0 else 'short'}"


def delays(fitted: Fit) -> Iterator[Explanation]:
    """Yield a lag of the torque behind the position [s]: of all joints alike, then of each one."""
    arm = fitted.arm
    number: dict[str, Any] = {
        "factor": 1e3,
        "unit": "ms",
        "is_possible": lambda v, e: abs(v[0]) < LONGEST_DELAY,
    }
    text = "torque lags position by {value}; record both at the same instant"
    yield from widened("delay", text, arm, DELAY, 0.04, **number)

    def late(part: Part, point: Point) -> Array:
        """Return the torque (m, J) per second of delay."""
        return arm.terms[DELAY].columns(part, point)[:, :, 0]

    for joint, name in enumerate(arm.joints):
        text = f"torque of joint {name} alone lags position by {{value}}; record all joints at once"
        columns = of_joint(late, joint)
        yield new_term("delay", text, name, columns, 0.04, joint=joint, **number)


def position_scales(fitted: Fit) -> Iterator[Explanation]:
    """Yield positions of one joint, or of all, that are a factor times the true ones."""
    arm = fitted.arm
    step = 1e-5

    def stretched(joints: list[int], part: Part, point: Point) -> Array:
        """Return the torque (m, J) per unit by which positions of some joints read too little."""
        sides = []
        for factor in (1.0 - step, 1.0 + step):
            scale = np.ones(arm.robot.n_joints)
            scale[joints] = factor
            motion = part.motion
            moves = LinkDynamics(arm.robot, point.gravity).motion(
                motion.q * scale, motion.qd * scale, motion.qdd * scale
            )
            sides.append(moves.torque(point.carried(part.is_loaded))[:, arm.indices])
        return (sides[1] - sides[0]) / (2.0 * step)

    for joint, name in ((None, ""), *enumerate(arm.robot.joint_names)):
        every = list(range(arm.robot.n_joints))
        owner = "all joints" if joint is None else f"joint {name}"
        text = (
            f"{owner} moved {{value}} as far as the positions say; in another unit, or "
        )
        text += "before a gear? put them right with --columns FILE"
        columns = partial(stretched, every if joint is None else [joint])
        yield new_term(
            "angle-unit",
            text,
            name,
            columns,
            0.2,
            joint=joint,
            unit="times",
            shift=1.0,
            harmful_from=0.0,
            is_possible=lambda v, e: bool(abs(v[0]) < LARGEST_STRETCH),
        )


def weight_share(fitted: Fit) -> Iterator[Explanation]:
    """Yield a share of the links' weight that is missing from the torque, as a balancer takes it.

    The weight of the last link is free beside it: its mass and first moments.
    """
    arm = fitted.arm
    text = "{value} of the links' weight is missing from the torque: is there a spring balancer "
    text += "that the model lacks, or is gravity compensated in part? record the measured joint "
    text += "torque, not the command"

    def columns(part: Part, point: Point) -> Array:
        """Return the torque (m, J, 5)."""
        weight = resting(arm, part, point)[:, :, None]
        return np.concatenate((weight, last_weight(arm, part, point)), axis=-1)

    def is_missing(v: Array, e: Array) -> bool:
        """Return whether the share v[0] lacks for sure, and no more than all of the weight."""
        return bool(-1.0 - 3.0 * e[0] < v[0] < -max(0.05, 2.0 * e[0]))

    spread = np.append(0.5, parameter_scale(0.1 * arm.robot.mass, 0.1)[:4])
    yield new_term(
        "gravity",
        text,
        "share",
        columns,
        spread,
        level=Level.REFUSE,
        factor=-100.0,
        unit="%",
        is_possible=is_missing,
    )


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
    last = [arm.robot.n_joints - 1]

    def columns(part: Part, point: Point) -> Array:
        """Return the torque (m, J, 10) per unit of the last link's parameters after the instant."""
        motion = part.motion
        key = "after", instant
        after = part.low_passed(key, lambda m: (m.time >= instant).astype(float))
        moves = LinkDynamics(arm.robot, point.gravity)
        torque = moves.motion(motion.q, motion.qd, motion.qdd).columns(last)
        return torque[:, arm.indices] * after[:, None, None]

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

    mass = 0.05 * arm.robot.mass
    spread = parameter_scale(mass, 0.1 * arm.robot.length)
    return new_term(
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
    """Yield a constant force on the last link, then a weight of it that contradicts its inertia."""
    arm = fitted.arm
    total = arm.robot.mass
    down = float(np.linalg.norm(gravity_vector(arm.robot))) or 9.81
    text = "a constant force of {value} acts on the last link, as of a hand, a cable or a spring; "
    text += "take it away, and record again"

    def pull(part: Part, point: Point) -> Array:
        """Return the torque (m, J, 12) of forces along three axes, and of their offsets."""
        # The weight of one kilogram under a gravity of one along an axis stands for a unit force.
        axes = [-last_weight(arm, part, point, axis) for axis in np.eye(3)]
        torque = np.stack(axes, axis=-1)
        return torque.reshape(*torque.shape[:2], 12)

    def is_sure(v: Array, e: Array) -> bool:
        """Return whether the force is larger than three times its standard error."""
        return bool(np.any(np.abs(v[:3]) > 3.0 * e[:3]))

    def describe(v: Array, e: Array) -> str:
        """Return the text for force and moments v (12,) with standard errors e (12,)."""
        force = with_error(float(np.linalg.norm(v[:3])), float(np.max(e[:3])), "N")
        return text.replace("{value}", force)

    spread = 0.1 * total * down * np.repeat((1.0, 0.1, 0.1, 0.1), 3)
    yield new_term(
        "force",
        text,
        "tip",
        pull,
        spread,
        level=Level.REFUSE,
        words=describe,
        is_possible=is_sure,
    )
    carried = "the last link weighs {value} more than its inertia says: something holds a part of "
    carried += "it, or pulls, as a hand or a hose does; take it away, record again"
    yield new_term(
        "force",
        carried,
        "weight",
        partial(last_weight, arm),
        parameter_scale(0.1 * total, 0.1)[:4],
        level=Level.REFUSE,
        unit="kg",
    )


def at_joint(arm: ArmTerms, joint: int, shapes: Callable[[Any], list[Array]]) -> Column:
    """Return the torque (m, J, e) of shapes (m,) of the motion that act at one joint."""

    def columns(part: Part, point: Point) -> Array:
        """Return the torque (m, J, e)."""
        stacked = np.stack(shapes(part.motion), axis=-1)
        torque = np.zeros((len(stacked), len(arm.joints), stacked.shape[-1]))
        torque[:, joint] = stacked
        return torque

    return columns


def springs(fitted: Fit) -> Iterator[Explanation]:
    """Yield a torque at each joint in its position q, sin q and cos q, as of a spring or hose."""
    arm = fitted.arm
    torque = typical_torque(fitted)
    for joint, name in enumerate(arm.joints):
        text = f"at joint {name} a torque follows the position, as of a spring, a balancer or a "
        text += "hose; the model has to have it, or take it away"
        k = arm.indices[joint]

        def shapes(motion: Any, k: int = k) -> list[Array]:
            """Return the shapes (m,) of a joint's position."""
            return [motion.q[:, k], np.sin(motion.q[:, k]), np.cos(motion.q[:, k])]

        yield new_term(
            "force",
            text,
            f"spring {name}",
            at_joint(arm, joint, shapes),
            np.full(3, 0.5 * torque[joint]),
            level=Level.REFUSE,
            joint=joint,
        )


def typical_torque(fitted: Fit) -> Array:
    """Return the root mean square torque (J,) of joints, at least 2 % of the strongest's [N m]."""
    counts = np.maximum(np.sum(fitted.sums.counts, axis=0), 1.0)
    torque = np.sqrt(np.sum(fitted.sums.squared_torque, axis=0) / counts)
    return np.asarray(np.maximum(torque, 0.02 * np.max(torque)))


def hums(fitted: Fit) -> Iterator[Explanation]:
    """Yield the strongest sine over time in each joint's residual torque.

    Rates from 2 periods per log to 0.4 periods per row are tried.
    """
    time = np.concatenate([r.motion.time for r in fitted.recordings])
    time = time - time[0]
    span = float(time[-1])
    step = float(np.median(np.diff(time)))
    rates = np.arange(2.0 / span, 0.4 / step, 0.25 / span)
    waves = np.exp(2j * np.pi * np.outer(rates, time))
    power = np.abs(waves @ np.nan_to_num(fitted.residuals())) ** 2
    for joint, name in enumerate(fitted.arm.joints):
        rate = float(rates[np.argmax(power[:, joint])])
        text = f"torque of joint {name} hums: a sine of {rate:.2g} Hz and {{value}} that neither "
        text += "motion nor friction makes; find its source"
        yield _wave(fitted, joint, "contact", text, 2.0 * np.pi * rate, len(rates))


def ripples(fitted: Fit) -> Iterator[Explanation]:
    """Yield each joint's strongest residual torque that is periodic in position, as of cogging."""
    q = np.concatenate([r.motion.q for r in fitted.recordings])
    residual = np.nan_to_num(fitted.residuals())
    for joint, name in enumerate(fitted.arm.joints):
        k = fitted.arm.indices[joint]
        waves = np.exp(1j * np.outer(q[:, k], RIPPLES))
        count = RIPPLES[int(np.argmax(np.abs(residual[:, joint] @ waves)))]
        text = f"torque of joint {name} ripples about {count} times per turn by {{value}}, as of "
        text += "cogging; errors count it as noise"
        yield _wave(fitted, joint, "ripple", text, count, len(RIPPLES))


def _wave(
    fitted: Fit, joint: int, check: str, text: str, rate: float, choices: int
) -> Explanation:
    """Return the explanation of a sine of any phase at one joint, in its position or in time."""
    k = fitted.arm.indices[joint]

    def shapes(motion: Any) -> list[Array]:
        """Return cosine and sine (m,)."""
        phase = rate * (motion.q[:, k] if check == "ripple" else motion.time)
        return [np.cos(phase), np.sin(phase)]

    return new_term(
        check,
        text,
        fitted.arm.joints[joint],
        at_joint(fitted.arm, joint, shapes),
        np.full(2, 0.1 * typical_torque(fitted)[joint]),
        level=Level.NOTE if check == "ripple" else Level.WARN,
        joint=joint,
        unit="N m",
        is_norm=True,
        choices=choices,
    )


def crosstalk(fitted: Fit) -> Iterator[Explanation]:
    """Yield torque sensors that also read a share of the torque of the joint before or after."""
    arm = fitted.arm
    torque = typical_torque(fitted)
    for joint, name in enumerate(arm.joints):
        for other in (joint - 1, joint + 1):
            if not 0 <= other < len(arm.joints):
                continue
            text = f"the torque of joint {name} holds {{value}} of that of joint "
            text += f"{arm.joints[other]}; calibrate its sensor"
            yield new_term(
                "crosstalk",
                text,
                f"{name} {other}",
                of_joint(partial(rigid, arm), joint, other),
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
    spread = 0.5 * np.maximum(np.abs(dry), 0.01 * typical_torque(fitted))
    text = "friction falls over the log; let the arm warm up before it is recorded"
    for constant in WARM_UP:

        def columns(part: Part, point: Point, constant: float = constant) -> Array:
            """Return the torque (m, J, J) of friction above that at the end."""
            decay = np.exp((first - part.motion.time) / constant)
            dry = arm.friction_column("coulomb", part, point) * decay[:, None]
            return dry[:, :, None] * np.eye(len(arm.joints))

        yield new_term(
            "friction",
            text,
            f"{constant}",
            columns,
            spread,
            level=Level.NOTE,
            choices=len(WARM_UP),
        )


def lost_load(fitted: Fit) -> Iterator[Explanation]:
    """Yield gears that lose more of their load than usual ones."""
    text = "the gear of joint {joint} loses {value} of its load, which no model file can hold; "
    text += "friction is right at this load alone"
    yield from widened(
        "friction",
        text,
        fitted.arm,
        "load",
        0.15,
        level=Level.NOTE,
        factor=100.0,
        unit="%",
        is_possible=lambda v, e: bool(0.0 < v[0] < 0.5),
    )


def wrong_links(fitted: Fit) -> Iterator[Explanation]:
    """Yield each link but the last as one that the model has wrong."""
    arm = fitted.arm
    stated = is_stated(arm) if arm.others else ()
    for link, is_known in zip(arm.others, stated):
        if not is_known:
            continue
        body = arm.robot.links[link]
        names = tuple(link_names(arm.robot, link))
        lengths = link_lengths(arm.robot, [link])
        prior = Prior(np.zeros(10), link_factor([body.theta], OTHER_LINK, lengths))

        def describe(v: Array, e: Array, link: int = link) -> str:
            """Return the text for the ten parameters v (10,) with standard errors e (10,)."""
            body = arm.robot.links[link]
            mass = with_error(float(v[0]), float(e[0]), "kg")
            old, new = (np.linalg.norm(theta[1:4]) for theta in (body.theta, v))
            return (
                f"link {body.body_name} is not as in the model: {mass} for {body.theta[0]:.3g} kg, "
                f"mass times distance of its centre {new:.3g} for {old:.3g} kg m"
            )

        columns = partial(arm._links, [link])
        term = Term("model", names, columns, prior)
        yield Explanation(term, level=Level.NOTE, joint=link, words=describe)


def wrong_inertias(fitted: Fit) -> Iterator[Explanation]:
    """Yield inertias of all links about their centres that are a factor times the model's."""
    arm = fitted.arm
    thetas = np.zeros_like(arm.robot.thetas)
    for link in arm.others:
        _, _, inertia = spatial.com_from_theta(arm.robot.thetas[link])
        thetas[link] = spatial.theta_from_com(0.0, np.zeros(3), inertia)

    def columns(part: Part, point: Point) -> Array:
        """Return the torque (m, J) of the inertias about centres of mass."""
        motion = part.motion
        moves = LinkDynamics(arm.robot, point.gravity).motion(
            motion.q, motion.qd, motion.qdd
        )
        return moves.torque(thetas)[:, arm.indices]

    text = "the links turn as if their inertias about their centres of mass were {value} those of "
    text += "the model: are they placeholders, or in another unit?"
    yield new_term(
        "model",
        text,
        "inertias",
        columns,
        2.0,
        level=Level.NOTE,
        unit="times",
        shift=1.0,
    )


CAUSES: tuple[Callable[[Fit], Iterator[Explanation]], ...] = (
    torque_scales,
    drifting_scales,
    zeros,
    tilt,
    time_base,
    delays,
    position_scales,
    weight_share,
    payload_steps,
    forces,
    springs,
    hums,
    ripples,
    crosstalk,
    warming,
    lost_load,
    wrong_links,
    wrong_inertias,
)
"""Functions that take the fit of a log and yield explanations."""


def explanations(fitted: Fit) -> list[Explanation]:
    """Return what all functions of ``CAUSES`` yield for the fit of a log."""
    return [explanation for cause in CAUSES for explanation in cause(fitted)]
