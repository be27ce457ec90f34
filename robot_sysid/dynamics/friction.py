"""Joint friction as columns that are linear in their coefficients.

The torque of friction (and of the other per-joint effects that a torque channel contains) is
tau_f = sum_k c_k phi_k(qd, qdd, load). Each phi_k is one named term:

===========  ============================  ==========================================
term         column                        coefficient's unit (hinge joint)
===========  ============================  ==========================================
coulomb      sign(qd)                      N m
viscous      qd                            N m s/rad
offset       1                             N m (torque sensor or current offset)
armature     qdd                           kg m^2 (rotor inertia seen through the gear)
sqrt         sign(qd) sqrt(abs(qd))        N m (s/rad)^0.5
stribeck     sign(qd) exp(-(qd/vs)^2)      N m (breakaway above Coulomb)
load         sign(qd) abs(load)            1 (loss of a gear that grows with its load)
quadratic    qd abs(qd)                    N m s^2/rad^2
cubic        qd^3                          N m s^3/rad^3
sigmoid      tanh(qd/vs)                   N m (Coulomb friction that turns round softly)
fading_fast  sign(qd) exp(-abs(qd)/0.04)   N m (friction above Coulomb that fades with speed)
fading       sign(qd) exp(-abs(qd)/0.13)   N m
fading_slow  sign(qd) exp(-abs(qd)/0.4)    N m
===========  ============================  ==========================================

Coulomb friction that differs between the two directions is coulomb plus, and minus, offset.
Viscous, quadratic and cubic terms are the polynomial of a joint's ``damping="a b c"`` in MuJoCo.

Sources: Coulomb, viscous and Stribeck terms as in Armstrong-Helouvry, Dupont, Canudas de Wit,
"A survey of models, analysis tools and compensation methods for the control of machines with
friction", Automatica 30(7), 1994, eq. 4; load term as in Hamon, Gautier, Garrec, "Dynamic
identification of robots with a dry friction model depending on load and velocity", IROS 2010.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import Array


@dataclass(frozen=True)
class BentTerm:
    """A term whose column depends on one more number, a speed vs.

    Attributes:
        column, slope: of velocities (...) and vs [rad/s]; its derivative by vs.
        usual: vs where nothing is known of it [rad/s].
        tried: speeds worth trying, ascending; vs is sought from half the first to twice the last.
            Stribeck velocities of geared joints lie between 0.01 and 0.3 rad/s at the output.
    """

    column: Callable[[Array, Array | float], Array]
    slope: Callable[[Array, Array | float], Array]
    usual: float
    tried: tuple[float, ...]

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and largest vs [rad/s]."""
        return 0.5 * self.tried[0], 2.0 * self.tried[-1]


def _stribeck(qd: Array, speed: Array | float) -> Array:
    # Numbers near 1e-308 take a hundred times as long to multiply.
    size = (qd / speed) ** 2
    return np.asarray(np.sign(qd) * np.where(size < 200.0, np.exp(-size), 0.0))


_STRIBECK = BentTerm(
    _stribeck,
    lambda qd, speed: _stribeck(qd, speed) * 2.0 * qd**2 / speed**3,
    usual=0.1,
    tried=(0.02, 0.05, 0.1, 0.2),
)
# The square of cosh(300) is the last one that is a number.
_SIGMOID = BentTerm(
    lambda qd, speed: np.sign(qd) * np.tanh(np.abs(qd) / speed),
    lambda qd, speed: (
        -qd / (speed * np.cosh(np.minimum(np.abs(qd / speed), 300.0))) ** 2
    ),
    usual=0.05,
    tried=(0.01, 0.03, 0.1, 0.3),
)
FADING_SPEEDS: Mapping[str, float] = {
    "fading_fast": 0.04,
    "fading": 0.13,
    "fading_slow": 0.4,
}
"""Term to the speed over which it fades [rad/s]: together they follow any friction that falls with
speed, whatever its own speed is."""


def _fading(qd: Array, qdd: Array, load: Array, fading_speed: float) -> Array:
    # Numbers near 1e-308 take a hundred times as long to multiply.
    decay = np.minimum(np.abs(qd) / fading_speed, 200.0)
    return np.asarray(np.sign(qd) * np.exp(-decay))


BENT: Mapping[str, BentTerm] = {"stribeck": _STRIBECK, "sigmoid": _SIGMOID}
"""Terms that are nonlinear in one parameter; the fit of a whole arm seeks it too."""

