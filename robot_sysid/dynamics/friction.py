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
stribeck     sign(qd) exp(-(qd/0.1)^2)     N m (breakaway above Coulomb)
load         sign(qd) abs(load)            1 (loss of a gear that grows with its load)
sigmoid      tanh(qd/0.05)                 N m (Coulomb friction with a smooth reversal)
fading_fast  sign(qd) exp(-abs(qd)/0.04)   N m (friction above Coulomb that fades with speed)
fading       sign(qd) exp(-abs(qd)/0.13)   N m
fading_slow  sign(qd) exp(-abs(qd)/0.4)    N m
===========  ============================  ==========================================

Coulomb friction that differs between the two directions is coulomb plus, and minus, offset.

Sources: Coulomb, viscous and Stribeck terms as in Armstrong-Helouvry, Dupont, Canudas de Wit,
"A survey of models, analysis tools and compensation methods for the control of machines with
friction", Automatica 30(7), 1994, eq. 4; load term as in Hamon, Gautier, Garrec, "Dynamic
identification of robots with a dry friction model depending on load and velocity", IROS 2010.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import Array


def _fading(qd: Array, qdd: Array, load: Array, speed: float, power: int = 1) -> Array:
    """Return sign(qd) exp(-(abs(qd) / speed)^power) (N,), as a column of ``TERMS``.

    Args:
        qd: (N,) velocities [rad/s].
        qdd, load: (N,) accelerations and loads, which have no effect.
        speed: at which 1/e of the friction is left [rad/s].
        power: of the speed.
    """
    # Arithmetic with numbers near 1e-308 is a hundred times slower.
    decay = np.minimum((np.abs(qd) / speed) ** power, 200.0)
    return np.sign(qd) * np.exp(-decay)


FADING_SPEEDS: Mapping[str, float] = {
    "fading_fast": 0.04,
    "fading": 0.13,
    "fading_slow": 0.4,
}
"""Term to the speed at which 1/e of it is left [rad/s]. A sum of these terms approximates any
friction that falls with speed."""

TERMS: Mapping[str, Callable[[Array, Array, Array], Array]] = {
    "coulomb": lambda qd, qdd, load: np.sign(qd),
    "viscous": lambda qd, qdd, load: qd,
    "offset": lambda qd, qdd, load: np.ones_like(qd),
    "armature": lambda qd, qdd, load: qdd,
    "sqrt": lambda qd, qdd, load: np.sign(qd) * np.sqrt(np.abs(qd)),
    "stribeck": partial(_fading, speed=0.1, power=2),
    "load": lambda qd, qdd, load: np.sign(qd) * np.abs(load),
    "sigmoid": lambda qd, qdd, load: np.tanh(qd / 0.05),
    **{term: partial(_fading, speed=v) for term, v in FADING_SPEEDS.items()},
}
"""Term name to the function that returns its column (N,) from velocities [rad/s],
accelerations [rad/s^2] and loads of the gear [N m], (N,) each; a new term is one more line."""

DRY_TERMS = ("coulomb", "sqrt", "stribeck", "sigmoid", *FADING_SPEEDS)
"""Terms whose columns depend on a speed alone and are not smooth where it changes sign."""

DEFAULT_MEASURED = "coulomb-viscous-offset-armature"
"""Name of the default friction model for measured data."""


def split_name(name: str) -> tuple[str, str]:
    """Return (term, joint or motor) of a parameter's name such as "coulomb[joint6]".

    The second one is "" for a parameter without brackets, such as one of a body.
    """
    term, _, owner = name.partition("[")
    return term, owner[:-1]


def names_of(term: str, joints: Iterable[str]) -> tuple[str, ...]:
    """Return the names of a term's parameters, one per joint, such as "scale[joint6]"."""
    return tuple(f"{term}[{joint}]" for joint in joints)


def friction_terms(name: str) -> tuple[str, ...]:
    """Return the terms of a friction model: "none", or names of ``TERMS`` joined by "-" or "+".

    A leading "+" adds terms to the default for measured data, so "+sqrt" is
    "coulomb-viscous-offset-armature-sqrt".

    Raises:
        InputError: a term is unknown, or named twice.
    """
    terms = () if name == "none" else tuple(re.split(r"[-+]", name.lstrip("+")))
    if name.startswith("+"):
        default = tuple(DEFAULT_MEASURED.split("-"))
        terms = default + tuple(term for term in terms if term not in default)
    for term in terms:
        if term not in TERMS:
            raise InputError(
                f"unknown friction term {term!r} in {name!r}; join any of {', '.join(TERMS)} with "
                f"'-', as in {DEFAULT_MEASURED}, or use none"
            )
    if len(set(terms)) != len(terms):
        raise InputError(
            f"friction terms {list(terms)} name a term twice; use each once"
        )
    return terms


@dataclass(frozen=True)
class Coupling:
    """One motor that turns with several joints.

    Attributes:
        terms: names of the friction terms, which depend on the motor's speed; offset and load are
            terms of the joints alone.
        ratios: (n,) motor speed per joint speed, zero for joints it does not turn with.
        name: such as ``joint_5+joint_6``.
        model: (len(terms),) the robot model's value of each parameter, in the order of ``terms``;
            zeros by default.
        tendon: MuJoCo id of the fixed tendon that is this motor; None where the model has none.
    """

    ratios: Array
    name: str
    model: Array = field(default_factory=lambda: np.zeros(3))
    tendon: int | None = None
    terms: ClassVar[tuple[str, ...]] = ("coulomb", "viscous", "armature")

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the motor's parameters, such as ``coulomb[joint_5+joint_6]``."""
        return tuple(f"{term}[{self.name}]" for term in self.terms)
