"""What may be wrong with a log or its model: explanations, each a few columns with a prior.

An explanation adds torque that its coefficients make to first order beside the base model, around
what that model finds. A new one is one more function of ``LINEAR``: it yields the name of a check,
columns, the prior's standard deviations, and words with a remedy.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from robot_sysid.diagnosis import Level
from robot_sysid.diagnosis.evidence import Posterior
from robot_sysid.diagnosis.rows import PAYLOAD, REACH, LogRows, Prior, rms
from robot_sysid.dynamics.newton_euler import TILT_NAMES, LinkDynamics, gravity_vector
from robot_sysid.dynamics.spatial import parameter_scale
from robot_sysid.records import Array, Motion
from robot_sysid.records.messages import percent, with_error
from robot_sysid.signals.process import ProcessedSignals

STEPS = 17
"""Instants at which a payload may change."""
PUSHES = (0.5, 1.5, 3.0, 6.0)
"""Durations of a push [s]."""
RIPPLES = tuple(range(4, 41, 3))
"""Waves per turn of a ripple."""
GROSS_ZERO = 0.05
"""Error of a joint's zero that no estimate allows for [rad]."""
WARM_UP = (10.0, 30.0, 100.0)
"""Time constants over which friction falls as a gear warms up [s]."""

Words = Callable[[Array, Array], str]
"""Text of an explanation from its coefficients (e,) and their standard errors (e,)."""


@dataclass(frozen=True)
class Explanation:
    """One way in which a log may be wrong.

    Attributes:
        name: of the check that finds it.
        level: of what it does to a result that takes no notice of it.
        columns: (K, n, e) torque per unit of each coefficient, (K, e) where it is of one joint.
        spread: (e,) prior standard deviations.
        words: what it is and what to do.
        joint: the only one that feels it.
        choices: out of how many alike it is the best.
        is_possible: whether coefficients (e,) with standard errors (e,) are what the words say;
            else they have no name.
        nearby: makes others of the kind, among which a winner is refined.
        harmful_from: size of the first coefficient from which on its level holds even where the
            last link comes out as it would without.
    """

    name: str
    level: Level
    columns: Array
    spread: Array
    words: Words
    joint: int | None = None
    choices: int = 1
    is_possible: Callable[[Array, Array], bool] = lambda values, errors: True
    nearby: Callable[[], list[Explanation]] = list
    harmful_from: float = np.inf

    @property
    def subject(self) -> tuple[str, int | None]:
        """What is told once only: the check, and its joint."""
        return self.name, self.joint

    @property
    def family(self) -> tuple[object, ...]:
        """What explanations have in common of which only the best is scored further."""
        return *self.subject, len(self.spread), self.choices

    def of_joint(self, joint: int) -> Array | None:
        """Return the columns (K, e) of a joint in units of their priors; None where it has none."""
        if self.joint is None:
            return self.columns[:, joint] * self.spread
        return self.columns * self.spread if joint == self.joint else None


class Fitted:
    """What the base model makes of a log: what explanations are columns of.

    All of it has passed the low-pass of the rows: what has not would explain what the filter does.

    Attributes:
        log: rows around the base model.
        values: (p,) parameters of the base model.
        time: (K,) from -1 at the first row to 1 at the last.
        rigid: (K, n) torque of the links, other links as in the model [N m].
        weight: (K, n) the part of it that gravity makes.
        tip_force: (K, n, 12) torque per newton at the last link's origin [m], and per newton metre
            of the same force's offset along the link's axes, for each of the world's axes.
        last_weight: (K, n, 4) weight of the last link per unit of its mass and first moment.
        residual: (K, n) torque that the base model leaves [N m].
    """

    def __init__(
        self,
        log: LogRows,
        signals: Sequence[ProcessedSignals],
        prior: Prior,
        posterior: Posterior,
        trusted: bool,
    ) -> None:
        self.log = log
        self.robot = log.robot
        ends = log.motion.time[[0, -1]]
        self.time = (2.0 * log.motion.time - ends.sum()) / np.ptp(ends)
        self.values = prior.parameters(posterior.values)
        explained = [rows @ self.values[at] for rows, at in zip(log.rows, log.places)]
        self.residual = (log.right - np.column_stack(explained)) * log.used

        bodies = prior.mean.copy()
        if trusted:
            bodies[:10] = self.values[:10]
        self.rigid = log.links_torque(bodies)
        self._thetas = log.columns.thetas(bodies[: len(log.columns.names)])
        filtered = [
            log.filter_columns(self._of_positions, smooth=True) for log in signals
        ]
        self.weight, self.tip_force, self.last_weight = map(
            np.concatenate, zip(*filtered)
        )

    def _of_positions(self, motion: Motion) -> tuple[Array, Array, Array]:
        """Return what follows from positions alone, see the attributes."""
        still = np.zeros_like(motion.q)
        last = self.robot.n_joints - 1
        # A mass of one kilogram under an acceleration of one: the torque that holds it.
        pulls = [LinkDynamics(self.robot, axis) for axis in np.eye(3)]
        forces = [
            -pull.motion(motion.q, still, still).columns([last])[:, :, :4]
            for pull in pulls
        ]
        resting = LinkDynamics(self.robot).motion(motion.q, still, still)
        columns = resting.columns([last])[:, :, :4]
        return resting.torque(self._thetas), np.concatenate(forces, axis=-1), columns

    @cached_property
    def inertial(self) -> Array:
        """The part (K, n) of the links' torque that gravity does not make [N m]."""
        return self.rigid - self.weight

    def derivative(self, torque: Array) -> Array:
        """Return the derivative (K, n) by time [N m/s]."""
        derivative = np.empty_like(torque)
        for window in self.log.windows:
            derivative[window] = np.gradient(
                torque[window], self.log.motion.time[window], axis=0
            )
        return derivative


