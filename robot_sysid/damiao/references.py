"""Joint references as functions of time, also in a stop, and what should hold an arm still.

A motor that turns the other way than its joint, or that sits at another joint, moves an arm on
another path than the one that was checked; where gravity loads the joint, its torque shows it.

A motor holds an arm by its feed-forward torque and by kp times the distance between the reference
and the joint. A stop that moves the reference to where the joint is takes that second part away,
and a weak motor's joint falls. So ``CarriedStop`` brakes the reference from where it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Optional

import numpy as np

from robot_sysid.damiao.joints import DamiaoJoint
from robot_sysid.damiao.safety.guards import CommandRange, Mask
from robot_sysid.damiao.trajectory import DamiaoTrajectory
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array


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
"""The reference at a time after the beginning [s]; times never go back."""


def trajectory_reference(
    trajectory: DamiaoTrajectory, speed: float
) -> ReferenceFunction:
    """Return a trajectory, interpolated between its rows, as a function of time.

    At a ``speed`` s of the file's the joints pass the same positions with s times the velocity. The
    feed-forward torque is the file's: at reduced speed its inertial part is too large, which the
    position control makes up for. The end is held.
    """
    times = trajectory.time
    values = np.hstack([trajectory.q, trajectory.qd, trajectory.tau])

    def reference(time: float) -> Reference:
        moment = times[0] + time * speed
        later = int(np.searchsorted(times, moment))
        row = values[min(later, len(times) - 1)]
        if 0 < later < len(times):
            share = (moment - times[later - 1]) / (times[later] - times[later - 1])
            row = values[later - 1] + (row - values[later - 1]) * share
        position, velocity, torque = np.split(row, 3)
        return Reference(position, velocity * speed, torque)

    return reference


STRAIGHT = "straight"
ORDERS = (STRAIGHT, "joint by joint from the base", "joint by joint from the tip")
"""Orders in which joints go from one pose to another: all at once, or one after the other."""


def poses_between(begin: Array, end: Array, order: str) -> list[Array]:
    """Return the corners (n,) of the path from ``begin`` to ``end`` (n,) [rad], both included.

    The path is straight between corners; its joints move in one of ``ORDERS``.
    """
    poses = [begin]
    if order != STRAIGHT:
        joints = np.flatnonzero(begin != end)
        if order != ORDERS[1]:
            joints = joints[::-1]
        for joint in joints[:-1]:
            pose = poses[-1].copy()
            pose[joint] = end[joint]
            poses.append(pose)
    return [*poses, end]


def transfer_reference(
    start: Reference,
    target: Reference,
    speed: float,
    shortest: float,
    order: str = STRAIGHT,
    carries: Callable[[Array], Array] = np.zeros_like,
) -> tuple[ReferenceFunction, float]:
    """Return a motion from rest at ``start`` to rest at ``target``, and its duration [s].

    Along each straight line the arm moves by the quintic 10 s^3 - 15 s^4 + 6 s^5 of the share s of
    its time, whose peak speed is 15/8 of the mean.

    Args:
        speed: that no joint exceeds [rad/s].
        shortest: least duration of a line [s].
        order: one of ``ORDERS``.
        carries: from a pose (n,) [rad] to the torque (n,) that carries the arm in it [N m]. It is
            fed forward, and besides what start and target have beyond it, blended over the time.
    """
    poses = poses_between(start.position, target.position, order)
    lines = np.diff(poses, axis=0)
    times = np.maximum(shortest, 1.875 * np.max(np.abs(lines), axis=1) / speed)
    begins = np.append(0.0, np.cumsum(times))
    duration = float(begins[-1])
    extra_at_start = start.torque - carries(start.position)
    extra_at_target = target.torque - carries(target.position)

    def reference(time: float) -> Reference:
        k = int(np.clip(np.searchsorted(begins, time) - 1, 0, len(times) - 1))
        s = min(max((time - begins[k]) / times[k], 0.0), 1.0)
        share = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
        rate = 30.0 * s * s * (1.0 - s) ** 2 / times[k]
        done = (begins[k] + share * times[k]) / duration
        q = poses[k] + share * lines[k]
        fed = carries(q) + (1.0 - done) * extra_at_start + done * extra_at_target
        return Reference(q, rate * lines[k], fed)

    return reference, duration


TRANSFER_RATE = 100.0
"""Rows per second of ``transfer_rows``, enough for motions of a second and more [Hz]."""


def transfer_rows(
    trajectory: DamiaoTrajectory,
    begin: Array,
    end: Array,
    pace: tuple[float, float],
    order: str = STRAIGHT,
) -> DamiaoTrajectory:
    """Return the motion between two poses (n,) [rad] as rows of a trajectory, without torque.

    ``trajectory`` gives the motors; for ``pace``, speed [rad/s] and shortest duration [s], and
    ``order`` see ``transfer_reference``.
    """
    zero = np.zeros_like(begin)
    start = Reference(begin, zero, zero)
    target = Reference(end, zero, zero)
    reference, duration = transfer_reference(start, target, *pace, order)
    time = np.linspace(0.0, duration, int(np.ceil(duration * TRANSFER_RATE)) + 1)
    q, qd, tau = (np.array(signal) for signal in zip(*map(reference, time)))
    return replace(
        trajectory, line=np.arange(len(time)), time=time, q=q, qd=qd, tau=tau
    )


def hold_reference(reference: Reference) -> ReferenceFunction:
    """Return a function that stays at a reference's position and torque, without velocity."""
    at_rest = Reference(
        reference.position, np.zeros_like(reference.velocity), reference.torque
    )
    return lambda time: at_rest


