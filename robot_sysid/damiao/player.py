"""Playing a trajectory on motors: enable, approach, play, come to rest; or a controlled stop.

The player only deals with motors and time: whether a real arm, a simulated one or a test double
answers makes no difference. In each control cycle it sends one command and gets the state of each
joint, sampled just before this command acts: so a sample belongs to the command of the last cycle,
which is called ``acted``. All quantities are those of joints, (n,) [rad, rad/s, N m]. A state is
believed where it is plausible after the last believed one.
"""

from __future__ import annotations

import contextlib
import signal
import time
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from robot_sysid.damiao.bus import SystemClock, undisturbed_processor
from robot_sysid.damiao.protocol import KD_STEP, Codes, MitCommand
from robot_sysid.damiao.recorder import Aside, MeasurementRecorder
from robot_sysid.damiao.references import (
    Activity,
    Follower,
    Reference,
    ReferenceFunction,
    hold_reference,
    transfer_reference,
)
from robot_sysid.damiao.safety.health import CONFIRMED
from robot_sysid.damiao.safety.holding import HoldingTorque
from robot_sysid.damiao.safety.outputs import watched_outputs
from robot_sysid.damiao.safety.plausibility import Mask, Replies
from robot_sysid.damiao.safety.reversal import Reversal
from robot_sysid.damiao.safety.stopping import LONGEST_LOWERING, CarriedStop, Lowering
from robot_sysid.damiao.safety.watch import PLAYING, Phase, Watch
from robot_sysid.damiao.session import REPLY_SHARE, MotorSession
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.errors import (
    SUSPENSION,
    HardwareAbort,
    error_text,
    handle_stop_signals,
)
from robot_sysid.records import Array
from robot_sysid.wording import option_name

RISE_SHARE = 0.2
"""Share of the ramp's time in which stiffness and torque rise: short, so that the arm does not sink
under a load that nobody knows; in the rest of the time the standing arm is observed."""
LEAST_RISE_STEPS = 4.0
"""Number of cycles of that time at which they still rise step by step. In fewer, longer steps the
arm would fall before it is held, so that all is there at once."""
LONGEST_STOP = 2.0
"""Time after which the motors are disabled although the arm has not come to rest [s]: twice what
braking from 5 rad/s, a motor's no-load speed, and the rest after it take (a judgement)."""
LONGEST_SILENCE = 0.15
"""Time without any answer after which a stop has no effect any more [s]: by then the watchdogs (0.1
s, plus half of that) have stopped the motors, or the bus has failed."""
SAME_KEY_PRESS = 0.2
"""Time within which a second interrupt is the same key press [s]: it may arrive twice, from the
terminal and passed on by the program that started this one. A busy computer passes it on in less
time; a person who presses twice takes longer."""
_STATED_PERCENTILES = [50.0, 99.0]
"""Percentiles of the cycles' delays that a report states."""


class CycleTimer:
    """Waits for the cycles of a control loop; their deadlines are multiples of the period.

    The deadlines do not depend on when earlier cycles began, so lateness does not accumulate.

    Attributes:
        period: length of a cycle [s].
        max_lateness: largest delay with which a cycle may begin [s].
        skipped: number of cycles that passed while the computer was late.
        lateness: delay of each cycle [s].
    """

    def __init__(self, clock: SystemClock, period: float, max_lateness: float) -> None:
        self._clock = clock
        self.period = period
        self.max_lateness = max_lateness
        self._start = clock.now() + period
        self._index = 0
        self.skipped = 0
        self.lateness = array("f")

    @property
    def next_deadline(self) -> float:
        """Time in the clock at which the next cycle is due [s]."""
        return self._start + self._index * self.period

    def wait(self, lenient: bool = False) -> float:
        """Sleep until the next cycle is due and return its deadline in the clock [s].

        Whole cycles that have already passed are skipped, never replayed: the deadline is then that
        of the last one that is due. Unless ``lenient``, a delay of more than ``max_lateness``
        raises HardwareAbort.
        """
        deadline = self.next_deadline
        self._clock.sleep_until(deadline)
        lateness = self._clock.now() - deadline
        self.lateness.append(lateness)
        n_passed = max(int(lateness / self.period), 0)
        self.skipped += n_passed
        self._index += n_passed + 1
        if not lenient:
            self._require_timely(lateness)
        return deadline + n_passed * self.period

    def require_kept(self) -> None:
        """Raise HardwareAbort where the present cycle has not ended by when the next one is due.

        A program that was held in the middle of a cycle finds motors whose watchdogs have ended,
        and joints elsewhere: that is its own pause, and no fault of theirs.
        """
        self._require_timely(self._clock.now() - self.next_deadline)

    def _require_timely(self, lateness: float) -> None:
        """Raise HardwareAbort for a delay [s] of more than ``max_lateness``."""
        if lateness > self.max_lateness:
            raise HardwareAbort(
                f"the computer was {1e3 * lateness:.1f} ms late for a control cycle, limit "
                f"{1e3 * self.max_lateness:g} ms; allow real-time priority (see docs/motors.md), "
                f"close other programs or lower {option_name('rate')}"
            )


