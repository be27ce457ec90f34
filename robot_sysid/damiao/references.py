"""Joint references as functions of time, also for a stop.

A motor holds an arm by its feed-forward torque and by kp times the distance between the reference
and the joint. A stop that sets the reference to the joint's position would remove the second
torque, and the joint of a weak motor would fall. So ``CarriedStop`` keeps this distance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from robot_sysid.damiao.safety.plausibility import Mask
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.damiao.trajectory import DamiaoTrajectory
from robot_sysid.records import Array, Limits


class Reference(NamedTuple):
    """State commanded to n joints at one moment.

    Attributes:
        position: (n,) [rad].
        velocity: (n,) [rad/s].
        torque: feed-forward torque (n,) [N m].
    """

    position: Array
    velocity: Array
    torque: Array


ReferenceFunction = Callable[[float], Reference]
"""Returns the reference at a time since its phase began [s]; called with non-decreasing times."""


def trajectory_reference(
    trajectory: DamiaoTrajectory, speed: float
) -> ReferenceFunction:
    """Return a trajectory, interpolated between its rows, as a function of time.

    The feed-forward torque is that of the file: at reduced
    speed its inertial share is too large, which the position control compensates.

    Args:
        trajectory: trajectory with at least two rows.
        speed: factor of the file's velocities; its times are divided by this factor.
    """

    def reference(time: float) -> Reference:
        """Return the trajectory's state at ``time`` [s] of playing since its first row."""
        position, velocity, torque = trajectory.sampled(np.array(time * speed))
        return Reference(position, velocity * speed, torque)

    return reference


def transfer_reference(
    start: Reference,
    target: Reference,
    speed: float,
    shortest: float,
    carries: Callable[[Array], Array],
) -> tuple[ReferenceFunction, float]:
    """Return a straight motion from rest at ``start`` to rest at ``target``, and its duration [s].

    After a share s of the time it has covered the share 10 s^3 - 15 s^4 + 6 s^5 of the line; the
    peak speed is 15/8 = 1.875 of the mean speed.

    Args:
        start: begin; its velocity is ignored.
        target: end; its velocity is ignored.
        speed: velocity that no joint exceeds [rad/s].
        shortest: least duration [s].
        carries: returns the torque (n,) [N m] that carries the arm in a pose (n,) [rad]. The
            feed-forward torque is this plus a difference, interpolated along the line, so that it
            equals the torques of ``start`` and ``target`` at the ends.
    """
    line = target.position - start.position
    duration = max(shortest, 15.0 / 8.0 * np.max(np.abs(line)) / speed)
    extra_at_start = start.torque - carries(start.position)
    extra_at_target = target.torque - carries(target.position)

    def reference(time: float) -> Reference:
        """Return the state at ``time`` [s] after the beginning."""
        s = min(max(time / duration, 0.0), 1.0)
        share = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
        share_per_second = 30.0 * s * s * (1.0 - s) ** 2 / duration
        q = start.position + share * line
        extra = (1.0 - share) * extra_at_start + share * extra_at_target
        return Reference(q, share_per_second * line, carries(q) + extra)

    return reference, duration


def hold_reference(reference: Reference) -> ReferenceFunction:
    """Return a function of time that always returns a reference's position and torque, at rest."""
    at_rest = reference._replace(velocity=np.zeros_like(reference.velocity))
    return lambda time: at_rest


@dataclass(frozen=True)
class Activity:
    """What a run does with an arm that it holds.

    Attributes:
        announcement: what is said when it begins.
        begin: returns the reference from the one in which the arm stands.
        duration: longest time that it takes [s].
        first: reference to which the arm is moved before; None where it stays.
    """

    announcement: str
    begin: Callable[[Reference], ReferenceFunction]
    duration: float
    first: Reference | None = None


class Follower:
    """Base of references that depend on the arm's state, which they get in every cycle.

    The base itself stands for one that does not: it uses no state, and the whole stiffness.

    Attributes:
        stiffness: share of the motors' stiffness, of all joints or of each (n,).
        damping: share of the motors' damping.
    """

    stiffness: Array | float = 1.0
    damping = 1.0

    def follow(self, q: Array, qd: Array, torque: Array) -> None:
        """Take believed positions and velocities, and torques commanded last, (n,) each.

        They are NaN where they are unknown [rad, rad/s, N m].
        """

    def __call__(self, time: float) -> Reference:
        """Return the reference at ``time`` [s] of its phase; times never go back."""
        raise NotImplementedError

    @property
    def is_done(self) -> bool:
        """Whether its phase may end before its time."""
        return False


