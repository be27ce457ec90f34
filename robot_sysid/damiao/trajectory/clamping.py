"""Keeping a trajectory within the motors' limits, and telling what had to change."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from robot_sysid.damiao.protocol.joints import DamiaoJoint
from robot_sysid.damiao.protocol.motors import MotorSpec
from robot_sysid.records import Array

_RPM_PER_RAD_S = 60.0 / (2.0 * np.pi)


@dataclass
class ClampTally:
    """Clamps chunks to the motors' limits and counts what it changed.

    Attributes:
        joints: the motors, base to terminal.
        samples: rows seen so far.
        clamped: (n,) rows in which at least one value of the joint was changed.
        peak_velocity, peak_torque: (n,) largest magnitudes before clamping [rad/s, N m].
    """

    joints: tuple[DamiaoJoint, ...]
    samples: int = 0
    clamped: Array = field(init=False)
    peak_velocity: Array = field(init=False)
    peak_torque: Array = field(init=False)

    def __post_init__(self) -> None:
        self.clamped = np.zeros(len(self.joints))
        self.peak_velocity = np.zeros(len(self.joints))
        self.peak_torque = np.zeros(len(self.joints))

    def clamp(self, q: Array, qd: Array, tau: Array) -> tuple[Array, Array, Array]:
        """Return the chunk within the motors' limits, counting what had to change."""
        limits = np.array([joint.spec.limits for joint in self.joints]).T
        self.peak_velocity = np.maximum(self.peak_velocity, np.abs(qd).max(axis=0))
        self.peak_torque = np.maximum(self.peak_torque, np.abs(tau).max(axis=0))
        inside = [np.clip(x, -limit, limit) for x, limit in zip((q, qd, tau), limits)]
        changed = np.any([a != b for a, b in zip((q, qd, tau), inside)], axis=0)
        self.clamped += changed.sum(axis=0)
        self.samples += len(q)
        return inside[0], inside[1], inside[2]

    @property
    def clamped_percent(self) -> Array:
        """Share of rows (n,) with a changed value [%]."""
        return np.asarray(100.0 * self.clamped / max(self.samples, 1))

    def warnings(self, supply: float | None) -> Iterator[str]:
        """Yield a sentence per joint and limit or rating that the trajectory exceeds.

        Args:
            supply: voltage that no-load speeds are taken at [V]; None takes each type's own.
        """
        for j, joint in enumerate(self.joints):
            if self.clamped[j]:
                yield (
                    f"{joint.label}: {self.clamped_percent[j]:.2f} % of the samples were clamped "
                    f"to the limits of a {joint.motor_type}; use a stronger motor or a slower "
                    "trajectory"
                )
            yield from rating_warnings(joint, self.peak_velocity[j], self.peak_torque[j], supply)


def rating_warnings(
    joint: DamiaoJoint, velocity: float, torque: float, supply: float | None = None
) -> Iterator[str]:
    """Yield a sentence for each rating of a motor that a peak velocity or torque exceeds.

    Args:
        joint: the motor.
        velocity, torque: largest magnitudes asked for [rad/s, N m].
        supply: supply voltage [V]; None takes the type's own.
    """
    spec = joint.spec
    yield from _torque_warnings(joint.label, spec, torque)
    top = spec.no_load_speed(supply)
    if top is not None and velocity > top:
        volts = spec.supply if supply is None else supply
        yield (
            f"{joint.label}: {velocity:.2f} rad/s ({velocity * _RPM_PER_RAD_S:.0f} rpm) exceeds "
            f"the no-load speed of a {spec.name} at {volts:g} V, {top:.2f} rad/s; "
            "it cannot follow"
        )


def _torque_warnings(label: str, spec: MotorSpec, torque: float) -> Iterator[str]:
    for limit, name, remedy in (
        (spec.peak_torque, "peak", "it cannot follow"),
        (spec.rated_torque, "rated", "fine for a moment, too hot for long"),
    ):
        if limit is not None and torque > limit:
            yield (
                f"{label}: {torque:.2f} N m exceeds the {name} torque of a {spec.name}, "
                f"{limit:g} N m; {remedy}"
            )
            return
