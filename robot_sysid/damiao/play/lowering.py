"""Lowering an arm that nothing supports: each joint slowly yields to its load."""

from __future__ import annotations

import numpy as np

from robot_sysid.damiao.play.sampler import Reference
from robot_sysid.records import Array

# Share of the peak torque at which a joint yields with full speed; less load, less speed.
_FULL_LOAD = 0.05
_FADE = 1.0
_STILL_SPEED, _STILL_TIME = 0.02, 0.5
LONGEST = 20.0
"""After this time [s] the arm counts as lowered."""


class Lowering:
    """A reference that gives way to the torque its joints carry.

    What is fed forward fades within a second, so that the position control carries the load and
    the measured torque tells it. Each reference position then moves against that torque, no faster
    than ``speed``, until the arm lies or hangs.

    Args:
        begin: where the arm is held.
        speed: highest joint speed [rad/s].
        peak: (n,) the motors' peak torques [N m].

    Attributes:
        torque: (n,) measured last [N m]; NaN where unknown. To be set in every cycle.
        done: whether no joint has yielded for half a second.
    """

    def __init__(self, begin: Reference, speed: float, peak: Array) -> None:
        self._position, self._fed = begin.position.copy(), begin.torque
        self._speed, self._full_load = speed, _FULL_LOAD * peak
        self.torque: Array = np.full(len(peak), np.nan)
        self._time = self._moved_at = 0.0

    def __call__(self, time: float) -> Reference:
        """Return the reference at ``time`` [s] after the beginning; times never go back."""
        share = np.clip(np.nan_to_num(self.torque) / self._full_load, -1.0, 1.0)
        faded = max(1.0 - time / _FADE, 0.0)
        velocity = np.zeros_like(share) if faded > 0.0 else -self._speed * share
        self._position = self._position + velocity * (time - self._time)
        self._time = time
        if faded > 0.0 or np.max(np.abs(velocity)) > _STILL_SPEED:
            self._moved_at = time
        return Reference(self._position, velocity, faded * self._fed)

    @property
    def done(self) -> bool:
        """See the class."""
        return self._time - self._moved_at > _STILL_TIME
