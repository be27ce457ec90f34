"""Faults of a log or its model as explanations: each is a few columns with a normal prior.

An explanation adds torque that is linear in its coefficients to the base model, linearised around
the base model's estimate. To add one, add a function to ``LINEAR`` that takes the base model's fit
and yields explanations.

Throughout, K is the number of instants, n that of joints, e that of coefficients.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from robot_sysid.diagnosis import Level
from robot_sysid.diagnosis.log_model import PAYLOAD, REACH, Posterior, rms
from robot_sysid.dynamics.inverse_dynamics import (
    TILT_NAMES,
    LinkDynamics,
    gravity_vector,
)
from robot_sysid.dynamics.spatial import parameter_scale
from robot_sysid.records import Array, Motion
from robot_sysid.records.messages import percent, with_error
from robot_sysid.signals.process import ProcessedSignals

STEPS = 17
"""Number of evenly spaced instants at which a change of payload is tried."""
PUSHES = (0.5, 1.5, 3.0, 6.0)
"""Durations of contacts that are tried [s]."""
RIPPLES = tuple(range(4, 41, 3))
"""Numbers of torque waves per turn of a joint that are tried."""
GROSS_ZERO = 0.05
"""Error of a joint's zero above which it is harmful in any case [rad]."""
WARM_UP = (10.0, 30.0, 100.0)
"""Time constants over which friction falls as a gear warms up [s]."""
Description = Callable[[Array, Array], str]
"""Function of an explanation's coefficients (e,) and their standard errors (e,) that returns its
text for the user."""


@dataclass(frozen=True)
class Explanation:
    """One fault that a log may have, as torque that is linear in e coefficients.

    Attributes:
        name: of the check that reports it, a key of ``logs.CHECKS``.
        level: severity of the finding, where a result without the explanation would be wrong.
        columns: torque per unit of each coefficient: (K, n, e), or (K, e) with a ``joint``.
        spread: (e,) prior standard deviations of the coefficients.
        describe: returns the fault and what to do, for the user.
        joint: index of the joint that it acts on; None for all.
        choices: number of similar explanations that are tried, the best of which counts.
        is_possible: whether coefficients (e,) with standard errors (e,) fit the description.
        nearby: returns similar explanations, with which a winner is refined.
        harmful_from: size of the first coefficient above which the explanation is harmful even if
            the last link does not change with it.
    """

    name: str
    level: Level
    columns: Array
    spread: Array
    describe: Description
    joint: int | None = None
    choices: int = 1
    is_possible: Callable[[Array, Array], bool] = lambda values, errors: True
    nearby: Callable[[], list[Explanation]] = list
    harmful_from: float = np.inf

    @property
    def subject(self) -> tuple[str, int | None]:
        """Check and joint; explanations of one subject are named once."""
        return self.name, self.joint

    @property
    def family(self) -> tuple[object, ...]:
        """Key of similar explanations, of which only the best is scored with its own noise."""
        return *self.subject, len(self.spread), self.choices

    def of_joint(self, joint: int) -> Array:
        """Return the columns (K, e) of a joint on which it acts, in prior units."""
        columns = self.columns[:, joint] if self.joint is None else self.columns
        return columns * self.spread


