"""Playing a trajectory on motors: enable, approach, play, come to rest; or stop when it must.

The player knows motors and time, not physics: whether a real arm, a simulated one or a test double
answers makes no difference to it.
"""

from __future__ import annotations

import contextlib
import gc
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import FrameType

import numpy as np

from robot_sysid.damiao.bus.clock import Clock
from robot_sysid.damiao.play.cycle_timer import CycleTimer
from robot_sysid.damiao.play.recorder import MeasurementRecorder
from robot_sysid.damiao.play.sampler import (
    Reference,
    ReferenceFunction,
    approach,
    come_to_rest,
    hold,
)
from robot_sysid.damiao.play.session import MotorSession, Replies
from robot_sysid.damiao.play.settings import PlaySettings
from robot_sysid.damiao.play.supervision import Supervisor, VelocityScalingCheck
from robot_sysid.damiao.protocol.codec import MitCommand, Scaling
from robot_sysid.errors import HardwareAbort
from robot_sysid.interrupts import STOPPING
from robot_sysid.records import Array

# The torque that carries the arm is there early in the ramp, before the arm has sunk.
_LIFT_SHARE = 0.2
_REPLY_SHARE = 0.9
_LEAST_REPLY_SHARE = 0.3
_SCALING_CHECK_CYCLES = 50


@dataclass(frozen=True)
class PlayReport:
    """How a run went.

    Attributes:
        cycles: control cycles while playing.
        skipped: cycles left out because the computer was late.
        lateness_p50, lateness_p99: how late cycles started [s].
        missed: (n,) unanswered commands.
        worst_tracking: (n,) largest distance from the path [rad].
    """

    cycles: int
    skipped: int
    lateness_p50: float
    lateness_p99: float
    missed: Array
    worst_tracking: Array


