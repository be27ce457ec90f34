"""Measured torques beside predicted ones, sample by sample: what a report draws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records.arm import InertialParameters, JointLimits
from robot_sysid.records.arrays import Array

SIGNALS = ("q", "qd", "measured", "predicted", "before", "friction")


@dataclass(frozen=True)
class Signals:
    """K instants of all n joints whose torque was used.

    Attributes:
        joints: their names.
        is_slide: (n,) whether a joint is a slide.
        time: (K,) [s].
        q, qd: (K, n) positions and velocities [rad, rad/s].
        measured: (K, n) torque [N m]; NaN where a sample was not used.
        predicted: (K, n) torque that the result predicts [N m].
        before: (K, n) torque that was predicted before: by the model as it is in its file, of a
            payload by the arm without it [N m].
        friction: (K, n) the part of ``predicted`` that friction makes [N m].
    """

    joints: tuple[str, ...]
    is_slide: tuple[bool, ...]
    time: Array
    q: Array
    qd: Array
    measured: Array
    predicted: Array
    before: Array
    friction: Array

    def __post_init__(self) -> None:
        shape = (len(self.time), len(self.joints))
        for name in SIGNALS:
            if np.shape(getattr(self, name)) != shape:
                raise InputError(f"{name} has shape {np.shape(getattr(self, name))}, not {shape}")


@dataclass(frozen=True)
class Traces(Signals):
    """All instants of a result; the time starts anew with each log.

    Attributes:
        limits: of these joints.
        truth: what a simulated arm's link really is; None where nobody knows.
    """

    limits: JointLimits
    truth: InertialParameters | None = None

    @property
    def residual(self) -> Array:
        """Measured minus predicted torque (K, n) [N m]; NaN where a sample was not used."""
        return self.measured - self.predicted