def add_held_motors(
    reference: ReferenceFunction, positions: Array
) -> ReferenceFunction:
    """Return a reference of n + m joints: behind n others it holds m at ``positions`` [rad]."""
    zero = np.zeros_like(positions)

    def extended_reference(time: float) -> Reference:
        position, velocity, torque = reference(time)
        return Reference(
            np.append(position, positions),
            np.append(velocity, zero),
            np.append(torque, zero),
        )

    return extended_reference


# Share of the peak torque at which a joint yields with full speed; less load, less speed. A
# judgement: dry friction is of this size, and leaves a joint alone.
_FULL_LOAD = 0.05
# Judgements: the feed-forward torque fades in [s]; slower than [rad/s] for so long [s] is still.
_FADE = 1.0
_STILL_SPEED = 0.02
_STILL_TIME = 0.5
LONGEST_LOWERING = 20.0
"""After this time [s] the arm counts as lowered."""


class Lowering:
    """A reference that lowers an arm: it gives way to the torque that its joints carry.

    The feed-forward torque fades within a second, so that the position control carries the load and
    the commanded torque shows it. Each reference position then moves against that torque until the
    arm lies or hangs, or a joint is at the end of its range.

    Args:
        begin: reference from which the arm is lowered.
        speed: largest speed of a joint [rad/s].
        peak: peak torque (n,) of the joints [N m].
        lower, upper: range (n,) of the joints [rad].

    Attributes:
        torque: commanded last (n,) [N m]; NaN where unknown. The caller sets it in every cycle.
    """

    def __init__(
        self, begin: Reference, speed: float, peak: Array, lower: Array, upper: Array
    ) -> None:
        self._position = begin.position.copy()
        self._fed = begin.torque
        self._speed = speed
        self._full_load = _FULL_LOAD * peak
        self._lower = lower
        self._upper = upper
        self.torque: Array = np.full(len(peak), np.nan)
        self._time = self._moved_at = 0.0

    def __call__(self, time: float) -> Reference:
        """Return the reference at ``time`` [s] after the beginning; times never go back."""
        load_share = np.clip(np.nan_to_num(self.torque) / self._full_load, -1.0, 1.0)
        fed_share = max(1.0 - time / _FADE, 0.0)
        velocity = np.zeros_like(load_share)
        if fed_share == 0.0:
            velocity = -self._speed * load_share
        moved = self._position + velocity * (time - self._time)
        self._position = np.clip(moved, self._lower, self._upper)
        velocity = np.where(self._position == moved, velocity, 0.0)
        self._time = time
        if fed_share > 0.0 or np.max(np.abs(velocity)) > _STILL_SPEED:
            self._moved_at = time
        return Reference(self._position, velocity, fed_share * self._fed)

    @property
    def is_done(self) -> bool:
        """Whether no joint has yielded for half a second."""
        return self._time - self._moved_at > _STILL_TIME


# Share of a motor's peak torque up to which torque proves no load (a judgement).
_DOUBT = 0.06
# In units of the doubt: a joint that should carry more than the first is judged by its torque, also
# where a guessed model is twice too heavy; one that then carries less than the second is not at the
# joint it is taken for.
_LOADED = 2.0
_BARE = 0.5


def torque_doubt(joints: Sequence[DamiaoJoint]) -> Array:
    """Return the torque (n,) of each joint up to which friction hides its load [N m]."""
    return _DOUBT * np.array(
        [joint.spec.peak_torque * joint.torque_ratio for joint in joints]
    )


MotionCheck = Callable[[float, Array, Array, Array], Optional[tuple[int, str]]]
"""Takes time [s], positions, velocities and commanded torques (n,) of each cycle; returns the
number of a joint in which something is wrong, with a sentence about it, or None."""