@dataclass(frozen=True)
class PlayReport:
    """Timing, health of the bus and tracking errors of a run of n joints.

    The health is that of all cycles since the motors were enabled. A command is answered, or its
    answer was refused, came late, or was lost.

    Attributes:
        cycles: number of control cycles in which the trajectory was played.
        skipped: number of cycles that were skipped because the computer was late.
        lateness_p50: median delay of the cycles [s].
        lateness_p99: 99th percentile of the cycles' delays [s].
        missed: number (n,) of commands without an answer that was used.
        worst_tracking: largest distance (n,) from the commanded position [rad].
        commands: number (n,) of commands.
        late: number (n,) of answers that no command of their cycle awaited any more.
        refused: number (n,) of answers that were not used, because they cannot be true or say that
            the motor does not drive.
        reports: how often each of the n motors answered with a status code other than "enabled", by
            code, whether the answer was used or not.
        error_frames: number of error frames on the bus, as far as the adapter reports them.
        findings: what the recording says of the arm, a sentence each.
        is_as_expected: whether the recording contradicts neither itself nor the model by more than
            models are usually off.
    """

    cycles: int
    skipped: int
    lateness_p50: float
    lateness_p99: float
    missed: Codes
    worst_tracking: Array
    commands: Codes
    late: Codes
    refused: Codes
    reports: tuple[Mapping[int, int], ...]
    error_frames: int
    findings: tuple[str, ...] = ()
    is_as_expected: bool = True

    @property
    def n_lost(self) -> Codes:
        """Number (n,) of commands to which no answer came at all."""
        return np.maximum(self.missed - self.late - self.refused, 0)

    @property
    def lost_share(self) -> float:
        """Share of all commands to which no answer came at all."""
        return float(np.sum(self.n_lost)) / max(float(np.sum(self.commands)), 1.0)

    @property
    def is_flawless(self) -> bool:
        """Whether every command was answered, and nothing else was seen on the bus."""
        counts = np.concatenate([self.missed, self.late, self.refused])
        return not (np.any(counts) or self.error_frames or any(self.reports))

    @property
    def confirmed_reports(self) -> tuple[Mapping[int, int], ...]:
        """The ``reports`` that are the motors' own: a single one may be a damaged answer."""
        return tuple(
            {code: n for code, n in sorted(counts.items()) if n >= CONFIRMED}
            for counts in self.reports
        )


