"""References that stop an arm and carry it, and that lower it.

A motor holds an arm by its feed-forward torque and by kp times the distance between the reference
and the joint. A stop that sets the reference to the joint's position would remove the second
torque, and the joint of a weak motor would fall. So ``CarriedStop`` keeps this distance.
"""

from __future__ import annotations

import numpy as np

from robot_sysid.damiao.protocol import KP_MAX
from robot_sysid.damiao.references import Follower, Reference
from robot_sysid.damiao.safety.plausibility import Mask
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.records import Array, Limits

# A slower joint is at rest [rad/s], and so is one that stays as near [rad] (a judgement).
_AT_REST = 0.05
_STRAY = 0.02
# Damping over stiffness below which a motor, which computes its torque a thousand times a second,
# swings [s].
_FASTEST_DECAY = 0.004
# Torque that may make up for raised stiffness where a joint carries less, as a share of its torque
# limit: ``confine`` then still lets a motor reach its peak torque.
_SPARE_SHARE = 0.25
# A motor obeys its stiffness where its torque is off by less than this share of the torque of its
# position error, and of its torque limit. With more, the joint of a motor that ignores its gains is
# thrown by the torque that makes up for more stiffness (by 0.9 to 1.5 rad); with less, rounding and
# friction keep sound motors soft.
_MISSING_SHARE = 0.3
_MISSING_FLOOR = 0.01
# What acts through the feed-forward torque: its age [cycles], damping over the motor's kd, and
# stiffness times that age over kd. Larger gains feed energy into light or flexible joints, smaller
# ones let the joint fall farther.
_AGE = 1.5
_ADDED_DAMPING = 0.25
_ADDED_STIFFNESS = 0.4
# A joint that goes faster below its reference in the direction of its load sinks [rad/s]: more than
# a sound joint differs from its reference, so that only a falling one is fed twice its load.
_SINKING_SPEED = 0.1
# Time for which light joints bear twice their load [s]: late samples let it act too long.
_BORNE_LIFT = 0.004
# Least time in which the feed-forward torque changes to that at rest [s]: a step would throw a
# light joint.
_BLEND_TIME = 0.1
# Distance that a joint moves only where it carries load, and presses against no obstacle [rad].
_CARRYING_WAY = 0.01
# Time constant with which a joint that may press against an obstacle is let go [s].
_RELIEF_TIME = 0.3


