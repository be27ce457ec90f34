"""Faults of a log or its model as explanations: each is a few columns with a normal prior.

The base model is the model of a log without faults, with the parameters and priors of the estimate.
An explanation adds torque to it that is linear in the explanation's coefficients, linearised around
the base model's estimate. To add one, add a function to ``LINEAR`` that takes the base model's fit
and yields explanations.

Throughout, K is the number of instants, n that of joints, e that of an explanation's coefficients;
[:, :, None] makes the torque (K, n) of one coefficient an array of columns (K, n, 1). In texts
{value} stands for the number with its error, {joint} for the joint's name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.diagnosis import Level
from robot_sysid.diagnosis.base_fit import BaseFit
from robot_sysid.diagnosis.log_prior import PAYLOAD, REACH
from robot_sysid.diagnosis.log_rows import rms
from robot_sysid.dynamics.equations import names_of
from robot_sysid.dynamics.inverse_dynamics import TILT_NAMES, gravity_vector
from robot_sysid.dynamics.spatial import parameter_scale
from robot_sysid.records import Array
from robot_sysid.records.messages import percent, with_error

STEPS = 17
"""Number of evenly spaced instants at which a change of payload is tried."""
RIPPLES = tuple(range(4, 41, 3))
"""Numbers of torque waves per turn of a joint that are tried."""
GROSS_ZERO = 0.05
"""Error of a joint's zero position from which it is harmful in any case [rad]."""
WARM_UP = (10.0, 30.0, 100.0)
"""Time constants over which friction falls as a gear warms up [s]."""
Description = Callable[[Array, Array], str]
"""Function that returns the user's text from coefficients (e,) and standard errors (e,)."""


@dataclass(frozen=True)
class Explanation:
    """One fault that a log may have, as torque that is linear in e coefficients.

    Attributes:
        name: name of the check that reports it, a key of ``logs.CHECKS``.
        level: severity of the finding, where a result without the explanation would be wrong.
        columns: torque per unit of each coefficient: (K, n, e), or (K, e) with a ``joint``.
        spread: (e,) prior standard deviations of the coefficients.
        describe: returns the fault and what to do, for the user.
        joint: index of the joint that it acts on; None for all.
        choices: number of similar explanations that are tried, of which only the best one counts;
            the logarithm of this number is taken from its gain.
        is_possible: whether coefficients (e,) with standard errors (e,) fit the description.
        nearby: returns similar explanations to try where this one fits well; by default none.
        harmful_from: size of the first coefficient from which the explanation is harmful even if
            the estimate of the last link does not change with it.
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
        """The name of the check and the joint; a log's findings name each subject once."""
        return self.name, self.joint

    @property
    def family(self) -> tuple[object, ...]:
        """Key of explanations of which only the best one is scored with noise estimated anew."""
        return *self.subject, len(self.spread), self.choices

    def of_joint(self, joint: int) -> Array:
        """Return the columns (K, e) at a joint on which the explanation acts [N m].

        They are per prior standard deviation of each coefficient. ``joint`` is the joint's index.
        """
        columns = self.columns[:, joint] if self.joint is None else self.columns
        return columns * self.spread


def _first_coefficient(
    text: str, factor: float = 1.0, unit: str = "", shift: float = 0.0, **fields: Any
) -> Description:
    """Return a function that fills the first coefficient and its error into a text at {value}.

    Args:
        text: description of the fault, with {value} where the number goes, if it is shown.
        factor: factor from the coefficient's unit to ``unit``.
        unit: unit of the number in the text; "" for none.
        shift: added to the coefficient before it is multiplied by the factor.
        fields: further fields of the text and what stands there, such as the joint's name.
    """

    def describe(v: Array, e: Array) -> str:
        """Return the text for coefficients v (e,) with standard errors e (e,)."""
        value = factor * (float(v[0]) + shift)
        return text.format(value=with_error(value, abs(factor) * e[0], unit), **fields)

    return describe


def _norm(text: str, factor: float, unit: str, **fields: Any) -> Description:
    """Return a function that fills the coefficients' Euclidean norm into a text at {value}.

    The largest standard error stands for that of the norm. ``text``, ``factor``, ``unit`` and
    ``fields`` are as in ``_first_coefficient``.
    """
    describe_number = _first_coefficient(text, factor, unit, **fields)

    def describe(v: Array, e: Array) -> str:
        """Return the text for coefficients v (e,) with standard errors e (e,)."""
        return describe_number(np.array([np.linalg.norm(v)]), np.array([np.max(e)]))

    return describe


