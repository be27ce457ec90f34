"""Joint friction as columns that are linear in their coefficients.

The torque of friction (and of the other per-joint effects that a torque channel contains) is
tau_f = sum_k c_k phi_k(qd, qdd, load). Each phi_k is the formula of an entry of ``TERMS``, which
says all that there is to say of it: a new term is one more entry of ``_OTHERS``. Fit, plan, files,
tables and messages read it from there.

Coulomb friction that differs between the two directions is coulomb plus, and minus, offset.

Friction of gears bends: it grows with speed, and the slower the faster the joint turns. Below a
speed ``top`` it is, beside dry and viscous friction,

    bend (3 u - 3 u |u| + u^3),   u = qd / top,   bend >= 0,

whose slope 3 bend (1 - |u|)^2 / top is nowhere negative: it flattens towards ``top`` and never
falls, so that no value of ``bend`` drives a joint. It is what a joint's ``damping="a b c"`` holds,
a qd + b qd |qd| + c qd^3 (MuJoCo 3.7), and one number: three free ones fit a log as well and are
many times as wrong at other speeds.

Sources: Coulomb, viscous and Stribeck terms as in Armstrong-Helouvry, Dupont, Canudas de Wit,
"A survey of models, analysis tools and compensation methods for the control of machines with
friction", Automatica 30(7), 1994, eq. 4; load term as in Hamon, Gautier, Garrec, "Dynamic
identification of robots with a dry friction model depending on load and velocity", IROS 2010.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from robot_sysid.records import Array, RobotModel
from robot_sysid.records.parameters import Parameter
from robot_sysid.records.usual_errors import CURVATURE, FADING

TOP_OVER_FASTEST = 1.25
"""Speed at which friction is flat, over the highest speed of a log: a little beyond it, so that
nothing in the log speaks of the flat part."""
TOP_OVER_LIMIT = 0.4
"""Least such speed, over the joint's speed limit: slow logs show the beginning of the curve alone,
which would otherwise be flat where the arm usually moves."""
LEAST_TOP = 1.0
"""Least such speed where no limit is stated [rad/s or m/s]."""

STRIBECK_SPEED = 0.1
"""Speed above which breakaway has faded, of the term of this name [rad/s or m/s]."""
SIGMOID_SPEED = 0.05
"""Speed at which Coulomb friction of a smooth reversal is three quarters of itself [rad/s or
m/s]."""
LARGEST_EXPONENT = 200.0
"""Exponents from which exp(-x) counts as one number, 1e-87: denormal numbers, from 708 on, are a
hundred times slower."""

_TORQUE = ("N·m", "N")


def _decay(exponent: Array) -> Array:
    """Return exp(-exponent), where the exponent counts up to ``LARGEST_EXPONENT``."""
    return np.exp(-np.minimum(exponent, LARGEST_EXPONENT))


class FrictionTerm(Parameter):
    """An entry of ``TERMS``, or that of a joint or motor.

    It is pickled by its name, as results are: a function without a name cannot be.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how pickle makes the object again: from the table."""
        return _term_of, (self.name, self.of, self.is_slide)


def _term_of(name: str, owner: str, is_slide: bool) -> Parameter:
    """Return the parameter of a joint or motor by the name of its term."""
    return TERMS[name].at(owner, is_slide)


def _fading_term(name: str, speed: float) -> FrictionTerm:
    """Return friction that fades with speed, of which 1/e is left at a speed [rad/s].

    A sum of several approximates any friction that falls with speed.
    """
    return FrictionTerm(
        name,
        units=_TORQUE,
        formula=f"sign(qd) * exp(-abs(qd) / {speed:g})",
        torque=lambda sign, qd, qdd, load: sign * _decay(np.abs(qd) / speed),
        is_dry=True,
        lower=0.0,
        prior=FADING,
    )


COULOMB = FrictionTerm(
    "coulomb",
    "Coulomb friction",
    _TORQUE,
    "sign(qd)",
    lambda sign, qd, qdd, load: sign,
    is_dry=True,
    is_coulomb=True,
    lower=0.0,
    attribute="frictionloss",
)
"""Dry friction, the same at any speed."""
VISCOUS = FrictionTerm(
    "viscous",
    "viscous friction",
    ("N·m·s/rad", "N·s/m"),
    "qd",
    lambda sign, qd, qdd, load: qd,
    lower=0.0,
    attribute="damping",
)
"""Friction in proportion to speed."""
OFFSET = FrictionTerm(
    "offset",
    "torque offset",
    _TORQUE,
    "1",
    lambda sign, qd, qdd, load: np.ones_like(qd),
    is_friction=False,
)
"""Offset of a sensor of torque or current, which no file holds."""
ROTOR = FrictionTerm(
    "armature",
    "rotor inertia",
    ("kg·m²", "kg"),
    "qdd",
    lambda sign, qd, qdd, load: qdd,
    is_friction=False,
    lower=0.0,
    attribute="armature",
)
"""Rotor inertia, seen through the gear."""
BEND = FrictionTerm(
    "bend",
    "bend of friction",
    _TORQUE,
    "3 * (qd / top) - 3 * (qd / top) * abs(qd / top) + (qd / top)**3",
    lambda sign, qd, qdd, load: qd * (3.0 - 3.0 * np.abs(qd) + qd**2),
    over_top=True,
    yields=True,
    lower=0.0,
    prior=CURVATURE,
)
"""Friction that flattens towards a speed and never falls."""
QUADRATIC = FrictionTerm(
    "quadratic",
    "damping by speed squared",
    ("N·m·s²/rad²", "N·s²/m²"),
    "qd * abs(qd)",
    lambda sign, qd, qdd, load: qd * np.abs(qd),
    attribute="dampingpoly",
    entry=0,
)
"""Second coefficient of a joint's damping, as a model may state it."""
CUBIC = FrictionTerm(
    "cubic",
    "damping by speed cubed",
    ("N·m·s³/rad³", "N·s³/m³"),
    "qd**3",
    lambda sign, qd, qdd, load: qd * qd**2,
    attribute="dampingpoly",
    entry=1,
)
"""Third coefficient of a joint's damping, as a model may state it."""
_OTHERS = (
    # It bends the curve of friction, either way.
    FrictionTerm(
        "sqrt",
        units=("N·m·√(s/rad)", "N·√(s/m)"),
        formula="sign(qd) * sqrt(abs(qd))",
        torque=lambda sign, qd, qdd, load: sign * np.sqrt(np.abs(qd)),
        is_dry=True,
    ),
    _fading_term("fading_fast", 0.04),
    _fading_term("fading", 0.13),
    _fading_term("fading_slow", 0.4),
    # Breakaway above Coulomb friction.
    FrictionTerm(
        "stribeck",
        "Stribeck friction",
        _TORQUE,
        f"sign(qd) * exp(-(qd / {STRIBECK_SPEED})**2)",
        lambda sign, qd, qdd, load: sign * _decay((qd / STRIBECK_SPEED) ** 2),
        is_dry=True,
        lower=0.0,
    ),
    # Share of its load that a gear loses: with half of it, the gear would lock backwards.
    FrictionTerm(
        "load",
        formula="sign(qd) * abs(load)",
        torque=lambda sign, qd, qdd, load: sign * np.abs(load),
        is_dry=True,
        lower=0.0,
        upper=0.3,
        prior=1.0,
    ),
    # Coulomb friction with a smooth reversal.
    FrictionTerm(
        "sigmoid",
        units=_TORQUE,
        formula=f"tanh(qd / {SIGMOID_SPEED})",
        torque=lambda sign, qd, qdd, load: np.tanh(qd / SIGMOID_SPEED),
        is_dry=True,
        is_coulomb=True,
        lower=0.0,
    ),
)
TERMS: Mapping[str, FrictionTerm] = {
    term.name: term
    for term in (COULOMB, VISCOUS, OFFSET, ROTOR, BEND, QUADRATIC, CUBIC, *_OTHERS)
}
"""Name of each friction term to what it is."""