class BaseFit:
    """Torques of the fitted base model along a log, from which explanations make their columns.

    All torques are low-passed like the rows: an unfiltered one would explain the filter's effect.

    Args:
        posterior: posterior of the base model.
        signals: low-passed signals of the log's pieces.
        trusted: whether the estimated last link is plausible; if not, its prior's mean is used.

    Attributes:
        log: equations of the log.
        values: (p,) parameters of the fitted base model.
        time: (K,) from -1 at the first row to 1 at the last.
        rigid: (K, n) inverse-dynamics torque of the links [N m], the last one as fitted, all others
            as in the model.
        weight: (K, n) the torque of gravity in ``rigid`` [N m].
        tip_force: (K, n, 12) for each world axis, joint torque per unit of force on the last link:
            at its origin [N m per N], then offset along the link's x, y, z [N m per N m].
        last_weight: (K, n, 4) torque of gravity on the last link, per unit of its mass and of each
            first moment.
        residual: (K, n) residual torque of the base model, zero in unused rows [N m].
    """

    def __init__(
        self, posterior: Posterior, signals: Sequence[ProcessedSignals], trusted: bool
    ) -> None:
        log = posterior.model.log
        self.log = log
        self.robot = log.robot
        ends = log.motion.time[[0, -1]]
        self.time = (2.0 * log.motion.time - ends.sum()) / np.ptp(ends)
        self.values = posterior.values
        self.residual = (log.right_sides - log.torque_of(self.values)) * log.used
        bodies = posterior.model.prior.mean.copy()
        if trusted:
            bodies[:10] = self.values[:10]
        self.rigid = log.links_torque(bodies)
        self._thetas = log.columns.thetas(bodies[: len(log.columns.names)])
        filtered = [s.filter_columns(self._of_positions, smooth=True) for s in signals]
        self.weight, self.tip_force, self.last_weight = map(
            np.concatenate, zip(*filtered)
        )

    def _of_positions(self, motion: Motion) -> tuple[Array, Array, Array]:
        """Return (weight, tip_force, last_weight) of the class, unfiltered, along a motion."""
        zero = np.zeros_like(motion.q)
        last = [self.robot.n_joints - 1]
        forces = []
        # The weight of one kilogram under a gravity of one along an axis stands for a unit force.
        for axis in np.eye(3):
            pulled = LinkDynamics(self.robot, axis).motion(motion.q, zero, zero)
            forces.append(-pulled.columns(last)[:, :, :4])
        resting = LinkDynamics(self.robot).motion(motion.q, zero, zero)
        weight = resting.torque(self._thetas)
        return weight, np.concatenate(forces, axis=-1), resting.columns(last)[:, :, :4]

    @cached_property
    def inertial(self) -> Array:
        """The torque (K, n) of the links' inertia, without gravity [N m]."""
        return self.rigid - self.weight

    def derivative(self, torque: Array) -> Array:
        """Return the time derivative (K, n) [N m/s] of a torque (K, n) [N m], window by window."""
        derivative = np.empty_like(torque)
        for window in self.log.windows:
            derivative[window] = np.gradient(
                torque[window], self.log.motion.time[window], axis=0
            )
        return derivative


def _first_coefficient(
    text: str, factor: float = 1.0, unit: str = "", shift: float = 0.0
) -> Description:
    """Return a description: ``text`` with the first coefficient and its error in place of {}.

    Args:
        text: with {} where the number goes, if it is shown.
        factor: from the coefficient's unit to ``unit``.
        unit: of the number in the text.
        shift: added to the coefficient before it is multiplied by the factor.
    """

    def describe(v: Array, e: Array) -> str:
        """Return the text for coefficients v (e,) with standard errors e (e,)."""
        value = factor * (float(v[0]) + shift)
        return text.format(with_error(value, abs(factor) * e[0], unit))

    return describe


def _norm(text: str, factor: float, unit: str) -> Description:
    """Return a description: ``text`` with the coefficients' Euclidean norm in place of {}.

    ``factor`` converts from the coefficients' unit to ``unit``.
    """

    def describe(v: Array, e: Array) -> str:
        """Return the text for coefficients v (e,) with standard errors e (e,)."""
        return _first_coefficient(text, factor, unit)(
            np.array([np.linalg.norm(v)]), np.array([np.max(e)])
        )

    return describe


def _of_each_joint(
    fit: BaseFit,
    name: str,
    torque: Array,
    spread: float,
    describe: Callable[[str], Description],
) -> Iterator[Explanation]:
    """Yield one explanation per joint, whose column is the joint's column of a torque (K, n).

    Args:
        name: of the check.
        spread: prior standard deviation of the coefficient.
        describe: returns the description for a joint name.
    """
    spreads = np.array([spread])
    for joint, joint_name in enumerate(fit.robot.joint_names):
        column = torque[:, [joint]]
        text = describe(joint_name)
        yield Explanation(name, Level.WARN, column, spreads, text, joint)


