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
    ScaleCheck,
    VelocityCheck,
)
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array

_MOVES = (
    "while it should stand still: a motor turns the other way than its joint, two ids are swapped, "
    "or the file's torque lacks gravity or is for another pose or arm; see 'motors map'"
)
# Rows of what is watched of each joint: torque reported against torque commanded; position,
# velocity and torque against the path; effort against the effort of the last moments. Then the
# number of cycles in a row that have to be beyond the limit: one may be a damaged frame.
_REPORTED, _PATH, _SPEED, _TORQUE, _EFFORT = range(5)
_CYCLES = np.array([[3], [1], [2], [2], [3]])


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
        steps: tuple[Array, ...],
        peak_torque: Array,
        holding: HoldingCheck,
    ) -> None:
        n_joints = len(joints)
        self._joints = joints
        self._settings = settings
        self._peak = peak_torque
        self._position_step, self._velocity_step, torque_step = steps
        self._doubt = torque_doubt(joints)
        rated = np.array([j.spec.rated_torque for j in joints])
        kp = np.maximum(settings.kp, 1e-9)
        # How far a standing joint may sag: an arm half a radian from the first point, or with a new
        # load, needs half of this.
        self._sag = np.minimum(2.0 * rated / kp, settings.max_tracking_error)
        # The limit of a sudden effort is that of a position error of 0.05 rad.
        way = 0.05 * kp
        self._still_limit = np.maximum(way, 0.03 * peak_torque)
        # Limits (5, n) of what is watched, for an arm that moves.
        self._limits = np.array(
            [
                0.15 * peak_torque + 4.0 * torque_step,
                np.full(n_joints, settings.max_tracking_error),
                # Both velocities may be off by one step.
                settings.max_speed_error + 2.0 * self._velocity_step,
                settings.max_torque_error,
                np.clip(way, 0.1 * peak_torque, 0.25 * peak_torque),
            ]
        )
        # Number of cycles in a row (5, n) in which each was beyond its limit.
        self._beyond = np.zeros((5, n_joints), int)
        # kp is above 0 here, because ``VelocityCheck`` divides by these values.
        fades = settings.period * kp / np.array(settings.kd)
        self._velocity_check = VelocityCheck(self._velocity_step, fades)
        # Error of a single torque: by rounding, or half a percent of the peak torque. Judged from
        # 25 torques on. TMAX of two types differ by a fifth.
        self._torque_scale = ScaleCheck(
            np.maximum(4.0 * torque_step, 0.005 * peak_torque),
            least=25,
            tolerance=0.15,
            explained=np.ones(n_joints),
        )
        self._zero_check = holding.watch and holding.watch()
        # (2, n) each, NaN before the first cycle: means of effort and of feed-forward torque over
        # the last moments; position and velocity of the last answer; commanded position and torque
        # when an answer last differed from the one before.
        unknown = np.full((2, n_joints), np.nan)
        self._means = self._last = self._still_since = unknown
        self._cycles = 0
        self.missed, self.silent, self.total_missed = np.zeros((3, n_joints), int)
        # Cycles in a row with doubted answers only.
        self._damaged = np.zeros(n_joints, int)
        # Answers in a row with the same position and velocity.
        self._still = np.zeros(n_joints, int)
        self._surplus, self._foreign = np.zeros((2, n_joints))
        self.worst_tracking = np.zeros(n_joints)
        self.failed, self.stuck, self.to_switch_off = np.zeros((3, n_joints), bool)
        self._stale = np.zeros(n_joints, bool)
        self._slip: tuple[int, str] | None = None
        # Commanded and reported positions of the last 25 cycles, in which a blocked joint is looked
        # for, the newest first.
        self._moments = np.full((25, 2, n_joints), np.nan)

    def update(self, replies: Replies) -> None:
        """Count missing, doubted and surplus answers, and foreign commands, of a cycle's replies.

        A motor that reports a fault is noted in ``failed``, and a slip for the next ``check``.
        """
        unanswered = replies.requested & ~replies.answered
        damaged = self._damaged + replies.doubted
        counts = [self.missed + unanswered, self.silent + 1, damaged]
        self.missed, self.silent, self._damaged = np.where(replies.answered, 0, counts)
        self.total_missed += unanswered
        # Counts decay: a single wrong one is a damaged frame.
        self._surplus = 0.9 * self._surplus + replies.surplus
        self._foreign = 0.9 * self._foreign + replies.foreign
        feedback = replies.feedback
        is_faulty = (feedback.status != ENABLED) & (feedback.status != NO_STATUS)
        # Where two motors answer on one id, the status may be the other motor's: see _check_states.
        is_double = is_faulty & (self._surplus > 1.0)
        self._surplus = np.where(is_double, np.inf, self._surplus)
        self.failed |= is_faulty & ~is_double
        slip = self._velocity_check.add(
            replies.time, feedback.position, feedback.velocity
        )
        self._slip = slip or self._slip

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
        self._check_states(replies)
        self._check_frozen(replies, acted, commanded)
        self._moments = np.roll(self._moments, 1, axis=0)
        self._moments[0] = acted.position, feedback.position
        effort = commanded - acted.torque
        self._check_limits(replies, acted, commanded, effort, standing, rising)
        self._check_scales(commanded, feedback.torque, feedback.velocity)
        if not rising:
            self._check_opposite_load()
        values = np.array([effort, acted.torque])
        # Over a quarter of a second.
        share = 1.0 if rising else min(self._settings.period / 0.25, 1.0)
        means = np.where(np.isnan(self._means), values, self._means)
        changed = means + share * (values - means)
        self._means = np.where(np.isnan(values), means, changed)
        if self._zero_check is not None and not (rising or lowered):
            time = np.mean(replies.time)
            finding = self._zero_check(
                time, feedback.position, feedback.velocity, commanded
            )
            if finding is not None:
                self._raise(*finding)

    @property
    def trusted_joints(self) -> Mask:
        """Joints (n,) that answer, and whose position may be used to control them."""
        return ~self._stale & (self.silent < self._settings.max_missed)

    @property
    def fed_torque(self) -> Array:
        """Mean feed-forward torque of the last moments (n,), NaN before the first [N m]."""
        return self._means[1]

    def _check_states(self, replies: Replies) -> None:
        """Stop for a motor that gets commands of another program, answers too often, is not
        enabled, does not answer, is too hot, or jumped.
        """
        # Decayed count of what may be damaged frames.
        few = 2.5
        self._raise_first(
            self._foreign > few,
            lambda j: (
                "gets commands of another program: end it; one master moves an arm"
            ),
        )
        self._raise_first(
            self._surplus > few,
            lambda j: (
                "answers more often than it is asked: a second motor has its id, or another "
                "program commands it"
            ),
        )
        feedback = replies.feedback
        settings = self._settings
        self._raise_first(
            replies.answered & (feedback.status != ENABLED),
            lambda j: f"reports {status_text(feedback.status[j])}",
        )
        # A motor whose answer is missing is sent nothing for four cycles, see ``session.PAUSE``, so
        # commands alone would count too slowly.
        silent = self.missed >= settings.max_missed
        silent |= self.silent >= 2 * settings.max_missed
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
        hot = feedback.temperature
        self._raise_first(
            replies.answered & (hot > settings.max_temperature),
            lambda j: f"is at {hot[j]} deg C, limit {settings.max_temperature:g}",
        )
        # Two samples confirm a jump.
        self.stuck |= replies.jump != 0.0
        self._raise_first(
            replies.jump != 0.0,
            lambda j: (
                f"jumped by {abs(replies.jump[j]):.3f} rad between two samples: its encoder or its "
                "mounting is not sound"
            ),
        )

    def _check_scales(self, commanded: Array, tau: Array, qd: Array) -> None:
        """Stop for a slip; every 50 cycles also for a wrong scale.

        ``commanded`` (n,) and ``tau`` (n,) are the commanded and the reported torques [N m], ``qd``
        (n,) the velocities [rad/s].
        """
        # A motor may fail to make more, and at higher velocities [rad/s] late samples would make
        # a commanded torque wrong.
        can_follow = np.abs(commanded) < 0.9 * self._peak
        usable = np.isfinite(tau) & can_follow & (np.abs(qd) < 0.1)
        self._torque_scale.add(commanded, tau, usable)
        if self._slip is not None:
            self._raise(*self._slip)
        self._cycles += 1
        if self._cycles % 50 == 0:
            for check, sentence in (
                (self._torque_scale, _TORQUE_SCALE),
                (self._velocity_check.scale, _VELOCITY_SCALE),
            ):
                worst = check.worst()
                if worst is not None:
                    self._raise(worst[0], sentence.format(worst[1]))

    def _check_frozen(
        self, replies: Replies, acted: MitCommand, commanded: Array
    ) -> None:
        """Stop for a joint whose answers, or positions, do not change while its command moves on.

        ``acted`` is the command in force, ``commanded`` (n,) its torque [N m]. A motor with a
        frozen encoder cannot hold its joint: it is disabled at once and its windings brake.
        """
        feedback = replies.feedback
        now = np.stack([feedback.position, feedback.velocity])
        same = replies.answered & (now == self._last).all(axis=0)
        begins = replies.answered & ~same
        command = [acted.position, commanded]
        self._still_since = np.where(begins, command, self._still_since)
        self._still = np.where(begins, 0, self._still + same)
        self._last = np.where(replies.answered, now, self._last)
        # Change of commanded position and of commanded torque while the answers stayed the same.
        led_by = np.abs(acted.position - self._still_since[0])
        turned_by = np.abs(commanded - self._still_since[1])
        is_led = (led_by > 20.0 * self._position_step) & (self._still >= 3)
        difference = np.abs(commanded - feedback.torque)
        does_not_follow = difference > 0.5 * self._limits[_REPORTED]
        repeats = is_led & does_not_follow
        self._stale |= repeats
        self._raise_first(
            repeats,
            lambda j: (
                f"repeats the same position for {self._still[j]} cycles while its command goes on: "
                "its answers are stale"
            ),
        )
        # Twice the doubt overcomes dry friction.
        frozen = is_led & ~does_not_follow & (turned_by > 2.0 * self._doubt)
        self.stuck |= frozen
        self.to_switch_off |= frozen
        self._raise_first(
            frozen,
            lambda j: (
                f"reports one and the same position while its path goes on by {led_by[j]:.3f} rad "
                f"and its motor pushes with {turned_by[j]:.1f} N·m: its encoder is frozen, or it "
                "is blocked"
            ),
        )

    def _check_opposite_load(self) -> None:
        """Stop for a joint whose load is opposite to its feed-forward torque."""
        effort, fed = self._means
        carried = fed + effort
        is_judged = np.abs(fed) > 2.0 * self._doubt
        is_opposite = np.sign(fed) * carried < -0.5 * self._doubt
        self._raise_first(
            is_judged & is_opposite,
            lambda j: (
                f"carries the arm with {carried[j]:.1f} N·m where {fed[j]:.1f} are fed "
                "forward: it is not where it says (its gear slips, its zero has moved), or it is "
                "another joint (cables of two arms exchanged, ids swapped, mirrored)"
            ),
        )

    def standing_limit(self, q: Array, reference_q: Array, fed: Array) -> Array:
        """Return how far each joint (n,) may be from the position where it should stand still.

        Args:
            q: believed positions (n,) [rad].
            reference_q: positions (n,) at which the joints should stand [rad].
            fed: feed-forward torque (n,) [N m].
        """
        # No load pulls in the direction of the feed-forward torque.
        return np.where(self.is_pushed(q, reference_q, fed), 0.5, 1.0) * self._sag

    def is_pushed(self, q: Array, reference_q: Array, fed: Array) -> Mask:
        """Return whether each joint (n,) has moved in the direction of its feed-forward torque.

        The arguments are those of ``standing_limit``; a torque that friction may explain pushes
        nothing.
        """
        return ((q - reference_q) * fed > 0.0) & (np.abs(fed) > self._doubt)

    def _check_limits(
        self,
        replies: Replies,
        acted: MitCommand,
        commanded: Array,
        effort: Array,
        standing: bool,
        rising: bool,
    ) -> None:
        """Stop for a joint whose position, velocity, torque or effort is too far from the expected.

        Expected are the command in force, and for the effort its mean over the last moments. Where
        joints are to stand still, ``standing_limit`` says how far they may sag. ``worst_tracking``
        is brought up to date.

        Args:
            replies: replies of all n joints.
            acted: command in force when the replies were sampled.
            commanded: torque (n,) that it commands at the sampled state [N m].
            effort: part (n,) of it that the position control adds [N m].
            standing: whether the joints are to stand still.
            rising: whether gains are being raised; then torque and effort are not judged.
        """
        feedback = replies.feedback
        fed = acted.torque
        limits = self._limits.copy()
        if standing:
            limits[_PATH] = self.standing_limit(feedback.position, acted.position, fed)
        # A wrong model gets half of a change of the feed-forward torque wrong.
        mean_effort, mean_fed = self._means
        limits[_EFFORT] += 0.5 * np.nan_to_num(np.abs(fed - mean_fed))
        # A standing joint has no friction that reverses, so its limit is lower.
        stands = np.abs(acted.velocity) <= self._velocity_step
        still_limit = np.minimum(limits[_EFFORT], self._still_limit)
        limits[_EFFORT] = np.where(stands, still_limit, limits[_EFFORT])
        if rising:
            limits[_TORQUE:] = np.inf
        # A light joint has slowed down by the end of the cycle, when it is sampled.
        slowed = acted.velocity / self._velocity_check.explained
        lowest = np.minimum(acted.velocity, slowed)
        highest = np.maximum(acted.velocity, slowed)
        velocity = np.clip(feedback.velocity, lowest, highest)
        reachable = np.clip(commanded, -self._peak, self._peak)
        tau = feedback.torque
        measured = np.array([tau, feedback.position, feedback.velocity, tau, effort])
        expected = np.array([reachable, acted.position, velocity, fed, mean_effort])
        errors = np.nan_to_num(np.abs(measured - expected))
        self.worst_tracking = np.maximum(self.worst_tracking, errors[_PATH])
        # A missing answer tells nothing.
        is_within = replies.answered & (errors <= limits)
        self._beyond = np.where(is_within, 0, self._beyond + (errors > limits))
        for k, j in np.argwhere(self._beyond >= _CYCLES)[:1]:
            text = _BEYOND[k].format(errors[k, j], limits[k, j], tau[j], reachable[j])
            if k in (_PATH, _SPEED) and standing:
                text += f", {_MOVES}"
            blocked = None if k == _REPORTED else self._blocked_joint()
            if blocked is not None:
                self.stuck[blocked] = True
                text = f"stands still while its path goes on: it is blocked ({text})"
                j = blocked
            self._raise(j, text)

    def _blocked_joint(self) -> int | None:
        """Return the index of the joint that moved least for its command, if blocked; else None."""
        # Changes (25, n) of command and of position from each of the last cycles until now.
        led_by, came_by = np.abs(self._moments[0] - self._moments).transpose(1, 0, 2)
        # Least change of command by which a joint is judged [rad].
        least = 0.015
        moved_share = came_by / np.maximum(led_by, least)
        share = np.where(led_by > least, moved_share, np.inf)
        joint = int(np.argmin(np.min(share, axis=0)))
        return joint if np.min(share[:, joint]) < 0.3 else None

    def _raise_first(self, mask: Mask, describe: Callable[[int], str]) -> None:
        """Raise HardwareAbort for the first joint in a mask (n,); ``describe`` gets its index."""
        for j in np.flatnonzero(mask)[:1]:
            self._raise(j, describe(j))

    def _raise(self, joint: int, description: str) -> None:
        """Raise HardwareAbort for a joint; ``description`` is a sentence without its name."""
        raise HardwareAbort(f"{self._joints[joint].label} {description}")


# What is said of the rows of ``_CYCLES``: error, limit, reported and commanded torque.
_BEYOND = (
    "reports {2:.1f} N·m where {3:.1f} are commanded: it is weak, its supply sags, its encoder is "
    "frozen, its torque has another sign or scale, or another program commands it",
    "is {0:.3f} rad off its path, limit {1:g}",
    "is {0:.3f} rad/s off its speed, limit {1:g}",
    "is {0:.3f} N·m off its torque, limit {1:g}",
    "suddenly needs {0:.1f} N·m beside what carried it",
)
_TORQUE_SCALE = (
    "reports {:.2f} times the torque that it was commanded to make: its TMAX register does not "
    "describe its torques"
)
_VELOCITY_SCALE = (
    "moves {:.3f} times as far as its velocity says, and sampling does not explain it: one of the "
    "two has another scale; turn the joint by hand by a known angle and compare with 'motors "
    "monitor', before anything is changed"
)