LONGEST_LOWERING = 20.0
"""Time after which lowering ends in any case [s]."""


class Lowering(Follower):
    """A reference that lowers an arm by moving its joints in the direction of their load.

    The feed-forward torque is first reduced to zero within a second, so that the position control
    carries the load and the commanded torque equals the load. Each joint's reference then moves
    against the commanded torque until the arm lies or hangs, or the joint's range ends.

    Args:
        begin: reference from which the arm is lowered.
        speed: largest speed of a joint [rad/s].
        peak: peak torque (n,) of the joints [N m].
        limits: of the joints' positions.
    """

    def __init__(
        self, begin: Reference, speed: float, peak: Array, limits: Limits
    ) -> None:
        self._position = begin.position.copy()
        self._fed = begin.torque
        self._speed = speed
        # Torque from which a joint is lowered with full speed; less torque, less speed. It is a
        # judgement: dry friction is of this size, and should not move a joint.
        self._full_load = 0.05 * peak
        self._limits = limits
        self._torque = np.zeros(len(peak))
        self._time = 0.0
        self._moved_at = 0.0

    def follow(self, q: Array, qd: Array, torque: Array) -> None:
        """Take the torque (n,) commanded last [N m]; q and qd are not used."""
        self._torque = np.nan_to_num(torque)

    def __call__(self, time: float) -> Reference:
        """Return the reference at ``time`` [s] after the beginning; times never go back.

        Each call moves the stored position on.
        """
        load_share = np.clip(self._torque / self._full_load, -1.0, 1.0)
        # It fades within a second.
        fed_share = max(1.0 - time, 0.0)
        velocity = np.zeros_like(load_share)
        if fed_share == 0.0:
            # The torque that carries a joint is opposite to its load.
            velocity = -self._speed * load_share
        unlimited = self._position + velocity * (time - self._time)
        self._position = np.clip(unlimited, self._limits.lower, self._limits.upper)
        velocity = np.where(self._position == unlimited, velocity, 0.0)
        self._time = time
        # Slower joints are still.
        if fed_share > 0.0 or np.max(np.abs(velocity)) > 0.02:
            self._moved_at = time
        return Reference(self._position, velocity, fed_share * self._fed)

    @property
    def is_done(self) -> bool:
        """Whether no joint has been lowered any further for half a second."""
        return self._time - self._moved_at > 0.5