def _of_each_joint(
    fit: BaseFit,
    name: str,
    torque: Array,
    spread: float,
    text: str,
    factor: float,
    unit: str,
    shift: float = 0.0,
) -> Iterator[Explanation]:
    """Yield one warning per joint, that has one coefficient and acts at this joint alone.

    Args:
        fit: the fitted base model.
        name: name of the check.
        torque: (K, n) torque at each joint per unit of its coefficient [N m].
        spread: prior standard deviation of each coefficient.
        text: description of the fault, with {joint} and {value}.
        factor: as in ``_first_coefficient``, like ``unit`` and ``shift``.
    """
    spreads = np.array([spread])
    for joint, joint_name in enumerate(fit.robot.joint_names):
        column = torque[:, [joint]]
        describe = _first_coefficient(text, factor, unit, shift, joint=joint_name)
        yield Explanation(name, Level.WARN, column, spreads, describe, joint)


def torque_scales(fit: BaseFit) -> Iterator[Explanation]:
    """Yield an error of each joint's torque scale: the coefficient is the scale minus 1.

    It scales the torque of the links alone, not that of friction and rotors.
    """
    text = "torque of joint {joint} reads {value} what links and the other joints say; weigh a "
    text += "known mass (payload --known-mass) and pass the file that it writes as --torque-scale"
    yield from _of_each_joint(
        fit,
        "torque-scale",
        fit.rigid,
        spread=0.3,
        text=text,
        factor=1.0,
        unit="times",
        shift=1.0,
    )


def drifting_scales(fit: BaseFit) -> Iterator[Explanation]:
    """Yield torque scales that drift linearly over the log: of all joints alike, then of each."""
    text = "changes its scale by {value} over the log; let motors and sensors warm up, and record "
    text += "again"
    drifting = fit.rigid * fit.time[:, None]
    # The time runs from -1 to 1, so that a scale changes by twice its coefficient.
    to_percent = 200.0
    describe = _first_coefficient(f"the torque of all joints {text}", to_percent, "%")
    columns = drifting[:, :, None]
    spread = np.array([0.1])
    yield Explanation("torque-scale", Level.WARN, columns, spread, describe)
    yield from _of_each_joint(
        fit,
        "torque-scale",
        drifting,
        spread=0.15,
        text=f"the torque of joint {{joint}} {text}",
        factor=to_percent,
        unit="%",
    )


def zeros(fit: BaseFit) -> Iterator[Explanation]:
    """Yield a constant error of each joint's position; its coefficient is the error [rad]."""
    text = "the position of joint {joint} reads {value} too much; correct its zero"
    spread = np.array([0.1])
    for name in fit.robot.joint_names:
        columns = fit.log.columns_of([f"zero[{name}]"])
        describe = _first_coefficient(text, unit="rad", joint=name)
        zero = Explanation("zero", Level.WARN, columns, spread, describe)
        yield replace(zero, harmful_from=GROSS_ZERO)


def tilt(fit: BaseFit) -> Iterator[Explanation]:
    """Yield a tilt of the base, by two angles [rad]; nothing where the model has no gravity."""
    if np.any(gravity_vector(fit.robot)):
        text = "the base is tilted by {value} against the model's; level it, or turn the model"
        to_degrees = float(np.degrees(1.0))
        describe = _norm(text, to_degrees, "degrees")
        columns = fit.log.columns_of(TILT_NAMES)
        spread = np.full(len(TILT_NAMES), 0.15)
        yield Explanation("tilt", Level.WARN, columns, spread, describe)


def time_base(fit: BaseFit) -> Iterator[Explanation]:
    """Yield two errors of the time stamps' scale: a constant one, and one that also drifts.

    Time stamps that are too long by a small share s make accelerations and squared speeds too small
    by 2 s, so they change inertial torque alone. The coefficients are s in the middle of the log
    and, with drift, the change of s from there to the end.
    """
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
        yield Explanation(
            "clock", Level.WARN, columns, spread, describe, harmful_from=0.0
        )


