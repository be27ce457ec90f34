"""Does a motion show a joint's dry friction in full?

MuJoCo's ``frictionloss`` is not Coulomb's law but a ramp in velocity and acceleration that ends at
the Coulomb level: torque = clip(D (qdd + b qd), -fc, +fc). D and b follow from the constraint
settings and the inertia the joint had when the model was compiled. On a joint without armature the
ramp can be so wide that a slow motion never leaves it; the torque is then viscous friction D b and
inertia D, and no data can give fc. ``RampUse`` counts how often each joint was past its ramp.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.records import Array, checked_array
from robot_sysid.records.options import PerJoint
from robot_sysid.signals.process import USUAL_DEADBAND

STANDSTILL = 1e-6
"""Highest speed of a joint that is taken not to move at all [rad/s]."""
_FULL = 1e-6


@dataclass(frozen=True)
class FrictionRamp:
    """The ramps of all joints.

    Attributes:
        coulomb: (n,) level at which each ramp ends, fc [N m]; 0 for a joint without dry friction.
        inertia: (n,) slope in acceleration, D [kg m^2].
        rate: (n,) b, so that D b is the slope in velocity [1/s].
    """

    coulomb: Array
    inertia: Array
    rate: Array

    def __post_init__(self) -> None:
        size = np.shape(self.coulomb)[0]
        for name in ("coulomb", "inertia", "rate"):
            object.__setattr__(self, name, checked_array(getattr(self, name), (size,), name))

    @property
    def viscous(self) -> Array:
        """Viscous friction that each ramp looks like from within, D b (n,) [N m s/rad]."""
        return self.inertia * self.rate


class RampUse:
    """Counts, joint by joint, the samples whose dry friction has its full size.

    Args:
        joints: (n,) joint names.
        ramp: their ramps.
    """

    def __init__(self, joints: tuple[str, ...], ramp: FrictionRamp) -> None:
        self._joints, self._ramp = joints, ramp
        self._samples = 0
        self._full = np.zeros(len(joints), dtype=np.int64)
        self._speed = np.zeros(len(joints))
        self._ramp_speed = np.zeros(len(joints))

    def add(self, qd: Array, dry: Array) -> None:
        """Count a chunk.

        Args:
            qd: (N, n) velocities.
            dry: (N, n) resisting dry friction torques [N m].
        """
        full = dry * np.sign(qd) >= (1.0 - _FULL) * self._ramp.coulomb
        speed = np.abs(qd)
        self._samples += len(qd)
        self._full += np.count_nonzero(full, axis=0)
        self._speed = np.maximum(self._speed, np.max(speed, axis=0))
        on_ramp = np.max(np.where(full, 0.0, speed), axis=0)
        self._ramp_speed = np.maximum(self._ramp_speed, on_ramp)

    @property
    def share(self) -> Array:
        """Share of the samples (n,) with full dry friction; 1 for joints that have none."""
        counted = self._full / max(self._samples, 1)
        return np.where(self._ramp.coulomb > 0.0, counted, 1.0)

    @property
    def ramp_speed(self) -> Array:
        """Highest speed (n,) at which dry friction was not complete [rad/s].

        Leaving out all slower samples makes Coulomb's law exact for the rest.
        """
        return np.where(self._ramp.coulomb > 0.0, self._ramp_speed, 0.0)

    @property
    def never_full(self) -> tuple[str, ...]:
        """Names of the joints whose dry friction never reaches its full size."""
        return tuple(name for name, share in zip(self._joints, self.share) if share == 0.0)

    def sentences(self, deadband: PerJoint | None = None) -> tuple[str, ...]:
        """Return what the user should know, one sentence each.

        Args:
            deadband: speed below which samples are going to be left out [rad/s]; None stands for
                the usual share of each joint's highest speed.
        """
        moving = self._speed >= STANDSTILL
        never = (self.share == 0.0) & moving
        left_out = USUAL_DEADBAND * self._speed if deadband is None else deadband
        partly = (self.ramp_speed > left_out) & ~never & moving
        still = (self._ramp.coulomb > 0.0) & ~moving
        found = [self._never(int(j)) for j in np.flatnonzero(never)]
        found += [self._partly(np.flatnonzero(partly))] if np.any(partly) else []
        found += [
            f"{self._joints[j]} does not move, so its friction does not show in the data"
            for j in np.flatnonzero(still)
        ]
        return tuple(found)

    def _never(self, j: int) -> str:
        coulomb, viscous = self._ramp.coulomb[j], self._ramp.viscous[j]
        return (
            f"the frictionloss of {self._joints[j]} ({coulomb:.3g} N m) is never reached: in "
            "MuJoCo it builds up with speed and is complete only above about "
            f"{coulomb / viscous:.2g} rad/s, and this motion stays below {self._speed[j]:.2g} "
            f"rad/s. It acts as {viscous:.2g} N m s/rad of extra viscous friction, so its Coulomb "
            "coefficient cannot be identified; give the joint armature in the plant model or let "
            "it move faster"
        )

    def _partly(self, joints: NDArray[np.int64]) -> str:
        listed = ", ".join(f"{self._joints[j]} {self._ramp_speed[j]:.2g}" for j in joints)
        highest = float(np.max(self._ramp_speed[joints]))
        return (
            f"MuJoCo's frictionloss is incomplete below these speeds in rad/s: {listed}. Friction "
            "coefficients come out wrong unless slower samples are left out "
            f"(--velocity-deadband {_rounded_up(highest):g} covers all joints); armature in the "
            "plant model lowers these speeds"
        )


def _rounded_up(value: float) -> float:
    """Return the next number of two digits that is not smaller."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / step) * step:.2g}")