def torque_scales(fit: BaseFit) -> Iterator[Explanation]:
    """Yield an error of one joint's torque scale; it scales the torque of the links alone, not that
    of friction and rotors.
    """
    text = "torque of joint {0} reads {{}} what links and the other joints say; weigh a known mass "
    text += "(payload --known-mass) and pass the file that it writes as --torque-scale"
    yield from _of_each_joint(
        fit,
        "torque-scale",
        fit.rigid,
        0.3,
        lambda j: _first_coefficient(text.format(j), 1.0, "times", 1.0),
    )


def drifting_scales(fit: BaseFit) -> Iterator[Explanation]:
    """Yield torque scales that drift over the log, of all joints and of each one."""
    text = "the torque of {0} changes its scale by {{}} over the log; let motors and sensors warm "
    text += "up, and record again"
    drifting = fit.rigid * fit.time[:, None]

    def describe(joint: str) -> Description:
        """Return the description for a joint, or all, by name."""
        return _first_coefficient(text.format(joint), 200.0, "%")

    spread = np.array([0.1])
    yield Explanation(
        "torque-scale", Level.WARN, drifting[:, :, None], spread, describe("all joints")
    )
    yield from _of_each_joint(
        fit, "torque-scale", drifting, 0.15, lambda joint: describe(f"joint {joint}")
    )


def zeros(fit: BaseFit) -> Iterator[Explanation]:
    """Yield a constant error of each joint's position."""
    text = "the position of joint {} reads {{}} too much; correct its zero"
    spread = np.array([0.1])
    for name in fit.robot.joint_names:
        columns = fit.log.columns_of([f"zero[{name}]"])
        describe = _first_coefficient(text.format(name), 1.0, "rad")
        zero = Explanation("zero", Level.WARN, columns, spread, describe)
        yield replace(zero, harmful_from=GROSS_ZERO)


def tilt(fit: BaseFit) -> Iterator[Explanation]:
    """Yield a tilt of the base against the model's; none without gravity."""
    if np.any(gravity_vector(fit.robot)):
        text = "the base is tilted by {} against the model's; have it found (identify --tilt auto)"
        describe = _norm(text, float(np.degrees(1.0)), "degrees")
        columns = fit.log.columns_of(TILT_NAMES)
        yield Explanation("tilt", Level.WARN, columns, np.full(2, 0.15), describe)


def time_base(fit: BaseFit) -> Iterator[Explanation]:
    """Yield an error and a drift of the time stamps' scale, which change inertial torque alone."""
    slope = 2.0 * fit.inertial[:, :, None]
    advice = "record the controller's own time stamps"

    def describe_scale(v: Array, e: Array) -> str:
        """Return the text for coefficients v (e,) with standard errors e (e,)."""
        return (
            f"by inertia beside gravity, time in the log is {_too_long(v[0])} "
            f"(\u00b1 {percent(float(e[0]))}); {advice}, or scale them with --columns FILE: "
            f"time = {1.0 / (1.0 + float(v[0])):.3g} * TITLE"
        )

    def describe_drift(v: Array, e: Array) -> str:
        """Return the text for coefficients v (e,) with standard errors e (e,)."""
        return (
            f"by inertia beside gravity, the clock drifts: time is {_too_long(v[0] - v[1])} at "
            f"first, {_too_long(v[0] + v[1])} at the end; {advice}"
        )

    drift = np.concatenate((slope, slope * fit.time[:, None, None]), axis=-1)
    for columns, describe in ((slope, describe_scale), (drift, describe_drift)):
        spread = np.full(columns.shape[-1], 0.1)
        clock = Explanation("clock", Level.WARN, columns, spread, describe)
        yield replace(clock, harmful_from=0.0)


def _too_long(share: float) -> str:
    """Return "3 % too long" for a share of 0.03, "3 % too short" for -0.03."""
    return f"{percent(abs(float(share)))} too {'long' if share > 0.0 else 'short'}"


