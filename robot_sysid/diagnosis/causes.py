"""What may be wrong with a log or its model: each cause is a term with a wide prior.

An error that every fit allows for, such as a joint's zero, has a second term here, with the same
columns and a wider prior. To add a cause, add a function to ``explanations`` that takes the fit of
a log and yields explanations.

Throughout, m is the number of rows of a chunk, J that of joints, e that of a cause's parameters.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

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
    SCALES,
    TILT,
    ZEROS,
    ArmTerms,
    Point,
    Term,
    independent,
)
from robot_sysid.records import Array
from robot_sysid.records.messages import Level, position_unit, torque_unit, with_error

STEPS = 15
"""Number of evenly spaced instants at which a change of payload is tried."""
RIPPLES = np.arange(4, 41)
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
Column = Callable[[Rows, Point], Array]
"""Function that returns a torque (m, J) or (m, J, e) of a chunk of rows around a point [N m]."""
# Words of a text for a positive number, and for a negative one.
_BY_SIGN = re.compile(r"\{([^|{}]*)\|([^|{}]*)\}")


@dataclass(frozen=True)
class Explanation:
    """One fault that a log or its model may have.

    In text and remedy {value} stands for the size of the number with its standard error,
    {more|less} for the word that its sign needs, and {inverse} for 1 / (1 + first value).

    Attributes:
        term: its parameters and prior. The cause is the name of the check that reports it, a key of
            ``logs.CHECKS``.
        text: the fault.
        remedy: what to do; "" for nothing.
        level: level of the finding, where a result without the explanation would be wrong.
        joint: index of the joint that it acts on; None for all.
        factor: the number in the text is the first value times it.
        unit: of the number.
        relative_error: of the number, beside the standard error of the fit.
        is_norm: whether the number is the Euclidean norm of the first three values, not the first.
        choices: number of similar explanations that are tried, of which only the best one counts.
        is_possible: whether values (e,) with standard errors (e,) fit the text.
        harmful_from: size of the first value from which it is harmful in any case.
        nearby: returns similar explanations to try where this one wins.
    """

    term: Term
    text: str
    remedy: str = ""
    level: Level = Level.DOUBTS
    joint: int | None = None
    factor: float = 1.0
    unit: str = ""
    relative_error: float = 0.0
    is_norm: bool = False
    choices: int = 1
    is_possible: Callable[[Array, Array], bool] = lambda values, errors: True
    harmful_from: float = np.inf
    nearby: Callable[[], list[Explanation]] = list

    @property
    def subject(self) -> tuple[str, int | None]:
        """The name of the check and the joint; a log's findings name each subject once."""
        return self.term.cause, self.joint

    def number(self, values: Array, errors: Array) -> tuple[float, float]:
        """Return the number of values (e,) with standard errors (e,), and its standard error."""
        if self.is_norm:
            return float(np.linalg.norm(values[:3])), np.max(errors[:3])
        return values[0], errors[0]

    def is_sure(self, values: Array, errors: Array) -> bool:
        """Return whether values (e,) are possible, and the stated number clearly not zero."""
        value, error = self.number(values, errors)
        is_clear = "{value}" not in self.text or abs(value) > SURE * error
        return is_clear and self.is_possible(values, errors)

    def describe(self, values: Array, errors: Array) -> tuple[str, str]:
        """Return (text, remedy) with values (e,) and standard errors (e,)."""
        value, error = self.number(values, errors)
        error = abs(self.factor) * np.hypot(error, self.relative_error * value)
        number = with_error(abs(self.factor * value), error, self.unit)

        def fill_in(template: str) -> str:
            """Return a text with the number and the words for its sign."""
            words = _BY_SIGN.sub(r"\1" if value > 0.0 else r"\2", template)
            inverse = f"{1.0 / (1.0 + value):.3g}"
            return words.replace("{value}", number).replace("{inverse}", inverse)

        return fill_in(self.text), fill_in(self.remedy)


def single(
    check: str,
    key: str,
    columns: Column,
    spread: Any,
    text: str,
    remedy: str = "",
    **fields: Any,
) -> Explanation:
    """Return an explanation of columns (m, J), or (m, J, e).

    Args:
        check: name of the check.
        key: tells the parameters' names from those of all others.
        columns: torque per unit of each parameter.
        spread: prior standard deviations, (e,) or one number.
        text: see ``Explanation``.
        remedy: see ``Explanation``.
        fields: other ones of the explanation.
    """
    deviations = np.atleast_1d(spread)
    names = tuple(f"{check} {key} {k}" for k in range(len(deviations)))

    def stacked(rows: Rows, point: Point) -> Array:
        """Return the columns (m, J, e)."""
        torque = columns(rows, point)
        return torque if torque.ndim == 3 else torque[:, :, None]

    term = Term(check, names, stacked, independent(deviations))
    return Explanation(term, text, remedy, **fields)