def _says(text: str, factor: float = 1.0, unit: str = "", shift: float = 0.0) -> Words:
    """Return words in which {} stands for the first coefficient, in a unit, with its error."""

    def words(v: Array, e: Array) -> str:
        return text.format(
            with_error(factor * (float(v[0]) + shift), abs(factor) * e[0], unit)
        )

    return words


def _size_says(text: str, factor: float = 1.0, unit: str = "") -> Words:
    """Return words in which {} stands for the length of all coefficients together."""

    def words(v: Array, e: Array) -> str:
        size = factor * float(np.linalg.norm(v))
        return text.format(with_error(size, factor * float(np.max(e)), unit))

    return words


def _of_each_joint(
    fit: Fitted, name: str, torque: Array, spread: float, words: Callable[[str], Words]
) -> Iterator[Explanation]:
    """Yield one explanation per joint, whose columns are its own torque (K, n)."""
    for joint, joint_name in enumerate(fit.robot.joint_names):
        column = torque[:, joint, None]
        sizes = np.array([spread])
        yield Explanation(name, Level.WARN, column, sizes, words(joint_name), joint)


def torque_scales(fit: Fitted) -> Iterator[Explanation]:
    """Yield that one joint's torque reads too much or too little; no part of it is rotors."""
    text = "torque of joint {0} reads {{}} what links and the other joints say; weigh a known mass "
    text += "(payload --known-mass) and pass the file that it writes as --torque-scale"
    yield from _of_each_joint(
        fit,
        "torque-scale",
        fit.rigid,
        0.3,
        lambda j: _says(text.format(j), 1.0, "times", 1.0),
    )


def drifting_scales(fit: Fitted) -> Iterator[Explanation]:
    """Yield torque gains that change over the log."""
    text = "the torque of {0} changes its scale by {{}} over the log; let motors and sensors warm "
    text += "up, and record again"
    drifting = fit.rigid * fit.time[:, None]
    words = _says(text.format("all joints"), 200.0, "%")
    yield Explanation(
        "torque-scale", Level.WARN, drifting[:, :, None], np.array([0.1]), words
    )
    yield from _of_each_joint(
        fit,
        "torque-scale",
        drifting,
        0.15,
        lambda joint: _says(text.format(f"joint {joint}"), 200.0, "%"),
    )


def _columns(fit: Fitted, names: Sequence[str]) -> Array:
    """Return the columns (K, n, e) of some parameters of the estimate."""
    joints = range(fit.robot.n_joints)
    return np.transpose(
        [[fit.log.column(j, name) for j in joints] for name in names], (2, 1, 0)
    )


def zeros(fit: Fitted) -> Iterator[Explanation]:
    """Yield that a joint's position is off by a constant."""
    for name in fit.robot.joint_names:
        words = _says(
            f"the position of joint {name} reads {{}} too much; correct its zero",
            1.0,
            "rad",
        )
        columns = _columns(fit, [f"zero[{name}]"])
        yield Explanation(
            "zero", Level.WARN, columns, np.array([0.1]), words, harmful_from=GROSS_ZERO
        )


