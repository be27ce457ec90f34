"""What an arm's numbers are: the fit, params.json, console, page and model files read one record.

Friction terms are a table of these in ``dynamics.friction``. Here are the parameters of bodies and
those of sensors and base.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from robot_sysid.records.arm import RobotModel
from robot_sysid.records.arrays import Array
from robot_sysid.records.data import Motion
from robot_sysid.records.messages import torque_unit
from robot_sysid.spatial import PARAMETER_NAMES

Torque = Callable[[Array, Array, Array, Array], Array]
"""Function that returns a joint's torque from directions of motion (-1 to 1), velocities [rad/s],
accelerations [rad/s^2] and loads of the gear [N m], arrays of one shape."""


def _no_torque(sign: Array, qd: Array, qdd: Array, load: Array) -> Array:
    """Return zeros: what is neither friction nor rotor has no torque of its own joint's motion."""
    return 0.0 * qd


@dataclass(frozen=True)
class Parameter:
    """One number of an arm; an entry of a table is that of any joint (``at``).

    Attributes:
        name: what it is, as params.json has it.
        label: what it is, in words; "" where the name says it.
        units: in a hinge and in a slide, or one for both.
        formula: torque per unit, as a program computes it from the joint's speed ``qd``, its
            acceleration ``qdd`` and the torque ``load`` that its gear transmits; "" where that does
            not depend on these alone.
        torque: the formula as a function.
        is_dry: whether the torque jumps where the joint reverses, or all but jumps.
        is_coulomb: whether it is the dry friction that stays at any speed.
        is_friction: whether the torque takes power, and changes with temperature.
        lower, upper: bounds where no prior stands in their place.
        prior: standard deviation where a friction model lacks the term, over the joint's dry
            friction and the prior "friction"; 0 of a term that is then taken to be nothing.
        attribute: of a joint that holds it in a compiled model; "" where none does.
        entry: of the attribute, where that is an array; None where it is a number.
        over_top: whether its torque is a function of the speed over the joint's top speed, at which
            its friction is flat, in place of the speed.
        yields: whether it is held at its bound before others are that cross theirs.
        of: joint or motor that has it; "" for the arm, and in a table.
        is_slide: whether that is a slide.
        body: link or payload that has it, which its name says; "" for the last link.
    """

    name: str
    label: str = ""
    units: tuple[str, ...] = ("",)
    formula: str = ""
    torque: Torque = _no_torque
    is_dry: bool = False
    is_coulomb: bool = False
    is_friction: bool = True
    lower: float = -np.inf
    upper: float = np.inf
    prior: float = 0.0
    attribute: str = ""
    entry: int | None = None
    over_top: bool = False
    yields: bool = False
    of: str = ""
    is_slide: bool = False
    body: str = ""

    def column(self, motion: Motion, top: Array | float = 1.0) -> Array:
        """Return the torque per unit (N, n) of n joints without load.

        ``top`` (n,) are the speeds at which their friction is flat.
        """
        qd = motion.qd
        return self.of_state(np.sign(qd), qd, motion.qdd, 0.0 * qd, top)

    def of_state(
        self, sign: Array, qd: Array, qdd: Array, load: Array, top: Array | float
    ) -> Array:
        """Return the torque per unit of joints in some states, arrays of one shape.

        ``top`` are the speeds at which their friction is flat, in a shape that fits.
        """
        return self.torque(sign, qd / top if self.over_top else qd, qdd, load)

    @property
    def key(self) -> str:
        """Its name among all parameters of an arm, such as "coulomb[joint6]"."""
        return self.key_of(self.of)

    @property
    def words(self) -> str:
        """What it is, and whose: "rotor inertia of joint6"."""
        return f"{self.label or self.name} of {self.of or self.body or 'the last link'}"

    @property
    def unit(self) -> str:
        """The unit of its values."""
        return self.units[-1 if self.is_slide else 0]

    @property
    def is_dry_torque(self) -> bool:
        """Whether it is a dry torque, which slow motion alone tells from Coulomb friction."""
        return self.is_dry and self.unit == torque_unit(self.is_slide)

    def stated_value(self, robot: RobotModel) -> Array:
        """Return the model's value (n,) of each joint; zero of what no file holds."""
        if not self.attribute:
            return np.zeros(robot.n_joints)
        return self.values_in(robot.mj_model, "dof")[robot.dof_index]

    def values_in(self, mj_model: Any, kind: str) -> Array:
        """Return a compiled model's values of all its joints ("dof") or tendons ("tendon")."""
        count = mj_model.nv if kind == "dof" else mj_model.ntendon
        # Older releases of MuJoCo lack polynomials, and rotors of tendons.
        missing = np.zeros(count if self.entry is None else (count, self.entry + 1))
        values = getattr(mj_model, f"{kind}_{self.attribute}", missing)
        return values if self.entry is None else values[:, self.entry]

    def at(self, owner: str, is_slide: bool = False) -> Parameter:
        """Return the parameter of a joint or motor."""
        return replace(self, of=owner, is_slide=is_slide)

    def key_of(self, owner: str) -> str:
        """Return the name of a joint's or motor's parameter among all of an arm."""
        return f"{self.name}[{owner}]" if owner else self.name


def keys_of(parameters: Iterable[Parameter]) -> tuple[str, ...]:
    """Return the names of parameters among all of an arm."""
    return tuple(parameter.key for parameter in parameters)


def drift_of(parameters: Iterable[Parameter]) -> tuple[Parameter, ...]:
    """Return the changes of parameters from the middle of several recordings to the last."""
    return tuple(
        Parameter(
            f"{each.name}_drift", units=each.units, of=each.of, is_slide=each.is_slide
        )
        for each in parameters
    )


INERTIAL = (
    Parameter("m", "mass", ("kg",)),
    *(Parameter(f"h{axis}", f"CoM moment {axis}", ("kg·m",)) for axis in "xyz"),
    *(Parameter(n, f"inertia {n[1:]}", ("kg·m²",)) for n in PARAMETER_NAMES[4:]),
)
"""The ten inertial parameters of a body, inertia about the origin of its frame."""


def of_body(name: str) -> tuple[Parameter, ...]:
    """Return the inertial parameters of a body other than the last link, such as "m(forearm)"."""
    return tuple(
        replace(each, name=f"{each.name}({name})", body=name) for each in INERTIAL
    )


SCALE = Parameter("scale", "error of the torque scale")
"""Share by which a torque reads too large."""
DRIFT = Parameter("drift")
"""Change of friction from the middle of several recordings to the last, as a share."""
ZERO = Parameter("zero", "encoder zero", ("rad", "m"))
"""Position that an encoder reads too large."""
TILTS = (
    Parameter("tilt_1", "tilt of the base, first axis", ("rad",)),
    Parameter("tilt_2", "tilt of the base, second axis", ("rad",)),
)
"""Angles by which a base is tilted."""
DELAY = Parameter("delay", "delay of the torque", ("s",))
"""Time by which a torque is later than the position."""
