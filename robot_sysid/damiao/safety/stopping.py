"""A stop that carries: it brakes from where the joints were led, and lets go of nothing they held.

A motor holds an arm by its feed-forward torque and by kp times the distance between the reference
and the joint. A stop that moves the reference to where the joint is takes that second part away,
and a weak motor's joint falls. So the reference brakes from where it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid.damiao.references import Reference
from robot_sysid.damiao.safety.bounds import CommandRange
from robot_sysid.damiao.safety.samples import Mask
from robot_sysid.records import Array

# Torque that holds a joint without moving it is given back within this time [s], until the joint
# has moved so far [rad]: then it was its load and not an obstacle.
_RELIEF_TIME = 0.3
_RELIEF_MOVED = 0.01
# A joint that leaves its way is stiffened by the computer, through the feed-forward torque. It sees
# what is one and a half cycles old, which takes damping away: half of the motor's at most.
_DELAY_CYCLES = 1.5
_DAMPING_SHARE = 0.5
_MOST_STIFFENING = 4.0
# It pulls harder on a joint that leaves than on one that comes back: so it takes energy away. Full
# difference at about this speed [rad/s].
_STEADY = 0.6
_LEAVING = 0.4
_SPEED_SCALE = 0.3
# The feed-forward torque changes over to what carries the arm at rest in this time at least [s].
_BLEND_TIME = 0.1
# Judgements: joints slower than this are at rest [rad/s].
_REST_SPEED = 0.05


@dataclass(frozen=True)
class StopStart:
    """What is known when a stop begins, each (n,).

    Attributes:
        reference: what the joints should have done.
        q, qd: where they are believed to be, and how fast; NaN where that is unknown [rad, rad/s].
        fed: torque that carries the arm at rest, by its model or as fed forward before [N m].
        kp, kd: stiffness and damping of the motors [N m/rad, N m s/rad].
        stuck: joints that stand still against their motor: nothing more is pushed there.
        command_range: how far commands may go.
    """

    reference: Reference
    q: Array
    qd: Array
    fed: Array
    kp: Array
    kd: Array
    stuck: Mask
    command_range: CommandRange


class CarriedStop:
    """A reference that brakes all joints together and then carries them.

    - It brakes at ``deceleration`` [rad/s^2] from the reference; a joint that is slower than its
      reference from its own speed, and one that goes the other way from rest.
    - The distance between reference and joint stays, and with it the torque that it makes.
    - What a joint does not need to stay where it is, is given back: it may lean on an obstacle.
    - A joint that leaves its way, under its load or thrown by another joint, is held stiffer.

    ``q`` and ``qd`` (n,), as believed last, are to be set in every cycle; NaN where unknown.
    ``last`` is the last reference. Joints are at rest when they have stood for ``rest_time`` [s].
    """

    def __init__(
        self, start: StopStart, deceleration: float, period: float, rest_time: float
    ) -> None:
        self.q: Array = start.q
        self.qd: Array = start.qd
        self.last = start.reference
        self._start = start
        self._rest_time = rest_time
        self._moved_at = 0.0
        led = start.reference.velocity
        speed = np.where(np.isfinite(start.qd), start.qd, led)
        self._velocity = np.clip(speed, np.minimum(led, 0.0), np.maximum(led, 0.0))
        self.duration = float(np.max(np.abs(self._velocity), initial=0.0)) / deceleration
        self._offset = np.nan_to_num(start.reference.position - start.q)
        stable = _DAMPING_SHARE * start.kd / (_DELAY_CYCLES * period)
        self._stiffening = np.minimum(stable, _MOST_STIFFENING * start.kp)
        self._relief = np.where(start.stuck, 1.0, 0.0)
        self._reached = start.q
        self._has_moved = np.zeros(len(led), dtype=bool)
        self._time = 0.0

    def __call__(self, time: float) -> Reference:
        """Return the reference at ``time`` [s] after the beginning; times never go back."""
        start = self._start
        braked = min(max(time, 0.0), self.duration)
        left = 1.0 - braked / self.duration if self.duration > 0.0 else 0.0
        position = start.reference.position + self._velocity * braked * (1.0 + left) / 2.0
        position = np.clip(position, start.command_range.lower, start.command_range.upper)
        goal = position - self._offset
        displaced = self._displacement(goal)
        self._relieve(time, np.nan_to_num(goal - self.q))
        share = min(time / max(self.duration, _BLEND_TIME), 1.0)
        fed = start.reference.torque + share * (start.fed - start.reference.torque)
        leaving = -np.sign(displaced) * np.nan_to_num(self.qd)
        lift = self._stiffening * displaced * (_STEADY + _LEAVING * np.tanh(leaving / _SPEED_SCALE))
        relief_torque = self._relief * start.kp * self._offset
        if braked < self.duration or np.any(np.abs(np.nan_to_num(self.qd)) > _REST_SPEED):
            self._moved_at = time
        self.last = Reference(position, self._velocity * left, fed + lift - relief_torque)
        return self.last

    def _displacement(self, goal: Array) -> Array:
        """Return how far joints (n,) are off the way that they have come and have to go [rad]."""
        ahead = np.fmax(self._reached, np.fmin(self.q, goal))
        behind = np.fmin(self._reached, np.fmax(self.q, goal))
        self._reached = np.where(self._velocity < 0.0, behind, ahead)
        lowest = np.fmin(self._reached, goal)
        highest = np.fmax(self._reached, goal)
        return np.nan_to_num(np.clip(self.q, lowest, highest) - self.q)

    def _relieve(self, time: float, moved: Array) -> None:
        passed = time - self._time
        self._time = time
        if time <= self.duration:
            return
        self._has_moved |= np.abs(moved) > _RELIEF_MOVED
        less = (1.0 - self._relief) * min(passed / _RELIEF_TIME, 1.0)
        self._relief = np.where(self._has_moved, self._relief, self._relief + less)

    @property
    def is_at_rest(self) -> bool:
        """Whether all joints whose speed is known have stood still for a while."""
        return self._time - self._moved_at > self._rest_time