def _too_long(share: float) -> str:
    """Return "3 % too long" for a share of 0.03, "3 % too short" for -0.03."""
    return f"{percent(abs(float(share)))} too {'long' if share > 0.0 else 'short'}"


def delays(fit: BaseFit) -> Iterator[Explanation]:
    """Yield a lag of the torque behind the position: of all joints alike, then of each one.

    A torque that lags by a short time d is tau(t - d), nearly tau(t) - d tau'(t). The coefficient
    is d [s].
    """
    late = -fit.derivative(fit.rigid)
    text = "torque lags position by {value}; record both at the same instant"
    describe = _first_coefficient(text, factor=1e3, unit="ms")
    spread = 0.04
    columns = late[:, :, None]
    yield Explanation("delay", Level.WARN, columns, np.array([spread]), describe)
    text = "torque of joint {joint} alone lags position by {value}; record all joints at once"
    yield from _of_each_joint(fit, "delay", late, spread, text, factor=1e3, unit="ms")


def weight_share(fit: BaseFit) -> Iterator[Explanation]:
    """Yield the fault that a share of the weight of links and load is missing from the torque.

    The coefficients (5,) are the change of the links' weight, as a share that is negative where
    weight is missing, and the mass [kg] and first moments [kg m] by which the last link's weight
    differs.
    """
    text = "{value} of the links' weight is missing from the torque: is there a spring balancer "
    text += "that the model lacks, or is gravity compensated in part? record the measured joint "

    def is_missing(v: Array, e: Array) -> bool:
        """Return whether the share v[0] ± e[0] lacks between 5 % and all of the weight."""
        return bool(-1.0 - 3.0 * e[0] < v[0] < -0.05)

    yield Explanation(
        "gravity",
        Level.REFUSE,
        columns=np.concatenate((fit.weight[:, :, None], fit.last_weight), axis=-1),
        spread=np.append(0.5, parameter_scale(0.1 * fit.robot.mass, 0.1)[:4]),
        # In per cent, positive where weight is missing.
        describe=_first_coefficient(f"{text}torque, not the command", -100.0, "%"),
        is_possible=is_missing,
    )


def payload_steps(fit: BaseFit) -> Iterator[Explanation]:
    """Yield a change of the last link's load at each of ``STEPS`` evenly spaced instants."""
    start, end = fit.log.motion.time[[0, -1]]
    instants, spacing = np.linspace(start, end, STEPS + 2, retstep=True)
    for instant in instants[1:-1].tolist():
        yield _payload_step(fit, instant, float(spacing), STEPS)


def _payload_step(
    fit: BaseFit, instant: float, spacing: float, choices: int
) -> Explanation:
    """Return the explanation that the last link's load changes at an instant [s].

    Its coefficients are the changes of the last link's ten inertial parameters; an instant that is
    off by half a row moves them by several standard errors.

    Args:
        fit: the fitted base model.
        instant: first instant with the changed load [s].
        spacing: time between the instants that are tried [s].
        choices: number of instants that are tried without refinement.
    """
    row_period = float(np.median(np.diff(fit.log.motion.time)))
    mass = 0.3 * PAYLOAD * fit.robot.mass
    size = 0.5 * REACH * fit.robot.length

    def nearby() -> list[Explanation]:
        """Return steps at eleven instants around this one, a sixth of the spacing apart."""
        finer = spacing / 6.0
        instants = instant + finer * np.arange(-5, 6)
        return [_payload_step(fit, at, finer, choices) for at in instants.tolist()]

    def describe(v: Array, e: Array) -> str:
        """Return the text for coefficients v (e,) with standard errors e (e,)."""
        # The torque scale multiplies the load, which the base model's scales do not know of.
        error = math.hypot(e[0], fit.scale_error * v[0])
        change = with_error(abs(float(v[0])), error, "kg")
        return (
            f"from about {instant:.3g} s on the last link carries {change} "
            f"{'more' if v[0] > 0.0 else 'less'}: was something picked up, dropped or moved? "
            "record each state in a log of its own"
        )

    return Explanation(
        "payload-step",
        Level.REFUSE,
        fit.last_link * fit.share_after(instant)[:, None, None],
        parameter_scale(mass, size),
        describe,
        choices=choices,
        nearby=nearby if spacing > 0.2 * row_period else list,
    )