class Player:
    """Plays a trajectory once through a session of n motors.

    Args:
        session: session of the motors; it is entered and left by the caller.
        settings: gains, speeds and limits, with one gain per motor.
        stop: request for a stop, which is checked in every cycle.
        recorder: gets every cycle of the trajectory, but no transfers; None records nothing.
        console: prints beside the control loop.
        on_phase: called by the console with the name of each new phase.
        holding: computes the torque that holds the arm.
    """

    def __init__(
        self,
        session: MotorSession,
        settings: PlaySettings,
        stop: StopRequest,
        recorder: MeasurementRecorder | None,
        console: Aside,
        on_phase: Callable[[str], None],
        holding: HoldingTorque,
    ) -> None:
        self._session = session
        self._clock = session.clock
        self._settings = settings
        self._stop = stop
        self._recorder = recorder
        self._console = console
        self._announce: Callable[[str], None] = lambda text: console(
            partial(on_phase, text)
        )
        self._holding = holding
        self._watch = Watch(
            session.joints, settings, session.steps, session.limits.torque, holding
        )
        self._timer: CycleTimer
        self._kp = np.array(settings.kp)
        self._kd = np.array(settings.kd)
        # Factor, from 0 to 1, of stiffness and feed-forward torque.
        self._gain = 0.0
        self._phase = Phase(stands=True, settles=True)
        # The last reference and the last command that were sent.
        self._reference: Reference | None = None
        self._command: MitCommand | None = None
        # Gets the arm's state in every cycle; the reference, if that depends on it.
        self._follower = Follower()
        # Time in the clock at which the last phase before a stop began [s].
        self._origin: float
        # Time of the last answer in the clock [s].
        self._heard_at = 0.0
        self._reversal = Reversal(session.joints)
        # Motors (n,) that were switched off because they turned against their command.
        self._turned = np.zeros(session.n_joints, bool)
        # Torque (n,) that the reference needed before a stop [N m].
        self._needed = np.zeros(session.n_joints)
        self._n_recorded = 0
        self._first_error_frame = session.error_frames

    def play(self, activity: Activity) -> PlayReport:
        """Enable the motors, do what the activity says, rest, lower, and return a report.

        The session disables the motors afterwards. After any error, motors that still answer are
        brought to rest; then HardwareAbort states the cause.
        """
        with undisturbed_processor(self._clock.live):
            try:
                self._run_phases(activity)
            except BaseException as error:
                self._stop_gently()
                cause = self._reversed_motors
                since = self._watch.health.reason_of_silence()
                if isinstance(error, HardwareAbort) and not cause + since:
                    raise
                reason = f"{type(error).__name__}: {error_text(error)}"
                if isinstance(error, HardwareAbort):
                    reason = str(error)
                raise HardwareAbort(cause + reason + since) from error
        assert self.report is not None
        return self.report

    @property
    def report(self) -> PlayReport | None:
        """The run so far, also one that was stopped; None before the first cycle."""
        if self._reference is None:
            return None
        p50, p99 = np.percentile(self._timer.lateness, _STATED_PERCENTILES).tolist()
        health = self._watch.health
        return PlayReport(
            self._n_recorded,
            self._timer.skipped,
            p50,
            p99,
            health.total_missed,
            self._watch.worst_tracking,
            health.commanded,
            health.late,
            health.doubted,
            tuple(health.reports),
            self._session.error_frames - self._first_error_frame,
        )

    def _run_phases(self, activity: Activity) -> None:
        """Go through the phases of a run: enable, raise gains, approach, play, rest, lower.

        Any fault, or a request to stop, raises.
        """
        settings = self._settings
        self._stop_if_asked()
        self._announce("enabling the motors")
        start = self._session.enable()
        standing = Reference.at_rest(start, self._holding)
        self._timer = CycleTimer(self._clock, settings.period, settings.max_lateness)
        self._announce("raising the gains")
        rising = Phase(stands=True, rises=True, settles=True)
        self._follow(hold_reference(standing), settings.ramp_time, rising)
        self._hold_and_compare(standing)
        first = activity.first
        if first is not None:
            approach, approach_time = transfer_reference(
                standing,
                first,
                settings.approach_speed,
                settings.approach_time,
                self._holding,
            )
            self._announce(f"moving to the first point ({approach_time:.1f} s)")
            self._follow(approach, approach_time, Phase(settles=True))
            self._hold_and_compare(first)
        self._announce(activity.announcement)
        reference = activity.begin(standing)
        phase = Phase(yields=isinstance(reference, Follower))
        self._follow(reference, activity.duration, phase, record=True)
        self._announce("coming to rest")
        last = reference(activity.duration)
        self._follow(hold_reference(last), settings.rest_time)
        if settings.park is not None:
            self._announce("lowering the arm")
            lowering = self._lower_from(last)
            self._follow(lowering, LONGEST_LOWERING, Phase(yields=True))

    def _hold_and_compare(self, reference: Reference) -> None:
        """Hold the arm still for ``rest_time``; HardwareAbort where its torques do not carry it."""
        phase = Phase(stands=True, settles=True)
        self._follow(hold_reference(reference), self._settings.rest_time, phase)
        self._watch.check_holding(self._session.believed_motion[0])

    def _lower_from(self, begin: Reference) -> Lowering:
        """Return the reference that lowers the arm from ``begin``.

        Without a model nobody knows where the arm comes to lie, so the range of commands is opened.
        """
        if not self._holding.is_model:
            self._session.open_range()
        speed = self._settings.approach_speed
        lowering = Lowering(begin, speed, self._session.limits)
        lowering.stiffness = self._follower.stiffness
        return lowering

    def _follow(
        self,
        reference: ReferenceFunction,
        length: float,
        phase: Phase = PLAYING,
        record: bool = False,
    ) -> None:
        """Follow a reference for a time, one command per cycle; HardwareAbort for fault or stop.

        Args:
            reference: reference by the time since the phase began [s].
            length: duration [s]; a follower may end it earlier, and gets the state of every cycle.
            phase: what may be expected of the arm.
            record: whether cycles are recorded.
        """
        origin = self._timer.next_deadline
        self._origin = origin
        self._phase = phase
        self._follower = reference if isinstance(reference, Follower) else Follower()
        # Half a period of slack keeps the last sample in spite of rounding.
        end = origin + length + 0.5 * self._settings.period
        while self._timer.next_deadline < end:
            if self._follower.is_done:
                return
            deadline = self._timer.wait()
            time = min(deadline - origin, length)
            target = reference(time)
            if self._follower is not reference:
                target = self._carried_where_it_is(target)
            self._stop_if_asked()
            followed = self._reference or target
            replies, acted = self._exchange(target)
            if record:
                self._n_recorded += 1
                if self._recorder:
                    self._recorder.write(time, origin, replies, acted)
            self._timer.require_kept()
            self._watch.check(replies, acted, followed, phase)

    def _carried_where_it_is(self, reference: Reference) -> Reference:
        """Return a reference that feeds the weight of the pose in which the arm is, by the model.

        A soft arm sags, and weighs more as it sinks. Fed by the reference's pose, this growth would
        take the stiffness away that is to hold it, and the arm would sag twice as far or topple.
        """
        trusted, _ = self._trusted_motion
        if not self._holding.is_model or not np.isfinite(trusted).all():
            return reference
        fed = reference.weight
        if not np.isfinite(fed).all():
            fed = self._holding.torque(reference.position)
        weight = self._holding.torque(self._session.position_now)
        torque = reference.torque + weight - fed
        return reference._replace(torque=torque, weight=weight)

    def _stop_if_asked(self) -> None:
        """Raise HardwareAbort if a stop was requested, or recording or printing failed."""
        self._stop.look_at_outputs()
        if self._stop.reason:
            raise HardwareAbort(self._stop.reason)
        if self._recorder and self._recorder.failure is not None:
            raise HardwareAbort(f"cannot record: {error_text(self._recorder.failure)}")
        if self._console.failure is not None:
            raise HardwareAbort(f"cannot print: {error_text(self._console.failure)}")

    def _exchange(
        self, reference: Reference, braking: bool = False
    ) -> tuple[Replies, MitCommand]:
        """Command a reference, and pass the arm's state to watch and follower.

        Returns the replies, and the command that was in force when they were sampled. Reference,
        command and the time of the replies are stored. The gain, which scales stiffness and torque,
        rises to 1 in the first cycles of a run. Motors that the run has switched off get no
        command. If ``braking``, a command beyond the bounds is limited to them, not refused, and
        motors whose answers are missing are commanded too.
        """
        n_steps = RISE_SHARE * self._settings.ramp_time / self._settings.period
        rise = 1.0 / n_steps if n_steps > LEAST_RISE_STEPS else 1.0
        self._gain = min(self._gain + rise, 1.0)
        position, velocity, torque, *_ = reference
        kp = self._gain * self._kp * self._follower.stiffness
        kd = self._follower.damping * self._kd
        # Motors with stiffness alone oscillate.
        kd = np.maximum(kd, KD_STEP * (kp > 0.0))
        command = MitCommand(position, velocity, kp, kd, self._gain * torque)
        # A motor makes no torque before its first command.
        zero = 0.0 * torque
        acted = self._command or command._replace(kp=zero, kd=zero, torque=zero)
        until = self._clock.now() + REPLY_SHARE * self._settings.period
        # A motor that does not answer may still obey, and one that reports a fault may still drive.
        driven = ~self._watch.to_switch_off
        replies = self._session.exchange(command, until, driven, braking)
        self._watch.health.update(replies)
        self._reference = reference
        self._command = replies.command
        q, qd = self._session.believed_motion
        motor_torque = acted.motor_torque(q, qd)
        if not braking:
            self._needed = torque + self._watch.usually_added
        q, qd = self._trusted_motion
        off = q - acted.position
        signals = qd, acted.velocity, motor_torque, self._needed
        self._reversal.add(self._clock.now(), off, *signals)
        self._follower.follow(q, qd, motor_torque)
        if replies.answered.any():
            self._heard_at = self._clock.now()
        return replies, acted

    @property
    def _trusted_motion(self) -> tuple[Array, Array]:
        """Believed positions and velocities (n,) [rad, rad/s] of joints that can be controlled.

        They are NaN where they are not trusted, or the run has switched the motor off.
        """
        q, qd = self._session.believed_motion
        watch = self._watch
        is_known = watch.trusted_joints & ~watch.to_switch_off
        return np.where(is_known, q, np.nan), np.where(is_known, qd, np.nan)

    def _stop_gently(self) -> None:
        """Brake the motors that still answer, and hold the arm until it is at rest.

        Then the arm is lowered if ``park`` is not None and the user does not insist on an end.
        Nothing is done before the first complete cycle; errors during the stop are suppressed.
        """
        if self._reference is None:
            return
        self._announce("stopping")
        # An arm that is stopped while the gains rise needs the full stiffness.
        self._gain = 1.0
        self._heard_at = self._clock.now()
        # Drivers may raise SystemExit and KeyboardInterrupt too; the user's requests come by
        # ``self._stop``.
        with contextlib.suppress(BaseException):
            self._switch_off(self._watch.to_switch_off)
            self._switch_off_reversed()
            carried = self._carry_from(self._reference)
            self._stop_phase(carried, LONGEST_STOP)
            if self._settings.park is not None and not self._stop.insisted:
                self._stop_phase(self._lower_from(carried.last), LONGEST_LOWERING)

    @property
    def _reversed_motors(self) -> str:
        """The beginning of a message that names motors which were switched off, and why.

        A weak motor whose load drives it fast is switched off, too: the words name both causes.
        """
        labels = [self._session.joints[j].label for j in np.flatnonzero(self._turned)]
        if not labels:
            return ""
        return (
            f"{', '.join(labels)} was switched off, as its joint went against its commands (its "
            "torque or position has the other sign, or something stronger than it drives the "
            "joint); seen first: "
        )

    def _switch_off(self, joints: Mask) -> None:
        """Disable the motors of joints (n,), which get no command any more."""
        self._session.switch_off(joints)
        self._watch.to_switch_off |= joints
        self._watch.failed |= joints

    def _switch_off_reversed(self) -> None:
        """Disable the motor that turns against its command, if one does.

        Where another motor does not drive, its link falls and throws the other joints; and of late
        answers it cannot be told.
        """
        watch = self._watch
        if np.any(watch.failed & ~self._turned) or watch.health.is_untimely:
            return
        # What fails here must not keep the stop from carrying the arm.
        with contextlib.suppress(Exception):
            q, _ = self._session.believed_motion
            found = self._reversal.search(self._holding.inertia(q))
            if np.any(found):
                self._switch_off(found)
                self._turned |= found
                self._reversal.restart(self._clock.now())

    def _switch_off_misled(self, replies: Replies) -> None:
        """Disable motors whose position does not go as their joint does: they wind it up."""
        misled = self._watch.misled_joints(replies) & ~self._watch.to_switch_off
        if np.any(misled):
            self._switch_off(misled)

    def _carry_from(self, reference: Reference) -> CarriedStop:
        """Return the reference that stops the arm, from the last reference and the believed state.

        A joint that left its path in the direction of its feed-forward torque gets no such torque
        any more, because it is wrong; a joint that sank against the torque would sink farther
        without it.
        """
        watch = self._watch
        settings = self._settings
        q, qd = self._trusted_motion
        limit = np.array(settings.tracking)
        if self._phase.stands:
            limit = watch.standing_limit(q, reference.position, reference.torque)
        has_left = np.abs(q - reference.position) > limit
        is_pushed = watch.is_pushed(q, reference.position, reference.torque)
        if self._holding.is_model:
            pose = np.where(np.isfinite(q), q, reference.position)
            carrying_torque = self._holding.torque(pose)
        else:
            # While gains rise, the mean feed-forward torque is less than the torque that carries.
            is_rising = self._phase.rises
            carrying_torque = reference.torque if is_rising else watch.fed_torque
            carrying_torque = np.where(
                np.isfinite(reference.weight), reference.weight, carrying_torque
            )
        fed = np.where(has_left & is_pushed, 0.0, carrying_torque)
        # The position of a joint that jumped without stiffness may not be the one that its motor
        # controls: stiffness could push it on.
        is_loose = watch.stuck & (self._follower.stiffness == 0.0) & np.isfinite(q)
        position = np.where(is_loose, q, self._session.sent_position)
        return CarriedStop(
            settings,
            reference._replace(position=position),
            q,
            qd,
            fed=np.nan_to_num(fed),
            stuck=watch.stuck,
            limits=self._session.limits,
            deviation=self._session.torque_deviation,
            limp=is_loose | self._session.is_misled,
        )

    def _stop_phase(self, reference: Follower, duration: float) -> None:
        """Follow a reference in a stop, at most for ``duration`` [s]; errors are suppressed.

        The phase ends early when the arm has come to rest, when commands have no effect any more,
        or when the user insists.
        """
        self._follower = reference
        origin = self._timer.next_deadline
        while self._timer.next_deadline <= origin + duration:
            deadline = self._timer.wait(lenient=True)
            silent = self._clock.now() - self._heard_at > LONGEST_SILENCE
            # Where all motors have failed or are silent, commands have no effect any more.
            hopeless = silent or np.all(self._watch.failed)
            if hopeless or self._stop.insisted or reference.is_done:
                return
            # A bus that fails now may work again in the next cycle.
            with contextlib.suppress(BaseException):
                target = reference(deadline - origin)
                replies, acted = self._exchange(target, braking=True)
                self._switch_off_misled(replies)
                self._switch_off_reversed()
                if self._recorder:
                    time = self._clock.now() - self._origin
                    self._recorder.write(
                        time, self._origin, replies, acted, mark="# stop: "
                    )


