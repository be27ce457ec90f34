"""The watch over a run: position, speed and torque of each joint against what is expected of them.

Every joint's signals are averaged over 0.1 s, and these means over 1 s. A row of the watch compares
two of them, and stops the run where they differ by more than the row's bound:

=========  ============================================  =======================================
position   reported                                      commanded, in each cycle
speed      of the reported positions, over 0.1 s         commanded
speed      of the reported positions, over 0.1 and 1 s   reported
speed      the same over 1 s, with its sign              reported
torque     reported, over 0.1 and 1 s                    commanded
torque     reported, over 0.1 s                          fed forward
torque     commanded, over 0.1 s                         needed in the last second
torque     what carries the arm, over 0.1 s              its weight
=========  ============================================  =======================================

Means of exponential windows are used: a large residual is found sooner than a small one, and one
damaged frame is not enough. The torque needed in the last second is that fed forward plus what the
joint's control added: a wrong model is no fault, a sudden change is one.

Friction is no fault, either, and no file knows how large it is. What tells it from a load is that
it turns its sign with the motion. So a torque may be off by any friction that a joint of this motor
may have, in the direction in which the joint is led, and, since what was needed in the last second
contains friction of that second, by as much as the mean direction has changed since. The weight has
the ± of models as wrong as they usually are (``records.usual_errors``).

A model of the arm shows positions that are wrong, by the torques of a motion, see
``PositionShift``.

A message says which joint and which of the three disagree, with both numbers. It does not say why:
the recording shows that.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from robot_sysid.damiao.joints import DamiaoJoint, largest_friction
from robot_sysid.damiao.protocol import MitCommand
from robot_sysid.damiao.references import Reference
from robot_sysid.damiao.safety.health import BusHealth
from robot_sysid.damiao.safety.holding import LOADED, HoldingTorque, torque_doubt
from robot_sysid.damiao.safety.plausibility import Mask, Replies, without_nan
from robot_sysid.damiao.settings import PlaySettings, slowing_in_a_cycle
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array
from robot_sysid.records.levels import INTERVAL, STOPPING

# Time constants of exponential means [s]. The short one is as quiet as a plain mean over 0.1 s;
# with twice as much, an arm that a weak motor drops is found later, and falls twice as far.
_SHORT = 0.05
_LONG = 1.0
# What a joint's two speeds may differ by over 0.1 s: in any case [rad/s], and as a share of the
# speed. With less, the filter of a sound motor's velocity stops a run whose speed changes fast; a
# gear that slips by 0.3 rad/s has to be seen.
_SPEED_ERROR = 0.1
_SPEED_SHARE = 0.05
# The same of their means over a second, in any case [rad/s], and by the velocity's scale: one of
# 0.8 or 1.2 has to be seen, 2 % are usual.
_LONG_SPEED_ERROR = 0.02
_SCALE = 0.03
# What the signed means of the two over a second may differ by: in any case [rad/s], several times
# as much as in undisturbed runs; and by a velocity that is filtered [s].
_DRIFT = 0.01
_LATE = 0.01
# Cycles by which position, velocity and torque in an answer may differ in age: what a motor's
# firmware does, no manual says.
_OLDEST = 2.0
# Squared speed that stands for none where it is divided by [rad^2/s^2].
_TINY = 1e-12
# Cycles from one sample to the next one: more where answers are missing.
_NEXT = 1.5
# Factor by which a joint may slow down within a cycle before its samples say nothing of its speed:
# it may come to rest within each cycle.
_MOST_SLOWED = 2.0
# What a reported torque may be off its command: over 0.1 s, as a share of the peak torque; over a
# second, as a share of the commanded torque, and at least of the peak. A torque constant is a few
# per cent off, and 10 % have to pass; a factor of 0.8 or 1.25 has to be seen.
_TORQUE_ERROR = 0.15
_LONG_TORQUE_SHARE = 0.1
_LONG_TORQUE_FLOOR = 0.01
# Peak torque over what a reported torque may be off the one that is fed forward: two thirds of the
# peak are more than any excitation needs.
_PEAK_OVER_EXCITATION = 1.5
# By how much the torque that a joint needs may change within a second without a word. It is that of
# a position error [rad], but at least a share of the motor's peak torque: a standing joint has no
# friction that reverses, so that its share is lower.
_SUDDEN_ERROR = 0.05
_STANDING_LOAD = 0.03
_MOVING_LOAD = 0.1
# And at most this share of the peak: a motor that makes half of its torque needs more than that of
# a loaded joint.
_MOST_LOAD = 0.2
# Amplitude of a swing over the mean of its part on one side.
_CREST = np.pi
# Share of its commanded speed below which a joint presses against something (a judgement).
_BLOCKED_SHARE = 0.3
# Of a position that does not change at all: number of answers, and of steps [position steps] by
# which its command has gone on, from which it is stale; below which share of the peak torque the
# reported torque follows the command, half of ``_TORQUE_ERROR``, so that the motor controls what it
# reports; and the path [rad] that a joint which turns round stands still for with the usual
# stiffness, while friction and its fed torque reverse.
_LEAST_REPEATS = 3
_LED_STEPS = 20.0
_FOLLOWS_SHARE = 0.075
_TURNING_WAY = 0.03
# How far a position may leave the way of its speed in a stop [rad]: the oldest velocity and the
# fastest brake make half of it.
_MOST_SLIP = 0.1
# Rows of the watch: which of the three disagrees, then its two numbers.
_ROWS = (
    "position: it is at {:.3f} rad, and commanded to {:.3f}",
    "speed: it moves at {:.2f} rad/s, and is commanded {:.2f}",
    "speed: its positions change by {:.2f} rad/s, and it reports {:.2f}",
    "speed: in a second its positions change by {:.3f} rad/s, and it reports {:.3f}",
    "speed: in a second its positions change by {:.3f} rad/s, and it reports {:.3f}",
    "torque: it reports {:.1f} N·m, and is commanded {:.1f}",
    "torque: in a second it reports {:.2f} N·m, and is commanded {:.2f}",
    "torque: it reports {:.1f} N·m, and the path feeds forward {:.1f}",
    "torque: it needs {:.1f} N·m, and by the last second it would need {:.1f}",
)
# Places in ``_ROWS``: what samples of the speed say, and what is fed and needed.
_SAMPLED = slice(2, 5)
_FED = 7
_NEEDED = 8
_CARRIES = "torque: it carries the arm with {:.1f} N·m, and {:.1f} are expected"
_REPEATS = (
    "position: it reports {:.3f} rad again and again, and its command has gone on by "
    "{:.3f}"
)
_SHIFTED = (
    "position: it reports {:.2f} rad, and the torques of the motion are those of {:.2f}"
)


@dataclass(frozen=True)
class Phase:
    """What may be expected of an arm in a phase of a run.

    Attributes:
        stands: the joints are to stand still.
        rises: gains are being raised: an arm that takes up a new load then overshoots with twice
            the torque, so that needed torques are not judged.
        settles: the arm has not stood at the first point yet. Only now it shows by how much its
            weight is not the model's, and with little stiffness it swings about that for a second:
            what it needs is not compared with what it needed before.
        yields: joints go where their load takes them, and the arm may come to lie on something, so
            that its positions are not judged by its torques.
    """

    stands: bool = False
    rises: bool = False
    settles: bool = False
    yields: bool = False


PLAYING = Phase()
"""A phase in which the arm follows a motion."""


class _Comparison(NamedTuple):
    """What a row of the watch compares, of n joints each, and by how much it may differ."""

    measured: Array
    expected: Array
    bound: Array


class Watch:
    """Checks the replies of n joints in every cycle; HardwareAbort names the first fault.

    Args:
        joints: joints of the arm, base to terminal.
        settings: settings of the run, with gains and torque limits for each of the n joints.
        steps: one quantisation step (n,) of position, velocity and torque [rad, rad/s, N m].
        peak_torque: (n,) peak torque of each joint [N m].
        holding: computes the torque that carries the arm.

    Attributes:
        health: of the motors on the bus.
        failed: (n,) whether the motor does not drive any more; the array of ``health``.
        worst_tracking: (n,) largest distance from the commanded position so far [rad].
        stuck: (n,) whether the joint is blocked, frozen or jumped: it must not be pushed on.
        to_switch_off: (n,) whether the motor has to be disabled at once.
    """

    def __init__(
        self,
        joints: Sequence[DamiaoJoint],
        settings: PlaySettings,
        steps: tuple[Array, ...],
        peak_torque: Array,
        holding: HoldingTorque,
    ) -> None:
        n_joints = len(joints)
        self._joints = joints
        self._settings = settings
        self._peak = peak_torque
        self._position_step, self._velocity_step, self._torque_step = steps
        self._doubt = torque_doubt(joints)
        self._holding = holding
        self._shift = holding.position_shift()
        kp = np.maximum(settings.kp, 1e-9)
        self._spring = _SUDDEN_ERROR * kp
        # Torque by which the oldest position differs, per speed; and by the oldest velocity, per
        # change of it in a cycle. And how late velocities may be [s].
        self._of_old_position = _OLDEST * settings.period * kp
        self._of_old_velocity = _OLDEST * np.array(settings.kd)
        self._late = max(_LATE, _OLDEST * settings.period)
        # Means over 1 s (2, n) of reported minus commanded torque times the speed, and of the
        # squared speed: their ratio is what an older position makes.
        self._of_speed = np.zeros((2, n_joints))
        rated = np.array([joint.spec.rated_torque for joint in joints])
        # How far a standing joint may sag: an arm half a radian from the first point, or with a new
        # load, needs half of this. And how far it may go where its own torque pushes it.
        self._sag = np.minimum(2.0 * rated / kp, settings.tracking)
        self._pushed = np.minimum(rated / kp, settings.tracking)
        # How much faster a joint is on average than where it is sampled.
        self._slowed = slowing_in_a_cycle(settings.period, kp, np.array(settings.kd))
        # Bounds (n,) of rows that do not depend on the cycle.
        self._most_beside_led = settings.max_speed_error + 2.0 * self._velocity_step
        torque_slack = 4.0 * self._torque_step
        self._torque_error = _TORQUE_ERROR * peak_torque + torque_slack
        self._long_torque_floor = np.maximum(
            torque_slack, _LONG_TORQUE_FLOOR * peak_torque
        )
        self._most_beside_fed = peak_torque / _PEAK_OVER_EXCITATION
        # Time, position and velocity (3, n) of each joint's last sample.
        self._last = np.full((3, n_joints), np.nan)
        # The largest friction of a joint that nobody knows.
        self._friction = largest_friction(joints)
        self._tracking = np.array(settings.tracking)
        # Means over 0.1 s (9, n) of: the change of velocity from sample to sample, between which it
        # is not known; change of position, reported and commanded velocity; reported and commanded
        # torque, fed torque, the torque that the position control adds, and the sign of the
        # commanded velocity. Means over 1 s of these means, the first six as absolute values.
        self._short, self._long = np.zeros((2, 9, n_joints))
        # Means over 1 s (2, n) of the change of position and of the reported velocity, with their
        # signs: of a joint that moves to and fro, what only the positions do is left.
        self._drift = np.zeros((2, n_joints))
        # Means over 1 s (2, n) of what the control adds beyond what it usually adds, and below that
        # [N m]: what swings does both.
        self._swing = np.zeros((2, n_joints))
        # Answers in a row with the same position and velocity, and commanded position and torque
        # (2, n) when they began.
        self._repeats = np.zeros(n_joints, int)
        self._repeats_since = np.zeros((2, n_joints))
        # By how much positions (n,) have left the way of their speeds in a stop [rad].
        self._slip = np.zeros(n_joints)
        self._stale, self.stuck, self.to_switch_off = np.zeros((3, n_joints), bool)
        self.health = BusHealth(joints, settings)
        self.failed = self.health.failed
        self.worst_tracking = np.zeros(n_joints)

    @property
    def trusted_joints(self) -> Mask:
        """Joints (n,) that answer, and whose position may be used to control them."""
        return ~self._stale & (self.health.unheard < self._settings.max_doubted)

    @property
    def usually_added(self) -> Array:
        """Torque that the control has added to the fed one in the last second (n,) [N m]."""
        return self._long[7]

    @property
    def fed_torque(self) -> Array:
        """Mean feed-forward torque of the last moments (n,) [N m]."""
        return self._short[6]

    def check(
        self,
        replies: Replies,
        acted: MitCommand,
        followed: Reference,
        phase: Phase = PLAYING,
    ) -> None:
        """Raise HardwareAbort for the first fault in a cycle's replies.

        Args:
            replies: replies of all n joints; ``health`` is up to date with them.
            acted: command in force when the replies were sampled, fields (n,), in joint space.
            followed: reference of that command, with the weight in its pose.
            phase: of the run.
        """
        # Two samples confirm a jump.
        self.stuck |= replies.jump != 0.0
        self.health.check(replies)
        feedback = replies.feedback
        commanded = acted.motor_torque(feedback.position, feedback.velocity)
        self._check_repeats(replies, acted, commanded)
        self._average(replies, acted, commanded, phase)
        self._check_rows(replies, acted, followed, phase)
        if phase.rises:
            return
        self._check_weight(followed)
        if self._shift is not None and not phase.yields:
            time = float(replies.time.mean())
            shift = self._shift(time, feedback.position, feedback.velocity, commanded)
            if shift is not None:
                j, angle = shift
                q = self._last[1, j]
                self._raise(j, _SHIFTED.format(q, q + angle))

    def _average(
        self, replies: Replies, acted: MitCommand, commanded: Array, phase: Phase
    ) -> None:
        """Bring the means up to date with the joints that answered.

        ``acted`` is the command in force, ``commanded`` (n,) its torque [N m]. While gains rise,
        the long means of torques follow the short ones.
        """
        feedback = replies.feedback
        sample = np.array([replies.time, feedback.position, feedback.velocity])
        passed, way, turn = sample - self._last
        is_usable = replies.answered & (passed > 0.0)
        passed = np.where(is_usable, passed, 1.0)
        # A command is held for a cycle, at whose end the joint is sampled: it has moved on for half
        # a cycle since the mean, and stiffness makes that much less torque.
        hold_loss = 0.5 * self._settings.period * acted.kp * feedback.velocity
        share = -np.expm1(-passed / _LONG) * is_usable
        speed = feedback.velocity
        beside = (feedback.torque - commanded) * speed
        found = np.array([beside, speed**2])
        self._of_speed += without_nan(share * (found - self._of_speed))
        along, square = self._of_speed
        oldest = self._of_old_position
        per_speed = (along / np.maximum(square, _TINY)).clip(-oldest, oldest)
        of_age = per_speed * speed
        signals = np.array(
            [
                np.abs(turn),
                way / passed,
                0.5 * (sample[2] + self._last[2]),
                acted.velocity,
                feedback.torque,
                (commanded + of_age).clip(-self._peak, self._peak),
                acted.torque,
                commanded - acted.torque + hold_loss,
                np.sign(acted.velocity)
                * (np.abs(acted.velocity) > self._velocity_step),
            ]
        )
        # How a joint went between samples that are farther apart, these do not tell.
        is_next = passed < _NEXT * self._settings.period
        signals[:3] = np.where(is_next, signals[:3], self._short[:3])
        self._last = np.where(replies.answered, sample, self._last)
        change = -np.expm1(-passed / _SHORT) * (signals - self._short)
        self._short = np.where(is_usable, self._short + change, self._short)
        means = self._short.copy()
        np.abs(means[:6], out=means[:6])
        self._long += share * (means - self._long)
        self._drift += share * (self._short[1:3] - self._drift)
        if phase.rises:
            self._long[6:] = self._short[6:]
        beside = self._short[7] - self._usually_added()
        both = np.array([beside, -beside])
        self._swing += share * (np.maximum(both, 0.0) - self._swing)

    def _check_rows(
        self, replies: Replies, acted: MitCommand, followed: Reference, phase: Phase
    ) -> None:
        """Raise HardwareAbort for the joint and row that are farthest beyond their bound.

        The arguments are those of ``check``. A joint without an answer is not judged.
        """
        q = replies.feedback.position
        tracking = self._tracking
        if phase.stands:
            tracking = self.standing_limit(q, acted.position, acted.torque)
        stands = np.abs(acted.velocity) <= self._velocity_step
        stands &= self._long[3] <= self._velocity_step

        # In the order of ``_ROWS``.
        rows = [
            _Comparison(q, acted.position, tracking),
            *self._speed_comparisons(),
            *self._torque_comparisons(self._load_bound(stands, followed)),
        ]
        measured, expected, bounds = np.array(rows).swapaxes(0, 1)
        if phase.rises:
            bounds[_FED:] = np.inf
        if phase.settles:
            bounds[_NEEDED] = np.inf
        bounds[_SAMPLED, self._slowed > _MOST_SLOWED] = np.inf

        residuals = np.where(replies.answered, np.abs(measured - expected), 0.0)
        self.worst_tracking = np.maximum(self.worst_tracking, residuals[0])
        excess = residuals / bounds
        k, j = divmod(int(excess.argmax()), len(q))
        if excess[k, j] <= 1.0:
            return
        _, way, _, led, *_ = self._short
        self.stuck |= (np.abs(way) < _BLOCKED_SHARE * np.abs(led)) & ~stands
        self._raise(j, _ROWS[k].format(measured[k, j], expected[k, j]))

    def _speed_comparisons(self) -> Iterator[_Comparison]:
        """Yield the rows of speeds: against the command, over 0.1 and 1 s, and with their signs."""
        turn, way, speed, led, *_ = self._short
        long_turn, long_way, long_speed, *_ = self._long
        drift_way, drift_speed = self._drift
        yield _Comparison(way, led, self._most_beside_led)
        bound = _SPEED_ERROR + _SPEED_SHARE * np.abs(speed)
        bound = bound + self._velocity_step + _OLDEST * turn
        yield _Comparison(way, self._slowed_speed(way, speed), bound)
        long_bound = _LONG_SPEED_ERROR + _SCALE * long_speed
        long_bound = long_bound + 0.5 * self._velocity_step + _OLDEST * long_turn
        yield _Comparison(
            long_way, self._slowed_speed(long_way, long_speed), long_bound
        )
        # Positions that drift are not in these velocities. A right arm differs by a late velocity,
        # by its scale, and by rounding where it moves slowly.
        drift_bound = _DRIFT + self._late * np.abs(speed - drift_speed)
        drift_bound = drift_bound + _SCALE * np.abs(drift_speed)
        drift_bound = drift_bound + 0.5 * self._velocity_step
        yield _Comparison(
            drift_way, self._slowed_speed(drift_way, drift_speed), drift_bound
        )

    def _torque_comparisons(self, load: Array) -> Iterator[_Comparison]:
        """Yield the rows of torques: against the command, over 0.1 and 1 s, what is fed and needed.

        ``load`` (n,) is by how much what a joint needs may change within a second [N m].
        """
        tau, commanded, fed, added, _ = self._short[4:]
        long_tau, long_commanded, long_fed, _, _ = self._long[4:]
        yield _Comparison(tau, commanded, self._torque_error + self._aged(self._short))
        long_bound = _LONG_TORQUE_SHARE * long_commanded + self._long_torque_floor
        # In a second the age of the position has shown, and is in the commanded torque.
        long_bound = long_bound + self._of_old_velocity * self._long[0]
        yield _Comparison(long_tau, long_commanded, long_bound)
        yield _Comparison(tau, fed, self._most_beside_fed)
        # A wrong model gets half of a change of the feed-forward torque wrong.
        needed_bound = load + 0.5 * np.abs(fed - long_fed)
        yield _Comparison(fed + added, fed + self._usually_added(), needed_bound)

    def _aged(self, means: Array) -> Array:
        """Return by how much a torque (n,) is off whose position and velocity are older [N m].

        ``means`` are those over 0.1 or 1 s.
        """
        turn, _, speed, *_ = means
        return self._of_old_position * np.abs(speed) + self._of_old_velocity * turn

    def _load_bound(self, stands: Mask, followed: Reference) -> Array:
        """Return by how much the torque that each joint (n,) needs may change within a second.

        ``stands`` (n,) says which joints are led nowhere, ``followed`` is the reference [N m].
        """
        peak = self._peak
        least = np.where(stands, _STANDING_LOAD, _MOVING_LOAD) * peak
        load = self._spring.clip(least, _MOST_LOAD * peak)
        # What the weight is usually off changes with the pose: by all of it within a radian. An arm
        # that sinks where it is to stand has not been led anywhere.
        moved = min(_LONG * float(self._long[3].max()), 1.0)
        usual = without_nan(moved * INTERVAL * followed.weight_error)
        load = np.maximum(load, np.minimum(usual, _MOST_LOAD * peak))
        # A heavy joint with little damping swings about its path, and has done so before. A joint
        # that sticks and slips needs its friction one way, and at once the other way.
        swinging = load + _CREST * np.minimum(*self._swing)
        moving = np.maximum(swinging, 2.0 * self._friction)
        return np.where(stands, load, moving)

    def _usually_added(self) -> Array:
        """What the control of a sound joint may add to the fed torque (n,) [N m].

        Of what it has added in the last second, and any friction that has turned since, it is the
        nearest to what it adds now.
        """
        added = self._short[7]
        lasting = self._long[7]
        # Friction of one unit has changed the torque by this much since.
        turned = self._short[8] - self._long[8]
        most = self._friction * turned
        change = (added - lasting).clip(np.minimum(most, 0.0), np.maximum(most, 0.0))
        return lasting + change

    def _check_weight(self, followed: Reference) -> None:
        """Raise HardwareAbort for a joint that carries the arm in the direction of its weight.

        Friction may carry a joint that sticks or goes down, but not one that is lifted.
        """
        weight = followed.weight
        error = STOPPING * followed.weight_error
        # A soft arm sags, and its links weigh differently there: both poses have to say it.
        q = self._last[1]
        holding = self._holding
        error = error + holding.change_of_weight(q - followed.position)
        is_opposite = self._is_opposite(weight, error)
        if holding.is_model and is_opposite.any():
            is_opposite &= self._is_opposite(
                holding.torque(q), STOPPING * holding.error(q)
            )
        self._check_load(is_opposite, self._short[7] + weight, weight)

    def _is_opposite(self, weight: Array, error: Array) -> Mask:
        """Return which joints (n,) carry the arm against the direction of their weight.

        ``weight`` (n,) is what a pose needs, ``error`` (n,) by how much it may be off [N m].
        """
        sign = np.sign(weight)
        # What is fed beyond the weight accelerates the arm.
        carried = self._short[7] + weight
        lifts = np.minimum(sign * self._short[1], sign * self._short[3])
        is_lifted = lifts > self._velocity_step
        helped = np.where(is_lifted, 0.0, self._friction)
        # Where the weights of two links cancel, the model may have the sign wrong.
        least = np.abs(weight) - error
        helped = helped + self._aged(self._short)
        is_opposite = sign * carried + helped < np.minimum(least, -0.5 * self._doubt)
        # Nothing but its motor lifts a joint, so that a smaller load is judged there.
        least_load = np.where(is_lifted, 1.0, LOADED) * self._doubt
        return is_opposite & (np.abs(weight) > least_load)

    def _slowed_speed(self, way: Array, speed: Array) -> Array:
        """Return the mean speed (n,) [rad/s] nearest to ``way`` that a sampled ``speed`` allows.

        Where a joint comes to rest within each cycle, a sample of any age may be that of its
        slowest or of its fastest moment.
        """
        slowest = speed / self._slowed
        fastest = speed * self._slowed
        return way.clip(np.minimum(slowest, fastest), np.maximum(slowest, fastest))

    def _check_repeats(
        self, replies: Replies, acted: MitCommand, commanded: Array
    ) -> None:
        """Stop for a joint whose position does not change at all while its command moves on.

        ``acted`` is the command in force, ``commanded`` (n,) its torque [N m]. Where the reported
        torque follows the command, the motor controls the frozen position: it cannot hold its
        joint, and is disabled at once, so that its windings brake. Else its answers are stale.
        """
        feedback = replies.feedback
        now = np.array([feedback.position, feedback.velocity])
        is_same = replies.answered & np.logical_and.reduce(now == self._last[1:])
        command = np.array([acted.position, commanded])
        begins = replies.answered & ~is_same
        self._repeats_since = np.where(begins, command, self._repeats_since)
        self._repeats = np.where(begins, 0, self._repeats + is_same)
        led_by, turned_by = np.abs(command - self._repeats_since)
        is_led = led_by > _LED_STEPS * self._position_step
        is_led &= (self._repeats >= _LEAST_REPEATS) & replies.answered
        follows = np.abs(commanded - feedback.torque) < _FOLLOWS_SHARE * self._peak
        # A joint that turns round stands still while friction, and its fed torque, reverse.
        is_frozen = is_led & follows & (led_by > _TURNING_WAY)
        is_frozen &= turned_by > 2.0 * self._doubt
        # Answers that stay the same at a velocity of more than two steps per cycle are old, too.
        moves = (
            np.abs(feedback.velocity) * self._settings.period
            > 2.0 * self._position_step
        )
        self._stale = (is_same & moves) | (is_led & ~follows)
        self.stuck |= is_frozen
        self.to_switch_off |= is_frozen
        for j in (is_frozen | (is_led & ~follows)).nonzero()[0].tolist():
            self._raise(j, _REPEATS.format(feedback.position[j], led_by[j]))

    def misled_joints(self, replies: Replies) -> Mask:
        """Return whether the position of each joint (n,) does not go as its speed says.

        It is asked in every cycle of a stop, in which nothing else is checked: by a position that
        stays while the joint moves, the stiffness of a stop winds the joint up.
        """
        feedback = replies.feedback
        sample = np.array([replies.time, feedback.position, feedback.velocity])
        passed, change, _ = sample - self._last
        way = 0.5 * (sample[2] + self._last[2]) * passed
        self._slip += without_nan(replies.answered * (change - way))
        self._last = np.where(replies.answered, sample, self._last)
        return np.abs(self._slip) > _MOST_SLIP

    def check_holding(self, q: Array) -> None:
        """Raise HardwareAbort for a joint that does not hold the arm still at q (n,) [rad]."""
        carried = self._short[6] + self._short[7]
        is_wrong = self._holding.contradicts(q, carried)
        self._check_load(
            is_wrong, carried, self._holding.torque(q), "; see 'motors map'"
        )

    def _check_load(
        self, is_wrong: Mask, carried: Array, expected: Array, hint: str = ""
    ) -> None:
        """Raise HardwareAbort for the first joint in ``is_wrong`` (n,), with both torques (n,)."""
        for j in is_wrong.nonzero()[0].tolist():
            self._raise(j, _CARRIES.format(carried[j], expected[j]) + hint)

    def standing_limit(self, q: Array, reference_q: Array, fed: Array) -> Array:
        """Return how far each joint (n,) may be from the position where it should stand still.

        Args:
            q: believed positions (n,) [rad].
            reference_q: positions (n,) at which the joints should stand [rad].
            fed: feed-forward torque (n,) [N m].
        """
        # No load pulls in the direction of the feed-forward torque.
        return np.where(self.is_pushed(q, reference_q, fed), self._pushed, self._sag)

    def is_pushed(self, q: Array, reference_q: Array, fed: Array) -> Mask:
        """Return whether each joint (n,) has moved in the direction of its feed-forward torque.

        The arguments are those of ``standing_limit``; a torque that friction may explain pushes
        nothing.
        """
        return ((q - reference_q) * fed > 0.0) & (np.abs(fed) > self._doubt)

    def _raise(self, joint: int, description: str) -> None:
        """Raise HardwareAbort for a joint; ``description`` begins with what disagrees."""
        raise HardwareAbort(f"{self._joints[joint].label} disagrees in {description}")