def forces(fit: BaseFit) -> Iterator[Explanation]:
    """Yield a constant force on the last link, then a weight of it that contradicts its inertia.

    The coefficients (12,) of the force are those of ``BaseFit.tip_force``; those (4,) of the weight
    are the mass and first moments by which the weight differs (``BaseFit.last_weight``).
    """
    total = fit.robot.mass
    down = float(np.linalg.norm(gravity_vector(fit.robot))) or 9.81
    text = "a constant force of {value} acts on the last link, as of a hand, a cable or a spring; "
    advice = "take it away, and record again"
    describe_force = _norm(f"{text}{advice}", factor=1.0, unit="N")
    # Per axis the force, then the force times its offset (0.1 m) along x, y and z of the link.
    spread = 0.1 * total * down * np.tile((1.0, 0.1, 0.1, 0.1), 3)
    force = slice(None, None, 4)

    def describe(v: Array, e: Array) -> str:
        """Return the text for coefficients v (12,) with standard errors e (12,)."""
        return describe_force(v[force], e[force])

    def is_sure(v: Array, e: Array) -> bool:
        """Return whether the force in v (12,) exceeds three times its standard error in e (12,)."""
        return bool(np.linalg.norm(v[force]) > 3.0 * np.max(e[force]))

    yield Explanation(
        "force", Level.REFUSE, fit.tip_force, spread, describe, is_possible=is_sure
    )
    text = "the last link weighs {value} more than its inertia says: something holds a part of it, "
    text += "or pulls, as a hand or a hose does; take it away, record again"
    carried = _first_coefficient(text, unit="kg")
    spread = parameter_scale(0.1 * total, 0.1)[:4]
    yield Explanation("force", Level.REFUSE, fit.last_weight, spread, carried)


def springs(fit: BaseFit) -> Iterator[Explanation]:
    """Yield a torque at each joint in its position q, sin q and cos q, as of a spring or hose."""
    text = "at joint {joint} a torque follows the position, as of a spring, a balancer or a hose; "
    text += "the model has to have it, or take it away"
    for joint, name in enumerate(fit.robot.joint_names):
        q = fit.log.motion.q[:, joint]
        shapes = np.stack((q, np.sin(q), np.cos(q)), axis=1)
        spread = np.full(3, 0.5 * fit.log.typical_torque[joint])
        describe = _first_coefficient(text, joint=name)
        yield Explanation("force", Level.REFUSE, shapes, spread, describe, joint)


def hums(fit: BaseFit) -> Iterator[Explanation]:
    """Yield the strongest sine over time in each joint's residual torque.

    The frequencies that are tried go from 2 periods per log to 0.4 periods per row, in steps of a
    quarter of a period per log.
    """
    time = fit.log.motion.time - fit.log.motion.time[0]
    span = float(time[-1])
    step = float(np.median(np.diff(time)))
    rates = np.arange(2.0 / span, 0.4 / step, 0.25 / span)
    waves = np.exp(2j * np.pi * np.outer(rates, time))
    power = np.abs(waves @ fit.residual) ** 2
    text = "torque of joint {joint} hums: a sine of {rate:.2g} Hz and {value} that neither motion "
    text += "nor friction makes; find its source"
    for joint, name in enumerate(fit.robot.joint_names):
        best = int(np.argmax(power[:, joint]))
        describe = _norm(text, factor=1.0, unit="N m", joint=name, rate=rates[best])
        columns, spread = _sinusoid(fit, joint, waves[best])
        yield Explanation(
            "contact", Level.WARN, columns, spread, describe, joint, len(rates)
        )


def _sinusoid(
    fit: BaseFit, joint: int, wave: NDArray[np.complex128]
) -> tuple[Array, Array]:
    """Return columns (K, 2) of a cosine and a sine at one joint, and the spread (2,) of both [N m].

    They are real and imaginary part of ``wave`` (K,); their sum has any phase.
    """
    columns = np.stack((wave.real, wave.imag), axis=1)
    return columns, np.full(2, 0.1 * fit.log.typical_torque[joint])