class CarriedStop(Follower):
    """A reference that brakes all joints together and then carries them.

    - Each joint brakes from the velocity of its reference, or from its own velocity if that is
      slower, or from rest if it moves opposite to its reference.
    - The distance between reference and joint stays constant, and so does its torque, although the
      motors' stiffness is raised at once: the feed-forward torque makes up for the difference.
      Motors act without delay, so that their stiffness gives no joint any energy.
    - A joint that is sinking is fed its load twice, until it first sinks no farther: its motor may
      be weak, and the load of a sinking arm grows.
    - When the reference stands, the torque of the distance is removed from joints that do not move
      without it: they may press against an obstacle.
    - Further stiffness and damping act through the feed-forward torque, one and a half cycles
      late, and the delay removes damping at some frequencies. With a quarter of the motor's kd as
      damping, and 0.4 kd over the delay as stiffness, no energy goes into a joint of any inertia or
      flexibility that was thrown, even if samples are two cycles older; larger gains make light or
      flexible joints swing.

    Args:
        settings: gains, deceleration of the fastest joint, and the time for which all joints have
            to stand until they are at rest.
        reference: reference commanded last.
        q: last believed positions (n,) [rad]; NaN where unknown.
        qd: last believed velocities (n,) [rad/s]; NaN where unknown.
        fed: torque (n,) that carries the arm at rest: of its model, or fed forward last [N m].
        stuck: whether each joint (n,) is blocked: the torque of its position error is removed.
        limits: of commanded positions and torques.
        deviation: reported torque minus the commanded one (n,) [N m]: where it is that of the
            position error, the motor may ignore its stiffness, and that is not raised.
        limp: whether each joint (n,) gets no stiffness, because its motor's own control may use
            another position than the believed one. What acts through the feed-forward torque holds
            it.

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
        deviation: Array | float = 0.0,
        limp: Mask | bool = False,
    ) -> None:
        self.follow(q, qd, fed)
        self.last = self._begin = reference
        self._fed = fed
        self._limits = limits
        self._rest_time = settings.rest_time
        self._time = self._moved_at = 0.0
        # Position (n,) that each joint last left by more than ``_STRAY``, and when [rad, s].
        self._stood = q
        self._gone_at = np.zeros(len(q))
        # Velocity from which each joint brakes: its own, between zero and its reference's.
        led = reference.velocity
        own = np.where(np.isfinite(qd), qd, led)
        self._velocity = np.clip(own, np.minimum(led, 0.0), np.maximum(led, 0.0))
        top_speed = np.max(np.abs(self._velocity), initial=0.0)
        self.duration = top_speed / settings.deceleration
        # Reference minus joint position.
        self._offset = np.nan_to_num(reference.position - q)
        kp, self._kd = np.array([settings.kp, settings.kd])
        # A motor reaches its peak torque if what makes up for the stiffness is no larger than its
        # load, see ``confine``.
        spare = np.maximum(np.abs(fed), _SPARE_SHARE * limits.torque)
        most = kp + spare / np.maximum(np.abs(self._offset), 1e-9)
        raised = np.clip(np.minimum(self._kd / _FASTEST_DECAY, most), kp, KP_MAX)
        # Without its stiffness, a motor would only make the torque that makes up for more of it.
        doubt = _MISSING_SHARE * kp * np.abs(self._offset)
        doubt += _MISSING_FLOOR * limits.torque
        obeys = np.isfinite(q) & ~stuck & (kp > 0.0) & (np.abs(deviation) <= doubt)
        stiffness = np.where(limp, 0.0, np.where(obeys, raised, kp))
        self.stiffness = stiffness / np.maximum(kp, 1e-9)
        # Torque without that of the distance, and what is added to the feed-forward torque now.
        self._relieved = -stiffness * self._offset
        kept = np.where(stuck | limp, 0.0, kp)
        self._added = kept * self._offset + self._relieved
        self._stiffening = _ADDED_STIFFNESS * self._kd / (_AGE * settings.period)
        self._has_moved = np.zeros(len(led), dtype=bool)
        sinking_speed = np.sign(fed) * (led - own)
        is_below = self._offset * fed > 0.0
        self._sinks = is_below & (sinking_speed > _SINKING_SPEED) & ~stuck
        self._depth = np.full(len(led), -np.inf)
        self._lift = fed * min(1.0, _BORNE_LIFT / settings.period)

    def follow(self, q: Array, qd: Array, torque: Array) -> None:
        """Take the believed positions and velocities (n,); the ``torque`` is not used."""
        self._q = q
        self._qd = qd

    def __call__(self, time: float) -> Reference:
        """Return the reference at ``time`` [s] of the stop and store it; times never go back."""
        left = max(1.0 - time / self.duration, 0.0) if self.duration > 0.0 else 0.0
        velocity = left * self._velocity
        way = 0.5 * self.duration * (1.0 - left**2) * self._velocity
        position = self._begin.position + way
        position = np.clip(position, self._limits.lower, self._limits.upper)
        # How far each joint is behind where it should be now (n,) [rad].
        lag = position - self._offset - self._q
        if time > self.duration:
            self._relieve(time - self._time, np.abs(lag))
        self._time = time
        depth = np.sign(self._fed) * lag
        self._sinks &= depth > self._depth
        self._depth = depth
        # The feed-forward torque is blended from the last one to that at rest.
        share = min(time / max(self.duration, _BLEND_TIME), 1.0)
        torque = self._begin.torque + share * (self._fed - self._begin.torque)
        torque = torque + self._added + self._sinks * self._lift
        torque = torque + self._stiffening * np.nan_to_num(lag)
        torque = torque + _ADDED_DAMPING * self._kd * np.nan_to_num(velocity - self._qd)
        has_gone = np.abs(self._q - self._stood) > _STRAY
        self._stood = np.where(has_gone, self._q, self._stood)
        self._gone_at = np.where(has_gone, time, self._gone_at)
        # An encoder that drifts says that its joint moves and stays: holding on turns the joint.
        moves = np.abs(self._qd) > _AT_REST
        moves &= time - self._gone_at <= _STRAY / _AT_REST
        if left > 0.0 or np.any(moves):
            self._moved_at = time
        self.last = Reference(position, velocity, torque)
        return self.last

    def _relieve(self, passed: float, distance: Array) -> None:
        """Let ``_added`` (n,) tend towards ``_relieved`` for a time [s].

        Nothing is removed from a joint that has ever been a ``distance`` (n,) [rad] away.
        """
        self._has_moved |= distance > _CARRYING_WAY
        less = min(passed / _RELIEF_TIME, 1.0) * (self._relieved - self._added)
        self._added = self._added + np.where(self._has_moved, 0.0, less)

    @property
    def is_done(self) -> bool:
        """Whether all joints of known velocity have stood still for ``rest_time``."""
        return self._time - self._moved_at > self._rest_time


LONGEST_LOWERING = 20.0
"""Time after which lowering ends in any case [s]."""
# Torque from which a joint is lowered with full speed, as a share of its torque limit; less torque,
# less speed. Dry friction is of this size, and should not move a joint (a judgement).
_FULL_LOAD_SHARE = 0.05
# An arm whose joints are lowered no faster [rad/s] for so long [s] lies or hangs.
_LOWERED_SPEED = 0.02
_LOWERED_TIME = 0.5


class Lowering(Follower):
    """A reference that lowers an arm by moving its joints in the direction of their load.

    The feed-forward torque is first reduced to zero within a second, so that the position control
    carries the load and the commanded torque equals the load. Each joint's reference then moves
    against the commanded torque until the arm lies or hangs, or the joint's range ends.

    Args:
        begin: reference from which the arm is lowered.
        speed: largest speed of a joint [rad/s].
        limits: of the joints' positions and torques.
    """

    def __init__(self, begin: Reference, speed: float, limits: Limits) -> None:
        self._position = begin.position.copy()
        self._fed = begin.torque
        self._speed = speed
        self._full_load = _FULL_LOAD_SHARE * limits.torque
        self._limits = limits
        self._torque = np.zeros_like(begin.torque)
        self._time = self._moved_at = 0.0

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
        if fed_share > 0.0 or np.max(np.abs(velocity)) > _LOWERED_SPEED:
            self._moved_at = time
        return Reference(self._position, velocity, fed_share * self._fed)

    @property
    def is_done(self) -> bool:
        """Whether no joint has been lowered any further for a while."""
        return self._time - self._moved_at > _LOWERED_TIME