def delays(fit: BaseFit) -> Iterator[Explanation]:
    """Yield a lag of the torque behind the position, of all joints and of each one."""
    late = -fit.derivative(fit.rigid)
    text = (
        "torque lags position by {}; record both at the same instant, or have it found "
    )
    text += "(identify --delay auto; payload does so by itself)"
    describe = _first_coefficient(text, 1e3, "ms")
    yield Explanation("delay", Level.WARN, late[:, :, None], np.array([0.04]), describe)
    text = "torque of joint {0} alone lags position by {{}}; record all joints at once"
    yield from _of_each_joint(
        fit,
        "delay",
        late,
        0.04,
        lambda j: _first_coefficient(text.format(j), 1e3, "ms"),
    )


def weight_share(fit: BaseFit) -> Iterator[Explanation]:
    """Yield the fault that a share of the weight of links and load is missing from the torque."""
    total = fit.robot.mass
    text = "{} of the links' weight is missing from the torque: is there a spring balancer that "
    text += "the model lacks, or is gravity compensated in part? record the measured joint torque, "
    yield Explanation(
        "gravity",
        Level.REFUSE,
        np.concatenate((fit.weight[:, :, None], fit.last_weight), axis=-1),
        np.append(0.5, parameter_scale(0.1 * total, 0.1)[:4]),
        _first_coefficient(f"{text}not the command", -100.0, "%"),
        is_possible=lambda v, e: bool(-1.0 - 3.0 * e[0] < v[0] < -0.05),
    )


def payload_steps(fit: BaseFit) -> Iterator[Explanation]:
    """Yield a change of the last link's load at each of ``STEPS`` instants."""
    spacing = len(fit.time) // (STEPS + 1)
    for row in spacing * np.arange(1, STEPS + 1):
        yield _payload_step(fit, int(row), spacing, STEPS)