def per_joint(
    arm: ArmTerms,
    check: str,
    key: str,
    columns: Column,
    spread: float,
    text: str,
    remedy: str,
    has_common: bool = True,
    harmful_from: float = np.inf,
    **fields: Any,
) -> Iterator[Explanation]:
    """Yield an error that all joints have in common, if there are several, and that of each joint.

    Arguments are as in ``single``, but for these:

    Args:
        arm: all terms.
        columns: (m, J, J), per unit of each joint's error.
        text: has {owner} for the joint's name or "all joints".
        has_common: whether all joints may have the error in common.
        harmful_from: of the error of one joint.
    """

    def column(joint: int | None, rows: Rows, point: Point) -> Array:
        """Return the torque (m, J) per unit of one joint's error, or of a common one."""
        torque = columns(rows, point)
        return np.sum(torque, axis=2) if joint is None else torque[:, :, joint]

    owners: dict[str, int | None] = {}
    if has_common and len(arm.joints) > 1:
        owners["all joints"] = None
    for joint, name in enumerate(arm.joints):
        owners[f"joint {name}"] = joint
    for owner, number in owners.items():
        sentence = text.replace("{owner}", owner)
        fields["joint"] = number
        fields["harmful_from"] = np.inf if number is None else harmful_from
        own = partial(column, number)
        yield single(check, f"{key} {owner}", own, spread, sentence, remedy, **fields)


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


def span_of(fitted: Fit) -> tuple[float, float]:
    """Return the times of the first and of the last row of a log [s]."""
    return fitted.recordings[0].motion.time[0], fitted.recordings[-1].motion.time[-1]


def along(fitted: Fit, columns: Column) -> Column:
    """Return a torque (m, ...) times the time, from -1 at the begin of the log to 1 at its end."""
    first, last = span_of(fitted)

    def drifting(rows: Rows, point: Point) -> Array:
        """Return the torque (m, ...)."""
        time = (2.0 * rows.motion.time - first - last) / (last - first)
        return (columns(rows, point).T * time).T

    return drifting


def sensors(fitted: Fit) -> Iterator[Explanation]:
    """Yield errors of torque and position sensors: scales, their drift, zeros, delays, gears.

    A common scale and links that are all too heavy make the same torques.
    """
    arm = fitted.arm
    scales = arm.terms[SCALES].columns
    yield from per_joint(
        arm,
        "torque-scale",
        "",
        scales,
        0.4,
        "torque of {owner} reads {value} too {much|little} for the model's links, or the links "
        "that it carries are {heavier|lighter} than in the model",
        "weigh a known mass (--known-mass of payload), and pass the file that it writes as "
        "--torque-scale",
        factor=100.0,
        unit="%",
        is_possible=lambda v, e: v[0] > -0.5,
    )
    yield from per_joint(
        arm,
        "torque-scale",
        "drift",
        along(fitted, scales),
        0.15,
        "the torque scale of {owner} {rises|falls} by {value} over the log",
        "let motors and sensors warm up, and record again",
        # The time runs from -1 to 1.
        factor=200.0,
        unit="%",
    )
    for explanation in per_joint(
        arm,
        "zero",
        "",
        lambda rows, point: arm.terms[ZEROS].columns(rows, point)[:, :, arm.indices],
        0.1,
        "the position of {owner} reads {value} too {much|little}",
        "correct the joint's zero",
        has_common=False,
        harmful_from=GROSS_ZERO,
    ):
        unit = position_unit(arm.joints[explanation.joint or 0] in arm.robot.slides)
        yield replace(explanation, unit=unit)
    yield from per_joint(
        arm,
        "delay",
        "",
        lambda rows, point: (
            arm.terms[DELAY].columns(rows, point) * np.eye(len(arm.joints))
        ),
        0.04,
        "torque of {owner} is {value} {later|earlier} than position",
        "record torques and positions of all joints at the same instant",
        factor=1e3,
        unit="ms",
        is_possible=lambda v, e: abs(v[0]) < LONGEST_DELAY,
        harmful_from=GROSS_DELAY,
    )
    yield single(
        "friction",
        "load",
        partial(arm.friction_column, "load"),
        0.15,
        "every gear loses {value} of its load, which no model file can hold: friction in the file "
        "is right at this load alone",
        level=Level.SAYS,
        factor=100.0,
        unit="%",
        is_possible=lambda v, e: 0.0 < v[0] < 0.5,
    )