def tilt(fit: Fitted) -> Iterator[Explanation]:
    """Yield that the base is not as the model says."""
    if np.any(gravity_vector(fit.robot)):
        text = "the base is tilted by {} against the model's; have it found (identify --tilt auto)"
        words = _size_says(text, float(np.degrees(1.0)), "degrees")
        yield Explanation(
            "tilt", Level.WARN, _columns(fit, TILT_NAMES), np.full(2, 0.15), words
        )


def time_base(fit: Fitted) -> Iterator[Explanation]:
    """Yield that inertia and gravity disagree about the length of a second."""
    slope = 2.0 * fit.inertial[:, :, None]
    advice = "record the controller's own time stamps"

    def stretched(v: Array, e: Array) -> str:
        return (
            f"by inertia beside gravity, time in the log is {_too_long(v[0])} "
            f"(\u00b1 {percent(float(e[0]))}); {advice}, or scale them with --columns FILE: "
            f"time = {1.0 / (1.0 + float(v[0])):.3g} * TITLE"
        )

    def drifting(v: Array, e: Array) -> str:
        return (
            f"by inertia beside gravity, the clock drifts: time is {_too_long(v[0] - v[1])} at "
            f"first, {_too_long(v[0] + v[1])} at the end; {advice}"
        )

    yield Explanation(
        "clock", Level.WARN, slope, np.array([0.1]), stretched, harmful_from=0.0
    )
    both = np.concatenate((slope, slope * fit.time[:, None, None]), axis=-1)
    yield Explanation(
        "clock", Level.WARN, both, np.full(2, 0.1), drifting, harmful_from=0.0
    )


def _too_long(share: float) -> str:
    return f"{percent(abs(float(share)))} too {'long' if share > 0.0 else 'short'}"


def delays(fit: Fitted) -> Iterator[Explanation]:
    """Yield that torque belongs to an earlier or later position."""
    late = -fit.derivative(fit.rigid)
    text = (
        "torque lags position by {}; record both at the same instant, or have it found "
    )
    words = _says(
        f"{text}(identify --delay auto; payload does so by itself)", 1e3, "ms"
    )
    yield Explanation("delay", Level.WARN, late[:, :, None], np.array([0.04]), words)
    text = "torque of joint {0} alone lags position by {{}}; record all joints at once"
    yield from _of_each_joint(
        fit, "delay", late, 0.04, lambda joint: _says(text.format(joint), 1e3, "ms")
    )


def weight_share(fit: Fitted) -> Iterator[Explanation]:
    """Yield that a part of the links' weight, and of what they carry, is not in the torque."""
    total = fit.robot.mass
    text = "{} of the links' weight is missing from the torque: is there a spring balancer that "
    text += "the model lacks, or is gravity compensated in part? record the measured joint torque, "
    yield Explanation(
        "gravity",
        Level.REFUSE,
        np.concatenate((fit.weight[:, :, None], fit.last_weight), axis=-1),
        np.append(0.5, parameter_scale(0.1 * total, 0.1)[:4]),
        _says(f"{text}not the command", -100.0, "%"),
        is_possible=lambda v, e: bool(-1.0 - 3.0 * e[0] < v[0] < -0.05),
    )


def payload_steps(fit: Fitted) -> Iterator[Explanation]:
    """What the last link carries changes once."""
    spacing = len(fit.time) // (STEPS + 1)
    for row in spacing * np.arange(1, STEPS + 1):
        yield _payload_step(fit, int(row), spacing, STEPS)


