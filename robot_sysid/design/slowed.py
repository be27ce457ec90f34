"""The same path, slower: for the first run of a trajectory on an arm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Motion, MotionPlan


@dataclass(frozen=True)
class SlowedTrajectory:
    """A trajectory scaled in time: q(s t), s q'(s t), s^2 q''(s t).

    Attributes:
        plan: the trajectory at full speed.
        speed: factor s, 0 < s <= 1; a faster motion would leave the limits it was made for.
    """

    plan: MotionPlan
    speed: float

    def __post_init__(self) -> None:
        if not 0.0 < self.speed <= 1.0:
            raise InputError(
                f"--speed must be above 0 and at most 1 (got {self.speed:g}): the trajectory was "
                "made for full speed and can only be slowed down"
            )

    @property
    def duration(self) -> float:
        """Length [s]."""
        return self.plan.duration / self.speed

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return self.plan.n_joints

    def evaluate(self, time: Array) -> Motion:
        """Return the motion at times (N,) [s]; exact derivatives."""
        time = np.asarray(time, dtype=float)
        # Rounding must not carry the last sample beyond the end.
        motion = self.plan.evaluate(np.minimum(self.speed * time, self.plan.duration))
        return Motion(time, motion.q, self.speed * motion.qd, self.speed**2 * motion.qdd)


def at_speed(plan: MotionPlan, speed: float) -> MotionPlan:
    """Return the trajectory at a share of its speed; 1 returns it as it is."""
    return plan if speed == 1.0 else SlowedTrajectory(plan, speed)
