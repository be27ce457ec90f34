"""Playing a trajectory on motors: enable, approach, play, come to rest; or stop when it must.

The player knows motors and time, not physics: whether a real arm, a simulated one or a test double
answers makes no difference to it.
"""

from __future__ import annotations

import contextlib
import gc
import sys
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.damiao import references as paths
from robot_sysid.damiao import supervision
from robot_sysid.damiao.bus import SystemClock
from robot_sysid.damiao.protocol.codec import MitCommand
from robot_sysid.damiao.recorder import MeasurementRecorder
from robot_sysid.damiao.references import HoldingCheck, Reference, ReferenceFunction, hold
from robot_sysid.damiao.session import MotorSession, Replies
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.errors import HardwareAbort, words_of
from robot_sysid.records import Array


class CycleTimer:
    """Hands out absolute deadlines [s]: a late cycle is skipped, lateness does not add up."""

    def __init__(self, clock: SystemClock, period: float, max_lateness: float) -> None:
        self._clock, self.period, self.max_lateness = clock, period, max_lateness
        self._start = clock.now() + period
        self._index = 0
        self.skipped = 0
        self._lateness = array("f")

    @property
    def next_deadline(self) -> float:
        """When the next cycle is due [s]."""
        return self._start + self._index * self.period

    def wait(self, lenient: bool = False) -> float:
        """Sleep until the next cycle is due and return its deadline [s].

        Whole cycles that have already passed are skipped, never replayed. Unless ``lenient``, one
        that is too late raises HardwareAbort.
        """
        deadline = self.next_deadline
        self._clock.sleep_until(deadline)
        late = self._clock.now() - deadline
        self._lateness.append(late)
        skip = max(int(late / self.period), 0)
        self.skipped += skip
        self._index += skip + 1
        if late > self.max_lateness and not lenient:
            raise HardwareAbort(
                f"the computer was {1e3 * late:.1f} ms late for a control cycle, limit "
                f"{1e3 * self.max_lateness:g} ms; close other programs or lower --rate"
            )
        return deadline + skip * self.period

    def lateness(self, percentile: float) -> float:
        """Return a percentile of how late cycles started [s]."""
        return float(np.percentile(self._lateness, percentile)) if self._lateness else 0.0


# Stiffness and the torque that carries the arm come in together, in this share of the ramp: before
# the arm has sunk. For the rest of it the arm is watched while it should stand.
_LIFT_SHARE = 0.2
# Of a cycle: how long replies are waited for, and at least, where it began late. The rest is for
# the checks; seven motors' commands and replies take 1.9 of 4 ms on classic CAN.
_REPLY_SHARE, _LEAST_REPLY_SHARE = 0.9, 0.3
# Judgements: how often scales are judged, the progress is told [s], and over how many cycles the
# torque that holds the arm is averaged.
_SCALING_CHECK_CYCLES, _PROGRESS_INTERVAL, _STILL_SAMPLES = 50, 0.1, 100
# A busy thread gives way after this long [s]; Python's own default is more than a control cycle.
_SWITCH_INTERVAL = 2e-4
# Nothing heard for longer than this while braking: the watchdogs (0.1 s, and half as much again)
# have stopped the motors, or the bus is gone [s].
_DEAF = 0.15