def ripples(fit: BaseFit) -> Iterator[Explanation]:
    """Yield each joint's strongest residual torque that is periodic in position, as of cogging.

    The numbers of waves per turn that are tried are ``RIPPLES``.
    """
    text = "torque of joint {joint} ripples about {count} times per turn by {value}, as of "
    text += "cogging; errors count it as noise"
    for joint, name in enumerate(fit.robot.joint_names):
        waves = np.exp(1j * np.outer(fit.log.motion.q[:, joint], RIPPLES))
        best = int(np.argmax(np.abs(fit.residual[:, joint] @ waves)))
        count = RIPPLES[best]
        describe = _norm(text, factor=1.0, unit="N m", joint=name, count=count)
        columns, spread = _sinusoid(fit, joint, waves[:, best])
        yield Explanation(
            "ripple", Level.NOTE, columns, spread, describe, joint, len(RIPPLES)
        )


def couplings(fit: BaseFit) -> Iterator[Explanation]:
    """Yield, for each motor that may turn several joints, the friction and inertia of its rotor.

    The coefficients (3,) are its Coulomb and viscous friction and its rotor inertia. These
    explanations compete, but ``is_possible`` rules out that they are reported: the estimate reports
    couplings, and uses them only with clear evidence.
    """
    speed = np.max(rms(fit.log.motion.qd))
    acceleration = np.max(rms(fit.log.motion.qdd))
    # Typical sizes of what Coulomb, viscous friction and rotor inertia are multiplied by.
    units = np.array([1.0, speed, acceleration])
    for motor in fit.log.columns.couplings:
        name = motor.name
        terms = (f"coulomb[{name}]", f"viscous[{name}]", f"armature[{name}]")
        columns = fit.log.columns_of(terms)
        size = 0.3 * float(np.min(fit.log.typical_torque[motor.ratios != 0.0]))
        describe = _first_coefficient("one motor turns with joints {joint}", joint=name)
        coupling = Explanation("coupling", Level.NOTE, columns, size / units, describe)
        yield replace(coupling, is_possible=lambda v, e: False)


def crosstalk(fit: BaseFit) -> Iterator[Explanation]:
    """Yield torque sensors that also read a share of the torque of the joint before or after."""
    text = "the torque of joint {joint} holds {value} of that of joint {other}; calibrate its "
    text += "sensor"
    names = fit.robot.joint_names
    typical_torque = fit.log.typical_torque
    for joint, name in enumerate(names):
        for neighbour in (joint - 1, joint + 1):
            if not 0 <= neighbour < len(names):
                continue
            ratio = typical_torque[joint] / typical_torque[neighbour]
            spread = np.array([0.1 * min(1.0, ratio)])
            column = fit.rigid[:, [neighbour]]
            other = names[neighbour]
            describe = _first_coefficient(text, 100.0, "%", joint=name, other=other)
            yield Explanation("crosstalk", Level.WARN, column, spread, describe, joint)


def warming(fit: BaseFit) -> Iterator[Explanation]:
    """Yield friction that falls as gears warm up, with each of the time constants ``WARM_UP``.

    Nothing is yielded for a log no longer than the first of them. The coefficients (n,) are each
    joint's Coulomb friction at the start of the log minus the value to which it decays
    exponentially [N m].
    """
    time = fit.log.motion.time - fit.log.motion.time[0]
    if time[-1] <= WARM_UP[0]:
        return
    coulomb = fit.log.columns_of(names_of("coulomb", fit.robot.joint_names))
    sizes = np.abs(fit.values[fit.log.friction_indices("coulomb")])
    spread = 0.5 * np.maximum(sizes, 0.01 * fit.log.typical_torque)
    text = "friction falls over the log; let the arm warm up before it is recorded"
    describe = _first_coefficient(text)
    for constant in WARM_UP:
        columns = coulomb * np.exp(-time / constant)[:, None, None]
        yield Explanation(
            "friction", Level.NOTE, columns, spread, describe, choices=len(WARM_UP)
        )


LINEAR: tuple[Callable[[BaseFit], Iterator[Explanation]], ...] = (
    torque_scales,
    drifting_scales,
    zeros,
    tilt,
    time_base,
    delays,
    weight_share,
    payload_steps,
    forces,
    springs,
    hums,
    ripples,
    couplings,
    crosstalk,
    warming,
)
"""Functions that take the fitted base model and yield explanations, all linear in coefficients."""


def explanations(fit: BaseFit) -> list[Explanation]:
    """Return the explanations that all functions of ``LINEAR`` yield for a fitted base model."""
    return list(chain.from_iterable(function(fit) for function in LINEAR))