def tilt(fitted: Fit) -> Iterator[Explanation]:
    """Yield a tilt of the base, by two angles [rad]; nothing where the model has no gravity."""
    if TILT in fitted.arm.terms:
        yield single(
            "tilt",
            "",
            fitted.arm.terms[TILT].columns,
            np.full(2, 0.15),
            "the base is tilted by {value} against the model's",
            "level it, or turn the base in the model",
            factor=np.degrees(1.0),
            unit="degrees",
            is_norm=True,
        )


def time_base(fitted: Fit) -> Iterator[Explanation]:
    """Yield errors of the time stamps' scale: a constant one, and one that also drifts.

    Time stamps that are too long by a small share s make accelerations and squared speeds too small
    by 2 s, so they change inertial torque alone.
    """
    arm = fitted.arm
    own_stamps = "record the controller's own time stamps"

    def inertial(rows: Rows, point: Point) -> Array:
        """Return the torque (m, J) per unit of a constant error."""
        return 2.0 * (arm.links_torque(rows, point) - weight(arm, rows, point))

    def with_drift(rows: Rows, point: Point) -> Array:
        """Return the torque (m, J, 2) per unit of a change to the end, and of a constant error."""
        change = along(fitted, inertial)(rows, point)
        return np.stack((change, inertial(rows, point)), axis=-1)

    yield single(
        "clock",
        "",
        inertial,
        0.1,
        "time in the log is {value} too {long|short}, as the torque of inertia shows beside that "
        "of gravity",
        f"{own_stamps}, or scale these with a line in --columns FILE: "
        "time = {inverse} * TITLE",
        factor=100.0,
        unit="%",
        harmful_from=0.0,
    )
    yield single(
        "clock",
        "drift",
        with_drift,
        [0.1, 0.1],
        "the clock drifts, as the torque of inertia shows beside that of gravity: time stamps "
        "grow by {value} {more|less} at the end of the log than at its begin",
        own_stamps,
        # The time runs from -1 to 1.
        factor=200.0,
        unit="%",
        harmful_from=0.0,
    )