class HoldingCheck:
    """Compares the torques that hold an arm still with those that should hold it.

    Args:
        joints: the n joints of the arm, base to terminal.
        torque: from a pose (n,) [rad] to the torque (n,) that should hold the arm there [N m].
        doubt: (n,) dry friction, where it is known [N m].
        source: start of the phrase that states that torque: "the model arm.xml needs".
        load: from a pose to the torque (n,) that a kilogram at the arm's end takes there [N m];
            None without a model.
        watch: makes the check of one run's motion; None where there is none.

    Attributes:
        n_joints: joints that are judged; motors beside the arm come behind them.
        doubt: torque (n,) up to which friction hides a joint's load [N m].
        is_model: whether a model of the arm states what should hold it, in every pose.
        watch: as above.
    """

    def __init__(
        self,
        joints: Sequence[DamiaoJoint],
        torque: Callable[[Array], Array],
        doubt: Array | float,
        source: str,
        load: Callable[[Array], Array] | None = None,
        watch: Callable[[], MotionCheck] | None = None,
    ) -> None:
        self._expected_torque = torque
        self._joints = joints
        self._source = source
        self._load = load
        self.watch = watch
        self.n_joints = len(joints)
        self.doubt = doubt + torque_doubt(joints)
        self.is_model = load is not None

    def unverified_joints(self, q: Array) -> list[DamiaoJoint]:
        """Return the unverified joints whose load at q (n,) [rad] is too small for a direction."""
        is_bare = np.abs(self._expected_torque(q)) <= _LOADED * self.doubt
        joints = [self._joints[j] for j in np.flatnonzero(is_bare).tolist()]
        return [joint for joint in joints if not joint.verified]

    def load(self, q: Array) -> Array:
        """Return the torque (n,) that a kilogram at the arm's end takes at q (n + m,) [N m]."""
        assert self._load is not None
        return self._load(q[: self.n_joints])

    def torque(self, q: Array) -> Array:
        """Return the torque (n + m,) that holds the arm at q (n + m,) [rad]; 0 for m others [N m].

        The m motors beside the arm come behind its joints.
        """
        n_others = len(q) - self.n_joints
        return np.append(self._expected_torque(q[: self.n_joints]), np.zeros(n_others))

    def __call__(self, q: Array, tau: Array) -> None:
        """Compare the torques tau (n + m,) [N m] of an arm that is held still at q (n + m,) [rad].

        HardwareAbort where a joint is loaded the other way, or far less, than it should be.
        """
        expected = self._expected_torque(q[: self.n_joints])
        tau = tau[: self.n_joints]
        size = np.abs(expected)
        along = np.sign(expected) * tau
        is_wrong = (size > self.doubt) & (along < -self.doubt)
        is_wrong |= (size > _LOADED * self.doubt) & (along < _BARE * self.doubt)
        for j in np.flatnonzero(is_wrong).tolist():
            raise HardwareAbort(
                f"{self._joints[j].label} holds the arm with {tau[j]:.1f} N m but {self._source} "
                f"{expected[j]:.1f} N m in this pose: a motor turns the other way than its joint, "
                "sits at another one, or has another zero; see 'motors map'"
            )


# So near to the first point its torque is nearly what holds the arm: 2 N m off at 20 N m/rad [rad].
# With less acceleration [rad/s^2] it is the torque at rest: 1 N m at 2 kg m^2.
_NEAR = 0.1
_GENTLE = 0.5


class FileHolding(HoldingCheck):
    """Holding torques of an arm near a trajectory's first point, from the trajectory's own torque.

    It is the feed-forward torque of the row near there that accelerates least. Where that row still
    accelerates, nothing is compared. A trajectory whose torque is within every joint's doubt all
    the time does not carry an arm.
    """

    def __init__(self, trajectory: DamiaoTrajectory) -> None:
        q = trajectory.q
        is_near = np.all(np.abs(q - q[0]) <= _NEAR, axis=1)
        accelerations = np.gradient(trajectory.qd, trajectory.time, axis=0)
        acceleration = np.max(np.abs(accelerations), axis=1)
        row = int(np.argmin(np.where(is_near, acceleration, np.inf)))
        torque = trajectory.tau[row]
        super().__init__(
            trajectory.joints, lambda q: torque, 0.0, "the trajectory feeds forward"
        )
        self._is_at_rest = acceleration[row] < _GENTLE
        self._first = q[0]
        peaks = np.abs(trajectory.tau).max(axis=0)
        self._carries_arm = bool(np.any(peaks > self.doubt))

    def __call__(self, q: Array, tau: Array) -> None:
        """Compare the torques tau (n + m,) [N m] of an arm that is held still at q (n + m,) [rad].

        HardwareAbort where a joint is loaded the other way, or far less, than the trajectory feeds
        forward, and where this never carries an arm that has weight. Far from the first point
        nothing is compared.
        """
        if np.any(np.abs(q[: self.n_joints] - self._first) > _NEAR):
            return
        if not self._carries_arm:
            is_loaded = np.abs(tau[: self.n_joints]) > _LOADED * self.doubt
            for j in np.flatnonzero(is_loaded).tolist():
                raise HardwareAbort(
                    f"{self._joints[j].label} holds the arm with {tau[j]:.1f} N m, and the "
                    "trajectory never feeds forward what carries an arm: its torque lacks gravity"
                )
        if self._is_at_rest:
            super().__call__(q, tau)


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
    """State of n joints when a stop begins; all arrays are (n,).

    Attributes:
        reference: commanded last.
        q, qd: positions and velocities as believed last; NaN where unknown [rad, rad/s].
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