TERMS: Mapping[str, Callable[[Array, Array, Array], Array]] = {
    "coulomb": lambda qd, qdd, load: np.sign(qd),
    "viscous": lambda qd, qdd, load: qd,
    "offset": lambda qd, qdd, load: np.ones_like(qd),
    "armature": lambda qd, qdd, load: qdd,
    "sqrt": lambda qd, qdd, load: np.sign(qd) * np.sqrt(np.abs(qd)),
    "stribeck": lambda qd, qdd, load: _STRIBECK.column(qd, _STRIBECK.usual),
    "load": lambda qd, qdd, load: np.sign(qd) * np.abs(load),
    "quadratic": lambda qd, qdd, load: qd * np.abs(qd),
    "cubic": lambda qd, qdd, load: qd * qd * qd,
    "sigmoid": lambda qd, qdd, load: _SIGMOID.column(qd, _SIGMOID.usual),
    **{
        name: partial(_fading, fading_speed=speed)
        for name, speed in FADING_SPEEDS.items()
    },
}
"""Term name to the function that makes its column, see ``FrictionModel.columns``; a new term is one
more line here. Those of ``BENT`` take their usual speed."""

DEFAULT_MEASURED = "coulomb-viscous-offset-armature"
"""Friction model for measured data."""


@dataclass(frozen=True)
class FrictionModel:
    """Which friction terms a joint has: names of ``TERMS``, in the order of the columns."""

    terms: tuple[str, ...]

    def __post_init__(self) -> None:
        if len(set(self.terms)) != len(self.terms):
            raise InputError(
                f"friction terms {list(self.terms)} name a term twice; use each once"
            )

    @property
    def name(self) -> str:
        """The terms joined by "-", or "none"."""
        return "-".join(self.terms) or "none"

    @property
    def non_negative(self) -> tuple[bool, ...]:
        """Per term, whether a physical joint has a coefficient >= 0.

        An offset has no sign. The square-root term bends the curve either way and, where it is
        present, only the sum with the viscous term is bound to brake, so neither has one.
        """
        free = {"offset", "sqrt"} | ({"viscous"} if "sqrt" in self.terms else set())
        return tuple(term not in free for term in self.terms)

    @property
    def bent(self) -> tuple[str, ...]:
        """Those of its terms that are nonlinear in a speed."""
        return tuple(term for term in self.terms if term in BENT)

    def parameter_names(self, joint: str) -> tuple[str, ...]:
        """Return the parameter name of each column, for instance ``coulomb[joint6]``."""
        return tuple(f"{term}[{joint}]" for term in self.terms)

    def columns(self, qd: Array, qdd: Array, load: Array) -> Array:
        """Return one joint's regressor columns (N, k) at velocities, accelerations and torques
        that its gear transmits (N,) [rad/s, rad/s^2, N m].
        """
        columns = [TERMS[term](qd, qdd, load) for term in self.terms]
        return np.stack(columns).T if columns else np.empty((len(qd), 0))


def speed_name(term: str, joint: str) -> str:
    """Return the name of a bent term's speed, for instance ``stribeck_speed[joint6]``."""
    return f"{term}_speed[{joint}]"


def friction_model(name: str) -> FrictionModel:
    """Return the friction model with this name: "none", or terms joined by "-" or "+"; a leading
    "+" adds to the default for measured data, so "+sqrt" is "coulomb-viscous-offset-armature-sqrt".
    """
    terms = () if name == "none" else tuple(re.split(r"[-+]", name.lstrip("+")))
    if name.startswith("+"):
        usual = tuple(DEFAULT_MEASURED.split("-"))
        terms = usual + tuple(term for term in terms if term not in usual)
    unknown = [term for term in terms if term not in TERMS]
    if unknown:
        known = f"join any of {', '.join(TERMS)} with '-', as in {DEFAULT_MEASURED}, or use none"
        raise InputError(f"unknown friction term {unknown[0]!r} in {name!r}; {known}")
    return FrictionModel(terms)


_COUPLED = FrictionModel(("coulomb", "viscous", "armature", "sqrt", "stribeck"))


@dataclass(frozen=True)
class Coupling:
    """One motor that turns with several joints.

    Attributes:
        ratios: (n,) motor speed per joint speed, zero for joints it does not turn with.
        name: such as ``joint_5+joint_6``.
        model: (terms,) what the model has of each of its parameters.
        tendon: MuJoCo id of the fixed tendon that is this motor; None where the model has none.
    """

    ratios: Array
    name: str
    model: Array = field(default_factory=lambda: np.zeros(len(_COUPLED.terms)))
    tendon: int | None = None

    @property
    def terms(self) -> tuple[str, ...]:
        """Friction terms of its own speed; offset and load stay with the joints."""
        return _COUPLED.terms

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of its parameters, such as ``coulomb[joint_5+joint_6]``."""
        return _COUPLED.parameter_names(self.name)

    def columns(self, qd: Array, qdd: Array) -> Array:
        """Return its torque (N, terms) per unit of each parameter, of the joints' velocities and
        accelerations (N, n); each joint feels it times its ratio.
        """
        speed = qd @ self.ratios
        return _COUPLED.columns(speed, qdd @ self.ratios, np.zeros_like(speed))