def _payload_step(fit: BaseFit, row: int, spacing: int, choices: int) -> Explanation:
    """Return the explanation that the last link's load changes at the instant with index ``row``.

    Args:
        spacing: number of rows between the instants that are tried.
        choices: number of instants that are tried.
    """
    total = fit.robot.mass
    reach = fit.robot.length
    bodies = np.stack([rows[:, :10] for rows in fit.log.rows], axis=1)
    at = float(fit.log.motion.time[row])

    def nearby() -> list[Explanation]:
        """Return steps at up to eleven instants around this one, at a sixth of the spacing."""
        step = -(-spacing // 6)
        rows = range(row - step * ((spacing - 1) // step), row + spacing, step)
        inside = [k for k in rows if 0 < k < len(bodies)]
        return [_payload_step(fit, k, step, choices) for k in inside]

    def describe(v: Array, e: Array) -> str:
        """Return the text for coefficients v (e,) with standard errors e (e,)."""
        return (
            f"from about {at:.3g} s on the last link carries {_more(v[0], e[0])}: was something "
            "picked up, dropped or moved? record each state in a log of its own"
        )

    return Explanation(
        "payload-step",
        Level.REFUSE,
        bodies * (np.arange(len(bodies)) >= row)[:, None, None],
        parameter_scale(0.3 * PAYLOAD * total, 0.5 * REACH * reach),
        describe,
        choices=choices,
        nearby=nearby if spacing > 1 else list,
    )


def _more(mass: float, error: float) -> str:
    """Return a difference in mass [kg] with its error as text, such as "0.5 ± 0.1 kg more"."""
    return f"{with_error(abs(float(mass)), float(error), 'kg')} {'more' if mass > 0.0 else 'less'}"


def forces(fit: BaseFit) -> Iterator[Explanation]:
    """Yield a constant force on the last link, and a weight that contradicts its inertia."""
    total = fit.robot.mass
    down = float(np.linalg.norm(gravity_vector(fit.robot))) or 9.81
    text = "a constant force of {} acts on the last link, as of a hand, a cable or a spring; take "
    describe_force = _norm(f"{text}it away, and record again", 1.0, "N")
    spread = np.outer(np.full(3, 0.1 * total * down), (1.0, 0.1, 0.1, 0.1)).ravel()
    force = slice(None, None, 4)

    def describe(v: Array, e: Array) -> str:
        """Return the text for coefficients v (e,) with standard errors e (e,)."""
        return describe_force(v[force], e[force])

    def is_sure(v: Array, e: Array) -> bool:
        """Return whether the force differs from zero by three standard errors e (e,) of v (e,)."""
        return bool(np.linalg.norm(v[force]) > 3.0 * np.max(e[force]))

    columns = fit.tip_force
    yield Explanation(
        "force", Level.REFUSE, columns, spread, describe, is_possible=is_sure
    )
    text = "the last link weighs {} more than its inertia says: something holds a part of it, or "
    carried = _first_coefficient(
        f"{text}pulls, as a hand or a hose does; take it away, record again", 1.0, "kg"
    )
    spread = parameter_scale(0.1 * total, 0.1)[:4]
    yield Explanation("force", Level.REFUSE, fit.last_weight, spread, carried)


def springs(fit: BaseFit) -> Iterator[Explanation]:
    """Yield a torque that depends on the position of one joint, as of a spring or a hose."""
    text = "at joint {} a torque follows the position, as of a spring, a balancer or a hose; the "
    text += "model has to have it, or take it away"
    for joint, name in enumerate(fit.robot.joint_names):
        q = fit.log.motion.q[:, joint]
        shapes = np.stack((q, np.sin(q), np.cos(q)), axis=1)
        spread = np.full(3, 0.5 * fit.log.typical_torque[joint])
        describe = _first_coefficient(text.format(name))
        yield Explanation("force", Level.REFUSE, shapes, spread, describe, joint)


def pushes(fit: BaseFit) -> Iterator[Explanation]:
    """Yield a contact for each duration of ``PUSHES``, when the residual torque is largest."""
    step = float(np.median(np.diff(fit.log.motion.time)))
    power = np.sum((fit.residual / np.maximum(rms(fit.residual), 1e-12)) ** 2, axis=1)
    for length in PUSHES:
        width = max(3, round(length / step))
        if 3 * width < len(power):
            start = int(np.argmax(np.convolve(power, np.ones(width), mode="valid")))
            yield _push(fit, start, width, 2 * len(power) // width)


def _push(fit: BaseFit, start: int, width: int, choices: int) -> Explanation:
    """Return the explanation of a contact, half a sine wave of torque at all joints.

    Args:
        start: index of its first row; may be outside the log.
        width: number of rows.
        choices: number of contacts that are tried.
    """
    time = fit.log.motion.time
    rows = np.arange(max(start, 0), min(start + width, len(time)))
    wave = np.zeros(len(time))
    wave[rows] = np.sin(np.pi * (rows - start + 0.5) / width)
    first, last = time[rows[[0, -1]]]

    def nearby() -> list[Explanation]:
        """Return contacts that begin up to half a width earlier or later, of three widths."""
        contacts = []
        for first_row in range(start - width // 2, start + width // 2, -(-width // 6)):
            for size in (round(0.7 * width), width, round(1.4 * width)):
                contact = _push(fit, first_row, size, choices)
                contacts.append(replace(contact, nearby=list))
        return contacts

    def describe(v: Array, e: Array) -> str:
        """Return the text for coefficients v (e,) with standard errors e (e,)."""
        joint = int(np.argmax(np.abs(v)))
        return (
            f"from {first:.2f} s to {last:.2f} s something else acts on the arm: "
            f"{abs(float(v[joint])):.3g} N m at joint {fit.robot.joint_names[joint]} that the "
            "model does not explain; was there contact, or did a gripper move? cut it out, or "
            "record again"
        )

    columns = wave[:, None, None] * np.eye(fit.robot.n_joints)
    spread = fit.log.typical_torque
    contact = Explanation("contact", Level.WARN, columns, spread, describe)
    return replace(contact, choices=choices, nearby=nearby, harmful_from=0.0)


def hums(fit: BaseFit) -> Iterator[Explanation]:
    """Yield the strongest sine over time in each joint's residual torque."""
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
        describe = _norm(
            f"{text}motion nor friction makes; find its source", 1.0, "N m"
        )
        spread = np.full(2, 0.1 * fit.log.typical_torque[joint])
        yield Explanation(
            "contact", Level.WARN, columns, spread, describe, joint, len(rates)
        )


def ripples(fit: BaseFit) -> Iterator[Explanation]:
    """Yield a torque that is periodic in the position, as of cogging or a gear's teeth."""
    for joint, name in enumerate(fit.robot.joint_names):
        waves = np.exp(1j * np.outer(fit.log.motion.q[:, joint], RIPPLES))
        best = int(np.argmax(np.abs(fit.residual[:, joint] @ waves)))
        columns = np.stack((waves[:, best].real, waves[:, best].imag), axis=1)
        text = f"torque of joint {name} ripples about {RIPPLES[best]} times per turn by {{}}, "
        describe = _norm(f"{text}as of cogging; errors count it as noise", 1.0, "N m")
        spread = np.full(2, 0.1 * fit.log.typical_torque[joint])
        yield Explanation(
            "ripple", Level.NOTE, columns, spread, describe, joint, len(RIPPLES)
        )


def couplings(fit: BaseFit) -> Iterator[Explanation]:
    """Yield motors that turn two joints, and sensors that read a share of a neighbour's torque."""
    terms = ("coulomb", "viscous", "armature")
    units = np.array(
        [1.0, np.max(rms(fit.log.motion.qd)), np.max(rms(fit.log.motion.qdd))]
    )
    names = fit.robot.joint_names
    typical_torque = fit.log.typical_torque
    for motor in fit.log.columns.couplings:
        columns = fit.log.columns_of([f"{term}[{motor.name}]" for term in terms])
        size = 0.3 * float(np.min(typical_torque[motor.ratios != 0.0]))
        describe = _first_coefficient(f"one motor turns with joints {motor.name}")
        # Couplings are reported by the estimate, which uses them only with clear evidence.
        coupling = Explanation("coupling", Level.NOTE, columns, size / units, describe)
        yield replace(coupling, is_possible=lambda v, e: False)
    text = "the torque of joint {} holds {{}} of that of joint {}; calibrate its sensor"
    for one, other in itertools.permutations(range(len(names)), 2):
        if abs(one - other) == 1:
            ratio = typical_torque[one] / typical_torque[other]
            spread = np.array([0.1 * min(1.0, ratio)])
            column = fit.rigid[:, [other]]
            message = text.format(names[one], names[other])
            describe = _first_coefficient(message, 100.0, "%")
            yield Explanation("crosstalk", Level.WARN, column, spread, describe, one)


def warming(fit: BaseFit) -> Iterator[Explanation]:
    """Yield friction that falls as gears warm up."""
    time = fit.log.motion.time - fit.log.motion.time[0]
    if time[-1] <= WARM_UP[0]:
        return
    coulomb = fit.log.columns_of([f"coulomb[{name}]" for name in fit.robot.joint_names])
    sizes = np.abs(fit.values[fit.log.friction_indices("coulomb")])
    spread = 0.5 * np.maximum(sizes, 0.01 * fit.log.typical_torque)
    text = "friction falls over the log; let the arm warm up before it is recorded"
    describe = _first_coefficient(text)
    for constant in WARM_UP:
        columns = coulomb * np.exp(-time / constant)[:, None, None]
        friction = Explanation("friction", Level.NOTE, columns, spread, describe)
        yield replace(friction, choices=len(WARM_UP))


LINEAR: tuple[Callable[[BaseFit], Iterator[Explanation]], ...] = (
    *(torque_scales, drifting_scales, zeros, tilt, time_base, delays, weight_share),
    *(payload_steps, forces, springs, pushes, hums, ripples, couplings, warming),
)
"""Functions that together yield all explanations; they are linear in their coefficients."""


def explanations(fit: BaseFit) -> list[Explanation]:
    """Return all explanations of the base model's residual torque."""
    return list(itertools.chain.from_iterable(family(fit) for family in LINEAR))