class Player:
    """Plays references through a session.

    Args:
        session: the motors.
        clock: for the deadlines.
        settings: gains and limits.
        stop: polled in every cycle.
        recorder: gets every cycle of the trajectory itself; None keeps nothing.
        on_phase: called with a sentence when a new phase begins.
        on_progress: called with the time played so far [s].
    """

    def __init__(
        self,
        session: MotorSession,
        clock: Clock,
        settings: PlaySettings,
        stop: StopRequest,
        recorder: MeasurementRecorder | None,
        on_phase: Callable[[str], None],
        on_progress: Callable[[float], None],
    ) -> None:
        self._session, self._clock, self._settings = session, clock, settings
        self._stop, self._recorder = stop, recorder
        self._announce, self._on_progress = on_phase, on_progress
        self._supervisor = Supervisor(session.joints, settings)
        self._scaling_check = VelocityScalingCheck(session.scaling.steps[1])
        self._timer: CycleTimer
        self._kp, self._kd = np.array(settings.kp), np.array(settings.kd)
        self._gain = 0.0
        self._reference: Reference | None = None
        self._command: MitCommand | None = None
        self._measured = np.full(session.n_joints, np.nan)
        self._cycles = self._played = 0

    def play(self, trajectory: ReferenceFunction, duration: float) -> PlayReport:
        """Enable the motors, play ``trajectory`` and come to rest; disabling is the session's job.

        Args:
            trajectory: reference as a function of time; asked at times that never go back.
            duration: its length [s].

        Raises:
            HardwareAbort: with the cause; motors that still answer have been brought to rest.
        """
        with _undisturbed():
            try:
                self._run_phases(trajectory, duration)
            except BaseException as error:
                self._stop_gently()
                if isinstance(error, HardwareAbort):
                    raise
                raise HardwareAbort(f"{type(error).__name__}: {error}") from error
        return self._report()

    def _run_phases(self, trajectory: ReferenceFunction, duration: float) -> None:
        settings = self._settings
        first = trajectory(0.0)
        self._announce("enabling the motors")
        start = self._session.enable()
        here = Reference(start, np.zeros_like(start), first.torque)
        way, way_time = approach(start, first, settings.approach_speed, settings.approach_time)
        self._timer = CycleTimer(self._clock, settings.period, settings.max_lateness)
        self._announce("raising the gains")
        self._phase(hold(here), settings.ramp_time, ramp=True)
        self._announce(f"moving to the first point ({way_time:.1f} s)")
        self._phase(way, way_time)
        self._phase(hold(first), settings.rest_time)
        self._announce(f"playing ({duration:.1f} s)")
        self._phase(trajectory, duration, record=True)
        self._announce("coming to rest")
        self._phase(hold(trajectory(duration)), settings.rest_time)

    def _phase(
        self,
        reference: ReferenceFunction,
        duration: float,
        ramp: bool = False,
        record: bool = False,
    ) -> None:
        origin = self._timer.next_deadline
        # Half a period of slack keeps the last sample in spite of rounding.
        end = origin + duration + 0.5 * self._settings.period
        while self._timer.next_deadline < end:
            deadline = self._timer.wait()
            time = min(deadline - origin, duration)
            self._gain = time / duration if ramp else 1.0
            wanted = reference(time)
            if self._stop.count:
                raise HardwareAbort(self._stop.reason)
            try:
                replies, acted = self._cycle(wanted, deadline)
            except BaseException:
                self._keep_partial(time, origin, record)
                raise
            if record:
                self._keep(time, origin, replies, acted)
            self._check(replies, acted)

    def _cycle(self, reference: Reference, deadline: float) -> tuple[Replies, MitCommand]:
        """Exchange one command; return the replies and the command they were sampled under."""
        before, command = self._command, self._command_for(reference)
        replies = self._session.exchange(command, self._reply_deadline(deadline))
        self._supervisor.update(replies)
        self._reference, self._command = reference, replies.command
        position = replies.feedback.position
        self._measured = np.where(replies.answered, position, self._measured)
        return replies, before or command

    def _keep(self, time: float, origin: float, replies: Replies, acted: MitCommand) -> None:
        self._played += 1
        if self._recorder:
            self._recorder.write(time, origin, replies, acted)
            self._recorder.end_cycle()
        self._on_progress(time)

    def _keep_partial(self, time: float, origin: float, record: bool) -> None:
        """Record what an exchange had collected when it was cut short."""
        partial = self._session.last_replies
        if record and partial is not None and self._command is not None:
            self._keep(time, origin, partial, self._command)

    def _check(self, replies: Replies, acted: MitCommand) -> None:
        self._supervisor.check(replies, acted.position)
        feedback = replies.feedback
        self._scaling_check.add(replies.time, feedback.position, feedback.velocity)
        self._cycles += 1
        if self._cycles % _SCALING_CHECK_CYCLES == 0:
            self._check_scaling()

    def _check_scaling(self) -> None:
        found = self._scaling_check.worst()
        if found:
            j, slope = found
            raise HardwareAbort(
                f"motor {self._session.joints[j].can_id} (joint {j}) moves {slope:.3f} times as "
                "far as its velocity says: its VMAX register does not describe its velocities"
            )

    def _command_for(self, reference: Reference) -> MitCommand:
        return MitCommand(
            reference.position,
            reference.velocity,
            self._gain * self._kp,
            self._kd,
            min(self._gain / _LIFT_SHARE, 1.0) * reference.torque,
        )

    def _reply_deadline(self, deadline: float) -> float:
        period = self._settings.period
        least = self._clock.now() + _LEAST_REPLY_SHARE * period
        return max(deadline + _REPLY_SHARE * period, least)

    def _stop_gently(self) -> None:
        """Brake and hold the motors that still answer; gives up on any trouble or second wish."""
        if self._reference is None:
            return
        wishes = self._stop.count
        # The terminal may be gone; the arm has to brake all the same.
        with contextlib.suppress(Exception):
            self._announce("stopping")
        with contextlib.suppress(Exception):
            start = self._stop_start(self._reference)
            braking, duration = come_to_rest(start, self._settings.deceleration)
            rest = hold(braking(duration))
            for reference, length in ((braking, duration), (rest, self._settings.rest_time)):
                self._stop_phase(reference, length, wishes)

    def _stop_start(self, reference: Reference) -> Reference:
        """Return where braking begins; a joint far off its path stops where it is."""
        away = np.abs(self._measured - reference.position) > self._settings.max_tracking_error
        return Reference(
            np.where(away, self._measured, reference.position),
            np.where(away, 0.0, reference.velocity),
            reference.torque,
        )

    def _stop_phase(self, reference: ReferenceFunction, duration: float, wishes: int) -> None:
        origin = self._timer.next_deadline
        while self._timer.next_deadline <= origin + duration:
            deadline = self._timer.wait(lenient=True)
            if not self._supervisor.any_alive or self._stop.count > wishes:
                return
            # A motor that does not answer may still obey, so only failed ones are left out.
            driving = ~self._supervisor.failed
            inside = _within(reference(deadline - origin), self._session.scaling)
            command = self._command_for(inside)
            replies = self._session.exchange(command, self._reply_deadline(deadline), driving)
            self._supervisor.update(replies)
            if self._recorder:
                # A disk that is full must not keep the arm from braking.
                with contextlib.suppress(OSError):
                    self._recorder.end_cycle()

    def _report(self) -> PlayReport:
        return PlayReport(
            self._played,
            self._timer.skipped,
            self._timer.lateness(50.0),
            self._timer.lateness(99.0),
            self._supervisor.total_missed,
            self._supervisor.worst_tracking,
        )


def _within(reference: Reference, scaling: Scaling) -> Reference:
    limits = scaling.position, scaling.velocity, scaling.torque
    return Reference(*(np.clip(x, -limit, limit) for x, limit in zip(reference, limits)))


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Keep the garbage collector from pausing a control cycle."""
    was_on = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


class StopRequest:
    """Remembers whether somebody wants the run to end, and how often they asked.

    The first wish brings the arm to rest before it is disabled; a second one disables it at once.
    """

    def __init__(self) -> None:
        self.count = 0
        self.reason = ""

    def __call__(self, reason: str) -> None:
        """Ask for a stop."""
        self.count += 1
        self.reason = self.reason or reason

    @contextlib.contextmanager
    def on_signals(self) -> Iterator[None]:
        """Turn interrupt, terminate and hang-up signals into wishes inside the block."""
        before = {number: signal.signal(number, self._handle) for number in STOPPING}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self(f"stopped by {signal.Signals(number).name}")