class StopRequest:
    """Stores requests to end a run, and whether it has to end at once.

    The first request brings the arm to rest before it is disabled. Only a second interrupt by a
    person (Ctrl-C) means "at once, even if the arm drops": hang-up and termination signals come in
    bursts when a terminal is closed or a computer shuts down.

    A run that prints into a pipe which nobody reads any more comes to rest, too, as at a hang-up.

    Args:
        now: returns the time by which interrupts are told apart [s].
        outputs: text streams into which the run prints; none are watched by default.

    Attributes:
        reason: reason of the first request; "" before.
        insisted: whether the run has to end at once.
    """

    def __init__(
        self, now: Callable[[], float] = time.monotonic, outputs: Sequence[Any] = ()
    ) -> None:
        self._outputs = outputs
        self._is_unread: Callable[[], bool] = lambda: False
        self.reason = ""
        self.insisted = False
        self._now = now
        self._interrupted_at = float("inf")

    def __call__(self, reason: str, insist: bool = False) -> None:
        """Request a stop for a ``reason``; with ``insist``, at once."""
        self.reason = self.reason or reason
        self.insisted |= insist

    @contextlib.contextmanager
    def on_signals(self) -> Iterator[None]:
        """Let signals that ask the program to end request a stop inside the block.

        So does Ctrl-Z: watchdogs would let go of the arm of a program that is suspended.
        """
        signals = handle_stop_signals(self._handle, further=SUSPENSION)
        with watched_outputs(self._outputs) as self._is_unread, signals:
            yield

    def look_at_outputs(self) -> None:
        """Request a stop where nobody reads any more what the run prints."""
        if self._is_unread():
            self("stopped because nobody reads its output any more")

    def _handle(self, number: int, frame: Any) -> None:
        """Request a stop for a signal, at once for a second interrupt by another key press.

        ``number`` is the signal's number; ``frame`` is not used.
        """
        insists = False
        if number == signal.SIGINT:
            now = self._now()
            self._interrupted_at = min(self._interrupted_at, now)
            insists = now - self._interrupted_at > SAME_KEY_PRESS
        self(f"stopped by {signal.Signals(number).name}", insist=insists)