def _payload_step(fit: Fitted, row: int, spacing: int, choices: int) -> Explanation:
    """Return the explanation that the last link's payload changes at a row, one of some that are
    so many rows apart.
    """
    total = fit.robot.mass
    reach = fit.robot.length
    bodies = np.stack([rows[:, :10] for rows in fit.log.rows], axis=1)
    at = float(fit.log.motion.time[row])

    def nearby() -> list[Explanation]:
        step = -(-spacing // 6)
        rows = range(row - step * ((spacing - 1) // step), row + spacing, step)
        return [
            _payload_step(fit, k, step, choices) for k in rows if 0 < k < len(bodies)
        ]

    def words(v: Array, e: Array) -> str:
        return (
            f"from about {at:.3g} s on the last link carries {_more(v[0], e[0])}: was something "
            "picked up, dropped or moved? record each state in a log of its own"
        )

    return Explanation(
        "payload-step",
        Level.REFUSE,
        bodies * (np.arange(len(bodies)) >= row)[:, None, None],
        parameter_scale(0.3 * PAYLOAD * total, 0.5 * REACH * reach),
        words,
        choices=choices,
        nearby=nearby if spacing > 1 else list,
    )


def _more(mass: float, error: float) -> str:
    return f"{with_error(abs(float(mass)), float(error), 'kg')} {'more' if mass > 0.0 else 'less'}"


def forces(fit: Fitted) -> Iterator[Explanation]:
    """Yield that something pulls at the last link, or carries a part of it."""
    total = fit.robot.mass
    down = float(np.linalg.norm(gravity_vector(fit.robot))) or 9.81
    text = "a constant force of {} acts on the last link, as of a hand, a cable or a spring; take "
    size_says = _size_says(f"{text}it away, and record again", 1.0, "N")
    spread = np.outer(np.full(3, 0.1 * total * down), (1.0, 0.1, 0.1, 0.1)).ravel()
    force = slice(None, None, 4)

    def words(v: Array, e: Array) -> str:
        return size_says(v[force], e[force])

    def is_sure(v: Array, e: Array) -> bool:
        return bool(np.linalg.norm(v[force]) > 3.0 * np.max(e[force]))

    columns = fit.tip_force
    yield Explanation(
        "force", Level.REFUSE, columns, spread, words, is_possible=is_sure
    )
    text = "the last link weighs {} more than its inertia says: something holds a part of it, or "
    carried = _says(
        f"{text}pulls, as a hand or a hose does; take it away, record again", 1.0, "kg"
    )
    spread = parameter_scale(0.1 * total, 0.1)[:4]
    yield Explanation("force", Level.REFUSE, fit.last_weight, spread, carried)


def springs(fit: Fitted) -> Iterator[Explanation]:
    """Yield that a spring or a hose acts at one joint."""
    text = "at joint {} a torque follows the position, as of a spring, a balancer or a hose; the "
    text += "model has to have it, or take it away"
    for joint, name in enumerate(fit.robot.joint_names):
        q = fit.log.motion.q[:, joint]
        shapes = np.stack((q, np.sin(q), np.cos(q)), axis=1)
        spread = np.full(3, 0.5 * fit.log.usual[joint])
        yield Explanation(
            "force", Level.REFUSE, shapes, spread, _says(text.format(name)), joint
        )


def pushes(fit: Fitted) -> Iterator[Explanation]:
    """Something touches the arm for a while: of each duration, where most is left."""
    step = float(np.median(np.diff(fit.log.motion.time)))
    power = np.sum((fit.residual / np.maximum(rms(fit.residual), 1e-12)) ** 2, axis=1)
    for length in PUSHES:
        width = max(3, round(length / step))
        if 3 * width < len(power):
            start = int(np.argmax(np.convolve(power, np.ones(width), mode="valid")))
            yield _push(fit, start, width, 2 * len(power) // width)


def _push(fit: Fitted, start: int, width: int, choices: int) -> Explanation:
    """Return the explanation of a push that begins at a row and lasts for some rows."""
    time = fit.log.motion.time
    rows = np.arange(max(start, 0), min(start + width, len(time)))
    wave = np.zeros(len(time))
    wave[rows] = np.sin(np.pi * (rows - start + 0.5) / width)
    first, last = time[rows[[0, -1]]]

    def nearby() -> list[Explanation]:
        starts = range(start - width // 2, start + width // 2, -(-width // 6))
        widths = (round(0.7 * width), width, round(1.4 * width))
        pushes = [_push(fit, k, size, choices) for k in starts for size in widths]
        return [replace(push, nearby=list) for push in pushes]

    def words(v: Array, e: Array) -> str:
        joint = int(np.argmax(np.abs(v)))
        return (
            f"from {first:.2f} s to {last:.2f} s something else acts on the arm: "
            f"{abs(float(v[joint])):.3g} N m at joint {fit.robot.joint_names[joint]} that the "
            "model does not explain; was there contact, or did a gripper move? cut it out, or "
            "record again"
        )

    columns = wave[:, None, None] * np.eye(fit.robot.n_joints)
    level = Level.WARN
    spread = fit.log.usual
    return Explanation(
        "contact",
        level,
        columns,
        spread,
        words,
        None,
        choices,
        nearby=nearby,
        harmful_from=0.0,
    )


def hums(fit: Fitted) -> Iterator[Explanation]:
    """Yield the strongest sine that is left of each joint's torque."""
    time = fit.log.motion.time - fit.log.motion.time[0]
    span = float(time[-1])
    step = float(np.median(np.diff(time)))
    rates = np.arange(2.0 / span, 0.4 / step, 0.25 / span)
    waves = np.exp(2j * np.pi * np.outer(rates, time))
    power = np.abs(waves @ fit.residual) ** 2
    for joint, name in enumerate(fit.robot.joint_names):
        best = int(np.argmax(power[:, joint]))
        columns = np.stack((waves[best].real, waves[best].imag), axis=1)
        text = f"torque of joint {name} hums: a sine of {rates[best]:.2g} Hz and {{}} that neither "
        words = _size_says(
            f"{text}motion nor friction makes; find its source", 1.0, "N m"
        )
        spread = np.full(2, 0.1 * fit.log.usual[joint])
        yield Explanation(
            "contact", Level.WARN, columns, spread, words, joint, len(rates)
        )


def ripples(fit: Fitted) -> Iterator[Explanation]:
    """Yield torque that comes again some times per turn, as of cogging or a gear's teeth."""
    for joint, name in enumerate(fit.robot.joint_names):
        waves = np.exp(1j * np.outer(fit.log.motion.q[:, joint], RIPPLES))
        best = int(np.argmax(np.abs(fit.residual[:, joint] @ waves)))
        columns = np.stack((waves[:, best].real, waves[:, best].imag), axis=1)
        text = f"torque of joint {name} ripples about {RIPPLES[best]} times per turn by {{}}, "
        words = _size_says(f"{text}as of cogging; errors count it as noise", 1.0, "N m")
        spread = np.full(2, 0.1 * fit.log.usual[joint])
        yield Explanation(
            "ripple", Level.NOTE, columns, spread, words, joint, len(RIPPLES)
        )


def couplings(fit: Fitted) -> Iterator[Explanation]:
    """Yield motors that turn with two joints, and torques that read a part of a neighbour's."""
    terms = ("coulomb", "viscous", "armature")
    units = np.array(
        [1.0, np.max(rms(fit.log.motion.qd)), np.max(rms(fit.log.motion.qdd))]
    )
    names = fit.robot.joint_names
    for motor in fit.log.columns.couplings:
        columns = _columns(fit, [f"{term}[{motor.name}]" for term in terms])
        usual = 0.3 * float(np.min(fit.log.usual[motor.ratios != 0.0]))
        words = _says(f"one motor turns with joints {motor.name}")
        # The estimate tells of motors, for it knows on which side of the gears sensors are.
        coupling = Explanation("coupling", Level.NOTE, columns, usual / units, words)
        yield replace(coupling, is_possible=lambda v, e: False)
    text = "the torque of joint {} holds {{}} of that of joint {}; calibrate its sensor"
    for one, other in itertools.permutations(range(len(names)), 2):
        if abs(one - other) == 1:
            words = _says(text.format(names[one], names[other]), 100.0, "%")
            share = 0.1 * min(1.0, fit.log.usual[one] / fit.log.usual[other])
            column = fit.rigid[:, other, None]
            yield Explanation(
                "crosstalk", Level.WARN, column, np.array([share]), words, one
            )


def warming(fit: Fitted) -> Iterator[Explanation]:
    """Yield friction that falls as gears warm up."""
    time = fit.log.motion.time - fit.log.motion.time[0]
    names = [f"coulomb[{name}]" for name in fit.robot.joint_names]
    sizes = np.abs(fit.values[fit.log.columns.indices(names)])
    spread = 0.5 * np.maximum(sizes, 0.01 * fit.log.usual)
    words = _says(
        "friction falls over the log; let the arm warm up before it is recorded"
    )
    for constant in WARM_UP if time[-1] > WARM_UP[0] else ():
        columns = _columns(fit, names) * np.exp(-time / constant)[:, None, None]
        count = len(WARM_UP)
        yield Explanation("friction", Level.NOTE, columns, spread, words, None, count)


LINEAR: tuple[Callable[[Fitted], Iterator[Explanation]], ...] = (
    *(torque_scales, drifting_scales, zeros, tilt, time_base, delays, weight_share),
    *(payload_steps, forces, springs, pushes, hums, ripples, couplings, warming),
)
"""All explanations that are columns."""


def explanations(fit: Fitted) -> list[Explanation]:
    """Return every explanation of what the base model leaves."""
    return [explanation for family in LINEAR for explanation in family(fit)]