def payload_steps(fitted: Fit) -> Iterator[Explanation]:
    """Yield a change of the last link's load at each of ``STEPS`` evenly spaced instants."""
    instants, spacing = np.linspace(*span_of(fitted), STEPS + 2, retstep=True)
    for instant in instants[1:-1].tolist():
        yield payload_step(fitted, instant, spacing)


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

    def nearby() -> list[Explanation]:
        """Return steps at eleven instants around this one, a sixth of the spacing apart."""
        period = np.median(np.diff(fitted.recordings[0].motion.time))
        finer = spacing / 6.0
        if finer < 0.1 * period:
            return []
        instants = instant + finer * np.arange(-5, 6)
        return [payload_step(fitted, at, finer) for at in instants.tolist()]

    scales = fitted.at([n for n in fitted.names if n.startswith("scale[")])
    return single(
        "payload-step",
        f"{instant}",
        columns,
        parameter_scale(0.05 * arm.robot.mass, 0.1 * arm.robot.length),
        f"from about {instant:.3g} s on the last link carries {{value}} {{more|less}}: something "
        "was picked up, dropped or moved",
        "record each state in a log of its own",
        level=Level.REFUSES,
        unit="kg",
        # The torque scales multiply the load, too.
        relative_error=np.max(fitted.errors[scales], initial=0.0),
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

    def constant_force(rows: Rows, point: Point) -> Array:
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
        "tip",
        constant_force,
        total * down * np.repeat((0.1, 0.01), (3, 9)),
        "a constant force of {value} acts on the last link, as of a hand, a cable or a spring",
        "take it away, and record again",
        level=Level.REFUSES,
        is_possible=lambda v, e: np.any(np.abs(v[:3]) > 3.0 * e[:3]),
        unit="N",
        is_norm=True,
    )
    yield single(
        "force",
        "weight",
        lambda rows, point: last_weight(arm, rows, point.gravity),
        load,
        "the last link weighs {value} {more|less} than its inertia says: a hand, a hose or a "
        "support holds a part of it or draws at it",
        "take it away, and record again",
        level=Level.REFUSES,
        unit="kg",
    )
    yield single(
        "gravity",
        "share",
        share,
        np.append(0.5, load),
        "{value} of the links' weight is missing from the torque: a spring balancer that the model "
        "lacks, or gravity that is compensated in part",
        "record the measured joint torque, not the command",
        level=Level.REFUSES,
        factor=-100.0,
        unit="%",
        is_possible=lambda v, e: -1.0 - 3.0 * e[0] < v[0] < -max(0.05, SURE * e[0]),
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

    Of a hum and a ripple, the strongest sines in the joint's residual torque are tried: over time
    from 2 periods per log to 0.4 periods per row, over position with ``RIPPLES`` waves per turn.
    """
    arm = fitted.arm
    torque = typical_torque(fitted.sums)
    residual = np.nan_to_num(fitted.residuals())
    q = np.concatenate([recording.motion.q for recording in fitted.recordings])
    time = np.concatenate([recording.motion.time for recording in fitted.recordings])
    span = time[-1] - time[0]
    step = np.median(np.diff(time))
    rates = 2.0 * np.pi * np.arange(2.0 / span, 0.4 / step, 0.25 / span)
    in_time = np.abs(np.exp(1j * np.outer(rates, time)) @ residual)
    for joint, name in enumerate(arm.joints):
        yield single(
            "force",
            f"spring {name}",
            shapes_at(fitted, joint, spring),
            np.full(3, 0.5 * torque[joint]),
            f"at joint {name} a torque follows the position, as of a spring, a balancer or a hose",
            "take it away, or add it to the model",
            level=Level.REFUSES,
            joint=joint,
        )
        sine = partial(
            single,
            spread=np.full(2, 0.1 * torque[joint]),
            joint=joint,
            unit=torque_unit(name in arm.robot.slides),
            is_norm=True,
        )
        rate = rates[np.argmax(in_time[:, joint])]
        yield sine(
            "contact",
            name,
            shapes_at(fitted, joint, partial(waves, rate, True)),
            text=f"torque of joint {name} hums: a sine of {rate / (2.0 * np.pi):.2g} Hz and "
            "{value} that neither motion nor friction makes",
            remedy="find its source",
            choices=len(rates),
        )
        in_turn = np.exp(1j * np.outer(RIPPLES, q[:, arm.indices[joint]]))
        sizes = np.abs(in_turn @ residual[:, joint])
        for count in RIPPLES[np.argsort(sizes)[-LIKELY:]].tolist():
            yield sine(
                "ripple",
                f"{count} {name}",
                shapes_at(fitted, joint, partial(waves, count, False)),
                text=f"torque of joint {name} ripples about {count} times per turn by {{value}}, "
                "as of cogging; standard errors count it as noise",
                level=Level.SAYS,
                choices=len(RIPPLES),
            )


def waves(rate: float, in_time: bool, motion: Any, k: int) -> list[Array]:
    """Return cosine and sine (m,) of the time or a joint's position times a rate."""
    phase = rate * (motion.time if in_time else motion.q[:, k])
    return [np.cos(phase), np.sin(phase)]


def crosstalk(fitted: Fit) -> Iterator[Explanation]:
    """Yield torque sensors that also read a share of the torque of the joint before or after."""
    arm = fitted.arm
    torque = typical_torque(fitted.sums)

    def column(other: int, joint: int, rows: Rows, point: Point) -> Array:
        """Return the torque (m, J) of another joint at one joint."""
        return (
            arm.links_torque(rows, point)[:, [other]] * np.eye(len(arm.joints))[joint]
        )

    for joint, name in enumerate(arm.joints):
        for other in {joint - 1, joint + 1}.intersection(range(len(arm.joints))):
            yield single(
                "crosstalk",
                f"{name} {other}",
                partial(column, other, joint),
                0.1 * min(1.0, torque[joint] / torque[other]),
                f"the torque of joint {name} holds {{value}} of that of joint "
                f"{arm.joints[other]}{{|, with the opposite sign}}",
                "calibrate its sensor",
                joint=joint,
                factor=100.0,
                unit="%",
            )


def warming(fitted: Fit) -> Iterator[Explanation]:
    """Yield dry friction that falls as gears warm up, with each time constant of ``WARM_UP``.

    Nothing is yielded for a log no longer than the first of them.
    """
    arm = fitted.arm
    first, last = span_of(fitted)
    if last - first <= WARM_UP[0]:
        return
    dry = [fitted.by_name[name] for name in names_of("coulomb", arm.joints)]
    spread = 0.5 * np.maximum(np.abs(dry), 0.01 * typical_torque(fitted.sums))

    def excess(constant: float, rows: Rows, point: Point) -> Array:
        """Return the torque (m, J, J) of friction above that at the end."""
        decay = np.exp((first - rows.motion.time) / constant)
        return arm.terms["coulomb"].columns(rows, point) * decay[:, None, None]

    for constant in WARM_UP:
        yield single(
            "friction",
            f"{constant}",
            partial(excess, constant),
            spread,
            "friction falls over the log",
            "let the arm warm up before it is recorded",
            level=Level.SAYS,
            choices=len(WARM_UP),
        )


def explanations(fitted: Fit) -> list[Explanation]:
    """Return all explanations for the fit of a log."""
    return [
        *sensors(fitted),
        *tilt(fitted),
        *time_base(fitted),
        *payload_steps(fitted),
        *forces(fitted),
        *shapes_of_joints(fitted),
        *crosstalk(fitted),
        *warming(fitted),
    ]