class CarriedStop(Follower):
    """A reference that brakes all joints together and then carries them.

    - Each joint brakes from the velocity of its reference, or from its own velocity if that is
      slower, or from rest if it moves opposite to its reference.
    - The distance between reference and joint stays constant, and so does its torque.
    - When the reference stands, this torque is removed from joints that do not move without it:
      they may press against an obstacle.
    - A joint that leaves its path, under its load or thrown by another joint, is held with added
      stiffness and damping, as far as its motor's own damping allows: they act through the
      feed-forward torque, one and a half cycles late, and the delay removes damping at some
      frequencies. With a quarter of the motor's kd as damping, and 0.8 kd over the delay as
      stiffness, no energy goes into a joint of any inertia or flexibility, even if samples are two
      cycles older; larger gains make light or flexible joints swing.

    Args:
        settings: gains, deceleration of the fastest joint, and the time for which all joints have
            to stand until they are at rest.
        reference: reference commanded last.
        q: last believed positions (n,) [rad]; NaN where unknown.
        qd: last believed velocities (n,) [rad/s]; NaN where unknown.
        fed: torque (n,) that carries the arm at rest: of its model, or fed forward last [N m].
        stuck: whether each joint (n,) is blocked: the torque of its position error is removed.
        limits: of commanded positions.

    Attributes:
        last: reference returned last.
        duration: time in which the reference brakes [s].
    """

    def __init__(
        self,
        settings: PlaySettings,
        reference: Reference,
        q: Array,
        qd: Array,
        fed: Array,
        stuck: Mask,
        limits: Limits,
    ) -> None:
        self._q = q
        self._qd = qd
        self.last = reference
        self._begin = reference
        self._fed = fed
        self._limits = limits
        self._kp = np.array(settings.kp)
        self._kd = np.array(settings.kd)
        self._rest_time = settings.rest_time
        self._moved_at = 0.0
        # Velocity from which each joint brakes: its own, between zero and its reference's.
        led = reference.velocity
        joint_velocity = np.where(np.isfinite(qd), qd, led)
        self._velocity = np.clip(
            joint_velocity, np.minimum(led, 0.0), np.maximum(led, 0.0)
        )
        top_speed = np.max(np.abs(self._velocity), initial=0.0)
        self.duration = top_speed / settings.deceleration
        # Reference minus joint position; the share ``_relief`` of kp times it is removed.
        self._offset = np.nan_to_num(reference.position - q)
        self._relief = np.where(stuck, 1.0, 0.0)
        # Added stiffness [N m/rad], and the farthest position of each joint on its path [rad].
        delay = 1.5 * settings.period
        self._stiffening = 0.8 * self._kd / delay
        self._reached = q
        self._has_moved = np.zeros(len(led), dtype=bool)
        self._time = 0.0

    def follow(self, q: Array, qd: Array, torque: Array) -> None:
        """Take the believed positions and velocities (n,); the ``torque`` is not used."""
        self._q = q
        self._qd = qd

    def __call__(self, time: float) -> Reference:
        """Return the reference at ``time`` [s] of the stop and store it; times never go back."""
        position, velocity = self._braking_path(time)
        # Where the joints should be now (n,) [rad].
        goal = position - self._offset
        self._relieve(time, goal)
        # The feed-forward torque is blended from the last one to that at rest, in 0.1 s or more.
        share = min(time / max(self.duration, 0.1), 1.0)
        torque = self._begin.torque + share * (self._fed - self._begin.torque)
        difference = np.nan_to_num(velocity - self._qd)
        torque = torque + (self._lift(goal) + 0.25 * self._kd * difference)
        torque = torque - self._relief * self._kp * self._offset
        # Slower joints are at rest [rad/s] (a judgement).
        is_moving = np.abs(np.nan_to_num(self._qd)) > 0.05
        if time < self.duration or np.any(is_moving):
            self._moved_at = time
        self.last = Reference(position, velocity, torque)
        return self.last

    def _braking_path(self, time: float) -> tuple[Array, Array]:
        """Return the evenly braked position and velocity (n,) [rad, rad/s] at ``time`` [s]."""
        braked = min(max(time, 0.0), self.duration)
        share_left = 1.0 - braked / self.duration if self.duration > 0.0 else 0.0
        # The mean of the first and the present velocity is (1 + share_left) / 2 of the first.
        way = self._velocity * braked * (1.0 + share_left) / 2.0
        position = self._begin.position + way
        position = np.clip(position, self._limits.lower, self._limits.upper)
        return position, self._velocity * share_left

    def _lift(self, goal: Array) -> Array:
        """Return the torque (n,) [N m] that pulls the joints back to their paths.

        A joint's path leads from its farthest position so far, not beyond its ``goal`` (n,) [rad],
        to the goal. The farthest positions are updated. Unknown positions (NaN) are ignored.
        """
        highest_reached = np.fmax(self._reached, np.fmin(self._q, goal))
        lowest_reached = np.fmin(self._reached, np.fmax(self._q, goal))
        moves_down = self._velocity < 0.0
        self._reached = np.where(moves_down, lowest_reached, highest_reached)
        lowest = np.fmin(self._reached, goal)
        highest = np.fmax(self._reached, goal)
        displacement = np.nan_to_num(np.clip(self._q, lowest, highest) - self._q)
        leaving_speed = -np.sign(displacement) * np.nan_to_num(self._qd)
        # More for a joint that leaves than for one that returns, which removes energy.
        share = 0.6 + 0.4 * np.tanh(leaving_speed / 0.3)
        return self._stiffening * displacement * share

    def _relieve(self, time: float, goal: Array) -> None:
        """Raise ``_relief`` (n,), the share of the offset's torque that is removed, towards 1.

        Nothing is removed before the reference stands, nor from a joint that has moved away from
        its ``goal`` (n,) [rad] since then. ``time`` [s] is stored as the present one.
        """
        passed = time - self._time
        self._time = time
        if time <= self.duration:
            return
        # A joint that moves as far carries load, and presses against no obstacle.
        self._has_moved |= np.abs(np.nan_to_num(goal - self._q)) > 0.01
        # Within a time constant of 0.3 s.
        less = (1.0 - self._relief) * min(passed / 0.3, 1.0)
        self._relief = np.where(self._has_moved, self._relief, self._relief + less)

    @property
    def is_done(self) -> bool:
        """Whether all joints of known velocity have stood still for ``rest_time``."""
        return self._time - self._moved_at > self._rest_time