@dataclass(frozen=True)
class PlayReport:
    """How a run went: cycles while playing, and those skipped because the computer was late.

    Lateness is in [s]; commands that were missed and the tracking error [rad] are (n,).
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
        stop: polled in every cycle.
        recorder: gets every cycle of the trajectory itself; None keeps nothing.
        on_phase, on_progress: told of new phases and of the time played so far [s]; neither may
            raise or wait.
        park: where to leave the arm: "rest", "start", or (n,) positions [rad]; None where it ends.
        holding: says what holds the arm where it stands, and is called with positions and torques
            (n,) of the arm held still there and at the first point; may raise HardwareAbort.
        orders: in which of ``references.ORDERS`` joints go to the first point and are parked.
    """

    def __init__(
        self,
        session: MotorSession,
        settings: PlaySettings,
        stop: supervision.StopRequest,
        recorder: MeasurementRecorder | None,
        on_phase: Callable[[str], None],
        on_progress: Callable[[float], None],
        park: str | Array | None,
        holding: HoldingCheck,
        orders: Sequence[str],
    ) -> None:
        self._session, self._clock, self._settings = session, session.clock, settings
        self._stop, self._recorder = stop, recorder
        self._announce, self._on_progress = on_phase, on_progress
        _, velocity_step, torque_step = session.steps
        self._supervisor = supervision.Supervisor(session.joints, settings, velocity_step)
        # Without stiffness there is next to none: 0 / 0 would tell nothing of any joint.
        fades = settings.period * np.maximum(settings.kp, 1e-9) / np.array(settings.kd)
        self._velocity_check = supervision.VelocityScalingCheck(velocity_step, fades)
        self._torque_check = supervision.TorqueScalingCheck(torque_step, session.peak_torque)
        self._timer: CycleTimer
        self._kp, self._kd = np.array(settings.kp), np.array(settings.kd)
        self._gain, self._standing, self._rising = 0.0, True, False
        self._reference: Reference | None = None
        self._command: MitCommand | None = None
        self._measured = np.full((2, session.n_joints), np.nan)
        self._heard_at = 0.0
        self._cycles = self._played = 0
        self._told_at = -np.inf
        self._park, self._holding, self._orders = park, holding, orders
        self._lowering: paths.Lowering | None = None
        self._still: list[Array] = []

    def play(self, trajectory: ReferenceFunction, duration: float) -> PlayReport:
        """Enable the motors, play ``trajectory`` and come to rest; disabling is the session's job.

        The trajectory is asked at times that never go back, up to its duration [s]. HardwareAbort
        tells the cause when motors that still answer have been brought to rest.
        """
        with _undisturbed():
            try:
                self._run_phases(trajectory, duration)
            except BaseException as error:
                self._stop_gently()
                if isinstance(error, HardwareAbort):
                    raise
                raise HardwareAbort(f"{type(error).__name__}: {words_of(error)}") from error
        timer, watched = self._timer, self._supervisor
        counts = self._played, timer.skipped, timer.lateness(50.0), timer.lateness(99.0)
        return PlayReport(*counts, watched.total_missed, watched.worst_tracking)

    def _run_phases(self, trajectory: ReferenceFunction, duration: float) -> None:
        settings = self._settings
        first = trajectory(0.0)
        self._stop_if_asked()
        self._announce("enabling the motors")
        start = self._session.enable()
        here = Reference(start, np.zeros_like(start), self._holding.torque(start))
        speed, shortest = settings.approach_speed, settings.approach_time
        order, carries = self._orders[0], self._holding.torque
        way, way_time = paths.approach(here, first, speed, shortest, order, carries)
        self._timer = CycleTimer(self._clock, settings.period, settings.max_lateness)
        self._announce("raising the gains")
        self._rising = True
        self._phase(hold(here), settings.ramp_time, standing=True)
        self._rising = False
        self._hold_and_compare(here)
        # What held the arm lately, or else what was fed forward.
        still = [torque for _, torque in self._still] or [here.torque]
        held = np.asarray(np.mean(still, axis=0))
        self._announce(f"moving to the first point, {order} ({way_time:.1f} s)")
        self._phase(way, way_time)
        self._hold_and_compare(first)
        self._announce(f"playing ({duration:.1f} s)")
        self._phase(trajectory, duration, record=True)
        self._announce("coming to rest")
        last = trajectory(duration)
        self._phase(hold(last), settings.rest_time)
        self._leave(last, Reference(start, np.zeros_like(start), held))

    def _hold_and_compare(self, reference: Reference) -> None:
        self._still.clear()
        self._phase(hold(reference), self._settings.rest_time, standing=True)
        if self._still:
            self._holding(*np.mean(self._still[len(self._still) // 2 :], axis=0))

    def _leave(self, last: Reference, stood: Reference) -> None:
        if self._park is None:
            return
        if isinstance(self._park, str) and self._park == "rest":
            self._announce("lowering the arm")
            self._phase(self._lower_from(last), paths.LONGEST)
            return
        target, carries = stood, self._holding.torque
        if not isinstance(self._park, str):
            beyond = last.torque - carries(last.position)
            target = Reference(self._park, np.zeros_like(self._park), carries(self._park) + beyond)
        speed, order = self._settings.approach_speed, self._orders[-1]
        way, time = paths.approach(last, target, speed, 1.0, order, carries)
        self._announce(f"parking, {order} ({time:.1f} s)")
        self._phase(way, time)
        self._phase(hold(target), self._settings.rest_time)

    def _lower_from(self, begin: Reference) -> paths.Lowering:
        speed, peak = self._settings.approach_speed, self._session.peak_torque
        self._lowering = paths.Lowering(begin, speed, peak)
        return self._lowering

    @property
    def _lowering_is_done(self) -> bool:
        return self._lowering is not None and self._lowering.done

    def _phase(
        self,
        reference: ReferenceFunction,
        length: float,
        standing: bool = False,
        record: bool = False,
    ) -> None:
        origin, self._standing = self._timer.next_deadline, standing
        # Half a period of slack keeps the last sample in spite of rounding.
        end = origin + length + 0.5 * self._settings.period
        while self._timer.next_deadline < end and not self._lowering_is_done:
            deadline = self._timer.wait()
            time = min(deadline - origin, length)
            wanted = reference(time)
            self._stop_if_asked()
            try:
                replies, acted = self._cycle(wanted, deadline)
            except BaseException:
                # What the exchange had collected when it was cut short is recorded.
                partial = self._session.last_replies
                if record and partial is not None and self._command is not None:
                    self._keep(time, origin, partial, self._command)
                raise
            if record:
                self._keep(time, origin, replies, acted)
            self._check(replies, acted)

    def _stop_if_asked(self) -> None:
        if self._stop.count:
            raise HardwareAbort(self._stop.reason)
        failure = self._recorder.failure if self._recorder else None
        if failure is not None:
            raise HardwareAbort(f"cannot record: {words_of(failure)}")

    def _cycle(self, reference: Reference, deadline: float) -> tuple[Replies, MitCommand]:
        """Exchange one command; return the replies and the command they were sampled under."""
        lift_time = _LIFT_SHARE * self._settings.ramp_time
        self._gain = min(self._gain + self._settings.period / lift_time, 1.0)
        before, command = self._command, self._command_for(reference)
        replies = self._session.exchange(command, self._reply_deadline(deadline))
        self._supervisor.update(replies)
        self._reference, self._command = reference, replies.command
        self._note(replies)
        return replies, before or command

    def _note(self, replies: Replies) -> None:
        now = np.stack([replies.feedback.position, replies.feedback.velocity])
        self._measured = np.where(replies.answered, now, self._measured)
        if self._lowering is not None:
            old, new = self._lowering.torque, replies.feedback.torque
            self._lowering.torque = np.where(replies.answered, new, old)
        if np.any(replies.answered):
            self._heard_at = self._clock.now()

    def _keep(self, time: float, origin: float, replies: Replies, acted: MitCommand) -> None:
        self._played += 1
        if self._recorder:
            self._recorder.write(time, origin, replies, acted)
            self._recorder.end_cycle()
        if time - self._told_at >= _PROGRESS_INTERVAL:
            self._told_at = time
            self._on_progress(time)

    def _check(self, replies: Replies, acted: MitCommand) -> None:
        self._supervisor.check(replies, acted, self._standing, self._rising)
        feedback = replies.feedback
        self._velocity_check.add(replies.time, feedback.position, feedback.velocity)
        told = acted.motor_torque(feedback.position, feedback.velocity)
        self._torque_check.add(told, feedback.torque, feedback.velocity)
        if np.all(replies.answered):
            self._still.append(np.stack([feedback.position, feedback.torque]))
            del self._still[:-_STILL_SAMPLES]
        self._cycles += 1
        if self._cycles % _SCALING_CHECK_CYCLES == 0:
            self._check_scaling()

    def _check_scaling(self) -> None:
        torque, moved = self._torque_check.worst(), self._velocity_check.worst()
        for found, words in (
            (torque, "reports {:.2f} times the torque that it was told to make: its TMAX register "
            "does not describe its torques, or its torque ratio is another"),
            (moved, "moves {:.3f} times as far as its velocity says, and sampling does not explain "
            "it: one of the two has another scale; turn the joint by hand by a known angle and "
            "compare with 'motors monitor', before anything is changed"),
        ):  # fmt: skip
            if found:
                j, factor = found
                raise HardwareAbort(f"{self._session.joints[j].label} {words.format(factor)}")

    def _command_for(self, reference: Reference) -> MitCommand:
        position, velocity, torque = reference
        return MitCommand(position, velocity, self._gain * self._kp, self._kd, self._gain * torque)

    def _reply_deadline(self, deadline: float) -> float:
        period = self._settings.period
        least = self._clock.now() + _LEAST_REPLY_SHARE * period
        return max(deadline + _REPLY_SHARE * period, least)

    def _stop_gently(self) -> None:
        """Brake and hold the motors that still answer, whatever else goes wrong meanwhile."""
        if self._reference is None:
            return
        self._announce("stopping")
        # What holds an arm that was stopped while the gains rose is its full stiffness.
        self._gain = 1.0
        self._heard_at = self._clock.now()
        # Drivers raise SystemExit and KeyboardInterrupt too; people's wishes come by ``stop``.
        with contextlib.suppress(BaseException):
            start = self._stop_start(self._reference)
            braking, duration = paths.come_to_rest(start, self._settings.deceleration)
            rest = hold(braking(duration))
            for reference, length in ((braking, duration), (rest, self._settings.rest_time)):
                self._stop_phase(reference, length)
            if self._park is not None and not self._stop.insisted:
                self._stop_phase(self._lower_from(rest(0.0)), paths.LONGEST)

    def _stop_start(self, reference: Reference) -> Reference:
        """Return where braking begins.

        A joint that is far from where it should be, or from how fast it should be, brakes from
        where it is. Where it is on the side to which its feed-forward torque pushes, this torque
        has just proved wrong; where it sank against it, it would sink farther without.
        """
        settings, (q, qd) = self._settings, self._measured
        away = np.abs(q - reference.position) > settings.max_tracking_error
        fast = np.abs(qd - reference.velocity) > settings.max_speed_error
        place, watched = (reference.position, reference.torque), self._supervisor
        left = watched.has_left(q, *place) if self._standing else away
        wrong = (away | fast | left) & watched.is_pushed(q, *place)
        return Reference(
            np.where(away | fast, q, reference.position),
            np.where(away, 0.0, reference.velocity),
            np.where(wrong, 0.0, reference.torque),
        )

    def _stop_phase(self, reference: ReferenceFunction, duration: float) -> None:
        origin = self._timer.next_deadline
        while self._timer.next_deadline <= origin + duration:
            deadline = self._timer.wait(lenient=True)
            silent = self._clock.now() - self._heard_at > _DEAF
            # Where all have failed or are silent, nothing that is sent has an effect any more.
            hopeless = bool(np.all(self._supervisor.failed)) or silent
            if hopeless or self._stop.insisted or self._lowering_is_done:
                return
            # A bus that fails now may work again in the next cycle.
            with contextlib.suppress(BaseException):
                self._stop_cycle(reference(deadline - origin), deadline)

    def _stop_cycle(self, wanted: Reference, deadline: float) -> None:
        # A motor that does not answer may still obey, so only failed ones are left out.
        driving = ~self._supervisor.failed
        command = self._command_for(Reference(*self._session.clipped(*wanted)))
        until = self._reply_deadline(deadline)
        replies = self._session.exchange(command, until, driving, regardless=True)
        self._supervisor.update(replies)
        self._note(replies)
        if self._recorder:
            self._recorder.end_cycle()


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Keep the garbage collector, and what happens aside, from pausing a control cycle."""
    was_on, interval = gc.isenabled(), sys.getswitchinterval()
    gc.collect()
    gc.disable()
    sys.setswitchinterval(_SWITCH_INTERVAL)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)
        if was_on:
            gc.enable()
