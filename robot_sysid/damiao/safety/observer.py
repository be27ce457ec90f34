"""An observer of all joints, which stops a run when signals disagree.

In every control cycle it compares each motor's command, the state that the motor reports, and the
torque that the arm needs:

=====================================  =========================================================
the bus                                answers missing, damaged, doubled; commands of others
torque reported, torque commanded      torque scale or sign, weak motor, another master, supply
position, integrated velocity          velocity scale or sign, slipping gear or encoder
position, command                      blocked joint, frozen encoder, answers that repeat
torque commanded, torque needed        weak motor, new load, push, moved zero, slipping gear
=====================================  =========================================================

The needed torque is the feed-forward torque (of the model or the trajectory file) plus the torque
that the joint's control added a moment ago: a wrong model is no fault, a sudden change is one. The
added torque, kp (position error) + kd (velocity error), is called effort here. Several limits are
given in units of the doubt, ``torque_doubt``: torque too small to draw conclusions from.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from robot_sysid.damiao.joints import DamiaoJoint
from robot_sysid.damiao.protocol import ENABLED, MitCommand, status_text
from robot_sysid.damiao.references import HoldingCheck, torque_doubt
from robot_sysid.damiao.safety.guards import (
    NO_STATUS,
    Mask,
    Replies,
    Slip,
    TorqueScalingCheck,
    VelocityScalingCheck,
)
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array

# Added to the limit of velocity errors [velocity steps]: each of the two may be off by one.
_STEPS = 2.0
# Cycles without an answer per unanswered command that is allowed: a motor whose answer is missing
# is sent nothing for four cycles, see ``session.PAUSE``, so commands alone would count too slowly.
_SILENT_CYCLES = 2
# How far a standing joint may sag, in units of rated torque / stiffness: an arm half a radian from
# the first point, or with a new load, needs half of this.
_SAG = 2.0
# Factor of that limit in the direction of the feed-forward torque, in which no load pulls.
_PUSHED = 0.5
_DRIVEN = (
    "drives it off; a motor turns the other way than its joint, two ids are swapped, or the file "
    "is for another pose or arm: see 'motors map'"
)
_SINKS = (
    "does not carry it; the trajectory's torque lacks gravity, two ids are swapped, or the arm is "
    "far heavier than its model"
)
_SCALING_CYCLES = 50  # Cycles from one judgement of the scales to the next.
_RECENT = 5  # Number of last cycles whose commanded and reported torques are compared.
# Number of these cycles, or of cycles in a row, that have to disagree: one is a damaged frame.
_ENOUGH = 3
_MEMORY = 0.9  # Factor per cycle by which counts of surplus answers and foreign commands decay.
_FEW = 2.5  # Decayed count above which the run stops: a single wrong one is a damaged frame.
_OTHER_TORQUE = 0.15  # Accepted error of a reported torque [share of the peak torque].
_EFFORT_WAY = 0.05  # Position error that makes the limit of a sudden effort [rad].
_LEAST_EFFORT = 0.1  # Least such limit [share of the peak torque].
_MOST_EFFORT = 0.25  # Largest such limit [share of the peak torque].
_STILL_EFFORT = 0.03  # Least such limit of a standing joint [share of the peak torque].
_MOMENT = 0.25  # Time over which the effort before a sudden change is averaged [s].
_LOADED_DOUBTS = 2.0  # Feed-forward torque from which loads are judged [doubts].
_OPPOSITE_DOUBTS = 0.5  # Opposite load that stops the run [doubts].
_MODEL_SHARE = 0.5  # Relative error of a model's change of feed-forward torque.
_FED_TIME = 0.3  # Time over which the feed-forward torque is averaged [s].
_STILL_STEPS = 20.0  # Change of command at which a position is frozen [steps].
_STILL_CYCLES = 3  # Number of cycles in which a frozen position does not change.
_FROZEN_DOUBTS = 2.0  # Change of torque that overcomes dry friction [doubts].
_MOMENTS = 25  # Number of last cycles in which a blocked joint is looked for.
_LED_BY = 0.015  # Least change of command by which a joint is judged as blocked [rad].
_CAME_SHARE = 0.3  # Share of its command that a blocked joint moves at most.


class Observer:
    """Checks the replies of n joints in every cycle; HardwareAbort names the first fault.

    Args:
        joints: joints of the trajectory, base to terminal.
        settings: settings of the run, with gains and torque limits for each of the n joints.
        steps: one quantisation step (n,) of position, velocity and torque [rad, rad/s, N m].
        peak_torque: (n,) peak torque of each joint [N m].
        holding: computes the torque that carries the arm.

    Attributes:
        missed: (n,) number of commands in a row without an answer.
        silent: (n,) number of cycles in a row without an answer.
        total_missed: (n,) number of all commands without an answer.
        worst_tracking: (n,) largest distance from the commanded position so far [rad].
        failed: (n,) whether the motor reported that it does not drive any more.
        stuck: (n,) whether the joint is blocked, frozen or jumped: it must not be pushed on.
        to_switch_off: (n,) whether the motor has to be disabled at once.
    """

    def __init__(
        self,
        joints: Sequence[DamiaoJoint],
        settings: PlaySettings,
        steps: tuple[Array, Array, Array],
        peak_torque: Array,
        holding: HoldingCheck,
    ) -> None:
        n_joints = len(joints)
        self._joints = joints
        self._settings = settings
        self._holding = holding
        self._peak = peak_torque
        self._position_step, self._velocity_step, torque_step = steps
        self._speed_limit = settings.max_speed_error + _STEPS * self._velocity_step
        self._torque_limit = np.array(settings.max_torque_error)
        self._doubt = torque_doubt(joints)
        rated = np.array([j.spec.rated_torque * j.torque_ratio for j in joints])
        kp = np.maximum(settings.kp, 1e-9)
        self._sag = np.minimum(_SAG * rated / kp, settings.max_tracking_error)
        self._effort_limit = np.clip(
            _EFFORT_WAY * kp, _LEAST_EFFORT * peak_torque, _MOST_EFFORT * peak_torque
        )
        self._still_limit = np.maximum(_EFFORT_WAY * kp, _STILL_EFFORT * peak_torque)
        self._other_torque = _OTHER_TORQUE * peak_torque + 4.0 * torque_step
        # kp is above 0 here, because ``VelocityScalingCheck`` divides by these values.
        fades = settings.period * kp / np.array(settings.kd)
        self._velocity_check = VelocityScalingCheck(self._velocity_step, fades)
        self._torque_check = TorqueScalingCheck(torque_step, peak_torque)
        self._zero_check = holding.watch() if holding.watch is not None else None
        self._added = _RunningMean(n_joints, settings.period / _MOMENT)
        self._needed = _RunningMean(n_joints, settings.period / _MOMENT)
        self._fed = _RunningMean(n_joints, settings.period / _FED_TIME)
        self._cycles = 0
        self.missed, self.silent, self.total_missed = np.zeros((3, n_joints), int)
        # Cycles in a row: with doubted answers only, with a sudden effort.
        self._damaged, self._sudden = np.zeros((2, n_joints), int)
        # Answers in a row with the same position and velocity, and with the same torque too.
        self._still, self._repeated = np.zeros((2, n_joints), int)
        self._surplus, self._foreign = np.zeros((2, n_joints))
        self.worst_tracking = np.zeros(n_joints)
        self.failed, self.stuck, self.to_switch_off = np.zeros((3, n_joints), bool)
        self._stale = np.zeros(n_joints, bool)
        # Commanded and reported torque of the last cycles.
        self._pairs = np.full((2, _RECENT, n_joints), np.nan)
        # Position, velocity and torque of the last answer.
        self._last = np.full((3, n_joints), np.nan)
        # Commanded position and torque when an answer last differed from the one before.
        self._still_since = np.full((2, n_joints), np.nan)
        self._slip: Slip | None = None
        # Commanded and reported positions of the last cycles, the newest first.
        self._moments = np.full((_MOMENTS, 2, n_joints), np.nan)
        self._added_now = np.full(n_joints, np.nan)
        self._was_fast = np.zeros(n_joints, bool)
        # Whether path, velocity and torque error (3, n) were beyond their limits a cycle ago.
        self._was_beyond = np.zeros((3, n_joints), bool)

    def update(self, replies: Replies) -> None:
        """Count missing, doubted and surplus answers, and foreign commands, of a cycle's replies.

        A motor that reports a fault is noted in ``failed``, and a slip for the next ``check``.
        """
        unanswered = replies.requested & ~replies.answered
        self.missed = np.where(replies.answered, 0, self.missed + unanswered)
        self.silent = np.where(replies.answered, 0, self.silent + 1)
        self._damaged = np.where(replies.answered, 0, self._damaged + replies.doubted)
        self.total_missed += unanswered
        self._surplus = _MEMORY * self._surplus + replies.surplus
        self._foreign = _MEMORY * self._foreign + replies.foreign
        feedback = replies.feedback
        is_faulty = (feedback.status != ENABLED) & (feedback.status != NO_STATUS)
        # Where two motors answer on one id, the status may be the other motor's: see _check_bus.
        is_double = is_faulty & (self._surplus > 1.0)
        self._surplus = np.where(is_double, np.inf, self._surplus)
        self.failed |= is_faulty & ~is_double
        motion = feedback.position, feedback.velocity
        self._slip = self._velocity_check.add(replies.time, *motion) or self._slip

    def check(
        self,
        replies: Replies,
        acted: MitCommand,
        standing: bool = False,
        rising: bool = False,
        lowered: bool = False,
    ) -> None:
        """Raise HardwareAbort for the first fault in a cycle's replies; call ``update`` before.

        Args:
            replies: replies of all n joints.
            acted: command in force when the replies were sampled, fields (n,), in joint space.
            standing: whether the joints are to stand still.
            rising: whether gains are being raised: an arm that takes up a new load then overshoots
                with twice the torque, so that efforts and torque errors are not judged.
            lowered: whether the arm is being lowered: it may come to lie on something, so that
                moved zeros are not judged.
        """
        feedback = replies.feedback
        commanded = acted.motor_torque(feedback.position, feedback.velocity)
        self._check_bus()
        self._check_states(replies)
        self._check_jump(replies)
        self._check_frozen(replies, acted, commanded)
        self._check_reported(commanded, feedback.torque)
        self._torque_check.add(commanded, feedback.torque, feedback.velocity)
        if standing:
            self._check_standing(replies, acted)
        self._check_scales()
        self._moments = np.roll(self._moments, 1, axis=0)
        self._moments[0] = acted.position, feedback.position
        self._added_now = commanded - acted.torque
        if not rising:
            self._check_sudden_effort(acted)
            self._check_opposite_load()
        self._added.add(self._added_now, restart=rising)
        self._needed.add(acted.torque, restart=rising)
        self._fed.add(acted.torque, restart=rising)
        self._check_limits(replies, acted, rising)
        if not (rising or lowered):
            self._check_zeros(replies, commanded)

    @property
    def trusted_joints(self) -> Mask:
        """Joints (n,) that answer, and whose position may be used to control them."""
        return ~self._stale & (self.silent < self._settings.max_missed)

    @property
    def fed_torque(self) -> Array:
        """Mean feed-forward torque of the last moments (n,), NaN before the first [N m]."""
        return self._fed.value

    def _check_states(self, replies: Replies) -> None:
        """Stop for a motor that is not enabled, does not answer, or is too hot."""
        feedback = replies.feedback
        settings = self._settings
        self._raise_first(
            replies.answered & (feedback.status != ENABLED),
            lambda j: f"reports {status_text(int(feedback.status[j]))}",
        )
        silent = self.missed >= settings.max_missed
        silent |= self.silent >= _SILENT_CYCLES * settings.max_missed
        self._raise_first(
            silent & (self._damaged >= settings.max_missed),
            lambda j: (
                f"answered {self._damaged[j]} times in a row what cannot be true: its line is "
                "disturbed, its encoder is not sound, or another motor has its id"
            ),
        )
        self._raise_first(
            silent, lambda j: f"did not answer in time for {self.silent[j]} cycles"
        )
        hot = np.maximum(feedback.temperature_mos, feedback.temperature_rotor)
        self._raise_first(
            replies.answered & (hot > settings.max_temperature),
            lambda j: f"is at {hot[j]} deg C, limit {settings.max_temperature:g}",
        )

    def _check_bus(self) -> None:
        """Stop for a motor that gets commands of another program, or answers too often."""
        text = "gets commands of another program: end it; one master moves an arm"
        self._raise_first(self._foreign > _FEW, lambda j: text)
        self._raise_first(
            self._surplus > _FEW,
            lambda j: (
                "answers more often than it is asked: a second motor has its id, or another "
                "program commands it"
            ),
        )

    def _check_jump(self, replies: Replies) -> None:
        """Stop for a joint whose position jumped, as two samples confirm; mark it as ``stuck``."""
        self.stuck |= replies.jump != 0.0
        self._raise_first(
            replies.jump != 0.0,
            lambda j: (
                f"jumped by {abs(replies.jump[j]):.3f} rad between two samples: its encoder or its "
                "mounting is not sound"
            ),
        )

    def _check_reported(self, commanded: Array, tau: Array) -> None:
        """Stop for a motor that reports, in most of the last cycles, a torque not commanded.

        ``commanded`` (n,) and ``tau`` (n,) are the commanded and the reported torques [N m].
        """
        self._pairs = np.roll(self._pairs, 1, axis=1)
        self._pairs[:, 0] = np.clip(commanded, -self._peak, self._peak), tau
        error = np.abs(self._pairs[1] - self._pairs[0])
        often = np.count_nonzero(error > self._other_torque, axis=0) >= _ENOUGH
        worst = np.argmax(np.nan_to_num(error), axis=0)
        self._raise_first(
            often,
            lambda j: (
                f"reports {self._pairs[1, worst[j], j]:.1f} N m where "
                f"{self._pairs[0, worst[j], j]:.1f} are commanded: it is weak, its supply sags, "
                "its encoder is frozen, its torque has another sign or scale, or another program "
                "commands it"
            ),
        )

    def _check_scales(self) -> None:
        """Stop for a slip; every ``_SCALING_CYCLES`` cycles also for a wrong scale."""
        if self._slip is not None:
            self._raise(self._slip.joint, self._slip.description)
        self._cycles += 1
        if self._cycles % _SCALING_CYCLES:
            return
        worst_torque = self._torque_check.worst()
        if worst_torque is not None:
            self._raise(worst_torque[0], _TORQUE_SCALE.format(worst_torque[1]))
        worst_velocity = self._velocity_check.worst()
        if worst_velocity is not None:
            self._raise(worst_velocity[0], _VELOCITY_SCALE.format(worst_velocity[1]))

    def _check_frozen(
        self, replies: Replies, acted: MitCommand, commanded: Array
    ) -> None:
        """Stop for a joint whose answers, or positions, do not change while its command moves on.

        ``acted`` is the command in force, ``commanded`` (n,) its torque [N m]. A motor with a
        frozen encoder cannot hold its joint: it is disabled at once and its windings brake.
        """
        feedback = replies.feedback
        now = np.stack([feedback.position, feedback.velocity, feedback.torque])
        same = replies.answered & (now[:2] == self._last[:2]).all(axis=0)
        begins = replies.answered & ~same
        command = [acted.position, commanded]
        self._still_since = np.where(begins, command, self._still_since)
        self._still = np.where(begins, 0, self._still + same)
        identical = same & (now[2] == self._last[2])
        self._repeated = np.where(begins, 0, self._repeated + identical)
        self._last = np.where(replies.answered, now, self._last)
        # Change of commanded position and of commanded torque while the answers stayed the same.
        led_by = np.abs(acted.position - self._still_since[0])
        turned_by = np.abs(commanded - self._still_since[1])
        is_led = led_by > _STILL_STEPS * self._position_step
        is_led &= self._still >= _STILL_CYCLES
        does_not_follow = np.abs(commanded - feedback.torque) > 0.5 * self._other_torque
        repeats = is_led & (self._repeated == self._still) & does_not_follow
        self._stale |= repeats
        self._raise_first(
            repeats,
            lambda j: (
                f"repeats the same answer for {self._still[j]} cycles while its command goes on: "
                "its answers are stale"
            ),
        )
        frozen = is_led & ~does_not_follow & (turned_by > _FROZEN_DOUBTS * self._doubt)
        self.stuck |= frozen
        self.to_switch_off |= frozen
        self._raise_first(
            frozen,
            lambda j: (
                f"reports one and the same position while its path goes on by {led_by[j]:.3f} rad "
                f"and its motor pushes with {turned_by[j]:.1f} N m: its encoder is frozen, or it "
                "is blocked"
            ),
        )

    def _check_sudden_effort(self, acted: MitCommand) -> None:
        """Stop for a joint whose effort left its mean of the last moments, some cycles in a row.

        The limit grows with a change of the feed-forward torque, which a wrong model gets wrong.
        """
        change = np.abs(self._added_now - self._added.value)
        model_doubt = _MODEL_SHARE * np.abs(acted.torque - self._needed.value)
        effort_limit = self._effort_limit + model_doubt
        # A standing joint has no friction that reverses, so its limit is lower.
        stands = np.abs(acted.velocity) <= self._velocity_step
        still_limit = np.minimum(effort_limit, self._still_limit)
        effort_limit = np.where(stands, still_limit, effort_limit)
        self._sudden = np.where(change > effort_limit, self._sudden + 1, 0)
        for j in np.flatnonzero(self._sudden >= _ENOUGH)[:1].tolist():
            text = f"suddenly needs {change[j]:.1f} N m beside what carried it"
            self._raise_effort(j, text)

    def _check_opposite_load(self) -> None:
        """Stop for a joint whose load is opposite to its feed-forward torque."""
        needed = self._needed.value
        carried = needed + self._added.value
        is_judged = np.abs(needed) > _LOADED_DOUBTS * self._doubt
        is_opposite = np.sign(needed) * carried < -_OPPOSITE_DOUBTS * self._doubt
        self._raise_first(
            is_judged & is_opposite,
            lambda j: (
                f"carries the arm with {carried[j]:.1f} N m where {needed[j]:.1f} are fed "
                "forward: it is not where it says (its gear slips, its zero has moved), or it is "
                "another joint (cables of two arms exchanged, ids swapped, mirrored)"
            ),
        )

    def _check_zeros(self, replies: Replies, commanded: Array) -> None:
        """Stop for a joint whose zero has moved, by the model's torques; none without a model."""
        if self._zero_check is None:
            return
        feedback = replies.feedback
        time = float(np.mean(replies.time))
        finding = self._zero_check(
            time, feedback.position, feedback.velocity, commanded
        )
        if finding is not None:
            self._raise(*finding)

    def has_left(self, q: Array, reference_q: Array, fed: Array) -> Mask:
        """Return whether each joint (n,) is too far from the position where it should stand still.

        Args:
            q: believed positions (n,) [rad].
            reference_q: positions (n,) at which the joints should stand [rad].
            fed: feed-forward torque (n,) [N m].
        """
        limit = np.where(self.is_pushed(q, reference_q, fed), _PUSHED, 1.0) * self._sag
        return np.asarray(np.abs(q - reference_q) > limit)

    def is_pushed(self, q: Array, reference_q: Array, fed: Array) -> Mask:
        """Return whether each joint (n,) has moved in the direction of its feed-forward torque.

        The arguments are those of ``has_left``; a torque that friction may explain pushes nothing.
        """
        return np.asarray(((q - reference_q) * fed > 0.0) & (np.abs(fed) > self._doubt))

    def _check_standing(self, replies: Replies, acted: MitCommand) -> None:
        """Stop for a joint that should stand still but ``has_left`` its position or moves too fast.

        Its velocity has to exceed the limit in two cycles in a row, because one may be a damaged
        frame; ``_was_fast`` (n,) keeps which velocities did so, for the next cycle.
        """
        q = replies.feedback.position
        qd = replies.feedback.velocity
        fed = acted.torque
        error = q - acted.position
        has_left = self.has_left(q, acted.position, fed)
        is_pushed = self.is_pushed(q, acted.position, fed)
        is_fast = np.abs(qd) > self._speed_limit
        was_fast = self._was_fast
        self._was_fast = is_fast
        self._raise_first(
            replies.answered & (has_left | is_fast & was_fast),
            lambda j: (
                f"is {error[j]:.3f} rad off, at {qd[j]:.2f} rad/s, while it should stand still: "
                f"its feed-forward torque of {round(fed[j], 1) + 0.0:g} N m "
                f"{_DRIVEN if is_pushed[j] else _SINKS}"
            ),
        )

    def _check_limits(self, replies: Replies, acted: MitCommand, rising: bool) -> None:
        """Stop for a joint too far off its commanded position, velocity or torque.

        Velocity and torque must be off in two cycles in a row (``_was_beyond`` has the last one);
        torque is not judged if ``rising``. ``worst_tracking`` is brought up to date.
        """
        feedback = replies.feedback
        path_limit = np.full(len(self._joints), self._settings.max_tracking_error)
        torque_limit = np.inf * self._torque_limit if rising else self._torque_limit
        limits = np.array([path_limit, self._speed_limit, torque_limit])
        # A light joint has slowed down by the end of the cycle, when it is sampled.
        slowed = acted.velocity / self._velocity_check.explained
        lowest = np.minimum(acted.velocity, slowed)
        highest = np.maximum(acted.velocity, slowed)
        expected_velocity = np.clip(feedback.velocity, lowest, highest)
        measured = np.array([feedback.position, feedback.velocity, feedback.torque])
        targets = np.array([acted.position, expected_velocity, acted.torque])
        errors = np.where(replies.answered, np.abs(measured - targets), 0.0)
        self.worst_tracking = np.maximum(self.worst_tracking, errors[0])
        is_beyond = errors > limits
        # One velocity or torque that is a little too large may be a damaged frame.
        counts = is_beyond & self._was_beyond
        counts[0] = is_beyond[0]
        self._was_beyond = is_beyond
        for k, j in np.argwhere(counts)[:1].tolist():
            text = f"is {errors[k, j]:.3f} {_OFF[k]}, limit {limits[k, j]:g}"
            self._raise_effort(j, text)

    def _raise_effort(self, joint: int, description: str) -> None:
        """Raise a fault of a blocked joint if there is one, else of ``joint``.

        ``description`` is a sentence about ``joint`` without its name.
        """
        blocked = self._blocked_joint()
        if blocked is not None:
            self.stuck[blocked] = True
            text = f"stands still while its path goes on: it is blocked ({description})"
            self._raise(blocked, text)
        self._raise(joint, description)

    def _blocked_joint(self) -> int | None:
        """Return the index of the joint that moved least for its command, if blocked; else None."""
        # Changes (_MOMENTS, n) of command and of position from each of the last cycles until now.
        led_by, came_by = np.abs(self._moments[0] - self._moments).transpose(1, 0, 2)
        moved_share = came_by / np.maximum(led_by, _LED_BY)
        share = np.where(led_by > _LED_BY, moved_share, np.inf)
        joint = int(np.argmin(np.min(share, axis=0)))
        return joint if np.min(share[:, joint]) < _CAME_SHARE else None

    def _raise_first(self, mask: Mask, describe: Callable[[int], str]) -> None:
        """Raise HardwareAbort for the first joint in a mask (n,); ``describe`` gets its index."""
        for j in np.flatnonzero(mask)[:1].tolist():
            self._raise(j, describe(j))

    def _raise(self, joint: int, description: str) -> None:
        """Raise HardwareAbort for a joint; ``description`` is a sentence without its name."""
        raise HardwareAbort(f"{self._joints[joint].label} {description}")


_OFF = "rad off its path", "rad/s off its speed", "N m off its torque"
_TORQUE_SCALE = (
    "reports {:.2f} times the torque that it was commanded to make: its TMAX register does not "
    "describe its torques, or its torque ratio is another"
)
_VELOCITY_SCALE = (
    "moves {:.3f} times as far as its velocity says, and sampling does not explain it: one of the "
    "two has another scale; turn the joint by hand by a known angle and compare with 'motors "
    "monitor', before anything is changed"
)


class _RunningMean:
    """Exponentially weighted mean of vectors (n,); the mean is NaN before the first.

    ``share`` is the weight of each new vector; with 1 or more, the last one is the mean.
    """

    def __init__(self, n_joints: int, share: float) -> None:
        self.value: Array = np.full(n_joints, np.nan)
        self._share = min(share, 1.0)

    def add(self, value: Array, restart: bool) -> None:
        """Add a vector (n,), or take it as the mean if ``restart``; NaN entries change nothing."""
        share = 1.0 if restart else self._share
        mean = np.where(np.isnan(self.value), value, self.value)
        self.value = np.where(np.isnan(value), mean, mean + share * (value - mean))