POLYNOMIAL = (QUADRATIC, CUBIC)
"""What a joint's damping holds beside the linear part."""
CHOICES = tuple(name for name, term in TERMS.items() if term not in POLYNOMIAL)
"""Names of the terms that a friction model may have: polynomials are what a model states."""


def top_speeds(fastest: Array, limits: Array) -> Array:
    """Return the speeds (n,) at which friction of joints or motors is flat [rad/s or m/s].

    Args:
        fastest: (n,) highest speeds of the logs.
        limits: (n,) speed limits; infinite where none is stated.
    """
    of_limit = np.where(np.isfinite(limits), TOP_OVER_LIMIT * limits, LEAST_TOP)
    return np.maximum(TOP_OVER_FASTEST * fastest, of_limit)


def polynomial(viscous: float, bend: float, top: float) -> tuple[float, float, float]:
    """Return a, b, c of damping a qd + b qd |qd| + c qd^3 from viscous friction and a bend."""
    return viscous + 3.0 * bend / top, -3.0 * bend / top**2, bend / top**3


def stated_top(damping: Array, quadratic: Array, cubic: Array) -> Array:
    """Return the speed (n,) at which stated dampings are flat, or least steep; 0 of other ones.

    That is -b / 3c of a polynomial that bends downwards, b < 0 < c, and nowhere falls: the same
    curve as viscous friction and ``bend``.
    """
    cubic = np.maximum(cubic, 1e-300)
    is_bend = (quadratic < 0.0) & (cubic > 1e-300)
    # A falling one is no bend, whatever it was written for; a written one is flat but for rounding.
    is_bend &= damping * (1.0 + 1e-9) >= quadratic**2 / (3.0 * cubic)
    return np.where(is_bend, -quadratic / (3.0 * cubic), 0.0)


def stated_tops(robot: RobotModel) -> Array:
    """Return ``stated_top`` of each joint of an arm (n,), as its model states friction."""
    quadratic, cubic = (term.stated_value(robot) for term in POLYNOMIAL)
    return stated_top(robot.friction.viscous, quadratic, cubic)


@dataclass(frozen=True)
class Coupling:
    """One motor that turns with several joints.

    Attributes:
        terms: its friction terms, which depend on the motor's speed; offset and load are terms of
            the joints alone.
        ratios: (n,) motor speed per joint speed, zero for joints it does not turn with.
        name: such as ``joint_5+joint_6``.
        model: (len(terms),) the robot model's value of each parameter, in the order of ``terms``;
            zeros by default.
        tendon: MuJoCo id of the fixed tendon that is this motor; None where the model has none.
        top: motor speed at which its friction is flat.
        stated_top: that of the model, if its friction bends; else 0.
    """

    ratios: Array
    name: str
    model: Array = field(default_factory=lambda: np.zeros(3))
    tendon: int | None = None
    top: float = LEAST_TOP
    stated_top: float = 0.0
    terms: ClassVar = (COULOMB, VISCOUS, ROTOR)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The motor's parameters, such as ``coulomb[joint_5+joint_6]``."""
        return tuple(term.at(self.name) for term in self.terms)

    def stated_value(self, parameter: Parameter, mj_model: Any) -> float:
        """Return a compiled model's value of a parameter of this motor; 0 where it states none."""
        if self.tendon is None or not parameter.attribute:
            return 0.0
        return float(np.ravel(parameter.values_in(mj_model, "tendon")[self.tendon])[0])
