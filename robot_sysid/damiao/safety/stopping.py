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
# A joint that leaves its way is stiffened and damped by the computer, through the feed-forward
# torque, which acts on what is one and a half cycles old. That takes damping away at one frequency
# or another, so both are shares of the motor's own: of kd, and of kd per delay. With these, no
# energy goes into a joint of any inertia or flexibility, also when samples are two cycles older;
# more of either makes light or flexible joints swing.
_DELAY_CYCLES = 1.5
_ADDED_DAMPING = 0.25
_ADDED_STIFFNESS = 0.8
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
    - A joint that leaves its way, under its load or thrown by another joint, is held stiffer and
      damped more, as far as its motor's own damping allows.

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
        self.duration = (
            float(np.max(np.abs(self._velocity), initial=0.0)) / deceleration
        )
        self._offset = np.nan_to_num(start.reference.position - start.q)
        self._stiffening = _ADDED_STIFFNESS * start.kd / (_DELAY_CYCLES * period)
        self._relief = np.where(start.stuck, 1.0, 0.0)
        self._reached = start.q
        self._has_moved = np.zeros(len(led), dtype=bool)
        self._time = 0.0

    def __call__(self, time: float) -> Reference:
        """Return the reference at ``time`` [s] after the beginning; times never go back."""
        start = self._start
        position, velocity = self._braking_path(time)
        goal = position - self._offset
        self._relieve(time, goal)
        relief_torque = self._relief * start.kp * self._offset
        holding_torque = self._lift(goal) + self._damping_torque(velocity)
        torque = self._carrying_torque(time) + holding_torque - relief_torque
        self._note_motion(time)
        self.last = Reference(position, velocity, torque)
        return self.last

    def _braking_path(self, time: float) -> tuple[Array, Array]:
        """Return position and velocity (n,) of the reference: it slows down evenly, then stands."""
        braked = min(max(time, 0.0), self.duration)
        share_left = 1.0 - braked / self.duration if self.duration > 0.0 else 0.0
        position = self._start.reference.position
        position = position + self._velocity * braked * (1.0 + share_left) / 2.0
        command_range = self._start.command_range
        position = np.clip(position, command_range.lower, command_range.upper)
        return position, self._velocity * share_left

    def _carrying_torque(self, time: float) -> Array:
        """Return the feed-forward torque (n,): from that of the path to what carries at rest."""
        last_torque = self._start.reference.torque
        share = min(time / max(self.duration, _BLEND_TIME), 1.0)
        return last_torque + share * (self._start.fed - last_torque)

    def _lift(self, goal: Array) -> Array:
        """Return the torque (n,) that pulls joints back to their way, more so as they leave it."""
        displacement = self._displacement(goal)
        leaving_speed = -np.sign(displacement) * np.nan_to_num(self.qd)
        share = _STEADY + _LEAVING * np.tanh(leaving_speed / _SPEED_SCALE)
        return np.asarray(self._stiffening * displacement * share)

    def _damping_torque(self, velocity: Array) -> Array:
        """Return the torque (n,) against speeds other than that of the reference."""
        return np.asarray(
            _ADDED_DAMPING * self._start.kd * np.nan_to_num(velocity - self.qd)
        )

    def _displacement(self, goal: Array) -> Array:
        """Return how far joints (n,) are off the way that they have come and have to go [rad]."""
        ahead = np.fmax(self._reached, np.fmin(self.q, goal))
        behind = np.fmin(self._reached, np.fmax(self.q, goal))
        self._reached = np.where(self._velocity < 0.0, behind, ahead)
        lowest = np.fmin(self._reached, goal)
        highest = np.fmax(self._reached, goal)
        return np.nan_to_num(np.clip(self.q, lowest, highest) - self.q)

    def _relieve(self, time: float, goal: Array) -> None:
        """Give back more of what holds joints that stand, once the reference stands at ``goal``."""
        passed = time - self._time
        self._time = time
        if time <= self.duration:
            return
        self._has_moved |= np.abs(np.nan_to_num(goal - self.q)) > _RELIEF_MOVED
        less = (1.0 - self._relief) * min(passed / _RELIEF_TIME, 1.0)
        self._relief = np.where(self._has_moved, self._relief, self._relief + less)

    def _note_motion(self, time: float) -> None:
        is_moving = np.abs(np.nan_to_num(self.qd)) > _REST_SPEED
        if time < self.duration or np.any(is_moving):
            self._moved_at = time

    @property
    def is_at_rest(self) -> bool:
        """Whether all joints whose speed is known have stood still for a while."""
        return self._time - self._moved_at > self._rest_time
